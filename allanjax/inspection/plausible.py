"""Plausibility of the stated units, sample rate and length."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from jaxtyping import Float

from allanjax.base.earth import STANDARD_GRAVITY as _G
from allanjax.inspection.facts import Consequence, Fact
from allanjax.inspection.motion import AT_REST, DEG
from allanjax.record.recording import Axis, scales_of
from allanjax.record.units import parse_sample_unit, unit_scale

# Tolerance of gravity measured by a triad, and by a single axis. Gravity is known to 0.3 % anywhere, biases
# and scale factors of consumer sensors to 5 %. A tilted single axis may read anything: hence less for it.
_TRIAD, _ALONE = 0.05, 0.01
# A triad whose mean is within this of gravity is not questioned.
_ABOUT = 0.2
# A triad that averages less than this share of gravity has none in it: simulated, or taken out.
_NONE = 0.1
_ACCEL_UNITS = ("m/s²", "g", "mg", "cm/s²", "ft/s²")
# An option that contradicts the header is refused.
_HEADER = ", or correct the header if it says another unit"
# Zero-rate level beyond the specification of any gyro.
_LARGEST_BIAS = 20.0 * DEG
# deg/√h in rad/√s.
_ROOT_HOUR = DEG / 60.0
# White noise [rad/√s] below that of the best gyro made.
_BEST_GYRO = 3e-5 * _ROOT_HOUR
# Least ratio of the gyros' white noise [deg/√h] to the accelerometers' [m/s/√h]: of tested units it is 0.17
# (fibre-optic gyros beside MEMS accelerometers) to 30, and 57 times less if rad/s are taken for deg/s.
_LEAST_RATIO = 0.1
# White noise [m/s/√h] above which accelerometers are MEMS.
_MEMS = 0.03
# Units [s] in which a column of times may be.
_TIMES = {"s": 1.0, "ms": 1e-3, "µs": 1e-6, "ns": 1e-9}
# Relative difference beyond which time stamps contradict the rate.
_SAME_RATE = 0.05
# Noise is white if its Allan deviation times root of cluster time varies by less than this factor.
_FLAT = 6.0
# Samples among which the interval of a column of times is looked for.
_COUNTED = 1 << 14
#: Shorter recordings [s] say little of B and K, which show over tens of seconds.
SHORT = 60.0
# Fewer samples determine N so poorly that it is worth a warning.
_FEW_SAMPLES = 1000


def implausible(
    axes: Sequence[Axis],
    rate: float,
    mean: Float[np.ndarray, " axes"],
    white: Float[np.ndarray, "scales axes"],
    auxiliary: Mapping[str, Float[np.ndarray, " n"]],
    moving: Collection[str] = (),
    vibrating: bool = False,
) -> list[Fact]:
    """Facts about units or a rate that cannot be right.

    Args:
        axes: axes of the recording.
        rate: sample rate [Hz].
        mean: mean of each axis [rad/s or m/s²].
        white: Allan deviation times root of cluster time, for clusters up to a second [rad/√s or m/s/√s]; the
            least is an upper bound of the white noise N.
        auxiliary: other columns, among which may be one of times.
        moving: sensors that are known not to be at rest.
        vibrating: whether the platform is meant to move.
    """
    grave: Consequence = "not a measurement"
    found = [Fact("rate", _rate(rate, auxiliary), tuple(axis.name for axis in axes), grave)]
    for accel in accelerometers(axes):
        line = _accel(axes, accel, rate, mean, "accel" in moving)
        # What a single axis reads is a matter of its tilt.
        means: Consequence = grave if len(accel) >= 3 else "none"
        found.append(Fact("accel unit", line, tuple(axes[k].name for k in accel), means))
    # Where accelerometers of the right unit move, gyros do, too.
    moves = vibrating or ("accel" in moving and not any(fact.text for fact in found[1:]))
    gyros = tuple(axis.name for axis in axes if axis.sensor == "gyro")
    found.append(Fact("gyro unit", _gyro(axes, mean, white, "gyro" in moving, moves), gyros, grave))
    return [fact for fact in found if fact.text]


def accelerometers(axes: Sequence[Axis]) -> list[list[int]]:
    """Indices of the axes of each accelerometer: those whose names differ in their last letter only."""
    groups: dict[str, list[int]] = {}
    for k, axis in enumerate(axes):
        if axis.sensor == "accel":
            groups.setdefault(axis.name.rstrip("xyz"), []).append(k)
    return list(groups.values())


def _accel(
    axes: Sequence[Axis], accel: Sequence[int], rate: float, mean: Float[np.ndarray, " axes"], moving: bool
) -> str:
    """Warning about an accelerometer if it does not measure gravity, or "" if it does."""
    size = float(np.linalg.norm(mean[accel]))
    triad = len(accel) >= 3
    if abs(size / _G - 1.0) < _ABOUT or size == 0.0:
        return ""
    own = parse_sample_unit(axes[accel[0]].unit, "accel")
    number = size / scales_of([axes[accel[0]]], rate)[0]
    wrong = f"accelerometers average {number:.4g} {own.name}: gravity is 9.81 m/s²"
    tolerance = _TRIAD if triad else _ALONE

    def is_gravity(acceleration: float) -> bool:
        return abs(acceleration / _G - 1.0) < tolerance

    if own.quantity == "increment":
        for factor in (10.0, 0.1, 100.0, 0.01):
            if is_gravity(size / factor):
                probable = rate / factor
                return (
                    f"{wrong}, or {_G / size * number:.4g} {own.name} at {rate:g} Hz; the rate is probably "
                    f"{probable:g} Hz: --rate {probable:g}"
                )
    for other in _ACCEL_UNITS:
        if is_gravity(number * unit_scale(other, "accel")):
            option = f"--accel-unit {other.replace('²', '^2')}"
            return f"{wrong}; their unit is probably {other}: {option}{_HEADER}"
    if own.quantity == "rate" and is_gravity(size * rate):
        return (
            f"{wrong}, {_G / rate:.4g} m/s a sample; they are probably increments: --accel-unit m/s{_HEADER}"
        )
    if triad and not moving and size > _NONE * _G:
        return (
            f"{wrong}, and this is {size:.3g}; is the unit right, and the range wide enough? (--accel-unit)"
        )
    return ""


def _gyro(
    axes: Sequence[Axis],
    mean: Float[np.ndarray, " axes"],
    white: Float[np.ndarray, "scales axes"],
    moving: bool,
    platform_moves: bool,
) -> str:
    """Warning about the gyros if their bias or noise is that of no gyro at rest, or ""."""
    gyros = [k for k, axis in enumerate(axes) if axis.sensor == "gyro"]
    if not gyros:
        return ""
    unit = axes[gyros[0]].unit
    noise, bias = float(np.median(white.min(axis=0)[gyros])), float(abs(mean[gyros]).max())
    # Motion is not white, but noise in another unit still is.
    flat = bool(np.median((white.max(axis=0) - _FLAT * white.min(axis=0))[gyros]) < 0.0)
    known = f"gyros average {bias / DEG:.3g} deg/s with a noise of {noise / _ROOT_HOUR:.2g} deg/√h"
    beyond = (noise > AT_REST["gyro"] and flat) or (bias > _LARGEST_BIAS and not moving)
    if beyond and not platform_moves:
        remedy = "is the unit right? (--gyro-unit)"
        if "deg" not in unit:
            remedy = f"are they deg/s? --gyro-unit deg/s{_HEADER}"
        return f"{known}, beyond any gyro at rest; {remedy}"
    if 0.0 < noise < _BEST_GYRO:
        return f"{known}, and the best ones made have 0.0001 deg/√h; is the unit right? (--gyro-unit)"
    accel = [k for k, axis in enumerate(axes) if axis.sensor == "accel"]
    if accel and "rad" not in unit:
        beside = float(np.median(white.min(axis=0)[accel])) * 60.0
        if 0.0 < noise / _ROOT_HOUR < _LEAST_RATIO * beside and beside > _MEMS:
            return (
                f"{known}, too little beside accelerometers of {beside:.2g} m/s/√h; are they rad/s? "
                f"--gyro-unit rad/s{_HEADER}"
            )
    return ""


def _rate(rate: float, auxiliary: Mapping[str, Float[np.ndarray, " n"]]) -> str:
    """Warning about an unused column of times that contradicts the rate, or "" if there is none."""
    for name, column in auxiliary.items():
        if not ("time" in name.lower() or name.lower() in ("t", "stamp")):
            continue
        step = float(np.median(np.diff(np.asarray(column, float)[:_COUNTED])))
        if not (np.isfinite(step) and step > 0.0):
            continue
        rates = {1.0 / (step * size): unit for unit, size in _TIMES.items()}
        nearest = min(rates, key=lambda r: abs(np.log(r / rate)))
        if abs(nearest / rate - 1.0) > _SAME_RATE:
            return (
                f"the column {name!r} grows by {step:g} a sample, {nearest:.4g} Hz if in {rates[nearest]}, "
                f"and the rate is {rate:g} Hz; if that is wrong, take its times by --time {name}, or its "
                f"rate by --time none --rate {nearest:.6g} (rate={nearest:.6g})"
            )
    return ""


def short(n: int, rate: float, axes: Sequence[Axis]) -> list[Fact]:
    """Fact about a recording of n samples at this rate [Hz] that is short."""
    if n >= _FEW_SAMPLES and n / rate >= SHORT:
        return []
    line = f"{n / rate:.3g} s: too short for B and K, which show over tens of seconds and more"
    if n < _FEW_SAMPLES:
        line += f"; of {n} samples, N is known to {100.0 / np.sqrt(n):.0f} % at best"
    return [Fact("length", line, tuple(axis.name for axis in axes), size=n / rate, unit="s")]
