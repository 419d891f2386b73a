"""Other people's ways from a record to noise coefficients, run as their users would."""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Callable

import matplotlib
import numpy as np
from scipy.optimize import least_squares

from benchmarks.common.truth import T0, Case, allan_shape

matplotlib.use("Agg")

# Names of the terms in allan-variance; its users have flicker for everything between white noise and walk.
EFFECTS = {"Q": "quantization", "N": "white", "B": "flicker", "q": "flicker", "K": "walk"}
SLOPES = {"Q": -2, "N": -1, "K": 1}


def by_allan_variance(case: Case, x: np.ndarray) -> np.ndarray:
    """allan-variance: its `compute_avar` and `estimate_parameters` as they come."""
    from allan_variance import compute_avar, estimate_parameters

    tau, variance = compute_avar(x, T0)
    effects = [EFFECTS[c] for c in case.amplitudes]
    table, _ = estimate_parameters(tau, variance, effects)
    missing = np.full(x.shape[1], np.nan)
    columns = [missing if c in "qT" else table[EFFECTS[c]].to_numpy() for c in case.truth]
    return np.stack(columns, axis=1)


def by_avar(case: Case, x: np.ndarray, longest: float = 0.5) -> np.ndarray:
    """avar: its `windows` and `variance`, and its interactive `fit` with the key "o" pressed.

    Components start at the true values; it optimizes magnitudes only, so T_c stays at the truth.
    """
    if "B" in case.truth:
        return np.full((x.shape[1], len(case.truth)), np.nan)
    import avar
    from matplotlib import pyplot as plt
    from matplotlib.backend_bases import KeyEvent

    sizes = avar.windows(len(x))
    sizes = sizes[sizes <= longest * len(x)]
    ks = [
        [0, case.truth["q"] ** 2 * case.truth["T"] / 2.0, case.truth["T"]]
        if c == "q"
        else [SLOPES[c], case.truth[c] ** 2]
        for c in case.amplitudes
    ]
    rows = []
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        variances = avar.variance(np.ascontiguousarray(x.T), sizes)
        for variance in variances:
            figure = plt.figure(figsize=(0.5, 0.5), dpi=20)
            panel = avar.fit(sizes * T0, variance, T=T0, ks=ks, ax=figure.add_subplot())
            canvas = figure.canvas
            canvas.draw = lambda: None  # nobody looks
            canvas.callbacks.process("key_press_event", KeyEvent("key_press_event", canvas, "o"))
            found = dict(zip(case.amplitudes, (k[1] for k in panel.ks), strict=True))
            if "q" in found:
                found["q"] *= 2.0 / case.truth["T"]
            rows.append([np.nan if c == "T" else np.sqrt(found[c]) for c in case.truth])
            plt.close(figure)
    return np.array(rows)


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
    "avar": by_avar,
    "avar, to n/10": lambda case, x: by_avar(case, x, 0.1),
    "log-log": by_log_log,
    "log-log, to n/10": lambda case, x: by_log_log(case, x, 0.1),
}
