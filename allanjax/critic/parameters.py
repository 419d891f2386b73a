"""Parameters and details of findings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, TypeAlias

import numpy as np
from jaxtyping import Float

from allanjax.base.normal import ONE_SIDED_95, TWO_SIDED_95
from allanjax.noise.estimate import Estimate
from allanjax.record.recording import Axis

# Distance of a maximum from a bound, absolute and in standard deviations, below which it is at the bound.
_AT_BOUND, _NEAR_BOUND = 2e-2, 1.0
#: Side of its 95 % limit on which a parameter lies; "" if it has an estimate.
Limit: TypeAlias = Literal["", "above", "below"]
#: Detail of a finding besides its parameters: a word, several words, or a list of numbers.
Detail: TypeAlias = str | tuple[str, ...] | tuple[Estimate, ...]


def parameter_estimate(
    axis: Axis,
    label: str,
    value: float,
    std: float,
    unit: str,
    limit: Limit = "",
    log_normal: bool = False,
) -> Estimate:
    """Parameter of a finding, with intervals from a normal law of the value or of its logarithm.

    If the search ended at a bound of its range, or the effect may continue beyond the record, the value is a
    95 % `limit`: the parameter lies "above" or "below" it and has no standard deviation.
    """
    value, std = float(value), float("nan") if limit else float(std)

    def interval(deviations: float) -> tuple[float, float]:
        if log_normal:
            factor = float(np.exp(deviations * std / value))
            return value / factor, value * factor
        return value - deviations * std, value + deviations * std

    return Estimate(
        axis=axis,
        label=label,
        value=value,
        std=std,
        interval=interval(TWO_SIDED_95),
        interval_68=interval(1.0),
        unit=unit,
        usual_unit=unit,
        source="critique",
        upper_limit=value if limit == "below" else None,
        lower_limit=value if limit == "above" else None,
    )


def limited(
    u: float, std: float, bounds: Sequence[float] | Float[np.ndarray, " 2"]
) -> tuple[float, float, Limit]:
    """Estimate and its standard deviation, or a 95 % limit where it is at a bound."""
    if u > bounds[1] - max(_AT_BOUND, _NEAR_BOUND * std):
        return min(u, bounds[1]) - ONE_SIDED_95 * std, float("nan"), "above"
    if u < bounds[0] + max(_AT_BOUND, _NEAR_BOUND * std):
        return max(u, bounds[0]) + ONE_SIDED_95 * std, float("nan"), "below"
    return u, std, ""


def side_of_limit(e: Estimate) -> Limit:
    """Side of its 95 % limit on which a finding's parameter lies; "" if it has an estimate."""
    if e.lower_limit is not None:
        return "above"
    return "" if e.upper_limit is None else "below"


def values_of(detail: Detail) -> tuple[tuple[float, ...] | tuple[str, ...], float, str]:
    """Words or values of a detail, the standard deviation of the first value, and their unit."""
    words = (detail,) if isinstance(detail, str) else tuple(x for x in detail if isinstance(x, str))
    numbers = [x for x in detail if isinstance(x, Estimate)]
    return (tuple(x.value for x in numbers), numbers[0].std, numbers[0].unit) if numbers else (words, 0.0, "")


def written(x: Estimate | Detail) -> tuple[float | tuple[float, ...] | tuple[str, ...], float, str, Limit]:
    """Value, standard deviation and unit of a parameter or a detail, and the side of a limit."""
    return (x.value, x.std, x.unit, side_of_limit(x)) if isinstance(x, Estimate) else (*values_of(x), "")


def numbers_in(details: Mapping[str, Detail], name: str) -> list[float]:
    """Values of a list among details; none if there is no such list."""
    return [x.value for x in details.get(name, ()) if isinstance(x, Estimate)]
