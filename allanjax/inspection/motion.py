"""Tests for motion: whether a sensor changes, wanders or shakes more than one at rest can."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from allanjax.inspection.scores import mean_squares, steps_of
from allanjax.inspection.windows import Windows

DEG = np.pi / 180.0
# Allan deviation at 1 s that no gyro [rad/s] and no accelerometer [m/s²] at rest has. The noisiest consumer
# gyros have 2 deg/√h, 0.033 deg/s at 1 s, and the noisiest accelerometers 1 mg/√Hz, 0.01 m/s²; a correlated
# part, or a line, makes up to ten times of it.
AT_REST = {"gyro": 0.3 * DEG, "accel": 0.15}
# Cluster times [s] tested: below, vibration and quantization are large at rest, too; above, drift is.
_SHORTEST, _LONGEST = 0.3, 10.0
# Largest range of the mean at rest [rad/s or m/s²]: zero-rate levels drift by less than 3 deg/s once a sensor
# runs, and 0.5 m/s² is a tilt of 3 degrees.
WANDERS = {"gyro": 3.0 * DEG, "accel": 0.5}
# Largest rms about the mean at rest [rad/s or m/s²]: the noisiest sensors above have half as much at 400 Hz.
SHAKES = {"gyro": 10.0 * DEG, "accel": 2.0}


@dataclasses.dataclass(frozen=True)
class Motion:
    """Evidence that an axis is not at rest.

    Attributes:
        kind: "changes" from one cluster time to the next, "wanders" over the record, "shakes".
        axis: index of the axis.
        value: rms change, range of the mean, or rms about it [rad/s or m/s²].
        limit: the largest such value of a sensor at rest.
        time: the cluster time [s] of changes.
    """

    kind: str
    axis: int
    value: float
    limit: float
    time: float = 0.0


def motions(windows: Windows, sensors: Sequence[str], rate: float) -> list[Motion]:
    """Evidence of motion on every axis that shows it, the strongest last."""
    moving = _changes(windows, sensors, rate)
    # Means over a second at least, or those of the windows if there are too few.
    over = max(int(np.ceil(rate / windows.size)), 1)
    whole = len(windows) // over * over
    mean = windows.mean[:whole].reshape(-1, over, len(sensors)).mean(axis=1) if whole else windows.mean
    wander, shake = np.ptp(mean, axis=0), rms_within(windows)
    for kind, values, limits in (("wanders", wander, WANDERS), ("shakes", shake, SHAKES)):
        moving += [
            Motion(kind, k, float(values[k]), limits[sensor])
            for k, sensor in enumerate(sensors)
            if values[k] > limits[sensor]
        ]
    return sorted(moving, key=lambda m: m.value / m.limit)


def _changes(windows: Windows, sensors: Sequence[str], rate: float) -> list[Motion]:
    """Axes and cluster times at which the means of neighbouring clusters differ too much for rest."""
    within = mean_squares(windows)
    known = [k for k, square in enumerate(within) if np.isfinite(square).any()]
    sizes = [(1 << k, np.nanmean(within[k], axis=0)) for k in known]
    sizes += [(s.lag * windows.size, (s.step**2).mean(axis=1)) for s in steps_of(windows, sensors)]
    found = []
    for size, square in sizes:
        time = size / rate
        if not _SHORTEST <= time <= _LONGEST:
            continue
        for k, sensor in enumerate(sensors):
            # The limit follows white noise up to 1 s; the rms difference of two means is √2 times the Allan
            # deviation.
            limit = AT_REST[sensor] * np.sqrt(2.0 / min(time, 1.0))
            if square[k] > limit**2:
                found.append(Motion("changes", k, float(np.sqrt(square[k])), float(limit), time))
    return found


def rms_within(windows: Windows) -> Float[np.ndarray, " axes"]:
    """Rms of the samples about the mean of their window."""
    # The sum of squares about the mean is a weighted sum over the differences of halves of all sizes.
    scales = 2.0 ** np.arange(len(windows.power))
    return np.sqrt((windows.power.sum(axis=1) * (scales / 2.0)[:, None]).sum(axis=0) / windows.count.sum())
