"""Files of a fit: JSON after `schema("fit")`, CSV tables and figures."""

import csv
import io
import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from allanjax.base.errors import AllanjaxError
from allanjax.comparison.specification import LimitCheck, SpecCheck
from allanjax.estimate.as_json import to_dict
from allanjax.estimate.check import Check
from allanjax.estimate.result import Fit
from allanjax.fleet.fleet import FleetResult
from allanjax.noise.state_space import StateSpace
from allanjax.record.units import rate_unit_of
from allanjax.spectrum.psd import PowerSpectrum

# List of numbers in JSON, one in each line.
_NUMBERS = re.compile(r"\[\n\s+((?:-?[\d.eE+-]+|null)(?:,\n\s+(?:-?[\d.eE+-]+|null))*)\n\s+\]")

_COEFFICIENT_COLUMNS = (
    *("axis", "coefficient", "value", "std", "lower_95", "upper_95", "unit"),
    *("detected", "held", "measured", "upper_limit_95", "reason"),
)


def write_json(
    fit: Fit, path: str | os.PathLike[str], check: Check | None = None, spec: SpecCheck | None = None
) -> None:
    """Write `to_dict(fit)` to a file of JSON, with checks of its recording and of limits if there are any."""
    write_document(with_checks(fit, check, spec), path)


def write_document(document: Any, path: str | os.PathLike[str]) -> None:
    """Write plain dictionaries and lists to a file of JSON."""
    text = json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False)
    # Numbers of a list side by side: in texts there are no line breaks.
    text = _NUMBERS.sub(lambda match: f"[{', '.join(match[1].split()).replace(',,', ',')}]", text)
    # A name may come from a file name that is no text.
    Path(path).write_text(text + "\n", encoding="utf-8", errors="backslashreplace")


def with_checks(fit: Fit, check: Check | None, spec: SpecCheck | None = None) -> dict[str, Any]:
    """The fit as plain dictionaries, with checks of its recording and of limits if there are any."""
    checks = {"check": check, "spec": spec}
    return {**to_dict(fit), **{key: x.to_dict() for key, x in checks.items() if x is not None}}


def to_junit(spec: SpecCheck) -> str:
    """The checks of limits as JUnit XML."""
    return _junit([spec], [""])


def fleet_to_junit(fleet: FleetResult) -> str:
    """The checks of a fleet's recordings as JUnit XML, a test suite each."""
    return _junit(fleet.checks, [f"{check.name}." for check in fleet.checks])


def _junit(specs: Sequence[SpecCheck], begins: Sequence[str]) -> str:
    """JUnit XML of several recordings, and how the names of their axes begin."""
    root = ElementTree.Element("testsuites", _counts([r for spec in specs for r in spec.results]))
    for spec, begin in zip(specs, begins, strict=True):
        named = {"name": f"{spec.name} against {spec.sheet}", **_counts(spec.results)}
        _add_cases(ElementTree.SubElement(root, "testsuite", named), spec, begin)
    ElementTree.indent(root)
    text = ElementTree.tostring(root, encoding="unicode")
    # Control characters, which a name may have, are not allowed in XML.
    return (
        '<?xml version="1.0" encoding="utf-8"?>\n'
        + re.sub(r"[^\t\n -\ud7ff\ue000-\U0010ffff]", "?", text)
        + "\n"
    )


def _counts(results: Sequence[LimitCheck]) -> dict[str, str]:
    """How many checks there are, and how many of them are not met or undecided."""
    verdicts = [result.verdict for result in results]
    counts = {"tests": len(verdicts), "failures": verdicts.count("fail"), "errors": 0}
    return {key: str(count) for key, count in (counts | {"skipped": verdicts.count("undecided")}).items()}


def _add_cases(suite: ElementTree.Element, spec: SpecCheck, begin: str) -> None:
    """Add a test case for each limit and axis."""
    for result in spec.results:
        name = f"{result.limit.title} ({result.limit.meaning})"
        case = ElementTree.SubElement(suite, "testcase", {"classname": begin + result.axis, "name": name})
        value, limit, unit, margin, chance, verdict = result.row()[2:]
        text = f"estimate {value}, limit {limit} {unit}, margin {margin}, probability to meet it {chance}"
        if verdict in ("fail", "undecided"):
            kind = "failure" if verdict == "fail" else "skipped"
            ElementTree.SubElement(case, kind, {"message": result.reason or text})
        ElementTree.SubElement(case, "system-out").text = text


def curve_csv(fit: Fit) -> str:
    """CSV of the Allan deviations with 68 % intervals and those of the model, one row per cluster time.

    The header states the unit of each axis: that of the recording, or rad/s or m/s² for increments. The
    model's column is empty for an axis without a result.
    """
    curve = fit.curve
    columns = {"cluster_time [s]": curve.cluster_time}
    lower, upper = curve.confidence_interval(0.68)
    for k, result in enumerate(fit.results):
        unit, scale = rate_unit_of(result.axis.unit, result.axis.sensor)
        name = result.axis.name
        parts = {"deviation": curve.deviation[:, k], "lower_68": lower[:, k], "upper_68": upper[:, k]}
        parts["model"] = np.full(len(lower), np.nan)
        if result.converged:
            parts["model"] = fit.model_deviation(name, curve.cluster_time)
        columns |= {f"{name} {kind} [{unit}]": part / scale for kind, part in parts.items()}
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    return _csv(list(columns), [dict(zip(columns, row, strict=True)) for row in rows])


def coefficients_csv(fit: Fit) -> str:
    """CSV of one row per coefficient in its usual unit, and one with the reason per axis without a result.

    A coefficient that is not a measurement (see `AxisFit.measured`) has a reason but no error or interval.
    """
    rows: list[dict[str, Any]] = []
    for result in fit.results:
        if not result.converged:
            rows.append({"axis": result.axis.name, "reason": result.reason})
            continue
        for c in result.coefficients.values():
            flags = {name: str(getattr(c, name)).lower() for name in ("detected", "held", "measured")}
            rows.append({**c.row(), **flags, "reason": "" if c.measured else result.verdict})
    rows += [{"axis": dead.axis.name, "reason": dead.reason} for dead in fit.dead]
    return _csv(_COEFFICIENT_COLUMNS, rows)


def write_curve_csv(fit: Fit, path: str | os.PathLike[str]) -> None:
    """Write the Allan deviations and those of the model to a file; see `curve_csv`."""
    _write(curve_csv(fit), path)


def write_coefficients_csv(fit: Fit, path: str | os.PathLike[str]) -> None:
    """Write the coefficients to a file, one row each; see `coefficients_csv`."""
    _write(coefficients_csv(fit), path)


def write_results(
    fit: Fit,
    spectrum: PowerSpectrum | None,
    directory: str | os.PathLike[str],
    name: str,
    check: Check | None = None,
    figure_format: str = "png",
    spec: SpecCheck | None = None,
) -> tuple[Path, ...]:
    """Write NAME.json, NAME_{allan,coefficients}.csv and figures NAME_{allan,psd}.png; returns their paths.

    Without a spectrum, as for a recording read in chunks, there is no NAME_psd.png; with the check of limits
    there is NAME_spec.xml.
    """
    from allanjax.presentation.spectrum_figure import plot_psd

    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    paths = [directory / f"{name}.json"]
    write_json(fit, paths[0], check, spec)
    if spec is not None:
        paths.append(directory / f"{name}_spec.xml")
        paths[-1].write_text(spec.to_junit(), encoding="utf-8")
    for suffix, write in (("allan", write_curve_csv), ("coefficients", write_coefficients_csv)):
        paths.append(directory / f"{name}_{suffix}.csv")
        write(fit, paths[-1])
    paths.append(directory / f"{name}_allan.{figure_format}")
    fit.plot(path=paths[-1])
    if spectrum is not None:
        paths.append(directory / f"{name}_psd.{figure_format}")
        plot_psd(spectrum, fit, path=paths[-1])
    return tuple(paths)


def _csv(header: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> str:
    """Columns of rows; a number that is missing or not finite is an empty cell."""
    text = io.StringIO(newline="")
    table = csv.writer(text)
    table.writerow(header)
    for row in rows:
        cells = map(row.get, header)
        table.writerow(None if isinstance(x, float) and not math.isfinite(x) else x for x in cells)
    return text.getvalue()


def _write(text: str, path: str | os.PathLike[str]) -> None:
    Path(path).write_text(text, encoding="utf-8", errors="backslashreplace", newline="")


_MATRICES = ("A", "H", "Q", "R", "P0")
_LAW = "x[k+1] = A x[k] + w[k], z[k] = H x[k] + v[k], cov w = Q, cov v = R, cov x[0] = P0; SI"


def to_numpy(space: StateSpace, path: str | os.PathLike[str]) -> None:
    """Write an .npz file of A, H, Q, R, P0, names, units and rate."""
    with open(path, "wb") as file:
        np.savez(
            file,
            **{name: getattr(space, name) for name in _MATRICES},
            names=np.array(space.names, str),
            units=np.array(space.units, str),
            rate=space.rate,
        )


def to_matlab(space: StateSpace) -> str:
    """Text of a MATLAB script that defines A, H, Q, R, P0, names, units and rate, to all digits."""
    lines = [f"% {_LAW}", f"% {space.model}", f"rate = {space.rate!r}; % Hz"]
    for name in _MATRICES:
        matrix = getattr(space, name)
        # An empty matrix keeps its shape.
        rows = ["  " + " ".join(repr(float(x)) for x in row) for row in matrix]
        text = "[\n" + ";\n".join(rows) + "]" if matrix.size else "zeros({}, {})".format(*matrix.shape)
        lines.append(f"{name} = {text};")
    for name in ("names", "units"):
        values = ", ".join("'" + text.replace("'", "''") + "'" for text in getattr(space, name))
        lines.append(f"{name} = {{{values}}};")
    return "\n".join(lines) + "\n"


def to_c_header(space: StateSpace, prefix: str = "noise") -> str:
    """Text of a C header: constants `NOISE_STATES` and `NOISE_RATE`, arrays `noise_A` to `noise_P0`.

    Raises:
        AllanjaxError: the prefix is not a C identifier, or the model has no states, as C has no empty arrays.
    """
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", prefix):
        raise AllanjaxError(f"the prefix of a C header must be a C identifier such as noise, not {prefix!r}")
    if not space.size:
        raise AllanjaxError(f"{space.model} has no states, only white noise R, so it needs no header")
    own = prefix.upper()
    lines = [f"/* {_LAW}", f"   {space.model} */", f"#ifndef {own}_H", f"#define {own}_H", ""]
    lines += [f"#define {own}_STATES {space.size}", f"#define {own}_RATE {space.rate!r} /* Hz */", ""]
    states = zip(space.names, space.units, strict=True)
    lines += [f"/* state {k}: {name} [{unit}] */" for k, (name, unit) in enumerate(states)]
    for name in _MATRICES:
        matrix = getattr(space, name)
        rows = ["    {" + ", ".join(repr(float(x)) for x in row) + "}" for row in matrix]
        shape = "".join(f"[{n}]" for n in matrix.shape)
        lines += [f"static const double {prefix}_{name}{shape} = {{", ",\n".join(rows), "};"]
    return "\n".join([*lines, "", f"#endif /* {own}_H */"]) + "\n"
