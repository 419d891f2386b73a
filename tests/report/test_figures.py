"""Figures show the numbers of their results, in the units that their axes name: artists are looked at."""

import dataclasses
import functools

import bench
import numpy as np
import pytest
from altered_fits import with_terms, without_result
from figures import check_texts_apart, lines_of, panels, points_of, strip_of, texts
from matplotlib import pyplot as plt

import allanjax as aj

pytestmark = pytest.mark.usefixtures("no_windows")
HOUR, MICRO_G = np.pi / 180.0 / 3600.0, 9.80665e-6
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
    with pytest.raises(aj.AllanjaxError, match="ax="):
        draw(ax=ax)
    for axes in (["gyro_q"], []):
        with pytest.raises(aj.AllanjaxError, match="accel_z"):
            draw(axes)


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
    names = ("velocity random walk", "rate random walk", "model")
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
    fit, spectrum = bench.fit("small"), of_small(aj.power_spectrum)
    strip = strip_of(aj.plot_allan(fit, "gyro_y"))
    points = points_of(strip)["residual"][0].get_ydata()
    ratio = fit.curve.deviation[:, 1] / fit.model_deviation("gyro_y", fit.curve.cluster_time)
    np.testing.assert_allclose(points, 100.0 * (ratio - 1.0), atol=1e-9)
    beyond = [len(line.get_xdata()) for line in strip.get_lines() if line.get_label() == "beyond the strip"]
    assert sum(beyond) == (abs(points) > strip.get_ylim()[1]).sum()
    points = points_of(strip_of(aj.plot_psd(spectrum, fit, "gyro_y")))["residual"][0].get_ydata()
    model = fit["gyro_y"].model.sampled(100.0)
    ratio = spectrum.density[:, 1] / (2.0 * np.asarray(model.sampled_psd(spectrum.frequency, 100.0)))
    # The lowest ordinates stand alone; all together, weighted with their ordinates, have one mean.
    np.testing.assert_allclose(points[:4], 100.0 * (ratio[:4] - 1.0), rtol=1e-9)
    ordinate = np.cumsum(spectrum.count) - spectrum.count + 1
    last = np.floor(4 * np.log2(ordinate)) == np.floor(4 * np.log2(ordinate[-1]))
    expected = np.average(ratio[last], weights=spectrum.count[last]) - 1.0
    assert points[-1] == pytest.approx(100.0 * expected, rel=1e-9)
    fit = bench.fit("line", "N + K")
    strip, off = strip_of(fit.plot()), 100.0 * fit["gyro_x"].misfit.rms
    (band,) = strip.patches
    np.testing.assert_allclose(band.get_path().get_extents(band.get_patch_transform()).intervaly, [-off, off])
    assert 3.0 < off < strip.get_ylim()[1]


def test_keys_tell_every_coefficient_or_limit():
    """Detected ones beside their lines, too, to 6 % of a deviation; of a spectrum N with its band."""
    fit, spectrum = bench.fit("small"), of_small(aj.power_spectrum)
    for figure in (aj.plot_allan(fit), aj.plot_psd(spectrum, fit)):
        shown = " ".join(" ".join(texts(figure)).split())
        for result in fit.results:
            assert all(c.in_unit().describe() in shown for c in result.coefficients.values())
    for name in NAMES:
        walk = spectrum.random_walk(name)
        low, high = walk.band
        assert f"{walk.in_unit().describe()} ({low:.3g} to {high:.3g} Hz)" in shown
        (flat,) = [p for p in panels(figure)[name].patches if p.get_label() == "flat part"]
        assert (flat.get_x(), flat.get_x() + flat.get_width()) == pytest.approx(walk.band)
    panel = panels(aj.plot_allan(fit))["gyro_x"]
    for symbol, begin in (("N", "N = "), ("B", "0.664 B, B = ")):
        c = fit["gyro_x"][symbol].in_unit()
        (told,) = [t.get_text().removeprefix(begin) for t in panel.texts if t.get_text().startswith(begin)]
        assert told.split(" ")[1] == c.unit
        assert abs(float(told.split(" ")[0]) - c.value) < 0.06 * c.std


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
        for result in (last, unsure, last.unmeasured(moving=True))
    )
    # The model is the sum of its terms as before.
    assert (set(known) - set(not_detected), set(known)) == ({"rate random walk"}, set(moving))
    np.testing.assert_array_equal(not_detected["model"].get_ydata(), known["model"].get_ydata())


def test_a_sinusoid_is_a_vertical_line_a_resonance_a_peak_and_a_ramp_is_not_drawn():
    """A Lorentzian of power σ² and full width f0/Q is 2σ²/(π·width) high."""
    line, peak = aj.Sinusoid(60.0 * HOUR, 3.3), aj.Resonance(200.0 * HOUR, 20.0, 2000.0)
    model = aj.AngleRandomWalk(6e-5) + line + peak + aj.DriftRamp(1e-6)
    figure, lines = model_lines("psd", with_terms(bench.fit("small"), {"gyro_x": model}), "gyro_x")
    assert set(lines["sinusoid"].get_xdata()) == {3.3}
    assert "drift ramp" not in lines
    assert "not drawn" in " ".join(" ".join(texts(figure)).split())
    height = 2.0 * 200.0**2 / (np.pi * 20.0 / 2000.0)
    assert lines["resonance"].get_ydata().max() == pytest.approx(height, rel=0.05)


def test_several_are_drawn_over_one_another_axis_by_axis():
    fit, shorter = bench.fit("small"), bench.recording("small").between(0.0, 81.92)["gyro_x", "accel_z"]
    axes = (shorter.axes[0], dataclasses.replace(shorter.axes[1], name="accel_x"))
    other = dataclasses.replace(shorter, axes=axes, name="shorter")
    curve = aj.allan_deviation(other)
    found = panels(aj.plot_allan([fit, other, curve], labels=["fit", "recording", "curve"]))
    points = {name: {label: c[0] for label, c in points_of(p).items()} for name, p in found.items()}
    both = {"gyro_x": ["fit", "recording", "curve"], "accel_x": ["recording", "curve"]}
    assert {name: list(p) for name, p in points.items()} == {name: ["fit"] for name in NAMES} | both
    np.testing.assert_allclose(points["gyro_x"]["fit"].get_ydata(), fit.curve.deviation[:, 0] / HOUR)
    np.testing.assert_allclose(points["accel_x"]["recording"].get_ydata(), curve.deviation[:, 1] / MICRO_G)
    np.testing.assert_allclose(points["accel_x"]["curve"].get_ydata(), curve.deviation[:, 1] / MICRO_G)
    line = lines_of(found["gyro_x"])["fit: model"]
    expected = fit.model_deviation("gyro_x", line.get_xdata()) / HOUR
    np.testing.assert_allclose(line.get_ydata(), expected, rtol=1e-9)
    assert "shorter" in texts(aj.plot_allan([fit, other], axes="accel_x"))
    ax = plt.subplots()[1]
    aj.plot_allan([fit, other], ["gyro_x"], labels=["a", "b"], ax=ax)
    assert [t.get_text() for t in ax.get_legend().get_texts()] == ["a", "b"]


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
    with pytest.raises(aj.AllanjaxError, match=word):
        call(bench.fit("small"))


def test_arrays_without_a_unit_have_panels_by_number():
    curve, spectrum = aj.allan_deviation(SAMPLES, 10.0), aj.power_spectrum(SAMPLES, 10.0)
    for figure, label in ((aj.plot_allan(curve), "Allan deviation"), (spectrum.plot(), "one-sided PSD")):
        assert set(panels(figure)) == {"0", "1"}
        assert figure.axes[0].get_ylabel() == label


def test_figures_do_not_pile_up_and_one_is_rendered(tmp_path):
    """The user's, one that waits, and the one that is drawn; a saved one is pyplot's no longer."""
    own, fit = plt.figure(), bench.fit("small")
    for k in range(2):
        saved = fit.plot(["gyro_x"], path=tmp_path / "a.png")
        assert len(plt.get_fignums()) == 1 + k
        assert plt.gcf() is not saved
        fit.plot("gyro_x")
        assert own.number in plt.get_fignums()
    # Small, and its name is no formula.
    figure = dataclasses.replace(fit, name="[/red] x $a$ :smile: <b>&").plot("gyro_x")
    type(figure).savefig.original(figure, tmp_path / "real.png")
    assert 5_000 < (tmp_path / "real.png").stat().st_size < 500_000
