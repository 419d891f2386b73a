"""Notes on a fleet's groups and units, and its printed table."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from allanjax.base.wording import format_interval, format_with_error, significant
from allanjax.fleet.grades import Split, found_split, pooled_values
from allanjax.fleet.outlying_units import FEWEST_UNITS
from allanjax.fleet.remarks import (
    INCOMPLETE,
    NOT_MEASURED,
    AxisStructure,
    Remark,
    unlike_mates,
)
from allanjax.fleet.table import families, mark_outlying
from allanjax.noise.estimate import title_of

if TYPE_CHECKING:
    import pandas as pd

# Names that a note lists at most.
_NAMED = 5
# Rows of the printed table of units at most.
_ROWS = 40
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
        f"{apart} times apart: {', '.join(parts)}. Units are compared within these; say which belong "
        "together by group= (--group)"
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
    more = f"; {len(found) - _NAMED} more of them are in the column warnings" if len(found) > _NAMED else ""
    heading = f"{count} recording{'s' * (count > 1)} with warnings{more}"
    most = sorted(found.items(), key=lambda pair: -len(pair[1]))[:_NAMED]
    return [heading, *(f"  {listed(names)}: {warning}" for warning, names in most)]


def _remarked(units: Mapping[str, Sequence[AxisStructure]]) -> Iterator[str]:
    """Notes on axes that are not a measurement, whose model is incomplete, or that were corrected."""
    wrong = "are not a measurement of the sensor: they are not in the statistics, nor compared"
    sentences: Mapping[str, Callable[[Remark], bool]] = {
        wrong: lambda remark: remark.kind == NOT_MEASURED,
        "are of an incomplete model: their intervals allow for it": lambda remark: remark.kind == INCOMPLETE,
        "are corrected for lines, resonances or filters": lambda remark: remark.corrected,
    }
    for sentence, concerns in sentences.items():
        named = []
        for name, unit in units.items():
            axes = [axis.axis for axis in unit if any(map(concerns, axis.remarks))]
            named += [f"{name} ({', '.join(axes)})"] if axes else []
        if named:
            yield f"the coefficients of {listed(named)} {sentence}"


def _unlike(table: pd.DataFrame, units: Mapping[str, Sequence[AxisStructure]]) -> list[str]:
    """Note on units whose structure is unlike that of most others of their group."""
    found: dict[str, str] = {}
    for _, of in table.groupby("group", sort=False):
        found |= unlike_mates({name: units[name] for name in of["recording"].unique()})
    named = [f"{name} ({words})" for name, words in found.items()]
    whose = "units have" if len(named) > 1 else "unit has"
    return [f"{len(named)} {whose} a structure unlike that of most others: {listed(named)}"] if named else []


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
                "they are of another grade than the others, say so by group= (--group)"
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
    return [f"{whose}: too few to say whether one is unlike the others, which takes {FEWEST_UNITS}"]


def left_out(files: Sequence[Path], folder: Path) -> str:
    """Note on recordings that an earlier run had, and this one does not name."""
    recordings, be = ("recordings", "are") if len(files) > 1 else ("recording", "is")
    return (
        f"{len(files)} {recordings} of an earlier run {be} not among these files and {be} left out of "
        f"fleet.parquet: {listed([str(path) for path in files])}. What was computed stays in {folder}: name "
        "the files too, and they are in the table again"
    )


def listed(names: Sequence[str]) -> str:
    """List of names, the first five of many."""
    more = len(names) - _NAMED
    return ", ".join(names[:_NAMED]) + (f" and {more} more" if more > 0 else "")


def cells(table: pd.DataFrame) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Headings of the printed table, and a row for each group, axis and coefficient.

    Median, scatter and quantiles are those of estimates with an interval, without outlying units; counts are
    of axes that are a measurement of the sensor.
    """
    grouped = bool((table["group"] != "").any())
    headings = ("axis", "coefficient", *(["group"] if grouped else []))
    rows = []
    # Axes and coefficients in the order in which they first occur.
    order = [table[name].factorize(sort=name == "group")[0] for name in ("axis", "coefficient", "group")]
    for _, of in table.groupby(order, sort=True):
        first, odd = of.iloc[0], of[of["outlying"]]
        of = of[of["measured"]]
        found = of[of["detected"] & np.isfinite(of["value"])]
        usual = found.loc[~found["outlying"], "value"]
        spread = _spread(usual.to_numpy(), found["std"].to_numpy(), first["unit"])
        ratios = zip(odd["recording"], odd["value"] / usual.median(), strict=True)
        # Where all others have limits there is no median.
        units = [f"{name} ({significant(ratio, 2)})" if ratio == ratio else name for name, ratio in ratios]
        title = title_of(first["coefficient"], first["sensor"])
        row = (first["axis"], title, first["group"]) if grouped else (first["axis"], title)
        rows.append((*row, f"{len(found)} of {len(of)}", *spread, listed(units)))
    return (
        *headings,
        "detected",
        "median ± scatter",
        "5 … 95 %",
        "outlying, left out of both (× median)",
    ), rows


def cells_of_units(table: pd.DataFrame) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Headings of the printed table of units with remarks, and a row for each unit and remark on its axes."""
    rows: list[tuple[str, ...]] = []
    axes = table.loc[table["remarks"] != ""].drop_duplicates(["recording", "axis"])
    for (name, remarks), of in axes.groupby(["recording", "remarks"], sort=False):
        rows.append((str(name), ", ".join(of["axis"]), str(remarks)))
    if len(rows) > _ROWS:
        more = f"{len(rows) - _ROWS} more rows: see the column remarks"
        rows = [*rows[:_ROWS], ("…", "", more)]
    return ("unit", "axes", "corrected, left out or wrong"), rows


def _spread(values: np.ndarray, stds: np.ndarray, unit: str) -> tuple[str, str]:
    """Median with the scatter among units (of a single unit its own error), and 5 and 95 % quantiles."""
    if not len(values):
        return "", ""
    named = "" if unit == "1" else f" {unit}"
    if len(values) == 1:
        return f"{format_with_error(values[0], stds[0])}{named}", ""
    low, median, high = map(float, np.quantile(values, (0.05, 0.5, 0.95)))
    scatter = float(np.std(values, ddof=1))
    return f"{format_with_error(median, scatter)}{named}", format_interval(low, high, median, scatter)
