"""Exports of a fit: each target's own arithmetic gives the covariances of the model."""

import dataclasses
import functools
import itertools
import json
import math
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import bench
import numpy as np
import pytest
from altered_fits import with_terms
from commands import run
from export_arithmetic import EACH, ONE_TIME, STEPS, WITH_TIME, error_of, predicted, read_python, read_yaml

import allanjax as aj
from benchmarks.common.export_sensors import AXES, RATE, model_of, recording, walk, with_one_time

pytestmark = pytest.mark.usefixtures("elsewhere")

# Steps of 12 ms and less make an error of 1.2 % of the covariance of angle and bias over 1 s.
TOLERANCE = 0.02
WITHOUT_BIAS = ("imu_utils-original", "glim", "robot_localization", "isaac-lab", "gazebo-classic")


@functools.cache
def walking():
    return bench.once("export walking", lambda: aj.fit(recording(walk), "N + K"))


@functools.cache
def wandering():
    models = {}
    for k, name in enumerate(AXES):
        scale = 1.0 if name.startswith("gyro") else 10.0
        process = aj.Markov(3e-4 * scale * (1.0 + 0.3 * k), 5.0 - 0.4 * k)
        models[name] = aj.AngleRandomWalk(1e-4 * scale * (1.0 + 0.2 * k)) + process
    return with_terms(walking(), models)


def coefficients(sensor, label="angle_random_walk"):
    return [walking()[f"{sensor}_{axis}"].coefficients[label] for axis in "xyz"]


def test_the_reference_is_the_textbook_one_and_there_is_an_arithmetic_of_every_target():
    want = [[4.0 + 9.0 / 3.0, 9.0 / 2.0], [9.0 / 2.0, 9.0]]
    np.testing.assert_allclose(predicted(2.0, 3.0), want, rtol=1e-12)
    assert re.findall(r"^(\S+)", run("export", "--list").stdout, re.M) == list(STEPS)


@pytest.mark.parametrize("target", STEPS)
def test_a_target_predicts_what_the_model_does(target):
    """By the rate of the recording and another; autopilots have their own. No recording's name spoils it."""
    fit, model = walking(), model_of(walking())
    # A walk is told with a long correlation time: an hour is far beyond 1 s.
    assert error_of(target, aj.export(fit, target), model, RATE) < TOLERANCE
    if target not in ("px4", "ardupilot"):
        assert error_of(target, aj.export(fit, target, rate=500.0), model, 500.0) < TOLERANCE
    text = aj.export(dataclasses.replace(fit, name="a --> b\n--- é: }"), target)
    assert text.isascii()
    assert error_of(target, text, model, RATE) < TOLERANCE
    # YAML 1.1, which Kalibr's reader has, takes 1e-05 for a text.
    assert all("." in number for number in re.findall(r"[:\s\[](-?[\d.]+e[+-]?\d+)", text))


@pytest.mark.parametrize("target", WITH_TIME)
def test_a_target_with_a_correlation_time_holds_a_markov_process(target):
    model = model_of(wandering(), "markov_amplitude", "markov_correlation_time")
    text = aj.export(wandering(), target)
    if target in ONE_TIME:
        model = with_one_time(model)
    assert error_of(target, text, model, RATE) < TOLERANCE
    assert " has no " not in text


def words_of(text):
    lines = [re.sub(r"^\s*(#|%|<!--)", "", line).removesuffix("-->") for line in text.splitlines()]
    return " ".join(" ".join(lines).split())


@pytest.mark.parametrize("target", STEPS)
def test_every_value_says_where_it_comes_from(target):
    text = words_of(aj.export(walking(), target))
    assert "source: " in text
    assert ("FLOOR" in text) == (target in ("px4", "ardupilot"))
    number = r"\(?(-?[\d.]+(?:e[+-]\d+)?)"
    for symbol, label in (("N", "angle_random_walk"), ("K", "rate_random_walk")):
        lacking = symbol == "K" and target in WITHOUT_BIAS
        assert (f" has no {label.replace('_', ' ')}: {symbol} = " in text) == lacking
        # The power of ten is told once, behind the interval.
        pattern = rf"{symbol} = {number} \S+ \(95 %: {number} \.\.\. {number}\)?(e[+-]\d+)?"
        told = [(float(v), float(low + e), float(high + e)) for v, low, high, e in re.findall(pattern, text)]
        for sensor in ("gyro", "accel") if not lacking else ():
            cs = [c for c in coefficients(sensor, label) if c.detected]
            for c in cs if target in EACH else [max(cs, key=lambda c: c.value)]:
                # The error is told with two digits.
                assert any(np.allclose(got, (c.value, *c.interval), 0.0, 0.06 * c.std) for got in told)
    limit = coefficients("gyro", "rate_random_walk")[2].upper_limit
    if target in EACH and target not in WITHOUT_BIAS:
        assert f"K = {limit:.4e} rad/s/sqrt(s) (95 % upper limit), not detected" in text


def test_the_worst_the_mean_and_each():
    """Of a mean of independent axes, the half width is 1.96 standard deviations. A limit in it is told."""
    N = [c.value for c in coefficients("gyro")]
    worst, mean = 3 * [max(N)], 3 * [np.mean(N)]
    for axes, each, value in ((None, N, worst[0]), ("worst", worst, worst[0]), ("mean", mean, mean[0])):
        got = read_yaml(aj.export(walking(), "kalibr", axes=axes))["gyroscope_noise_density"]
        assert got == pytest.approx(value, rel=1e-5)
        got = json.loads(aj.export(walking(), "basalt", axes=axes))["value0"]["gyro_noise_std"]
        np.testing.assert_allclose(got, each, rtol=1e-5)
    assert aj.export(walking(), "basalt", axes="each") == aj.export(walking(), "basalt")
    std = math.hypot(*(c.std for c in coefficients("accel"))) / 3.0
    text = words_of(aj.export(walking(), "kalibr", axes="mean"))
    low, high = map(float, re.search(r"N = \S+ m/s/sqrt\(s\) \(95 %: (\S+) \.\.\. (\S+)\)", text).groups())
    assert (high - low) / 2.0 == pytest.approx(1.96 * std, rel=0.05)
    assert "not detected on gyro_z" in text


def test_what_is_not_there_is_left_out():
    gyros = dataclasses.replace(walking(), results=walking().results[:3])
    text = aj.export(gyros, "kalibr")
    assert {name.split("_")[0] for name in read_yaml(text)} == {"gyroscope", "rostopic", "update"}
    assert "accelerometer_noise_density, accelerometer_random_walk left out" in words_of(text)
    (child,) = ET.fromstring(aj.export(gyros, "gz-sim"))
    assert (child.tag, child.find("x/noise").get("type")) == ("angular_velocity", "gaussian")
    assert set(read_python(aj.export(gyros, "pegasus"))["imu_config"]) == {"gyroscope"}
    text = aj.export(wandering(), "vins-mono")
    assert set(read_yaml(text)) == {"gyr_n", "acc_n"}
    assert "gyr_w, acc_w left out" in words_of(text)
    assert "VINS-Mono has no Markov process amplitude: q_c = " in words_of(text)
    # No limit, for a simulator makes noise of it.
    fit = bench.fit("small")
    text = aj.export(fit, "matlab")
    values = json.loads(re.search(r"^gyro.BiasInstability = (.*);$", text, re.M)[1])
    np.testing.assert_allclose(values, [fit[f"gyro_{a}"]["B"].value for a in "xyz"], rtol=1e-4)
    assert "accel.BiasInstability = ...; left out: B = " in words_of(text)


def test_what_is_no_measurement_or_cannot_be_asked_is_refused():
    x, *others = walking().results
    spoilt = dataclasses.replace(walking(), results=(x.unmeasured(not_measured=("at rest",)), *others))
    text, N = aj.export(spoilt, "basalt"), [c.value for c in coefficients("gyro")[1:]]
    np.testing.assert_allclose(json.loads(text)["value0"]["gyro_noise_std"], [max(N), *N], rtol=1e-5)
    assert "without gyro_x" in text
    with pytest.raises(aj.FitError, match="axis"):
        aj.export(dataclasses.replace(spoilt, results=spoilt.results[:1]), "kalibr")
    wrong = ({"rate": 0.0}, "rate"), ({"axes": "best"}, "worst"), ({"axes": "each"}, "all axes")
    for options, word in (({"target": "fusioncore"}, "kalibr"), *wrong):
        with pytest.raises(aj.AllanjaxError, match=word):
            aj.export(walking(), **{"target": "kalibr", **options})


def test_the_command_gives_what_the_function_does():
    white = bench.fit("white", "N")
    aj.write_json(walking(), "bench.json")
    aj.write_json(white, "white.json")
    done = run("export", "white.json", "--to", "Vins Mono", "-o", "imu.yaml")
    assert (done.exit_code, "acc_n, acc_w left out" in done.stderr) == (0, True)
    aj.export(white, "vins_mono", path="same.yaml")
    texts = [Path(name).read_text(encoding="ascii") for name in ("imu.yaml", "same.yaml")]
    assert texts == [aj.export(white, "vins-mono")] * 2
    shown = run("export", "bench.json", "--to", "basalt", "--rate", "100", "--axes", "mean")
    assert shown.stdout == aj.export(walking(), "basalt", axes="mean", rate=100.0)
    refused = {"": 2, "bench.json": 2, "bench.json --to no": 1, "none.json --to kalibr": 1}
    assert {words: run("export", *words.split()).exit_code for words in refused} == refused


# Range of each parameter, as AP_NavEKF3.cpp and the yaml files of PX4's ekf2 document it, and its rate [Hz].
RANGES = {
    "ardupilot": {
        "EK3_GYRO_P_NSE": (0.0001, 0.1),
        "EK3_ACC_P_NSE": (0.01, 1.0),
        "EK3_GBIAS_P_NSE": (0.00001, 0.001),
        "EK3_ABIAS_P_NSE": (0.00001, 0.02),
    },
    "px4": {
        "EKF2_GYR_NOISE": (0.0001, 0.1),
        "EKF2_ACC_NOISE": (0.01, 1.0),
        "EKF2_GYR_B_NOISE": (0.0, 0.01),
        "EKF2_ACC_B_NOISE": (0.0, 0.01),
    },
}
KEYS = ("gyroscope_noise_density", "accelerometer_noise_density", "gyroscope_random_walk")
KEYS += ("accelerometer_random_walk",)


@pytest.mark.parametrize("target", RANGES)
def test_a_value_beyond_the_documented_range_is_commented_out(tmp_path, target):
    rate, ranges = {"ardupilot": 1.0 / 0.012, "px4": 100.0}[target], RANGES[target]
    for end, factor in itertools.product((0, 1), (0.99, 1.01)):
        values = {name: max(factor * limits[end], 1e-8) for name, limits in ranges.items()}
        rows = [f"{key}: {x / math.sqrt(rate):.17g}" for key, x in zip(KEYS, values.values(), strict=True)]
        (tmp_path / "there.yaml").write_text("\n".join(rows), encoding="utf-8")
        done = run("export", "there.yaml", "--from", "kalibr", "--to", target)
        shown, off = (
            set(re.findall(rf"^{begin}(?:param set )?(EK\w+)[, ]\S+$", done.stdout, re.M))
            for begin in ("", "# ")
        )
        assert shown == {name for name, (least, most) in ranges.items() if least <= values[name] <= most}
        assert off == ranges.keys() - shown
        assert sum("is commented out: the range" in line for line in done.stderr.splitlines()) == len(off)
        assert done.exit_code == (1 if off else 0)


UNREADABLE = ("imu_utils", "gtsam", "airsim", "isaac-lab", "pegasus", "matlab")
OWN_N, OWN_K = {"gyro": 1.7e-4, "accel": 2.0e-3}, {"gyro": 1.9e-5, "accel": 6.0e-4}
# Whose files hold no walk of a bias: none, or a Markov process.
WITHOUT_WALK = (
    "imu_utils-original glim robot_localization gz-sim gazebo-classic rotors hybvio kf-gins ob-gins"
)
# As Kalibr's wiki has it.
KALIBR = f"""#Accelerometers
accelerometer_noise_density: {OWN_N["accel"]:.6e}   #Noise density (continuous-time)
accelerometer_random_walk:   {OWN_K["accel"]:.6e}   #Bias random walk
gyroscope_noise_density:     {OWN_N["gyro"]:.6e}
gyroscope_random_walk:       {OWN_K["gyro"]:.6e}
rostopic:                    /imu0      #the IMU ROS topic
update_rate:                 {RATE}      #Hz (for discretization of the values above)
"""

# A part of euroc_config.yaml of VINS, with what stands around the four.
VINS = """%YAML:1.0

extrinsicRotation: !!opencv-matrix
   data: [0.0148655429818,
           0.999557249008]

#imu parameters       The more accurate parameters you provide, the better performance
acc_n: 0.08          # accelerometer measurement noise standard deviation. #0.2   0.04
gyr_n: 0.004         # gyroscope measurement noise standard deviation.     #0.05  0.004
acc_w: 0.00004         # accelerometer bias random work noise standard deviation.  #0.02
gyr_w: 2.0e-6       # gyroscope bias random work noise standard deviation.     #4.0e-5
"""
# deg/√h, m/s/√h, deg/h, mGal and h.
GINS = """imudatarate: 200
imunoise:
  arw: [0.003, 0.004, 0.003]          # [deg/sqrt(hr)]
  vrw: [0.03, 0.03, 0.03]
  gbstd: [0.027, 0.027, 0.05]
  abstd: [15.0, 15.0, 15.0]
  corrtime: 4.0                    # [hr]
antlever:  [ 0.136, -0.301, -0.184 ]
"""


def converted(tmp_path, text, source, target, *options):
    (tmp_path / "there.yaml").write_text(text, encoding="utf-8")
    done = run("export", "there.yaml", "--from", source, "--to", target, *options)
    assert done.exit_code == 0, done.stderr
    return done.stdout


def number(text, name):
    found = re.search(rf"^{name}: +(\S+)", text, re.M)
    return float(found[1]) if found else None


@pytest.mark.parametrize("target", STEPS)
def test_there_and_back(tmp_path, target):
    """Its file is Kalibr's again; what is there is read in the target's own arithmetic elsewhere."""
    there = converted(tmp_path, KALIBR, "kalibr", target)
    model = {sensor: {"y": (OWN_N[sensor], OWN_K[sensor], math.inf)} for sensor in OWN_N}
    assert error_of(target, there, model, RATE) < TOLERANCE
    if target in UNREADABLE:
        done = run("export", "there.yaml", "--from", target, "--to", "kalibr")
        assert (done.exit_code, "can not be conv" in done.stderr) == (1, True)
        return
    back = converted(tmp_path, there, target, "kalibr", "--rate", RATE)
    for sensor, name in (("gyro", "gyroscope"), ("accel", "accelerometer")):
        # Six digits are written, and their square has half of the error.
        assert number(back, f"{name}_noise_density") == pytest.approx(OWN_N[sensor], rel=1e-5)
        walk = None if target in WITHOUT_WALK else pytest.approx(OWN_K[sensor], rel=1e-5)
        assert number(back, f"{name}_random_walk") == walk


def test_a_file_of_vins_with_what_else_is_in_it_and_a_rate_that_is_asked_for(tmp_path):
    """By hand: N = n/√(2r), K = w/√r."""
    got = converted(tmp_path, VINS, "VINS-Mono", "kalibr", "--rate", RATE)
    for name, n, w in (("accelerometer", 0.08, 4e-5), ("gyroscope", 0.004, 2e-6)):
        assert number(got, f"{name}_noise_density") == pytest.approx(n / math.sqrt(400.0), rel=1e-5)
        assert number(got, f"{name}_random_walk") == pytest.approx(w / math.sqrt(200.0), rel=1e-5)
    assert number(got, "update_rate") == 200.0
    converted(tmp_path, converted(tmp_path, KALIBR, "kalibr", "okvis2"), "okvis2", "lio-sam")
    asked = run("export", "there.yaml", "--from", "okvis2", "--to", "vins-mono")
    assert (asked.exit_code, "--rate" in asked.stderr) == (1, True)


def test_a_markov_process_goes_between_targets_that_have_one(tmp_path):
    """From KF-GINS' own file: std σ and T in q = σ√(2/T), by hand."""
    made = converted(tmp_path, GINS, "kf-gins", "gz-sim", "--rate", RATE)
    deg, T = math.pi / 180.0, 4.0 * 3600.0
    gyros = [(0.003 * deg / 60.0, 0.027 * deg / 3600.0), (0.003 * deg / 60.0, 0.05 * deg / 3600.0)]
    for axis, (n, std) in {"gyro x": gyros[0], "gyro z": gyros[1], "accel x": (0.03 / 60.0, 15e-5)}.items():
        sensor, name = axis.split()
        model = {sensor: {name: (n, std * math.sqrt(2.0 / T), T)}}
        assert error_of("gz-sim", made, model, RATE) < TOLERANCE


def test_of_imu_utils_the_user_says_which_fork(tmp_path):
    """By hand: in the original n is N times the root of the rate, 400 Hz; in mintar's it is N."""
    text = "%YAML:1.0\nGyr:\n   avg-axis:\n      gyr_n: 2.0e-03\n      gyr_w: 3.0e-05\n"
    (tmp_path / "there.yaml").write_text(text, encoding="utf-8")
    asked = run("export", "there.yaml", "--from", "imu_utils", "--to", "kalibr")
    assert asked.exit_code == 1
    for name, n, w in (("imu_utils-original", 1e-4, None), ("imu_utils-mintar", 2e-3, 3e-5)):
        assert f"--from {name}" in asked.stderr
        got = converted(tmp_path, text, name, "kalibr", "--rate", 400)
        assert number(got, "gyroscope_noise_density") == pytest.approx(n, rel=1e-5)
        assert number(got, "gyroscope_random_walk") == w


@pytest.mark.parametrize(
    ("text", "source", "target", "word"),
    [
        (VINS, "vins-mono", "kalibr", "--rate"),
        (VINS, "kalibr", "vins-mono", "gyroscope_noise_density"),
        (KALIBR + "gyroscope_noise_density: 1.0e-3\n", "kalibr", "gtsam", "2 times"),
        (KALIBR.replace("1.900000e-05", "0"), "kalibr", "gtsam", "gyroscope_random_walk"),
        ("<imu>", "gz-sim", "kalibr", "gz-sim"),
        ('{"value0": {"gyro_noise_std": [1, 2]}}', "basalt", "kalibr", "gyro_noise_std"),
        ("imunoise:\n  gbstd: [1, 1, 1]\n", "kf-gins", "gz-sim", "correlation time"),
        (b"\xff\xfe\x00", "kalibr", "vins-mono", "not a text"),
        (None, "kalibr", "vins-mono", "No such file"),
    ],
)
def test_what_cannot_be_converted_is_refused(tmp_path, text, source, target, word):
    if text is not None:
        (tmp_path / "there.yaml").write_bytes(text if isinstance(text, bytes) else text.encode())
    done = run("export", "there.yaml", "--from", source, "--to", target)
    assert (done.exit_code, word in done.stderr) == (1, True)
    assert done.stderr.startswith("error: there.yaml: ")
