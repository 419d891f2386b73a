"""The table's estimators: camera, lidar and GNSS with an IMU.

N, K, q, T and B are the fit's, in SI, of two-sided densities; r is the rate of steps, dt = 1/r. A formula
follows the target's own code, which `source` names: what it does with the value in a step of dt has to come
to N²·dt for the angle and K²·dt for the bias.
"""

from __future__ import annotations

import dataclasses

from allanjax.record.units import SENSORS
from allanjax.report.export.targets import (
    DENSITY,
    DENSITY_SQUARED,
    SAMPLE,
    SAMPLE_WALK,
    VARIANCE,
    WALK,
    WALK_SQUARED,
    WALK_VARIANCE,
    Key,
    Of,
    Target,
    Text,
    both,
)

_YOURS = "not known to the fit: put yours"
_FRAGMENT = "these are lines of that file: its other ones stay yours"
_PRIORS = "sigma_bg and sigma_ba are priors of the turn-on bias, which one recording does not tell"
_RATE = Key("update_rate", "r", "Hz")
_TOPIC = Text("rostopic", "/imu0", _YOURS)
_FAST_LIO = (
    *both("mapping/gyr_cov", "mapping/acc_cov", "N**2*r", VARIANCE),
    *both("mapping/b_gyr_cov", "mapping/b_acc_cov", "K**2*r", WALK_VARIANCE),
)
_KALIBR = (
    *both("gyroscope_noise_density", "accelerometer_noise_density", "N", DENSITY),
    *both("gyroscope_random_walk", "accelerometer_random_walk", "K", WALK),
)
_VINS = (*both("gyr_n", "acc_n", "N*sqrt(2*r)", SAMPLE), *both("gyr_w", "acc_w", "K*sqrt(r)", SAMPLE_WALK))
_VINS_NOTES = (
    _FRAGMENT,
    "midpoint integration takes two samples a step with weight dt/2 each, hence sqrt(2*r); the common advice "
    "'n divided by sqrt(dt), w times sqrt(dt)' gives a bias walk too small by the factor r",
)
_VINS_SOURCE = "vins_estimator/src/factor/integration_base.h: V*noise*V^T with V(theta,n) = dt/2, V(b,w) = dt"


def _under(path: str, keys: tuple[Key, ...]) -> tuple[Key, ...]:
    return tuple(_moved(key, f"{path}/{key.name}") for key in keys)


def _moved(key: Key, name: str) -> Key:
    return dataclasses.replace(key, name=name)


def _imu_utils() -> tuple[Key | Text, ...]:
    axes: tuple[Of, ...] = ("mean", "x", "y", "z")
    rows: list[Key | Text] = [Text("type", "IMU"), Text("name", "imu", _YOURS)]
    for at, sensor in enumerate(SENSORS):
        block, stem = (("Gyr", "gyr"), ("Acc", "acc"))[at]
        rows.append(Text(f"{block}/unit", f'" {SAMPLE[at]}"', sensor=sensor))
        for of in axes:
            path = f"{block}/{of.replace('mean', 'avg')}-axis"
            rows += [
                Key(f"{path}/{stem}_n", "N", DENSITY[at], sensor, of),
                Key(f"{path}/{stem}_w", "K", WALK[at], sensor, of),
            ]
    return tuple(rows)


ESTIMATORS = (
    Target(
        "kalibr",
        "Kalibr",
        "yaml",
        "kalibr ConfigReader.py: discrete noise = density/sqrt(dt), walk = density*sqrt(dt)",
        (*_KALIBR, _TOPIC, _RATE),
        ("Kalibr stops unless all four are above zero; it estimates none of them",),
    ),
    Target(
        "allan_variance_ros",
        "allan_variance_ros",
        "yaml",
        "allan_variance_ros scripts/analysis.py, which writes Kalibr's imu.yaml",
        (*_KALIBR, _TOPIC, _RATE),
        (
            "allan_variance_ros itself reads K off a line of slope 1/2 over all cluster times and N off one "
            "below 10 s: its numbers differ from these where the curve is no such line",
        ),
    ),
    Target(
        "imu_utils",
        "imu_utils",
        "yaml",
        "mintar/imu_utils: densities (in the original, w was the curve's minimum and units were wrong)",
        _imu_utils(),
        unreadable="its forks write different quantities under the same keys, and it does not say which",
    ),
    Target("vins-mono", "VINS-Mono", "yaml", _VINS_SOURCE, _VINS, _VINS_NOTES),
    Target("vins-fusion", "VINS-Fusion", "yaml", _VINS_SOURCE, _VINS, _VINS_NOTES),
    Target(
        "orb_slam3",
        "ORB_SLAM3",
        "yaml",
        "ORB_SLAM3 Tracking.cc: Ng*sqrt(f), Na*sqrt(f), Ngw/sqrt(f), Naw/sqrt(f)",
        (
            *both("IMU.NoiseGyro", "IMU.NoiseAcc", "N", DENSITY),
            *both("IMU.GyroWalk", "IMU.AccWalk", "K", WALK),
            Key("IMU.Frequency", "r", "Hz"),
        ),
        (_FRAGMENT, "IMU.Frequency must be the true rate of the IMU: noise per sample is made with it"),
    ),
    Target(
        "openvins",
        "OpenVINS",
        "yaml",
        "OpenVINS config/euroc_mav/kalibr_imu_chain.yaml: continuous densities",
        (
            *_under("imu0", _KALIBR),
            Text("imu0/rostopic", "/imu0", _YOURS),
            Key("imu0/update_rate", "r", "Hz"),
            Text("imu0/model", '"kalibr"'),
        ),
        (
            _FRAGMENT,
            "T_i_b, time_offset, Tw, R_IMUtoGYRO, Ta, R_IMUtoACC, Tg are a calibration's, not noise",
        ),
    ),
    Target(
        "basalt",
        "Basalt",
        "json",
        "basalt-headers calibration.hpp: discrete std = std*sqrt(imu_update_rate)",
        (
            *both("value0/gyro_noise_std", "value0/accel_noise_std", "N", DENSITY, "three"),
            *both("value0/gyro_bias_std", "value0/accel_bias_std", "K", WALK, "three"),
            Key("value0/imu_update_rate", "r", "Hz"),
        ),
        ("merge these into value0 of calibration.json",),
        comment_at="value0",
    ),
    Target(
        "okvis",
        "OKVIS",
        "yaml",
        "OKVIS config/config_fpga_p2_euroc.yaml: continuous densities",
        (
            *both("imu_params/sigma_g_c", "imu_params/sigma_a_c", "N", DENSITY),
            *both("imu_params/sigma_gw_c", "imu_params/sigma_aw_c", "K", WALK),
            Key("imu_params/imu_rate", "r", "Hz"),
        ),
        (
            _FRAGMENT,
            _PRIORS,
            "OKVIS' own comment gives sigma_aw_c in m/s^2/sqrt(Hz); it is used as m/s^3/sqrt(Hz)",
        ),
    ),
    Target(
        "okvis2",
        "OKVIS2",
        "yaml",
        "okvis2 config/euroc.yaml: continuous densities, as in OKVIS",
        (
            *both("imu_parameters/sigma_g_c", "imu_parameters/sigma_a_c", "N", DENSITY),
            *both("imu_parameters/sigma_gw_c", "imu_parameters/sigma_aw_c", "K", WALK),
        ),
        (
            _FRAGMENT,
            _PRIORS,
        ),
    ),
    Target(
        "gtsam",
        "GTSAM",
        "lines",
        "gtsam/navigation/PreintegrationParams.h: continuous covariances, used as Cov/dt and dt*biasCov",
        (
            *both(
                "params.setGyroscopeCovariance(np.diag({}))",
                "params.setAccelerometerCovariance(np.diag({}))",
                "N**2",
                DENSITY_SQUARED,
                "three",
            ),
            *both(
                "params.setBiasOmegaCovariance(np.diag({}))",
                "params.setBiasAccCovariance(np.diag({}))",
                "K**2",
                WALK_SQUARED,
                "three",
            ),
        ),
        (
            "Python; C++ has the same functions. 9.81 m/s^2 is gravity with z up: put yours",
            "integrationCovariance is no noise of the sensor and has no value from a fit: it stays",
        ),
        before=(
            "import gtsam",
            "import numpy as np",
            "",
            "params = gtsam.PreintegrationCombinedParams.MakeSharedU(9.81)",
        ),
        unreadable="a program, not a file of values",
    ),
    *(
        Target(
            name,
            title,
            "yaml",
            "src/imuPreintegration.cpp: squared into GTSAM's continuous covariances; bias sqrt(dt)*BiasN",
            (
                *both(f"{root}/imuGyrNoise", f"{root}/imuAccNoise", "N", DENSITY),
                *both(f"{root}/imuGyrBiasN", f"{root}/imuAccBiasN", "K", WALK),
            ),
            (_FRAGMENT, note),
        )
        for name, title, root, note in (
            ("lio-sam", "LIO-SAM", "lio_sam", "in ROS 2 they stand below /**: ros__parameters:"),
            ("lvi-sam", "LVI-SAM", "lvi_sam", "params_lidar.yaml; its camera part takes those of vins-mono"),
        )
    ),
    Target(
        "fast-lio2",
        "FAST-LIO2",
        "yaml",
        "esekfom.hpp predict(): (dt*F_w)*Q*(dt*F_w)^T, so that these are variances per step",
        _FAST_LIO,
        (_FRAGMENT, "FAST-LIO rescales accelerations to 9.81 m/s^2; these are of true m/s^2"),
        also=("FAST-LIO",),
    ),
    Target(
        "fast-livo2",
        "FAST-LIVO2",
        "yaml",
        "FAST-LIVO2 config/avia.yaml, variances per step as in FAST-LIO2",
        tuple(_moved(key, key.name.replace("mapping/", "imu/")) for key in _FAST_LIO),
        (_FRAGMENT,),
    ),
    Target(
        "glim",
        "GLIM",
        "json",
        "koide3/glim config/config_sensors.json: squared into GTSAM's continuous covariances",
        both("sensors/imu_gyro_noise", "sensors/imu_acc_noise", "N", DENSITY),
        (
            "merge these into sensors of config_sensors.json",
            "imu_bias_noise is left out: one number for both sensors, of a unit that is not documented",
            "imu_int_noise is left out: it is no noise of the sensor",
        ),
        comment_at="sensors",
    ),
    Target(
        "hybvio",
        "HybVIO",
        "lines",
        "HybVIO src/odometry/ekf.cpp: variance per step (dt*x)^2; a step lets the bias decay by exp(-dt*Rev) "
        "and drives it with x^2*(1-exp(-2*dt*Rev))/(2*Rev)",
        (
            *both("-noiseProcessGyro={}", "-noiseProcessAcc={}", "N*sqrt(r)", SAMPLE),
            *both("-noiseProcessBGA={}", "-noiseProcessBAA={}", "q", WALK),
            *both("-noiseProcessBGARev={}", "-noiseProcessBAARev={}", "1/T", ("1/s", "1/s")),
        ),
        (
            "options of its command line, names of its parameters without the dash",
            "its authors call the first two continuous (HybVIO issue 44), but its code takes them per sample",
        ),
        also=("spectacularai",),
    ),
    Target(
        "kf-gins",
        "KF-GINS",
        "yaml",
        "KF-GINS dataset/kf-gins.yaml: bias is a first-order Gauss-Markov process, std q*sqrt(T/2)",
        (
            Key("imunoise/arw", "N", "deg/√h", "gyro", "three"),
            Key("imunoise/vrw", "N", "m/s/√h", "accel", "three"),
            Key("imunoise/gbstd", "q*sqrt(T/2)", "deg/h", "gyro", "three"),
            Key("imunoise/abstd", "q*sqrt(T/2)", "mGal", "accel", "three"),
            Key("imunoise/corrtime", "T", "h", "gyro"),
        ),
        (
            _FRAGMENT,
            "corrtime is one for all axes: stds are such that the density q that drives a bias is as fitted",
            "KF-GINS takes gbstd and abstd for the initial bias, too, without initbgstd and initbastd",
        ),
        one_time=True,
    ),
    Target(
        "ob-gins",
        "OB_GINS",
        "yaml",
        "OB_GINS dataset/ob_gins.yaml: bias is a first-order Gauss-Markov process, std q*sqrt(T/2)",
        (
            Key("imumodel/arw", "N", "deg/√h", "gyro"),
            Key("imumodel/vrw", "N", "m/s/√h", "accel"),
            Key("imumodel/gbstd", "q*sqrt(T/2)", "deg/h", "gyro"),
            Key("imumodel/abstd", "q*sqrt(T/2)", "mGal", "accel"),
            Key("imumodel/corrtime", "T", "h", "gyro"),
        ),
        (_FRAGMENT, "corrtime is one for gyros and accelerometers: stds are such that q is the fitted one"),
        one_time=True,
    ),
    Target(
        "robot_localization",
        "robot_localization",
        "yaml",
        "sensor_msgs/Imu, as robot_localization reads it: variance per sample, row-major 3 x 3",
        both("angular_velocity_covariance", "linear_acceleration_covariance", "N**2*r", VARIANCE, "matrix"),
        (
            "it has no parameter of its own: the driver of the IMU writes these into its messages",
            "they hold for messages at the rate r, each a mean over its interval; --rate gives another",
        ),
        rate_name="rate at which messages are published",
    ),
)
