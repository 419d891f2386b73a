"""Reader for the text output of VectorNav sensors: lines such as `$VNYMR,...*65`, without time stamps."""

import io
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from allanjax.record.io.table import Format, Table, damage_reported
from allanjax.record.validation import Source

_GYRO = tuple(f"gyro_{axis} [rad/s]" for axis in "xyz")
_ACCEL = tuple(f"accel_{axis} [m/s²]" for axis in "xyz")
_MAG = tuple(f"mag_{axis} [gauss]" for axis in "xyz")
_ANGLES = tuple(f"{angle} [deg]" for angle in ("yaw", "pitch", "roll"))
# Fields of messages with samples.
_FIELDS = {
    b"$VNYMR": (*_ANGLES, *_MAG, *_ACCEL, *_GYRO),
    b"$VNQMR": (*(f"quaternion_{k}" for k in range(4)), *_MAG, *_ACCEL, *_GYRO),
    b"$VNMAR": (*_MAG, *_ACCEL, *_GYRO),
    b"$VNIMU": (*_MAG, *_ACCEL, *_GYRO, "temperature [degC]", "pressure [kPa]"),
    b"$VNDTV": (
        "interval [s]",
        *(f"delta_theta_{axis} [deg]" for axis in "xyz"),
        *(f"delta_vel_{axis} [m/s]" for axis in "xyz"),
    ),
    b"$VNGYR": _GYRO,
    b"$VNACC": _ACCEL,
}
_LINE = re.compile(rb"(?:^|\n)\$VN[A-Z]{3},")
# Exclusive or of the bytes after the $, in two hexadecimal digits at the end of a line.
_ENDED = re.compile(rb"\*([0-9A-Fa-f]{2})\s*$")


def read_vectornav(path: Path, source: Source) -> Table:
    """Return the lines of the most frequent message; a damaged line is a sample with nan.

    Raises:
        RecordingError: no message has samples.
    """
    import pandas as pd

    lines = path.read_bytes().split(b"\n")
    count = Counter(line[:6] for line in lines if line.startswith(b"$VN"))
    known = {kind: count[kind] for kind in _FIELDS if kind in count}
    if not known:
        there = ", ".join(sorted(kind.decode("latin-1") for kind in count))
        wanted = ", ".join(kind.decode() for kind in _FIELDS)
        raise source.error(f"no message with samples (only {there}); let the sensor write {wanted}")
    kind = max(known, key=lambda kind: known[kind])
    places = [k for k, line in enumerate(lines) if line.startswith(kind)]
    # Lines between messages that are not messages are damaged ones.
    torn = (
        k
        for k in range(places[0], places[-1])
        if lines[k].strip() and not lines[k].startswith((b"$VN", b"#"))
    )
    places = sorted([*places, *torn])
    rows = [lines[k] for k in places]
    labels = _FIELDS[kind]
    nothing = (len(labels) - 1) * b","
    intact = _are_intact(rows, len(labels))
    bodies = [
        row[7:].partition(b"*")[0].strip() if good else nothing
        for row, good in zip(rows, intact, strict=True)
    ]
    with damage_reported(source, "lines of numbers", "repair the lines, or save it as CSV"):
        text = io.BytesIO(b"\n".join(bodies))
        frame = pd.read_csv(text, header=None, encoding="latin-1", skip_blank_lines=False, low_memory=False)
    notes = [f"{known[kind]} lines of {kind.decode()}"]
    others = len(lines) - len(rows) - sum(not line.strip() for line in lines)
    if others:
        notes.append(f"{others} other lines are skipped")
    source = Source(source.label, lambda row: f"line {places[row] + 1}", "a damaged line")
    columns = tuple(frame[name].to_numpy() for name in frame.columns)
    return Table.of(columns, labels, source, notes=tuple(notes))


def _are_intact(rows: Sequence[bytes], fields: int) -> Bool[np.ndarray, " rows"]:
    """Return whether each line has so many fields and, if it states a check sum, the right one."""
    ends = [_ENDED.search(row) for row in rows]
    intact = np.array([row.count(b",") == fields for row in rows], bool)
    summed = [k for k, end in enumerate(ends) if end is not None and intact[k]]
    if summed:
        bodies = [rows[k][1:].partition(b"*")[0] for k in summed]
        starts = np.cumsum([0, *map(len, bodies[:-1])])
        sums = np.bitwise_xor.reduceat(np.frombuffer(b"".join(bodies), np.uint8), starts)
        intact[summed] = [int(rows[k].rpartition(b"*")[2], 16) for k in summed] == sums
    return intact


VECTORNAV = Format(
    "VectorNav", lambda magic: _LINE.search(magic) is not None, read_vectornav, in_chunks=False
)
