"""Does the joint spectral model recover a filtered sensor with resonances, its structure being given?

    python benchmarks/studies/joint_model.py [--seeds 100] [--quick] [--results PATH]

White noise of 10⁻³ rad/s/√Hz and a rate random walk of 2·10⁻⁵ rad/s/√s at 100 Hz, 200,000 samples, through a
digital filter of one pole at 15 Hz; a resonance at 20 Hz (Q 15) is added after it, or passes through it, or
another one at 35 Hz (Q 6) is added, too. The simulator is NumPy's and SciPy's: white noise, sums of it, a
recursive filter, and oscillators by their transfer function at eight times the rate, of which each eighth
sample is kept.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import paths
from scipy.signal import lfilter

import allanjax as aj
from benchmarks.common.machine import describe
from benchmarks.common.report import publish, table

RATE, SAMPLES = 100.0, 200_000
N, K, BANDWIDTH = 1e-3, 2e-5, 15.0
FINER = 8
# Cluster times up to this one are compared; beyond, a record's own scatter is all there is.
SHORT = 1.0


class Wave(NamedTuple):
    """A resonance: frequency [Hz], quality factor, rms [rad/s], and whether the filter comes after it."""

    frequency: float
    quality: float
    rms: float
    inside: bool


CASES = {
    "resonance after the filter": (Wave(20.0, 15.0, 5e-3, False),),
    "resonance inside": (Wave(20.0, 15.0, 5e-3, True),),
    "two resonances after it": (Wave(20.0, 15.0, 5e-3, False), Wave(35.0, 6.0, 3e-3, False)),
}


def oscillation(wave: Wave, rng: np.random.Generator) -> np.ndarray:
    """Stationary noise of a damped oscillator at the instants of the samples."""
    n = SAMPLES * FINER
    f = np.fft.rfftfreq(n, 1.0 / (RATE * FINER)) / wave.frequency
    response = 1.0 / (1.0 - f**2 + 1j * f / wave.quality)
    x = np.fft.irfft(np.fft.rfft(rng.standard_normal(n)) * response, n)
    # Its variance is π·f0·Q·S/2 for white noise of one-sided density S = 2/rate.
    variance = np.pi * wave.frequency * wave.quality / (RATE * FINER)
    return wave.rms * x[::FINER] / np.sqrt(variance)


def record(waves: tuple[Wave, ...], seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    h = 1.0 / RATE
    white = N / np.sqrt(h) * rng.standard_normal(SAMPLES)
    steps, bridges = rng.standard_normal((2, SAMPLES)) * np.sqrt(h)
    # Means of a Brownian path over the sample interval.
    walk = K * (np.cumsum(steps) - steps / 2.0 + bridges / np.sqrt(12.0))
    drawn = [oscillation(wave, rng) for wave in waves]
    inside = white + walk + sum(x for x, wave in zip(drawn, waves, strict=True) if wave.inside)
    w = np.exp(-2.0 * np.pi * BANDWIDTH / RATE)
    after = sum(x for x, wave in zip(drawn, waves, strict=True) if not wave.inside)
    return lfilter([1.0 - w], [1.0, -w], inside) + after


def model_of(waves: tuple[Wave, ...]) -> aj.Model:
    """The true structure; of two resonances each has a start for its frequency, four per cent off."""
    drawn = [
        (aj.Resonance(frequency=1.04 * wave.frequency) if len(waves) > 1 else aj.Resonance(), wave.inside)
        for wave in waves
    ]
    inside = aj.AngleRandomWalk() + aj.RateRandomWalk()
    model = aj.LowPass1() * (inside if not drawn[0][1] else inside + drawn[0][0])
    for term, passes in drawn:
        model = model if passes else model + term
    return model


def truth_of(waves: tuple[Wave, ...]) -> dict[str, float]:
    """True value of each coefficient by its label."""
    truth = {"angle_random_walk": N, "rate_random_walk": K}
    for k, wave in enumerate(waves, 1):
        label = "resonance" if len(waves) == 1 else f"resonance_{k}"
        truth |= {f"{label}_amplitude": wave.rms, f"{label}_frequency": wave.frequency}
        truth[f"{label}_quality_factor"] = wave.quality
    return truth | {"low_pass1_bandwidth": BANDWIDTH}


class Outcome(NamedTuple):
    """Of one record: errors over standard deviations, whether the 95 % intervals hold the truth, whether it

    converged, the largest deviation of the fitted Allan deviation from the measured one up to a second, and
    the seconds that it took.
    """

    scores: dict[str, float]
    covered: dict[str, bool]
    converged: bool
    deviation: float
    seconds: float


def fitted(waves: tuple[Wave, ...], seed: int) -> Outcome:
    x = record(waves, seed)
    recording = aj.Recording.from_array(x[:, None], RATE, gyro_unit="rad/s", names=["gyro_x"])
    begun = time.perf_counter()
    fit = aj.fit(recording, model_of(waves), objective="whittle", as_is=True)
    taken = time.perf_counter() - begun
    (result,) = fit.results
    if not result.converged:
        return Outcome({}, {}, False, np.nan, taken)
    truth = truth_of(waves)
    found = {label: result[label] for label in truth}
    scores = {label: (c.value - truth[label]) / c.std for label, c in found.items() if c.std > 0.0}
    covered = {label: c.interval[0] <= truth[label] <= c.interval[1] for label, c in found.items()}
    curve = fit.curve
    ratio = curve.deviation[:, 0] / fit.model_deviation("gyro_x", curve.cluster_time)
    off = abs(np.log(ratio[curve.cluster_time <= SHORT])).max()
    return Outcome(scores, covered, True, float(off), taken)


HEAD = ["parameter", "records with it", "mean of z", "its error", "sd of z", "intervals with the truth"]


def section(name: str, waves: tuple[Wave, ...], seeds: int, first: int) -> str:
    outcomes = [fitted(waves, first + k) for k in range(seeds)]
    good = [o for o in outcomes if o.converged]
    rows = []
    for label in truth_of(waves):
        # A power that the data do not call for is zero: it has a limit, and no error.
        z = np.array([o.scores[label] for o in good if label in o.scores])
        rows.append(
            [
                label.replace("_", " "),
                f"{z.size}",
                f"{z.mean():+.2f}",
                f"{z.std(ddof=1) / np.sqrt(z.size):.2f}",
                f"{z.std(ddof=1):.2f}",
                f"{np.mean([o.covered[label] for o in good]):.2f}",
            ]
        )
    off = [o.deviation for o in good]
    # The first fit compiles.
    taken = np.median([o.seconds for o in outcomes[1:]])
    return "\n".join(
        [
            f"## {name.capitalize()}: {seeds} records",
            "",
            table(HEAD, rows),
            "",
            f"Converged: {len(good)} of {seeds}; a fit takes {taken:.2f} s (median). Up to {SHORT:g} s the "
            f"model's Allan deviation is off by at most {100.0 * np.median(off):.1f} % (median), "
            f"{100.0 * max(off):.1f} % (the worst).",
            "",
        ]
    )


INTRODUCTION = """# The joint spectral model with its structure given

{machine}

White noise (10⁻³ rad/s/√Hz) and a rate random walk (2·10⁻⁵ rad/s/√s), 200,000 samples at 100 Hz, through a
pole at 15 Hz; resonances after it or inside. The model has the true structure, and no start but for the
frequencies of two resonances. z is the error of a coefficient over its standard deviation; the intervals are
those of 95 % that `fit(objective="whittle")` gives. No seed was used for anything else. Reproduce with
`python benchmarks/studies/joint_model.py`.
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=100, help="records of each case")
    parser.add_argument("--first", type=int, default=190_000, help="the first seed")
    parser.add_argument("--quick", action="store_true", help="three records of each")
    parser.add_argument("--results", type=Path, default=paths.RESULTS / "joint_model.md")
    arguments = parser.parse_args()
    seeds = 3 if arguments.quick else arguments.seeds
    parts = [INTRODUCTION.format(machine=describe())]
    cases = enumerate(CASES.items())
    parts += [section(name, waves, seeds, arguments.first + 1000 * k) for k, (name, waves) in cases]
    publish("\n".join(parts), arguments.results, arguments.quick)


if __name__ == "__main__":
    main()
