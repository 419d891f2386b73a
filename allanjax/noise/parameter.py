"""Parameters of noise terms, and how a term declares them."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, Literal, TypeAlias

import equinox as eqx

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
    """

    name: str
    symbol: str
    kind: ParameterKind
    time_exponent: float
    lower: float
    upper: float

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
) -> Any:
    """Declare a parameter of a noise term (a dataclass field; see `Parameter` for the arguments).

    A parameter left at None is estimated from the data; one with a value is estimated with that value as a
    start, unless the term holds it (`NoiseTerm.hold`).
    """
    declared: dict[str, Any] = {"symbol": symbol, "kind": kind, "time_exponent": time_exponent}
    declared |= {"lower": lower, "upper": upper}
    return eqx.field(default=default, metadata={"parameter": declared})
