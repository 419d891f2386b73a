"""The noise term: one phase covariance, from which everything else follows.

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
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import erfc
from jaxtyping import Array, ArrayLike, Float, Num, PRNGKeyArray
from scipy.fft import next_fast_len

from allanjax.errors import AllanjaxError
from allanjax.terms.recursion import linear_recurrence

if TYPE_CHECKING:
    from allanjax.model import Model

# Lags that the default of `sampled_psd` takes one by one.
_SINGLE_LAGS = 512

#: A parameter's value: a number, an array inside compiled functions, or None for "to be estimated".
Value: TypeAlias = Any

ParameterKind = Literal["amplitude", "time", "frequency", "line", "number"]


@dataclasses.dataclass(frozen=True)
class Parameter:
    """What one field of a noise term is.

    Attributes:
        name: the field's name.
        symbol: how the literature writes it, e.g. "N".
        kind: "amplitude" (G is proportional to its square; the first parameter of every term), "time" [s],
            "frequency" [Hz], "line" (the frequency [Hz] of a narrow feature, started at peaks of the
            spectrum) or "number" (dimensionless).
        time_exponent: of an amplitude, the p in its SI unit (rate)·s^p, rate being rad/s or m/s².
        lower, upper: the open bounds of the admissible values.
    """

    name: str
    symbol: str
    kind: ParameterKind
    time_exponent: float
    lower: float
    upper: float


def parameter(
    symbol: str,
    kind: ParameterKind = "amplitude",
    *,
    time_exponent: float = 0.0,
    lower: float = 0.0,
    upper: float = math.inf,
    default: float | None = None,
) -> Any:
    """Declare a parameter of a noise term (a dataclass field; see `Parameter` for the arguments).

    A parameter left at None is estimated from the data; one with a value is estimated with that value as a
    start, unless the term holds it (`NoiseTerm.hold`).
    """
    declared: dict[str, Any] = {"symbol": symbol, "kind": kind, "time_exponent": time_exponent}
    declared |= {"lower": lower, "upper": upper}
    return eqx.field(default=default, metadata={"parameter": declared})


class NoiseTerm(eqx.Module):
    """A noise term. A subclass declares its parameters, amplitude first, and its phase covariance.

        class FlickerAngle(allanjax.NoiseTerm):
            coefficient: float | None = allanjax.parameter("F", time_exponent=1.0)

            def phase_covariance(self, lag):
                return -(self.coefficient**2) * jnp.log(jnp.maximum(lag, 1e-3))

    and works in fits, simulations and plots. Overriding `psd` (and, for speed, `simulate`) is optional.
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

    def column(self, time: Float[Array, " n"]) -> Float[Array, " n"]:
        """A deterministic term of unit amplitude at times [s] since the record's start.

        For terms that are known but for that one factor; lines of unknown phase are not.
        """
        raise NotImplementedError(f"{type(self).__name__} defines no column(time)")

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Float[Array, " n"]:
        """n samples of the rate (means over successive sample intervals) at `rate` [Hz], exact in law.

        The default draws the increments of the rate, whose autocovariance is that of the second difference
        of θ, by circulant embedding (Davies & Harte 1987), and adds them up from zero: the level itself has
        no law when the term is not stationary.
        """
        half = next_fast_len(max(n, 2), real=True)
        increments = _gaussian_sequence(key, self._increment_autocovariance(half + 1, rate))[:n]
        return linear_recurrence(1.0, increments)

    @property
    def oscillates(self) -> bool:
        """Whether G swings with a period of its own, so that sums over lags must look more closely."""
        return self.narrow_band

    def power_scatter(self, duration: Float[ArrayLike, ""]) -> Float[Array, ""]:
        """Relative variance of a narrow-band term's mean square over a record of this duration [s]."""
        raise NotImplementedError(f"{type(self).__name__} is narrow-band and defines no power_scatter")

    def sampled(self, rate: float) -> Self:
        """The term as seen by a sensor that samples at `rate` [Hz]; itself, unless sampling matters."""
        return self

    # ------------------------------------------------------------------ what follows from it
    def sampled_psd(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        """Two-sided PSD of the samples, aliases included, (rad/s)²/Hz or (m/s²)²/Hz, up to the Nyquist
        frequency.

        The samples are means over 1/rate, so that minus the second difference of G takes the place of
        their autocovariance H, and S(f) = Σ_d H(d) cos(2πf·d/rate) / rate. This default sums it numerically
        over a dozen periods, enough for a covariance that is smooth or has ended by then; narrow-band terms
        and those with a closed form override it. Zero for a deterministic term.
        """
        f = jnp.asarray(frequency, float)
        if self.deterministic:
            return jnp.zeros(f.shape)
        return jax.vmap(lambda f: self._density(2.0 * jnp.pi * f / rate, rate))(f.ravel()).reshape(f.shape)

    def at_low_frequencies(self) -> NoiseTerm | None:
        """For a term whose covariance oscillates: one of smooth covariance that it becomes at low
        frequencies.

        None if there the term is white.
        """
        return None

    def end_effect(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        """Power [rate²] that the two ends of a record add to its cosine spectrum, times its number of
        samples.

        It spreads over all frequencies, and matters for terms whose own density falls off towards low ones.
        Zero unless overridden; see `cosine` for the lowest frequencies, where it is never neglected.
        """
        return jnp.zeros(np.shape(frequency))

    def _density(self, a: Float[Array, ""], rate: float) -> Float[Array, ""]:
        """`sampled_psd` at a radians per sample.

        Lags are taken singly at first, then in stretches that grow up to half a period, as integrals. H need
        not decay: the sum fades out smoothly over many periods, which leaves what oscillates untouched.
        """
        h = 1.0 / rate

        def fading(d: Array) -> Array:
            return erfc(4.0 * (d * a / (12.0 * jnp.pi) - 2.0)) / 2.0

        G = self.phase_covariance(jnp.arange(_SINGLE_LAGS + 2) * h)
        single = -_second_difference(jnp.concatenate([G[1:2], G])) / h**2
        lag = jnp.arange(_SINGLE_LAGS + 1)
        total = jnp.sum(jnp.where(lag > 0, 2.0, 1.0) * single * fading(lag) * jnp.cos(a * lag))

        def summand(d: Array) -> Array:
            # Another call may have another gauge, which the last single lag tells.
            H = -_derivative(_derivative(self.phase_covariance))(jnp.append(d, _SINGLE_LAGS) * h)
            return 2.0 * (H[:-1] - H[-1] + single[-1]) * fading(d) * jnp.cos(a * d)

        x, w = np.polynomial.legendre.leggauss(12)
        growing = jnp.minimum(_SINGLE_LAGS * 1.5 ** jnp.arange(22.0), jnp.pi / a)
        lengths = jnp.append(growing, jnp.full(36, jnp.pi / a))
        starts = _SINGLE_LAGS + 0.5 + jnp.append(0.0, jnp.cumsum(lengths))
        d = starts[:-1, None] + lengths[:, None] * (x + 1.0) / 2.0
        integral = jnp.dot((lengths[:, None] / 2.0 * w).ravel(), summand(d.ravel()))
        # Euler and Maclaurin's first correction, of a sum over the integers that starts half a step before.
        correction = _derivative(summand)(starts[:1])[0] / 24.0
        return (total + integral + correction) / rate

    def allan_variance(self, cluster_time: Float[ArrayLike, ...]) -> Float[Array, ...]:
        """Allan variance [rate²] at cluster times [s]: [6G(0) − 8G(T) + 2G(2T)]/(2T²)."""
        return self._filter_variance(cluster_time, (6.0, -8.0, 2.0), 2.0)

    def hadamard_variance(self, cluster_time: Float[ArrayLike, ...]) -> Float[Array, ...]:
        """Hadamard variance [rate²] at cluster times [s]: [20G(0) − 30G(T) + 12G(2T) − 2G(3T)]/(6T²)."""
        return self._filter_variance(cluster_time, (20.0, -30.0, 12.0, -2.0), 6.0)

    def _filter_variance(
        self, cluster_time: Float[ArrayLike, ...], weights: Sequence[float], divisor: float
    ) -> Float[Array, ...]:
        T = jnp.asarray(cluster_time, float)

        def at(t: Float[Array, ""]) -> Float[Array, ""]:
            covariance = self.phase_covariance(jnp.arange(len(weights)) * t)
            return jnp.dot(jnp.asarray(weights), covariance) / (divisor * t**2)

        return jax.vmap(at)(T.ravel()).reshape(T.shape)

    def _increment_autocovariance(self, n: int, rate: float) -> Float[Array, " n"]:
        """Autocovariance of x[k+1] − x[k] at lags 0 … n−1 samples: the fourth difference of G.

        Rounding of a growing G drowns that difference at long lags. Where G is smooth over a sample, its
        inner second difference is therefore expanded, δ²G = h²G⁽²⁾ + h⁴G⁽⁴⁾/12 + h⁶G⁽⁶⁾/360 + …, with
        δ²G⁽⁴⁾ for h²G⁽⁶⁾, and only the outer one is taken.
        """
        h = 1.0 / rate
        lag = jnp.arange(n + 2) * h
        G = self.phase_covariance(lag)
        both_sides = jnp.concatenate([G[2:0:-1], G])
        direct = jnp.convolve(both_sides, jnp.asarray([1.0, -4.0, 6.0, -4.0, 1.0]), mode="valid") / h**2

        # From lag 1 on: G may have a kink at zero, where no derivative exists.
        second = _derivative(_derivative(self.phase_covariance))
        G2, G4 = second(lag[1:]), _derivative(_derivative(second))(lag[1:])
        last = _second_difference(h**4 * G4) / 360.0
        inner = (h**2 * G2 + h**4 * G4 / 12.0)[1:-1] + last
        expanded = jnp.pad(_second_difference(inner) / h**2, (3, 0))
        # What is left out is far less than the last term, which may do no harm already.
        error = jnp.pad(jnp.abs(_second_difference(last)) / h**2, (3, 0), constant_values=jnp.inf)
        rounding = 64.0 * jnp.finfo(float).eps * jax.lax.cummax(jnp.abs(G))[2:] / h**2
        return jnp.where(error <= jnp.maximum(1e-9 * jnp.abs(expanded), rounding), expanded, direct)

    # ------------------------------------------------------------------ parameters
    @classmethod
    def parameters(cls) -> tuple[Parameter, ...]:
        """The declared parameters, in order; the first is the amplitude."""
        found = tuple(
            Parameter(field.name, **field.metadata["parameter"])
            for field in dataclasses.fields(cls)
            if "parameter" in field.metadata
        )
        if not found or found[0].kind != "amplitude":
            raise AllanjaxError(
                f"{cls.__name__}: the first parameter of a noise term must be its amplitude; "
                "declare it with `coefficient: float | None = allanjax.parameter('c', time_exponent=…)`"
            )
        return found

    @classmethod
    def name(cls) -> str:
        """The term's name, e.g. "bias_instability"."""
        return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", cls.__name__).lower()

    def is_free(self, p: Parameter) -> bool:
        """Whether a fit estimates this parameter. An infinite value is a limit, never a start."""
        value = getattr(self, p.name)
        infinite = isinstance(value, float) and math.isinf(value)
        return p.name not in self.held and not infinite

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

    def __repr__(self) -> str:
        """As it is written in Python, values in SI: `Markov(correlation_time=3).hold("correlation_time")`."""
        usual = {field.name: field.default for field in dataclasses.fields(self)}
        shown = {p.name: _shown(getattr(self, p.name)) for p in self.parameters()}
        names = [name for name, text in shown.items() if text != _shown(usual[name])]
        values = [f"{name}={shown[name]}" for name in names]
        arguments = ", ".join(values).removeprefix("coefficient=")
        held = ", ".join(f'"{name}"' for name in names if name in self.held)
        return f"{type(self).__name__}({arguments})" + (f".hold({held})" if held else "")

    def __add__(self, other: NoiseTerm | Model) -> Model:
        from allanjax.model import Model

        return Model((self,)) + other

    def __check_init__(self) -> None:
        for p in self.parameters():
            value = getattr(self, p.name)
            if isinstance(value, int | float | np.floating):
                amplitude = p.kind == "amplitude"
                bound = ""
                if not (value >= 0 if amplitude else value > p.lower):
                    bound = "≥ 0" if amplitude else f"> {p.lower:g}"
                # Infinity is a limit that a term may know, e.g. of a cutoff.
                elif value >= p.upper < math.inf:
                    bound = f"< {p.upper:g}"
                if bound:
                    raise AllanjaxError(f"{self.name()}: {p.name} must be {bound}, got {value!r}")


def _shown(value: Value) -> str:
    """Six digits of a number; of an array inside a compiled function, what it says of itself."""
    return f"{value:.6g}" if isinstance(value, int | float | np.floating) else str(value)


def _derivative(function: Callable[[Array], Array]) -> Callable[[Array], Array]:
    """The derivative of an elementwise function, in one call so that it keeps to one gauge."""
    return lambda x: jax.jvp(function, (x,), (jnp.ones_like(x),))[1]


def _second_difference(x: Float[Array, " k"]) -> Float[Array, " k-2"]:
    return x[2:] - 2.0 * x[1:-1] + x[:-2]


def _gaussian_sequence(key: PRNGKeyArray, autocovariance: Float[Array, " half+1"]) -> Float[Array, " 2*half"]:
    """A stationary Gaussian sequence on a circle of 2·half samples with this autocovariance.

    Successive samples up to half + 1 of them are a draw of the process on a line (circulant embedding).
    """
    half = autocovariance.shape[0] - 1
    circle = jnp.concatenate([autocovariance, autocovariance[-2:0:-1]])
    # A true embedding has eigenvalues ≥ 0; rounding leaves some at −1e-16 of the largest.
    eigenvalues = jnp.maximum(jnp.fft.rfft(circle).real, 0.0)
    # The transform of real white noise is complex white noise, but real at its two ends.
    real, imaginary = jax.random.normal(key, (2, half + 1))
    ends = (jnp.arange(half + 1) % half) == 0
    noise = jnp.where(ends, real, jax.lax.complex(real, imaginary) / jnp.sqrt(2.0))
    return jnp.fft.irfft(jnp.sqrt(2.0 * half * eigenvalues) * noise, 2 * half)


def in_gauge(small: Callable, large: Callable, x: Num[Array, ...]) -> Num[Array, ...]:
    """`small(x)` if all arguments of the call are below one in magnitude, else `large(x)`.

    The two must differ by c0 + c1·x² only. Near zero that difference would swallow the digits that
    survive the second difference, far out it would dominate them; so the whole call takes one side.
    """
    is_small = jnp.max(jnp.abs(x)) < 1.0
    return jnp.where(is_small, small(jnp.where(is_small, x, jnp.zeros_like(x))), large(x))
