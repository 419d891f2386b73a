"""Probabilities of the units of gyros and accelerometers, given what both of them measure.

Bayes' rule: each pair of units has a prior probability, given what the labels state, and a likelihood: the
density of the noise, the mean and the resolution of real sensors in these units. So a label that is wrong for
one sensor puts that of the other in doubt, and so does noise that is strange beside that of the other.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Collection, Sequence
from functools import cached_property
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float

from allanjax.base.earth import EARTH_RATE, STANDARD_GRAVITY
from allanjax.base.wording import plain
from allanjax.inspection.facts import NOT_A_MEASUREMENT, Consequence, Fact
from allanjax.inspection.windows import DEG, OfAxes, Sampled, Windows, mean_squares
from allanjax.record.columns import names_of
from allanjax.record.recording import Axis, scales_of
from allanjax.record.units import COUNT_SIZES, SAMPLE_UNITS, SENSORS, Sensor, parse_sample_unit, unit_scale


class _Law(NamedTuple):
    """Density of a logarithm: even from low to high, with Gaussian shoulders of this standard deviation."""

    low: float
    high: float
    shoulder: float
    weight: float = 1.0

    def log_density(self, value: np.ndarray | float) -> np.ndarray:
        """Logarithm of the density times the weight."""
        x, (low, high) = np.log(value), np.log([self.low, self.high])
        off = (x - np.clip(x, low, high)) / self.shoulder
        return np.log(self.weight / (high - low + np.sqrt(2.0 * np.pi) * self.shoulder)) - 0.5 * off**2


_OfUnits: TypeAlias = Float[np.ndarray, " units"]
_Laws: TypeAlias = tuple[_Law, ...]

_COUNTS, _OTHER = "counts", "another unit"
# Units of gyros and accelerometers that programs write, and how often: a judgement.
_PAIRS = {
    ("deg/s", "g"): 0.33,
    ("rad/s", "m/s²"): 0.25,
    ("deg/s", "m/s²"): 0.1,
    (_COUNTS, _COUNTS): 0.08,
    ("rad/s", "g"): 0.05,
    ("mdeg/s", "mg"): 0.05,
    ("rad", "m/s"): 0.05,
    ("deg/s", "mg"): 0.03,
    ("deg", "m/s"): 0.03,
    ("deg/h", "µg"): 0.03,
    ("deg/h", "m/s²"): 0.02,
    (_OTHER, _OTHER): 0.02,
}
# Share of each unit that is not among them.
_SELDOM = 0.002
# Probability, a judgement, that both labels are those of a template which the data do not follow; the same if
# the user gave another unit than the label of one sensor.
_TEMPLATE, _ONE_WAS_WRONG = 0.01, 0.5
# Probability, a judgement, that a single label is wrong, and that a unit is wrong which the user gave.
_LABEL, _GIVEN = 0.005, 0.003
# Least probability of a unit that is not in doubt.
_TRUSTED = 0.8
# Factors by which a rate that belongs to increments may be wrong.
_RATES = (10.0, 0.1, 100.0, 0.01)

# Smaller sizes, such as the mean of a simulation, count as this one.
_ZERO = 1e-12
# Noise of gyros divided by that of accelerometers: units that were tested had 0.17 (fibre-optic gyros beside
# MEMS accelerometers) to 30, and a defective gyro may have four times as much.
_RATIO = _Law(0.13, 120.0, 0.1)
# Accelerometers with less noise are not MEMS, and may be beside better gyros.
_MEMS = 0.03
# Size of the mean of gyros [deg/s]: biases, or the earth's rate; of gyros that turn, up to their range.
_BIAS = (_Law(_ZERO, 9.5, 0.17, 0.95), _Law(0.98 * EARTH_RATE / DEG, 1.02 * EARTH_RATE / DEG, 0.01, 0.05))
_TURNING = (_Law(_ZERO, 4000.0, 0.5),)
# Size of the mean of accelerometers [g]. Three of them measure gravity within 5 %, as consumer sensors do, or
# are badly calibrated, or gravity was removed or not simulated.
_GRAVITY = _Law(0.95, 1.05, 0.01, 0.9)
_TRIAD = (_GRAVITY, _Law(0.8, 1.2, 1e-3, 0.05), _Law(_ZERO, 0.1, 0.02, 0.05))
# Fewer than three measure gravity or any part of it; in motion, there may be more.
_FEWER = (_Law(0.98, 1.02, 0.01, 0.3), _Law(_ZERO, 1.02, 0.05, 0.7))
_MOVING = (_GRAVITY, _Law(_ZERO, 30.0, 0.5, 0.1))
# Noise per sample and mean in counts: less than one to hundreds, and up to 24 bits.
_NOISE_COUNTS, _MEAN_COUNTS = (_Law(0.3, 300.0, 0.7),), (_Law(_ZERO, 2.0**24, 0.5),)
# A quantity in a unit that is not known.
_ANYWHERE = (_Law(_ZERO, 1e12, 1.0),)
# Relative precision of steps, and share of sensors that have one of the common steps.
_PRECISION, _COMMON = 1e-3, 0.1
# Noise is white if its Allan deviation times root of cluster time varies by less than this factor.
_FLAT = 6.0


class _Kind(NamedTuple):
    """What gyros, or accelerometers, are like.

    Attributes:
        plural: what they are called.
        usual: usual unit of samples, deg/s or g, in SI.
        root_hour, unit: usual unit of white noise, deg/√h or m/s/√h, in SI and in words.
        noise: law of the white noise in that unit.
        step: law of the step of the output in deg/s or g.
        common: steps of common sensors, which may be times any power of two.
    """

    plural: str
    usual: float
    root_hour: float
    unit: str
    noise: _Laws
    step: _Laws
    common: tuple[float, ...]


# Noise is from the best of navigation grade to consumer sensors of 1 mg/√Hz; steps of few bits are 0.07 deg/s
# and 31 mg. Common steps are 1/131 deg/s, 4.375 mdeg/s and 250 deg/s in 2¹⁵, and 1/16384 g and 0.061 mg.
_KINDS = {
    "gyro": _Kind(
        plural="gyros",
        usual=DEG,
        root_hour=DEG / 60.0,
        unit="deg/√h",
        noise=(_Law(2e-4, 4.0, 0.5),),
        step=(_Law(_ZERO, 0.1, 0.3),),
        common=(1.0 / 131.0, 4.375e-3, 250.0 / 2**15),
    ),
    "accel": _Kind(
        plural="accelerometers",
        usual=STANDARD_GRAVITY,
        root_hour=1.0 / 60.0,
        unit="m/s/√h",
        noise=(_Law(1e-3, 0.6, 0.5),),
        step=(_Law(_ZERO, 0.04, 0.3),),
        common=(1.0, 0.061e-3),
    ),
}


class _Units(NamedTuple):
    """Units that samples may be in, that of the label first.

    Attributes:
        names: the units; "--rate 10" for increments at that rate.
        factors: factor of samples in each unit to samples as read; nan if it is unknown.
        usual: how often programs write each.
    """

    names: tuple[str, ...]
    factors: _OfUnits
    usual: _OfUnits


@dataclasses.dataclass(frozen=True)
class _Shown:
    """What the axes of one sensor show.

    Attributes:
        axes: the axes, of one sensor.
        rate: sample rate [Hz].
        noise: upper bound of the white noise, as read [rad/√s or m/s/√s].
        mean: size of the mean of all axes [rad/s or m/s²]; None for a curve.
        step: step of the output [rad/s or m/s²], the same on all axes; 0 if there is none.
        moves: whether motion may add to the noise and the mean.
        given: factor from the unit of the labels to the one that the user gave, 1 without labels; None if the
            user gave none.
    """

    axes: Sequence[Axis]
    rate: float
    noise: float
    mean: float | None = None
    step: float = 0.0
    moves: bool = False
    given: float | None = None

    @property
    def sensor(self) -> Sensor:
        """Gyro or accel."""
        return self.axes[0].sensor

    @property
    def kind(self) -> _Kind:
        """What sensors of this kind are like."""
        return _KINDS[self.sensor]

    @property
    def unit(self) -> str:
        """Unit of the samples as read."""
        return parse_sample_unit(self.axes[0].unit, self.sensor).name

    @property
    def scale(self) -> float:
        """Factor from the numbers of the record to SI, as read."""
        return float(scales_of(self.axes[:1], self.rate)[0])

    @property
    def random_walk(self) -> float:
        """White noise, as read [deg/√h or m/s/√h]."""
        return self.noise / self.kind.root_hour

    def noise_in(self, factor: float) -> str:
        """The noise if samples are this many times as large as read, as text."""
        return f"{plain(factor * self.random_walk, 3)} {self.kind.unit}"

    @cached_property
    def units(self) -> _Units:
        """Units that the samples may be in."""
        own = parse_sample_unit(self.axes[0].unit, self.sensor)
        factors = {own.name: 1.0}
        for quantity, names in SAMPLE_UNITS[self.sensor].items():
            # A curve is of rates.
            if quantity == "rate" or self.mean is not None:
                per = (self.rate if quantity == "increment" else 1.0) / self.scale
                factors |= {name: unit_scale(name) * per for name in names if name != own.name}
        step = self.step / self.scale
        if step > 0.5 and abs(step - round(step)) < _PRECISION:
            factors[_COUNTS] = np.nan
        factors[_OTHER] = np.nan
        usual = dict.fromkeys(factors, _SELDOM)
        for pair, share in _PAIRS.items():
            name = pair[SENSORS.index(self.sensor)]
            if name in usual:
                usual[name] += share
        if own.quantity == "increment" and self.sensor == "accel":
            wrong = {f"--rate {self.rate / ratio:g}": 1.0 / ratio for ratio in _RATES}
            factors, usual = factors | wrong, usual | dict.fromkeys(wrong, 1.0)
        return _Units(tuple(factors), np.array([*factors.values()]), np.array([*usual.values()]))


def units_of_record(sampled: Sampled, part: Windows, steps: OfAxes, moving: Collection[Sensor]) -> list[Fact]:
    """Return facts about units that are in doubt in a recording or stream.

    Args:
        sampled: the recording or stream.
        part: windows of its longest part.
        steps: step of the output of each axis [rad/s or m/s²]; 0 for none.
        moving: sensors that seem to move, or are meant to.
    """
    axes, rate = sampled.axes, sampled.rate
    # Allan deviation times the root of the cluster time, for cluster times up to a second.
    time = 2.0 ** np.arange(len(part.power)) / rate
    known = part.pairs.any(axis=1) & (time <= max(1.0, time[0]))
    white = np.sqrt(np.nanmean(mean_squares(part)[known], axis=1) / 2.0 * time[known, None])
    least, most = white.min(axis=0), white.max(axis=0)
    facts = []
    for pair in itertools.zip_longest(*(groups(axes, sensor) for sensor in SENSORS)):
        shown = []
        for which in filter(None, pair):
            own, step = [axes[k] for k in which], steps[which]
            noise, size = float(np.median(least[which])), float(np.linalg.norm(part.average[which]))
            alike = float(step[0]) if np.allclose(step, step[0], rtol=_PRECISION, atol=0.0) else 0.0
            # Motion is not white, but noise in another unit still is.
            flat = np.median((most - _FLAT * least)[which]) < 0.0
            moves = "accel" in moving or ("gyro" in moving and not flat)
            shown.append(_Shown(own, rate, noise, size, alike, moves, sampled.given.get(own[0].sensor)))
        facts += _doubts(shown)
    return facts


def units_of_curve(
    axes: Sequence[Axis],
    time: Float[np.ndarray, " m"],
    deviation: Float[np.ndarray, "m axes"],
    given: Collection[Sensor],
) -> list[Fact]:
    """Return facts about units that are in doubt in Allan deviations [rad/s or m/s²] at cluster times [s].

    `given` are the sensors whose unit the user gave.
    """
    short = time <= max(1.0, time[0])
    white = (deviation * np.sqrt(time)[:, None])[short].min(axis=0)
    shown = []
    for sensor in SENSORS:
        own = [axis for axis in axes if axis.sensor == sensor]
        if own:
            noise = np.median([x for x, axis in zip(white, axes, strict=True) if axis.sensor == sensor])
            shown.append(_Shown(own, 1.0 / time[0], float(noise), given=1.0 if sensor in given else None))
    return _doubts(shown)


def groups(axes: Sequence[Axis], sensor: Sensor) -> list[list[int]]:
    """Return the axes of each gyro or accelerometer: indices of names that differ only in the last letter."""
    found: dict[str, list[int]] = {}
    for k, axis in enumerate(axes):
        if axis.sensor == sensor:
            found.setdefault(axis.name.rstrip("xyz"), []).append(k)
    return list(found.values())


def _doubts(shown: Sequence[_Shown]) -> list[Fact]:
    """Return facts about units that are in doubt: of gyros, of accelerometers, or of both in this order."""
    alone = [_log_likelihood(x) for x in shown]
    if len(shown) == 1:
        odds = [_normalised(alone[0] + np.log(_prior(shown[0], _TEMPLATE + _LABEL)))]
    else:
        joint = _normalised(np.add.outer(*alone) + _log_ratio(*shown) + np.log(_joint_prior(*shown)))
        odds = [joint.sum(axis=1), joint.sum(axis=0)]
    facts = []
    for k, x in enumerate(shown):
        if odds[k][0] >= _TRUSTED:
            continue
        # Against a user's word, whole numbers alone are no evidence of counts.
        beside = all(of[0] >= _TRUSTED for j, of in enumerate(odds) if j != k)
        told = dataclasses.replace(x, step=0.0) if x.given is not None and beside else x
        trusting = _prior(dataclasses.replace(told, given=1.0), 0.0)
        impossible = bool(_normalised(_log_likelihood(told) + np.log(trusting))[0] < _TRUSTED)
        found = _finding(x) + "".join(_beside(shown[j], odds[j]) for j in range(len(shown)) if j != k)
        meaning, remedy = _advice(x, odds[k], impossible)
        # The mean of one or two accelerometers depends on their tilt. A unit that the user gave is refused if
        # the sensor itself cannot have it, whatever the other sensor shows.
        tilted = x.sensor == "accel" and x.mean is not None and len(x.axes) < 3
        sure = not tilted and (impossible or x.given is None)
        means: Consequence = NOT_A_MEASUREMENT if sure else "none"
        names = names_of(x.axes)
        facts.append(Fact(f"{x.sensor} unit", found, names, means, meaning=meaning, remedy=remedy))
    return facts


# --- Probabilities -----------------------------------------------------------------------------------------


def _prior(x: _Shown, wrong: float) -> _OfUnits:
    """Return the probabilities of units before what the sensor shows; `wrong` is that of a wrong label."""
    wrong = wrong if x.given is None else _GIVEN
    prior = wrong * x.units.usual / x.units.usual.sum()
    prior[0] += 1.0 - wrong
    return prior


def _joint_prior(gyro: _Shown, accel: _Shown) -> Float[np.ndarray, "gyro accel"]:
    """Return the probabilities of the units of both sensors before what they show."""
    pairs = [[_PAIRS.get((a, b), _SELDOM**2) for b in accel.units.names] for a in gyro.units.names]
    usual = np.array(pairs)
    given = [x.given for x in (gyro, accel) if x.given is not None]
    template = 0.0 if given else _TEMPLATE
    if len(given) == 1 and abs(given[0] - 1.0) > _PRECISION:
        template = _ONE_WAS_WRONG
        (usual if accel.given is None else usual.T)[1:] = 0.0
    single = np.outer(_prior(gyro, _LABEL), _prior(accel, _LABEL))
    return (1.0 - template) * single + template * usual / usual.sum()


def _log_likelihood(x: _Shown) -> _OfUnits:
    """Return the log-likelihood of each unit from what the sensor itself shows."""
    names, factors = np.array(x.units.names), x.units.factors
    known = np.isfinite(factors)

    def of(size: float, laws: _Laws, number: float, laws_of_counts: _Laws) -> _OfUnits:
        sizes = np.maximum(np.where(known, size * factors, 1.0), _ZERO)
        likely = np.where(names == _OTHER, _mixture(_ANYWHERE, 1.0), _mixture(laws, sizes))
        return np.where(names == _COUNTS, _mixture(laws_of_counts, max(number, _ZERO)), likely)

    found = np.zeros(len(names))
    if x.noise > 0.0:
        laws = x.kind.noise
        if x.moves:
            # All of it may be motion, as read; more in another unit needs more motion.
            laws = tuple(law._replace(high=max(law.high, x.random_walk)) for law in laws)
        found += of(x.random_walk, laws, x.noise * np.sqrt(x.rate) / x.scale, _NOISE_COUNTS)
    if x.mean:
        found += of(x.mean / x.kind.usual, _means(x), x.mean / x.scale, _MEAN_COUNTS)
    if x.step > 0.0:
        steps = np.where(known, x.step * factors / x.kind.usual, 1e-9)
        octaves = np.log2(steps[:, None] / x.kind.common)
        precision = _PRECISION / np.log(2.0)
        common = (abs(octaves - np.rint(octaves)) < precision).any(axis=1) & known
        by_chance = 2.0 * precision * octaves.shape[1]
        found += np.log(1.0 - _COMMON + _COMMON * common / by_chance) + _mixture(x.kind.step, steps)
    return found


def _means(x: _Shown) -> _Laws:
    """Return the law of the size of the mean [deg/s or g]."""
    if x.sensor == "gyro":
        return _TURNING if x.moves else _BIAS
    if x.moves:
        return _MOVING
    return _TRIAD if len(x.axes) >= 3 else _FEWER


def _log_ratio(*shown: _Shown) -> Float[np.ndarray, "gyro accel"]:
    """Return the log-likelihood of pairs of units from the ratio of the white noise of the sensors.

    It is zero within the range of the ratio: that each noise is one that sensors have is counted already.
    """
    gyro, accel = (x.random_walk * x.units.factors for x in shown)
    if any(x.moves or not x.noise for x in shown):
        return np.zeros((len(gyro), len(accel)))
    ratio = gyro[:, None] / accel
    ratio = np.maximum(ratio, np.minimum(ratio / np.minimum(accel / _MEMS, 1.0), 1.0))
    return np.nan_to_num(_RATIO.log_density(ratio) - _RATIO.log_density(1.0))


def _mixture(laws: _Laws, value: _OfUnits | float) -> _OfUnits:
    """Logarithm of the density of a mixture."""
    return np.logaddexp.reduce([law.log_density(value) for law in laws])


def _normalised(log_odds: np.ndarray) -> np.ndarray:
    """Return probabilities from their logarithms up to a constant."""
    odds = np.exp(log_odds - log_odds.max())
    return odds / odds.sum()


# --- Words -------------------------------------------------------------------------------------------------


def _finding(x: _Shown) -> str:
    """Return what the sensor shows, as read."""
    head, noise = f"as read ({x.unit}) the {x.kind.plural}", x.noise_in(1.0)
    if x.mean is None:
        return f"{head} have {noise} of noise"
    mean = f"{plain(x.mean / DEG, 3)} deg/s"
    if x.sensor == "accel":
        gravity = f"{STANDARD_GRAVITY / x.scale:.4g} {x.unit}"
        mean = f"{x.mean / x.scale:.4g} {x.unit} (gravity is {gravity})"
    return f"{head} average {mean} with {noise} of noise"


def _beside(x: _Shown, odds: _OfUnits) -> str:
    """Return what the other sensor shows, or that its own label is wrong, and by which factor."""
    best, given = int(np.argmax(odds)), x.given or 1.0
    if best > 0:
        factor = x.units.factors[best]
        by = f" (a factor of {plain(factor, 4)})" if np.isfinite(factor) else ""
        return f", and the {x.kind.plural} are probably in {x.units.names[best]}, not {x.unit}{by}"
    if abs(given - 1.0) < _PRECISION:
        return f", beside {x.kind.plural} with {x.noise_in(1.0)}"
    return f", and the label of the {x.kind.plural} is wrong by a factor of {plain(given, 4)}"


def _advice(x: _Shown, odds: _OfUnits, impossible: bool) -> tuple[str, str]:
    """Return the probable unit, and what to do."""
    best, option = 1 + int(np.argmax(odds[1:])), f"--{x.sensor}-unit"
    name, factor = x.units.names[best], x.units.factors[best]
    if name == _OTHER:
        wide = "" if x.sensor == "gyro" else ", and is the range wide enough"
        return "no usual unit makes that plausible", f"is the unit right ({option}){wide}?"
    if name == _COUNTS:
        size = COUNT_SIZES[x.sensor]
        return "they are whole numbers, probably counts", f"give the size of one with {option}, e.g. {size}"
    if name.startswith("--rate"):
        return f"the rate is probably {name.removeprefix('--rate ')} Hz", f"pass {name}"
    likely = "probably" if odds[best] > 0.5 else "perhaps"
    told = f"the unit is {likely} {name} (a factor of {plain(factor, 4)})"
    remedy = f"pass {option} {name.replace('²', '^2')}"
    if x.given is None:
        own = f"{option} {x.unit.replace('²', '^2')} if that is right"
        remedy += f", or {'correct the unit in the header' if impossible else own}"
    return f"{told}, in which the noise is {x.noise_in(factor)}", remedy
