"""Likely noise models given a fit: its own within its intervals, and rival sets of terms; their curve.

The powers of the fitted set are drawn from the normal law of their logarithms. Sets of terms that the data do
not distinguish from it are fitted to the Allan variances with non-negative powers, and drawn in the same way.
The curve of a fit is that of its detected terms; where sets of terms are undecided, it is their average.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, TypeAlias

import numpy as np
from jaxtyping import Bool, Float

from allanjax.allan.deviation import AllanDeviation
from allanjax.base.normal import TWO_SIDED_95
from allanjax.estimate.evidence import information, power_fits
from allanjax.estimate.misfit import Misfit
from allanjax.estimate.selection import AxisSelection, TermSet
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model, NoiseTerm
from allanjax.noise.notation import term_classes
from allanjax.noise.terms import Markov, basic_terms

# Widest standard deviation of the logarithm of a power that is drawn; and number of correlation times that
# are tried for a Markov process in a rival set.
_WIDEST, _TIMES = 1.5, 15
# Share of further terms in a variance above which it says nothing of others.
_MOSTLY = 0.5
# Draws for the curve of a model and its interval.
_DRAWS = 400


_Times: TypeAlias = Float[np.ndarray, " t"]


class FittedAxis(Protocol):
    """What is needed of the fit of an axis (`AxisFit`)."""

    @property
    def model(self) -> Model: ...
    @property
    def coefficients(self) -> Mapping[str, Estimate]: ...
    @property
    def covariance(self) -> Float[np.ndarray, "params params"]: ...
    @property
    def worst(self) -> Misfit | None: ...
    @property
    def measured(self) -> bool: ...


# Terms among which a fit chooses.
_CANDIDATES = (*(type(term) for term in basic_terms()), Markov)


class Likely(NamedTuple):
    """A set of terms with unit amplitudes, and draws of their squared amplitudes, the `power` [SI].

    Each term is a model by itself, with the response if the term passes it. Those that are not `detected` are
    only known to be below a limit. `stated` are the squared amplitudes that stand for the set.
    """

    labels: tuple[str, ...]
    terms: tuple[Model, ...]
    power: Float[np.ndarray, "draws terms"]
    detected: Bool[np.ndarray, " terms"]
    stated: Float[np.ndarray, " terms"]

    def unit_variances(self, rate: float, cluster_time: _Times) -> Float[np.ndarray, "terms t"]:
        """Allan variance of each term of unit amplitude at cluster times [s], sampled at `rate` [Hz]."""
        return np.array([term.sampled(rate).allan_variance(cluster_time) for term in self.terms])


def exact_model(model: Model, *others: Model) -> Likely:
    """A model whose own amplitudes are a draw; so are those of others that differ from it in them only."""
    labels, names = model.term_labels, [term.amplitude_parameter().name for term in model.terms]
    unit = Model(tuple(term.with_unit_amplitude() for term in model.terms), model.response, model.inside)
    alone = tuple(unit.without([other for other in labels if other != label]) for label in labels)
    amplitudes = [[float(getattr(*x)) for x in zip(of.terms, names, strict=True)] for of in (model, *others)]
    power = np.square(amplitudes)
    return Likely(labels, alone, power, np.ones(len(labels), bool), power.mean(axis=0))


def side_by_side(sets: Sequence[Likely]) -> Likely:
    """The terms of all sets together, of which each draw has those of one set, and their average."""
    from scipy.linalg import block_diag

    labels, terms, power, detected, stated = zip(*sets, strict=True)
    weight = np.array([len(draws) for draws in power], float)
    average = [x * w for x, w in zip(stated, weight / weight.sum(), strict=True)]
    every = block_diag(*power), np.concatenate(detected), np.concatenate(average)
    return Likely(sum(labels, ()), sum(terms, ()), *every)


def class_of(label: str, classes: Mapping[str, type[NoiseTerm]]) -> type[NoiseTerm]:
    """Class of a term by its label in a model, which has a number if there are several of its kind."""
    return classes[label if label in classes else label.rpartition("_")[0]]


@dataclass(frozen=True, eq=False)
class Statement:
    """What the fit of an axis states with its intervals: likely models and their Allan deviation.

    Attributes:
        found: the fit of the axis.
        ranking: its ranking of terms, if the fit chose them.
        curve: Allan deviations of the record.
        column: the axis's column of the curve.
    """

    found: FittedAxis
    ranking: AxisSelection | None
    curve: AllanDeviation
    column: int

    def models(self, draws: int, rng: np.random.Generator) -> list[Likely]:
        """Sets of terms, with draws in proportion to their probabilities; the first is that of the fit."""
        if self.ranking is None:
            return [_of_fit(self.found, draws, rng, alone=True)]
        close = {s.terms: s for s in (self.ranking.chosen, *self.ranking.indistinguishable)}
        weight = np.array([s.probability for s in close.values()])
        first, *others = rng.multinomial(draws, weight / weight.sum()).tolist()
        rivals = [(s, count) for s, count in zip(list(close.values())[1:], others, strict=True) if count]
        own = _of_fit(self.found, max(first, 1), rng, alone=not rivals)
        return [own, *(_of_curve(self.found, self.curve, self.column, *rival, rng) for rival in rivals)]

    def together(self, draws: int = _DRAWS) -> Likely:
        """The likely models side by side."""
        return side_by_side(self.models(draws, np.random.default_rng(0)))

    def deviation(self, cluster_time: _Times) -> Float[np.ndarray, "3 t"]:
        """Allan deviation [rad/s or m/s²] at cluster times [s], and the ends of its 95 % interval.

        It is that of the detected terms; where sets of terms are undecided, it is their average. The lower
        end is that of the detected terms; the upper one includes those below a limit.
        """
        likely = self.together()
        unit = likely.unit_variances(self.curve.rate, cluster_time)
        stated = likely.stated @ unit
        low = np.quantile(likely.power[:, likely.detected] @ unit[likely.detected], 0.025, axis=0)
        high = np.quantile(likely.power @ unit, 0.975, axis=0)
        curves = np.sqrt([stated, np.minimum(low, stated), np.maximum(high, stated)])
        return self._as_measured(cluster_time, curves)

    def density(self, frequency: Float[np.ndarray, " f"]) -> Float[np.ndarray, " f"]:
        """One-sided density [rate²/Hz] of samples at frequencies [Hz], without lines."""
        likely, rate = self.together(), self.curve.rate
        density = np.zeros(len(frequency))
        for power, term in zip(likely.stated, likely.terms, strict=True):
            if not term.terms[0].deterministic:
                density += 2.0 * power * np.asarray(term.sampled(rate).sampled_psd(frequency, rate))
        return density

    def drawn(self, cluster_time: _Times, draws: int) -> Float[np.ndarray, "draws t"]:
        """Allan deviations [rad/s or m/s²] of likely models at cluster times [s]."""
        likely = self.together(draws)
        unit = likely.unit_variances(self.curve.rate, cluster_time)
        return self._as_measured(cluster_time, np.sqrt(likely.power @ unit))

    def _as_measured(
        self, cluster_time: _Times, curves: Float[np.ndarray, "_ t"]
    ) -> Float[np.ndarray, "_ t"]:
        """Deviations within the 95 % band of the measured ones, if the model fits."""
        if self.found.worst is not None or not self.found.measured or not self.curve.determined:
            return curves
        return np.clip(curves, *_band(self.curve, self.column, cluster_time))


def _of_fit(found: FittedAxis, draws: int, rng: np.random.Generator, alone: bool) -> Likely:
    """The fitted model; if it is the only set, with the terms below a limit, which are not in its curve."""
    (labels, terms, power, detected, stated), classes = exact_model(found.model), term_classes()
    amplitudes = {k: c for k, c in enumerate(found.coefficients.values()) if c.is_amplitude}
    rows = [k for k, c in amplitudes.items() if c.term in labels]
    fitted = np.array([amplitudes[k].value for k in rows])
    covariance = np.nan_to_num(4.0 * found.covariance[np.ix_(rows, rows)] / np.outer(fitted, fitted))
    if alone and any(amplitudes[k].detected for k in rows):
        stated = np.where([amplitudes[k].detected or amplitudes[k].held for k in rows], stated, 0.0)
    below = [
        c
        for c in amplitudes.values()
        if alone and not c.detected and c.term in classes.keys() - labels
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
        np.append(stated, np.zeros(len(below))),
    )


def _of_curve(
    found: FittedAxis,
    curve: AllanDeviation,
    column: int,
    terms: TermSet,
    draws: int,
    rng: np.random.Generator,
) -> Likely:
    """A rival set, fitted to the Allan variances of an axis at octaves, which are nearly independent.

    Filter, resonances and lines are those of the fit.
    """
    own, classes = exact_model(found.model), term_classes()
    octaves = np.unique(np.searchsorted(curve.cluster_size, 2 ** np.arange(np.log2(curve.cluster_size[-1]))))
    time, variance = curve.cluster_time[octaves], curve.deviation[octaves, column] ** 2
    shape = np.maximum(curve.edf[octaves, column], 1.0) / 2.0
    plain = [class_of(name, classes) in _CANDIDATES for name in own.labels]
    further = np.flatnonzero(~np.array(plain))
    fixed = own.stated[further] @ [own.terms[k].sampled(curve.rate).allan_variance(time) for k in further]
    # Where further terms are most of the variance, it does not determine the others.
    shape = np.where(fixed < _MOSTLY * variance, shape, 1e-6)
    variance = np.maximum(variance - fixed, 1e-6 * variance)
    # A Markov process of any time between ten samples and the longest cluster.
    markov = [Markov(1.0, T) for T in np.geomspace(10.0 / curve.rate, time[-1], _TIMES).tolist()]
    kinds = [class_of(name, classes) for name in terms.terms]
    tried = [markov if kind is Markov else [kind().with_unit_amplitude()] for kind in kinds]
    models = [[_through(found.model, own, term) for term in each] for each in tried]
    curves = [[one.sampled(curve.rate).allan_variance(time) for one in each] for each in models]
    unit = np.stack(np.broadcast_arrays(*curves), axis=1)
    powers, loss = power_fits(variance, shape, variance, unit)
    best = int(np.argmin(loss))
    value, there = powers[best], powers[best] > 0.0
    F = information(unit[best], value @ unit[best], shape)
    # Detected terms by the normal law of their logarithms, the others within their limits.
    precision = (F * np.outer(value, value))[np.ix_(there, there)] + np.eye(there.sum()) / _WIDEST**2
    drawn = value[there] * _factors(np.linalg.inv(precision), draws, rng)
    power = np.abs(rng.standard_normal((draws, len(value)))) / np.sqrt(np.diag(F))
    power[:, there] = drawn
    besides = [(own.labels[k], own.terms[k], own.stated[k]) for k in further]
    return Likely(
        (*terms.terms, *(label for label, *_ in besides)),
        (*(each[best % len(each)] for each in models), *(term for _, term, _ in besides)),
        np.hstack([power, np.broadcast_to(own.stated[further], (draws, len(further)))]),
        np.append(there, np.ones(len(further), bool)),
        np.append(value, own.stated[further]),
    )


def _through(model: Model, own: Likely, term: NoiseTerm) -> Model:
    """A term of unit amplitude by itself, with the response if that of its kind in the fit passes it."""
    passes = [bool(one.inside and one.inside[0]) for one in own.terms if type(one.terms[0]) is type(term)]
    if model.response is None or not any(passes):
        return Model((term,))
    return Model((term,), model.response, (True,))


def _factors(
    covariance: Float[np.ndarray, "terms terms"], draws: int, rng: np.random.Generator
) -> Float[np.ndarray, "draws terms"]:
    """Draws of factors with this covariance of their logarithms, whose standard deviations are limited."""
    scale = np.minimum(1.0, _WIDEST / np.sqrt(np.maximum(np.diag(covariance), 1e-300)))
    return np.exp(rng.multivariate_normal(np.zeros(len(scale)), covariance * np.outer(scale, scale), draws))


def _band(curve: AllanDeviation, column: int, cluster_time: _Times) -> tuple[_Times, _Times]:
    """Ends of the 95 % band of an axis's measured Allan deviation; none beyond the measured times [s].

    The band is one for all cluster times together (Bonferroni): those of an octave, which share most
    clusters, count as one.
    """
    log = np.log(cluster_time)
    own = np.log(curve.cluster_time)
    octaves = 1.0 + float(own[-1] - own[0]) / np.log(2.0)
    low, high = (
        np.exp(np.interp(log, own, np.log(np.maximum(end[:, column], 1e-300)), beyond, beyond))
        for end, beyond in zip(
            curve.confidence_interval(1.0 - 0.05 / octaves), (-np.inf, np.inf), strict=True
        )
    )
    return low, high
