"""Table of a fleet, with a row for each recording, axis and coefficient."""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Int

from allanjax.fleet.outlying_units import FALSE_ALARMS, Values, log_values, outlying, testable
from allanjax.fleet.remarks import structures
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
    return pa.schema(
        {
            "recording": text,
            "file": text,
            "group": text,
            "axis": text,
            "sensor": text,
            "coefficient": text,
            "value": number,
            "std": number,
            "lower_95": number,
            "upper_95": number,
            "unit": text,
            "detected": flag,
            "upper_limit_95": number,
            "measured": flag,
            "p_value": number,
            "terms": text,
            "outlying": flag,
            "start_s": number,
            "stop_s": number,
            "remarks": text,
            "warnings": text,
        }
    )


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
