"""Parts of figures of Allan deviations: measured points, units and labels."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from allanjax.allan.deviation import AllanDeviation, allan_deviation, rate_unit
from allanjax.base.errors import AllanjaxError
from allanjax.estimate.result import Fit
from allanjax.record.recording import Axis, Recording
from allanjax.report.figure import Points

CLUSTER_TIME = "cluster time T [s]"
#: What can be drawn as an Allan deviation.
Drawable: TypeAlias = Fit | AllanDeviation | Recording


def fit_and_curve(data: Drawable) -> tuple[Fit | None, AllanDeviation]:
    """Fit, if there is one, and Allan deviations of what is to be drawn."""
    if isinstance(data, Fit):
        return data, data.curve
    if isinstance(data, Recording):
        return None, allan_deviation(data)
    if isinstance(data, AllanDeviation):
        return None, data
    raise AllanjaxError(
        f"cannot draw {type(data).__name__} as an Allan deviation: give a fit, what allan_deviation returns, "
        "or a recording"
    )


def allan_points(curve: AllanDeviation, k: int, scale: float = 1.0) -> Points:
    """Estimates of an axis with their 68 % intervals, in the unit of this size."""
    ends = [end[:, k] for end in curve.confidence_interval(0.68)]
    return Points.of(curve.cluster_time, curve.deviation[:, k], ends, scale)


def times_to_draw(curve: AllanDeviation) -> Float[np.ndarray, " t"]:
    """Cluster times at which a model's curve is drawn [s].

    They are whole numbers of samples: between them a sinusoid above the Nyquist frequency would be another.
    """
    return np.unique(np.rint(np.geomspace(1.0, curve.cluster_size[-1], 400))) / curve.rate


def unit_of(axis: Axis | None) -> tuple[str, float]:
    """Unit in which an axis's deviations are drawn, and its factor to SI."""
    return ("", 1.0) if axis is None else rate_unit(axis)


def label_in(quantity: str, unit: str) -> str:
    """Label of a vertical axis, with its unit if it has one."""
    return f"{quantity}\n[{unit}]" if unit else quantity


def kind_of(curve: AllanDeviation) -> str:
    """Name of the curve's statistic, e.g. "Allan deviation"."""
    return {"allan": "Allan", "modified": "modified Allan", "hadamard": "Hadamard"}[curve.kind] + " deviation"
