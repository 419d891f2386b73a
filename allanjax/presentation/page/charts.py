"""Charts of a fit for a page: Allan deviation, spectrum, residuals, the record over time, predicted drift."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float

from allanjax.allan.deviation import DynamicAllan, rate_unit
from allanjax.base.wording import duration, percent, plain
from allanjax.comparison.compare import SHOWN, drift
from allanjax.critic.finding import Finding, numbers_in
from allanjax.estimate.result import AxisFit, Fit
from allanjax.navigation.likely import sensors_of
from allanjax.noise.datasheet import MINIMUM
from allanjax.noise.estimate import title_of
from allanjax.noise.terms.deterministic import Transient
from allanjax.presentation import allan_figure, draw, spectrum_figure
from allanjax.presentation.draw import SENSORS, Residual
from allanjax.presentation.page.blocks import Chart, Mark, Span, Trace, View
from allanjax.record.recording import Axis, Recording
from allanjax.record.units import SI, Sensor, rate_unit_of
from allanjax.spectrum.psd import PowerSpectrum, density_unit

# Points at which models are drawn, and blocks of the record over time.
_POINTS, _BLOCKS = 160, 1000
# Every how many of these points terms are drawn, and the least share of a term that is.
_EVERY, _LITTLE = 2, 1e-3
# Layer of what lies by chance about zero, which is hidden at first where there are several axes.
_CHANCE = "95 % by chance"
# Horizons of the predicted drift [s], and their number.
_HORIZONS, _COUNT = (1.0, 36_000.0), 55
# Cluster times that are shown through time.
_SHOWN = 4
# Share of the record from which on a span is not marked, and most marks of single outliers.
_EVERYWHERE, _MOST = 0.95, 200

_Places: TypeAlias = Float[np.ndarray, " m"]
_Columns: TypeAlias = Float[np.ndarray, "m axes"]


def by_sensor(axes: Sequence[Axis]) -> dict[Sensor, list[Axis]]:
    """The axes of each sensor that there is, gyros first."""
    every = {sensor: [axis for axis in axes if axis.sensor == sensor] for sensor in SENSORS}
    return {sensor: own for sensor, own in every.items() if own}


def each(
    axes: Sequence[Axis], title: str, views: Callable[[list[Axis]], Iterable[View]], slider: str = ""
) -> list[Chart]:
    """A chart of each sensor, with the views of its axes."""
    parts = by_sensor(axes).items()
    return [Chart(title.format(SENSORS[of].capitalize()), [*views(own)], slider) for of, own in parts]


def allan(axis: Axis, name: str = "Allan deviation σ(τ)") -> dict[str, Any]:
    """Labels and units of Allan deviations over the cluster time."""
    return _labels((name, "cluster time τ", "s", "σ"), rate_unit(axis), SI[axis.sensor]["rate"])


def psd(axis: Axis) -> dict[str, Any]:
    """Labels and units of one-sided power spectral densities."""
    labels = "PSD S(f)", "frequency f", "Hz", "S"
    return _labels(labels, density_unit(axis), f"({SI[axis.sensor]['rate']})²/Hz")


def over(axis: Axis, name: str = "samples") -> dict[str, Any]:
    """Labels and units of samples over time."""
    labels = name, "time since the start", "s", "samples − mean"
    shown = _labels(labels, rate_unit_of(axis.unit, axis.sensor), SI[axis.sensor]["rate"])
    return {**shown, "log": "", "interval": "least … largest"}


def _labels(labels: Sequence[str], unit: tuple[str, float], si: str) -> dict[str, Any]:
    """Fields of a view; SI is no second unit of itself."""
    named = dict(zip(("name", "x", "x_unit", "y"), labels, strict=True))
    return {**named, "units": [*dict([unit, (si, 1.0)]).items()]}


def curves(fit: Fit) -> list[Chart]:
    """Allan deviations of each sensor with 95 % intervals, models, terms, and points to read coefficients."""
    curve, time = fit.curve, draw.times_of(fit.curve, _POINTS)
    ends = curve.confidence_interval(0.95)

    def views(own: Sequence[Axis]) -> Iterator[View]:
        traces, marks = list[Trace](), list[Mark]()
        for group, axis in enumerate(own):
            k, result = curve.names.index(axis.name), fit[axis.name]
            points = measured(group, k, curve.cluster_time, curve.deviation, ends)
            if result.converged:
                traces += _curve(points, result, curve.rate, time, fit.model_curve(axis.name, time))
            else:
                traces.append(points)
            marks += _marks(result, points)
        yield _view(own, traces, **allan(own[0]), marks=marks, single=True)

    return each(_axes(fit), "{}", views)


def measured(group: int, k: int, x: _Places, y: _Columns, ends: Sequence[_Columns]) -> Trace:
    """The measured points of the axis in column k, with their intervals."""
    low, high = (end[:, k] for end in ends)
    return Trace(group, "measured", x, y[:, k], low, high)


def _axes(fit: Fit) -> list[Axis]:
    """The axes that were fitted."""
    return [result.axis for result in fit.results]


def _view(own: Sequence[Axis], traces: Sequence[Trace], **more: Any) -> View:
    """View of axes; if there are several, it has layers that are hidden at first."""
    layers = {trace.layer for trace in traces}
    hidden = [layer for layer in ("terms", _CHANCE) if layer in layers and len(own) > 1]
    return View(groups=[axis.name for axis in own], traces=traces, hidden=hidden, **more)


def _curve(
    points: Trace, result: AxisFit, rate: float, x: _Places, stated: Iterable[_Places]
) -> Iterator[Trace]:
    """The model at x, its terms, and the measured points, with the largest term at each of them.

    The model is what the fit states: Allan deviations with the ends of their interval, or densities.
    """
    group, (line, *ends) = points.group, stated
    low, high = ends or (None, None)
    at, drawn = (_powers(result, rate, to, bool(ends)) for to in (points.x, x))
    yield Trace(group, "model", x, line, low, high, look="line")
    total = sum(drawn.values())
    for power in drawn.values():
        # Where a term is next to nothing, it would only stretch the scale.
        some = np.flatnonzero(power > _LITTLE * total)[::_EVERY]
        y = power[some]
        yield Trace(group, "terms", x[some], np.sqrt(y) if ends else y, look="dashes")
    titles, words = [title_of(label, result.axis.sensor) for label in at], list[str]()
    for y in np.array([*at.values()]).T:
        k = int(np.argmax(y))
        words.append(f"mostly {titles[k]} ({percent(float(y[k] / max(y.sum(), 1e-300)))})")
    names = list(dict.fromkeys(words))
    yield dataclasses.replace(points, labels=[names.index(word) for word in words], names=names)


def _powers(result: AxisFit, rate: float, x: _Places, is_allan: bool) -> dict[str, _Places]:
    """Allan variances at times, or one-sided densities, of the terms that have one, by labels."""
    found = {}
    for label, term in zip(result.term_labels, result.model.sampled(rate).processes, strict=True):
        if is_allan and not isinstance(term, Transient):
            found[label] = np.asarray(term.allan_variance(x))
        elif not is_allan and not term.deterministic:
            found[label] = 2.0 * np.asarray(term.sampled_psd(x, rate))
    return found


def _marks(result: AxisFit, points: Trace) -> Iterator[Mark]:
    """N at 1 s, K at 3 s, the minimum of the measured curve, and 0.664 B."""
    every = result.coefficients.values() if result.converged else ()
    known = {c.label: c for c in every if c.detected and c.measured and not c.held}
    for label, at in (("angle_random_walk", 1.0), ("rate_random_walk", 3.0)):
        if label in known:
            yield Mark(f"{known[label].symbol} at {at:g} s", at, known[label].value, points.group)
    # The longest times are so uncertain that the lowest of them is lower by chance.
    high: Any = points.high
    lowest = int(np.argmin(np.fmax(high, points.y)))
    at = float(points.x[lowest])
    yield Mark("minimum", at, float(points.y[lowest]), points.group)
    if "bias_instability" in known:
        yield Mark("0.664·B", at, MINIMUM * known["bias_instability"].value, points.group)


def densities(fit: Fit, spectrum: PowerSpectrum, findings: Sequence[Finding]) -> list[Chart]:
    """One-sided PSD with 95 % intervals, models, terms, and the findings that are in the spectrum."""
    ends = spectrum.confidence_interval(0.95)

    def views(own: Sequence[Axis]) -> Iterator[View]:
        traces = list[Trace]()
        for group, axis in enumerate(own):
            k, result = spectrum.names.index(axis.name), fit[axis.name]
            points = measured(group, k, spectrum.frequency, spectrum.density, ends)
            if result.converged:
                f = spectrum_figure.frequencies(spectrum, result.model)
                traces += _curve(points, result, spectrum.rate, f, [fit.stated(axis.name).density(f)])
            else:
                traces.append(points)
        spans = [*_places(findings, own, "frequency", 0.5 * spectrum.rate)]
        yield _view(own, traces, **psd(own[0]), spans=spans)

    return each(_axes(fit), "{}: power spectral density", views)


def _places(findings: Sequence[Finding], axes: Sequence[Axis], domain: str, total: float) -> Iterator[Span]:
    """Where findings on these axes are, in time or frequency; outliers are marked singly."""
    for finding in findings:
        own = [group for group, axis in enumerate(axes) if axis.name in finding.axes]
        start, stop = map(float, finding.span)
        here = own and finding.domain == domain and stop - start < _EVERYWHERE * total
        if here and not numbers_in(finding.details, "times"):
            # Of one axis, or of all that the chart shows.
            group = own[0] if len(own) == 1 < len(axes) else None
            yield Span(finding.named(finding.cause), start, stop, group)


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

    def views(own: Sequence[Axis]) -> Iterator[View]:
        names = [axis.name for axis in own]
        of = [allan_figure.residual(fit.as_for(name), fit.curve.names.index(name)) for name in names]
        yield _residual(own, of, ("Allan deviation", "cluster time τ", "s"))
        if spectrum is not None:
            of = [spectrum_figure.residual(spectrum, spectrum.names.index(name), fit) for name in names]
            yield _residual(own, of, ("PSD", "frequency f", "Hz"))

    known = [axis for axis in _axes(fit) if fit[axis.name].converged]
    return each(known, "{}: measured over model", views)


def _residual(own: Sequence[Axis], residuals: Sequence[Residual], labels: Sequence[str]) -> View:
    """Residuals of axes with their 68 % intervals, and where 95 % of each lie by chance."""
    traces = []
    for group, residual in enumerate(residuals):
        p, (low, high) = residual.points, residual.chance
        traces.append(Trace(group, "residual", p.x, p.y, p.y - p.spread[0], p.y + p.spread[1]))
        traces.append(Trace(group, _CHANCE, p.x, np.zeros_like(p.y), low, high, "dashes"))
    shown = _labels((*labels, "measured/model − 1"), ("%", 1.0), "%")
    return _view(own, traces, **shown, log="x", interval="68 %")


def thinned(group: int, x: Float[np.ndarray, " n"], rate: float, most: int = _BLOCKS) -> Trace:
    """Mean, least and largest sample of each of some blocks, less the mean of all: no sample is missed."""
    first, length = draw.blocks(len(x), most)
    x = np.ascontiguousarray(x) - np.mean(x)
    time = (first + 0.5 * (length - 1)) / rate
    low, high = np.minimum.reduceat(x, first), np.maximum.reduceat(x, first)
    return Trace(group, "mean of blocks", time, np.add.reduceat(x, first) / length, low, high, look="line")


def over_time(recording: Recording, fit: Fit | None, findings: Sequence[Finding]) -> list[Chart]:
    """The samples over time with gaps, what was left out of a fit, and the findings that have a place."""

    def views(own: Sequence[Axis]) -> Iterator[View]:
        traces, marks = list[Trace](), list[Mark]()
        for group, axis in enumerate(own):
            samples = recording.values[:, recording.names.index(axis.name)]
            traces.append(thinned(group, samples, recording.rate))
            marks += _outliers(findings, axis.name, traces[-1])
        spans = [*_parts(recording, fit, own)] if fit is not None else []
        spans += _places(findings, own, "time", recording.duration)
        yield _view(own, traces, **over(own[0]), marks=marks, spans=spans)

    return each(recording.axes, "{} over time", views)


def _parts(recording: Recording, fit: Fit, own: Sequence[Axis]) -> Iterator[Span]:
    """Gaps of the record, what was left out of the fit, and facts about these axes that are at some time."""
    for gap in recording.gaps or ():
        yield Span("gap", gap.first / recording.rate, (gap.first + gap.samples) / recording.rate)
    edges = [0.0, *(t for part in fit.parts for t in part), recording.duration] if fit.parts else []
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        if stop - start > 1.0 / recording.rate:
            yield Span("left out", start, stop)
    for fact in fit.facts:
        for start, stop in fact.spans if any(axis.name in fact.axes for axis in own) else ():
            if stop - start < _EVERYWHERE * recording.duration:
                yield Span(fact.kind, start, stop)


def _outliers(findings: Sequence[Finding], name: str, samples: Trace) -> Iterator[Mark]:
    """Single samples that were found to be outliers."""
    ends = np.array([samples.low, samples.high])
    for finding in (member for f in findings for member in (f.members or (f,))):
        if name in finding.axes and finding.domain == "time":
            for time in numbers_in(finding.details, "times")[:_MOST]:
                k = min(int(np.searchsorted(samples.x, time)), len(samples.x) - 1)
                y = max(ends[:, max(k - 1, 0) : k + 1].flat, key=abs)
                yield Mark("", float(time), float(y), samples.group)


def through_time(dynamic: DynamicAllan, findings: Sequence[Finding]) -> list[Chart]:
    """Allan deviations in successive windows at some cluster times, with the findings that have a place."""
    ends = dynamic.confidence_interval()
    some = np.unique(np.linspace(0, len(dynamic.cluster_time) - 1, _SHOWN).astype(int)).tolist()

    def views(own: Sequence[Axis]) -> Iterator[View]:
        spans = [*_places(findings, own, "time", dynamic.window * len(dynamic.time))]
        for m in some:
            y, *at = (of[:, m] for of in (dynamic.deviation, *ends))
            places = enumerate(map(dynamic.axes.index, own))
            traces = [measured(group, k, dynamic.time, y, at) for group, k in places]
            labels = allan(own[0], f"τ = {plain(dynamic.cluster_time[m], 3)} s")
            yield _view(own, traces, **{**labels, "x": "time since the start"}, spans=spans, log="y")

    return each(dynamic.axes, f"{{}} in windows of {duration(dynamic.window)}", views)


def drifts(fit: Fit) -> list[Chart]:
    """Predicted error of the integrated rate over a horizon, with its interval; √2·t·σ_A(t).

    Axes whose fit had no term that drifts are left out.

    The bias is taken to be the mean over an equally long time before; see `AxisPosterior.predicted_drift`.
    """
    noise, length = sensors_of(fit, None, 0), fit.curve.n / fit.curve.rate
    time = np.geomspace(max(_HORIZONS[0], 2.0 / fit.curve.rate), _HORIZONS[1], _COUNT)

    def views(own: Sequence[Axis]) -> Iterator[View]:
        known = [drift(noise, noise.axes[axis.name], time) for axis in own]
        traces = [Trace(group, "drift", time, *of) for group, of in enumerate(known)]
        word, si = ("angle", "rad") if own[0].sensor == "gyro" else ("velocity", "m/s")
        labels = _labels(("drift", "horizon t", "s", f"{word} error (1σ)"), SHOWN[own[0].sensor], si)
        beyond = Span("beyond half the record: extrapolated", length / 2.0, float(time[-1]))
        yield _view(own, traces, **labels, spans=[beyond] if beyond.start < beyond.stop else [])

    known = [of.axis for of in noise.axes.values() if not of.lacking]
    return each(known, "{}: predicted drift", views, "Horizon")
