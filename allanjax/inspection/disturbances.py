"""What is done about the events of a recording: cut out, drawn anew on one axis, kept, or refused."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from allanjax.base.wording import plain
from allanjax.inspection.facts import Fact
from allanjax.inspection.quiet import Event
from allanjax.inspection.words import grid, listed, refused, said_of_events, span, unclear
from allanjax.record.completion import MOST_MISSING
from allanjax.record.recording import Axis

#: Least share of the recording that coefficients may be estimated from.
LEAST_SHARE = 0.3
# A part that is quieter by this factor, and this share of the recording, may be the sensor at rest.
_MUCH, _LONG = 1.5, 0.1
# An excess of the Allan variance by less than this biases a coefficient by less than 5 %.
_SLIGHT = 0.1
_KIND = "disturbances"

#: Samples of axes by their names: from the first up to but not including the last, as often as needed.
Places = Mapping[str, tuple[tuple[int, int], ...]]
Part = tuple[float, float]


@dataclasses.dataclass(frozen=True)
class Treatment:
    """What is done about events.

    Attributes:
        parts: start and end [s] of what is used; none for all of it.
        lost: stretches on one axis alone, which are drawn given its other samples.
        cut, alone, kept, harmless: the events that are cut out; that are on one axis alone; that are kept,
            and allowed for; that change nothing.
        possible: whether enough is left without those that have to be cut out.
        unclear: whether the sensor was disturbed for so long that the quiet part may not be the one at rest.
    """

    parts: tuple[Part, ...]
    lost: Places
    cut: tuple[Event, ...]
    alone: tuple[Event, ...]
    kept: tuple[Event, ...]
    harmless: tuple[Event, ...]
    possible: bool
    unclear: bool

    @classmethod
    def of(
        cls,
        events: Sequence[Event],
        parts: Sequence[tuple[int, int]],
        axes: Sequence[Axis],
        rate: float,
        n: int,
        as_is: bool,
    ) -> Treatment:
        """Treatment of events, given the parts without those that are to be cut out, as sample indices."""
        touched = [e for e in events if e.matters]
        cut = [e for e in touched if e.is_cut]
        alone = [e for e in touched if e.is_of_one_axis and not e.is_slight]
        kept = [e for e in touched if e.is_slight]
        harmless = [e for e in events if not e.matters]
        quieter = [e for e in cut if e.kind == "quieter" and e.size > _MUCH]
        unlikely_rest = sum(e.last - e.first for e in quieter) > _LONG * n
        possible = sum(b - a for a, b in parts) >= LEAST_SHARE * n and not unlikely_rest
        if cut and not possible and not unlikely_rest and sum(e.share for e in cut) < _SLIGHT:
            cut, kept, possible = [], [*kept, *cut], True
        rounded = [_rounded(a, b, n, rate) for a, b in parts] if cut and possible and not as_is else []
        lost: dict[str, tuple[tuple[int, int], ...]] = {}
        for e in alone:
            name = axes[e.axes[0]].name
            lost[name] = (*lost.get(name, ()), (e.first, e.last))
        few = {name: of for name, of in lost.items() if sum(b - a for a, b in of) < MOST_MISSING * n}
        of_all = (tuple(cut), tuple(alone), tuple(kept), tuple(harmless))
        return cls(tuple(rounded), {} if as_is else few, *of_all, possible, unlikely_rest)

    def allowance(self, axes: int) -> Float[np.ndarray, " axes"]:
        """Relative error of the Allan deviation of each axis by the events that are kept."""
        found = np.zeros(axes)
        for e in self.kept:
            found[list(e.axes)] += 0.5 * np.array(e.shares)[list(e.axes)]
        return found

    def said(self, axes: Sequence[Axis], rate: float, n: int) -> str:
        """The events that are cut out, in words."""
        return said_of_events(self.cut, axes, rate, n / rate)

    def refusal(self, axes: Sequence[Axis], rate: float, n: int, parts: Sequence[tuple[int, int]]) -> str:
        """Why there are no coefficients, in words; "" if there are."""
        if self.possible or not self.cut:
            return ""
        said = self.said(axes, rate, n)
        a, b = max(parts, key=lambda part: part[1] - part[0])
        longest = span(a / rate, b / rate, grid(n / rate))
        return unclear(said) if self.unclear else refused(said, longest, LEAST_SHARE)

    def facts(self, axes: Sequence[Axis], rate: float, n: int, as_is: bool, refusal: str) -> list[Fact]:
        """Facts about all events but those that change nothing."""
        every, step, facts = tuple(axis.name for axis in axes), grid(n / rate), []

        def fact(events: Sequence[Event], then: str, names: tuple[str, ...], consequence: str) -> Fact:
            said = said_of_events(events, axes, rate, n / rate)
            spans = tuple((e.first / rate, e.last / rate) for e in events)
            return Fact(_KIND, f"{said}{then}", names, consequence, spans=spans)  # type: ignore[arg-type]

        if self.cut and refusal:
            spans = tuple((e.first / rate, e.last / rate) for e in self.cut)
            facts.append(Fact(_KIND, f"no coefficients: {refusal}", every, "not a measurement", spans=spans))
        elif self.cut:
            used = listed([span(*part, step) for part in self.parts], len(self.parts))
            then = f": coefficients are of {used}" if used else ": coefficients are of all of it, as asked"
            out = n / rate - sum(stop - start for start, stop in self.parts) if self.parts else None
            facts.append(dataclasses.replace(fact(self.cut, then, every, "none"), size=out, unit="s"))
        for name in dict.fromkeys(axes[e.axes[0]].name for e in self.alone):
            own = [e for e in self.alone if axes[e.axes[0]].name == name]
            drawn = ": left out on this axis, and drawn given its other samples"
            if as_is:
                facts.append(fact(own, f" ({name} alone): kept, as asked", (name,), "none"))
            elif name in self.lost:
                facts.append(fact(own, f" ({name} alone){drawn}", (name,), "widened"))
            else:
                most = f"more than {100.0 * MOST_MISSING:.0f} % of {name}, and of no other axis"
                facts.append(fact(own, f": {most}", (name,), "not a measurement"))
        if self.kept:
            share = 100.0 * float(self.allowance(len(axes)).max())
            then = f": kept; intervals allow for {plain(share, 1)} % in the Allan deviation"
            names = tuple(axes[k].name for k in sorted({k for e in self.kept for k in e.axes}))
            facts.append(fact(self.kept, then, names, "widened"))
        return facts


def _rounded(begin: int, end: int, n: int, rate: float) -> Part:
    """Start and end [s] of a quiet part, rounded inwards."""
    step = grid(n / rate)
    start = np.ceil(begin / rate / step - 1e-9) * step if begin else 0.0
    stop = np.floor(end / rate / step + 1e-9) * step if end < n else n / rate
    return round(float(start), 9), round(float(stop), 9)
