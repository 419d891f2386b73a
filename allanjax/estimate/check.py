"""Check, line by line, whether a recording is suitable for estimation, and how long it should be.

Rough fits find the powers of quantization, N, B and K that make the cosine spectrum most likely; errors
follow from the Fisher information. Nothing is compiled, no terms are chosen, no structure is searched.

The levels c_j² of the cosine spectrum (see `spectrum.cosine`) are independent and χ² with one degree of
freedom around the density S(f_j) = Σ p_a u_a(f_j), f_j = j·rate/2n, j = 1 … n−1, of terms with powers p_a.
So the Fisher information of n samples about the powers is

    F_ab = ½ Σ_j u_a(f_j) u_b(f_j)/S(f_j)²,

and no unbiased estimate of p_a has a standard deviation below √[F⁻¹]_aa. A longer recording adds lower
frequencies, where slow terms dominate, and more levels at all others.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float

from allanjax.base.chi_squared import beyond_doubt
from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError, RecordingError
from allanjax.base.normal import ONE_SIDED_95, TWO_SIDED_68, TWO_SIDED_95
from allanjax.base.tables import Column, Tabled, columns_from
from allanjax.base.wording import clauses, duration, finite_or_none, plain, record_size, significant
from allanjax.estimate.evidence import Ramps, bound, information, power_fits
from allanjax.estimate.inference import estimate_of
from allanjax.estimate.spectral.components import columns_of
from allanjax.estimate.spectral.fit import chi_squared
from allanjax.inspection import Inspection, inspect
from allanjax.inspection.checks import Line, Verdict, lines_of, worst
from allanjax.inspection.spectral import bandwidth_in, spectrum_of
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model
from allanjax.noise.terms import NoiseTerm, basic_terms
from allanjax.record.io.given import RecordingLike, as_recording
from allanjax.record.io.options import GapChoice
from allanjax.record.recording import Axis, Recording
from allanjax.spectrum.cosine import Bins, SpectralStatistics, joint_statistics

SCHEMA_VERSION = 1
#: Relative standard deviation at which a coefficient counts as known, and the coefficients of interest.
TARGET, _ASKED = 0.2, ("N", "B", "K")
_TARGET_WORDS = f"±{100.0 * TARGET:.0f} %"
#: Longest recording that is proposed [s], a month; and the fewest samples of a recording for which it is.
LONGEST, _FEWEST = 30.0 * 86400.0, 64
# Lengths that are tried, and levels an octave that stand for all of them above the lowest 64.
_LENGTHS, _PER_OCTAVE = 40, 32
# Fits of an axis, each without the lines that exceed the one before; and the scatter beyond which a level
# contains a line.
_ROUNDS, _LINE = 3, 6.0
# Characters of a finding that the table has room for; a longer one is cut, and printed in full below.
_CELL = 71
_Terms: TypeAlias = Float[np.ndarray, " terms"]
Trial: TypeAlias = tuple[float, Float[np.ndarray, "terms m"], Float[np.ndarray, " m"]]


@dataclasses.dataclass(frozen=True, eq=False)
class NeededLength(ByValue):
    """How well a coefficient is known, and how long to record for a standard deviation of 20 %.

    Attributes:
        coefficient: the estimate of N, B or K [SI].
        relative_std: its relative standard deviation now; nan if it is not detected or not measured.
        now: length [s] that was fitted.
        seconds: length [s] at which the Cramér–Rao bound is 20 %, or as much less as the standard deviation
            is above the bound now; for an undetected coefficient as if it were at its 95 % upper limit; None
            if that is more than a month, or unknown.
        reason: why it is unknown; "" if it is known.
    """

    coefficient: Estimate
    relative_std: float
    now: float
    seconds: float | None
    reason: str = ""

    @property
    def known(self) -> bool:
        """Whether the coefficient is known to ±20 % already."""
        return self.relative_std <= TARGET

    def __str__(self) -> str:
        return f"{self.coefficient.axis.name}: {self.describe()}"

    def describe(self) -> str:
        """Return what is known and how long to record, in words, without the name of the axis."""
        needed = f"{in_words(self.seconds)} would give {_TARGET_WORDS}"
        if not math.isnan(self.relative_std):
            known = f"known to ±{plain(100.0 * self.relative_std, 2)} %"
            return known if self.known else f"{known}, {self.reason or needed}"
        if self.reason:
            return f"unknown, {self.reason}"
        c = self.coefficient.in_unit()
        below = f"not detected (< {significant(c.upper_limit or 0.0)} {c.unit}, 95 %)"
        if self.seconds is not None and self.seconds <= self.now:
            return f"{below}, at that limit it would usually be detected by now"
        return f"{below}; if it were at that limit, {needed}"

    def to_dict(self) -> dict[str, Any]:
        """Return the length as a dictionary, for JSON."""
        c = self.coefficient
        return {
            "axis": c.axis.name,
            "coefficient": c.label,
            "detected": c.detected,
            "relative_std": finite_or_none(self.relative_std),
            "target": TARGET,
            "needed_s": self.seconds,
            "of_size_si": c.value if c.detected else c.upper_limit,
            "reason": self.reason,
        }


def random_terms() -> list[NoiseTerm]:
    """The basic terms whose lengths are known: quantization, N, B and K."""
    return [term for term in basic_terms().terms if not term.deterministic]


def _lengths(
    quiet: Recording, inspection: Inspection, widths: Mapping[str, float | None]
) -> Iterator[NeededLength]:
    """Yield how long to record for N, B and K of each axis, by rough fits to its spectrum."""
    terms = random_terms()
    bins, statistics = joint_statistics((quiet.values,), quiet.rate)
    columns, trials = columns_of(terms, bins).mean(axis=1), [*trial_lengths(terms, quiet.rate, quiet.n)]
    for row, axis in enumerate(quiet.axes):
        # Up to half of its bandwidth a filter passes nearly everything.
        width = widths[axis.name]
        inside = bins.frequency <= (np.inf if width is None else width / 2.0)
        own = SpectralStatistics(*(x[row][inside] for x in statistics))
        power, std, fits = _rough_fit(own, bins.size[inside], columns[:, inside])
        found = [_estimate(axis, *x) for x in zip(terms, power.tolist(), std.tolist(), strict=True)]
        detected = np.array([c.value**2 for c in found])
        for k, c in enumerate(found):
            if c.symbol in _ASKED:
                c = c.unmeasured() if inspection.why_not(axis.name) else c
                yield _needed(c, k, detected, fits, trials)


def _rough_fit(
    statistics: SpectralStatistics, size: Float[np.ndarray, " m"], columns: Float[np.ndarray, "terms m"]
) -> tuple[_Terms, _Terms, bool]:
    """Powers of the terms in the spectrum of an axis, their standard deviations, and whether they fit."""
    level, used = statistics.squares / size, np.ones(len(size))
    # Levels are averaged over neighbours at first, as single ones scatter.
    logs = np.log(np.maximum(level, 1e-300))
    rough = np.exp(np.convolve(np.pad(logs, 3, mode="edge"), np.ones(7) / 7.0, "valid"))
    for _ in range(_ROUNDS):
        ramp = Ramps(statistics.cross * used, statistics.gram * used, np.ones(1, bool))
        (power,), _ = power_fits(level, used * size / 2.0, rough, columns[None], ramps=ramp)
        mean = power @ columns
        left, shape, _ = (x[0] for x in ramp.removed(level, size / 2.0, mean[None]))
        used = (((left / mean - 1.0) * np.sqrt(shape) < _LINE) | (size == 1)).astype(float)
    chi2 = chi_squared(left / mean, 2.0 * shape * used)
    F = information(columns, mean, shape * used)
    std = np.array([bound(F, gradient, power > 0.0) for gradient in np.eye(len(power))])
    return power, std, bool(chi2 <= beyond_doubt(np.asarray(max(used.sum() - 3.0, 1.0))))


def _estimate(axis: Axis, term: NoiseTerm, power: float, std: float) -> Estimate:
    """Amplitude of a term from its power, with errors and limits."""
    detected, value = power > ONE_SIDED_95 * std, math.sqrt(power)
    levels = (-TWO_SIDED_95, TWO_SIDED_95, -TWO_SIDED_68, TWO_SIDED_68, ONE_SIDED_95)
    ends = [math.sqrt(max(power + z * std, 0.0)) for z in levels]
    value, std = (value, std / 2.0 / value) if detected else (0.0, math.nan)
    return estimate_of(Model((term,)).parameters[0], axis, value, std, ends, detected)


def trial_lengths(terms: Sequence[NoiseTerm], rate: float, n: int) -> Iterator[Trial]:
    """Yield the recording's length [s] and others, each with levels of terms of unit power there.

    Last comes how many levels each of these stands for.
    """
    longest = max(LONGEST * rate, 2.0 * _FEWEST)
    units = [term.sampled(rate).with_unit_amplitude() for term in terms]
    for samples in [n, *np.geomspace(_FEWEST, longest, _LENGTHS)]:
        bins = Bins.of(round(samples), rate, per_octave=_PER_OCTAVE)
        levels = np.array([unit.sampled_psd(bins.frequency, rate) for unit in units])
        yield samples / rate, levels, bins.size.astype(float)


def _needed(c: Estimate, k: int, power: _Terms, fits: bool, trials: Sequence[Trial]) -> NeededLength:
    """How long to record for one coefficient of an axis, given the powers of its detected terms."""
    now, std = trials[0][0], c.std / c.value if c.detected and c.measured else math.nan
    if not c.measured:
        return NeededLength(c, std, now, None, "the fit does not describe this sensor")
    if std <= TARGET:
        return NeededLength(c, std, now, now)
    if c.detected and not fits:
        return NeededLength(c, std, now, None, "the length is unknown as the model does not fit the data")
    if not c.detected:
        power = power + (np.arange(len(power)) == k) * (c.upper_limit or 0.0) ** 2
    size = 2.0 * float(power[k])
    found = size * std if c.detected else 0.0
    seconds = length_for(size * TARGET, found, np.eye(len(power))[k], power, trials)
    return NeededLength(c, std, now, seconds)


def length_for(
    target: float,
    std: float,
    gradient: _Terms,
    power: _Terms,
    trials: Sequence[Trial],
) -> float | None:
    """Length [s] at which the Cramér–Rao bound of a quantity is `target`; None if that is more than a month.

    It is as much longer as the standard deviation is above the bound now. The quantity has this gradient by
    the powers of the terms.
    """
    of_powers = (information(unit, power @ unit, size / 2.0) for _, unit, size in trials)
    levels = np.array([bound(F, gradient, power > 0.0) for F in of_powers])
    # The fit cannot be better than the bound.
    target *= float(levels[0]) / max(std, float(levels[0]))
    if levels[-1] > target:
        return None
    # The bound falls with the length.
    log, known = np.log([seconds for seconds, *_ in trials[1:]]), -np.log(np.minimum.accumulate(levels[1:]))
    return float(np.exp(np.interp(-np.log(target), known, log)))


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Check(ByValue, Tabled):
    """Whether a recording is suitable for the estimation of noise coefficients.

    Attributes:
        name, n, rate: the recording's name, number of samples and sample rate [Hz]; 0 if it cannot be read.
        lines: the checks, each with its name, a verdict "fine", "look" or "stop", and the reason in words.
        lengths: how long to record for N, B and K of each axis to be known to ±20 %.
        notes: assumptions and findings of the reader.
    """

    name: str
    n: int
    rate: float
    lines: tuple[Line, ...]
    lengths: tuple[NeededLength, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def verdict(self) -> Verdict:
        """The worst verdict of the lines."""
        return worst(self.lines)

    @property
    def stops(self) -> tuple[Line, ...]:
        """The lines whose verdict is stop."""
        return tuple(self._of("stop"))

    def __getitem__(self, name: str) -> Line:
        """Return the line of this name; AllanjaxError if there is none."""
        names = [line.name for line in self.lines]
        if name not in names:
            raise AllanjaxError(f"no line {name!r}; lines are {', '.join(names)}")
        return self.lines[names.index(name)]

    def summary(self) -> str:
        """Return one line of text: which checks read stop or look, and how many are fine."""
        parts = [f"{verdict}: {names}" for verdict in ("stop", "look") if (names := self._names(verdict))]
        return "; ".join([*parts, f"{len(self._of('fine'))} of {len(self.lines)} checks are fine"])

    def to_dict(self) -> dict[str, Any]:
        """Return the check as plain dictionaries, lists, numbers and strings, for JSON."""
        seconds = self.n / self.rate if self.rate else 0.0
        return {
            "schema_version": SCHEMA_VERSION,
            "recording": {"name": self.name, "n": self.n, "rate_hz": self.rate, "duration_s": seconds},
            "verdict": self.verdict,
            "lines": [dataclasses.asdict(line) | {"reason": line.reason} for line in self.lines],
            "lengths": [length.to_dict() for length in self.lengths],
            "notes": list(self.notes),
        }

    def _title(self) -> str:
        return record_size(self.n, self.rate) if self.rate else "cannot be read as a recording"

    def _of(self, *verdicts: str) -> list[Line]:
        return [line for verdict in verdicts for line in self.lines if line.verdict == verdict]

    def _names(self, verdict: str) -> str:
        return ", ".join(line.name for line in self._of(verdict))

    def _tables(self) -> list[list[Column]]:
        lines = self._of("stop", "look")
        rows = [(line.name, line.verdict, line.finding) for line in lines]
        return [columns_from(("check", "verdict", "reason"), rows)] if rows else []

    def _notes(self) -> Iterator[str]:
        for line in self._of("stop", "look"):
            more = line.reason if len(line.finding) > _CELL else line.advice
            # The lengths of all axes are in `lengths`, and in JSON.
            if more and not line.name.startswith("length for"):
                yield f"{line.name}: {more}"
        yield f"fine: {self._names('fine') or 'none'}"
        yield from (f"reading: {note}" for note in self.notes)


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
    """Check, line by line, whether a recording is suitable for the estimation of noise coefficients.

    The lines are on time stamps, repeated and interpolated samples, resolution, saturation, dead axes,
    motion, disturbances, spectral lines, plausible units, temperature, bandwidth, and the length needed for
    N, B and K, which are estimated roughly.

    Args:
        recording: what `read` returns; or samples [samples, axes], a data frame, or a file's path.
        vibrating: whether the platform is meant to move or vibrate; then motion is not a reason to stop.
        rate, gyro_unit, accel_unit, names: as in `Recording.from_array` for an array; a data frame and a
            file may state their own.
        gaps: what to do about missing samples, as in `read`; in an array these are nan.

    Returns:
        The check. For a file with unusable time stamps or axes it has a single line with the reason.

    Raises:
        RecordingError, UnitError: the data cannot be read for another reason, such as a missing unit.
    """
    try:
        given = as_recording(recording, rate, gyro_unit, accel_unit, names, gaps)
    except RecordingError as error:
        name = Path(recording).name if isinstance(recording, str | os.PathLike) else ""
        return unreadable(error, name)
    return check_of(given, inspect(given, vibrating=vibrating))


def unreadable(error: RecordingError, name: str) -> Check:
    """Return the check of data with unusable samples or time stamps; other errors are raised again."""
    if not error.about:
        raise error
    return Check(name, 0, 0.0, (Line(error.about, "stop", str(error)),))


def check_of(recording: Recording, inspection: Inspection) -> Check:
    """Return the check of a recording that was inspected."""
    quiet = recording if inspection.refusal else inspection.quiet(recording)
    spectrum = spectrum_of(quiet.values, quiet.rate)
    widths = {name: spectrum and bandwidth_in(spectrum, k) for k, name in enumerate(quiet.names)}
    lengths = () if inspection.refusal or quiet.n < _FEWEST else tuple(_lengths(quiet, inspection, widths))
    lines = (*lines_of(recording, inspection, widths), *_of_length(inspection, lengths))
    return Check(recording.name, recording.n, recording.rate, lines, lengths, recording.notes)


def _of_length(inspection: Inspection, lengths: Sequence[NeededLength]) -> Iterator[Line]:
    """Yield lines on the length needed for N, B and K."""
    for symbol in _ASKED:
        own = [length for length in lengths if length.coefficient.symbol == symbol]
        name, left = f"length for {symbol}", [length for length in own if not length.known]
        if not own:
            why = "see disturbances" if inspection.refusal else f"fewer than {_FEWEST} samples"
            yield Line(name, "look", f"unknown, {why}")
        elif not left:
            poorest = max(own, key=lambda length: length.relative_std)
            yield Line(name, "fine", f"{poorest}{', other axes better' * (len(own) > 1)}")
        else:
            finding, needed = _in_short(symbol, left)
            yield Line(name, "look", finding, clauses(needed, *map(str, left)))


def _in_short(symbol: str, lengths: Sequence[NeededLength]) -> tuple[str, str]:
    """Return on which axes a coefficient is not known, and the longest recording that any of them needs."""
    # Axes whose fit does not describe the sensor have a line of their own.
    left, states = [x for x in lengths if not x.reason], dict[str, list[str]]()
    for x in left or lengths:
        state = "not detected" if math.isnan(x.relative_std) else f"known to worse than {_TARGET_WORDS}"
        states.setdefault("unknown" if x.reason else state, []).append(x.coefficient.axis.name)
    every = ((of[0] if len(of) == 1 else f"{len(of)} axes", state) for state, of in states.items())
    head = f"{symbol} is " + ", ".join(f"{state} on {axes}" for axes, state in every)
    if not left:
        return head, ""
    longest = max(left, key=lambda x: x.seconds or math.inf)
    at_limit = "if it is as large as its limit, " * (states.keys() == {"not detected"})
    where = f" ({longest.coefficient.axis.name})" * (len(left) > 1)
    return head, f"{at_limit}{in_words(longest.seconds)} would give {_TARGET_WORDS}{where}"


def in_words(seconds: float | None) -> str:
    return duration(seconds) if seconds else "more than a month"
