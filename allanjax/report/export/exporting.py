"""`export`: a fit as the file of a program that takes noise parameters."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from allanjax.base.errors import FitError
from allanjax.estimate.result import AxisFit, Fit
from allanjax.noise.datasheet import DataSheet
from allanjax.noise.estimate import Estimate
from allanjax.record.units import SENSORS, Sensor
from allanjax.report.export.assembly import (
    Axes,
    Exported,
    SensorNoise,
    assembled,
    checked_axes,
    checked_rate,
    rate_of_target,
)
from allanjax.report.export.table import TARGETS
from allanjax.report.export.targets import Target, target_of
from allanjax.report.export.values import Number, Quantities, of_sheet, quantities, usable_axes


def export(
    fit: Fit | DataSheet,
    target: str,
    *,
    axes: Axes | None = None,
    rate: float | None = None,
    force: bool = False,
    path: str | os.PathLike[str] | None = None,
) -> str:
    """The noise of a fitted sensor as the configuration of an estimator, autopilot or simulator.

    Every value has its formula, unit, the estimate with its 95 % interval and the source of the formula in a
    comment. What is not detected is exported as its 95 % limit, and says so; what the fit or the target
    cannot hold is said and left out. The text is ASCII; comments of JSON are in "_comment".

    Args:
        fit: the fit of a recording, from `fit` or `load`; or a data sheet, whose K, which data sheets do not
            have, is left out with the remedy.
        target: its name, e.g. "kalibr", "vins-mono", "gz-sim"; `allanjax export --list` lists all.
        axes: what becomes of several axes: "worst" is the largest value, "mean" the mean, "each" one for
            each axis, for targets that hold three; by default "each" for these and "worst" for others.
        rate: rate of the target's steps or samples [Hz]; by default that of the recording (of an autopilot
            that of its filter). A data sheet has none.
        force: whether to export what is not a measurement of the sensor, too.
        path: file to write the text to.

    Raises:
        AllanjaxError: there is no such target, it does not hold three values, or the rate is not positive.
        FitError: no axis has a result that is a measurement of the sensor.
    """
    text = exported(fit, target, axes=axes, rate=rate, force=force).text
    if path is not None:
        Path(path).write_text(text, encoding="ascii")
    return text


def exported(
    fit: Fit | DataSheet,
    target: str,
    *,
    axes: Axes | None = None,
    rate: float | None = None,
    force: bool = False,
) -> Exported:
    """What `export` writes, and what had to be left out of it."""
    to = target_of(target, TARGETS)
    checked_axes(to, axes)
    if isinstance(fit, DataSheet):
        of = {s: SensorNoise((s,), (of_sheet(fit, s),)) for s in fit.models}
        of = {s: of.get(s, SensorNoise((), ())) for s in SENSORS}
        head = f"{to.title}: noise of {fit.name or 'a sensor'} by its data sheet, not from a recording"
        source = [f"data sheet: {fit.source}"] if fit.source else []
        return assembled(to, of, axes, rate_of_target(to, rate, None), [head, *source, *fit.statements])
    r = checked_rate(rate if rate is not None else to.rate if to.rate is not None else fit.curve.rate)
    results = {sensor: usable_axes(fit, sensor, force) for sensor in SENSORS}
    if not any(usable for usable, _ in results.values()):
        why = "; ".join(text for _, wrong in results.values() for text in wrong)
        remedy = "; --force (force=True) exports it nevertheless" if fit.not_measured else ""
        raise FitError(f"{fit.name or 'the fit'}: no axis to export; {why or 'it has no axes'}{remedy}")
    duration = fit.curve.n / fit.curve.rate
    sensors = {
        sensor: SensorNoise(
            tuple(r.axis.name for r in usable),
            tuple(quantities(r, duration) for r in usable),
            tuple(wrong),
        )
        for sensor, (usable, wrong) in results.items()
    }
    size = f"{fit.curve.n:,} samples at {fit.curve.rate:g} Hz"
    head = (
        f"{to.title}: noise of {fit.name or 'a recording'} as fitted by allanjax ({size}), intervals of 95 %"
    )
    not_held = [
        text
        for sensor, (usable, _) in results.items()
        for text in _not_held(to, sensor, usable, sensors[sensor].axes)
    ]
    warnings = [f"WARNING: {text}" for text in fit.warnings]
    made = assembled(to, sensors, axes, r, [head, *warnings], not_held)
    return made._replace(left_out=(*fit.warnings, *made.left_out))


def _not_held(
    to: Target, sensor: Sensor, results: Sequence[AxisFit], axes: Sequence[Quantities]
) -> list[str]:
    """What was found in the axes of a sensor and the target cannot hold, in words."""
    symbols = {symbol for key in to.noise_keys if key.sensor == sensor for symbol in key.symbols}
    largest: dict[str, Estimate] = {}
    for result, of in zip(results, axes, strict=True):
        held = {number.label for x in symbols if isinstance(number := of[x], Number)}
        for c in result.coefficients.values():
            if not (c.is_amplitude and c.detected and c.value > 0.0) or c.label in held:
                continue
            if c.label not in largest or c.value > largest[c.label].value:
                largest[c.label] = c
    told = []
    for c in largest.values():
        walks = "; for less than its correlation time it walks as K = q_c does" if c.symbol == "q_c" else ""
        amount = c.in_unit().describe()
        told.append(f"NOT HELD by {to.title}: {c.title} {c.symbol} = {amount} of {c.axis.name}{walks}")
    corrected = [f"{r.axis.name}: {r.correction}" for r in results if r.correction]
    return told + [f"N is the density at low frequencies; NOT HELD: {text}" for text in corrected]
