"""The picture of a fit."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from figures import check_texts_apart, panels, texts

import allanjax as aj
from allanjax.estimate.misfit import Misfit
from allanjax.noise.notation import parse_model
from allanjax.noise.simulate import simulate, simulate_recording
from allanjax.report.allan_figure import plot_allan

pytestmark = pytest.mark.usefixtures("no_windows")


def labels_of(figure):
    return [label for axes in figure.axes for label in (axes.get_xlabel(), axes.get_ylabel()) if label]


def test_every_axis_has_a_panel_with_units_and_the_gyros_are_above(small_fit):
    figure = plot_allan(small_fit)
    found = panels(figure)
    assert set(found) == {"gyro_x", "gyro_y", "gyro_z", "accel_z"}
    assert found["gyro_x"].get_ylabel() == "Allan deviation\n[deg/h]"
    assert found["accel_z"].get_ylabel() == "Allan deviation\n[µg]"
    assert labels_of(figure).count("cluster time T [s]") == 4
    assert found["gyro_x"].get_position().y0 > found["accel_z"].get_position().y1
    assert found["gyro_x"].get_ylim() == found["gyro_y"].get_ylim() != found["accel_z"].get_ylim()


def test_points_and_lines_are_the_deviations_in_display_units(small_fit):
    panel = panels(plot_allan(small_fit))["accel_z"]
    (measured,) = [c for c in panel.containers if c.get_label() == "measured"]
    micro_g = 9.80665e-6
    np.testing.assert_allclose(measured[0].get_xdata(), small_fit.curve.cluster_time)
    np.testing.assert_allclose(measured[0].get_ydata(), small_fit.curve.deviation[:, 3] / micro_g, rtol=1e-12)
    lines = {line.get_label(): line for line in panel.get_lines()}
    time = lines["model"].get_xdata()
    expected = small_fit.model_deviation("accel_z", time) / micro_g
    np.testing.assert_allclose(lines["model"].get_ydata(), expected, rtol=1e-9)
    walk = small_fit["accel_z"]["angle_random_walk"].value
    np.testing.assert_allclose(
        lines["velocity random walk"].get_ydata(), walk / np.sqrt(time) / micro_g, rtol=1e-9
    )


def test_error_bars_end_where_the_intervals_do(small_fit):
    lower, upper = small_fit.curve.confidence_interval(0.68)
    for name, k, scale in (("gyro_y", 1, np.pi / 180 / 3600), ("accel_z", 3, 9.80665e-6)):
        panel = panels(plot_allan(small_fit))[name]
        (measured,) = [c for c in panel.containers if c.get_label() == "measured"]
        ends = np.array([segment[:, 1] for segment in measured[2][0].get_segments()])
        np.testing.assert_allclose(ends[:, 0], lower[:, k] / scale, rtol=1e-9)
        np.testing.assert_allclose(ends[:, 1], upper[:, k] / scale, rtol=1e-9)


def test_faint_lines_have_the_slopes_of_the_terms(small_fit):
    panel = panels(plot_allan(small_fit))["gyro_x"]
    slopes = {}
    for line in panel.get_lines():
        if line.get_label().startswith("slope "):
            (x0, x1), (y0, y1) = np.log10(line.get_xdata()), np.log10(line.get_ydata())
            slopes[line.get_label().removeprefix("slope ")] = (y1 - y0) / (x1 - x0)
    assert slopes == pytest.approx({"−1": -1.0, "−½": -0.5, "0": 0.0, "+½": 0.5, "+1": 1.0})
    assert set(slopes) <= {text.get_text() for text in panel.texts}
    # They stay behind what was measured and change no scale.
    measured = next(c for c in panel.containers if c.get_label() == "measured")[0]
    assert all(
        line.get_zorder() < measured.get_zorder() for line in panel.get_lines() if "slope" in line.get_label()
    )
    curve = small_fit.curve.cluster_time
    assert panel.get_xlim() == pytest.approx((curve[0] / 1.4, curve[-1] * 1.4))


def test_n_b_and_k_are_written_beside_their_lines(small_fit):
    figure = plot_allan(small_fit)
    figure.canvas.draw()
    written = {
        "gyro_x": {"N": "N = ", "B": "0.664 B, B = "},
        "accel_z": {"N": "N = ", "K": "K = "},
    }
    for axis, expected in written.items():
        panel, result = panels(figure)[axis], small_fit[axis]
        lines = {line.get_label(): line for line in panel.get_lines()}
        for c in result.coefficients.values():
            beginning = expected.get(c.parameter.symbol)
            found = [t for t in panel.texts if beginning and t.get_text().startswith(beginning)]
            assert len(found) == (c.detected and beginning is not None)
            if not found:
                continue
            number, unit = found[0].get_text().removeprefix(beginning).split(" ")
            shown = c.in_unit()
            assert unit == shown.unit
            assert abs(float(number) - shown.value) < 0.06 * shown.std
            # Within twice the text's height of the line of the same colour, at its angle.
            line = lines[c.title]
            assert found[0].get_color() == line.get_color()
            pixels = panel.transData.transform(line.get_xydata())
            place = panel.transData.transform(found[0].get_position())
            nearest = int(np.argmin(np.hypot(*(pixels - place).T)))
            assert np.hypot(*(pixels[nearest] - place)) < 2.0 * 6.5 * figure.dpi / 72
            (dx, dy) = pixels[nearest + 1] - pixels[nearest - 1]
            assert found[0].get_rotation() % 360 == pytest.approx(np.degrees(np.arctan2(dy, dx)) % 360, abs=1)


def test_the_strip_shows_measured_over_model_in_percent(small_fit):
    figure = plot_allan(small_fit, axes=["gyro_y"])
    strip = next(axes for axes in figure.axes if "[%]" in axes.get_ylabel())
    points = next(c for c in strip.containers if c.get_label() == "residual")[0].get_ydata()
    model = small_fit.model_deviation("gyro_y", small_fit.curve.cluster_time)
    np.testing.assert_allclose(points, 100 * (small_fit.curve.deviation[:, 1] / model - 1), atol=1e-9)
    reach = strip.get_ylim()[1]
    marked = sum(
        len(line.get_xdata()) for line in strip.get_lines() if line.get_label() == "beyond the strip"
    )
    assert marked == (abs(points) > reach).sum()


def test_the_models_own_error_is_a_band_in_the_strip(small_fit):
    first, second, *others = small_fit.results
    misfit = Misfit(largest=0.09, at=1.0, unit="s", rms=0.04, sustained=0.0)
    incomplete = dataclasses.replace(second, discrepancy=0.04, misfit=misfit)
    figure = plot_allan(dataclasses.replace(small_fit, results=(first, incomplete, *others)), axes=["gyro_y"])
    strip = next(axes for axes in figure.axes if "[%]" in axes.get_ylabel())
    (band,) = strip.patches
    np.testing.assert_allclose(band.get_path().get_extents(band.get_patch_transform()).intervaly, [-4.0, 4.0])
    assert strip.get_ylim()[1] > 4.0


def test_the_key_names_every_term_with_its_coefficient_or_limit(small_fit):
    shown = " ".join(" ".join(texts(plot_allan(small_fit))).split())
    for result in small_fit.results:
        for label, c in result.coefficients.items():
            name = label.replace("_", " ")
            if result.axis.sensor == "accel":
                name = name.replace("angle random walk", "velocity random walk")
            assert f"{name}{'' if c.detected else ':'} {c.in_unit().describe()}" in shown
    assert any(not c.detected for c in small_fit["gyro_x"].coefficients.values())
    assert "small" in shown
    assert "200 s at 100 Hz, 20,000 samples" in shown


def test_no_two_texts_overlap(small_fit, half_failed_fit):
    for figure in (
        plot_allan(small_fit),
        plot_allan(half_failed_fit),
        plot_allan(small_fit, axes=["gyro_x"]),
        plot_allan([small_fit, half_failed_fit], labels=["a", "the other of these two, at another time"]),
    ):
        assert check_texts_apart(figure) > 8


def test_an_axis_without_result_shows_what_was_measured_and_says_so(half_failed_fit):
    figure = plot_allan(half_failed_fit)
    panel = panels(figure)["gyro_y"]
    assert [c.get_label() for c in panel.containers] == ["measured"]
    assert "model" not in [line.get_label() for line in panel.get_lines()]
    assert "no result: the start was hopeless" in texts(figure)


class WhiteAngle(aj.NoiseTerm):
    """White noise of the angle over a short correlation time: a term of a user's own."""

    amplitude: float | None = aj.parameter("P", time_exponent=1.0)
    smoothing: float | None = aj.parameter("s", "time")

    def phase_covariance(self, lag):
        return self.amplitude**2 * jnp.exp(-0.5 * (lag / self.smoothing) ** 2)


def test_a_users_own_term_is_drawn_with_all_its_parameters():
    truth = aj.AngleRandomWalk(1e-4) + WhiteAngle(amplitude=1e-5, smoothing=0.05)
    recording = aj.Recording.from_array(np.asarray(simulate(truth, 8000, 100.0, 3)), 100.0, gyro_unit="rad/s")
    fitted = aj.fit(recording, aj.AngleRandomWalk() + WhiteAngle().hold(smoothing=0.05))
    figure = plot_allan(fitted)
    panel = panels(figure)["gyro"]
    lines = {line.get_label(): line for line in panel.get_lines()}
    time = lines["white angle"].get_xdata()
    G = [
        fitted["gyro"]["white_angle_amplitude"].value ** 2 * np.exp(-0.5 * (k * time / 0.05) ** 2)
        for k in (0, 1, 2)
    ]
    deviation = np.sqrt((6 * G[0] - 8 * G[1] + 2 * G[2]) / (2 * time**2))
    np.testing.assert_allclose(lines["white angle"].get_ydata(), deviation * 180 / np.pi * 3600, rtol=1e-6)
    key = " ".join(" ".join(texts(figure)).split())
    white = fitted["gyro"]["white_angle_amplitude"].in_unit()
    assert f"white angle: P = {white.describe()}, s = 0.05 s (held)" in key


def test_saves_a_small_file(small_fit, tmp_path):
    figure = small_fit.plot(path=tmp_path / "fit.png")
    assert (tmp_path / "fit.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "fit.png").stat().st_size < 500_000
    assert len(panels(figure)) == 4
    assert len(panels(small_fit.plot(axes=["gyro_y"]))) == 1


def test_a_curve_alone_of_a_recording_and_of_an_array(small_recording):
    curve = aj.allan_deviation(small_recording["gyro_x"], kind="hadamard")
    (panel,) = curve.plot().axes
    assert panel.get_ylabel() == "Hadamard deviation\n[deg/h]"
    curve = aj.allan_deviation(np.random.default_rng(0).normal(size=(500, 2)), 10.0)
    figure = plot_allan(curve)
    assert set(panels(figure)) == {"0", "1"}
    assert figure.axes[0].get_ylabel() == "Allan deviation"


@pytest.fixture(scope="module")
def other_recording(small_recording):
    """Of another length, with one axis less and one of its own."""
    shorter = small_recording.between(0.0, 150.0)["gyro_x", "accel_z"]
    axes = (shorter.axes[0], dataclasses.replace(shorter.axes[1], name="accel_x"))
    return dataclasses.replace(shorter, axes=axes, name="shorter")


def test_several_are_drawn_over_one_another_axis_by_axis(small_fit, other_recording):
    curve = aj.allan_deviation(other_recording)
    figure = plot_allan([small_fit, other_recording, curve], labels=["fit", "recording", "curve"])
    found = panels(figure)
    assert list(found) == ["gyro_x", "gyro_y", "gyro_z", "accel_z", "accel_x"]
    points = {name: {c.get_label(): c[0].get_xydata() for c in p.containers} for name, p in found.items()}
    assert {name: list(p) for name, p in points.items()} == {
        "gyro_x": ["fit", "recording", "curve"],
        "gyro_y": ["fit"],
        "gyro_z": ["fit"],
        "accel_z": ["fit"],
        "accel_x": ["recording", "curve"],
    }
    hour = np.pi / 180 / 3600
    fitted = small_fit.curve
    np.testing.assert_allclose(points["gyro_x"]["fit"][:, 1], fitted.deviation[:, 0] / hour)
    np.testing.assert_allclose(points["gyro_x"]["recording"][:, 1], curve.deviation[:, 0] / hour)
    np.testing.assert_allclose(points["accel_x"]["curve"][:, 1], curve.deviation[:, 1] / 9.80665e-6)
    # Fits have their models, and their coefficients below.
    line = next(x for x in found["gyro_x"].get_lines() if x.get_label() == "fit: model")
    expected = small_fit.model_deviation("gyro_x", line.get_xdata()) / hour
    np.testing.assert_allclose(line.get_ydata(), expected, rtol=1e-9)
    key = " ".join(" ".join(texts(figure)).split())
    walk = small_fit["gyro_x"]["angle_random_walk"].in_unit().describe()
    assert f"fit: N = {walk}" in key
    assert {"recording", "curve"} <= set(texts(figure))
    assert found["gyro_x"].get_xlim()[1] > fitted.cluster_time[-1]
    # Colours and markers tell them apart.
    styles = {(c[0].get_color(), c[0].get_marker()) for c in found["gyro_x"].containers}
    assert len({colour for colour, _ in styles}) == len({marker for _, marker in styles}) == 3


def test_several_are_called_by_their_names_unless_they_share_one(small_fit, other_recording):
    shown = texts(plot_allan([small_fit, other_recording], axes="accel_x"))
    assert "shorter" in shown
    shown = texts(plot_allan([other_recording, other_recording], axes="accel_x"))
    assert {"1", "2"} <= set(shown)


def test_one_axis_goes_into_axes_of_the_callers(small_fit, other_recording, tmp_path):
    from matplotlib import pyplot as plt

    figure, (left, middle, right) = plt.subplots(1, 3)
    assert plot_allan(small_fit, "gyro_x", tmp_path / "mine.png", ax=left) is figure
    assert (tmp_path / "mine.png").exists()
    own = panels(plot_allan(small_fit))["gyro_x"]
    assert left.get_ylabel() == own.get_ylabel()
    for mine, its in zip(left.get_lines(), own.get_lines(), strict=True):
        assert mine.get_label() == its.get_label()
        if "slope" not in mine.get_label():
            np.testing.assert_array_equal(mine.get_xydata(), its.get_xydata())
    assert small_fit.plot("accel_z", ax=middle) is figure
    assert middle.get_ylabel() == "Allan deviation\n[µg]"
    plot_allan([small_fit, other_recording], ["gyro_x"], labels=["a", "b"], ax=right)
    assert [t.get_text() for t in right.get_legend().get_texts()] == ["a", "b"]
    assert len(figure.axes) == 3
    curve = aj.allan_deviation(other_recording)
    assert curve.plot("accel_x", ax=plt.subplots()[1]) is not figure
    with pytest.raises(aj.AllanjaxError, match=r'ax= has room for one axis: name it, e\.g\. axes="gyro_x"'):
        plot_allan(small_fit, ax=left)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda fit, other: plot_allan([]), "nothing to draw"),
        (lambda fit, other: plot_allan([fit, other], labels=["a"]), "1 labels for 2 curves"),
        (lambda fit, other: plot_allan(fit, labels=["a"]), "labels= names several curves"),
        (lambda fit, other: plot_allan(3), "cannot draw int"),
        (lambda fit, other: plot_allan([fit, np.ones(3)]), "cannot draw ndarray"),
        (
            lambda fit, other: plot_allan([fit, aj.allan_deviation(other, kind="hadamard")]),
            "allan and hadamard deviations do not compare",
        ),
        (
            lambda fit, other: plot_allan([fit, aj.allan_deviation(np.arange(99.0) ** 2, 1.0)]),
            "arrays without a unit: draw them by themselves",
        ),
    ],
)
def test_what_cannot_be_drawn_together_is_refused(change, message, small_fit, other_recording):
    with pytest.raises(aj.AllanjaxError, match=message):
        change(small_fit, other_recording)


@pytest.mark.parametrize("axes", [["gyro_q"], []])
def test_an_axis_that_is_not_there_is_refused(small_fit, axes):
    with pytest.raises(aj.AllanjaxError, match="gyro_x, gyro_y, gyro_z, accel_z"):
        plot_allan(small_fit, axes=axes)


def test_one_of_two_like_terms_that_is_found_keeps_its_number(tmp_path):
    truth = parse_model("N=0.2 deg/√h + markov(amplitude=600 deg/h/√h, correlation_time=2 s)", "gyro")
    recording = simulate_recording({"gyro_x": truth}, 20_000, 100.0, 3)
    like = [aj.Markov(correlation_time=time).hold("correlation_time") for time in (0.05, 2.0)]
    fit = aj.fit(recording, aj.AngleRandomWalk() + like[0] + like[1])
    assert fit["gyro_x"]["markov_1_amplitude"].value == 0.0
    assert fit["gyro_x"].term_labels == ("angle_random_walk", "markov_2")
    allan = fit.plot(path=tmp_path / "allan.png")
    psd = aj.plot_psd(aj.power_spectrum(recording), fit, path=tmp_path / "psd.png")
    for figure in (allan, psd):
        labels = {line.get_label() for line in figure.axes[0].lines}
        assert {"markov 2"} == {label for label in labels if label.startswith("markov")}


def test_a_term_that_cannot_be_told_from_none_has_no_line(small_fit, small_recording):
    first, *others = small_fit.results
    label = "angle_random_walk"
    hidden = dataclasses.replace(first[label], detected=False)
    assert hidden.value > 0.0
    unsure = dataclasses.replace(first, _coefficients={**first.coefficients, label: hidden})
    spectrum = aj.power_spectrum(small_recording)
    for draw in (plot_allan, lambda fit, axes: aj.plot_psd(spectrum, fit, axes)):
        drawn = []
        for result in (first, unsure, first.unmeasured(moving=True)):
            panel, _, key = draw(dataclasses.replace(small_fit, results=(result, *others)), "gyro_x").axes
            lines = {line.get_label(): line for line in panel.get_lines()}
            drawn.append((lines, len(key.get_lines())))
        (found, in_key), (unsure_found, unsure_in_key), (unmeasured, unmeasured_in_key) = drawn
        # The model is the sum of its terms as before; the key tells the limit without a line.
        assert set(found) - set(unsure_found) == {"angle random walk"}
        assert set(found) == set(unmeasured)
        np.testing.assert_array_equal(unsure_found["model"].get_ydata(), found["model"].get_ydata())
        assert unsure_in_key == in_key - 1
        assert unmeasured_in_key == in_key


def test_white_noise_at_low_frequencies_that_is_of_other_terms_has_no_line(small_fit, small_recording):
    # Behind a filter whose shape the data leave open, N is told though no term of the model is white noise.
    first, *others = small_fit.results
    model = aj.Model((*first.model.without(["angle_random_walk"]).terms, aj.Quantization(1e-6)))
    coefficients = {
        **first.coefficients,
        "quantization": dataclasses.replace(first["quantization"], value=1e-6),
    }
    other = dataclasses.replace(first, _model=model, _coefficients=coefficients)
    assert other["angle_random_walk"].value > 0.0
    fit = dataclasses.replace(small_fit, results=(other, *others))
    for figure in (plot_allan(fit, "gyro_x"), aj.plot_psd(aj.power_spectrum(small_recording), fit, "gyro_x")):
        labels = [line.get_label() for line in figure.axes[0].get_lines()]
        assert "angle random walk" not in labels
        assert "model" in labels
