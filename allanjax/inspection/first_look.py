"""Inspection of a recording before its coefficients are estimated."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from allanjax.base.equality import ByValue
from allanjax.base.errors import expect
from allanjax.base.threads import for_each
from allanjax.base.wording import record_size
from allanjax.inspection.events import Event
from allanjax.inspection.facts import NOT_A_MEASUREMENT, Fact, grid, ordered, span, warnings_of
from allanjax.inspection.outliers import heavy_tails, spike_facts, spikes_in
from allanjax.inspection.plausible import (
    LOWEST_RATE,
    Ends,
    dead_facts,
    lattice,
    rate_facts,
    resolved,
    sampling_facts,
    saturated,
    short,
    temperature_facts,
)
from allanjax.inspection.spectral import spectral_facts
from allanjax.inspection.treatment import Places, Treatment, longest
from allanjax.inspection.units import units_of_record
from allanjax.inspection.windows import (
    OfAxes,
    Sampled,
    Samples,
    Values,
    Which,
    Windows,
    motion_fact,
    motions,
    rms_within,
)
from allanjax.record.columns import names_of
from allanjax.record.completion import bridged, completed
from allanjax.record.recording import Axis, DeadAxis, Recording
from allanjax.record.units import SENSORS

# Samples from which the step of the output is determined.
_LOOKED_AT = 1 << 14
_NOT_EXAMINED = "not examined in a stream: outliers, lines, interpolated samples, temperature"
_EXAMINED = "to check these, read a part of the file as a whole (--start, --stop)"


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
        return longest(self.parts) if self.parts else None

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
        rows = {part: _rows(part, self.rate) for part in self.parts}
        chosen, quiet = rows.pop(self.longest_part), recording.between(*self.longest_part)
        kept = [recording.names.index(name) for name in quiet.names]
        others = [completed(recording.values[part], lost[part])[:, kept] for part in rows.values()]
        alive = (x for x in others if (np.ptp(x, axis=0) > 0.0).all())
        everything = (*(x[:, kept] for x in recording.others), *alive)
        return dataclasses.replace(_completed(quiet, lost[chosen][:, kept]), others=everything, places=())

    def uncut(self) -> Inspection:
        """Return this inspection for accumulated samples: if parts must be left out, it is a refusal."""
        if self.longest_part is None:
            return self
        start, stop = (f"{time:.6g}" for time in self.longest_part)
        part = span(*self.longest_part, grid(self.n / self.rate))
        refused = Fact(
            "disturbances",
            self.left_out,
            names_of(self.axes),
            NOT_A_MEASUREMENT,
            meaning="no coefficients, as accumulated samples cannot be left out",
            remedy=f"read the undisturbed part {part} again with start={start}, stop={stop} "
            f"(--start {start} --stop {stop}), or use all samples with as_is=True (--as-is)",
        )
        facts = [f for f in self.facts if f.kind != "disturbances" or f.consequence != "none"]
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
    columns = zip(recording.values.T, _filled(recording).T, strict=True)
    spikes = for_each(lambda column: spikes_in(*column), columns)
    windows = Windows.of(_bridged(recording.values, spikes)).closed()
    treatment = Treatment(recording, windows, as_is, may_move)
    found = _of_samples(recording, treatment, spikes)
    return _inspection(recording, treatment, found, vibrating, recording.auxiliary)


def look(
    stream: Sampled,
    windows: Windows,
    ends: Ends,
    dead: Sequence[DeadAxis],
    *,
    as_is: bool = False,
    vibrating: bool = False,
) -> Inspection:
    """Return the inspection of a stream, as `inspect` does of a recording.

    Args:
        stream: the stream, with the axes that are not dead.
        windows, ends: windows of its samples, and ends of their range.
        dead: the axes that are dead.
        as_is, vibrating: as in `inspect`.
    """
    treatment = Treatment(stream, windows.closed(), as_is)
    steps = treatment.part.steps
    facts = [*resolved(treatment.part, stream.axes, steps), *dead_facts(dead)]
    facts.append(Fact("not examined", _NOT_EXAMINED, names_of(stream.axes), remedy=_EXAMINED))
    facts += saturated(stream.axes, ends, steps)
    found = _Found(facts, steps, np.zeros(len(steps)), treatment.lost)
    return _inspection(stream, treatment, found, vibrating, {})


class _Found(NamedTuple):
    """What the samples themselves show.

    Attributes:
        facts: facts about them.
        steps: step of the output of each axis; 0 if none is detected.
        outliers: variance that outliers which are kept add to each axis.
        lost: samples of single axes that are left out and filled in, by axis.
    """

    facts: list[Fact]
    steps: OfAxes
    outliers: OfAxes
    lost: Places


def _inspection(
    sampled: Sampled, treatment: Treatment, found: _Found, vibrating: bool, auxiliary: Mapping[str, Samples]
) -> Inspection:
    """Return the inspection of a recording or stream, given what its samples show."""
    axes, part = sampled.axes, treatment.part
    moving = motions(part, axes, sampled.rate)
    # Sensors whose noise and mean may be motion.
    moved = SENSORS if vibrating else {axes[m.axis].sensor for m in moving}
    facts = rate_facts(sampled, auxiliary)
    # At a wrong rate, noise is no evidence of the unit.
    if sampled.rate >= LOWEST_RATE:
        facts += units_of_record(sampled, part, found.steps, moved)
    if treatment.as_is:
        facts = [dataclasses.replace(fact, consequence="none") for fact in facts]
    # With a wrong unit noise looks like motion.
    wrong = _names(fact for fact in facts if fact.kind != "rate")
    moving = [m for m in moving if axes[m.axis].name not in wrong]
    refusal = treatment.refusal
    if moving and not vibrating:
        facts.append(motion_fact(moving, axes, bool(refusal)))
        # The fact about motion comes first and is reason enough.
        refusal = None
    facts += [*treatment.facts(refusal), *short(part.n, sampled), *found.facts]
    kept = treatment.describe(treatment.harmless)
    note = f"{kept}; kept, since no coefficient changes by more than its interval allows"
    return Inspection(
        name=sampled.name,
        rate=sampled.rate,
        n=treatment.n,
        axes=tuple(axes),
        mean=part.average,
        rms=np.sqrt(rms_within(part) ** 2 + part.averaged((part.mean - part.average) ** 2)),
        parts=treatment.parts,
        lost=found.lost,
        refusal=refusal.text if refusal else "",
        facts=ordered(facts),
        notes=(note,) if kept else (),
        events=treatment.events,
        left_out=treatment.describe(treatment.cut),
        steps=found.steps,
        added_noise=np.sqrt(found.steps**2 / 12.0 + found.outliers),
    )


def _of_samples(recording: Recording, treatment: Treatment, spikes: Sequence[Which]) -> _Found:
    """Return what the samples of a recording show, given the isolated outliers of its axes."""
    rows, axes = slice(0, recording.n), recording.axes
    if treatment.parts:
        rows, times = _rows(longest(treatment.parts), recording.rate), recording.time
        inside = np.any([(times >= a) & (times < b) for a, b in treatment.parts], axis=0)
        spikes = [at & inside for at in spikes]
    columns = zip(recording.values[rows].T, _filled(recording)[rows].T, strict=True)
    own = [x[~filled] if filled.any() else x for x, filled in columns]
    steps = np.array([lattice(x[:_LOOKED_AT]) or 0.0 for x in own])
    facts = list(resolved(treatment.part, axes, steps))
    held = _names(fact for fact in facts if fact.kind == "repeated samples" or fact.grave)
    for k, x in enumerate(own):
        facts += saturated(axes[k : k + 1], Ends.of(x[:, None]), steps[k : k + 1])
    whole = _bridged(recording.values, spikes)
    # A burst has power at all frequencies, some of which would look like lines.
    lost = treatment.lost
    calm = _bridged(whole, list(_at(lost, recording).T))[rows]
    facts += spectral_facts(calm, recording.rate, axes, held)
    facts += [*sampling_facts(recording), *temperature_facts(recording)]
    # What is no measurement, as interpolated samples, has no outliers of its own.
    grave, outliers = _names(fact for fact in facts if fact.grave), np.zeros(len(axes))
    for k, axis in enumerate(axes):
        if axis.name not in held | grave:
            outliers[k], of_axis = heavy_tails(calm[:, k], axis, float(steps[k]))
            facts += of_axis
    single = spike_facts(recording, whole, spikes)
    facts += [fact for fact in single if not grave.issuperset(fact.axes)]
    if not treatment.as_is:
        for axis, at in zip(axes, spikes, strict=True):
            places = ((k, k + 1) for k in np.flatnonzero(at).tolist())
            lost[axis.name] = (*lost.get(axis.name, ()), *places)
    return _Found(facts, steps, outliers, {name: of for name, of in lost.items() if of})


def _names(facts: Iterable[Fact]) -> set[str]:
    """Return the names of the axes that these facts are about."""
    return {name for fact in facts for name in fact.axes}


def _rows(part: tuple[float, float], rate: float) -> slice:
    """Return the samples of a part that starts and ends at these times [s]."""
    return slice(*(round(time * rate) for time in part))


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


def _filled(recording: Recording) -> Bool[np.ndarray, "n axes"]:
    """Return which samples were missing and have been filled in."""
    return np.zeros_like(recording.values, bool) if recording.missing is None else recording.missing


def _completed(recording: Recording, lost: Bool[np.ndarray, "n axes"]) -> Recording:
    """Return the recording with lost samples filled in given the others."""
    if not lost.any():
        return recording
    missing = lost | _filled(recording)
    return dataclasses.replace(recording, values=completed(recording.values, missing), missing=missing)
