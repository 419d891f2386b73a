"""Reader of JSON: an array of samples, arrays by name, or samples that name their sensor; in any nesting.

What pandas writes of a data frame is read in all its layouts.
"""

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from allanjax.record.io.arrays import from_named, stated_units
from allanjax.record.io.table import Format, Table, damage_reported
from allanjax.record.io.text import open_text
from allanjax.record.validation import MIN_SAMPLES, Source

# A document begins with an array of objects, or with an object. Of objects in lines, which are text, only
# those are read here that name their sensor.
_ARRAY = re.compile(rb"(?:\xef\xbb\xbf)?\s*\[\s*\{")
_OBJECT, _NEXT = re.compile(rb'(?:\xef\xbb\xbf)?\s*\{\s*"'), re.compile(rb"\}\s*\n\s*\{")
_SENSOR = re.compile(rb':\s*"\w*(?:gyr|acc)\w*"', re.IGNORECASE)


def _is_json(magic: bytes) -> bool:
    """Return whether a file with these first bytes is read here."""
    is_object = _OBJECT.match(magic) and (not _NEXT.search(magic) or _SENSOR.search(magic))
    return bool(_ARRAY.match(magic) or is_object)


def open_json(path: Path, source: Source) -> Table:
    """Return the table of a JSON document; text that is none, or is cut off, is read as other text."""
    content = path.read_bytes()
    try:
        document = json.loads(content)
    except ValueError:
        try:
            document = [json.loads(line) for line in content.splitlines() if line.strip()]
        except ValueError:
            return open_text(path, source)
    import pandas as pd

    with damage_reported(source, "JSON", "write an object per sample"):
        document = _as_records(document)
        records = _records(document)
        if not records:
            return from_named({name: np.asarray(x) for name, x in _flat(document, False)}, source)
        frame = pd.DataFrame([dict(_flat(record, True)) for record in records])
        columns = tuple(_numbers(frame[label]) for label in frame)
        units, notes = stated_units(dict(_flat(records[0], True)))
        return replace(Table.of(columns, tuple(map(str, frame)), source, notes=notes), units=units)


def _as_records(document: Any) -> Any:
    """Return the rows of a data frame as objects, from names beside rows, or objects by name or by row.

    Other documents are unchanged. An index that does not just count rows is a column.
    """
    match document:
        case {"columns": [*names], "data": [[*_], *_] as rows}:
            index = document.get("index", range(len(rows)))
            records = [dict(zip(names, row, strict=False)) for row in rows]
        case dict() if _are_alike([*document.values()]):
            inner = next(iter(document.values()))
            if len(inner) > len(document):
                index = [*inner]
                records = [{name: own[key] for name, own in document.items()} for key in inner]
            else:
                index, records = [*document], [*document.values()]
        case _:
            return document
    counts = all(str(key) == str(k) for k, key in enumerate(index))
    return records if counts else [{"index": key, **row} for key, row in zip(index, records, strict=False)]


def _are_alike(values: Sequence[Any]) -> bool:
    """Return whether values are objects with the same names, and either these or the objects are many."""
    if not values or not all(
        isinstance(value, dict) and value.keys() == values[0].keys() for value in values
    ):
        return False
    # Few objects with few names, such as a gyro and an accelerometer with arrays, are no rows.
    plain = not any(isinstance(cell, dict | list) for cell in values[0].values())
    return plain and max(len(values), len(values[0])) >= MIN_SAMPLES


def _records(value: Any) -> Sequence[dict[str, Any]]:
    """Return the longest array of objects in a document; an empty one if there is none."""
    if isinstance(value, list) and value and all(isinstance(item, dict) for item in value):
        return value
    inner = value.values() if isinstance(value, dict) else ()
    return max(map(_records, inner), key=len, default=())


def _flat(value: Any, is_record: bool, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield values with their names; elements of arrays in a record are values."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _flat(item, is_record, f"{name}.{key}" if name else key)
    elif isinstance(value, list) and is_record:
        for k, item in enumerate(value):
            yield from _flat(item, True, f"{name}[{k}]")
    else:
        yield name, value


def _numbers(column: Any) -> np.ndarray:
    """Return a column as numbers, which may be in quotes; other ones unchanged."""
    import pandas as pd

    try:
        return np.asarray(pd.to_numeric(column))
    except (ValueError, TypeError):
        return np.asarray(column, dtype=object)


JSON = Format("JSON", _is_json, open_json)
