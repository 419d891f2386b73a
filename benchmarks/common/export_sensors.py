"""Recordings with a known noise, by NumPy alone, whose fits are exported."""

import math

import numpy as np

import allanjax as aj

RATE = 200.0
AXES = [f"{sensor}_{axis}" for sensor in ("gyro", "accel") for axis in "xyz"]


def recording(bias, axes=AXES, n=16_384, name="bench"):
    """White noise and a bias of each axis, which `bias` makes of a generator and the scale of a sensor."""
    rng = np.random.default_rng(11)
    columns = []
    for k, axis in enumerate(axes):
        scale = 1.0 if axis.startswith("gyro") else 8.0
        white = 1e-4 * scale * (1.0 + 0.2 * k) * math.sqrt(RATE) * rng.normal(size=n)
        columns.append(white + bias(rng, n, scale * (1.0 + 0.3 * k), axis))
    return aj.Recording.from_array(
        np.stack(columns, 1), RATE, names=axes, gyro_unit="rad/s", accel_unit="m/s^2", name=name
    )


def walk(rng, n, scale, axis):
    """A random walk, which gyro_z does not have."""
    if axis == "gyro_z":
        return 0.0
    return np.cumsum(5e-5 * scale / math.sqrt(RATE) * rng.normal(size=n))


def model_of(fit, q="rate_random_walk", T=None):
    """(N, q, T) of each axis: estimates, and limits where there is none."""
    found = {"gyro": {}, "accel": {}}
    for name in AXES:
        cs = fit[name].coefficients
        amplitude = cs[q].value if cs[q].detected else cs[q].upper_limit
        time = cs[T].value if T else math.inf
        found[cs[q].axis.sensor][name[-1]] = (cs["angle_random_walk"].value, amplitude, time)
    return found


def with_one_time(model):
    """The same for a target with one time for all axes, that of the gyro driven most: q of each is kept."""
    T = max(model["gyro"].values(), key=lambda row: row[1])[2]
    return {s: {axis: (N, q, T) for axis, (N, q, _) in of.items()} for s, of in model.items()}
