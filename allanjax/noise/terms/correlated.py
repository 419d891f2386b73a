"""Noise with a correlation time: Gauss–Markov (thesis 4.3.6), telegraph, filtered white noise, resonances."""

from __future__ import annotations

import abc
import math
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Complex, Float, Num, PRNGKeyArray

from allanjax.base.arrays import namespace
from allanjax.base.errors import AllanjaxError
from allanjax.noise.model import NoiseTerm
from allanjax.noise.numerics import (
    averaged_lags,
    exponential_covariance,
    exponential_density,
    exponential_remainder,
    is_continuous,
    linear_recurrence,
)
from allanjax.noise.parameter import Value, option, parameter
from allanjax.noise.response import Parts, Poles
from allanjax.noise.state_space import Block, exponential_block, mean_block, together

# Ratio of sample interval to correlation time beyond which only two lags are left.
_SHORT = 30.0


class Markov(NoiseTerm):
    """First-order Gauss–Markov noise of the rate (4.59, 4.60), standard deviation q_c·√(T_c/2).

    `amplitude` q_c in rad/s/√s or m/s²/√s; `correlation_time` T_c in s.
    """

    amplitude: Value = parameter("q_c", time_exponent=-0.5)
    correlation_time: Value = parameter("T_c", "time")

    def phase_covariance(self, lag: Float[Array, ...]) -> Float[Array, ...]:
        T_c = self.correlation_time
        return -(self.amplitude**2) * T_c**3 / 2.0 * exponential_remainder(-lag / T_c)

    def psd(self, frequency: Float[ArrayLike, ...]) -> Float[Array, ...]:
        w = 2.0 * np.pi * namespace(self, frequency).asarray(frequency) * self.correlation_time
        return (self.amplitude * self.correlation_time) ** 2 / (1.0 + w**2)

    def sampled_psd(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        """PSD of means over the sample interval, whose autocovariance is geometric from the first lag on."""
        xp = namespace(self, frequency, rate)
        a = 2.0 * np.pi * xp.asarray(frequency) / rate
        x = 1.0 / (rate * self.correlation_time)
        at_zero, at_one = averaged_lags(x)
        # cos a − e^{-x} and 1 − 2e^{-x} cos a + e^{-2x}, without cancellation where both are small.
        s = 2.0 * xp.sin(a / 2.0) ** 2
        numerator = -s - xp.expm1(-x)
        denominator = xp.expm1(-x) ** 2 + 2.0 * xp.exp(-x) * s
        variance = self.amplitude**2 * self.correlation_time / 2.0
        return variance / rate * (at_zero + 2.0 * at_one * numerator / denominator)

    def parts(self, rate: float) -> Parts:
        """Parts of the density of means over sample intervals: a pole, and the excess of lag zero over it.

        A process that decays within a sample has only two lags left.
        """
        xp = namespace(self, rate)
        x = 1.0 / (rate * xp.asarray(self.correlation_time, float))
        variance = self.amplitude**2 * self.correlation_time / 2.0
        short = x > _SHORT
        slow, fast = xp.where(short, _SHORT, x), xp.where(short, x, _SHORT)
        r0, r1 = averaged_lags(slow)
        q0, q1 = averaged_lags(fast)
        weight = r1 * xp.exp(slow)
        white = xp.where(short, q0 + 2.0 * q1, r0 - weight)
        pole = xp.where(short, 0.5, xp.exp(-slow))
        poles = Poles(pole[None] + 0j, xp.where(short, 0.0, variance * weight)[None] + 0j)
        return Parts(variance * white, xp.where(short, -variance * q1, 0.0), 0.0, poles)

    def state_block(self, rate: float, duration: float | None) -> Block:
        variance = self.amplitude**2 * self.correlation_time / 2.0
        return mean_block(variance, 1.0 / (rate * self.correlation_time))

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Float[Array, " n"]:
        """Simulated samples: an exact recursion of the state, and Gaussian means between its values."""
        x = 1.0 / (rate * self.correlation_time)
        sigma = self.amplitude * jnp.sqrt(self.correlation_time / 2.0)
        state_key, mean_key = jax.random.split(key)
        drive = jax.random.normal(state_key, (n + 1,)) * sigma
        innovation = jnp.sqrt(-jnp.expm1(-2.0 * x))
        state = linear_recurrence(jnp.exp(-x), drive * jnp.where(jnp.arange(n + 1) == 0, 1.0, innovation))
        slope = jnp.tanh(x / 2.0) / x
        # Var(mean | both ends)/σ² = 2/x − 4 tanh(x/2)/x² → x/6 as x → 0.
        conditional = jnp.where(
            x < 0.01, x / 6.0 * (1.0 - x**2 / 10.0), 2.0 / x - 4.0 * jnp.tanh(x / 2.0) / x**2
        )
        between = sigma * jnp.sqrt(conditional) * jax.random.normal(mean_key, (n,))
        return slope * (state[1:] + state[:-1]) + between


class _Exponential(NoiseTerm):
    """Noise of the autocovariance R(t) = Re[c·e^{λt}], whose samples are read at their instants."""

    #: Sample interval [s]; 0 for the continuous rate.
    sample_interval: float = eqx.field(default=0.0, kw_only=True)

    @abc.abstractmethod
    def _mode(self) -> tuple[Num[Array, ""], Num[Array, ""]]:
        """Pole λ, real or complex, and weight c of the autocovariance."""

    def phase_covariance(self, lag: Float[Array, ...]) -> Float[Array, ...]:
        return exponential_covariance(*self._mode(), lag, self.sample_interval)

    def sampled_psd(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        return exponential_density(*self._mode(), frequency, rate, self.sample_interval)

    def state_block(self, rate: float, duration: float | None) -> Block:
        pole, weight = self._mode()
        return exponential_block(weight, pole / rate)

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Float[Array, " n"]:
        """Simulated samples by the exact recursion of the state: of an oscillator, one complex mode."""
        pole, weight = self._mode()
        variance, step, first = jnp.real(weight), jnp.exp(pole / rate), jnp.arange(n) == 0
        if not jnp.iscomplexobj(pole):
            innovation = jnp.where(first, 1.0, jnp.sqrt(-jnp.expm1(2.0 * pole / rate)))
            return linear_recurrence(step, jnp.sqrt(variance) * innovation * jax.random.normal(key, (n,)))
        # z = velocity − λ̄·position obeys z' = λz + drive, and position = Im z / Im λ. Stationary moments
        # of z follow from those of position (σ²) and velocity (σ²|λ|²), which are uncorrelated.
        power = 2.0 * variance * jnp.abs(pole) ** 2
        pseudo = variance * (jnp.abs(pole) ** 2 + jnp.conj(pole) ** 2)
        normal = jax.random.normal(key, (2, n))

        def draw(share: Float[Array, ""], pseudo_share: Complex[Array, ""]) -> Complex[Array, " n"]:
            """Complex Gaussians with E|z|² = share·power and E z² = pseudo_share·pseudo."""
            p, s = share * power, pseudo_share * pseudo
            re, im, cross = (p + s.real) / 2.0, (p - s.real) / 2.0, s.imag / 2.0
            tilt = cross / jnp.sqrt(re)
            other = jnp.sqrt(jnp.maximum(im - tilt**2, 0.0))
            return jnp.sqrt(re) * normal[0] + 1j * (tilt * normal[0] + other * normal[1])

        drive = draw(1.0 - jnp.abs(step) ** 2, 1.0 - step**2)
        start = draw(jnp.asarray(1.0), jnp.asarray(1.0 + 0j))
        return linear_recurrence(step, jnp.where(first, start, drive)).imag / pole.imag


class Telegraph(_Exponential):
    """Bias that jumps between two levels, as often down as up (Machlup 1954, J. Appl. Phys. 25:341).

    `amplitude` is the difference of the levels [rad/s or m/s²], `dwell_time` T_d the mean time in each [s].
    R(t) = (amplitude²/4)·e^{−2|t|/T_d}: to second order it is a Markov process of correlation time T_d/2,
    which has the same spectrum; its simulated paths do jump, its state is Gaussian.
    """

    amplitude: Value = parameter("J", time_exponent=0.0)
    dwell_time: Value = parameter("T_d", "time")

    def _mode(self) -> tuple[Num[Array, ""], Num[Array, ""]]:
        return -2.0 / namespace(self).asarray(self.dwell_time, float), self.amplitude**2 / 4.0

    def psd(self, frequency: Float[ArrayLike, ...]) -> Float[Array, ...]:
        """Two-sided PSD (amplitude²/4)·T_d/(1 + (πf·T_d)²)."""
        x = np.pi * namespace(self, frequency).asarray(frequency) * self.dwell_time
        return self.amplitude**2 / 4.0 * self.dwell_time / (1.0 + x**2)

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Float[Array, " n"]:
        """Simulated path with exponential dwell times: an odd Poisson number of jumps changes the level.

        The levels have mean zero and are equally likely at the start.
        """
        first_key, jump_key = jax.random.split(key)
        odd = -jnp.expm1(-2.0 / (rate * self.dwell_time)) / 2.0
        changes = jnp.cumsum(jax.random.bernoulli(jump_key, odd, (n,)))
        level = (changes + jax.random.bernoulli(first_key)) % 2
        return self.amplitude * (level - 0.5)


# Aliases on either side that are summed.
_ALIASES = 8


class Resonance(_Exponential):
    """Noise of a damped oscillator, Ω'' + (ω0/Q_f)Ω' + ω0²Ω = white noise.

    Not in the thesis, but found in sensors. `amplitude` is the RMS of the rate [rad/s or m/s²], `frequency`
    f0 = ω0/2π in Hz, `quality_factor` Q_f above ½ (underdamped). Its autocovariance is R(t) = σ²
    e^{−at}[cos ω_d t + (a/ω_d) sin ω_d t] with a = ω0/2Q_f, ω_d² = ω0² − a²; G is −R integrated twice. In
    fits and simulations at a known rate (`sampled`) the oscillator is read at the sample instants; otherwise
    it is averaged between them.
    """

    amplitude: Value = parameter("σ", time_exponent=0.0)
    frequency: Value = parameter("f0", "line")
    quality_factor: Value = parameter("Q_f", "number", lower=0.5)
    narrow_band: ClassVar[bool] = True

    def _mode(self) -> tuple[Num[Array, ""], Num[Array, ""]]:
        xp = namespace(self)
        w0 = 2.0 * np.pi * xp.asarray(self.frequency, float)
        a = w0 / (2.0 * self.quality_factor)
        wd = w0 * xp.sqrt(1.0 - 1.0 / (4.0 * self.quality_factor**2))
        return -a + wd * 1j, self.amplitude**2 * (1.0 - a / wd * 1j)

    def power_scatter(self, duration: Float[ArrayLike, ""]) -> Float[Array, ""]:
        """Relative variance 2∫R²/(R(0)²·duration) = Q_f/(π f0·duration), for Q_f not near ½."""
        return self.quality_factor / (np.pi * self.frequency * namespace(self, duration).asarray(duration))

    def psd(self, frequency: Float[ArrayLike, ...]) -> Float[Array, ...]:
        """Two-sided PSD 2σ²(ω0³/Q_f)/[(ω0² − ω²)² + (ω0ω/Q_f)²]."""
        w0 = 2.0 * np.pi * self.frequency
        w = 2.0 * np.pi * namespace(self, frequency).asarray(frequency)
        shape = (w0**2 - w**2) ** 2 + (w0 * w / self.quality_factor) ** 2
        return 2.0 * self.amplitude**2 * w0**3 / self.quality_factor / shape

    def sampled_psd(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        """PSD of the oscillator at the sample instants, or of its means between them."""
        if not is_continuous(self.sample_interval):
            return super().sampled_psd(frequency, rate)
        # For means, Σ_m psd(f + m·rate)·sinc²: aliases fall off with the sixth power.
        xp = namespace(self, frequency, rate)
        aliases = xp.asarray(frequency, float)[..., None] + rate * np.arange(-_ALIASES, _ALIASES + 1)
        return xp.sum(self.psd(aliases) * xp.sinc(aliases / rate) ** 2, axis=-1)

    def parts(self, rate: float) -> Parts:
        xp = namespace(self, rate)
        pole, weight = self._mode()
        w, half = xp.exp(pole / rate), weight / 2.0
        poles = Poles(xp.stack([w, xp.conj(w)]), xp.stack([half, xp.conj(half)]))
        return Parts(0.0, 0.0, 0.0, poles)

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Float[Array, " n"]:
        of = NoiseTerm if is_continuous(self.sample_interval) else _Exponential
        return of.simulate(self, key, n, rate)


# Nodes of the quadrature over the frequency: the spectrum stays smooth for spreads up to the width f0/Q_f.
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(11)
_SHARES = _WEIGHTS / _WEIGHTS.sum()


class WanderingResonance(NoiseTerm):
    """Noise of a damped oscillator (`Resonance`) whose frequency is spread by a normal law over the record.

    Not in the thesis, but found in sensors whose resonances move, e.g. with temperature. `amplitude` is the
    RMS of the rate [rad/s or m/s²], `frequency` f0 in Hz the mean, `quality_factor` Q_f above ½ that at any
    moment, `spread` Δf in Hz the standard deviation of the frequency. The spectrum is that of eleven
    oscillators at the nodes of Gauss–Hermite quadrature.
    """

    amplitude: Value = parameter("σ", time_exponent=0.0)
    frequency: Value = parameter("f0", "line")
    quality_factor: Value = parameter("Q_f", "number", lower=0.5)
    spread: Value = parameter("Δf", "frequency")
    #: Sample interval [s]; 0 for the continuous rate.
    sample_interval: float = 0.0
    narrow_band: ClassVar[bool] = True

    def _oscillators(self) -> list[Resonance]:
        """Oscillators that together have the spectrum; their frequencies stay above zero."""
        xp = namespace(self)
        frequencies = xp.asarray(self.frequency, float)[..., None] + _NODES * self.spread
        lowest = 0.01 * xp.asarray(self.frequency, float)
        return [
            Resonance(
                self.amplitude * math.sqrt(share),
                xp.maximum(frequencies[..., k], lowest),
                self.quality_factor,
                sample_interval=self.sample_interval,
            )
            for k, share in enumerate(_SHARES)
        ]

    def _sum(self, method: str, *arguments: Any) -> Any:
        """Sum of what this method of the oscillators returns."""
        return sum(getattr(one, method)(*arguments) for one in self._oscillators())

    def phase_covariance(self, lag: Float[Array, ...]) -> Float[Array, ...]:
        return self._sum("phase_covariance", lag)

    def power_scatter(self, duration: Float[ArrayLike, ""]) -> Float[Array, ""]:
        """Relative variance of the mean square: the oscillators' powers fluctuate independently."""
        return sum(
            x**2 * o.power_scatter(duration) for x, o in zip(_SHARES, self._oscillators(), strict=True)
        )

    def psd(self, frequency: Float[ArrayLike, ...]) -> Float[Array, ...]:
        return self._sum("psd", frequency)

    def sampled_psd(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        return self._sum("sampled_psd", frequency, rate)

    def parts(self, rate: float) -> Parts:
        xp = namespace(self, rate)
        poles = [one.parts(rate).poles for one in self._oscillators()]
        joined = (xp.concatenate(x) for x in zip(*poles, strict=True))
        return Parts(0.0, 0.0, 0.0, Poles(*joined))

    def state_block(self, rate: float, duration: float | None) -> Block:
        blocks = (one.state_block(rate, duration) for one in self._oscillators())
        return together([b.labelled(str(k + 1)) for k, b in enumerate(blocks)])

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Float[Array, " n"]:
        """Simulated samples: a stationary process with this spectrum."""
        keys = jax.random.split(key, len(_SHARES))
        draws = [one.simulate(k, n, rate) for k, one in zip(keys, self._oscillators(), strict=True)]
        return jnp.sum(jnp.stack(draws), axis=0)


class LowPass(_Exponential):
    """White noise after a Butterworth filter, S(f) = N²/(1 + (f/f_c)^(2·order)).

    Not in the thesis. `coefficient` N in rad/√s or m/s/√s (that of the white noise, two-sided PSD N²),
    `bandwidth` f_c in Hz (−3 dB), `order` 1 or 2. The filter's output is read at the sample instants: order 1
    is a first-order autoregression then. Its covariance is R(t) = Re[c·e^{λt}] with λ = −ω_c, c = N²ω_c/2,
    or, for order 2, that of an oscillator of quality factor 1/√2: λ = ω_c(−1 + i)/√2, c = (1 − i)·N²ω_c/√8.
    """

    coefficient: Value = parameter("N_f", time_exponent=0.5)
    bandwidth: Value = parameter("f_c", "frequency")
    order: int = option(default=1)

    def __check_init__(self) -> None:
        if self.order not in (1, 2):
            raise AllanjaxError(f"low_pass: the order must be 1 or 2, not {self.order!r}")

    def _mode(self) -> tuple[Num[Array, ""], Num[Array, ""]]:
        w = 2.0 * np.pi * namespace(self).asarray(self.bandwidth, float)
        power = self.coefficient**2 * w
        if self.order == 1:
            return -w, power / 2.0
        return w * (-1.0 + 1j) / math.sqrt(2.0), power * (1.0 - 1j) / math.sqrt(8.0)

    def psd(self, frequency: Float[ArrayLike, ...]) -> Float[Array, ...]:
        ratio = namespace(self, frequency).asarray(frequency, float) / self.bandwidth
        return self.coefficient**2 / (1.0 + ratio ** (2 * self.order))
