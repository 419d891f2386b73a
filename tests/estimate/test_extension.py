"""Fits of axes that the plain terms do not follow, of records by NumPy and SciPy alone."""

import dataclasses
import json
from importlib.resources import files

import numpy as np
import pytest
from scipy.signal import butter, lfilter, sosfilt

import allanjax as aj
from allanjax.estimate.as_json import to_dict
from allanjax.estimate.whittle import fit_axis
from allanjax.fleet.table import rows_of
from allanjax.noise.notation import parse_model

RATE, N = 100.0, 60_000
WHITE, WALK = 1e-3, 2e-4
SCHEMA = json.loads(files("allanjax.report").joinpath("fit.schema.json").read_text(encoding="utf-8"))


def noise(rng, n):
    """White noise and a random walk."""
    h = 1.0 / RATE
    white = WHITE / np.sqrt(h) * rng.standard_normal(n)
    return white + WALK * np.sqrt(h) * np.cumsum(rng.standard_normal(n))


def resonance(rng, n, frequency, quality, sigma):
    """Noise of an oscillator, by its recursion of two poles."""
    w = 2.0 * np.pi * frequency / RATE
    pole = np.exp(-w / (2.0 * quality) + 1j * w * np.sqrt(1.0 - 0.25 / quality**2))
    x = lfilter([1.0], np.poly([pole, pole.conj()]).real, rng.standard_normal(n + 4000))[4000:]
    return sigma * x / x.std()


@pytest.fixture(scope="module")
def recording():
    """A filtered axis with a resonance and a line, one behind another filter, and a plain one."""
    rng = np.random.default_rng(2)
    t = np.arange(N) / RATE
    low, settled = np.exp(-2.0 * np.pi * 15.0 / RATE), 1000
    first = lfilter([1.0 - low], [1.0, -low], noise(rng, N + settled))[settled:]
    first += resonance(rng, N, 20.0, 15.0, 5e-3) + 2e-3 * np.cos(2.0 * np.pi * 3.3 * t + 1.0)
    second = sosfilt(butter(2, 22.0, fs=RATE, output="sos"), noise(rng, N + settled))[settled:]
    values = np.column_stack([first, second, noise(rng, N)])
    names = ["gyro_x", "gyro_y", "gyro_z"]
    return aj.Recording.from_array(values, RATE, gyro_unit="rad/s", names=names)


@pytest.fixture(scope="module")
def fitted(recording):
    return aj.fit(recording)


def test_coefficients_are_corrected(fitted):
    """N within its 95 % interval and 3 %; of two axes both are inside nine times of ten, with this seed."""
    for name in ("gyro_x", "gyro_y"):
        c = fitted[name]["N"]
        assert c.interval[0] < WHITE < c.interval[1]
        assert c.value == pytest.approx(WHITE, rel=0.03)
        K = fitted[name]["K"]
        assert K.interval[0] < WALK < K.interval[1]
        assert fitted[name].discrepancy < 0.1 * fitted[name].plain.discrepancy
    # The misfit widens the interval of the plain fit, or is so large that there is none.
    assert fitted["gyro_x"].plain["N"].std > 2.0 * fitted["gyro_x"]["N"].std
    assert not fitted["gyro_y"].plain.measured
    assert fitted["gyro_y"].measured


def test_what_is_corrected_for_is_named(fitted):
    found = fitted["gyro_x"]
    assert found["resonance_frequency"].value == pytest.approx(20.0, rel=0.01)
    assert found["resonance_quality_factor"].value == pytest.approx(15.0, rel=0.25)
    assert found["sinusoid_frequency"].value == pytest.approx(3.3, abs=1e-3)
    assert found["sinusoid_amplitude"].value == pytest.approx(2e-3, rel=0.1)
    text = found.correction
    assert text.startswith("corrected for a 1")
    for part in (
        "Hz bandwidth",
        "a resonance at 20 Hz",
        "a line at 3.3 Hz",
        "angle random walk",
        "→",
        "deg/√h",
    ):
        assert part in text
    assert "22 Hz" in fitted["gyro_y"].correction.replace("21.9", "22").replace("22.1", "22")
    assert found.further == ("resonance", "sinusoid", found.own_template.response.name())


def test_the_model_is_what_was_measured(fitted):
    """Its Allan deviation is the measured one within four standard errors and 0.2 % up to 10 s."""
    time = fitted.curve.cluster_time
    short = time <= 10.0
    for k, result in enumerate(fitted.results):
        ratio = fitted.curve.deviation[:, k] / fitted.model_deviation(result.axis.name, time)
        error = 1.0 / np.sqrt(2.0 * fitted.curve.edf[:, k])
        assert np.all(abs(ratio - 1.0)[short] < (4.0 * error + 0.002)[short]), result.axis.name
    # Without the extension it was off by a quarter and by more.
    for name, k in (("gyro_x", 0), ("gyro_y", 1)):
        plain = fitted[name].plain.model.sampled(RATE).allan_variance(time)
        assert np.max(abs(fitted.curve.deviation[:, k] / np.sqrt(plain) - 1.0)[short]) > 0.25


def test_a_plain_axis_stays_plain(fitted, recording):
    assert fitted["gyro_z"].own_template is None
    assert fitted["gyro_z"].plain is None
    assert fitted["gyro_z"].correction == ""
    again = aj.fit(recording, plain=True)
    assert all(result.own_template is None for result in again.results)
    assert again["gyro_x"].misfit is not None
    # The plain fit is kept beside the other.
    assert fitted["gyro_x"].plain["N"].value == again["gyro_x"]["N"].value
    # Terms that the user gave are what is fitted.
    assert aj.fit(recording, "N + K")["gyro_x"].own_template is None


def test_the_table_says_it_in_one_line(fitted):
    text = " ".join(str(fitted).replace("│", " ").split())
    assert text.count("corrected for") == 2
    assert "resonance quality" not in text
    assert "low pass" not in text


def test_json_keeps_it(fitted, tmp_path):
    jsonschema = pytest.importorskip("jsonschema")
    path = tmp_path / "fit.json"
    aj.write_json(fitted, path)
    jsonschema.validate(json.loads(path.read_text(encoding="utf-8")), SCHEMA)
    again = aj.load(path)
    assert str(again) == str(fitted)
    for name in fitted.axes:
        assert again[name].correction == fitted[name].correction
        one, other = again[name].model, fitted[name].model
        assert repr(one.response) == repr(other.response)
        assert one.inside == other.inside
        time = np.array([0.01, 1.0, 50.0])
        np.testing.assert_allclose(
            one.sampled(RATE).allan_variance(time), other.sampled(RATE).allan_variance(time)
        )


def test_its_posterior_is_that_of_the_whole_model(fitted):
    """The standard deviation of N is that of the fit within the scatter of 2,000 correlated draws."""
    posterior = aj.sample(fitted, "gyro_y", max_steps=3000, min_length=20.0, max_r_hat=1.1, max_change=0.5)
    of = posterior["gyro_y"]
    assert fitted["gyro_y"].own_template.response.name() in " ".join(of.coefficients)
    assert of["N"].value == pytest.approx(fitted["gyro_y"]["N"].value, rel=0.02)
    assert of["N"].std == pytest.approx(fitted["gyro_y"]["N"].std, rel=0.4)


def test_pictures_name_it(fitted, recording):
    for figure in (
        aj.plot_allan(fitted, "gyro_x"),
        aj.plot_psd(aj.power_spectrum(recording), fitted, "gyro_x"),
    ):
        texts = " ".join(text.get_text() for axes in figure.axes for text in axes.texts)
        texts += " ".join(t.get_text() for t in figure.texts)
        texts += " ".join(t.get_text() for a in figure.artists for t in getattr(a, "texts", []))
        found = [t for t in figure.findobj() if hasattr(t, "get_text")]
        assert any("corrected for" in t.get_text().replace("\n", " ") for t in found), texts


def test_intervals_of_a_response_do_not_need_the_first_term(recording):
    """A response has an interval also where the first term that passes it is not in use."""
    model = parse_model("low_pass1 * (Q + N + K)")
    low = np.exp(-2.0 * np.pi * 15.0 / RATE)
    x = lfilter([1.0 - low], [1.0, -low], noise(np.random.default_rng(3), N))
    found = fit_axis(model, recording.axes[1], x, RATE, np.array([False, True, True]), {})
    bandwidth = found.coefficients.values["low_pass1_bandwidth"]
    # Four standard deviations; one of three axes in 16,000 is farther off.
    assert abs(bandwidth.value - 15.0) < 4.0 * bandwidth.std < 2.0


def test_without_extensions_it_is_the_plain_fit(fitted, recording):
    plain, again = fitted.without_extensions(), aj.fit(recording, plain=True)
    assert all(result.own_template is None for result in plain.results)
    for name in fitted.axes:
        assert plain[name].mean == fitted[name].mean
        assert plain[name]["N"].value == again[name]["N"].value


def test_a_fleet_compares_the_plain_terms(fitted):
    """Resonances are numbered by their strength, so that units do not compare in them."""
    rows = rows_of(to_dict(fitted), "unit", "unit.csv")
    named = {row["coefficient"] for row in rows if row["axis"] == "gyro_x"}
    assert "angle_random_walk" in named
    assert not any("resonance" in name or "sinusoid" in name or "low_pass" in name for name in named)


def test_regressors_leave_the_terms_plain(recording):
    """A fit with regressors has no extension, which would be without them."""
    with_channel = dataclasses.replace(
        recording, auxiliary={"temperature": np.sin(np.arange(N) / 5000.0) + np.arange(N) / N}
    )
    found = aj.fit(with_channel, objective="whittle", regressors=["temperature"], as_is=True)
    assert all(result.own_template is None and result.regression for result in found.results)
