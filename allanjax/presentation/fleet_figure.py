"""Figures of many recordings: the coefficients of a fleet's units, and those of a joint fit."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from allanjax.base.errors import AllanjaxError
from allanjax.base.wording import plain
from allanjax.comparison.repeatability import JointCoefficient, JointFit
from allanjax.fleet.fleet import FleetResult
from allanjax.fleet.table import outlying_names, table_schema, times
from allanjax.noise.estimate import Estimate, title_of
from allanjax.presentation import draw
from allanjax.presentation.draw import Heading, Sheet

_BLUE, _ORANGE, _GREEN, _RED, _PURPLE, _SKY = draw.COLOURS
_MEDIAN, _OUTLYING = _BLUE, _RED
# Colours of each group's points, by turns; None is the usual one.
_GROUPS = (None, _GREEN, _PURPLE, _ORANGE, _SKY)

_SHEET = Sheet(4.6, 2.1, gap=0.95, between=0.75, left=0.85, bottom=0.45)
# Height of a unit's name beside its point, and length of a letter of those below the axis [inches].
_NAME_HEIGHT, _TICK_LETTER = 0.125, 0.06
# Most letters of a unit's name beside its point, the last ones; width of a letter as a share of the panel.
_LONGEST, _LETTER = 18, 0.0115
# Half the width of an axis's units as a share of the distance between axes; distance from points to names as
# a share of the panel.
_SPREAD = 0.38
_BESIDE = 0.02
# Most outlying units that are named in a panel on each axis; the table names all.
_NAMED = 12
# Most units, and most letters of each, that are named below the axis.
_LISTED, _LETTERS = 12, 14
# Empty places between two groups as a share of all places; one at least.
_APART = 0.05
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
# Of a joint fit, inches for each recording, and for the letters of its name; most letters of a name, its end.
_ROW, _NAME_LETTER, _LONG_NAME = 0.19, 0.075, 24
# The row of what recordings have in common; most intervals between ticks.
_COMMON, _TICKS = "common", 4


def plot_fleet(fleet: FleetResult, path: str | os.PathLike[str] | None = None) -> Figure:
    """Draw each coefficient of every unit, one panel per coefficient, gyros beside accelerometers.

    Points are the units' estimates with their 95 % intervals, axis beside axis, group beside group, the units
    of each in the order of the table; hollow triangles are the 95 % limits of units in which the coefficient
    was not detected. Hollow circles are of axes with remarks (corrected, incomplete, partly left out); grey
    crosses are not a measurement of the sensor, and in no statistic. Outlying units are red and named, with
    their ratio to the median of their group. Blue are the median of the others' estimates in their group
    and the band of 90 % of them. Coefficients that were detected in no unit, or were held, have no panel.
    Up to twelve units are named below the axes, without the beginning that all names have in common.

    Raises:
        AllanjaxError: the table lacks a column.
    """
    table = fleet.table
    if missing := set(table_schema().names) - set(table.columns):
        raise AllanjaxError(f"the fleet's table lacks the column {', '.join(sorted(missing))}")
    drawn = _drawn(table)
    groups = list(table["group"].unique())
    sensors = [sensor for sensor in draw.SENSORS if (drawn["sensor"] == sensor).any()]
    coefficients = list(drawn["coefficient"].unique())
    rows, columns = max(len(coefficients), 1), max(len(sensors), 1)
    names = _short_names(table)
    below = _TICK_LETTER * max(map(len, names.values()), default=0)
    sheet = dataclasses.replace(_SHEET, between=_SHEET.between + below, bottom=_SHEET.bottom + below)
    with draw.style():
        counts = table[["unit_name", "recording"]].nunique().tolist()
        size = f"{counts[0]} units" + f", {counts[1]} records" * (counts[0] < counts[1])
        heading = Heading(size, _remarks(table, drawn), _key(table))
        figure, panels = sheet.draw(heading, [columns] * rows if coefficients else [0], path)
        for coefficient, row in zip(coefficients, panels, strict=False):
            for sensor, panel in zip(sensors, row, strict=True):
                of = drawn[(drawn["coefficient"] == coefficient) & (drawn["sensor"] == sensor)]
                if of.empty:
                    panel.remove()
                    continue
                _draw_panel(panel, of, groups, names)
        return draw.saved(figure, path)


def _drawn(table: pd.DataFrame) -> pd.DataFrame:
    """Rows with an interval, a limit, or no measurement; `height` is where they are drawn.

    Limits are drawn beside what was detected in another unit only.
    """
    height = np.where(table["detected"] | ~table["measured"], table["value"], table["upper_limit_95"])
    # Neither a value that was held nor one without an error is an estimate; zero is no fitted value.
    estimated = table["lower_95"] < table["upper_95"]
    shown = np.where(table["measured"], estimated | ~table["detected"], table["value"] != 0.0)
    drawn = table.assign(height=height)[np.isfinite(height) & shown]
    limits = drawn["measured"] & ~drawn["detected"]
    some = (~limits).groupby([drawn["coefficient"], drawn["sensor"]]).transform("any").astype(bool)
    return drawn[some]


def _short_names(table: pd.DataFrame) -> dict[str, str]:
    """Names of the units that are written below the axes, none if there are many."""
    units = [str(name) for name in table["recording"].unique()]
    if not 1 < len(units) <= _LISTED:
        return {}
    # The beginning that all have in common ends after a sign such as "_".
    starts = (k + 1 for k, letter in enumerate(units[0]) if not letter.isalnum())
    start = max((k for k in starts if all(name[:k] == units[0][:k] for name in units)), default=0)
    ends = {name: name[start:] for name in units}
    return {name: _short(end, _LETTERS) for name, end in ends.items()}


def _short(name: str, most: int) -> str:
    """A name, or its end of so many letters."""
    return name if len(name) <= most else f"…{name[1 - most :]}"


def _group_colours(table: pd.DataFrame) -> list[tuple[str, str | None]]:
    """Text of the key for the points of each group, and their colour."""
    groups = list(table["group"].unique())
    if len(groups) < 2:
        return [("estimate, 95 % interval", _GROUPS[0])]
    if len(groups) > len(_GROUPS):
        return [("estimates, 95 % intervals; one colour per group", _GROUPS[0])]
    counts = table.groupby("group")["recording"].nunique()
    names = [draw.literal(f"group {g} ({counts[g]})") for g in groups]
    return [*zip(names, _GROUPS, strict=False)]


def _remarks(table: pd.DataFrame, drawn: pd.DataFrame) -> str:
    """How many units or records are outlying, and which coefficients have no panel."""
    if table.empty:
        return "no results"
    text = f"{len(outlying_names(table)) or 'none'} of them outlying"
    left = table[table["measured"] & ~table["detected"]]
    kinds = set(zip(drawn["coefficient"], drawn["sensor"], strict=True))
    pairs = dict.fromkeys(zip(left["coefficient"], left["sensor"], strict=True))
    for sensor, name in draw.SENSORS.items():
        if absent := [title_of(c, s) for c, s in pairs if s == sensor and (c, s) not in kinds]:
            text += f"; {name}: no unit has {', '.join(absent)}"
    return text


def _key(table: pd.DataFrame) -> list[Any]:
    """Entries of the key for points, lines and bands."""
    hollow: dict[str, Any] = {"markersize": 4, "linewidth": 0.0, "markerfacecolor": "none"}
    grey = hollow | {"color": draw.ink(0.6)}
    remarked = hollow | {"color": draw.ink(0.3), "linewidth": 0.8}
    has_remark = (table["measured"] & (table["remarks"] != "")).any()
    return [
        *(draw.points_entry(name, colour) for name, colour in _group_colours(table)),
        *([draw.line_entry(marker="o", label="with a remark", **remarked)] if has_remark else []),
        *(
            []
            if table["measured"].all()
            else [draw.line_entry(marker="x", label="not a measurement", **grey)]
        ),
        draw.line_entry(marker="v", label="not detected: 95 % limit", **grey),
        draw.points_entry("outlying", _OUTLYING),
        draw.line_entry(color=_MEDIAN, linewidth=1.4, label="median of the other estimates"),
        draw.band_entry("90 % of them", _MEDIAN, 0.15),
    ]


def _draw_panel(panel: Axes, of: pd.DataFrame, groups: list[str], names: dict[str, str]) -> None:
    """Draw a coefficient of one kind of sensor."""
    coefficient, sensor, unit = of[["coefficient", "sensor", "unit"]].iloc[0]
    axes = list(of["axis"].unique())
    title = title_of(coefficient, sensor)
    draw.dress(panel, f"{draw.SENSORS[sensor]}: {title}", y=title if unit == "1" else f"{title}\n[{unit}]")
    panel.set_xticks(range(len(axes)), axes)
    panel.set_xlim(-0.5, len(axes) - 0.5)
    pad = 72.0 * _TICK_LETTER * max(map(len, names.values()), default=0)
    panel.tick_params(axis="x", length=0.0, pad=6.0 + pad)
    panel.tick_params(axis="x", which="minor", length=2.0, pad=2.0, labelsize=6.5, labelrotation=90)
    panel.grid(False, axis="x")
    _set_scale(panel, of)
    ticks = [_draw_axis(panel, k, of[of["axis"] == axis], groups, names) for k, axis in enumerate(axes)]
    units = pd.concat(ticks)
    if names:
        # The unit in the middle has its name, too, below that of the axis.
        panel.xaxis.remove_overlapping_locs = False
        panel.set_xticks(units["x"], [draw.literal(names[str(u)]) for u in units["recording"]], minor=True)


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


def _draw_axis(
    panel: Axes, k: int, of: pd.DataFrame, groups: list[str], names: dict[str, str]
) -> pd.DataFrame:
    """Draw the units' values on one axis about x = k, side by side, with a gap between groups.

    Returns the rows with their places `x`.
    """
    of = of.sort_values("group", key=lambda names: names.map(groups.index), kind="stable")
    number = of["group"].map(groups.index).to_numpy()
    apart = max(1, round(_APART * len(of)))
    steps = np.arange(len(of)) + apart * np.cumsum(np.diff(number, prepend=number[0]) > 0)
    of = of.assign(x=k + _SPREAD * (2.0 * steps / max(steps[-1], 1) - (steps[-1] > 0)))
    for g in np.unique(number):
        _draw_group(panel, of[number == g], _GROUPS[g % len(_GROUPS)])
    odd = of["outlying"] | of["odd_record"]
    if odd.any():
        _name_units(panel, k, of[odd].replace({"recording": names}))
    return of


def _draw_group(panel: Axes, of: pd.DataFrame, colour: str | None) -> None:
    """Draw the values of a group's units on one axis, and the band of most of them."""
    x, y, detected = (of[name].to_numpy() for name in ("x", "height", "detected"))
    outlying = (of["outlying"] | of["odd_record"]).to_numpy()
    measured, remarked = of["measured"].to_numpy(), (of["remarks"] != "").to_numpy()
    usual = detected & ~outlying
    if usual.any():
        low, median, high = np.quantile(y[usual], (_BAND[0], 0.5, _BAND[1]))
        reach = [x[0] - _BESIDE_POINTS, x[-1] + _BESIDE_POINTS]
        panel.fill_between(reach, low, high, **draw.band(_MEDIAN, 0.15, zorder=1))
        panel.plot(reach, [median, median], color=_MEDIAN, linewidth=1.4, zorder=2)
    limit = ~detected & measured
    panel.plot(x[limit], y[limit], "v", color=draw.ink(0.6), mfc="none", markersize=3.5, mew=0.7)
    panel.plot(x[~measured], y[~measured], "x", color=draw.ink(0.6), markersize=4.0, mew=0.9)
    # Many units' bars must not hide their points.
    bars = 0.8 if len(of) <= _MANY else 0.4
    ends = np.nan_to_num(np.stack([y - of["lower_95"].to_numpy(), of["upper_95"].to_numpy() - y]), posinf=0.0)
    hollow = {"markerfacecolor": draw.ink(1.0), "markeredgewidth": 0.9, "markersize": 3.8}
    for rows, shown, zorder in ((usual, colour or draw.ink(0.3), 3), (outlying, _OUTLYING, 4)):
        for part, more in ((rows & ~remarked, {}), (rows & remarked, hollow)):
            look = draw.dots(2.6, color=shown, elinewidth=bars, zorder=zorder, **more)
            panel.errorbar(x[part], y[part], np.maximum(ends[:, part], 0.0), **look)


def _name_units(panel: Axes, k: int, of: pd.DataFrame) -> None:
    """Write names in a column beside their points, from the lowest up, each clear of the one before."""
    of = of.sort_values("height")
    points = of[["x", "height"]].to_numpy()
    places = panel.transLimits.transform(panel.transScale.transform(points))
    units = zip(of["recording"], of["ratio"], strict=True)
    names = [f"{_short(name, _LONGEST)} {times(ratio)}" for name, ratio in units]
    if len(names) > _NAMED:
        names[_NAMED - 1 :] = [f"{names[_NAMED - 1]} and {len(names) - _NAMED} more"]
    steps = _NAME_HEIGHT / _SHEET.height * np.arange(len(names))
    level = np.maximum.accumulate(places[: len(names), 1] - steps) + steps
    # The uppermost is within the panel, too.
    level -= max(level[-1] - 0.96, 0.0)
    # On the side where the others are not, if that is within the panel.
    column = places[:, 0].max() + _BESIDE
    width = _LETTER * max(map(len, names))
    beyond = places[:, 0].min() - _BESIDE < width
    right = (of["x"].mean() <= k or beyond) and column + width < 1.0
    at = column if right else places[:, 0].min() - _BESIDE
    arrow = {"arrowstyle": "-", "color": _OUTLYING, "linewidth": 0.4, "shrinkA": 1, "shrinkB": 2}
    look: dict[str, Any] = {"color": _OUTLYING, "fontsize": 7, "va": "center", "arrowprops": arrow}
    look |= {"ha": "left" if right else "right", "textcoords": "axes fraction"}
    for name, point, y in zip(names, points, level, strict=False):
        panel.annotate(draw.literal(name), tuple(point), (at, y), **look)


def plot_joint(
    joint: JointFit, axes: Sequence[str] | str | None = None, path: str | os.PathLike[str] | None = None
) -> Figure:
    """Draw a forest plot of each coefficient: one row of panels per axis, one line per recording.

    Points are the recordings' values with their 95 % intervals, hollow triangles the 95 % limits of what a
    recording does not detect, and red is the odd one. Below them is the common value with its 95 % interval,
    in a pale bar of the range in which 95 % of recordings lie if their scatter is detected. Arrows are the
    ends of intervals outside the panel.

    Raises:
        AllanjaxError: there is no such axis.
    """
    results = [joint.results[k] for k in draw.rows_of(joint.axes, None, axes)[0]]
    names = [*(draw.literal(_short(name, _LONG_NAME)) for name in joint.names), _COMMON]
    left = 0.3 + _NAME_LETTER * max(map(len, names))
    sheet = Sheet(2.6, _ROW * (len(names) + 1), gap=0.3, between=0.95, left=left)
    with draw.style():
        key = [
            draw.points_entry("recording, 95 % interval"),
            draw.line_entry(marker="v", mfc="none", linewidth=0.0, color=draw.ink(0.6), label="95 % limit"),
            draw.points_entry("odd one", _OUTLYING),
            draw.points_entry("common value, 95 % interval", _MEDIAN),
            draw.band_entry("95 % of recordings", _MEDIAN, 0.25),
        ]
        heading = Heading(f"{len(joint.names)} recordings", "values of the joint fit", key)
        figure, rows = sheet.draw(heading, [len(axis.coefficients) for axis in results], path)
        for axis, panels in zip(results, rows, strict=True):
            for k, (c, panel) in enumerate(zip(axis.coefficients.values(), panels, strict=True)):
                unit = "" if c.common.usual_unit == "1" else f" [{c.common.usual_unit}]"
                draw.dress(panel, axis.axis.name, x=f"{c.common.title}{unit}")
                panel.set_ylim(len(names) - 0.3, -0.7)
                panel.set_yticks(range(len(names)), [] if k else names)
                panel.xaxis.set_major_locator(MaxNLocator(_TICKS, prune="both"))
                panel.xaxis.set_major_formatter(FuncFormatter(lambda x, _: plain(x)))
                _draw_joint(panel, c, joint.names)
        return draw.saved(figure, path)


def _draw_joint(panel: Axes, c: JointCoefficient, names: Sequence[str]) -> None:
    """Draw one coefficient: the recordings from the top, and what they have in common below."""
    common, scatter = c.common.in_unit(), c.scatter.in_unit()
    rows = [(names.index(name), of.in_unit(), name == c.effects.odd_one) for name, of in c.records.items()]
    panel.set_xlim(*_limits_of_joint([of for _, of, _ in rows], common))
    for y, of, odd in rows:
        _draw_estimate(panel, y, of, _OUTLYING if odd else draw.ink(0.3))
    if common.detected:
        panel.axvline(common.value, color=_MEDIAN, linewidth=0.8)
    if common.detected and scatter.detected:
        reach = 2.0 * np.hypot(scatter.value, common.std) / common.value
        low, high = common.value * np.exp([-reach, reach])
        panel.barh(len(names), high - low, 0.6, low, **draw.band(_MEDIAN, 0.25))
    _draw_estimate(panel, len(names), common, _MEDIAN)


def _limits_of_joint(records: Sequence[Estimate], common: Estimate) -> tuple[float, float]:
    """Limits of a panel: all values and limits, and as much of the intervals as is usual among them."""
    every = [*records, common]
    places = [x.value if x.detected else x.upper_limit or x.value for x in every]
    widths = [np.ptp(x.interval) for x in records if x.detected]
    reach = max(np.ptp(places) / 2.0, np.median(widths) if widths else 0.0) or abs(places[0]) or 1.0
    ends = np.array([x.interval for x in every if x.detected] or [(min(places), max(places))])
    low = max(min(places) - reach, np.nanmin(ends))
    high = min(max(places) + reach, np.nanmax(ends))
    low, high = min(low, min(places)), max(high, max(places))
    margin = 0.08 * (high - low)
    return low - margin if low > margin or min(places) < 0.0 else 0.0, high + margin


def _draw_estimate(panel: Axes, y: float, x: Estimate, colour: Any) -> None:
    """Draw an estimate with its interval, whose ends outside the panel are arrows at the edge, or a limit."""
    if not x.detected:
        shown = [] if x.upper_limit is None else [x.upper_limit]
        edge = colour if colour == _MEDIAN else draw.ink(0.6)
        panel.plot(shown, [y] * len(shown), "v", color=edge, mfc="none", markersize=4.0)
        return
    low, high = panel.get_xlim()
    panel.plot(np.clip(x.interval, low, high), [y, y], color=colour, linewidth=0.9)
    panel.plot(x.value, y, **draw.dots(3.6, color=colour))
    outside = (low, "<", x.interval[0] < low), (high, ">", x.interval[1] > high)
    for end, marker, beyond in outside:
        if beyond:
            panel.plot(end, y, marker, color=colour, markersize=4.5, clip_on=False)
