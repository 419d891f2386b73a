"""Presets of the three units that Hou (2004) tested for two hours: tables 5.2, 5.4 and 5.5."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import jax
from jaxtyping import PRNGKeyArray

from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError
from allanjax.noise.model import Model
from allanjax.noise.simulate import as_key, simulate_recording
from allanjax.noise.terms import (
    AngleRandomWalk,
    BiasInstability,
    DriftRamp,
    NoiseTerm,
    Quantization,
    RateRandomWalk,
)
from allanjax.record.recording import Recording
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


# Unit, and value and error of the axes x, y, z.
_Row = tuple[str, tuple[float, float], tuple[float, float], tuple[float, float]]


def _axes(sensor: str, rate: float, table: Mapping[type[NoiseTerm], _Row]) -> tuple[AxisPreset, ...]:
    """Presets of the axes x, y, z of a sensor, from the row of each term in the thesis's table."""
    return tuple(
        AxisPreset(
            f"{sensor}_{axis}",
            rate,
            MappingProxyType({term: Tabulated(*pairs[k], unit) for term, (unit, *pairs) in table.items()}),
        )
        for k, axis in enumerate("xyz")
    )


#: The thesis's units by key: "cimu", "hg1700", "motionpak2".
SENSORS: Mapping[str, SensorPreset] = MappingProxyType(
    {
        "cimu": SensorPreset(
            "cimu",
            "Honeywell CIMU, navigation grade (table 5.2)",
            _axes(
                "gyro",
                200.0,
                {
                    Quantization: ("arcsec", (0.9732, 0.0738), (0.5174, 0.0197), (0.5770, 0.0155)),
                    AngleRandomWalk: ("deg/√h", (0.0015, 0.0005), (0.0019, 0.0006), (0.0018, 0.0006)),
                },
            )
            + _axes(
                "accel",
                200.0,
                {
                    Quantization: ("m/h", (1.6801, 0.1275), (1.2980, 0.0985), (0.8785, 0.0666)),
                    DriftRamp: ("m/s/h²", (2.6364, 0.8795), (0.8915, 0.2974), (0.3915, 0.1309)),
                },
            ),
        ),
        "hg1700": SensorPreset(
            "hg1700",
            "Honeywell HG1700, tactical grade (table 5.4)",
            _axes(
                "gyro",
                100.0,
                {
                    Quantization: ("arcsec", (5.1154, 0.0683), (1.2742, 0.0032), (1.2316, 0.0028)),
                    AngleRandomWalk: ("deg/√h", (0.0936, 0.0312), (0.0883, 0.0295), (0.0753, 0.0251)),
                },
            )
            + _axes(
                "accel",
                100.0,
                {
                    Quantization: ("m/h", (2.1188, 0.0673), (2.1988, 0.1176), (2.1845, 0.0583)),
                    RateRandomWalk: ("m/s/h/√h", (0.7637, 0.2548), (1.1572, 0.3860), (3.3514, 1.1180)),
                },
            ),
        ),
        "motionpak2": SensorPreset(
            "motionpak2",
            "Systron Donner MotionPak II-3g, consumer grade (table 5.5)",
            _axes(
                "gyro",
                100.0,
                {
                    AngleRandomWalk: ("deg/√h", (0.5121, 0.0068), (0.4859, 0.0065), (0.4891, 0.0065)),
                    BiasInstability: ("deg/h", (13.58, 1.36), (11.69, 1.17), (16.79, 1.68)),
                },
            )
            + _axes(
                "accel",
                1000.0,
                {
                    AngleRandomWalk: ("m/s/√h", (0.01664, 3e-5), (0.01593, 3e-5), (0.01612, 3e-5)),
                    BiasInstability: ("m/s/h", (4.36, 0.04), (4.09, 0.08), (4.36, 0.08)),
                },
            ),
        ),
    }
)
