"""Other people's ways from a record to noise coefficients, run as their users would."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import least_squares

from benchmarks.common.truth import T0, Case, allan_shape

# Names of the terms in allan-variance; its users have flicker for everything between white noise and walk.
EFFECTS = {"Q": "quantization", "N": "white", "B": "flicker", "q": "flicker", "K": "walk"}


def by_allan_variance(case: Case, x: np.ndarray) -> np.ndarray:
    """allan-variance: its `compute_avar` and `estimate_parameters` as they come."""
    from allan_variance import compute_avar, estimate_parameters

    tau, variance = compute_avar(x, T0)
    effects = [EFFECTS[c] for c in case.amplitudes]
    table, _ = estimate_parameters(tau, variance, effects)
    missing = np.full(x.shape[1], np.nan)
    columns = [missing if c in "qT" else table[EFFECTS[c]].to_numpy() for c in case.truth]
    return np.stack(columns, axis=1)


def by_log_log(case: Case, x: np.ndarray, longest: float = 0.5) -> np.ndarray:
    """Unweighted least squares of ln σ(T), four cluster times an octave, started at the truth."""
    n = len(x)
    sizes = np.unique(np.rint(2.0 ** (np.arange(4 * int(np.log2(n)) - 3) / 4.0)).astype(int))
    sizes = sizes[sizes <= longest * n]
    phase = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(x, axis=0)]) * T0
    T = sizes * T0
    variances = [np.mean((phase[2 * m :] - 2 * phase[m:-m] + phase[: -2 * m]) ** 2, axis=0) for m in sizes]
    target = 0.5 * np.log(np.array(variances) / (2.0 * T[:, None] ** 2))
    start = np.log(list(case.truth.values()))

    def curve(p: np.ndarray) -> np.ndarray:
        value = dict(zip(case.truth, np.exp(p), strict=True))
        total = [value[c] ** 2 * allan_shape(c, T, value.get("T", 1.0)) for c in case.amplitudes]
        return 0.5 * np.log(sum(total))

    bounds = (start - 9.0, start + 9.0)
    found = [least_squares(lambda p, y=y: curve(p) - y, start, bounds=bounds).x for y in target.T]
    return np.exp(found)


PEERS: dict[str, Callable[[Case, np.ndarray], np.ndarray]] = {
    "allan-variance": by_allan_variance,
    "log-log": by_log_log,
    "log-log, to n/10": lambda case, x: by_log_log(case, x, 0.1),
}
