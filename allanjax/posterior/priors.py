"""Priors of single parameters [SI], with a support from `lower` to `upper`.

`log_density(x)` is the natural logarithm of the density [1/SI unit], −inf outside the support; `quantile(u)`
is the value below which the share u of the prior lies.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import ArrayLike, Float

from allanjax.base.errors import AllanjaxError


class Prior:
    """A prior by one of SciPy's laws."""

    lower: float
    upper: float

    @functools.cached_property
    def _law(self) -> Any:
        # Takes long to load.
        from scipy import stats

        return self._of(stats)

    def _of(self, stats: Any) -> Any:
        """The law, one of those in the module `scipy.stats`."""
        raise NotImplementedError

    def log_density(self, x: Float[ArrayLike, ...]) -> Float[np.ndarray, ...]:
        return self._law.logpdf(x)

    def quantile(self, u: Float[ArrayLike, ...]) -> Float[np.ndarray, ...]:
        # Rounding must not lead out of the support.
        return np.clip(self._law.ppf(u), self.lower, self.upper)

    def _require(self, condition: bool, wanted: str) -> None:
        if not condition:
            raise AllanjaxError(f"{self}: give {wanted}")


@dataclass(frozen=True)
class Uniform(Prior):
    """Uniform prior between `lower` and `upper`."""

    lower: float
    upper: float

    def __post_init__(self) -> None:
        ordered = -math.inf < self.lower < self.upper < math.inf
        self._require(ordered, "finite bounds, lower < upper")

    def _of(self, stats: Any) -> Any:
        return stats.uniform(self.lower, self.upper - self.lower)


@dataclass(frozen=True)
class LogUniform(Prior):
    """Prior uniform in ln(x − origin) between `lower` and `upper`: all factors are equally likely."""

    lower: float
    upper: float
    origin: float = 0.0

    def __post_init__(self) -> None:
        ordered = self.origin < self.lower < self.upper < math.inf
        self._require(ordered, f"finite bounds, {self.origin:g} < lower < upper")

    def _of(self, stats: Any) -> Any:
        return stats.loguniform(self.lower - self.origin, self.upper - self.origin, self.origin)


@dataclass(frozen=True)
class LogNormal(Prior):
    """Log-normal prior: 68 % of it lies between `median`/`factor` and `median`·`factor`."""

    median: float
    factor: float
    lower: float = field(default=0.0, init=False, repr=False)
    upper: float = field(default=math.inf, init=False, repr=False)

    def __post_init__(self) -> None:
        within = 0.0 < self.median < math.inf and 1.0 < self.factor < math.inf
        self._require(within, "a finite median above 0 and a finite factor above 1")

    def _of(self, stats: Any) -> Any:
        return stats.lognorm(math.log(self.factor), scale=self.median)


@dataclass(frozen=True)
class ModifiedLogUniform(Prior):
    """Modified Jeffreys prior on [0, upper]: p(x) = 1/[(x + scale)·ln(1 + upper/scale)].

    It is uniform in ln(x + scale) (Gregory 2005, ApJ 631:1198): uniform below the scale, where an amplitude
    cannot be distinguished from zero, and uniform in ln x far above it. Unlike 1/x it is proper, and it
    allows zero.
    """

    scale: float
    upper: float
    lower: float = field(default=0.0, init=False, repr=False)

    def __post_init__(self) -> None:
        within = 0.0 < self.scale < math.inf and 0.0 < self.upper < math.inf
        self._require(within, "a finite scale and a finite upper above 0")

    def _of(self, stats: Any) -> Any:
        return stats.loguniform(self.scale, self.scale + self.upper, -self.scale)
