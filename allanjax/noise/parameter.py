"""Parameters of noise terms: what each field of a term is, and how a term declares it."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, Literal, TypeAlias

import equinox as eqx

#: A parameter's value: a number, an array inside compiled functions, or None for "to be estimated".
Value: TypeAlias = Any


ParameterKind = Literal["amplitude", "time", "frequency", "line", "number"]


@dataclasses.dataclass(frozen=True)
class Parameter:
    """What one field of a noise term is.

    Attributes:
        name: the field's name.
        symbol: how the literature writes it, e.g. "N".
        kind: "amplitude" (G is proportional to its square; the first parameter of every term), "time" [s],
            "frequency" [Hz], "line" (the frequency [Hz] of a narrow feature, started at peaks of the
            spectrum) or "number" (dimensionless).
        time_exponent: of an amplitude, the p in its SI unit (rate)·s^p, rate being rad/s or m/s².
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
        """Whether it is a term's amplitude, not one of its shape parameters."""
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
