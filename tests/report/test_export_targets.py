"""Exports of a fit: each target's own arithmetic gives the covariances of the model."""

import dataclasses
import json
import math
import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from commands import run
from export_arithmetic import EACH, ONE_TIME, STEPS, WITH_TIME, error_of, predicted, read_python, read_yaml
from export_sensors import AXES, RATE, markov, model_of, recording, walk, with_one_time

import allanjax as aj
from allanjax.base.errors import AllanjaxError, FitError
from allanjax.report.export import exporting
from allanjax.report.export.table import TARGETS
from allanjax.report.export.targets import Key, Target
from allanjax.report.files import write_json

# Steps of 12 ms and less make an error of 1.2 % of the covariance of angle and bias over 1 s.
TOLERANCE = 0.02


@pytest.fixture(scope="module")
def walking():
    return aj.fit(recording(walk), "N + K")


@pytest.fixture(scope="module")
def wandering():
    return aj.fit(recording(markov), "N + markov")


@pytest.fixture(scope="module")
def gyros_only():
    return aj.fit(recording(walk, AXES[:3], 20_000), "N + K")


def test_there_is_an_arithmetic_of_every_target():
    assert set(STEPS) == set(TARGETS)


def test_the_reference_is_the_textbook_one():
    """Covariance of white noise and a walk over 1 s."""
    want = [[4.0 + 9.0 / 3.0, 9.0 / 2.0], [9.0 / 2.0, 9.0]]
    np.testing.assert_allclose(predicted(2.0, 3.0), want, rtol=1e-12)


@pytest.mark.parametrize("target", TARGETS)
def test_a_target_predicts_what_the_model_does(walking, target):
    assert not walking["gyro_z"].coefficients["rate_random_walk"].detected
    text = aj.export(walking, target)
    # A walk is told with a long correlation time: an hour is far beyond 1 s.
    assert error_of(target, text, model_of(walking), RATE) < TOLERANCE


@pytest.mark.parametrize("target", WITH_TIME)
def test_a_target_with_a_correlation_time_holds_a_markov_process(wandering, target):
    model = model_of(wandering, "markov_amplitude", "markov_correlation_time")
    text = aj.export(wandering, target)
    if target in ONE_TIME:
        model = with_one_time(model)
    assert error_of(target, text, model, RATE) < TOLERANCE
    assert "NOT HELD" not in text


@pytest.mark.parametrize("target", sorted(set(TARGETS) - {"px4", "ardupilot"}))
def test_another_rate_is_the_targets(walking, target):
    text = aj.export(walking, target, rate=500.0)
    assert error_of(target, text, model_of(walking), 500.0) < TOLERANCE


@pytest.mark.parametrize(
    ("target", "right", "wrong"),
    [
        ("vins-mono", "N*sqrt(2*r)", "N*sqrt(r)"),
        ("vins-mono", "K*sqrt(r)", "K/sqrt(r)"),
        ("kalibr", "K", "K*1.02"),
        ("fast-lio2", "N**2*r", "N**2"),
        ("ardupilot", "K*sqrt(r)", "K"),
        ("gz-sim", "q", "q*sqrt(T/2)"),
    ],
)
def test_a_wrong_formula_is_noticed(walking, monkeypatch, target, right, wrong):
    def spoilt(key):
        return dataclasses.replace(key, formula=wrong) if getattr(key, "formula", "") == right else key

    keys = tuple(map(spoilt, TARGETS[target].keys))
    assert keys != TARGETS[target].keys
    monkeypatch.setattr(exporting, "TARGETS", {target: dataclasses.replace(TARGETS[target], keys=keys)})
    assert error_of(target, aj.export(walking, target), model_of(walking), RATE) > TOLERANCE


def words_of(text):
    """A file without marks of comments and line breaks."""
    lines = [re.sub(r"^\s*(#|%|<!--)", "", line).removesuffix("-->") for line in text.splitlines()]
    return " ".join(" ".join(lines).split())


def numbers_in(text, begin):
    """Value and ends of the interval wherever a quantity in rad is told."""
    number = r"\(?(-?[\d.]+(?:e[+-]\d+)?)"
    pattern = rf"{begin} = {number} \S+ \(95 %: {number} \.\.\. {number}\)?(e[+-]\d+)?"
    for value, low, high, power in re.findall(pattern, text):
        yield float(value), float(low + power), float(high + power)


@pytest.mark.parametrize("target", TARGETS)
def test_every_value_says_where_it_comes_from(walking, target):
    """Its formula, unit, source, the estimate with its interval; and that K of gyro_z is a limit."""
    to, text = TARGETS[target], words_of(aj.export(walking, target))
    assert text.isascii()
    keys = [key for key in to.noise_keys if key.sensor]
    source = to.source.partition(":")[0]
    told = re.findall(r"= (\S+) \[\S+\]; source: " + re.escape(source), text)
    assert set(told) == {key.formula for key in keys if key.formula != "B"}
    for symbol, label in (("N", "angle_random_walk"), ("K", "rate_random_walk")):
        if not any({symbol, "q"} & set(key.symbols) for key in keys):
            assert f"NOT HELD by {to.title}: {label.replace('_', ' ')}" in text
            continue
        for sensor in ("gyro", "accel"):
            cs = [walking[f"{sensor}_{axis}"].coefficients[label] for axis in "xyz"]
            cs = [c for c in cs if c.detected]
            for c in cs if target in EACH else [max(cs, key=lambda c: c.value)]:
                want = (c.value, *c.interval)
                assert any(np.allclose(got, want, rtol=0.01) for got in numbers_in(text, symbol))
    limit = walking["gyro_z"].coefficients["rate_random_walk"].upper_limit
    if target in EACH and any({"K", "q"} & set(key.symbols) for key in keys):
        assert f"K NOT DETECTED: this is its 95 % upper limit {limit:.4e}" in text


def test_the_worst_the_mean_and_each(walking):
    N = [walking[f"gyro_{a}"].coefficients["angle_random_walk"].value for a in "xyz"]
    for axes, value in ((None, max(N)), ("worst", max(N)), ("mean", np.mean(N))):
        got = read_yaml(aj.export(walking, "kalibr", axes=axes))["gyroscope_noise_density"]
        assert got == pytest.approx(value, rel=1e-5)
    for axes, want in ((None, N), ("each", N), ("worst", [max(N)] * 3), ("mean", [np.mean(N)] * 3)):
        got = json.loads(aj.export(walking, "basalt", axes=axes))["value0"]["gyro_noise_std"]
        np.testing.assert_allclose(got, want, rtol=1e-5)
    with pytest.raises(AllanjaxError, match="one value for all axes"):
        aj.export(walking, "kalibr", axes="each")


def test_the_interval_of_a_mean_is_that_of_independent_axes(walking):
    cs = [walking[f"accel_{a}"].coefficients["angle_random_walk"] for a in "xyz"]
    text = aj.export(walking, "kalibr", axes="mean")
    low, high = map(float, re.search(r"N = \S+ m/s/sqrt\(s\) \(95 %: (\S+) \.\.\. (\S+)\)", text).groups())
    # Normal errors: the half width is 1.96 standard deviations of the mean.
    half = 1.96 * math.hypot(*(c.std for c in cs)) / 3.0
    assert (high - low) / 2.0 == pytest.approx(half, rel=0.05)


def test_a_mean_with_a_limit_in_it_says_so(walking):
    text = words_of(aj.export(walking, "kalibr", axes="mean"))
    assert "NOT DETECTED in gyro_z, of which the 95 % upper limit is in the mean" in text


def test_a_sensor_that_is_not_there_is_left_out_with_the_remedy(gyros_only):
    text = aj.export(gyros_only, "kalibr")
    assert set(read_yaml(text)) == {
        "gyroscope_noise_density", "gyroscope_random_walk", "rostopic", "update_rate",
    }  # fmt: skip
    why = "left out: there is no accelerometer with a result; take a recording that has one"
    assert f"accelerometer_noise_density, accelerometer_random_walk {why}" in words_of(text)
    root = ET.fromstring(aj.export(gyros_only, "gz-sim"))
    assert [child.tag for child in root] == ["angular_velocity"]
    names = read_python(aj.export(gyros_only, "pegasus"))
    assert set(names["imu_config"]) == {"gyroscope"}


def test_no_walk_is_invented(wandering):
    """A model without K: a target that holds nothing else gets none, and the process is told."""
    text = words_of(aj.export(wandering, "vins-mono"))
    assert set(read_yaml(aj.export(wandering, "vins-mono"))) == {"gyr_n", "acc_n"}
    assert "gyr_w, acc_w left out: no rate random walk in the fitted model" in text
    assert "NOT HELD by VINS-Mono: markov amplitude q_c" in text


def test_matlab_gets_a_bias_instability_that_is_detected_only(small_fit):
    """And no limit, for a simulator makes noise of it."""
    text = aj.export(small_fit, "matlab")
    for sensor, names in (("gyro", ("gyro_x", "gyro_y", "gyro_z")), ("accel", ("accel_z",))):
        found = [small_fit[name].coefficients["bias_instability"] for name in names]
        got = re.search(rf"^{sensor}.BiasInstability = (.*);$", text, re.M)
        assert bool(got) == any(c.detected for c in found)
        assert got or f"{sensor}.BiasInstability = ...; left out: B NOT DETECTED" in words_of(text)


def test_an_axis_that_is_no_measurement_is_not_exported(walking):
    x, *others = walking.results
    spoilt = dataclasses.replace(walking, results=(x.unmeasured(moving=True), *others))
    text = aj.export(spoilt, "basalt")
    N = [walking[f"gyro_{a}"].coefficients["angle_random_walk"].value for a in "yz"]
    got = json.loads(text)["value0"]["gyro_noise_std"]
    np.testing.assert_allclose(got, [max(N), *N], rtol=1e-5)
    assert "without gyro_x" in text
    assert "in the place of x" in text
    none = dataclasses.replace(walking, results=tuple(r.unmeasured(moving=True) for r in walking.results))
    with pytest.raises(FitError, match="no axis to export"):
        aj.export(none, "kalibr")


def test_an_autopilots_file_says_that_it_is_a_floor(walking):
    for target in ("px4", "ardupilot"):
        assert "FLOOR" in aj.export(walking, target)


def test_an_outside_value_is_told(gyros_only, monkeypatch):
    key = Key("k", "N", "rad/s/√Hz", "gyro", least=1.0, most=2.0)
    monkeypatch.setattr(exporting, "TARGETS", {"t": Target("t", "T", "yaml", "its manual", (key,))})
    assert "OUTSIDE of the 1 to 2 rad/s/sqrt(Hz) that T accepts" in aj.export(gyros_only, "t")


def test_a_new_target_takes_a_few_lines(gyros_only, monkeypatch):
    key = Key("imu/sigma", "N*sqrt(r)", "deg/s", "gyro")
    new = Target("mine", "Mine", "yaml", "its manual", (key,))
    monkeypatch.setattr(exporting, "TARGETS", {"mine": new})
    N = max(gyros_only[f"gyro_{a}"].coefficients["angle_random_walk"].value for a in "xyz")
    got = read_yaml(aj.export(gyros_only, "mine"))["imu"]["sigma"]
    assert got == pytest.approx(math.degrees(N * math.sqrt(RATE)), rel=1e-5)


def test_a_name_of_a_recording_spoils_no_file(gyros_only):
    odd = dataclasses.replace(gyros_only, name="a --> b\n--- é: }")
    for target in TARGETS:
        text = aj.export(odd, target)
        if TARGETS[target].syntax == "xml":
            ET.fromstring(text)
        elif TARGETS[target].syntax == "yaml":
            assert read_yaml(text)
        elif TARGETS[target].syntax == "json":
            json.loads(text)
        text.encode("ascii")


@pytest.mark.parametrize("target", [name for name, t in TARGETS.items() if t.syntax == "yaml"])
def test_numbers_are_numbers_to_old_readers_of_yaml(walking, target):
    """YAML 1.1, which Kalibr's reader has, takes 1e-05 for a text."""
    yaml = pytest.importorskip("yaml")

    def leaves(x):
        if isinstance(x, dict):
            return [leaf for value in x.values() for leaf in leaves(value)]
        return [leaf for value in x for leaf in leaves(value)] if isinstance(x, list) else [x]

    texts = {x for x in leaves(yaml.safe_load(aj.export(walking, target))) if isinstance(x, str)}
    assert texts <= {"/imu0", "kalibr", "IMU", "imu", " rad/s", " m/s^2"}


def test_gtsam_itself_predicts_what_the_model_does(walking):
    """Its own preintegration over 1 s of what the snippet has set."""
    gtsam = pytest.importorskip("gtsam")
    params = read_python(aj.export(walking, "gtsam"))["params"]
    measured = gtsam.PreintegratedCombinedMeasurements(params)
    for _ in range(int(RATE)):
        measured.integrateMeasurement(np.zeros(3), np.zeros(3), 1.0 / RATE)
    got = measured.preintMeasCov()
    model = model_of(walking)
    for k, axis in enumerate("xyz"):
        # Angle, position, velocity, biases of accelerometers and of gyros.
        for sensor, state, bias in (("gyro", k, 12 + k), ("accel", 6 + k, 9 + k)):
            N, K, _ = model[sensor][axis]
            want = predicted(N, K)
            assert got[state, state] == pytest.approx(want[0, 0], rel=TOLERANCE)
            assert got[bias, bias] == pytest.approx(want[1, 1], rel=TOLERANCE)


@pytest.mark.parametrize("name", ["VINS-Mono", "vins_mono", "Vins Mono", "vinsmono"])
def test_names_of_targets_are_written_as_people_do(gyros_only, name):
    assert aj.export(gyros_only, name) == aj.export(gyros_only, "vins-mono")


def test_what_cannot_be_asked_is_refused(gyros_only):
    with pytest.raises(AllanjaxError, match=r"no target 'fusioncore'.*kalibr"):
        aj.export(gyros_only, "fusioncore")
    with pytest.raises(AllanjaxError, match="rate must be positive"):
        aj.export(gyros_only, "kalibr", rate=0.0)
    with pytest.raises(AllanjaxError, match="one of each, worst, mean"):
        aj.export(gyros_only, "kalibr", axes="best")


def test_the_text_is_written_to_a_file(gyros_only, tmp_path):
    text = aj.export(gyros_only, "kalibr", path=tmp_path / "imu.yaml")
    assert (tmp_path / "imu.yaml").read_text(encoding="ascii") == text


def test_the_command_gives_what_the_function_does(gyros_only, tmp_path, elsewhere):
    write_json(gyros_only, "bench.json")
    done = run("export", "bench.json", "--to", "kalibr", "-o", "imu.yaml")
    assert done.exit_code == 0
    assert "warning: accelerometer_noise_density, accelerometer_random_walk left out" in done.stderr
    assert (tmp_path / "imu.yaml").read_text(encoding="ascii") == aj.export(gyros_only, "kalibr")
    shown = run("export", "bench.json", "--to", "basalt", "--rate", "100", "--axes", "mean")
    assert shown.stdout == aj.export(gyros_only, "basalt", axes="mean", rate=100.0)


def test_the_command_lists_and_refuses(gyros_only, elsewhere):
    listed = run("export", "--list").stdout
    assert all(re.search(rf"^{re.escape(name)} ", listed, re.M) for name in TARGETS)
    write_json(gyros_only, "bench.json")
    for words, code in (((), 2), (("bench.json",), 2), (("bench.json", "--to", "nothing"), 1)):
        assert run("export", *words).exit_code == code
    assert "no such file" in run("export", "none.json", "--to", "kalibr").stderr
