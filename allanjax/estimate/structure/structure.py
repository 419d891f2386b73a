"""Structure of a spectrum: a component for every slot of the joint spectral model, and its fit."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from allanjax.estimate.spectral.components import (
    BIQUAD,
    BUTTERWORTH_1,
    MOVING_AVERAGE,
    NONE,
    ONE_POLE,
    TWO_POLES,
    Levels,
    bandwidths,
    columns_of,
)
from allanjax.estimate.spectral.model import FULL, Maximum, Slots, covariance, maximize
from allanjax.noise.model import Model
from allanjax.noise.response import Biquad, Butterworth, LowPass1, LowPass2, MovingAverage, Response
from allanjax.noise.terms import AngleRandomWalk, Markov, NoiseTerm, Resonance, basic_terms
from allanjax.spectrum.cosine import Bins

#: Terms without a free shape, in the first columns; the white noise that is added after a response.
FIXED = ("quantization", "angle_random_walk", "bias_instability", "rate_random_walk")
QUANTIZATION, WHITE, OUTSIDE = 0, FIXED.index("angle_random_walk"), len(FIXED)
#: Column of a further term, whose shape is given.
FURTHER = OUTSIDE + 1
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
# Relative error of the part of the resonances, whose frequency and damping drift: a judgement.
_UNSTEADY = 0.1
# Relative errors of a response, per factor of e by which it has fallen, in a search beyond so many of these;
# and of a resonance farther from its peak than so many of its widths: judgements.
_FILTER, _DEEP, _SKIRT, _BESIDE = 0.05, 3.0, 0.2, 1.5
# Oscillators nearer to each other than the mean of their widths times this may be one: a judgement.
_CLOSE = 1.5
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
        count = FULL.components
        active, inside = np.zeros(count, bool), np.zeros(count, bool)
        active[np.asarray(columns, int)] = True
        inside[: FULL.first_oscillator] = True
        # The output is rounded; and a term of its own kind may have no closed form behind a response.
        inside[[QUANTIZATION, OUTSIDE, FURTHER]] = False
        slots = Slots.of(FULL, np.zeros(FULL.parameters, bool), inside)
        return cls(np.zeros(count), slots.usual()[count:], active, inside)

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
        return float(np.exp(self.shape[FULL.frequencies - FULL.components + k]))

    def quality(self, k: int) -> float:
        """Quality factor of an oscillator."""
        return 0.5 + float(np.exp(self.shape[FULL.qualities - FULL.components + k]))

    def width(self, k: int) -> float:
        """Width of an oscillator's peak [radians per sample]."""
        return self.frequency(k) / self.quality(k)

    def are_close(self, i: int, k: int) -> bool:
        """Whether two oscillators are so close that they may be one whose frequency drifts."""
        return abs(self.frequency(i) - self.frequency(k)) < _CLOSE * 0.5 * (self.width(i) + self.width(k))

    def companions(self, k: int) -> int:
        """Number of oscillators in use that are close to one of them, itself included; 0 if that is idle."""
        used = self.oscillators
        return sum(self.are_close(int(i), k) for i in used) if k in used else 0

    def time(self, k: int) -> float:
        """Correlation time of a Markov process [samples]."""
        return float(np.exp(self.shape[k]))

    @property
    def bandwidth(self) -> tuple[float, float]:
        """Bandwidth of the response [radians per sample], and its quality factor."""
        w, q = self.shape[FULL.response - FULL.components :][:2]
        return float(np.exp(w)), 0.5 + float(np.exp(q))

    def with_oscillator(
        self, frequency: float, quality: float, power: float, inside: bool
    ) -> Structure | None:
        """Structure with one more resonance; None if no slot is free."""
        used = self.oscillators
        if len(used) == FULL.oscillators:
            return None
        k = next(k for k in range(FULL.oscillators) if k not in used)
        shape = self.shape.copy()
        shape[FULL.frequencies - FULL.components + k] = np.log(frequency)
        shape[FULL.qualities - FULL.components + k] = np.log(quality - 0.5)
        return self._with(FULL.first_oscillator + k, power, inside, shape)

    def with_markov(self, time: float, power: float) -> Structure | None:
        """Structure with one more Markov process; None if no slot is free."""
        used = self.markovs
        if len(used) == FULL.markovs:
            return None
        k = next(k for k in range(FULL.markovs) if k not in used)
        shape = self.shape.copy()
        shape[k] = np.log(time)
        return self._with(FULL.first_markov + k, power, True, shape)

    def with_response(self, kind: int, bandwidth: float, quality: float = np.sqrt(0.5)) -> Structure:
        """Structure with this response [radians per sample]."""
        shape = self.shape.copy()
        shape[FULL.response - FULL.components :][:2] = np.log(bandwidth), np.log(quality - 0.5)
        return dataclasses.replace(self, shape=shape, kind=kind)

    def with_shape_of(self, other: Structure) -> Structure:
        """Structure with another one's response, its resonances and its white noise after the response."""
        mine = np.arange(len(self.active)) >= FULL.first_oscillator
        mine[OUTSIDE] = True
        shape = np.append(self.shape[: FULL.markovs], other.shape[FULL.markovs :])
        chosen = {name: np.where(mine, getattr(other, name), getattr(self, name)) for name in _SLOTS}
        return dataclasses.replace(self, shape=shape, kind=other.kind, **chosen)

    def has_shape_of(self, other: Structure) -> bool:
        """Whether both have the same kind of response and the same resonances in use."""
        mine, its = self.active[FULL.first_oscillator :], other.active[FULL.first_oscillator :]
        return self.kind == other.kind and bool(np.all(mine == its))

    def placed(self, component: int, inside: bool) -> Structure:
        """Structure in which a component is inside the response or after it."""
        places = self.inside.copy()
        places[component] = inside
        return dataclasses.replace(self, inside=places)

    def using(self, component: int, power: float) -> Structure:
        """Structure in which a component is in use."""
        return self._with(component, power, bool(self.inside[component]), self.shape)

    def with_powers(self, power: Float[np.ndarray, " components"]) -> Structure:
        """Structure with these powers."""
        return dataclasses.replace(self, power=power)

    def without(self, component: int) -> Structure:
        """Structure without one component."""
        active, power = self.active.copy(), self.power.copy()
        active[component], power[component] = False, 0.0
        return dataclasses.replace(self, active=active, power=power)

    def _with(self, component: int, power: float, inside: bool, shape: np.ndarray) -> Structure:
        active, powers, places = self.active.copy(), self.power.copy(), self.inside.copy()
        active[component], powers[component], places[component] = True, power, inside
        return dataclasses.replace(self, power=powers, shape=shape, active=active, inside=places)


class Fitted(NamedTuple):
    """A structure fitted to the levels of a spectrum.

    Attributes:
        structure: with its most likely values.
        evidence: log evidence [nats], by Laplace's approximation; each component costs as much as odds of
            twenty to one.
        maximum: the maximum of the likelihood.
    """

    structure: Structure
    evidence: float
    maximum: Maximum

    @property
    def loss(self) -> float:
        """Minus the log-likelihood [nats], prior included."""
        return float(self.maximum.loss)

    @property
    def mean(self) -> Float[np.ndarray, " capacity"]:
        """Expected levels [rate²]."""
        return np.asarray(self.maximum.mean)

    @property
    def resonant(self) -> Float[np.ndarray, "oscillators capacity"]:
        """Share of each resonance in them."""
        of = slice(FULL.first_oscillator, FULL.first_other)
        return self.structure.power[of, None] * np.asarray(self.maximum.model.unit)[of] / self.mean

    @property
    def covariance(self) -> Float[np.ndarray, "parameters parameters"]:
        """Covariance of powers [rate²] and shapes, in ln; zero for what is held or at a bound."""
        moved = np.ones(FULL.parameters)
        moved[: FULL.components] = self.structure.power + np.asarray(self.maximum.scale)
        return covariance(self.maximum) * np.outer(moved, moved)


#: Log prior odds against a component [nats]: a judgement, twenty to one.
PRICE = 3.0
# Widths of the priors of powers, correlation times, frequencies, Q, bandwidth and Q of the response, in ln.
_DECADES = np.log(10.0)


@dataclasses.dataclass(frozen=True, eq=False)
class Spectrum:
    """Levels of the cosine spectrum of one record that structures are fitted to.

    Attributes:
        bins: the bins.
        levels: the levels, and the expectations of the columns.
        rough: smooth levels, a first guess.
        size: number of coefficients in each level.
    """

    bins: Bins
    levels: Levels
    rough: Float[np.ndarray, " capacity"]
    size: Float[np.ndarray, " capacity"]

    @classmethod
    def of(
        cls,
        squares: Float[np.ndarray, " n-1"],
        bins: Bins,
        further: NoiseTerm | None = None,
        weight: Float[np.ndarray, " n-1"] | None = None,
    ) -> Spectrum:
        """Spectrum of squared coefficients, each with a weight.

        Args:
            squares: squared cosine coefficients [rate²].
            bins: the bins.
            further: a term whose column is used besides the basic ones.
            weight: weight of each coefficient, 0 or 1; 1 by default.
        """
        terms: list[NoiseTerm] = [basic_terms()[name] for name in FIXED] + [AngleRandomWalk()]
        terms += [] if further is None else [further]
        levels = Levels.of(bins, columns_of(terms, bins))
        count = bins.size.astype(float) if weight is None else bins.sums(weight)
        total = bins.sums(squares if weight is None else squares * weight)
        level = np.where(count > 0.0, total / np.maximum(count, 1.0), 1.0)
        nothing = np.zeros(len(levels.shape))
        return cls(bins, levels, nothing, nothing).with_data(level, count)

    def with_data(self, level: Float[np.ndarray, " m"], count: Float[np.ndarray, " m"]) -> Spectrum:
        """Copy with these mean squares [rate²] and numbers of coefficients."""
        window = np.ones(7)
        around = np.convolve(count, window, "same")
        smooth = np.convolve(level * count, window, "same") / np.maximum(around, 1e-9)
        rough = np.maximum(smooth, 1e-300)
        levels = self.levels.with_data(level, count / (1.0 + 0.5 * count * _ERROR**2))
        return Spectrum(self.bins, levels, rough, count)

    @property
    def n(self) -> int:
        """Number of samples."""
        return self.bins.n

    def weighing(self, fitted: Fitted, filters: bool = False, skirts: bool = False) -> Spectrum:
        """Spectrum whose levels count less where a fit has its resonances, and deep in a filter's stop band.

        Resonances drift, the more so where several stand for one that moves. No sensor's skirts and filters
        are just like the model's, and such errors are common to an octave; all of them count once the
        structure is known, as they hide what kind of filter it is. Models must be compared with the same
        weights.
        """
        structure, bins = fitted.structure, self.bins
        f, rows, resonant = bins.frequency, len(bins.size), fitted.resonant
        near = np.array([structure.companions(k) for k in range(FULL.oscillators)])
        square, common = (_UNSTEADY * near @ resonant) ** 2 + _ERROR**2, np.zeros(rows)
        if (response := response_of(structure, bins.rate)) is not None:
            fallen = -np.log(np.maximum(np.asarray(response.power(f, bins.rate)), 1e-300))
            common += (_FILTER * np.maximum(fallen - (0.0 if filters else _DEEP), 0.0)) ** 2
        hertz = bins.rate / (2.0 * np.pi)
        for k in structure.oscillators if skirts else ():
            beside = abs(f - structure.frequency(k) * hertz) > _BESIDE * structure.width(k) * hertz
            common += np.where(beside, _SKIRT * resonant[k, :rows], 0.0) ** 2
        square[:rows] += common * bins.per_octave()
        dof = self.size / (1.0 + 0.5 * self.size * square)
        return dataclasses.replace(self, levels=self.levels._replace(shape=dof / 2.0))

    def weighed_like(self, other: Spectrum) -> Spectrum:
        """Spectrum whose levels have the relative errors of another one with the same bins."""
        full = 0.5 * other.size
        share = np.where(full > 0.0, other.levels.shape / np.maximum(full, 1e-300), 1.0)
        # share = 1/(1 + full·error²), closer to 1 for fewer coefficients.
        square = (1.0 / np.maximum(share, 1e-300) - 1.0) / np.maximum(full, 1e-300)
        half = 0.5 * self.size
        return dataclasses.replace(self, levels=self.levels._replace(shape=half / (1.0 + half * square)))

    def loss_of(self, fitted: Fitted) -> float:
        """Minus the log-likelihood of these levels under a fit to others [nats]."""
        k = np.asarray(self.levels.shape)
        return float(np.sum(k * (np.log(fitted.mean) + self.levels.level / fitted.mean)))

    def fit(self, structure: Structure, tolerance: float = ROUGH) -> Fitted:
        """Fit all components jointly."""
        lower, upper = self._bounds(structure)
        at = FULL
        precision, centre = np.zeros(at.parameters), np.zeros(at.parameters)
        precision[at.qualities : at.response] = _QUALITY[1] ** -2
        centre[at.qualities : at.response] = _QUALITY[0]
        slots = Slots.of(at, _free(structure), structure.inside, structure.kind)
        slots = dataclasses.replace(slots, lower=lower, upper=upper, precision=precision, centre=centre)
        start = np.append(np.where(structure.active, structure.power, 0.0), structure.shape)
        found: Any = maximize(start, slots, self.levels, self.rough, tolerance)
        power = np.where(structure.active, found.theta[: at.components], 0.0)
        better = dataclasses.replace(structure, power=power, shape=found.theta[at.components :])
        return Fitted(better, self._evidence(found, structure), found)

    def _bounds(self, structure: Structure) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of the parameters."""
        at, n = FULL, self.n
        slots = Slots.of(at, np.zeros(at.parameters, bool), structure.inside)
        lower, upper = np.array(slots.lower), np.array(slots.upper)
        spacing = np.pi / n
        lower[at.times : at.frequencies], upper[at.times : at.frequencies] = np.log(_SHORTEST), np.log(n)
        started = structure.shape[at.frequencies - at.components : at.qualities - at.components]
        lower[at.frequencies : at.qualities] = np.maximum(started - _REACH, np.log(LOWEST * spacing))
        upper[at.frequencies : at.qualities] = np.minimum(started + _REACH, np.log(np.pi))
        lower[at.qualities : at.response] = np.log(LEAST_QUALITY - 0.5)
        widest = np.exp(started) / (LINE * spacing)
        upper[at.qualities : at.response] = np.log(np.maximum(widest, 2.0) - 0.5)
        least, most = bandwidths(structure.kind)
        lower[at.response] = np.log(max(LOWEST * spacing, 2.0 * np.pi * LOWEST_BANDWIDTH, least))
        upper[at.response] = np.log(min(4.0, most))
        lower[at.response + 1], upper[at.response + 1] = np.log(0.02), np.log(20.0)
        return lower, np.maximum(upper, lower)

    def _evidence(self, found: Maximum, structure: Structure) -> float:
        """Laplace's approximation, in which a parameter that the data do not determine costs nothing."""
        at, n = FULL, self.n
        widths = np.full(at.parameters, 8.0 * _DECADES)
        widths[at.times : at.frequencies] = np.log(n)
        widths[at.frequencies : at.qualities] = np.log(n / FREQUENCIES)
        widths[at.qualities : at.response] = 4.0 * _DECADES
        widths[at.response :] = 2.0 * _DECADES, np.log(20.0)
        free = np.asarray(found.interior)
        D = widths[free] / np.sqrt(2.0 * np.pi)
        F = np.asarray(found.information)[np.ix_(free, free)]
        _, logdet = np.linalg.slogdet(F * np.outer(D, D) + np.eye(len(D)))
        used = structure.active & (np.asarray(found.theta)[: at.components] > 0.0)
        more = int(used[OUTSIDE]) + int(np.sum(used[at.first_markov :]))
        if structure.kind != NONE:
            # Quantization beside a filter may be the filter's shape, the more so before it.
            more += 1 + int(used[QUANTIZATION]) * (1 + int(structure.inside[QUANTIZATION]))
        return -float(found.loss) - 0.5 * float(logdet) - PRICE * more


def _free(structure: Structure) -> Bool[np.ndarray, " parameters"]:
    """Parameters that are estimated."""
    at = FULL
    free = np.zeros(at.parameters, bool)
    free[: at.components] = structure.active
    free[at.times : at.frequencies] = structure.active[at.first_markov : at.first_oscillator]
    of_oscillators = structure.active[at.first_oscillator : at.first_other]
    free[at.frequencies : at.qualities] = free[at.qualities : at.response] = of_oscillators
    free[at.response] = structure.kind != NONE
    free[at.response + 1] = structure.kind in (TWO_POLES, BIQUAD)
    return free


def model_of(structure: Structure, rate: float, further: NoiseTerm | None = None) -> Model:
    """Model with the values of a structure for samples at `rate` [Hz].

    Args:
        structure: the structure.
        rate: sample rate [Hz].
        further: the term whose column it has besides the basic ones, with unit amplitude.
    """
    terms: list[tuple[NoiseTerm, bool]] = []
    for k in structure.there:
        terms.append((term_of(structure, k, rate, further), bool(structure.inside[k])))
    response = response_of(structure, rate)
    if response is None:
        return Model(tuple(term for term, _ in terms))
    inside = Model(tuple(term for term, passes in terms if passes))
    after = Model(tuple(term for term, passes in terms if not passes))
    return (response * inside if len(inside) else inside) + after


def response_of(structure: Structure, rate: float) -> Response | None:
    """Response of a structure; None without one."""
    if structure.kind == NONE:
        return None
    w, quality = structure.bandwidth
    bandwidth = w * rate / (2.0 * np.pi)
    if structure.kind >= BUTTERWORTH_1:
        return Butterworth(bandwidth, order_of(structure))
    if structure.kind == MOVING_AVERAGE:
        return MovingAverage(bandwidth)
    if structure.kind == ONE_POLE:
        return LowPass1(bandwidth)
    return (Biquad if structure.kind == BIQUAD else LowPass2)(bandwidth, quality)


def order_of(structure: Structure) -> int:
    """Order of the response: its number of poles, 1 of a moving average."""
    if structure.kind >= BUTTERWORTH_1:
        return structure.kind - BUTTERWORTH_1 + 1
    return 1 if structure.kind in (ONE_POLE, MOVING_AVERAGE) else 2


def resonance_of(structure: Structure, k: int, rate: float) -> Resonance:
    """One of the oscillators as a term; before the response if it passes through it."""
    power = float(structure.power[FULL.first_oscillator + k])
    return Resonance(np.sqrt(power), structure.frequency(k) * rate / (2.0 * np.pi), structure.quality(k))


def markov_of(structure: Structure, k: int, rate: float) -> Markov:
    """One of the Markov processes as a term."""
    power, time = float(structure.power[FULL.first_markov + k]), structure.time(k) / rate
    return Markov(np.sqrt(2.0 * power / time), time)


def term_of(structure: Structure, k: int, rate: float, further: NoiseTerm | None = None) -> NoiseTerm:
    """Term of component k; before the response if it passes through it."""
    amplitude = float(np.sqrt(structure.power[k]))
    if k < OUTSIDE:
        return basic_terms()[FIXED[k]].replace(coefficient=amplitude)
    if k == OUTSIDE:
        return AngleRandomWalk(amplitude)
    if k == FURTHER and further is not None:
        return further.replace(**{further.amplitude_parameter().name: amplitude})
    if k < FULL.first_oscillator:
        return markov_of(structure, k - FULL.first_markov, rate)
    return resonance_of(structure, k - FULL.first_oscillator, rate)
