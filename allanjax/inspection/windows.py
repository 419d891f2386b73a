"""Noise and mean of a recording in windows, in bounded memory however long it is; scores of the windows.

A score is the distance of a window from the others, relative to the scatter of most of them. A mean square of
Gaussian noise of any colour is nearly χ² distributed, and the cube root of a χ² variate is nearly normal
(Wilson and Hilferty, PNAS 17, 1931). Location and scatter of these roots over the windows are those of their
shortest half, which up to half of the windows cannot move. So a score is nearly standard normal in clean
records, whatever their noise; its threshold is a number of standard deviations.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple, Protocol, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Int

from allanjax.base.wording import plain
from allanjax.inspection.facts import NOT_A_MEASUREMENT, Fact, amount
from allanjax.record.columns import names_of
from allanjax.record.completion import runs_of
from allanjax.record.recording import Axis
from allanjax.record.units import Sensor

#: Largest number of windows; a long recording has between half as many and so many.
MOST = 1024
#: Samples of the shortest window.
SHORTEST = 16
# Samples that are processed at once: what a processor's cache holds.
_AT_ONCE = 1 << 15
# Samples at the start of each piece from which the resolution is determined.
_SAMPLED = 4096
# Fields with one entry per window, and the dimension of the array along which windows are.
_ALONG = dict.fromkeys(("count", "mean", "low", "high", "peak", "repeats"), 0) | {"power": 1, "pairs": 1}
# Functions that combine the statistics of two halves into those of one window.
_OF_TWO = dict.fromkeys(("count", "repeats", "power", "pairs"), np.add) | {
    "low": np.minimum,
    "high": np.maximum,
    "peak": np.maximum,
}
#: Width of the middle half of a normal law, in standard deviations.
_HALF_WIDTH = 1.349
#: Numbers of windows that are averaged to detect long runs that are only slightly louder.
LENGTHS = (1, 4, 16, 64)
#: Fewest independent averages among which an unusual one can be detected.
_FEWEST = 8
# Least scatter of the cube root of a squared step: 0.37 for one axis, but zero for samples of few values.
_LEAST_STEP_SCATTER = 0.3
# Added to squared steps in units of their scatter, for the same reason.
_SOFT = 0.5
# Shares of equal neighbours between which noise ceases to dither a rounded output: at 0.4 the noise is 0.7
# steps; at 0.6 it is 0.4 steps, and the mean level determines how often the value changes.
_DITHERED, _COARSE = 0.4, 0.6

DEG = np.pi / 180.0
# Allan deviation at 1 s that no gyro [rad/s] and no accelerometer [m/s²] has at rest. The noisiest consumer
# gyros have 2 deg/√h, 0.033 deg/s at 1 s, and the noisiest accelerometers 1 mg/√Hz, 0.01 m/s²; a correlated
# part, or a line, makes up to ten times of it.
AT_REST = {"gyro": 0.3 * DEG, "accel": 0.15}
# Cluster times [s] that are tested: vibration and quantization are large below them, and drift above.
_SHORTEST, _LONGEST = 0.3, 10.0
# Largest range of the mean at rest [rad/s or m/s²]: biases drift by less; 0.5 m/s² is a tilt of 3 degrees.
WANDERS = {"gyro": 3.0 * DEG, "accel": 0.5}
# Largest rms about the mean at rest [rad/s or m/s²]: the noisiest sensors above have half as much at 400 Hz.
SHAKES = {"gyro": 10.0 * DEG, "accel": 2.0}

#: Samples of all axes, and of one; which samples, and which windows; a number of each axis.
Values: TypeAlias = Float[np.ndarray, "n axes"]
Samples: TypeAlias = Float[np.ndarray, " n"]
Which: TypeAlias = Bool[np.ndarray, " n"]
WhichWindows: TypeAlias = Bool[np.ndarray, " w"]
OfAxes: TypeAlias = Float[np.ndarray, " axes"]
_OfWindows: TypeAlias = Float[np.ndarray, "w axes"]
#: Groups of axes by their indices, and their scores.
Groups: TypeAlias = Sequence[Sequence[int]]
Scores: TypeAlias = Float[np.ndarray, "groups places"]


class Sampled(Protocol):
    """A recording or a stream: what it is of, whatever its samples."""

    @property
    def name(self) -> str:
        """Name for display."""

    @property
    def axes(self) -> Sequence[Axis]:
        """Axes of the samples."""

    @property
    def rate(self) -> float:
        """Sample rate [Hz]."""

    @property
    def given(self) -> Mapping[Sensor, float]:
        """Sensors whose unit was given, as in `Recording`."""


@dataclasses.dataclass(frozen=True, eq=False)
class Windows:
    """Adjacent windows of a recording, with statistics of each.

    Attributes:
        size: samples of a window, a power of two; one at the seam of two merged pieces may be shorter.
        count: samples of each window.
        mean, low, high: mean, least and largest of its samples [rad/s or m/s²].
        power: sums of squares of the differences between the means of neighbouring clusters of 1, 2, 4, …,
            size/2 samples, which do not overlap; `pairs` are how many.
        peak: largest difference of two neighbouring samples.
        repeats: number of samples equal to the one before; 15 of 16 neighbours are compared.
        resolution: smallest step between samples on each axis.
        rest: samples after the last window, fewer than its size.
    """

    size: int
    count: Int[np.ndarray, " w"]
    mean: _OfWindows
    low: _OfWindows
    high: _OfWindows
    power: Float[np.ndarray, "scales w axes"]
    pairs: Int[np.ndarray, "scales w"]
    peak: _OfWindows
    repeats: Int[np.ndarray, "w axes"]
    resolution: OfAxes
    rest: Float[np.ndarray, "r axes"]

    @classmethod
    def of(cls, values: Values, size: int | None = None) -> Windows:
        """Windows of these samples, of `size` samples each; by default `MOST` windows at most."""
        if size is None:
            size = SHORTEST
            while len(values) // size > MOST:
                size *= 2
        whole = len(values) // size * size
        step = max(_AT_ONCE // size, 1) * size
        firsts = range(0, whole, step)
        parts = [_statistics(values[k : min(k + step, whole)], size, size) for k in firsts]
        joined = _statistics(values[:0], size, size)._joined(*parts)
        resolution = np.full(values.shape[1], np.inf)
        if len(values) > 1:
            first = np.sort(values[:_SAMPLED], axis=0)
            d = np.diff(first, axis=0)
            # Differences due to floating-point rounding are not steps.
            resolution = np.where(d > 1e-9 * np.ptp(first, axis=0), d, np.inf).min(axis=0)
        return dataclasses.replace(joined, resolution=resolution, rest=np.array(values[whole:]))

    def __len__(self) -> int:
        return len(self.count)

    @property
    def repeated(self) -> _OfWindows:
        """Share of the samples in each window that are equal to the one before."""
        compared = (SHORTEST - 1) * (self.count // SHORTEST)
        return self.repeats / np.maximum(compared, 1)[:, None]

    @property
    def steps(self) -> OfAxes:
        """Smallest step between samples on each axis; 0 without any."""
        return np.where(np.isfinite(self.resolution), self.resolution, 0.0)

    @property
    def average(self) -> OfAxes:
        """Mean of all samples but those after the last window."""
        return self.averaged(self.mean)

    def averaged(self, values: _OfWindows) -> OfAxes:
        """Mean of what there is of each window over the windows, weighted by their samples."""
        return np.average(values, axis=0, weights=self.count)

    @property
    def n(self) -> int:
        """Number of samples, those after the last window included."""
        return int(self.count.sum()) + len(self.rest)

    @property
    def edges(self) -> Int[np.ndarray, " w+1"]:
        """Indices of the first sample of each window, and of the one after the last window."""
        return np.concatenate([[0], np.cumsum(self.count)])

    def updated(self, values: Values) -> Windows:
        """These windows and those of the samples that follow, twice as long once there would be too many."""
        held, left = self, np.concatenate([self.rest, values])
        wanted = (MOST - len(held)) * held.size
        while len(left) >= wanted + held.size:
            held = held._joined(Windows.of(left[:wanted], held.size))._coarser()
            left = left[wanted:]
            wanted = (MOST - len(held)) * held.size
        return held._joined(Windows.of(left, held.size))

    def merge(self, right: Windows) -> Windows:
        """Windows of this piece and the next one, with one of the samples that are left at the seam."""
        if self.n == 0:
            return right
        left = self.closed()
        while left.size < right.size:
            left = left._coarser()
        while right.size < left.size:
            right = right._coarser()
        joined = left._joined(right)
        while len(joined) > MOST:
            joined = joined._coarser()
        return joined

    def closed(self) -> Windows:
        """These windows with the remaining samples in a shorter last one, or, if few, in the last one."""
        if len(self.rest) == 0:
            return self
        last = self._joined(_statistics(self.rest, self.size, len(self.rest)))
        if 2 * len(self.rest) >= self.size or len(self) == 0:
            return last
        before, two = last.between(0, len(self) - 1), last.between(len(self) - 1, len(self) + 1)
        return before._joined(two._paired())

    def of_axes(self, keep: Bool[np.ndarray, " axes"]) -> Windows:
        """Windows of some of the axes."""
        columns = ("mean", "low", "high", "power", "peak", "repeats", "resolution", "rest")
        return dataclasses.replace(self, **{name: getattr(self, name)[..., keep] for name in columns})

    def between(self, first: int, last: int) -> Windows:
        """Windows `first` up to but not including `last`."""
        return dataclasses.replace(self._rows(slice(first, last)), rest=self.rest[:0])

    def _rows(self, rows: slice) -> Windows:
        """Some of the windows."""
        part = {name: getattr(self, name)[(slice(None),) * along + (rows,)] for name, along in _ALONG.items()}
        return dataclasses.replace(self, **part)

    def _joined(self, *others: Windows) -> Windows:
        """Windows of this piece followed by those of others, of the same size."""
        pieces, joined = (self, *others), {}
        for name, along in _ALONG.items():
            joined[name] = np.concatenate([getattr(piece, name) for piece in pieces], axis=along)
        resolution = np.min([piece.resolution for piece in pieces], axis=0)
        return Windows(self.size, **joined, resolution=resolution, rest=pieces[-1].rest)

    def _coarser(self) -> Windows:
        """Windows twice as long, each of two; an odd one at the end stays as it is."""
        even = len(self) // 2 * 2
        twos, odd = self.between(0, even), self._rows(slice(even, None))
        whole = (twos.count[::2] == self.size) & (twos.count[1::2] == self.size)
        d = np.where(whole[:, None], twos.mean[1::2] - twos.mean[::2], 0.0)
        longer = twos._paired()._joined(odd)
        # Sums of squares at one more cluster size, of which the odd window has none.
        power, pairs = np.pad(d * d, ((0, len(odd)), (0, 0))), np.pad(whole.astype(int), (0, len(odd)))
        return dataclasses.replace(
            longer,
            size=2 * self.size,
            power=np.concatenate([longer.power, power[None]]),
            pairs=np.concatenate([longer.pairs, pairs[None]]),
        )

    def _paired(self) -> Windows:
        """Pairs of windows as one window each, but for the differences between the two."""
        a, b = self._rows(slice(0, None, 2)), self._rows(slice(1, None, 2))
        paired = {name: of_two(getattr(a, name), getattr(b, name)) for name, of_two in _OF_TWO.items()}
        mean = (a.count[:, None] * a.mean + b.count[:, None] * b.mean) / paired["count"][:, None]
        return dataclasses.replace(self, **paired, mean=mean)


def _statistics(values: Values, size: int, length: int) -> Windows:
    """Windows of `length` samples without a rest: `size`, or fewer for a single short one."""
    axes = values.shape[1]
    # Axis by axis, so that neighbouring samples are adjacent in memory.
    x = np.ascontiguousarray(values.T).reshape(axes, -1, length)
    count = np.full(x.shape[1], length)
    low, high = x.min(axis=2).T, x.max(axis=2).T
    # Samples equal to the one before are counted in blocks of the shortest window.
    whole = length // SHORTEST
    blocks = x[..., : whole * SHORTEST].reshape(axes, len(count), whole, SHORTEST)
    repeats = np.count_nonzero(blocks[..., 1:] == blocks[..., :-1], axis=(-2, -1)).T
    peak = np.zeros(low.shape)
    power = np.empty((size.bit_length() - 1, *low.shape))
    pairs = np.empty((len(power), len(count)), int)
    for k in range(len(power)):
        even, odd = x[:, :, :-1:2], x[:, :, 1::2]
        d = odd - even
        if k == 0 and length > 1:
            peak = np.maximum(d.max(axis=2), -d.min(axis=2)).T
        power[k], pairs[k] = np.einsum("awk,awk->wa", d, d), d.shape[2]
        x = 0.5 * (odd + even)
    mean = x[:, :, 0].T if length == size else values.mean(axis=0)[None]
    resolution = np.full(axes, np.inf)
    return Windows(size, count, mean, low, high, power, pairs, peak, repeats, resolution, values[:0])


class Steps(NamedTuple):
    """Differences between the means of neighbouring runs of windows, at all places.

    Attributes:
        lag: number of windows of a run; place k compares those from k on with those from k + lag on.
        step: difference of each axis, less the median.
        scatter: scatter of the differences of each axis.
    """

    lag: int
    step: Float[np.ndarray, "axes places"]
    scatter: OfAxes

    def mean_squares(self, groups: Groups) -> Scores:
        """Mean squares of the steps of groups of axes, in scatters."""
        squares = (self.step / self.scatter[:, None]) ** 2
        return np.stack([squares[g].mean(axis=0) for g in groups])

    def scores(self, groups: Groups) -> Scores:
        """Scores of groups of axes."""
        roots = np.cbrt(self.mean_squares(groups) + _SOFT)
        return _scored(roots, np.full(len(groups), _LEAST_STEP_SCATTER))


def shortest_half(
    u: Float[np.ndarray, "... places"],
) -> tuple[Float[np.ndarray, " ..."], Float[np.ndarray, " ..."]]:
    """Robust location and standard deviation from the shortest half of the values; NaN are left out."""
    ordered = np.sort(u, axis=-1)
    count = int(np.isfinite(ordered).sum(axis=-1).min())
    half = count // 2
    low, high = ordered[..., : count - half], ordered[..., half:count]
    place = np.argmin(high - low, axis=-1)[..., None]
    low, high = (np.take_along_axis(x, place, axis=-1)[..., 0] for x in (low, high))
    return 0.5 * (low + high), (high - low) / _HALF_WIDTH


def mean_squares(windows: Windows) -> Float[np.ndarray, "scales w axes"]:
    """Return mean square differences of neighbouring clusters; NaN for windows without any."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(windows.pairs[..., None] > 0, windows.power / windows.pairs[..., None], np.nan)


def mean_square(
    windows: Windows, rows: slice | WhichWindows = slice(None)
) -> Float[np.ndarray, "scales axes"]:
    """Return mean square differences of neighbouring clusters over all of these windows; 0 without any."""
    pairs = np.maximum(windows.pairs[:, rows].sum(axis=1), 1)
    return windows.power[:, rows].sum(axis=1) / pairs[:, None]


def lattice_power(windows: Windows) -> OfAxes:
    """Return the mean square difference that rounding alone may cause if samples have few values."""
    repeated = np.median(windows.repeated, axis=0)
    share = np.clip((repeated - _DITHERED) / (_COARSE - _DITHERED), 0.0, 1.0)
    return share * windows.steps**2 / 4.0


def groups_of(sensors: Sequence[str]) -> Groups:
    """Return the groups of axes to score: each axis, each sensor, and all, since handling moves all."""
    alone = [[k] for k in range(len(sensors))]
    kinds = [[k for k, s in enumerate(sensors) if s == kind] for kind in dict.fromkeys(sensors)]
    together = [g for g in kinds if 1 < len(g) < len(sensors)]
    return alone + together + ([list(range(len(sensors)))] if len(sensors) > 1 else [])


def noise_scores(windows: Windows, groups: Groups, length: int, left_out: WhichWindows) -> Iterator[Scores]:
    """Yield scores of the noise at each cluster size within a window, averaged over `length` windows.

    Place k is the average from window k on. Windows that are left out count as typical ones.
    """
    if len(windows) < _FEWEST * length:
        return
    # A short window at a seam has fewer differences and scatters more than the others.
    few = 2 * windows.pairs < np.median(windows.pairs, axis=1, keepdims=True)
    squares = np.where((left_out | few)[..., None], np.nan, mean_squares(windows))
    for root, pairs in zip(np.cbrt(squares + lattice_power(windows)), windows.pairs, strict=True):
        known = np.isfinite(root[:, 0])
        if not known.any():
            continue
        middle = np.median(root[known], axis=0)
        relative = root / np.where(middle > 0.0, middle, np.inf)
        total = np.cumsum(np.where(np.isfinite(relative), relative, 1.0), axis=0)
        total = np.concatenate([np.zeros((1, total.shape[1])), total])
        averaged = (total[length:] - total[:-length]) / length
        together = np.stack([averaged[:, g].mean(axis=1) for g in groups])
        # The scatter is no less than that of as many independent differences.
        usual = float(max(np.median(pairs), 1.0))
        sizes = np.array([len(g) for g in groups])
        yield _scored(together, np.sqrt(2.0 / (9.0 * usual * length * sizes)))


def steps_of(windows: Windows, left_out: WhichWindows | None = None) -> Iterator[Steps]:
    """Differences between the means of neighbouring runs of 1, 2, 4, … windows.

    Their median is subtracted: a ramp over the record is a term of the noise model. The means leave out the
    windows in `left_out`.
    """
    weight = windows.count.astype(float) if left_out is None else windows.count * ~left_out
    mean = windows.mean - windows.mean.mean(axis=0)
    total = np.concatenate([[0.0 * mean[0]], np.cumsum(weight[:, None] * mean, axis=0)])
    known, floor = np.concatenate([[0.0], np.cumsum(weight)]), lattice_power(windows)
    lag = 1
    while len(windows) >= _FEWEST * lag:
        count = known[lag:] - known[:-lag]
        level = (total[lag:] - total[:-lag]) / np.where(count > 0.0, count, np.nan)[:, None]
        step = (level[lag:] - level[:-lag]).T
        if np.isfinite(step[0]).sum() < _FEWEST:
            return
        middle, scatter = shortest_half(step)
        scatter = np.sqrt(scatter**2 + floor)
        step = np.nan_to_num(step - middle[:, None])
        yield Steps(lag, step, np.where(scatter > 0.0, scatter, np.inf))
        lag *= 2


def _scored(roots: Scores, least: Float[np.ndarray, " groups"]) -> Scores:
    """Cube roots standardized by robust location and scatter, the relative scatter being at least `least`."""
    middle, scatter = shortest_half(roots)
    scatter = np.maximum(scatter, least * abs(middle))
    with np.errstate(invalid="ignore", divide="ignore"):
        score = (roots - middle[:, None]) / scatter[:, None]
    return np.nan_to_num(score, nan=0.0, posinf=0.0, neginf=0.0)


class Motion(NamedTuple):
    """Evidence that an axis is not at rest.

    Attributes:
        axis: index of the axis.
        factor: how much more it moves than any sensor at rest.
        words: how it moves, and the limit at rest.
    """

    axis: int
    factor: float
    words: str


def motions(windows: Windows, axes: Sequence[Axis], rate: float) -> list[Motion]:
    """Return the evidence of motion for every axis that shows it, the strongest last."""
    # Means over a second at least, or those of the windows if there are too few.
    over = max(int(np.ceil(rate / windows.size)), 1)
    whole = len(windows) // over * over
    mean = windows.mean[:whole].reshape(-1, over, len(axes)).mean(axis=1) if whole else windows.mean
    within = mean_squares(windows)[windows.pairs.any(axis=1)]
    changes = [(2.0**k / rate, np.nanmean(squares, axis=0)) for k, squares in enumerate(within)]
    changes += [(of.lag * windows.size / rate, (of.step**2).mean(axis=1)) for of in steps_of(windows)]
    tests = []
    for time, square in changes:
        if _SHORTEST <= time <= _LONGEST:
            how = f"changes by {{}} rms between consecutive {plain(time, 2)} s averages"
            # Limits follow white noise up to 1 s; the rms difference of two means is √2 times the Allan
            # deviation.
            tests.append((how, np.sqrt(square), AT_REST, np.sqrt(2.0 / min(time, 1.0))))
    tests.append(("drifts over a range of {}", np.ptp(mean, axis=0), WANDERS, 1.0))
    tests.append(("varies by {} rms", rms_within(windows), SHAKES, 1.0))
    evidence = []
    for how, values, limits, factor in tests:
        for k, axis in enumerate(axes):
            limit = limits[axis.sensor] * factor
            if values[k] > limit:
                moved, most = how.format(amount(values[k], axis)), amount(limit, axis)
                words = f"{axis.name} {moved}; a sensor at rest stays below {most}"
                evidence.append(Motion(k, values[k] / limit, words))
    return sorted(evidence, key=lambda motion: motion.factor)


def rms_within(windows: Windows, most: int | None = None) -> OfAxes:
    """Return the rms of the samples about the mean of their window, or of parts of 2^most samples."""
    # The sum of squares about the mean is a weighted sum over the differences of halves of all sizes.
    power = windows.power[:most]
    scales = 2.0 ** np.arange(len(power))
    return np.sqrt((power.sum(axis=1) * (scales / 2.0)[:, None]).sum(axis=0) / windows.count.sum())


def motion_fact(moving: Sequence[Motion], axes: Sequence[Axis], disturbed: bool) -> Fact:
    """Return the fact about this motion.

    `disturbed` is whether disturbances prevent coefficients even if the motion is intended.
    """
    # The strongest of each sensor, which is the last.
    reasons = {axes[m.axis].sensor: m.words for m in moving}
    concerned = {m.axis for m in moving}
    too = (" --as-is", ", as_is=True") if disturbed else ("", "")
    return Fact(
        "at rest",
        ", and ".join(reasons.values()),
        # If two axes show motion, all axes move.
        names_of(axes[k] for k in concerned) if len(concerned) == 1 else names_of(axes),
        NOT_A_MEASUREMENT,
        meaning="this is not a static recording, and the coefficients describe the motion, not the sensor",
        remedy="record it at rest, or select a part at rest with --start and --stop; if the motion is "
        f"intended, pass --vibrating{too[0]} (vibrating=True{too[1]})",
    )


def runs(mask: Which, gap: int) -> list[tuple[int, int]]:
    """Return first and end index of each run of true values; runs at most `gap` apart are joined."""
    joined: list[tuple[int, int]] = []
    for a, b in runs_of(mask).tolist():
        if joined and a - joined[-1][1] <= gap:
            joined[-1] = (joined[-1][0], b)
        else:
            joined.append((a, b))
    return joined
