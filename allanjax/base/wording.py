"""Numbers as text in one style: values with errors, intervals, limits, durations.

An error has two significant digits; its value and interval have as many decimals. Commas separate thousands.
Only numbers below 1e-4 or from 1e7 on have an exponent.
"""

import math

# Numbers from _SMALL up to _LARGE are written without an exponent.
_SMALL, _LARGE = 1e-4, 1e7


def format_with_error(value: float, std: float) -> str:
    """Value and standard deviation, e.g. "0.5121 ± 0.0068" or "(1.680 ± 0.013)e-05".

    Without an error it is the value alone, to six digits.
    """
    if not _known(value, std):
        return plain(value, 6)
    power = _power(max(abs(value), std))
    return _with_power(f"{_fixed(value, std, power)} ± {_fixed(std, std, power)}", power)


def without_error(value: float, std: float) -> str:
    """Value with the decimals that its standard deviation warrants, e.g. "0.5121" or "1.680e-05"."""
    if not _known(value, std):
        return plain(value, 4)
    power = _power(max(abs(value), std))
    return _fixed(value, std, power) + (f"e{power:+03d}" if power else "")


def format_interval(lower: float, upper: float, value: float, std: float) -> str:
    """Interval with the decimals that `format_with_error` uses for the value, e.g. "0.4985 … 0.5257".

    Without an error the width of the interval determines the decimals.
    """
    if not _known(value, std):
        std = (upper - lower) / 4.0
    if not (_known(value, std) and math.isfinite(lower) and math.isfinite(upper)):
        return f"{plain(lower, 6)} … {plain(upper, 6)}"
    power = _power(max(abs(value), std))
    return _with_power(f"{_fixed(lower, std, power)} … {_fixed(upper, std, power)}", power)


def significant(x: float, digits: int = 3) -> str:
    """Number with `digits` significant digits, including zeros, e.g. "3,470", "0.500" or "1.20e-06"."""
    if not math.isfinite(x) or x == 0.0:
        return f"{x:g}"
    place = 10.0 ** (_exponent(x, digits) - digits + 2)
    power = _power(float(f"{x:.{digits - 1}e}"))
    text = _fixed(x, place, power)
    return f"{text}e{power:+03d}" if power else text


def plain(x: float, digits: int = 6) -> str:
    """Number with at most `digits` digits and no trailing zeros, e.g. "0.5" or "1,234.5"."""
    text, _, power = significant(x, digits).partition("e")
    text = text.rstrip("0").rstrip(".") if "." in text else text
    return f"{text}e{power}" if power else text


def duration(seconds: float) -> str:
    """Duration as text, e.g. "600 s", "25 min" or "2.78 h"."""
    if seconds < 1000.0:
        return f"{plain(seconds, 3)} s"
    return f"{plain(seconds / 60.0, 3)} min" if seconds < 7200.0 else f"{plain(seconds / 3600.0, 3)} h"


def finite_or_none(x: float) -> float | None:
    """A finite number, or None: JSON has neither NaN nor infinity, and their CSV cells are empty."""
    return float(x) if math.isfinite(x) else None


def _known(value: float, std: float) -> bool:
    """Whether there is a value with an error."""
    return math.isfinite(value) and math.isfinite(std) and std > 0.0


def _exponent(x: float, digits: int) -> int:
    """Exponent of ten of x, rounded to `digits` significant digits."""
    return int(f"{x:.{digits - 1}e}".partition("e")[2])


def _power(largest: float) -> int:
    """Exponent of ten to write after a number; 0 if the number is easy to read without one."""
    return 0 if _SMALL <= abs(largest) < _LARGE or largest == 0.0 else _exponent(largest, 16)


def _fixed(x: float, error: float, power: int) -> str:
    """Number x/10^power with decimals down to the second digit of its error."""
    decimals = power + 1 - _exponent(error, 2)
    # Adding zero turns minus zero into zero.
    rounded = round(x / 10.0**power, decimals) + 0.0
    return f"{rounded:,.{max(decimals, 0)}f}"


def _with_power(text: str, power: int) -> str:
    """Text, in brackets with its power of ten if there is one."""
    return f"({text})e{power:+03d}" if power else text
