"""Noise terms and their sums: one phase covariance a term, from which everything else follows.

Let θ(t) be the running integral of the rate output (angle of a gyro, velocity of an accelerometer). Every
random term of the thesis has stationary second differences of θ, so it is described completely by a
generalized covariance G(t): for filters a, b with Σa = Σa·t = 0,

    cov(Σ a_p θ(t_p), Σ b_q θ(t_q)) = Σ_p Σ_q a_p b_q G(t_p − t_q).

G is known only up to c0 + c1·t², which such filters do not see.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterator, Sequence
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from allanjax.base.arrays import namespace
from allanjax.base.errors import AllanjaxError
from allanjax.noise.numerics import gaussian_sequence, increment_autocovariance, sampled_density
from allanjax.noise.parameter import Parameter, Value
from allanjax.noise.recursion import linear_recurrence


class NoiseTerm(eqx.Module):
    """A noise term. A subclass declares its parameters, amplitude first, and its phase covariance.

        class FlickerAngle(allanjax.NoiseTerm):
            coefficient: float | None = allanjax.parameter("F", time_exponent=1.0)

            def phase_covariance(self, lag):
                return -(self.coefficient**2) * jnp.log(jnp.maximum(lag, 1e-3))

    and works in fits, simulations and plots. Overriding `psd` (and, for speed, `simulate`) is optional.
    Where an argument or a parameter is an array of JAX, so are the results of allanjax's own terms; else they
    are NumPy's, and nothing is compiled.
    """

    held: frozenset[str] = eqx.field(static=True, default=frozenset(), kw_only=True)

    #: True for a line, a ramp, a step: it is the same in every record, so that its square does not scatter.
    deterministic: ClassVar[bool] = False
    #: True if the term oscillates for long: its whole power fluctuates together, see `power_scatter`.
    narrow_band: ClassVar[bool] = False

    # ------------------------------------------------------------------ what a subclass provides
    def phase_covariance(self, lag: Float[Array, ...]) -> Float[Array, ...]:
        """Generalized covariance G [rad² or (m/s)²] of the integrated rate at lags ≥ 0 [s].

        Known up to c0 + c1·t², and one call need agree only with itself about these two constants.
        """
        raise NotImplementedError(f"{type(self).__name__} defines no phase_covariance(lag)")

    def psd(self, frequency: Float[ArrayLike, ...]) -> Float[Array, ...]:
        """Two-sided power spectral density of the rate, (rad/s)²/Hz or (m/s²)²/Hz, at frequencies [Hz]."""
        raise NotImplementedError(f"{type(self).__name__} defines no psd(frequency)")

    def column(self, time: Float[Array | np.ndarray, " n"]) -> Float[Array, " n"]:
        """Values of a deterministic term of unit amplitude at times [s] since the record's start.

        For terms that are known but for their amplitude; lines of unknown phase are not.
        """
        raise NotImplementedError(f"{type(self).__name__} defines no column(time)")

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Float[Array, " n"]:
        """Simulated samples of the rate (n means over sample intervals) at `rate` [Hz], exact in law.

        The default draws the increments of the rate, whose autocovariance is that of the second difference
        of θ, by circulant embedding (Davies & Harte 1987), and adds them up from zero: the level itself has
        no law when the term is not stationary.
        """
        from scipy.fft import next_fast_len

        half = next_fast_len(max(n, 2), real=True)
        increments = gaussian_sequence(key, increment_autocovariance(self.phase_covariance, half + 1, rate))[
            :n
        ]
        return linear_recurrence(1.0, increments)

    @property
    def oscillates(self) -> bool:
        """Whether G oscillates with a period of its own, so that sums over lags need more nodes."""
        return self.narrow_band

    def power_scatter(self, duration: Float[ArrayLike, ""]) -> Float[Array, ""]:
        """Relative variance of a narrow-band term's mean square over a record of this duration [s]."""
        raise NotImplementedError(f"{type(self).__name__} is narrow-band and defines no power_scatter")

    def sampled(self, rate: float) -> Self:
        """The term as seen by a sensor that samples at `rate` [Hz]; itself, unless sampling matters."""
        return self

    # ------------------------------------------------------------------ what follows from it
    def sampled_psd(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        """Two-sided PSD of the samples with aliases, (rad/s)²/Hz or (m/s²)²/Hz, up to the Nyquist frequency.

        The samples are means over 1/rate, so that minus the second difference of G takes the place of
        their autocovariance H, and S(f) = Σ_d H(d) cos(2πf·d/rate) / rate. This default sums it numerically
        over a dozen periods, enough for a covariance that is smooth or has ended by then; narrow-band terms
        and those with a closed form override it. Zero for a deterministic term.
        """
        xp = namespace(self, frequency, rate)
        f = xp.asarray(frequency, float)
        if self.deterministic:
            return xp.zeros(f.shape)
        # With derivatives of G, which are JAX's.
        density = jax.vmap(lambda a: sampled_density(self.phase_covariance, a, rate))
        return density(2.0 * np.pi * f.ravel() / rate).reshape(f.shape)

    def at_low_frequencies(self) -> NoiseTerm | None:
        """Smooth term that an oscillating one becomes at low frequencies; None if that is white noise."""
        return None

    def end_effect(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        """Power [rate²] that a record's two ends add to its cosine spectrum, times its number of samples.

        It spreads over all frequencies, and matters for terms whose own density falls off towards low ones.
        Zero unless overridden; see `cosine` for the lowest frequencies, where it is never neglected.
        """
        return namespace(self, frequency).zeros(np.shape(frequency))

    def allan_variance(self, cluster_time: Float[ArrayLike, ...]) -> Float[Array, ...]:
        """Allan variance [rate²] at cluster times [s]: [6G(0) − 8G(T) + 2G(2T)]/(2T²)."""
        return self._filter_variance(cluster_time, (6.0, -8.0, 2.0), 2.0)

    def hadamard_variance(self, cluster_time: Float[ArrayLike, ...]) -> Float[Array, ...]:
        """Hadamard variance [rate²] at cluster times [s]: [20G(0) − 30G(T) + 12G(2T) − 2G(3T)]/(6T²)."""
        return self._filter_variance(cluster_time, (20.0, -30.0, 12.0, -2.0), 6.0)

    @np.errstate(divide="ignore", invalid="ignore")
    def _filter_variance(
        self, cluster_time: Float[ArrayLike, ...], weights: Sequence[float], divisor: float
    ) -> Float[Array, ...]:
        """Weighted sum of G at 0, 1, … cluster times, over divisor·T²."""
        xp = namespace(self, cluster_time)
        T = xp.asarray(cluster_time, float)
        G, steps, w = self.phase_covariance, xp.arange(len(weights)), xp.asarray(weights)

        def at(t: Float[Array, ""]) -> Float[Array, ""]:
            # A call a cluster time, since G is known up to a multiple of t² that each call may choose.
            return G(steps * t) @ w / (divisor * t**2)

        # A term of the user's own may be JAX's only.
        if xp is np and T.size and not isinstance(at(T.flat[0]), jax.Array):
            return xp.array([at(t) for t in T.flat]).reshape(T.shape)
        return jax.vmap(at)(T.ravel()).reshape(T.shape)

    # ------------------------------------------------------------------ parameters
    @classmethod
    def parameters(cls) -> tuple[Parameter, ...]:
        """Declared parameters, in order; the first is the amplitude."""
        found = tuple(
            Parameter(field.name, **field.metadata["parameter"])
            for field in dataclasses.fields(cls)
            if "parameter" in field.metadata
        )
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

    @classmethod
    def name(cls) -> str:
        """Name of the term, e.g. "bias_instability"."""
        return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", cls.__name__).lower()

    def is_free(self, p: Parameter) -> bool:
        """Whether a fit estimates this parameter. An infinite value is a limit, never a start."""
        value = getattr(self, p.name)
        infinite = isinstance(value, float) and math.isinf(value)
        return p.name not in self.held and not infinite

    @property
    def has_free_amplitude(self) -> bool:
        """Whether a fit estimates the amplitude."""
        return self.is_free(self.amplitude_parameter())

    def hold(self, *names: str, **values: float) -> Self:
        """A copy whose named parameters a fit leaves alone, e.g. `Markov().hold(correlation_time=100.0)`."""
        known = {p.name for p in self.parameters()}
        for name in (*names, *values):
            if name not in known:
                raise AllanjaxError(f"{self.name()} has no parameter {name!r}; it has {sorted(known)}")
        held = self.held | set(names) | set(values)
        term = dataclasses.replace(self, **values, held=held)
        unset = [name for name in held if getattr(term, name) is None]
        if unset:
            raise AllanjaxError(f"{self.name()}: cannot hold {unset[0]} without a value; give {unset[0]}=…")
        return term

    def replace(self, **values: Any) -> Self:
        """A copy with these parameter values."""
        return dataclasses.replace(self, **values)

    def with_unit_amplitude(self) -> Self:
        """A copy of amplitude 1."""
        return self.replace(**{self.amplitude_parameter().name: 1.0})

    def __repr__(self) -> str:
        """Python expression with values in SI, e.g. `Markov(correlation_time=3).hold("correlation_time")`."""
        usual = {field.name: field.default for field in dataclasses.fields(self)}
        shown = {p.name: _shown(getattr(self, p.name)) for p in self.parameters()}
        names = [name for name, text in shown.items() if text != _shown(usual[name])]
        values = [f"{name}={shown[name]}" for name in names]
        arguments = ", ".join(values).removeprefix("coefficient=")
        held = ", ".join(f'"{name}"' for name in names if name in self.held)
        return f"{type(self).__name__}({arguments})" + (f".hold({held})" if held else "")

    def __add__(self, other: NoiseTerm | Model) -> Model:
        return Model((self,)) + other

    def __check_init__(self) -> None:
        for p in self.parameters():
            value = getattr(self, p.name)
            if isinstance(value, int | float | np.floating):
                bound = ""
                if not (value >= 0 if p.is_amplitude else value > p.lower):
                    bound = "≥ 0" if p.is_amplitude else f"> {p.lower:g}"
                # Infinity is a valid limit of some parameters, e.g. of a cutoff.
                elif value >= p.upper < math.inf:
                    bound = f"< {p.upper:g}"
                if bound:
                    raise AllanjaxError(f"{self.name()}: {p.name} must be {bound}, got {value!r}")


def _shown(value: Value) -> str:
    """Value to six digits; an array inside a compiled function as JAX prints it."""
    return f"{value:.6g}" if isinstance(value, int | float | np.floating) else str(value)


def _zeros(like: ArrayLike) -> Float[Array, ...]:
    """Zeros in the shape of the argument, NumPy's unless that is JAX's."""
    return namespace(like).zeros(np.shape(like))


@dataclasses.dataclass(frozen=True)
class ModelParameter:
    """A parameter of one term of a model.

    Attributes:
        label: name in the model, e.g. "bias_instability" (for a term's sole `coefficient`),
            "markov_correlation_time", or "markov_2_amplitude" where there are several Markov terms.
        term: index of its term.
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
    """A sum of noise terms, written with `+`: `Quantization() + AngleRandomWalk() + Markov()`."""

    terms: tuple[NoiseTerm, ...]

    def __check_init__(self) -> None:
        for term in self.terms:
            if not isinstance(term, NoiseTerm):
                raise AllanjaxError(
                    f"a model adds up noise terms, and {term!r} is none; "
                    "add instances, e.g. AngleRandomWalk() with its parentheses"
                )

    def __add__(self, other: NoiseTerm | Model) -> Model:
        if isinstance(other, Model):
            return Model(self.terms + other.terms)
        if isinstance(other, NoiseTerm):
            return Model((*self.terms, other))
        raise AllanjaxError(
            f"cannot add {other!r} to a model; add instances of noise terms, e.g. AngleRandomWalk()"
        )

    def __repr__(self) -> str:
        return " + ".join(map(repr, self.terms)) or "Model(())"

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
        """Parameters of all terms, in order."""
        found = []
        for i, (term, term_label) in enumerate(zip(self.terms, self.term_labels, strict=True)):
            for p in term.parameters():
                label = term_label if p.name == "coefficient" else f"{term_label}_{p.name}"
                found.append(ModelParameter(label, i, term_label, p, term.is_free(p), getattr(term, p.name)))
        return tuple(found)

    @property
    def values(self) -> dict[str, float | None]:
        """Value of each parameter by its label, SI; None where it has none yet."""
        return {p.label: getattr(self.terms[p.term], p.parameter.name) for p in self.parameters}

    def with_values(self, **values: ArrayLike) -> Model:
        """A copy with these parameter values (SI), named by label."""
        places = {p.label: p for p in self.parameters}
        terms = list(self.terms)
        for label, value in values.items():
            if label not in places:
                raise AllanjaxError(f"the model has no parameter {label!r}; it has {', '.join(places)}")
            p = places[label]
            terms[p.term] = terms[p.term].replace(**{p.parameter.name: value})
        return Model(tuple(terms))

    def without(self, labels: Sequence[str]) -> Model:
        """A copy without the terms of these names."""
        pairs = zip(self.term_labels, self.terms, strict=True)
        return Model(tuple(term for label, term in pairs if label not in labels))

    def sampled(self, rate: float) -> Model:
        """The model as seen by a sensor that samples at `rate` [Hz]."""
        return Model(tuple(term.sampled(rate) for term in self.terms))

    def check_complete(self) -> None:
        """Raise AllanjaxError if a parameter has no value."""
        for label, value in self.values.items():
            if value is None:
                raise AllanjaxError(f"{label} has no value: give it one, or fit the model to a recording")

    # ------------------------------------------------------------------ sums over the terms
    def phase_covariance(self, lag: Float[ArrayLike, ...]) -> Float[Array, ...]:
        """Generalized covariance of the integrated rate [rad² or (m/s)²] at lags [s]."""
        self.check_complete()
        lags: Any = namespace(lag).asarray(lag)
        return sum((t.phase_covariance(lags) for t in self.terms), _zeros(lag))

    def psd(self, frequency: Float[ArrayLike, ...]) -> Float[Array, ...]:
        """Two-sided rate PSD, (rad/s)²/Hz or (m/s²)²/Hz, at frequencies [Hz]; lines have no density."""
        self.check_complete()
        return sum((t.psd(frequency) for t in self.terms), _zeros(frequency))

    def sampled_psd(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        """Two-sided PSD of samples at `rate` [Hz], aliases included; lines and ramps have none."""
        self.check_complete()
        return sum((t.sampled_psd(frequency, rate) for t in self.terms), _zeros(frequency))

    def allan_variance(self, cluster_time: Float[ArrayLike, ...]) -> Float[Array, ...]:
        """Allan variance [rate²] at cluster times [s]."""
        self.check_complete()
        return sum((t.allan_variance(cluster_time) for t in self.terms), _zeros(cluster_time))

    def hadamard_variance(self, cluster_time: Float[ArrayLike, ...]) -> Float[Array, ...]:
        """Hadamard variance [rate²] at cluster times [s]."""
        self.check_complete()
        return sum((t.hadamard_variance(cluster_time) for t in self.terms), _zeros(cluster_time))

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Float[Array, " n"]:
        """Simulated samples of the sum, n means of the rate, each term drawn with a key of its own."""
        self.check_complete()
        keys = jax.random.split(key, max(len(self.terms), 1))
        draws = (t.simulate(k, n, rate) for t, k in zip(self.terms, keys, strict=False))
        return sum(draws, jnp.zeros(n))
