"""Simulated stand-ins, with the same effects, for the two real ADIS16405 units of the notebooks.

They serve readers who do not have the real recordings. Sizes are close to those of the real units, so that
the notebooks run and show similar results; the numbers in their text are those of the real units.
"""

from __future__ import annotations

import numpy as np

import allanjax as aj

RATE = 100.0
GYROS, ACCELS = ("gyro_x", "gyro_y", "gyro_z"), ("accel_x", "accel_y", "accel_z")
# What differs between the units: frequencies [Hz] of a peak on gyro_z and of a bump on the accelerometers.
PEAK, BUMP = {1: 21.9, 2: 20.3}, {1: 11.0, 2: 10.1}
# The line that all accelerometers share, with its third harmonic: frequency [Hz], size [mg].
LINE = ((0.567, 0.6), (1.70, 0.18))
# Resolution of the registers: 0.05 deg/s and 3.33 mg.
COUNT = {"gyro": 0.05, "accel": 3.33e-3}
SI = {"gyro": aj.convert(1.0, "deg/s", "rad/s"), "accel": aj.convert(1.0, "g", "m/s²")}


def simulated_unit(unit: int, n: int = 1_000_000) -> aj.Recording:
    """Unit 1 or 2, n samples at 100 Hz: noise behind a roll-off, peaks, a shared line and drift, rounding."""
    peak = aj.Resonance(aj.convert(0.27, "deg/s", "rad/s"), PEAK[unit], 24.0)
    bump = aj.Resonance(aj.convert(0.7, "mg", "m/s²"), BUMP[unit], 15.0)
    models = {name: gyro() for name in GYROS} | {name: accelerometer() + bump for name in ACCELS}
    models["gyro_z"] = gyro() + peak
    noise = aj.simulate_recording(models, n, RATE, key=10 * unit).values
    noise[:, 3:] += shared(unit, n)[:, None] * [1.0, 0.5, 0.8]
    noise[:, 5] -= aj.convert(1.0, "g", "m/s²")
    counts, units = (np.repeat([of["gyro"], of["accel"]], 3) for of in (COUNT, SI))
    return aj.Recording.from_array(
        counts * np.round(noise / (counts * units)),
        RATE,
        gyro_unit="deg/s",
        accel_unit="g",
        names=[*GYROS, *ACCELS],
        name=f"simulated_unit{unit}",
    )


def gyro() -> aj.Model:
    return (
        aj.LowPass(aj.convert(2.3, "deg/√h", "rad/√s"), 28.0)
        + aj.BiasInstability(aj.convert(30.0, "deg/h", "rad/s"))
        + aj.RateRandomWalk(aj.convert(200.0, "deg/h/√h", "rad/s/√s"))
    )


def accelerometer() -> aj.Model:
    return (
        aj.LowPass(aj.convert(0.2, "m/s/√h", "m/s/√s"), 30.0)
        + aj.BiasInstability(aj.convert(200.0, "µg", "m/s²"))
        + aj.RateRandomWalk(aj.convert(20.0, "m/s/h/√h", "m/s²/√s"))
    )


def shared(unit: int, n: int) -> np.ndarray:
    """What all accelerometers [m/s²] of a unit feel: a drift, motion, a wandering line, its harmonic."""
    parts = [aj.RateRandomWalk(aj.convert(120.0, "m/s/h/√h", "m/s²/√s"))]
    parts += [aj.AngleRandomWalk(aj.convert(0.06, "m/s/√h", "m/s/√s"))]
    parts += [aj.Resonance(aj.convert(size, "mg", "m/s²"), f, 300.0) for f, size in LINE]
    return sum(np.asarray(aj.simulate(part, n, RATE, 100 * unit + k)) for k, part in enumerate(parts))
