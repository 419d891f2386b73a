"""Truths drawn at random: coefficients spread over a factor around values that are clearly seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.common.truth import RATE, SHAPES, Case

# Scenarios are written for so many samples. Longer records have their noise stretched along with them, so
# that every term stays as well seen as it was.
_LENGTH = 1 << 14
# A stretch by s of all times but the sample interval multiplies a coefficient by s to this power.
_STRETCH = {"Q": 0.0, "N": 0.0, "B": -0.5, "q": -1.0, "K": -1.0, "R": -1.5, "A": -0.5, "T": 1.0, "f": 0.0}
# Frequencies of lines are uniform [Hz].
LINE_BAND = (0.05 * RATE, 0.4 * RATE)


@dataclass(frozen=True)
class Scenario:
    """A set of terms, and the middle (geometric mean) of each coefficient's range at 2¹⁴ samples."""

    name: str
    middle: dict[str, float]
    factor: float = 3.0

    def ranges(self, n: int) -> dict[str, tuple[float, float]]:
        """Least and largest value of each coefficient in records of n samples."""
        half = np.sqrt(self.factor)
        found = {}
        for c, value in self.middle.items():
            value *= (n / _LENGTH) ** _STRETCH[c]
            found[c] = LINE_BAND if c == "f" else (value / half, value * half)
        return found

    def as_case(self) -> Case:
        """The middle of all ranges, at 2¹⁴ samples."""
        return Case(self.name, self.middle)

    def draw(
        self, n: int, records: int, rng: np.random.Generator, strength: tuple[float, float] = (1.0, 1.0)
    ) -> Case:
        """Coefficients for so many records: frequencies uniform, others log-uniform.

        Amplitudes but that of white noise are multiplied by a strength, one for each record, drawn between
        these log-uniformly.
        """
        truth = {}
        for c, (low, high) in self.ranges(n).items():
            u = rng.uniform(size=records)
            truth[c] = low + u * (high - low) if c == "f" else low * (high / low) ** u
        if strength != (1.0, 1.0):
            weaker = strength[0] * (strength[1] / strength[0]) ** rng.uniform(size=records)
            truth = {c: v if c in ("N", *SHAPES) else v * weaker for c, v in truth.items()}
        return Case(self.name, truth)


def one(case: Case, k: int) -> Case:
    """The k-th record's truth."""
    return Case(case.name, {c: float(v[k]) for c, v in case.truth.items()})


SCENARIOS = {
    s.name: s
    for s in (
        Scenario("N", {"N": 1.0}),
        Scenario("N+K", {"N": 1.0, "K": 2.0}),
        Scenario("Q+N+K", {"Q": 0.1, "N": 1.0, "K": 2.0}),
        Scenario("N+B", {"N": 1.0, "B": 2.0}),
        Scenario("N+B+K", {"N": 1.0, "B": 4.0, "K": 5.0}),
        Scenario("N+Markov", {"N": 1.0, "q": 40.0, "T": 0.1}),
        Scenario("N+Markov+K", {"N": 1.0, "q": 40.0, "T": 0.1, "K": 6.0}),
        Scenario("N+K+R", {"N": 1.0, "K": 2.0, "R": 2.5}),
        Scenario("Q+N+B+K+R", {"Q": 0.1, "N": 1.0, "B": 5.0, "K": 5.0, "R": 6.0}, factor=2.0),
        Scenario("N+sinusoid", {"N": 1.0, "A": 3.0, "f": 1.0}),
    )
}
