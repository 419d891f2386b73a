"""Reader for ArduPilot's DataFlash logs, which define their own messages."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Int, Shaped, UInt8

from allanjax.record.io.series import Series, choose, describe_choice, recording_of
from allanjax.record.io.table import Format, Table, floats
from allanjax.record.validation import Source

# A message begins with two bytes and its type; type 128 defines another message in 89 bytes.
_HEAD = 3
_FMT, _FMT_SIZE = 128, 89
# Characters for types of numbers; others are texts and numbers that do not occur in samples.
_TYPES = {"b": "i1", "B": "u1", "M": "u1", "h": "<i2", "H": "<u2", "i": "<i4", "I": "<u4", "q": "<i8"}
_TYPES |= {"Q": "<u8", "g": "<f2", "f": "<f4", "d": "<f8", "n": "S4", "N": "S16", "Z": "S64", "L": "<i4"}
_TYPES |= {"a": "(32,)<i2", "c": "<i2", "C": "<u2", "e": "<i4", "E": "<u4"}
# Messages with samples, with a number for further sensors; and groups that form one recording.
_SAMPLES = re.compile(r"(IMU|ACC|GYR)(\d?)")
_GROUPS = (("GYR", "ACC"), ("IMU",))
_BATCHES = ("ISBH", "ISBD")
# Bytes that are searched at a time.
_BLOCK = 1 << 26
_LOG_IMU = "set IMU_FAST or IMU_RAW in LOG_BITMASK, and LOG_DISARMED to 1"


class _Definition(NamedTuple):
    """Definition of a message: its name, and its fields as a NumPy type; None if it is damaged."""

    name: str
    dtype: np.dtype | None


def open_dataflash(path: Path, source: Source, topic: str | None, instance: int | None) -> Table:
    """Return the samples of IMU, or of GYR and ACC, whichever has the higher rate or is chosen.

    Raises:
        RecordingError: the log has no samples of an IMU, only batches, or not the chosen message.
    """
    data = np.memmap(path, np.uint8, "r")
    heads = _heads(data)
    definitions = _definitions(data, heads)
    if not definitions:
        raise source.error(
            "cannot be read as a DataFlash log: it defines no messages; copy it again, or save the data as "
            "CSV, Parquet or NumPy .npy"
        )
    lengths = np.zeros(256, np.int64)
    lengths[_FMT] = _FMT_SIZE
    for kind, definition in definitions.items():
        if definition.dtype is not None:
            lengths[kind] = _HEAD + definition.dtype.itemsize
    starts = _messages(data, heads, lengths)
    kinds = data[starts + 2]
    found: dict[tuple[str, int], Series] = {}
    batches = False
    for kind, definition in definitions.items():
        rows = starts[kinds == kind]
        batches |= definition.name in _BATCHES and len(rows) > 0
        if _SAMPLES.fullmatch(definition.name) and definition.dtype is not None and len(rows):
            payload = data[rows[:, None] + np.arange(_HEAD, lengths[kind])]
            found |= _series(definition.name, payload.view(definition.dtype)[:, 0], source)
    if batches and (not found or topic in _BATCHES):
        raise source.error(
            f"batches with pauses (ISBH, ISBD) are unsuitable for Allan deviations; {_LOG_IMU}"
        )
    if not found:
        raise source.error(f"no samples of an IMU (IMU, or GYR and ACC); {_LOG_IMU}")
    chosen = choose(found, _GROUPS, topic, instance, source)
    notes = [describe_choice(found, chosen)]
    skipped = len(data) - int(lengths[kinds].sum())
    if skipped:
        notes.append(f"{skipped} of {len(data)} bytes are incomplete messages and left out")
    if batches:
        notes.append("batches of samples with pauses (ISBH, ISBD) are left out")
    return recording_of(chosen, source).table("time", source, notes)


def _heads(data: UInt8[np.ndarray, " bytes"]) -> Int[np.ndarray, " heads"]:
    """Return the places where a message may begin."""
    found = [np.zeros(0, np.int64)]
    for first in range(0, len(data) - 2, _BLOCK):
        block = data[first : first + _BLOCK + 1]
        found.append(first + np.flatnonzero((block[:-1] == 0xA3) & (block[1:] == 0x95)))
    places = np.concatenate(found)
    return places[places < len(data) - 2]


def _definitions(
    data: UInt8[np.ndarray, " bytes"], heads: Int[np.ndarray, " heads"]
) -> dict[int, _Definition]:
    """Return the definitions of messages by type."""
    definitions = {}
    for start in heads[data[heads + 2] == _FMT]:
        message = data[start : start + _FMT_SIZE].tobytes()
        if len(message) == _FMT_SIZE:
            name, characters, labels = (
                message[part].partition(b"\0")[0].decode("latin-1")
                for part in (slice(5, 9), slice(9, 25), slice(25, None))
            )
            definitions[message[3]] = _Definition(name, _dtype(characters, labels, message[4]))
    return definitions


def _dtype(characters: str, labels: str, length: int) -> np.dtype | None:
    """Return the type of a message's fields; None if the definition is inconsistent."""
    names = [name.strip() for name in labels.split(",")] if labels else []
    known = all(character in _TYPES for character in characters)
    if not characters or not known or len(names) != len(characters) or len(set(names)) < len(names):
        return None
    dtype = np.dtype([(name, _TYPES[c]) for name, c in zip(names, characters, strict=True)])
    return dtype if "" not in names and dtype.itemsize == length - _HEAD else None


def _messages(
    data: UInt8[np.ndarray, " bytes"], heads: Int[np.ndarray, " heads"], lengths: Int[np.ndarray, "256"]
) -> Int[np.ndarray, " messages"]:
    """Return the places of messages: heads of a known type, with another head where the message ends."""
    size = lengths[data[heads + 2]]
    ends = heads + size
    is_head = np.isin(ends, heads) | (ends == len(data))
    starts, ends = heads[(size > 0) & is_head], ends[(size > 0) & is_head]
    # The bytes of a head may occur within a message: a head within a kept message is not one.
    while len(starts):
        within = np.append(False, starts[1:] < ends[:-1])
        within &= ~np.append(False, within[:-1])
        if not within.any():
            break
        starts, ends = starts[~within], ends[~within]
    return starts


def _series(
    name: str, rows: Shaped[np.ndarray, " messages"], source: Source
) -> Mapping[tuple[str, int], Series]:
    """Return series by message and sensor number, which is in a field or in the name of the message."""
    match = _SAMPLES.fullmatch(name)
    assert match is not None
    fields = [name for name in rows.dtype.names or () if rows.dtype[name].kind in "iuf"]
    clock = next((clock for clock in ("SampleUS", "TimeUS", "TimeMS") if clock in fields), None)
    halves = {
        sensor: np.column_stack([floats(rows[f"{label}{axis}"]) for axis in "XYZ"])
        for sensor, label in (("gyro", "Gyr"), ("accel", "Acc"))
        if {f"{label}{axis}" for axis in "XYZ"} <= {*fields}
    }
    if clock is None or not halves:
        raise source.error(f"{name} lacks times or samples (it has {', '.join(fields)}); {_LOG_IMU}")
    times = rows[clock].astype(np.int64) * (10**6 if clock == "TimeMS" else 10**3)
    others = {"temperature [degC]": floats(rows["T"])} if "T" in fields else {}
    whole = Series(match[1], times, halves.get("gyro"), halves.get("accel"), others)
    numbers = rows["I"] if "I" in fields else np.full(len(rows), max(int(match[2] or 1) - 1, 0))
    return {(match[1], int(i)): whole.taken(numbers == i).in_order() for i in np.unique(numbers)}


DATAFLASH = Format(
    "DataFlash",
    lambda magic: magic.startswith(b"\xa3\x95"),
    open_dataflash,
    (".bin",),
    in_chunks=False,
    choices=("topic", "instance"),
)
