"""Priors of single parameters [SI], with a support from `lower` to `upper`.

`log_density(x)` is the natural logarithm of the density [1/SI unit], −inf outside the support; `quantile(u)`
is the value below which the share u of the prior lies.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, TypeAlias

import numpy as np
from jaxtyping import ArrayLike, Float
from scipy.special import ndtri

from allanjax.base.errors import AllanjaxError


def _require(prior: Prior, condition: bool, wanted: str) -> None:
    if not condition:
        raise AllanjaxError(f"{prior}: give {wanted}")


@dataclass(frozen=True)
class Uniform:
    """Uniform prior between `lower` and `upper`."""

    lower: float
    upper: float

    def __post_init__(self) -> None:
        _require(self, -math.inf < self.lower < self.upper < math.inf, "finite bounds, lower < upper")

    def log_density(self, x: Float[ArrayLike, ...]) -> Float[np.ndarray, ...]:
        at = np.asarray(x, float)
        return np.where((at >= self.lower) & (at <= self.upper), -math.log(self.upper - self.lower), -np.inf)

    def quantile(self, u: Float[ArrayLike, ...]) -> Float[np.ndarray, ...]:
        return self.lower + np.asarray(u) * (self.upper - self.lower)


@dataclass(frozen=True)
class LogUniform:
    """Prior uniform in ln(x − origin) between `lower` and `upper`: all factors are equally likely."""

    lower: float
    upper: float
    origin: float = 0.0

    def __post_init__(self) -> None:
        ordered = self.origin < self.lower < self.upper < math.inf
        _require(self, ordered, f"finite bounds, {self.origin:g} < lower < upper")

    @property
    def _width(self) -> float:
        """Width of the support in ln(x − origin)."""
        return math.log1p((self.upper - self.lower) / (self.lower - self.origin))

    def log_density(self, x: Float[ArrayLike, ...]) -> Float[np.ndarray, ...]:
        at = np.asarray(x, float)
        # Outside the support the logarithm only needs a valid argument.
        density = -np.log((np.maximum(at, self.lower) - self.origin) * self._width)
        return np.where((at >= self.lower) & (at <= self.upper), density, -np.inf)

    def quantile(self, u: Float[ArrayLike, ...]) -> Float[np.ndarray, ...]:
        # The lower end itself without rounding.
        return self.lower + (self.lower - self.origin) * np.expm1(np.asarray(u) * self._width)


@dataclass(frozen=True)
class LogNormal:
    """Log-normal prior: 68 % of it lies between `median`/`factor` and `median`·`factor`."""

    median: float
    factor: float
    lower: ClassVar[float] = 0.0
    upper: ClassVar[float] = math.inf

    def __post_init__(self) -> None:
        within = 0.0 < self.median < math.inf and 1.0 < self.factor < math.inf
        _require(self, within, "a finite median above 0 and a finite factor above 1")

    def log_density(self, x: Float[ArrayLike, ...]) -> Float[np.ndarray, ...]:
        at, width = np.asarray(x, float), math.log(self.factor)
        positive = np.where(at > 0.0, at, 1.0)
        z = np.log(positive / self.median) / width
        density = -0.5 * z**2 - np.log(positive * width * math.sqrt(2.0 * math.pi))
        return np.where(at > 0.0, density, -np.inf)

    def quantile(self, u: Float[ArrayLike, ...]) -> Float[np.ndarray, ...]:
        return self.median * self.factor ** ndtri(np.asarray(u, float))


@dataclass(frozen=True)
class ModifiedLogUniform:
    """Modified Jeffreys prior on [0, upper]: p(x) = 1/[(x + scale)·ln(1 + upper/scale)].

    It is uniform in ln(x + scale) (Gregory 2005, ApJ 631:1198): uniform below the scale, where an amplitude
    cannot be distinguished from zero, and uniform in ln x far above it. Unlike 1/x it is proper, and it
    allows zero.
    """

    scale: float
    upper: float
    lower: ClassVar[float] = 0.0

    def __post_init__(self) -> None:
        within = 0.0 < self.scale < math.inf and 0.0 < self.upper < math.inf
        _require(self, within, "a finite scale and a finite upper above 0")

    def log_density(self, x: Float[ArrayLike, ...]) -> Float[np.ndarray, ...]:
        return LogUniform(0.0, self.upper, -self.scale).log_density(x)

    def quantile(self, u: Float[ArrayLike, ...]) -> Float[np.ndarray, ...]:
        return LogUniform(0.0, self.upper, -self.scale).quantile(u)


Prior: TypeAlias = Uniform | LogUniform | LogNormal | ModifiedLogUniform
