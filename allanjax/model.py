"""A model: the sum of noise terms."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from allanjax.errors import AllanjaxError
from allanjax.terms.base import NoiseTerm, Parameter


@dataclasses.dataclass(frozen=True)
class ModelParameter:
    """A parameter of one term of a model.

    Attributes:
        label: its name in the model, e.g. "bias_instability" (for a term's sole `coefficient`),
            "markov_correlation_time", or "markov_2_amplitude" where there are several Markov terms.
        term: index of its term.
        term_label: that term's name, numbered where there are several.
        parameter: what it is.
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
        """The term of that name, e.g. `model["bias_instability"]` or `model["markov_2"]`."""
        labels = self.term_labels
        if label not in labels:
            raise AllanjaxError(f"the model has no term {label!r}; it has {', '.join(labels)}")
        return self.terms[labels.index(label)]

    @property
    def term_labels(self) -> tuple[str, ...]:
        """The terms' names, numbered from 1 where one occurs several times."""
        names = [term.name() for term in self.terms]
        return tuple(
            f"{name}_{names[: i + 1].count(name)}" if names.count(name) > 1 else name
            for i, name in enumerate(names)
        )

    @property
    def parameters(self) -> tuple[ModelParameter, ...]:
        """All parameters, term after term."""
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
        return sum((t.phase_covariance(jnp.asarray(lag)) for t in self.terms), jnp.zeros(np.shape(lag)))

    def psd(self, frequency: Float[ArrayLike, ...]) -> Float[Array, ...]:
        """Two-sided rate PSD, (rad/s)²/Hz or (m/s²)²/Hz, at frequencies [Hz]; lines have no density."""
        self.check_complete()
        return sum((t.psd(frequency) for t in self.terms), jnp.zeros(np.shape(frequency)))

    def sampled_psd(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        """Two-sided PSD of samples at `rate` [Hz], aliases included; lines and ramps have none."""
        self.check_complete()
        return sum((t.sampled_psd(frequency, rate) for t in self.terms), jnp.zeros(np.shape(frequency)))

    def allan_variance(self, cluster_time: Float[ArrayLike, ...]) -> Float[Array, ...]:
        """Allan variance [rate²] at cluster times [s]."""
        self.check_complete()
        return sum((t.allan_variance(cluster_time) for t in self.terms), jnp.zeros(np.shape(cluster_time)))

    def hadamard_variance(self, cluster_time: Float[ArrayLike, ...]) -> Float[Array, ...]:
        """Hadamard variance [rate²] at cluster times [s]."""
        self.check_complete()
        return sum((t.hadamard_variance(cluster_time) for t in self.terms), jnp.zeros(np.shape(cluster_time)))

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Float[Array, " n"]:
        """n rate samples of the sum, every term with its own share of the key."""
        self.check_complete()
        keys = jax.random.split(key, max(len(self.terms), 1))
        draws = (t.simulate(k, n, rate) for t, k in zip(self.terms, keys, strict=False))
        return sum(draws, jnp.zeros(n))
