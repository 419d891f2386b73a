"""Pictures of posteriors, filters, decompositions and critiques show the numbers of their results."""

import bench
import numpy as np
import pytest
from figures import check_texts_apart, lines_of, panels

import allanjax as aj

pytestmark = pytest.mark.usefixtures("no_windows")
HOUR, MICRO_G, DEG_ROOT_HOUR = np.pi / 180.0 / 3600.0, 9.80665e-6, np.pi / 180.0 / 60.0


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


def test_bands_are_quantiles_of_the_draws_curves(posterior):
    """Sixty draws against three hundred: three standard errors of a median, four of the ends of 68 %."""
    deviation, density = posterior.plot().axes[2:4]
    assert (deviation.get_xlabel(), deviation.get_ylabel()) == ("cluster time T [s]", "Allan deviation [µg]")
    assert (density.get_xlabel(), density.get_ylabel()) == ("frequency [Hz]", "one-sided PSD [µg²/Hz]")
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


def test_measured_points_are_drawn_where_they_are_given(posterior):
    fit, spectrum = bench.fit("small"), aj.power_spectrum(bench.recording("small"))
    deviation, density = posterior.plot(fit, ["accel_z"], spectrum=spectrum).axes
    points = lines_of(density)["measured"]
    np.testing.assert_allclose(points.get_ydata(), spectrum.density[spectrum.frequency > 0.0, 3] / MICRO_G**2)
    (points,) = [c for c in deviation.containers if c.get_label() == "measured"]
    np.testing.assert_allclose(points[0].get_ydata(), fit.curve.deviation[:, 3] / MICRO_G)
    for axes in (["gyro_q"], []):
        with pytest.raises(aj.AllanjaxError, match="axis"):
            posterior.plot(axes=axes)


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
    with pytest.raises(aj.AllanjaxError, match="accel_z"):
        found.plot("gyro_q")


def test_an_autocorrelation_is_drawn_with_the_band_of_the_model():
    model = aj.AngleRandomWalk(6e-5) + aj.Markov(3e-4, 2.0)
    found = aj.autocorrelation(bench.recording("small"), model=model)
    for name, k, scale in (("gyro_y", 1, HOUR**2), ("accel_z", 3, MICRO_G**2)):
        panel, half = panels(found.plot())[name], 1.959964 * found.standard_error[:, k]
        ends = np.array([found.value[:, k] - half, found.value[:, k] + half]) / scale
        np.testing.assert_allclose(ends_of(panel, ""), ends, atol=1e-9 * ends.max())


def test_a_decomposition_is_drawn_part_by_part():
    found = aj.wavelet_decomposition(bench.recording("small"), levels=6)
    figure = found.plot("gyro_z", [5, 6])
    labels = [axes.get_ylabel() for axes in figure.axes]
    assert labels == ["measured", "level 5\n1.6–3.1 Hz", "level 6\n0.78–1.6 Hz", "below\n0.78 Hz"]
    parts = [found.recording, found.details(5), found.details(6), found.approximation(6)]
    for panel, part in zip(figure.axes, parts, strict=True):
        ends = panel.collections[0].get_paths()[0].vertices[:, 1]
        values = part.values[:, 2] / HOUR
        assert [ends.min(), ends.max()] == pytest.approx([values.min(), values.max()])
    with pytest.raises(aj.AllanjaxError, match="gyro_w"):
        found.plot("gyro_w")


def test_a_figure_for_every_finding_and_one_for_each_axis_without(tmp_path):
    critique, steps = bench.critique("lines"), bench.critique("steps")
    figures = critique.plot(tmp_path / "new")
    written = {path.name for path in (tmp_path / "new").iterdir()}
    assert len(figures) == len(written)
    assert {f"lines_{axis}.png" for axis in critique if not critique[axis].findings} <= written
    finding = next(f for f in critique.findings if f.cause == "sinusoid")
    (figure,) = critique.plot(findings=[finding])
    allan, psd, spectrum, text = figure.axes
    labels = [axes.get_xlabel() for axes in (allan, psd, spectrum)]
    assert labels == ["cluster time T [s]", "frequency f [Hz]", "frequency f [Hz]"]
    unit = "deg/h" if finding.strongest.axes[0].startswith("gyro") else "µg"
    assert allan.get_ylabel() == f"Allan deviation [{unit}]"
    x, y = spectrum.get_lines()[0].get_data()
    assert x[np.argmax(y)] == pytest.approx(finding.parameters["frequency"].value, abs=0.01)
    assert "sinusoid" in " ".join(t.get_text() for t in text.texts)
    (step,) = steps.plot(findings=steps.findings[:1])
    assert step.axes[2].get_xlabel() == "time since start [s]"
    for each in (figure, step):
        check_texts_apart(each)
