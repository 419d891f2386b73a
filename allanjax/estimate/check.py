"""Whether a recording is fit for its purpose, line by line, and how long it would have to be."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError, RecordingError
from allanjax.base.tables import html_table, text_table
from allanjax.base.wording import duration, finite_or_none
from allanjax.estimate.needed_length import TARGET, NeededLength, needed_lengths
from allanjax.estimate.rough import rough_fits
from allanjax.inspection import Inspection, inspect
from allanjax.inspection.checklist import Line, Verdict, lines_of, worst
from allanjax.inspection.spectral import bandwidth_in, spectrum_of
from allanjax.record.io.given import RecordingLike, as_recording
from allanjax.record.io.options import GapChoice
from allanjax.record.recording import Recording

SCHEMA_VERSION = 1
# Fewest samples that say how long to record.
_FEWEST = 64
_HEADINGS = ("check", "verdict", "reason")
_SYMBOLS = {"angle_random_walk": "N", "bias_instability": "B", "rate_random_walk": "K"}


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Check(ByValue):
    """Whether a recording is fit for the estimation of noise coefficients.

    Attributes:
        name, n, rate: the recording's name, number of samples and sample rate [Hz]; 0 if it cannot be read.
        lines: the checks, each with its name, a verdict "fine", "look" or "stop", and the reason in words.
        lengths: how long to record for N, B and K of each axis to be known to ± 20 %.
    """

    name: str
    n: int
    rate: float
    lines: tuple[Line, ...]
    lengths: tuple[NeededLength, ...] = ()

    @property
    def verdict(self) -> Verdict:
        """The worst verdict of the lines."""
        return worst(self.lines)

    @property
    def stops(self) -> tuple[Line, ...]:
        """The lines that say stop."""
        return tuple(line for line in self.lines if line.verdict == "stop")

    def __getitem__(self, name: str) -> Line:
        """The line of this name; AllanjaxError if there is none."""
        for line in self.lines:
            if line.name == name:
                return line
        raise AllanjaxError(f"no line {name!r}; there are {', '.join(line.name for line in self.lines)}")

    def summary(self) -> str:
        """One line of text: which checks say stop or look, and how many are fine."""
        parts = []
        for verdict in ("stop", "look"):
            names = [line.name for line in self.lines if line.verdict == verdict]
            parts += [f"{verdict}: {', '.join(names)}"] if names else []
        fine = sum(line.verdict == "fine" for line in self.lines)
        return "; ".join([*parts, f"{fine} of {len(self.lines)} checks are fine"])

    def to_dict(self) -> dict[str, Any]:
        """The check as plain dictionaries, lists, numbers and strings, for JSON."""
        return {
            "schema_version": SCHEMA_VERSION,
            "recording": {
                "name": self.name,
                "n": self.n,
                "rate_hz": self.rate,
                "duration_s": self.n / self.rate if self.rate else 0.0,
            },
            "verdict": self.verdict,
            "lines": [dataclasses.asdict(line) for line in self.lines],
            "lengths": [_length(length) for length in self.lengths],
        }

    def _title(self) -> str:
        name = f"{self.name}: " if self.name else ""
        if not self.rate:
            return f"{name}cannot be read as a recording"
        return f"{name}{self.n:,} samples at {self.rate:g} Hz ({duration(self.n / self.rate)})"

    def _cells(self) -> list[tuple[str, str, str]]:
        return [(line.name, line.verdict, line.reason) for line in self.lines]

    def __str__(self) -> str:
        return text_table(self._title(), _HEADINGS, self._cells())

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return html_table(self._title(), _HEADINGS, self._cells())


def check(
    recording: RecordingLike,
    *,
    vibrating: bool = False,
    rate: float | None = None,
    gyro_unit: str | None = None,
    accel_unit: str | None = None,
    names: Sequence[str] | None = None,
    gaps: GapChoice | None = None,
) -> Check:
    """Say line by line whether a recording is fit for the estimation of noise coefficients.

    Looked at are time stamps, repeated and interpolated samples, resolution, saturation, dead axes, motion,
    disturbances, lines, units by their plausibility, temperature, bandwidth, and the length that N, B and K
    need, for which these are estimated roughly. No structure is searched for: it takes seconds.

    Args:
        recording: what `read` returns; or samples [samples, axes], a data frame, or a file's path.
        vibrating: whether the platform moves or vibrates, and is to: motion is no reason to stop then.
        rate, gyro_unit, accel_unit, names: of an array, as `Recording.from_array` takes them; a data frame
            and a file may state their own.
        gaps: what to do about missing samples, as in `read`; of an array those that are nan.

    Returns:
        The lines. A file whose time stamps, or whose axes, allow no recording has one line, which says why.

    Raises:
        RecordingError, UnitError: what is given cannot be read for another reason, such as a missing unit.
    """
    try:
        given = as_recording(recording, rate, gyro_unit, accel_unit, names, gaps)
    except RecordingError as error:
        name = Path(recording).name if isinstance(recording, str | os.PathLike) else ""
        return unreadable(error, name)
    return check_of(given, inspect(given, vibrating=vibrating))


def unreadable(error: RecordingError, name: str) -> Check:
    """Check of what cannot be read because of its samples or time stamps; other errors are raised again."""
    if not error.about:
        raise error
    return Check(name, 0, 0.0, (Line(error.about, "stop", str(error)),))


def check_of(recording: Recording, seen: Inspection) -> Check:
    """Check of a recording that was inspected."""
    quiet = recording if seen.refusal else seen.quiet(recording)
    spectrum = spectrum_of(quiet.values, quiet.rate)
    widths = {name: spectrum and bandwidth_in(spectrum, k) for k, name in enumerate(quiet.names)}
    lengths = () if seen.refusal or quiet.n < _FEWEST else _lengths(quiet, seen, widths)
    lines = (*lines_of(recording, seen, widths), *_of_length(seen, lengths))
    return Check(recording.name, recording.n, recording.rate, lines, lengths)


def _lengths(
    quiet: Recording, seen: Inspection, widths: Mapping[str, float | None]
) -> tuple[NeededLength, ...]:
    """How long to record for N, B and K of each axis."""
    # Up to half of the bandwidth a filter passes nearly all.
    below = np.array([np.inf if width is None else width / 2.0 for width in widths.values()])
    results = (
        result.unmeasured(not_measured=why) if (why := seen.why_not(result.axis.name)) else result
        for result in rough_fits(quiet, below)
    )
    return tuple(length for result in results for length in needed_lengths(result, quiet.n, quiet.rate))


def _of_length(seen: Inspection, lengths: Sequence[NeededLength]) -> Iterator[Line]:
    """Lines on the length that N, B and K need."""
    for label, symbol in _SYMBOLS.items():
        own = [length for length in lengths if length.coefficient.label == label]
        name = f"length for {symbol}"
        if not own:
            short = f"fewer than {_FEWEST} samples"
            told = "there are no coefficients, see disturbances" if seen.refusal else short
            yield Line(name, "look", f"cannot be said: {told}")
        elif all(length.known for length in own):
            poorest = max(own, key=lambda length: length.relative_std)
            yield Line(name, "fine", f"{poorest}, other axes better" if len(own) > 1 else str(poorest))
        else:
            yield Line(name, "look", _together([length for length in own if not length.known]))


def _together(lengths: Sequence[NeededLength]) -> str:
    """Lengths in words, axes of which the same is told together."""
    axes: dict[str, list[str]] = {}
    for length in lengths:
        axes.setdefault(length.told(), []).append(length.coefficient.axis.name)
    return "; ".join(f"{', '.join(names)} {told}" for told, names in axes.items())


def _length(length: NeededLength) -> dict[str, Any]:
    """A needed length as a dictionary."""
    c = length.coefficient
    return {
        "axis": c.axis.name,
        "coefficient": c.label,
        "detected": c.detected,
        "relative_std": finite_or_none(length.relative_std),
        "target": TARGET,
        "needed_s": length.seconds,
        "of_size_si": c.value if c.detected else c.upper_limit,
        "reason": length.reason,
    }
