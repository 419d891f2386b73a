"""Sections of a fleet's page: its summary, the distribution of each coefficient, and a table of the units."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from allanjax.fleet.fleet import FleetResult
from allanjax.fleet.table import lines_of, tables
from allanjax.noise.estimate import SYMBOLS, title_of
from allanjax.presentation.draw import SENSORS
from allanjax.presentation.page.blocks import (
    Block,
    Chart,
    Fold,
    Mark,
    Row,
    Section,
    Table,
    Text,
    Trace,
    Units,
    View,
)
from allanjax.record.units import unit_scale

if TYPE_CHECKING:
    import pandas as pd


def of_fleet(fleet: FleetResult, pages: Mapping[str, str]) -> Iterator[Section]:
    """Sections about a fleet; `pages` are the addresses of the units' own pages by their names."""
    table = fleet.table
    outlying = sorted(set(fleet.outlying["recording"]))
    style = "care" if outlying or fleet.errors else "good"
    verdict = f"{len(outlying) or 'No'} outlying unit{'' if len(outlying) == 1 else 's'}"
    blocks: list[Block] = [Text(f"{verdict}; {fleet.summary}.", f"verdict {style}")]
    blocks += [Table.of(columns) for columns in tables(table) if sum(any(c.cells) for c in columns) > 1]
    blocks += [Text(line, "note") for line in lines_of(table)]
    blocks += [Text(note, "warning") for note in fleet.notes]
    if fleet.errors:
        errors = [Text(f"{error['file']}: {error['message']}", "warning") for error in fleet.errors]
        blocks.append(Fold(f"{len(errors)} errors", errors))
    yield Section("Result", blocks)
    if charts := list(_distributions(table)):
        yield Section("Distributions", [Row(charts)])
    yield Section("Units", [_units(table, pages)])


def _distributions(table: pd.DataFrame) -> Iterator[Chart]:
    """Values of each coefficient in ascending order, with their intervals; outlying units are named."""
    found = table[table["detected"] & table["measured"]]
    parts: Mapping[Any, Any] = dict(iter(found.groupby(["sensor", "coefficient"], sort=False)))
    for (sensor, coefficient), of in parts.items():
        traces, marks, axes = list[Trace](), list[Mark](), list(of["axis"].unique())
        unit, si = of["unit"].iloc[0], unit_scale(of["unit"].iloc[0], sensor)
        for group, axis in enumerate(axes):
            own = of[of["axis"] == axis].sort_values("value")
            share = 100.0 * (np.arange(len(own)) + 0.5) / len(own)
            value, low, high = (own[name].to_numpy() * si for name in ("value", "lower_95", "upper_95"))
            names, numbers = own["recording"].tolist(), range(len(own))
            traces.append(Trace(group, "units", share, value, low, high, labels=numbers, names=names))
            places = np.flatnonzero(own["outlying"].to_numpy()).tolist()
            marks += [Mark(names[k], float(share[k]), float(value[k]), group) for k in places]
        title = f"{title_of(coefficient, sensor)}, {SENSORS[sensor]}"
        view = View(
            *(coefficient, "units up to this value", "%", title_of(coefficient, sensor)),
            units=[(unit, si)],
            groups=axes,
            traces=traces,
            marks=marks,
            log="y",
        )
        yield Chart(title.capitalize(), [view], f"Distribution over {len(of['recording'].unique())} units.")


def _units(table: pd.DataFrame, pages: Mapping[str, str]) -> Units:
    """One row per unit: its coefficients, which are limits where it has a "<", and its remarks."""
    shown = table[table["measured"]]
    known = shown[shown["coefficient"].isin(shown.loc[shown["detected"], "coefficient"])]
    columns = list(dict.fromkeys(zip(known["coefficient"], known["axis"], known["unit"], strict=True)))
    cells: dict[str, dict[tuple[str, str], Any]] = {}
    fields = ("recording", "coefficient", "axis", "value", "detected", "upper_limit_95")
    for name, coefficient, axis, value, detected, limit in zip(*(shown[f] for f in fields), strict=True):
        below = None if limit is None or np.isnan(limit) else f"< {limit:.3g}"
        cells.setdefault(name, {})[coefficient, axis] = float(f"{value:.4g}") if detected else below
    rows, marked = list[list[Any]](), list[int]()
    outlying = set(table.loc[table["outlying"], "recording"])
    for name, texts in table.groupby("recording", sort=False)[["remarks", "warnings"]]:
        own, unit = cells.get(str(name), {}), str(name)
        remarks = dict.fromkeys(text for text in texts.to_numpy().ravel() if text)
        marked += [len(rows)] if unit in outlying else []
        first = [unit, pages[unit]] if unit in pages else unit
        rows.append([first, *(own.get((c, axis)) for c, axis, _ in columns), "; ".join(remarks)])
    symbols = [SYMBOLS.get(label, label.replace("_", " ")) for label, *_ in columns]
    names = [f"{axis} {symbol} [{unit}]" for symbol, (_, axis, unit) in zip(symbols, columns, strict=True)]
    return Units(["unit", *names, "remarks"], rows, marked)
