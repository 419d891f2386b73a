"""Accuracy of the coefficients: allanjax, its peers and a plain log-log fit against the Cramér-Rao bound.

    python benchmarks/accuracy.py [--quick] [--cases N+K,Q+N+K] [--records 400] [--results PATH]

Simulated records of known noise are given to each fitter. Nothing that generates or judges them comes from
allanjax: the simulator, the generalized covariances and the bound are written here in NumPy. Coefficients are
in units of N (all fitters are equivariant to scale), times in seconds.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import matplotlib
import numpy as np
from machine import describe
from scipy.linalg import cho_factor, cho_solve, toeplitz
from scipy.optimize import least_squares
from scipy.signal import lfilter

import allanjax as aj

matplotlib.use("Agg")

RATE = 100.0
T0 = 1.0 / RATE
CHUNK = 50
FULL_BLOCK = 128

TERMS = {
    "Q": aj.Quantization(),
    "N": aj.AngleRandomWalk(),
    "B": aj.BiasInstability(),
    "q": aj.Markov(),
    "K": aj.RateRandomWalk(),
}
LABELS = {
    "Q": "quantization",
    "N": "angle_random_walk",
    "B": "bias_instability",
    "q": "markov_amplitude",
    "T": "markov_correlation_time",
    "K": "rate_random_walk",
    "R": "drift_ramp",
}
BASIC = "QNBKR"
SHOWN = {"q": "q_c", "T": "T_c"}
# Names of the terms in allan-variance; its users have flicker for everything between white noise and walk.
EFFECTS = {"Q": "quantization", "N": "white", "B": "flicker", "q": "flicker", "K": "walk"}
SLOPES = {"Q": -2, "N": -1, "K": 1}


@dataclass(frozen=True)
class Case:
    """A true model: coefficients by symbol (T is the Markov correlation time), in units of N and s."""

    name: str
    truth: dict[str, float]

    @property
    def amplitudes(self) -> list[str]:
        return [c for c in self.truth if c != "T"]

    @property
    def model(self) -> aj.Model:
        return aj.Model(tuple(TERMS[c] for c in self.amplitudes))


CASES = (
    Case("N+K", {"N": 1.0, "K": 2.0}),
    Case("Q+N+K", {"Q": 0.1, "N": 1.0, "K": 2.0}),
    Case("N+B", {"N": 1.0, "B": 2.0}),
    Case("N+B+K", {"N": 1.0, "B": 3.0, "K": 5.0}),
    Case("N+Markov+K", {"N": 1.0, "q": 40.0, "T": 0.1, "K": 6.0}),
)


# --- The noise: covariances, Allan variances and records, independent of the package -----------------------


def covariance_shape(symbol: str, n: int, correlation_time: float) -> np.ndarray:
    """Generalized covariance H(k) of the rate at lags 0 ... n-1 samples, unit coefficient, averaged samples.

    cov(Σ a_p x_p, Σ b_q x_q) = Σ Σ a_p b_q H(p - q) for all filters a, b without response to a constant.
    """
    k = np.arange(n, dtype=float)
    H = np.zeros(n)
    if symbol == "Q":
        H[:2] = 2.0 * RATE**2, -(RATE**2)
    elif symbol == "N":
        H[0] = RATE
    elif symbol == "K":
        H = -k * T0 / 2.0
        H[0] = -T0 / 6.0
    elif symbol == "B":
        # -(1/2π) times the second difference of k² ln k.
        far = k[2:]
        growing = (far + 1.0) ** 2 * np.log1p(1.0 / far) + (far - 1.0) ** 2 * np.log1p(-1.0 / far)
        H[2:] = -(2.0 * np.log(far) + growing) / (2.0 * np.pi)
        H[1] = -4.0 * np.log(2.0) / (2.0 * np.pi)
    elif symbol == "q":
        x = T0 / correlation_time
        H = np.expm1(-x) ** 2 * np.exp(-(k - 1.0) * x)
        H[0] = 2.0 * (x + np.expm1(-x))
        H *= correlation_time / 2.0 / x**2
    return H


def allan_shape(symbol: str, T: np.ndarray, correlation_time: float = 1.0) -> np.ndarray:
    """Allan variance with unit coefficient (Hou 2004, 4.29 to 4.60)."""
    x = T / correlation_time
    return {
        "Q": 3.0 / T**2,
        "N": 1.0 / T,
        "B": np.full_like(T, 2.0 * np.log(2.0) / np.pi),
        "K": T / 3.0,
        "q": correlation_time**2 / T * (1.0 - (3.0 - 4.0 * np.exp(-x) + np.exp(-2.0 * x)) / (2.0 * x)),
    }[symbol]


def simulate(case: Case, n: int, records: int, rng: np.random.Generator) -> np.ndarray:
    """Records [n, records]: samples are means over their intervals, all terms exact in law.

    (Markov but for terms of order (t0/T_c)² in the scatter of the mean between two states.)
    """
    x = np.zeros((n, records))
    for symbol in case.amplitudes:
        c = case.truth[symbol]
        if symbol == "N":
            x += c * np.sqrt(RATE) * rng.standard_normal((n, records))
        elif symbol == "Q":
            x += c * RATE * np.diff(rng.standard_normal((n + 1, records)), axis=0)
        elif symbol == "K":
            # The mean of a Brownian path between two ends: their mean, and the area of the bridge.
            step = rng.standard_normal((n, records)) * np.sqrt(T0)
            bridge = rng.standard_normal((n, records)) * np.sqrt(T0 / 12.0)
            x += c * (np.cumsum(step, axis=0) - step / 2.0 + bridge)
        elif symbol == "q":
            sigma = c * np.sqrt(case.truth["T"] / 2.0)
            decay = np.exp(-T0 / case.truth["T"])
            drive = sigma * np.sqrt(1.0 - decay**2) * rng.standard_normal((n + 1, records))
            drive[0] /= np.sqrt(1.0 - decay**2)
            state = lfilter([1.0], [1.0, -decay], drive, axis=0)
            x += (state[1:] + state[:-1]) / 2.0
            x += c * np.sqrt(T0 / 12.0) * rng.standard_normal((n, records))
        elif symbol == "B":
            # Increments by circulant embedding (Davies & Harte 1987).
            H = covariance_shape("B", n + 2, 1.0)
            H = np.concatenate([H[1:2], H])
            gamma = c**2 * (2.0 * H[1:-1] - H[2:] - H[:-2])
            power = np.fft.rfft(np.concatenate([gamma, gamma[-2:0:-1]])).real
            assert power.min() > -1e-9 * power.max()
            size = 2 * (len(gamma) - 1)
            noise = np.fft.rfft(rng.standard_normal((size, records)), axis=0)
            increments = np.fft.irfft(np.sqrt(np.maximum(power, 0.0))[:, None] * noise, size, axis=0)
            x += np.cumsum(increments[:n], axis=0)
    return x


# --- The Cramér-Rao bound ----------------------------------------------------------------------------------


def derivatives(case: Case, n: int) -> tuple[np.ndarray, np.ndarray]:
    """H [n] of the record, and its derivatives [params, n] by the coefficients."""
    Tc = case.truth.get("T", 1.0)
    shapes = {c: covariance_shape(c, n, Tc) for c in case.amplitudes}
    total = sum(case.truth[c] ** 2 * shapes[c] for c in case.amplitudes)
    by = []
    for c in case.truth:
        if c == "T":
            h = 1e-4 * Tc
            change = covariance_shape("q", n, Tc + h) - covariance_shape("q", n, Tc - h)
            by.append(case.truth["q"] ** 2 * change / (2.0 * h))
        else:
            by.append(2.0 * case.truth[c] * shapes[c])
    return total, np.array(by)


def exact_bound(case: Case, n: int) -> np.ndarray:
    """Cramér-Rao standard deviations from ½ tr(C⁻¹C_i C⁻¹C_j) of the n - 1 differenced rates."""

    def differenced(H: np.ndarray) -> np.ndarray:
        H = np.concatenate([H[1:2], H])
        return toeplitz(2.0 * H[1:-1] - H[2:] - H[:-2])

    H, by = derivatives(case, n)
    factor = cho_factor(differenced(H))
    return _bound([cho_solve(factor, differenced(d)) for d in by])


def bound(case: Case, n: int, block: int = FULL_BLOCK) -> np.ndarray:
    """The same for long records, in the basis of cosines (DCT-II without its constant).

    Cosines have no response to a constant rate, so the unknown bias is profiled out, and unlike the Fourier
    basis of the differenced record they leak little: random walk plus white noise is diagonal in them but for
    the averaging. The lowest `block` coefficients are taken with their full covariance, the others as if
    independent, with their exact variances.
    """
    H, by = derivatives(case, n)
    block = min(block, n - 1)
    low, low_by = _cosine_block(H, block), [_cosine_block(d, block) for d in by]
    factor = cho_factor(low)
    information = _information([cho_solve(factor, d) for d in low_by])
    S, S_by = _cosine_variances(H)[block:], np.array([_cosine_variances(d)[block:] for d in by])
    information += 0.5 * (S_by / S) @ (S_by / S).T
    return np.sqrt(np.diag(np.linalg.inv(information)))


def _information(products: list[np.ndarray]) -> np.ndarray:
    return np.array([[0.5 * np.sum(a * b.T) for b in products] for a in products])


def _bound(products: list[np.ndarray]) -> np.ndarray:
    return np.sqrt(np.diag(np.linalg.inv(_information(products))))


def _cosine_block(H: np.ndarray, block: int) -> np.ndarray:
    """Covariance of the cosine coefficients 1 ... block."""
    n = len(H)
    circle = np.fft.rfft(np.concatenate([H, [0.0], H[:0:-1]]))
    j = np.arange(1, block + 1)[:, None]
    A = np.sqrt(2.0 / n) * np.cos(np.pi * j * (np.arange(n) + 0.5) / n)
    product = np.empty((block, block))
    for i in range(0, block, 128):
        rows = np.fft.irfft(np.fft.rfft(A[i : i + 128], 2 * n, axis=1) * circle, 2 * n, axis=1)[:, :n]
        product[i : i + 128] = rows @ A.T
    return (product + product.T) / 2.0


def _cosine_variances(H: np.ndarray) -> np.ndarray:
    """Variances of the cosine coefficients 1 ... n-1: Σ_k H(k) times their autocorrelation, by FFT."""
    n = len(H)
    k = np.arange(n)
    even = np.fft.rfft((1.0 - k / n) * H, 2 * n).real[1:n]
    odd = -np.fft.rfft(H, 2 * n).imag[1:n]
    return 2.0 * even - H[0] - 2.0 * odd / (n * np.sin(np.pi * k[1:] / n))


# --- The fitters -------------------------------------------------------------------------------------------


def recording_of(x: np.ndarray) -> aj.Recording:
    """One recording whose axes are the records."""
    axes = tuple(aj.Axis(f"gyro_{i}", "gyro", "rad/s") for i in range(x.shape[1]))
    return aj.Recording(x, RATE, axes, MappingProxyType({}), "", ())


def by_allanjax(case: Case, x: np.ndarray) -> dict[str, np.ndarray]:
    """Values, 1-σ, interval ends and detections [records, params] of allanjax with the true model's terms."""
    fields: dict[str, list] = {"value": [], "std": [], "lower": [], "upper": [], "detected": []}
    for axis in aj.fit(recording_of(x), case.model):
        try:
            found = [axis[LABELS[c]] for c in case.truth]
        except aj.AllanjaxError:
            found = None
        for name, column in fields.items():
            if found is None:
                column.append([np.nan] * len(case.truth))
            elif name in ("lower", "upper"):
                column.append([c.interval[name == "upper"] for c in found])
            else:
                column.append([float(getattr(c, name)) for c in found])
    return {name: np.array(column) for name, column in fields.items()}


def by_selection(x: np.ndarray) -> np.ndarray:
    """Which of the basic terms `fit(recording)` detects, [records, terms]; NaN where it did not converge."""
    rows = []
    for axis in aj.fit(recording_of(x)):
        try:
            rows.append([float(axis[LABELS[c]].detected) for c in BASIC])
        except aj.AllanjaxError:
            rows.append([np.nan] * len(BASIC))
    return np.array(rows)


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


# --- The comparison ----------------------------------------------------------------------------------------

PEERS: dict[str, Callable[[Case, np.ndarray], np.ndarray]] = {
    "allan-variance": by_allan_variance,
    "avar": by_avar,
    "avar, to n/10": lambda case, x: by_avar(case, x, 0.1),
    "log-log": by_log_log,
    "log-log, to n/10": lambda case, x: by_log_log(case, x, 0.1),
}


@dataclass
class Outcome:
    """What came of one case at one record length."""

    case: Case
    n: int
    bound: np.ndarray
    ours: dict[str, np.ndarray]
    peers: dict[str, np.ndarray]
    selection: np.ndarray | None
    simulator_deviation: float

    @property
    def truth(self) -> np.ndarray:
        return np.array(list(self.case.truth.values()))

    def errors(self, estimates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Bias and RMSE over the records that have a result, in Cramér-Rao standard deviations."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            error = (estimates - self.truth) / self.bound
            return np.nanmean(error, axis=0), np.sqrt(np.nanmean(error**2, axis=0))


def compare(case: Case, n: int, records: int, seed: int) -> Outcome:
    """All fitters on the same records."""
    rng = np.random.default_rng(seed)
    ours: list[dict[str, np.ndarray]] = []
    peers: dict[str, list[np.ndarray]] = {name: [] for name in PEERS}
    selection: list[np.ndarray] = []
    curves: list[np.ndarray] = []
    for first in range(0, records, CHUNK):
        x = simulate(case, n, min(CHUNK, records - first), rng)
        curves.append(_allan(x))
        ours.append(by_allanjax(case, x))
        if "q" not in case.truth:
            selection.append(by_selection(x))
        for name, run in PEERS.items():
            peers[name].append(run(case, x))
    curve = np.concatenate(curves, axis=1)
    T = T0 * 2.0 ** np.arange(len(curve))
    shapes = {c: allan_shape(c, T, case.truth.get("T", 1.0)) for c in case.amplitudes}
    expected = sum(case.truth[c] ** 2 * shapes[c] for c in case.amplitudes)
    z = (curve.mean(axis=1) - expected) / (curve.std(axis=1, ddof=1) / np.sqrt(records))
    return Outcome(
        case,
        n,
        bound(case, n),
        {name: np.concatenate([part[name] for part in ours]) for name in ours[0]},
        {name: np.concatenate(parts) for name, parts in peers.items()},
        np.concatenate(selection) if selection else None,
        float(np.abs(z).max()),
    )


def _allan(x: np.ndarray) -> np.ndarray:
    """Overlapping Allan variances at octaves, [m, records]."""
    phase = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(x, axis=0)]) * T0
    sizes = 2 ** np.arange(int(np.log2(len(x) // 8)))
    second = (phase[2 * m :] - 2.0 * phase[m:-m] + phase[: -2 * m] for m in sizes)
    mean_squares = np.array([np.mean(d**2, axis=0) for d in second])
    return mean_squares / (2.0 * (sizes[:, None] * T0) ** 2)


# --- The report --------------------------------------------------------------------------------------------

RMSE_TARGET = 1.10
COVERAGE_TARGET = (0.92, 0.98)


def table(head: list[str], rows: list[list[str]]) -> str:
    """A Markdown table whose columns line up."""
    widths = [max(len(row[k]) for row in [head, *rows]) for k in range(len(head))]
    rule = ["-" * w for w in widths]
    return "\n".join(
        "| " + " | ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)) + " |"
        for row in [head, rule, *rows]
    )


def accuracy_table(outcomes: list[Outcome]) -> str:
    rows = []
    for o in outcomes:
        columns = [o.errors(estimates) for estimates in (o.ours["value"], *o.peers.values())]
        for k, symbol in enumerate(o.case.truth):
            cells = [f"{b[k]:+.2f}, {r[k]:.2f}" if np.isfinite(r[k]) else "n/a" for b, r in columns]
            name = SHOWN.get(symbol, symbol)
            relative = f"{100.0 * o.bound[k] / o.truth[k]:.2f} %"
            rows.append([o.case.name if k == 0 else "", f"{name} = {o.truth[k]:g}", relative, *cells])
    return table(["true model", "coefficient", "bound", "allanjax", *PEERS], rows)


def interval_table(outcomes: list[Outcome]) -> str:
    rows = []
    for o in outcomes:
        value, std, low, high = (o.ours[name] for name in ("value", "std", "lower", "upper"))
        good = np.isfinite(value[:, 0])
        inside, above, below = (
            np.mean(hit[good], axis=0)
            for hit in ((low <= o.truth) & (o.truth <= high), o.truth > high, o.truth < low)
        )
        one_sigma = np.mean(np.abs(value - o.truth)[good] <= std[good], axis=0)
        detected = o.ours["detected"][good].mean(axis=0)
        for k, symbol in enumerate(o.case.truth):
            error = np.sqrt(max(inside[k] * (1.0 - inside[k]), 0.01) / good.sum())
            rows.append(
                [
                    o.case.name if k == 0 else "",
                    SHOWN.get(symbol, symbol),
                    f"{inside[k]:.3f} ± {error:.3f}",
                    f"{above[k]:.3f}",
                    f"{below[k]:.3f}",
                    f"{one_sigma[k]:.3f}",
                    f"{np.nanmean(std[:, k]) / o.bound[k]:.2f}",
                    f"{detected[k]:.3f}",
                    f"{good.mean():.3f}" if k == 0 else "",
                ]
            )
    head = ["true model", "coefficient", "95 % interval", "truth above", "truth below", "value ± std"]
    return table([*head, "mean std / bound", "detected", "converged"], rows)


def selection_table(outcomes: list[Outcome]) -> str:
    rows = []
    for o in outcomes:
        if o.selection is None:
            continue
        good = np.isfinite(o.selection[:, 0])
        found = o.selection[good] > 0.0
        true = np.array([c in o.case.truth for c in BASIC])
        complete, spurious = found[:, true].all(axis=1), found[:, ~true].any(axis=1)
        others = ", ".join(
            f"{c} {rate:.3f}"
            for c, rate, known in zip(BASIC, found.mean(axis=0), true, strict=True)
            if not known and rate > 0.0
        )
        fractions = (complete.mean(), spurious.mean(), (complete & ~spurious).mean(), good.mean())
        rows.append([o.case.name, *(f"{fraction:.3f}" for fraction in fractions), others])
    head = ["true model", "all its terms found", "a term too many", "exactly its terms", "converged"]
    return table([*head, "terms too many"], rows)


def misses(outcomes: list[Outcome]) -> list[str]:
    """What falls short of the targets."""
    found = []
    for o in outcomes:
        _, rmse = o.errors(o.ours["value"])
        good = np.isfinite(o.ours["value"][:, 0])
        inside = (o.ours["lower"] <= o.truth) & (o.truth <= o.ours["upper"])
        coverage = inside[good].mean(axis=0)
        for k, symbol in enumerate(o.case.truth):
            where = f"{o.case.name}, n = {o.n}, {SHOWN.get(symbol, symbol)}"
            if rmse[k] > RMSE_TARGET:
                found.append(f"{where}: RMSE {rmse[k]:.2f} (± {rmse[k] / np.sqrt(2.0 * good.sum()):.2f})")
            if not COVERAGE_TARGET[0] <= coverage[k] <= COVERAGE_TARGET[1]:
                found.append(f"{where}: coverage {coverage[k]:.3f}")
    return found


def bound_check(cases: list[Case], n: int = 2048) -> str:
    """The bound by cosines against the exact one."""
    rows = []
    for case in cases:
        ratio = bound(case, n) / exact_bound(case, n)
        cells = (f"{SHOWN.get(c, c)} {r:.4f}" for c, r in zip(case.truth, ratio, strict=True))
        rows.append([case.name, ", ".join(cells)])
    return table(["true model", f"bound by cosines / exact bound, n = {n}"], rows)


INTRODUCTION = """# Accuracy

Records of known noise, simulated at {rate:g} Hz, are fitted by allanjax with the true model's terms, and by
its peers. Errors are in units of the Cramér-Rao bound of the *whole record* (exact Gaussian likelihood, bias
unknown), below which no unbiased estimator can go. Simulator, bound and log-log fit are the benchmark's own
and share no code with allanjax. Reproduce with `python benchmarks/accuracy.py`.

{machine}

## How the others are run

- **allan-variance**: `compute_avar` and `estimate_parameters` with their defaults (100 cluster times up to
  n/10) and the true effects. It has no Markov noise; its users fit flicker in its place.
- **avar**: `windows`, `variance` (64 cluster times a decade up to n/2, its default) and the interactive class
  `fit`, started at the *true* values and driven by the key event "o" without a display. It adjusts magnitudes
  only, so T_c is held at the truth; it has no bias instability. "to n/10" leaves out the long cluster times.
- **log-log**: unweighted least squares of ln σ(T), four cluster times an octave up to n/2 (or n/10), started
  at the true values, each coefficient within e⁹ of its truth.

Coefficients: N = 1 sets the unit; times in s.
"""


def report(groups: list[tuple[int, list[Outcome]]], check: str, seconds: float) -> str:
    parts = [INTRODUCTION.format(rate=RATE, machine=describe())]
    for records, outcomes in groups:
        n = outcomes[0].n
        worst = max(o.simulator_deviation for o in outcomes)
        parts += [
            f"## {n} samples ({n * T0:.0f} s), {records} records a model\n",
            "Bias, RMSE; both in multiples of the bound, which is given in per cent of the coefficient. "
            f"Standard error of an RMSE of 1: {1.0 / np.sqrt(2.0 * records):.3f}.\n",
            accuracy_table(outcomes) + "\n",
            "allanjax's intervals: fraction of records that have the truth inside the 95 % interval (with "
            "its standard error), above it, below it; inside value ± std (Gaussian: 0.683).\n",
            interval_table(outcomes) + "\n",
            "`fit(recording)` without a model, which chooses among the five basic terms:\n",
            selection_table(outcomes) + "\n",
            "Simulator: the mean Allan variances of the records are within "
            f"{worst:.1f} standard errors of theory at every octave.\n",
        ]
    short = misses([o for _, outcomes in groups for o in outcomes])
    low, high = COVERAGE_TARGET
    parts += [
        f"## Against the targets (RMSE ≤ {RMSE_TARGET:.2f} bounds, coverage {low:.2f} to {high:.2f})\n",
        "\n".join(f"- {line}" for line in short) + "\n" if short else "All met.\n",
        "## The bound\n",
        check + "\n",
        f"Whole run: {seconds / 60.0:.0f} min.\n",
    ]
    return "\n".join(parts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few short records, to see that all of it runs")
    parser.add_argument("--cases", help="true models, e.g. N+K,N+B; all by default")
    parser.add_argument("--lengths", help="record lengths and counts, e.g. 16384:400,65536:200")
    parser.add_argument("--results", type=Path, default=Path(__file__).parent / "results" / "accuracy.md")
    options = parser.parse_args()
    names = options.cases.split(",") if options.cases else [case.name for case in CASES]
    cases = [case for case in CASES if case.name in names]
    lengths = options.lengths or ("16384:50" if options.quick else "16384:400,65536:200")
    started = time.perf_counter()
    groups = []
    for length in lengths.split(","):
        n, records = (int(part) for part in length.split(":"))
        outcomes = []
        for case in cases:
            begun = time.perf_counter()
            outcomes.append(compare(case, n, records, seed=n + CASES.index(case)))
            print(f"{case.name}, {n} samples: {time.perf_counter() - begun:.0f} s", flush=True)
        tables = (accuracy_table(outcomes), interval_table(outcomes), selection_table(outcomes))
        print("\n\n".join(tables), flush=True)
        groups.append((records, outcomes))
    text = report(groups, bound_check(cases), time.perf_counter() - started)
    print(text)
    if not options.quick or options.results != parser.get_default("results"):
        options.results.parent.mkdir(exist_ok=True)
        options.results.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
