"""How the events of a recording are handled: cut out, filled in on one axis, kept, or a refusal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from allanjax.base.wording import plain
from allanjax.inspection.events import Event, quiet_parts
from allanjax.inspection.facts import (
    NOT_A_MEASUREMENT,
    Consequence,
    Fact,
    amount,
    grid,
    listed,
    seconds,
    span,
)
from allanjax.inspection.levels import levels_of
from allanjax.inspection.windows import Sampled, Windows, groups_of
from allanjax.record.columns import names_of
from allanjax.record.completion import MOST_MISSING

# Least share of the recording that coefficients may be estimated from.
_LEAST_SHARE = 0.3
# A ratio of the noise above which the quieter one is nearly none.
_FAR = 1e3
# Ways to obtain coefficients nevertheless.
_REMEDY = (
    "select a part with --start and --stop (start=, stop=, .between), use all samples with --as-is "
    "(as_is=True), or run allanjax critique for the causes"
)
# Clauses about one event and about several: of another noise, and at an instant; of each kind, in the order
# in which they are reported.
_NOISE = "{spans} is {ratio} {kind} than the rest", "{spans} are {ratio} {kind} than the rest"
_INSTANT = "a {kind} of {size} at {places} ({axis})", "{count} {kind}s of up to {size} ({axis}) at {places}"
_CLAUSES = {
    "noisier": _NOISE,
    "quieter": _NOISE,
    "silent": ("{axis} does not change at all in {spans}",) * 2,
    "warm-up": ("warm-up drift until {end} s ({axis} starts {size} off)",) * 2,
    "step": _INSTANT,
    "shift": ("{axis} shifts by {size} in {spans}", "the mean shifts by up to {size} ({axis}) in {spans}"),
    "knock": _INSTANT,
    "spike": (
        "an outlying sample {size} off at {places} ({axis})",
        "{count} outlying samples of up to {size} off ({axis}) at {places}",
    ),
}

#: Samples by axis name: ranges from the first index up to but not including the last.
Places = Mapping[str, tuple[tuple[int, int], ...]]


def longest(parts: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Return the longest of these parts, from a first to a last place."""
    return max(parts, key=lambda part: part[1] - part[0])


class Treatment:
    """How the events of a recording or stream are handled, given its windows.

    Attributes:
        as_is: whether all samples are used in any case.
        events, quiet: the events, and the parts without those that must be cut out, as sample indices.
        cut: the events that are cut out.
        alone: those that affect a single axis, by its name.
        harmless: those that are kept, since they change no coefficient, or are how it varies.
        possible: whether enough remains without the events that must be cut out.
        doubt: why a long quiet part may not be the sensor at rest, in words; "" if it is, or there is none.
        parts: start and end [s] of the parts that are used, rounded inwards; empty if all samples are used.
        part: windows of the longest of them.
    """

    def __init__(self, sampled: Sampled, windows: Windows, as_is: bool, may_move: bool = False) -> None:
        self.axes, self.rate = sampled.axes, sampled.rate
        self.n, self.as_is = windows.n, as_is
        levels = levels_of(windows, self.rate)
        groups = groups_of([axis.sensor for axis in self.axes])
        self.events, quiet = quiet_parts(windows, groups, may_move, levels)
        edges = windows.edges.tolist()
        self.quiet = [(edges[a], edges[b]) for a, b in quiet]
        matter = [e for e in self.events if e.matters]
        self.cut = [e for e in matter if e.is_cut]
        self.alone: dict[str, list[Event]] = {}
        for e in matter:
            if e.is_of_one_axis and not e.is_slight:
                self.alone.setdefault(self.axes[e.axes[0]].name, []).append(e)
        self.harmless = [e for e in self.events if e.is_slight or not e.matters]
        self.doubt = "" if levels is None else levels.doubt
        # A quiet part beside a loud one is the sensor, however short it is.
        least = 0.0 if levels is not None else _LEAST_SHARE * self.n
        self.possible = sum(b - a for a, b in self.quiet) >= least and not self.doubt
        used = self.cut and self.possible and not as_is
        self.parts = tuple(self._inwards(a, b) for a, b in self.quiet) if used else ()
        self.part = windows
        if self.parts:
            start, stop = longest(self.parts)
            first = int(np.searchsorted(edges, self.rate * (start - 1e-9)))
            last = int(np.searchsorted(edges, self.rate * (stop + 1e-9), side="right")) - 1
            self.part = windows.between(first, max(last, first + 1))

    def _inwards(self, first: int, last: int) -> tuple[float, float]:
        """Start and end [s] of a part, rounded inwards."""
        whole, step = self.n / self.rate, self._step
        start = np.ceil(first / self.rate / step - 1e-9) * step if first else 0.0
        stop = np.floor(last / self.rate / step + 1e-9) * step if last < self.n else whole
        return round(float(start), 9), round(float(stop), 9)

    @property
    def _step(self) -> float:
        """Rounding of times [s]."""
        return grid(self.n / self.rate)

    @property
    def lost(self) -> dict[str, tuple[tuple[int, int], ...]]:
        """Samples of a single axis that are filled in from its other samples, if enough of these remain."""
        ranges = {name: tuple((e.first, e.last) for e in own) for name, own in self.alone.items()}
        most = 0.0 if self.as_is else MOST_MISSING * self.n
        return {name: of for name, of in ranges.items() if sum(b - a for a, b in of) < most}

    @property
    def refusal(self) -> Fact | None:
        """Why there are no coefficients; None if there are."""
        if self.possible or not self.cut or self.as_is:
            return None
        if self.doubt:
            means = f"no coefficients, as the quiet part may not be the sensor: {self.doubt}"
            loud = [(e.first, e.last) for e in self.cut if e.kind == "noisier"]
            choice = ", ".join(map(self._selected, (self.quiet, loud)))
            remedy = f"select a part with {choice}, or use all samples with --as-is (as_is=True)"
        else:
            first, last = longest(self.quiet)
            undisturbed = span(first / self.rate, last / self.rate, self._step)
            means = (
                f"no coefficients, as the undisturbed parts are less than {100.0 * _LEAST_SHARE:.0f} % of "
                f"the recording (the longest is {undisturbed})"
            )
            remedy = _REMEDY
        return replace(self._fact_of_cut, consequence=NOT_A_MEASUREMENT, meaning=means, remedy=remedy)

    def facts(self, refusal: Fact | None) -> Iterator[Fact]:
        """Yield facts about the events that matter, including why there are no coefficients."""
        if refusal:
            yield refusal
        elif self.cut:
            used = listed([span(*part, self._step) for part in self.parts], len(self.parts))
            then = f"coefficients are estimated from {used}" if used else "all samples are used"
            out = self.n / self.rate - sum(b - a for a, b in self.parts) if used else None
            yield replace(self._fact_of_cut, meaning=then, size=out, unit="s")
        for name, own in self.alone.items():
            consequence: Consequence = "none"
            then = "all samples are used"
            if name in self.lost:
                consequence, then = "widened", "these samples are left out and filled in"
            elif not self.as_is:
                consequence = NOT_A_MEASUREMENT
                then = f"this is more than {100.0 * MOST_MISSING:.0f} % of the axis, too much to be filled in"
            text = f"{name} only: {self.describe(own).replace(f' ({name})', '')}"
            yield Fact("disturbances", text, (name,), consequence, spans=self._spans(own), meaning=then)

    @property
    def _fact_of_cut(self) -> Fact:
        """Fact about the events that must be cut out."""
        names, spans = names_of(self.axes), self._spans(self.cut)
        return Fact("disturbances", self.describe(self.cut), names, spans=spans)

    def _spans(self, events: Sequence[Event]) -> tuple[tuple[float, float], ...]:
        """Start and end [s] of events."""
        return tuple((e.first / self.rate, e.last / self.rate) for e in events)

    def _selected(self, parts: Sequence[tuple[int, int]]) -> str:
        """The options that select the longest of these parts."""
        start, stop = (seconds(end / self.rate, self._step) for end in longest(parts))
        return f"--start {start} --stop {stop} (start={start}, stop={stop})"

    def describe(self, events: Sequence[Event]) -> str:
        """Events in words, e.g. "0–5 s is 9 times noisier than the rest, a step of 1 deg/s at 9 s"."""
        by_kind = [(kind, [e for e in events if e.kind == kind]) for kind in _CLAUSES]
        return ", ".join(self._clause(kind, of) for kind, of in by_kind if of)

    def _clause(self, kind: str, events: Sequence[Event]) -> str:
        """Return a clause about all events of one kind."""
        step = self._step
        # Time spans, rounded; outwards if the rounded ends were the same.
        ends = [(e.first / self.rate / step, e.last / self.rate / step) for e in events]
        ends = [x if round(x[0]) != round(x[1]) else (np.floor(x[0]), np.ceil(x[1])) for x in ends]
        middles = [seconds(0.5 * (e.first + e.last) / self.rate, step) for e in events]
        largest = max(events, key=lambda e: abs(e.size))
        axis = self.axes[largest.axis]
        # Two digits, or three where it is near one.
        ratio = f"{plain(largest.size, 2 if largest.size >= 2.0 else 3)} times"
        one, several = _CLAUSES[kind]
        clause = one if len(events) == 1 else several
        return clause.format(
            kind=kind,
            spans=listed([span(step * first, step * last, step) for first, last in ends]),
            places=listed([f"{middle} s" for middle in middles]),
            end=seconds(events[-1].last / self.rate, step),
            ratio="far" if largest.size > _FAR else ratio,
            size=amount(abs(largest.size), axis),
            axis=axis.name,
            count=len(events),
        )
