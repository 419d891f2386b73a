"""Sample times and the sample rate from a file's time stamps."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from allanjax.base.errors import UnitError
from allanjax.record.columns import Column
from allanjax.record.io.table import as_float, is_numeric
from allanjax.record.units import convert
from allanjax.record.validation import Source

# An interval longer than the median by this factor is a gap if the stamps after it are half an interval later
# than those before it let expect; else a stamp is late. So many are looked at on either side.
_GAP = 1.5
_ABOUT = 8
# Largest rms jitter of the other intervals, over their mean.
_MAX_JITTER = 0.2
#: Largest relative difference between two statements of the sample rate.
MAX_RATE_DIFFERENCE = 0.01
# Share of long intervals above which sampling is irregular, not interrupted by gaps.
_MANY_GAPS = 0.05
# A remedy in many messages.
_IGNORE = "ignore the stamps by time='none' and rate= (--time none --rate)"
# Units that stamps without one may have.
_UNITS = ("s", "ms", "us", "ns")
# What stamps without a unit must fit: UNIX time in s, 2001 to 2065, and the rates of inertial sensors in Hz.
_UNIX_SECONDS = (1e9, 3e9)
_PLAUSIBLE_RATES = (1.0, 2e4)


class Times(NamedTuple):
    """Times in s from the first sample; the stamps' unit, if they are numbers in one column; and notes."""

    seconds: Float[np.ndarray, " samples"]
    unit: str | None
    notes: tuple[str, ...]


def seconds_from_first(
    stamps: Sequence[tuple[Column, Shaped[np.ndarray, " samples"]]],
    time_unit: str | None,
    rate: float | None,
    source: Source,
) -> Times:
    """Times in s from the first sample, from one column or from seconds and nanoseconds.

    Raises:
        RecordingError: a stamp is missing or not a number, or the unit cannot be told.
        UnitError: the unit is not one of time, or stated twice and differently.
    """
    if len(stamps) == 2:
        parts = [_since_first(values, column.label, source) for column, values in stamps]
        return Times(parts[0] + 1e-9 * parts[1], None, ())
    column, values = stamps[0]
    if values.dtype.kind == "O":
        values = _iso_dates(values)
    if values.dtype.kind == "M":
        missing = np.flatnonzero(np.isnat(values))
        if missing.size:
            raise source.error(
                f"column {column.label!r} has no time at {source.locate(int(missing[0]))}; repair it"
            )
        return Times((values - values[0]) / np.timedelta64(1, "ns") * 1e-9, None, ())
    times = _since_first(values, column.label, source)
    unit, notes = _unit(column, times, values, time_unit, rate, source)
    wrapped = int(np.count_nonzero(values[1:] < values[:-1]))
    if wrapped and (np.diff(times) > 0).all():
        again = f"{wrapped} times" if wrapped > 1 else "once"
        notes += (f"column {column.label!r} starts again {again}, as a counter of few bits: continued",)
    return Times(convert(times, unit, "s"), unit, notes)


class Rate(NamedTuple):
    """Sample rate [Hz], a note on where it comes from, and the rms jitter [s] of the intervals.

    `places` are the samples' numbers on the grid of the rate, which count those that are missing.
    """

    rate: float
    note: str
    jitter: float
    places: Int[np.ndarray, " samples"]


def rate_from_times(
    times: Float[np.ndarray, " samples"],
    label: str,
    rate: float | None,
    source: Source,
    more: bool = False,
    gaps: bool = False,
) -> Rate:
    """Sample rate from times in s; a given `rate` [Hz] is used if they agree with it.

    `more` says that the times are not all that there are: which stretch is the longest is not known then.
    `gaps` says that samples may be missing.

    Raises:
        RecordingError: times that repeat, run backwards, have gaps or too much jitter, or contradict `rate`.
    """
    intervals = np.diff(times)
    if not intervals.any():
        raise source.error(
            f"column {label!r} is the same throughout: no times were recorded; {_IGNORE}", "jitter"
        )
    backwards = np.flatnonzero(intervals <= 0)
    if backwards.size:
        first = int(backwards[0]) + 1
        what, by, why = "repeats", "", "packets recorded twice, or stamps coarser than the samples"
        remedy = "sort or repair the file"
        if not gaps:
            remedy += ", leave out packets recorded twice by gaps='fill' (--gaps fill)"
        if intervals[first - 1] < 0:
            what, by = "is earlier than", f", by {-intervals[first - 1]:.6g} s,"
            why, remedy = "a clock that was set, or packets out of order", "sort or repair the file"
        raise source.error(
            f"column {label!r} {what} the time before it{by} at {source.locate(first)} ({backwards.size} "
            f"such in all: {why}); {remedy}, or {_IGNORE}",
            "jitter",
        )
    typical = float(np.median(intervals))
    long = intervals > _GAP * typical
    # Where they are many, a stamp cannot be told to be late by those about it.
    if not gaps or np.mean(long) <= _MANY_GAPS:
        long = _gaps(times)
    jitter, regular = float(np.std(intervals[~long])), float(np.mean(intervals[~long]))
    steps = np.where(long, np.maximum(np.rint(intervals / regular), 2.0), 1.0)
    if gaps:
        jitter = float(np.std(intervals - steps * regular))
    if jitter > _MAX_JITTER * regular or (np.mean(long) > _MANY_GAPS and not gaps):
        raise source.error(
            f"column {label!r} is irregular: the mean interval is {np.mean(intervals):.6g} s, the rms jitter "
            f"{np.std(intervals):.3g} s, and {np.mean(long):.0%} of the intervals are gaps, longer than "
            f"{_GAP} times the median; jitter up to {_MAX_JITTER:.0%} is accepted; if samples "
            "are missing, draw them by gaps='fill' (--gaps fill); if the samples themselves are regular, "
            f"{_IGNORE}; resampling to even times would smooth the noise, which is what is measured",
            "jitter",
        )
    if np.any(long) and not gaps:
        gap = _gap(times, np.flatnonzero(long), typical, source, more)
        raise source.error(f"column {label!r} has {gap}, or if no sample is lost {_IGNORE}", "gaps")
    places = np.concatenate([[0], np.cumsum(steps)]).astype(int)
    measured = int(places[-1]) / float(times[-1] - times[0])
    stamped = f"{measured:.9g} Hz from column {label!r}, jitter {told_jitter(jitter)}"
    if rate is None:
        return Rate(measured, f"sample rate {stamped}", jitter, places)
    if abs(measured / rate - 1.0) > MAX_RATE_DIFFERENCE:
        raise source.error(
            f"rate {rate:g} Hz contradicts column {label!r}, whose stamps give {measured:.6g} Hz; leave "
            "out rate= (--rate), correct time_unit= (--time-unit), or ignore the stamps by time='none' "
            "(--time none)",
            "rate",
        )
    return Rate(rate, f"sample rate {rate:.9g} Hz as given; {stamped}", jitter, places)


def after_gaps(times: Float[np.ndarray, " samples"]) -> Bool[np.ndarray, " samples"]:
    """Which samples come after a gap of their times."""
    return np.concatenate([[False], _gaps(times)])


def regular_intervals(times: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " intervals"]:
    """Intervals between successive times that are no gaps."""
    intervals = np.diff(times)
    return intervals[~_gaps(times)] if intervals.size else intervals


def told_jitter(jitter: float) -> str:
    """Jitter [s] in words; below a nanosecond it is due to the rounding of the stamps."""
    return f"{jitter * 1e6:.3g} µs rms" if jitter >= 1e-9 else "below 1 ns"


def _gaps(times: Float[np.ndarray, " samples"]) -> Bool[np.ndarray, " intervals"]:
    """Which of the intervals are gaps."""
    intervals = np.diff(times)
    typical = np.median(intervals)
    gaps = intervals > _GAP * typical
    if typical <= 0.0:
        return gaps
    rows = np.flatnonzero(gaps)[:, None]
    # How much later than expected from that before the interval, in intervals, is each stamp about it?
    about = np.clip(rows + np.arange(-_ABOUT, _ABOUT) + 1, 0, len(intervals))
    delays = (times[about] - times[rows]) / typical - (about - rows)
    gaps[rows[:, 0]] = np.median(delays[:, _ABOUT:], axis=1) - np.median(delays[:, :_ABOUT], axis=1) > 0.5
    return gaps


def _since_first(values: Shaped[np.ndarray, " samples"], label: str, source: Source) -> np.ndarray:
    """Stamps minus the first one: 19-digit integers lose digits as floats, their differences do not."""
    if is_numeric(values) and values.dtype.kind in "iu":
        return _unwrapped((values - values[0]).astype(np.int64)).astype(float)
    numbers = as_float(values, label, source)
    bad = np.flatnonzero(~np.isfinite(numbers))
    if bad.size:
        raise source.error(
            f"column {label!r} has no time at {source.locate(int(bad[0]))}; repair it, or {_IGNORE}"
        )
    return numbers - numbers[0]


def _unwrapped(counts: Int[np.ndarray, " samples"]) -> Int[np.ndarray, " samples"]:
    """Counts of a counter that starts again from zero after 2¹⁶, 2²⁴ or 2³², continued."""
    steps = np.diff(counts)
    back = steps < 0
    if not back.any() or back.all():
        return counts
    typical = float(np.median(steps[~back]))
    for bits in (16, 24, 32):
        if np.ptp(counts) < 2**bits and (abs(steps[back] + 2.0**bits - typical) <= 0.5 * typical + 1.0).all():
            return counts + 2**bits * np.concatenate([[0], np.cumsum(back)])
    return counts


def _iso_dates(values: Shaped[np.ndarray, " samples"]) -> np.ndarray:
    """Dates as datetime64 if all cells are ISO 8601, else the cells as they are."""
    import pandas as pd

    dates = pd.to_datetime(pd.Series(values), format="ISO8601", utc=True, errors="coerce")
    return values if dates.isna().any() else dates.dt.tz_localize(None).to_numpy(dtype="datetime64[ns]")


def _unit(
    column: Column,
    times: Float[np.ndarray, " samples"],
    values: Shaped[np.ndarray, " samples"],
    time_unit: str | None,
    rate: float | None,
    source: Source,
) -> tuple[str, tuple[str, ...]]:
    """Unit of the stamps, and notes: stated, or the only one that fits."""
    for unit in filter(None, (column.unit, time_unit)):
        try:
            convert(1.0, unit, "s")
        except UnitError as error:
            raise UnitError(
                f"{source.label}: column {column.label!r}: {unit!r} is not a unit of time; use s, ms, "
                "us or ns"
            ) from error
    if column.unit is not None and time_unit is not None and convert(1.0, column.unit, time_unit) != 1.0:
        raise UnitError(
            f"{source.label}: column {column.label!r} is in {column.unit} by its header but time_unit= "
            f"(--time-unit) says {time_unit}; leave out time_unit= or correct the header"
        )
    stated = column.unit or time_unit
    if stated is not None:
        return stated, ()
    typical = float(np.median(np.diff(times)))
    fitting = [
        unit for unit in _UNITS if typical > 0 and _fits(unit, float(values[0]), typical, values, rate)
    ]
    if len(fitting) == 1:
        return fitting[0], (f"column {column.label!r} taken to be in {fitting[0]}, the only unit that fits",)
    raise source.error(
        f"column {column.label!r} has no unit and it can not be told; pass time_unit= (--time-unit), "
        f"e.g. s, ms, us or ns, or write it in the header as `{column.name} [s]`"
    )


def _fits(unit: str, first: float, typical: float, values: np.ndarray, rate: float | None) -> bool:
    """Whether stamps are plausible in `unit`: by the rate given, else by their size or by being fractions."""
    scale = convert(1.0, unit, "s")
    stamped = 1.0 / (typical * scale)
    if rate is not None:
        return abs(stamped / rate - 1.0) < MAX_RATE_DIFFERENCE
    low, high = _PLAUSIBLE_RATES
    unix = _UNIX_SECONDS[0] < first * scale < _UNIX_SECONDS[1]
    # Whole numbers may also be a counter.
    return low <= stamped <= high and (unix or bool(np.any(values % 1)))


def _gap(
    times: Float[np.ndarray, " samples"],
    gaps: Int[np.ndarray, " gaps"],
    typical: float,
    source: Source,
    more: bool,
) -> str:
    """Gaps after these samples in words: length and place of the first, and what to take instead."""
    first = int(gaps[0])
    before, after = times[first], times[first + 1]
    text = (
        f"a gap of {after - before:.6g} s ({(after - before) / typical:.3g} intervals) before "
        f"{source.locate(first + 1)}"
    )
    if more:
        return (
            f"{text}; take what comes before it by stop={_before(before):.3f} (--stop) or after it by "
            f"start={_after(after):.3f} (--start)"
        )
    edges = np.concatenate([[-1], gaps, [len(times) - 1]])
    longest = int(np.argmax(np.diff(edges)))
    begin, end = times[edges[longest] + 1], times[edges[longest + 1]]
    count = "the only gap" if len(gaps) == 1 else f"the first of {len(gaps)} gaps"
    lost = int(np.sum(np.rint(np.diff(times)[gaps] / typical) - 1))
    return (
        f"{text}, {count}; take a stretch without gaps, the longest by start={_after(begin):.3f}, "
        f"stop={_before(end):.3f} (--start, --stop) or by gaps='segments' (--gaps segments), or let the "
        f"{lost} missing samples be drawn given the {len(times)} others by gaps='fill' (--gaps fill)"
    )


def _after(time: float) -> float:
    """Time rounded up to ms, to stay clear of a gap before it; a whole ms stays as it is."""
    return float(np.ceil(time * 1e3 - 1e-7) / 1e3)


def _before(time: float) -> float:
    """Time rounded down to ms, to stay clear of a gap after it; a whole ms stays as it is."""
    return float(np.floor(time * 1e3 + 1e-7) / 1e3)
