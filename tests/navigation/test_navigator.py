"""Growth of a navigator's errors: against dense covariances, a strapdown mechanization, and the thesis."""

import dataclasses
import functools
import json
import math

import bench
import numpy as np
import pytest

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
    "N": aj.AngleRandomWalk(1e-3),
    "K": aj.RateRandomWalk(1e-4),
    "Q": aj.Quantization(1e-5),
    "markov": aj.Markov(1e-4, 3.0),
    "sinusoid": aj.Sinusoid(1e-3, 3.3),
    "ramp": aj.DriftRamp(1e-7),
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


@pytest.mark.parametrize("schuler", [False, True])
@pytest.mark.parametrize("name", MODELS)
def test_errors_are_those_of_a_dense_covariance(name, schuler):
    """A gravity of 0.01·R makes a loop of 63 s: series and closed forms differ from polynomials.

    The tilt loop has ω² = g/R, the vertical channel −2g/R, the heading none. Rounding of G's cancelling parts
    allows 10⁻⁷ of the variance.
    """
    model = MODELS[name] if isinstance(MODELS[name], aj.Model) else aj.Model((MODELS[name],))
    gravity, k = 0.01 * RADIUS, 0.01 * schuler
    axes = dict.fromkeys(("gyro_y", "gyro_z", "accel_x", "accel_z"), model)
    found = aj.navigate(
        axes, [AFTER / RATE], rate=RATE, calibration=BEFORE / RATE, gravity=gravity, schuler=schuler
    )
    C = covariance_of_samples(model)
    level, vertical, heading = (
        np.sqrt(np.einsum("ai,ij,aj->a", w, C, w)) for w in map(weights, (k, -2.0 * k, 0))
    )
    expected = {
        ("attitude", "east"): level[0],
        ("attitude", "down"): heading[0],
        ("velocity", "north"): np.hypot(level[0], gravity * level[1]),
        ("position", "north"): np.hypot(level[1], gravity * level[2]),
        ("velocity", "down"): vertical[0],
        ("position", "down"): vertical[1],
    }
    for (quantity, channel), error in expected.items():
        assert found[quantity].of(channel)[0] == pytest.approx(error, rel=1e-7), (quantity, channel)
    assert found["attitude"].channels == ("east", "down")
    by_gyro, by_accel = (
        sum(
            part[0] ** 2
            for cause, part in found["position"].causes["north"].items()
            if cause.startswith(axis)
        )
        for axis in ("gyro_y", "accel_x")
    )
    assert np.sqrt(by_gyro) == pytest.approx(gravity * level[2], rel=1e-7)
    assert np.sqrt(by_accel) == pytest.approx(level[1], rel=1e-7)


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
        push = np.einsum("cij,cj->ci", middle, accel[:, k] - down) + down
        p += h * v + h**2 / 2.0 * push
        v += h * push
    angles = [np.arctan2(C[:, 2, 1], C[:, 2, 2]), -np.arcsin(C[:, 2, 0]), np.arctan2(C[:, 1, 0], C[:, 0, 0])]
    return np.stack(angles, axis=1), v, p


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
    walked = np.cumsum(steps, axis=1) - steps / 2.0 + bridge / math.sqrt(12.0)
    return white / math.sqrt(h) * rng.standard_normal(shape) + walked


@pytest.mark.parametrize(("schuler", "gravity", "push"), [(False, 9.8, 1.0), (True, 1600.0, 160.0)])
def test_errors_are_those_of_a_strapdown_mechanization(schuler, gravity, push):
    """800 navigators: a standard deviation scatters by 1/√1600 = 2.5 %, and eight are within 10 %.

    With a gravity of 1,600 m/s² the Schuler period is 400 s, and 60 s are a good part of it. Angles stay
    below 0.01, so that terms beyond the linear ones are below 10⁻⁴. On the sphere no vertical is simulated.
    """
    count, before, n, h = 800, 100, 300, 0.2
    noises = {"gyro": (2e-4, 5e-5), "accel": (3e-3 * push, 4e-4 * push)}
    rng, samples, models = np.random.default_rng(11), {}, {}
    for sensor, (white, walk) in noises.items():
        z = drawn(rng, (count, before + n, 3), h, white, walk)
        samples[sensor] = z[:, before:] - z[:, :before].mean(axis=1, keepdims=True)
        models |= {f"{sensor}_{a}": aj.AngleRandomWalk(white) + aj.RateRandomWalk(walk) for a in "xyz"}
    errors = strapdown(samples["gyro"], samples["accel"], gravity, h, RADIUS if schuler else None)
    options = {"rate": 1.0 / h, "calibration": before * h, "gravity": gravity, "schuler": schuler}
    found = aj.navigate(models, [n * h], **options)
    for quantity, seen in zip(found, errors, strict=True):
        kept = slice(0, 2 if schuler and quantity != "attitude" else 3)
        np.testing.assert_allclose(found[quantity].error[kept, 0], seen.std(axis=0)[kept], rtol=0.1)


# ------------------------------------------------------------------------------------------------- intervals
@pytest.fixture(scope="module")
def result():
    return aj.navigate(bench.fit("small"), calibration=50.0, gyro_bias="2 deg/h", accel_bias=1e-3)


def test_a_fit_has_intervals_that_hold_the_truth(result):
    """Of the one record: the true model with the same biases, at 1 s and at 100 s, in each direction."""
    truth = bench.truth("small").truth
    terms = {"angle_random_walk": "N", "bias_instability": "B", "rate_random_walk": "K"}
    units = {"gyro": {"N": "rad/√s", "B": "rad/s"}, "accel": {"N": "m/s/√s", "K": "m/s²/√s"}}
    models = {
        name: " + ".join(f"{terms[k]}={x} {units[name.split('_')[0]][terms[k]]}" for k, x in of.items())
        for name, of in truth.items()
    }
    time, options = result["attitude"].time, {"gyro_bias": "2 deg/h", "accel_bias": 1e-3}
    exact = aj.navigate(models, time, rate=100.0, calibration=50.0, **options)
    assert list(result) == ["attitude", "velocity", "position"]
    assert time[[0, -1]] == pytest.approx([1.0, 1000.0])
    for quantity, growth in result.items():
        assert growth.channels == ("north", "east", "down")
        assert np.all((growth.lower < growth.error) & (growth.error < growth.upper))
        at = [0, 12]
        assert np.all(growth.lower[:, at] <= exact[quantity].error[:, at])
        assert np.all(exact[quantity].error[:, at] <= growth.upper[:, at])
        assert np.isnan(exact[quantity].lower).all()
        for k, channel in enumerate(growth.channels):
            parts = growth.causes[channel]
            np.testing.assert_allclose(sum(p**2 for p in parts.values()), growth.error[k] ** 2, rtol=1e-9)
            largest = [max(parts, key=lambda name, j=j: parts[name][j]) for j in range(len(time))]
            assert growth.largest(channel) == largest
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
    t, options = [1.0, 10.0, 60.0], {"calibration": 40.0}
    biases = {"gyro_bias": 3e-6, "accel_bias": 2e-4}
    found = aj.navigate(posterior, t, **options, **biases)
    for name, quantity, channel, power, bias in (
        ("gyro_x", "attitude", "north", 1.0, 3e-6),
        ("accel_z", "velocity", "down", 1.0, 2e-4),
        ("accel_z", "position", "down", 2.0, 2e-4 / 2.0),
    ):
        variances = []
        for model in posterior[name].models(400):
            amplitudes = [getattr(term, term.amplitude_parameter().name) for term in model.terms]
            unit = [
                unit_error(name, type(term).__name__, quantity, channel, tuple(t)) for term in model.terms
            ]
            variances.append(sum((a * u) ** 2 for a, u in zip(amplitudes, unit, strict=True)))
        variances = np.array(variances) + (bias * np.array(t) ** power) ** 2
        growth = found[quantity]
        k = growth.channels.index(channel)
        np.testing.assert_allclose(growth.error[k], np.sqrt(variances.mean(axis=0)), rtol=1e-9)
        ends = np.sqrt(np.quantile(variances, [0.025, 0.975], axis=0))
        np.testing.assert_allclose([growth.lower[k], growth.upper[k]], ends, rtol=1e-9)


@functools.cache
def unit_error(axis, term, quantity, channel, t):
    """Error of a term of amplitude one by itself."""
    found = aj.navigate({axis: getattr(aj, term)(1.0)}, t, rate=100.0, calibration=40.0)
    return found[quantity].of(channel)


# ------------------------------------------------------------------------------------------ words and figures
def test_the_table_the_frame_and_the_document_tell_the_same(result):
    frame, document = result.to_dataframe(), json.loads(json.dumps(result.to_dict(), allow_nan=False))
    for quantity, growth in result.items():
        for k, channel in enumerate(growth.channels):
            rows = frame[(frame.quantity == quantity) & (frame.channel == channel)]
            told = document["errors"][quantity]["channels"][channel]
            for column, values in (
                ("error", growth.error),
                ("lower_95", growth.lower),
                ("upper_95", growth.upper),
            ):
                np.testing.assert_array_equal(rows[column], values[k])
                np.testing.assert_array_equal(told[column], values[k])
            assert set(rows.unit) == {{"attitude": "rad", "velocity": "m/s", "position": "m"}[quantity]}
    assert (document["calibration_s"], document["rate_hz"], document["gravity_m_s2"]) == (50.0, 100.0, G)
    attitude = result["attitude"]
    told = [line.split("│")[1:6] for line in str(result).splitlines() if line.startswith("│")][:4]
    assert [row[1].strip() for row in told] == ["1 s", "10 s", "100 s", "1,000 s"]
    for row, at in zip(told, (0, 6, 12, 18), strict=True):
        numbers = [float(x) for x in f"{row[2]} {row[3]}".replace("deg", "").replace("…", "").split()]
        expected = np.array([attitude.error[0, at], attitude.lower[0, at], attitude.upper[0, at]]) / DEG
        np.testing.assert_allclose(numbers, expected, rtol=6e-3)


def test_exact_models_have_no_interval_and_are_told_at_decades():
    """Neighbouring ones of 30 times between 0.7 s and 2,000 s are 0.12 decades apart."""
    text = str(aj.navigate({"gyro_x": QUIET}, np.geomspace(0.7, 2000.0, 30), rate=RATE))
    assert "interval" not in text
    rows = [line.split("│") for line in text.splitlines() if line.startswith("│")]
    told = [float(row[2].replace(",", "").removesuffix(" s ")) for row in rows[:5]]
    np.testing.assert_allclose(np.log10(told), [0, 1, 2, 3, np.log10(2000.0)], atol=0.07)


def test_what_a_result_is_good_for_is_noted():
    """A quarter of the Schuler period, half of the record, axes without a measurement."""
    models, times = {"gyro_y": QUIET, "accel_x": QUIET}, [10.0, 1266.0, 1268.0]
    assert aj.navigate(models, times, rate=1.0).quarter_period == pytest.approx(1266.05, abs=0.1)
    for last, schuler, word in (
        (1266.0, False, ""),
        (1267.0, False, "schuler=True"),
        (1267.0, True, "unstable"),
    ):
        notes = aj.navigate(models, [last], rate=1.0, schuler=schuler).notes
        assert " ".join(notes).count(word) == 1 if word else notes == ()
    first, *others = bench.fit("small").results
    bad = dataclasses.replace(first, converged=False, reason="no start")
    fit = dataclasses.replace(bench.fit("small"), results=(bad, *others))
    # The record has 163.84 s.
    for time, words in ((20.0, ["gyro_x"]), (23.0, ["gyro_x", "extrapolate"])):
        notes = " ".join(aj.navigate(fit, [time], calibration=60.0).notes)
        assert ("extrapolate" in notes) == ("extrapolate" in words)
        assert "gyro_x is left out" in notes
    with pytest.raises(aj.FitError, match="measurement"):
        aj.navigate(dataclasses.replace(fit, results=(bad,)))


@pytest.mark.parametrize(
    ("data", "options", "word"),
    [
        ({"gyro_x": QUIET}, {}, "rate"),
        ({}, {"rate": 1.0}, "models"),
        ({"temperature": QUIET}, {"rate": 1.0}, "temperature"),
        ({"gyro_q": QUIET}, {"rate": 1.0}, "gyro_q"),
        ({"gyro_x": QUIET}, {"rate": 1.0, "times": [0.1]}, "times"),
        ({"gyro_x": QUIET}, {"rate": 1.0, "calibration": 0.0}, "calibration"),
        ({"gyro_x": QUIET}, {"rate": 1e4, "times": [1e3]}, "210 s"),
        ({"gyro_x": QUIET}, {"rate": 1.0, "gyro_bias": -1.0}, "gyro_bias"),
        ({"gyro_x": QUIET}, {"rate": 1.0, "accel_bias": "much"}, "accel_bias"),
        ({"gyro_x": QUIET}, {"rate": 1.0, "gyro_bias": "1 m/s²"}, "m/s²"),
        ({"gyro_x": QUIET}, {"rate": 1.0, "gravity": 0.0}, "gravity"),
    ],
)
def test_what_is_wrong_is_refused(data, options, word):
    with pytest.raises(aj.AllanjaxError, match=word):
        aj.navigate(data, **options)


def test_a_fit_has_its_own_rate_and_an_unknown_error_is_named(result):
    with pytest.raises(aj.AllanjaxError, match="rate"):
        aj.navigate(bench.fit("small"), rate=100.0)
    with pytest.raises(aj.AllanjaxError, match="height"):
        result["height"]
    with pytest.raises(aj.AllanjaxError, match="up"):
        result["position"].of("up")
