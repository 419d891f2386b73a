"""Calibrations: every number against dense least squares of sensors simulated by (2.22) and (2.23)."""

import dataclasses
import json

import numpy as np
import pytest
from refusals import refuses
from scipy.optimize import fsolve
from scipy.stats import chi2 as chi2_law
from scipy.stats import norm
from scipy.stats import t as student
from turned_sensors import BIAS, EIGHTEEN, SIX, SN, Errors, G, at_rest, dense, jacobian, least_squares

import allanjax as aj

DEG_H = np.pi / 180.0 / 3600.0
EARTH_RATE_DEG_H = 15.041067
WHITE, N, K = "N=0.0134 m/s/√h", 2e-3, 3e-5
RATE = 5.0
# Of different lengths, apart, and not in the order of time.
START, LENGTH = np.array([0.0, 900.0, 200.0]), np.array([150.0, 300.0, 500.0])
readings_of = Errors(SN, BIAS, np.zeros(3)).readings


def calibrated(records, orientations=None, model=WHITE, **options):
    """A calibration with the gravity of the tests, by all of each recording."""
    return aj.calibrate(records, orientations, gravity=G, model=model, as_is=True, **options)


def six_of(means, n=32, rate=20.0):
    """Recordings of the six positions that have these means."""
    return {name: at_rest(m, n, rate) for name, m in zip(SIX, means, strict=True)}


def check_estimates(coefficients, values, std, rtol=1e-6):
    """Values, standard deviations and both intervals, which are those of a normal law."""
    for c, value, sigma in zip(coefficients, values, std, strict=True):
        assert c.value == pytest.approx(value, abs=1e-3 * sigma + 1e-12)
        assert c.std == pytest.approx(sigma, rel=rtol)
        for interval, probability in ((c.interval, 0.95), (c.interval_68, 0.68)):
            ends = norm.interval(probability, value, sigma)
            np.testing.assert_allclose(interval, ends, atol=(1e-3 + 2.0 * rtol) * sigma)


def flicker_covariance():
    """∫ S(f) H_k(f)* H_l(f) df of S = B²/(2πf), B = 2e-4, where H are the transforms of the contrasts."""
    # A thousand frequencies a decade from 1e-7 Hz to 30 Hz, beyond which 1e-6 of the power is left.
    f = np.geomspace(1e-7, 30.0, 8500)
    of = lambda a, d: np.sinc(f * d) * np.exp(-2j * np.pi * f * (a + d / 2.0))  # noqa: E731
    H = np.stack([of(a, d) - of(0.0, 1200.0) for a, d in zip(START, LENGTH, strict=True)])
    power = 2.0 * 4e-8 / (2.0 * np.pi * f)
    return np.trapezoid((power * H[:, None] * H[None].conj()).real, f, axis=-1)


# A walk has K²·min(t, s) about its average, by midpoints of 1 s to (1 s/150 s)² = 4e-5. A Markov process has
# a mean: (q²T_c/2)·exp(−|t − s|/T_c), not taken from its average.
WALKED = dense(lambda t, s: K**2 * np.minimum(t, s), START, LENGTH, 1.0, contrast=True)
MARKOV = dense(lambda t, s: 1e-6 * np.exp(-abs(t - s) / 200.0), START, LENGTH, 1.0, contrast=False)
MIDDLE = START + LENGTH / 2.0 - 600.0
# The filter's bandwidth of 1 Hz moves the ends of segments of 150 s and more by 0.16 s.
NOISES = {
    "white": (aj.Model(()), 0.0), "walk": (aj.RateRandomWalk(K), WALKED),
    "markov": (aj.Markov(1e-4, 200.0), MARKOV),
    "ramp": (aj.DriftRamp(1e-6), 1e-12 * np.outer(MIDDLE, MIDDLE)),
    "flicker": (aj.BiasInstability(2e-4), flicker_covariance()), "filter": (aj.RateRandomWalk(K), WALKED),
}  # fmt: skip


@pytest.mark.parametrize("name", NOISES)
def test_noise_correlates_means_as_its_dense_covariance_says(name):
    """One axis up, down and up again: bias, scale factor, χ², residuals and their scatter."""
    drift, covariance = NOISES[name]
    model, white = aj.AngleRandomWalk(N) + drift, np.diag(N**2 / LENGTH)
    X = np.array([[1.0, G], [1.0, -G], [1.0, G]])
    means = X @ [0.02, 1.0008] + [3e-4, -1e-4, -2e-4]
    recordings = [
        at_rest([m], round(d * RATE), RATE, name=f"z {way}", axes="z")
        for m, d, way in zip(means, LENGTH, ("up", "down", "up"), strict=True)
    ]
    model = aj.LowPass1(1.0) * model if name == "filter" else model
    found = calibrated(recordings, model=model, starts=list(START))
    expected, alone = (least_squares(X, means, C) for C in (white + covariance, white))
    axis, misfit = found["accel_z"], found.misfit["accel"]
    within = 1e-5 if name == "white" else 5e-3
    std, narrow = (np.sqrt(np.diag(of.covariance)) for of in (expected, alone))
    check_estimates((axis["bias"], axis["scale_factor"]), expected.values - [0.0, 1.0], std, within)
    widening = [axis.widening[k] for k in ("bias", "scale_factor")]
    assert widening == pytest.approx(std / narrow, rel=within)
    assert (misfit.dof, misfit.wider) == (1, 1.0)
    assert misfit.chi2 == pytest.approx(expected.chi2, rel=2.0 * within)
    assert misfit.p_value == pytest.approx(chi2_law.sf(expected.chi2, 1), rel=10.0 * within)
    np.testing.assert_allclose(misfit.residuals[:, 0], expected.residuals, rtol=2.0 * within, atol=1e-8)
    # One position down: its residual is none.
    scatter = np.sqrt(np.maximum(np.diag(expected.residual_covariance), 0.0))
    np.testing.assert_allclose(misfit.residual_std[:, 0], scatter, rtol=2.0 * within, atol=1e-8)


LEVELS = {"accel_x": 1e-3, "accel_y": 2e-3, "accel_z": 5e-4}
WALKS = {"accel_x": 2e-6, "accel_y": 5e-6, "accel_z": 1e-6}
MODELS = {a: aj.AngleRandomWalk(LEVELS[a]) + aj.RateRandomWalk(WALKS[a]) for a in LEVELS}


def parameters(errors):
    """b, S + N and S2 of each axis, 15 in all, in the order of axes."""
    return np.column_stack([errors.b, errors.SN, errors.S2]).ravel()


def errors_from(p):
    p = p.reshape(3, 5)
    return Errors(p[:, 1:4], p[:, 0], p[:, 4])


def labels_of(i):
    own = "xyz"[i]
    return ["bias", *("scale_factor" if a == own else f"misalignment_{a}" for a in "xyz"), "second_order"]


#: Of each axis of eighteen positions of ten minutes: white noise, and a random walk about its average.
COUNT, STARTS = len(EIGHTEEN), [620.0 * k for k in range(len(EIGHTEEN))]
WALK = dense(np.minimum, STARTS, np.full(COUNT, 600.0), 20.0, contrast=True)
COVARIANCES = [np.eye(COUNT) * LEVELS[a] ** 2 / 600.0 + WALKS[a] ** 2 * WALK for a in LEVELS]


def of_eighteen(errors, scatter, orientations=None, **options):
    """Means of eighteen positions, with a little noise of their own, and their calibration."""
    f = G * EIGHTEEN
    means = errors.readings(f) + scatter * np.random.default_rng(4).standard_normal(f.shape)
    recordings = [at_rest(m, 60, 0.1) for m in means]
    return means, calibrated(recordings, orientations, MODELS, starts=STARTS, **options)


@pytest.mark.parametrize(("second_order", "orientation_error"), [(False, 0.0), (True, 2e-4), (False, 2e-4)])
def test_errors_of_three_axes_are_those_of_dense_least_squares(second_order, orientation_error):
    """The design is the Jacobian of (2.23) by differences."""
    # An orientation that is off by a small rotation ρ moves the input by ρ × f, in all axes at once.
    errors, f = Errors(SN, BIAS, np.array([2e-5, -1e-5, 3e-5]) * second_order), G * EIGHTEEN
    options = {"second_order": second_order, "orientation_error": orientation_error}
    means, found = of_eighteen(errors, 1e-4, list(EIGHTEEN), **options)
    used = np.tile([True] * 4 + [second_order], 3)
    X = jacobian(lambda p: errors_from(p).readings(f).ravel(), parameters(errors), np.full(15, 1e-3))[:, used]
    noise = np.zeros((COUNT, 3, COUNT, 3))
    for a, own in enumerate(COVARIANCES):
        noise[:, a, :, a] = own
    for k, x in enumerate(f):
        cross = np.cross(np.eye(3), x)
        noise[k, :, k, :] += orientation_error**2 * cross @ cross.T
    white = np.diag(np.tile([level**2 / 600.0 for level in LEVELS.values()], COUNT))
    expected, alone = (least_squares(X, (means - f).ravel(), C.reshape(white.shape)) for C in (noise, white))
    std, over = np.sqrt(np.diag(expected.covariance)), np.sqrt(np.diag(alone.covariance))
    for i, axis in enumerate(found.values()):
        k = slice(i * used.sum() // 3, (i + 1) * used.sum() // 3)
        labels = labels_of(i)[: 4 + second_order]
        # A walk by midpoints of 20 s of 600 s.
        check_estimates([axis[label] for label in labels], expected.values[k], std[k], 2e-3)
        np.testing.assert_allclose([axis.widening[n] for n in labels], (std / over)[k], rtol=2e-3)
    misfit = found.misfit["accel"]
    assert misfit.dof == 3 * COUNT - used.sum()
    assert misfit.chi2 == pytest.approx(expected.chi2, rel=3e-3)
    assert misfit.names == ("accel_x", "accel_y", "accel_z")
    np.testing.assert_allclose(misfit.residuals.ravel(), expected.residuals, atol=2e-3 * 1e-4)


@pytest.mark.parametrize("second_order", [False, True])
def test_free_orientations_are_least_squares_of_the_norm(second_order):
    """The inputs that give the readings have the norm g: nine or twelve parameters, solved by fsolve."""
    errors = Errors(np.tril(SN), BIAS, 1e-3 * np.array([2.0, -1.0, 3.0]) * second_order)
    means, found = of_eighteen(errors, 2e-5, second_order=second_order)
    # x defines an axis and y a plane: their misalignments towards later axes are zero.
    free = np.array([[True, *(j <= i for j in range(3)), second_order] for i in range(3)]).ravel()

    def norms(values, readings=means):
        p = np.zeros(15)
        p[free] = values
        wrong = lambda f: (errors_from(p).readings(f.reshape(-1, 3)) - readings).ravel()  # noqa: E731
        return np.linalg.norm(fsolve(wrong, G * EIGHTEEN).reshape(-1, 3), axis=1)

    every = [axis.coefficients.get(k) for i, axis in enumerate(found.values()) for k in labels_of(i)]
    own = [c for c, kept in zip(every, free, strict=True) if kept]
    values, std = (np.array([getattr(c, name) for c in own]) for name in ("value", "std"))
    J = jacobian(norms, values, np.full(free.sum(), 1e-5))
    by_axis = [(norms(values, means + d) - norms(values, means - d)) / 2e-4 for d in 1e-4 * np.eye(3)]
    C = sum(np.outer(n, n) * own for n, own in zip(by_axis, COVARIANCES, strict=True))
    expected = least_squares(-J, norms(values) - G, C)
    # At the solution, no step is left.
    np.testing.assert_allclose(expected.values / std, 0.0, atol=1e-2)
    np.testing.assert_allclose(std, np.sqrt(np.diag(expected.covariance)), rtol=3e-3)
    assert np.all(abs(values - parameters(errors)[free]) < 4.0 * std)
    assert all(c.held == (not kept) for c, kept in zip(every, free, strict=True) if c)
    assert found.misfit["accel"].dof == COUNT - free.sum()
    assert found.misfit["accel"].chi2 == pytest.approx(expected.chi2, rel=1e-2)


@pytest.mark.study
def test_free_orientations_hold_the_truth():
    """100 calibrations of positions of ten minutes, 20 s apart, by means; `calibration` has six known."""
    # 600 intervals, of which six a calibration are not quite independent: 0.95 ± 0.013.
    rng, errors, hits, p = np.random.default_rng(6), Errors(np.tril(SN), BIAS, np.zeros(3)), [], []
    n, model = 620 * COUNT, aj.AngleRandomWalk(1e-3) + aj.RateRandomWalk(1e-5)
    for _ in range(100):
        noise = 1e-3 * rng.standard_normal((n, 3)) + np.cumsum(1e-5 * rng.standard_normal((n, 3)), axis=0)
        means = errors.readings(G * EIGHTEEN) + noise.reshape(COUNT, 620, 3)[:, :600].mean(axis=1)
        found = calibrated([at_rest(m, 60, 0.1) for m in means], model=model, starts=STARTS)
        p.append(found.misfit["accel"].p_value)
        for i, axis in enumerate(found.values()):
            for label, truth in zip(labels_of(i)[1 : i + 2], errors.SN[i, : i + 1], strict=True):
                hits.append(axis[label].interval[0] <= truth <= axis[label].interval[1])
    assert 0.91 <= np.mean(hits) <= 0.98
    assert 0.35 < np.mean(p) < 0.65


def test_gyros_with_headings_tell_misalignments():
    """Inputs of the Earth's rotation at −33 degrees, east of north by hand; ordinary least squares."""
    told = "x up, y north; x down, z north; y up, z east; y down, x west; z up, x south; z down, y north"
    # Up and north along x, y and z. East is north × up.
    up = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    north = np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0], [0, 0, -1], [-1, 0, 0], [0, 1, 0]])
    latitude, errors = np.radians(-33.0), 30.0 * SN
    f = EARTH_RATE_DEG_H * (np.sin(latitude) * up + np.cos(latitude) * north)
    means = 5.0 + f @ (np.eye(3) + errors).T + 1e-3 * np.random.default_rng(8).standard_normal(f.shape)
    records = {name: at_rest(m, 32, 0.4, "deg/h") for name, m in zip(told.split("; "), means, strict=True)}
    found = aj.calibrate(records, latitude=-33.0, model="N=0.01 deg/√h", as_is=True)
    X = np.column_stack([np.ones(6), f * DEG_H])
    level = 0.01 * DEG_H * 60.0 / np.sqrt(80.0)
    for i, axis in enumerate(found.values()):
        expected = least_squares(X, (means - f)[:, i] * DEG_H, level**2 * np.eye(6))
        std = np.sqrt(np.diag(expected.covariance))
        check_estimates([axis[label] for label in labels_of(i)[:4]], expected.values, std, 1e-4)
        assert not any(c.remark for c in axis.coefficients.values())
    assert found.misfit["gyro"].dof == 6


@pytest.mark.parametrize("heading", ["", ", x north"])
def test_two_positions_of_a_gyro_tell_bias_and_scale_as_if_aligned(heading):
    """(2.36), (2.37): half the sum of the means, and half the difference over the vertical rate less one."""
    # With the same heading in both, a misalignment would be told from the bias by no means. The Earth's rate
    # of the tests has seven digits. What is known to no better than 1 % is not applied.
    vertical = EARTH_RATE_DEG_H * np.sin(np.radians(51.0))
    up, down = [4.0, 6.0, 3.0 + 1.012 * vertical], [4.5, 6.5, 3.2 - 1.013 * vertical]
    records = {f"z {way}{heading}": at_rest(m, 64, 0.1, "deg/h") for way, m in (("up", up), ("down", down))}
    options = {"latitude": 51.0, "as_is": True}
    sharp, blunt = (aj.calibrate(records, model=f"N={n} deg/√h", **options) for n in (1e-3, 0.1))
    bias, scale = sharp["gyro_z"]["bias"], sharp["gyro_z"]["scale_factor"]
    assert bias.in_unit("deg/h").value == pytest.approx((up[2] + down[2]) / 2.0, rel=1e-9)
    assert scale.value == pytest.approx((up[2] - down[2]) / (2.0 * vertical) - 1.0, abs=1e-7)
    assert scale.in_unit().value == pytest.approx(100.0 * scale.value)
    # N²/T of each mean: 640 s, in deg/h.
    sigma = 1e-3 * 60.0 / np.sqrt(640.0) / np.sqrt(2.0)
    assert bias.in_unit("deg/h").std == pytest.approx(sigma, rel=1e-6)
    assert scale.std == pytest.approx(sigma / vertical, rel=1e-6)
    assert sharp.errors("gyro").M[2, 2] == pytest.approx(1.0 + scale.value)
    assert blunt["gyro_z"]["scale_factor"].std == pytest.approx(100.0 * scale.std, rel=1e-6)
    assert blunt.errors("gyro").M[2, 2] == 1.0
    other = sharp["gyro_x"]["scale_factor"]
    assert (np.isnan(other.value), "north" in other.remark) == (True, True)


@pytest.fixture(scope="module")
def six():
    """Six positions of three unequal accelerometers, without noise to speak of."""
    return six_of(readings_of(G * EIGHTEEN[:6]))


@pytest.fixture(scope="module")
def calibration(six):
    return calibrated(six)


def test_what_positions_do_not_tell_is_said(six):
    """Two positions one scale factor; six that are free no misalignment."""
    found = calibrated({k: six[k] for k in ("x up", "x down")})
    assert found["accel_x"]["scale_factor"].value == pytest.approx(SN[0, 0], abs=1e-9)
    scale, misfit = found["accel_y"]["scale_factor"], found.misfit["accel"]
    assert "'y up' and 'z up'" in scale.remark
    assert np.isnan([scale.value, scale.std, *scale.interval, misfit.p_value]).all()
    assert (found.errors("accel").M[1, 1], misfit.dof) == (1.0, 0)
    assert json.loads(json.dumps(found.to_dict()))["sensors"]["accel"]["p_value"] is None
    found = calibrated([dataclasses.replace(r, name="") for r in six.values()])
    assert found["accel_z"]["scale_factor"].value == pytest.approx(SN[2, 2], abs=1e-5)
    assert "9 or more" in found["accel_z"]["misalignment_x"].remark


def test_a_misplaced_position_is_named():
    """x up is tilted by 3 mrad towards y, as x down might be: the six positions do not tell the two apart."""
    f = G * EIGHTEEN[:6]
    f[0] = G * np.array([np.cos(3e-3), np.sin(3e-3), 0.0])
    records = six_of(readings_of(f), 60, 0.1)
    sure, found = (calibrated(records, model=MODELS, orientation_error=e) for e in (0.0, 3e-3))
    assert (sure.misfit["accel"].suspects, found.misfit["accel"].suspects) == (("x up", "x down"), ())
    assert sure.misfit["accel"].p_value < 1e-3
    assert found.misfit["accel"].p_value > 0.01
    # Two positions tell a misalignment: 3 mrad over √2.
    assert found["accel_y"]["misalignment_x"].std == pytest.approx(3e-3 / np.sqrt(2.0), rel=0.01)


#: What is up, and north: with x up and y east, z = x × y is up × east, north.
SAID = {
    "Y Down": ([0, -1, 0], None), "-z": ([0, 0, -1], None), "x+": ([1, 0, 0], None),
    "down": ([0, 0, -1], None), "imu_x-down_2": ([-1, 0, 0], None), "2024-05-01_yup": ([0, 1, 0], None),
    "x up, y north": ([1, 0, 0], [0, 1, 0]), "x up, y south": ([1, 0, 0], [0, -1, 0]),
    "x up, y east": ([1, 0, 0], [0, 0, 1]), "x up, y west": ([1, 0, 0], [0, 0, -1]),
}  # fmt: skip


def test_orientations_by_name_direction_and_matrix(six, calibration):
    """The matrix turns the frame into east, north and up: x points 30 degrees north of east."""
    c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
    orientations = [*SAID, [0.6, 0.0, -0.8], np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])]
    given = SAID | {"direction": ([0.6, 0.0, -0.8], None), "matrix": ([0, 0, 1], [s, c, 0])}
    records = [at_rest(G * np.array(up, float), 32, 1.0, name="imu") for up, _ in given.values()]
    found = calibrated(records, orientations).to_dict()
    for position, (up, north) in zip(found["positions"], given.values(), strict=True):
        np.testing.assert_allclose(position["up"], up, atol=1e-12)
        assert (position["north"] is None) == (north is None)
        np.testing.assert_allclose(position["north"] or 0.0, north or 0.0, atol=1e-12)
    assert [p["start_s"] for p in found["positions"]] == pytest.approx(list(range(0, 384, 32)))
    named = calibrated([dataclasses.replace(r, name=f"imu_{k}") for k, r in six.items()])
    assert named.results == calibration.results


# NIMA TR8350.2, table 3.4, at the equator and the poles; at 45 degrees Moritz's series for GRS 80,
# 9.806199203, less the difference of the two systems, below 2e-6; 0.3086 mGal a metre are in textbooks.
PLACES = {(0.0, 0.0): (9.7803253359, 1e-9), (-90.0, 0.0): (9.8321849378, 2e-9)}
PLACES |= {(45.0, 0.0): (9.806199203, 2e-6), (45.0, 1000.0): (9.806199203 - 3.086e-3, 5e-6)}


@pytest.mark.parametrize(("latitude", "height"), PLACES)
def test_normal_gravity_is_that_of_wgs_84(calibration, six, latitude, height):
    """And its anomaly, 35 mGal, is in the intervals of scale factors, but of nothing else."""
    expected, within = PLACES[latitude, height]
    found = aj.calibrate(six, latitude=latitude, height=height, model=WHITE, as_is=True)
    assert found.gravity == pytest.approx(expected, abs=within)
    assert found.gravity_std == 3.5e-4
    axes = found["accel_x"], calibration["accel_x"]
    own, exact = (np.array([c.std for c in axis.coefficients.values()]) for axis in axes)
    # Those of inputs are in proportion to 1/g.
    exact[1:] *= G / expected
    exact[1] = np.hypot(exact[1], 3.5e-4 / expected)
    np.testing.assert_allclose(own, exact, rtol=1e-5)


def test_a_longest_position_is_fitted_and_its_drift_told_by_scatter():
    """Student's law, and Birge's ratio, where the means scatter by more than N alone lets them."""
    rng, n, level, records = np.random.default_rng(12), 2048, 1e-3 * np.sqrt(20.0), []
    for shift, count, way in ((0.0, n, "up"), (3e-3, n // 2, "down"), (6e-3, n // 2, "up")):
        samples = level * rng.standard_normal((count, 1))
        samples += shift - samples.mean() + (G if way == "up" else -G)
        names = {"names": ["accel_z"], "name": f"z {way}", "accel_unit": "m/s²"}
        records.append(aj.Recording.from_array(samples, 20.0, **names))
    own = aj.calibrate(records, gravity=G)
    plain = aj.calibrate(records, gravity=G, fit=aj.fit(records[0]))
    # N, level²/n of each mean, is known to 1.6 %; likely sets of terms may have drift besides.
    X, C = np.array([[1.0, G], [1.0, -G], [1.0, G]]), np.diag(level**2 / np.array([n, n // 2, n // 2]))
    std = np.sqrt(np.diag(least_squares(X, np.array([0.0, 3e-3, 6e-3]), C).covariance))
    ratio = [plain["accel_z"][k].std for k in ("bias", "scale_factor")] / std
    assert np.all((ratio > 0.95) & (ratio < 1.5))
    misfit, c = own.misfit["accel"], own["accel_z"]["scale_factor"]
    assert (misfit.dof, plain.misfit["accel"].wider, "z up" in own.noise) == (1, 1.0, True)
    assert misfit.wider == pytest.approx(np.sqrt(misfit.chi2), rel=1e-9)
    assert misfit.wider > 3.0
    assert c.std == pytest.approx(misfit.wider * plain["accel_z"]["scale_factor"].std, rel=1e-9)
    ends = c.value + c.std * student.ppf([0.025, 0.16, 0.84, 0.975], 1)
    np.testing.assert_allclose(np.sort([*c.interval, *c.interval_68]), ends, rtol=1e-9)


def test_apply_takes_the_errors_out():
    """Of any inputs: those that were calibrated with, and 5 m/s² along each axis."""
    errors = Errors(SN, BIAS, np.array([2e-5, 0.0, -1e-5]))
    records = [at_rest(m, 32, 20.0) for m in errors.readings(G * EIGHTEEN)]
    found = calibrated(records, list(EIGHTEEN), second_order=True)
    f = np.random.default_rng(1).uniform(-5.0, 5.0, (64, 3))
    options = {"names": [*LEVELS, "gyro_x"], "accel_unit": "m/s²", "gyro_unit": "rad/s"}
    moved = aj.Recording.from_array(np.column_stack([errors.readings(f), f[:, 0]]), 20.0, **options)
    np.testing.assert_allclose(found.apply(moved).values, np.column_stack([f, f[:, 0]]), atol=1e-7)
    second = found["accel_x"]["second_order"].in_unit("µg/g²")
    assert second.value == pytest.approx(2e-5 * 9.80665e6, abs=1e-3)
    with pytest.raises(aj.RecordingError, match="accel_z"):
        found.apply(moved["accel_x", "accel_y"])
    with pytest.raises(aj.RecordingError, match="none"):
        found.apply(moved["gyro_x",])


UP, Z = ["x up"] * 5, ("x up", "x down")
WRONG = [
    (SIX, {"gravity": None}, "latitude="), (SIX, {"gravity": None, "latitude": 91.0}, "latitude"),
    (SIX, {"gravity": None, "latitude": 45.0, "height": np.nan}, "height"), (SIX, {"gravity": 981.0}, "m/s²"),
    (SIX, {"orientations": ["x up"]}, "orientations"), (SIX, {"orientations": [*UP, "sideways"]}, "sideways"),
    (SIX, {"orientations": [*UP, [1.0, 1.0, 0.0]]}, "orientation"),
    (SIX, {"orientations": [*UP, np.diag([1.0, 1.0, -1.0])]}, "orientation"),
    (SIX, {"orientations": [*UP, "x up, x north"]}, "cannot"),
    (SIX, {"model": {"gyro": "N=1 deg/√h"}}, "accel_x"), (SIX, {"starts": [0.0]}, "starts"),
    (SIX, {"starts": [0, 1, 40, 60, 80, 100]}, "starts"), (("x up", "y up"), {}, "accel axis"),
    (Z, {"second_order": True}, "second order"), (Z, {"orientations": Z[::-1]}, "exchange"),
    (SIX, {"model": aj.AngleRandomWalk(N) + aj.BiasStep(1e-3, 10.0)}, "noise"),
    (("backup", "x up"), {"sequence": True}, "backup"),
]  # fmt: skip


def test_wrong_settings_are_errors(six):
    for names, options, word in WRONG:
        given = {"gravity": G, "model": WHITE, "as_is": True, **options}
        recordings = [dataclasses.replace(six.get(name, six["x down"]), name=name) for name in names]
        if not given.pop("sequence", False):
            recordings = dict(zip(names, recordings, strict=True))
        refuses(word, aj.calibrate, recordings, **given)


@pytest.mark.usefixtures("no_windows")
def test_the_table_the_document_and_the_figure_have_the_numbers(calibration):
    """Bars of residuals end one standard deviation away."""
    frame, document = calibration.to_dataframe().set_index(["axis", "parameter"]), calibration.to_dict()
    units = {"bias": ("mg", 9.80665e-3), "scale_factor": ("ppm", 1e-6), "misalignment_z": ("µrad", 1e-6)}
    for label, (unit, size) in units.items():
        row, c = frame.loc["accel_y", label], calibration["accel_y"][label]
        numbers = row[["value", "std", "lower_95", "upper_95"]].to_numpy(float) * size
        np.testing.assert_allclose(numbers, [c.value, c.std, *c.interval], rtol=1e-9)
        assert row["unit"] == unit
    sensor = document["sensors"]["accel"]
    np.testing.assert_allclose(sensor["b"], BIAS, atol=1e-9)
    np.testing.assert_allclose(sensor["M"], np.eye(3) + SN, atol=1e-9)
    assert (sensor["dof"], document["gravity_m_s2"], document["positions"][1]["up"]) == (6, G, [-1, 0, 0])
    f = G * EIGHTEEN[:6]
    means = readings_of(f) + 1e-4 * np.random.default_rng(3).standard_normal(f.shape)
    found = calibrated(six_of(means, 60, 0.1), model=MODELS)
    figure, misfit = found.plot(["accel_y", "accel_z"]), found.misfit["accel"]
    for panel, k in zip(figure.axes, (1, 2), strict=True):
        points, _, (bars,) = panel.containers[0]
        np.testing.assert_allclose(points.get_ydata(), misfit.residuals[:, k] / 9.80665e-6)
        ends = [np.ptp(segment[:, 1]) * 9.80665e-6 for segment in bars.get_segments()]
        np.testing.assert_allclose(ends, 2.0 * misfit.residual_std[:, k])
        assert [label.get_text() for label in panel.get_xticklabels()] == list(SIX)
    assert figure.axes[0].get_ylabel() == "residual [µg]"
    refuses("accel_q", found.plot, "accel_q")


def test_two_places_of_known_gravity_tell_bias_and_scale_factor():
    """(2.27) to (2.29): I = −(1 + S)·g + b at either place; noise by hand, and by 400 simulated sensors."""
    g, S, b = np.array([9.8082, 9.7726]), 800e-6, 0.03
    level, T = 2e-5, 640.0
    model = f"N={level} m/s/√s"

    def measured(readings, **options):
        records = [at_rest([m], 64, 0.1, name="z down", axes="z") for m in readings]
        return aj.calibrate(records, gravity=list(g), model=model, as_is=True, **options)

    readings = -(1.0 + S) * g + b + [3e-7, -8e-7]
    found = measured(readings)
    scale, bias = found["accel_z"]["scale_factor"], found["accel_z"]["bias"]
    by_hand = (readings[0] - readings[1]) / (g[1] - g[0]) - 1.0
    assert scale.value == pytest.approx(by_hand, abs=1e-9)
    assert bias.value == pytest.approx(readings[0] + (1.0 + by_hand) * g[0], abs=1e-8)
    sigma = level / np.sqrt(T)
    assert scale.std == pytest.approx(np.sqrt(2.0) * sigma / (g[0] - g[1]), rel=1e-6)
    assert bias.std == pytest.approx(sigma * np.hypot(*g) / (g[0] - g[1]), rel=1e-6)
    # What they add up to at the first place is known as well as its mean.
    at = np.array([1.0, -g[0]])
    assert np.sqrt(at @ found["accel_z"].covariance[:2, :2] @ at) == pytest.approx(sigma, rel=1e-3)
    assert [p["gravity_m_s2"] for p in found.to_dict()["positions"]] == list(g)
    assert "g = 9.77260 … 9.80820 m/s²" in str(found)
    assert all(found["accel_z"][f"misalignment_{x}"].remark for x in "xy")
    rng, hits = np.random.default_rng(3), []
    for _ in range(400):
        c = measured(-(1.0 + S) * g + b + sigma * rng.standard_normal(2))["accel_z"]
        hits.append(
            [x.interval[0] <= truth <= x.interval[1] for x, truth in ((c["bias"], b), (c["scale_factor"], S))]
        )
    # 0.95 ± 0.011.
    assert np.all(abs(np.mean(hits, axis=0) - 0.95) < 0.03)
    # A second place that is upside down besides: dense least squares with three gravities.
    g3, means = np.array([9.8082, 9.7726, 9.8]), np.array([-9.81, -9.774, 9.83])
    records = {w: at_rest([m], 64, 0.1, axes="z") for w, m in zip("abc", means, strict=True)}
    ways = ["z down", "z down", "z up"]
    three = aj.calibrate(list(records.values()), ways, gravity=g3, model=model, as_is=True)["accel_z"]
    X = np.column_stack([np.ones(3), g3 * [-1, -1, 1]])
    expected = least_squares(X, means, sigma**2 * np.eye(3))
    std = np.sqrt(np.diag(expected.covariance))
    check_estimates((three["bias"], three["scale_factor"]), expected.values - [0.0, 1.0], std)


def test_places_of_nearly_the_same_gravity_leave_both_unknown():
    """A scale factor to no better than 1 % is not applied, and its bias neither."""
    records = [at_rest([m], 64, 0.1, name="z up", axes="z") for m in (9.80, 9.801)]
    found = aj.calibrate(records, gravity=[9.8, 9.8003], model="N=2e-4 m/s/√s", as_is=True)
    assert found["accel_z"]["scale_factor"].std > 0.01
    assert (found.errors("accel").M[2, 2], found.errors("accel").b[2]) == (1.0, 0.0)
    assert any("not applied" in note for note in found.notes)
    for gravity in ([9.8, 9.8, 9.8], [9.8, 98.0], []):
        refuses("gravity", aj.calibrate, records, gravity=gravity, model=WHITE, as_is=True)
    # The same place twice determines neither.
    refuses("scale factor", aj.calibrate, records, gravity=[9.8, 9.8], model=WHITE, as_is=True)
