"""Levels of an output: the step that samples are multiples of, held samples, and the ends of its range."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from allanjax.base.wording import plain
from allanjax.inspection.facts import Fact
from allanjax.inspection.windows import Windows
from allanjax.inspection.words import amount
from allanjax.record.recording import Axis

#: Distance from a multiple of the step, in steps, up to which a sample is on the lattice.
TOLERANCE = 1e-3
# Least share of the gaps between values that are multiples of the step.
_SHARE = 0.999
# Number of different values up to which there may be a lattice although most samples differ.
_FEW = 20000
# Fewest runs of samples at the largest value, or fewest such samples, that are not by chance: judgements.
_LEAST, _MANY = 4, 100
# Fewest steps of a rounded output between its extremes for it to have a tail.
_FEW_LEVELS = 4
# Samples among which the step is looked for.
_LOOKED_AT = 1 << 14
# Share of equal neighbours at which the noise is 0.4 steps of the resolution; with more, it is not seen.
_HIDDEN = 0.6
# Share of equal neighbours, beyond those due to the resolution, at which samples must have been held.
_HELD = 0.1
# Rms of the noise in steps, below which it is hidden by the rounding, and below which this is worth a word:
# its own variance of a twelfth is then a third of all, and 2 %.
_TOO_FEW, _FEW_STEPS = 0.5, 2.0


def lattice(x: Float[np.ndarray, " n"]) -> float | None:
    """Step between the samples' values, if these are on a lattice, else None."""
    values = np.unique(x)
    least = 1e-9 * float(np.max(abs(values))) + 1e-300
    gaps = np.diff(values)
    gaps = gaps[gaps > least]
    if len(gaps) < 1 or (len(values) > max(len(x) / 2.0, 3) and len(values) > _FEW):
        return None
    q = float(gaps.min())
    for _ in range(3):
        steps = np.rint(gaps / q)
        q = float(np.sum(gaps) / np.sum(steps))
    off = abs(gaps / q - np.rint(gaps / q))
    return q if np.mean(off < TOLERANCE * np.maximum(np.rint(gaps / q), 1.0)) > _SHARE else None


@dataclasses.dataclass(frozen=True, eq=False)
class Ends:
    """How often samples are at the ends of their range, in constant memory however many they are.

    Each array has two rows: of the upper end, and of the lower one, for which signs are changed.

    Attributes:
        n: number of samples.
        value, count, runs: the largest value, samples that are there, and runs of them.
        below, count_below: the largest of the other values, and samples that are there.
    """

    n: int
    value: Float[np.ndarray, "2 axes"]
    count: Int[np.ndarray, "2 axes"]
    runs: Int[np.ndarray, "2 axes"]
    below: Float[np.ndarray, "2 axes"]
    count_below: Int[np.ndarray, "2 axes"]

    @classmethod
    def of(cls, values: Float[np.ndarray, "n axes"]) -> Ends:
        """Ends of the range of these samples."""
        sides = [values, -values]
        value = [x.max(axis=0, initial=-np.inf) for x in sides]
        at = [x == top for x, top in zip(sides, value, strict=True)]
        others = [np.where(there, -np.inf, x) for x, there in zip(sides, at, strict=True)]
        below = [x.max(axis=0, initial=-np.inf) for x in others]
        runs = [there[:1].sum(axis=0) + (there[1:] & ~there[:-1]).sum(axis=0) for there in at]
        count_below = [(x == level).sum(axis=0) for x, level in zip(others, below, strict=True)]
        count = [there.sum(axis=0) for there in at]
        return cls(len(values), *map(np.array, (value, count, runs, below, count_below)))

    def merge(self, right: Ends) -> Ends:
        """Ends of the range of the samples of two pieces."""
        value = np.maximum(self.value, right.value)
        both = [(x, x.value == value) for x in (self, right)]
        count, runs = (
            np.sum([np.where(at, getattr(x, name), 0) for x, at in both], axis=0)
            for name in ("count", "runs")
        )
        others = [(np.where(at, x.below, x.value), np.where(at, x.count_below, x.count)) for x, at in both]
        below = np.maximum(others[0][0], others[1][0])
        count_below = np.sum([np.where(level == below, counted, 0) for level, counted in others], axis=0)
        return Ends(self.n + right.n, value, count, runs, below, count_below)

    def of_axes(self, keep: Bool[np.ndarray, " axes"]) -> Ends:
        """Those of some of the axes."""
        names = [field.name for field in dataclasses.fields(self) if field.name != "n"]
        return dataclasses.replace(self, **{name: getattr(self, name)[:, keep] for name in names})

    def piled_up(self, steps: Float[np.ndarray, " axes"]) -> Bool[np.ndarray, "2 axes"]:
        """Whether more samples are at an end than a tail would leave there, given the steps, 0 for none."""
        # Copies of one extreme sample are another matter.
        often = (self.runs >= _LEAST) | (self.count >= _MANY)
        adjacent = abs(self.value - steps - self.below) < steps / 2.0
        tail = np.where(adjacent, self.count_below, 0)
        beyond = (self.count > tail + 6.0 * np.sqrt(tail + 1.0)) & (self.count >= 5 * _LEAST)
        has_tail = self.value.sum(axis=0) >= _FEW_LEVELS * steps
        return np.where(steps > 0.0, beyond & has_tail, often)


def resolved(
    windows: Windows, axes: Sequence[Axis], columns: Sequence[Float[np.ndarray, " recorded"]] | None
) -> tuple[list[Fact], Float[np.ndarray, " axes"]]:
    """Facts about axes whose noise is coarsely rounded or whose samples are held, and each axis's step.

    Args:
        windows: of the samples.
        axes: their axes.
        columns: the samples of each axis, where they are in memory.

    Returns:
        The facts; and the step of each axis [rad/s or m/s²], 0 where none is seen.
    """
    repeated = np.average(windows.repeated, axis=0, weights=windows.count)
    rms = np.sqrt(windows.power[0].sum(axis=0) / max(windows.pairs[0].sum(), 1) / 2.0)
    if columns is None:
        steps = np.where(np.isfinite(windows.resolution), windows.resolution, 0.0)
    else:
        steps = np.array([lattice(x[:_LOOKED_AT]) or 0.0 for x in columns])
    noise = rms / np.where(steps > 0.0, steps, 1.0)
    # Share of equal neighbours that rounding makes of Gaussian noise.
    chance = np.where(noise > 0.0, 0.5 / np.sqrt(np.pi) / np.maximum(noise, 1e-12), 0.0) * (steps > 0.0)
    facts = []
    for k, axis in enumerate(axes):
        name, size = (axis.name,), float(noise[k])
        few = f"the noise of {axis.name} is {plain(size, 2)} steps of its output, {amount(steps[k], axis, 3)}"
        if steps[k] > 0.0 and (noise[k] < _TOO_FEW or (repeated[k] > _HIDDEN and chance[k] > _HIDDEN)):
            text = f"{few}: its coefficients are those of the rounding; take a finer resolution"
            facts.append(Fact("resolution", text, name, "not a measurement", size, "steps"))
        elif repeated[k] > _HELD + 2.0 * chance[k]:
            share = f"{axis.name}: {100.0 * repeated[k]:.0f} % of its samples repeat the one before"
            text = f"{share}: the sensor gives fewer than the rate says, and what is faster is not its own"
            facts.append(Fact("repeated samples", text, name, "none", float(repeated[k]), "1"))
        elif steps[k] > 0.0 and noise[k] < _FEW_STEPS:
            text = f"{few}: rounding is part of what looks like noise, and the intervals of N allow for it"
            facts.append(Fact("resolution", text, name, "widened", size, "steps"))
    return facts, steps


def saturated(axes: Sequence[Axis], ends: Ends, steps: Float[np.ndarray, " axes"]) -> list[Fact]:
    """Facts about axes with more samples at their largest or smallest value than a tail would leave there."""
    facts = []
    for side, k in np.argwhere(ends.piled_up(steps) & (ends.count >= _LEAST)):
        axis, share = axes[k], 100.0 * float(ends.count[side, k]) / ends.n
        level = amount((1.0, -1.0)[side] * ends.value[side, k], axis, 4)
        text = (
            f"{axis.name} is at {level} in {plain(share, 2)} % of the samples: its range ends there; use a "
            "wider one, or remove the offset"
        )
        facts.append(Fact("saturation", text, (axis.name,), "not a measurement", share, "%"))
    return facts
