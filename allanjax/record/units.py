"""Units of samples and of noise coefficients, on pint.

The registry is our own: an angle is a base dimension, so that a gyro's unit cannot be taken for an
accelerometer's, and `g` is the standard acceleration of gravity, not the gram.
"""

import functools
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeVar, cast

import numpy as np

from allanjax.base.errors import UnitError

if TYPE_CHECKING:
    import pint

#: Kinds of sensors.
Sensor = Literal["gyro", "accel"]
#: Quantities that samples are of: rates, or their increments over a sample interval.
Quantity = Literal["rate", "increment"]
Value = TypeVar("Value", float, np.ndarray)

#: Sensors whose noise is analysed, and their names with an article.
SENSORS: tuple[Sensor, ...] = ("gyro", "accel")
_A: dict[Sensor, str] = {"gyro": "a gyro", "accel": "an accelerometer"}
_OTHER: dict[Sensor, Sensor] = {"gyro": "accel", "accel": "gyro"}

#: Units of samples, those of rates and those of increments, as messages list and displays write them.
SAMPLE_UNITS: dict[Sensor, dict[Quantity, tuple[str, ...]]] = {
    "gyro": {
        "rate": ("deg/h", "deg/s", "mdeg/s", "rad/s", "mrad/s", "rad/h", "arcsec/s", "rpm"),
        "increment": ("rad", "mrad", "µrad", "deg", "arcmin", "arcsec"),
    },
    "accel": {
        "rate": ("m/s²", "cm/s²", "mm/s²", "g", "mg", "µg", "Gal", "mGal", "ft/s²", "m/s/h"),
        "increment": ("m/s", "cm/s", "mm/s", "ft/s"),
    },
}

# Definitions of the units in pint's language.
_DEFINITIONS = """
milli- = 1e-3 = m-
micro- = 1e-6 = u-
nano- = 1e-9 = n-
centi- = 1e-2 = c-
kilo- = 1e3 = k-
radian = [angle] = rad = radians
degree = 0.017453292519943295 * radian = deg = degrees
arcminute = degree / 60 = arcmin = arcminutes
arcsecond = degree / 3600 = arcsec = arcseconds
revolution = 6.283185307179586 * radian = rev = revolutions
meter = [length] = m = metre = meters = metres
foot = 0.3048 * meter = ft = feet
second = [time] = s = sec = seconds
minute = 60 * second = min = minutes
hour = 3600 * second = h = hr = hours
day = 86400 * second = d = days
count = [count] = LSB = counts = lsb = digit = digits
hertz = 1 / second = Hz
degree_per_second = degree / second = dps
degree_per_hour = degree / hour = dph
revolution_per_minute = revolution / minute = rpm
standard_gravity = 9.80665 * meter / second ** 2 = g
ppm = 1e-6
percent = 1e-2
gal = 0.01 * meter / second ** 2 = Gal
"""

#: Examples in messages for the size of a count.
COUNT_SIZES: dict[Sensor, str] = {
    "gyro": "'0.07 deg/s', 'deg/s/131' or '131 LSB/(deg/s)'",
    "accel": "'0.061 mg', 'g/16384' or '16384 LSB/g'",
}

# SI units of rates and increments, and the base dimension that the units of a sensor never have.
SI: dict[Sensor, dict[Quantity, str]] = {
    "gyro": {"rate": "rad/s", "increment": "rad"},
    "accel": {"rate": "m/s²", "increment": "m/s"},
}
_FOREIGN_DIMENSION: dict[Sensor, str] = {"gyro": "[length]", "accel": "[angle]"}

# Usual units of coefficients by the exponent of time in their SI dimension rate·s^exponent.
_COEFFICIENT_UNITS: dict[Sensor, dict[float, str]] = {
    "gyro": {1.0: "arcsec", 0.5: "deg/√h", 0.0: "deg/h", -0.5: "deg/h/√h", -1.0: "deg/h²"},
    "accel": {1.0: "m/s", 0.5: "m/s/√h", 0.0: "µg", -0.5: "m/s/h/√h", -1.0: "m/s/h²"},
}

# SI units as they are usually written.
_SI_UNITS = (
    *("rad", "rad/√s", "rad/s", "rad/s/√s", "rad/s²"),
    *("m/s", "m/s/√s", "m/s²", "m/s²/√s", "m/s³"),
    *("s", "Hz", "1"),
)

# Units that messages propose if the dimension is the same.
_PROPOSED = (
    *(unit for sensor in SENSORS for unit in _COEFFICIENT_UNITS[sensor].values()),
    *("deg/s/√Hz", "mdps/√Hz", "deg/h/√Hz", "µg/√Hz", "mg/√Hz", "deg/s", "g", "deg", "h"),
    *_SI_UNITS,
)

#: Number as people write it, for regular expressions.
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_QUANTITY = re.compile(rf"\s*({NUMBER})\s*(.*?)\s*")
# Number that is a factor of a unit, not a power.
_NUMBER = r"(?<![\w.^])(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?"

# Words whose case has no meaning; not m, g and words with a prefix: M and G could be mega and giga.
_WORDS = ("s", "h", "mGal", "uGal", *re.findall(r"[A-Za-z]{2,}", _DEFINITIONS))
_ANY_CASE = {word.lower(): word for word in _WORDS}

_SUPERSCRIPTS = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")
_SYMBOLS = str.maketrans(
    {"%": "percent", "′": "arcmin"}
    | dict.fromkeys("µμ", "u")
    | dict.fromkeys("°º", "deg")
    | dict.fromkeys('″”"', "arcsec")
    | dict.fromkeys("·⋅×", "*")
)
# A unit per (unknown) unit of another channel, e.g. `deg/s/[temperature]`.
_PER_CHANNEL = re.compile(r"(.+)/(\[.+\])")
# pint reads `rads` and `degs` as plurals of an angle; people may mean rad/s and deg/s.
_AMBIGUOUS_PLURAL = re.compile(r"\b[a-z]?(rad|deg|g|h|hr|ft|arcsec|arcmin)s\b")


@dataclass(frozen=True)
class SampleUnit:
    """Unit of the samples of a sensor.

    Attributes:
        name: label for display, e.g. `deg/s`.
        scale: factor to SI: rad/s or m/s² for rates, rad or m/s for increments.
        quantity: `rate`, or `increment` (angle or velocity gained within one sample interval).
    """

    name: str
    scale: float
    quantity: Quantity


class _Unit(NamedTuple):
    """Unit with its factor to SI and its exponents of the base dimensions."""

    scale: float
    dimension: dict[str, float]

    @property
    def base(self) -> str:
        """Its dimension in words."""
        powers = [f"{name}^{power:g}" for name, power in sorted(self.dimension.items())]
        return "·".join(powers) or "dimensionless"


@functools.cache
def parse_sample_unit(text: str, sensor: Sensor) -> SampleUnit:
    """Parse the unit of a sensor's samples, in any usual spelling (`°/s`, `dps`, `m/s^2`, `mg`, ...).

    It may have a number, as the size of a count: `0.07 deg/s`, `deg/s/131`, `70 mdps/LSB`, `131 LSB/(deg/s)`.

    Raises:
        UnitError: the unit is unknown or does not fit the sensor; the message lists units that do.
    """
    unit = _of_a_count(_parse(text))
    quantity = _quantity(unit, sensor)
    if unit is None or quantity is None:
        accepted = SAMPLE_UNITS[sensor]
        other = _OTHER[sensor]
        hint = f"; {text!r} is a unit of {_A[other]}" if _quantity(unit, other) else ""
        if unit is not None and unit.dimension == {"[count]": 1.0}:
            hint = f"; for counts give the size of one, e.g. {COUNT_SIZES[sensor]}"
        raise UnitError(
            f"unknown unit {text!r} for {_A[sensor]}{hint}; accepted: {', '.join(accepted['rate'])} (rates); "
            f"{', '.join(accepted['increment'])} (increments)"
        )
    # One of the usual labels if the unit is the same, else the text.
    labels = SAMPLE_UNITS[sensor][quantity]
    spelled = [label for label in labels if _expression(label) == _expression(text)]
    equal = [label for label in labels if np.isclose(unit_scale(label), unit.scale, rtol=1e-12, atol=0.0)]
    return SampleUnit([*spelled, *equal, text.strip()][0], unit.scale, quantity)


def rate_unit_of(unit: str, sensor: Sensor) -> tuple[str, float]:
    """Return the display unit of rates for samples in this unit, and its factor to SI.

    For increments it is rad/s or m/s², for counts the unit of the size of one.
    """
    own = parse_sample_unit(unit, sensor)
    if own.quantity == "rate" and not re.search(_NUMBER, own.name):
        return own.name, own.scale
    named = (label for label in SAMPLE_UNITS[sensor]["rate"] if label in unit and own.quantity == "rate")
    label = next(named, SI[sensor]["rate"])
    return label, unit_scale(label)


def default_coefficient_unit(sensor: Sensor, time_exponent: float) -> str:
    """Usual unit of a noise coefficient whose SI dimension is rate·s^time_exponent.

    The rate is in rad/s (gyro) or m/s² (accel). Quantization has the exponent 1, random walk 1/2,
    bias instability 0, rate random walk -1/2, ramp -1; another exponent gets an SI label that
    `unit_scale` parses, e.g. `rad/s^0.75`.
    """
    usual = _COEFFICIENT_UNITS[sensor].get(float(time_exponent))
    if usual is not None:
        return usual
    return _per_time("rad", time_exponent - 1.0) if sensor == "gyro" else _per_time("m", time_exponent - 2.0)


@functools.cache
def si_unit(unit: str) -> str:
    """SI unit of the same dimension, e.g. `rad/√s` for `deg/√h`.

    Raises:
        UnitError: the unit is unknown.
    """
    per_channel = _PER_CHANNEL.fullmatch(unit)
    if per_channel:
        return f"{si_unit(per_channel[1])}/{per_channel[2]}"
    known = _known(unit, None)
    usual = next((label for label in _SI_UNITS if _known(label, None).dimension == known.dimension), None)
    if usual is not None:
        return usual
    bases = {"[angle]": "rad", "[length]": "m"}
    powers = ((bases[name], power) for name, power in known.dimension.items() if name in bases)
    base = "·".join(name if power == 1.0 else f"{name}^{power:.12g}" for name, power in powers)
    return _per_time(base or "1", known.dimension.get("[time]", 0.0))


def _per_time(base: str, exponent: float) -> str:
    """Unit from a base and a power of seconds, e.g. `rad/s^0.75`."""
    if exponent == 0.0:
        return base
    power = "s" if abs(exponent) == 1.0 else f"s^{abs(exponent):.12g}"
    return f"{base}·{power}" if exponent > 0.0 else f"{base}/{power}"


def unit_scale(unit: str, sensor: Sensor | None = None) -> float:
    """Factor of one `unit` in SI (rad, m, s and their products): value_SI = value · factor.

    Roots may be written `deg/√h`, `deg/sqrt(h)`, `deg/h^0.5`. With a `sensor`, a unit of the other
    sensor is refused.

    Raises:
        UnitError: the unit is unknown or belongs to the other sensor.
    """
    return _known(unit, sensor).scale


def convert(value: Value, from_unit: str, to_unit: str, sensor: Sensor | None = None) -> Value:
    """Convert `value` (a number or an array) between two units of the same dimension.

    Raises:
        UnitError: a unit is unknown, belongs to the other sensor, or the dimensions differ.
    """
    source, target = _known(from_unit, sensor), _known(to_unit, sensor)
    if source.dimension != target.dimension:
        same = [u for u in _PROPOSED if u != from_unit and _known(u, None).dimension == source.dimension]
        raise UnitError(
            f"cannot convert {from_unit!r} to {to_unit!r}, of {source.base} and of {target.base}; "
            + (f"possible are {', '.join(same)}" if same else "give units of the same dimension")
        )
    return value * (source.scale / target.scale)


def parse_quantity(text: Any) -> tuple[float, str] | None:
    """Return number and unit of a text such as "0.1 deg/s"; None for other texts, or without a unit."""
    found = _QUANTITY.fullmatch(text) if isinstance(text, str) else None
    return (float(found[1]), found[2]) if found and found[2] else None


def is_unit(text: str, like: str | None = None) -> bool:
    """Whether a text is a known unit, of the same dimension as another one if that is given."""
    unit = _parse(text)
    return unit is not None and (like is None or unit.dimension == _known(like, None).dimension)


def same_unit(one: str, other: str) -> bool:
    """Return whether two units are the same, in any spelling; unknown units are not."""
    units = _of_a_count(_parse(one)), _of_a_count(_parse(other))
    return None not in units and units[0] == units[1]


def density_power(unit: str) -> float:
    """Return the power of a density in a unit: 1/2 for `deg/s/√Hz`, 1 for `(deg/h)²/Hz`, 0 without Hz.

    A one-sided density is twice the two-sided one, to this power.

    Raises:
        UnitError: the unit is unknown.
    """
    _known(unit, None)
    exponents = cast(Mapping[str, float], _registry().Quantity(_expression(unit)).units._units)
    return max(-sum(power for name, power in exponents.items() if name.endswith("hertz")), 0.0)


def _known(text: str, sensor: Sensor | None) -> _Unit:
    """Return the unit named by `text`; UnitError if it is unknown or a unit of the other sensor."""
    unit = _parse(text)
    if unit is None:
        raise UnitError(
            f"unknown unit {text!r}; use e.g. deg/h, deg/√h, deg/h/√h, m/s/√h, µg, µg/√Hz, rad/s/√Hz"
        )
    if sensor is not None and _FOREIGN_DIMENSION[sensor] in unit.dimension:
        raise UnitError(
            f"unit {text!r} is for {_A[_OTHER[sensor]]}, not for {_A[sensor]}; "
            f"use e.g. {', '.join(_COEFFICIENT_UNITS[sensor].values())}"
        )
    return unit


@functools.cache
def _parse(text: str) -> _Unit | None:
    """Unit named by `text`, or None if it is unknown."""
    import pint

    per_channel = _PER_CHANNEL.fullmatch(text)
    if per_channel:
        own = _parse(per_channel[1])
        return own and _Unit(own.scale, {**own.dimension, f"channel {per_channel[2]}": -1.0})
    expression = _expression(text)
    if not _is_product(expression) or _AMBIGUOUS_PLURAL.search(expression):
        return None
    registry = _registry()
    try:
        size: Any = registry.Quantity(expression).to_root_units()
        factor = float(size.magnitude)
    except (pint.PintError, ValueError, ArithmeticError):
        return None
    if not 0.0 < factor < np.inf:
        return None
    powers = cast(Mapping[str, float], size.dimensionality)
    dimension = {name: round(power, 9) for name, power in powers.items()}
    return _Unit(factor, {name: power for name, power in dimension.items() if power})


@functools.cache
def _registry() -> "pint.UnitRegistry":
    """Return a registry of pint with only the units defined here."""
    import pint

    registry: pint.UnitRegistry = pint.UnitRegistry(None)
    registry.load_definitions(_DEFINITIONS.strip().splitlines())
    return registry


def _expression(text: str) -> str:
    """Unit as an expression for pint: powers by `**`, products by `*`, usual spellings replaced."""
    text = text.strip().translate(_SYMBOLS).replace("**", "^")
    text = re.sub(r"[⁰¹²³⁴⁵⁶⁷⁸⁹⁻]+", lambda run: "^" + run[0].translate(_SUPERSCRIPTS), text)
    text = re.sub(r"(?:√|\bsqrt|\b(?:rt|root)-?)\s*(?:\(\s*(\w+)\s*\)|(\w+))", r"(\1\2^0.5)", text)
    text = re.sub(r"\s+per\s+", "/", text)
    text = re.sub(r"\b[gG]['’]s\b", "g", text)
    text = re.sub(r"\s*([/*^()])\s*", r"\1", text)
    text = re.sub(rf"({_NUMBER})(?=[A-Za-z])(?![eE][+-]?\d)", r"\1*", text)
    text = re.sub(r"(?<=[A-Za-z])\.(?=[A-Za-z])|(?<=[\w)])\s+(?=[\w(])", "*", text)
    text = re.sub(r"([A-Za-z])(?<!\d[eE])\^?(-?\d+(?:\.\d+)?)", r"\1^\2", text)
    text = re.sub(r"[A-Za-z]+", lambda word: _ANY_CASE.get(word[0].lower(), word[0]), text)
    return text.replace("^", "**")


def _is_product(expression: str) -> bool:
    """Return whether the expression is a product of powers; pint's parser accepts more, or crashes."""
    number = r"-?\d{1,3}(?:\.\d+)?"
    factor = rf"(?:[A-Za-z]+|{_NUMBER})\^?"
    product = rf"{factor}(?:[*/]{factor})*"
    expression = re.sub(rf"\*\*(?:{number}|\({number}(?:/{number})?\))", "^", expression)
    found = 1
    while found:
        expression, found = re.subn(rf"\({product}\)", "u", expression)
    return re.fullmatch(product, expression) is not None


def _of_a_count(unit: _Unit | None) -> _Unit | None:
    """Return the size of a count from a unit per count or counts per unit; other units unchanged."""
    power = 0.0 if unit is None else unit.dimension.get("[count]", 0.0)
    if unit is None or abs(power) != 1.0 or len(unit.dimension) == 1:
        return unit
    dimension = {name: -power * p for name, p in unit.dimension.items() if name != "[count]"}
    return _Unit(unit.scale**-power, dimension)


def _quantity(unit: _Unit | None, sensor: Sensor) -> Quantity | None:
    """Quantity of samples in this unit, or None if it does not fit the sensor."""
    dimensions = ((quantity, _known(si, None).dimension) for quantity, si in SI[sensor].items())
    return next((quantity for quantity, own in dimensions if unit and own == unit.dimension), None)
