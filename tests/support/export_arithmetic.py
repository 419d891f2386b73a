"""What programs do with the noise parameters in their files, in a few lines of NumPy each.

Each target's function reads its file and gives, for a sensor and an axis, what is added to the variances of
the angle (or the velocity) and of the bias in one step of dt, and by which factor the bias decays; written
from the target's documentation and code, not from the formulas of the export.
"""

import json
import math
import re
import sys
import types
import xml.etree.ElementTree as ET
from typing import NamedTuple

import numpy as np
import scipy.linalg

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
    got = covariance(step, time)
    want = predicted(N, q if step.bias is not None else 0.0, T, time)
    use = (slice(None), slice(None)) if step.bias is not None else (0, 0)
    return float(np.max(np.abs(got[use] / want[use] - 1.0)))


# Readers of the files, each by a library that knows nothing of ours.


def read_yaml(text):
    from ruamel.yaml import YAML

    return YAML(typ="safe", pure=True).load(text)


def read_assignments(text, pattern):
    """Numbers, or lists of them, that lines assign to names."""
    found = {}
    for line in text.splitlines():
        if match := re.fullmatch(pattern, line):
            found[match["name"]] = json.loads(match["value"])
    return found


def read_python(text, **modules):
    """Names that a snippet of Python leaves, with modules that stand for those which are not installed."""
    kept = {name: sys.modules.get(name) for name in modules}
    sys.modules.update(modules)
    try:
        names = {}
        exec(compile(text, "snippet", "exec"), names)
        return names
    finally:
        for name, module in kept.items():
            if module is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module


class _Params:
    """What stands for GTSAM's parameters: it keeps what is set."""

    @classmethod
    def MakeSharedU(cls, gravity):  # noqa: N802
        return cls()

    def __getattr__(self, name):
        return lambda value: self.__dict__.__setitem__(name, value)


def _gtsam():
    module = types.ModuleType("gtsam")
    module.PreintegrationCombinedParams = _Params
    return module


# The targets.

AT = {"x": 0, "y": 1, "z": 2}
LONG = {"gyro": "gyroscope", "accel": "accelerometer"}


def kalibr(text, sensor, axis, rate):
    v = read_yaml(text)
    dt = 1.0 / v["update_rate"]
    discrete = v[f"{LONG[sensor]}_noise_density"] / math.sqrt(dt)
    walk = v[f"{LONG[sensor]}_random_walk"] * math.sqrt(dt)
    return Step(dt, (dt * discrete) ** 2, walk**2)


def openvins(text, sensor, axis, rate):
    v = read_yaml(text)["imu0"]
    dt = 1.0 / v["update_rate"]
    # Continuous densities: the discrete covariance is sigma^2/dt, that of the bias sigma^2*dt.
    white, walk = v[f"{LONG[sensor]}_noise_density"], v[f"{LONG[sensor]}_random_walk"]
    return Step(dt, dt**2 * white**2 / dt, walk**2 * dt)


def imu_utils(text, sensor, axis, rate):
    v = read_yaml(text)[{"gyro": "Gyr", "accel": "Acc"}[sensor]][f"{axis}-axis"]
    stem, dt = {"gyro": "gyr", "accel": "acc"}[sensor], 1.0 / rate
    return Step(dt, v[f"{stem}_n"] ** 2 * dt, v[f"{stem}_w"] ** 2 * dt)


def vins(text, sensor, axis, rate):
    v, dt = read_yaml(text), 1.0 / rate
    n, w = (v[{"gyro": "gyr", "accel": "acc"}[sensor] + end] for end in ("_n", "_w"))
    # Midpoint: noise of both samples of a step, each with dt/2; V*diag(n^2)*V^T.
    V = np.array([[dt / 2.0, dt / 2.0, 0.0], [0.0, 0.0, dt]])
    Q = V @ np.diag([n**2, n**2, w**2]) @ V.T
    return Step(dt, Q[0, 0], Q[1, 1])


def orb_slam3(text, sensor, axis, rate):
    v = read_yaml(text)
    f = v["IMU.Frequency"]
    noise, walk = {"gyro": ("NoiseGyro", "GyroWalk"), "accel": ("NoiseAcc", "AccWalk")}[sensor]
    sf = math.sqrt(f)
    ng, ngw = v[f"IMU.{noise}"] * sf, v[f"IMU.{walk}"] / sf
    return Step(1.0 / f, ng**2 / f**2, ngw**2)


def basalt(text, sensor, axis, rate):
    v = json.loads(text)["value0"]
    r = v["imu_update_rate"]
    white = v[f"{sensor}_noise_std"][AT[axis]] * math.sqrt(r)
    return Step(1.0 / r, (white / r) ** 2, (v[f"{sensor}_bias_std"][AT[axis]] / math.sqrt(r)) ** 2)


def okvis(root):
    def read(text, sensor, axis, rate):
        v, letter, dt = read_yaml(text)[root], {"gyro": "g", "accel": "a"}[sensor], 1.0 / rate
        return Step(dt, v[f"sigma_{letter}_c"] ** 2 * dt, v[f"sigma_{letter}w_c"] ** 2 * dt)

    return read


def gtsam(text, sensor, axis, rate):
    kept = vars(read_python(text, gtsam=_gtsam())["params"])
    white, walk = {
        "gyro": ("setGyroscopeCovariance", "setBiasOmegaCovariance"),
        "accel": ("setAccelerometerCovariance", "setBiasAccCovariance"),
    }[sensor]
    dt, k = 1.0 / rate, AT[axis]
    return Step(dt, dt**2 * kept[white][k, k] / dt, dt * kept[walk][k, k])


def lio_sam(root):
    def read(text, sensor, axis, rate):
        v, stem, dt = read_yaml(text)[root], {"gyro": "Gyr", "accel": "Acc"}[sensor], 1.0 / rate
        white, between = v[f"imu{stem}Noise"] ** 2, math.sqrt(dt) * v[f"imu{stem}BiasN"]
        return Step(dt, dt**2 * white / dt, between**2)

    return read


def fast_lio(root):
    def read(text, sensor, axis, rate):
        v, stem, dt = read_yaml(text)[root], {"gyro": "gyr", "accel": "acc"}[sensor], 1.0 / rate
        return Step(dt, dt * v[f"{stem}_cov"] * dt, dt * v[f"b_{stem}_cov"] * dt)

    return read


def glim(text, sensor, axis, rate):
    v, dt = json.loads(text)["sensors"], 1.0 / rate
    return Step(dt, v[{"gyro": "imu_gyro_noise", "accel": "imu_acc_noise"}[sensor]] ** 2 / dt * dt**2, None)


def gins(root):
    def read(text, sensor, axis, rate):
        v, dt = read_yaml(text)[root], 1.0 / rate
        white, bias = {"gyro": ("arw", "gbstd"), "accel": ("vrw", "abstd")}[sensor]
        pick = lambda x: x[AT[axis]] if isinstance(x, list) else x  # noqa: E731
        n = pick(v[white]) * (DEG if sensor == "gyro" else 1.0) / 60.0
        std = pick(v[bias]) * (DEG / 3600.0 if sensor == "gyro" else 1e-5)
        T = v["corrtime"] * 3600.0
        return Step(dt, n**2 * dt, 2.0 * std**2 / T * dt, math.exp(-dt / T))

    return read


def hybvio(text, sensor, axis, rate):
    v, dt = read_assignments(text, r"-(?P<name>\w+)=(?P<value>\S+)"), 1.0 / rate
    white, bias = {"gyro": ("Gyro", "BGA"), "accel": ("Acc", "BAA")}[sensor]
    theta = v[f"noiseProcess{bias}Rev"]
    drive = v[f"noiseProcess{bias}"] ** 2 * -math.expm1(-2.0 * dt * theta) / (2.0 * theta)
    return Step(dt, (dt * v[f"noiseProcess{white}"]) ** 2, drive, math.exp(-dt * theta))


def robot_localization(text, sensor, axis, rate):
    name = {"gyro": "angular_velocity", "accel": "linear_acceleration"}[sensor]
    matrix = np.array(read_yaml(text)[f"{name}_covariance"]).reshape(3, 3)
    assert np.count_nonzero(matrix) == 3
    return Step(1.0 / rate, matrix[AT[axis], AT[axis]] / rate**2, None)


def sdf(text, sensor, axis, rate):
    name = {"gyro": "angular_velocity", "accel": "linear_acceleration"}[sensor]
    noise = ET.fromstring(text).find(f"{name}/{axis}/noise")
    assert noise.get("type") == "gaussian"
    v, dt = {child.tag: float(child.text) for child in noise}, 1.0 / rate
    white = (v["stddev"] * dt) ** 2
    if "dynamic_bias_stddev" not in v:
        return Step(dt, white, None)
    sigma, tau = v["dynamic_bias_stddev"], v["dynamic_bias_correlation_time"]
    return Step(dt, white, sigma**2 * tau / 2.0 * -math.expm1(-2.0 * dt / tau), math.exp(-dt / tau))


def _rotors(density, walk, tau, dt):
    sigma_d = density / math.sqrt(dt)
    sigma_b_d = math.sqrt(-(walk**2) * tau / 2.0 * math.expm1(-2.0 * dt / tau))
    return Step(dt, (sigma_d * dt) ** 2, sigma_b_d**2, math.exp(-dt / tau))


def rotors(text, sensor, axis, rate):
    find = lambda end: float(ET.fromstring(text).find(LONG[sensor] + end).text)  # noqa: E731
    return _rotors(find("NoiseDensity"), find("RandomWalk"), find("BiasCorrelationTime"), 1.0 / rate)


def pegasus(text, sensor, axis, rate):
    v = read_python(text)["imu_config"][LONG[sensor]]
    return _rotors(v["noise_density"], v["random_walk"], v["bias_correlation_time"], 1.0 / rate)


def airsim(text, sensor, axis, rate):
    v, dt = json.loads(text)["Sensors"]["Imu"], 1.0 / rate
    if sensor == "gyro":
        white = v["AngularRandomWalk"] / math.sqrt(3600.0) * DEG
        stability, tau = v["GyroBiasStability"] / 3600.0 * DEG, v["GyroBiasStabilityTau"]
    else:
        white = v["VelocityRandomWalk"] * G / 1000.0
        stability, tau = v["AccelBiasStability"] * 1e-6 * G, v["AccelBiasStabilityTau"]
    return Step(dt, (white / math.sqrt(dt) * dt) ** 2, (stability / math.sqrt(tau) * math.sqrt(dt)) ** 2)


def isaac_lab(text, sensor, axis, rate):
    noise = types.ModuleType("isaaclab.utils.noise")
    noise.GaussianNoiseCfg = lambda mean, std: std
    names = read_python(
        text,
        **{"isaaclab": types.ModuleType("isaaclab"), "isaaclab.utils": types.ModuleType("isaaclab.utils")},
        **{"isaaclab.utils.noise": noise},
    )
    return Step(1.0 / rate, (names[f"{sensor}_noise"] / rate) ** 2, None)


def matlab(text, sensor, axis, rate):
    v = read_assignments(text, r"(?P<name>\w+\.\w+) = (?P<value>\[.*\]);")
    white = v[f"{sensor}.NoiseDensity"][AT[axis]] * math.sqrt(rate)
    walk = v[f"{sensor}.RandomWalk"][AT[axis]] / math.sqrt(rate)
    return Step(1.0 / rate, (white / rate) ** 2, walk**2)


def px4(text, sensor, axis, rate):
    v, dt = read_assignments(text, r"param set (?P<name>\w+) (?P<value>\S+)"), 0.010
    stem = {"gyro": "GYR", "accel": "ACC"}[sensor]
    return Step(dt, (dt * v[f"EKF2_{stem}_NOISE"]) ** 2, (dt * v[f"EKF2_{stem}_B_NOISE"]) ** 2)


def ardupilot(text, sensor, axis, rate):
    v, dt = read_assignments(text, r"(?P<name>\w+),(?P<value>\S+)"), 0.012
    white, walk = {"gyro": ("GYRO", "GBIAS"), "accel": ("ACC", "ABIAS")}[sensor]
    # The state is a delta angle's bias, bias*dt.
    delta = (dt**2 * v[f"EK3_{walk}_P_NSE"]) ** 2
    return Step(dt, (dt * v[f"EK3_{white}_P_NSE"]) ** 2, delta / dt**2)


STEPS = {
    "kalibr": kalibr,
    "allan_variance_ros": kalibr,
    "imu_utils": imu_utils,
    "vins-mono": vins,
    "vins-fusion": vins,
    "orb_slam3": orb_slam3,
    "openvins": openvins,
    "basalt": basalt,
    "okvis": okvis("imu_params"),
    "okvis2": okvis("imu_parameters"),
    "gtsam": gtsam,
    "lio-sam": lio_sam("lio_sam"),
    "lvi-sam": lio_sam("lvi_sam"),
    "fast-lio2": fast_lio("mapping"),
    "fast-livo2": fast_lio("imu"),
    "glim": glim,
    "hybvio": hybvio,
    "kf-gins": gins("imunoise"),
    "ob-gins": gins("imumodel"),
    "robot_localization": robot_localization,
    "gz-sim": sdf,
    "gazebo-classic": sdf,
    "rotors": rotors,
    "airsim": airsim,
    "isaac-lab": isaac_lab,
    "pegasus": pegasus,
    "matlab": matlab,
    "px4": px4,
    "ardupilot": ardupilot,
}

#: Targets that hold a value for each axis; those with one correlation time for all, and with any.
EACH = ("imu_utils", "basalt", "gtsam", "kf-gins", "robot_localization", "gz-sim", "gazebo-classic", "matlab")
ONE_TIME = ("kf-gins", "ob-gins")
WITH_TIME = ("kf-gins", "ob-gins", "gz-sim", "rotors", "pegasus")


def error_of(target: str, text: str, values: dict, rate: float) -> float:
    """Largest error of a target's covariance over 1 s against the model's.

    Args:
        target: its name.
        text: its file.
        values: (N, q, T) of the model by sensor and axis, e.g. values["gyro"]["x"].
        rate: of the IMU [Hz].
    """
    errors = []
    for sensor, of in values.items():
        largest_N = max(N for N, _, _ in of.values())
        largest_q, its_T = max((q, T) for _, q, T in of.values())
        for axis, (N, q, T) in of.items():
            step = STEPS[target](text, sensor, axis, rate)
            if target not in EACH:
                N, q, T = largest_N, largest_q, its_T
            errors.append(relative_error(step, N, q, T))
    return max(errors)
