"""A target's own file as that of another."""

import math
import re

import pytest
from commands import run
from export_arithmetic import STEPS, relative_error

from allanjax.base.errors import AllanjaxError
from allanjax.report.export.converting import converted
from allanjax.report.export.table import TARGETS

READABLE = [name for name, target in TARGETS.items() if not target.unreadable]
RATE = 200.0
N, K = {"gyro": 1.7e-4, "accel": 2.0e-3}, {"gyro": 1.9e-5, "accel": 3.0e-3}

# As Kalibr's wiki has it.
KALIBR = f"""#Accelerometers
accelerometer_noise_density: {N["accel"]:.6e}   #Noise density (continuous-time)
accelerometer_random_walk:   {K["accel"]:.6e}   #Bias random walk

#Gyroscopes
gyroscope_noise_density:     {N["gyro"]:.6e}
gyroscope_random_walk:       {K["gyro"]:.6e}

rostopic:                    /imu0      #the IMU ROS topic
update_rate:                 {RATE}      #Hz (for discretization of the values above)
"""

# A part of euroc_config.yaml of VINS, with what stands around the four.
VINS = """%YAML:1.0

#common parameters
imu_topic: "/imu0"
extrinsicRotation: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [0.0148655429818, -0.999880929698, 0.00414029679422,
           0.999557249008, 0.0149672133247, 0.025715529948]

#imu parameters       The more accurate parameters you provide, the better performance
acc_n: 0.08          # accelerometer measurement noise standard deviation. #0.2   0.04
gyr_n: 0.004         # gyroscope measurement noise standard deviation.     #0.05  0.004
acc_w: 0.00004         # accelerometer bias random work noise standard deviation.  #0.02
gyr_w: 2.0e-6       # gyroscope bias random work noise standard deviation.     #4.0e-5
g_norm: 9.81007     # gravity magnitude
"""


@pytest.mark.parametrize("target", TARGETS)
def test_what_kalibr_has_reaches_every_target(target):
    """The target's own arithmetic gives the covariances of Kalibr's densities."""
    text = converted(KALIBR, "kalibr", target).text
    for sensor in ("gyro", "accel"):
        for axis in "xyz":
            step = STEPS[target](text, sensor, axis, RATE)
            assert relative_error(step, N[sensor], K[sensor]) < 0.02


@pytest.mark.parametrize("target", READABLE)
def test_there_and_back(target):
    """Kalibr's file as that of each, and that as Kalibr's again, as far as the other holds it."""
    there = converted(KALIBR, "kalibr", target).text
    back = converted(there, target, "kalibr", rate=RATE).text
    for sensor, name in (("gyro", "gyroscope"), ("accel", "accelerometer")):
        got = re.search(rf"^{name}_noise_density: (\S+)", back, re.M)
        # Six digits are written, and their square has half of the error.
        assert float(got[1]) == pytest.approx(N[sensor], rel=1e-5)
        walk = re.search(rf"^{name}_random_walk: (\S+)", back, re.M)
        symbols = {s for key in TARGETS[target].noise_keys for s in key.symbols}
        assert bool(walk) == ("K" in symbols)
        if walk:
            assert float(walk[1]) == pytest.approx(K[sensor], rel=1e-5)
        elif "q" in symbols:
            assert "is a Markov process, which is no walk" in " ".join(back.replace("#", "").split())


def test_a_file_of_vins_with_what_else_is_in_it():
    """By hand: N = n/√(2r), K = w/√r."""
    got = converted(VINS, "VINS-Mono", "kalibr", rate=RATE).text
    want = {
        "accelerometer_noise_density": 0.08 / math.sqrt(400.0),
        "gyroscope_noise_density": 0.004 / math.sqrt(400.0),
        "accelerometer_random_walk": 4e-5 / math.sqrt(200.0),
        "gyroscope_random_walk": 2e-6 / math.sqrt(200.0),
        "update_rate": 200.0,
    }
    for name, value in want.items():
        found = re.search(rf"^{name}: (\S+)$", got, re.M)
        assert float(found[1]) == pytest.approx(value, rel=1e-5)
    assert "not from a recording" in got


def test_a_markov_process_goes_between_targets_that_have_one():
    """From KF-GINS' own file: std σ and T in q = σ√(2/T), by hand."""
    text = """imudatarate: 200
imunoise:
  arw: [0.003, 0.004, 0.003]          # [deg/sqrt(hr)]
  vrw: [0.03, 0.03, 0.03]          # [m/s/sqrt(hr)]
  gbstd: [0.027, 0.027, 0.05]        # [deg/hr]
  abstd: [15.0, 15.0, 15.0]     # [mGal]
  corrtime: 4.0                    # [hr]
antlever:  [ 0.136, -0.301, -0.184 ]
"""
    made = converted(text, "kf-gins", "gz-sim", rate=RATE).text
    deg = math.pi / 180.0
    for sensor, axis, n, std in (
        ("gyro", "x", 0.003 * deg / 60.0, 0.027 * deg / 3600.0),
        ("gyro", "y", 0.004 * deg / 60.0, 0.027 * deg / 3600.0),
        ("gyro", "z", 0.003 * deg / 60.0, 0.05 * deg / 3600.0),
        ("accel", "x", 0.03 / 60.0, 15e-5),
    ):
        step = STEPS["gz-sim"](made, sensor, axis, RATE)
        T = 4.0 * 3600.0
        assert relative_error(step, n, std * math.sqrt(2.0 / T), T) < 0.02


@pytest.mark.parametrize("name", ["imu_utils", "gtsam", "airsim", "isaac-lab", "pegasus", "matlab"])
def test_ambiguous_files_are_refused_by_name(name):
    with pytest.raises(AllanjaxError, match=f"a file of {re.escape(TARGETS[name].title)} can not be conv"):
        converted(KALIBR, name, "kalibr")


@pytest.mark.parametrize(
    ("text", "source", "target", "message"),
    [
        (VINS, "vins-mono", "kalibr", "values of VINS-Mono are per step.*give --rate"),
        (VINS, "kalibr", "vins-mono", "not a file of Kalibr: none of gyroscope_noise_density"),
        (KALIBR + "gyroscope_noise_density: 1.0e-3\n", "kalibr", "gtsam", "stands in it 2 times"),
        (KALIBR.replace("1.900000e-05", "0"), "kalibr", "gtsam", "gyroscope_random_walk is 0, which no"),
        ("{", "basalt", "kalibr", "not a file of Basalt, or damaged"),
        ("<imu>", "gz-sim", "kalibr", "not a file of gz-sim SDF, or damaged"),
        ('{"value0": {"gyro_noise_std": [1, 2]}}', "basalt", "kalibr", "gyro_noise_std has 2 numbers"),
        ("imunoise:\n  gbstd: [1, 1, 1]\n", "kf-gins", "gz-sim", "gbstd needs the correlation time"),
    ],
)
def test_what_cannot_be_converted_is_refused(text, source, target, message):
    with pytest.raises(AllanjaxError, match=f"^there.yaml: .*{message}"):
        converted(text, source, target, name="there.yaml")


def test_a_rate_that_the_other_takes_is_asked_for():
    okvis = converted(KALIBR, "kalibr", "okvis2").text
    with pytest.raises(AllanjaxError, match=r"VINS-Mono takes the rate of the IMU.*give --rate"):
        converted(okvis, "okvis2", "vins-mono")
    assert converted(okvis, "okvis2", "lio-sam").text


def test_the_command_converts(tmp_path, elsewhere):
    (tmp_path / "imu.yaml").write_text(KALIBR, encoding="utf-8")
    done = run("export", "imu.yaml", "--from", "kalibr", "--to", "vins-mono")
    assert done.exit_code == 0
    assert done.stdout == converted(KALIBR, "kalibr", "vins-mono", name="imu.yaml").text
    (tmp_path / "odd.yaml").write_bytes(b"\xff\xfe\x00")
    assert run("export", "odd.yaml", "--from", "kalibr", "--to", "vins-mono").exit_code == 1
    missing = run("export", "none.yaml", "--from", "kalibr", "--to", "vins-mono")
    assert (missing.exit_code, missing.stderr) == (1, "error: none.yaml: No such file or directory\n")
