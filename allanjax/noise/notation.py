"""Models written as text, e.g. on the command line: `N=0.1 deg/√h + markov(correlation_time=100 s held)`."""

from __future__ import annotations

import functools
import re
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

from allanjax.base.errors import AllanjaxError, UnitError
from allanjax.noise import terms as all_terms
from allanjax.noise.model import Model
from allanjax.noise.parameter import Parameter, Parametrized
from allanjax.noise.response import Biquad, Butterworth, LowPass1, LowPass2, MovingAverage, Response
from allanjax.noise.terms import NoiseTerm
from allanjax.record.units import NUMBER, SENSORS, Sensor, convert, default_coefficient_unit, unit_scale

if TYPE_CHECKING:
    from allanjax.record.columns import Column
    from allanjax.record.recording import Axis

#: A model as functions take it: the model itself, a single term, or a text for `parse_model`.
ModelLike: TypeAlias = Model | NoiseTerm | str
#: A model for all axes, models by the names of axes or sensors, or a fit, which has one for each axis.
Modelling: TypeAlias = ModelLike | Mapping[str, Any]

# A term, a parameter in its brackets, and a value with its unit.
_TERM = re.compile(r"(?P<name>\w+)\s*(?:=\s*(?P<value>.+)|\((?P<arguments>.*)\))?", re.DOTALL)
_ARGUMENT = re.compile(r"(?P<name>\w+)\s*=\s*(?P<value>.+)", re.DOTALL)
_VALUE = re.compile(rf"(?P<number>{NUMBER})\s*(?P<unit>.*?)\s*(?P<held>\bheld)?")
# SI units of parameters other than amplitudes, by their kind.
_KIND_UNIT = {"time": "s", "frequency": "Hz", "line": "Hz"}


_Kind = TypeVar("_Kind", bound=Parametrized)


def response_classes() -> dict[str, type[Response]]:
    """Classes of responses by name, e.g. `low_pass1`."""
    return {c.name(): c for c in (LowPass1, LowPass2, Biquad, Butterworth, MovingAverage)}


@functools.cache
def term_classes() -> dict[str, type[NoiseTerm]]:
    """Classes of allanjax's noise terms by name, e.g. `angle_random_walk`."""
    found = (getattr(all_terms, name) for name in all_terms.__all__)
    classes = (c for c in found if isinstance(c, type) and issubclass(c, NoiseTerm) and c is not NoiseTerm)
    return {c.name(): c for c in classes}


def as_model(model: ModelLike, axes: Iterable[Axis | Column] = ()) -> Model:
    """Model from terms written with `+`, a single term, or a text such as `"N + B + K"`.

    Args:
        model: the terms.
        axes: the axes it is for; amplitudes in a text must have units of their sensor.

    Raises:
        AllanjaxError: `model` is not a model; it has values, which are for one kind of sensor, but there are
            axes of both.
        UnitError: as for `parse_model`.
    """
    if not isinstance(model, str):
        return Model(()) + model
    sensors = {axis.sensor for axis in axes}
    parsed = parse_model(model, next(iter(sensors)) if len(sensors) == 1 else None)
    if len(sensors) > 1:
        for p in parsed.parameters:
            if p.parameter.is_amplitude and p.start is not None:
                raise AllanjaxError(
                    f"{p.label} in {model!r} has a value for one kind of sensor, but there are axes of both: "
                    'leave out the value, or use the axes of one sensor, recording["gyro"]'
                )
    return parsed


def parse_model(text: str, sensor: Sensor | None = None) -> Model:
    """Model written as text, such as `"N + B + K"`.

    Terms stand side by side with `+` or `,`. Each is a name or the symbol of its amplitude (`N` for
    `angle_random_walk`), alone, with the amplitude (`N=0.1 deg/√h`), or with parameters in brackets
    (`markov(amplitude=3 deg/h/√h, correlation_time=100 s)`). `held` after a value keeps it fixed in a fit.
    Terms that pass a filter stand in brackets after it: `low_pass1(bandwidth=28 Hz) * (N + K) + resonance`.
    Options are integers, `butterworth(order=4) * N`.

    Args:
        text: e.g. `"N + B + K"` or `"quantization, angle_random_walk, markov"`.
        sensor: sensor whose units the amplitudes must have; by default either.

    Raises:
        AllanjaxError: an unknown term or parameter, or a value that is not a number.
        UnitError: a unit that is unknown or does not fit the parameter.
    """
    model = Model(())
    for part in _split(text, "+,"):
        *filters, passing = _split(part, "*")
        in_brackets = passing.startswith("(")
        inner = parse_model(passing[1:-1], sensor) if in_brackets else _named(passing, term_classes(), sensor)
        for filter_ in reversed(filters):
            inner = _named(filter_, response_classes(), sensor) * inner
        model = model + inner
    return model


def _split(text: str, separators: str) -> list[str]:
    """Parts of `text` between separators outside brackets, not counting the + of a number such as 1e+3."""
    parts, depth = [""], 0
    for i, char in enumerate(text):
        depth += (char == "(") - (char == ")")
        exponent = char == "+" and re.search(r"[\d.][eE]$", text[:i]) is not None
        if char in separators and depth == 0 and not exponent:
            parts.append("")
        else:
            parts[-1] += char
    parts = [part.strip() for part in parts]
    if depth != 0 or not all(parts):
        raise AllanjaxError(
            f"cannot read {text!r}: write terms such as 'N + B + markov(correlation_time=100 s)'"
        )
    return parts


def _named(text: str, classes: Mapping[str, type[_Kind]], sensor: Sensor | None) -> _Kind:
    """Noise term or response written as text."""
    match = _TERM.fullmatch(text)
    if match is None:
        raise AllanjaxError(
            f"cannot read the term {text!r}; write a name such as angle_random_walk or N=0.1 deg/√h"
        )
    by_symbol = {c.parameters()[0].symbol: c for c in classes.values() if issubclass(c, NoiseTerm)}
    cls = classes.get(match["name"].lower()) or by_symbol.get(match["name"])
    if cls is None:
        known = ", ".join(f"{label} ({c.parameters()[0].symbol})" for label, c in classes.items())
        what = "term" if by_symbol else "response"
        raise AllanjaxError(f"unknown {what} {match['name']!r}; known are {known}")
    first = cls.parameters()[0]
    arguments = [(first.name, match["value"])] if match["value"] else []
    for argument in _split(match["arguments"], ",") if match["arguments"] else []:
        pair = _ARGUMENT.fullmatch(argument)
        if pair is None:
            raise AllanjaxError(f"cannot read {argument!r} in {text!r}; write e.g. correlation_time=100 s")
        arguments.append((pair["name"], pair["value"]))
    values: dict[str, float] = {}
    held: list[str] = []
    for name, value in arguments:
        if name in cls.option_names():
            if re.fullmatch(r"[-+]?\d+", value.strip()) is None:
                raise AllanjaxError(f"{name} must be an integer, not {value!r}")
            values[name] = int(value)
            continue
        p = next((p for p in cls.parameters() if name in (p.name, p.symbol)), None)
        if p is None:
            names = [*(p.name for p in cls.parameters()), *cls.option_names()]
            raise AllanjaxError(f"{cls.name()} has no parameter {name!r}; it has {', '.join(names)}")
        values[p.name], is_held = _value(value, p, sensor)
        held += [p.name] if is_held else []
    made = cls().replace(**values)
    return made.hold(*held) if held else made


def _value(text: str, p: Parameter, sensor: Sensor | None) -> tuple[float, bool]:
    """Value of a parameter in SI, and whether it is held."""
    match = _VALUE.fullmatch(text.strip())
    if match is None:
        raise AllanjaxError(f"{p.name}: cannot read the value {text!r}; write a number and a unit")
    number, unit, held = float(match["number"]), match["unit"], match["held"] is not None
    if p.is_amplitude:
        return number * _amplitude_scale(unit, p, sensor), held
    si_unit = _KIND_UNIT.get(p.kind)
    if si_unit is None:
        if unit:
            raise UnitError(f"{p.name} is a plain number; leave out {unit!r}")
        return number, held
    return (convert(number, unit, si_unit) if unit else number), held


def _amplitude_scale(unit: str, p: Parameter, sensor: Sensor | None) -> float:
    """Factor from this unit to SI; UnitError if its dimension is not that of the amplitude."""
    sensors = SENSORS if sensor is None else (sensor,)
    usual = {s: default_coefficient_unit(s, p.time_exponent) for s in sensors}
    if not unit:
        raise UnitError(f"{p.name} ({p.symbol}) needs a unit, e.g. 0.1 {' or '.join(usual.values())}")
    problem = None
    for s, expected in usual.items():
        try:
            convert(1.0, unit, expected, s)
        except UnitError as error:
            problem = error
        else:
            return unit_scale(unit, s)
    raise UnitError(f"{p.name} ({p.symbol}): {problem}")


def model_of(models: Modelling, axis: Axis | str) -> Model:
    """Model of an axis, complete with values: its own, that of its sensor, or the one for all axes.

    Args:
        models: a model for all axes, or models by the names of axes or sensors, or a fit.
        axis: the axis; or only its name, if its sensor is unknown.

    Raises:
        AllanjaxError: there is no model for this axis; a parameter without a value.
    """
    own: Any = models
    name, sensors = (axis, []) if isinstance(axis, str) else (axis.name, [axis])
    if isinstance(models, Mapping):
        keys = [name, *(known.sensor for known in sensors)]
        own = next((models[key] for key in keys if key in models), None)
        if own is None:
            raise AllanjaxError(f"no noise model for {name}; there are models for {', '.join(models)}")
    # A fit of an axis has its model.
    fitted = getattr(own, "model", None)
    model = as_model(fitted if isinstance(fitted, Model) else own, sensors)
    model.check_complete()
    return model
