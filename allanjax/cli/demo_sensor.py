"""Simulated sensor of the demonstration, and the comparison of a fit with its true coefficients."""

from collections.abc import Mapping
from dataclasses import replace

from allanjax.base.earth import STANDARD_GRAVITY
from allanjax.base.tables import as_text, columns_from
from allanjax.base.wording import plain
from allanjax.estimate.result import Fit
from allanjax.noise.model import Model
from allanjax.noise.notation import parse_model
from allanjax.noise.simulate import simulate_recording
from allanjax.record.recording import Recording

RATE = 100.0
DURATION = 1500.0
_SEED = 952
# Terms of the order of a good MEMS unit, each visible in 25 minutes, so that a fit can find it.
_TRUTH = {
    "gyro_x": "Q=0.6 arcsec + N=0.20 deg/√h + B=6 deg/h",
    "gyro_y": "Q=0.5 arcsec + N=0.25 deg/√h + B=8 deg/h",
    "gyro_z": "Q=0.7 arcsec + N=0.15 deg/√h + B=5 deg/h",
    "accel_x": "N=0.05 m/s/√h + K=40 m/s/h/√h",
    "accel_y": "N=0.06 m/s/√h + K=50 m/s/h/√h",
    "accel_z": "N=0.08 m/s/√h + K=60 m/s/h/√h",
}


def demo_models() -> Mapping[str, Model]:
    """True model of each axis."""
    return {axis: parse_model(text, "gyro" if "gyro" in axis else "accel") for axis, text in _TRUTH.items()}


def demo_recording() -> Recording:
    """Recording of 25 minutes of a six-axis sensor at 100 Hz, always the same."""
    n = round(DURATION * RATE)
    return simulate_recording(demo_models(), n, RATE, _SEED, bias={"accel_z": STANDARD_GRAVITY}, name="demo")


def compare(fit: Fit) -> tuple[str, int, int]:
    """Comparison of the coefficients of a fit of `demo_recording` with the truth.

    Returns a table for a terminal, each coefficient in its usual unit; how many 95 % intervals, or upper
    limits of terms that are not detected, contain the true value; and how many there are.
    """
    models, rows, inside = demo_models(), [], 0
    for result in fit.results:
        for c in result.coefficients.values() if result.converged else ():
            truth = models[result.axis.name].values.get(c.label) or 0.0
            limit = None if c.detected else c.upper_limit
            lower, upper = c.interval if limit is None else (0.0, limit)
            holds = lower <= truth <= upper
            inside += holds
            shown = c.in_unit()
            value = replace(c, value=truth).in_unit().value
            true = f"{plain(value, 4)} {shown.unit}" if truth else "none"
            rows.append((c.axis.name, c.title, shown.describe(), true, "inside" if holds else "OUTSIDE"))
    headings = ("axis", "coefficient", "estimate", "true", "95 %")
    return as_text("estimates and true coefficients", [columns_from(headings, rows)]), inside, len(rows)
