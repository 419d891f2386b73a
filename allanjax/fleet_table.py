"""The table of a fleet: one row a recording, axis and coefficient."""

from __future__ import annotations

import functools
import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from allanjax.outliers import FALSE_ALARMS, outlying

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa


@functools.cache
def table_schema() -> pa.Schema:
    """Columns and types of the Parquet file, the same whatever is in it."""
    import pyarrow as pa

    text, number, flag = pa.string(), pa.float64(), pa.bool_()
    return pa.schema(
        {
            "recording": text,
            "file": text,
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
        }
    )


def rows_of(fit: Mapping[str, Any], recording: str, file: str) -> list[dict[str, Any]]:
    """The rows of one recording, from its fit as `export.to_dict` gives it; outlying units are marked later.

    Axes without result have no rows.
    """
    rows = []
    for axis in fit["axes"]:
        for c in axis["coefficients"]:
            rows.append(
                {
                    "recording": recording,
                    "file": file,
                    "axis": axis["name"],
                    "sensor": axis["sensor"],
                    "coefficient": c["label"],
                    "value": c["value"],
                    "std": c["std"],
                    "lower_95": c["interval_95"][0],
                    "upper_95": c["interval_95"][1],
                    "unit": c["unit"],
                    "detected": c["detected"],
                    "upper_limit_95": c["upper_limit_95"],
                    "measured": c["measured"],
                    "p_value": axis["p_value"],
                    "terms": " + ".join(_terms(axis)),
                    "outlying": False,
                }
            )
    return rows


def fleet_table(rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """The rows as a table, with outlying units marked (see `mark_outlying`)."""
    import pyarrow as pa

    return mark_outlying(pa.Table.from_pylist(list(rows), table_schema()).to_pandas())


def mark_outlying(table: pd.DataFrame) -> pd.DataFrame:
    """A copy whose column `outlying` says which values are unlike those of the other units.

    The values of one coefficient on one axis are compared over the fleet, as `outliers.outlying` says. The
    probability that anything is marked in a fleet of like units is 1 % for the whole table (Bonferroni: every
    coefficient of every axis has its share).
    """
    marked = np.zeros(len(table), bool)
    groups = table.groupby(["axis", "coefficient"], sort=False).indices
    numbers = ("value", "lower_95", "upper_95", "upper_limit_95")
    for rows in groups.values():
        value, lower, upper, limit = (table[name].to_numpy()[rows] for name in numbers)
        detected = table["detected"].to_numpy()[rows]
        marked[rows] = outlying(value, lower, upper, limit, detected, FALSE_ALARMS / len(groups))
    return table.assign(outlying=marked)


def write_table(table: pd.DataFrame, path: str | os.PathLike[str]) -> None:
    """Write the table to a Parquet file."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    pq.write_table(pa.Table.from_pandas(table, table_schema(), preserve_index=False), path)


def _terms(axis: Mapping[str, Any]) -> list[str]:
    """The terms that the fit chose for the axis, or was given."""
    for s in axis["selection"] or ():
        if s["chosen"]:
            return list(s["terms"])
    return list(dict.fromkeys(c["term"] for c in axis["coefficients"]))
