"""Inspection of a recording before its coefficients are estimated."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from allanjax.base.equality import ByValue
from allanjax.base.wording import duration
from allanjax.inspection.motion import motions, rms_within
from allanjax.inspection.plausible import coarse, implausible
from allanjax.inspection.quiet import Event, quiet_part
from allanjax.inspection.scores import mean_squares
from allanjax.inspection.windows import Windows
from allanjax.inspection.words import cannot_cut, grid, refused, said_of_events, said_of_motion, span, unclear
from allanjax.record.recording import Axis, Recording

#: Least share of the recording that coefficients may be estimated from: one event leaves half of the
#: recording wherever it is, two leave a third.
LEAST_SHARE = 0.3
# A part that is quieter by this factor, and this share of the recording, may be the sensor at rest.
_MUCH, _LONG = 1.5, 0.1
# An excess of the Allan variance by less than this biases a coefficient by less than 5 %.
_SLIGHT = 0.1


@dataclasses.dataclass(frozen=True, eq=False)
class Inspection(ByValue):
    """Findings about a recording before anything is estimated from it.

    Attributes:
        name, rate, n, axes: name, sample rate [Hz], number of samples and axes of the recording.
        mean, rms: mean and rms about it of each axis, over the stretch [rad/s or m/s²].
        stretch: start and end [s from the first sample] of the part to estimate from; None for all of it.
        refusal: why coefficients cannot be given; "" if they can.
        findings: what the user should know, the most important first: the subject of each and a sentence.
            Subjects are "accel" and "gyro" (units), "rate", "motion", "events", "length", "resolution" and
            "repeats".
        notes: sentences of less weight.
        moving: indices of the axes that are not at rest; one alone may be broken, two are a moving platform,
            and then all of its axes are.
        events: what happened to the sensor.
        said: the events that matter, in words.
    """

    name: str
    rate: float
    n: int
    axes: tuple[Axis, ...]
    mean: Float[np.ndarray, " axes"]
    rms: Float[np.ndarray, " axes"]
    stretch: tuple[float, float] | None
    refusal: str
    findings: tuple[tuple[str, str], ...]
    notes: tuple[str, ...]
    moving: tuple[int, ...]
    events: tuple[Event, ...]
    said: str

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences of the findings."""
        return tuple(line for _, line in self.findings)

    def about(self, subject: str) -> tuple[str, ...]:
        """Sentences of the findings on one subject."""
        return tuple(line for of, line in self.findings if of == subject)

    @property
    def at_rest(self) -> bool:
        """Whether no axis shows motion."""
        return not self.moving

    def quiet(self, recording: Recording) -> Recording:
        """The stretch of the recording that coefficients should be estimated from."""
        return recording if self.stretch is None else recording.between(*self.stretch)

    def uncut(self) -> Inspection:
        """This inspection for samples that cannot be cut any more: where a cut is needed, a refusal."""
        if self.stretch is None:
            return self
        refusal = cannot_cut(self.said, span(*self.stretch, grid(self.n / self.rate)), self.stretch)
        findings = tuple(
            (about, f"no coefficients: {refusal}" if line.startswith(self.said) else line)
            for about, line in self.findings
        )
        return dataclasses.replace(self, stretch=None, refusal=refusal, findings=findings)

    def __str__(self) -> str:
        length = duration(self.n / self.rate)
        head = f"{self.name or 'recording'}: {self.n:,} samples at {self.rate:g} Hz ({length})"
        lines = self.warnings or ("nothing unusual",)
        return "\n".join(
            [head, *(f"  {line}" for line in lines), *(f"  note: {note}" for note in self.notes)]
        )

    __repr__ = __str__


def inspect(
    recording: Recording, *, as_is: bool = False, vibrating: bool = False, may_move: bool = False
) -> Inspection:
    """Check a recording for handling, motion, and implausible units, rate or resolution.

    Noise and mean of each window are compared with those of the others, relative to the scatter of most of
    them; so noise of any colour is nothing unusual. Unusual stretches that change the Allan variance at some
    cluster time by more than its own error are left out: coefficients are estimated from the longest part
    without them, on all axes, if that is at least 30 % of the recording. Otherwise they are refused, unless
    the Allan deviation is off by 5 % at most.

    Args:
        recording: the recording.
        as_is: whether all of it is to be used in any case; the warnings stay.
        vibrating: whether its platform is meant to move and vibrate: then it is not tested for rest.
        may_move: whether steps and other changes of the mean are expected, as where a model has terms for
            them.

    Returns:
        The stretch to use, and warnings. It takes a tenth of a second for 10⁶ samples of six axes.
    """
    return look(
        Windows.of(recording.values),
        recording.axes,
        recording.rate,
        name=recording.name,
        as_is=as_is,
        vibrating=vibrating,
        may_move=may_move,
        values=recording.values,
        auxiliary=recording.auxiliary,
    )


def look(
    windows: Windows,
    axes: Sequence[Axis],
    rate: float,
    *,
    name: str = "",
    as_is: bool = False,
    vibrating: bool = False,
    may_move: bool = False,
    values: Float[np.ndarray, "n axes"] | None = None,
    auxiliary: Mapping[str, Float[np.ndarray, " n"]] | None = None,
) -> Inspection:
    """Inspection of a recording with this rate [Hz] that is known by its windows; see `inspect`.

    `values` and `auxiliary` are its samples and other columns, where they are in memory.
    """
    windows, n = windows.closed(), windows.n
    sensors = [axis.sensor for axis in axes]
    events, begin, end = quiet_part(windows, sensors, may_move)
    touched, harmless = [e for e in events if e.matters], [e for e in events if not e.matters]
    quieter = [e for e in touched if e.kind == "quieter" and e.size > _MUCH]
    unlikely_rest = sum(e.last - e.first for e in quieter) > _LONG * n
    long_enough = end - begin >= LEAST_SHARE * n and not unlikely_rest
    cut = bool(touched) and long_enough and not as_is
    stretch = _rounded(begin, end, n, rate) if cut else None
    part = windows.between(*_windows_in(windows, stretch, rate))
    mean = np.average(part.mean, axis=0, weights=part.count)
    rms = np.sqrt(rms_within(part) ** 2 + np.average((part.mean - mean) ** 2, axis=0, weights=part.count))
    moving = motions(part, sensors, rate)
    about = {sensors[m.axis] for m in moving}
    units = implausible(axes, rate, mean, _white(part, rate), auxiliary or {}, about)
    # In a wrong unit noise looks like motion.
    moving = [] if vibrating else [m for m in moving if sensors[m.axis] not in units]
    said = said_of_events(touched, axes, rate, n / rate)
    refusal, happened = "", ""
    where = span(begin / rate, end / rate, grid(n / rate))
    share = sum(e.share for e in touched)
    if touched and stretch is not None:
        happened = f"{said}: coefficients are of {span(*stretch, grid(n / rate))}"
    elif touched and as_is:
        happened = f"{said}: coefficients are of all of it, as asked"
    elif touched and not unlikely_rest and share < _SLIGHT:
        happened = f"{said}: the Allan deviation is {50.0 * share:.1g} % off by it at most"
    elif touched and moving:
        # The warning about motion comes first, and is reason enough.
        happened = f"{said}; the longest part without that is {where}"
    elif touched:
        refusal = unclear(said) if unlikely_rest else refused(said, where, LEAST_SHARE)
        happened = f"no coefficients: {refusal}"
    motion = said_of_motion(moving, axes) if moving else ""
    findings = (
        *units.items(),
        ("motion", motion),
        ("events", happened),
        *coarse(windows, axes, rate, values),
    )
    note = said_of_events(harmless, axes, rate, n / rate)
    shown = {m.axis: m for m in moving}
    return Inspection(
        name,
        rate,
        n,
        tuple(axes),
        mean,
        rms,
        stretch,
        refusal,
        tuple((about, line) for about, line in findings if line),
        (f"{note}: too little to change a coefficient by more than its error",) if note else (),
        # Two axes that show motion mean that all move.
        tuple(range(len(axes)) if len(shown) > 1 else shown),
        events,
        said,
    )


def _rounded(begin: int, end: int, n: int, rate: float) -> tuple[float, float]:
    """Start and end [s] of the quiet part, rounded inwards."""
    step = grid(n / rate)
    start = np.ceil(begin / rate / step - 1e-9) * step if begin else 0.0
    stop = np.floor(end / rate / step + 1e-9) * step if end < n else n / rate
    return round(float(start), 9), round(float(stop), 9)


def _windows_in(windows: Windows, stretch: tuple[float, float] | None, rate: float) -> tuple[int, int]:
    """Indices of the first window in the stretch and of the one after its last."""
    if stretch is None:
        return 0, len(windows)
    edges = windows.edges / rate
    first = int(np.searchsorted(edges, stretch[0] - 1e-9))
    last = int(np.searchsorted(edges, stretch[1] + 1e-9, side="right")) - 1
    return first, max(last, first + 1)


def _white(windows: Windows, rate: float) -> Float[np.ndarray, "scales axes"]:
    """Allan deviation times the root of the cluster time, at cluster times up to a second."""
    squares, time = mean_squares(windows), 2.0 ** np.arange(len(windows.power)) / rate
    known = np.isfinite(squares).any(axis=(1, 2)) & (time <= max(1.0, time[0]))
    return np.sqrt(np.nanmean(squares[known], axis=1) / 2.0 * time[known, None])
