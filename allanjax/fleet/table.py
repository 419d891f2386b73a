"""Table of a fleet, with a row for each recording, axis and coefficient, and remarks on its units."""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from allanjax.base.wording import plain
from allanjax.fleet.outlying_units import FALSE_ALARMS, FEWEST_UNITS, Values, log_values, outlying, testable
from allanjax.inspection.facts import why_no_measurement
from allanjax.record.units import Sensor

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

# Columns that say how large a coefficient is.
_NUMBERS = ("value", "lower_95", "upper_95", "upper_limit_95")
# Columns that a coefficient has in the JSON, too.
_AS_IN_JSON = ("value", "std", "unit", "detected", "upper_limit_95", "measured")


@functools.cache
def table_schema() -> pa.Schema:
    """Columns of the Parquet file and their types, the same whatever is in it."""
    import pyarrow as pa

    text, number, flag = pa.string(), pa.float64(), pa.bool_()
    types = (
        ("recording file group axis sensor coefficient", text),
        ("value std lower_95 upper_95", number),
        ("unit", text),
        ("detected", flag),
        ("upper_limit_95", number),
        ("measured", flag),
        ("p_value", number),
        ("terms", text),
        ("outlying", flag),
        ("start_s stop_s", number),
        ("remarks warnings", text),
    )
    return pa.schema([(name, kind) for names, kind in types for name in names.split()])


def rows_of(fit: Mapping[str, Any], recording: str, file: str, group: str = "") -> list[dict[str, Any]]:
    """Rows of one recording, from its fit as `as_json.to_dict` gives it.

    Axes without a result have no rows, nor have the filters, resonances and lines for which an axis was
    corrected, which are among its remarks. Outlying units are marked later.
    """
    about = {axis.axis: axis for axis in structures(fit)}
    start, stop = fit["stretch_s"] or (None, None)
    of_all = {
        "recording": recording,
        "file": file,
        "group": group,
        "outlying": False,
        "start_s": start,
        "stop_s": stop,
        "warnings": "\n".join(fit["warnings"]),
    }
    return [
        {name: c[name] for name in _AS_IN_JSON}
        | {
            "axis": axis["name"],
            "sensor": axis["sensor"],
            "coefficient": c["label"],
            "lower_95": c["interval_95"][0],
            "upper_95": c["interval_95"][1],
            "p_value": axis["p_value"],
            "terms": " + ".join(about[axis["name"]].terms),
            "remarks": ", ".join(map(str, about[axis["name"]].remarks)),
        }
        | of_all
        for axis in fit["axes"]
        if axis["converged"]
        for c in axis["coefficients"]
        # Filters, resonances and lines are numbered by their strength: units do not compare in them.
        if c["term"] not in (axis["extension"] or {"further": ()})["further"]
    ]


def table_of(rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Table of these rows, with the columns and types of `table_schema`."""
    import pyarrow as pa

    return pa.Table.from_pylist(list(rows), table_schema()).to_pandas()


@dataclass(frozen=True, eq=False)
class Family:
    """One coefficient of the units of a group, on all axes of a sensor.

    Attributes:
        sensor, coefficient: sensor, label of the coefficient.
        recordings: names of the units.
        rows: their rows in the table, −1 where there is none.
        axes: logarithms of the coefficient on each axis.
    """

    sensor: Sensor
    coefficient: str
    recordings: Sequence[str]
    rows: Int[np.ndarray, "units axes"]
    axes: list[Values]


def families(table: pd.DataFrame) -> Iterator[Family]:
    """Coefficients of every sensor and group, in the order of the table."""
    value, lower, upper, limit = (np.append(table[name].to_numpy(), np.nan) for name in _NUMBERS)
    is_detected = np.append(table["detected"].to_numpy(), False)
    parts: Mapping[Any, Any] = table.groupby(["group", "sensor", "coefficient"], sort=False).indices
    for (_, sensor, coefficient), places in parts.items():
        of = table.iloc[places]
        units, names = of["recording"].factorize()
        columns, axes = of["axis"].factorize()
        rows = np.full((len(names), len(axes)), -1)
        rows[units, columns] = places
        values = [log_values(value[r], lower[r], upper[r], limit[r], is_detected[r]) for r in rows.T]
        yield Family(sensor, coefficient, list(names), rows, values)


def mark_outlying(table: pd.DataFrame) -> pd.DataFrame:
    """Copy whose column `outlying` marks values that differ from those of the other units of the group.

    `outlying_units.outlying` judges a coefficient by all axes of a sensor. In a fleet of equal units, the
    probability of any mark is 1 % (Bonferroni: every coefficient has its share).
    """
    judged = [family for family in families(table) if testable(family.axes)]
    marked = np.zeros(len(table) + 1, bool)
    for family in judged:
        found = outlying(family.axes, FALSE_ALARMS / len(judged), family.coefficient)
        marked[family.rows[found]] = True
    return table.assign(outlying=marked[:-1])


def write_table(table: pd.DataFrame, path: str | os.PathLike[str]) -> None:
    """Write the table to a Parquet file."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    pq.write_table(pa.Table.from_pandas(table, table_schema(), preserve_index=False), path)


# --- Remarks on the units: what was corrected, left out or is wrong, in a few words per axis ----------------

# Kinds of facts and terms whose name in a remark is another; others have their own.
_NAMES = {
    "lines": "line",
    "sinusoid": "line",
    "dead axes": "dead",
    "at rest": "moved",
    "disturbances": "disturbed",
}
# Units of sizes that a remark has.
_UNITS = ("Hz", "%", "s")
# Frequencies that differ by less than this share are one.
_SAME = 0.1
# What so few of the other units have, or so many, is unusual where a unit has it, or lacks it.
_RARE, _USUAL = 0.25, 0.75

NOT_MEASURED, INCOMPLETE = "not a measurement", "misfit"


class Remark(NamedTuple):
    """Something about an axis, e.g. a line at 7.3 Hz, for which its noise terms may have been corrected.

    `size` is nan where no number says how large it is.
    """

    kind: str
    size: float = np.nan
    unit: str = ""
    corrected: bool = False

    def __str__(self) -> str:
        return f"{self.kind} {plain(self.size, 2)} {self.unit}" if np.isfinite(self.size) else self.kind

    def like(self, other: Remark) -> bool:
        """Whether another one is of the same kind, and, if of a frequency, of the same one."""
        if self.unit == other.unit == "Hz" and self.size > 0.0 and other.size > 0.0:
            return self.kind == other.kind and abs(np.log(self.size / other.size)) < _SAME
        return self.kind == other.kind


class AxisStructure(NamedTuple):
    """What the model of an axis consists of: its terms and the remarks on it."""

    axis: str
    sensor: str
    terms: Sequence[str]
    remarks: Sequence[Remark]


def structures(fit: Mapping[str, Any]) -> list[AxisStructure]:
    """Terms of each axis with a result, and remarks on it, the gravest first, by a fit's JSON."""
    return [
        AxisStructure(axis["name"], axis["sensor"], terms_of(axis), _remarks(fit, axis))
        for axis in fit["axes"]
        if axis["converged"]
    ]


def terms_of(axis: Mapping[str, Any]) -> list[str]:
    """Terms that the fit chose for the axis, or was given."""
    for s in axis["selection"] or ():
        if s["chosen"]:
            return list(s["terms"])
    return list(dict.fromkeys(c["term"] for c in axis["coefficients"]))


def why_not_measured(axis: Mapping[str, Any]) -> str:
    """Why an axis's coefficients are not a measurement of the sensor, in words, by the axis's JSON."""
    return why_no_measurement(axis["not_measured"]) or "the model does not fit"


def _remarks(fit: Mapping[str, Any], axis: Mapping[str, Any]) -> list[Remark]:
    found = []
    if not axis["measured"]:
        found.append(Remark(NOT_MEASURED))
    elif axis["discrepancy"]:
        found.append(Remark(INCOMPLETE))
    if (extension := axis["extension"]) is not None:
        found += [_correction(label, axis, extension) for label in extension["further"]]
    for fact in fit["facts"]:
        remark = _of_fact(fact)
        if axis["name"] in fact["axes"] and remark and not any(remark.like(other) for other in found):
            found.append(remark)
    return found


def _correction(label: str, axis: Mapping[str, Any], extension: Mapping[str, Any]) -> Remark:
    """Remark on a term that a fit found besides the plain ones, or on its response."""
    kind = re.sub(r"_\d+$", "", label)
    is_term = kind in {term["term"] for term in extension["model"]}
    name = _NAMES.get(kind, kind.replace("_", " ")) if is_term else "filter"
    hertz = [c["value"] for c in axis["coefficients"] if c["term"] == label and c["unit"] == "Hz"]
    return Remark(name, hertz[0] if hertz else np.nan, "Hz", corrected=True)


def _of_fact(fact: Mapping[str, Any]) -> Remark | None:
    """Remark on a fact; None on what says nothing about the unit."""
    if fact["kind"] == "not examined":
        return None
    sized = fact["size"] is not None and fact["unit"] in _UNITS
    size = (fact["size"], fact["unit"]) if sized else ()
    cut = fact["kind"] == "disturbances" and bool(size)
    return Remark("cut" if cut else _NAMES.get(fact["kind"], fact["kind"]), *size)


def unlike_mates(units: Mapping[str, Sequence[AxisStructure]]) -> dict[str, str]:
    """What a unit's model has that few others have, or lacks that most have, by the unit's name.

    A term counts if most axes of a sensor have it, or none, as it may be chosen by chance on one axis; a
    remark counts on any axis.
    """
    found: dict[str, dict[str, list[str]]] = {}
    for sensor in dict.fromkeys(axis.sensor for unit in units.values() for axis in unit):
        own = {name: [axis for axis in unit if axis.sensor == sensor] for name, unit in units.items()}
        some = {name: _parts(axes, 0.0) for name, axes in own.items() if axes}
        most = {name: _parts(axes, 0.5) for name, axes in own.items() if axes}
        every = _distinct([part for unit in some.values() for part in unit])
        if len(some) < FEWEST_UNITS:
            continue
        any_has, most_have = (
            np.array([[any(x.like(y) for y in unit) for x in every] for unit in parts.values()], bool)
            for parts in (some, most)
        )
        rare = most_have & (_share_of_others(any_has) < _RARE)
        lacking = ~any_has & (_share_of_others(most_have) > _USUAL)
        for name, has, lacks in zip(some, rare, lacking, strict=True):
            words = [str(x) for x, it in zip(every, has, strict=True) if it]
            words += [f"no {x}" for x, it in zip(every, lacks, strict=True) if it]
            if words:
                found.setdefault(name, {}).setdefault(", ".join(words).replace("_", " "), []).append(sensor)
    return {
        name: "; ".join(f"{', '.join(sensors)}: {words}" for words, sensors in of.items())
        for name, of in found.items()
    }


def _parts(axes: Sequence[AxisStructure], share: float) -> list[Remark]:
    """Remarks on these axes, and terms that more than a share of them have."""
    terms = dict.fromkeys(term for axis in axes for term in axis.terms)
    usual = [term for term in terms if sum(term in axis.terms for axis in axes) > share * len(axes)]
    return _distinct([*map(Remark, usual), *(remark for axis in axes for remark in axis.remarks)])


def _share_of_others(has: Bool[np.ndarray, "units parts"]) -> Float[np.ndarray, "units parts"]:
    """Share of the other units that have each part."""
    return (has.sum(axis=0) - has) / (len(has) - 1)


def _distinct(remarks: Sequence[Remark]) -> list[Remark]:
    """Remarks without those that are like an earlier one."""
    found: list[Remark] = []
    for remark in remarks:
        if not any(remark.like(other) for other in found):
            found.append(remark)
    return found
