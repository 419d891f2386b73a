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

import jax
import jax.numpy as jnp
import numpy as np
import paths
from common.machine import describe
from common.report import publish, table
from scipy.fft import dct
from scipy.signal import lfilter

import allanjax as aj
from allanjax.estimate.spectral.columns import columns_of
from allanjax.estimate.spectral.components import ONE_POLE
from allanjax.estimate.spectral.levels import level_edges, levels_of, padded
from allanjax.estimate.spectral.model import (
    COLUMNS,
    COMPONENTS,
    FREQUENCIES,
    MARKOVS,
    OSCILLATORS,
    PARAMETERS,
    QUALITIES,
    RESPONSE,
    parameters,
    power_scales,
    slots_of,
)
from allanjax.estimate.spectral.scoring import covariance, maximize

RATE, SAMPLES = 100.0, 200_000
N, K, BANDWIDTH = 1e-3, 2e-5, 15.0
FINER = 8
TERMS = (aj.AngleRandomWalk(), aj.RateRandomWalk())
WAVE = COLUMNS + MARKOVS
# Largest factor, in ln, by which the powers are off at the start.
SPREAD = 2.0


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


class Outcome(NamedTuple):
    """Standardized errors of the parameters, whether it converged, steps, milliseconds."""

    scores: np.ndarray
    converged: bool
    steps: int
    milliseconds: float


def fitted(waves: tuple[Wave, ...], seed: int) -> Outcome:
    x = record(waves, seed)
    widths = tuple((w.frequency / RATE, w.frequency / w.quality / RATE) for w in waves)
    edges = level_edges(SAMPLES, widths)
    size = np.diff(edges)
    squares = np.add.reduceat(dct(x - x.mean(), norm="ortho")[1:] ** 2, edges[:-1] - 1)
    columns = columns_of(TERMS, edges, SAMPLES, RATE)
    levels = levels_of(squares / size, size.astype(float), edges, SAMPLES, columns)
    power = np.zeros(COMPONENTS)
    power[:2] = N**2, K**2
    power[WAVE : WAVE + len(waves)] = [w.rms**2 for w in waves]
    angles, qualities = np.ones(OSCILLATORS), np.full(OSCILLATORS, 5.0)
    angles[: len(waves)] = [2.0 * np.pi * w.frequency / RATE for w in waves]
    qualities[: len(waves)] = [w.quality for w in waves]
    pole = np.array([2.0 * np.pi * BANDWIDTH / RATE, 1.0])
    shapes = np.full(MARKOVS, 100.0), angles, qualities, pole
    free = np.zeros(PARAMETERS, bool)
    free[:COMPONENTS] = power > 0.0
    for first in (FREQUENCIES, QUALITIES):
        free[first : first + len(waves)] = True
    free[RESPONSE] = True
    inside = np.zeros(COMPONENTS, bool)
    inside[:2] = True
    inside[WAVE : WAVE + len(waves)] = [w.inside for w in waves]
    ones = np.ones(COMPONENTS)
    slots = slots_of(ones, free, inside, ONE_POLE)
    smooth = np.convolve(squares, np.ones(7), "same") / np.convolve(size, np.ones(7), "same")
    scale = np.asarray(
        power_scales(jnp.asarray(parameters(ones, ones, *shapes)), slots, levels, padded(smooth, 1.0))
    )
    slots = slots._replace(scale=scale)
    truth = parameters(power, scale, *shapes)
    away = np.exp(np.random.default_rng(seed).uniform(-SPREAD, SPREAD, COMPONENTS))
    start = jnp.asarray(parameters(power * away, scale, *shapes))
    begun = time.perf_counter()
    found = jax.block_until_ready(maximize(start, slots, levels))
    taken = 1e3 * (time.perf_counter() - begun)
    error = np.sqrt(np.diag(np.asarray(covariance(found))))
    with np.errstate(divide="ignore"):
        scores = (np.asarray(found.theta) - truth)[free] / error[free]
    return Outcome(scores, bool(found.converged), int(found.steps), taken)


def names(waves: tuple[Wave, ...]) -> list[str]:
    """Names of the free parameters in their order."""
    each = [f" at {w.frequency:g} Hz" if len(waves) > 1 else "" for w in waves]
    return ["N²", "K²", *(f"{p}{of}" for p in ("σ²", "f0", "Q") for of in each), "f_c"]


HEAD = ["parameter", "records with it", "mean of z", "its error", "sd of z", "z within ±1.96", "farthest z"]


def section(name: str, waves: tuple[Wave, ...], seeds: int, first: int) -> str:
    outcomes = [fitted(waves, first + k) for k in range(seeds)]
    scores = np.array([o.scores for o in outcomes])
    # A power that the data do not call for is zero: it has a limit, and no error.
    seen = np.isfinite(scores)
    rows = [
        [
            label,
            f"{z.size}",
            f"{z.mean():+.2f}",
            f"{z.std(ddof=1) / np.sqrt(z.size):.2f}",
            f"{z.std(ddof=1):.2f}",
            f"{np.mean(abs(z) < 1.96):.2f}",
            f"{abs(z).max():.1f}",
        ]
        for label, z in zip(names(waves), (x[k] for x, k in zip(scores.T, seen.T, strict=True)), strict=True)
    ]
    steps = [o.steps for o in outcomes]
    # The first fit compiles.
    taken = np.median([o.milliseconds for o in outcomes[1:]])
    converged = sum(o.converged for o in outcomes)
    return "\n".join(
        [
            f"## {name.capitalize()}: {seeds} records",
            "",
            table(HEAD, rows),
            "",
            f"Converged: {converged} of {seeds}, in {min(steps)} to {max(steps)} steps, {np.mean(steps):.0f} "
            f"on average; a fit takes {taken:.0f} ms (median).",
            "",
        ]
    )


INTRODUCTION = """# The joint spectral model with its structure given

{machine}

White noise (10⁻³ rad/s/√Hz) and a rate random walk (2·10⁻⁵ rad/s/√s), 200,000 samples at 100 Hz, through a
pole at 15 Hz; resonances after it or inside. Starts: powers off by up to e^±2, each its own factor. z is the
error of a parameter's logarithm over its standard deviation from Fisher's information. No seed was used for
anything else. Reproduce with `python benchmarks/studies/joint_model.py`.
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=100, help="records of each case")
    parser.add_argument("--first", type=int, default=90_000, help="the first seed")
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
