"""Fixed composite sensors: one gyro whose noise passes one pole, with resonances behind it or inside."""

from __future__ import annotations

import time

import numpy as np

import allanjax as aj
from benchmarks.common import composite_noise as physical
from benchmarks.common.composite_judge import CLUSTERS, cluster_sizes, deviation, explained, overlapping, told

RATE, SAMPLES, LONGEST = 100.0, 200_000, 30.0
N_TRUE, K_TRUE, SIGMA = 1e-3, 2e-5, 2e-3
POLE = physical.Filter("one pole", 15.0, 1, RATE)
CASES: dict[str, tuple[physical.Resonance, ...]] = {
    "resonance behind the filter": (physical.Resonance(20.0, 15.0, RATE),),
    "resonance inside the filter": (physical.Resonance(20.0, 15.0, RATE, POLE),),
    "two resonances behind the filter": (
        physical.Resonance(20.0, 15.0, RATE),
        physical.Resonance(35.0, 6.0, RATE),
    ),
}


def case_record(name: str, seed: int) -> np.ndarray:
    rng = np.random.default_rng([seed, list(CASES).index(name)])
    x = N_TRUE * POLE.white(rng, SAMPLES) + K_TRUE * POLE.slow(physical.walk(rng, SAMPLES, RATE))
    return x + SIGMA * np.sum([r.draw(rng, SAMPLES) for r in CASES[name]], axis=0)


def case_deviation(name: str, sizes: np.ndarray) -> np.ndarray:
    """Expected Allan deviation, by the integral of the spectrum."""
    bins = 2**19
    f = (np.arange(bins) + 0.5) * RATE / 2.0 / bins
    power = N_TRUE**2 * POLE.white_spectrum(f) + K_TRUE**2 * POLE.power(f) * physical.walk_spectrum(f, RATE)
    power += SIGMA**2 * np.sum([r.spectrum(f) for r in CASES[name]], axis=0)
    w = np.pi * f / RATE
    return np.sqrt([2.0 * np.mean(power * np.sin(m * w) ** 4 / (m * np.sin(w)) ** 2) for m in sizes])


def case(name: str, seed: int) -> list[str]:
    """A row: errors of the Allan deviation and of N, the findings."""
    aj.enable_compilation_cache()
    record = case_record(name, seed)
    recording = aj.Recording.from_array(record[:, None], RATE, names=["gyro_z"], gyro_unit="rad/s")
    begun = time.perf_counter()
    critique = aj.critique(recording)
    seconds = time.perf_counter() - begun
    x, model = explained(critique, "gyro_z", record)
    sizes = cluster_sizes(int(LONGEST * RATE))
    ours = deviation(model, sizes / RATE)
    error = np.abs(ours / case_deviation(name, sizes) - 1.0)
    many = sizes <= len(x) // CLUSTERS
    beside = np.max(np.abs(ours[many] / overlapping(x, sizes[many]) - 1.0))
    N_seen = N_TRUE * np.sqrt(POLE.white_spectrum(np.zeros(1))[0] / RATE)
    N = model.values.get("angle_random_walk") or np.nan
    planted = 1 + len(CASES[name])
    worst = int(np.argmax(error))
    return [
        name,
        f"{100.0 * error[worst]:.1f} % at {sizes[worst] / RATE:.2g} s",
        f"{100.0 * beside:.1f} %",
        f"{100.0 * (float(N) / N_seen - 1.0):+.1f} %",
        f"{len(told(critique))} of {planted}",
        ", ".join(f.cause for f in told(critique)),
        f"{seconds:.0f}",
    ]
