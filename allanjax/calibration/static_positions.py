"""Calibration of gyros and accelerometers by recordings at rest in several orientations."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from allanjax.base.earth import EARTH_RATE, GRAVITY_ANOMALY, normal_gravity
from allanjax.base.errors import AllanjaxError, RecordingError
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
from allanjax.calibration.sensor_errors import (
    Covariances,
    Part,
    Setting,
    World,
    errors_of,
    parts_of_fit,
    parts_of_model,
)
from allanjax.estimate.fit import fit as fit_noise
from allanjax.estimate.result import Fit
from allanjax.inspection import inspect
from allanjax.noise.notation import ModelLike, as_model
from allanjax.record.io.given import RecordingLike, as_recording
from allanjax.record.recording import Axis, Recording
from allanjax.record.units import SENSORS, Sensor, convert


def calibrate(
    positions: Mapping[str, RecordingLike] | Sequence[RecordingLike],
    orientations: Sequence[OrientationLike] | None = None,
    *,
    latitude: float | None = None,
    height: float = 0.0,
    gravity: float | None = None,
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
    squares. The covariance of the means follows from the phase covariance of the noise, for drift also
    between positions, and so do the intervals; `AxisCalibration.widening` says how much wider they are than
    white noise alone would make them. Two positions give the thesis's (2.32), (2.33), (2.36) and (2.37),
    where its "up" reads −g: here an axis that points up reads +g.

    A bias is the level about which stationary noise scatters, averaged over the calibration if there is also
    noise without a mean. Axes are taken to be independent of each other.

    Args:
        positions: recordings by orientation, {"x up": recording, "x down": …}; or recordings (arrays, files).
        orientations: of recordings in a sequence, see `as_orientation`. Without them, by the names of the
            recordings ("imu_x_up", "down"); if no name tells any, they are free and estimated, which three
            accelerometers can be from nine positions or more: the norm of the specific force is gravity. The
            axes of reference are then the sensor's: x is that of accel_x, and accel_y is in the x-y plane.
        latitude: latitude [deg], for normal gravity and, needed for gyros, for the Earth's rate.
        height: height [m], for normal gravity.
        gravity: local gravity [m/s²], if it is known; else normal gravity, whose anomaly of 35 mGal (1 σ) is
            part of the scale factors' intervals.
        model: noise model with values, or one for each axis or sensor by name.
        fit: fit of a long recording of the same sensor, which knows the drift best. Without either, the
            longest of the positions is fitted, and where the means scatter more than it says, the intervals
            are as much wider.
        starts: when each recording starts [s]; without, each follows the one before it at once.
        second_order: whether accelerometers have a part S2·f², too (in (2.23) the square is missing).
        orientation_error: standard deviation [rad] of the orientations given, about each horizontal axis.
        as_is: whether to use all of a recording, also where it was handled.
        rate, gyro_unit, accel_unit, names: of arrays and files, as `fit` takes them.

    Raises:
        RecordingError: a recording that cannot be read or was not at rest; recordings without a common axis;
            positions that do not span; up and down exchanged.
        FitError: no noise model from the recordings; orientations that could not be estimated.
        AllanjaxError: an orientation that is none; neither latitude nor gravity; starts that overlap.
    """
    if isinstance(positions, Mapping):
        orientations = list(positions) if orientations is None else orientations
        positions = list(positions.values())
    options = (rate, gyro_unit, accel_unit, names)
    given = [p if isinstance(p, Recording) else as_recording(p, *options) for p in positions]
    if not given:
        raise AllanjaxError('give recordings, e.g. {"x up": recording, "x down": other}')
    turned, world = _orientations(given, orientations), _world(latitude, height, gravity)
    places, recordings, notes = _places(given, turned, starts, as_is)
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
            noise = Covariances.of(places, [parts[axis.name] for axis in own])
            found, misfit[sensor] = errors_of(setting, means, noise)
            results += found
            notes += _scatter(sensor, misfit[sensor])
    notes += _remarks(results, world)
    return Calibration(tuple(results), places, misfit, *world, source, tuple(notes))


def _places(
    recordings: Sequence[Recording],
    orientations: Sequence[Orientation | None],
    starts: Sequence[float] | None,
    as_is: bool,
) -> tuple[tuple[Position, ...], list[Recording], list[str]]:
    """Positions and the part of each recording that was at rest, and notes on them."""
    begin, notes = _starts(recordings, starts)
    places, kept = [], []
    for k, recording in enumerate(recordings):
        name = recording.name or f"position {k + 1}"
        seen = inspect(recording, as_is=as_is)
        if seen.refusal:
            raise RecordingError(f"{name}: {seen.refusal}")
        first = 0.0
        if seen.stretch is not None:
            first, last = seen.stretch
            notes.append(f"{name}: {seen.left_out}; {first:g} to {last:g} s used")
        kept.append(seen.quiet(recording))
        places.append(Position(name, orientations[k], float(begin[k]) + first, kept[-1].duration))
    return tuple(places), kept, notes


def _orientations(
    recordings: Sequence[Recording], given: Sequence[OrientationLike] | None
) -> list[Orientation | None]:
    """Orientation of each recording; None for all if nothing tells any."""
    if given is not None:
        if len(given) != len(recordings):
            raise AllanjaxError(f"{len(given)} orientations for {len(recordings)} recordings: give one each")
        return [as_orientation(o) for o in given]
    found = [orientation_in(r.name) for r in recordings]
    silent = [r.name or f"position {k + 1}" for k, r in enumerate(recordings) if found[k] is None]
    if silent and len(silent) < len(found):
        raise AllanjaxError(
            f"no orientation in the name of {', '.join(silent)}: give orientations=, or --position x+=FILE, "
            "or names such as imu_x_up"
        )
    return found


def _starts(recordings: Sequence[Recording], starts: Sequence[float] | None) -> tuple[np.ndarray, list[str]]:
    """Start of each recording [s], and what was assumed."""
    length = np.array([r.duration for r in recordings])
    if starts is None:
        note = "positions taken to follow each other at once, in the order given (starts=, --starts)"
        return np.concatenate([[0.0], np.cumsum(length)[:-1]]), [note] if len(length) > 1 else []
    begin = np.array(starts, dtype=float)
    if begin.shape != length.shape or not np.isfinite(begin).all():
        raise AllanjaxError(f"{len(begin)} starts for {len(length)} recordings: give one each, in s")
    order = np.argsort(begin)
    late = (begin + length)[order][:-1] - begin[order][1:]
    if (late > 1e-6).any():
        k = int(order[int(late.argmax()) + 1])
        raise AllanjaxError(
            f"the recording that starts at {begin[k]:g} s does so before the former ends: correct starts"
        )
    return begin - begin.min(), []


def _world(latitude: float | None, height: float, gravity: float | None) -> World:
    """Gravity with its standard deviation, and latitude."""
    if gravity is not None:
        if not 9.0 < gravity < 10.0:
            raise AllanjaxError(f"gravity must be the local one in m/s², about 9.8, not {gravity}")
        return World(gravity, 0.0, latitude)
    if latitude is None:
        raise AllanjaxError(
            "calibration needs gravity: give the latitude in deg, latitude= (--latitude), and height, or the "
            "local gravity in m/s², gravity= (--gravity)"
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
    notes += [f"{name} left out: not in each recording" for name in every if name not in names]
    why = ""
    if orientations[0] is None:
        why = "orientations are not known"
    elif latitude is None:
        why = "the Earth's rate needs the latitude"
    if why and any(axis.sensor == "gyro" for axis in common):
        notes.append(f"gyros left out: {why}")
        common = [axis for axis in common if axis.sensor != "gyro"]
    if orientations[0] is None and len({place_of(a) for a in common if a.sensor == "accel"}) < 3:
        raise RecordingError("orientations can be left out for three accelerometers only: give orientations=")
    for sensor in SENSORS:
        own = [a for a in common if a.sensor == sensor]
        if len({place_of(a) for a in own}) < len(own):
            raise RecordingError(f"{', '.join(a.name for a in own)} are not x, y and z: name them so")
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
    """Noise of each axis, and where it comes from; adds to the notes what to bear in mind."""
    if model is not None and fit is not None:
        raise AllanjaxError("give a model or a fit, not both")
    if model is not None:
        chosen = {a.name: _model_of(model, a) for a in axes}
        parts = {a.name: parts_of_model(as_model(chosen[a.name], [a]), recordings[0].rate) for a in axes}
        return parts, "given"
    source = f"the fit of {fit.name or 'a recording'}" if fit is not None else ""
    if fit is None:
        longest = max(recordings, key=lambda r: r.duration)
        fit = fit_noise(longest.select(*(a.name for a in axes)))
        source = f"fitted to the longest position, {longest.name or 'unnamed'}, {duration(longest.duration)}"
        if len(recordings) > 1:
            notes.append(
                "drift that is slower than the noise model's record is told from the scatter of the means "
                "alone: give the fit of a long recording (fit=, --fit) for narrower intervals"
            )
    notes += [f"{a.name}: {fit[a.name].verdict}" for a in axes if not fit[a.name].measured]
    return {a.name: parts_of_fit(fit, a.name) for a in axes}, source


def _model_of(model: ModelLike | Mapping[str, ModelLike], axis: Axis) -> ModelLike:
    if not isinstance(model, Mapping):
        return model
    found = model.get(axis.name, model.get(axis.sensor))
    if found is None:
        raise AllanjaxError(
            f"no noise model for {axis.name}: add it to model= by {axis.name!r} or {axis.sensor!r}"
        )
    return found


def _scatter(sensor: Sensor, misfit: Misfit) -> list[str]:
    """Note that the means scatter more than a noise model says that may lack drift, if they do."""
    if misfit.wider == 1.0:
        return []
    return [
        f"{sensor}: the means scatter {significant(misfit.wider)} times as much as this noise model says: "
        "the intervals are as much wider, and follow Student's law"
    ]


def _remarks(results: Sequence[AxisCalibration], world: World) -> list[str]:
    """What a user should know of gravity, and of what the Earth's rate does not tell of gyros."""
    notes = []
    if world.gravity_std and any(r.axis.sensor == "accel" for r in results):
        notes.append("normal gravity; its anomaly, 35 mGal (1 σ), is part of the scale factors' intervals")
    gyros = [r for r in results if r.axis.sensor == "gyro"]
    if not gyros:
        return notes
    rate = convert(EARTH_RATE, "rad/s", "deg/h")
    notes.append("gyros: a sensitivity to gravity would show as scale factor and misalignment")
    aligned = [r.axis.name for r in gyros if _as_if_aligned(r)]
    if aligned:
        notes.append(
            f"{', '.join(aligned)}: as if aligned, for a misalignment of 1 mrad makes a bias of up to "
            f"{1e-3 * rate:.3f} deg/h; the positions, with headings ('x up, y north') or without, do not tell"
        )
    scales = [c.std for r in gyros for label, c in r.coefficients.items() if label != "bias"]
    worst = max((s for s in scales if math.isfinite(s)), default=0.0)
    if worst > USEFUL:
        notes.append(
            f"gyros: the Earth's rate, {rate:.2f} deg/h, tells scale factors and misalignments to ± "
            f"{significant(100.0 * worst, 2)} % (1 σ) only; what is known to no better than 1 % is not "
            "applied. It takes a rate table"
        )
    return notes


def _as_if_aligned(result: AxisCalibration) -> bool:
    """Whether an axis has a scale factor and none of its misalignments is determined."""
    known = {label: math.isfinite(c.value) for label, c in result.coefficients.items()}
    return known.pop("scale_factor") and not any(found for label, found in known.items() if label != "bias")
