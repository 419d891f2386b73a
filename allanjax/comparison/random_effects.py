"""Values that repeat: their common value, and their scatter beyond what their errors explain.

The model is x_r = μ + b_r + e_r, with scatter b_r of variance τ² and errors e_r of known s_r. All follows
from Q(τ) = Σ (x_r − μ(τ))²/(τ² + s_r²) with the weighted mean μ(τ), which has a χ² law of k − 1 degrees of
freedom at the true τ: Q(0) tests whether the values agree (Cochran 1954), Q(τ) = k − 1 gives τ (Paule &
Mandel 1982, J. Res. NBS 87:377), and Q at the quantiles of χ² its interval (Viechtbauer 2007, Stat. Med.
26:37).

Values that happen to lie close tell nothing of errors smaller than the known ones. The error of μ is that by
τ and s_r, as if the factor of Hartung and Knapp were never below one (Röver, Knapp & Friede 2015, BMC Med.
Res. Methodol. 15:99). Its interval is the generalized one of Iyer, Wang & Mathew (2004, J. Am. Stat. Assoc.
99:1060): μ = μ(τ) + z/√W(τ), with a normal z, the sum W of the weights, and a τ whose Q is a χ² variate, or
zero if Q is below that without scatter. It is Student's t where the scatter is far larger than the errors,
and the normal interval where the values lie closer than these. An upper limit of τ is where the probability F
of a lower Q is 5 % of that without scatter, F(Q(τ)) = 0.05·F(Q(0)) (Read 2002, J. Phys. G 28:2693): it is
not below what the errors allow.

Squares of amplitudes that few clusters determine have skewed errors, in proportion to an unknown power. The
laws of Q and of t are then those of simulated values, with gamma errors of this skewness and normal scatter;
t counts the error of μ by τ and s_r, which makes intervals of two or three values too long.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Float

from allanjax.base.chi_squared import quantile, upper_tail
from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError
from allanjax.base.normal import TWO_SIDED_95
from allanjax.base.tables import Column, Tabled, columns_from
from allanjax.base.wording import format_p_value, format_range, significant

# Simulated sets of values, and skewness below which errors count as normal.
_DRAWS, _SKEWED = 4000, 0.05
# Newton's steps to a scatter; Q per degree of freedom below which values are as close as may be.
_STEPS, _LEAST_Q = 40, 0.01
# p-value below which values differ, or one of them from the others.
_CERTAIN = 0.05
_Values = Float[np.ndarray, " k"]
_Sets = Float[np.ndarray, "*sets k"]
# Probabilities at equal distances in ln(p/(1 − p)), and their weights: the rule of trapezoids.
_NODES = 1.0 / (1.0 + np.exp(-np.linspace(-30.0, 30.0, 240)))
_WEIGHTS = _NODES * (1.0 - _NODES) / np.sum(_NODES * (1.0 - _NODES))


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class RandomEffects(ByValue, Tabled):
    """Common value and scatter of values, e.g. of a coefficient on several days; see `random_effects`.

    Attributes:
        names: names of the values.
        values, stds: the values and their standard errors; these are zero if unknown.
        common, std: common value and its standard error.
        interval, interval_68, limit: its 95 % and 68 % interval, and its one-sided 95 % upper limit.
        scatter, scatter_interval, scatter_limit: standard deviation τ of the scatter beyond the errors, its
            95 % interval, and its one-sided 95 % upper limit.
        p_value: probability of values that differ as much if there is no scatter; NaN without errors.
        odd, odd_p_value: name of the value that differs most from the others, and the probability that any of
            so many differs as much; "" and NaN for two values.
    """

    names: tuple[str, ...]
    values: _Values
    stds: _Values
    common: float
    std: float
    interval: tuple[float, float]
    interval_68: tuple[float, float]
    limit: float
    scatter: float
    scatter_interval: tuple[float, float]
    scatter_limit: float
    p_value: float
    odd: str
    odd_p_value: float

    @property
    def sample_std(self) -> float:
        """Standard deviation of the values, from their mean and k − 1, as in Hou (2004), table 5.1."""
        return float(np.std(self.values, ddof=1))

    @property
    def difference(self) -> tuple[float, tuple[float, float]]:
        """Of two values, the second less the first, and its 95 % interval by their errors."""
        size = float(self.values[1] - self.values[0])
        reach = TWO_SIDED_95 * float(np.hypot(*self.stds))
        return size, (size - reach, size + reach)

    @property
    def odd_one(self) -> str:
        """The value that differs from the others for certain (p < 0.05); "" if none does.

        If the errors explain all differences, none does, even if the others are nearer to each other.
        """
        alike = self.p_value >= _CERTAIN
        return "" if alike or not self.odd_p_value < _CERTAIN else self.odd

    @property
    def verdict(self) -> str:
        """Whether the values repeat within their errors, in words."""
        std, error = significant(self.sample_std), float(np.sqrt(np.mean(self.stds**2)))
        if not error:
            return f"STD {std}, errors unknown"
        told = "differ beyond their errors" if self.p_value < _CERTAIN else "repeat"
        ratio = f"STD {std} is {significant(self.sample_std / error, 2)} times the error {significant(error)}"
        odd = f"; {self.odd_one} differs from the others" if self.odd_one else ""
        return f"the values {told} ({format_p_value(self.p_value)}): {ratio}{odd}"

    def _title(self) -> str:
        return f"{len(self.values)} values: {self.verdict}"

    def _tables(self) -> list[list[Column]]:
        pairs = {"common": (self.common, self.interval), "scatter": (self.scatter, self.scatter_interval)}
        if len(self.values) == 2 and self.stds.all():
            pairs["difference"] = self.difference
        rows = [(name, significant(x, 4), format_range(*ends)) for name, (x, ends) in pairs.items()]
        return [columns_from(("", "value", "95 % interval"), rows)]


class Weighted(NamedTuple):
    """Weighted means of sets of values, their standard errors, Q, and −dQ/dτ²."""

    mean: Any
    std: Any
    q: Any
    slope: Any


class Laws:
    """Values x with errors s of some skewness, and the laws of Q and of the mean that follow."""

    def __init__(self, x: _Values, s: _Values, skewness: _Values | None = None) -> None:
        self.x, self.dof = x, len(x) - 1
        # Without errors Q is infinite at zero, and of equal values it is zero at any scatter.
        self.s = s if s.all() else np.full(len(x), 1e-9 * float(np.ptp(x) or abs(x).max() or 1.0))
        if not np.ptp(x):
            self.x = x + 1e-6 * self.s * (-1.0) ** np.arange(len(x))
        self.skewness = np.zeros(len(x)) if skewness is None else skewness
        self.normal = not np.any(abs(self.skewness) > _SKEWED)

    @functools.cached_property
    def _drawn(self) -> tuple[Float[np.ndarray, "draws k"], Float[np.ndarray, "draws k"]]:
        """Errors of this skewness and normal scatter, both of unit variance."""
        rng, size = np.random.default_rng(0), (_DRAWS, len(self.x))
        shape = 4.0 / np.maximum(self.skewness, _SKEWED) ** 2
        return (rng.standard_gamma(shape, size) - shape) / np.sqrt(shape), rng.standard_normal(size)

    def fitted(self, variance: Any, x: _Sets | None = None) -> Weighted:
        """The values, or others with the same errors, at a scatter of these variances."""
        w = 1.0 / (self.s**2 + np.asarray(variance)[..., None])
        x = self.x if x is None else x
        total = w.sum(axis=-1)
        mean = (w * x).sum(axis=-1) / total
        weighed = w * (x - mean[..., None])
        q = np.maximum((weighed**2 / w).sum(axis=-1), 1e-300)
        return Weighted(mean, total**-0.5, q, (weighed**2).sum(axis=-1))

    def simulated(self, variance: float) -> Float[np.ndarray, "draws k"]:
        """Values about zero with these errors and a scatter of this variance."""
        errors, scatter = self._drawn
        return errors * self.s + scatter * np.sqrt(variance)

    def p_value(self) -> float:
        """Probability of a Q as large as that of the values without scatter."""
        q = self.fitted(0.0).q
        if self.normal:
            return float(upper_tail(q, self.dof))
        return float((1 + np.sum(self.fitted(0.0, self.simulated(0.0)).q >= q)) / (1 + _DRAWS))

    def scatter(self, q: Any = None) -> Any:
        """Variance of the scatter at which Q is q, by default its mean k − 1; zero if it is less at zero.

        q may be a function of the variance. Newton's steps from zero do not go beyond the solution, as 1/Q is
        concave in the variance.
        """
        q, variance = self.dof if q is None else q, 0.0
        for _ in range(_STEPS):
            at = self.fitted(variance)
            target = q(variance) if callable(q) else q
            step = at.q * (at.q / target - 1.0) / np.maximum(at.slope, 1e-300)
            variance, before = np.maximum(variance + step, 0.0), variance
            if np.allclose(variance, before, 1e-13, 0.0):
                break
        return variance

    def _below(self, q: float) -> float:
        """Probability of a Q below q without scatter, for normal errors."""
        from scipy.special import gammainc

        return float(gammainc(0.5 * self.dof, 0.5 * q))

    def mean_quantiles(self, p: Sequence[float]) -> list[float]:
        """Quantiles of the common value."""
        from scipy.optimize import brentq
        from scipy.special import ndtr

        if not self.normal:
            variance = self.scatter()
            at, drawn = self.fitted(variance), self.fitted(variance, self.simulated(variance))
            distance = drawn.mean / np.sqrt(drawn.q / self.dof)
            return (at.mean - np.quantile(distance, 1.0 - np.array(p))).tolist()
        below = self._below(self.fitted(0.0).q)
        weights = np.append(below * _WEIGHTS, 1.0 - below)
        variance = np.append(self.scatter(quantile(below * _NODES, self.dof)), 0.0)
        each = self.fitted(variance)
        # Of two values, the ends are at most 13 times their distance apart.
        reach = 50.0 * float(np.ptp(self.x) + self.s.max())

        def beyond(at: float, probability: float) -> float:
            return float(weights @ ndtr((at - each.mean) / each.std)) - probability

        ends = self.x.min() - reach, self.x.max() + reach
        return [brentq(beyond, *ends, (q,), xtol=1e-14 * reach) for q in p]

    def scatter_ends(self, p: float) -> tuple[float, float]:
        """Lower and upper limit of the scatter, each with a probability p beyond it."""
        own = self.fitted(0.0).q
        # As Q tends to zero, the probability of a lower one is a power of it.
        at = max(own, _LEAST_Q * self.dof)
        allowed = quantile(p * self._below(at), self.dof) * own / at
        ends = self.scatter(np.array([quantile(1.0 - p, self.dof), allowed]))
        if not self.normal:

            def quantile_of_q(probability: float) -> Callable[[float], Any]:
                return lambda v: np.quantile(self.fitted(v, self.simulated(v)).q, probability)

            ends = self.scatter(quantile_of_q(1.0 - p)), max(self.scatter(quantile_of_q(p)), ends[1])
        low, high = np.sqrt(ends)
        return float(low), float(high)

    def odd_one(self, variance: float) -> tuple[int, float]:
        """Index of the value that differs most from the others, and the probability that one of them does."""
        if not self.normal:
            # The largest distance from the mean, as in Grubbs' test.
            def distance(x: _Sets) -> Any:
                at = self.fitted(variance, x)
                return (x - at.mean[..., None]) ** 2 / (self.s**2 + variance) / at.q[..., None]

            own, drawn = distance(self.x), distance(self.simulated(variance)).max(axis=-1)
            return int(np.argmax(own)), float((1 + np.sum(drawn >= own.max())) / (1 + _DRAWS))
        from scipy.special import stdtr

        chances = []
        for k, (x, s) in enumerate(zip(self.x, self.s, strict=True)):
            others = Laws(np.delete(self.x, k), np.delete(self.s, k))
            variance = others.scatter()
            at = others.fitted(variance)
            # The others' own scatter is the scale, as for the error of their mean.
            scale = np.sqrt(at.std**2 + s**2 + variance)
            chances.append(2.0 * float(stdtr(others.dof, -abs(x - at.mean) / scale)))
        return int(np.argmin(chances)), min(len(chances) * min(chances), 1.0)


class Pooled(Laws):
    """Values of several units, each scattering about a mean of its own: Q and degrees of freedom are sums."""

    def __init__(self, units: Sequence[Laws]) -> None:
        self.units, self.normal = units, True
        self.dof = sum(of.dof for of in units)

    def fitted(self, variance: Any, x: _Sets | None = None) -> Weighted:
        """Q and its slope at a scatter of these variances; there is no common mean."""
        each = [of.fitted(variance) for of in self.units]
        return Weighted(np.nan, np.nan, sum(of.q for of in each), sum(of.slope for of in each))


def random_effects(
    values: ArrayLike,
    stds: ArrayLike | None = None,
    names: Sequence[str] | None = None,
    *,
    skewness: ArrayLike | None = None,
) -> RandomEffects:
    """Common value of several values, and their scatter beyond what their errors explain.

    See the module for the model and the papers. The odd one is the value farthest from the mean of the others
    in the scale of their scatter and all errors (Student's t with k − 2 degrees of freedom), its p-value
    multiplied by the number of values.

    Args:
        values: at least two values [k], e.g. of a coefficient on several days.
        stds: their standard errors, or one for all; without them the scatter is that of the values.
        names: their names; by default "1", "2", ….
        skewness: skewness ≥ 0 of their errors; by default 0, of normal ones.

    Raises:
        AllanjaxError: fewer than two values, a value that is not finite, an error that is not positive, or
            another number of errors or names.
    """
    try:
        x = np.atleast_1d(np.asarray(values, float))
    except (TypeError, ValueError) as error:
        raise AllanjaxError(f"random_effects takes numbers: {error}") from error
    called = tuple(map(str, range(1, x.size + 1) if names is None else names))
    if x.ndim != 1 or len(x) < 2 or not np.isfinite(x).all():
        raise AllanjaxError("random_effects needs at least two finite values in a row")
    s, g = (np.zeros(1) if y is None else np.atleast_1d(np.asarray(y, float)) for y in (stds, skewness))
    if not {s.size, g.size} <= {1, len(x)} or len(called) != len(x):
        raise AllanjaxError(f"{len(x)} values need {len(x)} names and stds, or one std for all")
    if stds is not None and not (np.isfinite(s) & (s > 0.0)).all():
        raise AllanjaxError("standard errors must be positive and finite; leave stds out if they are unknown")
    s = np.resize(s, len(x))
    laws = Laws(x, s, np.resize(g, len(x)))
    variance = laws.scatter()
    at = laws.fitted(variance)
    ends = laws.mean_quantiles([0.025, 0.975, 0.16, 0.84, 0.95])
    odd, chance = laws.odd_one(variance) if len(x) > 2 else (-1, float("nan"))
    return RandomEffects(
        names=called,
        values=x,
        stds=s,
        common=float(at.mean),
        std=float(at.std),
        interval=(ends[0], ends[1]),
        interval_68=(ends[2], ends[3]),
        limit=ends[4],
        scatter=float(np.sqrt(variance)),
        scatter_interval=laws.scatter_ends(0.025),
        scatter_limit=laws.scatter_ends(0.05)[1],
        p_value=laws.p_value() if s.all() else float("nan"),
        odd=called[odd] if odd >= 0 else "",
        odd_p_value=chance,
    )
