"""Numbers as they are written: what is printed, read back, is the number to half a unit of its last digit."""

import re

import numpy as np
import pytest

from allanjax.base.wording import duration, format_interval, format_with_error, plain, significant
from allanjax.fleet.summary import _spread

RNG = np.random.default_rng(12)
# Values over thirty decades, whose errors are from a millionth to ten times as large; and the awkward ones.
VALUES = np.exp(RNG.uniform(-35.0, 35.0, 400)) * RNG.choice([-1.0, 1.0], 400, p=[0.1, 0.9])
CASES = [(float(v), float(abs(v) * 10.0 ** RNG.uniform(-6.0, 1.0))) for v in VALUES]
CASES += [
    (0.0, 0.3),
    (5.0, 0.0996),
    (0.99951, 0.0999),
    (12226.0, 19.6),
    (310756.0, 1234.0),
    (9999999.7, 20.0),
]
CASES += [(99.96, 9.96), (1e-4, 1e-5), (0.99999e-4, 1e-6), (1e7, 1e5), (-0.001, 0.3), (1e15, 3.0)]

NUMBER = r"-?[\d,]+(?:\.\d+)?"


def unit_of_last_digit(text: str, digits: int) -> float:
    """What one more in the last written digit is; zeros of a whole number beyond `digits` are none."""
    whole, _, decimals = text.lstrip("-").partition(".")
    if decimals:
        return 10.0 ** -len(decimals)
    figures = whole.replace(",", "")
    return 10.0 ** (len(figures) - min(digits, len(figures)))


def parts(text: str, between: str) -> tuple[str, str, float]:
    """The two numbers of a text as they are written, and the power of ten that they share."""
    number = f"({NUMBER}) {between} ({NUMBER})"
    whole = re.fullmatch(number, text) or re.fullmatch(rf"\({number}\)e([+-]\d\d)", text)
    assert whole, text
    power = whole[3] if whole.lastindex == 3 else "0"
    return whole[1], whole[2], 10.0 ** int(power)


def read(text: str) -> float:
    return float(text.replace(",", ""))


@pytest.mark.parametrize(("value", "std"), CASES)
def test_an_error_has_two_digits_and_the_value_and_its_interval_as_many_decimals(value, std):
    shown, error, scale = parts(format_with_error(value, std), "±")
    last = unit_of_last_digit(error, 2)
    significant_digits = error.replace(",", "").replace(".", "").lstrip("0")
    assert len(significant_digits.rstrip("0") if last > 1.0 else significant_digits) <= 2
    assert last <= 1.0 or len(significant_digits) > 2
    if last <= 1.0:
        assert len(significant_digits) == 2
    # Half a unit of the last digit, and rounding of the double numbers themselves.
    spare = 1e-15 * abs(value) / scale
    assert abs(read(shown) - value / scale) <= 0.5001 * last + spare
    assert abs(read(error) - std / scale) <= 0.5001 * last
    assert len(shown.partition(".")[2]) == len(error.partition(".")[2])
    # An exponent only where it is called for.
    largest = max(abs(value), std)
    assert (scale != 1.0) == (largest < 1e-4 or largest >= 1e7)

    low, high = value - 1.96 * std, value + 2.3 * std
    lower, upper, same = parts(format_interval(low, high, value, std), "…")
    assert same == scale
    for written, end in ((lower, low), (upper, high)):
        assert abs(read(written) - end / scale) <= 0.5001 * last + spare
        assert len(written.partition(".")[2]) == len(error.partition(".")[2])


@pytest.mark.parametrize("digits", [1, 2, 3, 4, 6])
@pytest.mark.parametrize("x", [*VALUES[:60], 0.5, 9.996, 999.6, 99950.0, 9.9999e-5, 9999999.0, 1e7, 3470.0])
def test_significant_digits_are_as_many_as_asked_for(x, digits):
    for text in (significant(float(x), digits), plain(float(x), digits)):
        mantissa, _, power = text.partition("e")
        assert bool(power) == (not 1e-4 <= float(f"{abs(x):.{digits - 1}e}") < 1e7)
        value = read(mantissa) * 10.0 ** int(power or 0)
        assert abs(value - x) <= 0.5001 * 10.0 ** (np.floor(np.log10(abs(value))) - digits + 1)
    figures = re.sub(r"[-,.]", "", significant(float(x), digits).partition("e")[0]).lstrip("0")
    assert len(figures) >= digits
    assert figures[digits:].strip("0") == ""
    shortened = plain(float(x), digits).partition("e")[0]
    assert "." not in shortened or shortened[-1] not in "0."


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        *[(0.05, "0.05 s"), (12.34, "12.3 s"), (200.0, "200 s"), (600.0, "600 s"), (999.0, "999 s")],
        *[(1500.0, "25 min"), (3600.0, "60 min"), (10_000.0, "2.78 h"), (36_000.0, "10 h")],
        (604_800.0, "168 h"),
    ],
)
def test_short_records_are_in_seconds_long_ones_in_hours(seconds, text):
    assert duration(seconds) == text


def test_what_is_not_known_is_written_as_what_it_is():
    assert format_with_error(0.25, 0.0) == "0.25"
    assert format_with_error(0.25, float("nan")) == "0.25"
    assert format_interval(0.0, float("inf"), 1.0, 1.0) == "0 … inf"
    # Where only the interval is known, its width says how many digits there are.
    assert format_interval(1.0, 1.4, float("nan"), float("nan")) == "1 … 1.4"
    assert format_interval(1.0, 1.4, 1.2, 0.0) == "1.00 … 1.40"
    assert significant(0.0) == "0"
    assert format_with_error(-0.001, 0.3) == "0.00 ± 0.30"


def test_quantiles_of_a_fleet_have_the_medians_style():
    """An exponent stays with the numbers that it belongs to."""
    small = np.linspace(1.0e-5, 1.4e-5, 41)
    assert _spread(small, small / 10.0, "m/s") == ("(1.20 ± 0.12)e-05 m/s", "(1.02 … 1.38)e-05")
    assert _spread(1e8 * small, small, "1") == ("1,200 ± 120", "1,020 … 1,380")


def test_one_table_has_one_style(small_fit):
    """Of a fit: each value, its error and the ends of its interval have the same decimals."""
    rows = [cells for cells in small_fit._cells() if cells[1] and "±" in cells[2]]
    assert rows
    for _, _, value, interval in rows:
        decimals = {len(x.partition(".")[2]) for x in re.findall(NUMBER, f"{value} {interval}")[:4]}
        assert len(decimals) == 1, (value, interval)
    limits = [cells[2] for cells in small_fit._cells() if "below" in cells[2]]
    assert limits
    assert all(re.search(rf"below {NUMBER}(e-\d\d)? ", text) for text in limits)
    assert "small: 20,000 samples at 100 Hz (200 s)" in str(small_fit)
