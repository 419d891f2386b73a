"""How events and outlying samples are handled: cut out, filled in on one axis, kept, or refused."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float

from allanjax.base.wording import plain
from allanjax.inspection.events import Event
from allanjax.inspection.facts import Consequence, Fact, amount, grid, listed, seconds, span
from allanjax.inspection.scores import runs
from allanjax.record.completion import MOST_MISSING
from allanjax.record.recording import Axis

# Least share of the recording that coefficients may be estimated from.
_LEAST_SHARE = 0.3
# A part that is quieter by this factor and has this share of the recording may be the sensor at rest.
_MUCH, _LONG = 1.5, 0.1
# An excess of the Allan variance by less than this biases a coefficient by less than 5 %.
_SLIGHT = 0.1
# Ways to obtain coefficients nevertheless.
_REMEDY = (
    "select a part with --start and --stop (start=, stop=, .between), use all samples with --as-is "
    "(as_is=True), or run allanjax critique for the causes"
)
# Kinds of events in the order in which they are reported.
_KINDS = ("noisier", "quieter", "silent", "warm-up", "step", "shift", "knock", "spike")
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

#: Samples by axis name: ranges from the first index up to but not including the last.
Places = Mapping[str, tuple[tuple[int, int], ...]]


@dataclasses.dataclass(frozen=True)
class Treatment:
    """How the events of a recording of n samples of these axes at this rate [Hz] are handled.

    Attributes:
        as_is: whether all samples are used in any case.
        quiet: parts without the events that must be cut out, as sample indices.
        cut, alone, kept, harmless: the events that are cut out; that affect a single axis; that are kept and
            widen the intervals; that change no coefficient.
        possible: whether enough remains without the events that must be cut out.
        unclear: whether the disturbance lasts so long that the quiet part may not be the sensor at rest.
    """

    axes: Sequence[Axis]
    rate: float
    n: int
    as_is: bool
    quiet: Sequence[tuple[int, int]]
    cut: Sequence[Event]
    alone: Sequence[Event]
    kept: Sequence[Event]
    harmless: Sequence[Event]
    possible: bool
    unclear: bool

    @classmethod
    def of(
        cls,
        events: Sequence[Event],
        quiet: Sequence[tuple[int, int]],
        axes: Sequence[Axis],
        rate: float,
        n: int,
        as_is: bool,
    ) -> Treatment:
        """Return the treatment of events, given the parts without those that must be cut out."""
        touched = [e for e in events if e.matters]
        cut = [e for e in touched if e.is_cut]
        alone = [e for e in touched if e.is_of_one_axis and not e.is_slight]
        kept = [e for e in touched if e.is_slight]
        harmless = [e for e in events if not e.matters]
        quieter = sum(e.last - e.first for e in cut if e.kind == "quieter" and e.size > _MUCH)
        unclear = quieter > _LONG * n
        possible = sum(b - a for a, b in quiet) >= _LEAST_SHARE * n and not unclear
        if cut and not (possible or unclear) and sum(e.share for e in cut) < _SLIGHT:
            cut, kept, possible = [], [*kept, *cut], True
        return cls(axes, rate, n, as_is, quiet, cut, alone, kept, harmless, possible, unclear)

    @property
    def parts(self) -> tuple[tuple[float, float], ...]:
        """Start and end [s] of the parts that are used, rounded inwards; empty if all samples are used."""
        if not self.cut or not self.possible or self.as_is:
            return ()
        step, whole = grid(self.n / self.rate), self.n / self.rate
        starts = [np.ceil(a / self.rate / step - 1e-9) * step if a else 0.0 for a, _ in self.quiet]
        stops = [np.floor(b / self.rate / step + 1e-9) * step if b < self.n else whole for _, b in self.quiet]
        return tuple((round(float(a), 9), round(float(b), 9)) for a, b in zip(starts, stops, strict=True))

    @property
    def lost(self) -> dict[str, tuple[tuple[int, int], ...]]:
        """Samples of a single axis that are filled in from its other samples, if enough of these remain."""
        found = {
            name: tuple((e.first, e.last) for e in events)
            for name, events in self._alone().items()
            if not self.as_is
        }
        return {name: of for name, of in found.items() if sum(b - a for a, b in of) < MOST_MISSING * self.n}

    @property
    def disturbance_error(self) -> Float[np.ndarray, " axes"]:
        """Relative error of the Allan deviation of each axis due to the events that are kept."""
        found = np.zeros(len(self.axes))
        for e in self.kept:
            found[list(e.axes)] += 0.5 * np.array(e.shares)[list(e.axes)]
        return found

    def describe(self, events: Sequence[Event]) -> str:
        """Events in words, e.g. "0–5 s is 9 times noisier than the rest, a step of 1 deg/s at 9 s"."""
        by_kind = [(kind, [e for e in events if e.kind == kind]) for kind in _KINDS]
        return ", ".join(self._clause(kind, of) for kind, of in by_kind if of)

    @property
    def refusal(self) -> str:
        """Reason why there are no coefficients, in words; "" if there are."""
        if self.possible or not self.cut or self.as_is:
            return ""
        events = self.describe(self.cut)
        if self.unclear:
            return f"{events}; it is unclear which of these parts is the sensor at rest: {_REMEDY}"
        a, b = max(self.quiet, key=lambda part: part[1] - part[0])
        longest = span(a / self.rate, b / self.rate, grid(self.n / self.rate))
        return (
            f"{events}; the undisturbed parts are less than {100.0 * _LEAST_SHARE:.0f} % of the recording "
            f"(the longest is {longest}): {_REMEDY}"
        )

    def facts(self, refusal: str) -> list[Fact]:
        """Return facts about the events that matter, including why there are no coefficients."""
        facts, every = [], tuple(axis.name for axis in self.axes)
        if self.cut and refusal:
            facts.append(self._fact(self.cut, every, "not a measurement", f"no coefficients: {refusal}"))
        elif self.cut:
            step, parts = grid(self.n / self.rate), self.parts
            used = listed([span(*part, step) for part in parts], len(parts))
            then = f"coefficients are estimated from {used}" if used else "all samples are used"
            text = f"{self.describe(self.cut)}; {then}"
            out = self.n / self.rate - sum(b - a for a, b in parts) if parts else None
            fact = self._fact(self.cut, every, "none", text)
            facts.append(dataclasses.replace(fact, size=out, unit="s"))
        for name, own in self._alone().items():
            then, consequence = "all samples are used", "none"
            if name in self.lost:
                then, consequence = "these samples are left out and filled in", "widened"
            elif not self.as_is:
                then = f"this is more than {100.0 * MOST_MISSING:.0f} % of the axis, too much to be filled in"
                consequence = "not a measurement"
            text = f"{name} only: {self.describe(own).replace(f' ({name})', '')}; {then}"
            facts.append(self._fact(own, (name,), consequence, text))  # type: ignore[arg-type]
        if self.kept:
            share = plain(100.0 * float(self.disturbance_error.max()), 1)
            text = f"{self.describe(self.kept)}; kept, intervals are widened by {share} % of the deviation"
            names = tuple(every[k] for k in sorted({k for e in self.kept for k in e.axes}))
            facts.append(self._fact(self.kept, names, "widened", text))
        return facts

    def _alone(self) -> dict[str, list[Event]]:
        """Events on a single axis by its name."""
        names = dict.fromkeys(self.axes[e.axes[0]].name for e in self.alone)
        return {name: [e for e in self.alone if self.axes[e.axes[0]].name == name] for name in names}

    def _fact(
        self, events: Sequence[Event], names: tuple[str, ...], consequence: Consequence, text: str
    ) -> Fact:
        spans = tuple((e.first / self.rate, e.last / self.rate) for e in events)
        return Fact("disturbances", text, names, consequence, spans=spans)

    def _clause(self, kind: str, events: Sequence[Event]) -> str:
        """Return a clause about all events of one kind."""
        step = grid(self.n / self.rate)
        places = listed([self._around(e, step) for e in events])
        largest = max(events, key=lambda e: abs(e.size))
        axis = self.axes[largest.axis]
        size = amount(abs(largest.size), axis)
        if kind in ("noisier", "quieter"):
            # Two digits, or three where it is near one.
            ratio = plain(largest.size, 2 if largest.size >= 2.0 else 3)
            return f"{places} {'is' if len(events) == 1 else 'are'} {ratio} times {kind} than the rest"
        if kind == "silent":
            return f"{axis.name} does not change at all in {places}"
        if kind == "warm-up":
            until = seconds(events[-1].last / self.rate, step)
            return f"warm-up drift until {until} s ({axis.name} starts {size} off)"
        if kind == "shift":
            if len(events) == 1:
                return f"{axis.name} shifts by {size} in {places}"
            return f"the mean shifts by up to {size} ({axis.name}) in {places}"
        middles = listed([f"{seconds(0.5 * (e.first + e.last) / self.rate, step)} s" for e in events])
        noun, off = ("outlying sample", " off") if kind == "spike" else (kind, "")
        if len(events) > 1:
            return f"{len(events)} {noun}s of up to {size}{off} ({axis.name}) at {middles}"
        a, of = ("an", "") if kind == "spike" else ("a", "of ")
        return f"{a} {noun} {of}{size}{off} at {middles} ({axis.name})"

    def _around(self, e: Event, step: float) -> str:
        """Time span of an event, rounded; outwards if the rounded ends were the same."""
        first, last = e.first / self.rate / step, e.last / self.rate / step
        if round(first) == round(last):
            first, last = np.floor(first), np.ceil(last)
        return span(step * first, step * last, step)


def spikes_in(x: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
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


def outliers_of(x: Float[np.ndarray, " n"], step: float) -> tuple[int, float]:
    """Return the number of samples beyond Gaussian noise, and the variance that they add.

    Both are zero if chance explains the number. Deviations up to a rounding `step` do not count.
    """
    distance, scale = _distances(x)
    beyond = distance[distance * scale > _OUTLYING * scale + step]
    if len(beyond) <= _ENOUGH * (1.0 + len(x) * _GAUSSIAN_BEYOND):
        return 0, 0.0
    return len(beyond), float(np.sum(beyond**2 - 1.0)) * scale**2 / len(x)


def _distances(x: Float[np.ndarray, " n"]) -> tuple[Float[np.ndarray, " n"], float]:
    """Return distances from the mean of the two neighbours in robust standard deviations, and that deviation.

    Distances are zero if many samples equal that mean: the output is rounded, and its steps are not outliers.
    """
    left = np.zeros(len(x))
    left[1:-1] = abs(x[1:-1] - 0.5 * (x[:-2] + x[2:]))
    # The median itself would be coarse where the output is rounded.
    inner = np.partition(left, most := int(_INNER * len(x)))[:most]
    scale = float(np.sqrt(np.mean(inner**2))) / _INNER_RMS
    rounded = np.mean(left[1:-1] == 0.0) > _EQUAL
    return (np.zeros(len(x)) if rounded or not scale > 0.0 else left / scale), scale
