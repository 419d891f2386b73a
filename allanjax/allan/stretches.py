"""Stretches of a record as compiled programs read them: where they lie, if possible without a copy."""

from typing import Any

import numpy as np
from jaxtyping import Float

# JAX reads a NumPy array where it lies if it begins at a multiple of so many bytes, and copies every other.
_ALIGNMENT = 64
# Values that a stretch may have before its first row, so that it begins at such a multiple.
_SPARE = _ALIGNMENT // 8


def aligned(*shape: int) -> Float[np.ndarray, "..."]:
    """Array of this shape, of values not yet set, that JAX reads where it lies."""
    size = int(np.prod(shape))
    memory = np.empty(size + _SPARE)
    first = -memory.ctypes.data % _ALIGNMENT // 8
    return memory[first : first + size].reshape(shape)


def stretch(
    table: Any, begin: int, rows: int, fill: float | Float[np.ndarray, " axes"], read: int | None = None
) -> tuple[Float[np.ndarray, " values"], int]:
    """Rows of a table [n, axes] of numbers, one after the other, in an array that JAX reads where it lies.

    Args:
        table: the samples; a copy is made of what is not float64 in C order, and of a stretch at its ends.
        begin: index of the first row, which may be negative.
        rows: number of rows, which may go beyond the table.
        fill: what stands in rows that the table does not have.
        read: how many of the rows are read, if not all.

    Returns:
        So many rows and eight values more, and the index of the first row's first value among them.
    """
    axes = table.shape[1]
    size = rows * axes + _SPARE
    if table.dtype == np.float64 and table.flags.c_contiguous and table.flags.aligned:
        values = table.reshape(-1)
        spare = (values.ctypes.data // 8 + begin * axes) % _SPARE
        first = begin * axes - spare
        if 0 <= first <= len(values) - size:
            return values[first : first + size], spare
    copied = aligned(size)
    filled = copied[: rows * axes].reshape(rows, axes)
    start, end = (min(max(k, 0), len(table)) for k in (begin, begin + rows))
    filled[: start - begin] = filled[end - begin : read] = fill
    filled[start - begin : end - begin] = table[start:end]
    return copied, 0
