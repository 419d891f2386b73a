"""Parts of figures of Allan deviations: measured points, units and labels."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from jaxtyping import Float

from allanjax.allan.deviation import AllanDeviation, allan_deviation, rate_unit
from allanjax.base.errors import AllanjaxError
from allanjax.estimate.result import Fit
from allanjax.record.recording import Axis, Recording
from allanjax.report.figure import Unit, marks

if TYPE_CHECKING:
    from matplotlib.axes import Axes

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


def draw_measured(
    panel: Axes, curve: AllanDeviation, k: int, unit: Unit, label: str = "measured", **style: Any
) -> None:
    """Draw the estimates with their 68 % intervals."""
    deviation = curve.deviation[:, k]
    lower, upper = curve.confidence_interval(0.68)
    spread = np.stack([deviation - lower[:, k], upper[:, k] - deviation])
    panel.errorbar(
        curve.cluster_time,
        deviation / unit.scale,
        np.maximum(spread, 0.0) / unit.scale,
        label=label,
        zorder=3,
        **{**marks(2.6), **style},
    )


def times_to_draw(curve: AllanDeviation) -> Float[np.ndarray, " t"]:
    """Cluster times at which a model's curve is drawn [s].

    They are whole numbers of samples: between them a sinusoid above the Nyquist frequency would be another.
    """
    return np.unique(np.rint(np.geomspace(1.0, curve.cluster_size[-1], 400))) / curve.rate


def unit_of(axis: Axis | None) -> Unit:
    """Unit in which an axis's deviations are drawn."""
    return Unit("", 1.0) if axis is None else Unit(*rate_unit(axis))


def deviation_label(curve: AllanDeviation, unit: Unit) -> str:
    """Label of the vertical axis."""
    return f"{kind_of(curve)}\n[{unit.name}]" if unit.name else kind_of(curve)


def kind_of(curve: AllanDeviation) -> str:
    """Name of the curve's statistic, e.g. "Allan deviation"."""
    return {"allan": "Allan", "modified": "modified Allan", "hadamard": "Hadamard"}[curve.kind] + " deviation"
