"""Table of a fleet, with one row per recording, axis and coefficient; remarks, notes and printed tables."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Int

from allanjax.base.tables import Column, Number, column, columns_from, tables_of
from allanjax.base.wording import format_interval, plain, significant
from allanjax.estimate.result import MAIN
from allanjax.fleet.comparison import (
    FALSE_ALARMS,
    FEWEST_UNITS,
    Marks,
    Values,
    log_values,
    outlying,
    two_groups,
)
from allanjax.fleet.units import joined, odd_records, over_others, scatters, united
from allanjax.inspection.facts import listed, why_no_measurement
from allanjax.noise.estimate import SYMBOLS, title_of
from allanjax.record.units import Sensor

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

# Columns with the size of a coefficient.
_NUMBERS = ("value", "lower_95", "upper_95", "upper_limit_95")
# Columns that a coefficient has in the JSON, too.
_AS_IN_JSON = ("value", "std", "unit", "detected", "upper_limit_95", "measured")
# Names in a remark for kinds of facts and terms; others have their own name.
_NAMES = {
    "lines": "line",
    "sinusoid": "line",
    "dead axes": "dead",
    "at rest": "moved",
    "disturbances": "disturbed",
}
# Units of sizes that a remark has.
_UNITS = ("Hz", "%", "s")
# Names that a note lists at most.
_NAMED = 5
#: Units with remarks, or limits that are not met, that are printed at most.
ROWS = 40
# Characters of the names in a cell.
_SHORT = 28
# The ratios of a sensor's axes are reported as one number if they agree within this factor.
_ALIKE = 1.1


@functools.cache
def table_schema() -> pa.Schema:
    """Columns of the Parquet file and their types, the same whatever is in it."""
    import pyarrow as pa

    kinds = [
        (pa.string(), "recording file unit_name group axis sensor coefficient"),
        (pa.float64(), "value std lower_95 upper_95"),
        (pa.string(), "unit"),
        (pa.bool_(), "detected"),
        (pa.float64(), "upper_limit_95"),
        (pa.bool_(), "measured"),
        (pa.float64(), "p_value"),
        (pa.string(), "terms"),
        (pa.bool_(), "outlying"),
        (pa.float64(), "ratio"),
        (pa.bool_(), "odd_record"),
        (pa.float64(), "record_ratio start_s stop_s"),
        (pa.string(), "remarks warnings"),
    ]
    return pa.schema({name: kind for kind, names in kinds for name in names.split()})


def rows_of(
    fit: Mapping[str, Any], recording: str, file: str, unit: str = "", group: str = ""
) -> list[dict[str, Any]]:
    """Rows of one recording, of a unit and a group, from its fit as `as_json.to_dict` gives it.

    Axes without a result have no rows, nor have the filters, resonances and lines for which an axis was
    corrected, which are among its remarks. Outlying units are marked later.
    """
    start, stop = fit["stretch_s"] or (None, None)
    of_all = {
        "recording": recording,
        "file": file,
        "unit_name": unit,
        "group": group,
        "outlying": False,
        "ratio": None,
        "odd_record": False,
        "record_ratio": None,
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
            "terms": " + ".join(_terms(axis)),
            "remarks": ", ".join(_remarks(fit, axis)),
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


class Family(NamedTuple):
    """One coefficient of the recordings of a group, on all axes of a sensor.

    Attributes:
        sensor, coefficient, group: sensor, label of the coefficient, group.
        units: names of the units.
        rows: rows of the recordings in the table, −1 where there is none.
        names: names of the axes.
        axes: logarithms of the coefficient on each axis; the part of a recording is its unit's number.
    """

    sensor: Sensor
    coefficient: str
    group: str
    units: Sequence[str]
    rows: Int[np.ndarray, "recordings axes"]
    names: Sequence[str]
    axes: Sequence[Values]

    def of_units(self, odd: Marks | None = None) -> list[Values]:
        """Logarithms of the units, without odd recordings."""
        none = np.zeros(self.rows.shape, bool)
        return [*map(united, self.axes, (none if odd is None else odd).T)]


def families(table: pd.DataFrame) -> Iterator[Family]:
    """Coefficients of every sensor and group, in the order of the table."""
    value, lower, upper, limit = (np.append(table[name].to_numpy(), np.nan) for name in _NUMBERS)
    is_detected = np.append(table["detected"].to_numpy(), False)
    parts: Mapping[Any, Any] = table.groupby(["group", "sensor", "coefficient"], sort=False).indices
    for (group, sensor, coefficient), places in parts.items():
        of = table.iloc[places]
        records, names = of["recording"].factorize()
        columns, axes = of["axis"].factorize()
        unit, units = of["unit_name"].iloc[np.unique(records, return_index=True)[1]].factorize()
        rows = np.full((len(names), len(axes)), -1)
        rows[records, columns] = places
        values = [
            log_values(value[r], lower[r], upper[r], limit[r], is_detected[r], part=unit) for r in rows.T
        ]
        yield Family(sensor, coefficient, group, list(units), rows, list(axes), values)


def judged(table: pd.DataFrame) -> tuple[pd.DataFrame, tuple[str, ...]]:
    """Table with outlying units and records marked, in two groups if units fall into these, and notes on it.

    Groups that a user named are not divided. `ratio` is the value over the median of its group's units,
    `record_ratio` that over the median of the other records of its unit.
    """
    table, notes = _in_groups(table)
    compared = list(families(table))
    alarms = FALSE_ALARMS / (1 + any(len(of.units) < len(of.rows) for of in compared))
    odd = _marked(compared, [of.axes for of in compared], odd_records, alarms)
    units = [of.of_units(records) for of, records in zip(compared, odd, strict=True)]
    flags = np.zeros((2, len(table) + 1), bool)
    ratios = np.full((2, len(table) + 1), np.nan)
    every = zip(compared, units, odd, _marked(compared, units, outlying, alarms), strict=True)
    for of, own, records, marks in every:
        flags[:, of.rows] = marks[of.axes[0].part], records
        for rows, axis, unit in zip(of.rows.T, of.axes, own, strict=True):
            x = unit.x[np.isfinite(unit.x)]
            middle = np.median(x) if len(x) else np.nan
            ratios[:, rows] = np.where(axis.known, np.exp([axis.x - middle, over_others(axis)]), np.nan)
    names = ("outlying", "odd_record", "ratio", "record_ratio")
    table = table.assign(**dict(zip(names, (*flags[:, :-1], *ratios[:, :-1]), strict=True)))
    return table, (*_warned(table), *notes, *_too_few(table))


def _marked(
    compared: Sequence[Family],
    values: Sequence[Sequence[Values]],
    test: Callable[[Sequence[Sequence[Values]], float], list[Marks]],
    alarms: float,
) -> list[Marks]:
    """Marks that a test gives the units or recordings of each family.

    Those of groups of three units, too few by themselves, are compared together, each about its own median.
    """
    few = FEWEST_UNITS - 1
    keys = [
        (of.sensor, of.coefficient, *of.names, "" if len(of.units) == few else of.group) for of in compared
    ]
    places = [[k for k, own in enumerate(keys) if own == key] for key in dict.fromkeys(keys)]
    together = [[*map(joined, zip(*(values[k] for k in of), strict=True))] for of in places]
    marks: dict[int, Marks] = {}
    for of, found in zip(places, test(together, alarms), strict=True):
        ends = np.cumsum([len(values[k][0].x) for k in of])
        marks |= zip(of, np.split(found, ends[:-1]), strict=True)
    return [marks[k] for k in range(len(compared))]


def _in_groups(table: pd.DataFrame) -> tuple[pd.DataFrame, list[str]]:
    """Table with the two groups that the units fall into, if they do, and a note on these."""
    count = table["unit_name"].nunique()
    whole = [family for family in families(table) if len(family.units) == count]
    splits = [two_groups(family.of_units()) for family in whole]
    best = int(np.argmax([0.0, *(split.gap for split in splits)])) - 1
    if (table["group"] != "").any() or best < 0 or splits[best].gap <= 1.0:
        return table, []
    family, split = whole[best], splits[best]
    group = dict(zip(family.units, np.where(split.is_upper, "2", "1").tolist(), strict=True))
    members = {g: [name for name, own in group.items() if own == g] for g in "12"}
    told = (f"{g} ({len(names)} units: {listed(names, _NAMED)})" for g, names in members.items())
    note = (
        f"the units fall into two groups in {title_of(family.coefficient, family.sensor)} "
        f"({family.sensor}), apart by a factor of {significant(split.ratio, 2)}: {', '.join(told)}. "
        "Units are compared within these; pass groups of your own with group= (--group)"
    )
    return table.assign(group=table["unit_name"].map(group)), [note]


def _terms(axis: Mapping[str, Any]) -> list[str]:
    """Terms that the fit chose for the axis, or was given."""
    chosen = next((s["terms"] for s in axis["selection"] or () if s["chosen"]), None)
    return list(dict.fromkeys(c["term"] for c in axis["coefficients"]) if chosen is None else chosen)


def why_not_measured(axis: Mapping[str, Any]) -> str:
    """Why an axis's coefficients are not a measurement of the sensor, in words, by the axis's JSON."""
    return why_no_measurement(axis["not_measured"]) or "the model does not fit"


def _remarks(fit: Mapping[str, Any], axis: Mapping[str, Any]) -> list[str]:
    """Remarks on an axis, e.g. "line 7.3 Hz", the gravest first, by a fit's JSON and the axis's."""
    found = [] if axis["measured"] else ["not a measurement"]
    if axis["measured"] and axis["verdict"].startswith("does not fit"):
        found.append("does not fit")
    # Filters, resonances and lines for which the fit corrected the noise terms.
    for label in (axis["extension"] or {"further": ()})["further"]:
        kind = re.sub(r"_\d+$", "", label)
        is_term = kind in {term["term"] for term in axis["extension"]["model"]}
        name = _NAMES.get(kind, kind.replace("_", " ")) if is_term else "filter"
        own = (c for c in axis["coefficients"] if c["term"] == label and c["unit"] == "Hz")
        sizes = [f" {plain(c['value'], 2)} Hz" for c in own]
        found.append(f"corrected for {name}{''.join(sizes[:1])}")
    for fact in fit["facts"]:
        if axis["name"] in fact["axes"] and fact["kind"] != "not examined":
            sized = fact["size"] is not None and fact["unit"] in _UNITS
            cut = sized and fact["kind"] == "disturbances"
            name = "cut" if cut else _NAMES.get(fact["kind"], fact["kind"])
            found.append(f"{name} {plain(fact['size'], 2)} {fact['unit']}" if sized else name)
    return [text for text in dict.fromkeys(found) if f"corrected for {text}" not in found]


def _warned(table: pd.DataFrame) -> list[str]:
    """Notes on the warnings, each with the recordings that have it, the most frequent first."""
    of = table.drop_duplicates("recording")
    found: dict[str, list[str]] = {}
    for name, text in zip(of["recording"], of["warnings"], strict=True):
        for warning in text.splitlines():
            found.setdefault(warning, []).append(name)
    most = sorted(found.items(), key=lambda pair: -len(pair[1]))
    notes = [f"{listed(names, _NAMED)}: {warning}" for warning, names in most[:_NAMED]]
    more = len(found) - _NAMED
    return [*notes, f"{more} more warnings: see the column warnings"] if more > 0 else notes


def _too_few(table: pd.DataFrame) -> list[str]:
    """Note on the groups that are too small for outlying units to be found."""
    counts = table.groupby("group", sort=False)["unit_name"].nunique()
    small = counts[counts < FEWEST_UNITS]
    if (small == FEWEST_UNITS - 1).sum() > 1:
        # These are compared together.
        small = small[small < FEWEST_UNITS - 1]
    words = [f"{f'group {g}, ' * bool(g)}{n} unit{'s' * (n > 1)}" for g, n in small.items()]
    needed = f"too few to detect outlying units; {FEWEST_UNITS} are needed"
    return [f"{listed(words, _NAMED)}: {needed}"] if words else []


def left_out(files: Sequence[Path], folder: Path) -> str:
    """Note on recordings that an earlier run had, and this one does not name."""
    recordings = "recordings" if len(files) > 1 else "recording"
    return (
        f"{len(files)} {recordings} of an earlier run left out of fleet.parquet, as not among these files: "
        f"{listed(list(map(str, files)), _NAMED)}. Their results stay in {folder}; to include them, pass "
        "these files too"
    )


def tables(table: pd.DataFrame) -> list[list[Column]]:
    """Tables with one row per axis and group: of the median and of the range of each coefficient, by sensor.

    Median, scatter and range are those of units with an estimate that has an interval, without outlying ones;
    counts are of recordings whose axis is a measurement of the sensor. Where units have several recordings,
    there is a table of the scatter within and between units, too.
    """
    printed: list[list[Column]] = []
    spread = _scatters(table) if _has_several(table) else {}
    for _, of in table.groupby("sensor", sort=False):
        axes = list(of["axis"].unique())
        rows = sorted({*zip(of["axis"], of["group"], strict=True)}, key=lambda r: (axes.index(r[0]), r[1]))
        of_rows = [of[(of["axis"] == axis) & (of["group"] == group)] for axis, group in rows]
        first = columns_from(("axis", "group"), rows)
        counts = [(_detected(row), _units(row), _outlying_units(row)) for row in of_rows]
        medians, ranges, scatter = list[Column](), list[Column](), list[Column]()
        labels = sorted({*of["coefficient"]}, key=lambda name: [*SYMBOLS, name].index(name))
        for label in labels:
            unit = of.loc[of["coefficient"] == label, "unit"].iloc[0]
            name = SYMBOLS.get(label, title_of(label, of["sensor"].iloc[0]))
            usual = [_usual(row[row["coefficient"] == label]) for row in of_rows]
            medians.append(column(name, unit, list(map(_median, usual))))
            ranges.append(column(f"{name} 5…95 %", unit, list(map(_range, usual))))
            cells = [spread.get((*row, label), ("", "")) for row in rows]
            scatter += columns_from((f"{name} within units (%)", f"{name} between units (%)"), cells)
        main = sum(label in MAIN for label in labels)
        last = columns_from(("detected", "units", "outlying"), counts)
        printed += tables_of(first, medians[:main], medians[main:], last)
        for own, count in ((ranges, main), (scatter, 2 * main)):
            if any(any(c.cells) for c in own):
                printed += tables_of(first, own[:count], own[count:])
    return printed


def _has_several(table: pd.DataFrame) -> bool:
    """Whether a unit has several recordings."""
    return bool(table["unit_name"].nunique() < table["recording"].nunique())


def notes_on_units(table: pd.DataFrame) -> list[str]:
    """What the table of scatters states, if there is one."""
    text = "within, between units: scatter of a unit's records, and of the units, beyond what errors explain"
    return [f"{text} (95 % interval, or 95 % upper limit)"] if _has_several(table) else []


def _scatters(table: pd.DataFrame) -> dict[Any, list[str]]:
    """Scatter of each coefficient within and between units [%], 95 % intervals; by axis, group, label."""
    odd = np.append((table["outlying"] | table["odd_record"]).to_numpy(), False)
    found = {}
    for of in families(table):
        for name, rows, axis in zip(of.names, of.rows.T, of.axes, strict=True):
            texts = []
            for sizes in scatters(axis, odd[rows]):
                size, low, high, limit = (significant(100.0 * x, 2) for x in sizes)
                detected = sizes[1] > 0.0
                # A limit above 100 % tells nothing.
                known = detected or sizes[3] < 1.0
                texts.append((f"{size} ({low} … {high})" if detected else f"< {limit}") if known else "")
            found[name, of.group, of.coefficient] = texts
    return found


def _found(of: pd.DataFrame) -> pd.DataFrame:
    """The rows with a coefficient that was detected and is a measurement."""
    return of[of["measured"] & of["detected"] & np.isfinite(of["value"])]


def _usual(of: pd.DataFrame) -> pd.DataFrame:
    """Mean value and error of each unit, without outlying units and odd recordings."""
    found = _found(of)
    usual = found[~(found["outlying"] | found["odd_record"])]
    return usual.groupby("unit_name", sort=False)[["value", "std"]].mean()


def _units(of: pd.DataFrame) -> str:
    """How many units there are, and with how many recordings, if some have several."""
    counts = of[["unit_name", "recording"]].nunique()
    return f"{counts.iloc[0]} with {counts.iloc[1]} records" if counts.iloc[0] < counts.iloc[1] else ""


def _median(usual: pd.DataFrame) -> Number | None:
    """Median of one coefficient with its scatter among units, of a single unit with its own error."""
    if len(usual) < 2:
        return Number(usual["value"].iloc[0], usual["std"].iloc[0]) if len(usual) else None
    return Number(float(usual["value"].median()), float(usual["value"].std()))


def _range(usual: pd.DataFrame) -> str:
    """The 5 % and the 95 % quantile of one coefficient over the units; "" for a single unit."""
    value = usual["value"]
    low, high = value.quantile([0.05, 0.95])
    return format_interval(low, high, value.median(), value.std()) if len(value) > 1 else ""


def _detected(of: pd.DataFrame) -> str:
    """How many units have each coefficient, e.g. "6 of 6" or "N 6, B 1 of 6"."""
    names = dict.fromkeys(of["coefficient"])
    counts = {SYMBOLS.get(name, name): len(_found(of[of["coefficient"] == name])) for name in names}
    total = of.loc[of["measured"], "recording"].nunique()
    same = len(set(counts.values())) == 1
    each = ", ".join(f"{name} {count}" for name, count in counts.items() if count)
    return f"{next(iter(counts.values())) if same else each} of {total}"


def _outlying_units(of: pd.DataFrame) -> str:
    """Names of the outlying units and odd recordings, or their number."""
    names = outlying_names(of)
    text = ", ".join(names)
    return text if len(text) < _SHORT else f"{len(names)} units"


def outlying_names(table: pd.DataFrame) -> list[str]:
    """Names of the outlying units, and of recordings that differ from the others of their unit."""
    units = table.loc[table["outlying"], "unit_name"]
    return [*dict.fromkeys([*units, *table.loc[table["odd_record"], "recording"]])]


def times(ratio: float) -> str:
    """How many times the median of its group an outlying value is, e.g. "×1.31"."""
    return f"×{significant(ratio)}"


def _places(of: pd.DataFrame, ratio: str, table: pd.DataFrame) -> Iterator[tuple[str, float]]:
    """Axes and coefficients that are off, and how many times; the axes of a sensor as one if they agree."""
    axes: Mapping[Any, int] = dict(table.groupby("sensor")["axis"].nunique())
    for (sensor, label), part in of.groupby(["sensor", "coefficient"], sort=False):
        symbol = SYMBOLS.get(str(label), str(label))
        each = np.exp(np.log(part[ratio]).groupby(part["axis"], sort=False).mean())
        if 1 < len(each) == axes[sensor] and each.max() < _ALIKE * each.min():
            yield f"{sensor} {symbol}", float(np.exp(np.log(each).mean()))
        else:
            yield from ((f"{axis} {symbol}", size) for axis, size in each.items())


def lines_of(table: pd.DataFrame, most: int) -> list[str]:
    """A line per unit or record: in what it is outlying; what was corrected, left out or is wrong on it.

    There are at most so many lines, and one that says how many more there would be.
    """
    lines: dict[str, list[str]] = {}
    for unit, of in table[table["outlying"]].groupby("unit_name", sort=False):
        words = (f"{place} {times(ratio)}" for place, ratio in _places(of[~of["odd_record"]], "ratio", table))
        lines[str(unit)] = [f"outlying against the median of its group: {', '.join(words)}"]
    for name, of in table[table["odd_record"]].groupby("recording", sort=False):
        words = (f"{place} {significant(x)} ×" for place, x in _places(of, "record_ratio", table))
        count = table.loc[table["unit_name"] == of["unit_name"].iloc[0], "recording"].nunique()
        others = "its other records" if count > 2 else "its other record"
        lines.setdefault(str(name), []).append(f"{', '.join(words)} {others}")
    for unit, of in table.drop_duplicates(["recording", "axis"]).groupby("recording", sort=False):
        for remarks, part in of[of["remarks"] != ""].groupby("remarks", sort=False):
            axes = "all axes" if len(part) == len(of) > 1 else ", ".join(part["axis"])
            lines.setdefault(str(unit), []).append(f"{axes}: {remarks}")
    texts = [f"{unit}: {'; '.join(words)}" for unit, words in lines.items()]
    more = len(texts) - most
    return texts[:most] + ([f"{more} more units with remarks: see the column remarks"] if more > 0 else [])
