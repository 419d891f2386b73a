"""Structure of a spectrum: the components and the response that it consists of, and their fit."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from allanjax.estimate.spectral import components as kinds
from allanjax.estimate.spectral.components import Levels, bandwidths, columns_of, passed
from allanjax.estimate.spectral.fit import error_of_ends, model_error, share_with_error
from allanjax.estimate.spectral.model import (
    Component,
    Composition,
    Joint,
    Maximum,
    covariance,
    maximize,
    response_of,
)
from allanjax.noise.model import Model
from allanjax.noise.terms import AngleRandomWalk, Markov, NoiseTerm, Resonance, basic_terms
from allanjax.spectrum.cosine import Bins, smoothed
from allanjax.spectrum.peaks import LOWEST

#: Terms without a free shape, in the first columns; the white noise that is added after a response.
FIXED = ("quantization", "angle_random_walk", "bias_instability", "rate_random_walk")
QUANTIZATION, WHITE, OUTSIDE = 0, FIXED.index("angle_random_walk"), len(FIXED)
#: Column of a further term, whose shape is given.
FURTHER = OUTSIDE + 1
#: Least quality factor of a resonance: a wider one is an edge, as of a filter.
LEAST_QUALITY = 1.5
#: A resonance narrower than so many coefficients is a line.
LINE = 4.0
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
#: The prior of a resonance's frequency is uniform in its logarithm, over ln(n/this) for n samples.
FREQUENCIES = 32.0
# Prior of ln(Q − ½) of resonances: mean and precision. A judgement.
_QUALITY = (math.log(10.0), 1.0 / 9.0)
# Largest distance of a frequency from its start, in ln.
_REACH = 0.7
#: Log prior odds against a component [nats]: a judgement, twenty to one.
PRICE = 3.0
# Unit of the widths of the priors of powers, quality factors and bandwidth, in ln.
_DECADES = math.log(10.0)


def resonance(frequency: float, quality: float, power: float, inside: bool) -> Component:
    """Resonance at a frequency [radians per sample]."""
    return Component(kinds.OSCILLATOR, power, (math.log(frequency), math.log(quality - 0.5)), inside)


def markov(time: float, power: float) -> Component:
    """Markov process of a correlation time [samples], inside the response."""
    return Component(kinds.MARKOV, power, (math.log(time),), True)


def _column(which: int) -> Component:
    # The output is rounded; and a term of its own kind may have no closed form behind a response.
    return Component(kinds.COLUMN, inside=which not in (QUANTIZATION, OUTSIDE, FURTHER), which=which)


@dataclasses.dataclass(frozen=True, eq=False)
class Structure(Composition):
    """Composition of a record's spectrum, with values or start values.

    Attributes:
        further: the term of column `FURTHER`, with unit amplitude.
    """

    further: NoiseTerm | None = None

    @classmethod
    def plain(cls, columns: Iterable[int]) -> Structure:
        """Structure of some columns only, of which all but quantization pass through a response, if any."""
        return cls(tuple(map(_column, columns)))

    def place(self, column: int) -> int | None:
        """Place of a column among the components; None if it is not one of them."""
        found = (k for k, c in enumerate(self.components) if c.kind == kinds.COLUMN and c.which == column)
        return next(found, None)

    def column(self, column: int) -> Component:
        """The component of a column, without power if there is none."""
        k = self.place(column)
        return _column(column) if k is None else self.components[k]

    @property
    def there(self) -> list[int]:
        """Components whose power is not zero."""
        return [k for k, c in enumerate(self.components) if c.power > 0.0]

    def plus(self, *components: Component) -> Structure:
        """Structure with further components."""
        return dataclasses.replace(self, components=(*self.components, *components))

    def with_column(self, column: int, power: float) -> Structure:
        """Structure with a column of this power."""
        k, own = self.place(column), self.column(column)._replace(power=power)
        return self.plus(own) if k is None else self._changed({k: own})

    @property
    def filter(self) -> tuple[float, ...]:
        """Kind and shape of the response."""
        return self.kind, *self.response

    def with_response(self, kind: int, bandwidth: float, quality: float = math.sqrt(0.5)) -> Structure:
        """Structure with this response [radians per sample]."""
        response = math.log(bandwidth), math.log(quality - 0.5)
        return dataclasses.replace(self, kind=kind, response=response)

    def without_response(self) -> Structure:
        """Structure without a response, and without the white noise after it."""
        return dataclasses.replace(self.without(self.place(OUTSIDE)), kind=kinds.NONE)

    def with_shape_of(self, other: Structure) -> Structure:
        """Structure with another one's response and resonances, and with what is after the response there."""
        inside = {c.which: c.inside for c in other.components if c.kind == kinds.COLUMN}
        mine = (
            c._replace(inside=inside.get(c.which, c.inside)) if c.kind == kinds.COLUMN else c
            for c in self.components
            if not _is_shape(c)
        )
        components = (*mine, *filter(_is_shape, other.components))
        return dataclasses.replace(self, components=components, kind=other.kind, response=other.response)

    def has_shape_of(self, other: Structure) -> bool:
        """Whether both have the same kind of response and as many resonances."""
        return self.kind == other.kind and len(self.oscillators) == len(other.oscillators)

    def placed(self, places: Collection[int | None], inside: bool) -> Structure:
        """Structure in which these components are inside the response or after it."""
        return self._changed({k: self.components[k]._replace(inside=inside) for k in places if k is not None})

    def without(self, *places: int | None) -> Structure:
        """Structure without these components."""
        return dataclasses.replace(
            self, components=tuple(c for k, c in enumerate(self.components) if k not in places)
        )

    def with_powers(self, powers: Iterable[float]) -> Structure:
        """Structure with these powers."""
        both = zip(self.components, powers, strict=True)
        return dataclasses.replace(self, components=tuple(c._replace(power=p) for c, p in both))

    def _changed(self, new: dict[int, Component]) -> Structure:
        components = tuple(new.get(k, c) for k, c in enumerate(self.components))
        return dataclasses.replace(self, components=components)


def _is_shape(component: Component) -> bool:
    return component.kind == kinds.OSCILLATOR or (component.kind, component.which) == (kinds.COLUMN, OUTSIDE)


class Fitted(NamedTuple):
    """A structure fitted to a spectrum: log evidence and loss [nats], expected levels [rate²].

    The loss is minus the log-likelihood, prior included. The evidence is Laplace's approximation, where each
    component costs as much as odds of twenty to one.
    The `rivals` are other structures that were compared with it, and `doubt` is the relative error of white
    noise that follows from these.
    """

    structure: Structure
    evidence: float
    loss: float
    mean: Float[np.ndarray, " m"]
    maximum: Maximum
    rivals: tuple[Fitted, ...] = ()
    doubt: float = 0.0

    @property
    def covariance(self) -> Float[np.ndarray, "parameters parameters"]:
        """Covariance of powers [rate²] and shapes, in ln; zero for what is held or at a bound."""
        theta, scale = self.maximum.theta, self.maximum.scale
        moved = np.append(theta[: len(scale)] + scale, np.ones(len(theta) - len(scale)))
        return covariance(self.maximum) * np.outer(moved, moved)


@dataclasses.dataclass(frozen=True, eq=False)
class Spectrum:
    """Levels of the cosine spectrum of one record that structures are fitted to.

    Beside these: smooth ones, a first guess; the number of coefficients in each, the square of a model's
    relative error there, and the expectations of components and responses that were computed for these bins.
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
        levels = Levels.of(bins, columns_of(terms, bins))._replace(level=level)
        return cls(bins, levels, smoothed(level * count, count), count).with_error(_ERROR**2)

    def with_error(self, error: Any) -> Spectrum:
        """Copy for models with these squares of relative errors, of which models are to be compared only."""
        levels = self.levels._replace(shape=0.5 * self.size * share_with_error(self.size, error))
        return dataclasses.replace(self, levels=levels, error=error)

    @property
    def n(self) -> int:
        """Number of samples."""
        return self.bins.n

    def weighing(self, fitted: Fitted, filters: bool = False) -> Spectrum:
        """Spectrum whose levels count less where a fit has its resonances, and deep in a filter's stop band.

        No sensor's filter is just like the model's; in the pass band (`filters`) its errors count once the
        kind of filter is known, as they hide it.
        """
        allowed = 0.0 if filters else _DEEP
        error = model_error(fitted.structure, fitted.maximum, self.bins, allowed, skirt=0.0)
        return self.with_error(error + _ERROR**2)

    def with_full_weight(self, fitted: Fitted) -> Spectrum:
        """Spectrum whose levels count as if the model of a fit were exact."""
        of = fitted.structure
        return self.with_error(error_of_ends(of, of.parameters, self.levels, self.bins))

    def loss_of(self, fitted: Fitted) -> float:
        """Minus the log-likelihood of these levels under a fit to others [nats]."""
        return float(self.levels.shape @ (np.log(fitted.mean) + self.levels.level / fitted.mean))

    def know(self, structures: Sequence[Structure]) -> None:
        """Compute the responses of these structures that are not known yet, those of a kind together."""
        new = {s.filter: s for s in structures if s.kind != kinds.NONE and s.filter not in self.known}
        for kind in {s.kind for s in new.values()}:
            own = {key: s.bandwidth for key, s in new.items() if s.kind == kind}
            wc, Q = np.array(list(own.values())).T[:, :, None, None]
            self.known.update(zip(own, passed(self.levels, kind, wc, Q), strict=True))

    def units(self, structure: Structure, components: Sequence[Component]) -> Float[np.ndarray, "some m"]:
        """Levels of components of unit power before or after the response of a structure."""
        for kind, function in kinds.CLOSED.items():
            if new := [c.shape for c in components if c.kind == kind and c.shape not in self.known]:
                self.known.update(zip(new, function(self.levels, np.array(new))[0], strict=True))
        columns = self.levels.columns
        squares = np.array(
            [columns[c.which] if c.kind == kinds.COLUMN else self.known[c.shape] for c in components]
        )
        if structure.kind != kinds.NONE:
            self.know([structure])
            squares[[c.inside for c in components]] *= self.known[structure.filter]
        return 0.5 * (squares[:, 0] + squares[:, 1])

    def fit(self, structure: Structure, tolerance: float = ROUGH) -> Fitted:
        """Fit all components jointly."""
        priors = self._priors(structure)
        lower, upper, centre, precision, width = np.array(priors).T
        free = np.ones(len(priors), bool)
        free[-2:] = structure.kind != kinds.NONE, structure.kind in kinds.SHAPED
        joint = Joint(structure, free, lower, np.maximum(upper, lower), centre, precision)
        found = maximize(structure.parameters, joint, self.levels, self.rough, tolerance)
        better = structure.with_parameters(found.theta)
        evidence = self._evidence(found, better, width)
        return Fitted(better, evidence, found.loss, found.mean, found)

    def _priors(self, structure: Structure) -> list[tuple[float, float, float, float, float]]:
        """Bounds of all parameters, mean and precision of a normal prior, and its width for the evidence."""
        spacing = np.pi / self.n
        rows = [(0.0, np.inf, 0.0, 0.0, 8.0 * _DECADES)] * len(structure.components)
        for c in structure.components:
            if c.kind == kinds.MARKOV:
                rows.append((math.log(_SHORTEST), math.log(self.n), 0.0, 0.0, math.log(self.n)))
            elif c.kind == kinds.OSCILLATOR:
                lower = max(c.shape[0] - _REACH, math.log(LOWEST * spacing))
                upper = min(c.shape[0] + _REACH, math.log(np.pi))
                rows.append((lower, upper, 0.0, 0.0, math.log(self.n / FREQUENCIES)))
                highest = math.log(max(c.frequency / (LINE * spacing), 2.0) - 0.5)
                rows.append((math.log(LEAST_QUALITY - 0.5), highest, *_QUALITY, 4.0 * _DECADES))
        least, most = bandwidths(structure.kind)
        least = max(LOWEST * spacing, 2.0 * np.pi * LOWEST_BANDWIDTH, least)
        rows.append((math.log(least), math.log(min(4.0, most)), 0.0, 0.0, 2.0 * _DECADES))
        return [*rows, (math.log(0.02), math.log(20.0), 0.0, 0.0, math.log(20.0))]

    def _evidence(
        self, found: Maximum, structure: Structure, width: Float[np.ndarray, " parameters"]
    ) -> float:
        """Laplace's approximation, in which a parameter that the data do not determine costs nothing."""
        free = found.interior
        D = width[free] / np.sqrt(2.0 * np.pi)
        F = found.information[np.ix_(free, free)]
        _, logdet = np.linalg.slogdet(F * np.outer(D, D) + np.eye(len(D)))
        used = [structure.components[k] for k in structure.there]
        more = sum(c.kind != kinds.COLUMN or c.which == OUTSIDE for c in used)
        if structure.kind != kinds.NONE:
            # Quantization beside a filter may be the filter's shape, the more so before it.
            rounded = structure.column(QUANTIZATION)
            more += 1 + (rounded.power > 0.0) * (1 + rounded.inside)
        return float(-found.loss - 0.5 * logdet - PRICE * more)


def model_of(structure: Structure, rate: float) -> Model:
    """Model with the values of a structure for samples at `rate` [Hz]."""
    terms = [(term_of(structure, k, rate), structure.components[k].inside) for k in structure.there]
    response = response_of(structure, rate)
    if response is None:
        return Model(tuple(term for term, _ in terms))
    inside, after = (Model(tuple(term for term, passes in terms if passes == side)) for side in (True, False))
    return (response * inside if len(inside) else inside) + after


def order_of(structure: Structure) -> int:
    """Order of the response: its number of poles, 1 of a moving average."""
    if structure.kind >= kinds.BUTTERWORTH_1:
        return structure.kind - kinds.BUTTERWORTH_1 + 1
    return 2 if structure.kind in kinds.SHAPED else 1


def term_of(structure: Structure, k: int, rate: float) -> NoiseTerm:
    """Term of component k; before the response if it passes through it."""
    component = structure.components[k]
    root = math.sqrt(component.power)
    if component.kind == kinds.MARKOV:
        time = component.time / rate
        return Markov(math.sqrt(2.0 / time) * root, time)
    if component.kind == kinds.OSCILLATOR:
        return Resonance(root, component.frequency * rate / (2.0 * np.pi), component.quality)
    if component.which < OUTSIDE:
        return basic_terms()[FIXED[component.which]].replace(coefficient=root)
    if component.which == FURTHER and (further := structure.further) is not None:
        return further.replace(**{further.amplitude_parameter().name: root})
    return AngleRandomWalk(root)
