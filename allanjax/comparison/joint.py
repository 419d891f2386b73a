"""Joint fit of several recordings: one set of terms per axis, common coefficients, and their scatter.

Recordings are independent, so that the evidence of a set of terms is the product of the recordings' own. Each
recording has coefficients of its own. A term that no single recording shows is sought by the evidence of the
sum of their spectra, under the assumption that each basic term has the same power in every recording.

Averages are those of the squares v of the amplitudes, estimated from a recording's Allan variances V by
(D'C⁻¹D)⁻¹D'C⁻¹V with the covariance C of V under the joint model. These estimates are linear in V, and so
unbiased and of known variance even where a term is absent: then they are as often negative as positive.
Neither limits nor estimates that cannot be negative could be averaged. C is computed from powers that are
drawn towards the common one (the best linear prediction of random effects), so that the weight of an estimate
does not depend on its own error.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence, Set
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from allanjax.allan.deviation import AllanDeviation
from allanjax.base.errors import AllanjaxError, FitError, expect
from allanjax.base.wording import numbered
from allanjax.comparison.random_effects import Laws, RandomEffects, random_effects
from allanjax.comparison.repeatability import AxisJoint, JointCoefficient, JointFit
from allanjax.estimate.as_json import load_one
from allanjax.estimate.axis_fits import check_terms
from allanjax.estimate.design import AllanDesign, free_powers, free_shapes, model_to_fit
from allanjax.estimate.fit import fit, fit_curve
from allanjax.estimate.inference import Hypotheses, estimate_of, reported, skewness_of
from allanjax.estimate.result import AxisFit, Fit
from allanjax.estimate.selection import AxisSelection, TermSet, pooled
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model, ModelParameter
from allanjax.noise.notation import ModelLike
from allanjax.noise.terms import Markov, basic_terms
from allanjax.record.recording import Axis

# Largest relative error of an amplitude, in all recordings, whose logarithms are compared.
_PRECISE = 0.1
# Bayes factor above which a term that single recordings do not show is in the joint model ("strong").
_ODDS = 20.0
# Rounds in which weights and powers settle.
_ROUNDS = 4
_Terms = Float[np.ndarray, "records terms"]
# Estimates of powers and shapes of every recording, their variances, and their skewness.
_Forms = Float[np.ndarray, "3 records params"]


def joint_fit(
    recordings: Sequence[Any],
    model: ModelLike | None = None,
    *,
    names: Sequence[str] | None = None,
    **options: Any,
) -> JointFit:
    """Fit recordings of one unit on several days, or of units of one type, by one set of terms per axis.

    Without a model, the terms of an axis are those of the highest joint evidence (as `select_terms` chooses),
    and basic terms that have a Bayes factor above 20 if the powers are the same in all recordings. These are
    not sought in saved fits, which have no spectra, nor beside a Markov process. The values, the common value
    and the scatter follow from the Allan deviations of all recordings, see the module and `random_effects`;
    those of an axis with a model of its own (`AxisFit.own_template`) or with segments are taken from its fit.

    Args:
        recordings: at least two recordings, or whatever `fit` takes, fits, or paths of saved fits (.json).
        model: the terms, as in `fit`, but none that must be estimated from the record itself.
        names: names of the recordings; by default their own.
        options: options of `fit` for recordings.

    Raises:
        FitError: fewer than two recordings; no axis that two of them have measured; without a model, a fit
            that did not choose its terms; a line, a resonance or a transient.
    """
    expect(recordings, (list, tuple), "joint_fit takes a list of recordings or fits")
    fits = [_fit(each, model, options) for each in recordings]
    if len(fits) < 2:
        raise FitError(f"joint_fit compares at least two recordings, not {len(fits)}")
    called = [f.name or str(k) for k, f in enumerate(fits, 1)] if names is None else list(map(str, names))
    if len(called) != len(fits):
        raise AllanjaxError(f"{len(fits)} recordings need {len(fits)} names, not {len(called)}")
    called = numbered(called)
    results, notes = [], list[str]()
    for axis in dict.fromkeys(name for f in fits for name in f.axes):
        usable = (axis in f and f[axis].measured and f.curve.determined for f in fits)
        here = {name: f for name, f, use in zip(called, fits, usable, strict=True) if use}
        if absent := [name for name in called if name not in here]:
            why = "where it is absent, not a measurement, or has no interval"
            notes.append(f"{axis}: without {', '.join(absent)}, {why}")
        if len(here) > 1:
            results.append(_of_axis(axis, here, model))
    if not results:
        raise FitError(f"no axis is a measurement in two recordings; {'; '.join(notes)}")
    return JointFit(tuple(called), tuple(results), tuple(notes))


def _fit(of: Any, model: ModelLike | None, options: Mapping[str, Any]) -> Fit:
    if isinstance(of, str | Path) and Path(of).suffix == ".json":
        return load_one(of)
    return of if isinstance(of, Fit) else fit(of, model, **options)


def _of_axis(name: str, fits: Mapping[str, Fit], model: ModelLike | None) -> AxisJoint:
    """The joint fit of one axis of the recordings that have it."""
    axis = next(iter(fits.values()))[name].axis
    seen = {c.term for f in fits.values() for c in f[name].coefficients.values() if c.detected}
    selection, gains, rivals = None, dict[str, float](), dict[str, tuple[str, ...]]()
    if model is None:
        selection, chosen, gains, rivals = _chosen(axis, fits, seen)
        every = basic_terms() + Markov()
        model = every.without([label for label in every.term_labels if label not in chosen])
    terms = model_to_fit(model, [axis])
    check_terms(terms, "must be estimated from the record itself; leave it out of a joint fit")
    found = {t: gain for t, gain in gains.items() if gain > np.log(_ODDS) and t not in seen}
    told = {t: others for t, others in rivals.items() if others and t in terms.term_labels}
    coefficients = _Records.of(name, fits, terms).coefficients(found)
    return AxisJoint(axis, tuple(fits), coefficients, selection, found, told)


def _chosen(axis: Axis, fits: Mapping[str, Fit], seen: Set[str]) -> tuple[AxisSelection, Any, Any, Any]:
    """Ranking by the sum of the evidences, chosen terms, what each gains as common to all, and its rivals."""
    selection, together = _joint_ranking(axis, fits), _together(axis, fits)
    chosen, rivals = selection.chosen.terms, selection.doubtful()
    if together is None or not {*chosen} <= {*together.inclusion}:
        return selection, chosen, {}, rivals
    # What no recording shows alone may be another term with the same power in all.
    own = {*chosen} & seen or {*chosen}
    more = dataclasses.replace(together, ranking=tuple(s for s in together.ranking if own <= {*s.terms}))
    best = more.chosen.terms
    if together.gain(best, own) > np.log(_ODDS):
        doubtful, instead = more.doubtful(), tuple(t for t in chosen if t not in best)
        rivals |= {t: (*doubtful.get(t, ()), *instead) for t in best if t not in own}
        chosen = best
    rest = {t: [other for other in chosen if other != t] for t in chosen if len(chosen) > 1}
    return selection, chosen, {t: together.gain(chosen, others) for t, others in rest.items()}, rivals


def _joint_ranking(axis: Axis, fits: Mapping[str, Fit]) -> AxisSelection:
    """The sets of terms that were ranked in all recordings, by the sum of their log evidences."""
    rankings = []
    for name, f in fits.items():
        if f.selection is None:
            raise FitError(f"{name}: the fit did not choose its terms; give model=, or fit without one")
        rankings.append(f.selection[axis.name])
    each = [{s.terms: s for s in ranking.ranking} for ranking in rankings]
    common = [terms for terms in each[0] if all(terms in sets for sets in each)]
    total = np.array([sum(sets[terms].log_evidence for sets in each) for terms in common])
    probability = np.exp(total - np.logaddexp.reduce(total))
    found = [
        TermSet(terms, each[0][terms].parameters, float(behind), float(p))
        for terms, behind, p in zip(common, total - total.max(), probability, strict=True)
    ]
    found.sort(key=lambda s: -s.log_evidence)
    return AxisSelection(axis, tuple(found), max(r.discrepancy for r in rankings))


def _together(axis: Axis, fits: Mapping[str, Fit]) -> AxisSelection | None:
    """Ranking for common powers by the recordings whose spectra are known, at the rate of most; or None."""
    by_rate = dict[float, list[AxisSelection]]()
    for f in fits.values():
        if f.selection is not None and (own := f.selection[axis.name]).spectrum is not None:
            by_rate.setdefault(own.spectrum[0].rate, []).append(own)
    most = max(by_rate.values(), key=len, default=[])
    return pooled(most) if len(most) > 1 else None


@dataclasses.dataclass(frozen=True)
class _Records:
    """One axis of several recordings, and a model with the terms of all.

    `fitted` are the model's fits to the curves of recordings, by their rows. The curves of others do not
    suffice: their fits' own estimates are used.
    """

    model: Model
    names: list[str]
    results: list[AxisFit]
    fitted: dict[int, tuple[AxisFit, Hypotheses]]

    @classmethod
    def of(cls, name: str, fits: Mapping[str, Fit], model: Model) -> _Records:
        results, fitted = [f[name] for f in fits.values()], {}
        for row, (f, result) in enumerate(zip(fits.values(), results, strict=True)):
            if result.own_template is None and not f.curve.others:
                curve = f.curve[name]
                found = fit_curve(curve, model)[name]
                fitted[row] = found, _hypotheses(curve, model, found)
        return cls(model, list(fits), results, fitted)

    @property
    def places(self) -> dict[str, int]:
        """Columns of the forms by label: powers of the terms, then shapes."""
        amplitudes = {p.label: p.term for p in self.model.parameters if p.parameter.is_amplitude}
        return amplitudes | {p.label: len(self.model) + k for k, p in enumerate(free_shapes(self.model))}

    def forms(self, power: _Terms) -> _Forms:
        """Linear estimates of powers and shapes with weights of these powers; NaN where there is none."""
        terms = len(self.model)
        found = np.full((3, len(self.results), terms + len(free_shapes(self.model))), np.nan)
        for (row, result), p in itertools.product(enumerate(self.results), self.model.parameters):
            c = result.coefficients.get(p.label)
            if c is None or c.held:
                continue
            if p.parameter.is_amplitude:
                found[:, row, self.places[p.label]] = c.value**2, c.power_std**2, 0.0
            elif c.detected:
                distance = c.value - p.parameter.lower
                found[:, row, self.places[p.label]] = np.log(distance), (c.std / distance) ** 2, 0.0
        for row, (_, at) in self.fitted.items():
            own = power[[row]]
            estimated = np.append(free_powers(self.model), own[0, at.tangent.owner] > 0.0)[None]
            X, weighed, covariance, step = at.linearized(own, estimated)
            sd = np.sqrt(np.where(estimated, np.einsum("rpp->rp", covariance), np.nan))
            # Shapes, whose estimates may be negative, count as without power.
            around = np.pad(own, ((0, 0), (0, sd.shape[1] - terms)))
            skewness = skewness_of(X @ covariance, weighed @ covariance, sd, around)
            variance = (sd * self.results[row].widening) ** 2
            found[:, [row]] = step + around, variance, np.maximum(skewness, 0.0)
        return found

    def settled(self) -> tuple[_Forms, _Terms]:
        """Estimates and powers drawn towards the common ones, after a few rounds."""
        power = np.zeros((len(self.results), len(self.model)))
        for row, (_, at) in self.fitted.items():
            power[row] = at.power
        for _ in range(_ROUNDS):
            forms = self.forms(power)
            for k in range(len(self.model)):
                known = np.isfinite(forms[1, :, k])
                v, s = forms[0, known, k], np.sqrt(forms[1, known, k])
                if known.sum() > 1:
                    laws = Laws(v, s)
                    scatter = float(laws.scatter())
                    mean = max(float(laws.fitted(scatter).mean), 0.0)
                    v = (v * scatter + mean * s**2) / (scatter + s**2)
                power[known, k] = np.maximum(v, 0.0)
        return forms, power

    def coefficients(self, found: Mapping[str, float]) -> dict[str, JointCoefficient]:
        """The coefficients, with what is common to all recordings."""
        axis, result = self.results[0].axis, {}
        (forms, power), own = self.settled(), self._own_estimates()
        for p in (p for p in reported(self.model) if p.free):
            k = self.places[p.label]
            rows = [r for r, of in enumerate(own) if p.label in of and np.isfinite(forms[1, r, k])]
            if len(rows) < 2:
                continue
            records = {self.names[r]: own[r][p.label] for r in rows}
            value, variance, skewness = forms[:, rows, k]
            sd, scale = np.sqrt(variance), "logarithm"
            if not p.parameter.is_amplitude:
                value, skewness = np.log([c.value - p.parameter.lower for c in records.values()]), 0.0
            else:
                # The error at the power drawn to the common one: that at its own depends on what it weighs.
                at = np.maximum(power[rows, k], 1e-300)
                if np.all(value > 0.0) and np.all(sd < 2.0 * _PRECISE * at):
                    sd, skewness = sd / (2.0 * at), 0.0
                    # The logarithm of an unbiased square is low by half its relative variance.
                    value = 0.5 * np.log(value) + sd**2
                else:
                    scale = "square"
            effects = random_effects(value, sd, list(records), skewness=skewness)
            gain = found.get(p.term_label) if p.parameter.is_amplitude else None
            seen = gain is not None or any(c.detected for c in records.values())
            common, scatter = _common(p, axis, effects, scale == "square", seen, gain)
            result[p.label] = JointCoefficient(common, records, scatter, effects, scale)
        return result

    def _own_estimates(self) -> list[Mapping[str, Estimate]]:
        """Each recording's estimates of the joint model's coefficients by label."""
        own = [r.coefficients for r in self.results]
        for row, (of, _) in self.fitted.items():
            own[row] = of.widened(self.results[row].widening).coefficients if of.converged else {}
        return own


def _hypotheses(curve: AllanDeviation, model: Model, found: AxisFit) -> Hypotheses:
    """A curve of one axis at the best fit of a model."""
    power, shape = np.zeros((1, len(model))), np.zeros((1, len(free_shapes(model))))
    values = {label: c.value for label, c in (found.coefficients if found.converged else {}).items()}
    for p in model.parameters:
        if p.parameter.is_amplitude and p.label in values:
            power[:, p.term] = np.nan_to_num(values[p.label]) ** 2
    for k, p in enumerate(free_shapes(model)):
        u = np.log(values.get(p.label, np.nan) - p.parameter.lower)
        # Without the term any shape will do.
        shape[:, k] = u if np.isfinite(u) else 0.5 * np.log(curve.n) - np.log(curve.rate)
    tangent = AllanDesign.of(model, curve).tangent(shape)
    error = 2.0 * np.nan_to_num([found.discrepancy])
    none = np.zeros(power.shape, bool)
    return Hypotheses(tangent, curve.variance.T, none, none, none, power, error, np.zeros(shape.shape, bool))


def _common(
    p: ModelParameter, axis: Axis, e: RandomEffects, squared: bool, seen: bool, gain: float | None
) -> tuple[Estimate, Estimate]:
    """Common value and scatter of a coefficient, from the statistics of its logarithm or its square."""
    lower, relative = p.parameter.lower, np.array([e.scatter, *e.scatter_interval, e.scatter_limit])
    ends = np.array([e.common, *e.interval, *e.interval_68, e.limit])
    if squared:
        # Of a log-normal square with mean m and variance τ², the median is m/√(1 + τ²/m²). A τ that is not
        # detected may be chance, and many times the m of a weak term.
        mean = e.common if e.common > 0.0 else np.inf
        tau = e.scatter if e.scatter_interval[0] > 0.0 else 0.0
        value, *ends = (np.sqrt(np.maximum(ends, 0.0)) * (1.0 + (tau / mean) ** 2) ** -0.25).tolist()
        std, relative = 0.5 * value * e.std / mean, 0.5 * np.sqrt(np.log1p((relative / mean) ** 2))
    else:
        value, *ends = (lower + np.exp(np.minimum(ends, 300.0))).tolist()
        std = (value - lower) * e.std
    more: dict[str, Any] = {"bayes_factor": None if gain is None else float(np.exp(min(gain, 700.0)))}
    common = estimate_of(p, axis, value, std, ends, value > 0.0 and (seen or ends[0] > 0.0), **more)
    # Where there is no common value, there is no scatter about it.
    scale = value - lower if common.detected else np.nan
    size, low, high, limit = (scale * relative).tolist()
    # Its interval is far from symmetric, so that there is no standard deviation.
    scatter = estimate_of(p, axis, size, np.nan, [low, high, np.nan, np.nan, limit], low > 0.0)
    return common, dataclasses.replace(scatter, upper_limit=limit if np.isfinite(limit) else None)
