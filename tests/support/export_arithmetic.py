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
    """The same of the continuous model: white noise N, and a bias driven with q that decays with T.

    By Van Loan's matrix exponential (IEEE Trans. Autom. Control 23, 1978).
    """
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


def read_yaml(text, root=None):
    """By a library that knows nothing of ours; JSON is YAML, too."""
    v = YAML(typ="safe", pure=True).load(text)
    return v[root] if root else v


def read_assignments(text, pattern):
    """Numbers, or lists of them, that lines assign to names."""
    lines = (re.fullmatch(pattern, line) for line in text.splitlines())
    return {match["name"]: json.loads(match["value"]) for match in lines if match}


def read_python(text, **modules):
    """Names that a snippet of Python leaves, with modules that stand for those which are not installed."""
    names = {}
    with patch.dict(sys.modules, modules):
        exec(compile(text, "snippet", "exec"), names)
    return names


AT = {"x": 0, "y": 1, "z": 2}
LONG = {"gyro": "gyroscope", "accel": "accelerometer"}
STEM = {"gyro": "gyr", "accel": "acc"}
TOPIC = {"gyro": "angular_velocity", "accel": "linear_acceleration"}


def densities(rate, n, w=None):
    """A step of white noise n and a walk w of continuous time: noise n/√dt for dt, and a walk by w·√dt."""
    dt = 1.0 / rate
    return Step(dt, (n / math.sqrt(dt) * dt) ** 2, None if w is None else (w * math.sqrt(dt)) ** 2)


def named(text, sensor, axis, rate, root=None, gyro="", accel=""):
    """Densities by names: white noise, and the walk if there is one; for all axes, or a list of three."""
    v = read_yaml(text, root)
    rate = next((v[name] for name in ("update_rate", "IMU.Frequency", "imu_update_rate") if name in v), rate)
    found = [v[name] for name in {"gyro": gyro, "accel": accel}[sensor].split()]
    return densities(rate, *(x[AT[axis]] if isinstance(x, list) else x for x in found))


def imu_utils(text, sensor, axis, rate):
    v = read_yaml(text)[STEM[sensor].title()][f"{axis}-axis"]
    return densities(rate, v[f"{STEM[sensor]}_n"], v[f"{STEM[sensor]}_w"])


def vins(text, sensor, axis, rate):
    v, dt = read_yaml(text), 1.0 / rate
    n, w = v[f"{STEM[sensor]}_n"], v[f"{STEM[sensor]}_w"]
    # Midpoint: noise of both samples of a step, each with dt/2; V*diag(n^2)*V^T.
    V = np.array([[dt / 2.0, dt / 2.0, 0.0], [0.0, 0.0, dt]])
    Q = V @ np.diag([n**2, n**2, w**2]) @ V.T
    return Step(dt, Q[0, 0], Q[1, 1])


def gtsam(text, sensor, axis, rate):
    params, dt, k = read_python(text, gtsam=MagicMock())["params"], 1.0 / rate, AT[axis]
    white, bias = {"gyro": ("Gyroscope", "BiasOmega"), "accel": ("Accelerometer", "BiasAcc")}[sensor]
    kept = [getattr(params, f"set{name}Covariance").call_args.args[0][k, k] for name in (white, bias)]
    return Step(dt, dt**2 * kept[0] / dt, dt * kept[1])


def fast_lio(text, sensor, axis, rate, root):
    v, dt = read_yaml(text, root), 1.0 / rate
    return Step(dt, dt * v[f"{STEM[sensor]}_cov"] * dt, dt * v[f"b_{STEM[sensor]}_cov"] * dt)


def gins(text, sensor, axis, rate, root):
    v, dt = read_yaml(text, root), 1.0 / rate
    names = {"gyro": ("arw", "gbstd"), "accel": ("vrw", "abstd")}[sensor]
    units = {"gyro": (DEG / 60.0, DEG / 3600.0), "accel": (1.0 / 60.0, 1e-5)}[sensor]
    n, std = (np.broadcast_to(v[name], 3)[AT[axis]] * unit for name, unit in zip(names, units, strict=True))
    T = v["corrtime"] * 3600.0
    return Step(dt, n**2 * dt, 2.0 * std**2 / T * dt, math.exp(-dt / T))


def hybvio(text, sensor, axis, rate):
    v, dt = read_assignments(text, r"-(?P<name>\w+)=(?P<value>\S+)"), 1.0 / rate
    white, bias = {"gyro": ("Gyro", "BGA"), "accel": ("Acc", "BAA")}[sensor]
    theta = v[f"noiseProcess{bias}Rev"]
    drive = v[f"noiseProcess{bias}"] ** 2 * -math.expm1(-2.0 * dt * theta) / (2.0 * theta)
    return Step(dt, (dt * v[f"noiseProcess{white}"]) ** 2, drive, math.exp(-dt * theta))


def robot_localization(text, sensor, axis, rate):
    matrix = np.array(read_yaml(text)[f"{TOPIC[sensor]}_covariance"]).reshape(3, 3)
    assert np.count_nonzero(matrix) == 3
    return Step(1.0 / rate, matrix[AT[axis], AT[axis]] / rate**2, None)


def sdf(text, sensor, axis, rate):
    noise = ET.fromstring(text).find(f"{TOPIC[sensor]}/{axis}/noise")
    assert noise.get("type") == "gaussian"
    v, dt = {child.tag: float(child.text) for child in noise}, 1.0 / rate
    white = (v["stddev"] * dt) ** 2
    if "dynamic_bias_stddev" not in v:
        return Step(dt, white, None)
    sigma, tau = v["dynamic_bias_stddev"], v["dynamic_bias_correlation_time"]
    return Step(dt, white, sigma**2 * tau / 2.0 * -math.expm1(-2.0 * dt / tau), math.exp(-dt / tau))


def _rotors(density, walk, tau, dt):
    sigma_b_d = math.sqrt(-(walk**2) * tau / 2.0 * math.expm1(-2.0 * dt / tau))
    return Step(dt, (density / math.sqrt(dt) * dt) ** 2, sigma_b_d**2, math.exp(-dt / tau))


def rotors(text, sensor, axis, rate):
    ends = ("NoiseDensity", "RandomWalk", "BiasCorrelationTime")
    return _rotors(*(float(ET.fromstring(text).find(LONG[sensor] + end).text) for end in ends), 1.0 / rate)


def pegasus(text, sensor, axis, rate):
    v = read_python(text)["imu_config"][LONG[sensor]]
    return _rotors(v["noise_density"], v["random_walk"], v["bias_correlation_time"], 1.0 / rate)


def airsim(text, sensor, axis, rate):
    v = json.loads(text)["Sensors"]["Imu"]
    if sensor == "gyro":
        white, bias = v["AngularRandomWalk"] / math.sqrt(3600.0) * DEG, v["GyroBiasStability"] / 3600.0 * DEG
    else:
        white, bias = v["VelocityRandomWalk"] * G / 1000.0, v["AccelBiasStability"] * 1e-6 * G
    return densities(rate, white, bias / math.sqrt(v[f"{sensor.title()}BiasStabilityTau"]))


def isaac_lab(text, sensor, axis, rate):
    module = MagicMock(GaussianNoiseCfg=lambda mean, std: std)
    modules = dict.fromkeys(("isaaclab", "isaaclab.utils", "isaaclab.utils.noise"), module)
    return Step(1.0 / rate, (read_python(text, **modules)[f"{sensor}_noise"] / rate) ** 2, None)


def matlab(text, sensor, axis, rate):
    v = read_assignments(text, r"(?P<name>\w+\.\w+) = (?P<value>\[.*\]);")
    return densities(rate, v[f"{sensor}.NoiseDensity"][AT[axis]], v[f"{sensor}.RandomWalk"][AT[axis]])


def px4(text, sensor, axis, rate):
    v, dt = read_assignments(text, r"param set (?P<name>\w+) (?P<value>\S+)"), 0.010
    white, walk = (v[f"EKF2_{STEM[sensor].upper()}_{name}"] for name in ("NOISE", "B_NOISE"))
    return Step(dt, (dt * white) ** 2, (dt * walk) ** 2)


def ardupilot(text, sensor, axis, rate):
    v, dt = read_assignments(text, r"(?P<name>\w+),(?P<value>\S+)"), 0.012
    white, walk = {"gyro": ("GYRO", "GBIAS"), "accel": ("ACC", "ABIAS")}[sensor]
    # The state is a delta angle's bias, bias*dt.
    delta = (dt**2 * v[f"EK3_{walk}_P_NSE"]) ** 2
    return Step(dt, (dt * v[f"EK3_{white}_P_NSE"]) ** 2, delta / dt**2)


def _by_names(white, walk, gyro, accel):
    """A target whose names differ by that of the sensor alone."""
    names = (f"{white} {walk}".format(*2 * [sensor]) for sensor in (gyro, accel))
    return partial(named, **dict(zip(("gyro", "accel"), names, strict=True)))


kalibr = _by_names("{}_noise_density", "{}_random_walk", *LONG.values())
okvis, lio_sam = (
    _by_names("sigma_{}_c", "sigma_{}w_c", "g", "a"),
    _by_names("imu{}Noise", "imu{}BiasN", "Gyr", "Acc"),
)
basalt, glim = (
    _by_names("{}_noise_std", "{}_bias_std", "gyro", "accel"),
    _by_names("imu_{}_noise", "", "gyro", "acc"),
)
# In the order of the command's list.
STEPS = {"kalibr": kalibr, "allan_variance_ros": kalibr}
STEPS |= {"imu_utils": imu_utils, "vins-mono": vins, "vins-fusion": vins}
STEPS |= {"orb_slam3": partial(named, gyro="IMU.NoiseGyro IMU.GyroWalk", accel="IMU.NoiseAcc IMU.AccWalk")}
STEPS |= {"openvins": partial(kalibr, root="imu0"), "basalt": partial(basalt, root="value0")}
STEPS |= {"okvis": partial(okvis, root="imu_params"), "okvis2": partial(okvis, root="imu_parameters")}
STEPS |= {"gtsam": gtsam}
STEPS |= {"lio-sam": partial(lio_sam, root="lio_sam"), "lvi-sam": partial(lio_sam, root="lvi_sam")}
STEPS |= {"fast-lio2": partial(fast_lio, root="mapping"), "fast-livo2": partial(fast_lio, root="imu")}
STEPS |= {"glim": partial(glim, root="sensors"), "hybvio": hybvio}
STEPS |= {"kf-gins": partial(gins, root="imunoise"), "ob-gins": partial(gins, root="imumodel")}
STEPS |= {"robot_localization": robot_localization, "gz-sim": sdf, "gazebo-classic": sdf, "rotors": rotors}
STEPS |= {"airsim": airsim, "isaac-lab": isaac_lab, "pegasus": pegasus, "matlab": matlab}
STEPS |= {"px4": px4, "ardupilot": ardupilot}

#: Targets that hold a value for each axis; those with one correlation time for all, and with any.
EACH = ("imu_utils", "basalt", "gtsam", "kf-gins", "robot_localization", "gz-sim", "gazebo-classic", "matlab")
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
