"""A slope of the spectrum that no basic term has."""

from __future__ import annotations

import numpy as np

from allanjax.critique.causes.spectral import (
    baseline_predictive,
    coefficient_folds,
    fine_bins,
    log_likelihood,
    predictive,
    sums,
)
from allanjax.critique.noise import MARKOV, POWER_LAW, Noise, density
from allanjax.critique.view import EVERYTHING, MARGIN, Candidate, Cause, Quantity, View
from allanjax.terms import PowerLaw as PowerLawTerm


class PowerLaw(Cause):
    """Noise with a power law of any exponent, in the Markov process's place."""

    name = "power_law"

    def detect(self, view: View) -> Candidate | None:
        if POWER_LAW in view.allowed:
            return None
        allowed = [t for t in view.allowed if t != MARKOV] + [POWER_LAW]
        noise = view.weighing.best(allowed, required=(POWER_LAW,))
        # Any basic term that explains as much is the better word for it.
        basic = view.weighing.best([*EVERYTHING, *view.allowed]).log_evidence
        gain = noise.log_evidence - max(view.noise.log_evidence, basic)
        if POWER_LAW not in noise.power or gain < MARGIN:
            return None
        after = view.allowing(allowed)
        exponent, std = _exponent(view, noise)
        amplitude = float(np.sqrt(noise.power[POWER_LAW]))

        def held_out() -> float:
            total = 0.0
            for fold in coefficient_folds(view.n):
                with_it = view.family.of(view.c, view.factor, fold).best(allowed, required=(POWER_LAW,))
                total += predictive(view.c, view.variance(with_it), ~fold)
                total -= baseline_predictive(view, fold)
            return total

        parameters = {
            "exponent": Quantity(exponent, std, "1"),
            "amplitude": view.own(amplitude, float("nan"), "/√Hz"),
        }
        low = view.rate / (2.0 * view.n)
        return Candidate(
            self.name,
            parameters,
            gain,
            float(np.exp(-gain)),
            after,
            held_out,
            (low, view.rate / 2.0),
            "frequency",
        )


def _exponent(view: View, noise: Noise) -> tuple[float, float]:
    """By maximum likelihood, the other terms as they are, and its deviation from the curvature."""
    from scipy.optimize import minimize

    v = noise.variance
    own = noise.power[POWER_LAW] * view.family.spectrum(PowerLawTerm(1.0, noise.shape))
    first = fine_bins(view.n)
    size = np.diff(np.append(first, view.n - 1)).astype(float)
    frequency = sums(view.family.frequency, first) / size
    squares, rest = sums(view.squares, first), sums(np.maximum(v - own, 0.0), first) / size
    # Pivot where the law weighs most, so that amplitude and exponent are independent.
    share = sums((own / v) ** 2, first)
    pivot = float(np.exp(np.sum(share * np.log(frequency)) / share.sum()))

    def loss(theta: np.ndarray) -> float:
        if not -0.95 < theta[1] < 2.95:
            return np.inf
        term = PowerLawTerm(1.0, float(theta[1]))
        law = view.rate * density(term, frequency, view.rate) * np.exp(theta[0]) * pivot ** theta[1]
        return -log_likelihood(squares / (rest + law), size, np.ones_like(size)) + 0.5 * float(
            size @ np.log(rest + law)
        )

    start = np.array([np.log(noise.power[POWER_LAW]) - noise.shape * np.log(pivot), noise.shape])
    simplex = start + np.array([[0.0, 0.0], [0.2, 0.0], [0.0, 0.1]])
    found = minimize(loss, start, method="Nelder-Mead", options={"initial_simplex": simplex, "maxfev": 120}).x
    h = 0.02
    curvature = [loss(found + np.array([0.0, s * h])) for s in (-1.0, 0.0, 1.0)]
    second = (curvature[0] - 2.0 * curvature[1] + curvature[2]) / h**2
    return float(found[1]), float(1.0 / np.sqrt(max(second, 1e-4)))
