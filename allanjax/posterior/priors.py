"""Priors of single parameters, in SI."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, dataclass_transform

import numpy as np
from jaxtyping import Array, ArrayLike, Float

from allanjax.base.arrays import namespace
from allanjax.base.errors import AllanjaxError


@dataclass_transform(frozen_default=True)
class Prior:
    """Prior of one parameter, in SI.

    A subclass defines `lower`, `upper` and the two methods; its annotated names are fields of a dataclass.

    Attributes:
        lower, upper: ends of its support.
    """

    def __init_subclass__(cls) -> None:
        dataclasses.dataclass(frozen=True)(cls)

    if (
        TYPE_CHECKING
    ):  # Fields in some subclasses, which a property here would hide, and properties in others.

        @property
        def lower(self) -> float: ...

        @property
        def upper(self) -> float: ...

    def log_density(self, x: Float[ArrayLike, ...]) -> Float[Array, ...]:
        """Natural logarithm of the density [1/SI unit] at x, traceable by JAX; −inf outside the support."""
        raise NotImplementedError(f"{type(self).__name__} defines no log_density(x)")

    def quantile(self, u: Float[ArrayLike, ...]) -> Float[np.ndarray, ...]:
        """Value below which the share u of the prior lies; a draw from the prior if u is uniform."""
        raise NotImplementedError(f"{type(self).__name__} defines no quantile(u)")

    def _inside(self, x: Array, log_density: Array) -> Array:
        """Log density, set to −inf outside the support."""
        inside = (x >= self.lower) & (x <= self.upper)
        return namespace(inside, log_density).where(inside, log_density, -np.inf)

    def _require(self, condition: bool, wanted: str) -> None:
        """Raise AllanjaxError unless the condition holds."""
        if not condition:
            raise AllanjaxError(f"{self}: {wanted}")


class Uniform(Prior):
    """Uniform prior between `lower` and `upper`."""

    lower: float
    upper: float

    def __post_init__(self) -> None:
        finite = math.isfinite(self.lower) and math.isfinite(self.upper)
        self._require(finite and self.lower < self.upper, "give finite bounds, lower < upper")

    def log_density(self, x: Float[ArrayLike, ...]) -> Float[Array, ...]:
        xp = namespace(x)
        at = xp.asarray(x, float)
        return self._inside(at, xp.full(at.shape, -xp.log(self.upper - self.lower)))

    def quantile(self, u: Float[ArrayLike, ...]) -> Float[np.ndarray, ...]:
        return self.lower + np.asarray(u) * (self.upper - self.lower)


class _Logarithmic(Prior):
    """Prior uniform in ln(x − origin) between `lower` and `upper`, with a field or a property `origin`."""

    if TYPE_CHECKING:

        @property
        def origin(self) -> float: ...

    def log_density(self, x: Float[ArrayLike, ...]) -> Float[Array, ...]:
        xp = namespace(x)
        at = xp.asarray(x, float)
        # Outside the support the logarithm only needs a valid argument.
        distance = xp.maximum(at, self.lower) - self.origin
        ratio = (self.upper - self.origin) / (self.lower - self.origin)
        return self._inside(at, -xp.log(distance) - math.log(math.log(ratio)))

    def quantile(self, u: Float[ArrayLike, ...]) -> Float[np.ndarray, ...]:
        nearest, span = self.lower - self.origin, self.upper - self.lower
        # The lower end itself without rounding.
        return self.lower + nearest * np.expm1(np.asarray(u) * np.log1p(span / nearest))


class LogUniform(_Logarithmic):
    """Prior uniform in ln(x − origin) between `lower` and `upper`: all factors are equally likely."""

    lower: float
    upper: float
    origin: float = 0.0

    def __post_init__(self) -> None:
        ordered = self.origin < self.lower < self.upper < math.inf
        self._require(ordered, f"give finite bounds, {self.origin:g} < lower < upper")


class LogNormal(Prior):
    """Log-normal prior: 68 % of it lies between `median`/`factor` and `median`·`factor`."""

    median: float
    factor: float

    def __post_init__(self) -> None:
        self._require(0.0 < self.median < math.inf, "give a finite median above 0")
        self._require(1.0 < self.factor < math.inf, "give a finite factor above 1")

    @property
    def lower(self) -> float:
        return 0.0

    @property
    def upper(self) -> float:
        return math.inf

    def log_density(self, x: Float[ArrayLike, ...]) -> Float[Array, ...]:
        xp = namespace(x)
        at = xp.asarray(x, float)
        width = xp.log(self.factor)
        positive = xp.where(at > 0.0, at, 1.0)
        z = xp.log(positive / self.median) / width
        density = -0.5 * z**2 - xp.log(positive * width) - 0.5 * math.log(2.0 * math.pi)
        return xp.where(at > 0.0, density, -np.inf)

    def quantile(self, u: Float[ArrayLike, ...]) -> Float[np.ndarray, ...]:
        from scipy.special import ndtri

        return self.median * self.factor ** ndtri(np.asarray(u, float))


class ModifiedLogUniform(_Logarithmic):
    """Modified Jeffreys prior on [0, upper]: p(x) = 1/[(x + scale)·ln(1 + upper/scale)].

    It is uniform in ln(x + scale) (Gregory 2005, ApJ 631:1198): uniform below the scale, where an amplitude
    cannot be distinguished from zero, and uniform in ln x far above it. Unlike 1/x it is proper, and it
    allows zero.
    """

    scale: float
    upper: float

    def __post_init__(self) -> None:
        self._require(0.0 < self.scale < math.inf, "give a finite scale above 0")
        self._require(0.0 < self.upper < math.inf, "give a finite upper above 0")

    @property
    def lower(self) -> float:
        return 0.0

    @property
    def origin(self) -> float:
        return -self.scale
