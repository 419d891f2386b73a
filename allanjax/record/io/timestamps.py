"""Sample times and the sample rate from a file's time stamps."""

from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from allanjax.base.errors import RecordingError, UnitError
from allanjax.base.wording import percent, plain
from allanjax.record.columns import Column
from allanjax.record.completion import MOST_MISSING
from allanjax.record.io.table import as_float, is_numeric
from allanjax.record.units import convert, same_unit
from allanjax.record.validation import MIN_SAMPLES, Source, check_length

# An interval longer than the median by this factor is a gap if the stamps after it are half an interval later
# than expected from those before it; else a stamp is late. So many stamps on either side are compared.
_GAP = 1.5
_ABOUT = 8
# Largest rms jitter of the other intervals, over their mean.
_MAX_JITTER = 0.2
#: Largest relative difference between two statements of the sample rate.
MAX_RATE_DIFFERENCE = 0.01
# Share of long intervals above which sampling is irregular, not interrupted by gaps.
_MANY_GAPS = 0.05
_IGNORE = "ignore the stamps with time='none' and rate= (--time none --rate)"
# Numbers at which counters restart from zero: 8 to 32 bits, and a second, a minute, an hour, a day, a week;
# in units, or thousandths and millionths of them. The most samples that may be lost at a restart.
_TURNS = (2**8, 2**16, 2**24, 2**32, 60, 1000, 3600, 10**6, 86_400, 86_400_000, 604_800, 604_800_000)
_PARTS, _LOST_AT_TURN = (1, 1e-3, 1e-6), 100
# Possible units of stamps without a unit.
_UNITS = ("s", "ms", "us", "ns")
# Criteria for stamps without a unit: UNIX time in s, 2001 to 2065, and rates of inertial sensors in Hz.
_UNIX_SECONDS = (1e9, 3e9)
_PLAUSIBLE_RATES = (1.0, 2e4)


class Times(NamedTuple):
    """Times in s from the first sample; the unit of the stamps, if they are one numeric column; and notes.

    `begun` is the UNIX time of the first sample [s]; None if the stamps do not tell it.
    """

    seconds: Float[np.ndarray, " samples"]
    unit: str | None
    notes: tuple[str, ...]
    begun: float | None = None


def seconds_from_first(
    stamps: Sequence[tuple[Column, Shaped[np.ndarray, " samples"]]],
    time_unit: str | None,
    rate: float | None,
    source: Source,
) -> Times:
    """Return times in s from the first sample, from one column or from seconds and nanoseconds."""
    if len(stamps) == 2:
        parts = [_since_first(values, column.label, source) for column, values in stamps]
        return Times(parts[0] + 1e-9 * parts[1], None, (), _begun(float(stamps[0][1][0])))
    column, values = stamps[0]
    if values.dtype.kind == "O":
        import pandas as pd

        dates = pd.to_datetime(pd.Series(values), format="ISO8601", utc=True, errors="coerce")
        if not dates.isna().any():
            values = dates.dt.tz_localize(None).to_numpy(dtype="datetime64[ns]")
    if values.dtype.kind == "M":
        missing = np.flatnonzero(np.isnat(values))
        if missing.size:
            raise source.error(
                f"column {column.label!r} has no time at {source.locate(int(missing[0]))}; repair it"
            )
        begun = (values[0] - np.datetime64(0, "s")) / np.timedelta64(1, "s")
        return Times((values - values[0]) / np.timedelta64(1, "ns") * 1e-9, None, (), _begun(float(begun)))
    times = _since_first(values, column.label, source)
    unit, notes = _unit(column, times, values, time_unit, rate, source)
    wrapped = int(np.count_nonzero(values[1:] < values[:-1]))
    if wrapped and (np.diff(times) > 0).all():
        again = f"{wrapped} times" if wrapped > 1 else "once"
        notes += (
            f"column {column.label!r} starts again {again}, like a counter that overflows; it is continued",
        )
    return Times(convert(times, unit, "s"), unit, notes, _begun(float(values[0]) * convert(1.0, unit, "s")))


def _begun(seconds: float) -> float | None:
    """The time of the first stamp if it is a UNIX time, as of a clock that was set."""
    return seconds if _UNIX_SECONDS[0] < seconds < _UNIX_SECONDS[1] else None


class Rate(NamedTuple):
    """Sample rate [Hz], a note on where it comes from, and the rms jitter [s] of the intervals.

    `places` are the numbers of the samples on the grid of the rate, missing ones included; `stamped` is the
    rate according to the stamps, which may differ from a given rate.
    """

    rate: float
    note: str
    jitter: float
    places: Int[np.ndarray, " samples"]
    stamped: float


def uniform_rate(
    times: Float[np.ndarray, " samples"], label: str, rate: float | None, source: Source
) -> Rate:
    """Return the mean sample rate of times in s, or the given rate, for samples known to be evenly spaced."""
    span = float(times[-1] - times[0])
    if not span > 0.0:
        raise source.error(f"the times in column {label!r} do not increase; {_IGNORE}", "jitter")
    mean = (len(times) - 1) / span
    note = f"{mean:.9g} Hz, the mean of column {label!r} for evenly spaced samples"
    note = f"sample rate {note}" if rate is None else f"sample rate {rate:.9g} Hz as given (stamps: {note})"
    if (unsteady := _unsteadiness(times)) > MAX_RATE_DIFFERENCE:
        note += f"; the rates of its halves differ by {percent(unsteady)}"
    return Rate(rate or mean, note, float(np.std(np.diff(times))), np.arange(len(times)), mean)


def rate_from_times(
    times: Float[np.ndarray, " samples"],
    label: str,
    rate: float | None,
    source: Source,
    more: bool = False,
    gaps: bool = False,
) -> Rate:
    """Return the sample rate from times in s; a given `rate` [Hz] has precedence, with a note if they differ.

    `more` means that further times follow, so that the longest part is unknown. `gaps` means that samples may
    be missing.
    """
    intervals = np.diff(times)
    if (intervals <= 0.0).any():
        raise source.error(_backwards(times, label, source, more), "jitter")
    typical = float(np.median(intervals))
    long = intervals > _GAP * typical
    # If there are many, late stamps cannot be identified by their neighbours.
    if not gaps or np.mean(long) <= _MANY_GAPS:
        long = _gaps(times)
    jitter, regular = float(np.std(intervals[~long])), float(np.mean(intervals[~long]))
    steps = np.where(long, np.maximum(np.rint(intervals / regular), 2.0), 1.0)
    on_grid, lost = float(np.std(intervals - steps * regular)), int(steps.sum()) - len(intervals)
    if gaps:
        jitter = on_grid
    drawn = lost if on_grid <= _MAX_JITTER * regular and lost <= MOST_MISSING * (lost + len(times)) else 0
    if jitter > _MAX_JITTER * regular or (np.mean(long) > _MANY_GAPS and not gaps):
        fill = "if samples are missing, fill them in with gaps='fill' (--gaps fill); "
        raise source.error(
            f"column {label!r} is irregular: the mean interval is {np.mean(intervals):.6g} s, the rms jitter "
            f"{np.std(intervals):.3g} s, and {percent(float(np.mean(long)))} of the intervals are gaps "
            f"(longer than {_GAP} times the median); jitter up to {percent(_MAX_JITTER)} is accepted; "
            f"{_evenly(times)}"
            f"{fill if drawn and not gaps and not more else ''}{_IGNORE}; do not resample, which smooths the "
            "noise",
            "jitter",
        )
    if np.any(long) and not gaps:
        gap = _gap(times, np.flatnonzero(long), typical, source, more, drawn)
        raise source.error(f"column {label!r} has {gap}, or if no sample is missing, {_IGNORE}", "gaps")
    places = np.concatenate([[0], np.cumsum(steps)]).astype(int)
    measured = int(places[-1]) / float(times[-1] - times[0])
    note = f"{measured:.9g} Hz from column {label!r}, jitter {format_jitter(jitter)}"
    if rate is not None:
        differ = abs(measured / rate - 1.0) > MAX_RATE_DIFFERENCE
        note = f"{rate:.9g} Hz as given, {'not' if differ else 'and'} {note}"
    return Rate(rate or measured, f"sample rate {note}", jitter, places, measured)


def check_rate_kept(times: Float[np.ndarray, " samples"], label: str, stamped: float, source: Source) -> None:
    """Raise RecordingError if later times of a file are unusable or have another rate than the first."""
    later = rate_from_times(times, label, None, source, more=True).stamped
    if abs(later / stamped - 1.0) > MAX_RATE_DIFFERENCE:
        raise source.error(
            f"column {label!r} has {stamped:.6g} Hz at first, but {later:.6g} Hz from {source.locate(0)} on; "
            f"read a part with one rate with start= and stop= (--start, --stop), or {_IGNORE}",
            "rate",
        )


def _unsteadiness(times: Float[np.ndarray, " samples"]) -> float:
    """Return the relative difference of the mean intervals of both halves, beyond the effect of jitter."""
    half, span = len(times) // 2, float(times[-1] - times[0])
    drift = abs(float(times[-1] - times[-1 - half]) - float(times[half] - times[0]))
    beyond = max(drift - 4.0 * float(np.std(np.diff(times))), 0.0)
    return beyond / (0.5 * span) if span > 0.0 else np.inf


def _evenly(times: Float[np.ndarray, " samples"]) -> str:
    """Return the remedy for evenly spaced samples with uneven stamps, if the mean rate is steady."""
    if _unsteadiness(times) > MAX_RATE_DIFFERENCE:
        return ""
    mean = (len(times) - 1) / float(times[-1] - times[0])
    how = "pass time='uniform' (--time uniform); "
    return f"if the samples are evenly spaced (at {mean:.6g} Hz on average), {how}"


def _backwards(times: Float[np.ndarray, " samples"], label: str, source: Source, more: bool) -> str:
    """Return a message on stamps that repeat or go back, and what can be read instead."""
    intervals, uniform = np.diff(times), _evenly(times)
    back = np.flatnonzero(intervals < 0.0)
    first = int(back[0] if back.size else np.argmax(intervals == 0.0)) + 1
    what, why, segments = "repeats the previous time", "the stamps are too coarse", ""
    if back.size:
        what = f"goes back by {-intervals[first - 1]:.6g} s"
        why = "late stamps" if uniform else "the clock was set, or packets are out of order"
        longest = max(np.split(times, np.flatnonzero(after_gaps(times))), key=len)
        with suppress(RecordingError):
            check_length(0 if more else len(longest), source)
            rate_from_times(longest, label, None, source)
            segments = f"read the longest part without ({len(longest)} samples) with gaps='segments' "
            segments += "(--gaps segments); "
    return (
        f"column {label!r} {what} at {source.locate(first)} ({np.sum(intervals <= 0.0)} in total: {why}); "
        f"{uniform}{segments}{_IGNORE}"
    )


def after_gaps(times: Float[np.ndarray, " samples"]) -> Bool[np.ndarray, " samples"]:
    """Return which samples follow a gap in the times, or follow the clock being set back."""
    return np.concatenate([[False], _gaps(times) | (np.diff(times) < 0.0)])


def regular_intervals(times: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " intervals"]:
    """Return the intervals between successive times that are not gaps."""
    intervals = np.diff(times)
    return intervals[~_gaps(times)] if intervals.size else intervals


def format_jitter(jitter: float) -> str:
    """Return a jitter [s] as text; below a nanosecond it is due to rounding of the stamps."""
    return f"{plain(jitter * 1e6, 3)} µs rms" if jitter >= 1e-9 else "below 1 ns"


def _gaps(times: Float[np.ndarray, " samples"]) -> Bool[np.ndarray, " intervals"]:
    """Return which of the intervals are gaps."""
    intervals = np.diff(times)
    typical = np.median(intervals)
    gaps = intervals > _GAP * typical
    if typical <= 0.0:
        return gaps
    rows = np.flatnonzero(gaps)[:, None]
    # Delay of each nearby stamp, in intervals, against what the stamp before the interval implies.
    about = np.clip(rows + np.arange(-_ABOUT, _ABOUT) + 1, 0, len(intervals))
    delays = (times[about] - times[rows]) / typical - (about - rows)
    gaps[rows[:, 0]] = np.median(delays[:, _ABOUT:], axis=1) - np.median(delays[:, :_ABOUT], axis=1) > 0.5
    return gaps


def _since_first(values: Shaped[np.ndarray, " samples"], label: str, source: Source) -> np.ndarray:
    """Return stamps minus the first: 19-digit integers lose digits as floats, their differences do not."""
    if is_numeric(values) and values.dtype.kind in "iu":
        return _unwrapped((values - values[0]).astype(np.int64)).astype(float)
    numbers = as_float(values, label, source)
    bad = np.flatnonzero(~np.isfinite(numbers))
    if bad.size:
        raise source.error(
            f"column {label!r} has no time at {source.locate(int(bad[0]))}; repair it, or {_IGNORE}"
        )
    return _unwrapped(numbers - numbers[0])


def _unwrapped(counts: Shaped[np.ndarray, " samples"]) -> Shaped[np.ndarray, " samples"]:
    """Return the continued counts of a counter that restarts from zero, even if samples are lost there."""
    steps = np.diff(counts)
    back = steps < 0
    if not back.any() or back.all():
        return counts
    typical = float(np.median(steps[~back]))
    for part in _PARTS[: 1 if counts.dtype.kind == "i" else None]:
        for turn in (counts.dtype.type(turn * part) for turn in _TURNS):
            step = steps[back] + turn
            most = min(_LOST_AT_TURN * typical, turn / 4)
            if np.ptp(counts) < turn and (step > 0.5 * typical - 1.0 * part).all() and (step < most).all():
                return counts + turn * np.concatenate([[0], np.cumsum(back)])
    return counts


def _unit(
    column: Column,
    times: Float[np.ndarray, " samples"],
    values: Shaped[np.ndarray, " samples"],
    time_unit: str | None,
    rate: float | None,
    source: Source,
) -> tuple[str, tuple[str, ...]]:
    """Return the unit of the stamps, and notes: stated, the only plausible one, or implied by the rate."""
    name, stated = f"column {column.label!r}", time_unit or column.unit
    if stated is not None:
        try:
            convert(1.0, stated, "s")
        except UnitError as error:
            raise UnitError(
                f"{source.label}: {name}: {stated!r} is not a unit of time; pass time_unit= (--time-unit): "
                "s, ms, us, ns, min, h, or a multiple such as '0.1 ms'"
            ) from error
        if column.unit is None or same_unit(column.unit, stated):
            return stated, ()
        return stated, (f"{name} read in {stated} as requested, although labelled {column.unit}",)
    typical = float(np.median(np.diff(times)))
    rates = {unit: 1.0 / (typical * convert(1.0, unit, "s")) for unit in _UNITS if typical > 0.0}
    low, high = _PLAUSIBLE_RATES
    if rate is not None:
        fitting = [unit for unit, hz in rates.items() if abs(hz / rate - 1.0) < MAX_RATE_DIFFERENCE]
    else:
        # Fractions or dates; whole numbers may also be a counter.
        since = {unit: float(values[0]) * convert(1.0, unit, "s") for unit in rates}
        dated = {unit for unit, s in since.items() if _UNIX_SECONDS[0] < s < _UNIX_SECONDS[1]}
        known = rates if np.any(values % 1) else dated
        fitting = [unit for unit, hz in rates.items() if low <= hz <= high and unit in known]
    if len(fitting) == 1:
        return fitting[0], (f"{name} has no unit; assuming {fitting[0]}, the only plausible one",)
    possible = (f"in {unit} the rate is {hz:.4g} Hz" for unit, hz in rates.items() if low <= hz <= high)
    listed = ", ".join(possible) or "no unit gives a plausible rate"
    if rate is not None and typical > 0.0:
        step = 1.0 / rate / typical
        note = f"{name} has no unit, and none fits {rate:g} Hz ({listed})"
        return f"{step!r} s", (f"{note}; assuming counts of {step:.6g} s each",)
    raise source.error(
        f"{name} has no unit, and it is ambiguous ({listed}); pass time_unit= (--time-unit), such as s, ms "
        f"or '0.1 ms', or rate= (--rate), or write the unit in the header: `{column.name} [s]`"
    )


def _gap(
    times: Float[np.ndarray, " samples"],
    gaps: Int[np.ndarray, " gaps"],
    typical: float,
    source: Source,
    more: bool,
    drawn: int,
) -> str:
    """Return a message on gaps after these samples: length and place of the first, and what to read instead.

    `drawn` is how many missing samples can be filled in.
    """
    first = int(gaps[0])
    before, after = times[first], times[first + 1]
    text = (
        f"a gap of {after - before:.6g} s ({(after - before) / typical:.3g} intervals) before "
        f"{source.locate(first + 1)}"
    )
    if more:
        return (
            f"{text}; read the part before it with stop={_before(before):.3f} (--stop) or after it with "
            f"start={_after(after):.3f} (--start)"
        )
    edges = np.concatenate([[-1], gaps, [len(times) - 1]])
    longest = int(np.argmax(np.diff(edges)))
    begin, end = times[edges[longest] + 1], times[edges[longest + 1]]
    remedies = []
    if np.diff(edges)[longest] > MIN_SAMPLES:
        remedies.append(
            f"read a part without gaps, the longest with start={_after(begin):.3f}, stop={_before(end):.3f} "
            "(--start, --stop) or gaps='segments' (--gaps segments)"
        )
    if drawn:
        remedies.append(
            f"fill in the {drawn} missing of {drawn + len(times)} samples with gaps='fill' (--gaps fill)"
        )
    count = "the only gap" if len(gaps) == 1 else f"the first of {len(gaps)} gaps"
    return f"{text}, {count}; {', or '.join(remedies) or 'too few samples remain for a recording'}"


def _after(time: float) -> float:
    """Return the time rounded up to ms, to avoid a gap before it; a whole ms is unchanged."""
    return float(np.ceil(time * 1e3 - 1e-7) / 1e3) + 0.0


def _before(time: float) -> float:
    """Return the time rounded down to ms, to avoid a gap after it; a whole ms is unchanged."""
    return float(np.floor(time * 1e3 + 1e-7) / 1e3)
