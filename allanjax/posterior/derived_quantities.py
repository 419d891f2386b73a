"""Derived quantities of a posterior: curves, the bias-instability minimum, predicted drift."""

from __future__ import annotations

import dataclasses
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from allanjax.base.equality import ByValue
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model
from allanjax.record.recording import Axis

# Draws whose curves are evaluated at once: terms without a closed form need room.
_AT_ONCE = 16


def derived(
    label: str, axis: Axis, usual_unit: str, draws: Float[np.ndarray, " draws"], remark: str = ""
) -> Estimate:
    """Estimate of a derived quantity from its posterior draws [SI]: median, σ and intervals."""
    low, low_68, median, high_68, high = np.quantile(draws, [0.025, 0.16, 0.5, 0.84, 0.975]).tolist()
    # Draws that agree to rounding do not scatter.
    std = float(draws.std()) if high - low > 1e-12 * abs(median) else 0.0
    return Estimate(
        label=label,
        axis=axis,
        value=median,
        std=std,
        interval=(low, high),
        interval_68=(low_68, high_68),
        usual_unit=usual_unit,
        source="posterior",
        remark=remark,
    )


@dataclasses.dataclass(frozen=True, eq=False)
class BiasMinimum(ByValue):
    """The lowest point of the Allan deviation's curve.

    Attributes:
        deviation: its height.
        cluster_time: where it lies.
        at_start, at_end: share of the draws whose curve is lowest at one sample, or at half the record.
    """

    deviation: Estimate
    cluster_time: Estimate
    at_start: float
    at_end: float

    def __str__(self) -> str:
        return f"{self.deviation.in_unit()}\n{self.cluster_time.in_unit()}"

    def __repr__(self) -> str:
        return f"<BiasMinimum {self}>"


def with_draw(
    template: Model,
    labels: tuple[str, ...],
    absent: tuple[str, ...],
    values: Float[Array, " sampled"] | list[float],
) -> Model:
    """The model with these values of the labelled parameters, without the absent terms."""
    return template.with_values(**dict(zip(labels, values, strict=True))).without(absent)


@eqx.filter_jit
def curves(
    template: Model,
    labels: tuple[str, ...],
    absent: tuple[str, ...],
    draws: Float[ArrayLike, "draws sampled"],
    at: Float[ArrayLike, " points"],
    rate: float,
    kind: Literal["deviation", "density"],
) -> Float[Array, "draws points"]:
    """Allan deviation at cluster times [s], or one-sided PSD at frequencies [Hz], of every draw's model."""

    def one(values: Float[Array, " sampled"]) -> Float[Array, " points"]:
        model = with_draw(template, labels, absent, values).sampled(rate)
        if kind == "deviation":
            return jnp.sqrt(model.allan_variance(at))
        return 2.0 * model.sampled_psd(at, rate)

    return jax.lax.map(one, draws, batch_size=_AT_ONCE)


def lowest_point(
    axis: Axis,
    cluster_time: Float[np.ndarray, " points"],
    deviation: Float[np.ndarray, "draws points"],
    deviation_unit: str,
) -> BiasMinimum:
    """Minimum of each draw's curve on this grid, its height and place refined by a parabola in logarithms."""
    x, y = np.log(cluster_time), np.log(deviation)
    lowest = np.argmin(y, axis=1)
    last = len(x) - 1
    k = np.clip(lowest, 1, last - 1)
    row = np.arange(len(y))
    # Newton's parabola through the lowest point and its neighbours, which need not be equally far.
    left, right = x[k - 1] - x[k], x[k + 1] - x[k]
    slope_left, slope_right = (y[row, k - 1] - y[row, k]) / left, (y[row, k + 1] - y[row, k]) / right
    curvature = (slope_right - slope_left) / (right - left)
    slope = slope_left - curvature * left
    inside = (lowest == k) & (curvature > 0.0)
    step = np.where(inside, -slope / np.where(inside, 2.0 * curvature, 1.0), 0.0)
    height = np.where(inside, y[row, k] + step * slope / 2.0, y[row, lowest])
    place = np.where(inside, x[k] + step, x[lowest])
    at_start, at_end = float(np.mean(lowest == 0)), float(np.mean(lowest == last))
    remark_height = remark_place = ""
    if at_end > 0.5:
        remark_height = "an upper bound: the curve still falls at half the record"
        remark_place = "a lower bound: the curve still falls at half the record"
    elif at_start > 0.5:
        remark_height = remark_place = "the curve rises from one sample on"
    names = "bias-instability minimum", "cluster time of the minimum"
    return BiasMinimum(
        derived(names[0], axis, deviation_unit, np.exp(height), remark_height),
        derived(names[1], axis, "s", np.exp(place), remark_place),
        at_start,
        at_end,
    )
