"""Files of a fit: JSON after `fit.schema.json`, CSV tables and figures."""

import csv
import json
import os
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from allanjax.base.wording import finite_or_none
from allanjax.estimate.as_json import _numbers, to_dict
from allanjax.estimate.result import Fit
from allanjax.record.units import rate_unit_of
from allanjax.spectrum.psd import PowerSpectrum

# List of numbers in JSON, one in each line.
_NUMBERS = re.compile(r"\[\n\s+((?:-?[\d.eE+-]+|null)(?:,\n\s+(?:-?[\d.eE+-]+|null))*)\n\s+\]")


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
    for k, result in enumerate(fit.results):
        unit, scale = rate_unit_of(result.axis.unit, result.axis.sensor)
        name = result.axis.name
        model = (
            fit.model_deviation(name, fit.curve.cluster_time)
            if result.converged
            else np.full(len(fit.curve.cluster_time), np.nan)
        )
        header += [f"{name} {kind} [{unit}]" for kind in ("deviation", "lower_68", "upper_68", "model")]
        columns += [part / scale for part in (fit.curve.deviation[:, k], lower[:, k], upper[:, k], model)]
    _write_csv(path, header, ([finite_or_none(x) for x in row] for row in np.stack(columns, axis=1)))


def write_coefficients_csv(fit: Fit, path: str | os.PathLike[str]) -> None:
    """Write one row a coefficient, in its usual unit; an axis without result has one row with the reason.

    A coefficient that is not a measurement (see `AxisFit.measured`) has no error and no interval, but a
    reason.
    """
    header = ["axis", "coefficient", "value", "std", "lower_95", "upper_95", "unit"]
    header += ["detected", "held", "measured"]
    rows: list[list[Any]] = []
    for result in fit.results:
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


#: What is written of every fit: the end of the file's name, and what writes it.
FILES: tuple[tuple[str, Callable[[Fit, Path], object]], ...] = (
    (".json", write_json),
    ("_allan.csv", write_curve_csv),
    ("_coefficients.csv", write_coefficients_csv),
    ("_allan.png", lambda fit, path: fit.plot(path=path)),
)


def write_results(
    fit: Fit, spectrum: PowerSpectrum | None, directory: str | os.PathLike[str], name: str
) -> tuple[Path, ...]:
    """Write NAME.json, NAME_{allan,coefficients}.csv and NAME_{allan,psd}.png; returns their paths.

    Without a spectrum, as of a recording that was read in chunks, there is no NAME_psd.png.
    """
    from allanjax.report.spectrum_figure import plot_psd

    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    paths = [directory / f"{name}{suffix}" for suffix, _ in FILES]
    for path, (_, write) in zip(paths, FILES, strict=True):
        write(fit, path)
    if spectrum is not None:
        paths.append(directory / f"{name}_psd.png")
        plot_psd(spectrum, fit, path=paths[-1])
    return tuple(paths)


def _write_csv(path: str | os.PathLike[str], header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    with Path(path).open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(header)
        writer.writerows(rows)
