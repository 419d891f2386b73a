"""Calibration of gyros and accelerometers by recordings at rest in several orientations."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from allanjax.base.earth import EARTH_RATE, GRAVITY_ANOMALY, normal_gravity
from allanjax.base.errors import AllanjaxError, RecordingError, expect
from allanjax.base.wording import duration, significant
from allanjax.calibration.result import (
    USEFUL,
    AxisCalibration,
    Calibration,
    Misfit,
    Orientation,
    OrientationLike,
    Position,
    as_orientation,
    orientation_in,
    place_of,
)
from allanjax.calibration.sensor_errors import Part, Setting, World, errors_of, parts_of_fit, parts_of_model
from allanjax.estimate.fit import fit as fit_noise
from allanjax.estimate.result import Fit
from allanjax.inspection import inspect
from allanjax.noise.notation import ModelLike, model_of
from allanjax.record.io.given import RecordingLike, as_recording
from allanjax.record.recording import Axis, Recording
from allanjax.record.units import SENSORS, Sensor, convert


def calibrate(
    positions: Mapping[str, RecordingLike] | Sequence[RecordingLike],
    orientations: Sequence[OrientationLike] | None = None,
    *,
    latitude: float | None = None,
    height: float = 0.0,
    gravity: float | Sequence[float] | None = None,
    model: ModelLike | Mapping[str, ModelLike] | None = None,
    fit: Fit | None = None,
    starts: Sequence[float] | None = None,
    second_order: bool = False,
    orientation_error: float = 0.0,
    as_is: bool = False,
    rate: float | None = None,
    gyro_unit: str | None = None,
    accel_unit: str | None = None,
    names: Sequence[str] | None = None,
) -> Calibration:
    """Biases, scale factors and misalignments from recordings at rest, as in a six-position test.

    The means of the positions are fitted to I = f + b + S·f + N·f + e (2.22, 2.23) by generalized least
    squares. The covariance of the means and the intervals follow from the phase covariance of the noise,
    including drift between positions; `AxisCalibration.widening` is the factor by which they are wider than
    for white noise alone. Two positions give the thesis's (2.32), (2.33), (2.36) and (2.37), where its "up"
    reads −g: here an axis that points up reads +g. The same position at two places of known gravity gives
    (2.27) to (2.29): the difference of the readings over that of gravity is the scale factor, free of the
    bias; what they add up to at either place is known far better than either of them.

    A bias is the level about which stationary noise scatters, averaged over the calibration if there is also
    noise without a mean. Axes are taken as independent.

    Args:
        positions: recordings by orientation, {"x up": recording, "x down": …}; or recordings (arrays, files).
        orientations: orientations of recordings in a sequence, see `as_orientation`; by default those in the
            names of the recordings ("imu_x_up", "down"). If no name has any, they are estimated, which takes
            three accelerometers and nine positions or more: the norm of the specific force is gravity. The
            axes of reference are then the sensor's: x is that of accel_x, and accel_y is in the x-y plane.
        latitude: latitude [deg], for normal gravity and the Earth's rate; gyros need it.
        height: height [m], for normal gravity.
        gravity: local gravity [m/s²] if it is known, one for each position if these are at several places;
            by default normal gravity, whose anomaly of 35 mGal (1σ) is part of the scale factors' intervals.
        model: noise model with values, or models by the names of axes or sensors.
        fit: fit of a long recording of the same sensor, which describes its drift best. Without model and
            fit, the longest of the positions is fitted, and the intervals are widened if the means scatter
            more than under that model.
        starts: start of each recording [s]; by default each follows the previous one immediately.
        second_order: whether accelerometers also have a part S2·f² (in (2.23) the square is missing).
        orientation_error: standard deviation [rad] of the given orientations, about each horizontal axis.
        as_is: whether to use entire recordings, even if they were handled.
        rate, gyro_unit, accel_unit, names: rate, units and names of arrays and files, as for `fit`.

    Raises:
        RecordingError: a recording cannot be read or was not at rest; recordings without a common axis;
            positions that do not determine the errors; up and down exchanged.
        FitError: no noise model from the recordings, or one with too little noise; orientations that could
            not be estimated.
        AllanjaxError: an unknown orientation; neither latitude nor gravity; starts that overlap; a model
            with a parameter without a value, or with a step or a warm-up, which are not noise.
    """
    expect(positions, (list, tuple, Mapping), "calibrate takes a list or a dictionary of recordings")
    if isinstance(positions, Mapping):
        orientations = list(positions) if orientations is None else orientations
        positions = list(positions.values())
    options = (rate, gyro_unit, accel_unit, names)
    given = [p if isinstance(p, Recording) else as_recording(p, *options) for p in positions]
    if not given:
        raise AllanjaxError('give recordings, e.g. {"x up": recording, "x down": other}')
    turned, world = _orientations(given, orientations), world_of(latitude, height, gravity)
    places, recordings, notes = _places(
        given, turned, world.gravity if gravity is None else gravity, starts, as_is
    )
    axes = _axes(recordings, turned, latitude, notes)
    parts, source = _noise(recordings, axes, model, fit, notes)
    results: list[AxisCalibration] = []
    misfit: dict[Sensor, Misfit] = {}
    for sensor in SENSORS:
        own = tuple(axis for axis in axes if axis.sensor == sensor)
        if own:
            square, unknown = second_order and sensor == "accel", model is None and fit is None
            setting = Setting(own, places, world, square, orientation_error, unknown)
            means = np.stack([r.select(*(a.name for a in own)).values.mean(axis=0) for r in recordings])
            own_results, misfit[sensor] = errors_of(setting, means, [parts[axis.name] for axis in own])
            results += own_results
    notes += _remarks(results, misfit, world)
    return Calibration(tuple(results), places, misfit, *world, source, tuple(notes))


def _places(
    recordings: Sequence[Recording],
    orientations: Sequence[Orientation | None],
    gravity: float | Sequence[float],
    starts: Sequence[float] | None,
    as_is: bool,
) -> tuple[tuple[Position, ...], list[Recording], list[str]]:
    """Positions and the part of each recording that was at rest, and notes on them."""
    begin, notes = _starts(recordings, starts)
    local = np.ravel(gravity).tolist()
    if len(local) not in (1, len(recordings)):
        raise AllanjaxError(
            f"{len(local)} values of gravity for {len(recordings)} recordings: give one for all, or one each"
        )
    local *= len(recordings) // len(local)
    places, kept = [], []
    for k, recording in enumerate(recordings):
        name = recording.name or f"position {k + 1}"
        look = inspect(recording, as_is=as_is)
        if look.refusal:
            raise RecordingError(f"{name}: {look.refusal}")
        first = 0.0
        if look.longest_part is not None:
            first, last = look.longest_part
            notes.append(f"{name}: {look.left_out}; {first:g} to {last:g} s are used")
        kept.append(look.quiet(recording))
        since = float(begin[k]) + first
        places.append(Position(name, orientations[k], since, kept[-1].duration, local[k]))
    return tuple(places), kept, notes


def _orientations(
    recordings: Sequence[Recording], given: Sequence[OrientationLike] | None
) -> list[Orientation | None]:
    """Orientation of each recording; None for all if no name has any."""
    if given is not None:
        if len(given) != len(recordings):
            raise AllanjaxError(
                f"{len(given)} orientations for {len(recordings)} recordings: give one for each"
            )
        return [as_orientation(o) for o in given]
    named = [orientation_in(r.name) for r in recordings]
    silent = [r.name or f"position {k + 1}" for k, r in enumerate(recordings) if named[k] is None]
    if silent and len(silent) < len(named):
        raise AllanjaxError(
            f"no orientation in the name of {', '.join(silent)}: give orientations=, or --position x+=FILE, "
            "or names such as imu_x_up"
        )
    return named


def _starts(recordings: Sequence[Recording], starts: Sequence[float] | None) -> tuple[np.ndarray, list[str]]:
    """Start of each recording [s], and what was assumed."""
    length = np.array([r.duration for r in recordings])
    if starts is None:
        note = "positions are assumed to follow each other at once (otherwise pass starts=, --starts)"
        return np.concatenate([[0.0], np.cumsum(length)[:-1]]), [note] if len(length) > 1 else []
    begin = np.array(starts, dtype=float)
    if begin.shape != length.shape or not np.isfinite(begin).all():
        raise AllanjaxError(f"{len(begin)} starts for {len(length)} recordings: give one per recording, in s")
    order = np.argsort(begin)
    late = (begin + length)[order][:-1] - begin[order][1:]
    if (late > 1e-6).any():
        k = int(order[int(late.argmax()) + 1])
        raise AllanjaxError(
            f"the recording that starts at {begin[k]:g} s overlaps the previous one: correct starts"
        )
    return begin - begin.min(), []


def world_of(latitude: float | None, height: float, gravity: float | Sequence[float] | None) -> World:
    """Gravity, of several places their mean, with its standard deviation; and latitude."""
    if gravity is not None:
        given = np.ravel(np.asarray(gravity, float))
        if not (given.size and ((given > 9.0) & (given < 10.0)).all()):
            raise AllanjaxError(f"gravity must be the local gravity in m/s², about 9.8, not {gravity}")
        return World(float(given.mean()), 0.0, latitude)
    if latitude is None:
        raise AllanjaxError(
            "calibration needs gravity: pass latitude= (--latitude) in deg and height, or the local gravity= "
            "(--gravity) in m/s²"
        )
    return World(normal_gravity(latitude, height), GRAVITY_ANOMALY, latitude)


def _axes(
    recordings: Sequence[Recording],
    orientations: Sequence[Orientation | None],
    latitude: float | None,
    notes: list[str],
) -> list[Axis]:
    """Axes that all recordings have and that can be calibrated; adds to the notes what is left out."""
    every = dict.fromkeys(axis.name for r in recordings for axis in r.axes)
    common = [axis for axis in recordings[0].axes if all(axis.name in r.names for r in recordings)]
    names = [axis.name for axis in common]
    notes += [f"{name} is left out: some recordings lack it" for name in every if name not in names]
    why = ""
    if orientations[0] is None:
        why = "they need orientations"
    elif latitude is None:
        why = "they need the latitude, for the Earth's rate"
    if why and any(axis.sensor == "gyro" for axis in common):
        notes.append(f"gyros are left out: {why}")
        common = [axis for axis in common if axis.sensor != "gyro"]
    if orientations[0] is None and len({place_of(a) for a in common if a.sensor == "accel"}) < 3:
        raise RecordingError(
            "orientations cannot be estimated without three accelerometers: give orientations="
        )
    for sensor in SENSORS:
        own = [a for a in common if a.sensor == sensor]
        if len({place_of(a) for a in own}) < len(own):
            raise RecordingError(f"the axes {', '.join(a.name for a in own)} must be named as x, y and z")
    if not common:
        raise RecordingError("; ".join(["no axis to calibrate", *notes]))
    return common


def _noise(
    recordings: Sequence[Recording],
    axes: Sequence[Axis],
    model: ModelLike | Mapping[str, ModelLike] | None,
    fit: Fit | None,
    notes: list[str],
) -> tuple[dict[str, tuple[Part, ...]], str]:
    """Noise of each axis, and its source; adds limitations to the notes."""
    if model is not None and fit is not None:
        raise AllanjaxError("give a model or a fit, not both")
    if model is not None:
        rate = recordings[0].rate
        return {a.name: parts_of_model(model_of(model, a), rate) for a in axes}, "given"
    source = f"the fit of {fit.name or 'a recording'}" if fit is not None else ""
    if fit is None:
        longest = max(recordings, key=lambda r: r.duration)
        fit = fit_noise(longest.select(*(a.name for a in axes)))
        source = f"fitted to the longest position, {longest.name or 'unnamed'}, {duration(longest.duration)}"
        if len(recordings) > 1:
            notes.append(
                "drift slower than the noise model's record is estimated from the scatter of the means only; "
                "for narrower intervals pass the fit of a long recording (fit=, --fit)"
            )
    notes += [f"{a.name}: {fit[a.name].verdict}" for a in axes if not fit[a.name].measured]
    return {a.name: parts_of_fit(fit, a.name) for a in axes}, source


def _remarks(results: Sequence[AxisCalibration], misfit: Mapping[Sensor, Misfit], world: World) -> list[str]:
    """Notes on excessive scatter, on gravity, and on what the Earth's rate does not determine."""
    notes = [
        f"{sensor}: the means scatter {significant(of.wider)} times as much as under this noise model; "
        "the intervals are widened accordingly, with Student's law"
        for sensor, of in misfit.items()
        if of.wider != 1.0
    ]
    if world.gravity_std and any(r.axis.sensor == "accel" for r in results):
        notes.append("normal gravity; its anomaly, 35 mGal (1σ), is part of the scale factors' intervals")
    notes += [
        f"{r.axis.name}: bias and scale factor are known only together and not applied, as the scale factor "
        f"is ± {significant(100.0 * r['scale_factor'].std, 2)} % (1σ); add a position the other way up"
        for r in results
        if r.axis.sensor == "accel" and r["scale_factor"].std > USEFUL
    ]
    gyros = [r for r in results if r.axis.sensor == "gyro"]
    if not gyros:
        return notes
    rate = convert(EARTH_RATE, "rad/s", "deg/h")
    notes.append("gyros: sensitivity to gravity would appear as scale factor and misalignment")
    known = {r.axis.name: {x for x, c in r.coefficients.items() if math.isfinite(c.value)} for r in gyros}
    aligned = [name for name, labels in known.items() if labels - {"bias"} == {"scale_factor"}]
    if aligned:
        notes.append(
            f"{', '.join(aligned)}: taken as aligned, since the positions do not determine misalignments; "
            f"a misalignment of 1 mrad would change the bias by up to {1e-3 * rate:.3f} deg/h"
        )
    scales = [c.std for r in gyros for label, c in r.coefficients.items() if label != "bias"]
    worst = max((s for s in scales if math.isfinite(s)), default=0.0)
    if worst > USEFUL:
        notes.append(
            f"gyros: the Earth's rate, {rate:.2f} deg/h, determines scale factors and misalignments only to "
            f"± {significant(100.0 * worst, 2)} % (1σ); those not known to 1 % are not applied. Better "
            "values need a rate table"
        )
    return notes
