"""What a calibration leaves in motion and at rest: by hand (2.41, 2.42), and from its dense covariance."""

import dataclasses
import json

import numpy as np
import pytest
from numpy.testing import assert_allclose
from refusals import refuses
from turned_sensors import EIGHTEEN, SIX, Errors, G, at_rest

import allanjax as aj

DEG, EARTH, G0 = np.pi / 180.0, 7.292115e-5, 9.80665
QUIET, RATE = aj.AngleRandomWalk(1e-12), 20.0
PPM = 1e-6
SCALE = PPM * np.array([[300.0, 100.0, 200.0], [400.0, -500.0, 250.0], [50.0, -30.0, 800.0]])
LEVEL = 2e-4
TIME = np.array([4.5, 9.0, 20.0])


def of_accelerometers(bias=0.0, model=f"N={LEVEL} m/s/√s"):
    errors = Errors(SCALE, bias * np.array([1.0, -2.0, 3.0]), np.zeros(3))
    means = errors.readings(G * EIGHTEEN[:6])
    records = {name: at_rest(m, 64, 0.1) for name, m in zip(SIX, means, strict=True)}
    return aj.calibrate(records, gravity=G, model=model, as_is=True)


def of_gyros():
    """At 30 degrees of latitude, with headings, so that everything is determined."""
    told = "x up, y north; x down, z north; y up, z east; y down, x west; z up, x south; z down, y north"
    up = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    north = np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0], [0, 0, -1], [-1, 0, 0], [0, 1, 0]])
    f = EARTH / DEG * 3600.0 * (0.5 * up + np.sqrt(0.75) * north)
    means = 2.0 + f @ (np.eye(3) + SCALE).T
    records = {name: at_rest(m, 64, 0.1, "deg/h") for name, m in zip(told.split("; "), means, strict=True)}
    return aj.calibrate(records, latitude=30.0, model="N=1e-9 deg/√h", as_is=True)


def integrated(rate, order):
    """A rate that acts for 9 s, integrated so many times by sums over 0.1 ms, at the times of the tests."""
    step = 1e-4
    t = np.arange(0.0, 20.0, step) + step / 2.0
    x = np.where(t < 9.0, rate, 0.0)
    for _ in range(order):
        x = np.cumsum(x) * step
    return x[np.rint(TIME / step).astype(int) - 1]


def test_scale_factor_and_misalignment_in_a_turn_of_90_degrees():
    """800 ppm about z give 0.072 deg; the part of the turn that y senses tilts, and so moves, the craft."""
    calibration, turn = of_gyros(), aj.Profile(turn_rate="10 deg/s", duration="9 s")
    options = {"rate": RATE, "calibration": calibration, "at_rest": 60.0, "profile": turn}
    models = {f"gyro_{a}": QUIET for a in "xyz"}
    found = aj.navigate(models, TIME, corrected=False, **options)
    assert_allclose(found["attitude"].of("down") / DEG, 90.0 * 800.0 * PPM * np.array([0.5, 1, 1]), rtol=1e-3)
    assert [*found["attitude"].largest("down")] == ["gyro_z scale factor"] * 3
    rate = 10.0 * DEG * 250.0 * PPM
    assert_allclose(found["attitude"].of("east"), integrated(rate, 1), rtol=1e-3)
    for quantity, order in (("velocity", 2), ("position", 3)):
        assert_allclose(found[quantity].of("north"), G0 * integrated(rate, order), rtol=1e-3)
        assert found[quantity].largest("north")[-1] == "gyro_y misalignment"
    assert any("turn is long" in note for note in found.notes)
    # 2 deg/h act all the time where no means at rest replace them, and are nearly all corrected.
    options |= {"at_rest": None, "profile": None}
    biased, left = (aj.navigate(models, TIME, corrected=c, **options)["attitude"] for c in (False, True))
    assert_allclose(biased.of("north"), 2.0 * DEG / 3600.0 * TIME, rtol=1e-6)
    assert np.all(left.of("north") < 1e-3 * biased.of("north"))


def test_scale_factor_and_misalignment_at_one_g():
    """300 ppm of 1 g for 9 s along x, and what of it the accelerometer along z takes for its own."""
    push = aj.Profile(acceleration="1 g", duration=9.0)
    options = {"rate": RATE, "calibration": of_accelerometers(), "corrected": False}
    models = {"accel_x": QUIET, "accel_z": QUIET}
    found = aj.navigate(models, TIME, at_rest=60.0, profile=push, **options)
    for channel, size in (("north", 300.0), ("down", 50.0)):
        for quantity, order in (("velocity", 1), ("position", 2)):
            expected = integrated(G0 * size * PPM, order)
            assert_allclose(found[quantity].of(channel), expected, rtol=1e-3)
    # Without means at rest gravity, along −z, acts on scale factor and misalignment as a bias.
    still = aj.navigate(models, TIME, **options)["velocity"]
    for channel, size in (("north", 200.0), ("down", 800.0)):
        assert_allclose(still.of(channel), G0 * size * PPM * TIME, rtol=1e-3)
        kinds = {cause.partition(" ")[2] for cause in still.causes[channel]}
        assert kinds == {"bias", "velocity random walk"}


def test_what_is_left_is_the_covariance_of_the_calibration():
    """By dense least squares of readings up and twice down, whose bias and scale factor are correlated."""
    means = (("up", G + 0.01), ("down", -G + 0.012), ("down", -G + 0.0118))
    records = [at_rest([m], 64, 0.1, name=f"z {way}", axes="z") for way, m in means]
    known = aj.calibrate(records, gravity=G, model=f"N={LEVEL} m/s/√s", as_is=True)
    X = np.array([[1.0, G], [1.0, -G], [1.0, -G]])
    C = LEVEL**2 / 640.0 * np.linalg.inv(X.T @ X)
    assert_allclose(known["accel_z"].covariance[:2, :2], C, rtol=1e-6)
    push = aj.Profile(acceleration=(0.0, 0.0, 5.0), duration=9.0)
    found = aj.navigate({"accel_z": QUIET}, TIME, rate=RATE, calibration=known, profile=push)
    for quantity, order in (("velocity", 1), ("position", 2)):
        x = np.array([TIME**order / order, integrated(5.0, order) - G0 * TIME**order / order])
        expected = np.sqrt(np.einsum("it,ij,jt->t", x, C, x))
        assert_allclose(found[quantity].of("down"), expected, rtol=1e-4)
        alone = found[quantity].causes["down"]
        rest = np.array([1.0, -G0])
        assert_allclose(alone["accel_z bias"], np.sqrt(rest @ C @ rest) * TIME**order / order, rtol=1e-6)
        assert_allclose(alone["accel_z scale factor"], np.sqrt(C[1, 1]) * integrated(5.0, order), rtol=1e-3)
    # All of the calibration at rest was before the start.
    assert found.at_rest == pytest.approx(3 * 640.0)
    across = aj.Profile(acceleration=(1.0, 2.0, 0.0))
    found = aj.navigate({"accel_z": QUIET}, TIME, rate=RATE, calibration=known, profile=across)
    assert any("misalignment x, misalignment y" in note for note in found.notes)


def test_corrected_velocities_scatter_as_told():
    """150 simulated calibrations of one sensor, each applied to 5 m/s² for 9 s and to rest until 20 s."""
    rng, left = np.random.default_rng(5), []
    errors = Errors(SCALE, np.array([0.01, -0.02, 0.03]), np.zeros(3))
    rest, push = np.array([[0.0, 0.0, -G0]]), np.array([[5.0, 0.0, -G0]])
    for _ in range(150):
        means = errors.readings(G * EIGHTEEN[:6]) + LEVEL / np.sqrt(640.0) * rng.standard_normal((6, 3))
        records = {name: at_rest(m, 64, 0.1) for name, m in zip(SIX, means, strict=True)}
        known = aj.calibrate(records, gravity=G, model=f"N={LEVEL} m/s/√s", as_is=True)
        moving, still = (known.errors("accel").inputs(errors.readings(f)) - f for f in (push, rest))
        left.append((9.0 * moving + 11.0 * still)[0])
    profile = aj.Profile(acceleration=5.0, duration=9.0)
    models = {f"accel_{a}": QUIET for a in "xyz"}
    found = aj.navigate(models, [20.0], rate=RATE, calibration=known, profile=profile)["velocity"]
    # The scatter of 150 is known to 6 %.
    assert_allclose(np.std(left, axis=0), found.error[:, 0], rtol=0.18)


def test_it_is_told_in_text_document_and_figure():
    push = aj.Profile(acceleration="0.5 g", turn_rate=(0.0, 0.0, 10 * DEG), duration="20 s")
    options = {"rate": RATE, "calibration": of_accelerometers(0.003), "profile": push}
    found = aj.navigate({"accel_x": QUIET, "accel_y": QUIET}, TIME, corrected=False, **options)
    document = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert document["profile"]["acceleration_m_s2"] == pytest.approx([0.5 * G0, 0.0, 0.0])
    assert (document["profile"]["duration_s"], document["calibration"]) == (20.0, "uncorrected")
    causes = document["errors"]["velocity"]["channels"]["north"]["causes"]
    assert {"accel_x bias", "accel_x scale factor"} <= set(causes)
    assert "turning at 0, 0, 10 deg/s and accelerating at 0.5, 0, 0 g for 20 s" in str(found)
    lines = {line.get_label() for panel in found.plot().axes for line in panel.get_lines()}
    assert "accel_x scale factor" in lines
    # Coherent errors, 3 mm/s² and 200 µrad·g, and 300 ppm of 0.5 g.
    error = 0.003 - 200.0 * PPM * G0 + 300.0 * PPM * 0.5 * G0
    assert found["velocity"].of("north")[0] == pytest.approx(error * TIME[0], rel=1e-4)
    partly = aj.navigate({"accel_x": QUIET, "accel_y": QUIET, "gyro_z": QUIET}, TIME, **options)
    assert any("gyro_z: not calibrated" in note for note in partly.notes)


def test_what_is_wrong_is_refused():
    known, models = of_accelerometers(), {"accel_x": QUIET}
    for options, word in (
        ({"turn_rate": "10 m/s²"}, "m/s²"), ({"turn_rate": "fast"}, "--turn-rate"),
        ({"acceleration": "1, 2 g"}, "--acceleration"),
        ({"acceleration": [1.0, np.nan, 0.0]}, "acceleration"),
        ({"duration": "-1 s"}, "--for"),
    ):  # fmt: skip
        refuses(word, aj.Profile, **options)
    refuses("calibration=", aj.navigate, models, rate=RATE, profile=aj.Profile(acceleration=1.0))
    refuses("at_rest=", aj.navigate, models, rate=RATE, calibration=600.0)
    refuses("none of the axes", aj.navigate, {"gyro_x": QUIET}, rate=RATE, calibration=known)


def test_a_calibration_from_its_file_is_the_same(tmp_path):
    known = of_accelerometers(0.01)
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(known.to_dict()), encoding="utf-8")
    found = aj.load_calibration(path)
    assert str(found) == str(known)
    assert found.positions == known.positions
    for one, other in zip(found.values(), known.values(), strict=True):
        assert one.coefficients.keys() == other.coefficients.keys()
        for label, c in one.coefficients.items():
            numbers = ([x.value, x.std, *x.interval, *x.interval_68] for x in (c, other[label]))
            assert_allclose(*numbers, rtol=1e-12, atol=1e-300)
        assert_allclose(one.covariance, other.covariance)
    assert_allclose(found.misfit["accel"].residuals, known.misfit["accel"].residuals)
    options = {"rate": RATE, "corrected": False}
    grown = (aj.navigate({"accel_x": QUIET}, TIME, calibration=k, **options) for k in (found, known))
    assert_allclose(*(of["position"].error for of in grown), rtol=1e-12)
    damaged, other = json.dumps(known.to_dict() | {"axes": None}), '{"schema_version": 1}'
    for text, word in (("{", "JSON"), (other, "allanjax calibrate"), (damaged, "damaged")):
        path.write_text(text, encoding="utf-8")
        refuses(word, aj.load_calibration, path)
    refuses("no such file", aj.load_calibration, tmp_path / "none.json")
    assert dataclasses.replace(known) == known
