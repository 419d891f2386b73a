"""What Whittle's likelihood and the posterior cost, against the length of the record.

    python benchmarks/studies/likelihood_speed.py [--lengths 10000,1000000,10000000] [--results PATH]

One axis of N + B + K at 100 Hz. Times are the least of several runs, after compilation; the first column of
times is one pass over the record (`np.sum`), to compare with.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import paths

import allanjax as aj
from allanjax.posterior.likelihood import likelihood_of
from allanjax.spectrum.cosine import cosine_transform
from benchmarks.common.machine import describe
from benchmarks.common.report import publish, table

MODEL = aj.AngleRandomWalk() + aj.BiasInstability() + aj.RateRandomWalk()
TRUTH = aj.AngleRandomWalk(1e-4) + aj.BiasInstability(1e-5) + aj.RateRandomWalk(1e-6)
WALKERS = 16


def seconds(run: Callable[[], object], repeats: int = 3) -> float:
    """The least time of several runs, after one that compiles."""
    run()
    taken = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        taken.append(time.perf_counter() - start)
    return min(taken)


@eqx.filter_jit
def many(log_likelihood: Callable, values: jax.Array) -> jax.Array:
    return jax.vmap(log_likelihood)(values)


def row(n: int) -> list[str]:
    x = np.asarray(aj.simulate(TRUTH, n, 100.0, 1))
    recording = aj.Recording(x[:, None], 100.0, (aj.Axis("gyro_x", "gyro", "rad/s"),))
    fit = aj.fit(recording, MODEL, "whittle")
    log_likelihood = likelihood_of(fit, "gyro_x")
    values = jnp.asarray(np.tile(log_likelihood.start, (WALKERS, 1)))
    times = [
        seconds(lambda: np.sum(x)),
        seconds(lambda: cosine_transform(x)),
        seconds(lambda: aj.fit(recording, MODEL, "whittle"), 2),
        seconds(lambda: aj.fit(recording, MODEL, "allan"), 2),
        seconds(lambda: many(log_likelihood, values).block_until_ready(), 20),
        seconds(lambda: aj.sample(fit, progress=False), 2),
    ]
    posterior = aj.sample(fit, progress=False)["gyro_x"]
    return [f"{n:,}", *(f"{1e3 * t:.3g}" for t in times), "yes" if posterior.converged else "no"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    results = paths.RESULTS / "likelihood_speed.md"
    parser.add_argument("--lengths", default="10000,1000000,10000000")
    parser.add_argument("--results", type=Path, default=results)
    arguments = parser.parse_args()
    head = ["samples", "np.sum", "cosine transform", "Whittle fit", "Allan fit"]
    head += [f"likelihood of {WALKERS} walkers", "posterior", "converged"]
    text = "\n".join(
        [
            "# Cost of Whittle's likelihood and of the posterior",
            "",
            describe(),
            "",
            "Milliseconds, one axis, N + B + K, after compilation. Both fits include the Allan deviation at",
            "four cluster times an octave.",
            "",
            table(head, [row(int(n)) for n in arguments.lengths.split(",")]),
            "",
        ]
    )
    publish(text, arguments.results)


if __name__ == "__main__":
    main()
