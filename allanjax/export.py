"""Files of a fit: JSON after `fit.schema.json`, CSV tables and the picture."""

import csv
import json
import math
import os
import re
from collections.abc import Iterable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from allanjax.allan import AllanDeviation
from allanjax.estimate import Coefficient
from allanjax.misfit import Misfit
from allanjax.recording import DeadAxis
from allanjax.result import AxisFit, Fit
from allanjax.selection import AxisSelection, TermSelection
from allanjax.spectrum import PowerSpectrum
from allanjax.terms import NoiseTerm
from allanjax.units import rate_unit_of

SCHEMA_VERSION = 1
#: What stands for an infinite parameter of a model, for which JSON has no number.
INFINITY = "Infinity"
# Sets of terms that are less probable are not written.
_IMPROBABLE = 1e-6
_NUMBERS = re.compile(r"\[\n\s+((?:-?[\d.eE+-]+|null)(?:,\n\s+(?:-?[\d.eE+-]+|null))*)\n\s+\]")


def to_dict(fit: Fit) -> dict[str, Any]:
    """The fit as plain dictionaries, lists, numbers and strings; `fit.schema.json` says what each means.

    Numbers that do not exist, such as the χ² of an axis without result, are None; so are those that are not
    finite, the upper end of an interval without one, say. `load` makes the fit of them again.
    """
    return {
        "schema_version": SCHEMA_VERSION,
        "allanjax_version": version("allanjax"),
        "recording": {
            "name": fit.name,
            "n": int(fit.curve.n),
            "rate_hz": float(fit.curve.rate),
            "duration_s": fit.curve.n / fit.curve.rate,
        },
        "objective": fit.objective,
        "converged": fit.converged,
        "model": [_term(term) for term in fit.template],
        "curve": _curve(fit.curve, fit.axes),
        "axes": [*(_axis(result, fit.selection) for result in fit), *map(_dead_axis, fit.dead)],
        "warnings": list(fit.warnings),
        "stretch_s": None if fit.stretch is None else list(fit.stretch),
        "notes": list(fit.notes),
    }


def write_json(fit: Fit, path: str | os.PathLike[str]) -> None:
    """Write `to_dict(fit)` to a file of JSON."""
    text = json.dumps(to_dict(fit), indent=2, ensure_ascii=False, allow_nan=False)
    # Numbers of a list side by side: in texts there are no line breaks.
    text = _NUMBERS.sub(lambda match: f"[{', '.join(match[1].split()).replace(',,', ',')}]", text)
    # A name may come from a file name that is no text.
    Path(path).write_text(text + "\n", encoding="utf-8", errors="backslashreplace")


def write_curve_csv(fit: Fit, path: str | os.PathLike[str]) -> None:
    """Write the Allan deviations with their 68 % intervals and the model's, one row a cluster time.

    Each axis is in its recording's unit, which the header states; where that is one of increments, in rad/s
    or m/s². The model's column is empty for an axis without result.
    """
    header, columns = ["cluster_time [s]"], [fit.curve.cluster_time]
    lower, upper = fit.curve.confidence_interval(0.68)
    for k, result in enumerate(fit):
        unit, scale = rate_unit_of(result.axis.unit, result.axis.sensor)
        name = result.axis.name
        model = (
            fit.model_deviation(name, fit.curve.cluster_time)
            if result.converged
            else np.full(len(fit.curve.cluster_time), np.nan)
        )
        header += [f"{name} {kind} [{unit}]" for kind in ("deviation", "lower_68", "upper_68", "model")]
        columns += [part / scale for part in (fit.curve.deviation[:, k], lower[:, k], upper[:, k], model)]
    _write_csv(path, header, ([_finite(x) for x in row] for row in np.stack(columns, axis=1)))


def write_coefficients_csv(fit: Fit, path: str | os.PathLike[str]) -> None:
    """Write one row a coefficient, in its usual unit; an axis without result has one row with the reason.

    What is not a measurement (see `AxisFit.measured`) has no error and no interval, and a reason, too.
    """
    header = ["axis", "coefficient", "value", "std", "lower_95", "upper_95", "unit"]
    header += ["detected", "held", "measured"]
    rows: list[list[Any]] = []
    for result in fit:
        if not result.converged:
            rows.append([result.axis.name, *[""] * len(header), result.reason])
            continue
        for c in result.coefficients.values():
            shown = c.in_unit()
            n = _numbers(shown)
            numbers = [n["value"], n["std"], *n["interval_95"]]
            flags = [str(x).lower() for x in (c.detected, c.held, c.measured)]
            reason = "" if c.measured else result.verdict()
            rows.append(
                [result.axis.name, c.label, *numbers, shown.unit, *flags, n["upper_limit_95"], reason]
            )
    rows += [[dead.axis.name, *[""] * len(header), dead.reason] for dead in fit.dead]
    _write_csv(path, [*header, "upper_limit_95", "reason"], rows)


def write_results(
    fit: Fit, spectrum: PowerSpectrum | None, directory: str | os.PathLike[str], name: str
) -> tuple[Path, ...]:
    """Write NAME.json, NAME_{allan,coefficients}.csv and NAME_{allan,psd}.png; returns their paths.

    Without a spectrum, as of a recording that was read in chunks, there is no NAME_psd.png.
    """
    from allanjax.plot import plot_allan
    from allanjax.plot_spectrum import plot_psd

    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    suffixes = [".json", "_allan.csv", "_coefficients.csv", "_allan.png"]
    suffixes += [] if spectrum is None else ["_psd.png"]
    paths = tuple(directory / f"{name}{suffix}" for suffix in suffixes)
    write_json(fit, paths[0])
    write_curve_csv(fit, paths[1])
    write_coefficients_csv(fit, paths[2])
    plot_allan(fit, path=paths[3])
    if spectrum is not None:
        plot_psd(spectrum, fit, path=paths[4])
    return paths


def _dead_axis(dead: DeadAxis) -> dict[str, Any]:
    """As that of an axis without result."""
    axis = dead.axis
    return {
        "name": axis.name,
        "sensor": axis.sensor,
        "unit": axis.unit,
        "mean_si": None,
        "rms_si": None,
        "converged": False,
        "dead": True,
        "reason": dead.reason,
        "chi2": None,
        "dof": 0,
        "p_value": None,
        "discrepancy": None,
        "measured": False,
        "moving": False,
        "misfit": None,
        "coefficients": [],
        "covariance": {"labels": [], "units": [], "values": []},
        "selection": None,
        "selection_discrepancy": None,
        "regression": {},
    }


def _axis(result: AxisFit, selection: TermSelection | None) -> dict[str, Any]:
    coefficients = list(result.coefficients.values()) if result.converged else []
    covariance = result.covariance if result.converged else np.zeros((0, 0))
    return {
        "name": result.axis.name,
        "sensor": result.axis.sensor,
        "unit": result.axis.unit,
        "mean_si": _finite(result.mean),
        "rms_si": _finite(result.rms),
        "converged": result.converged,
        "dead": False,
        "reason": result.reason,
        "chi2": _finite(result.chi2) if result.converged else None,
        "dof": int(result.dof),
        "p_value": _finite(result.p_value) if result.converged else None,
        "discrepancy": _finite(result.discrepancy) if result.converged else None,
        "measured": result.measured,
        "moving": result.moving,
        "misfit": None if result.misfit is None else _misfit(result.misfit),
        "coefficients": [_coefficient(c) for c in coefficients],
        "covariance": {
            "labels": [c.label for c in coefficients],
            "units": [c.si_unit for c in coefficients],
            "values": [[_finite(x) for x in row] for row in covariance],
        },
        "selection": None if selection is None else _ranking(selection[result.axis.name]),
        "selection_discrepancy": None if selection is None else selection[result.axis.name].discrepancy,
        "regression": {
            name: {"value": value, "std": std} for name, (value, std) in result.regression.items()
        },
    }


def _misfit(misfit: Misfit) -> dict[str, Any]:
    return {
        "of": misfit.curve,
        "largest_deviation": _finite(misfit.largest),
        "at": _finite(misfit.at),
        "at_unit": misfit.unit,
        "rms_deviation": _finite(misfit.rms),
        "octave_deviation": _finite(misfit.sustained),
        "scatter": _finite(misfit.scatter),
    }


def _term(term: NoiseTerm) -> dict[str, Any]:
    values = {p.name: getattr(term, p.name) for p in term.parameters()}
    return {
        "term": term.name(),
        "parameters": {name: _start(x) for name, x in values.items()},
        "held": sorted(term.held),
    }


def _start(x: float | None) -> float | str | None:
    return x if x is None else float(x) if math.isfinite(x) else INFINITY


def _curve(curve: AllanDeviation, axes: Sequence[str]) -> dict[str, Any]:
    def by_axis(values: Float[np.ndarray, "m axes"]) -> dict[str, list[float | None]]:
        return {axis: [_finite(x) for x in column] for axis, column in zip(axes, values.T, strict=True)}

    return {
        "kind": curve.kind,
        "overlapping": curve.overlapping,
        "estimator": curve.estimator,
        "cluster_time_s": curve.cluster_time.tolist(),
        "cluster_size": curve.cluster_size.tolist(),
        "count": curve.count.tolist(),
        "deviation": by_axis(curve.deviation),
        "degrees_of_freedom": by_axis(curve.edf),
    }


def _ranking(selection: AxisSelection) -> list[dict[str, Any]]:
    # With the set of all terms, which says what there was to choose from.
    whole = max(selection.ranking, key=lambda s: len(s.terms))
    first = selection.ranking[:3]
    sets = [s for s in selection.ranking if s in first or s.probability > _IMPROBABLE or s == whole]
    return [
        {
            "terms": list(s.terms),
            "parameters": s.parameters,
            "probability": s.probability,
            "log_evidence": _finite(s.log_evidence - selection.best.log_evidence),
            "chosen": s == selection.chosen,
        }
        for s in sets
    ]


def _coefficient(c: Coefficient) -> dict[str, Any]:
    shown, si = c.in_unit(), c.in_unit(c.si_unit)
    return {
        "label": c.label,
        "term": c.term,
        "symbol": c.parameter.symbol,
        "kind": c.parameter.kind,
        "detected": c.detected,
        "held": c.held,
        "measured": c.measured,
        "unit": shown.unit,
        **_numbers(shown),
        "si": {"unit": si.unit, **_numbers(si)},
    }


def _numbers(c: Coefficient) -> dict[str, Any]:
    return {
        "value": _finite(c.value),
        "std": _finite(c.std),
        "interval_68": [_finite(x) for x in c.interval_68],
        "interval_95": [_finite(x) for x in c.interval],
        "upper_limit_95": None if c.upper_limit is None else _finite(c.upper_limit),
        "lower_limit_95": c.lower_limit,
    }


def _finite(x: float) -> float | None:
    """JSON has no NaN and no infinity, and an empty cell is the CSV for neither."""
    return float(x) if math.isfinite(x) else None


def _write_csv(path: str | os.PathLike[str], header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    with Path(path).open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(header)
        writer.writerows(rows)
