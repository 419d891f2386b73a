"""Growth of a navigator's errors: against dense covariances, a strapdown mechanization, and the thesis."""

import dataclasses
import math
import pickle

import numpy as np
import pytest

import allanjax as aj
from allanjax.base.earth import EARTH_RADIUS
from allanjax.navigation.growth import ErrorVariances, bias_response

DEG = math.pi / 180.0
RATE = 20.0
QUIET = aj.AngleRandomWalk(1e-12)


def test_the_thesis_numbers():
    """100 µg and 0.2 deg/h after 10 s and 1,000 s, with g = 10 m/s² (2.38–2.40), to the digits printed."""
    by_accel = aj.navigate({"accel_x": QUIET}, [10, 1000], rate=RATE, accel_bias=1e-3)
    np.testing.assert_allclose(by_accel["position"].of("north"), [0.05, 500.0], rtol=1e-6)
    by_gyro = aj.navigate({"gyro_y": QUIET}, [10, 1000], rate=RATE, gyro_bias="0.2 deg/h", gravity=10.0)
    found = by_gyro["position"].of("north")
    assert f"{found[0]:.4f}" == "0.0016"
    assert found[1] == pytest.approx(1600.0, rel=0.011)
    rad = 0.2 * DEG / 3600.0
    np.testing.assert_allclose(by_gyro["velocity"].of("north"), 10.0 * rad * np.array([50.0, 5e5]), rtol=1e-6)
    np.testing.assert_allclose(by_gyro["attitude"].of("east"), rad * np.array([10.0, 1000.0]), rtol=1e-6)


MODELS = [
    aj.AngleRandomWalk(1e-3),
    aj.RateRandomWalk(1e-4),
    aj.Quantization(1e-5),
    aj.Markov(1e-4, 3.0),
    aj.Sinusoid(1e-3, 3.3),
    aj.DriftRamp(1e-7),
    aj.LowPass1(4.0) * (aj.AngleRandomWalk(1e-3) + aj.RateRandomWalk(1e-4)),
]


@pytest.mark.parametrize("stiffness", [0.0, 0.01, -0.01])
@pytest.mark.parametrize("model", MODELS, ids=repr)
def test_variances_are_those_of_a_dense_covariance(model, stiffness):
    """States driven sample by sample: 60 samples after 90 of calibration, by the state space of the noise.

    The loop is solved by the matrix exponential of its differential equation; a loop of 63 s makes the series
    and the closed forms differ from polynomials. Rounding of G's cancelling parts allows 10⁻⁷.
    """
    from scipy.linalg import expm

    model = model if isinstance(model, aj.Model) else aj.Model((model,))
    n, before, h = 60, 90, 1.0 / RATE
    # Weights of the samples in the error of each order: integrators in a chain, with feedback.
    space = model.state_space(RATE)
    A = np.zeros((4, 4))
    # φ' = ε − k·v, v' = φ, p' = v; the error of orders 1, 2, 3; the last column is ε.
    A[0, 3], A[0, 1], A[1, 0], A[2, 1] = 1.0, -stiffness, 1.0, 1.0
    step = expm(A * h)
    weights, state = np.zeros((3, n)), step[:3, 3]
    for k in range(n - 1, -1, -1):
        weights[:, k] = state
        state = step[:3, :3] @ state
    constant = weights.sum(axis=1)
    whole = np.concatenate([np.repeat(-constant[:, None] / before, before, axis=1), weights], axis=1)
    covariance = np.zeros((before + n, before + n))
    P = space.P0
    for i in range(before + n):
        row = space.H @ P
        covariance[i, i] = (row @ space.H.T).item() + space.R.item()
        for j in range(i + 1, before + n):
            row = row @ space.A.T
            covariance[i, j] = covariance[j, i] = (row @ space.H.T).item()
        P = space.A @ P @ space.A.T + space.Q
    found = ErrorVariances((1, 2, 3), np.array([n]), before, RATE, stiffness)
    np.testing.assert_allclose(found.of_bias[:, 0], constant, rtol=1e-10)
    expected = np.einsum("ai,ij,aj->a", whole, covariance, whole)
    np.testing.assert_allclose(found(model).sum(axis=0)[:, 0], expected, rtol=1e-7)


def test_flicker_noise_is_that_of_its_closed_form():
    """Attitude after t from a calibration of the same length is 2t² times the Allan variance, 2 ln 2/π·B²."""
    found = ErrorVariances((1,), np.array([400]), 400, RATE)
    B = aj.Model((aj.BiasInstability(2e-4),))
    np.testing.assert_allclose(found(B)[0, 0], 2.0 * 20.0**2 * 2.0 * np.log(2.0) / np.pi * 4e-8, rtol=1e-9)


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize("stiffness", [1.54e-6, -3.1e-6])
def test_responses_to_a_bias_are_exact_from_a_millisecond_to_two_days(order, stiffness):
    """mpmath with 50 digits, on both sides of where the series ends."""
    mpmath = pytest.importorskip("mpmath")
    times = np.array([1e-3, 1.0, 500.0, 805.0, 806.0, 5000.0, 2e4])
    with mpmath.workdps(50):
        k = mpmath.mpf(stiffness)
        w = mpmath.sqrt(k)

        def exact(t):
            t = mpmath.mpf(t)
            sine = mpmath.sin(w * t) / w
            return mpmath.re([sine, (1 - mpmath.cos(w * t)) / k, (t - sine) / k][order - 1])

        expected = [float(exact(t)) for t in times]
    np.testing.assert_allclose(bias_response(times, order, stiffness), expected, rtol=2e-12)


def strapdown(gyro, accel, gravity, h, radius=None):
    """Errors of many navigators at rest: rotation matrices, specific force resolved, and integrated.

    Samples [navigators, n, 3] are those of the errors; axes are north, east and down. With a radius the
    navigation frame turns with the craft over the sphere.
    """
    count, n, _ = gyro.shape
    C = np.broadcast_to(np.eye(3), (count, 3, 3)).copy()
    down = np.array([0.0, 0.0, gravity])
    v, p = np.zeros((count, 3)), np.zeros((count, 3))
    for k in range(n):
        rotation = gyro[:, k] * h
        # To the middle of the interval, where the force is resolved, and to its end.
        middle = np.einsum("cij,cjk->cik", C, turned(rotation / 2.0))
        C = np.einsum("cij,cjk->cik", C, turned(rotation))
        if radius is not None:
            carried = np.stack([v[:, 1], -v[:, 0], np.zeros(count)], axis=1) / radius
            C = np.einsum("cij,cjk->cik", turned(-carried * h), C)
        force = np.einsum("cij,cj->ci", middle, accel[:, k] - down)
        push = force + down
        p += h * v + h**2 / 2.0 * push
        v += h * push
    angles = np.stack(
        [np.arctan2(C[:, 2, 1], C[:, 2, 2]), -np.arcsin(C[:, 2, 0]), np.arctan2(C[:, 1, 0], C[:, 0, 0])],
        axis=1,
    )
    return angles, v, p


def turned(rotation):
    """Rotation matrices by Rodrigues' formula."""
    x, y, z = np.moveaxis(rotation, -1, 0)
    zero = np.zeros_like(x)
    K = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)
    angle = np.linalg.norm(rotation, axis=-1)[:, None, None]
    return np.eye(3) + np.sinc(angle / np.pi) * K + 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2 * K @ K


def drawn(rng, shape, h, white, walk):
    """White noise and the means of a random walk over intervals, from NumPy."""
    steps, bridge = rng.standard_normal((2, *shape)) * walk * math.sqrt(h)
    return white / math.sqrt(h) * rng.standard_normal(shape) + (
        np.cumsum(steps, axis=1) - steps / 2.0 + bridge / math.sqrt(12.0)
    )


NOISES = {"gyro": (2e-4, 5e-5), "accel": (3e-3, 4e-4)}


@pytest.mark.parametrize("radius", [None, 4e4])
def test_errors_are_those_of_a_strapdown_mechanization(radius, monkeypatch):
    """1,500 navigators: a standard deviation scatters by 1/√3000 = 1.8 %, seven are within 7 %.

    On a sphere of 40 km the Schuler period is 400 s, and 60 s are a good part of it. Angles stay below 0.01,
    so that terms beyond the linear ones are below 10⁻⁴.
    """
    count, before, n, h, gravity = 1500, 200, 600, 0.1, 9.8
    rng = np.random.default_rng(11)
    samples = {}
    for sensor, (white, walk) in NOISES.items():
        z = drawn(rng, (count, before + n, 3), h, white, walk)
        samples[sensor] = z[:, before:] - z[:, :before].mean(axis=1, keepdims=True)
    angles, v, p = strapdown(samples["gyro"], samples["accel"], gravity, h, radius)
    models = {}
    for sensor, (white, walk) in NOISES.items():
        model = aj.AngleRandomWalk(white) + aj.RateRandomWalk(walk)
        models |= {f"{sensor}_{letter}": model for letter in "xyz"}
    if radius is not None:
        monkeypatch.setattr("allanjax.navigation.navigator.EARTH_RADIUS", radius)
    found = aj.navigate(
        models, [n * h], rate=1.0 / h, calibration=before * h, gravity=gravity, schuler=radius is not None
    )
    horizontal = slice(0, 3) if radius is None else slice(0, 2)
    for quantity, errors in (("attitude", angles), ("velocity", v), ("position", p)):
        seen = errors.std(axis=0)
        kept = slice(0, 3) if quantity == "attitude" else horizontal
        np.testing.assert_allclose(found[quantity].error[kept, 0], seen[kept], rtol=0.07)


@pytest.fixture(scope="module")
def result(small_fit):
    return aj.navigate(small_fit, calibration=50.0)


def test_a_fit_has_intervals_that_hold_its_own_errors(result, small_fit):
    assert list(result) == ["attitude", "velocity", "position"]
    assert result["attitude"].channels == ("north", "east", "down")
    # There is an accelerometer along z only: north and east have tilt alone.
    assert result["velocity"].channels == ("north", "east", "down")
    for growth in result.values():
        assert np.all(growth.lower <= growth.error)
        assert np.all(growth.error <= growth.upper)
    # At first a gyro's white noise dominates, which a fit of 200 s knows to some 10 %.
    assert np.all(result["attitude"].upper[:, 0] < 1.5 * result["attitude"].lower[:, 0])


def test_results_are_equal_by_value_and_told_in_a_line(result):
    again = pickle.loads(pickle.dumps(result))
    assert again == result
    assert hash(again) == hash(result)
    assert repr(result["attitude"]).startswith("<ErrorGrowth attitude after 1,000 s: north ")
    with pytest.raises(aj.AllanjaxError, match="no error of 'height'; there are attitude"):
        result["height"]
    with pytest.raises(aj.AllanjaxError, match="no error up; there are north, east, down"):
        result["position"].of("up")


def test_causes_add_up_to_the_error(result):
    for growth in result.values():
        for channel in growth.channels:
            total = sum(part**2 for part in growth.causes[channel].values())
            np.testing.assert_allclose(np.sqrt(total), growth.of(channel), rtol=1e-9)


def test_the_interval_holds_the_truth(result):
    """Of the one record that was simulated with these models, at 1 s and at 100 s."""
    truth = aj.navigate(
        {"gyro_x": "N=0.2 deg/√h + B=20 deg/h", "accel_z": "N=0.05 m/s/√h + K=200 m/s/h/√h"},
        result["attitude"].time,
        rate=100.0,
        calibration=50.0,
    )
    at = [0, 12]
    for quantity, channel in (("attitude", "north"), ("velocity", "down"), ("position", "down")):
        k = result[quantity].channels.index(channel)
        assert np.all(result[quantity].lower[k, at] <= truth[quantity].of(channel)[at])
        assert np.all(truth[quantity].of(channel)[at] <= result[quantity].upper[k, at])


def test_the_table_the_frame_and_the_document_tell_the_same(result):
    text = str(result)
    for words in ("1 s", "10 s", "100 s", "1,000 s", "attitude north", "gyro_x", "deg", "95 % interval"):
        assert words in text
    assert "velocity and position north are those of the gyro's tilt alone" in text
    assert "beyond half the record, 100 s, extrapolate the model" in text
    frame, document = result.to_dataframe(), result.to_dict()
    row = frame[(frame.quantity == "position") & (frame.channel == "down")].iloc[-1]
    assert row.error == document["errors"]["position"]["channels"]["down"]["error"][-1]
    assert row.error == result["position"].of("down")[-1]


def test_a_table_of_exact_models_has_no_interval_and_tells_the_times_nearest_to_decades():
    """Neighbouring ones of 30 times between 0.7 s and 2,000 s are 0.12 decades apart."""
    result = aj.navigate({"gyro_x": QUIET}, np.geomspace(0.7, 2000.0, 30), rate=RATE)
    text = str(result)
    assert "interval" not in text
    rows = [line.split("│") for line in text.splitlines() if line.startswith("│")]
    told = [float(row[2].replace(",", "").removesuffix(" s ")) for row in rows[:5]]
    np.testing.assert_allclose(np.log10(told), [0, 1, 2, 3, np.log10(2000.0)], atol=0.07)


def test_intervals_of_a_posterior_are_those_of_its_draws():
    """Angles of white noise: N² (t + t²/C), so that the interval is that of N but for the choice of draws.

    400 of 1,000 or more draws scatter the ends by a tenth of their distance.
    """
    recording = aj.simulate_recording({"gyro_x": aj.AngleRandomWalk(1e-3)}, 20_000, RATE, 1)
    fit = aj.fit(recording, "N", as_is=True)
    posterior = aj.sample(fit, seed=1)
    attitude = aj.navigate(posterior, [1.0, 10.0], calibration=50.0)["attitude"]
    N, grown = posterior["gyro_x"]["angle_random_walk"], np.sqrt([1.0 + 1.0 / 50.0, 10.0 + 100.0 / 50.0])
    np.testing.assert_allclose(attitude.of("north"), N.value * grown, rtol=0.1 * N.std / N.value)
    for found, end in zip((attitude.lower, attitude.upper), N.interval, strict=True):
        np.testing.assert_allclose(found[0], end * grown, rtol=0.4 * N.std / N.value)
    tilted = aj.align(posterior, 45.0)["gyro_x"]
    assert tilted.lower[-1] < tilted.error[-1] < tilted.upper[-1]


def test_draws_of_a_posterior_have_their_own_correlation_times():
    model = aj.AngleRandomWalk(1e-3) + aj.Markov(1e-3, 5.0)
    recording = aj.simulate_recording({"gyro_x": model}, 20_000, RATE, 1)
    fit = aj.fit(recording, "N + markov", as_is=True)
    posterior = aj.sample(fit, seed=1)
    found = aj.navigate(posterior, [10.0], calibration=50.0)["attitude"]
    of_draws = [
        aj.navigate({"gyro_x": model}, [10.0], rate=RATE, calibration=50.0)["attitude"].of("north")[0]
        for model in posterior["gyro_x"].models(100)
    ]
    # The central 95 % of 100 draws end between the third and fourth from either side.
    ordered, slack = np.sort(of_draws), 1.0 + 1e-9
    assert ordered[2] / slack <= found.lower[0, 0] <= slack * ordered[3]
    assert ordered[96] / slack <= found.upper[0, 0] <= slack * ordered[97]


@pytest.mark.usefixtures("no_windows")
def test_the_picture_has_a_panel_an_error_with_its_causes(result, tmp_path):
    figure = result.plot(tmp_path / "a.png")
    titles = [panel.get_title(loc="left") for panel in figure.axes]
    assert titles[0] == "attitude north [deg]"
    assert len(titles) == 9
    panel = figure.axes[titles.index("position down [m]")]
    model = next(line for line in panel.lines if line.get_label() == "model")
    np.testing.assert_allclose(model.get_ydata(), result["position"].of("down"))
    shown = {line.get_label() for line in panel.lines} - {"model"}
    assert set(result["position"].largest("down")) <= shown <= set(result["position"].causes["down"])
    assert (tmp_path / "a.png").stat().st_size > 1000


@pytest.mark.usefixtures("no_windows")
def test_no_two_causes_look_alike():
    """Eight causes for six colours and six dashes."""
    models = {
        "gyro_y": "N=1 deg/√h + B=10 deg/h + K=20 deg/h/√h + Q=50 arcsec",
        "accel_x": "N=0.1 m/s/√h + B=100 µg + K=1 m/s/h/√h + Q=0.01 m/s",
    }
    figure = aj.navigate(models, np.geomspace(0.05, 1000.0, 20), rate=RATE).plot()
    styles = {
        line.get_label(): (line.get_color(), str(line._dash_pattern))
        for line in figure.legends[0].get_lines()
    }
    assert len(styles) >= 7
    assert len(set(styles.values())) == len(styles)


def test_the_loop_holds_errors_back_and_its_absence_is_told():
    """A constant tilt rate makes R(t − sin ωt/ω): after half a Schuler period less than a third."""
    models, times = {"gyro_y": QUIET, "accel_x": QUIET}, [10.0, 1266.0, 2533.0]
    options = {"rate": 1.0, "gyro_bias": "0.01 deg/h"}
    short = aj.navigate(models, times, **options)
    loop = aj.navigate(models, times, schuler=True, **options)
    assert "hold up to 21.1 min, a quarter of the Schuler period" in str(short)
    assert "hold up to" not in str(loop)
    w = math.sqrt(short.gravity / EARTH_RADIUS)
    t = loop["position"].time
    expected = 0.01 * DEG / 3600.0 * EARTH_RADIUS * (t - np.sin(w * t) / w)
    np.testing.assert_allclose(loop["position"].of("north"), expected, rtol=1e-5)
    assert short["position"].of("north")[0] == pytest.approx(loop["position"].of("north")[0], rel=1e-4)
    assert short["position"].of("north")[2] > 1.5 * loop["position"].of("north")[2]


@pytest.mark.parametrize(
    ("data", "options", "message"),
    [
        ({"gyro_x": QUIET}, {}, "models need the sample rate"),
        ({}, {"rate": 1.0}, "give a fit, a posterior, or models by axis"),
        ({"temperature": QUIET}, {"rate": 1.0}, "'temperature' is no axis"),
        ({"gyro_x": QUIET}, {"rate": 1.0, "times": [0.1]}, "times must be finite and at least a sample"),
        ({"gyro_x": QUIET}, {"rate": 1.0, "calibration": 0.0}, "calibration must be finite"),
        ({"gyro_x": QUIET}, {"rate": 1e4, "times": [1e3]}, "times may be up to 210 s"),
        ({"gyro_x": QUIET}, {"rate": 1.0, "gyro_bias": -1.0}, "gyro_bias must be finite and not negative"),
        ({"gyro_x": QUIET}, {"rate": 1.0, "gyro_bias": "much"}, "cannot read 'much'"),
        ({"gyro_x": QUIET}, {"rate": 1.0, "gyro_bias": "1 m/s²"}, "m/s²"),
        ({"gyro_x": QUIET}, {"rate": 1.0, "gravity": 0.0}, "gravity must be positive"),
    ],
)
def test_what_is_wrong_is_refused(data, options, message):
    with pytest.raises(aj.AllanjaxError, match=message):
        aj.navigate(data, **options)


def test_an_axis_without_a_measurement_is_left_out_by_name(small_fit):
    first, *others = small_fit.results
    bad = dataclasses.replace(first, converged=False, reason="no start")
    fit = dataclasses.replace(small_fit, results=(bad, *others))
    assert "gyro_x is left out: no result: no start" in str(aj.navigate(fit, [1.0]))
    fit = dataclasses.replace(small_fit, results=(bad,))
    with pytest.raises(aj.FitError, match="no axis has a measurement"):
        aj.navigate(fit)
