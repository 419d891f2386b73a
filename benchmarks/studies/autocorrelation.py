"""Gauss-Markov parameters read off the autocorrelation, as the thesis does, against maximum likelihood.

    python benchmarks/studies/autocorrelation.py [--records 300] [--n 7200] [--seed 7300] [--results PATH]

Records of a Gauss-Markov process and white noise are simulated by the benchmark's own simulator (truth.py).
By the thesis's method (section 3.4.1) white noise is taken out first, by a wavelet approximation, then σ² is
the autocorrelation at lag zero and 1/β the lag at which it has fallen to 1/e. The level is the one that
`denoise` gives for the true model: the method is not blamed for a bad level.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import paths

import allanjax as aj
from benchmarks.common.machine import describe
from benchmarks.common.ours import fit_all, model_of, recording_of
from benchmarks.common.report import publish, share, table
from benchmarks.common.truth import RATE, Case, simulate

# σ² = q²T/2 is 1, and the white noise's variance, 100 N² at 100 Hz, is so many times that.
WHITE = 9.0
TIMES = (60, 350)


def case_of(samples: int) -> Case:
    """A Gauss-Markov process of σ² = 1 and this correlation time in samples, in white noise."""
    T = samples / RATE
    truth = {"N": np.sqrt(WHITE / RATE), "q": np.sqrt(2.0 / T), "T": T}
    return Case(f"1/β = {samples} samples", truth)


def by_autocorrelation(x: np.ndarray, case: Case) -> tuple[np.ndarray, np.ndarray, int]:
    """Values and standard errors [records, 2] of σ² and 1/β, NaN without a reading, and the level."""
    N, q, T = case.truth.values()
    model = aj.AngleRandomWalk(N) + aj.Markov(q, T)
    recording = recording_of(x)
    level = aj.denoise(recording_of(x[:, :1]), model).results[0].level
    smooth = aj.wavelet_decomposition(recording).approximation(level)
    found = aj.autocorrelation(smooth, longest_lag=len(x) / RATE / 2.0).markov()
    nothing = (np.nan, np.nan)
    rows = [
        [nothing if e is None else (e.value, e.std) for e in axis.estimates.values()]
        for axis in found.results
    ]
    values, errors = np.moveaxis(np.array(rows), 2, 0)
    return values, errors, level


def by_likelihood(x: np.ndarray, case: Case) -> tuple[np.ndarray, np.ndarray]:
    """Values and whether the 95 % interval has the truth, [records, 2]: 1/β, and σ² = q²T/2 without one."""
    axes, _ = fit_all(recording_of(x), model_of(case.truth), "whittle")
    rows, inside = [], []
    for axis in axes:
        if axis is None:
            rows.append((np.nan, np.nan))
            inside.append(np.nan)
            continue
        q, T = axis["markov_amplitude"], axis["markov_correlation_time"]
        rows.append((q.value**2 * T.value / 2.0, T.value))
        inside.append(float(T.interval[0] <= case.truth["T"] <= T.interval[1]))
    return np.array(rows), np.array(inside)


def relative(values: np.ndarray, truth: float) -> str:
    """Median, bias and RMSE of values relative to the truth, in per cent."""
    error = 100.0 * (values[np.isfinite(values)] / truth - 1.0)
    return f"{np.median(error):+.1f}, {error.mean():+.1f}, {np.sqrt(np.mean(error**2)):.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--records", type=int, default=300)
    parser.add_argument("--n", type=int, default=7200)
    parser.add_argument("--seed", type=int, default=7300)
    parser.add_argument("--results", type=Path, default=paths.RESULTS / "autocorrelation.md")
    options = parser.parse_args()
    rows = []
    for k, samples in enumerate(TIMES):
        case = case_of(samples)
        x = simulate(case, options.n, options.records, np.random.default_rng(options.seed + k))
        read, error, level = by_autocorrelation(x, case)
        fitted, inside = by_likelihood(x, case)
        accuracy = 100.0 * np.sqrt(2.0 * samples / options.n)
        for i, (name, truth) in enumerate((("σ²", 1.0), ("1/β", case.truth["T"]))):
            there = np.isfinite(read[:, i])
            covers = abs(read[there, i] - truth) <= 1.96 * error[there, i]
            good = np.isfinite(fitted[:, i])
            rows.append(
                [
                    f"{case.name}, level {level}" if not i else "",
                    name,
                    f"{accuracy:.1f}",
                    relative(read[:, i], truth),
                    f"{share(covers)} of {there.sum()}",
                    relative(fitted[:, i], truth),
                    f"{share(inside[good])} of {good.sum()}" if i else f"of {good.sum()}",
                ]
            )
    head = ["process", "", "(3.34) [%]", "autocorrelation: median, bias, RMSE [%]", "± 1.96 (3.34) covers"]
    head += ["likelihood: median, bias, RMSE [%]", "95 % interval covers"]
    text = (
        f"# Autocorrelation against maximum likelihood\n\n{options.records} records of {options.n:,} "
        f"samples, seeds {options.seed} and following: a Gauss-Markov process in white noise of {WHITE:g} "
        "times its variance. The thesis's method with the level by the true model (`denoise`), "
        '`autocorrelation(decomposition.approximation(level)).markov()`, and `fit(…, "N + markov", '
        'objective="whittle")`, on the same records. Errors are relative to the truth.\n\n'
        f"{table(head, rows)}\n\nThe likelihood has no interval of σ² itself, which is q_c²T_c/2.\n\n"
        f"## Machine\n\n{describe()}\n"
    )
    publish(text, options.results)


if __name__ == "__main__":
    main()
