"""Sensors in one form, whatever is known of them: coefficients with uncertainty, noise models and curves."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from allanjax.allan.deviation import AllanDeviation
from allanjax.base.errors import AllanjaxError
from allanjax.comparison.specification import least_deviation
from allanjax.critic.result import Critique
from allanjax.estimate.as_json import load
from allanjax.estimate.fit import fit
from allanjax.estimate.result import Fit
from allanjax.navigation.likely import NoiseLike
from allanjax.noise.datasheet import LEAST, MINIMUM, DataSheet, datasheet, datasheets
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model
from allanjax.noise.simulate import SENSORS, SensorPreset
from allanjax.noise.terms import BiasInstability
from allanjax.record.io.given import RecordingLike, as_recording
from allanjax.record.recording import Axis
from allanjax.record.units import SI, unit_scale

#: What can be compared: fits, critiques, recordings, data sheets, presets, curves, and their files or names.
Comparable: TypeAlias = Fit | Critique | DataSheet | SensorPreset | AllanDeviation | RecordingLike


class Compared(NamedTuple):
    """A sensor of a comparison.

    Attributes:
        label: what it is called.
        source: what is known of it, in words.
        coefficients: estimates by axis and label [SI]; a data sheet has those of "gyro" and "accel". Beside
            the amplitudes it is the least Allan deviation, `LEAST`.
        noise: its noise, for the growth of errors; None if no axis is a measurement.
        models: noise model of each axis that has one.
        rate: sample rate [Hz].
        curve: measured Allan deviations, if there are any.
    """

    label: str
    source: str
    coefficients: Mapping[str, Mapping[str, Estimate]]
    noise: NoiseLike | None
    models: Mapping[str, Model]
    rate: float
    curve: AllanDeviation | None = None

    def of(self, axis: str) -> Mapping[str, Estimate]:
        """Coefficients of an axis, those of its sensor for a data sheet; empty if there are none."""
        return self.coefficients.get(axis) or self.coefficients.get(axis.partition("_")[0]) or {}

    def model(self, axis: str) -> Model | None:
        """Noise model of an axis, that of its sensor for a data sheet."""
        return self.models.get(axis) or self.models.get(axis.partition("_")[0])


def compared(data: Comparable, label: str = "") -> Compared:
    """A sensor in the form of comparisons; recordings are read and fitted.

    Raises:
        AllanjaxError: a name that is neither a file nor a data sheet nor a preset, or what `fit` raises.
    """
    data = _opened(data)
    if isinstance(data, DataSheet):
        values = {str(sensor): _with_least(data.coefficients(sensor)) for sensor in data.models}
        models = {str(sensor): model for sensor, model in data.models.items()}
        source = f"data sheet: {data.source}" if data.source else "data sheet"
        return Compared(label or data.name, source, values, data, models, 100.0)
    if isinstance(data, SensorPreset):
        return _of_preset(data, label)
    found = data if isinstance(data, Fit) else data.fit if isinstance(data, Critique) else fit(data)
    measured = {r.axis.name: r for r in found.results if r.measured}
    values = {name: {**r.coefficients, LEAST: least_deviation(found, r)[0]} for name, r in measured.items()}
    models = {name: r.model for name, r in measured.items()}
    noise, hours = (found if values else None), found.curve.n / found.curve.rate / 3600.0
    source = f"fit of {hours:.2g} h at {found.curve.rate:g} Hz"
    if not values:
        source += "; not a measurement of the sensor"
    return Compared(label or found.name, source, values, noise, models, found.curve.rate, found.curve)


def _of_preset(preset: SensorPreset, label: str) -> Compared:
    """A unit with the values and errors of its tables."""
    values = {}
    for axis in preset.axes:
        own = Axis(axis.name, axis.name.partition("_")[0], SI[axis.name.partition("_")[0]]["rate"])  # type: ignore[arg-type, index]
        parameters = {p.label: p for p in axis.model.parameters if p.parameter.is_amplitude}
        pairs = zip(parameters.items(), axis.coefficients.values(), strict=True)
        values[axis.name] = _with_least(
            {label: _tabulated(own, label, p, known) for (label, p), known in pairs}
        )
    models = {axis.name: axis.model for axis in preset.axes}
    rate = preset.axes[0].rate
    return Compared(label or preset.name, preset.description, values, models, models, rate)


def _tabulated(axis: Axis, label: str, parameter: Any, known: Any) -> Estimate:
    """A coefficient of a table with its error as the standard deviation."""
    value, std = known.si, known.error * unit_scale(known.unit)
    ends = {share: (max(value - share * std, 0.0), value + share * std) for share in (1.96, 0.994)}
    about: dict[str, Any] = {"axis": axis, "label": label, "parameter": parameter.parameter}
    about |= {"term": parameter.term_label, "usual_unit": known.unit}
    return Estimate(value=value, std=std, interval=ends[1.96], interval_68=ends[0.994], **about)


def _with_least(coefficients: dict[str, Estimate]) -> dict[str, Estimate]:
    """Coefficients with the least Allan deviation that follows from bias instability, 0.664 B."""
    if (c := coefficients.get(BiasInstability.name())) is None:
        return coefficients
    least = dataclasses.replace(c.times(MINIMUM), label=LEAST, parameter=None, unit=c.unit)
    return coefficients | {LEAST: least}


def _opened(data: Comparable) -> Any:
    """What a path or a name stands for; anything else is returned as it is."""
    if not isinstance(data, str | os.PathLike):
        return (
            data
            if isinstance(data, Fit | Critique | DataSheet | SensorPreset | AllanDeviation)
            else as_recording(data)
        )
    path, name = Path(data), str(data)
    if path.exists() and path.suffix == ".json":
        found = load(path)
        if isinstance(found, Fit):
            return found
        raise AllanjaxError(f"{path}: has {len(found)} fits ({', '.join(found)}); give files with one each")
    if path.exists() and path.suffix == ".toml":
        return datasheet(path)
    if path.exists():
        return as_recording(path)
    if name in SENSORS:
        return SENSORS[name]
    if path.suffix:
        raise AllanjaxError(f"{name}: no such file; check the path")
    try:
        return datasheet(name)
    except AllanjaxError as error:
        presets = f"presets are {', '.join(SENSORS)}; data sheets are {', '.join(datasheets())}"
        raise AllanjaxError(f"{name!r} is neither a file nor a known sensor; {presets}") from error
