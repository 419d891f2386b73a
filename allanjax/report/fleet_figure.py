"""Figure of a fleet: the distribution of each coefficient over its units."""

from __future__ import annotations

import os
import textwrap
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from allanjax.base.errors import AllanjaxError
from allanjax.base.wording import plain
from allanjax.fleet.fleet import FleetResult
from allanjax.fleet.table import table_schema
from allanjax.noise.estimate import title_of
from allanjax.report.figure import (
    COLOURS,
    POINTS,
    SENSORS,
    add_legend,
    literal,
    marks,
    place,
    points_entry,
    save_and_close,
    style,
    write_title,
)

_BLUE, _ORANGE, _GREEN, _RED, _PURPLE, _SKY = COLOURS
_MEDIAN, _OUTLYING, _LIMIT = _BLUE, _RED, "0.6"
# Points of axes with remarks.
_HOLLOW: dict[str, Any] = {"markerfacecolor": "white", "markeredgewidth": 0.9, "markersize": 3.8}
# Colours of each group's points; the first one if there is a single group.
_GROUPS = (POINTS, _GREEN, _PURPLE, _ORANGE, _SKY, "0.5")

# Inches: places are fixed, so that nothing can overlap.
_LEFT, _RIGHT, _TOP, _BOTTOM = 0.75, 0.2, 0.85, 0.1
_PANEL_WIDTH, _PANEL_HEIGHT, _GAP, _ROW_GAP = 5.2, 2.3, 0.95, 0.65
_NAME_HEIGHT = 0.125
# Most letters of a unit's name beside its point, the last ones; width of a letter as a share of the panel.
_LONGEST, _LETTER = 18, 0.0115
# Half the width of an axis's units as a share of the distance between axes; distance from points to names as
# a share of the panel.
_SPREAD = 0.38
_BESIDE = 0.02
# Most outlying units that are named in a panel on each axis; the table names all.
_NAMED = 12
# Most units, and most lines, that the title names from left to right.
_LISTED, _MOST_LINES = 12, 4
# Empty places between two groups as a share of all places; one at least.
_APART = 0.05
# Heights of a line of the key and of the title [inches]; letters, and entries of the key, to an inch.
_LINE_HEIGHT, _TITLE_LINE, _LETTERS, _ENTRIES = 0.2, 0.16, 12.0, 0.5
# Distance from the outermost points of a group to the ends of its band, as a share of that between axes.
_BESIDE_POINTS = 0.04
# Units from which on error bars are thin.
_MANY = 60
# Most that the scale reaches beyond the outermost values, as a factor.
_BEYOND = 2.0
# Ratio of highest to lowest from which ticks are at 1, 2 and 5 times powers of ten.
_NEAR = 8.0
# Quantiles of the units that the bands reach from and to.
_BAND = (0.05, 0.95)


def plot_fleet(table: pd.DataFrame, path: str | os.PathLike[str] | None = None) -> Figure:
    """Draw each coefficient of every unit, a panel a coefficient, gyros beside accelerometers.

    Points are the units' estimates with their 95 % intervals, axis beside axis, group beside group, the units
    of each in the order of the table; hollow triangles are the 95 % limits of units in which the coefficient
    was not detected. Hollow circles are of axes with remarks (corrected, incomplete, partly left out); grey
    crosses are not a measurement of the sensor, and in no statistic. Outlying units are red and named. Blue
    are the median of the others' estimates in their group and the band of 90 % of them. Coefficients that no
    unit determines, or that were held, have no panel. The recordings of up to twelve units are named in the
    title.

    Args:
        table: of a fleet's coefficients, `FleetResult.table`.
        path: a file to save the picture to, by its suffix .png, .svg or .pdf.

    Returns:
        The matplotlib figure.

    Raises:
        AllanjaxError: the table lacks a column.
    """
    if missing := set(table_schema().names) - set(table.columns):
        raise AllanjaxError(
            f"a fleet's table has a column {', '.join(sorted(missing))}; pass the table of FleetResult"
        )
    drawn = _drawn(table)
    groups = list(table["group"].unique())
    sensors = [sensor for sensor in SENSORS if (drawn["sensor"] == sensor).any()]
    coefficients = list(drawn["coefficient"].unique())
    rows, columns = max(len(coefficients), 1), max(len(sensors), 1)
    width = _LEFT + _RIGHT + columns * _PANEL_WIDTH + (columns - 1) * _GAP
    facts = _facts(table, int(_LETTERS * (width - _LEFT - _RIGHT)))
    keys = _key(table)
    key_columns = max(int(_ENTRIES * (width - _LEFT - _RIGHT)), 1)
    top = _TOP + _TITLE_LINE * (len(facts) - 1) + _LINE_HEIGHT * (1 + -(-len(keys) // key_columns))
    height = top + _BOTTOM + rows * (_PANEL_HEIGHT + _ROW_GAP)
    with style():
        figure = plt.figure(figsize=(width, height))
        write_title(figure, _LEFT, f"{table['recording'].nunique()} units", "\n".join(facts))
        below = 0.42 + _LINE_HEIGHT + _TITLE_LINE * (len(facts) - 1)
        add_legend(figure, keys, "upper left", _LEFT, below, ncols=key_columns, columnspacing=1.2)
        for row, coefficient in enumerate(coefficients):
            for column, sensor in enumerate(sensors):
                of = drawn[(drawn["coefficient"] == coefficient) & (drawn["sensor"] == sensor)]
                if of.empty:
                    continue
                left = _LEFT + column * (_PANEL_WIDTH + _GAP)
                bottom = height - top - row * (_PANEL_HEIGHT + _ROW_GAP) - _PANEL_HEIGHT
                panel = place(figure, left, bottom, _PANEL_WIDTH, _PANEL_HEIGHT)
                _draw_panel(panel, of, groups)
        return save_and_close(figure, path)


def plot_fleet_result(fleet: FleetResult, path: str | os.PathLike[str] | None = None) -> Figure:
    """Draw the distribution of each coefficient over the fleet; see `plot_fleet`."""
    return plot_fleet(fleet.table, path)


def _drawn(table: pd.DataFrame) -> pd.DataFrame:
    """Rows with an interval, a limit, or no measurement; `height` is where they are drawn."""
    height = np.where(table["detected"] | ~table["measured"], table["value"], table["upper_limit_95"])
    # Neither a value that was held nor one without an error is an estimate; zero is no fitted value.
    estimated = table["lower_95"] < table["upper_95"]
    shown = np.where(table["measured"], estimated | ~table["detected"], table["value"] != 0.0)
    return table.assign(height=height)[np.isfinite(height) & shown]


def _group_colours(table: pd.DataFrame) -> list[tuple[str, str]]:
    """Text of the key for the points of each group, and their colour."""
    groups = list(table["group"].unique())
    if len(groups) < 2:
        return [("estimate, 95 % interval", _GROUPS[0])]
    if len(groups) > len(_GROUPS):
        return [("estimates, 95 % intervals: a colour a group", _GROUPS[0])]
    counts = table.groupby("group")["recording"].nunique()
    return [(literal(f"group {g} ({counts[g]})"), colour) for g, colour in zip(groups, _GROUPS, strict=False)]


def _facts(table: pd.DataFrame, letters: int) -> list[str]:
    """Lines on how many units are outlying, and which units there are if that does not take many."""
    units = table["recording"].nunique()
    if not units:
        return ["no results"]
    facts = f"{table.loc[table['outlying'], 'recording'].nunique() or 'none'} of them outlying"
    parts = [of["recording"].unique() for _, of in table.groupby("group", sort=False)]
    named = f"{facts}; left to right: {' | '.join(', '.join(names) for names in parts)}"
    lines = textwrap.wrap(named, letters, break_on_hyphens=False)
    return lines if units <= _LISTED and len(lines) <= _MOST_LINES else [facts]


def _key(table: pd.DataFrame) -> list[Any]:
    """Entries of the key for points, lines and bands."""
    no_line: dict[str, Any] = {"markersize": 4, "linewidth": 0.0, "markerfacecolor": "none"}
    remarked = (table["measured"] & (table["remarks"] != "")).any()
    hollow = Line2D([], [], color=POINTS, marker="o", label="with a remark", **{**no_line, "linewidth": 0.8})
    cross = Line2D([], [], color=_LIMIT, marker="x", label="not a measurement", **no_line)
    return [
        *(points_entry(name, colour) for name, colour in _group_colours(table)),
        *([hollow] if remarked else []),
        *([] if table["measured"].all() else [cross]),
        Line2D([], [], color=_LIMIT, marker="v", label="not detected: 95 % limit", **no_line),
        points_entry("outlying", _OUTLYING),
        Line2D([], [], color=_MEDIAN, linewidth=1.4, label="median of the other estimates"),
        Patch(color=_MEDIAN, alpha=0.15, linewidth=0.0, label="90 % of them"),
    ]


def _draw_panel(panel: Axes, of: pd.DataFrame, groups: list[str]) -> None:
    """Draw a coefficient of one kind of sensor."""
    coefficient, sensor, unit = of[["coefficient", "sensor", "unit"]].iloc[0]
    axes = list(of["axis"].unique())
    title = title_of(coefficient, sensor)
    panel.set_title(f"{SENSORS[sensor]}: {title}", loc="left", fontweight="bold")
    panel.set_ylabel(title if unit == "1" else f"{title} [{unit}]")
    panel.set_xticks(range(len(axes)), axes)
    panel.set_xlim(-0.5, len(axes) - 0.5)
    panel.tick_params(axis="x", length=0.0)
    panel.grid(True, axis="y", which="major", color="0.88", linewidth=0.6)
    panel.set_axisbelow(True)
    _set_scale(panel, of)
    for k, axis in enumerate(axes):
        _draw_axis(panel, k, of[of["axis"] == axis], groups)


def _set_scale(panel: Axes, of: pd.DataFrame) -> None:
    """Set a logarithmic scale where values allow; ends of wide intervals leave the panel."""
    height = of["height"].to_numpy()
    if (height <= 0.0).any():
        return
    low = max(float(of.loc[of["lower_95"] > 0.0, "lower_95"].min()), height.min() / _BEYOND)
    high = min(float(of.loc[of["detected"], "upper_95"].max()), height.max() * _BEYOND)
    low, high = np.nanmin([low, height.min()]), np.nanmax([high, height.max()])
    panel.set_yscale("log")
    margin = max((high / low) ** 0.08, 1.05)
    panel.set_ylim(low / margin, high * margin)
    # Within a decade or less, powers of ten alone would leave the scale without numbers.
    near = high / low < _NEAR
    panel.yaxis.set_major_locator(MaxNLocator(6) if near else LogLocator(subs=(1.0, 2.0, 5.0)))
    panel.yaxis.set_major_formatter(FuncFormatter(lambda y, _: plain(y)))
    panel.yaxis.set_minor_locator(NullLocator())


def _draw_axis(panel: Axes, k: int, of: pd.DataFrame, groups: list[str]) -> None:
    """Draw the units' values on one axis about x = k, side by side, with a gap between groups."""
    of = of.sort_values("group", key=lambda names: names.map(groups.index), kind="stable")
    number = of["group"].map(groups.index).to_numpy()
    apart = max(1, round(_APART * len(of)))
    steps = np.arange(len(of)) + apart * np.cumsum(np.diff(number, prepend=number[0]) > 0)
    of = of.assign(x=k + _SPREAD * (2.0 * steps / max(steps[-1], 1) - (steps[-1] > 0)))
    for g in np.unique(number):
        _draw_group(panel, of[number == g], _GROUPS[g % len(_GROUPS)])
    if of["outlying"].any():
        _name_units(panel, k, of[of["outlying"]])


def _draw_group(panel: Axes, of: pd.DataFrame, colour: str) -> None:
    """Draw the values of a group's units on one axis, and the band of most of them."""
    x, y, detected, outlying = (of[name].to_numpy() for name in ("x", "height", "detected", "outlying"))
    measured, remarked = of["measured"].to_numpy(), (of["remarks"] != "").to_numpy()
    usual = detected & ~outlying
    if usual.any():
        low, median, high = np.quantile(y[usual], (_BAND[0], 0.5, _BAND[1]))
        reach = [x[0] - _BESIDE_POINTS, x[-1] + _BESIDE_POINTS]
        panel.fill_between(reach, low, high, color=_MEDIAN, alpha=0.15, linewidth=0.0, zorder=1)
        panel.plot(reach, [median, median], color=_MEDIAN, linewidth=1.4, zorder=2)
    limit = ~detected & measured
    panel.plot(x[limit], y[limit], "v", color=_LIMIT, mfc="none", markersize=3.5, mew=0.7)
    panel.plot(x[~measured], y[~measured], "x", color=_LIMIT, markersize=4.0, mew=0.9)
    # Many units' bars must not hide their points.
    bars = 0.8 if len(of) <= _MANY else 0.4
    ends = np.nan_to_num(np.stack([y - of["lower_95"].to_numpy(), of["upper_95"].to_numpy() - y]), posinf=0.0)
    for rows, shown, zorder in ((usual, colour, 3), (outlying, _OUTLYING, 4)):
        for part, more in ((rows & ~remarked, {}), (rows & remarked, _HOLLOW)):
            look = {**marks(2.6), "color": shown, "elinewidth": bars, "zorder": zorder, **more}
            panel.errorbar(x[part], y[part], np.maximum(ends[:, part], 0.0), **look)


def _name_units(panel: Axes, k: int, of: pd.DataFrame) -> None:
    """Write names in a column beside their points, from the lowest up, each clear of the one before."""
    points = of[["x", "height"]].to_numpy()
    places = panel.transLimits.transform(panel.transScale.transform(points))
    names = [name if len(name) <= _LONGEST else f"…{name[1 - _LONGEST :]}" for name in of["recording"]]
    # Where there is more room.
    right = of["x"].mean() <= k
    step = _NAME_HEIGHT / _PANEL_HEIGHT
    column = places[:, 0].max() + _BESIDE if right else places[:, 0].min() - _BESIDE
    last = 1.0 - _LETTER * max(map(len, names))
    if right and column > last:
        # Within the panel, and above the points.
        column, places = last, places + np.array([0.0, step])
    order = np.argsort(places[:, 1])[:_NAMED]
    clear = -np.inf
    for count, i in enumerate(order):
        # So low that those above it have a place too.
        highest = 1.0 - (len(order) - 1 - count + 0.6) * step
        level = max(min(places[i, 1], highest), clear)
        clear = level + step
        more = len(names) - _NAMED
        panel.annotate(
            literal(names[i] if count < _NAMED - 1 or more <= 0 else f"{names[i]} and {more} more"),
            points[i],
            (column, level),
            textcoords="axes fraction",
            color=_OUTLYING,
            fontsize=7,
            va="center",
            ha="left" if right else "right",
            arrowprops={"arrowstyle": "-", "color": _OUTLYING, "linewidth": 0.4, "shrinkA": 1, "shrinkB": 2},
        )
