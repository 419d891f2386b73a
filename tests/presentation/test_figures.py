"""Figures show the numbers of their results, in the units that their axes name: artists are looked at."""

import dataclasses
import functools
import re
from unittest import mock

import bench
import numpy as np
import pytest
from altered_fits import with_terms, without_result
from figures import check_texts_apart, lines_of, panels, points_of, strip_of, texts
from matplotlib import pyplot as plt
from matplotlib.figure import Figure
from refusals import refuses
from scipy.signal import lfilter
from scipy.stats import chi2

import allanjax as aj

pytestmark = pytest.mark.usefixtures("no_windows")
HOUR, MICRO_G, DEG_ROOT_HOUR = np.pi / 180.0 / 3600.0, 9.80665e-6, np.pi / 180.0 / 60.0
UNITS = {"gyro": HOUR, "accel": MICRO_G}
NAMES = ("gyro_x", "gyro_y", "gyro_z", "accel_z")


@functools.cache
def of_small(function):
    return function(bench.recording("small"))


# Labels of abscissae, and of ordinates of gyros and accelerometers.
ALLAN = ("cluster time T [s]", "Allan deviation\n[deg/h]", "Allan deviation\n[µg]")
PSD = ("frequency f [Hz]", "one-sided PSD\n[(deg/h)²/Hz]", "one-sided PSD\n[µg²/Hz]")
LABELS = {"allan": ALLAN, "curve": ALLAN, "psd": PSD, "spectrum": PSD}
LABELS["wavelets"] = ("scale [s]", "wavelet variance\n[(deg/h)²]", "wavelet variance\n[µg²]")
LABELS["autocorrelation"] = ("lag [s]", "autocorrelation\n[(deg/h)²]", "autocorrelation\n[µg²]")


def what_draws(plot):
    """What draws all axes, or those that are named; abscissae, values and ends of their 68 % intervals."""
    fit = bench.fit("small")
    if plot in ("allan", "curve"):
        found, x, y = fit.curve, fit.curve.cluster_time, fit.curve.deviation
    elif plot == "autocorrelation":
        found = of_small(aj.autocorrelation)
        return found.plot, found.lag, found.value, None
    elif plot == "wavelets":
        found = of_small(aj.wavelet_variance)
        x, y = found.scale, found.variance
    else:
        found = of_small(aj.power_spectrum)
        x, y = found.frequency, found.density
    draw = {"allan": functools.partial(aj.plot_allan, fit), "psd": functools.partial(aj.plot_psd, found, fit)}
    return draw.get(plot, found.plot), x, y, found.confidence_interval(0.68)


def check_points(panel, plot, k):
    _, x, values, ends = what_draws(plot)
    scale = UNITS[NAMES[k].split("_")[0]] ** (1 if plot in ("allan", "curve") else 2)
    drawn = lines_of(panel)["estimate"] if ends is None else panel.containers[0][0]
    np.testing.assert_allclose(drawn.get_xdata(), x, rtol=1e-12)
    np.testing.assert_allclose(drawn.get_ydata(), values[:, k] / scale, rtol=1e-12)
    if ends is not None:
        bars = np.array(panel.containers[0][2][0].get_segments())[:, :, 1].T
        np.testing.assert_allclose(bars, np.array(ends)[:, :, k] / scale, rtol=1e-9)


@pytest.mark.parametrize("plot", LABELS)
def test_panels_have_the_numbers_of_their_axes_in_their_units(plot, tmp_path):
    draw, (xlabel, gyro, accel) = what_draws(plot)[0], LABELS[plot]
    figure = draw(path=tmp_path / "all.png")
    assert (tmp_path / "all.png").exists()
    found = panels(figure)
    assert tuple(found) == NAMES
    assert xlabel in [axes.get_xlabel() for axes in figure.axes]
    assert (found["gyro_x"].get_ylabel(), found["accel_z"].get_ylabel()) == (gyro, accel)
    if plot != "autocorrelation":
        assert found["gyro_x"].get_ylim() == found["gyro_y"].get_ylim() != found["accel_z"].get_ylim()
    for k, name in enumerate(NAMES):
        check_points(found[name], plot, k)
    assert check_texts_apart(figure) > 4
    own, ax = plt.subplots()
    assert draw("accel_z", ax=ax) is own
    assert (own.axes, ax.get_xlabel(), ax.get_ylabel()) == ([ax], xlabel, accel)
    check_points(ax, plot, 3)
    assert list(panels(draw(["gyro_z"]))) == ["gyro_z"]
    refuses("ax=", draw, ax=ax)
    for axes in (["gyro_q"], []):
        refuses("accel_z", draw, axes)


def model_lines(plot, fit, axis):
    draw = aj.plot_allan if plot == "allan" else functools.partial(aj.plot_psd, of_small(aj.power_spectrum))
    figure = draw(fit, axis)
    return figure, lines_of(panels(figure)[axis])


def test_lines_are_those_of_the_terms_and_of_their_sum():
    """N/√T and K·√(T/3); 2N², and at low frequencies 2K²/(2πf)², as of the rate."""
    fit = bench.fit("small", "N + K")
    N, K = (fit["accel_z"][symbol].value / MICRO_G for symbol in "NK")
    _, lines = model_lines("allan", fit, "accel_z")
    T = lines["model"].get_xdata()
    names = ("velocity random walk", "acceleration random walk", "model")
    white, walk, model = (lines[name].get_ydata() for name in names)
    np.testing.assert_allclose(white, N / np.sqrt(T), rtol=1e-6)
    np.testing.assert_allclose(walk, K * np.sqrt(T / 3.0), rtol=1e-6)
    np.testing.assert_allclose(model, np.hypot(white, walk), rtol=1e-6)
    slopes = {}
    for label, line in lines.items():
        if label.startswith("slope "):
            x, y = np.diff(np.log10(line.get_xydata()), axis=0)[0]
            slopes[label.removeprefix("slope ")] = y / x
    assert slopes == pytest.approx({"−1": -1.0, "−½": -0.5, "0": 0.0, "+½": 0.5, "+1": 1.0})
    _, lines = model_lines("psd", fit, "accel_z")
    f = lines["model"].get_xdata()
    white, walk, model = (lines[name].get_ydata() for name in names)
    np.testing.assert_allclose(white, 2.0 * N**2, rtol=1e-9)
    np.testing.assert_allclose(walk[f < 1.0], 2.0 * (K / (2.0 * np.pi * f[f < 1.0])) ** 2, rtol=2e-3)
    np.testing.assert_allclose(model, white + walk, rtol=1e-9)


def test_strips_show_measured_over_model_in_per_cent():
    fit, spectrum = bench.fit("small", "N + B"), of_small(aj.power_spectrum)
    strip = strip_of(aj.plot_allan(fit, "gyro_y"))
    points = points_of(strip)["residual"][0].get_ydata()
    ratio = fit.curve.deviation[:, 1] / fit.model_deviation("gyro_y", fit.curve.cluster_time)
    np.testing.assert_allclose(points, 100.0 * (ratio - 1.0), atol=1e-9)
    low, high = strip.get_ylim()
    assert low < points.min() < points.max() < high, "all of them are shown"
    residual = points
    points = points_of(strip_of(aj.plot_psd(spectrum, fit, "gyro_y")))["residual"][0].get_ydata()
    # Terms below their limits are not in the line.
    absent = [c.term for c in fit["gyro_y"].coefficients.values() if not c.detected]
    model = fit["gyro_y"].model.without(absent)
    ratio = spectrum.density[:, 1] / (2.0 * np.asarray(model.sampled_psd(spectrum.frequency, 100.0)))
    # The lowest ordinates stand alone; all together, weighted with their ordinates, have one mean.
    np.testing.assert_allclose(points[:4], 100.0 * (ratio[:4] - 1.0), rtol=1e-9)
    ordinate = np.cumsum(spectrum.count) - spectrum.count + 1
    last = np.floor(4 * np.log2(ordinate)) == np.floor(4 * np.log2(ordinate[-1]))
    expected = np.average(ratio[last], weights=spectrum.count[last]) - 1.0
    # White noise and quantization hardly curve within a point.
    assert points[-1] == pytest.approx(100.0 * expected, abs=0.05)
    low, high = ends_of(strip, "chance")
    edf = fit.curve.edf[:, 1]
    # A deviation is the root of a χ² variate over its degrees of freedom.
    np.testing.assert_allclose(low, 100.0 * (np.sqrt(chi2.ppf(0.025, edf) / edf) - 1.0), rtol=1e-6)
    assert np.mean((low < residual) & (residual < high)) > 0.9


def test_the_strip_of_a_narrow_resonance_compares_means_over_its_points():
    """The resonance is fifty times as narrow as a point; its peak is eight thousand times the white level."""
    n, f, quality = 1 << 17, 10.0, 2000.0
    rng, w = np.random.default_rng(5), 2.0 * np.pi * f / 100.0
    r = np.exp(-w / (2.0 * quality))
    y = lfilter([1.0], [1.0, -2.0 * r * np.cos(w), r * r], rng.standard_normal(n))
    x = rng.standard_normal(n) + 3.0 * y / y.std()
    options = {"rate": 100.0, "gyro_unit": "deg/s", "names": ["gyro_x"]}
    figure = aj.plot_psd(aj.power_spectrum(x, **options), aj.fit(x, **options))
    at, residual = points_of(strip_of(figure))["residual"][0].get_data()
    # A sum of some 25 independent values has a relative deviation of a fifth.
    assert np.max(abs(residual[(at > 5.0) & (at < 20.0)])) < 60.0


def test_a_misfit_is_marked_in_the_figure_of_its_curve():
    fit = bench.fit("line", "N + K")
    misfit = fit["gyro_x"].misfit
    figure = fit.plot()
    for panel in (panels(figure)["gyro_x"], strip_of(figure)):
        assert set(lines_of(panel)["worst place"].get_xdata()) == {misfit.at}
    assert str(misfit) in texts(figure)
    other = aj.plot_psd(aj.power_spectrum(bench.recording("line")), fit)
    of_spectrum = fit["gyro_x"].other_misfit
    assert (misfit.unit, of_spectrum.unit) == ("s", "Hz")
    assert set(lines_of(panels(other)["gyro_x"])["worst place"].get_xdata()) == {of_spectrum.at}
    assert fit["gyro_x"].verdict.startswith("does not fit: ")
    assert str(of_spectrum) in texts(other)
    (result,) = fit.results
    moving = dataclasses.replace(fit, results=(result.unmeasured(not_measured=("at rest",)),))
    assert texts(moving.plot()).count("not a measurement") == 1


def test_keys_show_every_coefficient_or_limit():
    """Detected ones beside their lines, too, to 6 % of a deviation; of a spectrum alone N with its band."""
    fit, spectrum = bench.fit("small"), of_small(aj.power_spectrum)
    for figure in (aj.plot_allan(fit), aj.plot_psd(spectrum, fit)):
        shown = texts(figure)
        for result in fit.results:
            for c in (c.in_unit() for c in result.coefficients.values()):
                limit = re.search(r"(?:below|<) (\S+ [^ ,]+)", c.describe())
                text = c.describe() if limit is None or c.rivals else f"{c.title} < {limit[1]}"
                assert text in shown
        assert "3.41" not in shown, "a picture has one N"
    shown = texts(figure := spectrum.plot())
    for name in NAMES:
        walk = spectrum.random_walk(name)
        low, high = walk.band
        assert f"{walk.in_unit().describe()} ({low:.3g} to {high:.3g} Hz)" in shown
        (flat,) = [p for p in panels(figure)[name].patches if p.get_label() == "flat part"]
        assert (flat.get_x(), flat.get_x() + flat.get_width()) == pytest.approx(walk.band)
    tiny = aj.fit(aj.simulate_recording({"gyro_x": "N=5e-5 deg/√h"}, 5000, 100.0, 1), "N + K")
    for of, symbol, begin in ((fit, "N", "N = "), (fit, "B", "B = "), (tiny, "N", "N = ")):
        panel, c = panels(of["gyro_x"].plot())["gyro_x"], of["gyro_x"][symbol].in_unit()
        (written,) = [t.get_text().removeprefix(begin) for t in panel.texts if t.get_text().startswith(begin)]
        number, unit = written.replace("×10⁻⁵", "e-5").split(" ")[:2]
        assert (unit, abs(float(number) - c.value) < 0.06 * c.std) == (c.unit, True)


@pytest.mark.parametrize("plot", ["allan", "psd"])
def test_what_is_not_known_has_no_line(plot):
    figure, lines = model_lines(plot, without_result(bench.fit("small"), "gyro_y"), "gyro_y")
    assert list(points_of(panels(figure)["gyro_y"])) == ["measured"]
    assert "model" not in lines
    assert "no result: the start was hopeless" in texts(figure)
    check_texts_apart(figure)
    fit = bench.fit("small", "N + K")
    *others, last = fit.results
    hidden = dataclasses.replace(last["rate_random_walk"], detected=False, rivals=())
    unsure = dataclasses.replace(last, _coefficients={**last.coefficients, "rate_random_walk": hidden})
    known, not_detected, moving = (
        model_lines(plot, dataclasses.replace(fit, results=(*others, result)), "accel_z")[1]
        for result in (last, unsure, last.unmeasured(not_measured=("at rest",)))
    )
    assert (set(known) - set(not_detected), set(known)) == ({"acceleration random walk"}, set(moving))
    # A term below its limit is not in the model's line, but those of a curve that is no measurement are.
    np.testing.assert_array_equal(moving["model"].get_ydata(), known["model"].get_ydata())
    if plot == "psd":
        alone = not_detected["white noise" if "white noise" in not_detected else "velocity random walk"]
        np.testing.assert_allclose(not_detected["model"].get_ydata(), alone.get_ydata(), rtol=1e-9)
    assert (not_detected["model"].get_ydata() < known["model"].get_ydata()).all()


def test_a_sinusoid_is_a_vertical_line_a_resonance_a_peak_and_a_ramp_is_not_drawn():
    """A Lorentzian of power σ² and full width f0/Q is 2σ²/(π·width) high."""
    line, peak = aj.Sinusoid(60.0 * HOUR, 3.3), aj.Resonance(200.0 * HOUR, 20.0, 2000.0)
    model = aj.AngleRandomWalk(6e-5) + line + peak + aj.DriftRamp(1e-6)
    figure, lines = model_lines("psd", with_terms(bench.fit("small"), {"gyro_x": model}), "gyro_x")
    assert set(lines["sinusoid"].get_xdata()) == {3.3}
    assert "drift ramp" not in lines
    assert "not drawn" in texts(figure)
    height = 2.0 * 200.0**2 / (np.pi * 20.0 / 2000.0)
    assert lines["resonance"].get_ydata().max() == pytest.approx(height, rel=0.05)


def test_several_are_drawn_over_one_another_axis_by_axis():
    fit, shorter = bench.fit("small"), bench.recording("small").between(0.0, 81.92)["gyro_x", "accel_z"]
    axes = (shorter.axes[0], dataclasses.replace(shorter.axes[1], name="accel_x"))
    other = dataclasses.replace(shorter, axes=axes, name="shorter")
    curve = aj.allan_deviation(other)
    found = panels(aj.plot_allan([fit, other, curve], labels=["fit", "recording", "curve"]))
    points = {name: {label: c[0] for label, c in points_of(p).items()} for name, p in found.items()}
    # What was measured once is drawn once.
    both = {"gyro_x": ["fit", "recording, curve"], "accel_x": ["recording, curve"]}
    assert {name: list(p) for name, p in points.items()} == {name: ["fit"] for name in NAMES} | both
    np.testing.assert_allclose(points["gyro_x"]["fit"].get_ydata(), fit.curve.deviation[:, 0] / HOUR)
    drawn = points["accel_x"]["recording, curve"].get_ydata()
    np.testing.assert_allclose(drawn, curve.deviation[:, 1] / MICRO_G)
    line = lines_of(found["gyro_x"])["fit: model"]
    expected = fit.model_deviation("gyro_x", line.get_xdata()) / HOUR
    np.testing.assert_allclose(line.get_ydata(), expected, rtol=1e-9)
    assert "shorter" in texts(aj.plot_allan([fit, other], axes="accel_x"))
    nameless = [dataclasses.replace(fit, name="", objective=of) for of in ("allan", "whittle")]
    assert {"Allan fit: model", "Whittle fit: model"} < {*lines_of(panels(aj.plot_allan(nameless))["gyro_x"])}
    ax = plt.subplots()[1]
    aj.plot_allan([fit, other], ["gyro_x"], labels=["a", "b"], ax=ax)
    assert {t.get_text() for t in ax.get_legend().get_texts()} == {"a", "b", "a: model"}


SAMPLES = np.random.default_rng(0).normal(size=(512, 2))


@pytest.mark.parametrize(
    ("call", "word"),
    [
        (lambda fit: aj.plot_allan([]), "nothing"),
        (lambda fit: aj.plot_allan([fit, fit], labels=["a"]), "labels"),
        (lambda fit: aj.plot_allan(fit, labels=["a"]), "labels="),
        (lambda fit: aj.plot_allan([fit, np.ones(3)]), "ndarray"),
        (lambda fit: aj.plot_allan([fit, aj.allan_deviation(SAMPLES, 1.0, kind="hadamard")]), "hadamard"),
        (lambda fit: aj.plot_allan([fit, aj.allan_deviation(SAMPLES, 1.0)]), "unit"),
        (lambda fit: aj.plot_psd(aj.power_spectrum(SAMPLES, 100.0), fit), "fitted"),
        (lambda fit: aj.plot_psd(dataclasses.replace(of_small(aj.power_spectrum), rate=50.0), fit), "50 Hz"),
    ],
)
def test_what_cannot_be_drawn_together_is_refused(call, word):
    refuses(word, call, bench.fit("small"))


def test_arrays_without_a_unit_have_panels_by_number():
    curve, spectrum = aj.allan_deviation(SAMPLES, 10.0), aj.power_spectrum(SAMPLES, 10.0)
    for figure, label in ((aj.plot_allan(curve), "Allan deviation"), (spectrum.plot(), "one-sided PSD")):
        assert set(panels(figure)) == {"0", "1"}
        assert figure.axes[0].get_ylabel() == label


def test_figures_do_not_pile_up(tmp_path):
    """The user's, one that waits, and the one that is drawn; a saved one is not pyplot's."""
    own, fit = plt.figure(), bench.fit("small")
    for k in range(2):
        saved = fit.plot(["gyro_x"], path=tmp_path / "a.png")
        assert len(plt.get_fignums()) == 1 + k
        assert plt.gcf() is not saved
        fit.plot("gyro_x")
        assert own.number in plt.get_fignums()
    refuses(".gif", fit.plot, path=tmp_path / "a.gif")


@pytest.mark.parametrize("suffix", ["png", "svg", "pdf"])
def test_a_picture_is_drawn_once_in_fixed_places(suffix, tmp_path, monkeypatch):
    """Layout would take most of the time. The picture is small, and its name is no formula."""
    path, named = tmp_path / f"a.{suffix}", dataclasses.replace(bench.fit("small"), name="[/red] x $a$ <b>&")
    monkeypatch.setattr(Figure, "savefig", Figure.savefig.original)
    draws = mock.Mock(side_effect=Figure.draw)
    monkeypatch.setattr(Figure, "draw", lambda *a, **k: draws(*a, **k))
    figure = named.plot("gyro_x", path=path)
    assert (draws.call_count, figure.get_layout_engine()) == (1, None)
    assert 5_000 < path.stat().st_size < 500_000


@pytest.fixture(scope="module")
def posterior():
    return bench.posterior("small", ("gyro_x", "accel_z"))


def ends_of(panel, label):
    """Lower and upper ends of a band, by its abscissae."""
    (band,) = [c for c in panel.collections if label in str(c.get_label())]
    vertices = band.get_paths()[0].vertices
    pairs = [vertices[vertices[:, 0] == x, 1] for x in np.unique(vertices[:, 0])]
    return np.array([[pair.min(), pair.max()] for pair in pairs]).T


def test_the_corner_shows_densities_medians_intervals_and_priors_in_display_units(posterior):
    """Of N: the prior is a density per deg/√h, 1/[(x + scale)·ln(1 + upper/scale)]."""
    axis = posterior["gyro_x"]
    walk, joint, flicker = axis.plot_corner().axes
    assert joint.get_xlabel() == "angle random walk\nN [deg/√h]"
    assert (joint.get_ylabel(), flicker.get_xlabel()) == ("bias instability\nB [deg/h]",) * 2
    for panel, k, unit in ((walk, 0, DEG_ROOT_HOUR), (flicker, 1, HOUR)):
        draws, prior = axis.draws[:, k] / unit, axis.priors[axis.labels[k]]
        marks = [line.get_xdata()[0] for line in panel.get_lines() if line.get_label() != "prior"]
        np.testing.assert_allclose(sorted(marks), np.quantile(draws, [0.16, 0.5, 0.84]))
        x, density = lines_of(panel)["prior"].get_data()
        expected = 1.0 / ((x + prior.scale / unit) * np.log1p(prior.upper / prior.scale))
        np.testing.assert_allclose(density, expected, rtol=1e-9)
        steps = panel.patches[0].get_data()
        assert np.sum(steps.values * np.diff(steps.edges)) == pytest.approx(1.0, abs=5e-3)
    points = axis.draws / [DEG_ROOT_HOUR, HOUR]
    for path, share in zip(joint.collections[-1].get_paths(), (0.95, 0.68), strict=True):
        # Smoothing widens contours a little.
        assert path.contains_points(points).mean() == pytest.approx(share, abs=0.03)
    other = posterior["accel_z"].plot_corner().axes[1]
    assert other.get_xlabel() == "velocity random walk\nN [m/s/√h]"


def test_bands_are_quantiles_of_the_draws_curves_beside_what_was_measured(posterior):
    """Sixty draws against three hundred: three standard errors of a median, four of the ends of 68 %."""
    deviation, density = posterior.plot().axes[2:4]
    assert (deviation.get_xlabel(), deviation.get_ylabel()) == (ALLAN[0], ALLAN[2])
    assert (density.get_xlabel(), density.get_ylabel()) == (PSD[0], PSD[2])
    models = [m.sampled(100.0) for m in posterior["accel_z"].models(60)]
    for panel, at in (
        (deviation, lambda m, x: np.sqrt(np.asarray(m.allan_variance(x))) / MICRO_G),
        (density, lambda m, x: 2.0 * np.asarray(m.sampled_psd(x, 100.0)) / MICRO_G**2),
    ):
        x, y = (values[::40] for values in lines_of(panel)["median"].get_data())
        logs = np.log([at(m, x) for m in models])
        median, spread = np.median(logs, axis=0), logs.std(axis=0)
        assert np.all(abs(np.log(y) - median) < 3.0 * 1.25 * spread * np.sqrt(1 / 60 + 1 / 300))
        for label, z in (("68 %", 0.994), ("95 %", 1.96)):
            # The log of a curve is nearly normal.
            low, high = (np.log(end[::40]) for end in ends_of(panel, label))
            np.testing.assert_allclose((low - median) / spread, -z, atol=0.9)
            np.testing.assert_allclose((high - median) / spread, z, atol=0.9)
    fit, spectrum = bench.fit("small"), aj.power_spectrum(bench.recording("small"))
    deviation, density = posterior.plot(fit, "accel_z", spectrum=spectrum).axes
    points = lines_of(density)["measured"]
    np.testing.assert_allclose(points.get_ydata(), spectrum.density[spectrum.frequency > 0.0, 3] / MICRO_G**2)
    (points,) = [c for c in deviation.containers if c.get_label() == "measured"]
    np.testing.assert_allclose(points[0].get_ydata(), fit.curve.deviation[:, 3] / MICRO_G)
    for axes in (["gyro_q"], []):
        refuses("axis", posterior.plot, axes=axes)


def test_a_filters_bias_has_its_interval_and_innovations_their_scale():
    recording = bench.recording("small")["gyro_x", "accel_z"].between(0.0, 20.48)
    found = aj.kalman_filter(recording, bench.fit("small"))
    axis, (upper, lower) = found["accel_z"], found.plot("accel_z").axes
    assert upper.get_ylabel() == "bias\n[g]"
    line = lines_of(upper)["bias"]
    some = np.isin(axis.time, line.get_xdata())
    np.testing.assert_allclose(line.get_ydata(), axis.bias[some] / 9.80665)
    low, high = ends_of(upper, "95 %")
    wide = 2.0 * 1.959964 * axis.bias_std[some] / 9.80665
    np.testing.assert_allclose((high - low)[10:], wide[10:], rtol=1e-6)
    np.testing.assert_allclose(lower.get_lines()[0].get_ydata(), axis.standardized[: len(axis.samples)])
    refuses("accel_z", found.plot, "gyro_q")


def test_an_autocorrelation_has_the_models_band_and_a_decomposition_a_panel_per_octave():
    model = aj.AngleRandomWalk(6e-5) + aj.Markov(3e-4, 2.0)
    found = aj.autocorrelation(bench.recording("small"), model=model)
    for name, k, scale in (("gyro_y", 1, HOUR**2), ("accel_z", 3, MICRO_G**2)):
        panel, half = panels(found.plot())[name], 1.959964 * found.standard_error[:, k]
        ends = np.array([found.value[:, k] - half, found.value[:, k] + half]) / scale
        np.testing.assert_allclose(ends_of(panel, ""), ends, atol=1e-9 * ends.max())
    found = aj.wavelet_decomposition(bench.recording("small"), levels=6)
    figure = found.plot("gyro_z", [5, 6])
    labels = [axes.get_ylabel() for axes in figure.axes]
    assert labels == ["measured", "level 5\n1.6–3.1 Hz", "level 6\n0.78–1.6 Hz", "below\n0.78 Hz"]
    parts = [found.recording, found.details(5), found.details(6), found.approximation(6)]
    for panel, part in zip(figure.axes, parts, strict=True):
        (time, drawn), values = panel.get_lines()[0].get_data(), part.values[:, 2] / HOUR
        np.testing.assert_array_equal(drawn, values[np.rint(100.0 * time).astype(int)])
        # Each stretch of five samples has its least and its largest one.
        ends = [end(values[:16_380].reshape(-1, 5), axis=1) for end in (np.min, np.max)]
        assert len(drawn) < 8_500
        assert np.isin(ends, drawn).all()
    refuses("gyro_w", found.plot, "gyro_w")


def test_a_figure_for_every_axis_and_one_for_each_finding_on_request(tmp_path):
    critique, steps = bench.critique("lines"), bench.critique("steps")
    figures = critique.plot(tmp_path / "new")
    assert {path.name for path in (tmp_path / "new").iterdir()} == {f"lines_{axis}.png" for axis in critique}
    for axis, shown in zip(critique, figures, strict=True):
        assert [axes.get_xlabel() for axes in shown.axes] == ["cluster time T [s]", "frequency f [Hz]"]
        # Measured points and simulated medians; with findings the points less a line, and other medians.
        assert len(shown.axes[0].get_lines()) == (4 if critique[axis].findings else 2)
        check_texts_apart(shown)
    assert len(steps.plot(findings=steps.findings)) == len(steps.findings)
    finding = next(f for f in critique.findings if f.cause == "sinusoid")
    (figure,) = critique.plot(findings=[finding])
    allan, psd, spectrum = figure.axes
    labels = [axes.get_xlabel() for axes in (allan, psd, spectrum)]
    assert labels == ["cluster time T [s]", "frequency f [Hz]", "frequency f [Hz]"]
    unit = "deg/h" if finding.strongest.axes[0].startswith("gyro") else "µg"
    assert allan.get_ylabel() == f"Allan deviation\n[{unit}]"
    x, y = spectrum.get_lines()[0].get_data()
    assert x[np.argmax(y)] == pytest.approx(finding.parameters["frequency"].value, abs=0.01)
    assert "spectral line" in texts(figure)
    (step,) = steps.plot(findings=steps.findings[:1])
    assert step.axes[2].get_xlabel() == "time since start [s]"
    for each in (figure, step):
        check_texts_apart(each)
