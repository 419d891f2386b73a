"""The grammar of text: how its lines hold the cells of rows, as its first lines show."""

import functools
import itertools
import re
import shlex
import tomllib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

from allanjax.base.errors import UnitError
from allanjax.base.wording import counted
from allanjax.record.columns import recognise, split_unit, with_unit
from allanjax.record.io.cells import (
    delimiter_beside_commas,
    delimiter_of,
    fits,
    has_decimal_commas,
    is_axis,
    is_border,
    is_comment,
    is_decorated,
    is_number,
    is_unit_name,
    split,
    trimmed,
    with_points,
    without_groups,
    without_mark,
)
from allanjax.record.io.kinds import LONG
from allanjax.record.io.messages import Message, Numbered, messages_in, records_of
from allanjax.record.units import SENSORS, Sensor, parse_sample_unit
from allanjax.record.validation import Source

#: So many lines at the start of a file show its grammar.
FIRST_LINES = 1000
# The line by which Excel names the delimiter, and the end of a line that states the sample rate.
_SEP = re.compile(r"\"?sep=(.)\"?\s*", re.IGNORECASE)
_RATE = re.compile(
    r"(?:(?:sampl\w*|update|output data)[\s_]*(?:rate|freq\w*)|\bodr)\W*(?:hz\W+)?"
    r"(\d+(?:\.\d+)?)\s*(k?)(?:hz|sps)?\W*$",
    re.IGNORECASE,
)
# Lines that are no rows of numbers before they are converted, and how.
_RAW = {
    r"^\s*(?:\(\d+\.\d+\)\s+)?\w*can\d+\s+[\dA-Fa-f]{3,8}(?:#|\s+\[\d+\])(?!.* :: )": (
        "these are raw frames of a CAN bus; decode them with the description of the bus (a DBC file), e.g. "
        "with cantools or SavvyCAN, into a table with a column per signal"
    ),
    r"^\W*(?:0[xX][\dA-Fa-f]+\W*){3,}$": (
        "its numbers are hexadecimal; convert them to decimal ones, those of four digits with their sign, by "
        "perl -pe 's/0x([0-9a-f]+)/hex($1)-(length($1)==4&&hex($1)>32767?65536:0)/gei' {path} > decimal.txt"
    ),
}
_INTERVAL = re.compile(r"Delta_X\t([\d.]+(?:[eE][+-]?\d+)?)\s")
# What states the unit of a sensor in a comment, or in a message under a name of its own; and before the names
# of LabVIEW's columns.
_UNIT = re.compile(
    r"\b(gyro\w*?|gyr|acc\w*?)(?:_units?\b|\s+units?\b|\s+sensitivity\b|(?:\s+data)?\s+in\b)"
    r"[\s:=\"'\\]+([^\"'\\,;}\n]+?)\s*(?:\band\b|[\"'\\,;}\n]|$)",
    re.IGNORECASE,
)
_UNITS_OF_LABVIEW = "Y_Unit_Label"
# Lines of files of noise coefficients, and the targets of `export` that such a file may be of.
_COEFFICIENTS = {
    r"^\s*\w+-axis:": "imu_utils",
    r"noise_density\W*[:=]": "kalibr",
    r"\b(?:gyr|acc)_n\b\W*[:=]": "vins-mono",
}
# A comment that has the units of columns, such as `% [s] [deg/h] [g]`.
_UNITS_IN_BRACKETS = re.compile(r"\s*[%#/]+\s*(?:\[[^\[\]]*\][\s,;|]*)+")
# A line that ends a table.
_SECTION = re.compile(r"\s*(?:[\[<]/?[A-Za-z][\w .-]*[\]>]|\w*END\w*)\s*")
# A header has at most so many lines; and this share of the first lines must be rows if each line is one.
_HEADER_LINES, _REGULAR = 4, 0.99
_GROUPS = "commas within numbers in quotes are taken to separate thousands"
_SENSORS: dict[Sensor, str] = {"gyro": "gyros", "accel": "accelerometers"}


@dataclass(frozen=True)
class Grammar:
    """How lines hold the cells of rows.

    Attributes:
        start: index of the first line of data.
        fields: number of columns.
        labels: their labels, or None.
        delimiter: what separates cells; None for white space.
        decimal: decimal mark.
        comment: what begins a comment.
        numeric: columns with numbers in the first row.
        message: the shape of messages; None if a line is its cells.
        rate: sample rate [Hz] stated before the data.
        notes: what users should know.
        units: unit of each sensor that a published format fixes.
        sizes: sizes of counts, by sensor, that messages propose.
        kinds: first words of rows, if comments before these name their columns for each of them.
    """

    start: int
    fields: int
    labels: tuple[str, ...] | None = None
    delimiter: str | None = None
    decimal: str = "."
    comment: str = "#"
    numeric: tuple[int, ...] = ()
    message: Message | None = None
    rate: float | None = None
    notes: tuple[str, ...] = ()
    units: Mapping[Sensor, str] = field(default_factory=dict)
    sizes: Mapping[Sensor, str] = field(default_factory=dict)
    kinds: frozenset[str] = frozenset()

    @property
    def has_axes(self) -> bool:
        """Whether an axis is among its labels."""
        return any(map(is_axis, self.labels or ()))

    @property
    def end(self) -> bytes:
        """What ends a record, with the first byte of the next one."""
        mark = self.message.mark if self.message else None
        return b"\n" if mark is None else b"\n" + (mark.encode() or b"\n")

    def without(self, others: Sequence[str], path: str) -> str:
        """What to do about lines that are no rows: a command that writes the rows alone, if there is one."""
        # A command must not write to the file that it reads.
        name = "rows.txt" if Path(path).name != "rows.txt" else "rows-2.txt"
        command = ""
        if self.message is None:
            mark = "" if self.delimiter is None else f" -F'{self.delimiter}'"
            command = f"awk{mark} 'NF=={self.fields}'"
        else:
            words = re.findall(r"\w+", self.message.shape)
            own = [word for word in words if not any(word in other for other in others)]
            command = f"grep -aF '{max(own, key=len)}'" if own else ""
        if not command:
            return "repair these lines, or leave them out"
        return f"to leave them out, run {command} {shlex.quote(path)} > {name}"

    def after(self, lines: int) -> "Grammar":
        """Return the grammar of a table that begins after so many lines."""
        note = f"the table from line {lines + 1} on is read, as the first one has no axes"
        return replace(self, start=self.start + lines, notes=(note, *self.notes))

    def records(self, lines: Iterable[Numbered]) -> Iterator[Numbered]:
        """Yield number and text of each record, which is a line or a message of several."""
        return records_of(lines, self.message.mark if self.message else None)

    def row(self, text: str) -> str | None:
        """A record as a line of a table, all nan if it is damaged; None if it is no row."""
        cells = self._cells(text) if self.message is None else self.message.row(text)
        # A damaged row is a missing sample; if there are stamps, these tell that it is missing.
        if cells is None or (not cells and any(recognise(x).role == "time" for x in self.labels or ())):
            return None
        return (self.delimiter or " ").join(cells or ["nan"] * self.fields)

    def is_whole(self, text: str) -> bool:
        """Whether a record is a row that is not damaged."""
        if self.message is not None:
            return bool(self.message.row(text))
        return bool(self._cells(text)) and fits(split(self._bare(text), self.delimiter), self.fields)

    def is_blank(self, text: str) -> bool:
        """Whether a record is empty; tabs alone are empty cells."""
        return not (text.strip(" \r") if self.delimiter == "\t" else text.strip())

    def kind(self, text: str) -> str:
        """What a record is that is no row.

        It is "known" (another message), "names" (the header again), "comment", "end" (of the table), or
        "strange".
        """
        if self.message is not None and self.message.is_other(text):
            return "known"
        cells = trimmed(split(without_mark(text.replace("\n", " ")), self.delimiter))
        if [split_unit(cell)[0] for cell in cells] == [split_unit(label)[0] for label in self.labels or ()]:
            return "names"
        if {*cells[:1]} & self.kinds:
            return "known"
        if is_comment(text) or is_border(text) or not re.search(r"\w", text):
            return "comment"
        is_header = self.delimiter is not None and len(cells) > 1 and not any(map(is_number, cells))
        has_names = is_header and any(recognise(cell).role != "auxiliary" for cell in cells)
        return "end" if has_names or _SECTION.fullmatch(text) else "strange"

    def _bare(self, text: str) -> str:
        return text.partition(self.comment)[0]

    def _cells(self, text: str) -> list[str] | None:
        """The cells of a line: an empty list if it is damaged, None if it is something else."""
        if is_comment(text) or is_border(text):
            return None
        cells = split(self._bare(text), self.delimiter)
        cells = cells[: self.fields] if fits(cells, self.fields) else trimmed(cells)
        cells = without_groups(cells, self.delimiter) if self.decimal == "." else cells
        numbers = {k for k, cell in enumerate(cells) if is_number(cell.replace(self.decimal, "."))}
        words = [k for k, cell in enumerate(cells) if cell and k in self.numeric and k not in numbers]
        # A delimiter within quotes separates nothing.
        cells = [f'"{cell}"' if self.delimiter and self.delimiter in cell else cell for cell in cells]
        missing = self.fields - len(cells)
        if missing == 0 and any(recognise(self.labels[k]).role == "time" for k in words if self.labels):
            return []
        if missing and {*cells[:1]} & self.kinds:
            return None
        if missing == 0:
            return cells if numbers & {*self.numeric} or not any(cells) else None
        if missing > 0:
            return None if words else [*cells, *["nan"] * missing]
        return [] if len(numbers) > len(words) else None


def names_axes(text: str) -> bool:
    """Whether a line has the name of an axis, and no number."""
    cells = split(text, delimiter_of(text))
    return len(cells) > 1 and not any(map(is_number, cells)) and any(map(is_axis, cells))


def grammar_of(texts: Sequence[str], file: str, source: Source) -> Grammar:
    """Return the grammar of a file from its first lines and its name.

    Raises:
        RecordingError: they have no row of numbers; the message says what they have.
    """
    head = list(enumerate(texts[:FIRST_LINES]))
    if not any(text.strip() for text in texts):
        raise source.no_rows()
    found = _plain(head)
    if found is None or not _is_regular(found, texts):
        found = _of_messages(head) or found
    if found is None or _raw(head):
        raise source.error(_without_rows(head, source.label))
    before = [text.strip() for text in texts[: found.start]]
    _, row = next(found.records(head[found.start :]))
    found = _with_rate(_with_units(found, [*filter(is_comment, before), row]), before)
    return _of_device(found, {"head": "\n".join(before), "row": row, "file": file})


def _with_rate(found: Grammar, before: Sequence[str]) -> Grammar:
    """Return the grammar with the sample rate that a line before the data states, or the interval."""
    stated = next(filter(None, map(_RATE.search, before)), None)
    interval = next(filter(None, map(_INTERVAL.match, before)), None)
    if stated is not None:
        line, rate = stated.string, float(stated[1]) * (1e3 if stated[2] else 1.0)
    elif interval is not None and float(interval[1]):
        line, rate = interval.string, 1.0 / float(interval[1])
    else:
        return found
    note = f"sample rate {rate:g} Hz from the line {line[:60]!r}"
    return replace(found, rate=rate, notes=(*found.notes, note))


def _with_units(found: Grammar, texts: Sequence[str]) -> Grammar:
    """Return the grammar with the units that comments and the first row state."""
    units: dict[Sensor, str] = {}
    for text in texts:
        for name, unit in _UNIT.findall(text):
            sensor = recognise(name).sensor
            with suppress(UnitError):
                if sensor is not None and sensor not in units:
                    units[sensor] = parse_sample_unit(unit, sensor).name
    if not units:
        return found
    told = " and ".join(f"{_SENSORS[sensor]} in {unit}" for sensor, unit in units.items())
    return replace(found, units=units, notes=(*found.notes, f"{told} where columns state none"))


def _without_rows(head: Sequence[Numbered], path: str) -> str:
    """What there is in place of rows of numbers, and what to do, in words."""
    number, text = _middle(head)
    looked = f"{len(head)} lines" if len(head) > 1 else "line"
    remedy = _raw(head).replace("{path}", shlex.quote(path)) or (
        "convert it to a line of names, such as time [s],gyro_x [deg/s],accel_x [g], and below it a row of "
        "numbers per sample"
    )
    for pattern, target in _COEFFICIENTS.items():
        if any(re.search(pattern, text) for _, text in head):
            other = "vins-mono" if target == "kalibr" else "kalibr"
            remedy = (
                "these are coefficients of noise and no samples; convert them, e.g. with allanjax export "
                f"'{path}' --from {target} --to {other} (allanjax export --list has the names)"
            )
            break
    return f"no row of numbers in its first {looked}; line {number + 1} is {text.strip()[:80]!r}; {remedy}"


def _middle(head: Sequence[Numbered]) -> Numbered:
    """Return the line in the middle of those that are not blank."""
    shown = [(number, text) for number, text in head if text.strip()]
    return shown[len(shown) // 2]


def _raw(head: Sequence[Numbered]) -> str:
    """How lines are to be converted before they are rows of numbers; "" if they are not."""
    return next((how for pattern, how in _RAW.items() if re.search(pattern, _middle(head)[1])), "")


def _of_messages(head: Sequence[Numbered]) -> Grammar | None:
    """Return the grammar of messages; None if there are none."""
    found = messages_in(head)
    if found is None:
        return None
    kind = f"the rows are messages such as {' '.join(found.example.split())[:60]!r}"
    notes = (*_skipped([text for _, text in head[: found.start] if text.strip()]), kind)
    fields = len(found.message.cells)
    return Grammar(found.start, fields, found.labels, "\t", message=found.message, notes=notes)


class _Line(NamedTuple):
    """A line before or of the data, split at its own delimiter."""

    number: int
    text: str
    delimiter: str | None
    cells: list[str]

    @property
    def numbers(self) -> int:
        """How many of its cells are numbers; 0 if a cell has a number beside something else."""
        is_mixed = any(is_decorated(cell, self.delimiter) for cell in self.cells)
        return 0 if is_mixed else sum(map(is_number, self.cells))


def _plain(head: Sequence[Numbered]) -> Grammar | None:
    """Return the grammar of lines that are cells between delimiters; None if none of them is a row."""
    head = [(number, text) for number, text in head if text.strip(" ") and not is_border(text)]
    if not head:
        return None
    sep = _SEP.fullmatch(head[0][1])
    lines, has_commas, has_groups = [], False, False
    for number, text in head[1:] if sep else head:
        own = has_decimal_commas(text)
        has_commas |= own
        delimiter = delimiter_beside_commas(text) if own else delimiter_of(text)
        delimiter = sep[1] if sep else delimiter
        cells = split(text, delimiter)
        bare = with_points(cells) if own else without_groups(cells, delimiter)
        has_groups |= not own and bare != cells
        lines.append(_Line(number, text, delimiter, bare))
    first = _first_row([line for line in lines if not is_comment(line.text)])
    if first is None:
        return None
    before = [line for line in lines if line.number < first.number]
    is_percent = any(line.text.lstrip().startswith("%") for line in before)
    found = Grammar(
        first.number,
        len(first.cells),
        delimiter=first.delimiter,
        decimal="," if has_commas else ".",
        comment="%" if is_percent else "#",
        numeric=tuple(k for k, cell in enumerate(first.cells) if is_number(cell)),
        notes=(*["numbers with decimal commas"] * has_commas, *[_GROUPS] * (has_groups and not has_commas)),
        kinds=_kinds(lines),
    )
    return _with_names(found, before)


def _kinds(lines: Sequence[_Line]) -> frozenset[str]:
    """Return the words at the start of comments with names that are those at the start of rows, too."""
    named = {without_mark(line.text).split(",")[0] for line in lines if is_comment(line.text)}
    return frozenset(named & {line.cells[0] for line in lines if line.numbers})


def _first_row(lines: Sequence[_Line]) -> _Line | None:
    """Return the first row: the one below names of axes, or else the first of the most frequent size."""
    for k, line in enumerate(lines):
        above = reversed(lines[max(k - _HEADER_LINES, 0) : k]) if any(map(is_number, line.cells)) else ()
        for other in above:
            names = trimmed(split(other.text, line.delimiter))
            if any(map(is_number, names)):
                break
            # The last names may have no cells if that is so in all rows.
            size = len(line.cells)
            is_short = size < len(names) and all(len(x.cells) == size for x in lines[k : k + 3])
            has_cells = fits(line.cells, len(names)) or is_short
            names_columns = any(map(is_axis, names)) or set(names) >= set(LONG)
            if names_columns and has_cells and _are_plain(names, line):
                return line._replace(cells=line.cells[: len(names)])
    rows = [line for line in lines if 0 < len(trimmed(line.cells)) <= 2 * line.numbers]
    if not rows:
        return None
    sizes = Counter((line.delimiter, len(line.cells)) for line in rows)
    first = max(rows, key=lambda line: sizes[line.delimiter, len(line.cells)])
    alike = [x for x in rows if (x.delimiter, len(x.cells)) == (first.delimiter, len(first.cells))]
    # Columns at the end that are empty in all rows are none.
    return first._replace(cells=first.cells[: max(len(trimmed(line.cells)) for line in alike)])


def _are_plain(names: Sequence[str], line: _Line) -> bool:
    """Whether no cell of a known column has a number beside something else, as messages have."""
    cells = zip(names, line.cells, strict=False)
    mixed = [name for name, cell in cells if is_decorated(cell, line.delimiter)]
    return all(name and recognise(name).role == "auxiliary" and not is_axis(name) for name in mixed)


def _is_regular(found: Grammar, texts: Sequence[str]) -> bool:
    """Whether nearly all lines of the data are rows."""
    lines = [text for text in texts[found.start : FIRST_LINES] if text.strip()]
    rows = [found.is_whole(x) for x in lines if found.row(x) or found.kind(x) not in ("comment", "known")]
    return sum(rows) >= _REGULAR * len(rows)


def _with_names(found: Grammar, before: Sequence[_Line]) -> Grammar:
    """Return the grammar with the labels that lines before the first row have."""
    plain = [line for line in before if not is_comment(line.text)]
    named = [(line.number, _names(line.text, found)) for line in plain]
    fitting = [(number, names) for number, names in named if len(names) == found.fields]
    header = next((x for x in fitting if "" not in x[1] and any(map(is_axis, x[1]))), None)
    if header is None and fitting:
        number, names = fitting[0]
        header = number, _joined([x for _, x in fitting[1 - _HEADER_LINES :]]) or names
    if header is not None:
        number, names = header
        units = _units([cells for n, cells in named if n > number or cells[:1] == [_UNITS_OF_LABVIEW]])
        pairs = itertools.zip_longest(names, units[: len(names)], fillvalue="")
        labels = tuple(with_unit(name, unit) for name, unit in pairs)
        notes = found.notes + _skipped([line.text for line in plain if line.number < number])
        # Without units, all lines after the header are data.
        return replace(found, start=found.start if units else number + 1, labels=labels, notes=notes)
    units = [""] * found.fields
    for line in reversed([line for line in before if is_comment(line.text)]):
        in_brackets = _UNITS_IN_BRACKETS.fullmatch(line.text) and re.findall(r"\[(.*?)\]", line.text)
        if in_brackets and len(in_brackets) == found.fields:
            units = [unit if is_unit_name(unit) else "" for unit in in_brackets]
            continue
        names = _names(line.text, found)
        labels = tuple(map(with_unit, names, units)) if len(names) == found.fields else ()
        if any(recognise(x).role != "auxiliary" or is_axis(x) for x in labels):
            return replace(found, labels=labels)
    return replace(found, notes=found.notes + _skipped([line.text for line in plain]))


def _names(text: str, found: Grammar) -> list[str]:
    """Return the names in a line, if it has as many as there are columns, else its cells.

    Names may have blanks if two or more separate them. A mark may be before them, and more names after them.
    """
    cells = split(text, found.delimiter)
    bare = split(without_mark(text), found.delimiter)
    aligned = re.split(r"\s{2,}", without_mark(text).strip()) if found.delimiter is None else []
    for names in (cells, bare, aligned):
        if fits(names, found.fields):
            return names[: found.fields]
    has_more = len(bare) > found.fields and any(map(is_axis, bare[: found.fields]))
    return bare[: found.fields] if has_more else cells


def _joined(lines: Sequence[Sequence[str]]) -> list[str]:
    """Return names that are in two lines, the sensors and the axes below; none if they are not of axes."""
    sensors, *below = map(list, lines)
    for k, cell in enumerate(sensors):
        sensors[k] = cell or (sensors[k - 1] if k and below else "")
    words = [["" if is_unit_name(cell) else cell for cell in cells] for cells in below]
    names = [" ".join(filter(None, cells)) for cells in zip(sensors, *words, strict=True)]
    return names if any(map(is_axis, names)) else []


def _units(lines: Iterable[Sequence[str]]) -> list[str]:
    """Return the units of the columns, blank where these lines below the names have none."""
    units: list[str] = []
    for cells in lines:
        bare = [re.sub(r"^[\[(](.*)[\])]$", r"\1", cell) for cell in cells]
        own = (cell if is_unit_name(cell) else "" for cell in bare)
        units = [one or other for one, other in itertools.zip_longest(own, units, fillvalue="")]
    return units if any(units) else []


def _skipped(lines: Sequence[str]) -> tuple[str, ...]:
    """Return a note on skipped lines before the data, if any."""
    if not lines:
        return ()
    first = f"{lines[0].strip()[:60]!r}" if len(lines) == 1 else f"the first is {lines[0].strip()[:60]!r}"
    return (f"skipped: {counted(len(lines), 'line')} before the data, {first}",)


@functools.cache
def _devices() -> list[dict[str, Any]]:
    text = files(__package__).joinpath("devices.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)["device"]


def _of_device(found: Grammar, texts: Mapping[str, str]) -> Grammar:
    """Return the grammar with what the published format of a device says, if the text is of one."""
    texts = {**texts, "labels": ",".join(found.labels or ())}
    for device in _devices():
        columns = tuple(device.get("columns", ()))
        matches = all(re.search(device[key], text) for key, text in texts.items() if key in device)
        # Names in the file are better than columns by their number.
        may_name = not columns or found.labels is None or found.message is not None
        if not (matches and may_name and len(columns) <= found.fields == device.get("count", found.fields)):
            continue
        message = found.message
        if message is not None and columns:
            message = replace(message, cells=tuple(range(message.pattern.groups))[-len(columns) :])
        rename = device.get("rename", {})
        units = {sensor: device[sensor] for sensor in SENSORS if sensor in device}
        said = ["columns"] if columns else []
        said += [f"{_SENSORS[sensor]} in {unit}" for sensor, unit in units.items()]
        said = said or ["names"]
        return replace(
            found,
            fields=len(columns) or found.fields,
            labels=tuple(rename.get(label, label) for label in columns or found.labels or ()) or None,
            message=message,
            notes=(*found.notes, f"{', '.join(said)} by the format of {device['name']}"),
            units={**found.units, **units},
            sizes=device.get("sizes", {}),
        )
    return found
