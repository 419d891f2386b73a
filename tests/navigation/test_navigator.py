"""Growth of a navigator's errors: against dense covariances, the thesis, mpmath, and draws."""

import dataclasses
import json
import math

import bench
import numpy as np
import pytest
from altered_fits import without_result

import allanjax as aj

DEG = math.pi / 180.0
RATE, RADIUS, G = 20.0, 6_371_000.0, 9.80665
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


MODELS = {
    "N": aj.Model((aj.AngleRandomWalk(1e-3),)),
    "K": aj.Model((aj.RateRandomWalk(1e-4),)),
    "Q": aj.Model((aj.Quantization(1e-5),)),
    "markov": aj.Model((aj.Markov(1e-4, 3.0),)),
    "sinusoid": aj.Model((aj.Sinusoid(1e-3, 3.3),)),
    "ramp": aj.Model((aj.DriftRamp(1e-7),)),
    "filter": aj.LowPass1(4.0) * (aj.AngleRandomWalk(1e-3) + aj.RateRandomWalk(1e-4)),
}
BEFORE, AFTER = 90, 60


def weights(stiffness):
    """What the mean error of each sample does to φ, φ's integral and its double integral after 60 samples.

    φ' = ε − k·v, v' = φ, p' = v, by the matrix exponential of the differential equation; with the samples of
    the calibration before, whose mean is taken out.
    """
    from scipy.linalg import expm

    A = np.zeros((4, 4))
    A[0, 3], A[0, 1], A[1, 0], A[2, 1] = 1.0, -stiffness, 1.0, 1.0
    step = expm(A / RATE)
    after, state = np.zeros((3, AFTER)), step[:3, 3]
    for k in range(AFTER - 1, -1, -1):
        after[:, k] = state
        state = step[:3, :3] @ state
    constant = after.sum(axis=1)
    return np.concatenate([np.repeat(-constant[:, None] / BEFORE, BEFORE, axis=1), after], axis=1)


def covariance_of_samples(model):
    """Dense covariance of 150 samples, from the state space of the noise."""
    space, n = model.state_space(RATE), BEFORE + AFTER
    covariance, P = np.zeros((n, n)), space.P0
    for i in range(n):
        row = space.H @ P
        covariance[i, i] = (row @ space.H.T).item() + space.R.item()
        for j in range(i + 1, n):
            row = row @ space.A.T
            covariance[i, j] = covariance[j, i] = (row @ space.H.T).item()
        P = space.A @ P @ space.A.T + space.Q
    return covariance


@pytest.mark.parametrize("name", MODELS)
def test_errors_are_those_of_a_dense_covariance(name):
    """A gravity of 0.01·R makes a loop of 63 s: series and closed forms differ from polynomials.

    The tilt loop has ω² = g/R, the vertical channel −2g/R, the heading none; towards east there is white
    noise. Rounding of G's cancelling parts allows 10⁻⁷ of the variance.
    """
    model, white, gravity = MODELS[name], aj.AngleRandomWalk(2e-3), 0.01 * RADIUS
    axes = dict.fromkeys(("gyro_y", "gyro_z", "accel_x", "accel_z"), model) | {
        "gyro_x": white,
        "accel_y": white,
    }
    C, of_white = covariance_of_samples(model), 2e-3**2 * RATE * np.eye(BEFORE + AFTER)
    for schuler in (False, True):
        options = {"rate": RATE, "calibration": BEFORE / RATE, "gravity": gravity, "schuler": schuler}
        found = aj.navigate(axes, [AFTER / RATE], **options)

        def errors(C, k):
            return np.sqrt(np.einsum("ai,ij,aj->a", w := weights(k), C, w))

        k = 0.01 * schuler
        level, vertical = errors(C, k), errors(C, -2.0 * k)
        tilt = np.stack([level, errors(of_white, k)], axis=1)
        expected = {
            "attitude": (tilt[0, 1], tilt[0, 0], errors(C, 0.0)[0]),
            "velocity": (*np.hypot(tilt[0], gravity * tilt[1]), vertical[0]),
            "position": (*np.hypot(tilt[1], gravity * tilt[2]), vertical[1]),
        }
        for quantity, error in expected.items():
            assert found[quantity].channels == ("north", "east", "down")
            np.testing.assert_allclose(found[quantity].error[:, 0], error, rtol=1e-7)
        for axis, error in (("gyro_y", gravity * level[2]), ("accel_x", level[1])):
            parts = [p[0] for cause, p in found["position"].causes["north"].items() if cause.startswith(axis)]
            assert math.hypot(*parts) == pytest.approx(error, rel=1e-7)


def test_flicker_noise_is_that_of_its_closed_form():
    """Attitude after t from a calibration of the same length is 2t² times the Allan variance, 2 ln 2/π·B²."""
    found = aj.navigate({"gyro_x": aj.BiasInstability(2e-4)}, [20.0], rate=RATE, calibration=20.0)
    expected = math.sqrt(2.0 * 20.0**2 * 2.0 * math.log(2.0) / math.pi) * 2e-4
    assert found["attitude"].of("north")[0] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(
    ("rate", "times"), [(1000.0, [1e-3, 1.0]), (2.0, [0.5, 500, 805, 806, 807, 5000, 2e4])]
)
def test_responses_to_a_bias_are_exact_from_a_millisecond_to_hours(rate, times):
    """mpmath with 50 digits, on both sides of 806 s, where the series ends; a bias by itself."""
    mpmath = pytest.importorskip("mpmath")
    models = {"gyro_y": QUIET, "accel_x": QUIET, "accel_z": QUIET}
    found = aj.navigate(models, times, rate=rate, schuler=True, gyro_bias=3e-6, accel_bias=2e-3)

    def exact(order, k):
        with mpmath.workdps(50):
            k = mpmath.mpf(k)
            w = mpmath.sqrt(k)

            def response(t):
                sine = mpmath.sin(w * t) / w
                return mpmath.re([sine, (1 - mpmath.cos(w * t)) / k, (t - sine) / k][order - 1])

            return np.array([float(response(mpmath.mpf(t))) for t in times])

    level, vertical = G / RADIUS, -2.0 * G / RADIUS
    for quantity, channel, cause, size, order, k in (
        ("attitude", "east", "gyro_y bias", 3e-6, 1, level),
        ("velocity", "north", "gyro_y bias", 3e-6 * G, 2, level),
        ("position", "north", "gyro_y bias", 3e-6 * G, 3, level),
        ("velocity", "north", "accel_x bias", 2e-3, 1, level),
        ("position", "north", "accel_x bias", 2e-3, 2, level),
        ("velocity", "down", "accel_z bias", 2e-3, 1, vertical),
        ("position", "down", "accel_z bias", 2e-3, 2, vertical),
    ):
        got = found[quantity].causes[channel][cause]
        np.testing.assert_allclose(got, np.abs(size * exact(order, k)), rtol=3e-12)


@pytest.fixture(scope="module")
def result():
    return aj.navigate(bench.fit("small"), calibration=50.0, gyro_bias="2 deg/h", accel_bias=1e-3)


def test_a_fit_has_intervals_that_hold_the_truth_and_is_told(result):
    """Of the one record: the true model with the same biases, at 1 s and at 100 s, in each direction."""
    of = {"angle": aj.AngleRandomWalk, "bias": aj.BiasInstability, "rate": aj.RateRandomWalk}
    truth = {k: [of[p.split("_")[0]](x) for p, x in v.items()] for k, v in bench.truth("small").truth.items()}
    models, time = {k: aj.Model(tuple(terms)) for k, terms in truth.items()}, result["attitude"].time
    options = {"calibration": 50.0, "gyro_bias": "2 deg/h", "accel_bias": 1e-3}
    exact = aj.navigate(models, time, rate=100.0, **options)
    frame, document = result.to_dataframe(), json.loads(json.dumps(result.to_dict(), allow_nan=False))
    assert list(result) == ["attitude", "velocity", "position"]
    assert time[[0, -1]] == pytest.approx([1.0, 1000.0])
    for quantity, growth in result.items():
        assert growth.channels == ("north", "east", "down")
        assert np.all((growth.lower < growth.error) & (growth.error < growth.upper))
        true = exact[quantity].error[:, [0, 12]]
        assert np.all((growth.lower[:, [0, 12]] <= true) & (true <= growth.upper[:, [0, 12]]))
        assert np.isnan(exact[quantity].lower).all()
        for k, channel in enumerate(growth.channels):
            parts = growth.causes[channel]
            np.testing.assert_allclose(sum(p**2 for p in parts.values()), growth.error[k] ** 2, rtol=1e-9)
            largest = [max(parts, key=lambda name, j=j: parts[name][j]) for j in range(len(time))]
            assert growth.largest(channel) == largest
            rows = frame[(frame.quantity == quantity) & (frame.channel == channel)]
            told = document["errors"][quantity]["channels"][channel]
            for column, name in (("error", "error"), ("lower_95", "lower"), ("upper_95", "upper")):
                np.testing.assert_array_equal(rows[column], getattr(growth, name)[k])
                np.testing.assert_array_equal(told[column], getattr(growth, name)[k])
            assert set(rows.unit) == {{"attitude": "rad", "velocity": "m/s", "position": "m"}[quantity]}
    assert (document["calibration_s"], document["rate_hz"], document["gravity_m_s2"]) == (50.0, 100.0, G)
    # There is an accelerometer along z only.
    assert any("velocity and position north" in note for note in result.notes)


def test_the_interval_of_one_term_is_that_of_its_coefficient():
    """Angles of white noise: N² (t + t²/C) + b² t²; draws scatter the ends by a sixth of N's deviation."""
    fit = bench.fit("white", "N")
    N, t, bias = fit["gyro_x"]["angle_random_walk"], np.array([1.0, 10.0]), 3e-6
    found = aj.navigate(fit, t, calibration=50.0, gyro_bias=bias)["attitude"]
    for row, value in ((found.error, N.value), (found.lower, N.interval[0]), (found.upper, N.interval[1])):
        white = np.sqrt(row[0] ** 2 - (bias * t) ** 2) / np.sqrt(t + t**2 / 50.0)
        np.testing.assert_allclose(white, value, atol=0.5 * N.std)


def test_intervals_of_a_posterior_are_those_of_its_draws():
    """Each variance is linear in the powers of the terms: quantiles of 400 draws, and biases beside them."""
    posterior = bench.posterior("small", ("gyro_x", "accel_z"))
    t = np.array([1.0, 10.0, 60.0])
    found = aj.navigate(posterior, t, calibration=40.0, gyro_bias=3e-6, accel_bias=2e-4)
    for name, quantity, channel, bias in (
        ("gyro_x", "attitude", "north", 3e-6 * t),
        ("accel_z", "velocity", "down", 2e-4 * t),
        ("accel_z", "position", "down", 2e-4 * t**2 / 2.0),
    ):
        models = posterior[name].models(400)
        variances = bias**2
        for k, term in enumerate(models[0].terms):
            # That of a term of amplitude one by itself.
            unit = aj.navigate({name: type(term)(1.0)}, t, rate=100.0, calibration=40.0)[quantity].of(channel)
            amplitude = term.amplitude_parameter().name
            squares = np.square([getattr(model.terms[k], amplitude) for model in models])
            variances = variances + np.outer(squares, unit**2)
        growth, k = found[quantity], found[quantity].channels.index(channel)
        np.testing.assert_allclose(growth.error[k], np.sqrt(variances.mean(axis=0)), rtol=1e-9)
        ends = np.sqrt(np.quantile(variances, [0.025, 0.975], axis=0))
        np.testing.assert_allclose([growth.lower[k], growth.upper[k]], ends, rtol=1e-9)


def test_tables_tell_decades(result):
    """Of 30 times of an exact model between 0.7 s and 2,000 s, neighbours are 0.12 decades apart."""
    attitude = result["attitude"]
    told = [line.split("│")[1:6] for line in str(result).splitlines() if line.startswith("│")][:4]
    assert [row[1].strip() for row in told] == ["1 s", "10 s", "100 s", "1,000 s"]
    for row, at in zip(told, (0, 6, 12, 18), strict=True):
        numbers = [float(x) for x in f"{row[2]} {row[3]}".replace("deg", "").replace("…", "").split()]
        expected = np.array([attitude.error[0, at], attitude.lower[0, at], attitude.upper[0, at]]) / DEG
        np.testing.assert_allclose(numbers, expected, rtol=6e-3)
    text = str(aj.navigate({"gyro_x": QUIET}, np.geomspace(0.7, 2000.0, 30), rate=RATE))
    assert "interval" not in text
    rows = [line.split("│")[2] for line in text.splitlines() if line.startswith("│")][:5]
    told = [float(row.replace(",", "").removesuffix(" s ")) for row in rows]
    np.testing.assert_allclose(np.log10(told), [0, 1, 2, 3, np.log10(2000.0)], atol=0.07)


def test_what_a_result_is_good_for_is_noted():
    """A quarter of the Schuler period, half of the record, axes without a measurement."""
    models, times = {"gyro_y": QUIET, "accel_x": QUIET}, [10.0, 1266.0, 1268.0]
    assert aj.navigate(models, times, rate=1.0).quarter_period == pytest.approx(1266.05, abs=0.1)
    for last, schuler, word in ((1266.0, False, ""), (1267.0, False, "schuler="), (1267.0, True, "unstable")):
        notes = aj.navigate(models, [last], rate=1.0, schuler=schuler).notes
        assert " ".join(notes).count(word) == 1 if word else notes == ()
    bad = without_result(bench.fit("small"), "gyro_x")
    # The record has 163.84 s.
    for time, extrapolated in ((20.0, False), (23.0, True)):
        notes = " ".join(aj.navigate(bad, [time], calibration=60.0).notes)
        assert ("extrapolate" in notes) == extrapolated
        assert "gyro_x is left out" in notes
    with pytest.raises(aj.AllanjaxError, match="rate"):
        aj.navigate(bad, rate=100.0)
    with pytest.raises(aj.FitError, match="measurement"):
        aj.navigate(dataclasses.replace(bad, results=bad.results[:1]))


@pytest.mark.parametrize(
    ("data", "options", "word"),
    [
        ({"gyro_x": QUIET}, {}, "rate"),
        ({}, {"rate": 1.0}, "models"),
        ({"gyro_q": QUIET}, {"rate": 1.0}, "gyro_q"),
        ({"gyro_x": QUIET}, {"rate": 1.0, "times": [0.1]}, "times"),
        ({"gyro_x": QUIET}, {"rate": 1.0, "calibration": 0.0}, "calibration"),
        ({"gyro_x": QUIET}, {"rate": 1e4, "times": [1e3]}, "210 s"),
        ({"gyro_x": QUIET}, {"rate": 1.0, "gyro_bias": -1.0}, "gyro_bias"),
        ({"gyro_x": QUIET}, {"rate": 1.0, "gyro_bias": "1 m/s²"}, "m/s²"),
        ({"gyro_x": QUIET}, {"rate": 1.0, "gravity": 0.0}, "gravity"),
    ],
)
def test_what_is_wrong_is_refused(data, options, word):
    with pytest.raises(aj.AllanjaxError, match=word):
        aj.navigate(data, **options)


def test_an_unknown_error_is_named(result):
    for word, get in (("height", lambda: result["height"]), ("up", lambda: result["position"].of("up"))):
        with pytest.raises(aj.AllanjaxError, match=word):
            get()
