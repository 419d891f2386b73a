"""Coefficients by what people call them."""

import pytest

import allanjax as aj
from allanjax.noise.estimate import Estimate
from allanjax.noise.names import called
from allanjax.noise.notation import parse_model
from allanjax.record.recording import Axis

AXES = {"gyro": Axis("gyro_x", "gyro", "deg/s"), "accel": Axis("accel_x", "accel", "g")}


def coefficients(sensor: str, text: str = "Q + N + B + K + R + markov") -> dict[str, Estimate]:
    return {
        p.label: Estimate(
            axis=AXES[sensor],
            value=1.0,
            std=0.1,
            interval=(0.8, 1.2),
            interval_68=(0.9, 1.1),
            label=p.label,
            term=p.term_label,
            parameter=p.parameter,
            upper_limit=None,
            detected=True,
        )
        for p in parse_model(text).parameters
    }


@pytest.mark.parametrize(
    ("sensor", "names", "label"),
    [
        ("gyro", ["N", "ARW", "arw", "angle_random_walk", "Angle random walk"], "angle_random_walk"),
        ("accel", ["N", "VRW", "velocity_random_walk", "velocity random walk"], "angle_random_walk"),
        ("gyro", ["K", "RRW", "rate-random-walk"], "rate_random_walk"),
        ("accel", ["K", "RRW", "acceleration_random_walk"], "rate_random_walk"),
        ("gyro", ["B", "BI", "flicker", "bias instability"], "bias_instability"),
        ("accel", ["Q", "QN", "quantization_noise"], "quantization"),
        ("gyro", ["R", "ramp", "rate_ramp", "drift_ramp"], "drift_ramp"),
        ("gyro", ["T_c", "markov_correlation_time"], "markov_correlation_time"),
        ("accel", ["q_c", "markov_amplitude"], "markov_amplitude"),
    ],
)
def test_labels_symbols_and_abbreviations(sensor, names, label):
    found = coefficients(sensor)
    assert {called(name, found) for name in names} == {label}


def test_what_could_be_two_things_is_neither():
    assert called("velocity_random_walk", coefficients("gyro")) is None
    # The angle random walk for some, the acceleration random walk for others.
    assert called("ARW", coefficients("accel")) is None
    two = coefficients("gyro", "N + markov + markov")
    assert called("T_c", two) is None
    assert called("markov_2_correlation_time", two) == "markov_2_correlation_time"
    assert called("n", coefficients("gyro")) is None


def test_an_axis_of_a_fit_is_asked_by_any_of_them(small_fit):
    gyro, accel = small_fit["gyro_x"], small_fit["accel_z"]
    assert gyro["N"] is gyro["ARW"] is gyro["angle_random_walk"]
    assert accel["velocity_random_walk"] is accel["VRW"] is accel["angle_random_walk"]
    with pytest.raises(aj.FitError, match="accel_z has no coefficient 'ARW'; it has quantization, "):
        accel["ARW"]
