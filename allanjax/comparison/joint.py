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
from collections.abc import Mapping, Sequence, Set
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from allanjax.allan.deviation import AllanDeviation
from allanjax.base.errors import AllanjaxError, FitError, expect
from allanjax.base.wording import numbered
from allanjax.comparison.random_effects import Laws, RandomEffects, random_effects
from allanjax.comparison.repeatability import AxisJoint, JointCoefficient, JointFit
from allanjax.estimate.as_json import load_one
from allanjax.estimate.axis_fits import check_terms
from allanjax.estimate.design import AllanDesign, check_no_response, free_powers, free_shapes
from allanjax.estimate.fit import fit, fit_curve
from allanjax.estimate.inference import Hypotheses, estimate_of, reported, skewness_of
from allanjax.estimate.result import AxisFit, Fit
from allanjax.estimate.selection import AxisSelection, TermSet, pooled
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model, ModelParameter
from allanjax.noise.notation import ModelLike, as_model
from allanjax.noise.terms import Markov, basic_terms
from allanjax.record.recording import Axis

# Largest relative error of an amplitude, in all recordings, whose logarithms are compared.
_PRECISE = 0.1
# ln of the Bayes factor above which a term that single recordings do not show is in the joint model: that of
# "strong" evidence, 20.
_ODDS = np.log(20.0)
# Rounds in which weights and powers settle.
_ROUNDS = 4
_Terms = Float[np.ndarray, "records terms"]
# Estimates of powers and shapes, their variances, and their skewness.
_Form = Float[np.ndarray, "3 params"]


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
    named = dict(zip(numbered(called), fits, strict=True))
    results, notes = [], []
    for axis in dict.fromkeys(name for f in fits for name in f.axes):
        known = (name for name, f in named.items() if axis in f and f[axis].measured)
        here = {name: named[name] for name in known if named[name].curve.determined}
        absent = [name for name in named if name not in here]
        if absent:
            why = "where it is absent, not a measurement, or has no interval"
            notes.append(f"{axis}: without {', '.join(absent)}, {why}")
        if len(here) > 1:
            results.append(_of_axis(axis, here, model))
    if not results:
        raise FitError(f"no axis is a measurement in two recordings; {'; '.join(notes)}")
    return JointFit(tuple(named), tuple(results), tuple(notes))


def _fit(of: Any, model: ModelLike | None, options: Mapping[str, Any]) -> Fit:
    if isinstance(of, str | Path) and Path(of).suffix == ".json":
        return load_one(of)
    return of if isinstance(of, Fit) else fit(of, model, **options)


def _of_axis(name: str, fits: Mapping[str, Fit], model: ModelLike | None) -> AxisJoint:
    """The joint fit of one axis of the recordings that have it."""
    axis = next(iter(fits.values()))[name].axis
    seen = {c.term for f in fits.values() for c in f[name].coefficients.values() if c.detected}
    choice = _Choice()
    if model is None:
        choice = _chosen(name, fits, seen)
        every = basic_terms() + Markov()
        model = every.without([label for label in every.term_labels if label not in choice.terms])
    terms = as_model(model, [axis])
    check_no_response(terms)
    check_terms(terms, "must be estimated from the record itself; leave it out of a joint fit")
    found = {t: gain for t, gain in choice.gains.items() if gain > _ODDS and t not in seen}
    rivals = {t: others for t, others in choice.rivals.items() if others and t in terms.term_labels}
    records = [_Record.of(label, name, f, terms) for label, f in fits.items()]
    return AxisJoint(axis, tuple(fits), _coefficients(axis, records, found), choice.selection, found, rivals)


class _Choice(NamedTuple):
    """Terms that are chosen, what each gains as common to all, and its rivals; empty for a given model."""

    selection: AxisSelection | None = None
    terms: Sequence[str] = ()
    gains: Mapping[str, float] = {}
    rivals: Mapping[str, tuple[str, ...]] = {}


def _chosen(axis: str, fits: Mapping[str, Fit], seen: Set[str]) -> _Choice:
    """Choice of the terms of an axis, of which single recordings show those that are seen."""
    rankings = list[AxisSelection]()
    for name, f in fits.items():
        if f.selection is None:
            raise FitError(f"{name}: the fit did not choose its terms; give model=, or fit without one")
        rankings.append(f.selection[axis])
    selection, together = _joint_ranking(rankings), _together(rankings)
    chosen, rivals = selection.chosen.terms, selection.doubtful()
    if together is None or not {*chosen} <= {*together.inclusion}:
        return _Choice(selection, chosen, rivals=rivals)
    # What no recording shows alone may be another term with the same power in all.
    own = {*chosen} & seen or {*chosen}
    more = dataclasses.replace(together, ranking=tuple(s for s in together.ranking if own <= {*s.terms}))
    best = more.chosen.terms
    if together.gain(best, own) > _ODDS:
        doubtful, instead = more.doubtful(), tuple(t for t in chosen if t not in best)
        rivals |= {t: (*doubtful.get(t, ()), *instead) for t in best if t not in own}
        chosen = best
    gains = {t: together.gain(chosen, {*chosen} - {t}) for t in chosen if len(chosen) > 1}
    return _Choice(selection, chosen, gains, rivals)


def _joint_ranking(rankings: Sequence[AxisSelection]) -> AxisSelection:
    """The sets of terms that were ranked in all recordings, by the sum of their log evidences."""
    each = [{s.terms: s for s in ranking.ranking} for ranking in rankings]
    common = [terms for terms in each[0] if all(terms in sets for sets in each)]
    total = np.array([sum(sets[terms].log_evidence for sets in each) for terms in common])
    probability = np.exp(total - np.logaddexp.reduce(total))
    found = []
    for terms, behind, p in zip(common, total - total.max(), probability, strict=True):
        found.append(TermSet(terms, each[0][terms].parameters, float(behind), float(p)))
    found.sort(key=lambda s: -s.log_evidence)
    return AxisSelection(rankings[0].axis, tuple(found), max(r.discrepancy for r in rankings))


def _together(rankings: Sequence[AxisSelection]) -> AxisSelection | None:
    """Ranking for common powers by the recordings whose spectra are known, at the rate of most; or None."""
    by_rate = dict[float, list[AxisSelection]]()
    for ranking in rankings:
        if ranking.spectrum is not None:
            by_rate.setdefault(ranking.spectrum[0].rate, []).append(ranking)
    most = max(by_rate.values(), key=len, default=[])
    return pooled(most) if len(most) > 1 else None


class _Record(NamedTuple):
    """One axis of a recording.

    Attributes:
        name: name of the recording.
        model: the joint model.
        coefficients: its estimates of the model's coefficients by label.
        widening: factor of their errors.
        at: its curve at the model's best fit; None for a curve that does not suffice, so that the estimates
            are those of the recording's own fit.
    """

    name: str
    model: Model
    coefficients: Mapping[str, Estimate]
    widening: float
    at: Hypotheses | None

    @classmethod
    def of(cls, name: str, axis: str, fit: Fit, model: Model) -> _Record:
        own = fit[axis]
        if own.own_template is not None or fit.curve.others:
            return cls(name, model, own.coefficients, own.widening, None)
        curve = fit.curve[axis]
        found = fit_curve(curve, model)[axis]
        coefficients = found.widened(own.widening).coefficients if found.converged else {}
        return cls(name, model, coefficients, own.widening, _hypotheses(curve, model, found))

    def form(self, power: Float[np.ndarray, " terms"]) -> _Form:
        """Linear estimates of powers and shapes with weights of these powers; NaN where there is none."""
        if self.at is None:
            return self._own_form()
        own, at = power[None], self.at
        estimated = np.append(free_powers(self.model), power[at.tangent.owner] > 0.0)[None]
        X, weighed, covariance, step = at.linearized(own, estimated)
        sd = np.sqrt(np.where(estimated, np.einsum("rpp->rp", covariance), np.nan))
        # Shapes, whose estimates may be negative, count as without power.
        around = np.pad(own, ((0, 0), (0, sd.shape[1] - len(power))))
        skewness = skewness_of(X @ covariance, weighed @ covariance, sd, around)
        return np.concatenate([step + around, (sd * self.widening) ** 2, np.maximum(skewness, 0.0)])

    def _own_form(self) -> _Form:
        """The same by the estimates and their errors, as if these were normal."""
        columns = _columns(self.model)
        found = np.full((3, len(columns)), np.nan)
        for k, p in enumerate(columns):
            c = self.coefficients.get(p.label)
            if c is None or c.held:
                continue
            if p.parameter.is_amplitude:
                found[:, k] = c.value**2, c.power_std**2, 0.0
            elif c.detected:
                distance = c.value - p.parameter.lower
                found[:, k] = np.log(distance), (c.std / distance) ** 2, 0.0
        return found


def _columns(model: Model) -> list[ModelParameter]:
    """What the columns of the forms are: amplitudes of the terms, then shapes."""
    return [*(p for p in model.parameters if p.parameter.is_amplitude), *free_shapes(model)]


def _settled(records: Sequence[_Record]) -> tuple[Float[np.ndarray, "3 records params"], _Terms]:
    """Forms of the recordings, and powers drawn towards the common ones, after a few rounds."""
    terms = len(records[0].model)
    power = np.concatenate([np.zeros((1, terms)) if one.at is None else one.at.power for one in records])
    for _ in range(_ROUNDS):
        forms = np.stack([one.form(own) for one, own in zip(records, power, strict=True)], axis=1)
        for k in range(terms):
            known = np.isfinite(forms[1, :, k])
            v, s = forms[0, known, k], np.sqrt(forms[1, known, k])
            if known.sum() > 1:
                laws = Laws(v, s)
                scatter = float(laws.scatter())
                mean = max(float(laws.fitted(scatter).mean), 0.0)
                v = (v * scatter + mean * s**2) / (scatter + s**2)
            power[known, k] = np.maximum(v, 0.0)
    return forms, power


def _coefficients(
    axis: Axis, records: Sequence[_Record], found: Mapping[str, float]
) -> dict[str, JointCoefficient]:
    """The coefficients, with what is common to all recordings."""
    model, result = records[0].model, {}
    labels = [p.label for p in _columns(model)]
    forms, power = _settled(records)
    for p in reported(model):
        if not p.free:
            continue
        k = labels.index(p.label)
        known = (one for one, error in zip(records, forms[1, :, k], strict=True) if np.isfinite(error))
        own = {one.name: one.coefficients[p.label] for one in known if p.label in one.coefficients}
        if len(own) < 2:
            continue
        rows = [row for row, one in enumerate(records) if one.name in own]
        value, sd = forms[0, rows, k], np.sqrt(forms[1, rows, k])
        scale, skewness = "logarithm", None
        if not p.parameter.is_amplitude:
            value = np.log([c.value - p.parameter.lower for c in own.values()])
        else:
            # The error at the power drawn to the common one: that at its own depends on what it weighs.
            relative = sd / (2.0 * np.maximum(power[rows, k], 1e-300))
            if np.all(value > 0.0) and np.all(relative < _PRECISE):
                # The logarithm of an unbiased square is low by half its relative variance.
                value, sd = 0.5 * np.log(value) + relative**2, relative
            else:
                scale, skewness = "square", forms[2, rows, k]
        effects = random_effects(value, sd, list(own), skewness=skewness)
        gain = found.get(p.term_label) if p.parameter.is_amplitude else None
        seen = gain is not None or any(c.detected for c in own.values())
        common, scatter = _common(p, axis, effects, scale == "square", seen, gain)
        result[p.label] = JointCoefficient(common, own, scatter, effects, scale)
    return result


def _hypotheses(curve: AllanDeviation, model: Model, found: AxisFit) -> Hypotheses:
    """A curve of one axis at the best fit of a model."""
    columns, terms = _columns(model), len(model)
    known = found.coefficients if found.converged else {}
    value = np.array([known[p.label].value if p.label in known else np.nan for p in columns])
    power = np.nan_to_num(value[None, :terms]) ** 2
    u = np.log(value[terms:] - [p.parameter.lower for p in columns[terms:]])
    # Without the term any shape will do.
    shape = np.where(np.isfinite(u), u, 0.5 * np.log(curve.n) - np.log(curve.rate))[None]
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
    detected = value > 0.0 and (seen or ends[0] > 0.0)
    factor = None if gain is None else float(np.exp(min(gain, 700.0)))
    common = estimate_of(p, axis, value, std, ends, detected, bayes_factor=factor)
    # Where there is no common value, there is no scatter about it.
    scale = value - lower if detected else np.nan
    (size, *ends), limit = (scale * relative[:3]).tolist(), float(scale * relative[3])
    # Its interval is far from symmetric, so that there is no standard deviation.
    scatter = estimate_of(p, axis, size, np.nan, [*ends, np.nan, np.nan, limit], ends[0] > 0.0)
    return common, dataclasses.replace(scatter, upper_limit=limit if np.isfinite(limit) else None)
