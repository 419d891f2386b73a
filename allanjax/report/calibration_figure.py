"""The figure of a calibration: what each position leaves, within the scatter that the noise gives it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from allanjax.base.wording import format_p_value
from allanjax.calibration.result import Calibration
from allanjax.record.units import Sensor, unit_scale
from allanjax.report.figure import (
    SENSORS,
    Heading,
    Sheet,
    dots,
    dress,
    ink,
    points_entry,
    rows_of,
    save_and_close,
    style,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SHEET = Sheet(2.7, 2.1, gap=0.25, between=1.2, bottom=0.95)
_UNITS: dict[Sensor, str] = {"gyro": "deg/h", "accel": "µg"}


def plot_calibration(
    calibration: Calibration,
    axes: Sequence[str] | str | None = None,
    path: str | os.PathLike[str] | None = None,
) -> Figure:
    """Draw the residuals of each position, in a panel an axis, with ± 1σ of the noise model.

    Args:
        calibration: what `calibrate` returned.
        axes: names of the axes; by default all.
        path: file to save the figure to.

    Raises:
        AllanjaxError: an axis that there is not.
    """
    names = [name for misfit in calibration.misfit.values() for name in misfit.names]
    chosen = [names[k] for k in rows_of(names, None, axes)[0]]
    kinds = [
        (sensor, m, [k for k, n in enumerate(m.names) if n in chosen])
        for sensor, m in calibration.misfit.items()
    ]
    rows = [row for row in kinds if row[2]]
    at = np.arange(len(calibration.positions))
    with style():
        checks = (f"{SENSORS[s]}: {format_p_value(m.p_value) if m.dof else 'no check'}" for s, m, _ in rows)
        key = [points_entry("measured − fitted mean, ± 1σ of the noise")]
        heading = Heading(f"Calibration from {len(at)} positions", "; ".join(checks), key)
        figure, panels = _SHEET.draw(heading, [len(kept) for _, _, kept in rows])
        for (sensor, misfit, kept), row in zip(rows, panels, strict=True):
            scale = unit_scale(_UNITS[sensor], sensor)
            reach = np.nanmax(np.abs(misfit.residuals) + misfit.residual_std) / scale * 1.15 or 1.0
            for column, (k, panel) in enumerate(zip(kept, row, strict=True)):
                value, spread = misfit.residuals[:, k] / scale, misfit.residual_std[:, k] / scale
                panel.axhline(0.0, color=ink(), linewidth=1.0)
                panel.errorbar(at, value, spread, label="residual", elinewidth=0.8, **dots(3.5))
                dress(panel, misfit.names[k], y="" if column else f"residual [{_UNITS[sensor]}]")
                panel.set_ylim(-reach, reach)
                panel.set_xlim(-0.5, len(at) - 0.5)
                labels = [p.label for p in calibration.positions]
                panel.set_xticks(at, labels, rotation=45, ha="right", rotation_mode="anchor")
                panel.tick_params(labelleft=column == 0)
        return save_and_close(figure, path)
