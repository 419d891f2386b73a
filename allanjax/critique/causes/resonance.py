"""Narrow-band noise: a damped oscillator, a structure or a loop that rings."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize
from scipy.special import gammaincc

from allanjax import terms
from allanjax.critique.causes.spectral import (
    baseline_predictive,
    coefficient_folds,
    fine_bins,
    log_likelihood,
    predictive,
    sums,
)
from allanjax.critique.noise import density
from allanjax.critique.view import Candidate, Cause, Quantity, View

_NARROWEST = 8
# Independent windows a width, and independent widths an octave.
_EFFECTIVE, _WIDTHS = 2.2, 0.75
_WORTH = 8.0
# The noise has taken part of the bump for its own, and gives it back bit by bit.
_ROUNDS, _SETTLED = 8, 0.2
_LEAST_Q = 0.6
# Coefficients below this one have drift in them; a bump narrower than this many is a line.
_LOWEST, _LINE = 16, 4.0


class Resonance(Cause):
    """A bump of the spectrum."""

    name = "resonance"

    def p_value(self, view: View) -> float:
        window = _conspicuous(view.c**2 / view.variance())
        return window[2]

    def detect(self, view: View) -> Candidate | None:
        window = _conspicuous(view.c**2 / view.variance())
        middle, width, p_value, windows, net = window
        if net < _WORTH:
            return None
        spacing = view.rate / (2.0 * view.n)
        start = np.log([middle * spacing, np.clip(middle / width, 1.0, middle / _LINE / 2.0)])
        after, theta = view, np.full(3, np.inf)
        for _ in range(_ROUNDS):
            v, before = view.variance(after.noise), theta
            theta, covariance = _fitted(view.c, v, start, width, view.rate)
            if not np.isfinite(covariance).all():
                return None
            after = view.with_x(view.x, 1.0 + _density(theta, view) / v)
            start = theta[:2]
            if np.all(abs(theta - before) < _SETTLED * np.sqrt(np.diag(covariance))):
                break
        gain = after.noise.log_evidence - view.noise.log_evidence
        # Where it is, how wide and how strong: each a share of what might have been.
        widths = np.log(len(view.c) / _NARROWEST)
        gain -= np.log(windows) + np.log(widths) + 2.0
        f0, Q, amplitude = np.exp(theta)
        deviation = np.sqrt(np.diag(covariance)) * np.exp(theta)
        parameters = {
            "frequency": Quantity(float(f0), float(deviation[0]), "Hz"),
            "quality_factor": Quantity(float(Q), float(deviation[1]), "1"),
            "amplitude": view.own(float(amplitude), float(deviation[2])),
        }
        half = f0 / Q
        return Candidate(
            self.name,
            parameters,
            float(gain),
            p_value,
            after,
            lambda: _held_out(view, theta, width),
            (max(f0 - 2.0 * half, 0.0), min(f0 + 2.0 * half, view.rate / 2.0)),
            "frequency",
            lambda model: model + terms.Resonance(float(amplitude), float(f0), float(Q)),
        )


def _density(theta: Float[np.ndarray, " 3"], view: View) -> Float[np.ndarray, " n-1"]:
    f0, Q, amplitude = (float(x) for x in np.exp(theta))
    return view.family.spectrum(terms.Resonance(amplitude, f0, Q).sampled(view.rate))


def _conspicuous(ratio: Float[np.ndarray, " n-1"]) -> tuple[float, float, float, float, float]:
    """The window with most excess: middle, width [coefficients], p-value, count of such windows, gain.

    Of a width, windows a quarter apart are worth `_EFFECTIVE` independent ones each width, as simulated.
    """
    total = np.concatenate([[0.0], np.cumsum(ratio)])
    best = (-np.inf, 0.0, 0.0, 0.0, 0.0)
    width, log_none = _NARROWEST, 0.0
    least = 1.0
    while width <= (len(ratio) - _LOWEST) // 4:
        first = np.arange(_LOWEST, len(ratio) - width + 1, max(width // 4, 1))
        level = float(np.max(total[first + width] - total[first])) / width
        k = int(np.argmax(total[first + width] - total[first]))
        windows = len(ratio) / width
        gain = 0.5 * width * (level - 1.0 - np.log(level)) if level > 1.0 else 0.0
        tail = float(gammaincc(width / 2.0, level * width / 2.0))
        of_width = -np.expm1(_EFFECTIVE * windows * np.log1p(-min(tail, 1.0 - 1e-12)))
        least, log_none = min(least, float(of_width)), log_none + 1.0
        if gain - np.log(windows) > best[0]:
            best = (gain - np.log(windows), first[k] + width / 2.0 + 1.0, float(width), windows, gain)
        width *= 2
    # Neighbouring widths see much the same.
    p_value = -np.expm1(_WIDTHS * log_none * np.log1p(-min(least, 1.0 - 1e-12)))
    return best[1], best[2], float(p_value), best[3], best[4]


def _fitted(
    c: Float[np.ndarray, " n-1"],
    v: Float[np.ndarray, " n-1"],
    start: Float[np.ndarray, " 2"],
    width: float,
    rate: float,
    fold: np.ndarray | None = None,
) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "3 3"]]:
    """Logarithms of frequency, quality factor and amplitude by maximum likelihood, and their covariance."""
    n = len(c) + 1
    spacing = rate / (2.0 * n)
    f0 = float(np.exp(start[0]))
    first = fine_bins(n, f0 / spacing, max(width, 2.0))
    used = np.ones(n - 1) if fold is None else fold.astype(float)
    size, squares, level = sums(used, first), sums(used * c**2 / v, first), sums(used * v, first)
    real = size > 0
    size, squares, level = size[real], squares[real], (level[real] / size[real])
    frequency = (sums(used * np.arange(1, n), first)[real] / size) * spacing

    def shape(theta: np.ndarray) -> np.ndarray:
        term = terms.Resonance(1.0, float(np.exp(theta[0])), float(np.exp(theta[1]))).sampled(rate)
        return rate * density(term, frequency, rate) / level

    near = abs(np.log(frequency / f0)) < max(1.5 / np.exp(start[1]), 4.0 * spacing / f0)
    unit = float(np.sum((size * shape(start))[near]))
    if not unit > 1e-200:
        return np.append(start, 0.0), np.full((3, 3), np.nan)
    excess = max(float(np.sum((squares - size)[near])), 1.0) / unit
    theta0 = np.append(start, 0.5 * np.log(excess))

    def loss(theta: np.ndarray) -> float:
        f, Q = np.exp(theta[:2])
        if not (_LOWEST * spacing < f < rate / 2.0 and _LEAST_Q < Q < f / (_LINE * spacing)):
            return np.inf
        return -log_likelihood(squares, size, 1.0 + np.exp(2.0 * theta[2]) * shape(theta))

    steps = np.array([0.3 * width * spacing / f0, 0.4, 0.3])
    simplex = np.vstack([theta0, theta0 + np.diag(steps)])
    found = minimize(
        loss, theta0, method="Nelder-Mead", options={"initial_simplex": simplex, "maxfev": 160, "fatol": 1e-2}
    ).x
    return found, _covariance(loss, found, np.array([0.05 / np.exp(found[1]), 0.05, 0.03]))


def _covariance(
    loss: Callable[[np.ndarray], float], theta: np.ndarray, step: np.ndarray
) -> Float[np.ndarray, "3 3"]:
    """Inverse of the second differences of the loss."""
    H = np.zeros((3, 3))
    unit = np.diag(step)
    for i in range(3):
        for j in range(i + 1):
            pp, pm = loss(theta + unit[i] + unit[j]), loss(theta + unit[i] - unit[j])
            mp, mm = loss(theta - unit[i] + unit[j]), loss(theta - unit[i] - unit[j])
            H[i, j] = H[j, i] = (pp - pm - mp + mm) / (4.0 * step[i] * step[j])
    if not np.isfinite(H).all():
        return np.full((3, 3), np.nan)
    values, vectors = np.linalg.eigh(H)
    return vectors @ np.diag(1.0 / np.maximum(values, 1e-4)) @ vectors.T


def _held_out(view: View, theta: Float[np.ndarray, " 3"], width: float) -> float:
    """Gain on every other coefficient by the bump fitted to the others, both ways."""
    gain = 0.0
    for fold in coefficient_folds(view.n):
        noise = view.family.of(view.c, view.factor, fold).best(view.allowed)
        v = view.variance(noise)
        for _ in range(2):
            found, _ = _fitted(view.c, v, theta[:2], width, view.rate, fold)
            factor = 1.0 + _density(found, view) / v
            whole = view.combined(factor)
            noise = view.family.of(view.c, whole, fold).best(view.allowed)
            v = view.variance(noise)
        gain += predictive(view.c, v * factor, ~fold) - baseline_predictive(view, fold)
    return gain
