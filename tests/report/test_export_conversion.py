"""A target's own file as that of another, by the command."""

import math
import re

import pytest
from commands import run
from export_arithmetic import STEPS, relative_error

pytestmark = pytest.mark.usefixtures("elsewhere")
UNREADABLE = ("imu_utils", "gtsam", "airsim", "isaac-lab", "pegasus", "matlab")
RATE = 200.0
N, K = {"gyro": 1.7e-4, "accel": 2.0e-3}, {"gyro": 1.9e-5, "accel": 3.0e-3}
# Whose files hold no walk of a bias: none, or a Markov process.
WITHOUT_WALK = "glim robot_localization gz-sim gazebo-classic rotors hybvio kf-gins ob-gins"
# As Kalibr's wiki has it.
KALIBR = f"""#Accelerometers
accelerometer_noise_density: {N["accel"]:.6e}   #Noise density (continuous-time)
accelerometer_random_walk:   {K["accel"]:.6e}   #Bias random walk

gyroscope_noise_density:     {N["gyro"]:.6e}
gyroscope_random_walk:       {K["gyro"]:.6e}

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
    step = STEPS[target](there, "gyro", "y", RATE)
    assert relative_error(step, N["gyro"], K["gyro"]) < 0.02
    if target in UNREADABLE:
        done = run("export", "there.yaml", "--from", target, "--to", "kalibr")
        assert (done.exit_code, "can not be conv" in done.stderr) == (1, True)
        return
    back = converted(tmp_path, there, target, "kalibr", "--rate", RATE)
    for sensor, name in (("gyro", "gyroscope"), ("accel", "accelerometer")):
        # Six digits are written, and their square has half of the error.
        assert number(back, f"{name}_noise_density") == pytest.approx(N[sensor], rel=1e-5)
        walk = None if target in WITHOUT_WALK else pytest.approx(K[sensor], rel=1e-5)
        assert number(back, f"{name}_random_walk") == walk


def test_a_file_of_vins_with_what_else_is_in_it(tmp_path):
    """By hand: N = n/√(2r), K = w/√r."""
    got = converted(tmp_path, VINS, "VINS-Mono", "kalibr", "--rate", RATE)
    for name, n, w in (("accelerometer", 0.08, 4e-5), ("gyroscope", 0.004, 2e-6)):
        assert number(got, f"{name}_noise_density") == pytest.approx(n / math.sqrt(400.0), rel=1e-5)
        assert number(got, f"{name}_random_walk") == pytest.approx(w / math.sqrt(200.0), rel=1e-5)
    assert number(got, "update_rate") == 200.0


def test_a_markov_process_goes_between_targets_that_have_one(tmp_path):
    """From KF-GINS' own file: std σ and T in q = σ√(2/T), by hand."""
    made = converted(tmp_path, GINS, "kf-gins", "gz-sim", "--rate", RATE)
    deg, T = math.pi / 180.0, 4.0 * 3600.0
    gyros = [(0.003 * deg / 60.0, 0.027 * deg / 3600.0), (0.003 * deg / 60.0, 0.05 * deg / 3600.0)]
    for axis, (n, std) in {"gyro x": gyros[0], "gyro z": gyros[1], "accel x": (0.03 / 60.0, 15e-5)}.items():
        step = STEPS["gz-sim"](made, *axis.split(), RATE)
        assert relative_error(step, n, std * math.sqrt(2.0 / T), T) < 0.02


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


def test_a_rate_that_the_other_takes_is_asked_for(tmp_path):
    converted(tmp_path, converted(tmp_path, KALIBR, "kalibr", "okvis2"), "okvis2", "lio-sam")
    asked = run("export", "there.yaml", "--from", "okvis2", "--to", "vins-mono")
    assert (asked.exit_code, "--rate" in asked.stderr) == (1, True)
