"""Likely noise models given a fit: its own within its intervals, and rival sets of terms.

The powers of the fitted set are drawn from the normal law of their logarithms. Sets of terms that the data do
not distinguish from it are fitted to the Allan variances with non-negative powers, and drawn in the same way.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from allanjax.base.normal import TWO_SIDED_95
from allanjax.estimate.result import AxisFit, Fit
from allanjax.estimate.spectral.powers import information, power_fits
from allanjax.noise.model import Model, NoiseTerm
from allanjax.noise.notation import term_classes
from allanjax.noise.terms import Markov

# Widest standard deviation of the logarithm of a power that is drawn; and number of correlation times that
# are tried for a Markov process in a rival set.
_WIDEST, _TIMES = 1.5, 15


class Likely(NamedTuple):
    """A set of terms with unit amplitudes, their names, and draws of their squared amplitudes [SI].

    The last `limited` columns are those of terms that are known only to be below a limit.
    """

    model: Model
    labels: tuple[str, ...]
    power: Float[np.ndarray, "draws terms"]
    limited: int


def exact_model(model: Model) -> Likely:
    """A model whose own amplitudes are the only draw."""
    amplitude = [float(getattr(term, term.amplitude_parameter().name)) for term in model.terms]
    unit = Model(tuple(term.with_unit_amplitude() for term in model.terms), model.response, model.inside)
    return Likely(unit, model.term_labels, np.square([amplitude]), 0)


def one_by_one(model: Model) -> list[Model]:
    """Models of one term each, with the response if the term passes it."""
    labels = model.term_labels
    return [model.without([other for other in labels if other != label]) for label in labels]


def side_by_side(
    sets: Sequence[Likely],
) -> tuple[list[tuple[str, Model]], Float[np.ndarray, "draws terms"], Bool[np.ndarray, " terms"]]:
    """The terms of all sets, each with its label; draws of their powers; and which of them are detected."""
    from scipy.linalg import block_diag

    terms = [pair for s in sets for pair in zip(s.labels, one_by_one(s.model), strict=True)]
    detected = [np.arange(len(s.labels)) < len(s.labels) - s.limited for s in sets]
    return terms, block_diag(*(s.power for s in sets)), np.concatenate(detected)


def class_of(label: str, classes: Mapping[str, type[NoiseTerm]]) -> type[NoiseTerm]:
    """Class of a term by its label in a model, which has a number if there are several of its kind."""
    return classes[label if label in classes else label.rpartition("_")[0]]


def likely_models(fit: Fit, axis: str, draws: int, rng: np.random.Generator) -> list[Likely]:
    """Sets of terms, with draws in proportion to their probabilities; the first set is that of the fit."""
    found = fit[axis]
    if fit.selection is None or found.own_template is not None:
        return [_of_fit(found, draws, rng, with_limits=found.own_template is None)]
    selection = fit.selection[axis]
    close = {s.terms: s.probability for s in (selection.chosen, *selection.indistinguishable)}
    weight = np.array(list(close.values()))
    first, *others = rng.multinomial(draws, weight / weight.sum()).tolist()
    own, column = _of_fit(found, max(first, 1), rng, with_limits=False), fit.axes.index(axis)
    rivals = zip(list(close)[1:], others, strict=True)
    return [own, *(_of_curve(fit, column, terms, count, rng) for terms, count in rivals if count)]


def _of_fit(found: AxisFit, draws: int, rng: np.random.Generator, with_limits: bool) -> Likely:
    """The fitted model, with the terms below a limit on request."""
    (unit, labels, power, _), classes = exact_model(found.model), term_classes()
    amplitudes = {k: c for k, c in enumerate(found.coefficients.values()) if c.is_amplitude}
    rows = [k for k, c in amplitudes.items() if c.term in labels]
    fitted = np.array([amplitudes[k].value for k in rows])
    covariance = np.nan_to_num(4.0 * found.covariance[np.ix_(rows, rows)] / np.outer(fitted, fitted))
    below = [
        c
        for c in amplitudes.values()
        if with_limits and not c.detected and c.term in classes.keys() - labels
        if c.upper_limit and np.isfinite(c.upper_limit)
        if len(classes[c.term].parameters()) == 1 or c.term == "bias_instability"
    ]
    for c in below:
        unit = unit + _unit(classes[c.term])
    limits = np.array([c.upper_limit for c in below], float) / TWO_SIDED_95
    known = power * _factors(covariance, draws, rng)
    extra = (rng.standard_normal((draws, len(below))) * limits) ** 2
    return Likely(unit, (*labels, *(c.term for c in below)), np.hstack([known, extra]), len(below))


def _of_curve(fit: Fit, column: int, terms: tuple[str, ...], draws: int, rng: np.random.Generator) -> Likely:
    """A rival set, fitted to the Allan variances of an axis at octaves, which are nearly independent."""
    curve, classes = fit.curve, term_classes()
    octaves = np.unique(np.searchsorted(curve.cluster_size, 2 ** np.arange(np.log2(curve.cluster_size[-1]))))
    time, variance = curve.cluster_time[octaves], curve.deviation[octaves, column] ** 2
    shape = np.maximum(curve.edf[octaves, column], 1.0) / 2.0
    # A Markov process of any time between ten samples and the longest cluster.
    times = np.geomspace(10.0 / curve.rate, time[-1], _TIMES).tolist()
    kinds = [class_of(name, classes) for name in terms]
    tried = [[Markov(1.0, T) for T in times] if kind is Markov else [_unit(kind)] for kind in kinds]
    unit = np.empty((max(map(len, tried)), len(tried), len(time)))
    for k, units in enumerate(tried):
        unit[:, k] = [term.sampled(curve.rate).allan_variance(time) for term in units]
    powers, loss = power_fits(variance, shape, variance, unit)
    best = int(np.argmin(loss))
    value, there = powers[best], powers[best] > 0.0
    F = information(unit[best], value @ unit[best], shape)
    # Detected terms by the normal law of their logarithms, the others within their limits.
    precision = (F * np.outer(value, value))[np.ix_(there, there)] + np.eye(there.sum()) / _WIDEST**2
    detected = value[there] * _factors(np.linalg.inv(precision), draws, rng)
    power = np.abs(rng.standard_normal((draws, len(value)))) / np.sqrt(np.diag(F))
    power[:, there] = detected
    order = np.argsort(~there, kind="stable")
    model = Model(tuple(tried[k][best % len(tried[k])] for k in order))
    return Likely(model, tuple(terms[k] for k in order), power[:, order], int((~there).sum()))


def _factors(
    covariance: Float[np.ndarray, "terms terms"], draws: int, rng: np.random.Generator
) -> Float[np.ndarray, "draws terms"]:
    """Draws of factors with this covariance of their logarithms, whose standard deviations are limited."""
    scale = np.minimum(1.0, _WIDEST / np.sqrt(np.maximum(np.diag(covariance), 1e-300)))
    return np.exp(rng.multivariate_normal(np.zeros(len(scale)), covariance * np.outer(scale, scale), draws))


def _unit(term: type[NoiseTerm]) -> NoiseTerm:
    return term(**{term.amplitude_parameter().name: 1.0})  # type: ignore[arg-type]
