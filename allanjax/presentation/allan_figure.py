"""Figures of Allan deviations: of a fit with its model and terms, of several curves, and through time."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Complex

from allanjax.allan.deviation import AllanDeviation, allan_of
from allanjax.base.chi_squared import quantile
from allanjax.base.errors import AllanjaxError
from allanjax.base.wording import duration, without_error
from allanjax.estimate.result import AxisFit, Fit
from allanjax.noise.datasheet import NOT_GIVEN, DataSheet
from allanjax.noise.estimate import Estimate, title_of
from allanjax.noise.terms.deterministic import Transient
from allanjax.presentation import draw
from allanjax.presentation.draw import Heading, KeyEntry, Panel, Points, Residual, Sheet
from allanjax.record.recording import Axis, Recording
from allanjax.record.units import Sensor

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    from allanjax.allan.deviation import DynamicAllan
    from allanjax.comparison.compare import Comparison
    from allanjax.critic.result import Critique
    from allanjax.navigation.rates import SampleRates

#: What can be drawn as an Allan deviation.
Drawable: TypeAlias = Fit | AllanDeviation | Recording | DataSheet
# Cluster times of models without a record [s].
_TIMES_OF_MODEL = np.geomspace(0.01, 1e4, 200)
# Markers by which curves are distinguished in black and white.
_MARKERS = "os^Dv*"


def plot_allan(
    data: Drawable | Sequence[Drawable],
    axes: Sequence[str] | str | None = None,
    path: str | os.PathLike[str] | None = None,
    *,
    labels: Sequence[str] | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw the Allan deviation against cluster time, one panel per axis, gyros above accelerometers.

    Points are the estimates with their 68 % intervals. For a fit, a line is the model that the fit states
    (see `Fit.model_deviation`) in a band of its 95 % interval, broken lines are its terms, with N, B and K
    written on them and all coefficients below the panel, and a strip shows measured
    over model minus one; a grey band in it is the model's own error where the model is incomplete. Deviations
    are in deg/h and µg. Faint lines have the slopes −1, −½, 0, +½ and +1. Several curves are drawn over one
    another, those of axes of one name in one panel, with their models but not the terms.

    Args:
        data: what `fit` or `allan_deviation` returns, a recording, or a data sheet; or several of the first
            three, e.g. two units, or one before and after: what several have measured is drawn once.
        axes: names of the axes to draw, e.g. `["gyro_x", "gyro_z"]`; all of them by default. For the curve of
            an array: `["0", "1", ...]`.
        path: a file to save the picture to, by its suffix .png, .svg or .pdf.
        labels: what to call the curves of several; by default their recordings' names.
        ax: matplotlib axes to draw a single axis into, without title, strip and key.

    Returns:
        The matplotlib figure.

    Raises:
        AllanjaxError: there is no such axis, a curve has no label, or `ax` is given for more than one axis.
    """
    if not isinstance(data, Fit | AllanDeviation | Recording) and isinstance(data, Sequence):
        return _plot_several(data, axes, path, labels, ax)
    if isinstance(data, DataSheet):
        sheet, sensors = data, [*data.models]
        look = _line_of_sheet(sheet, sensors)
        look["label"] += f": {draw.LEAST_KNOWN}" if "linestyle" in look else ""
        heading = Heading(data.name, "from its data sheet", [draw.line_entry(**look)])
        rows = [[k] for k in draw.rows_of(sensors, None, axes)[0]]
        panel_of = lambda k: _panel_of_sheet(sheet, sensors[k])  # noqa: E731
        return draw.draw_panels(heading, draw.CLUSTER_TIME, rows, panel_of, path, ax)
    if labels is not None:
        raise AllanjaxError("labels= names several curves: give them as a list, or leave it out")
    fit, curve = _fit_and_curve(data)
    heading = draw.heading_of(fit, _kind_of(curve), draw.facts_of_curve(curve), axes)
    rows = draw.rows_of(curve.names, curve.axes, axes)
    return draw.draw_panels(heading, draw.CLUSTER_TIME, rows, lambda k: _panel(curve, fit, k), path, ax)


def plot_sample_rates(
    result: SampleRates,
    axes: Sequence[str] | str | None = None,
    path: str | os.PathLike[str] | None = None,
    *,
    how: Literal["picked", "averaged"] = "picked",
) -> Figure:
    """Draw the Allan deviations at each rate over one another, of samples picked or averaged."""
    if how not in ("picked", "averaged"):
        raise AllanjaxError(f'how is "picked" or "averaged", not {how!r}')
    curves = getattr(result, how)
    return plot_allan(curves, axes, path, labels=[f"{curve.rate:g} Hz, {how}" for curve in curves])


def _fit_and_curve(data: Drawable) -> tuple[Fit | None, AllanDeviation]:
    """Fit, if there is one, and Allan deviations of what is to be drawn."""
    if isinstance(data, Fit):
        return data, data.curve
    if isinstance(data, Recording):
        return None, allan_of(data)
    if isinstance(data, AllanDeviation):
        return None, data
    raise AllanjaxError(
        f"cannot draw {type(data).__name__} as an Allan deviation: give a fit, what allan_deviation returns, "
        "or a recording; a data sheet is drawn by itself"
    )


def _kind_of(curve: AllanDeviation) -> str:
    """Name of the curve's statistic, e.g. "Allan deviation"."""
    return {"allan": "Allan", "modified": "modified Allan", "hadamard": "Hadamard"}[curve.kind] + " deviation"


# --- One curve ----------------------------------------------------------------------------------------------


def _panel(curve: AllanDeviation, fit: Fit | None, k: int) -> Panel:
    """Allan deviations of an axis and, of a fit, the model, its terms and residuals."""
    unit, scale = draw.unit_of(None if curve.axes is None else curve.axes[k])
    name, label = curve.names[k], draw.label_in(_kind_of(curve), unit)
    points = [draw.allan_points(curve, k, scale)]
    if fit is None:
        return Panel(name, label, points, _draw_slopes, ())
    result = fit.results[k]
    verdict = draw.verdict_entry(result, "s")
    if not result.converged:
        return Panel(name, label, points, _draw_slopes, [verdict])
    fit = fit.as_for(name)
    absent = " (no Allan variance: not drawn)"
    entries = draw.term_entries(fit, result, lambda term: isinstance(term, Transient), absent, _HEIGHT)

    def fill(panel: Axes) -> None:
        lines, total = _draw_model(panel, fit, result, scale)
        _draw_slopes(panel)
        _write_values(panel, result.coefficients, lines, total)

    strip = residual(fit, k)
    return Panel(name, label, points, fill, [*entries, verdict], strip, draw.worst_place(result, "s"))


def _draw_model(panel: Axes, fit: Fit, result: AxisFit, scale: float) -> tuple[dict[str, Line2D], Line2D]:
    """Draw the model and its terms; returns the lines of the terms by their labels, and the model's."""
    time = draw.times_of(fit.curve)
    styles = draw.term_styles(fit, result)
    lines = {}
    for label, term in zip(result.term_labels, result.model.sampled(fit.curve.rate).processes, strict=True):
        if isinstance(term, Transient):
            continue
        if label in styles:
            y, name = np.sqrt(term.allan_variance(time)) / scale, title_of(label, result.axis.sensor)
            (lines[label],) = panel.plot(time, y, label=name, **styles[label])
    stated, low, high = fit.model_curve(result.axis.name, time) / scale
    panel.fill_between(time, low, high, **draw.model_band())
    return lines, panel.plot(time, stated, **draw.model_line())[0]


def residual(fit: Fit, k: int) -> Residual:
    """Measured deviations over the model's."""
    curve, result = fit.curve, fit.results[k]
    model = fit.model_deviation(result.axis.name, curve.cluster_time)
    measured = draw.allan_points(curve, k)
    points = Points(measured.x, 100.0 * (measured.y / model - 1.0), 100.0 * measured.spread / model)
    edf = curve.edf[:, k]
    chance = np.sqrt(quantile(np.array([[0.025], [0.975]]), edf) / edf) - 1.0
    if not curve.determined:
        chance[:] = np.nan
    return Residual(points, edf > 0.5 / draw.PRECISE**2, 100.0 * chance)


def _line_of_sheet(sheet: DataSheet, sensors: Sequence[Sensor]) -> dict[str, Any]:
    """Style of a data sheet's sum of terms, which is a lower bound if not all of N, B and K are given."""
    return draw.model_line() | (draw.AT_LEAST if any(map(sheet.lacking, sensors)) else {})


def _panel_of_sheet(sheet: DataSheet, sensor: Sensor) -> Panel:
    """Expected Allan deviation of a sensor by its data sheet, and that of its terms."""
    coefficients, model = sheet.coefficients(sensor), sheet[sensor]
    axis = next(iter(coefficients.values())).axis
    unit, scale = draw.unit_of(axis)
    time = _TIMES_OF_MODEL
    curves = [np.sqrt(np.asarray(term.allan_variance(time))) / scale for term in model.terms]
    total, hidden = np.sqrt(np.sum(np.square(curves), axis=0)), {"marker": "none"}
    styles = [draw.line_style(k, 1.3) for k in range(len(curves))]

    def fill(panel: Axes) -> None:
        lines = [panel.plot(time, y, **look)[0] for y, look in zip(curves, styles, strict=True)]
        (sum_line,) = panel.plot(time, total, **_line_of_sheet(sheet, [sensor]))
        _draw_slopes(panel)
        _write_values(panel, coefficients, dict(zip(coefficients, lines, strict=True)), sum_line)

    key = [
        KeyEntry(
            f"{c.title} {c.symbol} = {without_error(x.value, x.std)} {x.unit}{_HEIGHT.get(c.term, '')}", look
        )
        for c, look in zip(coefficients.values(), styles, strict=True)
        for x in (c.in_unit(),)
    ]
    own = [line.removeprefix(f"{sensor}: ") for line in sheet.statements if line.startswith(f"{sensor}: ")]
    key += [KeyEntry(line) for line in own]
    points = Points(time, total, np.zeros((2, len(time))), style=hidden)
    return Panel(sensor, draw.label_in("Allan deviation", unit), [points], fill, key)


# --- Several ------------------------------------------------------------------------------------------------


class _Curve(NamedTuple):
    """One of the curves: its label, the fit that it comes from if any, and the styles of model and points."""

    label: str
    fit: Fit | None
    curve: AllanDeviation
    line: dict[str, Any]
    points: dict[str, Any]

    def result(self, name: str) -> AxisFit | None:
        """Fit of the axis of this name, if it has a result."""
        found = None if self.fit is None else self.fit.results[self.curve.names.index(name)]
        return found if found is not None and found.converged else None


def _plot_several(
    data: Sequence[Drawable],
    axes: Sequence[str] | str | None,
    path: str | os.PathLike[str] | None,
    labels: Sequence[str] | None,
    ax: Axes | None,
) -> Figure:
    """Draw several curves over one another; see `plot_allan`."""
    curves = _curves(data, labels)
    # The axes of all, in the order in which they come.
    known: dict[str, Axis | None] = {}
    for c in curves:
        known |= zip(c.curve.names, c.curve.axes or [None] * len(c.curve.names), strict=True)
    of_curves = [axis for axis in known.values() if axis]
    if of_curves and len(of_curves) < len(known):
        raise AllanjaxError("some curves are of arrays without a unit: draw them separately")
    names, of_axes = list(known), [*known.items()]
    key = [draw.measured_entry(), *([draw.model_entry()] if any(c.fit for c in curves) else [])]
    heading = Heading(_kind_of(curves[0].curve), _facts_of_several([c.curve for c in curves]), key)
    rows = draw.rows_of(names, of_curves or None, axes)

    def panel(k: int) -> Panel:
        return _panel_of_several(curves, *of_axes[k], ax is not None)

    return draw.draw_panels(heading, draw.CLUSTER_TIME, rows, panel, path, ax)


def _facts_of_several(curves: Sequence[AllanDeviation]) -> str:
    """Lengths and rates of the records; of more than two kinds, from the least to the largest."""
    facts = list(dict.fromkeys(map(draw.facts_of_curve, curves)))
    if len(facts) <= 2:
        return "; ".join(facts)
    lengths, rates = sorted(c.n / c.rate for c in curves), sorted(c.rate for c in curves)
    ends = [list(dict.fromkeys(map(duration, (lengths[0], lengths[-1]))))]
    ends.append(list(dict.fromkeys(f"{rate:g}" for rate in (rates[0], rates[-1]))))
    length, rate = (" to ".join(pair) for pair in ends)
    return f"{length} at {rate} Hz"


def _panel_of_several(curves: Sequence[_Curve], name: str, axis: Axis | None, has_legend: bool) -> Panel:
    """Curves of the axes of one name; the legend is for axes of the caller's, which have no key."""
    curves = [c for c in curves if name in c.curve.names]
    unit, scale = draw.unit_of(axis)

    def fill(panel: Axes) -> None:
        for c in curves:
            if c.fit is not None and c.result(name) is not None:
                time = draw.times_of(c.curve)
                y = c.fit.model_deviation(name, time) / scale
                panel.plot(time, y, label=f"{c.label}: model", zorder=2.5, **c.line)
        if has_legend:
            panel.legend(frameon=False)
        _draw_slopes(panel)

    # What was measured once is drawn once, or the last would hide the others.
    points, entries = [], []
    for c in curves:
        same = [o for o in curves if np.array_equal(o.curve[name].deviation, c.curve[name].deviation)]
        entries.append(_entry(c, name, len(same) == 1))
        if c is same[0]:
            own = c.points if len(same) == 1 else {}
            label = ", ".join(o.label for o in same)
            points.append(
                dataclasses.replace(draw.allan_points(c.curve[name], 0, scale), label=label, style=own)
            )
    label = draw.label_in(_kind_of(curves[0].curve), unit)
    return Panel(name, label, points, fill, entries)


def _looks(k: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Styles of the line and of the points of the kth of several curves."""
    colour = draw.COLOURS[k % 6]
    line = {"color": colour, "linestyle": ("-", *draw.DASHES)[k % 6], "linewidth": 1.2}
    return line, {"color": colour, "marker": _MARKERS[k % 6]}


def _curves(data: Sequence[Drawable], labels: Sequence[str] | None) -> list[_Curve]:
    if not data:
        raise AllanjaxError("nothing to draw: give a fit, or several in a list")
    if labels is not None and len(labels) != len(data):
        raise AllanjaxError(f"{len(labels)} labels for {len(data)} curves: give one for each")
    pairs = [_fit_and_curve(x) for x in data]
    kinds = sorted({curve.kind for _, curve in pairs})
    if len(kinds) > 1:
        raise AllanjaxError(f"{' and '.join(kinds)} deviations cannot be compared: draw them separately")
    return [
        _Curve(str(label), fit, curve, *_looks(k))
        for k, (label, (fit, curve)) in enumerate(zip(labels or _labels(data), pairs, strict=True))
    ]


def _labels(data: Sequence[Drawable]) -> list[str]:
    """Names of curves; where one has none or the name of another, with the first by which all differ.

    That is how they were fitted, with which terms, or a number.
    """
    names = [str(getattr(x, "name", "")) for x in data]
    if all(names) and len(set(names)) == len(names):
        return names
    fits = [x if isinstance(x, Fit) else None for x in data]
    kinds = [["measured" if fit is None else f"{fit.objective.capitalize()} fit" for fit in fits]]
    kinds += [["measured" if fit is None else str(fit.template) for fit in fits]]
    kinds += [[str(k) for k in range(1, len(names) + 1)]]
    pairs = next(p for of in kinds if len(set(p := [*zip(names, of, strict=True)])) == len(names))
    return [f"{name} ({kind})" if name else kind for name, kind in pairs]


def _entry(c: _Curve, name: str, own_points: bool) -> KeyEntry:
    """Entry of a curve in the key: its label and, of a fit, the coefficients that were detected.

    It has a marker if the curve has points of its own, whose colour is the line's.
    """
    result, text = c.result(name), c.label
    if c.fit is not None and result is None:
        text += ": no result"
    elif result is not None:
        shown = [x for x in result.coefficients.values() if x.detected and x.term not in result.further]
        values = ", ".join(f"{x.symbol} = {x.in_unit().describe()}" for x in shown) or "nothing detected"
        text += f": {values if result.measured else 'not a measurement of this sensor'}"
    return KeyEntry(text, c.line | c.points | {"markevery": [1], "markersize": 3.5} if own_points else c.line)


def plot_comparison(comparison: Comparison, path: str | os.PathLike[str] | None = None) -> Figure:
    """Draw the Allan deviations of all sensors over one another, one panel per axis.

    Points are measured, with 68 % intervals; lines are models. A data sheet has one line for all axes of a
    sensor, which is dotted, a lower bound, if the sheet does not give all of N, B and K. The key has the
    coefficients.
    """
    # Here, as a comparison imports more than other pictures need.
    from allanjax.comparison.compare import axes_of

    axes = axes_of(comparison.sensors)
    heading = Heading("Comparison", ", ".join(comparison.labels), [draw.measured_entry(), draw.model_entry()])
    rows = draw.rows_of([axis.name for axis in axes], axes, None)
    return draw.draw_panels(
        heading, draw.CLUSTER_TIME, rows, lambda k: _panel_of_sensors(comparison, axes[k]), path, None
    )


def _panel_of_sensors(comparison: Comparison, axis: Axis) -> Panel:
    """Curves and models of all sensors on an axis."""
    unit, scale = draw.unit_of(axis)
    lines, points, key = [], [], []
    for k, one in enumerate(comparison.sensors):
        look, style = _looks(k)
        has_curve = one.curve is not None and axis.name in one.curve.names
        lacking = [] if has_curve else one.lacking(axis.name)
        if has_curve:
            assert one.curve is not None
            own = draw.allan_points(one.curve[axis.name], 0, scale)
            points.append(Points(own.x, own.y, own.spread, one.label, style))
        if (model := one.model(axis.name)) is not None:
            time = one.curve.cluster_time if has_curve and one.curve is not None else _TIMES_OF_MODEL
            if lacking:
                look |= draw.AT_LEAST
            lines.append((time, one.deviation(axis.name, time) / scale, look))
        if model is not None or has_curve:
            known = [c for c in one.of(axis.name).values() if c.is_amplitude and (c.detected or c.held)]
            values = ", ".join(_value(c) for c in known if c.symbol in "NBKQR")
            absent = "not a measurement" if model is None else "nothing detected"
            least = f"; at least: {' and '.join(lacking)} {NOT_GIVEN}" if lacking else ""
            key.append(KeyEntry(f"{one.label}: {values or absent}{least}", look))

    def fill(panel: Axes) -> None:
        for x, y, look in lines:
            panel.plot(x, y, zorder=2.5, **look)
        _draw_slopes(panel)

    if not points:
        hidden = {"marker": "none"}
        points = [Points(x, y, np.zeros((2, len(x))), style=hidden) for x, y, _ in lines]
    return Panel(axis.name, draw.label_in("Allan deviation", unit), points, fill, key)


def _value(c: Estimate) -> str:
    """Symbol and value of a coefficient in its usual unit."""
    return f"{c.symbol} = {c.in_unit().describe().removesuffix(' (held)')}"


SLOPES = {-1.0: "−1", -0.5: "−½", 0.0: "0", 0.5: "+½", 1.0: "+1"}
"""Slopes of quantization, angle random walk, bias instability, rate random walk and ramp, as written."""

# Terms whose coefficient is written on its line.
_WRITTEN = ("angle_random_walk", "bias_instability", "rate_random_walk")
# What the key says of a line whose height at 1 s is not the coefficient's.
_HEIGHT = {"bias_instability": " (line\u00a0at\u00a00.664\u00a0B)"}
_SIZE = 7.0
# Half the mean width of a character, and distance of a text from its line, over the font's size.
_HALF_WIDTH, _AWAY = 0.3, 0.95
# Distances from a text to other lines, and to other texts, that are as good as larger ones [pixels].
_CLEAR, _APART = 45.0, 110.0


def _draw_slopes(panel: Axes) -> None:
    """Draw faint lines of the slopes through the middle of a panel whose scales are set."""
    (left, right), (bottom, top) = (np.log10(ends) for ends in (panel.get_xlim(), panel.get_ylim()))
    x0, y0 = (left + right) / 2.0, (bottom + top) / 2.0
    for slope, name in SLOPES.items():
        # Where it leaves the panel.
        reach = min((right - left) / 2.0, np.inf if slope == 0.0 else (top - bottom) / 2.0 / abs(slope))
        ends = np.array([-reach, reach])
        look: dict[str, Any] = {
            "color": draw.ink(0.78),
            "linewidth": 0.7,
            "linestyle": (0, (1, 4)),
            "zorder": 0.5,
        }
        panel.plot(10.0 ** (x0 + ends), 10.0 ** (y0 + slope * ends), label=f"slope {name}", **look)
        end = 0.93 * reach
        box = {"facecolor": draw.ink(1.0), "edgecolor": "none", "pad": 0.6}
        style: dict[str, Any] = {"color": draw.ink(0.55), "fontsize": _SIZE, "zorder": 0.6, "bbox": box}
        panel.text(10.0 ** (x0 + end), 10.0 ** (y0 + slope * end), name, ha="center", va="center", **style)


def _write_values(
    panel: Axes, coefficients: Mapping[str, Estimate], drawn: Mapping[str, Line2D], total: Line2D
) -> None:
    """Write N, B and K with their units on the lines `drawn` of their terms, away from the other terms.

    A text is on that side of its line where the model's is not.
    """
    from matplotlib.patheffects import withStroke

    look: dict[str, Any] = {"fontsize": _SIZE, "rotation_mode": "anchor", "ha": "center", "va": "center"}
    look |= {"path_effects": [withStroke(linewidth=1.5, foreground=draw.ink(1.0))], "zorder": 4}
    size = _SIZE * panel.figure.dpi / 72.0
    lower, upper = complex(*panel.bbox.p0), complex(*panel.bbox.p1)
    lines = {label: _pixels(panel, line) for label, line in drawn.items()}
    model, texts = _pixels(panel, total), [np.complex128(1e9)]
    for label, z in lines.items():
        c = coefficients.get(label)
        if c is None or c.term not in _WRITTEN or not c.detected:
            continue
        shown = c.in_unit()
        text = f"{c.symbol} = {without_error(shown.value, shown.std)} {shown.unit}"
        turn = np.gradient(z)
        turn = turn / abs(turn)
        middle = z + 1j * turn * np.where(model.imag >= z.imag, -_AWAY, _AWAY) * size
        half = _HALF_WIDTH * len(text) * size * turn
        ends = np.stack([middle - half - lower, middle + half - lower])
        ends = np.concatenate([ends, upper - lower - ends])
        inside = np.minimum(ends.real, ends.imag).min(axis=0) > size
        others = np.concatenate([own for other, own in lines.items() if other != label] or [np.array(texts)])
        score = np.minimum(abs(middle[:, None] - others).min(axis=1), _CLEAR)
        score += np.minimum(abs(middle[:, None] - np.array(texts)).min(axis=1), _APART)
        score -= 0.1 * abs(middle.real - (lower + upper).real / 2.0)
        if inside.any():
            texts.append(at := middle[k := np.argmax(np.where(inside, score, -np.inf))])
            x, y = panel.transData.inverted().transform((at.real, at.imag))
            angle = float(np.degrees(np.angle(turn[k])))
            panel.text(x, y, text, color=drawn[label].get_color(), rotation=angle, **look)


def _pixels(panel: Axes, line: Line2D) -> Complex[np.ndarray, " points"]:
    """Points of a line on the screen, x + iy in pixels."""
    return panel.transData.transform(np.asarray(line.get_xydata())) @ (1.0, 1.0j)


# --- Through time -------------------------------------------------------------------------------------------

_DYNAMIC = Sheet(4.2, 2.4, right=1.1)
# Factor from the median at which the colours end.
_FACTOR, _TICKS = 2.0, (0.5, 0.7, 1.0, 1.4, 2.0)


def plot_dynamic(
    dynamic: DynamicAllan,
    path: str | os.PathLike[str] | None = None,
    *,
    critique: Critique | None = None,
) -> Figure:
    """Draw the Allan deviation of each window over that of the median window, one panel per axis.

    Colours are the ratio on a logarithmic scale. Broken lines are the steps and the beginnings and ends of
    changes that a critique of the record found on the axis.
    """
    from matplotlib.colors import LogNorm

    names = dynamic.names
    key = [draw.line_entry(**_change(), label="found by the critique")] if critique is not None else []
    facts = f"{len(dynamic.time)} windows of {duration(dynamic.window)}"
    heading = Heading(f"{dynamic.name}: Allan deviation through time".removeprefix(": "), facts, key)
    across = min(3, len(names))
    rows = [min(across, len(names) - k) for k in range(0, len(names), across)]
    ratio = dynamic.deviation / np.median(dynamic.deviation, axis=0)
    edges = np.append(dynamic.time - 0.5 * dynamic.window, dynamic.time[-1] + 0.5 * dynamic.window)
    scale = LogNorm(1.0 / _FACTOR, _FACTOR)
    with draw.style():
        figure, panels = _DYNAMIC.draw(heading, rows, path)
        for k, panel in enumerate(panel for row in panels for panel in row):
            draw.dress(panel, names[k], draw.TIME, draw.CLUSTER_TIME, log="y")
            step = (dynamic.cluster_time[-1] / dynamic.cluster_time[0]) ** (
                0.5 / (len(dynamic.cluster_time) - 1)
            )
            heights = np.append(dynamic.cluster_time / step, dynamic.cluster_time[-1] * step)
            shown = panel.pcolormesh(
                edges, heights, ratio[:, :, k].T, norm=scale, cmap="RdBu_r", rasterized=True
            )
            for time in _changes(critique, names[k]):
                panel.axvline(time, **_change())
        place = panels[0][-1].get_position()
        bar = figure.colorbar(shown, figure.add_axes((place.x1 + 0.01, place.y0, 0.012, place.height)))
        bar.set_ticks(_TICKS, labels=[f"{tick:g}" for tick in _TICKS], minor=False)
        bar.ax.minorticks_off()
        bar.set_label("deviation over the median")
    return draw.saved(figure, path)


def _change() -> dict[str, Any]:
    """Style of a time at which a critique found a change."""
    return {"color": draw.ink(), "linestyle": "--", "linewidth": 0.9}


def _changes(critique: Critique | None, axis: str) -> list[float]:
    """Times within the record at which findings on an axis begin or end [s]."""
    if critique is None:
        return []
    spans = [f.span for f in critique.findings if f.domain == "time" and axis in f.axes]
    return sorted({float(t) for span in spans for t in span if 0.0 < t < 0.999 * critique.duration})
