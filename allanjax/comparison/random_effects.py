"""Values that repeat: their common value, and their scatter beyond what their errors explain.

The model is x_r = μ + b_r + e_r, with scatter b_r of variance τ² and errors e_r of known s_r. Everything follows
from Q(τ) = Σ (x_r − μ(τ))²/(τ² + s_r²) with the weighted mean μ(τ), which has a χ² law of k − 1 degrees of
freedom at the true τ: Q(0) tests whether the values agree (Cochran 1954), Q(τ) = k − 1 gives τ (Paule &
Mandel 1982, J. Res. NBS 87:377), Q at the quantiles of χ² its interval (Viechtbauer 2007, Stat. Med. 26:37),
and Q(τ)/(k − 1) corrects the error of μ, whose interval is that of Student's t (Hartung & Knapp 2001, Stat.
Med. 20:3875). These hold for three values as well as for thirty, exactly where all errors are equal.

Errors of squared amplitudes are skewed where few clusters determine them. The laws of Q and of t are then
those of simulated values: shifted gamma errors of this skewness, and normal scatter.
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
CERTAIN = 0.05
_Values = Float[np.ndarray, " k"]


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class RandomEffects(ByValue, Tabled):
    """Common value and scatter of values, e.g. of a coefficient on several days; see `random_effects`.

    Attributes:
        names: names of the values.
        values, stds: the values and their standard errors; these are zero if unknown.
        common, std, interval, interval_68: common value, its standard error, 95 % and 68 % interval.
        limits: its one-sided 95 % limits from below and from above.
        scatter, scatter_interval: standard deviation τ of the scatter beyond the errors, and its 95 % interval;
            without errors that of the values themselves.
        scatter_limit: one-sided 95 % upper limit of τ.
        p_value: probability of values that differ as much if there is no scatter; NaN without errors.
        odd, odd_p_value: index of the value that differs most from the others, and the probability that any
            of so many does; None and NaN for two values.
    """

    names: tuple[str, ...]
    values: _Values
    stds: _Values
    common: float
    std: float
    interval: tuple[float, float]
    interval_68: tuple[float, float]
    limits: tuple[float, float]
    scatter: float
    scatter_interval: tuple[float, float]
    scatter_limit: float
    p_value: float
    odd: int | None
    odd_p_value: float

    @property
    def sample_std(self) -> float:
        """Standard deviation of the values, from their mean and k − 1, as in Hou (2004), table 5.1."""
        return float(np.std(self.values, ddof=1))

    @property
    def error(self) -> float:
        """Root mean square of the standard errors."""
        return float(np.sqrt(np.mean(self.stds**2)))

    @property
    def scatters(self) -> bool:
        """Whether a scatter beyond the errors is detected: its interval excludes zero."""
        return self.scatter_interval[0] > 0.0

    @property
    def odd_one(self) -> str:
        """Name of the value that differs from the others; "" if none does for certain."""
        return self.names[self.odd] if self.odd is not None and self.odd_p_value < CERTAIN else ""

    @property
    def verdict(self) -> str:
        """Whether the values repeat within their errors, in words."""
        if not self.error > 0.0:
            return f"STD {significant(self.sample_std)}; errors unknown"
        ratio = self.sample_std / self.error
        sizes = f"STD {significant(self.sample_std)} is {significant(ratio, 2)} times the error"
        told = "the values differ beyond their errors" if self.p_value < CERTAIN else "the values repeat"
        odd = f"; {self.odd_one} differs from the others" if self.odd_one else ""
        return f"{told} ({format_p_value(self.p_value)}): {sizes} {significant(self.error)}{odd}"

    def to_dict(self) -> dict[str, Any]:
        """All numbers in types of JSON; those that are not finite are None."""
        from allanjax.estimate.as_json import in_json

        more = {"sample_std": self.sample_std, "odd_one": self.odd_one, "verdict": self.verdict}
        return {str(key): in_json(x) for key, x in (vars(self) | more).items()}

    def _title(self) -> str:
        return f"{len(self.values)} values: {self.verdict}"

    def _tables(self) -> list[list[Column]]:
        def row(name: str, x: float, ends: tuple[float, float]) -> tuple[str, str, str]:
            return name, significant(x, 4), " … ".join(significant(end) for end in ends)

        below = "" if self.scatters else "not detected"
        scatter = row("scatter", self.scatter, self.scatter_interval) + (below,)
        return [
            columns_from(
                ("", "value", "95 %", ""), [(*row("common", self.common, self.interval), ""), scatter]
            )
        ]


class _Laws:
    """Values x with errors s, and the laws of Q and t: χ² and Student's, or of draws of skewed errors."""

    def __init__(self, x: _Values, s: _Values, skewness: _Values) -> None:
        self.x, self.s, self.dof = x, s, len(x) - 1
        self.spread = float(np.ptp(x)) or float(s.max()) or 1.0
        # Without errors Q is infinite at zero.
        self.least = 0.0 if s.all() else 1e-9 * self.spread
        self.skewness = skewness if np.any(abs(skewness) > _SKEWED) else None

    @cached_property
    def drawn(self) -> tuple[Float[np.ndarray, "draws k"], Float[np.ndarray, "draws k"]]:
        """Errors of unit variance with this skewness, and scatter of unit variance."""
        rng, size = np.random.default_rng(0), (_DRAWS, len(self.x))
        g = np.maximum(np.abs(self.skewness), _SKEWED)
        errors = (rng.standard_gamma(4.0 / g**2, size) - 4.0 / g**2) * g / 2.0
        return errors * np.sign(self.skewness), rng.standard_normal(size)

    def fitted(self, x: Float[np.ndarray, "*sets k"], tau: float) -> tuple[Any, Any, float]:
        """Weighted mean of each set of values, Q, and the sum of the weights at a scatter τ."""
        w = 1.0 / (self.s**2 + max(tau, self.least) ** 2)
        mean = x @ w / w.sum()
        return mean, (x - mean[..., None]) ** 2 @ w, float(w.sum())

    def simulated(self, tau: float) -> Float[np.ndarray, "draws k"]:
        """Values around zero with these errors and this scatter."""
        errors, scatter = self.drawn
        return errors * self.s + scatter * tau

    def q(self, tau: float) -> float:
        return float(self.fitted(self.x, tau)[1])

    def q_quantile(self, p: float, tau: float) -> float:
        if self.skewness is None:
            return float(quantile(p, self.dof))
        return float(np.quantile(self.fitted(self.simulated(tau), tau)[1], p))

    def p_value(self) -> float:
        """Probability of a Q as large as that of the values without scatter."""
        if self.least:
            return float("nan")
        if self.skewness is None:
            return float(upper_tail(self.q(0.0), self.dof))
        return float((1 + np.sum(self.fitted(self.simulated(0.0), 0.0)[1] >= self.q(0.0))) / (1 + _DRAWS))

    def t_quantiles(self, p: Sequence[float], tau: float) -> list[float]:
        """Quantiles of the mean's distance from the common value, in its standard errors."""
        if self.skewness is None:
            from scipy.special import stdtrit

            return [float(stdtrit(self.dof, x)) for x in p]
        mean, q, total = self.fitted(self.simulated(tau), tau)
        t = mean / np.sqrt(np.maximum(q, 1e-300) / self.dof / total)
        return [float(x) for x in np.quantile(t, p)]

    def limit(self, p: float) -> float:
        """The τ at which Q is at a low quantile; if Q is below it even at zero, that of the values as exact."""
        return self.scatter(p) or float(
            np.sqrt(np.sum((self.x - self.x.mean()) ** 2) / quantile(p, self.dof))
        )

    def scatter(self, p: float | None = None) -> float:
        """The τ at which Q is at its quantile, or at its mean k − 1; zero if Q is below it at zero."""

        def beyond(tau: float) -> float:
            return self.q(tau) - (self.dof if p is None else self.q_quantile(p, tau))

        low, high = 0.0, self.spread
        if beyond(low) <= 0.0 or not np.ptp(self.x):
            return 0.0
        while beyond(high) > 0.0:
            high *= 2.0
        for _ in range(50):
            middle = (low + high) / 2.0
            low, high = (middle, high) if beyond(middle) > 0.0 else (low, middle)
        return high


def random_effects(
    values: ArrayLike,
    stds: ArrayLike | None = None,
    names: Sequence[str] | None = None,
    *,
    skewness: ArrayLike | None = None,
) -> RandomEffects:
    """Common value of several values, and their scatter beyond what their errors explain.

    See the module for the model and the papers. The odd one out is the value farthest from the mean of the
    others, in the scale of their scatter and all errors (Student's t with k − 2 degrees of freedom), its
    p-value multiplied by the number of values; with skewed errors simulated values give that p-value.

    Args:
        values: at least two values [k], e.g. of a coefficient on several days.
        stds: their standard errors, or one for all; without them the scatter is that of the values themselves.
        names: their names; by default "1", "2", ….
        skewness: skewness of their errors; by default 0, of normal ones.

    Raises:
        AllanjaxError: fewer than two values, a value that is not finite, an error that is not positive, or
            another number of errors or names.
    """
    x = np.atleast_1d(np.asarray(values, float))
    if x.ndim != 1 or len(x) < 2 or not np.isfinite(x).all():
        raise AllanjaxError("random_effects needs at least two finite values in a row")
    try:
        s = np.broadcast_to(0.0 if stds is None else np.asarray(stds, float), x.shape).copy()
        g = np.broadcast_to(0.0 if skewness is None else np.asarray(skewness, float), x.shape)
    except ValueError as error:
        raise AllanjaxError(f"{len(x)} values need as many stds and skewnesses, or one for all") from error
    if stds is not None and not (np.isfinite(s) & (s > 0.0)).all():
        raise AllanjaxError("standard errors must be positive and finite; leave stds out if they are unknown")
    called = tuple(map(str, names if names is not None else range(1, len(x) + 1)))
    if len(called) != len(x):
        raise AllanjaxError(f"{len(x)} values need {len(x)} names, not {len(called)}")
    laws = _Laws(x, s, g)
    tau = laws.scatter()
    mean, q, total = laws.fitted(x, tau)
    std = float(np.sqrt(max(q, 1e-300) / laws.dof / total))
    ends = [float(mean - t * std) for t in laws.t_quantiles([0.975, 0.025, 0.84, 0.16, 0.95, 0.05], tau)]
    odd, chance = _odd_one(laws, tau)
    return RandomEffects(
        names=called,
        values=x,
        stds=s,
        common=float(mean),
        std=std,
        interval=(ends[0], ends[1]),
        interval_68=(ends[2], ends[3]),
        limits=(ends[4], ends[5]),
        scatter=tau,
        scatter_interval=(laws.scatter(0.975), laws.limit(0.025)),
        scatter_limit=laws.limit(0.05),
        p_value=laws.p_value(),
        odd=odd,
        odd_p_value=chance,
    )


def _odd_one(laws: _Laws, tau: float) -> tuple[int | None, float]:
    """Index of the value that differs most from the others, and the probability that one of them does."""
    x, s, k = laws.x, laws.s, len(laws.x)
    if k < 3:
        return None, float("nan")

    def farthest(x: Float[np.ndarray, "*sets k"]) -> Any:
        mean, q, _ = laws.fitted(x, tau)
        apart = (x - mean[..., None]) ** 2 / (s**2 + max(tau, laws.least) ** 2)
        return apart / np.maximum(q, 1e-300)[..., None]

    if laws.skewness is not None:
        own, drawn = farthest(x), farthest(laws.simulated(tau)).max(axis=-1)
        return int(np.argmax(own)), float((1 + np.sum(drawn >= own.max())) / (1 + _DRAWS))
    from scipy.special import stdtr

    chances = []
    for j in range(k):
        others = _Laws(np.delete(x, j), np.delete(s, j), np.zeros(k - 1))
        tau = others.scatter()
        mean, q, total = others.fitted(others.x, tau)
        # The others' own scatter is the scale, as in Hartung & Knapp.
        scale = np.sqrt((s[j] ** 2 + max(tau, others.least) ** 2 + 1.0 / total) * max(q, 1e-300) / others.dof)
        chances.append(2.0 * float(stdtr(others.dof, -abs(x[j] - mean) / scale)))
    return int(np.argmin(chances)), min(k * min(chances), 1.0)
