"""Likely noise models given a fit: its own within its intervals, and rival sets of terms.

The powers of the fitted set are drawn from the normal law of their logarithms. Sets of terms that the data do
not distinguish from it are fitted to the Allan variances with non-negative powers, and drawn in the same way.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from allanjax.base.normal import TWO_SIDED_95
from allanjax.estimate.result import AxisFit, Fit
from allanjax.estimate.selection import TermSet
from allanjax.noise.model import Model, NoiseTerm
from allanjax.noise.notation import term_classes
from allanjax.noise.terms import Markov

# Widest standard deviation of the logarithm of a power that is drawn.
_WIDEST = 1.5
# Number of correlation times that are tried for a Markov process in a rival set.
_TIMES = 15
# Rounds in which the weights of a rival set's fit approach those of its own variances.
_STEPS = 8


class Likely(NamedTuple):
    """A set of terms with unit amplitude, and draws of their powers.

    Attributes:
        model: the terms with unit amplitudes.
        labels: names of the terms.
        power: draws of the squared amplitudes, SI.
        limited: number of columns at the end for terms that are known only to be below a limit.
    """

    model: Model
    labels: tuple[str, ...]
    power: Float[np.ndarray, "draws terms"]
    limited: int


def exact_model(model: Model) -> Likely:
    """A model whose own amplitudes are the only draw."""
    unit = Model(tuple(t.with_unit_amplitude() for t in model.terms), model.response, model.inside)
    return Likely(unit, model.term_labels, np.square([[_amplitude(term) for term in model.terms]]), 0)


def likely_models(fit: Fit, axis: str, draws: int, rng: np.random.Generator) -> list[Likely]:
    """Sets of terms, with draws in proportion to their probabilities; the first set is that of the fit."""
    found = fit[axis]
    if fit.selection is None or found.own_template is not None:
        return [_of_fit(found, draws, rng, with_limits=found.own_template is None)]
    selection = fit.selection[axis]
    close = {s.terms: s for s in (selection.chosen, *selection.indistinguishable)}
    weight = np.array([s.probability for s in close.values()])
    count = rng.multinomial(draws, weight / weight.sum())
    count[0] = max(count[0], 1)
    models = [_of_fit(found, int(count[0]), rng, with_limits=False)]
    column = fit.axes.index(axis)
    for k, terms in zip(count[1:], list(close.values())[1:], strict=True):
        if k:
            models.append(_of_curve(fit, column, terms, int(k), rng))
    return models


def _of_fit(found: AxisFit, draws: int, rng: np.random.Generator, with_limits: bool) -> Likely:
    """The fitted model, with the terms below a limit on request."""
    model, labels = found.model, found.term_labels
    estimates = [c for c in found.coefficients.values() if c.is_amplitude]
    rows = [list(found.coefficients).index(c.label) for c in estimates if c.term in labels]
    amplitude = np.array([_amplitude(term) for term in model.terms])
    fitted = np.array([c.value for c in estimates if c.term in labels])
    covariance = 4.0 * found.covariance[np.ix_(rows, rows)] / np.outer(fitted, fitted)
    covariance = np.nan_to_num(covariance)
    scale = np.minimum(1.0, _WIDEST / np.sqrt(np.maximum(np.diag(covariance), 1e-300)))
    log = rng.multivariate_normal(np.zeros(len(rows)), covariance * np.outer(scale, scale), draws)
    power = amplitude**2 * np.exp(log)
    below = [c for c in estimates if with_limits and not c.detected and c.term not in labels]
    classes = term_classes()
    below = [c for c in below if c.upper_limit and np.isfinite(c.upper_limit) and c.term in classes]
    below = [c for c in below if len(classes[c.term].parameters()) == 1 or c.term == "bias_instability"]
    limits = np.array([c.upper_limit for c in below]) / TWO_SIDED_95
    extra = (rng.standard_normal((draws, len(below))) * limits) ** 2
    unit = Model(tuple(term.with_unit_amplitude() for term in model.terms), model.response, model.inside)
    for c in below:
        unit = unit + _unit(classes[c.term])
    names = (*labels, *(c.term for c in below))
    return Likely(unit, names, np.concatenate([power, extra], axis=1), len(below))


def _amplitude(term: NoiseTerm) -> float:
    return float(getattr(term, term.amplitude_parameter().name))


def _unit(term: type[NoiseTerm]) -> NoiseTerm:
    """The term with an amplitude of one."""
    amplitude: dict[str, Any] = {term.amplitude_parameter().name: 1.0}
    return term(**amplitude)


def _of_curve(fit: Fit, column: int, terms: TermSet, draws: int, rng: np.random.Generator) -> Likely:
    """A rival set, fitted to the Allan variances of an axis at octaves, which are nearly independent."""
    curve, classes = fit.curve, term_classes()
    octaves = np.unique(np.searchsorted(curve.cluster_size, 2 ** np.arange(np.log2(curve.cluster_size[-1]))))
    time, variance = curve.cluster_time[octaves], curve.deviation[octaves, column] ** 2
    degrees = np.maximum(curve.edf[octaves, column], 1.0)
    # A Markov process of any time between ten samples and the longest cluster.
    times = np.geomspace(10.0 / curve.rate, time[-1], _TIMES)
    named = [name if name in classes else name.rpartition("_")[0] for name in terms.terms]
    fits: list[tuple[list[NoiseTerm], _Powers]] = []
    for T_c in times if "markov" in named else times[:1]:
        units = [Markov(1.0, float(T_c)) if name == "markov" else _unit(classes[name]) for name in named]
        curves = [np.asarray(u.sampled(curve.rate).allan_variance(time)) for u in units]
        fits.append((units, _powers(np.stack(curves, axis=1), variance, degrees)))
    units, found = min(fits, key=lambda fit: fit[1].misfit)
    there, power = found.there, found.drawn(draws, rng)
    order = np.argsort(~there, kind="stable")
    model = Model(tuple(units[k] for k in order))
    labels = tuple(terms.terms[k] for k in order)
    return Likely(model, labels, power[:, order], int((~there).sum()))


class _Powers(NamedTuple):
    """Squared amplitudes ≥ 0 of terms, their information, and minus twice the logarithm of the likelihood."""

    value: Float[np.ndarray, " terms"]
    information: Float[np.ndarray, "terms terms"]
    misfit: float

    @property
    def there(self) -> Bool[np.ndarray, " terms"]:
        """Which terms have power above zero."""
        return self.value > 0.0

    def drawn(self, draws: int, rng: np.random.Generator) -> Float[np.ndarray, "draws terms"]:
        """Draws: of detected terms by the normal law of their logarithms, and of the others within their
        limits."""
        there, value = self.there, self.value
        precision = (self.information * np.outer(value, value))[np.ix_(there, there)]
        # Widest standard deviation of a logarithm.
        covariance = np.linalg.inv(precision + np.eye(len(precision)) / _WIDEST**2)
        log = rng.multivariate_normal(np.zeros(len(precision)), covariance, draws)
        found = np.abs(rng.standard_normal((draws, len(value)))) / np.sqrt(np.diag(self.information))
        found[:, there] = value[there] * np.exp(log)
        return found


def _powers(
    columns: Float[np.ndarray, "m terms"],
    variance: Float[np.ndarray, " m"],
    degrees: Float[np.ndarray, " m"],
) -> _Powers:
    """Most likely squared amplitudes ≥ 0 of independent variances with these degrees of freedom."""
    from scipy.optimize import nnls

    mean, size = variance, np.linalg.norm(columns / variance[:, None], axis=0)
    for _ in range(_STEPS):
        weight = np.sqrt(degrees / 2.0) / mean
        power = nnls(columns / size * weight[:, None], variance * weight)[0] / size
        # Half the way in logarithms, as the weights of a mean far below its estimate are large.
        mean = np.sqrt(mean * np.maximum(columns @ power, 1e-3 * mean))
    mean = np.maximum(columns @ power, 1e-3 * mean)
    scaled = columns / mean[:, None]
    information = scaled.T @ (scaled * degrees[:, None] / 2.0)
    return _Powers(power, information, float(np.sum(degrees * (variance / mean + np.log(mean)))))
