"""The columns of a file of three gyros and three accelerometers, text made of columns, and refusals."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import allanjax as aj

SIX = ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")
HEADER = ("gyro_x [deg/s]", "gyro_y [deg/s]", "gyro_z [deg/s]", "accel_x [g]", "accel_y [g]", "accel_z [g]")
#: What a reader is told of a file without a header.
UNITS = {"gyro_unit": "deg/s", "accel_unit": "g"}
DEG, G0 = np.pi / 180.0, 9.80665


def rows(*columns: np.ndarray, mark: str = ",") -> list[str]:
    """Lines of text, with all digits; a matrix holds several columns."""
    every = [x for column in columns for x in np.asarray(column).reshape(len(column), -1).T]
    return [mark.join(repr(x.item()) for x in row) for row in zip(*every, strict=True)]


def write_text(path: Path, header: Sequence[str], *columns: np.ndarray) -> Path:
    """Write columns below a header."""
    path.write_text("\n".join([",".join(header), *rows(*columns), ""]), encoding="utf-8")
    return path


def refused(what: Path | Callable, words: str, kind: type = aj.RecordingError, **options: Any) -> Any:
    """The error of this class by which a call, or the reading of a file, is refused; it names all words."""
    with pytest.raises(aj.AllanjaxError) as caught:
        aj.read(what, **options) if isinstance(what, Path) else what(**options)
    assert type(caught.value) is kind, caught.value
    for word in [*words.split("|"), *([str(what)] if isinstance(what, Path) else [])]:
        assert word in str(caught.value)
    return caught.value


def noted(recording: aj.Recording, *words: str) -> bool:
    """Whether a note has all these words."""
    return any(all(word in note for word in words) for note in recording.notes)
