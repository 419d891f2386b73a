"""Parameters of noise terms and responses, and how these declare them."""

from __future__ import annotations

import dataclasses
import functools
import math
import re
from typing import Any, Literal, Self, TypeAlias

import equinox as eqx
import numpy as np

from allanjax.base.errors import AllanjaxError
from allanjax.base.module import Module

#: A parameter's value: a number, an array inside compiled functions, or None for "to be estimated".
Value: TypeAlias = Any


#: Kinds of parameters, explained at `Parameter`.
ParameterKind = Literal["amplitude", "time", "frequency", "line", "number"]


@dataclasses.dataclass(frozen=True)
class Parameter:
    """Parameter of a noise term: one field of its class.

    Attributes:
        name: name of the field.
        symbol: symbol in the literature, e.g. "N".
        kind: "amplitude" (G is proportional to its square; the first parameter of every term), "time" [s],
            "frequency" [Hz], "line" (the frequency [Hz] of a narrow feature, started at peaks of the
            spectrum) or "number" (dimensionless).
        time_exponent: p in the SI unit (rate)·s^p of an amplitude, rate being rad/s or m/s².
        lower, upper: the open bounds of the admissible values.
        starts: values to start a fit from, in sample rates, of a frequency; none for the usual grid.
    """

    name: str
    symbol: str
    kind: ParameterKind
    time_exponent: float
    lower: float
    upper: float
    starts: tuple[float, ...] = ()

    @property
    def is_amplitude(self) -> bool:
        """Whether this is a term's amplitude, not one of its shape parameters."""
        return self.kind == "amplitude"


def parameter(
    symbol: str,
    kind: ParameterKind = "amplitude",
    *,
    time_exponent: float = 0.0,
    lower: float = 0.0,
    upper: float = math.inf,
    default: float | None = None,
    starts: tuple[float, ...] = (),
) -> Any:
    """Declare a parameter of a noise term (a dataclass field; see `Parameter` for the arguments).

    A parameter left at None is estimated from the data; one with a value is estimated with that value as a
    start, unless the term holds it (`NoiseTerm.hold`).
    """
    declared: dict[str, Any] = {"symbol": symbol, "kind": kind, "time_exponent": time_exponent}
    declared |= {"lower": lower, "upper": upper, "starts": starts}
    return eqx.field(default=default, metadata={"parameter": declared})


def option(default: int, most: int | None = None) -> Any:
    """Declare a whole number that the user chooses, e.g. an order, from 1 to `most` (a dataclass field)."""
    return eqx.field(default=default, static=True, metadata={"option": most})


class Parametrized(Module):
    """What has parameters that are declared as fields: a noise term, or a response."""

    held: frozenset[str] = eqx.field(static=True, default=frozenset(), kw_only=True)

    @classmethod
    @functools.cache
    def parameters(cls) -> tuple[Parameter, ...]:
        """Declared parameters, in order."""
        fields = ((field.name, field.metadata.get("parameter")) for field in dataclasses.fields(cls))
        return tuple(Parameter(name, **declared) for name, declared in fields if declared is not None)

    @classmethod
    def option_names(cls) -> tuple[str, ...]:
        """Names of the declared options, in order."""
        return tuple(field.name for field in dataclasses.fields(cls) if "option" in field.metadata)

    @property
    def options(self) -> dict[str, int]:
        """Values of the options by name."""
        return {name: getattr(self, name) for name in self.option_names()}

    @classmethod
    def name(cls) -> str:
        """Name of the class, e.g. "bias_instability"."""
        return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", cls.__name__).lower()

    def is_free(self, p: Parameter) -> bool:
        """Whether a fit estimates this parameter. An infinite value is a limit, never a start."""
        value = getattr(self, p.name)
        infinite = isinstance(value, float) and math.isinf(value)
        return p.name not in self.held and not infinite

    def hold(self, *names: str, **values: float) -> Self:
        """A copy whose named parameters a fit leaves alone, e.g. `Markov().hold(correlation_time=100.0)`."""
        known = [p.name for p in self.parameters()]
        for name in (*names, *values):
            if name not in known:
                raise AllanjaxError(f"{self.name()} has no parameter {name!r}; it has {', '.join(known)}")
        held = self.held | set(names) | set(values)
        copy = dataclasses.replace(self, **values, held=held)
        unset = [name for name in held if getattr(copy, name) is None]
        if unset:
            raise AllanjaxError(f"{self.name()}: cannot hold {unset[0]} without a value; give {unset[0]}=…")
        return copy

    def replace(self, **values: Any) -> Self:
        """A copy with these parameter values."""
        return dataclasses.replace(self, **values)

    def __repr__(self) -> str:
        """Python expression with values in SI, e.g. `Markov(correlation_time=3).hold("correlation_time")`."""
        usual = {field.name: field.default for field in dataclasses.fields(self)}
        shown = {p.name: _shown(getattr(self, p.name)) for p in self.parameters()}
        names = [name for name, text in shown.items() if text != _shown(usual[name])]
        values = [f"{name}={shown[name]}" for name in names]
        values += [f"{name}={x}" for name, x in self.options.items() if x != usual[name]]
        arguments = ", ".join(values).removeprefix("coefficient=")
        held = ", ".join(f'"{name}"' for name in names if name in self.held)
        return f"{type(self).__name__}({arguments})" + (f".hold({held})" if held else "")

    def __check_init__(self) -> None:
        for p in self.parameters():
            value = getattr(self, p.name)
            if isinstance(value, int | float | np.floating):
                bound = ""
                if not (value >= 0 if p.is_amplitude else value > p.lower):
                    bound = "≥ 0" if p.is_amplitude else f"> {p.lower:g}"
                # Infinity is a valid limit of some parameters, e.g. of a cutoff.
                elif value >= p.upper < math.inf:
                    bound = f"< {p.upper:g}"
                if bound:
                    raise AllanjaxError(f"{self.name()}: {p.name} must be {bound}, not {value!r}")
        for name, value in self.options.items():
            most = type(self).__dataclass_fields__[name].metadata["option"]
            if most and not (isinstance(value, int) and 1 <= value <= most):
                raise AllanjaxError(f"{self.name()}: {name} must be from 1 to {most}, not {value!r}")


def _shown(value: Value) -> str:
    """Value to six digits; an array inside a compiled function as JAX prints it."""
    return f"{value:.6g}" if isinstance(value, int | float | np.floating) else str(value)
