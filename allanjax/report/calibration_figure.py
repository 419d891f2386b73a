"""The figure of a calibration: what each position leaves, within the scatter that the noise gives it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from allanjax.base.errors import AllanjaxError
from allanjax.calibration.result import Calibration
from allanjax.record.units import Sensor, unit_scale
from allanjax.report.figure import (
    SENSORS,
    add_grid,
    add_legend,
    marks,
    place,
    points_entry,
    save_and_close,
    style,
    write_title,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Inches.
_LEFT, _RIGHT, _TOP, _BELOW, _HEADING = 0.9, 0.2, 0.9, 0.95, 0.3
_WIDTH, _HEIGHT, _GAP = 2.7, 2.1, 0.25
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
    import matplotlib.pyplot as plt

    chosen = [axes] if isinstance(axes, str) else axes
    rows = [
        (sensor, misfit, [k for k, name in enumerate(misfit.names) if chosen is None or name in chosen])
        for sensor, misfit in calibration.misfit.items()
    ]
    names = [name for misfit in calibration.misfit.values() for name in misfit.names]
    if missing := [name for name in chosen or () if name not in names]:
        raise AllanjaxError(f"no residuals of {', '.join(missing)} to plot; there are {', '.join(names)}")
    rows = [row for row in rows if row[2]]
    columns = max(len(kept) for _, _, kept in rows)
    at = np.arange(len(calibration.positions))
    row_height = _HEADING + _HEIGHT + _BELOW
    width = _LEFT + _RIGHT + columns * (_WIDTH + _GAP)
    height = _TOP + len(rows) * row_height
    with style():
        figure = plt.figure(figsize=(width, height))
        told = (
            f"{SENSORS[s]}: p = {m.p_value:.2g}" if m.dof else f"{SENSORS[s]}: no check" for s, m, _ in rows
        )
        write_title(figure, _LEFT, f"Calibration from {len(at)} positions", "; ".join(told))
        add_legend(
            figure, [points_entry("mean less what was fitted, ± 1σ of the noise")], "upper left", _LEFT, 0.65
        )
        for i, (sensor, misfit, kept) in enumerate(rows):
            scale = unit_scale(_UNITS[sensor], sensor)
            bottom = height - _TOP - i * row_height - _HEADING - _HEIGHT
            reach = np.nanmax(np.abs(misfit.residuals) + misfit.residual_std) / scale * 1.15 or 1.0
            for column, k in enumerate(kept):
                panel = place(figure, _LEFT + column * (_WIDTH + _GAP), bottom, _WIDTH, _HEIGHT)
                value, spread = misfit.residuals[:, k] / scale, misfit.residual_std[:, k] / scale
                panel.axhline(0.0, color="black", linewidth=1.0)
                panel.errorbar(at, value, spread, label="residual", **marks(3.5))
                add_grid(panel)
                panel.set_ylim(-reach, reach)
                panel.set_xlim(-0.5, len(at) - 0.5)
                labels = [p.label for p in calibration.positions]
                panel.set_xticks(at, labels, rotation=45, ha="right", rotation_mode="anchor")
                panel.set_title(misfit.names[k], loc="left", fontweight="bold")
                panel.tick_params(labelleft=column == 0)
                if column == 0:
                    panel.set_ylabel(f"residual [{_UNITS[sensor]}]")
        return save_and_close(figure, path)
