"""Plausibility of samples, times and units: gravity, resolution, range, jitter, gaps."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterator, Mapping, Sequence
from types import MappingProxyType

import numpy as np
from jaxtyping import Bool, Float, Int

from allanjax.base.earth import STANDARD_GRAVITY as _G
from allanjax.base.wording import duration, plain
from allanjax.inspection.facts import Consequence, Fact, amount
from allanjax.inspection.windows import AT_REST, DEG, OfAxes, Samples, Values, Windows, rms_within
from allanjax.record.completion import widening
from allanjax.record.io.grid import format_jitter
from allanjax.record.recording import Axis, DeadAxis, Recording, scales_of
from allanjax.record.units import Sensor, parse_sample_unit, unit_scale

# Tolerance of gravity measured by a triad, and by a single axis. Gravity is known to 0.3 % anywhere, biases
# and scale factors of consumer sensors to 5 %. A tilted single axis may read anything: hence less for it.
_TRIAD, _ALONE = 0.05, 0.01
# A triad whose mean is within this of gravity is not questioned.
_ABOUT = 0.2
# A triad that averages less than this share of gravity is free of gravity: simulated, or removed.
_NONE = 0.1
_ACCEL_UNITS = ("m/s²", "g", "mg", "cm/s²", "ft/s²")
_HEADER = ", or correct the unit in the header"
# Zero-rate level beyond the specification of any gyro.
_LARGEST_BIAS = 20.0 * DEG
# deg/√h in rad/√s.
_ROOT_HOUR = DEG / 60.0
# White noise [rad/√s] below that of the best gyro made.
_BEST_GYRO = 3e-5 * _ROOT_HOUR
# Least and largest ratio of the gyros' white noise [deg/√h] to the accelerometers' [m/s/√h]: of tested units
# it is 0.17 (fibre-optic gyros beside MEMS accelerometers) to 30, 57 times less if rad/s are taken for deg/s,
# and 57 times more if deg/s are taken for rad/s.
_LEAST_RATIO, _MOST_RATIO = 0.1, 60.0
# White noise [m/s/√h] above which accelerometers are MEMS.
_MEMS = 0.03
# Possible units [s] of a column of times.
_TIMES = {"s": 1.0, "ms": 1e-3, "µs": 1e-6, "ns": 1e-9}
# Relative difference beyond which time stamps contradict the rate.
_SAME_RATE = 0.05
# Noise is white if its Allan deviation times root of cluster time varies by less than this factor.
_FLAT = 6.0
# Samples from which the interval of a column of times is determined.
_COUNTED = 1 << 14
#: Shorter recordings [s] hold little information on B and K, which show over tens of seconds.
SHORT = 60.0
# Shorter ones [s], and higher rates [Hz], are no records of inertial sensors.
_HARDLY, _HIGHEST_RATE = 1.0, 5e4
# Fewer samples determine N so poorly that users are warned.
_FEW_SAMPLES = 1000
#: Distance from a multiple of the step, in steps, up to which a value counts as that multiple.
TOLERANCE = 1e-3
# Least share of the gaps between values that are multiples of the step.
_SHARE = 0.999
# Number of distinct values up to which the output may be rounded although most samples differ.
_FEW = 20000
# Fewest runs of samples at the largest value, or fewest such samples, that are not chance (a judgement).
_LEAST, _MANY = 4, 100
# Fewest steps between the extremes of a rounded output for its distribution to have a tail.
_FEW_LEVELS = 4
# Samples from which the step is determined.
_LOOKED_AT = 1 << 14
# Octaves of samples, from one on, in which their noise is compared with the steps.
_OCTAVES = 6
# Share of equal neighbours, beyond those due to rounding, that shows that samples are repeated.
_HELD = 0.1
# Rms of the noise in steps below which rounding, a third or 2 % of the variance, hides it or is reported.
_TOO_FEW, _FEW_STEPS = 0.5, 2.0
# Jitter, as a share of the interval, up to which samples count as evenly spaced; readers refuse a fifth.
_JITTER = 0.05
# Number of parts whose means are compared with those of the temperature, and the fewest that suffice.
_PARTS, _FEWEST = 64, 12
# Probability that an axis seems to follow a temperature that does not affect it.
_CHANCE = 0.01


def implausible(
    axes: Sequence[Axis],
    rate: float,
    mean: OfAxes,
    white: Float[np.ndarray, "scales axes"],
    auxiliary: Mapping[str, Samples],
    moving: Collection[str] = (),
    vibrating: bool = False,
    given: Mapping[Sensor, float] = MappingProxyType({}),
) -> list[Fact]:
    """Return facts about implausible units or an implausible rate.

    Args:
        axes: axes of the recording.
        rate: sample rate [Hz].
        mean: mean of each axis [rad/s or m/s²].
        white: Allan deviation times root of cluster time, for clusters up to a second [rad/√s or m/s/√s]; the
            least is an upper bound of the white noise N.
        auxiliary: other columns, one of which may hold times.
        moving: sensors that are not at rest.
        vibrating: whether the platform is meant to move.
        given: sensors whose unit was given, and the factor from their labels' unit to it.
    """
    grave: Consequence = "not a measurement"
    facts = [Fact("rate", _rate(rate, auxiliary), tuple(axis.name for axis in axes), grave)]
    wrong = 1.0
    for accel in accelerometers(axes):
        line, factor = _accel(axes, accel, rate, mean, "accel" in moving)
        wrong = factor if factor != 1.0 else wrong
        # The reading of a single axis depends on its tilt.
        means: Consequence = grave if len(accel) >= 3 else "none"
        facts.append(Fact("accel unit", line, tuple(axes[k].name for k in accel), means))
    # If accelerometers with a plausible unit move, so do the gyros.
    moves = vibrating or ("accel" in moving and not any(fact.text for fact in facts[1:]))
    gyros = tuple(axis.name for axis in axes if axis.sensor == "gyro")
    doubt = _gyro(axes, mean, white, "gyro" in moving, moves) or _doubtful(axes, white, rate, wrong, given)
    facts.append(Fact("gyro unit", doubt, gyros, grave))
    return [fact for fact in facts if fact.text]


def accelerometers(axes: Sequence[Axis]) -> list[list[int]]:
    """Return the axes of each accelerometer: indices of names that differ only in the last letter."""
    groups: dict[str, list[int]] = {}
    for k, axis in enumerate(axes):
        if axis.sensor == "accel":
            groups.setdefault(axis.name.rstrip("xyz"), []).append(k)
    return list(groups.values())


def _accel(
    axes: Sequence[Axis], accel: Sequence[int], rate: float, mean: OfAxes, moving: bool
) -> tuple[str, float]:
    """Return a warning about an accelerometer that does not measure gravity, or "", and a likely factor."""
    size = float(np.linalg.norm(mean[accel]))
    triad = len(accel) >= 3
    if abs(size / _G - 1.0) < _ABOUT or size == 0.0:
        return "", 1.0
    own = parse_sample_unit(axes[accel[0]].unit, "accel")
    number = size / scales_of([axes[accel[0]]], rate)[0]
    wrong = f"the accelerometers average {number:.4g} {own.name}, but gravity is 9.81 m/s²"
    tolerance = _TRIAD if triad else _ALONE

    def is_gravity(acceleration: float) -> bool:
        return abs(acceleration / _G - 1.0) < tolerance

    if own.quantity == "increment":
        for factor in (10.0, 0.1, 100.0, 0.01):
            if is_gravity(size / factor):
                probable = rate / factor
                text = (
                    f"{wrong} ({_G / size * number:.4g} {own.name} at {rate:g} Hz); the rate is probably "
                    f"{probable:g} Hz: pass --rate {probable:g}"
                )
                return text, 1.0
    for other in _ACCEL_UNITS:
        scale = unit_scale(other, "accel")
        if is_gravity(number * scale):
            option = f"--accel-unit {other.replace('²', '^2')}"
            text = f"{wrong}; the unit is probably {other}: pass {option}{_HEADER}"
            return text, number * scale / size
    if own.quantity == "rate" and is_gravity(size * rate):
        text = (
            f"{wrong} ({_G / rate:.4g} m/s per sample); the samples are probably increments: pass "
            f"--accel-unit m/s{_HEADER}"
        )
        return text, rate
    if triad and not moving and size > _NONE * _G:
        return f"{wrong}; is the unit right (--accel-unit), and is the range wide enough?", 1.0
    return "", 1.0


def _gyro(
    axes: Sequence[Axis],
    mean: OfAxes,
    white: Float[np.ndarray, "scales axes"],
    moving: bool,
    platform_moves: bool,
) -> str:
    """Return a warning about gyros whose bias or noise is implausible at rest, or ""."""
    gyros = [k for k, axis in enumerate(axes) if axis.sensor == "gyro"]
    if not gyros:
        return ""
    unit = axes[gyros[0]].unit
    noise, bias = float(np.median(white.min(axis=0)[gyros])), float(abs(mean[gyros]).max())
    # Motion is not white, but noise in another unit still is.
    flat = bool(np.median((white.max(axis=0) - _FLAT * white.min(axis=0))[gyros]) < 0.0)
    density = f"{plain(noise / _ROOT_HOUR, 2)} deg/√h"
    known = f"as read ({unit}) the gyros average {plain(bias / DEG, 3)} deg/s with {density} of noise"
    beyond = (noise > AT_REST["gyro"] and flat) or (bias > _LARGEST_BIAS and not moving)
    if beyond and not platform_moves:
        remedy = "is the unit right? (--gyro-unit)"
        if "deg" not in unit:
            remedy = f"if the values are in deg/s, pass --gyro-unit deg/s{_HEADER}"
        return f"{known}; that is implausible at rest: {remedy}"
    if 0.0 < noise < _BEST_GYRO:
        return f"{known}; the best gyros have 0.0001 deg/√h: is the unit right? (--gyro-unit)"
    accel = [k for k, axis in enumerate(axes) if axis.sensor == "accel"]
    if accel and "rad" not in unit:
        beside = float(np.median(white.min(axis=0)[accel])) * 60.0
        if 0.0 < noise / _ROOT_HOUR < _LEAST_RATIO * beside and beside > _MEMS:
            return (
                f"{known}; that is too little beside accelerometers with {plain(beside, 2)} m/s/√h: if the "
                f"values are in rad/s, pass --gyro-unit rad/s{_HEADER}"
            )
    return ""


def _doubtful(
    axes: Sequence[Axis],
    white: Float[np.ndarray, "scales axes"],
    rate: float,
    factor: float,
    given: Mapping[Sensor, float],
) -> str:
    """Return a warning about gyros whose unit is doubtful beside the accelerometers, or "".

    A label that is wrong for the accelerometers is probably wrong for the gyros, too.

    Args:
        axes, white, rate, given: as for `implausible`.
        factor: factor from the accelerometers' samples as read to those in their probable unit.
    """
    gyros = [k for k, axis in enumerate(axes) if axis.sensor == "gyro"]
    accel = [k for k, axis in enumerate(axes) if axis.sensor == "accel"]
    if not gyros or not accel or "gyro" in given:
        return ""
    noise = float(np.median(white.min(axis=0)[gyros])) / _ROOT_HOUR
    beside = float(np.median(white.min(axis=0)[accel])) * 60.0 * factor
    unit = parse_sample_unit(axes[gyros[0]].unit, "gyro").name
    why, others = "", dict[str, float]()
    # Samples in a given unit are right, but their label was wrong.
    factor = factor * given.get("accel", 1.0)
    if factor != 1.0:
        why = "the label of the accelerometers is wrong, which puts that of the gyros in doubt"
        # From m/s² to g or mg, from g to m/s², and from rates to increments.
        if unit == "rad/s" and _is_about(factor, _G, _G / 1e3):
            others = {"deg/s": DEG}
        elif unit == "deg/s" and _is_about(factor, 1.0 / _G):
            others = {"rad/s": 1.0 / DEG}
        elif _is_about(factor, rate):
            others = {unit.removesuffix("/s"): rate}
    elif unit == "rad/s" and noise > _MOST_RATIO * beside > 0.0:
        why = f"that is too much beside accelerometers with {plain(beside, 2)} m/s/√h"
        others = {"deg/s": DEG}
    for other, scale in others.items():
        return (
            f"as read ({unit}) the gyros have {plain(noise, 3)} deg/√h of noise; {why}: in {other} it is "
            f"{plain(noise * scale, 3)} deg/√h: pass --gyro-unit {other}, or --gyro-unit {unit} if that is "
            "right"
        )
    return ""


def _is_about(factor: float, *wanted: float) -> bool:
    """Return whether a factor is one of these, within the tolerance of gravity."""
    return any(abs(factor / one - 1.0) < _TRIAD for one in wanted)


def _rate(rate: float, auxiliary: Mapping[str, Samples]) -> str:
    """Return a warning about a rate that no sensor has, or that an unused column contradicts, or ""."""
    if rate > _HIGHEST_RATE:
        return (
            f"the rate is {rate:g} Hz, which no inertial sensor has; if the unit of the times is wrong, pass "
            "--time-unit, or --rate"
        )
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
                f"the rate is {rate:g} Hz, but column {name!r} implies {nearest:.4g} Hz (if in "
                f"{rates[nearest]}); if the rate is wrong, use the column with --time {name}, or its rate "
                "with "
                f"--time none --rate {nearest:.6g} (rate={nearest:.6g})"
            )
    return ""


def short(n: int, rate: float, axes: Sequence[Axis]) -> list[Fact]:
    """Return a fact about a recording of n samples at this rate [Hz] if it is short."""
    if n >= _FEW_SAMPLES and n / rate >= SHORT:
        return []
    if n / rate < _HARDLY:
        line = (
            f"{n:,} samples last {n / rate:.3g} s only; if it was longer, the unit of the times is wrong: "
            "pass --time-unit, or --rate"
        )
        return [Fact("length", line, tuple(axis.name for axis in axes), size=n / rate, unit="s")]
    line = f"{n / rate:.3g} s is too short for B and K, which show over tens of seconds or more"
    if n < _FEW_SAMPLES:
        line += f"; with {n} samples, N is known to ±{100.0 / np.sqrt(n):.0f} % at best"
    return [Fact("length", line, tuple(axis.name for axis in axes), size=n / rate, unit="s")]


def lattice(x: Samples) -> float | None:
    """Return the step between the values if these are multiples of one, else None."""
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
    """How often samples are at the ends of their range, in constant memory for any number of samples.

    Each array has two rows: the upper end, and the lower end with changed signs.

    Attributes:
        n: number of samples.
        value, count, runs: the largest value, the number of samples with it, and the number of their runs.
        below, count_below: the second largest value, and the number of samples with it.
    """

    n: int
    value: Float[np.ndarray, "2 axes"]
    count: Int[np.ndarray, "2 axes"]
    runs: Int[np.ndarray, "2 axes"]
    below: Float[np.ndarray, "2 axes"]
    count_below: Int[np.ndarray, "2 axes"]

    @classmethod
    def of(cls, values: Values) -> Ends:
        """Return the ends of the range of these samples."""
        sides = np.stack([values, -values])
        value = sides.max(axis=1, initial=-np.inf)
        at = sides == value[:, None]
        runs = at[:, :1].sum(axis=1) + (at[:, 1:] & ~at[:, :-1]).sum(axis=1)
        others = np.where(at, -np.inf, sides)
        below = others.max(axis=1, initial=-np.inf)
        count_below = (others == below[:, None]).sum(axis=1)
        return cls(len(values), value, at.sum(axis=1), runs, below, count_below)

    def merge(self, right: Ends) -> Ends:
        """Return the ends of the range of two pieces together."""
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
        """Return the ends for some of the axes."""
        names = [field.name for field in dataclasses.fields(self) if field.name != "n"]
        return dataclasses.replace(self, **{name: getattr(self, name)[:, keep] for name in names})

    def piled_up(self, steps: OfAxes) -> Bool[np.ndarray, "2 axes"]:
        """Whether more samples are at an end than a tail explains, given each axis's step (0 for none)."""
        # Copies of a single extreme sample do not count.
        often = (self.runs >= _LEAST) | (self.count >= _MANY)
        adjacent = abs(self.value - steps - self.below) < steps / 2.0
        tail = np.where(adjacent, self.count_below, 0)
        beyond = (self.count > tail + 6.0 * np.sqrt(tail + 1.0)) & (self.count >= 5 * _LEAST)
        has_tail = self.value.sum(axis=0) >= _FEW_LEVELS * steps
        return np.where(steps > 0.0, beyond & has_tail, often)


def resolved(
    windows: Windows, axes: Sequence[Axis], columns: Sequence[Float[np.ndarray, " recorded"]] | None
) -> tuple[list[Fact], OfAxes]:
    """Return facts about axes with coarsely rounded or repeated samples, and the step of each axis.

    `columns` are the samples of each axis, if they are in memory. The step [rad/s or m/s²] is 0 if none is
    detected.
    """
    repeated = np.average(windows.repeated, axis=0, weights=windows.count)
    rms = np.sqrt(windows.power[0].sum(axis=0) / max(windows.pairs[0].sum(), 1) / 2.0)
    if columns is None:
        steps = np.where(np.isfinite(windows.resolution), windows.resolution, 0.0)
    else:
        steps = np.array([lattice(x[:_LOOKED_AT]) or 0.0 for x in columns])
    # Behind a filter neighbours differ little, but the samples still pass through many steps.
    noise, apart = (x / np.where(steps > 0.0, steps, 1.0) for x in (rms_within(windows, _OCTAVES), rms))
    # Share of equal neighbours in rounded Gaussian noise.
    chance = np.where(apart > 0.0, 0.5 / np.sqrt(np.pi) / np.maximum(apart, 1e-12), 0.0) * (steps > 0.0)
    facts = []
    for k, axis in enumerate(axes):
        name, size = (axis.name,), float(noise[k])
        few = f"the noise of {axis.name} is {plain(size, 2)} steps of {amount(steps[k], axis, 3)}"
        if steps[k] > 0.0 and noise[k] < _TOO_FEW:
            fact = Fact("resolution", few, name, "not a measurement", size, "steps")
            means, remedy = "the coefficients describe the rounding", "record with a finer resolution"
            facts.append(dataclasses.replace(fact, meaning=means, remedy=remedy))
        elif repeated[k] > _HELD + 2.0 * chance[k]:
            text = f"{axis.name}: {100.0 * repeated[k]:.0f} % of the samples repeat the one before"
            fact = Fact("repeated samples", text, name, "none", float(repeated[k]), "1")
            means = (
                "the sensor updates more slowly than the file's rate, and content above its own rate is an "
                "artefact"
            )
            facts.append(dataclasses.replace(fact, meaning=means))
        elif steps[k] > 0.0 and noise[k] < _FEW_STEPS:
            means = "part of the noise is rounding, and the intervals of N are widened accordingly"
            facts.append(Fact("resolution", few, name, "widened", size, "steps", meaning=means))
    return facts, steps


def saturated(axes: Sequence[Axis], ends: Ends, steps: OfAxes) -> list[Fact]:
    """Return facts about axes with more samples at their largest or smallest value than a tail explains."""
    facts = []
    for side, k in np.argwhere(ends.piled_up(steps) & (ends.count >= _LEAST)):
        axis, share = axes[k], 100.0 * float(ends.count[side, k]) / ends.n
        level = amount((1.0, -1.0)[side] * ends.value[side, k], axis, 4)
        text = f"{axis.name} is at {level} in {plain(share, 2)} % of the samples"
        fact = Fact("saturation", text, (axis.name,), "not a measurement", share, "%")
        means, remedy = "its range ends there", "use a wider range, or remove the offset"
        facts.append(dataclasses.replace(fact, meaning=means, remedy=remedy))
    return facts


def sampling_facts(recording: Recording) -> Iterator[Fact]:
    """Yield facts about times, missing samples and dead axes."""
    if (jitter := recording.jitter) is not None and jitter * recording.rate > _JITTER:
        yield Fact(
            "jitter",
            describe_jitter(recording),
            recording.names,
            size=jitter,
            unit="s",
            meaning="samples are treated as evenly spaced",
            remedy="if the jitter is real, use the sensor's own time stamps",
        )
    if gaps := recording.gaps:
        rate, lost, longest = recording.rate, sum(g.samples for g in gaps), max(g.samples for g in gaps)
        count = f"{len(gaps)} gaps of at most" if len(gaps) > 1 else "a gap of"
        text = f"{lost:,} samples are missing in {count} {duration(longest / rate)}"
        spans = tuple((gap.first / rate, (gap.first + gap.samples) / rate) for gap in gaps)
        means: Consequence = "none" if recording.missing is None else "widened"
        names = recording.names
        if recording.missing is None:
            then = f"{1 + len(recording.others)} segments without gaps are used"
        else:
            wider = 100.0 * (float(widening(recording.missing).max()) - 1.0)
            then = f"they are filled in, which widens the intervals by {plain(wider, 2)} %"
            drawn = zip(names, recording.missing.T, strict=True)
            names = tuple(name for name, x in drawn if x.any())
        yield Fact("gaps", text, names, means, lost / rate, "s", spans, meaning=then)
    yield from dead_facts(recording.dead)


def dead_facts(dead: Sequence[DeadAxis]) -> Iterator[Fact]:
    """Yield facts about axes that do not change or have no samples."""
    for d in dead:
        means = "the sensor seems stuck or disconnected"
        finding = f"{d.axis.name}: {d.reason}"
        yield Fact("dead axes", finding, (d.axis.name,), "not a measurement", meaning=means)


def describe_jitter(recording: Recording) -> str:
    """Return the jitter in s and as a share of the interval, as text."""
    jitter = recording.jitter or 0.0
    share = plain(100.0 * max(jitter, 1e-9) * recording.rate, 2)
    return f"jitter {format_jitter(jitter)}, {share} % of the interval"


def temperatures(recording: Recording) -> dict[str, Samples]:
    """Return the temperature channels by name."""
    return {key: z for key, z in recording.auxiliary.items() if "temp" in key.lower()}


def temperature_facts(recording: Recording) -> Iterator[Fact]:
    """Yield facts about axes whose mean changes in proportion to a temperature between parts of the record.

    Increments of a random walk are independent, and those of white noise and flicker partly cancel: the t
    test of proportional increments is exact for the former and conservative for the latter. A test of the
    means themselves would find a slope between any two random walks.
    """
    size = recording.n // _PARTS or 1
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
                text = f"{axis.name} follows {key} ({drift} over its range)"
                yield Fact("temperature", text, (axis.name,), remedy=remedy)
