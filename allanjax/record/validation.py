"""Checks for every recording, from a file or from an array."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Shaped

from allanjax.base.errors import RecordingError, UnitError
from allanjax.base.wording import harmless, with_commands
from allanjax.record.shapes import Channel, Values

MIN_SAMPLES = 16
"""Fewest samples that make a recording."""
LARGEST = 1e30
"""Largest size of a sample, in any unit: powers of larger values overflow."""
SMALLEST = 1e-30
"""Least range of an axis, in any unit: powers of smaller values vanish."""


@dataclass(frozen=True)
class Source:
    """Origin of samples, for messages: functions that take one raise a RecordingError that begins with it.

    Attributes:
        label: path of the file, or a name for an array.
        locate: place of a sample (counted from 0) in words, e.g. `line 17`.
        missing: possible causes of a NaN in such a source.
        sizes: sizes of counts that messages propose, by sensor; by default usual ones.
    """

    label: str
    locate: Callable[[int], str] = lambda row: f"row {row} (counting from 0)"
    missing: str = "nan"
    sizes: Mapping[Any, str] = field(default_factory=dict)

    def after(self, rows: int) -> "Source":
        """Return the source of the samples without the first `rows`."""
        return replace(self, locate=lambda row: self.locate(row + rows))

    def at(self, rows: Shaped[np.ndarray, " kept"]) -> "Source":
        """Return the source of these rows of the samples."""
        numbers = np.flatnonzero(rows) if rows.dtype == bool else rows
        return replace(self, locate=lambda row: self.locate(int(numbers[row])))

    def error(self, message: str, about: str = "") -> RecordingError:
        """Return a RecordingError whose message begins with the label; see there for `about`."""
        return RecordingError(f"{harmless(self.label)}: {with_commands(message)}", about)

    def no_rows(self) -> RecordingError:
        """Return the RecordingError for a source without rows."""
        return self.error("the file is empty (no rows); give one with a row of numbers per sample")

    def unit_error(self, message: str) -> UnitError:
        """Return a UnitError whose message begins with the label."""
        return UnitError(f"{harmless(self.label)}: {with_commands(message)}")


def check_rate(rate: float, source: Source) -> float:
    """Sample rate in Hz as a float; RecordingError if it is not a positive finite number."""
    value = np.asarray(rate)
    if value.ndim or value.dtype.kind not in "iuf" or not 0.0 < value < np.inf:
        raise source.error(f"the sample rate must be positive, in Hz, not {rate!r}; pass rate=")
    return float(rate)


def as_columns(values: Float[np.ndarray, "*shape"], source: Source) -> Values:
    """Return samples as one column per axis; RecordingError if they have another shape."""
    table = values[:, None] if values.ndim == 1 else values
    if table.ndim != 2 or table.shape[1] == 0:
        raise source.error(
            f"values must have the shape [samples] or [samples, axes], not {values.shape}; reshape them to "
            "one column per axis"
        )
    if table.shape[0] < table.shape[1]:
        raise source.error(
            f"values of shape {table.shape} seem transposed; pass values.T (one column per axis)"
        )
    return table


def check_names(names: Sequence[str], argument: str, source: Source) -> None:
    """Raise RecordingError if names of columns are not text."""
    other = next((name for name in names if not isinstance(name, str)), None)
    if other is not None:
        raise source.error(f"{argument} takes names of columns, e.g. ['gyro_x', 'accel_z'], not {other!r}")


def check_length(samples: int, source: Source, is_part: bool = False) -> None:
    """Raise `RecordingError` if there are fewer than `MIN_SAMPLES` samples; `is_part` if it may be longer."""
    if samples < MIN_SAMPLES:
        remedy = "use a longer recording"
        if is_part:
            remedy = "read a longer part with start= and stop="
        raise source.error(
            f"too short: {samples} sample{'s' * (samples != 1)}, but at least {MIN_SAMPLES} are needed "
            f"(thousands for a useful fit); {remedy}"
        )


def check_values(values: Values, labels: Sequence[str], source: Source) -> Bool[np.ndarray, " axes"]:
    """Check samples, one column per label, and return which columns are alive; the others are dead.

    A dead column never changes, or by less than any sensor's, or has no usable number.

    Raises:
        RecordingError: too few samples, an unusable value in a column with others, or only dead columns;
            the message names the column, the first place and the remedy.
    """
    check_length(len(values), source)
    living = np.array([bool(usable(x).any() and not x.max() - x.min() < SMALLEST) for x in values.T], bool)
    for label, column, lives in zip(labels, values.T, living, strict=True):
        if lives or not living.any():
            check_finite(column, label, source)
    if not living.any():
        raise constant_error(labels[0], float(values[0, 0]), source)
    return living


def usable(values: Float[np.ndarray, "*shape"]) -> Bool[np.ndarray, "*shape"]:
    """Return which values are finite and not beyond `LARGEST`."""
    return np.abs(values) <= LARGEST


def check_finite(column: Channel, label: str, source: Source) -> None:
    """Raise `RecordingError` if a value of the column is unusable; see `check_values`."""
    if not abs(column).max() <= LARGEST:
        bad = np.flatnonzero(~usable(column))
        value = column[bad[0]]
        raise bad_cells(label, bad.size, int(bad[0]), source, None if np.isnan(value) else str(value))


def constant_error(label: str, value: float, source: Source) -> RecordingError:
    """Return the RecordingError for columns that are all constant, the first of them at this value."""
    return source.error(
        f"column {label!r} is constant ({value:g} from {source.locate(0)} on), and no other axis varies: the "
        "sensor seems stuck or disconnected; record it again",
        "dead axis",
    )


def bad_cells(label: str, count: int, first: int, source: Source, text: str | None = None) -> RecordingError:
    """Return the RecordingError for `count` unusable cells of a column, the first of which holds `text`."""
    value = f"{text or source.missing} instead of a finite number within ±{LARGEST:.0e}"
    more = f", and {count - 1} more" if count > 1 else ""
    found = f"column {label!r}: {source.locate(first)} has {value}{more}; repair the file, "
    part = "a part without bad values with start= and stop="
    if text is not None:
        return source.error(f"{found}or read {part}")
    return source.error(
        f"{found}read {part} or the longest with gaps='segments', or fill in missing values with gaps='fill'",
        "gaps",
    )
