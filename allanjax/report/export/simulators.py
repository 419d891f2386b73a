"""The table's simulators and autopilots; formulas as in `estimators`."""

from __future__ import annotations

from allanjax.record.units import SENSORS
from allanjax.report.export.targets import (
    DENSITY,
    SAMPLE,
    WALK,
    Key,
    Of,
    Target,
    Text,
    both,
)

_LONG = ("gyroscope", "accelerometer")
_TURN_ON = "the turn-on bias is left out, one recording does not tell it"
_FLOOR = (
    "a FLOOR, not a recommendation to fly: it is what the sensor has at rest; vibration, aliasing, scale "
    "factor and timing come on top; the autopilot's defaults are 20 to 50 times a MEMS sensor's for that"
)


def _sdf(walk: bool) -> tuple[Key | Text, ...]:
    axes: tuple[Of, ...] = ("x", "y", "z")
    rows: list[Key | Text] = []
    for at, sensor in enumerate(SENSORS):
        block = ("angular_velocity", "linear_acceleration")[at]
        for of in axes:
            path = f"imu/{block}/{of}/noise type='gaussian'"
            rows.append(Text(f"{path}/mean", 0.0, sensor=sensor))
            rows.append(Key(f"{path}/stddev", "N*sqrt(r)", SAMPLE[at], sensor, of))
            if walk:
                rows.append(Key(f"{path}/dynamic_bias_stddev", "q", WALK[at], sensor, of))
                rows.append(Key(f"{path}/dynamic_bias_correlation_time", "T", "s", sensor, of))
    return tuple(rows)


def _rotors() -> tuple[Key, ...]:
    return tuple(
        key
        for at, sensor in enumerate(SENSORS)
        for key in (
            Key(f"plugin/{_LONG[at]}NoiseDensity", "N", DENSITY[at], sensor),
            Key(f"plugin/{_LONG[at]}RandomWalk", "q", WALK[at], sensor),
            Key(f"plugin/{_LONG[at]}BiasCorrelationTime", "T", "s", sensor),
        )
    )


def _pegasus() -> tuple[Key | Text, ...]:
    rows: list[Key | Text] = []
    for at, sensor in enumerate(SENSORS):
        of = f"imu_config['{_LONG[at]}']"
        rows += [
            Text(f"{of} = {{}}", "{}", sensor=sensor),
            Key(f"{of}['noise_density'] = {{}}", "N", DENSITY[at], sensor),
            Key(f"{of}['random_walk'] = {{}}", "q", WALK[at], sensor),
            Key(f"{of}['bias_correlation_time'] = {{}}", "T", "s", sensor),
        ]
    return tuple(rows)


SIMULATORS = (
    Target(
        "gz-sim",
        "gz-sim SDF",
        "xml",
        "gz-sensors src/GaussianNoiseModel.cc: stddev per sample; a step lets the bias decay by "
        "exp(-dt/T) and drives it with the variance q^2*T/2*(1-exp(-2*dt/T))",
        _sdf(walk=True),
        (
            "put it below <sensor type='imu'>",
            "dynamic_bias_stddev is the driving density, though SDF's text calls it a standard deviation",
            f"bias_mean and bias_stddev: {_TURN_ON}",
        ),
        rate_name="update_rate of the sensor",
        also=("gz", "gazebo", "sdf", "gz-sim/SDF"),
    ),
    Target(
        "gazebo-classic",
        "gazebo-classic",
        "xml",
        "gazebo-classic's sensor: stddev per sample, not scaled by the step (gazebo-classic #2670)",
        _sdf(walk=False),
        (
            "put it below <sensor type='imu'>",
            "this sensor has no moving bias; the plugin of the target rotors has",
        ),
        rate_name="update_rate of the sensor",
    ),
    Target(
        "rotors",
        "rotors / hector IMU plugin",
        "xml",
        "rotors gazebo_imu_plugin.h: continuous densities, bias a first-order Gauss-Markov process",
        _rotors(),
        (
            "put these elements into the <plugin> of gazebo_imu_plugin, whose name and filename stay yours",
            f"TurnOnBiasSigma: {_TURN_ON}; the plugin's default, which is not zero, holds",
        ),
        also=("gazebo-imu-plugin", "hector", "rotors-simulator"),
    ),
    Target(
        "airsim",
        "AirSim",
        "json",
        "AirSim ImuSimpleParams.hpp, ImuSimple.hpp: arw/sqrt(dt); bias a walk of stability/sqrt(tau)",
        (
            Text("Sensors/Imu/SensorType", 2),
            Text("Sensors/Imu/Enabled", True),
            Key("Sensors/Imu/AngularRandomWalk", "N", "deg/√h", "gyro"),
            Key("Sensors/Imu/GyroBiasStability", "K*sqrt(500)", "deg/h", "gyro"),
            Text(
                "Sensors/Imu/GyroBiasStabilityTau",
                500.0,
                "s: only stability/sqrt(tau) matters",
            ),
            Key("Sensors/Imu/VelocityRandomWalk", "N", "mg/√Hz", "accel"),
            Key("Sensors/Imu/AccelBiasStability", "K*sqrt(800)", "µg", "accel"),
            Text(
                "Sensors/Imu/AccelBiasStabilityTau",
                800.0,
                "s: only stability/sqrt(tau) matters",
            ),
        ),
        (
            "merge these into the vehicle's part of settings.json",
            "BiasStability is no bias instability B: the code makes a random walk of it",
        ),
        comment_at="Sensors/Imu",
        unreadable="its walk depends on two values, stability and tau; divide them and convert by hand",
    ),
    Target(
        "isaac-lab",
        "Isaac Lab",
        "lines",
        "IsaacLab isaaclab/utils/noise/noise_cfg.py: std per sample",
        both(
            "gyro_noise = GaussianNoiseCfg(mean=0.0, std={})",
            "accel_noise = GaussianNoiseCfg(mean=0.0, std={})",
            "N*sqrt(r)",
            SAMPLE,
        ),
        (
            "Isaac Sim's own IMUSensor has no noise",
            "the bias of NoiseModelWithAdditiveBiasCfg is drawn at a reset and stays: it holds no walk",
        ),
        rate_name="rate of the observations",
        before=("from isaaclab.utils.noise import GaussianNoiseCfg", ""),
        unreadable="a program, not a file of values",
        also=("isaac", "isaac-sim", "isaaclab"),
    ),
    Target(
        "pegasus",
        "Pegasus Simulator",
        "lines",
        "pegasus simulator/logic/sensors/imu.py: densities; bias a first-order Gauss-Markov process",
        _pegasus(),
        (
            "the values follow its documentation; its code of 2024 does not add the biases, draws those of "
            "accelerometers uniformly, and takes their correlation time for the gyros",
            f"turn_on_bias_sigma: {_TURN_ON}; the default, which is not zero, holds",
        ),
        before=("imu_config = {}",),
        unreadable="a program, not a file of values",
    ),
    Target(
        "matlab",
        "MATLAB imuSensor",
        "lines",
        "MathWorks gyroparams, accelparams: NoiseType double-sided, densities",
        (
            *both("gyro.NoiseDensity = {};", "accel.NoiseDensity = {};", "N", DENSITY, "three"),
            *both("gyro.RandomWalk = {};", "accel.RandomWalk = {};", "K", WALK, "three"),
            *both(
                "gyro.BiasInstability = {};",
                "accel.BiasInstability = {};",
                "B",
                ("rad/s", "m/s²"),
                "three",
                optional=True,
            ),
        ),
        (
            "then: imu = imuSensor('accel-gyro', 'SampleRate', r, 'Gyroscope', gyro, 'Accelerometer', accel)",
            "a Markov process needs BiasInstabilityCoefficients (R2023b), which are not written here",
        ),
        comment="%",
        before=(
            "gyro = gyroparams('NoiseType', 'double-sided');",
            "accel = accelparams('NoiseType', 'double-sided');",
        ),
        unreadable="a program, whose densities are one-sided or two-sided as NoiseType says elsewhere",
        also=("imusensor",),
    ),
)

AUTOPILOTS = (
    Target(
        "px4",
        "PX4 EKF2",
        "lines",
        "PX4 src/modules/ekf2/EKF/covariance.cpp: variance per prediction step (dt*x)^2",
        (
            Key("param set EKF2_GYR_NOISE {}", "N*sqrt(r)", "rad/s", "gyro", least=1e-4, most=0.1),
            Key("param set EKF2_ACC_NOISE {}", "N*sqrt(r)", "m/s²", "accel", least=0.01, most=1.0),
            Key("param set EKF2_GYR_B_NOISE {}", "K*sqrt(r)", "rad/s²", "gyro", most=0.01),
            Key("param set EKF2_ACC_B_NOISE {}", "K*sqrt(r)", "m/s³", "accel", most=0.01),
        ),
        (_FLOOR, "defaults: 0.015 rad/s, 0.35 m/s^2, 0.001 rad/s^2, 0.003 m/s^3"),
        rate=100.0,
        rate_name="1/EKF2_PREDICT_US of 10 ms, not that of the IMU",
        also=("ekf2",),
    ),
    Target(
        "ardupilot",
        "ArduPilot EK3",
        "lines",
        "ArduPilot AP_NavEKF3_core.cpp: variance per step (dt*x)^2, of the delta angle's bias (dt^2*x)^2",
        (
            Key("EK3_GYRO_P_NSE,{}", "N*sqrt(r)", "rad/s", "gyro"),
            Key("EK3_ACC_P_NSE,{}", "N*sqrt(r)", "m/s²", "accel"),
            Key("EK3_GBIAS_P_NSE,{}", "K*sqrt(r)", "rad/s²", "gyro"),
            Key("EK3_ABIAS_P_NSE,{}", "K*sqrt(r)", "m/s³", "accel"),
        ),
        (_FLOOR, "defaults: 0.015 rad/s, 0.35 m/s^2, 0.001 rad/s^2, 0.02 m/s^3"),
        rate=1.0 / 0.012,
        rate_name="1/EKF_TARGET_DT of 12 ms, not that of the IMU",
        also=("ek3",),
    ),
)
