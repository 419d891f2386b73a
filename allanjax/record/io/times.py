"""Times: the seconds that time stamps tell, whatever they are written as."""

import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Int

from allanjax.base.wording import plain
from allanjax.record.columns import Column
from allanjax.record.io.cells import is_number
from allanjax.record.io.table import as_float, is_numeric
from allanjax.record.shapes import Cells, Seconds
from allanjax.record.units import convert, is_unit, same_unit
from allanjax.record.validation import Source

if TYPE_CHECKING:
    import pandas as pd

Stamps = Sequence[Cells]
#: What stamps are: numbers in a unit, whole seconds and parts of them, dates, or times of the day.
Kind = Literal["numbers", "pair", "dates", "clock"]

#: Remedy where stamps are of no use.
IGNORE = "ignore the stamps with time='none' and rate="
#: Largest relative difference between two statements of the sample rate.
MAX_RATE_DIFFERENCE = 0.01
# Numbers at which counters restart from zero: 8 to 32 bits, and a second, a minute, an hour, a day, a week;
# in units, or thousandths and millionths of them. The most samples that may be lost at a restart.
_TURNS = (2**8, 2**16, 2**24, 2**32, 60, 1000, 3600, 10**6, 86_400, 86_400_000, 604_800, 604_800_000)
_PARTS, _LOST_AT_TURN = (1, 1e-3, 1e-6), 100
# A counter goes on below this part of its range, another clock was set.
_RESTART = 0.25
# Rows are sorted if they are at most so many places off, and their intervals then by this part of one.
_PLACES, _OFF = 100, 0.1
_HOUR, _DAY = 3600.0, 86_400.0
# Possible units of stamps without a unit.
_UNITS = ("s", "ms", "us", "ns")
# Criteria for stamps without a unit: UNIX time in s, 2001 to 2065, and rates of inertial sensors in Hz.
_UNIX_SECONDS = (1e9, 3e9)
_PLAUSIBLE_RATES = (1.0, 2e4)
# Stamps from which the resolution is determined.
_LOOKED_AT = 1 << 15
# Times of the day, or of the hour; a date with its zone; milliseconds after a colon, and a clock with dots.
_CLOCK = re.compile(
    r"\s*(?:(\d{1,2}):(?=\d\d:))?(\d{1,2}):(\d\d(?:\.\d+)?)\s*([ap]\.?m\.?)?\s*", re.IGNORECASE
)
_MILLISECONDS, _DOTTED = re.compile(r"(:\d\d:\d\d):(\d+)"), re.compile(r"(?<=[T ])(\d\d)\.(\d\d)\.(?=\d\d\.)")
_ZONE = re.compile(r"(?:Z|[+-]\d\d:?\d\d)\s*$")


@dataclass(frozen=True)
class Clock:
    """How the stamps of a table become seconds.

    Attributes:
        columns: columns of the stamps.
        kind: what the stamps are.
        unit: unit of numbers, or of the parts of seconds, "" for others.
        format: format of dates that are text, as for `datetime.strptime`.
        local: whether dates have no zone, so that they are set when summer time begins or ends.
        notes: assumptions that users should know.
    """

    columns: tuple[Column, ...]
    kind: Kind
    unit: str = ""
    format: str = ""
    local: bool = False
    notes: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        columns: tuple[Column, ...],
        first: Stamps,
        time_unit: str | None,
        rate: float | None,
        source: Source,
    ) -> "Clock":
        """Return the clock of a table from its first stamps, or all.

        Args:
            columns: columns of the stamps.
            first: their first values.
            time_unit: unit of the stamps, if it is given.
            rate: sample rate [Hz], if it is known without stamps.
            source: origin of the stamps.

        Raises:
            RecordingError, UnitError: the unit is unknown, or no stamp is a time.
        """
        if len(columns) == 2:
            assert columns[1].time_part
            return cls(columns, "pair", columns[1].time_part[1])
        values = first[0]
        if values.dtype.kind == "M":
            return cls(columns, "dates")
        text = next((str(x) for x in values if not is_missing(x)), "") if values.dtype.kind == "O" else ""
        text = _usual(text)
        if _CLOCK.fullmatch(text):
            return cls(columns, "clock")
        written = _date_format(text)
        if written:
            return cls(columns, "dates", format=written, local=_ZONE.search(text) is None)
        unit, notes = _unit(columns[0], values, time_unit, rate, source)
        return cls(columns, "numbers", unit, notes=notes)

    @property
    def label(self) -> str:
        """Label of the stamps."""
        return " + ".join(column.label for column in self.columns)

    def seconds(self, stamps: Stamps, source: Source) -> tuple[Seconds, tuple[str, ...]]:
        """Return times [s] from the first stamp, and notes on a clock that was set.

        Raises:
            RecordingError: a stamp is missing, or is no time.
        """
        if self.kind == "pair":
            whole = _since_first(stamps[0], self.columns[0].label, source)
            # Parts begin again with each second, whatever a counter does.
            parts = _differences(stamps[1], self.columns[1].label, source)
            return whole + convert(parts.astype(float), self.unit, "s"), ()
        values = stamps[0]
        if self.kind == "dates":
            dates = self._dates(values, source)
            times = (dates - dates[0]) / np.timedelta64(1, "ns") * 1e-9
            return _set_by_an_hour(times, self.label) if self.local else (times, ())
        if self.kind == "clock":
            has_hours = _usual(str(values[0])).count(":") > 1
            return _continued(self._of_day(values, source), _DAY if has_hours else _HOUR, self.label)
        counts = _since_first(values, self.label, source)
        notes: tuple[str, ...] = ()
        back = np.flatnonzero(values[1:] < values[:-1])
        if len(back) and (np.diff(counts) > 0).all():
            again = f"{len(back)} times" if len(back) > 1 else "once"
            how = f"starts again {again}, like a counter that overflows"
            turn = float(counts[back[0] + 1] - counts[back[0]]) + float(values[back[0]] - values[back[0] + 1])
            if (values[back + 1] > _RESTART * turn).any():
                how = f"is set back {again}, by {plain(convert(turn, self.unit, 's'))} s"
            notes = (f"column {self.label!r} {how}; it is continued",)
        return convert(counts, self.unit, "s"), notes

    def begun(self, stamps: Stamps) -> float | None:
        """Return the UNIX time of the first stamp [s]; None if it is none, as of a clock that was not set."""
        match self.kind:
            case "dates":
                dates = self._dates(stamps[0][:1], Source(self.label))
                time = float((dates[0] - np.datetime64(0, "s")) / np.timedelta64(1, "s"))
            case "clock":
                return None
            case "pair":
                time = float(stamps[0][0])
            case _:
                time = float(stamps[0][0]) * convert(1.0, self.unit, "s")
        return time if _UNIX_SECONDS[0] < time < _UNIX_SECONDS[1] else None

    def step(self, stamps: Stamps) -> float:
        """Return the resolution of the stamps [s]: all are multiples of it; 0 if none is known."""
        if self.kind == "pair":
            return convert(1.0, self.unit, "s")
        values = stamps[0][:_LOOKED_AT]
        if self.kind == "dates":
            return 1e-9 * _common_step(self._dates(values, Source(self.label)).astype(np.int64))
        if self.kind == "clock":
            return _decimal_step(self._of_day(values, Source(self.label)))
        if values.dtype.kind in "iu":
            return convert(float(_common_step(values)), self.unit, "s")
        return convert(_decimal_step(as_float(values, self.label, Source(self.label))), self.unit, "s")

    def _dates(self, values: Cells, source: Source) -> Cells:
        """Return stamps as datetime64[ns]."""
        dates = values
        if values.dtype.kind == "O":
            import pandas as pd

            parsed = pd.to_datetime(_all_usual(values), format=self.format, utc=True, errors="coerce")
            dates = parsed.dt.tz_localize(None).to_numpy(dtype="datetime64[ns]")
        _check(np.isnat(dates), values, self.label, source)
        return dates.astype("datetime64[ns]")

    def _of_day(self, values: Cells, source: Source) -> Seconds:
        """Return times of the day [s]."""
        parts = _all_usual(values).str.extract(_CLOCK)
        _check(parts[1].isna().to_numpy(), values, self.label, source)
        seconds = parts[2].astype(float)
        half = parts[3].str[:1].str.lower()
        as_read = parts[0].astype(float).fillna(0.0)
        hours = np.where(half.isna(), as_read, as_read % 12 + 12.0 * (half == "p"))
        return np.asarray(hours * _HOUR + parts[1].astype(float) * 60.0 + seconds, float)


def _check(bad: Cells, values: Cells, label: str, source: Source) -> None:
    """Raise RecordingError if a stamp is no time."""
    if bad.any():
        first = int(np.argmax(bad))
        cell = values[first]
        has = "no time" if is_missing(cell) else f"{str(cell)[:40]!r}, which is no time,"
        raise source.error(f"column {label!r} has {has} at {source.locate(first)}; repair it, or {IGNORE}")


def is_missing(cell: object) -> bool:
    """Return whether a cell is empty: None, nan or not a time."""
    return cell is None or bool(cell != cell)


def unevenness(stamps: Cells) -> int:
    """Return how uneven stamps are: 0 if intervals agree within a fifth, 1 if not, 2 if they never change.

    Of text it is 1 if stamps repeat.
    """
    if stamps.dtype.kind == "M":
        stamps = stamps.astype(np.int64)
    if stamps.dtype.kind == "O":
        return int(len(stamps) > 1 and stamps[0] == stamps[1])
    if not is_numeric(stamps) or len(stamps) < 3:
        return 0
    intervals = np.diff((stamps - stamps[0]).astype(float))
    typical = float(np.median(intervals))
    if not intervals.any():
        return 2
    return int(not typical > 0.0 or np.mean(abs(intervals / typical - 1.0) > 0.2) > 0.1)


def are_times(values: Cells) -> bool:
    """Return whether text has times of the day, with or without a date, that are not all the same."""
    ends = (values[0], values[-1]) if values.dtype.kind == "O" and len(values) else ()
    texts = [_usual(str(x)) for x in ends]
    is_time = bool(texts) and ":" in texts[0] and texts[0] != texts[1]
    return is_time and bool(_CLOCK.fullmatch(texts[0]) or _date_format(texts[0]))


def _usual(text: str) -> str:
    """Return a time with colons up to the seconds, and with a point before parts of them."""
    text = _DOTTED.sub(r"\1:\2:", text.replace(",", "."))
    return _MILLISECONDS.sub(lambda match: f"{match[1]}.{match[2]:0>3}", text, count=1)


def _all_usual(values: Cells) -> "pd.Series[str]":
    """Return times as `_usual` writes them; patterns are sought only where the first time has one."""
    import pandas as pd

    texts = pd.Series(values, dtype=object).astype(str)
    text = texts[0].replace(",", ".")
    return texts.str.replace(",", ".") if _usual(text) == text else texts.map(_usual)


def _date_format(text: str) -> str:
    """Return the format of a date, "ISO8601" for most; "" for a text that is no date."""
    if not re.search(r"\d{2,4}[-/. ]|\d{8}T", text):
        return ""
    import pandas as pd
    from pandas.tseries.api import guess_datetime_format

    if is_number(text):
        return ""
    if not pd.isna(pd.to_datetime(text, format="ISO8601", errors="coerce")):
        return "ISO8601"
    # The order of day and month matters only over midnight; pandas warns where it follows from the date.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return guess_datetime_format(text) or guess_datetime_format(text, dayfirst=True) or ""


def _since_first(values: Cells, label: str, source: Source) -> Seconds:
    """Return the continued stamps minus the first."""
    return _unwrapped(_differences(values, label, source)).astype(float)


def _differences(values: Cells, label: str, source: Source) -> Cells:
    """Return stamps minus the first: 19-digit integers lose digits as floats, their differences do not."""
    if is_numeric(values) and values.dtype.kind in "iu":
        return (values - values[0]).astype(np.int64)
    numbers = as_float(values, label, source)
    _check(~np.isfinite(numbers), values, label, source)
    return numbers - numbers[0]


def _unwrapped(counts: Cells) -> Cells:
    """Return the continued counts of a counter that restarts from zero, even if samples are lost there."""
    steps = np.diff(counts)
    back = steps < 0
    if not back.any() or back.all():
        return counts
    forward = steps[~back]
    # Whole seconds mostly stay as they are.
    forward = forward if np.median(forward) > 0 or not forward.any() else forward[forward > 0]
    typical = float(np.median(forward))
    for part in _PARTS[: 1 if counts.dtype.kind == "i" else None]:
        for turn in (counts.dtype.type(turn * part) for turn in _TURNS):
            step = steps[back] + turn
            most = min(_LOST_AT_TURN * typical, turn / 4)
            if np.ptp(counts) < turn and (step > 0.5 * typical - 1.0 * part).all() and (step < most).all():
                return counts + turn * np.concatenate([[0], np.cumsum(back)])
    return counts


def sorted_by(times: Seconds) -> Int[np.ndarray, " n"] | None:
    """Return the order of rows that came in another one than their times; None if they are in order.

    Sorted times are an interval apart, or several; rows are a few places off, as packets of a network are.
    """
    if not (np.diff(times) < 0.0).any():
        return None
    order = np.argsort(times, kind="stable")
    intervals = np.diff(times[order])
    if not np.median(intervals) > 0.0:
        return None
    steps = intervals / np.median(intervals)
    is_even = (abs(steps - np.rint(steps)) < _OFF).all() and (steps > 0.5).all()
    return order if is_even and abs(order - np.arange(len(order))).max() <= _PLACES else None


def _continued(times: Seconds, turn: float, label: str) -> tuple[Seconds, tuple[str, ...]]:
    """Return times of the day or of the hour [s] as times from the first, continued when these are over."""
    turns = np.cumsum(np.diff(times) < -0.5 * turn)
    since = times - times[0]
    since[1:] += turn * turns
    if not turns.any():
        return since, ()
    passed = "midnight" if turn == _DAY else "a full hour"
    return since, (f"column {label!r} passes {passed}; its times go on",)


def _set_by_an_hour(times: Seconds, label: str) -> tuple[Seconds, tuple[str, ...]]:
    """Return times [s] that go on where a local clock was set by an hour, and a note."""
    intervals = np.diff(times)
    typical = float(np.median(intervals))
    if not typical > 0.0:
        return times, ()
    # A gap of an hour, to within an interval, would be a rare chance.
    changed = np.rint(intervals / _HOUR)
    is_set = (abs(changed) == 1.0) & (abs(intervals - changed * _HOUR - typical) < typical)
    if not is_set.any():
        return times, ()
    shift = np.concatenate([[0.0], np.cumsum(np.where(is_set, changed, 0.0))])
    which = "forward" if changed[is_set][0] > 0.0 else "back"
    note = f"column {label!r} is set {which} by an hour, as at the change of summer time; its times go on"
    return times - _HOUR * shift, (note,)


def _common_step(values: Cells) -> int:
    """Return the greatest common divisor of the differences of whole numbers."""
    return int(np.gcd.reduce(np.diff(values).astype(np.int64)))


def _decimal_step(values: Seconds) -> float:
    """Return the greatest common divisor of the differences of decimal numbers; 0 if there is none."""
    largest = float(abs(values).max())
    for digits in range(10):
        scaled = values * 10.0**digits
        # Beyond 2^52 every number is whole.
        if largest * 10.0**digits > 2.0**52:
            return 0.0
        if np.allclose(scaled, np.rint(scaled), rtol=0.0, atol=max(1e-3, 4e-16 * largest * 10.0**digits)):
            return _common_step(np.rint(scaled).astype(np.int64)) * 10.0**-digits
    return 0.0


def _unit(
    column: Column,
    values: Cells,
    time_unit: str | None,
    rate: float | None,
    source: Source,
) -> tuple[str, tuple[str, ...]]:
    """Return the unit of the stamps, and notes: stated, the only plausible one, or implied by the rate."""
    name, stated = f"column {column.label!r}", time_unit or column.unit
    if stated is not None:
        if not is_unit(stated, "s"):
            raise source.unit_error(
                f"{name}: {stated!r} is not a unit of time; pass time_unit=: s, ms, us, ns, min, h, or a "
                "multiple such as '0.1 ms'"
            )
        if column.unit is None or same_unit(column.unit, stated):
            return stated, ()
        return stated, (f"{name} read in {stated} as requested, although labelled {column.unit}",)
    counts = _since_first(values, column.label, source)
    typical = float(np.median(np.diff(counts)))
    if not typical > 0.0:
        # Stamps in bursts, or too coarse ones, repeat.
        typical = float(counts[-1]) / max(len(counts) - 1, 1)
    rates = {unit: 1.0 / (typical * convert(1.0, unit, "s")) for unit in _UNITS if typical > 0.0}
    low, high = _PLAUSIBLE_RATES
    plausible = [unit for unit, hz in rates.items() if low <= hz <= high]
    if rate is not None:
        fitting = [unit for unit, hz in rates.items() if abs(hz / rate - 1.0) < MAX_RATE_DIFFERENCE]
    else:
        since = {unit: float(values[0]) * convert(1.0, unit, "s") for unit in plausible}
        dated = [unit for unit, s in since.items() if _UNIX_SECONDS[0] < s < _UNIX_SECONDS[1]]
        # Numbers that count up by one may be those of samples.
        may_count = typical == 1.0 and not np.any(counts % 1)
        fitting = dated or ([] if may_count else plausible)
    if len(fitting) == 1:
        return fitting[0], (f"{name} has no unit; assuming {fitting[0]}, the only plausible one",)
    possible = (f"in {unit} the rate is {rates[unit]:.4g} Hz" for unit in plausible)
    listed = ", ".join(possible) or "no unit gives a plausible rate"
    if rate is not None and typical > 0.0:
        step = 1.0 / rate / typical
        note = f"{name} has no unit, and none fits {rate:g} Hz ({listed})"
        return f"{step!r} s", (f"{note}; assuming counts of {step:.6g} s each",)
    raise source.error(
        f"{name} has no unit, and it is ambiguous ({listed}); pass time_unit=, such as s, ms or '0.1 ms', or "
        f"rate=, or write the unit in the header: `{column.name} [s]`"
    )
