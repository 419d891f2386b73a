"""Proposals of what else a spectrum may consist of, ranked by what they would gain.

A component is ranked by its score test: gradient g and information F of its power at zero, less what the
other parameters explain, promise a gain of g²/2F. The best few, and models with another response, are ranked
by fits of all powers with the shapes held, many models at a time.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from allanjax.estimate.spectral.model import FULL
from allanjax.estimate.structure.structure import (
    FURTHER,
    LOWEST,
    Fitted,
    Spectrum,
    Structure,
    response_of,
)
from allanjax.noise.numerics import averaged_lags

# Narrowest window [coefficients], and the least gain of one [nats].
_NARROWEST, _WORTH = 8, 4.0
# Oscillators an octave that are proposed, and their quality factors; and number of correlation times.
_OCTAVE, _QUALITIES, _TIMES = 8, (1.6, 3.5, 8.0), 20


def windows(ratio: Float[np.ndarray, " n-1"], most: int) -> list[tuple[float, float, float]]:
    """Windows with most excess: middle and width [coefficients] and gain [nats], no two of which overlap."""
    total = np.concatenate([[0.0], np.cumsum(ratio)])
    found: list[tuple[float, float, float]] = []
    width = _NARROWEST
    while width <= (len(ratio) - LOWEST) // 4:
        step = max(width // 4, 1)
        excess = (total[LOWEST + width :: step] - total[LOWEST : len(total) - width : step]) / width
        for k in np.argpartition(-excess, min(4 * most, len(excess) - 1))[: 4 * most]:
            level = float(excess[k])
            if level > 1.0:
                gain = 0.5 * width * (level - 1.0 - np.log(level)) - np.log(len(ratio) / width)
                found.append((gain, LOWEST + k * step + width / 2.0 + 1.0, float(width)))
        width *= 2
    chosen: list[tuple[float, float, float]] = []
    for gain, middle, wide in sorted(found, reverse=True):
        if gain < _WORTH or len(chosen) == most:
            break
        if all(abs(middle - other) > 0.5 * (wide + w) for other, w, _ in chosen):
            chosen.append((middle, wide, gain))
    return chosen


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
    """Expected levels of components of unit power in the bins of a record, but for what its ends add."""

    def __init__(self, spectrum: Spectrum) -> None:
        (part,) = spectrum.bins.parts
        self._frequency, self._rate = part.node_frequencies, spectrum.bins.rate
        self._s = np.sin(np.pi * self._frequency / self._rate) ** 2
        self._columns = np.asarray(spectrum.levels.columns)[:, :, : len(spectrum.bins.size)]
        self._passed: dict[tuple[float, ...], Float[np.ndarray, "2 m"]] = {}

    def __call__(self, structure: Structure, components: Sequence[int]) -> Float[np.ndarray, "some m"]:
        """Levels of some components of a structure."""
        passed = self._response(structure)
        squares = [self._columns[k] if k <= FURTHER else self._slot(structure, k) for k in components]
        rows = [x * passed if structure.inside[k] else x for x, k in zip(squares, components, strict=True)]
        return np.mean(rows, axis=1)

    def _response(self, structure: Structure) -> Float[np.ndarray, "2 m"]:
        key = (structure.kind, *structure.bandwidth)
        if key not in self._passed:
            response = response_of(structure, self._rate)
            flat = np.ones_like(self._s)
            power = flat if response is None else response.power(self._frequency, self._rate)
            self._passed[key] = np.asarray(power)
        return self._passed[key]

    def _slot(self, structure: Structure, component: int) -> Float[np.ndarray, "2 m"]:
        """Squares of a Markov process or an oscillator of variance 1, see `spectral.components`."""
        k = component - FULL.first_oscillator
        if k < 0:
            x = 1.0 / structure.time(component - FULL.first_markov)
            weight, y, (first, second) = 1.0, -np.expm1(-x), averaged_lags(x)
        else:
            w, Q = structure.frequency(k), structure.quality(k)
            root = np.sqrt(4.0 * Q**2 - 1.0)
            second = np.exp(w / (2.0 * Q) * (-1.0 + 1j * root))
            weight, y, first = 1.0 - 1j / root, 1.0 - second, 1.0
        D = y**2 + 4.0 * (1.0 - y) * self._s
        return np.real(weight * (first + second * 2.0 * (y - 2.0 * self._s) / D))


def promised(
    spectrum: Spectrum, now: Fitted, rows: Float[np.ndarray, "proposals m"]
) -> tuple[Float[np.ndarray, " proposals"], Float[np.ndarray, " proposals"]]:
    """Gain [nats] that the score test promises each component beside a fit, and its power then."""
    m = rows.shape[1]
    k, y = np.asarray(spectrum.levels.shape)[:m], np.asarray(spectrum.levels.level)[:m]
    mean, maximum = now.mean[:m], now.maximum
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
