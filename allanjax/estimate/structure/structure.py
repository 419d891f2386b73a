"""Structure of a spectrum: a component for every slot of the joint spectral model, and its fit."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from allanjax.estimate.spectral.components import (
    BUTTERWORTH_1,
    NONE,
    SHAPED,
    Levels,
    bandwidths,
    columns_of,
    markov,
    oscillator,
    passed,
    response_of_kind,
)
from allanjax.estimate.spectral.fit import CLOSE, FILTER, UNSTEADY
from allanjax.estimate.spectral.model import FULL, Maximum, Slots, covariance, maximize
from allanjax.noise.model import Model
from allanjax.noise.response import Response
from allanjax.noise.terms import AngleRandomWalk, Markov, NoiseTerm, Resonance, basic_terms
from allanjax.spectrum.cosine import Bins

#: Terms without a free shape, in the first columns; the white noise that is added after a response.
FIXED = ("quantization", "angle_random_walk", "bias_instability", "rate_random_walk")
QUANTIZATION, WHITE, OUTSIDE = 0, FIXED.index("angle_random_walk"), len(FIXED)
#: Column of a further term, whose shape is given.
FURTHER = OUTSIDE + 1
# Places of the shapes among all shapes.
_TIMES, _FREQUENCIES, _QUALITIES, _RESPONSE = (
    k - FULL.components for k in (FULL.times, FULL.frequencies, FULL.qualities, FULL.response)
)
#: Least quality factor of a resonance: a wider one is an edge, as of a filter.
LEAST_QUALITY = 1.5
#: Coefficients below this one contain drift; a resonance narrower than so many coefficients is a line.
LOWEST, LINE = 16, 4.0
# Least correlation time [samples] of a Markov process: a shorter one is filtered white noise.
_SHORTEST = 8.0
#: Least bandwidth [cycles per sample]: white noise behind a slower filter is a Markov process.
LOWEST_BANDWIDTH = 0.005
# Relative error of any sensor's model in each bin, since real filters differ from all models: a judgement.
_ERROR = 0.005
# Number of factors of e beyond which the errors of a response count in a search: a judgement.
_DEEP = 3.0
#: Tolerances [nats] of a fit within a search, and of one whose numbers are reported.
ROUGH, FINE = 1e-2, 1e-7
# Fields of a structure with a value for each component.
_SLOTS = ("power", "active", "inside")
#: The prior of a resonance's frequency is uniform in its logarithm, over ln(n/this) for n samples.
FREQUENCIES = 32.0
# Prior of ln(Q − ½) of resonances: mean and standard deviation. A judgement.
_QUALITY = (np.log(10.0), 3.0)
# Largest distance of a frequency from its start, in ln.
_REACH = 0.7
#: Log prior odds against a component [nats]: a judgement, twenty to one.
PRICE = 3.0
# Unit of the widths of the priors of powers, quality factors and bandwidth, in ln.
_DECADES = np.log(10.0)


@dataclasses.dataclass(frozen=True, eq=False)
class Structure:
    """Components in slots, with their values or start values.

    Attributes:
        power: power of each component [rate²], zero for unused ones.
        shape: the parameters of the joint spectral model that follow the powers, in ln.
        active: components in use.
        inside: components that pass through the response.
        kind: kind of the response, see `spectral.components`.
        further: the term of column `FURTHER`, with unit amplitude.
    """

    power: Float[np.ndarray, " components"]
    shape: Float[np.ndarray, " shapes"]
    active: Bool[np.ndarray, " components"]
    inside: Bool[np.ndarray, " components"]
    kind: int = NONE
    further: NoiseTerm | None = None

    @classmethod
    def plain(cls, columns: np.ndarray | list[int]) -> Structure:
        """Structure of some columns only, of which all but quantization pass through a response, if any."""
        active = np.isin(np.arange(FULL.components), columns)
        inside = np.arange(FULL.components) < FULL.first_oscillator
        # The output is rounded; and a term of its own kind may have no closed form behind a response.
        inside[[QUANTIZATION, OUTSIDE, FURTHER]] = False
        shape = Slots.of(FULL, np.zeros(FULL.parameters, bool), inside).usual()[FULL.components :]
        return cls(np.zeros(FULL.components), shape, active, inside)

    @property
    def there(self) -> list[int]:
        """Components whose power is not zero."""
        return [int(k) for k in np.flatnonzero(self.active & (self.power > 0.0))]

    @property
    def oscillators(self) -> np.ndarray:
        """Indices of the resonances in use, among all oscillators."""
        return np.flatnonzero(self.active[FULL.first_oscillator : FULL.first_other])

    @property
    def markovs(self) -> np.ndarray:
        """Indices of the Markov processes in use."""
        return np.flatnonzero(self.active[FULL.first_markov : FULL.first_oscillator])

    def frequency(self, k: int) -> float:
        """Frequency of an oscillator [radians per sample]."""
        return float(np.exp(self.shape[_FREQUENCIES + k]))

    def quality(self, k: int) -> float:
        """Quality factor of an oscillator."""
        return 0.5 + float(np.exp(self.shape[_QUALITIES + k]))

    def width(self, k: int) -> float:
        """Width of an oscillator's peak [radians per sample]."""
        return self.frequency(k) / self.quality(k)

    def are_close(self, i: int, k: int) -> bool:
        """Whether two oscillators are so close that they may be one whose frequency drifts."""
        return abs(self.frequency(i) - self.frequency(k)) < CLOSE * 0.5 * (self.width(i) + self.width(k))

    def time(self, k: int) -> float:
        """Correlation time of a Markov process [samples]."""
        return float(np.exp(self.shape[_TIMES + k]))

    @property
    def bandwidth(self) -> tuple[float, float]:
        """Bandwidth of the response [radians per sample], and its quality factor."""
        w, q = np.exp(self.shape[_RESPONSE:])
        return float(w), 0.5 + float(q)

    def with_oscillator(
        self, frequency: float, quality: float, power: float, inside: bool
    ) -> Structure | None:
        """Structure with one more resonance; None if no slot is free."""
        slots = range(FULL.first_oscillator, FULL.first_other)
        return self._added(slots, {_FREQUENCIES: frequency, _QUALITIES: quality - 0.5}, power, inside)

    def with_markov(self, time: float, power: float) -> Structure | None:
        """Structure with one more Markov process; None if no slot is free."""
        return self._added(range(FULL.first_markov, FULL.first_oscillator), {_TIMES: time}, power, True)

    def _added(self, slots: range, shapes: dict[int, float], power: float, inside: bool) -> Structure | None:
        free = next((k for k in slots if not self.active[k]), None)
        if free is None:
            return None
        shape = self.shape.copy()
        for first, value in shapes.items():
            shape[first + free - slots.start] = np.log(value)
        return dataclasses.replace(self, shape=shape).using(free, power).placed(free, inside)

    def with_response(self, kind: int, bandwidth: float, quality: float = np.sqrt(0.5)) -> Structure:
        """Structure with this response [radians per sample]."""
        shape = np.append(self.shape[:_RESPONSE], np.log([bandwidth, quality - 0.5]))
        return dataclasses.replace(self, shape=shape, kind=kind)

    def with_shape_of(self, other: Structure) -> Structure:
        """Structure with another one's response, its resonances and its white noise after the response."""
        mine = np.arange(len(self.active)) >= FULL.first_oscillator
        mine[OUTSIDE] = True
        shape = np.append(self.shape[:_FREQUENCIES], other.shape[_FREQUENCIES:])
        chosen = {name: np.where(mine, getattr(other, name), getattr(self, name)) for name in _SLOTS}
        return dataclasses.replace(self, shape=shape, kind=other.kind, **chosen)

    def has_shape_of(self, other: Structure) -> bool:
        """Whether both have the same kind of response and the same resonances in use."""
        return self.kind == other.kind and np.array_equal(self.oscillators, other.oscillators)

    def placed(self, components: Any, inside: bool) -> Structure:
        """Structure in which one or several components are inside the response or after it."""
        places = self.inside.copy()
        places[components] = inside
        return dataclasses.replace(self, inside=places)

    def using(self, component: int, power: float) -> Structure:
        """Structure in which a component is in use."""
        return self._changed(component, True, power)

    def without(self, component: int) -> Structure:
        """Structure without one component."""
        return self._changed(component, False, 0.0)

    def _changed(self, component: int, here: bool, power: float) -> Structure:
        active, powers = self.active.copy(), self.power.copy()
        active[component], powers[component] = here, power
        return dataclasses.replace(self, active=active, power=powers)


class Fitted(NamedTuple):
    """A structure fitted to a spectrum: log evidence and loss [nats], expected levels [rate²].

    The loss is minus the log-likelihood, prior included. The evidence is Laplace's approximation, where each
    component costs as much as odds of twenty to one.
    """

    structure: Structure
    evidence: float
    loss: float
    mean: Float[np.ndarray, " m"]
    maximum: Maximum

    @property
    def covariance(self) -> Float[np.ndarray, "parameters parameters"]:
        """Covariance of powers [rate²] and shapes, in ln; zero for what is held or at a bound."""
        moved = np.ones(FULL.parameters)
        moved[: FULL.components] = self.structure.power + self.maximum.scale
        return covariance(self.maximum) * np.outer(moved, moved)


@dataclasses.dataclass(frozen=True, eq=False)
class Spectrum:
    """Levels of the cosine spectrum of one record that structures are fitted to.

    Beside these: smooth ones, a first guess; the number of coefficients in each, the square of a model's
    relative error there, and the expectations of components that were computed for these bins.
    """

    bins: Bins
    levels: Levels
    rough: Float[np.ndarray, " m"]
    size: Float[np.ndarray, " m"]
    error: Any = _ERROR**2
    known: dict[tuple[float, ...], Float[np.ndarray, "2 m"]] = dataclasses.field(default_factory=dict)

    @classmethod
    def of(
        cls,
        squares: Float[np.ndarray, " n-1"],
        bins: Bins,
        further: NoiseTerm | None = None,
        weight: Float[np.ndarray, " n-1"] | None = None,
    ) -> Spectrum:
        """Spectrum of squared coefficients [rate²], of weight 0 or 1; with a column for a further term."""
        terms: list[NoiseTerm] = [basic_terms()[name] for name in FIXED] + [AngleRandomWalk()]
        terms += [] if further is None else [further]
        count = bins.size.astype(float) if weight is None else bins.sums(weight)
        total = bins.sums(squares if weight is None else squares * weight)
        level = np.where(count > 0.0, total / np.maximum(count, 1.0), 1.0)
        return cls(bins, Levels.of(bins, columns_of(terms, bins)), level, count).with_data(level, count)

    def with_data(self, level: Float[np.ndarray, " m"], count: Float[np.ndarray, " m"]) -> Spectrum:
        """Copy with these mean squares [rate²] and numbers of coefficients."""
        around, total = (np.convolve(x, np.ones(7), "same") for x in (count, level * count))
        rough, levels = (
            np.maximum(total / np.maximum(around, 1e-9), 1e-300),
            self.levels._replace(level=level),
        )
        return dataclasses.replace(self, levels=levels, rough=rough, size=count).with_error(_ERROR**2)

    def with_error(self, error: Any) -> Spectrum:
        """Copy for models with these squares of relative errors, of which models are to be compared only."""
        half = 0.5 * self.size
        levels = self.levels._replace(shape=half / (1.0 + half * error))
        return dataclasses.replace(self, levels=levels, error=error)

    @property
    def n(self) -> int:
        """Number of samples."""
        return self.bins.n

    def weighing(self, fitted: Fitted, filters: bool = False) -> Spectrum:
        """Spectrum whose levels count less where a fit has its resonances, and deep in a filter's stop band.

        Resonances drift, the more so where several stand for one that moves. No sensor's filter is just like
        the model's, and its errors are common to an octave; in the pass band (`filters`) they count once the
        kind of filter is known, as they hide it.
        """
        structure, oscillators = fitted.structure, fitted.structure.oscillators.tolist()
        own = FULL.first_oscillator + fitted.structure.oscillators
        resonant = structure.power[own, None] * fitted.maximum.model.unit[own] / fitted.mean
        near = [sum(structure.are_close(i, k) for i in oscillators) for k in oscillators]
        common = 0.0
        if (response := response_of(structure, self.bins.rate)) is not None:
            passed = np.asarray(response.power(self.bins.frequency, self.bins.rate))
            fallen = -np.log(np.maximum(passed, 1e-300)) - (0.0 if filters else _DEEP)
            common = (FILTER * np.maximum(fallen, 0.0)) ** 2 * self.bins.per_octave()
        return self.with_error((UNSTEADY * np.array(near) @ resonant) ** 2 + _ERROR**2 + common)

    def loss_of(self, fitted: Fitted) -> float:
        """Minus the log-likelihood of these levels under a fit to others [nats]."""
        return float(self.levels.shape @ (np.log(fitted.mean) + self.levels.level / fitted.mean))

    def units(self, structure: Structure, components: Sequence[int]) -> Float[np.ndarray, "some m"]:
        """Levels of some components of a structure, of unit power."""
        squares = [self._squares(structure, k) for k in components]
        if structure.kind != NONE:
            own = (structure.kind, *structure.bandwidth)
            response = self._once(own, lambda: passed(self.levels, *own))
            inside = structure.inside[components]
            squares = [x * response if within else x for x, within in zip(squares, inside, strict=True)]
        return np.mean(squares, axis=1)

    def _squares(self, structure: Structure, component: int) -> Float[np.ndarray, "2 m"]:
        """Expected squares at the nodes of a component of unit power before the response."""
        if component < FULL.first_markov:
            return self.levels.columns[component]
        if component < FULL.first_oscillator:
            time = structure.time(component - FULL.first_markov)
            return self._once((time,), lambda: markov(self.levels, time))
        k = component - FULL.first_oscillator
        of = structure.frequency(k), structure.quality(k)
        return self._once(of, lambda: oscillator(self.levels, *of))

    def _once(self, key: tuple[float, ...], function: Callable[[], Any]) -> Any:
        if key not in self.known:
            self.known[key] = function()
        return self.known[key]

    def fit(self, structure: Structure, tolerance: float = ROUGH) -> Fitted:
        """Fit all components jointly."""
        start = np.append(np.where(structure.active, structure.power, 0.0), structure.shape)
        found = maximize(start, self._slots(structure), self.levels, self.rough, tolerance)
        power = np.where(structure.active, found.theta[: FULL.components], 0.0)
        better = dataclasses.replace(structure, power=power, shape=found.theta[FULL.components :])
        return Fitted(better, self._evidence(found, better), found.loss, found.mean, found)

    def _slots(self, structure: Structure) -> Slots:
        """What is estimated of a structure, with its bounds and priors."""
        at, active, spacing = FULL, structure.active, np.pi / self.n
        time, frequency = slice(at.times, at.frequencies), slice(at.frequencies, at.qualities)
        quality, response = slice(at.qualities, at.response), at.response
        resonant = active[at.first_oscillator : at.first_other]
        filtered = [structure.kind != NONE, structure.kind in SHAPED]
        free = np.concatenate([active, active[at.first_markov :], resonant, filtered])
        slots = Slots.of(at, free, structure.inside, structure.kind)
        lower, upper = slots.lower, slots.upper
        lower[time], upper[time] = np.log(_SHORTEST), np.log(self.n)
        started = structure.shape[_FREQUENCIES:_QUALITIES]
        lower[frequency] = np.maximum(started - _REACH, np.log(LOWEST * spacing))
        upper[frequency] = np.minimum(started + _REACH, np.log(np.pi))
        lower[quality] = np.log(LEAST_QUALITY - 0.5)
        upper[quality] = np.log(np.maximum(np.exp(started) / (LINE * spacing), 2.0) - 0.5)
        least, most = bandwidths(structure.kind)
        lower[response] = np.log(max(LOWEST * spacing, 2.0 * np.pi * LOWEST_BANDWIDTH, least))
        upper[response] = np.log(min(4.0, most))
        lower[response + 1], upper[response + 1] = np.log(0.02), np.log(20.0)
        slots.upper[:] = np.maximum(upper, lower)
        slots.centre[quality], slots.precision[quality] = _QUALITY[0], _QUALITY[1] ** -2
        return slots

    def _evidence(self, found: Maximum, structure: Structure) -> float:
        """Laplace's approximation, in which a parameter that the data do not determine costs nothing."""
        at, n, free = FULL, self.n, found.interior
        widths = [8.0 * _DECADES, np.log(n), np.log(n / FREQUENCIES), 4.0 * _DECADES, 2.0 * _DECADES]
        counts = [at.components, at.markovs, at.oscillators, at.oscillators, 1, 1]
        D = np.repeat([*widths, np.log(20.0)], counts)[free] / np.sqrt(2.0 * np.pi)
        F = found.information[np.ix_(free, free)]
        _, logdet = np.linalg.slogdet(F * np.outer(D, D) + np.eye(len(D)))
        used = structure.power > 0.0
        more = int(used[OUTSIDE]) + int(np.sum(used[at.first_markov :]))
        if structure.kind != NONE:
            # Quantization beside a filter may be the filter's shape, the more so before it.
            more += 1 + int(used[QUANTIZATION]) * (1 + int(structure.inside[QUANTIZATION]))
        return float(-found.loss - 0.5 * logdet - PRICE * more)


def model_of(structure: Structure, rate: float) -> Model:
    """Model with the values of a structure for samples at `rate` [Hz]."""
    terms = [(term_of(structure, k, rate), structure.inside[k]) for k in structure.there]
    response = response_of(structure, rate)
    if response is None:
        return Model(tuple(term for term, _ in terms))
    inside, after = (Model(tuple(term for term, passes in terms if passes == side)) for side in (True, False))
    return (response * inside if len(inside) else inside) + after


def response_of(structure: Structure, rate: float) -> Response | None:
    """Response of a structure; None without one."""
    w, quality = structure.bandwidth
    return (
        None
        if structure.kind == NONE
        else response_of_kind(structure.kind, w * rate / (2.0 * np.pi), quality)
    )


def order_of(structure: Structure) -> int:
    """Order of the response: its number of poles, 1 of a moving average."""
    if structure.kind >= BUTTERWORTH_1:
        return structure.kind - BUTTERWORTH_1 + 1
    return 2 if structure.kind in SHAPED else 1


def term_of(structure: Structure, k: int, rate: float) -> NoiseTerm:
    """Term of component k; before the response if it passes through it."""
    power = float(structure.power[k])
    if k < OUTSIDE:
        return basic_terms()[FIXED[k]].replace(coefficient=float(np.sqrt(power)))
    if k == OUTSIDE:
        return AngleRandomWalk(float(np.sqrt(power)))
    if k == FURTHER and (further := structure.further) is not None:
        return further.replace(**{further.amplitude_parameter().name: float(np.sqrt(power))})
    if k < FULL.first_oscillator:
        time = structure.time(k - FULL.first_markov) / rate
        return Markov(float(np.sqrt(2.0 * power / time)), time)
    k -= FULL.first_oscillator
    return Resonance(
        float(np.sqrt(power)), structure.frequency(k) * rate / (2.0 * np.pi), structure.quality(k)
    )
