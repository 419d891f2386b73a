"""Simulated recordings: exact samples of a noise model; presets of the units that Hou (2004) tested."""

from __future__ import annotations

import dataclasses
import itertools
import math
import tomllib
from collections.abc import Mapping
from importlib.resources import files
from types import MappingProxyType
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError, RecordingError
from allanjax.base.normal import TWO_SIDED_68, TWO_SIDED_95
from allanjax.noise.datasheet import NOT_GIVEN, DataSheet
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model
from allanjax.noise.notation import ModelLike, as_model, term_classes
from allanjax.noise.terms import NoiseTerm
from allanjax.record.columns import recognise
from allanjax.record.recording import Axis, Recording
from allanjax.record.units import SENSORS as KINDS
from allanjax.record.units import SI, parse_sample_unit, unit_scale


def simulate(model: ModelLike, n: int, rate: float, key: PRNGKeyArray | int) -> Float[Array, " n"]:
    """Simulated samples of a model's rate [rad/s or m/s²], exact in law for a sensor that samples at `rate`.

    Compiled once for each combination of terms, n and rate; other coefficients reuse what was compiled. Terms
    that are not stationary (bias instability, rate random walk) start near zero.

    Args:
        model: the terms, every parameter with a value; or their text, `"N=0.1 deg/√h + B=2 deg/h"`.
        n: number of samples.
        rate: sample rate [Hz].
        key: a JAX random key or an integer seed.

    Raises:
        AllanjaxError: a parameter without a value, fewer than one sample, a rate that is not positive.
    """
    if n != int(n) or n < 1:
        raise AllanjaxError(f"the number of samples must be a positive integer, not {n}")
    if not 0.0 < rate < math.inf:
        raise AllanjaxError(f"the sample rate must be positive and finite, not {rate} Hz")
    if isinstance(model, DataSheet):
        raise AllanjaxError(
            'use simulate_recording for a data sheet; simulate takes one model, e.g. sheet["gyro"]'
        )
    model = as_model(model)
    model.check_complete()
    model = model.sampled(float(rate))
    # Python numbers would be constants of the compiled program. Infinite values select a term's formula.
    finite = {k: np.asarray(v, float) for k, v in model.values.items() if v is not None and np.isfinite(v)}
    return _draw(model.with_values(**finite), as_key(key), int(n), float(rate))


def simulate_recording(
    models: Mapping[str, ModelLike] | DataSheet,
    n: int,
    rate: float,
    key: PRNGKeyArray | int,
    *,
    bias: Mapping[str, float] | None = None,
    auxiliary: Mapping[str, Float[np.ndarray, " n"]] | None = None,
    gyro_unit: str = "deg/s",
    accel_unit: str = "m/s²",
    name: str = "",
) -> Recording:
    """Simulated recording of n samples, one column per model, the axes independent of each other.

    Args:
        models: model of each axis (`gyro_x`, `accel_z`, …), every parameter with a value; or a data sheet,
            with three axes for each sensor.
        n: number of samples.
        rate: sample rate [Hz].
        key: a JAX random key or an integer seed.
        bias: constant rate [rad/s or m/s²] to add to an axis, e.g. `{"accel_z": 9.81}`.
        auxiliary: channels of n samples by name, e.g. a temperature, that terms follow; without its channel
            an effect is left out, with a note in the recording.
        gyro_unit, accel_unit: units of the recording, for display.
        name: name of the recording.

    Raises:
        AllanjaxError: as `simulate`; a bias for an axis that is not simulated.
        RecordingError: a name that is no axis, fewer than 16 samples, or a channel of another length.
        UnitError: a unit that does not fit the sensor.
    """
    lacking: list[str] = []
    if isinstance(models, DataSheet):
        for sensor in models.models:
            absent = " and ".join(models.lacking(sensor))
            if absent:
                lacking.append(f"{sensor}: without {absent}, {NOT_GIVEN} by the data sheet")
        models = models.of_axes()
    if not models:
        raise AllanjaxError('no axis to simulate; give models, e.g. {"gyro_x": AngleRandomWalk(1e-4)}')
    bias = bias or {}
    for axis in bias:
        if axis not in models:
            raise AllanjaxError(
                f"the bias of {axis!r} has no model; there are models for {', '.join(models)}"
            )
    keys = jax.random.split(as_key(key), len(models))
    channels = {channel: np.asarray(samples, float) for channel, samples in (auxiliary or {}).items()}
    for channel, samples in channels.items():
        if samples.shape != (n,):
            raise RecordingError(
                f"the channel {channel!r} has the shape {samples.shape}; it must have ({n},), one value per "
                "simulated sample"
            )
    known = {axis: as_model(model, [recognise(axis)]).given(channels, rate) for axis, model in models.items()}
    columns = [
        np.asarray(simulate(model, n, rate, k)) + bias.get(axis, 0.0)
        for (axis, model), k in zip(known.items(), keys, strict=True)
    ]
    left_out = tuple(
        f"{axis}: the effect of {channel} is left out; pass auxiliary={{{channel!r}: …}} to include it"
        for axis, model in known.items()
        for term in model.terms
        if (channel := term.missing_channel)
    )
    recording = Recording.from_array(
        np.stack(columns, axis=1),
        rate,
        gyro_unit="rad/s",
        accel_unit="m/s²",
        names=list(models),
        auxiliary=channels,
        name=name,
    )
    own = {"gyro": gyro_unit, "accel": accel_unit}
    axes = (
        dataclasses.replace(axis, unit=parse_sample_unit(own[axis.sensor], axis.sensor).name)
        for axis in recording.axes
    )
    return dataclasses.replace(recording, axes=tuple(axes), notes=("simulated", *lacking, *left_out))


@eqx.filter_jit
def _draw(model: Model, key: PRNGKeyArray, n: int, rate: float) -> Float[Array, " n"]:
    """Simulated samples of the model, compiled once for each combination of terms, n and rate."""
    return model.simulate(key, n, rate)


def as_key(key: PRNGKeyArray | int) -> PRNGKeyArray:
    """JAX random key, as given or from a seed."""
    return jax.random.key(key) if isinstance(key, int | np.integer) else key


# Presets of the three units that Hou (2004) tested for two hours: tables 5.2, 5.4 and 5.5.


@dataclasses.dataclass(frozen=True)
class Tabulated:
    """Coefficient as the thesis prints it: value ± error by (4.66), and their unit."""

    value: float
    error: float
    unit: str

    @property
    def si(self) -> float:
        """Value in SI."""
        return self.value * unit_scale(self.unit)


@dataclasses.dataclass(frozen=True, eq=False)
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

    @property
    def estimates(self) -> dict[str, Estimate]:
        """The coefficients in SI by label, with the error in the thesis as standard deviation."""
        sensor: Any = self.name.partition("_")[0]
        axis, found = Axis(self.name, sensor, SI[sensor]["rate"]), {}
        amplitudes = (p for p in self.model.parameters if p.parameter.is_amplitude)
        for p, known in zip(amplitudes, self.coefficients.values(), strict=True):
            value, std = known.si, known.error * unit_scale(known.unit)
            outer, inner = (
                (max(value - z * std, 0.0), value + z * std) for z in (TWO_SIDED_95, TWO_SIDED_68)
            )
            found[p.label] = Estimate(
                axis=axis,
                label=p.label,
                value=value,
                std=std,
                interval=outer,
                interval_68=inner,
                parameter=p.parameter,
                term=p.term_label,
                usual_unit=known.unit,
            )
        return found

    def __repr__(self) -> str:
        values = (f"{term.name()} {c.value:g} {c.unit}" for term, c in self.coefficients.items())
        return f"<AxisPreset {self.name} at {self.rate:g} Hz: {', '.join(values)}>"


@dataclasses.dataclass(frozen=True, eq=False)
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
