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
from allanjax.base.module import Module
from allanjax.noise.parameter import Parameter, Parametrized
from allanjax.noise.process import Process, Reals, RealsLike, Samples
from allanjax.noise.response import FilteredProcess, Response
from allanjax.noise.state_space import Block, StateSpace, filtered_block, together
from allanjax.record.units import Sensor


class NoiseTerm(Parametrized, Process):
    """A noise term; a subclass declares its parameters, the amplitude first, and its phase covariance.

        class FlickerAngle(allanjax.NoiseTerm):
            coefficient: float | None = allanjax.parameter("F", time_exponent=1.0)

            def phase_covariance(self, lag):
                return -(self.coefficient**2) * jnp.log(jnp.maximum(lag, 1e-3))

    works in fits, simulations and plots. Overriding `psd` (and, for speed, `simulate`) is optional; with
    `parts` a term can pass a `Response`, with `state_block` it has states for a Kalman filter. If an argument
    or a parameter is a JAX array, allanjax's own terms return JAX arrays; otherwise NumPy's, and nothing is
    compiled.
    """

    # ------------------------------------------------------------------ what some subclasses provide
    def column(self, time: Float[Array | np.ndarray, " n"]) -> Samples:
        """Values of a deterministic term of unit amplitude at times [s] since the record's start.

        Only for terms of which nothing but the amplitude is unknown, unlike a line of unknown phase.
        """
        raise NotImplementedError(f"{type(self).__name__} does not define column(time)")

    def sampled(self, rate: float) -> Self:
        """The term for a sensor that samples at `rate` [Hz], if it has a field `sample_interval` [s]."""
        return self.replace(sample_interval=1.0 / rate) if hasattr(self, "sample_interval") else self

    def given(self, channels: Mapping[str, Float[np.ndarray, " n"]], rate: float) -> NoiseTerm:
        """The term with the samples at `rate` [Hz] of the channel that it follows, if it follows one."""
        return self

    @property
    def missing_channel(self) -> str:
        """Name of the channel that the term follows if its samples are missing; "" otherwise."""
        return ""

    def at_low_frequencies(self) -> NoiseTerm | None:
        """Smooth term that an oscillating one resembles at low frequencies; None for white noise."""
        return None

    def state_block(self, rate: float, duration: float | None) -> Block:
        """States of the term in samples at `rate` [Hz], for a Kalman filter; see `Model.state_space`.

        `duration` [s] is for terms without a finite state space, which are approximated up to there.
        """
        raise AllanjaxError(
            f"{self.name()} has no finite state space: leave it out, model.without(['{self.name()}']), or "
            "fit a term that has one, e.g. Markov()"
        )

    # ------------------------------------------------------------------ parameters
    @classmethod
    def parameters(cls) -> tuple[Parameter, ...]:  # type: ignore[override]  # without the cache
        """Declared parameters, in order; the first is the amplitude."""
        declared = super().parameters()
        if not declared or not declared[0].is_amplitude:
            raise AllanjaxError(
                f"{cls.__name__}: the first parameter of a noise term must be its amplitude; "
                "declare it with `coefficient: float | None = allanjax.parameter('c', time_exponent=…)`"
            )
        return declared

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
        start: its value in the model; None if it has none.
    """

    label: str
    term: int
    term_label: str
    parameter: Parameter
    free: bool
    start: float | None


class Model(Module):
    """A sum of noise terms, written with `+`: `Quantization() + AngleRandomWalk() + Markov()`.

    Some may pass a filter, the model's `response`, written as a factor:
    `LowPass1(28.0) * (AngleRandomWalk() + RateRandomWalk()) + Resonance()`.

    Attributes:
        terms: the noise terms.
        response: the filter that some of them pass, if there is one.
        inside: whether each term does; by default none does.
        rate: sample rate [Hz] of the response; 0 before `sampled`.
    """

    terms: tuple[NoiseTerm, ...]
    response: Response | None = None
    inside: tuple[bool, ...] = eqx.field(static=True, default=())
    rate: float = eqx.field(static=True, default=0.0)

    def __post_init__(self) -> None:
        self.inside = self.inside or (False,) * len(self.terms)

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
        inside = self.inside + other.inside
        return Model(self.terms + other.terms, response, inside, self.rate or other.rate)

    def __rmul__(self, other: Response) -> Model:
        if not isinstance(other, Response):
            return NotImplemented
        if self.response is not None:
            raise AllanjaxError(f"the model already has {self.response!r}; a model has one response")
        for term in self.terms:
            if term.deterministic:
                raise AllanjaxError(f"{term.name()} is deterministic: write it after the filter of the noise")
        return dataclasses.replace(self, response=other, inside=(True,) * len(self.terms))

    def __repr__(self) -> str:
        pairs = list(zip(self.terms, self.inside, strict=True))
        after = [repr(term) for term, inside in pairs if not inside]
        if self.response is not None:
            filtered = " + ".join(repr(term) for term, inside in pairs if inside)
            after = [f"{self.response!r} * ({filtered})", *after]
        return " + ".join(after) or "Model(())"

    @property
    def processes(self) -> tuple[Process, ...]:
        """The terms as they appear in the samples: after the response if they pass it."""
        if self.response is None:
            return self.terms
        return tuple(
            FilteredProcess(term, self.response, self.rate) if inside else term
            for term, inside in zip(self.terms, self.inside, strict=True)
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
        owners: list[tuple[Parametrized, str]] = list(zip(self.terms, self.term_labels, strict=True))
        if self.response is not None:
            owners.append((self.response, self.response.name()))
        parameters = []
        for i, (owner, name) in enumerate(owners):
            # Methods of modules are slow: each access makes an object.
            kind = type(owner)
            for p in kind.parameters():
                label = name if p.name == "coefficient" else f"{name}_{p.name}"
                free = kind.is_free(owner, p)
                parameters.append(ModelParameter(label, i, name, p, free, getattr(owner, p.name)))
        return tuple(parameters)

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
        terms, inside = tuple(self.terms[k] for k in kept), tuple(self.inside[k] for k in kept)
        return dataclasses.replace(self, terms=terms, inside=inside) if any(inside) else Model(terms)

    def sampled(self, rate: float) -> Model:
        """The model for a sensor that samples at `rate` [Hz]."""
        terms = tuple(term.sampled(rate) for term in self.terms)
        if self.response is None:
            return dataclasses.replace(self, terms=terms, rate=0.0)
        return dataclasses.replace(self, terms=terms, response=self.response.sampled(rate), rate=rate)

    def given(self, channels: Mapping[str, Float[np.ndarray, " n"]], rate: float) -> Model:
        """The model with the samples at `rate` [Hz] of the channels that its terms follow."""
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
                raise AllanjaxError(f"the {name} of a state space must be positive and finite, not {value}")
        return StateSpace.of(self.state_block(rate, duration), rate, sensor, repr(self))

    def state_block(self, rate: float, duration: float | None) -> Block:
        """States of all terms, after the response if they pass it; see `state_space`."""
        sampled = self.sampled(float(rate))
        blocks = [
            term.state_block(rate, duration).labelled(label)
            for term, label in zip(sampled.terms, self.term_labels, strict=True)
        ]
        if sampled.response is not None and any(self.inside):
            within = [b for b, inside in zip(blocks, self.inside, strict=True) if inside]
            after = [b for b, inside in zip(blocks, self.inside, strict=True) if not inside]
            b, a = sampled.response.transfer(rate)
            blocks = [filtered_block(together(within), b, a, sampled.response.name()), *after]
        return together(blocks)

    # ------------------------------------------------------------------ sums over the terms
    def phase_covariance(self, lag: RealsLike) -> Reals:
        """Generalized covariance of the integrated rate [rad² or (m/s)²] at lags [s]."""
        return self._sum("phase_covariance", namespace(lag).asarray(lag))

    def psd(self, frequency: RealsLike) -> Reals:
        """Two-sided rate PSD, (rad/s)²/Hz or (m/s²)²/Hz, at frequencies [Hz]; lines have no density."""
        return self._sum("psd", frequency)

    def sampled_psd(self, frequency: RealsLike, rate: float) -> Reals:
        """Two-sided PSD of samples at `rate` [Hz], aliases included; lines and ramps have none."""
        return self._sum("sampled_psd", frequency, rate)

    def allan_variance(self, cluster_time: RealsLike) -> Reals:
        """Allan variance [rate²] at cluster times [s]."""
        return self._sum("allan_variance", cluster_time)

    def hadamard_variance(self, cluster_time: RealsLike) -> Reals:
        """Hadamard variance [rate²] at cluster times [s]."""
        return self._sum("hadamard_variance", cluster_time)

    def _sum(self, method: str, x: RealsLike, *more: float) -> Reals:
        """Sum of this method's values over the processes; zeros without any, NumPy's unless x is JAX's."""
        self.check_complete()
        values = (getattr(process, method)(x, *more) for process in self.processes)
        return sum(values, namespace(x).zeros(np.shape(x)))

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Samples:
        """Simulated samples of the sum, n means of the rate, each term drawn with a key of its own."""
        self.check_complete()
        keys = jax.random.split(key, max(len(self.terms), 1))
        draws = (t.simulate(k, n, rate) for t, k in zip(self.processes, keys, strict=False))
        return sum(draws, jnp.zeros(n))
