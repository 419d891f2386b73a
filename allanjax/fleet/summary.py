"""Notes on a fleet's groups and units, and its printed table."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from allanjax.base.tables import Column, Number, column, columns_from, tables_of
from allanjax.base.wording import format_interval, significant
from allanjax.estimate.tables import MAIN, SYMBOLS
from allanjax.fleet.grades import Split, found_split, pooled_values
from allanjax.fleet.outlying_units import FEWEST_UNITS
from allanjax.fleet.table import (
    INCOMPLETE,
    NOT_MEASURED,
    AxisStructure,
    Remark,
    families,
    mark_outlying,
    unlike_mates,
)
from allanjax.noise.estimate import title_of

if TYPE_CHECKING:
    import pandas as pd

# Names that a note lists at most.
_NAMED = 5
# Units with remarks that are printed at most, and characters of the names in a cell.
_ROWS, _SHORT = 40, 28
# Columns that say which coefficient of which units a row is of.
_PLACE = ("axis", "group", "coefficient")
# Numbers in words.
_COUNTS = ("no", "one", "two", "three", "four", "five", "six")


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
    return table, (*about, *notes, *_alike(table), *_too_few(table))


def _parted(table: pd.DataFrame) -> Iterator[tuple[pd.DataFrame, list[str]]]:
    """Table of a group, or tables of the groups that it falls into, each with notes."""
    names = list(table["recording"].unique())
    split = found_split([pooled_values(family, names) for family in families(table)])
    if split is None:
        yield table, []
        return
    group = table["group"].iloc[0]
    of_rows = split.labels[[names.index(name) for name in table["recording"]]]
    words = [_told(split, names, group)]
    for g in range(split.groups):
        name = f"{group}/{g + 1}" if group else str(g + 1)
        for part, more in _parted(table[of_rows == g].assign(group=name)):
            yield part, words + more
            words = []


def _told(split: Split, names: Sequence[str], group: str) -> str:
    """Note on the groups that a group falls into."""
    title = title_of(split.pooled.coefficient, split.pooled.sensor)
    parts = []
    for g in range(split.groups):
        units = [name for name, label in zip(names, split.labels, strict=True) if label == g]
        parts.append(f"{f'{group}/' if group else ''}{g + 1} ({len(units)} units: {listed(units)})")
    apart = " and ".join(significant(ratio, 2) for ratio in split.ratios)
    count = _COUNTS[split.groups] if split.groups < len(_COUNTS) else str(split.groups)
    return (
        f"{split.pooled.sensor} {title}{f' of group {group}' if group else ''} falls into {count} groups, "
        f"{apart} times apart: {', '.join(parts)}. Units are compared within these; pass groups of your own "
        "with group= (--group)"
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
    return [heading, *(f"  {listed(names)}: {warning}" for warning, names in most)]


def _remarked(units: Mapping[str, Sequence[AxisStructure]]) -> Iterator[str]:
    """Notes on axes that are not a measurement, whose model is incomplete, or that were corrected."""
    wrong = "not a measurement of the sensor; left out of the statistics and the comparison"
    sentences: Mapping[str, Callable[[Remark], bool]] = {
        wrong: lambda remark: remark.kind == NOT_MEASURED,
        "the model does not fit; the intervals are widened accordingly": lambda r: r.kind == INCOMPLETE,
        "corrected for spectral lines, resonances or filters": lambda remark: remark.corrected,
    }
    for sentence, concerns in sentences.items():
        named = []
        for name, unit in units.items():
            axes = [axis.axis for axis in unit if any(map(concerns, axis.remarks))]
            named += [f"{name} ({', '.join(axes)})"] if axes else []
        if named:
            yield f"{listed(named)}: {sentence}"


def _unlike(table: pd.DataFrame, units: Mapping[str, Sequence[AxisStructure]]) -> list[str]:
    """Note on units whose structure is unlike that of most others of their group."""
    found: dict[str, str] = {}
    for _, of in table.groupby("group", sort=False):
        found |= unlike_mates({name: units[name] for name in of["recording"].unique()})
    named = [f"{name} ({words})" for name, words in found.items()]
    differ = "units differ" if len(named) > 1 else "unit differs"
    return [f"{len(named)} {differ} from most others: {listed(named)}"] if named else []


def _alike(table: pd.DataFrame) -> list[str]:
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
        whose = f"group{'s' * (len(small) > 1)} {listed([f'{g} ({n})' for g, n in small.items()])}"
    return [f"{whose}: too few to detect outlying units, which takes {FEWEST_UNITS}"]


def left_out(files: Sequence[Path], folder: Path) -> str:
    """Note on recordings that an earlier run had, and this one does not name."""
    recordings = "recordings" if len(files) > 1 else "recording"
    return (
        f"{len(files)} {recordings} of an earlier run left out of fleet.parquet, as not among these files: "
        f"{listed([str(path) for path in files])}. Their results stay in {folder}; to include them, pass "
        "these files too"
    )


def listed(names: Sequence[str]) -> str:
    """List of names, the first five of many."""
    more = len(names) - _NAMED
    return ", ".join(names[:_NAMED]) + (f" and {more} more" if more > 0 else "")


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
        counts = columns_from(("detected", "outlying"), [(_detected(row), _odd(row)) for row in of_rows])
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


def _odd(of: pd.DataFrame) -> str:
    """Outlying units by name, or how many there are."""
    names = list(dict.fromkeys(of.loc[of["outlying"], "recording"]))
    text = ", ".join(names)
    return text if len(text) < _SHORT else f"{len(names)} units"


def lines_of(table: pd.DataFrame) -> list[str]:
    """A line per unit: in what it is outlying, and what was corrected, left out or is wrong on its axes."""
    lines: dict[str, list[str]] = {}
    for row in table[table["outlying"]].to_dict("records"):
        same = (table[list(_PLACE)] == [row[name] for name in _PLACE]).all(axis=1)
        usual = _median(_usual(table[same]))
        # Where all others have limits there is no median.
        size = f" (×{significant(row['value'] / usual.value, 2)} the median)" if usual else ""
        what = f"outlying in {row['axis']} {SYMBOLS.get(row['coefficient'], row['coefficient'])}{size}"
        lines.setdefault(row["recording"], []).append(what)
    for unit, of in table.drop_duplicates(["recording", "axis"]).groupby("recording", sort=False):
        for remarks, part in of[of["remarks"] != ""].groupby("remarks", sort=False):
            axes = "all axes" if len(part) == len(of) > 1 else ", ".join(part["axis"])
            lines.setdefault(str(unit), []).append(f"{axes}: {remarks}")
    told = [f"{unit}: {'; '.join(words)}" for unit, words in lines.items()]
    more = len(told) - _ROWS
    return told[:_ROWS] + ([f"{more} more units with remarks: see the column remarks"] if more > 0 else [])
