"""Reader for MATLAB files up to -v7."""

import math
import struct
import warnings
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from allanjax.record.io.binary import from_named
from allanjax.record.io.table import Format, Table, check_claim, damage_reported
from allanjax.record.validation import Source

# Kinds of elements in a file, and the kinds in an array after its flags, shape and name.
_MATRIX, _COMPRESSED = 14, 15
_NUMBERS = frozenset({*range(1, 8), 9, 12, 13})
_TEXT = frozenset({*range(1, 8), 16, 17, 18})
_CELL, _STRUCT, _OBJECT, _CHAR, _SPARSE, _LAST_NUMBER = 1, 2, 3, 4, 5, 15
# Flag for complex numbers.
_COMPLEX = 0x0800
_HEADER = 128


def read_mat(path: Path, source: Source) -> Table:
    """Named arrays of a MATLAB file up to -v7, as for an .npz file; fields of a struct are arrays, too."""
    from scipy.io import loadmat, whosmat

    with damage_reported(source, "a MATLAB file", "save it again with -v7"), warnings.catch_warnings():
        # Warnings mean damage, too.
        warnings.simplefilter("error", UserWarning)
        content = memoryview(path.read_bytes())
        # Files up to -v4 begin with a number, which has a zero byte, instead of a header.
        if 0 not in content[:4]:
            _check_elements(content, path, source)
        check_claim(sum(math.prod(shape) for _, shape, _ in whosmat(path)), path, source)
        contents = loadmat(path, simplify_cells=True)
    arrays = {key: value for key, value in contents.items() if not key.startswith("__")}
    return from_named(_flat(arrays), source)


def _flat(contents: Mapping[str, Any], prefix: str = "") -> dict[str, np.ndarray]:
    """Return arrays of nested structs by their dotted names."""
    flat: dict[str, np.ndarray] = {}
    for key, value in contents.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{key}.")
        else:
            flat[prefix + key] = np.asarray(value)
    return flat


def _check_elements(content: memoryview, path: Path, source: Source) -> None:
    """Raise ValueError if an element has an invalid kind, which would crash the reading library."""
    order = "<" if content[_HEADER - 2 : _HEADER] == b"IM" else ">"
    claimed = 0
    for kind, payload in _elements(content[_HEADER:], order):
        if kind == _COMPRESSED:
            inflated = zlib.decompressobj().decompress(payload)
            claimed += len(inflated)
            check_claim(claimed, path, source)
            ((kind, payload),) = _elements(memoryview(inflated), order)
        if kind != _MATRIX:
            raise ValueError(f"an element of kind {kind} where an array is expected")
        _check_matrix(payload, order)


def _check_matrix(payload: memoryview, order: str) -> None:
    """Raise ValueError if an array, or a nested one, has an element of a kind its class does not allow."""
    elements = list(_elements(payload, order))
    if not elements:
        return
    flags = struct.unpack_from(f"{order}I", elements[0][1])[0]
    kind = flags & 0xFF
    names = {_CELL: 3, _STRUCT: 5, _OBJECT: 6}.get(kind)
    if names is not None:
        allowed = frozenset({_MATRIX})
    elif kind == _CHAR:
        names, allowed = 3, _TEXT
    elif kind <= _LAST_NUMBER:
        names, allowed = 3, _NUMBERS
    else:
        names, allowed = 1, _NUMBERS | _TEXT | {_MATRIX}
    if allowed <= _NUMBERS | _TEXT and len(elements) < names + _parts(kind, bool(flags & _COMPLEX)):
        raise ValueError("an array without its numbers")
    for number, (kind, inner) in enumerate(elements):
        if kind not in (allowed if number >= names else _NUMBERS | _TEXT):
            raise ValueError(f"an element of kind {kind} in an array that does not allow it")
        if kind == _MATRIX:
            _check_matrix(inner, order)


def _parts(kind: int, is_complex: bool) -> int:
    """Return the number of elements that hold the numbers of an array of this class."""
    return 1 + is_complex + (2 if kind == _SPARSE else 0)


def _elements(content: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Yield kind and content of each element; for small ones, size and kind share four bytes."""
    place = 0
    while place + 8 <= len(content):
        kind, size = struct.unpack_from(f"{order}II", content, place)
        begin, step = place + 8, 8 + size
        if kind >> 16:
            kind, size = kind & 0xFFFF, kind >> 16
            begin, step = place + 4, 8
        if begin + size > len(content) or (step == 8 and size > 4):
            raise ValueError(f"an element of {size} bytes where only {len(content) - begin} remain")
        yield kind, content[begin : begin + size]
        place += step if kind == _COMPRESSED else (step + 7) // 8 * 8


MAT = Format("mat", lambda magic: magic.startswith(b"MATLAB"), read_mat, (".mat",), in_chunks=False)
