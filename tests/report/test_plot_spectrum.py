"""The picture of a power spectrum, alone and with a fit over it."""

import dataclasses

import numpy as np
import pytest
from figures import check_texts_apart, panels, texts

import allanjax as aj
from allanjax.noise.notation import parse_model
from allanjax.noise.simulate import simulate_recording
from allanjax.report.allan_figure import plot_allan
from allanjax.report.spectrum_figure import plot_psd
from allanjax.spectrum.psd import power_spectrum

pytestmark = pytest.mark.usefixtures("no_windows")

MICRO_G = 9.80665e-6
DEG_PER_H = np.pi / 180 / 3600


def lines_of(panel):
    return {line.get_label(): line for line in panel.get_lines()}


@pytest.fixture(scope="module")
def spectrum(small_recording):
    return power_spectrum(small_recording)


def fit_of_truth(fitted, model, recording):
    """A fit that found the truth: no fit is needed to see how one is drawn."""
    some = next(c for c in fitted["gyro_x"].coefficients.values() if c.detected)
    coefficients = {
        p.label: dataclasses.replace(
            some,
            label=p.label,
            term=p.term_label,
            parameter=p.parameter,
            value=p.start,
            std=p.start / 100,
            upper_limit=None,
            unit="",
            usual_unit="",
        )
        for p in model.parameters
    }
    result = dataclasses.replace(fitted["gyro_x"], _model=model, _coefficients=coefficients)
    curve = aj.allan_deviation(recording)
    return dataclasses.replace(fitted, template=model, results=(result,), curve=curve)


def test_every_axis_has_a_panel_with_units_and_the_gyros_are_above(spectrum, small_fit):
    for figure in (plot_psd(spectrum, small_fit), plot_psd(spectrum)):
        found = panels(figure)
        assert set(found) == {"gyro_x", "gyro_y", "gyro_z", "accel_z"}
        assert found["gyro_x"].get_ylabel() == "one-sided PSD\n[(deg/h)²/Hz]"
        assert found["accel_z"].get_ylabel() == "one-sided PSD\n[µg²/Hz]"
        assert [axes.get_xlabel() for axes in figure.axes].count("frequency f [Hz]") == 4
        assert found["gyro_x"].get_position().y0 > found["accel_z"].get_position().y1
        assert found["gyro_x"].get_ylim() == found["gyro_y"].get_ylim() != found["accel_z"].get_ylim()
        assert found["gyro_x"].get_xscale() == found["gyro_x"].get_yscale() == "log"


def test_points_and_lines_are_one_sided_densities_in_display_units(spectrum, small_fit):
    panel = panels(plot_psd(spectrum, small_fit))["accel_z"]
    (measured,) = [c for c in panel.containers if c.get_label() == "measured"]
    np.testing.assert_allclose(measured[0].get_xdata(), spectrum.frequency)
    np.testing.assert_allclose(measured[0].get_ydata(), spectrum.density[:, 3] / MICRO_G**2, rtol=1e-12)
    lines = lines_of(panel)
    f = lines["model"].get_xdata()
    values = small_fit["accel_z"].model.values
    N, K = values["angle_random_walk"], values["rate_random_walk"]
    np.testing.assert_allclose(lines["velocity random walk"].get_ydata(), 2 * N**2 / MICRO_G**2, rtol=1e-9)
    # At low frequencies the samples' density is that of the rate, 2K²/(2πf)².
    low = f < 1.0
    walk = lines["rate random walk"].get_ydata()[low]
    np.testing.assert_allclose(walk, 2 * (K / (2 * np.pi * f[low])) ** 2 / MICRO_G**2, rtol=2e-3)
    terms = [line.get_ydata() for label, line in lines.items() if label not in ("model", "measured")]
    terms = [y for y in terms if len(y) == len(f)]
    np.testing.assert_allclose(lines["model"].get_ydata(), np.sum(terms, axis=0), rtol=1e-9)


def test_terms_look_as_in_the_allan_plot(spectrum, small_fit):
    here = lines_of(panels(plot_psd(spectrum, small_fit))["gyro_x"])
    there = lines_of(panels(plot_allan(small_fit))["gyro_x"])
    shared = set(here) & set(there) - {"beyond the strip"}
    assert {"model", "angle random walk"} <= shared
    for label in shared:
        assert here[label].get_color() == there[label].get_color()
        assert here[label].get_linestyle() == there[label].get_linestyle()


def test_the_strip_shows_means_of_measured_over_model_in_percent(spectrum, small_fit):
    figure = plot_psd(spectrum, small_fit, axes=["gyro_y"])
    strip = next(axes for axes in figure.axes if "[%]" in axes.get_ylabel())
    points = next(c for c in strip.containers if c.get_label() == "residual")[0]
    model = small_fit["gyro_y"].model.sampled(100.0)
    ratio = spectrum.density[:, 1] / (2 * np.asarray(model.sampled_psd(spectrum.frequency, 100.0)))
    # The lowest ordinates stand alone; all together, weighted with their ordinates, have one mean.
    np.testing.assert_allclose(points.get_ydata()[:4], 100 * (ratio[:4] - 1), rtol=1e-9)
    ordinate = np.cumsum(spectrum.count) - spectrum.count + 1
    last = np.floor(4 * np.log2(ordinate)) == np.floor(4 * np.log2(ordinate[-1]))
    expected = np.average(ratio[last], weights=spectrum.count[last]) - 1
    assert points.get_ydata()[-1] == pytest.approx(100 * expected, rel=1e-9)
    assert abs(points.get_ydata()[-8:]).max() < 20


def test_the_key_names_terms_and_n_with_its_band(spectrum, small_fit):
    figure = plot_psd(spectrum, small_fit)
    shown = " ".join(" ".join(texts(figure)).split())
    for result in small_fit.results:
        walk = spectrum.random_walk(result.axis.name)
        low, high = walk.band
        assert f"N by eq. (3.41): {walk.in_unit().describe()} ({low:.3g} to {high:.3g} Hz)" in shown
        for c in result.coefficients.values():
            assert c.in_unit().describe() in shown
    (flat,) = [p for p in panels(figure)["gyro_x"].patches if p.get_label() == "flat part"]
    band = spectrum.random_walk("gyro_x").band
    assert (flat.get_x(), flat.get_x() + flat.get_width()) == pytest.approx(band)


def test_a_sinusoid_is_a_vertical_line_and_a_ramp_is_not_drawn(small_fit):
    text = "N=0.2 deg/√h + sinusoid(amplitude=60 deg/h, frequency=3.3 Hz) + R=3000 deg/h²"
    model = parse_model(text, "gyro")
    recording = simulate_recording({"gyro_x": model}, 20_000, 100.0, 3)
    figure = plot_psd(power_spectrum(recording), fit_of_truth(small_fit, model, recording))
    lines = lines_of(panels(figure)["gyro_x"])
    assert set(lines["sinusoid"].get_xdata()) == {3.3}
    assert "drift ramp" not in lines
    shown = " ".join(" ".join(texts(figure)).split())
    assert "sinusoid: Ω0 = 60.00 ± 0.60 deg/h, f0 = 3.300 ± 0.033 Hz" in shown
    assert "(no density: not drawn)" in shown
    # The line's own residual is beyond the strip: it does not set its scale.
    strip = next(axes for axes in figure.axes if "[%]" in axes.get_ylabel())
    residual = next(c for c in strip.containers if c.get_label() == "residual")[0].get_ydata()
    assert residual.max() > 2 * strip.get_ylim()[1]
    assert len(lines_of(strip)["beyond the strip"].get_xdata()) > 0


def test_the_peak_of_a_resonance_is_drawn(small_fit):
    text = "N=0.2 deg/√h + resonance(amplitude=200 deg/h, frequency=20 Hz, quality_factor=2000)"
    model = parse_model(text, "gyro")
    recording = simulate_recording({"gyro_x": model}, 20_000, 100.0, 3)
    figure = plot_psd(power_spectrum(recording), fit_of_truth(small_fit, model, recording))
    lines = lines_of(panels(figure)["gyro_x"])
    # A Lorentzian of power σ² and full width f0/Q_f is 2σ²/(π·width) high.
    peak = 2 * 200**2 / (np.pi * 20.0 / 2000)
    assert lines["resonance"].get_ydata().max() == pytest.approx(peak, rel=0.05)


def test_no_two_texts_overlap(spectrum, small_fit, half_failed_fit):
    for figure in (
        plot_psd(spectrum, small_fit),
        plot_psd(spectrum, half_failed_fit),
        plot_psd(spectrum),
        plot_psd(spectrum, small_fit, axes=["gyro_x"]),
    ):
        assert check_texts_apart(figure) > 6


def test_an_axis_without_result_shows_what_was_measured_and_says_so(spectrum, half_failed_fit):
    figure = plot_psd(spectrum, half_failed_fit)
    panel = panels(figure)["gyro_y"]
    assert [c.get_label() for c in panel.containers] == ["measured"]
    assert "model" not in lines_of(panel)
    assert "no result: the start was hopeless" in texts(figure)


def test_an_array_a_long_welch_spectrum_and_what_is_nowhere_flat(small_recording):
    data = np.random.default_rng(0).normal(size=(500, 2))
    figure = power_spectrum(data, 10.0).plot()
    assert set(panels(figure)) == {"0", "1"}
    assert figure.axes[0].get_ylabel() == "one-sided PSD"
    welch = power_spectrum(small_recording["gyro_x"], method="welch", segment_time=100.0)
    (panel,) = panels(welch.plot()).values()
    assert len(panel.containers[0][0].get_xdata()) == len(welch.averaged().frequency) < 200
    walk = aj.Recording.from_array(data.cumsum(axis=0)[:, 0], 10.0, gyro_unit="deg/s")
    assert "N by eq. (3.41): nowhere flat over an octave" in texts(power_spectrum(walk).plot())


def test_saves_a_small_file(spectrum, small_fit, tmp_path):
    plot_psd(spectrum, small_fit, path=tmp_path / "psd.png")
    assert (tmp_path / "psd.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "psd.png").stat().st_size < 500_000


def test_what_does_not_belong_together_is_refused(spectrum, small_fit):
    for axes in (["gyro_q"], []):
        with pytest.raises(aj.AllanjaxError, match="gyro_x, gyro_y, gyro_z, accel_z"):
            plot_psd(spectrum, axes=axes)
    with pytest.raises(aj.AllanjaxError, match="recording that was fitted"):
        plot_psd(power_spectrum(np.random.default_rng(0).normal(size=100), 100.0), small_fit)
    with pytest.raises(aj.AllanjaxError, match="come at 50 Hz, the fit's at 100 Hz"):
        plot_psd(dataclasses.replace(spectrum, rate=50.0), small_fit)


def test_one_axis_goes_into_axes_of_the_callers(spectrum, small_fit, tmp_path):
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2)
    assert plot_psd(spectrum, small_fit, "gyro_x", tmp_path / "mine.png", ax=left) is figure
    assert (tmp_path / "mine.png").exists()
    own = panels(plot_psd(spectrum, small_fit))["gyro_x"]
    assert left.get_ylabel() == own.get_ylabel()
    assert left.get_xlabel() == "frequency f [Hz]"
    for name in ("model", "angle random walk"):
        np.testing.assert_array_equal(lines_of(left)[name].get_xydata(), lines_of(own)[name].get_xydata())
    assert spectrum.plot(["accel_z"], ax=right) is figure
    measured = right.containers[0][0].get_ydata()
    np.testing.assert_allclose(measured, spectrum.density[:, 3] / MICRO_G**2)
    with pytest.raises(aj.AllanjaxError, match="ax= has room for one axis"):
        plot_psd(spectrum, ax=left)
