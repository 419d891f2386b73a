"""Simulated sensor of the demonstration, whose true coefficients a fit is compared with."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from allanjax.base.tables import text_table
from allanjax.base.wording import plain
from allanjax.estimate.result import Fit
from allanjax.noise.estimate import Estimate
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


@dataclass(frozen=True)
class TruthComparison:
    """Estimate of a coefficient and its true value.

    Attributes:
        found: the estimate [SI].
        truth: true value [SI]; 0 for a term that was left out.
    """

    found: Estimate
    truth: float

    @property
    def inside(self) -> bool:
        """Whether the 95 % interval, or the upper limit of what is not detectable, holds the truth."""
        c = self.found
        if not c.detected and c.upper_limit is not None:
            return self.truth <= c.upper_limit
        return c.interval[0] <= self.truth <= c.interval[1]


def demo_models() -> Mapping[str, Model]:
    """True model of each axis."""
    return {axis: parse_model(text, "gyro" if "gyro" in axis else "accel") for axis, text in _TRUTH.items()}


def demo_recording() -> Recording:
    """Recording of 25 minutes of a six-axis sensor at 100 Hz, always the same."""
    n = round(DURATION * RATE)
    return simulate_recording(demo_models(), n, RATE, _SEED, bias={"accel_z": 9.80665}, name="demo")


def compare(fit: Fit) -> list[TruthComparison]:
    """Comparisons of every coefficient of a fit of `demo_recording` with the truth."""
    models = demo_models()
    return [
        TruthComparison(c, models[result.axis.name].values.get(c.label) or 0.0)
        for result in fit.results
        if result.converged
        for c in result.coefficients.values()
    ]


def comparison_table(comparisons: Iterable[TruthComparison]) -> str:
    """Table of the comparisons for a terminal, each coefficient in its usual unit."""
    rows = []
    for comparison in comparisons:
        c = comparison.found.in_unit()
        truth = replace(comparison.found, value=comparison.truth).in_unit().value
        put_in = f"{plain(truth, 4)} {c.unit}" if truth else "nothing"
        rows.append(
            (c.axis.name, c.title, c.describe(), put_in, "inside" if comparison.inside else "OUTSIDE")
        )
    return text_table("found, and put in", ("axis", "coefficient", "found", "put in", "95 %"), rows)
