"""Calibrations of sensors simulated from (2.22) and (2.23)."""

import dataclasses
import json

import numpy as np
import pytest
from turned_sensors import EARTH_RATE_DEG_H, ERRORS, SIX, G, markov_noise, random_walk, white_noise

import allanjax as aj
from allanjax.calibration.noise import parts_of_model
from allanjax.calibration.orientation import as_orientation
from allanjax.calibration.result import Position
from allanjax.calibration.sensor_errors import Covariances, Setting, World, errors_of
from allanjax.record.recording import Axis

N, K, T, PAUSE = 1e-3, 1e-5, 600.0, 20.0
NOISE = aj.AngleRandomWalk(N) + aj.RateRandomWalk(K)
WORLD = World(G, 0.0, None)
UPS = np.stack(list(SIX.values()))
ACCELEROMETERS = tuple(Axis(f"accel_{a}", "accel", "m/s²") for a in "xyz")


def places(ups, known=True) -> tuple[Position, ...]:
    """Positions of ten minutes, 20 s apart."""
    turned = [as_orientation(up) if known else None for up in ups]
    return tuple(Position(f"p{k}", o, k * (T + PAUSE), T) for k, o in enumerate(turned))


def means_of(inputs, noise, errors=ERRORS, rate=1.0) -> np.ndarray:
    """Means of the readings: the inputs', and that of the noise over each of the positions."""
    count, step = round(T * rate), round((T + PAUSE) * rate)
    drift = np.stack([noise[k * step : k * step + count].mean(axis=0) for k in range(len(inputs))])
    return errors.readings(inputs) + drift


def noise_of(rng, n, N=N, K=K) -> np.ndarray:
    """White noise and a random walk at 1 Hz."""
    return white_noise(rng, n, N, 1.0) + random_walk(rng, n, K, 1.0)


def covariances(positions, model=NOISE) -> Covariances:
    """Those of three like axes."""
    return Covariances.of(positions, [parts_of_model(model, 1.0)] * 3)


def recordings(errors=ERRORS, noise=1e-3, rate=20.0, n=400, seed=1) -> dict[str, aj.Recording]:
    """Short six-position recordings of three accelerometers with white noise."""
    rng = np.random.default_rng(seed)
    found = {}
    for name, up in SIX.items():
        samples = errors.readings(G * up[None])[0] + noise * rng.standard_normal((n, 3))
        found[name] = aj.Recording.from_array(samples, rate, accel_unit="m/s²", name=f"imu_{name}")
    return found


@pytest.fixture(scope="module")
def six():
    return recordings()


@pytest.fixture(scope="module")
def calibration(six):
    return aj.calibrate(six, gravity=G, model="N=0.0134 m/s/√h")


# ---------------------------------------------------------------------------- parameters and their intervals
def test_six_positions_are_recovered(calibration):
    """1e-3 m/s² a sample: 5e-5 a mean of 400, 2.9e-6 of the scale. Each number is within 4 of its σ."""
    truth = np.concatenate([ERRORS.b[:, None], ERRORS.SN], axis=1)
    for i, result in enumerate(calibration.values()):
        others = [j for j in range(3) if j != i]
        found = [c.value for c in result.coefficients.values()]
        std = [c.std for c in result.coefficients.values()]
        expected = truth[i, [0, 1 + i, *(1 + j for j in others)]]
        assert np.all(np.abs(found - expected) < 4.0 * np.array(std))
        # White noise, six positions: means' σ over √6 for the bias, over √2·g for what two positions tell.
        sigma = 1e-3 / np.sqrt(400)
        np.testing.assert_allclose(std, [sigma / np.sqrt(6.0), *[sigma / np.sqrt(2.0) / G] * 3], rtol=2e-3)
        assert list(result.widening.values()) == pytest.approx([1.0] * 4, rel=1e-6)


def test_with_white_noise_it_is_ordinary_least_squares(six, calibration):
    means = np.stack([r.values.mean(axis=0) for r in six.values()])
    X = np.concatenate([np.ones((6, 1)), G * np.stack(list(SIX.values()))], axis=1)
    for i, result in enumerate(calibration.values()):
        plain = np.linalg.lstsq(X, means[:, i], rcond=None)[0]
        assert result["bias"].value == pytest.approx(plain[0], abs=1e-12)
        assert result["scale_factor"].value == pytest.approx(plain[1 + i] - 1.0, abs=1e-12)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_two_positions_of_an_accelerometer_by_hand(sign):
    """(2.32) and (2.33), with the means of the samples themselves.

    There the axis that is up reads −g: here it is the one that is down.
    """
    rng = np.random.default_rng(3)
    up, down = (1.002 * s * G + 0.05 * sign + 0.01 * rng.standard_normal(64) for s in (1.0, -1.0))
    found = aj.calibrate(
        {"up": up, "down": down}, gravity=G, model="N=0.1 m/s/√h", rate=10.0, accel_unit="m/s²"
    )
    bias, scale = (up.mean() + down.mean()) / 2.0, (up.mean() - down.mean() - 2.0 * G) / (2.0 * G)
    assert found["accel"]["bias"].value == pytest.approx(bias, abs=1e-13)
    assert found["accel"]["scale_factor"].value == pytest.approx(scale, abs=1e-13)
    assert "x up" in found["accel"]["misalignment_x"].describe()
    assert "no check" in str(found)


def test_two_positions_of_a_gyro_by_hand():
    """(2.36) and (2.37) at 51 degrees, where the Earth's rate is 11.689 deg/h about the vertical."""
    rng = np.random.default_rng(4)
    vertical = EARTH_RATE_DEG_H * np.sin(np.radians(51.0))
    up, down = (3.0 + 1.01 * s * vertical + rng.standard_normal(64) for s in (1.0, -1.0))
    found = aj.calibrate(
        {"up": up, "down": down}, latitude=51.0, model="N=0.005 deg/√h", rate=10.0, gyro_unit="deg/h"
    )
    bias, scale = (up.mean() + down.mean()) / 2.0, (up.mean() - down.mean()) / (2.0 * vertical) - 1.0
    assert found["gyro"]["bias"].in_unit().value == pytest.approx(bias, rel=1e-6)
    assert found["gyro"]["scale_factor"].value == pytest.approx(scale, abs=1e-6)


CASES = {
    "walk": (NOISE, lambda rng, n: random_walk(rng, n, K, 1.0), 1.0),
    "Markov": (
        aj.AngleRandomWalk(N) + aj.Markov(2e-4 * np.sqrt(2.0 / 900.0), 900.0),
        lambda rng, n: markov_noise(rng, n, 2e-4, 900.0, 1.0),
        0.0,
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_intervals_hold_the_truth(case):
    """300 calibrations of noise at 1 Hz, whose means are taken here: full records take too long for a test.

    Drift without a mean takes the bias with it: the truth is its average then. Of three like axes a share of
    0.95 scatters by √(0.95·0.05/900) = 0.007, and no kind of parameter may leave 0.92 to 0.98. p-values are
    uniform: the mean of 300 scatters by 0.017. Of plain least squares the intervals are too narrow, and
    its errors are no smaller.
    """
    model, draw, carried = CASES[case]
    rng, setting = np.random.default_rng(11), Setting(ACCELEROMETERS, places(SIX), WORLD)
    noise, n = covariances(setting.positions, model), round(6 * T + 5 * PAUSE)
    X = np.concatenate([np.ones((6, 1)), UPS * G], axis=1)
    # N²/T of each mean.
    white = 1.96 * N / np.sqrt(T) * np.sqrt(np.diag(np.linalg.inv(X.T @ X)))
    hits, ours, ordinary, p = np.zeros((300, 3, 4), bool), [], [], []
    for k in range(300):
        drift = draw(rng, n)
        means = means_of(UPS * G, drift + white_noise(rng, n, N, 1.0))
        found, misfit = errors_of(setting, means, noise)
        p.append(misfit.p_value)
        ordinary.append(np.linalg.lstsq(X, means - UPS * G, rcond=None)[0][1:] - ERRORS.SN.T)
        estimates = np.empty((3, 3))
        for i, result in enumerate(found):
            truth = {"bias": ERRORS.b[i] + carried * drift[:, i].mean(), "scale_factor": ERRORS.SN[i, i]}
            truth |= {f"misalignment_{a}": ERRORS.SN[i, j] for j, a in enumerate("xyz") if j != i}
            for j, (label, c) in enumerate(result.coefficients.items()):
                hits[k, i, j] = c.interval[0] <= truth[label] <= c.interval[1]
                if j:
                    estimates["xyz".index(label[-1]) if j > 1 else i, i] = c.value - truth[label]
        ours.append(estimates)
    coverage = hits.mean(axis=(0, 1))
    assert np.all((coverage >= 0.92) & (coverage <= 0.98)), coverage
    assert np.mean(p) == pytest.approx(0.5, abs=0.06)
    assert np.mean(np.abs(ordinary) < white[1:, None]) < 0.85
    assert np.mean(np.square(ours)) < np.mean(np.square(ordinary))


def test_drift_that_the_model_lacks_widens_the_intervals():
    """300 calibrations with a drift of the means, 5 times as large as the white noise that the model has.

    It is drawn independently for each mean, as residuals take it to be. The share scatters by 0.007.
    """
    drift = 5.0 * N / np.sqrt(T)
    rng, setting = np.random.default_rng(15), Setting(ACCELEROMETERS, places(SIX), WORLD, lacks_drift=True)
    noise = covariances(setting.positions, aj.Model((aj.AngleRandomWalk(N),)))
    hits: dict[bool, list[bool]] = {True: [], False: []}
    for _ in range(300):
        means = ERRORS.readings(UPS * G) + drift * rng.standard_normal((6, 3))
        for widened, sums in hits.items():
            found, _ = errors_of(setting._replace(lacks_drift=widened), means, noise)
            for i, result in enumerate(found):
                lower, upper = result["scale_factor"].interval
                sums.append(lower <= ERRORS.SN[i, i] <= upper)
    assert 0.92 <= np.mean(hits[True]) <= 0.98
    assert np.mean(hits[False]) < 0.5


# ------------------------------------------------------------------------------- what positions determine
def test_positions_that_do_not_span_are_refused(six):
    with pytest.raises(aj.RecordingError, match=r"do not span: from x up; y up .* as well"):
        aj.calibrate({k: six[k] for k in ("x up", "y up")}, gravity=G, model=NOISE)


def test_what_two_positions_do_not_tell_is_said(six):
    found = aj.calibrate({k: six[k] for k in ("x up", "x down")}, gravity=G, model=NOISE)
    assert found["accel_x"]["scale_factor"].value == pytest.approx(ERRORS.SN[0, 0], abs=1e-4)
    said = found["accel_y"]["scale_factor"].describe()
    assert said == "not determined by these data; it takes, e.g., 'y up' and 'z up' as well"
    assert np.isnan(found["accel_y"]["scale_factor"].std)
    assert found.errors("accel").M[1, 1] == 1.0
    json.dumps(found.to_dict(), allow_nan=False)
    told = [line for line in str(found).splitlines() if line.startswith("not determined of")]
    assert told[0] == "not determined of accel_x, accel_y, accel_z: it takes, e.g., 'y up' and 'z up' as well"


def test_the_second_order_takes_a_third_level(six):
    with pytest.raises(aj.RecordingError, match=r"beside its second order; it takes, .* 'y down' and"):
        aj.calibrate({k: six[k] for k in ("x up", "x down")}, gravity=G, model=NOISE, second_order=True)
    errors = ERRORS._replace(S2=np.array([2e-5, 0.0, -1e-5]))
    found = aj.calibrate(recordings(errors), gravity=G, model="N=0.0134 m/s/√h", second_order=True)
    second = found["accel_x"]["second_order"]
    assert abs(second.value - 2e-5) < 4.0 * second.std < 1e-5
    # 2e-5 s²/m are 2e-5·9.80665 = 196 µg/g².
    assert second.in_unit("µg/g²").value == pytest.approx(second.value * 9.80665e6)
    truth = G * SIX["z down"]
    reading = recordings(errors)["z down"]
    np.testing.assert_allclose(found.apply(reading).values.mean(axis=0), truth, atol=5e-4)


def test_a_gyro_learns_no_scale_from_the_earth():
    """0.1 deg/√h for ten minutes: 0.24 deg/h a mean, which are 1.2 % of 2·11.7 deg/h by √2."""
    rng, vertical = np.random.default_rng(2), EARTH_RATE_DEG_H * np.sin(np.radians(51.0))
    records = {
        f"z {way}": 5.0 + np.array([0.0, 0.0, s * vertical]) + 19.0 * rng.standard_normal((6000, 3))
        for way, s in (("up", 1.0), ("down", -1.0))
    }
    found = aj.calibrate(records, latitude=51.0, model="N=0.1 deg/√h", rate=10.0, gyro_unit="deg/h")
    scale = found["gyro_z"]["scale_factor"]
    assert scale.std == pytest.approx(0.1 / np.sqrt(1.0 / 6.0) / np.sqrt(2.0) / vertical, rel=1e-3)
    assert "It takes a rate table" in str(found)
    assert found.errors("gyro").M[2, 2] == 1.0
    assert "north" in found["gyro_x"]["scale_factor"].describe()


@pytest.mark.parametrize("heading", ["", ", x north"])
def test_two_positions_of_a_gyro_tell_bias_and_scale_as_if_aligned(heading):
    """(2.36), (2.37): half the sum of the means, and half the difference over the vertical rate less one.

    With the same heading in both, a misalignment would be told from the bias by no means. Of the thesis, up
    and down are exchanged. The Earth's rate of the tests has seven digits.
    """
    rng, vertical = np.random.default_rng(2), EARTH_RATE_DEG_H * np.sin(np.radians(51.0))
    records = {
        f"z {way}{heading}": 5.0 + np.array([0.0, 0.0, s * vertical]) + 0.2 * rng.standard_normal((6000, 3))
        for way, s in (("up", 1.0), ("down", -1.0))
    }
    found = aj.calibrate(records, latitude=51.0, model="N=0.001 deg/√h", rate=10.0, gyro_unit="deg/h")
    up, down = (record[:, 2].mean() for record in records.values())
    bias, scale = found["gyro_z"]["bias"], found["gyro_z"]["scale_factor"]
    assert bias.in_unit().value == pytest.approx((up + down) / 2.0, rel=1e-9)
    assert scale.value == pytest.approx((up - down) / (2.0 * vertical) - 1.0, abs=1e-7)
    assert scale.in_unit().unit == "%"
    assert "gyro_z: as if aligned" in str(found)


def test_gyros_with_headings_tell_misalignments():
    rng, errors = np.random.default_rng(8), ERRORS.SN * 30.0
    sin, cos = np.sin(np.radians(51.0)), np.cos(np.radians(51.0))
    records = {}
    for name in (
        "x up, y north",
        "x down, z north",
        "y up, z east",
        "y down, x west",
        "z up, x south",
        "z down, y north",
    ):
        o = as_orientation(name)
        rate = (np.eye(3) + errors) @ (EARTH_RATE_DEG_H * (sin * o.up + cos * o.north))
        records[name] = rate + 0.05 * rng.standard_normal((400, 3))
    found = aj.calibrate(records, latitude=51.0, model="N=0.000186 deg/√h", rate=20.0, gyro_unit="deg/h")
    labels = [[f"misalignment_{b}" if a != b else "scale_factor" for b in "xyz"] for a in "xyz"]
    value = [
        [result[label].value for label in row] for result, row in zip(found.values(), labels, strict=True)
    ]
    # 0.05 deg/h/√400 of 15 deg/h, three positions or so to a parameter: 1.5e-4; four times that.
    np.testing.assert_allclose(value, errors, atol=6e-4)


# ------------------------------------------------------------------------------------ free orientations
@pytest.fixture(scope="module")
def anyhow():
    """Eighteen directions: the axes, and between them."""
    between = [
        v / np.sqrt(2.0)
        for v in np.array([[1, 1, 0], [1, 0, 1], [0, 1, 1], [1, -1, 0], [1, 0, -1], [0, 1, -1]])
    ]
    return np.stack([*SIX.values(), *between, *(-v for v in between)])


def test_free_orientations(anyhow):
    """The norm of gravity tells all but how the sensor is mounted; 100 calibrations, nine free parameters."""
    rng, errors = np.random.default_rng(6), ERRORS._replace(SN=np.tril(ERRORS.SN))
    setting = Setting(ACCELEROMETERS, places(anyhow, known=False), WORLD)
    noise, n, inside, p = covariances(setting.positions), round(18 * (T + PAUSE)), [], []
    for _ in range(100):
        found, misfit = errors_of(setting, means_of(G * anyhow, noise_of(rng, n), errors), noise)
        p.append(misfit.p_value)
        for i, result in enumerate(found):
            assert [c.held for c in result.coefficients.values()].count(True) == 2 - i
            for j, a in enumerate("xyz"[:i]):
                low, high = result[f"misalignment_{a}"].interval
                inside.append(low <= errors.SN[i, j] <= high)
            low, high = result["scale_factor"].interval
            inside.append(low <= errors.SN[i, i] <= high)
    # 600 intervals, of which six a calibration are not quite independent: 0.95 ± 0.013.
    assert 0.91 <= np.mean(inside) <= 0.98
    assert 0.35 < np.mean(p) < 0.65


def test_free_orientations_tell_the_second_order(anyhow):
    """Without noise to speak of: what is left is of the third order in the errors, 1e-3."""
    errors = ERRORS._replace(SN=np.tril(ERRORS.SN), S2=np.array([2e-5, -1e-5, 3e-5]))
    setting = Setting(ACCELEROMETERS, places(anyhow, known=False), WORLD, second_order=True)
    noise = covariances(setting.positions, aj.Model(()) + aj.AngleRandomWalk(1e-7))
    found, _ = errors_of(setting, errors.readings(G * anyhow), noise)
    assert [r["second_order"].value for r in found] == pytest.approx(errors.S2, rel=1e-4)
    assert [r["bias"].value for r in found] == pytest.approx(errors.b, rel=1e-4)


def test_six_free_positions_tell_no_misalignment(six):
    found = aj.calibrate([dataclasses.replace(r, name="") for r in six.values()], gravity=G, model=NOISE)
    assert found["accel_z"]["scale_factor"].value == pytest.approx(ERRORS.SN[2, 2], abs=1e-4)
    assert "9 orientations" in found["accel_z"]["misalignment_x"].describe()


# --------------------------------------------------------------------------------------------- the check
def test_a_misplaced_position_is_named():
    """x up is tilted by 3 mrad towards y, as x down might be: the six positions do not tell the two apart."""
    rng, tilted = np.random.default_rng(9), UPS * G
    tilted[0] = G * np.array([np.cos(3e-3), np.sin(3e-3), 0.0])
    means = means_of(tilted, noise_of(rng, 3800))
    setting = Setting(ACCELEROMETERS, places(SIX), WORLD)
    noise = covariances(setting.positions)
    _, misfit = errors_of(setting, means, noise)
    assert misfit.suspects == ("x up", "x down")
    assert "the means do not fit" in str(misfit)
    found, misfit = errors_of(setting._replace(orientation_error=3e-3), means, noise)
    assert misfit.p_value > 0.01
    # Two positions tell a misalignment: 3 mrad over √2.
    assert found[1]["misalignment_x"].std == pytest.approx(3e-3 / np.sqrt(2.0), rel=0.05)


def test_up_and_down_exchanged_is_an_error(six):
    turned = {"x up": "x down", "x down": "x up"}
    with pytest.raises(aj.RecordingError, match=r"accel_x reads -1 times .* Exchange up and down"):
        aj.calibrate({turned.get(k, k): r for k, r in six.items()}, gravity=G, model=NOISE)


# ------------------------------------------------------------------------------- recordings and settings
def test_apply_takes_the_errors_out(six, calibration):
    for name, up in SIX.items():
        found = calibration.apply(six[name])
        # 5e-5 m/s² a mean, and as much from the calibration; five times that.
        np.testing.assert_allclose(found.values.mean(axis=0), G * up, atol=4e-4)
    assert found.notes[-1] == "calibrated: accel_x, accel_y, accel_z"
    with pytest.raises(aj.RecordingError, match="no accel_z, but accel_x, accel_y"):
        calibration.apply(six["x up"]["accel_x", "accel_y"])


def test_names_tell_orientations(six, calibration):
    assert aj.calibrate(list(six.values()), gravity=G, model="N=0.0134 m/s/√h").results == calibration.results
    with pytest.raises(aj.AllanjaxError, match="no orientation in the name of other"):
        aj.calibrate([six["x up"], dataclasses.replace(six["x down"], name="other")], gravity=G, model=NOISE)


def test_what_is_not_known_of_gravity_is_not_known_of_the_scale(six, calibration):
    """35 mGal are 3.5e-4/9.81 = 36 ppm."""
    found = aj.calibrate(six, latitude=51.0, height=80.0, model="N=0.0134 m/s/√h")
    added = found["accel_x"]["scale_factor"].std ** 2 - calibration["accel_x"]["scale_factor"].std ** 2
    assert np.sqrt(added) == pytest.approx(3.5e-4 / found.gravity, rel=1e-3)
    assert "35 mGal" in str(found)


def test_starts_matter_to_drift(six):
    walk = {"accel": aj.AngleRandomWalk(1e-6) + aj.RateRandomWalk(1e-4)}

    def std(step: float) -> float:
        found = aj.calibrate(six, gravity=G, model=walk, starts=[k * step for k in range(6)])
        return found["accel_z"]["misalignment_x"].std

    near, far = std(20.0), std(2000.0)
    # Means of two stretches of T that begin a time t apart differ by K²(t − T/3): by 13.3 and 1,993 s.
    assert far / near == pytest.approx(np.sqrt(1993.3 / 13.3), rel=0.1)
    with pytest.raises(aj.AllanjaxError, match="starts at 10 s does so before"):
        aj.calibrate(six, gravity=G, model=walk, starts=[0, 10, 40, 60, 80, 100])


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({}, "give the latitude"),
        ({"gravity": 981.0}, "in m/s², about 9.8"),
        ({"gravity": G, "orientations": ["x up"]}, "1 orientations for 6"),
        ({"gravity": G, "model": {"gyro": "N"}}, "no noise model for accel_x"),
        ({"gravity": G, "model": NOISE, "starts": [0.0]}, "1 starts for 6"),
    ],
)
def test_wrong_settings_are_errors(six, options, said):
    with pytest.raises(aj.AllanjaxError, match=said):
        aj.calibrate(list(six.values()), **{"model": NOISE, **options})


def test_the_longest_position_is_fitted_where_no_noise_is_given():
    rng, records = np.random.default_rng(12), {}
    for way, sign, n in (("up", 1.0, 1000), ("down", -1.0, 500)):
        samples = sign * G + 1e-3 * np.sqrt(20.0) * rng.standard_normal(n)
        name = f"z {way}"
        records[name] = aj.Recording.from_array(
            samples, 20.0, accel_unit="m/s²", names=["accel_z"], name=name
        )
    found = aj.calibrate(records, gravity=G)
    assert found.noise == "fitted to the longest position, z up, 50 s"
    # N to within 5 %, its error with 1,000 samples being 2 %; likely sets of terms may have drift besides.
    expected = 1e-3 * np.sqrt(1.0 / 50.0 + 1.0 / 25.0) / 2.0
    assert expected * 0.95 < found["accel_z"]["bias"].std < expected * 1.5
    fitted = aj.fit(records["z up"])
    assert aj.calibrate(records, gravity=G, fit=fitted).results == found.results


def test_it_is_shown(calibration, tmp_path):
    frame = calibration.to_dataframe()
    assert frame.columns.tolist()[:4] == ["axis", "parameter", "value", "std"]
    assert frame["unit"].unique().tolist() == ["mg", "ppm", "µrad"]
    document = json.loads(json.dumps(calibration.to_dict(), allow_nan=False))
    assert document["sensors"]["accel"]["b"] == pytest.approx(ERRORS.b, abs=2e-4)
    assert document["positions"][1]["up"] == [-1.0, 0.0, 0.0]
    figure = calibration.plot(path=tmp_path / "calibration.png")
    assert [ax.get_title(loc="left") for ax in figure.axes] == ["accel_x", "accel_y", "accel_z"]
    labels = [label.get_text() for label in figure.axes[0].get_xticklabels()]
    assert labels == list(SIX)
    assert (tmp_path / "calibration.png").stat().st_size > 10_000
