"""Can the units, the rate and the resolution be what they are said to be?"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from allanjax.inspection.motion import AT_REST
from allanjax.recording import Recording
from allanjax.units import parse_sample_unit, unit_scale

_DEG = np.pi / 180.0
_G = 9.80665
# Gravity is known to 0.3 % anywhere; biases and scale factors of consumer sensors to 5 %. A single axis may be
# tilted, and is taken for gravity in another unit only within what is left to chance.
_TRIAD, _ALONE = 0.05, 0.01
# A triad whose mean is within this of gravity is not questioned.
_ABOUT = 0.2
# A triad that averages less than this share of gravity has none in it: simulated, or taken out.
_NONE = 0.1
_ACCEL_UNITS = ("m/s²", "g", "mg", "cm/s²", "ft/s²")
# Zero-rate level beyond the specification of any gyro.
_LARGEST_BIAS = 20.0 * _DEG
# deg/√h in rad/√s; m/s/√h in m/s/√s.
_ROOT_HOUR = _DEG / 60.0
# White noise below that of the best gyro made; and that of any MEMS accelerometer of a unit whose gyros are
# tactical or better.
_BEST_GYRO = 3e-5 * _ROOT_HOUR
# Least ratio of the gyros' white noise [deg/√h] to the accelerometers' [m/s/√h]: of tested units it is 0.17
# (fibre-optic gyros beside MEMS accelerometers) to 30, and 57 times less if rad/s are taken for deg/s.
_LEAST_RATIO = 0.07
# Values of an axis that are few, and the samples they are counted among.
_FEW, _COUNTED = 8, 1 << 14
# Share of equal neighbours at which the noise is 0.4 steps of the resolution: below, it is not seen.
_HIDDEN = 0.6
# Share of repeats beyond what the resolution makes that says samples are held.
_HELD = 0.1
#: Shorter recordings [s] say little of B and K, which show over tens of seconds.
SHORT = 60.0
_FEW_SAMPLES = 1000


def implausible(recording: Recording, white: Float[np.ndarray, " axes"]) -> list[str]:
    """A line on each unit or rate that cannot be.

    Args:
        recording: the samples.
        white: of each axis, an upper bound of its white noise N [rad/√s or m/s/√s].
    """
    return [line for line in (_accel(recording), _gyro(recording, white), _rate(recording)) if line]


def _accel(recording: Recording) -> str:
    """Gravity is 9.81 m/s², and known better than any unit is mistaken for another."""
    axes = [k for k, axis in enumerate(recording.axes) if axis.sensor == "accel"]
    if not axes:
        return ""
    unit = recording.axes[axes[0]].unit
    mean = float(np.linalg.norm(recording.values[:, axes].mean(axis=0)))
    triad = len(axes) >= 3
    tolerance = _TRIAD if triad else _ALONE
    own = parse_sample_unit(unit, "accel")
    rate = recording.rate if own.quantity == "increment" else 1.0
    number = mean / (own.scale * rate)
    shown = f"accelerometers average {number:.4g} {unit}" + (f" at {rate:g} Hz" if rate != 1.0 else "")
    if abs(mean / _G - 1.0) < _ABOUT or mean < 1e-3 * _G:
        return ""
    if own.quantity == "increment":
        for factor in (10.0, 0.1, 100.0, 0.01):
            if abs(mean / (factor * _G) - 1.0) < tolerance:
                return f"{shown}: that is {mean:.4g} m/s², and gravity is 9.81 m/s²; the rate is probably {rate / factor:g} Hz: --rate"
    for other in _ACCEL_UNITS:
        if abs(number * unit_scale(other, "accel") / _G - 1.0) < tolerance:
            return f"{shown}: gravity is 9.81 m/s²; their unit is probably {other}: --accel-unit {_plain(other)}"
    if own.quantity == "rate" and abs(mean * recording.rate / _G - 1.0) < tolerance:
        return f"{shown}: gravity is 9.81 m/s²; they are probably increments: --accel-unit m/s"
    if triad and mean > _NONE * _G:
        return f"{shown}, {mean:.3g} m/s², and gravity is 9.81 m/s²: is the unit right, or the sensor's range too small? (--accel-unit)"
    return ""


def _gyro(recording: Recording, white: Float[np.ndarray, " axes"]) -> str:
    """A gyro at rest reads the Earth's rate, 15 deg/h, its bias, and noise that its kind of sensor can have."""
    axes = [k for k, axis in enumerate(recording.axes) if axis.sensor == "gyro"]
    if not axes:
        return ""
    unit = recording.axes[axes[0]].unit
    noise, bias = float(np.median(white[axes])), float(abs(recording.values[:, axes].mean(axis=0)).max())
    steady = noise < AT_REST["gyro"]
    known = f"gyros average up to {bias / _DEG:.3g} deg/s with noise of {noise / _ROOT_HOUR:.2g} deg/√h"
    remedy = "" if "deg" in unit else "; if they are deg/s: --gyro-unit deg/s"
    if bias > _LARGEST_BIAS and steady:
        return f"{known}: no gyro at rest has such a bias{remedy or '; was it turning, or is the unit wrong? (--gyro-unit)'}"
    if noise > AT_REST["gyro"] and "deg" not in unit:
        return f"{known}: beyond any sensor at rest{remedy}"
    if noise < _BEST_GYRO and noise > 0.0:
        return f"{known}: the best gyros made have 0.0001 deg/√h; is {unit} the right unit? (--gyro-unit)"
    accel = [k for k, axis in enumerate(recording.axes) if axis.sensor == "accel"]
    if accel and "rad" not in unit:
        beside = float(np.median(white[accel])) * 60.0
        if 0.0 < noise / _ROOT_HOUR < _LEAST_RATIO * beside and beside > 0.03:
            return (
                f"{known}, too quiet beside accelerometers of {beside:.2g} m/s/√h: are they rad/s? "
                "--gyro-unit rad/s"
            )
    return ""


def _rate(recording: Recording) -> str:
    """A column of times that was not used, and disagrees with the rate that was given."""
    for name, column in recording.auxiliary.items():
        if "time" not in name.lower() and name.lower() not in ("t", "stamp", "timestamp"):
            continue
        step = float(np.median(np.diff(np.asarray(column, float)[:_COUNTED])))
        if not (np.isfinite(step) and step > 0.0):
            continue
        rates = {1.0 / (step * unit): label for unit, label in ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs"), (1e-9, "ns"))}
        nearest = min(rates, key=lambda r: abs(np.log(r / recording.rate)))
        if abs(nearest / recording.rate - 1.0) > 0.05:
            return (
                f"the column {name!r} steps by {step:g}, {nearest:.4g} Hz in {rates[nearest]}, and the rate "
                f"given is {recording.rate:g} Hz: leave out --rate and --time none to use the stamps"
            )
    return ""


def coarse(
    recording: Recording, repeated: Float[np.ndarray, " axes"], resolution: Float[np.ndarray, " axes"]
) -> list[str]:
    """A line on what cannot be known of so few samples, or of so few values.

    Args:
        recording: the samples.
        repeated: share of the samples of each axis that are equal to the one before.
        resolution: smallest step between the samples of each axis [rad/s or m/s²].
    """
    lines = []
    duration = recording.duration
    if recording.n < _FEW_SAMPLES or duration < SHORT:
        what = f"{recording.n} samples in {duration:.3g} s" if recording.n < _FEW_SAMPLES else f"{duration:.3g} s"
        lines.append(
            f"{what}: too short for B and K, which show over tens of seconds and more"
            + ("" if recording.n >= _FEW_SAMPLES else f"; N is known to {100.0 / np.sqrt(recording.n):.0f} % at best")
        )
    scales = recording.own_scales
    for sensor in dict.fromkeys(axis.sensor for axis in recording.axes):
        hidden, held = [], []
        for k, axis in enumerate(recording.axes):
            if axis.sensor != sensor:
                continue
            sample = recording.values[: _COUNTED, k]
            few = len(np.unique(sample))
            # As many values in all as were seen at first: else there are more.
            if repeated[k] > _HIDDEN and few <= _FEW:
                hidden.append((k, len(np.unique(recording.values[:, k]))))
            elif repeated[k] > _HELD + 3.0 * _chance(sample, resolution[k]):
                held.append(k)
        if hidden:
            k, count = hidden[0]
            names = _names(recording, [k for k, _ in hidden])
            step = f"{resolution[k] / scales[k]:.3g} {recording.axes[k].unit}"
            lines.append(
                f"{names} {'has' if len(hidden) == 1 else 'have'} {count} distinct values{'' if len(hidden) == 1 else ' or so'}: the noise is below the "
                f"resolution of {step}, and the coefficients are those of the rounding"
            )
        if held:
            share = 100.0 * float(np.mean(repeated[held]))
            lines.append(
                f"{_names(recording, held)}: {share:.0f} % of the samples repeat the one before: the sensor gives "
                "fewer than the rate says, and N at the shortest cluster times is not its own"
            )
    return lines


def _chance(sample: Float[np.ndarray, " n"], resolution: float) -> float:
    """Share of repeats that rounding to the resolution makes of noise."""
    d = np.diff(sample)
    moving = d[d != 0.0]
    if len(moving) == 0 or not np.isfinite(resolution):
        return 0.0
    # Differences of neighbours are normal with this deviation: the density at zero, times a step.
    scatter = float(np.median(abs(moving))) / 0.6745
    return float(min(resolution / (scatter * np.sqrt(2.0 * np.pi)), 1.0))


def _names(recording: Recording, axes: Sequence[int]) -> str:
    names = [recording.axes[k].name for k in axes]
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _plain(unit: str) -> str:
    return unit.replace("²", "^2")
