"""One axis with some of its findings: its samples less what these subtract, and the model of the rest."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float, Int

from allanjax.base.equality import ByValue
from allanjax.critic.noise import RAMP, NoiseFamily, centred, family_of
from allanjax.record.columns import scales_of
from allanjax.record.completion import in_time
from allanjax.record.recording import Axis

# Growth of bins: six an octave, and so little that the noise hardly changes within one, see `law`.
_OCTAVE, _NARROW = 2.0 ** (1.0 / 6.0) - 1.0, 2e-3
_ALL = slice(None)


@dataclasses.dataclass(frozen=True, eq=False)
class Stage(ByValue):
    """One axis with none of its findings, with all but one, or with all, to compare, draw and simulate.

    Arrays that follow from the fields are computed when they are needed, and kept until `forget`.

    Attributes:
        axis: the axis.
        x: samples less what the findings subtract [SI].
        rate: sample rate [Hz].
        powers: squared coefficients of the basic terms in the noise, by name (a ramp has none).
        index: place of the correlation time or exponent of the term that has one in the grid of shapes.
        ramp: slope of a drift ramp [rate/s].
        factor: ratio of the spectrum to that of these terms; None for 1.
        drawn: whether each sample was filled in: drawn given the others.
    """

    axis: Axis
    x: Float[np.ndarray, " n"]
    rate: float
    powers: Mapping[str, float]
    index: int
    ramp: float
    factor: Float[np.ndarray, " n-1"] | None
    drawn: Bool[np.ndarray, " n"]

    @property
    def n(self) -> int:
        """Number of samples."""
        return len(self.x)

    @property
    def scale(self) -> float:
        """Factor from the axis's own unit to SI."""
        return float(scales_of((self.axis,), self.rate)[0])

    @property
    def family(self) -> NoiseFamily:
        """Noise family of records of this length and rate."""
        return family_of(self.n, self.rate)

    @functools.cached_property
    def variance(self) -> Float[np.ndarray, " n-1"]:
        """Expected squared cosine coefficients of x [rate²]."""
        v = self.family.expected(dict(self.powers), self.index)
        return v if self.factor is None else np.multiply(v, self.factor, out=v)

    @functools.cached_property
    def deviation(self) -> Float[np.ndarray, " n-1"]:
        """Standard deviations of the cosine coefficients of x [rate]."""
        return np.sqrt(self.variance)

    @functools.cached_property
    def whitened_coefficients(self) -> Float[np.ndarray, " n-1"]:
        """Whitened coefficients, independent and standard normal if the model is right."""
        c = centred(self.x)
        if self.ramp:
            c -= self.ramp * self.family.ramp
        return np.divide(c, self.deviation, out=c)

    @property
    def residual(self) -> Float[np.ndarray, " n-1"]:
        """Cosine coefficients of x without the model's ramp."""
        return self.whitened_coefficients * self.deviation

    @functools.cached_property
    def whitened(self) -> Float[np.ndarray, " n"]:
        """Whitened residuals in time order."""
        return in_time(self.whitened_coefficients)

    @functools.cached_property
    def sums(self) -> Float[np.ndarray, "4 bins"]:
        """Sums in `narrow_bins`: of expected squares, their squares, and residual and whitened squares."""
        v, square = self.variance, self.whitened_coefficients**2
        first = narrow_bins(self.n)[:-1] - 1
        return np.stack([np.add.reduceat(y, first) for y in (v, v * v, square * v, square)])

    def share(self, term: str, places: slice | Int[np.ndarray, " m"] = _ALL) -> Float[np.ndarray, " m"]:
        """Share of a noise term in the expected squares, in all of them or at some places; 0 for no term."""
        total = sum(p * self.family.unit(name, self.index)[places] for name, p in self.powers.items())
        own = self.powers.get(term, 0.0) * self.family.unit(term, self.index)[places]
        return own / np.maximum(total, 1e-300)

    def same_record(self, other: Stage) -> bool:
        """Whether only the noise differs from that of another stage of the axis."""
        return self.x is other.x and self.ramp == other.ramp

    def forget(self, keep_transform: bool = False) -> None:
        """Drop the arrays that are as long as the record and can be recomputed, perhaps but its transform."""
        for name in ("variance", "deviation", "whitened", *["whitened_coefficients"] * (not keep_transform)):
            vars(self).pop(name, None)

    def __repr__(self) -> str:
        terms = [*self.powers, *[RAMP] * bool(self.ramp)]
        return f"<Stage: {self.n} samples less findings; noise {' + '.join(terms)}>"


@functools.lru_cache(maxsize=4)
def octave_bins(n: int) -> Int[np.ndarray, " bins+1"]:
    """Edges of logarithmic bins of the coefficients 1 … n−1, six an octave once that makes more than one."""
    # The rest at the end belongs to the last whole bin.
    return np.append(_growing(n, _OCTAVE)[:-2], n)


@functools.lru_cache(maxsize=4)
def narrow_bins(n: int) -> Int[np.ndarray, " bins+1"]:
    """Edges of bins in which the noise hardly changes; they divide those of `octave_bins`."""
    return np.union1d(octave_bins(n), np.minimum(_growing(n, _NARROW), n))


def _growing(n: int, growth: float) -> list[int]:
    """Edges of bins from 1 to n or above whose widths are this share of the coefficient, 1 at least."""
    edges = [1]
    while (last := edges[-1]) < n:
        edges.append(last + max(1, int(last * growth)))
    return edges
