"""Whether samples, times and units can be a sensor's: gravity, resolution, range, jitter, gaps."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from allanjax.base.earth import STANDARD_GRAVITY as _G
from allanjax.base.wording import duration, plain
from allanjax.inspection.facts import Consequence, Fact, amount
from allanjax.inspection.scores import AT_REST, DEG
from allanjax.inspection.windows import Windows
from allanjax.record.completion import widening
from allanjax.record.io.timestamps import told_jitter
from allanjax.record.recording import Axis, DeadAxis, Recording, scales_of
from allanjax.record.units import parse_sample_unit, unit_scale

# Tolerance of gravity measured by a triad, and by a single axis. Gravity is known to 0.3 % anywhere, biases
# and scale factors of consumer sensors to 5 %. A tilted single axis may read anything: hence less for it.
_TRIAD, _ALONE = 0.05, 0.01
# A triad whose mean is within this of gravity is not questioned.
_ABOUT = 0.2
# A triad that averages less than this share of gravity has none in it: simulated, or taken out.
_NONE = 0.1
_ACCEL_UNITS = ("m/s²", "g", "mg", "cm/s²", "ft/s²")
# An option that contradicts the header is refused.
_HEADER = ", or correct the header if it says another unit"
# Zero-rate level beyond the specification of any gyro.
_LARGEST_BIAS = 20.0 * DEG
# deg/√h in rad/√s.
_ROOT_HOUR = DEG / 60.0
# White noise [rad/√s] below that of the best gyro made.
_BEST_GYRO = 3e-5 * _ROOT_HOUR
# Least ratio of the gyros' white noise [deg/√h] to the accelerometers' [m/s/√h]: of tested units it is 0.17
# (fibre-optic gyros beside MEMS accelerometers) to 30, and 57 times less if rad/s are taken for deg/s.
_LEAST_RATIO = 0.1
# White noise [m/s/√h] above which accelerometers are MEMS.
_MEMS = 0.03
# Units [s] in which a column of times may be.
_TIMES = {"s": 1.0, "ms": 1e-3, "µs": 1e-6, "ns": 1e-9}
# Relative difference beyond which time stamps contradict the rate.
_SAME_RATE = 0.05
# Noise is white if its Allan deviation times root of cluster time varies by less than this factor.
_FLAT = 6.0
# Samples among which the interval of a column of times is looked for.
_COUNTED = 1 << 14
#: Shorter recordings [s] say little of B and K, which show over tens of seconds.
SHORT = 60.0
# Fewer samples determine N so poorly that it is worth a warning.
_FEW_SAMPLES = 1000
#: Distance from a multiple of the step, in steps, up to which a sample is on the lattice.
TOLERANCE = 1e-3
# Least share of the gaps between values that are multiples of the step.
_SHARE = 0.999
# Number of different values up to which there may be a lattice although most samples differ.
_FEW = 20000
# Fewest runs of samples at the largest value, or fewest such samples, that are not by chance: judgements.
_LEAST, _MANY = 4, 100
# Fewest steps of a rounded output between its extremes for it to have a tail.
_FEW_LEVELS = 4
# Samples among which the step is looked for.
_LOOKED_AT = 1 << 14
# Share of equal neighbours at which the noise is 0.4 steps of the resolution; with more, it is not seen.
_HIDDEN = 0.6
# Share of equal neighbours, beyond those due to the resolution, at which samples must have been held.
_HELD = 0.1
# Rms of the noise in steps, below which it is hidden by the rounding, and below which this is worth a word:
# its own variance of a twelfth is then a third of all, and 2 %.
_TOO_FEW, _FEW_STEPS = 0.5, 2.0
# Jitter, as a share of the interval, up to which samples are as good as even; readers refuse a fifth.
_JITTER = 0.05
# Stretches whose means are compared with the temperature's, and fewest that tell anything.
_STRETCHES, _FEWEST = 64, 12
# Chance of an axis that seems to follow a temperature that it does not feel.
_CHANCE = 0.01


def implausible(
    axes: Sequence[Axis],
    rate: float,
    mean: Float[np.ndarray, " axes"],
    white: Float[np.ndarray, "scales axes"],
    auxiliary: Mapping[str, Float[np.ndarray, " n"]],
    moving: Collection[str] = (),
    vibrating: bool = False,
) -> list[Fact]:
    """Facts about units or a rate that cannot be right.

    Args:
        axes: axes of the recording.
        rate: sample rate [Hz].
        mean: mean of each axis [rad/s or m/s²].
        white: Allan deviation times root of cluster time, for clusters up to a second [rad/√s or m/s/√s]; the
            least is an upper bound of the white noise N.
        auxiliary: other columns, among which may be one of times.
        moving: sensors that are known not to be at rest.
        vibrating: whether the platform is meant to move.
    """
    grave: Consequence = "not a measurement"
    found = [Fact("rate", _rate(rate, auxiliary), tuple(axis.name for axis in axes), grave)]
    for accel in accelerometers(axes):
        line = _accel(axes, accel, rate, mean, "accel" in moving)
        # What a single axis reads is a matter of its tilt.
        means: Consequence = grave if len(accel) >= 3 else "none"
        found.append(Fact("accel unit", line, tuple(axes[k].name for k in accel), means))
    # Where accelerometers of the right unit move, gyros do, too.
    moves = vibrating or ("accel" in moving and not any(fact.text for fact in found[1:]))
    gyros = tuple(axis.name for axis in axes if axis.sensor == "gyro")
    found.append(Fact("gyro unit", _gyro(axes, mean, white, "gyro" in moving, moves), gyros, grave))
    return [fact for fact in found if fact.text]


def accelerometers(axes: Sequence[Axis]) -> list[list[int]]:
    """Indices of the axes of each accelerometer: those whose names differ in their last letter only."""
    groups: dict[str, list[int]] = {}
    for k, axis in enumerate(axes):
        if axis.sensor == "accel":
            groups.setdefault(axis.name.rstrip("xyz"), []).append(k)
    return list(groups.values())


def _accel(
    axes: Sequence[Axis], accel: Sequence[int], rate: float, mean: Float[np.ndarray, " axes"], moving: bool
) -> str:
    """Warning about an accelerometer if it does not measure gravity, or "" if it does."""
    size = float(np.linalg.norm(mean[accel]))
    triad = len(accel) >= 3
    if abs(size / _G - 1.0) < _ABOUT or size == 0.0:
        return ""
    own = parse_sample_unit(axes[accel[0]].unit, "accel")
    number = size / scales_of([axes[accel[0]]], rate)[0]
    wrong = f"accelerometers average {number:.4g} {own.name}: gravity is 9.81 m/s²"
    tolerance = _TRIAD if triad else _ALONE

    def is_gravity(acceleration: float) -> bool:
        return abs(acceleration / _G - 1.0) < tolerance

    if own.quantity == "increment":
        for factor in (10.0, 0.1, 100.0, 0.01):
            if is_gravity(size / factor):
                probable = rate / factor
                return (
                    f"{wrong}, or {_G / size * number:.4g} {own.name} at {rate:g} Hz; the rate is probably "
                    f"{probable:g} Hz: --rate {probable:g}"
                )
    for other in _ACCEL_UNITS:
        if is_gravity(number * unit_scale(other, "accel")):
            option = f"--accel-unit {other.replace('²', '^2')}"
            return f"{wrong}; their unit is probably {other}: {option}{_HEADER}"
    if own.quantity == "rate" and is_gravity(size * rate):
        return (
            f"{wrong}, {_G / rate:.4g} m/s a sample; they are probably increments: --accel-unit m/s{_HEADER}"
        )
    if triad and not moving and size > _NONE * _G:
        return (
            f"{wrong}, and this is {size:.3g}; is the unit right, and the range wide enough? (--accel-unit)"
        )
    return ""


def _gyro(
    axes: Sequence[Axis],
    mean: Float[np.ndarray, " axes"],
    white: Float[np.ndarray, "scales axes"],
    moving: bool,
    platform_moves: bool,
) -> str:
    """Warning about the gyros if their bias or noise is that of no gyro at rest, or ""."""
    gyros = [k for k, axis in enumerate(axes) if axis.sensor == "gyro"]
    if not gyros:
        return ""
    unit = axes[gyros[0]].unit
    noise, bias = float(np.median(white.min(axis=0)[gyros])), float(abs(mean[gyros]).max())
    # Motion is not white, but noise in another unit still is.
    flat = bool(np.median((white.max(axis=0) - _FLAT * white.min(axis=0))[gyros]) < 0.0)
    known = f"gyros average {bias / DEG:.3g} deg/s with a noise of {noise / _ROOT_HOUR:.2g} deg/√h"
    beyond = (noise > AT_REST["gyro"] and flat) or (bias > _LARGEST_BIAS and not moving)
    if beyond and not platform_moves:
        remedy = "is the unit right? (--gyro-unit)"
        if "deg" not in unit:
            remedy = f"are they deg/s? --gyro-unit deg/s{_HEADER}"
        return f"{known}, beyond any gyro at rest; {remedy}"
    if 0.0 < noise < _BEST_GYRO:
        return f"{known}, and the best ones made have 0.0001 deg/√h; is the unit right? (--gyro-unit)"
    accel = [k for k, axis in enumerate(axes) if axis.sensor == "accel"]
    if accel and "rad" not in unit:
        beside = float(np.median(white.min(axis=0)[accel])) * 60.0
        if 0.0 < noise / _ROOT_HOUR < _LEAST_RATIO * beside and beside > _MEMS:
            return (
                f"{known}, too little beside accelerometers of {beside:.2g} m/s/√h; are they rad/s? "
                f"--gyro-unit rad/s{_HEADER}"
            )
    return ""


def _rate(rate: float, auxiliary: Mapping[str, Float[np.ndarray, " n"]]) -> str:
    """Warning about an unused column of times that contradicts the rate, or "" if there is none."""
    for name, column in auxiliary.items():
        if not ("time" in name.lower() or name.lower() in ("t", "stamp")):
            continue
        step = float(np.median(np.diff(np.asarray(column, float)[:_COUNTED])))
        if not (np.isfinite(step) and step > 0.0):
            continue
        rates = {1.0 / (step * size): unit for unit, size in _TIMES.items()}
        nearest = min(rates, key=lambda r: abs(np.log(r / rate)))
        if abs(nearest / rate - 1.0) > _SAME_RATE:
            return (
                f"the column {name!r} grows by {step:g} a sample, {nearest:.4g} Hz if in {rates[nearest]}, "
                f"and the rate is {rate:g} Hz; if that is wrong, take its times by --time {name}, or its "
                f"rate by --time none --rate {nearest:.6g} (rate={nearest:.6g})"
            )
    return ""


def short(n: int, rate: float, axes: Sequence[Axis]) -> list[Fact]:
    """Fact about a recording of n samples at this rate [Hz] that is short."""
    if n >= _FEW_SAMPLES and n / rate >= SHORT:
        return []
    line = f"{n / rate:.3g} s: too short for B and K, which show over tens of seconds and more"
    if n < _FEW_SAMPLES:
        line += f"; of {n} samples, N is known to {100.0 / np.sqrt(n):.0f} % at best"
    return [Fact("length", line, tuple(axis.name for axis in axes), size=n / rate, unit="s")]


def lattice(x: Float[np.ndarray, " n"]) -> float | None:
    """Step between the samples' values, if these are on a lattice, else None."""
    values = np.unique(x)
    least = 1e-9 * float(np.max(abs(values))) + 1e-300
    gaps = np.diff(values)
    gaps = gaps[gaps > least]
    if len(gaps) < 1 or (len(values) > max(len(x) / 2.0, 3) and len(values) > _FEW):
        return None
    q = float(gaps.min())
    for _ in range(3):
        steps = np.rint(gaps / q)
        q = float(np.sum(gaps) / np.sum(steps))
    off = abs(gaps / q - np.rint(gaps / q))
    return q if np.mean(off < TOLERANCE * np.maximum(np.rint(gaps / q), 1.0)) > _SHARE else None


@dataclasses.dataclass(frozen=True, eq=False)
class Ends:
    """How often samples are at the ends of their range, in constant memory however many they are.

    Each array has two rows: of the upper end, and of the lower one, for which signs are changed.

    Attributes:
        n: number of samples.
        value, count, runs: the largest value, samples that are there, and runs of them.
        below, count_below: the largest of the other values, and samples that are there.
    """

    n: int
    value: Float[np.ndarray, "2 axes"]
    count: Int[np.ndarray, "2 axes"]
    runs: Int[np.ndarray, "2 axes"]
    below: Float[np.ndarray, "2 axes"]
    count_below: Int[np.ndarray, "2 axes"]

    @classmethod
    def of(cls, values: Float[np.ndarray, "n axes"]) -> Ends:
        """Ends of the range of these samples."""
        sides = [values, -values]
        value = [x.max(axis=0, initial=-np.inf) for x in sides]
        at = [x == top for x, top in zip(sides, value, strict=True)]
        others = [np.where(there, -np.inf, x) for x, there in zip(sides, at, strict=True)]
        below = [x.max(axis=0, initial=-np.inf) for x in others]
        runs = [there[:1].sum(axis=0) + (there[1:] & ~there[:-1]).sum(axis=0) for there in at]
        count_below = [(x == level).sum(axis=0) for x, level in zip(others, below, strict=True)]
        count = [there.sum(axis=0) for there in at]
        return cls(len(values), *map(np.array, (value, count, runs, below, count_below)))

    def merge(self, right: Ends) -> Ends:
        """Ends of the range of the samples of two pieces."""
        value = np.maximum(self.value, right.value)
        both = [(x, x.value == value) for x in (self, right)]
        count, runs = (
            np.sum([np.where(at, getattr(x, name), 0) for x, at in both], axis=0)
            for name in ("count", "runs")
        )
        others = [(np.where(at, x.below, x.value), np.where(at, x.count_below, x.count)) for x, at in both]
        below = np.maximum(others[0][0], others[1][0])
        count_below = np.sum([np.where(level == below, counted, 0) for level, counted in others], axis=0)
        return Ends(self.n + right.n, value, count, runs, below, count_below)

    def of_axes(self, keep: Bool[np.ndarray, " axes"]) -> Ends:
        """Those of some of the axes."""
        names = [field.name for field in dataclasses.fields(self) if field.name != "n"]
        return dataclasses.replace(self, **{name: getattr(self, name)[:, keep] for name in names})

    def piled_up(self, steps: Float[np.ndarray, " axes"]) -> Bool[np.ndarray, "2 axes"]:
        """Whether more samples are at an end than a tail would leave there, given the steps, 0 for none."""
        # Copies of one extreme sample are another matter.
        often = (self.runs >= _LEAST) | (self.count >= _MANY)
        adjacent = abs(self.value - steps - self.below) < steps / 2.0
        tail = np.where(adjacent, self.count_below, 0)
        beyond = (self.count > tail + 6.0 * np.sqrt(tail + 1.0)) & (self.count >= 5 * _LEAST)
        has_tail = self.value.sum(axis=0) >= _FEW_LEVELS * steps
        return np.where(steps > 0.0, beyond & has_tail, often)


def resolved(
    windows: Windows, axes: Sequence[Axis], columns: Sequence[Float[np.ndarray, " recorded"]] | None
) -> tuple[list[Fact], Float[np.ndarray, " axes"]]:
    """Facts about axes whose noise is coarsely rounded or whose samples are held, and each axis's step.

    Args:
        windows: of the samples.
        axes: their axes.
        columns: the samples of each axis, where they are in memory.

    Returns:
        The facts; and the step of each axis [rad/s or m/s²], 0 where none is seen.
    """
    repeated = np.average(windows.repeated, axis=0, weights=windows.count)
    rms = np.sqrt(windows.power[0].sum(axis=0) / max(windows.pairs[0].sum(), 1) / 2.0)
    if columns is None:
        steps = np.where(np.isfinite(windows.resolution), windows.resolution, 0.0)
    else:
        steps = np.array([lattice(x[:_LOOKED_AT]) or 0.0 for x in columns])
    noise = rms / np.where(steps > 0.0, steps, 1.0)
    # Share of equal neighbours that rounding makes of Gaussian noise.
    chance = np.where(noise > 0.0, 0.5 / np.sqrt(np.pi) / np.maximum(noise, 1e-12), 0.0) * (steps > 0.0)
    facts = []
    for k, axis in enumerate(axes):
        name, size = (axis.name,), float(noise[k])
        few = f"the noise of {axis.name} is {plain(size, 2)} steps of its output, {amount(steps[k], axis, 3)}"
        if steps[k] > 0.0 and (noise[k] < _TOO_FEW or (repeated[k] > _HIDDEN and chance[k] > _HIDDEN)):
            text = f"{few}: its coefficients are those of the rounding; take a finer resolution"
            facts.append(Fact("resolution", text, name, "not a measurement", size, "steps"))
        elif repeated[k] > _HELD + 2.0 * chance[k]:
            share = f"{axis.name}: {100.0 * repeated[k]:.0f} % of its samples repeat the one before"
            text = f"{share}: the sensor gives fewer than the rate says, and what is faster is not its own"
            facts.append(Fact("repeated samples", text, name, "none", float(repeated[k]), "1"))
        elif steps[k] > 0.0 and noise[k] < _FEW_STEPS:
            text = f"{few}: rounding is part of what looks like noise, and the intervals of N allow for it"
            facts.append(Fact("resolution", text, name, "widened", size, "steps"))
    return facts, steps


def saturated(axes: Sequence[Axis], ends: Ends, steps: Float[np.ndarray, " axes"]) -> list[Fact]:
    """Facts about axes with more samples at their largest or smallest value than a tail would leave there."""
    facts = []
    for side, k in np.argwhere(ends.piled_up(steps) & (ends.count >= _LEAST)):
        axis, share = axes[k], 100.0 * float(ends.count[side, k]) / ends.n
        level = amount((1.0, -1.0)[side] * ends.value[side, k], axis, 4)
        text = (
            f"{axis.name} is at {level} in {plain(share, 2)} % of the samples: its range ends there; use a "
            "wider one, or remove the offset"
        )
        facts.append(Fact("saturation", text, (axis.name,), "not a measurement", share, "%"))
    return facts


def sampling_facts(recording: Recording) -> Iterator[Fact]:
    """Facts about times, missing samples and dead axes."""
    if (share := jitter_share(recording)) is not None and share > _JITTER:
        remedy = (
            "samples are taken as evenly spaced; if the stamps are right, read those of the sensor's clock"
        )
        text = f"{jitter_in_words(recording)}: {remedy}"
        yield Fact("jitter", text, recording.names, size=recording.jitter, unit="s")
    if recording.gaps:
        yield _gaps(recording)
    yield from dead_facts(recording.dead)


def dead_facts(dead: Sequence[DeadAxis]) -> Iterator[Fact]:
    """Facts about axes that do not change, or are without samples."""
    for d in dead:
        yield Fact("dead axes", f"{d.axis.name}: {d.reason}", (d.axis.name,), "not a measurement")


def _gaps(recording: Recording) -> Fact:
    """Fact about missing samples, which have been drawn, or are between stretches."""
    gaps, rate = recording.gaps or (), recording.rate
    lost, longest = sum(gap.samples for gap in gaps), max(gap.samples for gap in gaps)
    count = f"{len(gaps)} gaps of at most" if len(gaps) > 1 else "a gap of"
    text = f"{lost} samples are missing, in {count} {duration(longest / rate)}"
    spans = tuple((gap.first / rate, (gap.first + gap.samples) / rate) for gap in gaps)
    if recording.missing is None:
        rest = f"{text}: {1 + len(recording.others)} stretches between them are used"
        return Fact("gaps", rest, recording.names, "none", lost / rate, "s", spans)
    drawn = tuple(name for name, x in zip(recording.names, recording.missing.T, strict=True) if x.any())
    wider = 100.0 * (float(widening(recording.missing).max()) - 1.0)
    text = f"{text}: drawn given the others, which makes intervals {plain(wider, 2)} % wider"
    return Fact("gaps", text, drawn, "widened", lost / rate, "s", spans)


def jitter_share(recording: Recording) -> float | None:
    """Rms jitter of the time stamps as a share of the interval; None without any."""
    return None if recording.jitter is None else recording.jitter * recording.rate


def jitter_in_words(recording: Recording) -> str:
    """The jitter in s and as a share of the interval."""
    jitter = recording.jitter or 0.0
    share = plain(100.0 * max(jitter, 1e-9) * recording.rate, 2)
    return f"{told_jitter(jitter)}, {share} % of the interval"


def temperatures(recording: Recording) -> dict[str, Float[np.ndarray, " n"]]:
    """Channels of temperature by their names."""
    return {key: z for key, z in recording.auxiliary.items() if "temp" in key.lower()}


def temperature_facts(recording: Recording) -> Iterator[Fact]:
    """Axes whose mean changes in proportion to a temperature, from one stretch of the record to the next.

    Changes of a random walk are independent of each other, and those of white noise and flicker add up to
    less: so the t test of a proportion between changes is right for the one and cautious for the others. One
    between the means themselves would find a slope between any two walks.
    """
    size = recording.n // _STRETCHES or 1
    whole = recording.n // size * size
    if whole // size < _FEWEST:
        return
    from scipy.special import stdtr

    channels = temperatures(recording)
    for key, z in channels.items():
        dz = np.diff(z[:whole].reshape(-1, size).mean(axis=1))
        if not (np.isfinite(dz).all() and dz.any()):
            continue
        for axis, column in zip(recording.axes, recording.values.T, strict=True):
            dx = np.diff(column[:whole].reshape(-1, size).mean(axis=1))
            slope = float(dz @ dx / (dz @ dz))
            dof = len(dz) - 1
            t = slope / np.sqrt(np.sum((dx - slope * dz) ** 2) / dof / (dz @ dz))
            if 2.0 * stdtr(dof, -abs(t)) < _CHANCE / len(recording.axes):
                drift = amount(abs(slope) * float(np.ptp(z)), axis)
                remedy = f"fit with --objective whittle --regressors {','.join(channels)}"
                text = f"{axis.name} follows {key}, by {drift} over its range: {remedy}"
                yield Fact("temperature", text, (axis.name,))
