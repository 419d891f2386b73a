"""Noise models of sensor axes and the uncertainty of their powers, from a fit, a posterior, or as given."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TypeAlias, cast

import numpy as np
from jaxtyping import Float, Int

from allanjax.base.errors import AllanjaxError, FitError
from allanjax.estimate.likely_models import Likely, exact_model, side_by_side
from allanjax.estimate.result import Fit
from allanjax.noise.datasheet import NOT_GIVEN, RATE, DataSheet
from allanjax.noise.estimate import title_of
from allanjax.noise.model import Model
from allanjax.noise.notation import ModelLike, as_model
from allanjax.posterior.result import AxisPosterior, Posterior
from allanjax.record.columns import recognise
from allanjax.record.recording import Axis
from allanjax.record.units import SI, Sensor, convert, parse_quantity

# Draws of the powers; of a posterior with shapes, each of which is a model of its own, fewer.
_DRAWS, _SHAPES = 400, 100
# Least probability of a set of terms that counts, and for which an interval has to hold by itself.
_LIKELY = 0.05


class Drawn(NamedTuple):
    """A quantity that is linear in the powers of the terms of an axis.

    An average over sets of terms would hide the tails of a set with a probability of 10 % beyond the
    interval's ends. So each end is that of the set of terms for which it is outermost.

    Attributes:
        mean: means of the detected terms, averaged over sets of terms; by the term's title.
        known: draws of the sum of the detected terms, for the set whose lower end is lowest.
        upper: the same including terms that are only known to be below a limit, for the set whose upper end
            is highest.
        correlation: what the total has besides the sum of the means, as some of these are of causes that are
            correlated; perhaps negative.
        is_bound: whether the quantity is at least this, as its source does not give all that it comes from.
    """

    mean: Mapping[str, Float[np.ndarray, ...]]
    known: Float[np.ndarray, "draws ..."]
    upper: Float[np.ndarray, "draws ..."]
    correlation: Float[np.ndarray, ...] | float = 0.0
    is_bound: bool = False

    @property
    def total(self) -> Float[np.ndarray, ...]:
        """The mean of all detected terms, with other causes."""
        return sum(self.mean.values(), np.zeros_like(self.known[0]) + self.correlation)

    def plus(
        self, causes: Mapping[str, Float[np.ndarray, ...]], all_of_them: Float[np.ndarray, ...]
    ) -> Drawn:
        """With known values of other causes: each by itself, by its title, and all of them together."""
        mean = {**self.mean, **{title: part for title, part in causes.items() if np.any(part > 0.0)}}
        correlation = all_of_them - sum(causes.values())
        known, upper = self.known + all_of_them, self.upper + all_of_them
        return Drawn(mean, known, upper, correlation, self.is_bound)


class AxisNoise(NamedTuple):
    """Noise of an axis: sets of terms with draws of their powers, and which of N, B and K are not given."""

    axis: Axis
    sets: Sequence[Likely]
    lacking: tuple[str, ...] = ()

    @property
    def drifts(self) -> bool:
        """Whether it has what a drift comes from: B or K at least."""
        return not {"B", "K"} <= {*self.lacking}

    def drawn(self, of_term: Callable[[Model], Float[np.ndarray, ...]]) -> Drawn:
        """Draws of a quantity, given its value for a term of unit amplitude by itself."""
        labels, terms, power, detected, _ = side_by_side(self.sets)
        # Models that differ in their shapes only are one set. Sets that are too unlikely for the interval are
        # not in the mean, which would else lie outside.
        names = [likely.labels for likely in self.sets]
        of = np.repeat([names.index(own) for own in names], [len(likely.power) for likely in self.sets])
        draws = np.bincount(of)[of]
        kept = draws >= min(_LIKELY * len(of), draws.max())
        power, of = power[kept], of[kept]
        each, mean = np.stack([of_term(term) for term in terms]), dict[str, np.ndarray]()
        for k in np.flatnonzero(detected & power.any(axis=0)).tolist():
            title = f"{self.axis.name} {title_of(labels[k], self.axis.sensor)}"
            mean[title] = mean.get(title, 0.0) + power[:, k].mean() * each[k]
        known = np.tensordot(power[:, detected], each[detected], axes=1)
        upper = np.tensordot(power, each, axes=1)
        ends = _outermost(known, of, 0.025), _outermost(upper, of, 0.975)
        return Drawn(mean, *ends, is_bound=bool(self.lacking))


def _outermost(
    draws: Float[np.ndarray, "draws ..."], of: Int[np.ndarray, " draws"], probability: float
) -> Float[np.ndarray, "kept ..."]:
    """Draws of the set of terms whose quantile is the outermost, the draws of each set repeated."""
    sets = [draws[of == k] for k in np.unique(of)]
    ends = np.stack([np.quantile(own, probability, axis=0) for own in sets])
    best = ends.argmin(axis=0) if probability < 0.5 else ends.argmax(axis=0)
    filled = np.stack([own[np.arange(_DRAWS) * len(own) // _DRAWS] for own in sets])
    return np.take_along_axis(filled, best[None, None], axis=0)[0]


class Sensors(NamedTuple):
    """Axes of gyros and accelerometers with their noise.

    Attributes:
        name: the recording's name.
        rate: sample rate [Hz].
        record: length of the fitted record [s]; infinite for given models.
        estimated: whether the powers were estimated, and have intervals.
        axes: noise by the name of the axis.
        notes: what is left out or not given, and why.
    """

    name: str
    rate: float
    record: float
    axes: Mapping[str, AxisNoise]
    notes: tuple[str, ...]
    estimated: bool = False

    def ends(self, drawn: Drawn) -> tuple[np.ndarray, np.ndarray]:
        """Ends of the central 95 % interval of a quantity: the lower from detected terms, the upper from all.

        Both ends are nan if the models are taken as exact. The upper end is infinite if the quantity is only
        a lower bound.
        """
        if not self.estimated:
            return (np.full_like(drawn.total, np.nan),) * 2
        low, high = np.quantile(drawn.known, 0.025, axis=0), np.quantile(drawn.upper, 0.975, axis=0)
        return low, np.full_like(high, np.inf) if drawn.is_bound else high

    def along(self, sensor: Sensor, letter: str) -> AxisNoise | None:
        """The axis of this sensor along x, y or z; one without a letter stands for all three."""
        own = [noise for noise in self.axes.values() if noise.axis.sensor == sensor]
        for noise in own:
            if noise.axis.name.endswith(f"_{letter}"):
                return noise
        return next((noise for noise in own if "_" not in noise.axis.name), None)


#: Sources of the errors of sensors: a fit, a posterior, a data sheet, or models by the names of axes.
NoiseLike: TypeAlias = Fit | Posterior | DataSheet | Mapping[str, ModelLike]


def sensors_of(data: NoiseLike, rate: float | None, seed: int) -> Sensors:
    """Axes with draws of their likely models, or with given models, which are taken as exact."""
    if isinstance(data, Fit | Posterior):
        if rate is not None:
            raise AllanjaxError("rate= is for models only, as a fit has its own sample rate; leave it out")
        fit, rng = data.fit if isinstance(data, Posterior) else data, np.random.default_rng(seed)
        noise = {}
        for own in (data[name] for name, r in fit.items() if r.measured and name in data):
            if isinstance(own, AxisPosterior):
                # Draws with equal shapes are one set; terms that were not sampled are left out.
                fixed = all(own.coefficients[label].is_amplitude for label in own.labels)
                models = own.models(_DRAWS if fixed else _SHAPES)
                sets = [exact_model(*models)] if fixed else list(map(exact_model, models))
            else:
                sets = fit.stated(own.axis.name).models(_DRAWS, rng)
            noise[own.axis.name] = AxisNoise(own.axis, sets, fit[own.axis.name].lacking)
        if not noise:
            raise FitError("no axis is a measurement of the sensor; allanjax characterize prints the reasons")
        others = [(r.axis, r.verdict) for r in fit.values() if not r.measured]
        others += [(dead.axis, dead.reason) for dead in fit.dead]
        told = [f"{axis.name} is left out: {why}" for axis, why in others]
        white = ", ".join(name for name, axis in noise.items() if axis.lacking)
        if white:
            told.append(f"{white}: B and K {NOT_GIVEN} by the terms of the fit; fit others (--terms)")
        curve, left_out = fit.curve, (*told, *fit.curve.unknown)
        return Sensors(fit.name, curve.rate, curve.n / curve.rate, noise, left_out, curve.determined)
    name, notes, lacking = "", tuple[str, ...](), dict[str, tuple[str, ...]]()
    if isinstance(data, DataSheet):
        name, notes, rate = data.name, data.statements, RATE if rate is None else rate
        lacking = {str(sensor): data.lacking(sensor) for sensor in data.models}
        data = cast(Mapping[str, ModelLike], data.models)
    if not isinstance(data, Mapping) or not data:
        raise AllanjaxError(
            "give a fit, a posterior, a data sheet, or models by axis, e.g. "
            '{"gyro_x": "N=0.1 deg/√h", "accel_x": "N=0.01 m/s/√h"}'
        )
    if rate is None or not 0.0 < rate < np.inf:
        raise AllanjaxError(f"models need a sample rate: give a positive rate in Hz, not {rate}")
    given = cast(Mapping[str, ModelLike], data)
    exact = {axis: _exact(axis, model, lacking.get(axis, ())) for axis, model in given.items()}
    return Sensors(name, float(rate), np.inf, exact, notes)


def _exact(name: str, model: ModelLike, lacking: tuple[str, ...]) -> AxisNoise:
    """Noise of an axis whose model is taken as exact."""
    column = recognise(name)
    if column.sensor is None:
        raise AllanjaxError(f"{name!r} is not an axis of a gyro or accelerometer; use names such as gyro_x")
    complete = as_model(model, [column])
    complete.check_complete()
    if not complete.terms:
        raise AllanjaxError(f"{name}: a model without terms has no errors; leave the axis out")
    axis = Axis(name, column.sensor, SI[column.sensor]["rate"])
    return AxisNoise(axis, [exact_model(complete)], lacking)


def in_si(value: float | str, unit: str, name: str, sensor: Sensor | None = None) -> float:
    """Value in this SI unit, from a number in that unit or a text with a unit, e.g. "0.2 deg/h"."""
    number, text = value, unit
    if isinstance(value, str):
        quantity = parse_quantity(value)
        if quantity is None:
            raise AllanjaxError(f"{name}: cannot read {value!r}; write a number and a unit, e.g. 0.1 {unit}")
        number, text = quantity
    if not 0.0 <= float(number) < np.inf:
        raise AllanjaxError(f"{name} must be finite and at least 0, not {value}")
    return float(convert(float(number), text, unit, sensor))


def biases_of(gyro_bias: float | str, accel_bias: float | str) -> dict[Sensor, float]:
    """Standard deviations of biases by sensor [SI], see `in_si`."""
    given: dict[Sensor, float | str] = {"gyro": gyro_bias, "accel": accel_bias}
    return {s: in_si(bias, SI[s]["rate"], f"{s}_bias", s) for s, bias in given.items()}


def together(parts: Sequence[Drawn]) -> Drawn:
    """Sum of independent quantities."""
    mean = {title: part for drawn in parts for title, part in drawn.mean.items()}
    # Repeated draws must not be paired.
    order = [np.random.default_rng(k).permutation(_DRAWS) for k in range(len(parts))]
    known = sum(drawn.known[at] for drawn, at in zip(parts, order, strict=True))
    upper = sum(drawn.upper[at] for drawn, at in zip(parts, order, strict=True))
    correlation, is_bound = sum(drawn.correlation for drawn in parts), any(drawn.is_bound for drawn in parts)
    return Drawn(mean, np.asarray(known), np.asarray(upper), correlation, is_bound)
