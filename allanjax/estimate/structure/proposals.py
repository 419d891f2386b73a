"""Proposals of what else a spectrum may consist of, ranked by what they would gain.

A component is ranked by its score test: gradient g and information F of its power at zero, less what the
other parameters explain, promise a gain of g²/2F. The best few, and models with another response, are ranked
by fits of all powers with the shapes held, many models at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from allanjax.estimate.spectral.components import NONE, Levels, markov, oscillator, passed
from allanjax.estimate.spectral.model import FULL
from allanjax.estimate.structure.structure import LINE, LOWEST, Fitted, Spectrum, Structure, response_of

# Narrowest window [coefficients], and the least gain of one [nats].
_NARROWEST, _WORTH = 8, 4.0
# Oscillators an octave that are proposed, and their quality factors; and number of correlation times.
_OCTAVE, _QUALITIES, _TIMES = 8, (1.6, 3.5, 8.0), 20


class Peak(NamedTuple):
    """Window of a spectrum with an excess.

    Attributes:
        gain: of a higher level there [nats].
        slimness: middle over width.
        values: frequency [radians per sample], quality factor and power [rate²] of such a resonance.
    """

    gain: float
    slimness: float
    values: tuple[float, float, float]


def peaks(squares: Float[np.ndarray, " n-1"], level: Float[np.ndarray, " n-1"], most: int) -> list[Peak]:
    """Windows with most excess over a level of all coefficients, no two of which overlap."""
    total, n = np.concatenate([[0.0], np.cumsum(squares / level)]), len(level) + 1
    found: list[tuple[float, float, float]] = []
    width = _NARROWEST
    while width <= (n - 1 - LOWEST) // 4:
        step = max(width // 4, 1)
        excess = (total[LOWEST + width :: step] - total[LOWEST : n - width : step]) / width
        for k in np.argpartition(-excess, min(4 * most, len(excess) - 1))[: 4 * most]:
            if (ratio := float(excess[k])) > 1.0:
                gain = 0.5 * width * (ratio - 1.0 - np.log(ratio)) - np.log((n - 1) / width)
                found.append((gain, LOWEST + k * step + width / 2.0 + 1.0, float(width)))
        width *= 2
    chosen: list[tuple[float, float]] = []
    resonances = []
    for gain, middle, wide in sorted(found, reverse=True):
        if gain < _WORTH or len(chosen) == most:
            break
        if all(abs(middle - other) > 0.5 * (wide + w) for other, w in chosen):
            chosen.append((middle, wide))
            quality = float(np.clip(middle / wide, 2.0, max(middle / LINE / 2.0, 2.0)))
            # The excess is about as large as the level, over the window.
            values = np.pi * middle / n, quality, float(level[int(middle) - 1]) * wide / n
            resonances.append(Peak(gain, middle / wide, values))
    return resonances


def slots_to_try(structure: Structure, n: int, inside: bool) -> list[Structure]:
    """Structures with one oscillator or Markov process more, of unit power, on a grid of their shapes."""
    lowest = LOWEST * np.pi / n
    octaves = np.log2(np.pi / lowest)
    tried = [
        structure.with_oscillator(w, Q, 1.0, inside)
        for w in np.geomspace(lowest, 0.97 * np.pi, int(octaves * _OCTAVE))
        for Q in _QUALITIES
    ]
    tried += [structure.with_markov(time, 1.0) for time in np.geomspace(20.0, n / 4.0, _TIMES)]
    return [s for s in tried if s is not None]


class Units:
    """Expected levels of components of unit power; what several structures have in common, computed once."""

    def __init__(self, levels: Levels) -> None:
        self._levels = levels
        self._known: dict[tuple[Any, ...], Any] = {}

    def __call__(self, structure: Structure, components: Sequence[int]) -> Float[np.ndarray, "some m"]:
        """Levels of some components of a structure."""
        squares = [self._squares(structure, k) for k in components]
        if structure.kind != NONE:
            own = (structure.kind, *structure.bandwidth)
            response = self._once(own, lambda: passed(self._levels, response_of(structure, 1.0)))
            squares = [
                x * response if structure.inside[k] else x for x, k in zip(squares, components, strict=True)
            ]
        return np.mean(squares, axis=1)

    def _squares(self, structure: Structure, component: int) -> Float[np.ndarray, "2 m"]:
        if component < FULL.first_markov:
            return self._levels.columns[component]
        k = component - FULL.first_oscillator
        if k < 0:
            time = structure.time(component - FULL.first_markov)
            return self._once((time,), lambda: markov(self._levels, time))
        of = structure.frequency(k), structure.quality(k)
        return self._once(of, lambda: oscillator(self._levels, *of))

    def _once(self, key: tuple[Any, ...], function: Callable[[], Any]) -> Any:
        if key not in self._known:
            self._known[key] = function()
        return self._known[key]


def promised(
    spectrum: Spectrum, now: Fitted, rows: Float[np.ndarray, "proposals m"]
) -> tuple[Float[np.ndarray, " proposals"], Float[np.ndarray, " proposals"]]:
    """Gain [nats] that the score test promises each component beside a fit, and its power then."""
    k, y = spectrum.levels.shape, spectrum.levels.level
    mean, maximum = now.mean, now.maximum
    relative = rows / mean
    g = relative @ (k * (y / mean - 1.0))
    interior = np.flatnonzero(np.asarray(maximum.interior))
    slope = maximum.slope[interior]
    F = np.asarray(maximum.information)[np.ix_(interior, interior)]
    size = 1.0 / np.sqrt(np.maximum(np.diag(F), 1e-12))
    cross = (relative * k) @ (slope * size[:, None]).T
    alone = relative**2 @ k
    scaled = F * np.outer(size, size) + 1e-9 * np.eye(len(F))
    left = alone - np.einsum("cp,cp->c", cross, np.linalg.solve(scaled, cross.T).T)
    left = np.maximum(left, 1e-6 * alone)
    power = np.maximum(g, 0.0) / left
    return 0.5 * np.maximum(g, 0.0) * power, power
