"""Table of a fleet, with one row per recording, axis and coefficient; remarks, notes and printed tables."""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from allanjax.base.tables import Column, Number, column, columns_from, tables_of
from allanjax.base.wording import format_interval, plain, significant
from allanjax.estimate.result import MAIN
from allanjax.fleet.comparison import (
    FALSE_ALARMS,
    FEWEST_UNITS,
    Family,
    Split,
    found_split,
    log_values,
    outlying,
)
from allanjax.inspection.facts import listed, why_no_measurement
from allanjax.noise.estimate import SYMBOLS, title_of

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
# Frequencies that differ by less than this share are one.
_SAME = 0.1
# A part that fewer than this share of the other units have is rare; one that more than this have is usual.
_RARE, _USUAL = 0.25, 0.75

_NOT_MEASURED, _INCOMPLETE = "not a measurement", "misfit"
# Names that a note lists at most.
_NAMED = 5
# Units with remarks that are printed at most, and characters of the names in a cell.
_ROWS, _SHORT = 40, 28
# Columns that identify the coefficient and the units of a row.
_PLACE = ("axis", "group", "coefficient")


@functools.cache
def table_schema() -> pa.Schema:
    """Columns of the Parquet file and their types, the same whatever is in it."""
    import pyarrow as pa

    kinds = [
        (pa.string(), "recording file group axis sensor coefficient"),
        (pa.float64(), "value std lower_95 upper_95"),
        (pa.string(), "unit"),
        (pa.bool_(), "detected"),
        (pa.float64(), "upper_limit_95"),
        (pa.bool_(), "measured"),
        (pa.float64(), "p_value"),
        (pa.string(), "terms"),
        (pa.bool_(), "outlying"),
        (pa.float64(), "start_s stop_s"),
        (pa.string(), "remarks warnings"),
    ]
    return pa.schema({name: kind for kind, names in kinds for name in names.split()})


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

    `comparison.outlying` judges a coefficient by all axes of a sensor. In a fleet of equal units, the
    probability of any mark is 1 % (Bonferroni: every coefficient has its share).
    """
    judged = [family for family in families(table) if any(axis.testable for axis in family.axes)]
    marked = np.zeros(len(table) + 1, bool)
    for family in judged:
        found = outlying(family.axes, FALSE_ALARMS / len(judged), family.coefficient)
        marked[family.rows[found]] = True
    return table.assign(outlying=marked[:-1])


class Remark(NamedTuple):
    """Something about an axis, e.g. a line at 7.3 Hz, for which its noise terms may have been corrected.

    `size` is nan if no number describes it.
    """

    kind: str
    size: float = np.nan
    unit: str = ""
    corrected: bool = False

    def __str__(self) -> str:
        return f"{self.kind} {plain(self.size, 2)} {self.unit}" if np.isfinite(self.size) else self.kind

    def like(self, other: Remark) -> bool:
        """Whether another one is of the same kind and, if it has a frequency, at the same frequency."""
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
        AxisStructure(axis["name"], axis["sensor"], _terms(axis), _remarks(fit, axis))
        for axis in fit["axes"]
        if axis["converged"]
    ]


def _terms(axis: Mapping[str, Any]) -> list[str]:
    """Terms that the fit chose for the axis, or was given."""
    chosen = next((s["terms"] for s in axis["selection"] or () if s["chosen"]), None)
    return list(dict.fromkeys(c["term"] for c in axis["coefficients"]) if chosen is None else chosen)


def why_not_measured(axis: Mapping[str, Any]) -> str:
    """Why an axis's coefficients are not a measurement of the sensor, in words, by the axis's JSON."""
    return why_no_measurement(axis["not_measured"]) or "the model does not fit"


def _remarks(fit: Mapping[str, Any], axis: Mapping[str, Any]) -> list[Remark]:
    found = []
    if not axis["measured"]:
        found.append(Remark(_NOT_MEASURED))
    elif axis["verdict"].startswith("does not fit"):
        found.append(Remark(_INCOMPLETE))
    # Filters, resonances and lines for which the fit corrected the noise terms.
    for label in (axis["extension"] or {"further": ()})["further"]:
        kind = re.sub(r"_\d+$", "", label)
        is_term = kind in {term["term"] for term in axis["extension"]["model"]}
        name = _NAMES.get(kind, kind.replace("_", " ")) if is_term else "filter"
        hertz = [c["value"] for c in axis["coefficients"] if c["term"] == label and c["unit"] == "Hz"]
        found.append(Remark(name, hertz[0] if hertz else np.nan, "Hz", corrected=True))
    for fact in fit["facts"]:
        if axis["name"] in fact["axes"] and fact["kind"] != "not examined":
            sized = fact["size"] is not None and fact["unit"] in _UNITS
            cut = sized and fact["kind"] == "disturbances"
            name = "cut" if cut else _NAMES.get(fact["kind"], fact["kind"])
            remark = Remark(name, *(fact["size"], fact["unit"]) if sized else ())
            found += [] if any(remark.like(other) for other in found) else [remark]
    return found


def unlike_mates(units: Mapping[str, Sequence[AxisStructure]]) -> dict[str, str]:
    """Parts of a unit's model that few others have, or that it lacks and most have, by the unit's name.

    A term counts as present if most axes of a sensor have it, and as lacking if none has, since it may be
    chosen by chance on one axis; a remark counts on any axis.
    """
    unusual: dict[str, dict[str, list[str]]] = {}
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
                unusual.setdefault(name, {}).setdefault(", ".join(words).replace("_", " "), []).append(sensor)
    return {
        name: "; ".join(f"{', '.join(sensors)}: {words}" for words, sensors in of.items())
        for name, of in unusual.items()
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


def judged(
    table: pd.DataFrame, units: Mapping[str, Sequence[AxisStructure]]
) -> tuple[pd.DataFrame, tuple[str, ...]]:
    """Table with the groups that units fall into and outlying units marked, and notes on it and the units."""
    parted, notes = [], []
    for _, of in table.groupby("group", sort=False):
        for part, words in _parted(of):
            parted.append(part)
            notes += words
    if parted:
        import pandas as pd

        table = pd.concat(parted).sort_index()
    table = mark_outlying(table)
    about = (*_warned(table), *_remarked(units), *_unlike(table, units))
    return table, (*about, *notes, *_another_grade(table), *_too_few(table))


def _parted(table: pd.DataFrame) -> Iterator[tuple[pd.DataFrame, list[str]]]:
    """Table of a group, or tables of the groups that it falls into, each with notes."""
    names = list(table["recording"].unique())
    split = found_split(list(families(table)), names)
    if split is None:
        yield table, []
        return
    group = table["group"].iloc[0]
    of_rows = split.labels[[names.index(name) for name in table["recording"]]]
    words = [_split_note(split, names, group)]
    for g in range(len(split.ratios) + 1):
        name = f"{group}/{g + 1}" if group else str(g + 1)
        for part, more in _parted(table[of_rows == g].assign(group=name)):
            yield part, words + more
            words = []


def _split_note(split: Split, names: Sequence[str], group: str) -> str:
    """Note on the groups that a group falls into."""
    title = title_of(split.family.coefficient, split.family.sensor)
    parts = []
    for g in range(len(split.ratios) + 1):
        units = [name for name, label in zip(names, split.labels, strict=True) if label == g]
        parts.append(f"{f'{group}/' if group else ''}{g + 1} ({len(units)} units: {listed(units, _NAMED)})")
    apart = " and ".join(significant(ratio, 2) for ratio in split.ratios)
    what = f"the units{f' of group {group}' if group else ''} fall into {len(parts)} groups"
    return (
        f"{what} in {title} ({split.family.sensor}), apart by a factor of {apart}: {', '.join(parts)}. Units "
        "are compared within these; pass groups of your own with group= (--group)"
    )


def _warned(table: pd.DataFrame) -> list[str]:
    """Notes on the warnings, each with the recordings that have it, the most frequent first."""
    of = table.drop_duplicates("recording")
    found: dict[str, list[str]] = {}
    for name, text in zip(of["recording"], of["warnings"], strict=True):
        for warning in text.splitlines():
            found.setdefault(warning, []).append(name)
    if not found:
        return []
    count = int((of["warnings"] != "").sum())
    more = f" ({len(found) - _NAMED} more in the column warnings)" if len(found) > _NAMED else ""
    heading = f"{count} recording{'s have' if count > 1 else ' has'} warnings{more}"
    most = sorted(found.items(), key=lambda pair: -len(pair[1]))[:_NAMED]
    return [heading, *(f"  {listed(names, _NAMED)}: {warning}" for warning, names in most)]


def _remarked(units: Mapping[str, Sequence[AxisStructure]]) -> Iterator[str]:
    """Notes on axes that are not a measurement, whose model is incomplete, or that were corrected."""
    sentences = {
        _NOT_MEASURED: "not a measurement of the sensor; left out of the statistics and the comparison",
        _INCOMPLETE: "the model does not fit; the intervals are widened accordingly",
        "corrected": "corrected for spectral lines, resonances or filters",
    }
    for kind, sentence in sentences.items():
        named = []
        for name, unit in units.items():
            axes = [
                a.axis for a in unit if any(kind in (r.kind, r.corrected and "corrected") for r in a.remarks)
            ]
            named += [f"{name} ({', '.join(axes)})"] if axes else []
        if named:
            yield f"{listed(named, _NAMED)}: {sentence}"


def _unlike(table: pd.DataFrame, units: Mapping[str, Sequence[AxisStructure]]) -> list[str]:
    """Note on units whose structure is unlike that of most others of their group."""
    found: dict[str, str] = {}
    for _, of in table.groupby("group", sort=False):
        found |= unlike_mates({name: units[name] for name in of["recording"].unique()})
    named = [f"{name} ({words})" for name, words in found.items()]
    differ = "units differ" if len(named) > 1 else "unit differs"
    return [f"{len(named)} {differ} from most others: {listed(named, _NAMED)}"] if named else []


def _another_grade(table: pd.DataFrame) -> list[str]:
    """Notes on coefficients in which so many units are outlying that they could be a grade of their own."""
    notes = []
    for family in families(table):
        odd = table["outlying"].to_numpy()[family.rows] & (family.rows >= 0)
        units = [name for name, is_odd in zip(family.recordings, odd.any(axis=1), strict=True) if is_odd]
        if len(units) >= max(FEWEST_UNITS, len(family.recordings) / 8):
            title = title_of(family.coefficient, family.sensor)
            notes.append(
                f"{len(units)} of {len(family.recordings)} units are outlying in {family.sensor} {title}: if "
                "they are of another grade, make them a group of their own with group= (--group)"
            )
    return notes


def _too_few(table: pd.DataFrame) -> list[str]:
    """Note on the groups that are too small for outlying units to be found."""
    counts = table.groupby("group", sort=False)["recording"].nunique()
    small = counts[counts < FEWEST_UNITS]
    if small.empty:
        return []
    if list(small.index) == [""]:
        count = int(small.iloc[0])
        whose = f"{count} unit{'s' * (count > 1)}"
    else:
        whose = f"group{'s' * (len(small) > 1)} {listed([f'{g} ({n})' for g, n in small.items()], _NAMED)}"
    return [f"{whose}: too few to detect outlying units; {FEWEST_UNITS} are needed"]


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

    Median, scatter and range are those of estimates with an interval, without outlying units; counts are of
    axes that are a measurement of the sensor.
    """
    printed: list[list[Column]] = []
    for _, of in table.groupby("sensor", sort=False):
        axes = list(dict.fromkeys(of["axis"]))
        rows = sorted(set(zip(of["axis"], of["group"], strict=True)), key=lambda r: (axes.index(r[0]), r[1]))
        parts: dict[Any, pd.DataFrame] = dict(list(of.groupby(list(_PLACE))))
        of_rows = [of[(of["axis"] == axis) & (of["group"] == group)] for axis, group in rows]
        first = columns_from(("axis", "group"), rows)
        counts = columns_from(
            ("detected", "outlying"), [(_detected(row), _outlying_units(row)) for row in of_rows]
        )
        medians: dict[bool, list[Column]] = {True: [], False: []}
        ranges: dict[bool, list[Column]] = {True: [], False: []}
        for label in sorted(set(of["coefficient"]), key=lambda name: [*SYMBOLS, name].index(name)):
            one = of[of["coefficient"] == label].iloc[0]
            name = SYMBOLS.get(label, title_of(label, one["sensor"]))
            usual = [_usual(parts.get((*row, label), of[:0])) for row in rows]
            medians[label in MAIN].append(column(name, one["unit"], list(map(_median, usual))))
            ranges[label in MAIN].append(column(f"{name} 5…95 %", one["unit"], list(map(_range, usual))))
        printed += tables_of(first, medians[True], medians[False], counts)
        if any(any(c.cells) for columns in ranges.values() for c in columns):
            printed += tables_of(first, ranges[True], ranges[False])
    return printed


def _found(of: pd.DataFrame) -> pd.DataFrame:
    """The rows with a coefficient that was detected and is a measurement."""
    return of[of["measured"] & of["detected"] & np.isfinite(of["value"])]


def _usual(of: pd.DataFrame) -> pd.DataFrame:
    """The same without outlying units."""
    found = _found(of)
    return found[~found["outlying"]]


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
    """Names of the outlying units, or their number."""
    names = list(dict.fromkeys(of.loc[of["outlying"], "recording"]))
    text = ", ".join(names)
    return text if len(text) < _SHORT else f"{len(names)} units"


def lines_of(table: pd.DataFrame) -> list[str]:
    """A line per unit: in what it is outlying, and what was corrected, left out or is wrong on its axes."""
    lines: dict[str, list[str]] = {}
    for row in table[table["outlying"]].to_dict("records"):
        same = (table[list(_PLACE)] == [row[name] for name in _PLACE]).all(axis=1)
        usual = _median(_usual(table[same]))
        # There is no median if all others have limits.
        size = f" (×{significant(row['value'] / usual.value, 2)} the median)" if usual else ""
        what = f"outlying in {row['axis']} {SYMBOLS.get(row['coefficient'], row['coefficient'])}{size}"
        lines.setdefault(row["recording"], []).append(what)
    for unit, of in table.drop_duplicates(["recording", "axis"]).groupby("recording", sort=False):
        for remarks, part in of[of["remarks"] != ""].groupby("remarks", sort=False):
            axes = "all axes" if len(part) == len(of) > 1 else ", ".join(part["axis"])
            lines.setdefault(str(unit), []).append(f"{axes}: {remarks}")
    texts = [f"{unit}: {'; '.join(words)}" for unit, words in lines.items()]
    more = len(texts) - _ROWS
    return texts[:_ROWS] + ([f"{more} more units with remarks: see the column remarks"] if more > 0 else [])
