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
from allanjax.estimate.evidence import information, power_fits
from allanjax.estimate.result import AxisFit, Fit
from allanjax.noise.model import Model, NoiseTerm
from allanjax.noise.notation import term_classes
from allanjax.noise.terms import Markov

# Widest standard deviation of the logarithm of a power that is drawn; and number of correlation times that
# are tried for a Markov process in a rival set.
_WIDEST, _TIMES = 1.5, 15


class Likely(NamedTuple):
    """A set of terms with unit amplitudes, and draws of their squared amplitudes, the `power` [SI].

    Each term is a model by itself, with the response if the term passes it. Those that are not `detected` are
    only known to be below a limit.
    """

    labels: tuple[str, ...]
    terms: tuple[Model, ...]
    power: Float[np.ndarray, "draws terms"]
    detected: Bool[np.ndarray, " terms"]


def exact_model(model: Model, *others: Model) -> Likely:
    """A model whose own amplitudes are a draw; so are those of others that differ from it in them only."""
    labels, names = model.term_labels, [term.amplitude_parameter().name for term in model.terms]
    unit = Model(tuple(term.with_unit_amplitude() for term in model.terms), model.response, model.inside)
    alone = tuple(unit.without([other for other in labels if other != label]) for label in labels)
    amplitudes = [[float(getattr(*x)) for x in zip(of.terms, names, strict=True)] for of in (model, *others)]
    return Likely(labels, alone, np.square(amplitudes), np.ones(len(labels), bool))


def side_by_side(sets: Sequence[Likely]) -> Likely:
    """The terms of all sets together, of which each draw has those of one set."""
    from scipy.linalg import block_diag

    labels, terms, power, detected = zip(*sets, strict=True)
    return Likely(sum(labels, ()), sum(terms, ()), block_diag(*power), np.concatenate(detected))


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
    (labels, terms, power, detected), classes = exact_model(found.model), term_classes()
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
    limits = np.array([c.upper_limit for c in below], float) / TWO_SIDED_95
    known = power * _factors(covariance, draws, rng)
    extra = (rng.standard_normal((draws, len(below))) * limits) ** 2
    return Likely(
        (*labels, *(c.term for c in below)),
        (*terms, *(Model((classes[c.term]().with_unit_amplitude(),)) for c in below)),
        np.hstack([known, extra]),
        np.append(detected, np.zeros(len(below), bool)),
    )


def _of_curve(fit: Fit, column: int, terms: tuple[str, ...], draws: int, rng: np.random.Generator) -> Likely:
    """A rival set, fitted to the Allan variances of an axis at octaves, which are nearly independent."""
    curve, classes = fit.curve, term_classes()
    octaves = np.unique(np.searchsorted(curve.cluster_size, 2 ** np.arange(np.log2(curve.cluster_size[-1]))))
    time, variance = curve.cluster_time[octaves], curve.deviation[octaves, column] ** 2
    shape = np.maximum(curve.edf[octaves, column], 1.0) / 2.0
    # A Markov process of any time between ten samples and the longest cluster.
    markov = [Markov(1.0, T) for T in np.geomspace(10.0 / curve.rate, time[-1], _TIMES).tolist()]
    kinds = [class_of(name, classes) for name in terms]
    tried = [markov if kind is Markov else [kind().with_unit_amplitude()] for kind in kinds]
    curves = [[term.sampled(curve.rate).allan_variance(time) for term in each] for each in tried]
    unit = np.stack(np.broadcast_arrays(*curves), axis=1)
    powers, loss = power_fits(variance, shape, variance, unit)
    best = int(np.argmin(loss))
    value, there = powers[best], powers[best] > 0.0
    F = information(unit[best], value @ unit[best], shape)
    # Detected terms by the normal law of their logarithms, the others within their limits.
    precision = (F * np.outer(value, value))[np.ix_(there, there)] + np.eye(there.sum()) / _WIDEST**2
    detected = value[there] * _factors(np.linalg.inv(precision), draws, rng)
    power = np.abs(rng.standard_normal((draws, len(value)))) / np.sqrt(np.diag(F))
    power[:, there] = detected
    alone = tuple(Model((each[best % len(each)],)) for each in tried)
    return Likely(terms, alone, power, there)


def _factors(
    covariance: Float[np.ndarray, "terms terms"], draws: int, rng: np.random.Generator
) -> Float[np.ndarray, "draws terms"]:
    """Draws of factors with this covariance of their logarithms, whose standard deviations are limited."""
    scale = np.minimum(1.0, _WIDEST / np.sqrt(np.maximum(np.diag(covariance), 1e-300)))
    return np.exp(rng.multivariate_normal(np.zeros(len(scale)), covariance * np.outer(scale, scale), draws))
