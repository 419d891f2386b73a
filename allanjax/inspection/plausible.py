"""Plausibility of samples and times: rate, resolution, range, jitter, gaps."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from itertools import compress

import numpy as np
from jaxtyping import Bool, Float, Int

from allanjax.base.wording import duration, plain
from allanjax.inspection.facts import NOT_A_MEASUREMENT, Fact, amount
from allanjax.inspection.windows import OfAxes, Sampled, Samples, Values, Windows, mean_square, rms_within
from allanjax.record.columns import names_of
from allanjax.record.completion import Gap, widening
from allanjax.record.io.grid import format_jitter
from allanjax.record.recording import Axis, DeadAxis, Recording

# Possible units [s] of a column of times.
_TIMES = {"s": 1.0, "ms": 1e-3, "µs": 1e-6, "ns": 1e-9}
# Relative difference beyond which time stamps contradict the rate.
_SAME_RATE = 0.05
# Samples from which the interval of a column of times is determined.
_COUNTED = 1 << 14
#: Shorter recordings [s] hold little information on B and K, which show over tens of seconds.
SHORT = 60.0
# Shorter ones [s], and higher rates [Hz], are no records of inertial sensors.
_HARDLY, _HIGHEST_RATE = 1.0, 5e4
#: Lower rates [Hz] are rather those of a clock that was misread.
LOWEST_RATE = 0.99
_WRONG_TIMES = "if the unit of the times is wrong, pass --time-unit, or --rate"
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


def rate_facts(sampled: Sampled, auxiliary: Mapping[str, Samples]) -> list[Fact]:
    """Return a fact about a rate that no sensor has, or that an unused column of times contradicts."""
    finding, remedy = f"the rate is {sampled.rate:g} Hz, which no inertial sensor has", _WRONG_TIMES
    if sampled.rate < LOWEST_RATE:
        slow = f"the rate is {sampled.rate:g} Hz, which hardly any inertial sensor has"
        return [Fact("rate", slow, names_of(sampled.axes), meaning="units are not checked", remedy=remedy)]
    if sampled.rate <= _HIGHEST_RATE:
        finding, remedy = _contradiction(sampled.rate, auxiliary)
    names = names_of(sampled.axes)
    return [Fact("rate", finding, names, NOT_A_MEASUREMENT, remedy=remedy)] if finding else []


def _contradiction(rate: float, auxiliary: Mapping[str, Samples]) -> tuple[str, str]:
    """Return the rate that an unused column of times implies, if it is another one, and what to do."""
    for name, column in auxiliary.items():
        if not ("time" in name.lower() or name.lower() in ("t", "stamp")):
            continue
        step = float(np.median(np.diff(np.asarray(column, float)[:_COUNTED])))
        if not (np.isfinite(step) and step > 0.0):
            continue
        rates = {1.0 / (step * size): unit for unit, size in _TIMES.items()}
        nearest = min(rates, key=lambda r: abs(np.log(r / rate)))
        if abs(nearest / rate - 1.0) > _SAME_RATE:
            implied = f"column {name!r} implies {nearest:.4g} Hz (if in {rates[nearest]})"
            remedy = (
                f"if the rate is wrong, use the column with --time {name}, or its rate with --time none "
                f"--rate {nearest:.6g} (rate={nearest:.6g})"
            )
            return f"the rate is {rate:g} Hz, but {implied}", remedy
    return "", ""


def short(n: int, sampled: Sampled) -> Iterator[Fact]:
    """Yield a fact about n samples if they are few or last a short time."""
    length, names = n / sampled.rate, names_of(sampled.axes)
    if length < _HARDLY:
        text = f"{n:,} samples last {length:.3g} s only"
        yield Fact("length", text, names, size=length, unit="s", remedy=_WRONG_TIMES)
    elif length < SHORT or n < _FEW_SAMPLES:
        text = f"{length:.3g} s is too short for B and K, which show over tens of seconds or more"
        few = f"with {n} samples, N is known to ±{100.0 / np.sqrt(n):.0f} % at best"
        yield Fact("length", text, names, size=length, unit="s", meaning=few * (n < _FEW_SAMPLES))


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

    The sides are the upper end, and the lower end with changed signs.

    Attributes:
        n: number of samples.
        value, count: the largest and second largest value, and the number of samples with each.
        runs: the number of runs of samples with the largest value.
    """

    n: int
    value: Float[np.ndarray, "2 sides axes"]
    count: Int[np.ndarray, "2 sides axes"]
    runs: Int[np.ndarray, "sides axes"]

    @classmethod
    def of(cls, values: Values) -> Ends:
        """Return the ends of the range of these samples."""
        sides = np.stack([values, -values])
        value, where = _two_largest(sides, 1)
        at = where[0]
        runs = at[:, :1].sum(axis=1) + (at[:, 1:] & ~at[:, :-1]).sum(axis=1)
        return cls(len(values), value, np.stack([each.sum(axis=1) for each in where]), runs)

    def merge(self, right: Ends) -> Ends:
        """Return the ends of the range of two pieces together."""
        value, where = _two_largest(np.concatenate([self.value, right.value]), 0)
        counts = np.concatenate([self.count, right.count])
        count = np.stack([(counts * each).sum(axis=0) for each in where])
        runs = sum(x.runs * (x.value[0] == value[0]) for x in (self, right))
        return Ends(self.n + right.n, value, count, runs)

    def of_axes(self, keep: Bool[np.ndarray, " axes"]) -> Ends:
        """Return the ends for some of the axes."""
        return Ends(self.n, self.value[..., keep], self.count[..., keep], self.runs[:, keep])

    def piled_up(self, steps: OfAxes) -> Bool[np.ndarray, "sides axes"]:
        """Whether more samples are at an end than a tail explains, given each axis's step (0 for none)."""
        (value, below), (count, count_below) = self.value, self.count
        # Copies of a single extreme sample do not count.
        often = (self.runs >= _LEAST) | (count >= _MANY)
        tail = np.where(abs(value - steps - below) < steps / 2.0, count_below, 0)
        beyond = (count > tail + 6.0 * np.sqrt(tail + 1.0)) & (count >= 5 * _LEAST)
        has_tail = value.sum(axis=0) >= _FEW_LEVELS * steps
        return np.where(steps > 0.0, beyond & has_tail, often)


def _two_largest(x: np.ndarray, axis: int) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Return the largest and second largest values along an axis, and where they are."""
    largest = x.max(axis=axis, keepdims=True, initial=-np.inf)
    at = x == largest
    others = np.where(at, -np.inf, x)
    second = others.max(axis=axis, keepdims=True, initial=-np.inf)
    return np.stack([largest, second]).squeeze(axis + 1), (at, others == second)


def resolved(windows: Windows, axes: Sequence[Axis], steps: OfAxes) -> Iterator[Fact]:
    """Yield facts about axes with coarsely rounded or repeated samples; the step of others is 0."""
    repeated = windows.averaged(windows.repeated)
    rms = np.sqrt(mean_square(windows)[0] / 2.0)
    # Behind a filter neighbours differ little, but the samples still pass through many steps.
    within = rms_within(windows, _OCTAVES)
    noise = np.divide(within, steps, out=np.full(len(steps), np.inf), where=steps > 0.0)
    # Share of equal neighbours in rounded Gaussian noise.
    chance = 0.5 / np.sqrt(np.pi) * np.divide(steps, rms, out=np.zeros(len(steps)), where=rms > 0.0)
    for k, axis in enumerate(axes):
        name, size = (axis.name,), float(noise[k])
        few = f"the noise of {axis.name} is {plain(size, 2)} steps of {amount(steps[k], axis, 3)}"
        if size < _TOO_FEW:
            means, cure = "the coefficients describe the rounding", "record with a finer resolution"
            yield Fact("resolution", few, name, NOT_A_MEASUREMENT, size, "steps", meaning=means, remedy=cure)
        elif repeated[k] > _HELD + 2.0 * chance[k]:
            text = f"{axis.name}: {100.0 * repeated[k]:.0f} % of the samples repeat the one before"
            means = (
                "the sensor updates more slowly than the file's rate, and content above its own rate is an "
                "artefact"
            )
            yield Fact("repeated samples", text, name, size=float(repeated[k]), unit="1", meaning=means)
        elif size < _FEW_STEPS:
            means = "part of the noise is rounding, and the intervals of N are widened accordingly"
            yield Fact("resolution", few, name, "widened", size, "steps", meaning=means)


def saturated(axes: Sequence[Axis], ends: Ends, steps: OfAxes) -> Iterator[Fact]:
    """Yield facts about axes with more samples at their largest or smallest value than a tail explains."""
    for side, k in np.argwhere(ends.piled_up(steps)):
        axis, share = axes[k], 100.0 * float(ends.count[0, side, k]) / ends.n
        level = amount((1.0, -1.0)[side] * ends.value[0, side, k], axis, 4)
        yield Fact(
            "saturation",
            f"{axis.name} is at {level} in {plain(share, 2)} % of the samples",
            (axis.name,),
            NOT_A_MEASUREMENT,
            size=share,
            unit="%",
            meaning="its range ends there",
            remedy="use a wider range, or remove the offset",
        )


def sampling_facts(recording: Recording) -> Iterator[Fact]:
    """Yield facts about times, missing samples and dead axes."""
    jitter = recording.jitter or 0.0
    if jitter * recording.rate > _JITTER:
        yield Fact(
            "jitter",
            describe_jitter(recording),
            recording.names,
            size=jitter,
            unit="s",
            meaning="samples are treated as evenly spaced",
            remedy="if the jitter is real, use the sensor's own time stamps",
        )
    if recording.gaps:
        yield _gaps(recording, recording.gaps)
    yield from dead_facts(recording.dead)


def _gaps(recording: Recording, gaps: Sequence[Gap]) -> Fact:
    """Return the fact about missing samples."""
    rate, lost = recording.rate, sum(gap.samples for gap in gaps)
    count = f"{len(gaps)} gaps of at most" if len(gaps) > 1 else "a gap of"
    longest = duration(max(gap.samples for gap in gaps) / rate)
    text = f"{lost:,} samples are missing in {count} {longest}"
    spans = tuple((gap.first / rate, (gap.first + gap.samples) / rate) for gap in gaps)
    if recording.missing is None:
        then = f"{1 + len(recording.others)} segments without gaps are used"
        return Fact("gaps", text, recording.names, "none", lost / rate, "s", spans, meaning=then)
    wider = 100.0 * (float(widening(recording.missing).max()) - 1.0)
    then = f"they are filled in, which widens the intervals by {plain(wider, 2)} %"
    names = tuple(compress(recording.names, np.any(recording.missing, axis=0).tolist()))
    return Fact("gaps", text, names, "widened", lost / rate, "s", spans, meaning=then)


def dead_facts(dead: Sequence[DeadAxis]) -> Iterator[Fact]:
    """Yield facts about axes that do not change or have no samples."""
    means = "the sensor seems stuck or disconnected"
    for axis, reason in ((d.axis.name, d.reason) for d in dead):
        yield Fact("dead axes", f"{axis}: {reason}", (axis,), NOT_A_MEASUREMENT, meaning=means)


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
