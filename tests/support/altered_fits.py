"""Fits whose results are others than those that were estimated."""

import dataclasses

import numpy as np

import allanjax as aj


def without_result(fit: aj.Fit, name: str, reason: str = "the start was hopeless") -> aj.Fit:
    """The fit, had this axis not converged."""
    failed = {"converged": False, "reason": reason}
    results = [dataclasses.replace(r, **failed) if r.axis.name == name else r for r in fit.results]
    return dataclasses.replace(fit, results=tuple(results))


def with_terms(fit: aj.Fit, models: dict[str, aj.Model]) -> aj.Fit:
    """The fit with these models of axes, which have the same terms, as found: each value is known to 1 %."""
    results = []
    for result in fit.results:
        if result.axis.name in models:
            model, N = models[result.axis.name], result["N"]
            found = {}
            for p in model.parameters:
                of = {"label": p.label, "term": p.term_label, "parameter": p.parameter}
                ends = (0.98 * p.start, 1.02 * p.start)
                known = {"value": p.start, "std": p.start / 100, "interval": ends, "upper_limit": None}
                found[p.label] = dataclasses.replace(N, **of, **known, unit="", usual_unit="")
            covariance = np.diag([c.std**2 for c in found.values()])
            result = dataclasses.replace(result, _model=model, _coefficients=found, _covariance=covariance)
        results.append(result)
    return dataclasses.replace(fit, template=model, results=tuple(results))
