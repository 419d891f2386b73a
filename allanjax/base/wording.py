"""Text in one style: values with errors, intervals, limits, durations; options that messages name.

An error has two significant digits; its value and interval have as many decimals. Commas separate thousands.
Only numbers below 0.001 or from 1e7 on have a power of ten, e.g. "1.20×10⁻⁶".
"""

import math
import re
import shlex
from collections.abc import Sequence

# Numbers from _SMALL up to _LARGE are written without a power of ten.
_SMALL, _LARGE = 1e-3, 1e7
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


# Control characters, halves of characters that a file system hands over, and marks that turn text around.
_UNPRINTABLE = re.compile("[\x00-\x1f\x7f-\x9f\ud800-\udfff\u202a-\u202e\u2066-\u2069]")
# An option of reading in a message, with its value if it has one; or text in quotes, such as the name of a
# column, in which nothing is an option.
_OPTION = re.compile(
    r"(?<![\w=])(?:'[^']*'|\"[^\"]*\")"
    r"|\b(rate|(?:gyro|accel|time)_unit|columns|time|start|stop|topic|instance|gaps|force)="
    r"(?:'([^']*)'|([\d.]*\d)|True)?(?! \(--)"
)


def harmless(text: str) -> str:
    """Text from elsewhere that a terminal may show: blanks for white space, \\x1b for other controls."""

    def safe(found: re.Match[str]) -> str:
        return " " if found[0].isspace() else found[0].encode("unicode_escape").decode()

    return _UNPRINTABLE.sub(safe, text)


def with_commands(message: str) -> str:
    """Return a message in which the option of commands follows each one of Python, `rate= (--rate)`, once."""
    told: set[str] = set()

    def both(found: re.Match[str]) -> str:
        if found[1] is None or found[0] in told:
            return found[0]
        told.add(found[0])
        value = shlex.quote(found[2]) if found[2] else found[3] or ""
        return f"{found[0]} ({f'--{found[1]} '.replace('_', '-')}{value}".rstrip() + ")"

    return _OPTION.sub(both, message)


def clauses(*parts: str) -> str:
    """Return the parts that are not empty as clauses of one sentence."""
    return "; ".join(filter(None, parts))


def counted(n: int, noun: str) -> str:
    """Number and noun, e.g. "1 line" or "5,300 lines"."""
    return f"{n:,} {noun}" if n == 1 else f"{n:,} {noun}s"


def format_with_error(value: float, std: float) -> str:
    """Value and standard deviation, e.g. "0.5121 ± 0.0068" or "(1.680 ± 0.013)×10⁻⁵".

    Without an error it is the value alone, to six digits.
    """
    return _joined(" ± ", (value, std), value, std) if _known(value, std) else plain(value, 6)


def without_error(value: float, std: float) -> str:
    """Value with the decimals that its standard deviation warrants, e.g. "0.5121" or "1.680×10⁻⁵"."""
    return _joined("", (value,), value, std) if _known(value, std) else plain(value, 4)


def format_interval(lower: float, upper: float, value: float, std: float) -> str:
    """Interval with the decimals that `format_with_error` uses for the value, e.g. "0.4985 … 0.5257".

    Without an error the width of the interval determines the decimals.
    """
    if not _known(value, std):
        std = (upper - lower) / 4.0
    if not (_known(value, std) and math.isfinite(lower) and math.isfinite(upper)):
        return f"{plain(lower, 6)} … {plain(upper, 6)}"
    return _joined(" … ", (lower, upper), value, std)


def format_range(lower: float, upper: float) -> str:
    """Ends of an interval with three digits each, e.g. "9.72 … 12.9"; "" if there is none."""
    return "" if math.isnan(lower) else f"{significant(lower)} … {significant(upper)}"


def significant(x: float, digits: int = 3) -> str:
    """Number with `digits` significant digits, including zeros, e.g. "3,470", "0.500" or "1.20×10⁻⁶"."""
    if not math.isfinite(x) or x == 0.0:
        return f"{x:g}"
    power = power_of(float(f"{x:.{digits - 1}e}"))
    return fixed(x / 10.0**power, power + digits - 1 - exponent(x, digits)) + times_ten(power)


def plain(x: float, digits: int = 6) -> str:
    """Number with at most `digits` digits and no trailing zeros, e.g. "0.5" or "1,234.5"."""
    text, times, power = significant(x, digits).partition("×")
    return (text.rstrip("0").rstrip(".") if "." in text else text) + times + power


def percent(share: float, digits: int = 2) -> str:
    """Share in per cent with at most `digits` digits, e.g. "95 %" or "0.5 %"."""
    return f"{plain(100.0 * share, digits)} %"


def numbered(names: Sequence[str]) -> list[str]:
    """The names, of which those that came before have their places, e.g. "imu" and "imu-2"."""
    return [name if name not in names[:k] else f"{name}-{k + 1}" for k, name in enumerate(names)]


def duration(seconds: float) -> str:
    """Duration as text, e.g. "600 s", "25 min" or "2.78 h"."""
    if seconds < 1000.0:
        return f"{plain(seconds, 3)} s"
    return f"{plain(seconds / 60.0, 3)} min" if seconds < 7200.0 else f"{plain(seconds / 3600.0, 3)} h"


def record_size(n: int, rate: float) -> str:
    """Length and rate of a record, e.g. "150,000 samples at 100 Hz (25 min)"."""
    return f"{n:,} samples at {rate:g} Hz ({duration(n / rate)})"


def format_p_value(p: float) -> str:
    """p-value in words, e.g. "p = 0.66"."""
    return f"p = {plain(p, 2)}" if p > 1e-300 else "p < 10⁻³⁰⁰"


def chi_squared(chi2: float, dof: int, p_value: float) -> str:
    """Test of a fit in words, e.g. "χ² = 119.9 for 127 degrees of freedom (p = 0.66)"."""
    text = f"χ² = {chi2:,.1f} for {dof} degrees of freedom"
    return text if math.isnan(p_value) else f"{text} ({format_p_value(p_value)})"


def finite_or_none(x: float) -> float | None:
    """A finite number, or None: JSON has neither NaN nor infinity, and their CSV cells are empty."""
    return float(x) if math.isfinite(x) else None


def exponent(x: float, digits: int = 2) -> int:
    """Exponent of ten of x, rounded to `digits` significant digits."""
    return int(f"{x:.{digits - 1}e}".partition("e")[2])


def power_of(largest: float) -> int:
    """Exponent of ten to write after a number; 0 if the number is easy to read without one."""
    # Of sixteen digits the last one is rounded.
    return 0 if _SMALL <= abs(largest) < _LARGE or largest == 0.0 else exponent(largest, 15)


def times_ten(power: int) -> str:
    """Power of ten as it stands after a number, e.g. "×10⁻⁵"; "" for the power 0."""
    return f"×10{superscript(power)}" if power else ""


def superscript(power: int) -> str:
    """Whole number as an exponent, e.g. "⁻⁵"."""
    return str(power).translate(_SUPERSCRIPT)


def fixed(x: float, decimals: int) -> str:
    """Number rounded to so many decimals, or to tens, hundreds, … if these are negative."""
    # Adding zero turns minus zero into zero.
    return f"{round(x, decimals) + 0.0:,.{max(decimals, 0)}f}"


def _known(value: float, std: float) -> bool:
    """Whether there is a value with an error."""
    return math.isfinite(value) and math.isfinite(std) and std > 0.0


def _joined(sign: str, numbers: Sequence[float], value: float, error: float) -> str:
    """Numbers with decimals down to the second digit of an error and one power of ten, joined by a sign."""
    power = power_of(max(abs(value), error))
    text = sign.join(fixed(x / 10.0**power, power + 1 - exponent(error)) for x in numbers)
    return (f"({text})" if power and len(numbers) > 1 else text) + times_ten(power)
