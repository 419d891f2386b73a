"""Errors of the axes of one sensor from their means in several orientations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import stdtrit

from allanjax.base.chi_squared import upper_tail
from allanjax.base.earth import EARTH_RATE
from allanjax.base.errors import AllanjaxError, FitError, RecordingError
from allanjax.base.normal import TWO_SIDED_68, TWO_SIDED_95
from allanjax.calibration.result import (
    AxisCalibration,
    Misfit,
    Orientation,
    Position,
    Triad,
    estimate,
    place_of,
    six_positions,
)
from allanjax.estimate.result import Fit
from allanjax.noise.model import Model
from allanjax.noise.process import Process
from allanjax.noise.terms import AngleRandomWalk
from allanjax.noise.terms.deterministic import Transient
from allanjax.record.recording import Axis
from allanjax.record.units import Sensor

# Least singular value, relative to the largest, of a direction that the positions determine: for known
# orientations, beyond rounding; for estimated ones, beyond what errors of scale and alignment may simulate.
KNOWN, FREE = 1e-6, 2e-2
# Part of a parameter in undetermined directions above which it counts as undetermined itself.
_PART = 1e-6
_ITERATIONS = 50

# Covariance of the means of segments of a record, from the phase covariance G(t) of its noise.
#
# The mean over a segment is the difference of the phase at its ends, over its length. So the covariance of
# two means is a second difference of G, however far apart they are.
#
# Stationary noise has mean zero: the bias is the level about which it scatters. Other noise (flicker noise,
# random walks, ramps) moves the bias: then the bias is the average over the entire calibration, and the
# deviations of the means from that average count.

_DRAWS = 400
# The PSD of a stationary process is level at low frequencies; that of flicker noise grows fourfold in two
# octaves.
_GROWTH = 2.0
# Lag, in lengths of the record, at which G of a stationary process has no part that grows with its square.
_FAR = 1e6


#: A factor of the power of a process, and the process.
Part: TypeAlias = tuple[float, Process]


def parts_of_model(model: Model, rate: float) -> tuple[Part, ...]:
    """The terms of a model at a sample rate [Hz]."""
    model.check_complete()
    for term in model.terms:
        if isinstance(term, Transient):
            raise AllanjaxError(f"{term.name()} is not noise: leave out that part of the data, and the term")
    return tuple((1.0, process) for process in model.sampled(rate).processes)


def parts_of_fit(fit: Fit, axis: str) -> tuple[Part, ...]:
    """The terms of an axis's fit, with their powers averaged over intervals and likely sets of terms."""
    likely = fit.stated(axis).together(_DRAWS)
    parts = [part for term in likely.terms for part in parts_of_model(term, fit.curve.rate)]
    known = np.flatnonzero(likely.detected).tolist()
    return tuple((float(likely.power[:, k].mean()), parts[k][1]) for k in known)


def covariance_of_means(
    parts: Sequence[Part], start: Float[np.ndarray, " k"], length: Float[np.ndarray, " k"]
) -> Float[np.ndarray, "k k"]:
    """Covariance [rate²] of the noise of means over segments with these starts and lengths [s].

    For processes that are not stationary it is that of the deviations from the mean over the entire time.
    """
    begin, end = start.min(), (start + length).max()
    # The last segment is the entire time.
    edges = np.stack([np.append(start, begin), np.append(start + length, end)])
    size = edges[1] - edges[0]
    total = np.zeros((len(start), len(start)))
    for power, process in parts:
        # All lags and the far one in one call, since G is known up to c0 + c1·t² that each call may choose.
        lags = np.abs(edges[:, None, :, None] - edges[None, :, None, :])
        far = _FAR * (end - begin)
        G = np.asarray(process.phase_covariance(np.append(lags.ravel(), far)))  # type: ignore[arg-type]
        low, high = np.asarray(process.psd(np.array([0.25e-5, 1e-5]) / (end - begin)))
        stationary = not low > _GROWTH * high
        curvature = G[-1] / far**2 if stationary else 0.0
        at = G[:-1].reshape(lags.shape) - curvature * lags**2
        C = (at[0, 0] + at[1, 1] - at[0, 1] - at[1, 0]) / np.outer(size, size)
        if not stationary:
            C = C - C[:, -1:] - C[-1:, :] + C[-1, -1]
        total += power * C[:-1, :-1]
    return total


def white_covariance(parts: Sequence[Part], length: Float[np.ndarray, " k"]) -> Float[np.ndarray, "k k"]:
    """The part of the white noise in `covariance_of_means` [rate²]: N²/T on the diagonal."""
    # A filtered process holds the one before its filter.
    white = [of for of in parts if isinstance(getattr(of[1], "process", of[1]), AngleRandomWalk)]
    return covariance_of_means(white, np.zeros(len(length)), length) * np.eye(len(length))


_QUANTILES = (TWO_SIDED_95, TWO_SIDED_68)
# Below this p-value the positions that fit worst are named.
_DOUBT = 1e-3
# Positions whose omission lowers χ² equally, to within this share, cannot be distinguished.
_TIE = 0.02
# An axis is vertical if the cosine of its tilt is one to within this.
_VERTICAL = 1e-6


class Solution(NamedTuple):
    """Parameters with their covariance.

    Attributes:
        values: the parameters; meaningless where not determined.
        covariance: covariance of the parameters.
        determined: which of them the observations determine.
        residuals: observations less fitted values.
        residual_covariance: covariance of the residuals.
        weight: Q with residuals'·Q·residuals = χ².
        dof: observations less determined directions.
    """

    values: Float[np.ndarray, " p"]
    covariance: Float[np.ndarray, "p p"]
    determined: Bool[np.ndarray, " p"]
    residuals: Float[np.ndarray, " m"]
    residual_covariance: Float[np.ndarray, "m m"]
    weight: Float[np.ndarray, "m m"]
    dof: int

    @property
    def chi2(self) -> float:
        """Sum of the weighted squares of the residuals."""
        return float(self.residuals @ self.weight @ self.residuals)

    def gain_without(self, rows: Bool[np.ndarray, " m"]) -> float:
        """How much χ² falls if these observations are left out."""
        pull, Q = (self.weight @ self.residuals)[rows], self.weight[np.ix_(rows, rows)]
        return float(pull @ np.linalg.pinv(Q, 1e-9, hermitian=True) @ pull)


def determined_directions(X: Float[np.ndarray, "m p"], tolerance: float) -> Float[np.ndarray, "r p"]:
    """Orthonormal directions of the parameters that the rows of X, in equal units, determine."""
    _, size, directions = np.linalg.svd(X, full_matrices=False)
    return directions[size > tolerance * size.max(initial=1e-300)]


def is_determined(directions: Float[np.ndarray, "r p"]) -> Bool[np.ndarray, " p"]:
    """Which parameters lie entirely in these directions."""
    return 1.0 - (directions**2).sum(axis=0) < _PART


def least_squares(
    X: Float[np.ndarray, "m p"],
    y: Float[np.ndarray, " m"],
    C: Float[np.ndarray, "m m"],
    unit: Float[np.ndarray, " p"],
    bias: Bool[np.ndarray, " p"],
    tolerance: float = KNOWN,
) -> Solution:
    """Parameters β of y = Xβ + e with the least variance, for noise e of covariance C.

    Args:
        X: the design.
        y: observations.
        C: their covariance; may be singular along the columns of biases.
        unit: size of each column of X, by which it is divided.
        bias: which parameters are biases: adding their columns to C does not change the estimate.
        tolerance: see `determined_directions`.
    """
    V = determined_directions(X / unit, tolerance)
    Z = X / unit @ V.T
    level = X[:, bias]
    try:
        inverse = np.linalg.inv(np.linalg.cholesky(C + C.diagonal().max() * level @ level.T))
    except np.linalg.LinAlgError as error:
        raise FitError(
            "some combination of the means has no noise under the noise model: add white noise (N) to it"
        ) from error
    P = inverse.T @ inverse
    estimator = np.linalg.solve(Z.T @ P @ Z, Z.T @ P)
    W = V.T @ estimator / unit[:, None]
    left = np.eye(len(y)) - Z @ estimator
    return Solution(
        values=W @ y,
        covariance=W @ C @ W.T,
        determined=is_determined(V),
        residuals=left @ y,
        residual_covariance=left @ C @ left.T,
        weight=left.T @ P @ left,
        dof=len(y) - len(V),
    )


def by_norm(
    readings: Float[np.ndarray, "k 3"],
    noise: Float[np.ndarray, "3 k k"],
    g: Float[np.ndarray, " k"],
    unit: Float[np.ndarray, "3 p"],
) -> Solution:
    """Errors of three axes from positions of unknown orientation: the norm of the inputs is g.

    The reference frame is fixed to the sensor: its first axis is the sensor's x, and the sensor's y lies in
    the plane of its first two. So the misalignments of x towards y and z and of y towards z are zero.

    Args:
        readings: means of the three axes in each position [m/s²].
        noise: covariance of the means of each axis.
        g: gravity in each position [m/s²].
        unit: see `least_squares`; the parameters of each axis: bias, row of M − 1, and, perhaps, q.
    """
    p = unit.shape[1]
    free = np.array([[True, *(j <= i for j in range(3)), *(True for _ in range(p - 4))] for i in range(3)])
    bias = np.zeros((3, p), bool)
    bias[:, 0] = True
    values = np.zeros((3, p))
    for _ in range(_ITERATIONS):
        M, b, q = np.eye(3) + values[:, 1:4], values[:, 0], values[:, 4] if p > 4 else np.zeros(3)
        f = Triad(M, b, q).inputs(readings)
        size = np.linalg.norm(f, axis=1)
        # How the norm of the inputs depends on each reading.
        slopes = [M + np.diag(2.0 * q * x) for x in f]
        n = np.stack([np.linalg.solve(D.T, x / s) for D, x, s in zip(slopes, f, size, strict=True)])
        columns = np.concatenate([np.ones((len(f), 1)), f], axis=1)
        rows = n[:, :, None] * np.repeat(columns[:, None, :], 3, axis=1)
        if p > 4:
            rows = np.concatenate([rows, (n * f**2)[:, :, None]], axis=2)
        C = np.einsum("ki,li,ikl->kl", n, n, noise)
        solution = least_squares(rows[:, free], size - g, C, unit[free], bias[free], FREE)
        values[free] += solution.values
        if np.all(np.abs(solution.values * unit[free]) < 1e-9 * g.mean()):
            break
        if not np.all(np.abs(values * unit) < g.mean()):
            values[:] = np.nan
            break
    else:
        values[:] = np.nan
    if not np.isfinite(values).all():
        raise FitError(
            "the orientations could not be estimated: check the unit and that each position is different and "
            "at rest, or give the orientations"
        )
    covariance, determined = np.zeros((3 * p, 3 * p)), np.ones(3 * p, bool)
    covariance[np.ix_(free.ravel(), free.ravel())] = solution.covariance
    determined[free.ravel()] = solution.determined
    return solution._replace(values=values.ravel(), covariance=covariance, determined=determined)


class World(NamedTuple):
    """Inputs of a sensor at rest: gravity [m/s²] with its standard deviation, and latitude [deg].

    The gravity is that of one place, or the mean of several.
    """

    gravity: float
    gravity_std: float
    latitude: float | None

    def input(self, sensor: Sensor, orientation: Orientation) -> Float[np.ndarray, 3]:
        """Input along the sensor's axes; nan if it depends on an unknown heading.

        An axis that points up reads +g, and the Earth's rate times the sine of the latitude (2.34).
        """
        if sensor == "accel":
            return self.gravity * orientation.up
        latitude = math.radians(self.latitude or 0.0)
        vertical = EARTH_RATE * math.sin(latitude) * orientation.up
        if orientation.north is not None:
            return vertical + EARTH_RATE * math.cos(latitude) * orientation.north
        return np.where(1.0 - np.abs(orientation.up) < _VERTICAL, vertical, np.nan)


class Setting(NamedTuple):
    """How a sensor was calibrated.

    Attributes:
        axes: axes of one sensor.
        positions: times and orientations; all orientations unknown for three accelerometers only.
        world: inputs of the sensor.
        second_order: whether readings have a part proportional to the square of the input.
        orientation_error: standard deviation of the orientations about each perpendicular axis [rad].
        lacks_drift: whether the noise model's record is too short to contain the drift between positions.
    """

    axes: tuple[Axis, ...]
    positions: tuple[Position, ...]
    world: World
    second_order: bool = False
    orientation_error: float = 0.0
    lacks_drift: bool = False

    @property
    def sensor(self) -> Sensor:
        """The sensor whose axes they are."""
        return self.axes[0].sensor

    @property
    def known(self) -> bool:
        """Whether the orientations are known."""
        return all(p.orientation is not None for p in self.positions)

    @property
    def units(self) -> Float[np.ndarray, " p"]:
        """Sizes of the columns of a design."""
        size = self.world.gravity if self.sensor == "accel" else EARTH_RATE
        return np.array([1.0, size, size, size, size**2][: 5 if self.second_order else 4])

    @property
    def inputs(self) -> Float[np.ndarray, "k 3"]:
        """Inputs along the sensor's axes in the positions, whose orientations are known."""
        known = [(self.world._replace(gravity=p.gravity), p.orientation) for p in self.positions]
        return np.stack([world.input(self.sensor, o) for world, o in known if o is not None])

    def design(self, axis: Axis, f: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k p"]:
        """Design of an axis: ones, inputs along x, y and z and, perhaps, the square of its own.

        Inputs that depend on an unknown heading are zero; if the axis's own input does, its row is nan.
        """
        own = f[:, [place_of(axis)]]
        X = np.concatenate([np.ones((len(f), 1)), np.nan_to_num(f), own**2], axis=1)
        return np.where(np.isfinite(own), X, np.nan)[:, : len(self.units)]

    def fitted_design(self, axis: Axis) -> Float[np.ndarray, "k p"]:
        """Design of an axis in the positions; for a gyro, as if aligned if only that determines its errors.

        A constant part of the Earth's rate along another axis cannot be distinguished from the bias.
        """
        X = self.design(axis, self.inputs)
        aligned = X.copy()
        aligned[:, [1 + j for j in range(3) if j != place_of(axis)]] *= 0.0
        needed = self.determines(axis, aligned) and not self.determines(axis, X)
        return aligned if self.sensor == "gyro" and needed else X

    def determines(self, axis: Axis, X: Float[np.ndarray, "k p"]) -> bool:
        """Whether a design determines bias and scale factor of an axis."""
        used = X[np.isfinite(X[:, 0])] / self.units
        determined = is_determined(determined_directions(used, KNOWN))
        return bool(determined[0] and determined[1 + place_of(axis)])


def errors_of(
    setting: Setting, means: Float[np.ndarray, "k axes"], noise: Sequence[Sequence[Part]]
) -> tuple[tuple[AxisCalibration, ...], Misfit]:
    """Errors of a sensor's axes from their means [rad/s or m/s²] in each position, and how well they fit.

    `noise` are the terms of the noise of each axis.
    """
    axes, p = setting.axes, len(setting.units)
    start, length = np.array([(x.start, x.duration) for x in setting.positions]).T
    full = np.stack([covariance_of_means(parts, start, length) for parts in noise])
    solution = _solution(setting, means, full, setting.orientation_error)
    determined = solution.determined.reshape(-1, p)
    if not any(d[0] and d[1 + place_of(axis)] for d, axis in zip(determined, axes, strict=True)):
        given = "; ".join(position.label for position in setting.positions)
        besides = " together with its second order" if setting.second_order else ""
        raise RecordingError(
            f"the positions ({given}) do not determine bias and scale factor of any "
            f"{setting.sensor} axis{besides}: {_remedy(setting, axes[0])}"
        )
    wider, quantiles = _by_scatter(solution) if setting.lacks_drift else (1.0, _QUANTILES)
    covariance, over_white = wider**2 * solution.covariance, np.full(determined.size, np.nan)
    white = np.stack([white_covariance(parts, length) for parts in noise])
    if (white.diagonal(axis1=1, axis2=2) > 0.0).all():
        alone = _solution(setting, means, white, 0.0).covariance.diagonal()
        over_white = np.sqrt(covariance.diagonal() / np.maximum(alone, 1e-300))
    results = []
    for k, axis in enumerate(axes):
        places = _places(axis, setting.second_order)
        own = k * p + np.array(list(places.values()))
        known = solution.determined[own]
        C = np.where(np.outer(known, known), covariance[np.ix_(own, own)], np.nan)
        if setting.sensor == "accel":
            # The uncertainty of gravity is also one of the scale, the second parameter.
            C[1, 1] += (setting.world.gravity_std / setting.world.gravity) ** 2
        value, widening = (np.where(known, x[own], np.nan) for x in (solution.values, over_white))
        std = np.sqrt(np.maximum(C.diagonal(), 0.0))
        remark = "" if known.all() else _remedy(setting, axis)
        estimates = {}
        for label, x, error in zip(places, value.tolist(), std.tolist(), strict=True):
            ends = [(x - z * error, x + z * error) for z in quantiles]
            estimates[label] = estimate(axis, label, x, error, remark, ends)
        scale = estimates["scale_factor"]
        # Two places of nearly the same gravity may leave the scale factor nearly undetermined.
        if setting.sensor == "accel" and scale.value + 4.0 * scale.std < -0.5:
            raise RecordingError(
                f"{axis.name} reads {1.0 + scale.value:.3g} times the expected value (an axis that points up "
                "reads +g): exchange up and down if the sensor outputs gravity, or correct its unit"
            )
        factors = dict(zip(places, widening.tolist(), strict=True))
        results.append(AxisCalibration(axis, estimates, factors, C))
    return tuple(results), _misfit(solution, setting, wider)


def _solution(
    setting: Setting, means: Float[np.ndarray, "k axes"], noise: Float[np.ndarray, "axes k k"], error: float
) -> Solution:
    """Errors of all axes together, since a wrong orientation moves the input between them."""
    if not setting.known:
        gravity = np.array([position.gravity for position in setting.positions])
        return by_norm(means, noise, gravity, np.tile(setting.units, (3, 1)))
    X = np.stack([setting.fitted_design(axis) for axis in setting.axes], axis=1)
    k, count, p = X.shape
    design, C = np.zeros((k, count, count, p)), np.zeros((k, count, k, count))
    f = X[:, :, 1:4]
    place = [place_of(axis) for axis in setting.axes]
    y = means - np.stack([f[:, a, i] for a, i in enumerate(place)], axis=1)
    for a in range(count):
        design[:, a, a, :] = X[:, a]
        C[:, a, :, a] = noise[a]
    for n, vector in enumerate(np.nan_to_num(setting.inputs)):
        across = vector @ vector * np.eye(3) - np.outer(vector, vector)
        C[n, :, n, :] += error**2 * across[np.ix_(place, place)]
    used = np.isfinite(X[:, :, 0]).ravel()
    bias = np.arange(count * p) % p == 0
    return least_squares(
        design.reshape(k * count, count * p)[used],
        y.ravel()[used],
        C.reshape(k * count, k * count)[np.ix_(used, used)],
        np.tile(setting.units, count),
        bias,
    )


def _places(axis: Axis, second_order: bool) -> dict[str, int]:
    """Names of an axis's parameters, in the order of the table, and their places in its design."""
    own = place_of(axis)
    others = {f"misalignment_{letter}": 1 + j for j, letter in enumerate("xyz") if j != own}
    return {"bias": 0, "scale_factor": 1 + own, **others, **({"second_order": 4} if second_order else {})}


def _by_scatter(solution: Solution) -> tuple[float, tuple[float, float]]:
    """Factor by which errors are wider if the means scatter more than under the noise model, and quantiles.

    The ratio of Birge (1932, Phys. Rev. 40:207) and Student's law of its degrees of freedom.
    """
    if solution.dof == 0 or solution.chi2 <= solution.dof:
        return 1.0, _QUANTILES
    outer, inner = stdtrit(solution.dof, [0.975, 0.84])
    return math.sqrt(solution.chi2 / solution.dof), (float(outer), float(inner))


def _remedy(setting: Setting, axis: Axis) -> str:
    """Positions to add so that all parameters of an axis are determined, in words."""
    if not setting.known:
        count = 12 if setting.second_order else 9
        return f"add positions ({count} or more, well spread, some between the axes), or give orientations"
    X = setting.design(axis, setting.inputs) / setting.units
    X = X[np.isfinite(X[:, 0])]
    added: list[str] = []
    for candidate in six_positions(with_heading=setting.sensor == "gyro"):
        before = determined_directions(X, KNOWN)
        if is_determined(before).all():
            break
        f = setting.world.input(setting.sensor, candidate)[None]
        more = np.concatenate([X, setting.design(axis, f) / setting.units])
        if len(determined_directions(more, KNOWN)) > len(before):
            X, added = more, [*added, candidate.name]
    return f"add positions, e.g. {' and '.join(map(repr, added))}"


def _misfit(solution: Solution, setting: Setting, wider: float) -> Misfit:
    """How well the means fit, and which positions fit worst."""
    labels = [position.label for position in setting.positions]
    names, used = ["norm of the three axes"], np.ones((len(labels), 1), bool)
    if setting.known:
        names = [axis.name for axis in setting.axes]
        used = np.isfinite(setting.inputs[:, [place_of(axis) for axis in setting.axes]])
    residuals, scatter = np.full(used.shape, np.nan), np.full(used.shape, np.nan)
    residuals[used] = solution.residuals
    scatter[used] = np.sqrt(np.maximum(solution.residual_covariance.diagonal(), 0.0))
    p = float(upper_tail(solution.chi2, solution.dof)) if solution.dof else math.nan
    suspects: tuple[str, ...] = ()
    if p < _DOUBT:
        of = np.broadcast_to(np.arange(len(labels))[:, None], used.shape)[used]
        gain = np.array([solution.gain_without(of == k) for k in range(len(labels))])
        suspects = tuple(labels[k] for k in np.flatnonzero(gain >= (1.0 - _TIE) * gain.max()))
    return Misfit(tuple(names), residuals, scatter, solution.chi2, solution.dof, p, suspects, wider)
