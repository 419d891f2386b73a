"""Noise terms, their parameters, and their sums.

Each is a process with a phase covariance (`process`), from which all else follows.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from allanjax.base.arrays import namespace
from allanjax.base.errors import AllanjaxError
from allanjax.base.renamed import renamed
from allanjax.noise.parameter import Parameter, Parametrized
from allanjax.noise.process import FilteredProcess, Process
from allanjax.noise.response import Response
from allanjax.noise.state_space import Block, StateSpace, filtered_block, together
from allanjax.record.units import Sensor


class NoiseTerm(Parametrized, Process):
    """A noise term. A subclass declares its parameters, amplitude first, and its phase covariance.

        class FlickerAngle(allanjax.NoiseTerm):
            coefficient: float | None = allanjax.parameter("F", time_exponent=1.0)

            def phase_covariance(self, lag):
                return -(self.coefficient**2) * jnp.log(jnp.maximum(lag, 1e-3))

    and works in fits, simulations and plots. Overriding `psd` (and, for speed, `simulate`) is optional; with
    `parts` a term can pass a `Response`, with `state_block` it has states for a Kalman filter.
    Where an argument or a parameter is an array of JAX, so are the results of allanjax's own terms; else they
    are NumPy's, and nothing is compiled.
    """

    # ------------------------------------------------------------------ what some subclasses provide
    def column(self, time: Float[Array | np.ndarray, " n"]) -> Float[Array, " n"]:
        """Values of a deterministic term of unit amplitude at times [s] since the record's start.

        For terms that are known but for their amplitude; lines of unknown phase are not.
        """
        raise NotImplementedError(f"{type(self).__name__} does not define column(time)")

    def sampled(self, rate: float) -> Self:
        """The term for a sensor that samples at `rate` [Hz]; the term itself, unless sampling matters."""
        return self

    def given(self, channels: Mapping[str, Float[np.ndarray, " n"]], rate: float) -> NoiseTerm:
        """The term with the channel that it follows, sampled at `rate` [Hz]; itself if it follows none."""
        return self

    @property
    def missing_channel(self) -> str:
        """Name of the channel that it follows and has not been given; "" if there is none."""
        return ""

    def at_low_frequencies(self) -> NoiseTerm | None:
        """Smooth term that an oscillating one becomes at low frequencies; None if that is white noise."""
        return None

    def state_block(self, rate: float, duration: float | None) -> Block:
        """States of the term in samples at `rate` [Hz], for a Kalman filter; see `Model.state_space`.

        `duration` [s] is for terms that have no finite state space, and are approximated up to there.
        """
        raise AllanjaxError(
            f"{self.name()} has no finite state space: leave it out, model.without(['{self.name()}']), or "
            "fit a term that has one, e.g. Markov()"
        )

    # ------------------------------------------------------------------ parameters
    @classmethod
    def parameters(cls) -> tuple[Parameter, ...]:
        """Declared parameters, in order; the first is the amplitude."""
        found = super().parameters()
        if not found or not found[0].is_amplitude:
            raise AllanjaxError(
                f"{cls.__name__}: the first parameter of a noise term must be its amplitude; "
                "declare it with `coefficient: float | None = allanjax.parameter('c', time_exponent=…)`"
            )
        return found

    @classmethod
    def amplitude_parameter(cls) -> Parameter:
        """The amplitude, to the square of which the phase covariance is proportional."""
        return cls.parameters()[0]

    @property
    def has_free_amplitude(self) -> bool:
        """Whether a fit estimates the amplitude."""
        return self.is_free(self.amplitude_parameter())

    def with_unit_amplitude(self) -> Self:
        """A copy of amplitude 1."""
        return self.replace(**{self.amplitude_parameter().name: 1.0})

    def __add__(self, other: NoiseTerm | Model) -> Model:
        return Model((self,)) + other

    def __rmul__(self, other: Response) -> Model:
        return other * Model((self,))


def _zeros(like: ArrayLike) -> Float[Array, ...]:
    """Zeros in the shape of the argument, NumPy's unless that is JAX's."""
    return namespace(like).zeros(np.shape(like))


@dataclasses.dataclass(frozen=True)
class ModelParameter:
    """A parameter of one term of a model, or of its response.

    Attributes:
        label: name in the model, e.g. "bias_instability" (for a term's sole `coefficient`),
            "markov_correlation_time", or "markov_2_amplitude" where there are several Markov terms.
        term: index of its term; that of a response follows those of all terms.
        term_label: name of that term, numbered where there are several.
        parameter: the term's declaration of it.
        free: whether a fit estimates it.
        start: its value in the model, if it has one.
    """

    label: str
    term: int
    term_label: str
    parameter: Parameter
    free: bool
    start: float | None


class Model(eqx.Module):
    """A sum of noise terms, written with `+`: `Quantization() + AngleRandomWalk() + Markov()`.

    Some may pass a filter, the model's `response`, written as a factor:
    `LowPass1(28.0) * (AngleRandomWalk() + RateRandomWalk()) + Resonance()`.

    Attributes:
        terms: the noise terms.
        response: the filter that some of them pass, if there is one.
        inside: which of them do; none if it is empty.
        rate: sample rate [Hz] at which the response is meant; 0 before `sampled`.
    """

    terms: tuple[NoiseTerm, ...]
    response: Response | None = None
    inside: tuple[bool, ...] = eqx.field(static=True, default=())
    rate: float = eqx.field(static=True, default=0.0)

    def __check_init__(self) -> None:
        for term in self.terms:
            if not isinstance(term, NoiseTerm):
                raise AllanjaxError(
                    f"{term!r} is not a noise term; add instances such as AngleRandomWalk(), with parentheses"
                )

    def __add__(self, other: NoiseTerm | Model) -> Model:
        if isinstance(other, NoiseTerm):
            other = Model((other,))
        if not isinstance(other, Model):
            raise AllanjaxError(
                f"cannot add {other!r} to a model; add instances of noise terms, e.g. AngleRandomWalk()"
            )
        if None not in (self.response, other.response) and repr(self.response) != repr(other.response):
            raise AllanjaxError(f"a model has one response, not {self.response!r} and {other.response!r}")
        response = other.response if self.response is None else self.response
        inside = () if response is None else self._is_inside + other._is_inside
        return Model(self.terms + other.terms, response, inside, self.rate or other.rate)

    def __rmul__(self, other: Response) -> Model:
        if not isinstance(other, Response):
            return NotImplemented
        if self.response is not None:
            raise AllanjaxError(f"the model has already passed {self.response!r}; a model has one response")
        for term in self.terms:
            if term.deterministic:
                raise AllanjaxError(f"{term.name()} is not noise: write it after the filter")
        return dataclasses.replace(self, response=other, inside=(True,) * len(self.terms))

    def __repr__(self) -> str:
        after = [repr(term) for term, inside in zip(self.terms, self._is_inside, strict=True) if not inside]
        if self.response is not None:
            passing = zip(self.terms, self._is_inside, strict=True)
            filtered = [repr(term) for term, inside in passing if inside]
            after = [f"{self.response!r} * ({' + '.join(filtered)})", *after]
        return " + ".join(after) or "Model(())"

    @property
    def _is_inside(self) -> tuple[bool, ...]:
        """Whether each term passes the response."""
        return self.inside or (False,) * len(self.terms)

    seen = renamed("processes")

    @property
    def processes(self) -> tuple[Process, ...]:
        """The terms as they appear in the samples: after the response if they pass it."""
        if self.response is None:
            return self.terms
        return tuple(
            FilteredProcess(term, self.response, self.rate) if inside else term
            for term, inside in zip(self.terms, self._is_inside, strict=True)
        )

    def __iter__(self) -> Iterator[NoiseTerm]:
        return iter(self.terms)

    def __len__(self) -> int:
        return len(self.terms)

    def __getitem__(self, label: str) -> NoiseTerm:
        """Term of this name, e.g. `model["bias_instability"]` or `model["markov_2"]`."""
        labels = self.term_labels
        if label not in labels:
            raise AllanjaxError(f"the model has no term {label!r}; it has {', '.join(labels)}")
        return self.terms[labels.index(label)]

    @property
    def term_labels(self) -> tuple[str, ...]:
        """Names of the terms, numbered from 1 where one occurs several times."""
        names = [term.name() for term in self.terms]
        return tuple(
            f"{name}_{names[: i + 1].count(name)}" if names.count(name) > 1 else name
            for i, name in enumerate(names)
        )

    @property
    def parameters(self) -> tuple[ModelParameter, ...]:
        """Parameters of all terms, in order, then those of the response."""
        found = []
        for i, (term, term_label) in enumerate(zip(self.terms, self.term_labels, strict=True)):
            for p in term.parameters():
                label = term_label if p.name == "coefficient" else f"{term_label}_{p.name}"
                found.append(ModelParameter(label, i, term_label, p, term.is_free(p), getattr(term, p.name)))
        if (r := self.response) is not None:
            found += [
                ModelParameter(
                    f"{r.name()}_{p.name}", len(self.terms), r.name(), p, r.is_free(p), getattr(r, p.name)
                )
                for p in r.parameters()
            ]
        return tuple(found)

    @property
    def values(self) -> dict[str, float | None]:
        """Value of each parameter by its label, SI; None where it has none yet."""
        return {p.label: p.start for p in self.parameters}

    def with_values(self, **values: ArrayLike) -> Model:
        """A copy with these parameter values (SI), named by label."""
        places = {p.label: p for p in self.parameters}
        owners: list[Any] = [*self.terms, self.response]
        for label, value in values.items():
            if label not in places:
                raise AllanjaxError(f"the model has no parameter {label!r}; it has {', '.join(places)}")
            p = places[label]
            owners[p.term] = owners[p.term].replace(**{p.parameter.name: value})
        return dataclasses.replace(self, terms=tuple(owners[:-1]), response=owners[-1])

    def without(self, labels: Sequence[str]) -> Model:
        """A copy without the terms of these names."""
        kept = [k for k, label in enumerate(self.term_labels) if label not in labels]
        inside = tuple(self._is_inside[k] for k in kept)
        if not any(inside):
            return Model(tuple(self.terms[k] for k in kept))
        return dataclasses.replace(self, terms=tuple(self.terms[k] for k in kept), inside=inside)

    def sampled(self, rate: float) -> Model:
        """The model for a sensor that samples at `rate` [Hz]."""
        terms = tuple(term.sampled(rate) for term in self.terms)
        if self.response is None:
            return dataclasses.replace(self, terms=terms, rate=0.0)
        return dataclasses.replace(self, terms=terms, response=self.response.sampled(rate), rate=rate)

    def given(self, channels: Mapping[str, Float[np.ndarray, " n"]], rate: float) -> Model:
        """The model whose terms have been given the channels that they follow, sampled at `rate` [Hz]."""
        return dataclasses.replace(self, terms=tuple(term.given(channels, rate) for term in self.terms))

    def check_complete(self) -> None:
        """Raise AllanjaxError if a parameter has no value."""
        for label, value in self.values.items():
            if value is None:
                raise AllanjaxError(f"{label} has no value: set it, or fit the model to a recording")

    def state_space(
        self, rate: float, *, duration: float | None = None, sensor: Sensor = "gyro"
    ) -> StateSpace:
        """Matrices A, H, Q, R and P0 of the samples at `rate` [Hz], for a Kalman filter.

        Exact but for bias instability and power laws, which are sums of Gauss–Markov processes: their
        spectrum and Allan variance are within 3 % from 1/duration to half the rate. Random walks begin
        at zero, as in `simulate`: a bias at switching on is the user's to add to P0.

        Args:
            rate: sample rate [Hz].
            duration: how long the filter runs [s]; needed for bias instability and power laws only.
            sensor: "gyro" or "accel", for the units.

        Raises:
            AllanjaxError: a parameter without a value; a term or a response that has no finite state
                space; no duration where one is needed; a rate or a duration that is not positive.
        """
        self.check_complete()
        for name, value in (("rate", rate), ("duration", duration)):
            if value is not None and not 0.0 < value < math.inf:
                raise AllanjaxError(f"the {name} of a state space must be positive and finite, got {value}")
        return StateSpace.of(self.state_block(rate, duration), rate, sensor, repr(self))

    def state_block(self, rate: float, duration: float | None) -> Block:
        """States of all terms, after the response if they pass it; see `state_space`."""
        sampled = self.sampled(float(rate))
        blocks = [
            term.state_block(rate, duration).labelled(label)
            for term, label in zip(sampled.terms, self.term_labels, strict=True)
        ]
        if sampled.response is not None and any(self._is_inside):
            within = [b for b, inside in zip(blocks, self._is_inside, strict=True) if inside]
            after = [b for b, inside in zip(blocks, self._is_inside, strict=True) if not inside]
            b, a = sampled.response.transfer(rate)
            blocks = [filtered_block(together(within), b, a, sampled.response.name()), *after]
        return together(blocks)

    # ------------------------------------------------------------------ sums over the terms
    def phase_covariance(self, lag: Float[ArrayLike, ...]) -> Float[Array, ...]:
        """Generalized covariance of the integrated rate [rad² or (m/s)²] at lags [s]."""
        self.check_complete()
        lags: Any = namespace(lag).asarray(lag)
        return sum((t.phase_covariance(lags) for t in self.processes), _zeros(lag))

    def psd(self, frequency: Float[ArrayLike, ...]) -> Float[Array, ...]:
        """Two-sided rate PSD, (rad/s)²/Hz or (m/s²)²/Hz, at frequencies [Hz]; lines have no density."""
        self.check_complete()
        return sum((t.psd(frequency) for t in self.processes), _zeros(frequency))

    def sampled_psd(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        """Two-sided PSD of samples at `rate` [Hz], aliases included; lines and ramps have none."""
        self.check_complete()
        return sum((t.sampled_psd(frequency, rate) for t in self.processes), _zeros(frequency))

    def allan_variance(self, cluster_time: Float[ArrayLike, ...]) -> Float[Array, ...]:
        """Allan variance [rate²] at cluster times [s]."""
        self.check_complete()
        return sum((t.allan_variance(cluster_time) for t in self.processes), _zeros(cluster_time))

    def hadamard_variance(self, cluster_time: Float[ArrayLike, ...]) -> Float[Array, ...]:
        """Hadamard variance [rate²] at cluster times [s]."""
        self.check_complete()
        return sum((t.hadamard_variance(cluster_time) for t in self.processes), _zeros(cluster_time))

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Float[Array, " n"]:
        """Simulated samples of the sum, n means of the rate, each term drawn with a key of its own."""
        self.check_complete()
        keys = jax.random.split(key, max(len(self.terms), 1))
        draws = (t.simulate(k, n, rate) for t, k in zip(self.processes, keys, strict=False))
        return sum(draws, jnp.zeros(n))
