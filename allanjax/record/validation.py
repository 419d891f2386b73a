"""Checks that every recording passes, from a file or from an array alike."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Shaped

from allanjax.base.errors import RecordingError

MIN_SAMPLES = 16
"""Fewest samples that make a recording."""
LARGEST = 1e100
"""Largest size of a sample, in any unit: what is larger overflows when it is scaled and squared."""


@dataclass(frozen=True)
class Source:
    """Origin of samples, for messages.

    Attributes:
        label: path of the file, or a name for an array.
        locate: place of a sample (counted from 0) in words, e.g. `line 17`.
        missing: possible causes of a NaN in such a source.
    """

    label: str
    locate: Callable[[int], str] = lambda row: f"row {row} (counting from 0)"
    missing: str = "nan"

    def after(self, rows: int) -> "Source":
        """Source of the samples that are left when the first `rows` are dropped."""
        return replace(self, locate=lambda row: self.locate(row + rows))

    def at(self, rows: Shaped[np.ndarray, " kept"]) -> "Source":
        """Source of these rows of the samples."""
        numbers = np.flatnonzero(rows) if rows.dtype == bool else rows
        return replace(self, locate=lambda row: self.locate(int(numbers[row])))

    def error(self, message: str, about: str = "") -> RecordingError:
        """RecordingError whose message begins with the label; see there for what it is `about`."""
        return RecordingError(f"{self.label}: {message}", about)


def check_rate(rate: float, source: Source) -> float:
    """Sample rate in Hz as a float; RecordingError if it is not a positive finite number."""
    value = np.asarray(rate)
    if value.ndim or value.dtype.kind not in "iuf" or not 0.0 < value < np.inf:
        raise source.error(
            f"the sample rate must be a positive number of Hz, not {rate!r}; pass rate= (--rate)"
        )
    return float(rate)


def as_columns(values: Float[np.ndarray, "*shape"], source: Source) -> Float[np.ndarray, "samples axes"]:
    """Samples as one column an axis; RecordingError if they have another shape."""
    table = values[:, None] if values.ndim == 1 else values
    if table.ndim != 2 or table.shape[1] == 0:
        raise source.error(
            f"values must have the shape [samples] or [samples, axes], not {values.shape}; reshape them to "
            "one column an axis"
        )
    if table.shape[0] < table.shape[1]:
        raise source.error(
            f"values of shape {table.shape} seem transposed; pass values.T, one column an axis"
        )
    return table


def check_length(samples: int, source: Source) -> None:
    """Raise `RecordingError` if there are fewer than `MIN_SAMPLES` samples."""
    if samples < MIN_SAMPLES:
        raise source.error(
            f"too short: {samples} samples, and at least {MIN_SAMPLES} are needed (thousands for a useful "
            "fit); give a longer recording, or a longer stretch by start= and stop= (--start, --stop)"
        )


def check_values(
    values: Float[np.ndarray, "samples axes"], labels: Sequence[str], source: Source
) -> Bool[np.ndarray, " axes"]:
    """Check samples, one column per label, and return which columns live; the others are dead.

    A dead column never changes, or has no usable number throughout.

    Raises:
        RecordingError: too few samples, a value that is not usable in a column that has others, or no column
            that lives; the message names the column, the first place and the remedy.
    """
    check_length(len(values), source)
    living = np.array([bool(usable(x).any() and (x != x[0]).any()) for x in values.T], bool)
    for label, column, lives in zip(labels, values.T, living, strict=True):
        if lives or not living.any():
            check_finite(column, label, source)
    if not living.any():
        raise constant_error(labels[0], float(values[0, 0]), source)
    return living


def usable(values: Float[np.ndarray, "*shape"]) -> Bool[np.ndarray, "*shape"]:
    """Which values are finite, and not beyond `LARGEST`."""
    return np.abs(values) <= LARGEST


def check_finite(column: Float[np.ndarray, " samples"], label: str, source: Source) -> None:
    """Raise `RecordingError` if a value of the column is not usable; see `check_values`."""
    bad = np.flatnonzero(~usable(column))
    if bad.size:
        value = column[bad[0]]
        raise bad_cells(label, bad.size, int(bad[0]), source, None if np.isnan(value) else str(value))


def constant_error(label: str, value: float, source: Source) -> RecordingError:
    """RecordingError for a column that has this value throughout."""
    return source.error(
        f"column {label!r} is constant ({value:g} from {source.locate(0)} on): a sensor that is stuck "
        "or not connected has no noise to fit; leave it out by columns= (--columns)",
        "dead axis",
    )


def bad_cells(label: str, count: int, first: int, source: Source, text: str | None = None) -> RecordingError:
    """RecordingError for `count` cells of a column that are not usable, the first of which holds `text`."""
    limit = f"finite number{'s' * (count > 1)} within ±{LARGEST:.0e}"
    cells = f"1 value is not a {limit}"
    if count > 1:
        cells = f"{count} values are not {limit}, the first"
    told = f"column {label!r}: {cells} at {source.locate(first)}: {text or source.missing}; "
    if text is not None:
        return source.error(
            f"{told}repair the file, or take a stretch without bad values by start= and stop= "
            "(--start, --stop)"
        )
    return source.error(
        f"{told}repair the file, take a stretch without bad values by start= and stop= (--start, --stop) or "
        "the longest by gaps='segments' (--gaps segments), or let missing values be drawn given the others "
        "by gaps='fill' (--gaps fill)",
        "gaps",
    )
