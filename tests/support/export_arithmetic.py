"""What programs do with the noise parameters in their files, in a few lines of NumPy each.

Each target's function reads its file and gives, for a sensor and an axis, what is added to the variances of
the angle (or the velocity) and of the bias in one step of dt, and by which factor the bias decays; written
from the target's documentation and code, not from the formulas of the export.
"""

import json
import math
import re
import sys
import xml.etree.ElementTree as ET
from functools import partial
from typing import NamedTuple
from unittest.mock import MagicMock, patch

import numpy as np
import scipy.linalg
from ruamel.yaml import YAML

DEG = math.pi / 180.0
G = 9.80665


class Step(NamedTuple):
    """A step of dt: variances added to the angle and to the bias (None: it has none), decay of the bias."""

    dt: float
    angle: float
    bias: float | None
    decay: float = 1.0


def covariance(step: Step, time: float = 1.0) -> np.ndarray:
    """Covariance of angle and bias after as many steps as fit into a time [s], both known at first."""
    F = np.array([[1.0, step.dt], [0.0, step.decay]])
    P = np.zeros((2, 2))
    for _ in range(round(time / step.dt)):
        P = F @ P @ F.T + np.diag([step.angle, step.bias or 0.0])
    return P


def predicted(N: float, q: float, T: float = math.inf, time: float = 1.0) -> np.ndarray:
    """The same of the continuous model: white noise N, and a bias driven with q that decays with T."""
    # By Van Loan's matrix exponential (IEEE Trans. Autom. Control 23, 1978).
    A = np.array([[0.0, 1.0], [0.0, -1.0 / T]])
    big = np.zeros((4, 4))
    big[:2, :2], big[:2, 2:], big[2:, 2:] = -A, np.diag([N**2, q**2]), A.T
    exponential = scipy.linalg.expm(big * time)
    return exponential[2:, 2:].T @ exponential[:2, 2:]


def relative_error(step: Step, N: float, q: float, T: float = math.inf) -> float:
    """Largest relative error of what steps give; of a target without a bias that of the angle's variance."""
    time = round(1.0 / step.dt) * step.dt
    use = (0, 0) if step.bias is None else (slice(None), slice(None))
    want = predicted(N, 0.0 if step.bias is None else q, T, time)
    return float(np.max(np.abs(covariance(step, time)[use] / want[use] - 1.0)))


def read_yaml(text):
    """By a library that knows nothing of ours; JSON is YAML, too."""
    return YAML(typ="safe", pure=True).load(text)


def read_python(text, **modules):
    """Names that a snippet of Python leaves, with modules that stand for those which are not installed."""
    names = {}
    with patch.dict(sys.modules, modules):
        exec(compile(text, "snippet", "exec"), names)
    return names


def _tree(element):
    return {child.tag: _tree(child) for child in element} or float(element.text)


# Lines that assign a number, or a list, to a name.
LINES = {"hybvio": r"-(\w+)=(\S+)", "px4": r"param set (\w+) (\S+)", "ardupilot": r"(\w+),(\S+)"}
LINES["matlab"] = r"(\w+\.\w+) = (\[.*\]);"


def read(target, text):
    """Values by names, with those of the levels above them."""
    if target in LINES:
        return {name: json.loads(value) for name, value in re.findall(f"^{LINES[target]}$", text, re.M)}
    if target == "gtsam":
        calls = read_python(text, gtsam=MagicMock())["params"].method_calls
        return {name: given[0] for name, given, _ in calls if given}
    if target == "isaac-lab":
        module = MagicMock(GaussianNoiseCfg=lambda mean, std: std)
        return read_python(text, **{f"isaaclab{name}": module for name in ("", ".utils", ".utils.noise")})
    if target == "pegasus":
        return _flat(read_python(text)["imu_config"])
    return _flat(_tree(ET.fromstring(text)) if text.lstrip().startswith("<") else read_yaml(text))


def _flat(v, above=""):
    if not isinstance(v, dict):
        return {above.removesuffix("."): v}
    return {name: x for key, part in v.items() for name, x in _flat(part, f"{above}{key}.").items()}


# Laws: what a step of dt adds, by what the file has for the sensor and the axis, in SI.


def walk(dt, n, w=None):
    """White noise n and a walk w of continuous time: noise n/√dt for dt, and a walk by w·√dt."""
    return Step(dt, (n / math.sqrt(dt) * dt) ** 2, None if w is None else (w * math.sqrt(dt)) ** 2)


def vins(dt, n, w):
    # Midpoint: noise of both samples of a step, each with dt/2; V*diag(n^2)*V^T.
    V = np.array([[dt / 2.0, dt / 2.0, 0.0], [0.0, 0.0, dt]])
    return Step(dt, *np.diag(V @ np.diag([n**2, n**2, w**2]) @ V.T))


def gins(dt, n, std, T):
    return Step(dt, n**2 * dt, 2.0 * std**2 / T * dt, math.exp(-dt / T))


def hybvio(dt, n, w, theta):
    drive = w**2 * -math.expm1(-2.0 * dt * theta) / (2.0 * theta)
    return Step(dt, (dt * n) ** 2, drive, math.exp(-dt * theta))


def sdf(dt, stddev, sigma=None, tau=1.0):
    drive = None if sigma is None else sigma**2 * tau / 2.0 * -math.expm1(-2.0 * dt / tau)
    return Step(dt, (stddev * dt) ** 2, drive, math.exp(-dt / tau))


def rotors(dt, density, walk, tau):
    sigma_b_d = math.sqrt(-(walk**2) * tau / 2.0 * math.expm1(-2.0 * dt / tau))
    return Step(dt, (density / math.sqrt(dt) * dt) ** 2, sigma_b_d**2, math.exp(-dt / tau))


def ekf2(_, white, walk, dt=0.010):
    return Step(dt, (dt * white) ** 2, (dt * walk) ** 2)


def ekf3(_, white, walk, dt=0.012):
    # The state is a delta angle's bias, bias*dt.
    return Step(dt, (dt * white) ** 2, (dt**2 * walk) ** 2 / dt**2)


# Words for a sensor in the names of values.
WORDS = {"as": "long Long stem Stem STEM short Short SHORT g G of Of bias rw rate topic"}
WORDS["gyro"] = "gyroscope Gyroscope gyr Gyr GYR gyro Gyro GYRO g G gyro Gyro Omega arw Angular"
WORDS["gyro"] += " angular_velocity"
WORDS["accel"] = "accelerometer Accelerometer acc Acc ACC acc Acc ACC a A accel Accel Acc vrw Velocity"
WORDS["accel"] += " linear_acceleration"
NOISE = "{topic}.{axis}.noise."
SDF = f"{NOISE}stddev {NOISE}dynamic_bias_stddev {NOISE}dynamic_bias_correlation_time"
AIRSIM = "Sensors.Imu.{rate}RandomWalk Sensors.Imu.{Of}BiasStability Sensors.Imu.{Of}BiasStabilityTau"
# Names of values, and the law, in the order of the command's list.
TARGETS = {
    "kalibr": ("{long}_noise_density {long}_random_walk", walk),
    "allan_variance_ros": ("{long}_noise_density {long}_random_walk", walk),
    "imu_utils": ("{Stem}.{axis}-axis.{stem}_n {Stem}.{axis}-axis.{stem}_w", walk),
    "imu_utils-mintar": ("{Stem}.{axis}-axis.{stem}_n {Stem}.{axis}-axis.{stem}_w", walk),
    "imu_utils-original": ("{Stem}.{axis}-axis.{stem}_n", lambda dt, n: Step(dt, (n * dt) ** 2, None)),
    "vins-mono": ("{stem}_n {stem}_w", vins),
    "vins-fusion": ("{stem}_n {stem}_w", vins),
    "orb_slam3": ("IMU.Noise{Short} IMU.{Short}Walk", walk),
    "openvins": ("imu0.{long}_noise_density imu0.{long}_random_walk", walk),
    "basalt": ("value0.{of}_noise_std value0.{of}_bias_std", walk),
    "okvis": ("imu_params.sigma_{g}_c imu_params.sigma_{g}w_c", walk),
    "okvis2": ("imu_parameters.sigma_{g}_c imu_parameters.sigma_{g}w_c", walk),
    "gtsam": ("set{Long}Covariance setBias{bias}Covariance", lambda t, c, b: Step(t, t**2 * c / t, t * b)),
    "lio-sam": ("lio_sam.imu{Stem}Noise lio_sam.imu{Stem}BiasN", walk),
    "lvi-sam": ("lvi_sam.imu{Stem}Noise lvi_sam.imu{Stem}BiasN", walk),
    "fast-lio2": ("mapping.{stem}_cov mapping.b_{stem}_cov", lambda t, c, b: Step(t, t * c * t, t * b * t)),
    "fast-livo2": ("imu.{stem}_cov imu.b_{stem}_cov", lambda t, c, b: Step(t, t * c * t, t * b * t)),
    "glim": ("sensors.imu_{short}_noise", walk),
    "hybvio": ("noiseProcess{Short} noiseProcessB{G}A noiseProcessB{G}ARev", hybvio),
    "kf-gins": ("imunoise.{rw} imunoise.{g}bstd imunoise.corrtime", gins),
    "ob-gins": ("imumodel.{rw} imumodel.{g}bstd imumodel.corrtime", gins),
    "robot_localization": ("{topic}_covariance", lambda dt, variance: Step(dt, variance * dt**2, None)),
    "gz-sim": (SDF, sdf),
    "gazebo-classic": (f"{NOISE}stddev", sdf),
    "rotors": ("{long}NoiseDensity {long}RandomWalk {long}BiasCorrelationTime", rotors),
    "airsim": (AIRSIM, lambda dt, white, bias, tau: walk(dt, white, bias / math.sqrt(tau))),
    "isaac-lab": ("{of}_noise", sdf),
    "pegasus": ("{long}.noise_density {long}.random_walk {long}.bias_correlation_time", rotors),
    "matlab": ("{of}.NoiseDensity {of}.RandomWalk", walk),
    "px4": ("EKF2_{STEM}_NOISE EKF2_{STEM}_B_NOISE", ekf2),
    "ardupilot": ("EK3_{SHORT}_P_NSE EK3_{G}BIAS_P_NSE", ekf3),
}
# Units of what is not in SI.
UNITS = {("airsim", "gyro"): (DEG / 60.0, DEG / 3600.0, 1.0)}
UNITS["airsim", "accel"] = (G / 1000.0, 1e-6 * G, 1.0)
UNITS |= {(name, "gyro"): (DEG / 60.0, DEG / 3600.0, 3600.0) for name in ("kf-gins", "ob-gins")}
UNITS |= {(name, "accel"): (1.0 / 60.0, 1e-5, 3600.0) for name in ("kf-gins", "ob-gins")}


def step(target: str, text: str, sensor: str, axis: str, rate: float) -> Step:
    """A step of a target with this file, by the rate that the file has, if it has one."""
    v, k, found = read(target, text), "xyz".index(axis), []
    words = dict(zip(WORDS["as"].split(), WORDS[sensor].split(), strict=True))
    for name in TARGETS[target][0].format(axis=axis, **words).split():
        x = np.ravel(v[name])
        if len(x) == 9:
            assert np.count_nonzero(x) == 3
            x = x[::4]
        found.append(float(x[k % len(x)]))
    rates = [x for name, x in v.items() if name.endswith(("update_rate", "IMU.Frequency"))]
    found = np.array(found) * UNITS.get((target, sensor), 3 * [1.0])[: len(found)]
    return TARGETS[target][1](1.0 / (rates or [rate])[0], *found)


STEPS = {target: partial(step, target) for target in TARGETS}
#: Targets that hold a value for each axis; those with one correlation time for all, and with any.
EACH = ("imu_utils", "imu_utils-mintar", "imu_utils-original", "basalt", "gtsam", "kf-gins")
EACH += ("robot_localization", "gz-sim", "gazebo-classic", "matlab")
ONE_TIME = ("kf-gins", "ob-gins")
WITH_TIME = ("kf-gins", "ob-gins", "gz-sim", "rotors", "pegasus")


def error_of(target: str, text: str, values: dict, rate: float) -> float:
    """Largest error of a target's covariance over 1 s; `values` are (N, q, T) by sensor and axis."""
    largest = 0.0
    for sensor, of in values.items():
        worst = max(N for N, _, _ in of.values()), *max((q, T) for _, q, T in of.values())
        for axis, own in of.items():
            step = STEPS[target](text, sensor, axis, rate)
            largest = max(largest, relative_error(step, *(own if target in EACH else worst)))
    return largest
