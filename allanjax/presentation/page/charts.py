"""Charts of a fit for a page: Allan deviation, spectrum, residuals, the record over time, predicted drift."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float

from allanjax.allan.deviation import DynamicAllan, rate_unit
from allanjax.base.wording import duration, percent, plain
from allanjax.comparison.compare import SHOWN, drift
from allanjax.critic.finding import Finding, numbers_in
from allanjax.critic.result import Critique
from allanjax.estimate.result import AxisFit, Fit
from allanjax.navigation.likely import sensors_of
from allanjax.noise.datasheet import MINIMUM
from allanjax.noise.estimate import title_of
from allanjax.noise.process import Process
from allanjax.presentation import allan_figure, draw, spectrum_figure
from allanjax.presentation.draw import SENSORS, Residual
from allanjax.presentation.page.blocks import Chart, Mark, Span, Trace, View
from allanjax.record.recording import Axis, Recording
from allanjax.record.units import SI, Sensor, rate_unit_of
from allanjax.spectrum.psd import PowerSpectrum, density_unit

# Points at which models are drawn, every how many of them its terms are, the least share of a term that is
# drawn, and blocks of the record over time.
_POINTS, _EVERY, _LITTLE, _BLOCKS = 160, 2, 1e-3, 1000
# Horizons of the predicted drift [s], and their number.
_HORIZONS, _COUNT = (1.0, 36_000.0), 55
# Cluster times that are shown through time.
_SHOWN = 4
# Share of the record from which on a span is not marked, and most marks of single outliers.
_EVERYWHERE, _MOST = 0.95, 200

_Places: TypeAlias = Float[np.ndarray, " m"]


class Own(NamedTuple):
    """An axis of a chart: its number in the fit, and in the chart."""

    k: int
    group: int
    axis: Axis


def by_sensor(axes: Sequence[Axis]) -> Iterator[tuple[Sensor, list[Own]]]:
    """The axes of each sensor that there is, gyros first."""
    for sensor in SENSORS:
        own = [(k, axis) for k, axis in enumerate(axes) if axis.sensor == sensor]
        if own:
            yield sensor, [Own(k, group, axis) for group, (k, axis) in enumerate(own)]


def _view(
    own: Sequence[Own],
    labels: tuple[str, str, str, str],
    units: Sequence[tuple[str, float]],
    traces: Sequence[Trace],
    **more: Any,
) -> View:
    """View of axes; terms are hidden at first where there are several. SI is no second unit of itself."""
    hidden = ["terms"] if len(own) > 1 and any(trace.layer == "terms" for trace in traces) else []
    names = [axis.name for *_, axis in own]
    return View(*labels, units=[*dict(units).items()], groups=names, traces=traces, hidden=hidden, **more)


def curves(fit: Fit) -> list[Chart]:
    """Allan deviations of each sensor."""
    charts = []
    for sensor, own in by_sensor([r.axis for r in fit.results]):
        summary = f"Allan deviation of {', '.join(a.name for *_, a in own)}; the table has the coefficients."
        charts.append(Chart(SENSORS[sensor].capitalize(), [_allan(fit, own)], summary))
    return charts


def densities(fit: Fit, spectrum: PowerSpectrum, findings: Sequence[Finding]) -> list[Chart]:
    """Power spectral densities of each sensor."""
    return [
        Chart(
            f"{SENSORS[sensor].capitalize()}: power spectral density",
            [_density(fit, spectrum, own, findings)],
        )
        for sensor, own in by_sensor([r.axis for r in fit.results])
    ]


def _allan(fit: Fit, own: Sequence[Own]) -> View:
    """Allan deviations with 95 % intervals, models, terms, and the points at which coefficients are read."""
    curve, axis = fit.curve, own[0].axis
    low, high = curve.confidence_interval(0.95)
    time = draw.times_of(curve, _POINTS)
    traces, marks = list[Trace](), list[Mark]()
    for k, group, _ in own:
        points = (curve.cluster_time, curve.deviation[:, k], low[:, k], high[:, k])
        result = fit.results[k]
        stated = list(fit.model_curve(result.axis.name, time)) if result.converged else []
        traces += _curve(group, result, curve.rate, points, time, _variance, np.sqrt, stated)
        marks += _marks(fit, k, group)
    units = (rate_unit(axis), (SI[axis.sensor]["rate"], 1.0))
    return _view(
        own, ("Allan deviation σ(τ)", "cluster time τ", "s", "σ"), units, traces, marks=marks, single=True
    )


def _variance(term: Process, time: _Places, rate: float) -> Any:
    """Allan variance of a term; None of one that has none."""
    return None if isinstance(term, allan_figure.Transient) else term.allan_variance(time)


def _psd(term: Process, frequency: _Places, rate: float) -> Any:
    """One-sided density of a term; None of one that has none."""
    return None if term.deterministic else 2.0 * np.asarray(term.sampled_psd(frequency, rate))


def _curve(
    group: int,
    result: AxisFit,
    rate: float,
    points: tuple[_Places, _Places, _Places, _Places],
    x: _Places,
    of_term: Callable[[Process, _Places, float], Any],
    shown: np.ufunc,
    stated: Sequence[_Places],
) -> Iterator[Trace]:
    """The model at x, its terms, and the measured points, with the largest term at each of them.

    The model is what the fit states, perhaps with the ends of its interval. What is `shown` of a term is a
    function of what `of_term` gives.
    """
    if not result.converged:
        yield Trace(group, "measured", *points)
        return
    processes = dict(zip(result.term_labels, result.model.sampled(rate).processes, strict=True))
    there = {label: term for label, term in processes.items() if of_term(term, x[:1], rate) is not None}
    at, drawn = (
        np.reshape([np.asarray(of_term(term, to, rate)) for term in there.values()], (-1, len(to)))
        for to in (points[0], x)
    )
    total = drawn.sum(axis=0)
    line, *ends = stated
    low, high = ends or (None, None)
    yield Trace(group, "model", x, line, low, high, "line")
    for power in drawn:
        # Where a term is next to nothing, it would only stretch the scale.
        some = np.flatnonzero(power > _LITTLE * total)[::_EVERY]
        yield Trace(group, "terms", x[some], shown(power[some]), look="dashes")
    largest = np.argmax(at, axis=0) if len(at) else []
    share = np.max(at, axis=0, initial=0.0) / np.maximum(at.sum(axis=0), 1e-300)
    titles = [title_of(label, result.axis.sensor) for label in there]
    words = [f"mostly {titles[k]} ({percent(float(s))})" for k, s in zip(largest, share, strict=False)]
    names = list(dict.fromkeys(words))
    yield Trace(group, "measured", *points, labels=[names.index(word) for word in words], names=names)


def _marks(fit: Fit, k: int, group: int) -> Iterator[Mark]:
    """N at 1 s, K at 3 s, the minimum of the curve, and 0.664 B."""
    curve, result = fit.curve, fit.results[k]
    every = result.coefficients.values() if result.converged else ()
    known = {c.label: c for c in every if c.detected and c.measured and not c.held}
    for label, at in (("angle_random_walk", 1.0), ("rate_random_walk", 3.0)):
        if (c := known.get(label)) is not None:
            yield Mark(f"{c.symbol} at {at:g} s", at, c.value, group)
    # The longest times are so uncertain that the lowest of them is lower by chance.
    lowest = int(np.argmin(curve.confidence_interval(0.95)[1][:, k]))
    at = float(curve.cluster_time[lowest])
    yield Mark("minimum", at, float(curve.deviation[lowest, k]), group)
    if (c := known.get("bias_instability")) is not None:
        yield Mark("0.664·B", at, MINIMUM * c.value, group)


def _density(fit: Fit, spectrum: PowerSpectrum, own: Sequence[Own], findings: Sequence[Finding]) -> View:
    """One-sided PSD with 95 % intervals, models, terms, and the findings that are in the spectrum."""
    low, high = spectrum.confidence_interval(0.95)
    traces, names = list[Trace](), [a.name for *_, a in own]
    for _, group, axis in own:
        k, result = spectrum.names.index(axis.name), fit[axis.name]
        x = spectrum.frequency
        if result.converged:
            x = spectrum_figure.frequencies(spectrum, result.model)
        points = (spectrum.frequency, spectrum.density[:, k], low[:, k], high[:, k])
        stated = [fit.model_density(axis.name, x)] if result.converged else []
        traces += _curve(group, result, spectrum.rate, points, x, _psd, np.positive, stated)
    unit = SI[own[0].axis.sensor]["rate"]
    units = (density_unit(own[0].axis), (f"({unit})²/Hz", 1.0))
    spans = [_span(f, names) for f in findings if _is_within(f, names, 0.5 * spectrum.rate)]
    return _view(own, ("PSD S(f)", "frequency f", "Hz", "S"), units, traces, spans=spans)


def _is_within(finding: Finding, names: Sequence[str], highest: float) -> bool:
    """Whether a finding is on one of these axes and in a part of the spectrum."""
    start, stop = finding.span
    here = finding.domain == "frequency" and {*finding.axes} & {*names}
    return bool(here) and stop - start < _EVERYWHERE * highest


def _span(finding: Finding, names: Sequence[str]) -> Span:
    """Where a finding is; of one axis, or of all that the chart shows."""
    own = [names.index(name) for name in finding.axes if name in names]
    start, stop = (float(x) for x in finding.span)
    return Span(finding.named(finding.cause), start, stop, own[0] if len(own) == 1 < len(names) else None)


def line(frequency: float, axes: str, amplitude: float, strongest: AxisFit) -> str:
    """A spectral line in words, with its power over that of the rest of the axis on which it is strongest."""
    power = 0.5 * amplitude**2
    ratio = power / (strongest.rms**2 - power)
    text = f"a spectral line at {plain(frequency, 4)} Hz on {axes}"
    if not ratio > 0.0:
        return text
    return f"{text}, {f'{plain(ratio, 2)} times' if ratio > 1.0 else percent(ratio)} its noise power"


def residuals(fit: Fit, spectrum: PowerSpectrum | None) -> list[Chart]:
    """Measured over model minus one, of Allan deviations and of the spectra."""
    charts = []
    for sensor, every in by_sensor([r.axis for r in fit.results]):
        own = [one for one in every if fit.results[one.k].converged]
        if not own:
            continue
        names = [axis.name for *_, axis in own]
        of = [allan_figure.residual(fit.as_for(axis.name), k) for k, _, axis in own]
        views = [_residual_view("Allan deviation", ("cluster time τ", "s"), names, of)]
        if spectrum is not None:
            place = {name: k for k, name in enumerate(spectrum.names)}
            of = [spectrum_figure.residual(spectrum, place[name], fit) for name in names]
            views.append(_residual_view("PSD", ("frequency f", "Hz"), names, of))
        charts.append(Chart(f"{SENSORS[sensor].capitalize()}: measured over model", views))
    return charts


def _residual_view(
    name: str, x: tuple[str, str], names: Sequence[str], residuals: Sequence[Residual]
) -> View:
    """Residuals of axes with their 68 % intervals, and where 95 % of each lie by chance."""
    traces, chance = list[Trace](), "95 % by chance"
    for group, residual in enumerate(residuals):
        p = residual.points
        traces.append(Trace(group, "residual", p.x, p.y, p.y - p.spread[0], p.y + p.spread[1]))
        low, high = residual.chance
        traces.append(Trace(group, chance, p.x, np.zeros_like(p.y), low, high, look="dashes"))
    hidden = [chance] if len(names) > 1 else []
    labels = (name, *x, "measured/model − 1")
    return View(
        *labels, units=[("%", 1.0)], groups=names, traces=traces, log="x", interval="68 %", hidden=hidden
    )


class Series(NamedTuple):
    """An axis of a record over time, less its mean: ends and means of blocks."""

    time: Float[np.ndarray, " blocks"]
    low: Float[np.ndarray, " blocks"]
    mean: Float[np.ndarray, " blocks"]
    high: Float[np.ndarray, " blocks"]


def thinned(x: Float[np.ndarray, " n"], rate: float, most: int = _BLOCKS) -> Series:
    """Least, mean and largest sample of each of some blocks, so that no sample is missed."""
    first, length = draw.blocks(len(x), most)
    x = np.ascontiguousarray(x) - np.mean(x)
    time = (first + 0.5 * (length - 1)) / rate
    return Series(
        time, np.minimum.reduceat(x, first), np.add.reduceat(x, first) / length, np.maximum.reduceat(x, first)
    )


def over_time(recording: Recording, fit: Fit, critique: Critique | None) -> list[Chart]:
    """The samples over time with gaps, and parts that were left out or the findings that have a place.

    With a critique the recording is what was criticized.
    """
    findings = () if critique is None else critique.findings
    charts = []
    for sensor, own in by_sensor(recording.axes):
        names, traces, marks = [axis.name for *_, axis in own], list[Trace](), list[Mark]()
        for k, group, _ in own:
            s = thinned(recording.values[:, k], recording.rate)
            traces.append(Trace(group, "mean of blocks", s.time, s.mean, s.low, s.high, look="line"))
            marks += _outliers(findings, names[group], group, s)
        labels = ("samples", "time since the start", "s", "samples − mean")
        units = (rate_unit_of(own[0].axis.unit, sensor), (SI[sensor]["rate"], 1.0))
        spans = [*_parts(recording, fit, names)] if critique is None else []
        spans += _places(findings, names, recording.duration)
        more = {"marks": marks, "spans": spans, "log": "", "interval": "least … largest"}
        views = [_view(own, labels, units, traces, **more)]
        summary = f"Least and largest sample of each of {len(traces[0].x)} blocks."
        charts.append(Chart(f"{SENSORS[sensor].capitalize()} over time", views, summary))
    return charts


def _parts(recording: Recording, fit: Fit, names: Sequence[str]) -> Iterator[Span]:
    """Gaps of the record, what was left out of the fit, and facts about these axes that are at some time."""
    for gap in recording.gaps or ():
        yield Span("gap", gap.first / recording.rate, (gap.first + gap.samples) / recording.rate)
    edges = [0.0, *(t for part in fit.parts for t in part), recording.duration] if fit.parts else []
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        if stop - start > 1.0 / recording.rate:
            yield Span("left out", start, stop)
    for fact in fit.facts:
        for start, stop in fact.spans if {*fact.axes} & {*names} else ():
            if stop - start < _EVERYWHERE * recording.duration:
                yield Span(fact.kind, start, stop)


def _places(findings: Sequence[Finding], names: Sequence[str], total: float) -> Iterator[Span]:
    """Findings on these axes that are at some time; outliers are marked singly."""
    for finding in findings:
        if finding.domain == "time" and {*finding.axes} & {*names}:
            span = _span(finding, names)
            if span.stop - span.start < _EVERYWHERE * total and not numbers_in(finding.details, "times"):
                yield span


def _outliers(findings: Sequence[Finding], name: str, group: int, s: Series) -> Iterator[Mark]:
    """Single samples that were found to be outliers."""
    for finding in (member for f in findings for member in (f.members or (f,))):
        if name in finding.axes and finding.domain == "time":
            for time in numbers_in(finding.details, "times")[:_MOST]:
                k = int(np.clip(np.searchsorted(s.time, time), 0, len(s.time) - 1))
                near = slice(max(k - 1, 0), k + 1)
                y = max((*s.low[near], *s.high[near]), key=abs)
                yield Mark("", float(time), float(y), group)


def through_time(dynamic: DynamicAllan, critique: Critique | None) -> list[Chart]:
    """Allan deviations in successive windows at some cluster times, with the findings that have a place."""
    charts, (low, high) = [], dynamic.confidence_interval()
    some = np.unique(np.linspace(0, len(dynamic.cluster_time) - 1, _SHOWN).astype(int)).tolist()
    findings, total = () if critique is None else critique.findings, dynamic.window * len(dynamic.time)
    for sensor, own in by_sensor(dynamic.axes):
        units, views = (rate_unit(own[0].axis), (SI[sensor]["rate"], 1.0)), []
        spans = list(_places(findings, [axis.name for *_, axis in own], total))
        for m in some:
            value, least, most = (y[:, m] for y in (dynamic.deviation, low, high))
            traces = [
                Trace(group, "measured", dynamic.time, value[:, k], least[:, k], most[:, k])
                for k, group, _ in own
            ]
            labels = (f"τ = {plain(dynamic.cluster_time[m], 3)} s", "time since the start", "s", "σ")
            views.append(_view(own, labels, units, traces, spans=spans, log="y"))
        title = f"{SENSORS[sensor].capitalize()} in windows of {duration(dynamic.window)}"
        charts.append(Chart(title, views))
    return charts


def drifts(fit: Fit) -> list[Chart]:
    """Predicted error of the integrated rate over a horizon, with its interval; √2·t·σ_A(t).

    The bias is taken to be the mean over an equally long time before; see `AxisPosterior.predicted_drift`.
    """
    noise, length = sensors_of(fit, None, 0), fit.curve.n / fit.curve.rate
    time = np.geomspace(max(_HORIZONS[0], 2.0 / fit.curve.rate), _HORIZONS[1], _COUNT)
    charts = []
    for sensor, own in by_sensor([of.axis for of in noise.axes.values()]):
        traces = []
        for _, group, axis in own:
            traces.append(Trace(group, "drift", time, *drift(noise, noise.axes[axis.name], time)))
        word = "angle" if sensor == "gyro" else "velocity"
        beyond = Span("beyond half the record: extrapolated", length / 2.0, float(time[-1]))
        labels = ("drift", "horizon t", "s", f"{word} error (1σ)")
        units = (SHOWN[sensor], ("rad" if sensor == "gyro" else "m/s", 1.0))
        view = _view(own, labels, units, traces, spans=[beyond] if beyond.start < beyond.stop else [])
        charts.append(Chart(f"{SENSORS[sensor].capitalize()}: predicted drift", [view], slider="Horizon"))
    return charts
