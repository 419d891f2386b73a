"""Presets of the three units that Hou (2004) tested for two hours: tables 5.2, 5.4 and 5.5."""

from __future__ import annotations

import itertools
import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from types import MappingProxyType
from typing import Any

import jax
from jaxtyping import PRNGKeyArray

from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError
from allanjax.noise.model import Model
from allanjax.noise.notation import term_classes
from allanjax.noise.simulate import as_key, simulate_recording
from allanjax.noise.terms import NoiseTerm
from allanjax.record.recording import Recording
from allanjax.record.units import SENSORS as KINDS
from allanjax.record.units import unit_scale


@dataclass(frozen=True)
class Tabulated:
    """Coefficient as the thesis prints it: value ± error by (4.66), and their unit."""

    value: float
    error: float
    unit: str

    @property
    def si(self) -> float:
        """Value in SI."""
        return self.value * unit_scale(self.unit)


@dataclass(frozen=True, eq=False)
class AxisPreset(ByValue):
    """Coefficients of one axis of a tested unit.

    Attributes:
        name: name of the axis, e.g. `gyro_x`.
        rate: sample rate [Hz].
        coefficients: one for each term that was identified, by the term's class.
    """

    name: str
    rate: float
    coefficients: Mapping[type[NoiseTerm], Tabulated]

    @property
    def model(self) -> Model:
        """Noise model of the axis: the sum of the identified terms."""
        amplitudes = ((term, term.amplitude_parameter().name, c.si) for term, c in self.coefficients.items())
        return Model(tuple(term().replace(**{name: value}) for term, name, value in amplitudes))

    def __repr__(self) -> str:
        values = (f"{term.name()} {c.value:g} {c.unit}" for term, c in self.coefficients.items())
        return f"<AxisPreset {self.name} at {self.rate:g} Hz: {', '.join(values)}>"


@dataclass(frozen=True, eq=False)
class SensorPreset(ByValue):
    """Tested inertial measurement unit.

    Attributes:
        name: key in `SENSORS`.
        description: maker, type, grade.
        axes: its six axes.
    """

    name: str
    description: str
    axes: tuple[AxisPreset, ...]

    def __repr__(self) -> str:
        axes = ", ".join(axis.name for axis in self.axes)
        return f"<SensorPreset {self.name}: {self.description}; {axes}>"

    def __getitem__(self, axis: str) -> AxisPreset:
        """Preset of the axis of this name; AllanjaxError if there is none."""
        for preset in self.axes:
            if preset.name == axis:
                return preset
        raise AllanjaxError(
            f"{self.name} has no axis {axis!r}; it has {', '.join(preset.name for preset in self.axes)}"
        )

    def model(self, axis: str) -> Model:
        """Noise model of an axis."""
        return self[axis].model

    def rate(self, axis: str) -> float:
        """Sample rate of an axis [Hz]."""
        return self[axis].rate

    def simulate(self, duration: float, key: PRNGKeyArray | int) -> tuple[Recording, ...]:
        """Simulated recordings of this many seconds, one for each sample rate.

        Raises:
            AllanjaxError: a duration that is not positive.
            RecordingError: fewer than 16 samples.
        """
        if not 0.0 < duration < math.inf:
            raise AllanjaxError(f"the duration must be positive and finite, not {duration} s")
        rates = list(dict.fromkeys(axis.rate for axis in self.axes))
        return tuple(
            simulate_recording(
                {axis.name: axis.model for axis in self.axes if axis.rate == rate},
                round(duration * rate),
                rate,
                k,
                name=self.name,
            )
            for rate, k in zip(rates, jax.random.split(as_key(key), len(rates)), strict=True)
        )


def _preset(name: str, table: Mapping[str, Any]) -> SensorPreset:
    """Preset of a unit, from its table in `sensors.toml`."""
    classes = term_classes()
    axes = []
    for sensor, k in itertools.product(KINDS, range(3)):
        rows = ((classes[term], row[0], row[1 + k]) for term, row in table[sensor].items())
        tabulated = {term: Tabulated(value, error, unit) for term, unit, (value, error) in rows}
        axes.append(AxisPreset(f"{sensor}_{'xyz'[k]}", table["rate"][sensor], MappingProxyType(tabulated)))
    return SensorPreset(name, table["description"], tuple(axes))


_TABLES = tomllib.loads(files(__package__).joinpath("sensors.toml").read_text(encoding="utf-8"))
#: The thesis's units by key: "cimu", "hg1700", "motionpak2".
SENSORS: Mapping[str, SensorPreset] = MappingProxyType(
    {name: _preset(name, table) for name, table in _TABLES.items()}
)
