"""Values that repeat: their common value, and their scatter beyond what their errors explain.

The model is x_r = μ + b_r + e_r, with scatter b_r of variance τ² and errors e_r of known s_r. All follows
from Q(τ) = Σ (x_r − μ(τ))²/(τ² + s_r²) with the weighted mean μ(τ), which has a χ² law of k − 1 degrees of
freedom at the true τ: Q(0) tests whether the values agree (Cochran 1954), Q(τ) = k − 1 gives τ (Paule &
Mandel 1982, J. Res. NBS 87:377), Q at the quantiles of χ² its interval (Viechtbauer 2007, Stat. Med. 26:37),
and Q(τ)/(k − 1) corrects the error of μ, whose interval is that of Student's t (Hartung & Knapp 2001, Stat.
Med. 20:3875). These hold for three values as well as for thirty, exactly where all errors are equal.

Squares of amplitudes that few clusters determine have skewed errors. The laws of Q and of t are then those of
simulated values, with gamma errors of this skewness and normal scatter.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import ArrayLike, Float

from allanjax.base.chi_squared import quantile, upper_tail
from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError
from allanjax.base.tables import Column, Tabled, columns_from
from allanjax.base.wording import format_p_value, significant

# Simulated sets of values, and skewness below which errors count as normal.
_DRAWS, _SKEWED = 4000, 0.05
# p-value below which values differ, or one of them from the others.
_CERTAIN = 0.05
_Values = Float[np.ndarray, " k"]
_Sets = Float[np.ndarray, "*sets k"]


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
        rows = [
            (name, significant(x, 4), " … ".join(map(significant, ends))) for name, (x, ends) in pairs.items()
        ]
        return [columns_from(("", "value", "95 % interval"), rows)]


class Laws:
    """Values x with errors s of some skewness, and the laws of Q and of t that follow."""

    def __init__(self, x: _Values, s: _Values, skewness: _Values | None = None) -> None:
        self.x, self.s, self.dof = x, s, len(x) - 1
        # Without errors Q is infinite at zero.
        self.least = 0.0 if s.all() else 1e-9 * float(np.ptp(x) or abs(x).max() or 1.0)
        self.skewness = np.zeros(len(x)) if skewness is None else skewness
        self.normal = not np.any(abs(self.skewness) > _SKEWED)

    @cached_property
    def _drawn(self) -> tuple[Float[np.ndarray, "draws k"], Float[np.ndarray, "draws k"]]:
        """Errors of this skewness and normal scatter, both of unit variance."""
        rng, size = np.random.default_rng(0), (_DRAWS, len(self.x))
        shape = 4.0 / np.maximum(self.skewness, _SKEWED) ** 2
        return (rng.standard_gamma(shape, size) - shape) / np.sqrt(shape), rng.standard_normal(size)

    def fitted(self, x: _Sets, tau: float) -> tuple[Any, Any, Any]:
        """Weighted mean of each set of values, its standard error, and Q, at a scatter τ."""
        w = 1.0 / (self.s**2 + max(tau, self.least) ** 2)
        mean = x @ w / w.sum()
        q = np.maximum((x - mean[..., None]) ** 2 @ w, 1e-300)
        return mean, np.sqrt(q / self.dof / w.sum()), q

    def simulated(self, tau: float) -> Float[np.ndarray, "draws k"]:
        """Values about zero with these errors and this scatter."""
        errors, scatter = self._drawn
        return errors * self.s + scatter * tau

    def p_value(self) -> float:
        """Probability of a Q as large as that of the values without scatter."""
        q = self.fitted(self.x, 0.0)[2]
        if self.least:
            return float("nan")
        if self.normal:
            return float(upper_tail(q, self.dof))
        return float((1 + np.sum(self.fitted(self.simulated(0.0), 0.0)[2] >= q)) / (1 + _DRAWS))

    def t_quantiles(self, p: Sequence[float], tau: float) -> Float[np.ndarray, " p"]:
        """Quantiles of the mean's distance from the common value, in its standard errors."""
        if self.normal:
            from scipy.special import stdtrit

            return np.asarray(stdtrit(self.dof, p))
        mean, std, _ = self.fitted(self.simulated(tau), tau)
        return np.quantile(mean / std, p)

    def scatter(self, p: float | None = None) -> float:
        """The τ at which Q is at its quantile, or at its mean k − 1; zero if Q is below it at zero."""
        from scipy.optimize import brentq

        def excess(tau: float) -> float:
            usual: Any = self.dof
            if p is not None and self.normal:
                usual = quantile(p, self.dof)
            elif p is not None:
                usual = np.quantile(self.fitted(self.simulated(tau), tau)[2], p)
            return float(np.log(self.fitted(self.x, tau)[2] / usual))

        high = float(np.ptp(self.x))
        if not excess(0.0) > 0.0:
            return 0.0
        while excess(high) > 0.0:
            high *= 2.0
        return float(brentq(excess, 0.0, high, xtol=1e-12 * high))

    def scatter_limit(self, p: float) -> float:
        """The τ at which Q is at a low quantile; if it is lower at zero, the τ of values without errors."""
        return self.scatter(p) or float(np.sqrt(self.dof * np.var(self.x, ddof=1) / quantile(p, self.dof)))

    def odd_one(self, tau: float) -> tuple[int, float]:
        """Index of the value that differs most from the others, and the probability that one of them does."""
        if not self.normal:
            # The largest distance from the mean, as in Grubbs' test.
            def distance(x: _Sets) -> Any:
                mean, _, q = self.fitted(x, tau)
                return (x - mean[..., None]) ** 2 / (self.s**2 + tau**2) / q[..., None]

            own, drawn = distance(self.x), distance(self.simulated(tau)).max(axis=-1)
            return int(np.argmax(own)), float((1 + np.sum(drawn >= own.max())) / (1 + _DRAWS))
        from scipy.special import stdtr

        chances = []
        for k, (x, s) in enumerate(zip(self.x, self.s, strict=True)):
            others = Laws(np.delete(self.x, k), np.delete(self.s, k))
            mean, std, q = others.fitted(others.x, tau := others.scatter())
            # The others' own scatter is the scale, as for the error of their mean.
            scale = np.sqrt(std**2 + (s**2 + max(tau, others.least) ** 2) * q / others.dof)
            chances.append(2.0 * float(stdtr(others.dof, -abs(x - mean) / scale)))
        return int(np.argmin(chances)), min(len(chances) * min(chances), 1.0)


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
    x = np.atleast_1d(np.asarray(values, float))
    called = tuple(map(str, range(1, x.size + 1) if names is None else names))
    if x.ndim != 1 or len(x) < 2 or not np.isfinite(x).all():
        raise AllanjaxError("random_effects needs at least two finite values in a row")
    s, g = (np.zeros(1) if y is None else np.atleast_1d(np.asarray(y, float)) for y in (stds, skewness))
    if not {s.size, g.size} <= {1, len(x)} or len(called) != len(x):
        raise AllanjaxError(f"{len(x)} values need {len(x)} names and stds, or one std for all")
    if stds is not None and not (np.isfinite(s) & (s > 0.0)).all():
        raise AllanjaxError("standard errors must be positive and finite; leave stds out if they are unknown")
    laws = Laws(x, np.resize(s, len(x)), np.resize(g, len(x)))
    tau = laws.scatter()
    mean, std, _ = (float(y) for y in laws.fitted(x, tau))
    ends = (mean - std * laws.t_quantiles([0.975, 0.025, 0.84, 0.16, 0.05], tau)).tolist()
    odd, chance = laws.odd_one(tau) if len(x) > 2 else (-1, float("nan"))
    return RandomEffects(
        names=called,
        values=x,
        stds=laws.s,
        common=mean,
        std=std,
        interval=(ends[0], ends[1]),
        interval_68=(ends[2], ends[3]),
        limit=ends[4],
        scatter=tau,
        scatter_interval=(laws.scatter(0.975), laws.scatter_limit(0.025)),
        scatter_limit=laws.scatter_limit(0.05),
        p_value=laws.p_value(),
        odd=called[odd] if odd >= 0 else "",
        odd_p_value=chance,
    )
