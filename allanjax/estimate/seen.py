"""What the inspection of a recording means for its fit."""

import dataclasses

import numpy as np

from allanjax.estimate.misfit import misfit_of
from allanjax.estimate.result import AxisFit, Fit
from allanjax.inspection import Inspection
from allanjax.inspection.facts import Fact, ordered
from allanjax.noise.terms import Sinusoid


def with_what_was_seen(found: Fit, seen: Inspection) -> Fit:
    """A fit with the results of its inspection: facts, parts, levels, and consequences for each axis."""
    rate, results = found.curve.rate, []
    facts = ordered(_left(fact, found) for fact in seen.facts)
    for r in found.results:
        k = [axis.name for axis in seen.axes].index(r.axis.name)
        r = dataclasses.replace(r, mean=float(seen.mean[k]), rms=float(seen.rms[k]))
        # A relative change of the power is half as large in the amplitude.
        widened = (f for f in facts if f.consequence == "widened" and r.axis.name in f.axes)
        share = sum(f.share or 0.0 for f in widened) / 2.0
        r = r.allowing(share, float(seen.added_noise[k]) / np.sqrt(rate))
        kinds = seen.why_not(r.axis.name)
        r = _with_stated_misfit(r, found).with_misfits_felt(rate) if r.converged else r
        results.append(r.unmeasured(not_measured=kinds) if r.converged and kinds else r)
    return dataclasses.replace(
        found, results=tuple(results), facts=facts, parts=seen.parts, notes=found.notes + seen.notes
    )


def _with_stated_misfit(result: AxisFit, found: Fit) -> AxisFit:
    """The result with the misfit of the Allan deviation that the fit states, if it chose the terms.

    It differs from that of the chosen terms where sets of terms are undecided.
    """
    if found.selection is None or result.worst is None or result.regression:
        return result
    curve, k = found.curve, found.axes.index(result.axis.name)
    time = curve.cluster_time
    ratio = curve.deviation[:, k] / found.model_deviation(result.axis.name, time)
    misfit = misfit_of(time, ratio, curve.edf[:, k], "s")
    if result.misfit is not None and result.misfit.unit == "s":
        return dataclasses.replace(result, misfit=misfit)
    return dataclasses.replace(result, other_misfit=misfit)


def _left(fact: Fact, found: Fit) -> Fact:
    """The fact; one about lines widens the intervals if no term of the axis's model describes them."""
    result = found[fact.axes[0]] if fact.kind == "lines" else None
    if result is None or not result.converged:
        return fact
    if any(term.narrow_band or isinstance(term, Sinusoid) for term in result.model.terms):
        return fact
    means = "no term of the model describes it, and the intervals are widened accordingly"
    return dataclasses.replace(fact, consequence="widened", meaning=means)
