"""Inspection of a recording before its coefficients are estimated."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float

from allanjax.base.equality import ByValue
from allanjax.base.renamed import renamed
from allanjax.base.wording import plain, record_size
from allanjax.inspection.disturbances import Places, Treatment, outliers_of, spikes_in
from allanjax.inspection.events import Event, quiet_parts
from allanjax.inspection.facts import Fact, amount, grid, listed, ordered, span, warnings_of
from allanjax.inspection.plausible import (
    Ends,
    dead_facts,
    implausible,
    resolved,
    sampling_facts,
    saturated,
    short,
    temperature_facts,
)
from allanjax.inspection.scores import mean_squares, motion_warning, motions, rms_within
from allanjax.inspection.spectral import spectral_facts
from allanjax.inspection.windows import Windows
from allanjax.record.completion import bridged, completed
from allanjax.record.recording import Axis, DeadAxis, Recording

_NOT_EXAMINED = (
    "not examined in a stream: outliers, lines, interpolated samples, temperature; to check these, read a "
    "part of the file as a whole (--start, --stop)"
)
# An excess of the Allan variance by less than this share changes a coefficient by 0.25 % at most.
_TRIFLE = 0.005


@dataclasses.dataclass(frozen=True, eq=False)
class Inspection(ByValue):
    """Findings about a recording before its coefficients are estimated.

    Attributes:
        name, rate, n, axes: name, sample rate [Hz], number of samples and axes of the recording.
        mean, rms: mean of each axis and rms about it, over the stretch [rad/s or m/s²].
        parts: start and end [s from the first sample] of the parts to estimate from, in order; empty if all
            samples are used.
        lost: samples of single axes that are filled in given the others, by axis.
        refusal: why there are no coefficients; "" if there are.
        facts: findings that affect the coefficients, the gravest first.
        notes: minor findings.
        events: disturbances of the sensor.
        left_out: the events for which parts are left out, in words.
        steps: step of the output of each axis [rad/s or m/s²]; 0 if none is detected.
        allowance: relative error of the Allan deviation of each axis due to disturbed samples that are kept.
        foreign: rms of white noise on each axis [rad/s or m/s²] that may not be the sensor's own: rounding
            and outliers.
    """

    name: str
    rate: float
    n: int
    axes: tuple[Axis, ...]
    mean: Float[np.ndarray, " axes"]
    rms: Float[np.ndarray, " axes"]
    parts: tuple[tuple[float, float], ...]
    lost: Places
    refusal: str
    facts: tuple[Fact, ...]
    notes: tuple[str, ...]
    events: tuple[Event, ...]
    left_out: str
    steps: Float[np.ndarray, " axes"]
    allowance: Float[np.ndarray, " axes"]
    foreign: Float[np.ndarray, " axes"]

    said = renamed("left_out")

    @property
    def stretch(self) -> tuple[float, float] | None:
        """Start and end [s] of the longest part to estimate from; None for the whole recording."""
        return max(self.parts, key=lambda part: part[1] - part[0], default=None)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Texts of the facts that matter to users of the coefficients."""
        return warnings_of(self.facts)

    def about(self, kind: str) -> tuple[str, ...]:
        """Return the texts of the facts of one kind."""
        return tuple(fact.text for fact in self.facts if fact.kind == kind)

    def why_not(self, axis: str) -> tuple[str, ...]:
        """Kinds of facts due to which an axis's coefficients are not a measurement of the sensor."""
        return tuple(dict.fromkeys(fact.kind for fact in self.facts if fact.grave and axis in fact.axes))

    @property
    def moving(self) -> tuple[int, ...]:
        """Indices of the axes that are not at rest."""
        return tuple(k for k, axis in enumerate(self.axes) if "at rest" in self.why_not(axis.name))

    @property
    def at_rest(self) -> bool:
        """Whether no axis shows motion."""
        return not self.moving

    def quiet(self, recording: Recording) -> Recording:
        """Return the recording to estimate from: its longest quiet part, with the other parts in `others`.

        Samples in `lost` are filled in.
        """
        lost = _at(self.lost, recording)
        if self.stretch is None:
            return _completed(recording, lost)
        rows = {part: slice(*(round(time * self.rate) for time in part)) for part in self.parts}
        longest = rows.pop(self.stretch)
        quiet = recording.between(*self.stretch)
        kept = [recording.names.index(name) for name in quiet.names]
        others = [completed(recording.values[part], lost[part])[:, kept] for part in rows.values()]
        alive = (x for x in others if (np.ptp(x, axis=0) > 0.0).all())
        everything = (*(x[:, kept] for x in recording.others), *alive)
        return dataclasses.replace(_completed(quiet, lost[longest][:, kept]), others=everything)

    def uncut(self) -> Inspection:
        """Return this inspection for accumulated samples: if parts must be left out, it is a refusal."""
        if self.stretch is None:
            return self
        start, stop = (f"{time:.6g}" for time in self.stretch)
        refusal = (
            f"{self.left_out}; accumulated samples cannot be left out: read again the undisturbed part "
            f"{span(*self.stretch, grid(self.n / self.rate))} with start={start}, stop={stop} "
            f"(--start {start} --stop {stop}), or use all samples with as_is=True (--as-is)"
        )
        facts = [fact for fact in self.facts if not fact.text.startswith(self.left_out)]
        names = tuple(axis.name for axis in self.axes)
        refused = Fact("disturbances", f"no coefficients: {refusal}", names, "not a measurement")
        return dataclasses.replace(self, parts=(), refusal=refusal, facts=ordered([*facts, refused]))

    def __str__(self) -> str:
        head = f"{self.name or 'recording'}: {record_size(self.n, self.rate)}"
        lines = self.warnings or ("nothing unusual",)
        return "\n".join(
            [head, *(f"  {line}" for line in lines), *(f"  note: {note}" for note in self.notes)]
        )

    __repr__ = __str__


def inspect(
    recording: Recording, *, as_is: bool = False, vibrating: bool = False, may_move: bool = False
) -> Inspection:
    """Check a recording for handling, motion, saturation, and implausible units, rate or resolution.

    Noise and mean of each window are compared with those of the others, relative to the scatter of most
    windows; so noise of any colour is not unusual. Unusual parts that change the Allan variance at some
    cluster time by more than its own error are left out on all axes, and coefficients are estimated from the
    parts between them if these are at least 30 % of the recording. Single outlying samples, and bursts of
    noise on a single axis, are left out on that axis and filled in given its other samples. A part that is
    less than 1.5 times noisier than the rest is kept, and the intervals are widened accordingly.

    Args:
        recording: the recording.
        as_is: whether to use all samples in any case and to trust units and rate; the warnings remain.
        vibrating: whether the platform is meant to move or vibrate: the test for rest is skipped.
        may_move: whether steps and other changes of the mean are expected, as in a model with such terms.

    Returns:
        The parts to use, and facts. This takes a second or two for 10⁶ samples of six axes.
    """
    values = recording.values.T
    # Samples that were filled in are not outliers of the sensor.
    spikes = [_spikes(x, lost) for x, lost in zip(values, _drawn(recording).T, strict=True)]
    return look(
        Windows.of(_bridged(values, spikes)),
        recording.axes,
        recording.rate,
        name=recording.name,
        as_is=as_is,
        vibrating=vibrating,
        may_move=may_move,
        recording=recording,
        spikes=spikes,
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
    recording: Recording | None = None,
    spikes: Sequence[Bool[np.ndarray, " n"]] = (),
    ends: Ends | None = None,
    dead: Sequence[DeadAxis] = (),
) -> Inspection:
    """Return the inspection of a recording with this rate [Hz], given its windows; see `inspect`.

    For a recording in memory, `recording` is the recording and `spikes` are the isolated outliers of its
    axes, without which the windows were computed. For a stream, `ends` are the ends of its range, and `dead`
    its dead axes.
    """
    windows, n = windows.closed(), windows.n
    sensors, names = [axis.sensor for axis in axes], tuple(axis.name for axis in axes)
    events, quiet = quiet_parts(windows, sensors, may_move)
    treatment = Treatment.of(events, quiet, axes, rate, n, as_is)
    parts = treatment.parts
    stretch = max(parts, key=lambda part: part[1] - part[0], default=None)
    part = windows.between(*_windows_in(windows, stretch, rate))
    mean = np.average(part.mean, axis=0, weights=part.count)
    rms = np.sqrt(rms_within(part) ** 2 + np.average((part.mean - mean) ** 2, axis=0, weights=part.count))
    moving = motions(part, axes, rate)
    about = {sensors[m.axis] for m in moving}
    auxiliary = {} if recording is None else recording.auxiliary
    facts = implausible(axes, rate, mean, _white(part, rate), auxiliary, about, vibrating)
    if as_is:
        facts = [dataclasses.replace(fact, consequence="none") for fact in facts]
    # With a wrong unit noise looks like motion.
    wrong = {axis for fact in facts for axis in fact.axes if fact.kind != "rate"}
    moving = [] if vibrating else [m for m in moving if names[m.axis] not in wrong]
    refusal = treatment.refusal
    if shown := tuple(dict.fromkeys(names[m.axis] for m in moving)):
        # If two axes show motion, all axes move.
        concerned = shown if len(shown) == 1 else names
        text = motion_warning(moving, axes, bool(refusal))
        facts.append(Fact("at rest", text, concerned, "not a measurement"))
        # The warning about motion comes first and is reason enough.
        refusal = ""
    spikes = [_within(parts, at, rate) for at in spikes]
    if recording is None:
        more, steps = resolved(part, axes, None)
        foreign = steps / np.sqrt(12.0)
        more += [*dead_facts(dead), Fact("not examined", _NOT_EXAMINED, names)]
        more += [] if ends is None else saturated(axes, ends, steps)
    else:
        more, steps, foreign = _of_samples(recording, part, stretch, spikes, treatment.lost)
    lost = dict(treatment.lost)
    for axis, at in zip(names, () if as_is else spikes, strict=False):
        if at.any():
            lost[axis] = (*lost.get(axis, ()), *((k, k + 1) for k in np.flatnonzero(at).tolist()))
    harmless = treatment.describe(treatment.harmless)
    return Inspection(
        name,
        rate,
        n,
        tuple(axes),
        mean,
        rms,
        parts,
        lost,
        refusal,
        ordered([*facts, *treatment.facts(refusal), *short(part.n, rate, axes), *more]),
        (f"{harmless}; kept, since no coefficient changes by more than its error",) if harmless else (),
        events,
        treatment.describe(treatment.cut),
        steps,
        treatment.allowance,
        foreign,
    )


def _of_samples(
    recording: Recording,
    part: Windows,
    stretch: tuple[float, float] | None,
    spikes: Sequence[Bool[np.ndarray, " n"]],
    lost: Places,
) -> tuple[list[Fact], Float[np.ndarray, " axes"], Float[np.ndarray, " axes"]]:
    """Facts from the samples themselves; the step, and the rms of foreign white noise, of each axis."""
    rows = slice(*((0, recording.n) if stretch is None else (round(t * recording.rate) for t in stretch)))
    drawn = _drawn(recording)
    own = [x[rows][~missing[rows]] for x, missing in zip(recording.values.T, drawn.T, strict=True)]
    facts, steps = resolved(part, recording.axes, own)
    held = {name for fact in facts if fact.kind == "repeated samples" or fact.grave for name in fact.axes}
    for k, (axis, x) in enumerate(zip(recording.axes, own, strict=True)):
        facts += saturated([axis], Ends.of(x[:, None]), steps[k : k + 1])
    whole = _bridged(recording.values.T, spikes)
    # A burst has power at all frequencies, some of which would look like lines.
    calm = _bridged(whole.T, _at(lost, recording).T)
    facts += spectral_facts(calm[rows], recording.rate, recording.axes, held)
    facts += [*sampling_facts(recording), *temperature_facts(recording)]
    # What is no measurement, as interpolated samples, has no outliers of its own.
    grave = {name for fact in facts if fact.grave for name in fact.axes}
    outliers = np.zeros(len(steps))
    for k, axis in enumerate(recording.axes):
        if axis.name not in held | grave:
            count, outliers[k] = outliers_of(calm[rows, k], float(steps[k]))
            facts += _outlier_facts(axis, count, outliers[k], calm[rows, k])
    foreign = np.sqrt(steps**2 / 12.0 + outliers)
    single = (fact for fact in _spike_facts(recording, whole, spikes) if not grave.issuperset(fact.axes))
    return [*facts, *single], steps, foreign


def _bridged(
    columns: Iterable[Float[np.ndarray, " n"]], where: Iterable[Bool[np.ndarray, " n"]]
) -> Float[np.ndarray, "n axes"]:
    """Return the samples of all axes with those at `where` interpolated."""
    return np.column_stack([bridged(x, at) for x, at in zip(columns, where, strict=True)])


def _at(places: Places, recording: Recording) -> Bool[np.ndarray, "n axes"]:
    """Return which samples are at these places."""
    found = np.zeros_like(recording.values, bool)
    for name, stretches in places.items():
        for first, last in stretches:
            found[first:last, recording.names.index(name)] = True
    return found


def _drawn(recording: Recording) -> Bool[np.ndarray, "n axes"]:
    """Return which samples were missing and have been filled in."""
    return np.zeros_like(recording.values, bool) if recording.missing is None else recording.missing


def _spikes(x: Float[np.ndarray, " n"], drawn: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Return isolated outliers of an axis that change its Allan variance by more than its own error."""
    at = spikes_in(x) & ~drawn
    without = bridged(x, at)
    off = (x - without)[at]
    return np.zeros_like(at) if _is_trifle(float(off @ off) / len(x), without) else at


def _within(
    parts: Sequence[tuple[float, float]], at: Bool[np.ndarray, " n"], rate: float
) -> Bool[np.ndarray, " n"]:
    """Return which of these samples are in the parts; all of them if there are no parts."""
    time = np.arange(len(at)) / rate
    inside = [(time >= first) & (time < last) for first, last in parts]
    return at & np.any(inside, axis=0) if parts else at


def _outlier_facts(axis: Axis, count: int, variance: float, x: Float[np.ndarray, " n"]) -> Iterator[Fact]:
    """Yield a fact about samples beyond Gaussian noise that are kept."""
    if _is_trifle(variance, x):
        return
    share = plain(100.0 * count / len(x), 2)
    text = (
        f"{count} samples of {axis.name} ({share} %) are outliers of Gaussian noise; they are kept, and the "
        f"interval of N is widened for the {amount(np.sqrt(variance), axis)} rms of white noise that they add"
    )
    yield Fact("spikes", text, (axis.name,), "widened", float(np.sqrt(variance)))


def _is_trifle(variance: float, x: Float[np.ndarray, " n"]) -> bool:
    """Return whether additional variance changes the Allan variance by less than its own error."""
    return variance <= max(_TRIFLE, np.sqrt(2.0 / len(x))) * np.mean(np.diff(x) ** 2) / 2.0


def _spike_facts(
    recording: Recording, without: Float[np.ndarray, "n axes"], spikes: Sequence[Bool[np.ndarray, " n"]]
) -> Iterator[Fact]:
    """Yield facts about isolated outliers that are left out."""
    for axis, x, calm, at in zip(recording.axes, recording.values.T, without.T, spikes, strict=True):
        if not at.any():
            continue
        off = float(abs(x - calm).max())
        places = (np.flatnonzero(at) / recording.rate).tolist()
        where = listed([f"{plain(time, 6)} s" for time in places])
        share = f" ({plain(100.0 * float(at.mean()), 1)} %)" if at.mean() >= _TRIFLE else ""
        single = f"{len(places)} outlying samples" if len(places) > 1 else "1 outlying sample"
        size = amount(off, axis, 3)
        text = f"{single} on {axis.name}{share}, up to {size} off; at {where}: left out and filled in"
        spans = tuple((time, time + 1.0 / recording.rate) for time in places)
        yield Fact("spikes", text, (axis.name,), "widened", off, "", spans)


def _completed(recording: Recording, lost: Bool[np.ndarray, "n axes"]) -> Recording:
    """Return the recording with lost samples filled in given the others."""
    if not lost.any():
        return recording
    missing = lost if recording.missing is None else lost | recording.missing
    return dataclasses.replace(recording, values=completed(recording.values, missing), missing=missing)


def _windows_in(windows: Windows, stretch: tuple[float, float] | None, rate: float) -> tuple[int, int]:
    """Return the indices of the first window in the stretch and of the one after its last."""
    if stretch is None:
        return 0, len(windows)
    edges = windows.edges / rate
    first = int(np.searchsorted(edges, stretch[0] - 1e-9))
    last = int(np.searchsorted(edges, stretch[1] + 1e-9, side="right")) - 1
    return first, max(last, first + 1)


def _white(windows: Windows, rate: float) -> Float[np.ndarray, "scales axes"]:
    """Return the Allan deviation times the root of the cluster time, for cluster times up to a second."""
    squares, time = mean_squares(windows), 2.0 ** np.arange(len(windows.power)) / rate
    known = np.isfinite(squares).any(axis=(1, 2)) & (time <= max(1.0, time[0]))
    return np.sqrt(np.nanmean(squares[known], axis=1) / 2.0 * time[known, None])
