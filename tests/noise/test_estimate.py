"""A value and its unit are one thing: whatever the class, the parameter and the unit."""

import dataclasses
import math
import re

import numpy as np
import pytest

import allanjax as aj
from allanjax.noise.estimate import Estimate
from allanjax.noise.notation import term_classes
from allanjax.noise.parameter import Parameter
from allanjax.record.recording import Axis
from allanjax.record.units import UnitError, si_unit, unit_scale

DEG, H, G0 = math.pi / 180.0, 3600.0, 9.80665

# Units by the dimension of what they measure, with their factors to SI worked out by hand.
GYRO = {
    1.0: {"rad": 1.0, "deg": DEG, "arcsec": DEG / H, "mrad": 1e-3},
    0.5: {"rad/√s": 1.0, "deg/√h": DEG / 60, "deg/sqrt(h)": DEG / 60, "deg/h/√Hz": DEG / H, "deg/√s": DEG},
    0.25: {"rad/s^0.75": 1.0, "deg/s^0.75": DEG},
    0.0: {"rad/s": 1.0, "deg/s": DEG, "deg/h": DEG / H, "°/h": DEG / H, "mdeg/s": 1e-3 * DEG},
    -0.5: {"rad/s/√s": 1.0, "deg/h/√h": DEG / H / 60, "deg/s/√s": DEG, "rad/s²/√Hz": 1.0},
    -1.0: {"rad/s²": 1.0, "deg/h²": DEG / H**2, "deg/h/s": DEG / H},
}
ACCEL = {
    1.0: {"m/s": 1.0, "mm/s": 1e-3, "ft/s": 0.3048},
    0.5: {"m/s/√s": 1.0, "m/s/√h": 1 / 60, "µg/√Hz": 1e-6 * G0, "m/s²/√Hz": 1.0},
    0.25: {"m/s^1.75": 1.0, "m/h^1.75": H**-1.75},
    0.0: {"m/s²": 1.0, "µg": 1e-6 * G0, "mg": 1e-3 * G0, "m/s/h": 1 / H, "Gal": 1e-2},
    -0.5: {"m/s²/√s": 1.0, "m/s/h/√h": 1 / H / 60, "µg/√h": 1e-6 * G0 / 60},
    -1.0: {"m/s³": 1.0, "m/s/h²": H**-2, "µg/h": 1e-6 * G0 / H},
}
TIMES = {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": H}
FREQUENCIES = {"Hz": 1.0, "kHz": 1e3, "1/s": 1.0, "1/h": 1 / H}
AXES = {"gyro": Axis("gyro_x", "gyro", "deg/s"), "accel": Axis("accel_z", "accel", "g")}


def units_of(parameter: Parameter, sensor: str) -> dict[str, float]:
    if parameter.kind == "amplitude":
        return {"gyro": GYRO, "accel": ACCEL}[sensor][float(parameter.time_exponent)]
    return {"time": TIMES, "frequency": FREQUENCIES, "line": FREQUENCIES}.get(parameter.kind, {"1": 1.0})


PARAMETERS = [(name, p) for name, cls in term_classes().items() for p in cls.parameters()]
PARAMETERS += [("user's", dataclasses.replace(aj.AngleRandomWalk.parameters()[0], time_exponent=0.25))]


def estimates(sensor: str, parameter: Parameter, label: str, size: float) -> list:
    """One from every source and in every state, of this size in SI."""
    axis = AXES[sensor]
    numbers = {
        "axis": axis,
        "value": 3.0 * size,
        "std": 0.1 * size,
        "interval": (2.8 * size, 3.2 * size),
        "interval_68": (2.9 * size, 3.1 * size),
    }
    names = {"label": label, "term": label, "parameter": parameter}
    limit = 3.17 * size
    of_amplitude = limit if parameter.kind == "amplitude" else None
    found = Estimate(**numbers, **names, upper_limit=of_amplitude, detected=True)
    absent = dataclasses.replace(found, value=0.0, std=0.0, upper_limit=limit, detected=False)
    shape = dataclasses.replace(absent, upper_limit=None)
    held = dataclasses.replace(found, std=0.0, held=True)
    marginal = Estimate(
        source="posterior", **numbers, **names, upper_limit=of_amplitude, detected=True, bayes_factor=0.01
    )
    walk = Estimate(
        source="spectrum",
        **numbers,
        **names,
        upper_limit=None,
        detected=True,
        band=(1.0, 7.0),
        excess=0.03 * size,
    )
    derived = Estimate(
        source="posterior", **numbers, label=label, usual_unit=found.usual_unit, remark="extrapolated"
    )
    # A shape that may be anywhere below is detected, and has a limit.
    below = [] if of_amplitude else [dataclasses.replace(found, upper_limit=limit)]
    return [found, absent, shape, held, marginal, walk, derived, *below]


def in_si(estimate, factor: float) -> list[float]:
    """Every number of it that has the unit, in SI by this factor."""
    numbers = [estimate.value, estimate.std, *estimate.interval, *estimate.interval_68]
    numbers += [x for name in ("upper_limit", "excess") if (x := getattr(estimate, name, None)) is not None]
    return [x * factor for x in numbers]


CASES = [
    pytest.param(sensor, name, p, id=f"{sensor}-{name}-{p.name}") for sensor in AXES for name, p in PARAMETERS
]


@pytest.mark.parametrize(("sensor", "label", "parameter"), CASES)
def test_number_and_unit_agree_in_every_unit(sensor, label, parameter):
    units = units_of(parameter, sensor)
    size = float(np.random.default_rng(len(label)).lognormal(-5.0, 6.0))
    for e in estimates(sensor, parameter, label, size):
        exact = in_si(e, 1.0)
        # What is not given a unit is in SI.
        assert units[e.unit] == 1.0
        assert e.in_unit().unit == e.usual_unit
        for unit, factor in units.items():
            shown = e.in_unit(unit)
            assert type(shown) is type(e)
            assert shown.unit == unit
            assert in_si(shown, factor) == pytest.approx(exact, rel=1e-12)
            assert shown.in_unit(unit) == shown
            for further, other in units.items():
                assert in_si(shown.in_unit(further), other) == pytest.approx(exact, rel=1e-12)
            assert in_si(shown.in_unit(e.unit), 1.0) == pytest.approx(exact, rel=1e-12)
            assert shown.in_unit().unit == shown.usual_unit == e.usual_unit
            assert (shown.axis, shown.title, shown.si_unit) == (e.axis, e.title, e.unit)


def numbers(text: str) -> list[float]:
    """The numbers of a text, those in `(1.23 ± 0.04)e-05` included."""
    found = []
    for bracket, power, plain in re.findall(
        r"\(([\d.]+ ± [\d.]+)\)e([+-]\d+)|(\d[\d.,]*(?:e[+-]\d+)?)", text.split(": ", 1)[1]
    ):
        found += [float(x) * 10.0 ** int(power) for x in bracket.split(" ± ")] if bracket else []
        found += [float(plain.rstrip(".,").replace(",", ""))] if plain else []
    return found


@pytest.mark.parametrize(("sensor", "label", "parameter"), CASES)
def test_what_is_printed_is_what_is_held(sensor, label, parameter):
    every = estimates(sensor, parameter, label, 7.3e-4)
    shape = every[2]
    for e in every:
        for unit, factor in units_of(parameter, sensor).items():
            shown = e.in_unit(unit)
            name = "" if unit == "1" else f" {unit}"
            assert str(shown).startswith(f"{e.axis.name} {e.title}: ")
            assert shown.describe() == e.describe(unit)
            told = str(shown)
            if e is shape:
                assert shown.describe() == "not determined: its term is not detectable"
                continue
            assert name in shown.describe()
            assert name in told
            first = numbers(f": {shown.describe()}")[0]
            is_shape = parameter.kind != "amplitude" and getattr(e, "upper_limit", None) is not None
            limit = (is_shape or not getattr(e, "detected", True)) and not getattr(e, "held", False)
            # Two digits of an error a thirtieth of the value, three of a limit, six of what is held.
            assert first * factor == pytest.approx(e.upper_limit if limit else e.value, rel=5e-3)
            assert numbers(told)[0] == first
            if shown.unit != shown.usual_unit:
                assert shown.in_unit().describe().split(" (95")[0].split(";")[0].split("below ")[-1] in told


@pytest.mark.parametrize(("sensor", "label", "parameter"), CASES)
def test_a_unit_of_something_else_is_refused(sensor, label, parameter):
    own = units_of(parameter, sensor)
    others = [u for table in (*GYRO.values(), *ACCEL.values(), TIMES, FREQUENCIES) for u in table]
    dimensions = {tuple(sorted(si_unit(u))) for u in own}
    for e in estimates(sensor, parameter, label, 1.0):
        for unit in (u for u in others if tuple(sorted(si_unit(u))) not in dimensions):
            with pytest.raises(UnitError):
                e.in_unit(unit)
        with pytest.raises(UnitError, match="unknown unit 'furlong'"):
            e.in_unit("furlong")


def test_a_fit_prints_both_units_and_a_second_conversion_changes_nothing(small_fit):
    c = small_fit["gyro_x"]["angle_random_walk"]
    assert c.unit == "rad/√s"
    usual = c.in_unit("deg/√h")
    assert usual.value == pytest.approx(c.value / (DEG / 60), rel=1e-12)
    assert usual.in_unit("deg/√h") == usual.in_unit() == usual
    assert str(usual) == f"gyro_x angle random walk: {usual.describe()}"
    assert str(c) == f"gyro_x angle random walk: {c.describe()} = {usual.describe()}"
    assert usual.in_unit("rad/s/√Hz").value == pytest.approx(c.value, rel=1e-12)
    absent = next(c for c in small_fit["gyro_x"].coefficients.values() if not c.detected)
    assert re.fullmatch(
        r"gyro_x [\w ]+: not detectable, below \S+ rad\S* = \S+ (deg|arcsec)\S* \(95 %\)", str(absent)
    )


def test_every_usual_unit_has_an_si_unit():
    for table in (*GYRO.values(), *ACCEL.values(), TIMES, FREQUENCIES):
        for unit, factor in table.items():
            assert unit_scale(unit) == pytest.approx(factor, rel=1e-12)
            assert table[si_unit(unit)] == 1.0
    assert unit_scale(si_unit("deg²/h")) == 1.0
