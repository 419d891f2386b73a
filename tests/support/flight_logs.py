"""Flight logs written byte by byte: PX4's ULog and ArduPilot's DataFlash."""

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

# Of ULog, and the characters of DataFlash, by the types of NumPy.
_ULOG = {"f4": "float", "f8": "double", "u8": "uint64_t", "u4": "uint32_t", "i4": "int32_t"}
_ULOG |= {"u1": "uint8_t", "i2": "int16_t", "u2": "uint16_t"}
_BIN = {"f4": "f", "f8": "d", "u8": "Q", "u4": "I", "u2": "H", "u1": "B", "i2": "h", "[32]i2": "a"}


def structured(**columns: np.ndarray) -> np.ndarray:
    """Structured array of columns, packed."""
    dtype = [(name, column.dtype.str, column.shape[1:]) for name, column in columns.items()]
    return np.array([*zip(*columns.values(), strict=True)], dtype)


def _fields(rows: np.ndarray) -> list[tuple[str, str, str]]:
    """Name, type and shape of each field."""
    types = [(name, rows.dtype[name].base.str[1:], rows.dtype[name].shape) for name in rows.dtype.names]
    return [(name, kind, f"[{shape[0]}]" if shape else "") for name, kind, shape in types]


def _ulog_message(kind: str, payload: bytes) -> bytes:
    return struct.pack("<HB", len(payload), ord(kind)) + payload


def write_ulog(
    path: Path, messages: Mapping[tuple[str, int], np.ndarray], dropouts: Sequence[int] = ()
) -> Path:
    """Write a ULog file of structured arrays by message name and instance; dropouts [ms] come last."""
    parts = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 1), _ulog_message("B", bytes(40))]
    for name, rows in {name: rows for (name, _), rows in messages.items()}.items():
        fields = "".join(f"{_ULOG[kind]}{shape} {field};" for field, kind, shape in _fields(rows))
        parts.append(_ulog_message("F", f"{name}:{fields}".encode()))
    for number, (name, instance) in enumerate(messages):
        parts.append(_ulog_message("A", struct.pack("<BH", instance, number) + name.encode()))
    for number, rows in enumerate(messages.values()):
        parts += [_ulog_message("D", struct.pack("<H", number) + row.tobytes()) for row in rows]
    parts += [_ulog_message("O", struct.pack("<H", length)) for length in dropouts]
    path.write_bytes(b"".join(parts))
    return path


def write_dataflash(path: Path, messages: Mapping[str, np.ndarray], junk: bytes = b"") -> Path:
    """Write a DataFlash log of structured arrays by message name; rows of all take turns, junk is between."""

    def packet(number: int, payload: bytes) -> bytes:
        return b"\xa3\x95" + bytes([number]) + payload

    parts, longest = [], max(map(len, messages.values()))
    defined = [(128, 89, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")]
    for number, (name, rows) in enumerate(messages.items(), start=130):
        characters = "".join(_BIN[shape + kind] for _, kind, shape in _fields(rows))
        defined.append((number, rows.dtype.itemsize + 3, name, characters, ",".join(rows.dtype.names)))
    for number, size, *words in defined:
        parts.append(packet(128, struct.pack("<BB4s16s64s", number, size, *map(str.encode, words))))
    for k in range(longest):
        parts.append(junk if k == longest // 2 else b"")
        for number, rows in enumerate(messages.values(), start=130):
            parts.append(packet(number, rows[k].tobytes()) if k < len(rows) else b"")
    path.write_bytes(b"".join(parts))
    return path
