"""Inspection of a recording before its coefficients are estimated, and its checks in one line each."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Literal

import numpy as np
from jaxtyping import Bool

from allanjax.base.earth import STANDARD_GRAVITY as _G
from allanjax.base.equality import ByValue
from allanjax.base.errors import expect
from allanjax.base.threads import for_each
from allanjax.base.wording import duration, plain, record_size
from allanjax.inspection.events import TRIFLE, Event, Places, Treatment, quiet_parts
from allanjax.inspection.facts import Fact, amount, grid, listed, ordered, span, warnings_of
from allanjax.inspection.levels import levels_of
from allanjax.inspection.plausible import (
    Ends,
    dead_facts,
    describe_jitter,
    rate_facts,
    resolved,
    sampling_facts,
    saturated,
    short,
    temperature_facts,
    temperatures,
)
from allanjax.inspection.spectral import spectral_facts
from allanjax.inspection.units import groups, units_of_record
from allanjax.inspection.windows import (
    IN_MOTION,
    OfAxes,
    Samples,
    Values,
    Which,
    Windows,
    mean_squares,
    motion_warning,
    motions,
    rms_within,
    runs,
)
from allanjax.record.completion import bridged, completed
from allanjax.record.recording import Axis, DeadAxis, Recording
from allanjax.record.units import Sensor, rate_unit_of

_NOT_EXAMINED = "not examined in a stream: outliers, lines, interpolated samples, temperature"
_EXAMINED = "to check these, read a part of the file as a whole (--start, --stop)"
# Standard deviations beyond which a sample is an outlier: Gaussian noise has one in 10⁹ samples.
_FAR = 6.0
# Samples on either side that are compared, and the most outliers within that distance.
_AROUND, _CLOSE = 3, 3
# Standard deviations beyond which Gaussian noise has this share of samples; so many times more is no chance.
_OUTLYING, _GAUSSIAN_BEYOND, _ENOUGH = 4.0, 6.3e-5, 5
# Share of the smallest distances from which the scale is estimated, and their rms for normal variates.
_INNER, _INNER_RMS = 0.7, 0.5565
# Share of zero distances beyond which the rounding is too coarse for that estimate.
_EQUAL = 0.35
# Largest share of outlying samples on an axis: with more, the noise itself has heavy tails.
_MOST = 0.1


@dataclasses.dataclass(frozen=True, eq=False)
class Inspection(ByValue):
    """Findings about a recording before its coefficients are estimated.

    Attributes:
        name, rate, n, axes: name, sample rate [Hz], number of samples and axes of the recording.
        mean, rms: mean of each axis and rms about it, over the longest part [rad/s or m/s²].
        parts: start and end [s from the first sample] of the parts to estimate from, in order; empty if all
            samples are used.
        lost: samples of single axes that are filled in given the others, by axis.
        refusal: why there are no coefficients; "" if there are.
        facts: findings that affect the coefficients, the gravest first.
        notes: minor findings.
        events: disturbances of the sensor.
        left_out: the events for which parts are left out, in words.
        steps: step of the output of each axis [rad/s or m/s²]; 0 if none is detected.
        added_noise: rms of white noise on each axis [rad/s or m/s²] from rounding and outliers, which may not
            be the sensor's own.
    """

    name: str
    rate: float
    n: int
    axes: tuple[Axis, ...]
    mean: OfAxes
    rms: OfAxes
    parts: tuple[tuple[float, float], ...]
    lost: Places
    refusal: str
    facts: tuple[Fact, ...]
    notes: tuple[str, ...]
    events: tuple[Event, ...]
    left_out: str
    steps: OfAxes
    added_noise: OfAxes

    @property
    def longest_part(self) -> tuple[float, float] | None:
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
        if self.longest_part is None:
            return _completed(recording, lost)
        rows = {part: slice(*(round(time * self.rate) for time in part)) for part in self.parts}
        longest = rows.pop(self.longest_part)
        quiet = recording.between(*self.longest_part)
        kept = [recording.names.index(name) for name in quiet.names]
        others = [completed(recording.values[part], lost[part])[:, kept] for part in rows.values()]
        alive = (x for x in others if (np.ptp(x, axis=0) > 0.0).all())
        everything = (*(x[:, kept] for x in recording.others), *alive)
        return dataclasses.replace(_completed(quiet, lost[longest][:, kept]), others=everything, places=())

    def uncut(self) -> Inspection:
        """Return this inspection for accumulated samples: if parts must be left out, it is a refusal."""
        if self.longest_part is None:
            return self
        start, stop = (f"{time:.6g}" for time in self.longest_part)
        means = "no coefficients, as accumulated samples cannot be left out"
        remedy = (
            f"read the undisturbed part {span(*self.longest_part, grid(self.n / self.rate))} again with "
            f"start={start}, stop={stop} (--start {start} --stop {stop}), or use all samples with as_is=True "
            "(--as-is)"
        )
        names = tuple(axis.name for axis in self.axes)
        facts = [f for f in self.facts if f.kind != "disturbances" or f.consequence != "none"]
        refused = Fact(
            "disturbances", self.left_out, names, "not a measurement", meaning=means, remedy=remedy
        )
        return dataclasses.replace(self, parts=(), refusal=refused.text, facts=ordered([*facts, refused]))

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
    less than 1.5 times noisier than the rest is kept: it is how the sensor's noise varies. If a tenth of the
    recording or more is louder than the rest by more, the quiet part is taken, however short, if the spectra
    show that the sensor is at rest in it (see `levels`); if they do not, there are no coefficients.

    Args:
        recording: the recording.
        as_is: whether to use all samples in any case and to trust units and rate; the warnings remain.
        vibrating: whether the platform is meant to move or vibrate: the test for rest is skipped.
        may_move: whether steps and other changes of the mean are expected, as in a model with such terms.

    Returns:
        The parts to use, and facts. This takes a second or two for 10⁶ samples of six axes.
    """
    expect(recording, Recording, "inspect takes a recording, as allanjax.read returns")
    # Samples that were filled in are not outliers of the sensor.
    spikes = for_each(lambda pair: _spikes(*pair), zip(recording.values.T, _drawn(recording).T, strict=True))
    return look(
        Windows.of(_bridged(recording.values, spikes)),
        recording.axes,
        recording.rate,
        name=recording.name,
        as_is=as_is,
        vibrating=vibrating,
        may_move=may_move,
        recording=recording,
        spikes=spikes,
        given=recording.given,
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
    spikes: Sequence[Which] = (),
    ends: Ends | None = None,
    dead: Sequence[DeadAxis] = (),
    given: Mapping[Sensor, float] = MappingProxyType({}),
) -> Inspection:
    """Return the inspection of a recording with this rate [Hz], given its windows; see `inspect`.

    For a recording in memory, `recording` is the recording and `spikes` are the isolated outliers of its
    axes, without which the windows were computed. For a stream, `ends` are the ends of its range, and `dead`
    its dead axes. `given` is as in `Recording`.
    """
    windows, n = windows.closed(), windows.n
    sensors, names = [axis.sensor for axis in axes], tuple(axis.name for axis in axes)
    levels = levels_of(windows, rate)
    events, quiet = quiet_parts(windows, sensors, may_move, levels)
    treatment = Treatment(events, quiet, axes, rate, n, as_is, levels)
    parts = treatment.parts
    longest = max(parts, key=lambda part: part[1] - part[0], default=None)
    part = windows
    if longest is not None:
        starts = windows.edges / rate
        first = int(np.searchsorted(starts, longest[0] - 1e-9))
        last = int(np.searchsorted(starts, longest[1] + 1e-9, side="right")) - 1
        part = windows.between(first, max(last, first + 1))
    mean = np.average(part.mean, axis=0, weights=part.count)
    rms = np.sqrt(rms_within(part) ** 2 + np.average((part.mean - mean) ** 2, axis=0, weights=part.count))
    moving = motions(part, axes, rate)
    about = {sensors[m.axis] for m in moving}
    # Allan deviation times the root of the cluster time, for cluster times up to a second.
    squares, time = mean_squares(part), 2.0 ** np.arange(len(part.power)) / rate
    known = np.isfinite(squares).any(axis=(1, 2)) & (time <= max(1.0, time[0]))
    white = np.sqrt(np.nanmean(squares[known], axis=1) / 2.0 * time[known, None])
    if recording is None:
        more, steps = resolved(part, axes, None)
        added_noise = steps / np.sqrt(12.0)
        more += [*dead_facts(dead), Fact("not examined", _NOT_EXAMINED, names, remedy=_EXAMINED)]
        more += [] if ends is None else saturated(axes, ends, steps)
    else:
        if parts:
            inside = np.any([(recording.time >= a) & (recording.time < b) for a, b in parts], axis=0)
            spikes = [at & inside for at in spikes]
        more, steps, added_noise = _of_samples(recording, part, longest, spikes, treatment.lost)
    facts = rate_facts(axes, rate, {} if recording is None else recording.auxiliary)
    facts += units_of_record(axes, rate, mean, white, steps, about, vibrating, given)
    if as_is:
        facts = [dataclasses.replace(fact, consequence="none") for fact in facts]
    # With a wrong unit noise looks like motion.
    wrong = {axis for fact in facts for axis in fact.axes if fact.kind != "rate"}
    moving = [] if vibrating else [m for m in moving if names[m.axis] not in wrong]
    refusal = treatment.refusal
    if shown := tuple(dict.fromkeys(names[m.axis] for m in moving)):
        # If two axes show motion, all axes move.
        concerned = shown if len(shown) == 1 else names
        finding, remedy = motion_warning(moving, axes, bool(refusal))
        facts.append(
            Fact("at rest", finding, concerned, "not a measurement", meaning=IN_MOTION, remedy=remedy)
        )
        # The warning about motion comes first and is reason enough.
        refusal = None
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
        refusal.text if refusal else "",
        ordered([*facts, *treatment.facts(refusal), *short(part.n, rate, axes), *more]),
        (f"{harmless}; kept, since no coefficient changes by more than its interval allows",)
        if harmless
        else (),
        events,
        treatment.describe(treatment.cut),
        steps,
        added_noise,
    )


def _of_samples(
    recording: Recording,
    part: Windows,
    longest: tuple[float, float] | None,
    spikes: Sequence[Which],
    lost: Places,
) -> tuple[list[Fact], OfAxes, OfAxes]:
    """Facts from the samples themselves; the step, and the rms of added white noise, of each axis."""
    rows = slice(*((0, recording.n) if longest is None else (round(t * recording.rate) for t in longest)))
    values, drawn = recording.values[rows].T, _drawn(recording)[rows].T
    own = [x[~missing] if missing.any() else x for x, missing in zip(values, drawn, strict=True)]
    facts, steps = resolved(part, recording.axes, own)
    held = {name for fact in facts if fact.kind == "repeated samples" or fact.grave for name in fact.axes}
    for k, (axis, x) in enumerate(zip(recording.axes, own, strict=True)):
        facts += saturated([axis], Ends.of(x[:, None]), steps[k : k + 1])
    whole = _bridged(recording.values, spikes)
    # A burst has power at all frequencies, some of which would look like lines.
    calm = _bridged(whole, list(_at(lost, recording).T))
    facts += spectral_facts(calm[rows], recording.rate, recording.axes, held)
    facts += [*sampling_facts(recording), *temperature_facts(recording)]
    # What is no measurement, as interpolated samples, has no outliers of its own.
    grave = {name for fact in facts if fact.grave for name in fact.axes}
    outliers = np.zeros(len(steps))
    for k, axis in enumerate(recording.axes):
        if axis.name not in held | grave:
            count, outliers[k] = outliers_of(x := calm[rows, k], float(steps[k]))
            if _is_trifle(outliers[k], x):
                continue
            rms, share = float(np.sqrt(outliers[k])), plain(100.0 * count / len(x), 2)
            text = f"{count} samples of {axis.name} ({share} %) are too large for Gaussian noise"
            added = amount(rms, axis)
            means = f"they are kept, and the interval of N is widened for the {added} rms that they add"
            facts.append(Fact("spikes", text, (axis.name,), "widened", rms, meaning=means))
    added_noise = np.sqrt(steps**2 / 12.0 + outliers)
    single = (fact for fact in _spike_facts(recording, whole, spikes) if not grave.issuperset(fact.axes))
    return [*facts, *single], steps, added_noise


def _bridged(values: Values, where: Sequence[Which]) -> Values:
    """Return the samples of all axes with those at `where` interpolated."""
    if not any(at.any() for at in where):
        return values
    return np.array([bridged(x, at) for x, at in zip(values.T, where, strict=True)]).T


def _at(places: Places, recording: Recording) -> Bool[np.ndarray, "n axes"]:
    """Return which samples are at these places."""
    at = np.zeros_like(recording.values, bool)
    for name, ranges in places.items():
        for first, last in ranges:
            at[first:last, recording.names.index(name)] = True
    return at


def _drawn(recording: Recording) -> Bool[np.ndarray, "n axes"]:
    """Return which samples were missing and have been filled in."""
    return np.zeros_like(recording.values, bool) if recording.missing is None else recording.missing


def _spikes(x: Samples, drawn: Which) -> Which:
    """Return isolated outliers of an axis that change its Allan variance by more than its own error."""
    at = spikes_in(x) & ~drawn
    without = bridged(x, at)
    off = (x - without)[at]
    return np.zeros_like(at) if _is_trifle(float(off @ off) / len(x), without) else at


def _is_trifle(variance: float, x: Samples) -> bool:
    """Return whether additional variance changes the Allan variance by less than its own error."""
    return variance <= max(TRIFLE, np.sqrt(2.0 / len(x))) * np.mean(np.diff(x) ** 2) / 2.0


def _spike_facts(recording: Recording, without: Values, spikes: Sequence[Which]) -> Iterator[Fact]:
    """Yield facts about isolated outliers that are left out."""
    for axis, x, calm, at in zip(recording.axes, recording.values.T, without.T, spikes, strict=True):
        if not at.any():
            continue
        off = float(abs(x - calm).max())
        places = (np.flatnonzero(at) / recording.rate).tolist()
        where = listed([f"{plain(time, 6)} s" for time in places])
        share = f" ({plain(100.0 * float(at.mean()), 1)} %)" if at.mean() >= TRIFLE else ""
        single = f"{len(places)} outlying samples" if len(places) > 1 else "1 outlying sample"
        size = amount(off, axis, 3)
        text = f"{single} on {axis.name}{share}, up to {size} off"
        spans = tuple((time, time + 1.0 / recording.rate) for time in places)
        means = f"left out and filled in at {where}"
        yield Fact("spikes", text, (axis.name,), "widened", off, "", spans, meaning=means)


def _completed(recording: Recording, lost: Bool[np.ndarray, "n axes"]) -> Recording:
    """Return the recording with lost samples filled in given the others."""
    if not lost.any():
        return recording
    missing = lost if recording.missing is None else lost | recording.missing
    return dataclasses.replace(recording, values=completed(recording.values, missing), missing=missing)


def spikes_in(x: Samples) -> Which:
    """Return which samples are isolated outliers, up to three close together; none if there are too many.

    An outlier is far both from the mean of its two neighbours and from the median of the seven samples around
    it, in standard deviations of Gaussian noise. A step is not far from the median; a knock or a burst has
    more such samples close together.
    """
    distance, scale = _distances(x)
    far, places = np.zeros(len(x), bool), np.flatnonzero(distance > _FAR)
    if len(places) > 3.0 * _MOST * len(x):
        return far
    around = np.pad(x, _AROUND, mode="reflect")[places[:, None] + np.arange(2 * _AROUND + 1)]
    far[places[abs(x[places] - np.median(around, axis=1)) > _FAR * scale]] = True
    for first, last in runs(far, _AROUND):
        far[first:last] &= far[first:last].sum() <= _CLOSE
    return far if far.mean() <= _MOST else np.zeros_like(far)


def outliers_of(x: Samples, step: float) -> tuple[int, float]:
    """Return the number of samples beyond Gaussian noise, and the variance that they add.

    Both are zero if chance explains the number. Deviations up to a rounding `step` do not count.
    """
    distance, scale = _distances(x)
    beyond = distance[distance * scale > _OUTLYING * scale + step]
    if len(beyond) <= _ENOUGH * (1.0 + len(x) * _GAUSSIAN_BEYOND):
        return 0, 0.0
    return len(beyond), float(np.sum(beyond**2 - 1.0)) * scale**2 / len(x)


def _distances(x: Samples) -> tuple[Samples, float]:
    """Return distances from the mean of the two neighbours in robust standard deviations, and that deviation.

    Distances are zero if many samples equal that mean: the output is rounded, and its steps are not outliers.
    """
    left = np.zeros(len(x))
    np.abs(x[1:-1] - 0.5 * (x[:-2] + x[2:]), out=left[1:-1])
    # Of long records an odd fraction of the samples suffices. The median itself would be coarse where the
    # output is rounded.
    some = left[:: 1 + 2 * (len(x) >> 19)]
    inner = np.partition(some, most := int(_INNER * len(some)))[:most]
    scale = float(np.sqrt(inner @ inner / max(most, 1))) / _INNER_RMS
    rounded = np.count_nonzero(left[1:-1] == 0.0) > _EQUAL * (len(x) - 2)
    return (np.zeros(len(x)) if rounded or not scale > 0.0 else left / scale), scale


# Checks of a recording: fine, look (worth a look), or stop (unusable as it is). Each kind of fact from an
# inspection is one line; without such a fact the line reads fine.

#: Verdicts, the best first.
Verdict = Literal["fine", "look", "stop"]

# Sample rate over bandwidth: from three to five, after Hou (2004) section 5.3, figure 5.10.
_LEAST_RATIO, _MOST_RATIO = 3.0, 5.0


@dataclasses.dataclass(frozen=True)
class Line:
    """One check: its name, the verdict, and the reason in words with numbers and units.

    Attributes:
        name: what was checked, the `kind` of a fact.
        verdict: fine, look or stop.
        finding: what was found, in words with numbers and units.
        advice: what it means and what to do; "" if nothing.
    """

    name: str
    verdict: Verdict
    finding: str
    advice: str = ""

    @property
    def reason(self) -> str:
        """Finding and advice."""
        return "; ".join(filter(None, (self.finding, self.advice)))


def lines_of(
    recording: Recording, inspection: Inspection, widths: Mapping[str, float | None]
) -> Iterator[Line]:
    """Yield the checks of a recording, given its inspection and the bandwidth of each axis."""

    def line(name: str, otherwise: str, verdict: Verdict = "fine") -> Line:
        facts = [fact for fact in inspection.facts if fact.kind == name]
        if not facts:
            return Line(name, verdict, otherwise)
        # Findings with the same advice share it.
        by_advice: dict[str, list[str]] = {}
        for fact in facts:
            by_advice.setdefault(fact.advice, []).append(fact.finding)
        (advice, findings), *others = by_advice.items()
        more = [part for rest, of in others for part in (", ".join(of), rest)]
        advice = "; ".join(filter(None, (advice, *more)))
        return Line(
            name, "stop" if any(fact.grave for fact in facts) else "look", ", ".join(findings), advice
        )

    timed, rate = recording.jitter is not None, f"{recording.rate:.6g} Hz"
    unknown = "cannot be checked without time stamps"
    yield (
        line("rate", f"{rate} by the time stamps")
        if timed
        else line("rate", f"{rate} as given; it {unknown}", "look")
    )
    yield line("jitter", describe_jitter(recording)) if timed else line("jitter", unknown, "look")
    yield line("gaps", unknown, "look") if recording.gaps is None else line("gaps", "none")
    yield line("repeated samples", "no more than rounding explains")
    yield line("interpolation", "no samples are interpolated")
    yield line("resolution", _resolution(recording, inspection))
    yield line("saturation", "samples do not pile up at the ends of their range")
    yield line("dead axes", "every axis changes")
    yield line("at rest", "no axis moves more than a sensor at rest")
    yield line("disturbances", "; ".join(inspection.notes) or "none")
    yield line("spikes", "no outlying samples")
    yield line("lines", "no spectral lines")
    sensors = {axis.sensor for axis in recording.axes}
    if "accel" in sensors:
        yield line("accel unit", *_gravity(inspection))
    if "gyro" in sensors:
        gyros = [k for k, axis in enumerate(inspection.axes) if axis.sensor == "gyro"]
        k = max(gyros, key=lambda k: abs(inspection.mean[k]))
        bias = f"{amount(abs(inspection.mean[k]), inspection.axes[k])} ({inspection.axes[k].name})"
        yield line("gyro unit", f"biases up to {bias} and the noise are plausible for a gyro")
    yield line("temperature", *_temperature(recording))
    yield line("length", f"{recording.n:,} samples, {duration(recording.duration)}")
    yield _bandwidth(recording.rate, widths)


def _resolution(recording: Recording, inspection: Inspection) -> str:
    """Return the noise of the axes in steps of their output, in words."""
    change = np.diff(recording.values, axis=0)
    rms = np.sqrt(np.einsum("ij,ij->j", change, change) / len(change) / 2.0)
    counts = [
        (float(r / q), k) for k, (r, q) in enumerate(zip(rms, inspection.steps, strict=True)) if q > 0.0
    ]
    if not counts:
        return "the samples show no rounding"
    least, k = min(counts)
    step = f"{amount(inspection.steps[k], recording.axes[k], 3)} ({recording.axes[k].name})"
    return f"the noise is at least {plain(least, 2)} steps of {step}"


def _gravity(inspection: Inspection) -> tuple[str, Verdict]:
    """Return the size of gravity in the accelerometers, which verifies their unit."""
    accel = max(groups(inspection.axes, "accel"), key=len)
    size = float(np.linalg.norm(inspection.mean[accel]))
    unit, scale = rate_unit_of(inspection.axes[accel[0]].unit, "accel")
    off = f"{plain(size / scale, 4)} {unit}, {plain(100.0 * abs(size / _G - 1.0), 2)} % off gravity"
    if abs(size / _G - 1.0) < 0.2:
        return f"the mean is {off}", "fine"
    if len(accel) < 3:
        mean = amount(size, inspection.axes[accel[0]])
        return f"the mean is {mean}; without all three axes, gravity does not verify the unit", "look"
    why = "the sensor moved" if inspection.moving else "was gravity removed, or not simulated?"
    return f"the mean is {off}; {why}", "look"


def _temperature(recording: Recording) -> tuple[str, Verdict]:
    """Return the temperature channels in words, if no axis follows one."""
    channels = temperatures(recording)
    if not channels:
        return "no temperature column; temperature drift will be counted as B, K or ramp", "look"
    missing = [key for key, z in channels.items() if not np.isfinite(z).all()]
    if missing:
        return f"values of {', '.join(missing)} are missing; whether an axis follows it is unknown", "look"
    varies = []
    for key, z in channels.items():
        unit = recording.auxiliary_units.get(key, "(unit of its column)")
        varies.append(f"{key} varies by {plain(float(np.ptp(z)), 3)} {unit}")
    return f"{' and '.join(varies)}, and no axis follows it", "fine"


def _bandwidth(rate: float, widths: Mapping[str, float | None]) -> Line:
    """Return the check of the sample rate against the bandwidth of the axes."""
    name, wanted = "bandwidth", "three to five times the bandwidth suffices"
    known = {axis: value for axis, value in widths.items() if value is not None}
    below = {axis: value for axis, value in known.items() if np.isfinite(value)}
    if not known:
        return Line(name, "look", "unknown", "drift or a short record hides the passband")
    if not below:
        unlimited = f"no filter below {plain(rate / 2.0, 4)} Hz, half the rate"
        aliased = f"if the sensor has more bandwidth, aliased noise adds to N ({wanted})"
        return Line(name, "look", unlimited, aliased)
    axis = max(below, key=below.__getitem__)
    widest = below[axis]
    found = f"{plain(widest, 3)} Hz ({axis}); the rate is {plain(rate / widest, 2)} times that"
    if rate < _LEAST_RATIO * widest:
        return Line(name, "look", found, f"aliased noise adds to N ({wanted})")
    return Line(name, "fine", found, f"{'more than needed, as ' * (rate > _MOST_RATIO * widest)}{wanted}")


def worst(lines: Sequence[Line]) -> Verdict:
    """Return the worst verdict of these lines."""
    order: Mapping[str, int] = {"fine": 0, "look": 1, "stop": 2}
    return max((line.verdict for line in lines), key=order.__getitem__, default="fine")
