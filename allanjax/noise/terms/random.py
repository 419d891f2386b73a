"""Random terms: power laws of the thesis, quantization (4.3.1), random walks (4.3.2, 4.3.4), flicker (4.3.3).

And noise with a correlation time: Gauss–Markov (4.3.6), telegraph, filtered white noise, resonances.
"""

from __future__ import annotations

import abc
import functools
import math
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Complex, Float, Num, PRNGKeyArray

from allanjax.base.arrays import as_array, namespace, special_functions
from allanjax.base.errors import AllanjaxError
from allanjax.noise.model import NoiseTerm
from allanjax.noise.parameter import Value, option, parameter
from allanjax.noise.process import (
    NO_POLES,
    Parts,
    Poles,
    Reals,
    RealsLike,
    Samples,
    averaged_lags,
    exponential_covariance,
    exponential_density,
    exponential_remainder,
    is_continuous,
    linear_recurrence,
)
from allanjax.noise.state_space import Block, exponential_block, mean_block, together, white_block

# Aliases on either side that are summed, for want of a closed form; those of flicker noise with a cutoff are
# then complete to 0.1 %, those of an oscillator fall off with the sixth power.
_ALIASES = 16
# Ratio of sample interval to correlation time beyond which only two lags are left.
_SHORT = 30.0


class Markov(NoiseTerm):
    """First-order Gauss–Markov noise of the rate (4.59, 4.60), standard deviation q_c·√(T_c/2).

    `amplitude` q_c in rad/s/√s or m/s²/√s; `correlation_time` T_c in s.
    """

    amplitude: Value = parameter("q_c", time_exponent=-0.5)
    correlation_time: Value = parameter("T_c", "time")

    def phase_covariance(self, lag: Reals) -> Reals:
        T_c = self.correlation_time
        return -(self.amplitude**2) * T_c**3 / 2.0 * exponential_remainder(-lag / T_c)

    def psd(self, frequency: RealsLike) -> Reals:
        w = 2.0 * np.pi * namespace(self, frequency).asarray(frequency) * self.correlation_time
        return (self.amplitude * self.correlation_time) ** 2 / (1.0 + w**2)

    def sampled_psd(self, frequency: RealsLike, rate: float) -> Reals:
        """PSD of means over the sample interval, whose autocovariance is geometric from the first lag on."""
        xp, f = as_array(frequency, self, rate)
        a = 2.0 * np.pi * f / rate
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

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Samples:
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

    def phase_covariance(self, lag: Reals) -> Reals:
        return exponential_covariance(*self._mode(), lag, self.sample_interval)

    def sampled_psd(self, frequency: RealsLike, rate: float) -> Reals:
        return exponential_density(*self._mode(), frequency, rate, self.sample_interval)

    def state_block(self, rate: float, duration: float | None) -> Block:
        pole, weight = self._mode()
        return exponential_block(weight, pole / rate)

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Samples:
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

    def psd(self, frequency: RealsLike) -> Reals:
        """Two-sided PSD (amplitude²/4)·T_d/(1 + (πf·T_d)²)."""
        x = np.pi * namespace(self, frequency).asarray(frequency) * self.dwell_time
        return self.amplitude**2 / 4.0 * self.dwell_time / (1.0 + x**2)

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Samples:
        """Simulated path with exponential dwell times: an odd Poisson number of jumps changes the level.

        The levels have mean zero and are equally likely at the start.
        """
        first_key, jump_key = jax.random.split(key)
        odd = -jnp.expm1(-2.0 / (rate * self.dwell_time)) / 2.0
        changes = jnp.cumsum(jax.random.bernoulli(jump_key, odd, (n,)))
        level = (changes + jax.random.bernoulli(first_key)) % 2
        return self.amplitude * (level - 0.5)


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

    def psd(self, frequency: RealsLike) -> Reals:
        """Two-sided PSD 2σ²(ω0³/Q_f)/[(ω0² − ω²)² + (ω0ω/Q_f)²]."""
        w0 = 2.0 * np.pi * self.frequency
        w = 2.0 * np.pi * namespace(self, frequency).asarray(frequency)
        shape = (w0**2 - w**2) ** 2 + (w0 * w / self.quality_factor) ** 2
        return 2.0 * self.amplitude**2 * w0**3 / self.quality_factor / shape

    def sampled_psd(self, frequency: RealsLike, rate: float) -> Reals:
        """PSD of the oscillator at the sample instants, or of its means between them."""
        if not is_continuous(self.sample_interval):
            return super().sampled_psd(frequency, rate)
        # For means, Σ_m psd(f + m·rate)·sinc².
        xp, f = as_array(frequency, self, rate)
        aliases = f[..., None] + rate * np.arange(-_ALIASES, _ALIASES + 1)
        return xp.sum(self.psd(aliases) * xp.sinc(aliases / rate) ** 2, axis=-1)

    def parts(self, rate: float) -> Parts:
        xp = namespace(self, rate)
        pole, weight = self._mode()
        w, half = xp.exp(pole / rate), weight / 2.0
        poles = Poles(xp.stack([w, xp.conj(w)]), xp.stack([half, xp.conj(half)]))
        return Parts(0.0, 0.0, 0.0, poles)

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Samples:
        of = NoiseTerm if is_continuous(self.sample_interval) else _Exponential
        return of.simulate(self, key, n, rate)


#: Frequencies of the oscillators in a wandering resonance, in standard deviations, and their shares of the
#: power. A frequency is at least so much of the mean; and a width at least so much of the standard deviation,
#: so that the spectrum is smooth.
NODES = np.linspace(-3.0, 3.0, 21)
SHARES = np.exp(-(NODES**2) / 2.0) / np.sum(np.exp(-(NODES**2) / 2.0))
LEAST_FREQUENCY, LEAST_WIDTH = 0.01, 0.35


class WanderingResonance(Resonance):
    """Noise of a damped oscillator (`Resonance`) whose frequency is spread by a normal law over the record.

    Not in the thesis, but found in sensors whose resonances move, e.g. with temperature. `amplitude` is the
    RMS of the rate [rad/s or m/s²], `frequency` f0 in Hz the mean, `quality_factor` Q_f above ½ that at any
    moment, `spread` Δf in Hz the standard deviation of the frequency. The spectrum is that of oscillators at
    21 frequencies up to 3Δf from the mean, whose width is never much below Δf/3, so that it is smooth.
    """

    spread: Value = parameter("Δf", "frequency")

    def _oscillators(self) -> list[Resonance]:
        """Oscillators that together have the spectrum; their frequencies stay above zero."""
        xp = namespace(self)
        frequencies = xp.asarray(self.frequency, float)[..., None] + NODES * self.spread
        lowest = LEAST_FREQUENCY * xp.asarray(self.frequency, float)
        least = LEAST_WIDTH * self.spread / self.frequency
        quality = 0.5 + (1.0 / (self.quality_factor - 0.5) ** 4 + least**4) ** -0.25
        return [
            Resonance(
                self.amplitude * math.sqrt(share),
                xp.maximum(frequencies[..., k], lowest),
                quality,
                sample_interval=self.sample_interval,
            )
            for k, share in enumerate(SHARES)
        ]

    def _sum(self, method: str, *arguments: Any) -> Any:
        """Sum of what this method of the oscillators returns."""
        return sum(getattr(one, method)(*arguments) for one in self._oscillators())

    def phase_covariance(self, lag: Reals) -> Reals:
        return self._sum("phase_covariance", lag)

    def power_scatter(self, duration: Float[ArrayLike, ""]) -> Float[Array, ""]:
        """Relative variance of the mean square: the oscillators' powers fluctuate independently."""
        return sum(x**2 * o.power_scatter(duration) for x, o in zip(SHARES, self._oscillators(), strict=True))

    def psd(self, frequency: RealsLike) -> Reals:
        return self._sum("psd", frequency)

    def sampled_psd(self, frequency: RealsLike, rate: float) -> Reals:
        return self._sum("sampled_psd", frequency, rate)

    def parts(self, rate: float) -> Parts:
        xp = namespace(self, rate)
        poles = [one.parts(rate).poles for one in self._oscillators()]
        joined = (xp.concatenate(x) for x in zip(*poles, strict=True))
        return Parts(0.0, 0.0, 0.0, Poles(*joined))

    def state_block(self, rate: float, duration: float | None) -> Block:
        blocks = (one.state_block(rate, duration) for one in self._oscillators())
        return together([b.labelled(str(k + 1)) for k, b in enumerate(blocks)])

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Samples:
        """Simulated samples: a stationary process with this spectrum."""
        keys = jax.random.split(key, len(SHARES))
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
    order: int = option(default=1, most=2)

    def _mode(self) -> tuple[Num[Array, ""], Num[Array, ""]]:
        w = 2.0 * np.pi * namespace(self).asarray(self.bandwidth, float)
        power = self.coefficient**2 * w
        if self.order == 1:
            return -w, power / 2.0
        return w * (-1.0 + 1j) / math.sqrt(2.0), power * (1.0 - 1j) / math.sqrt(8.0)

    def psd(self, frequency: RealsLike) -> Reals:
        ratio = namespace(self, frequency).asarray(frequency, float) / self.bandwidth
        return self.coefficient**2 / (1.0 + ratio ** (2 * self.order))


class Quantization(NoiseTerm):
    """White error of the angle (velocity) at each reading: σ²(T) = 3Q²/T² (4.29).

    `coefficient` Q in rad or m/s. A rounding of the angle to steps S has Q = S/√12.
    """

    coefficient: Value = parameter("Q", time_exponent=1.0)
    #: Sample interval [s]; only the PSD needs it (4.28).
    sample_interval: float = 0.0

    def phase_covariance(self, lag: Reals) -> Reals:
        return namespace(self, lag).where(lag == 0.0, self.coefficient**2, 0.0)

    def psd(self, frequency: RealsLike) -> Reals:
        """Two-sided PSD of sampled data, 4Q² sin²(πfT_z)/T_z ≈ (2πf)² T_z Q² (4.28).

        Raises:
            AllanjaxError: no sample interval.
        """
        xp, T_z = namespace(self, frequency), self.sample_interval
        if isinstance(T_z, float) and T_z == 0.0:
            raise AllanjaxError(
                "the PSD of quantization depends on the sample rate: use model.sampled(rate).psd(f)"
            )
        return 4.0 * self.coefficient**2 / T_z * xp.sin(np.pi * xp.asarray(frequency) * T_z) ** 2

    def sampled_psd(self, frequency: RealsLike, rate: float) -> Reals:
        return self.sampled(rate).psd(frequency)

    def end_effect(self, frequency: RealsLike, rate: float) -> Reals:
        """Power of the first and last reading's errors, which no neighbouring increment takes back."""
        xp, f = as_array(frequency, self, rate)
        a = 2.0 * np.pi * f / rate
        return 2.0 * (self.coefficient * rate) ** 2 * (1.0 + xp.cos(a))

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Samples:
        return self.coefficient * rate * jnp.diff(jax.random.normal(key, (n + 1,)))

    def parts(self, rate: float) -> Parts:
        return Parts(0.0, (self.coefficient * rate) ** 2, 0.0, NO_POLES)

    def state_block(self, rate: float, duration: float | None) -> Block:
        """States: the errors of the angle at the end of a sample interval and at its beginning."""
        noise = self.coefficient**2 * np.diag([1.0, 0.0])
        transition = np.array([[0.0, 0.0], [1.0, 0.0]])
        start = self.coefficient**2 * np.eye(2)
        names = ("now", "before")
        return Block(transition, [rate, -rate], noise, start, names, time_exponents=(1.0, 1.0))


class AngleRandomWalk(NoiseTerm):
    """White noise of the rate: σ²(T) = N²/T (4.36); velocity random walk for an accelerometer.

    `coefficient` N in rad/√s or m/s/√s (two-sided PSD N²; the thesis calls it Q).
    """

    coefficient: Value = parameter("N", time_exponent=0.5)

    def phase_covariance(self, lag: Reals) -> Reals:
        return -(self.coefficient**2) * lag / 2.0

    def psd(self, frequency: RealsLike) -> Reals:
        return namespace(self, frequency).full(np.shape(frequency), self.coefficient**2)

    def sampled_psd(self, frequency: RealsLike, rate: float) -> Reals:
        return self.psd(frequency)

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Samples:
        return self.coefficient * jnp.sqrt(rate) * jax.random.normal(key, (n,))

    def parts(self, rate: float) -> Parts:
        return Parts(self.coefficient**2 * rate, 0.0, 0.0, NO_POLES)

    def state_block(self, rate: float, duration: float | None) -> Block:
        return white_block(self.coefficient**2 * rate)


class RateRandomWalk(NoiseTerm):
    """Integrated white noise of the rate: σ²(T) = K²T/3 (4.53).

    `coefficient` K in rad/s/√s or m/s²/√s.
    """

    coefficient: Value = parameter("K", time_exponent=-0.5)

    def phase_covariance(self, lag: Reals) -> Reals:
        return self.coefficient**2 * lag**3 / 12.0

    @np.errstate(divide="ignore")
    def psd(self, frequency: RealsLike) -> Reals:
        _, f = as_array(frequency, self)
        return (self.coefficient / (2.0 * np.pi * f)) ** 2

    @np.errstate(divide="ignore")
    def sampled_psd(self, frequency: RealsLike, rate: float) -> Reals:
        """PSD of the samples, K²/rate²·(2 + cos a)/(12 sin²(a/2)), a = 2πf/rate."""
        xp, f = as_array(frequency, self, rate)
        a = 2.0 * np.pi * f / rate
        return (self.coefficient / rate) ** 2 * (2.0 + xp.cos(a)) / (12.0 * xp.sin(a / 2.0) ** 2)

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Samples:
        """Simulated means of a Brownian path over sample intervals: from its end points and bridges."""
        steps, bridge = jax.random.normal(key, (2, n)) / jnp.sqrt(rate)
        path_end = linear_recurrence(1.0, steps)
        return self.coefficient * (path_end - steps / 2.0 + bridge / jnp.sqrt(12.0))

    def parts(self, rate: float) -> Parts:
        """Parts of (2 + cos a)/(12 sin²(a/2)) = 1/(4s) − 1/6, times K²/rate."""
        walk = self.coefficient**2 / rate
        return Parts(-walk / 6.0, 0.0, walk, NO_POLES)

    def state_block(self, rate: float, duration: float | None) -> Block:
        """States: the mean of the path over a sample interval, and its end."""
        noise = self.coefficient**2 / rate * np.array([[1.0 / 3.0, 0.5], [0.5, 1.0]])
        transition = np.array([[0.0, 1.0], [0.0, 1.0]])
        return Block(transition, [1.0, 0.0], noise, noise, ("mean", "end"), level=(False, True))


class BiasInstability(NoiseTerm):
    """Flicker (1/f) noise of the rate up to a cutoff f0 (4.38, 4.48): σ(T) → 0.664·B (4.51).

    `coefficient` B in rad/s or m/s². `cutoff_frequency` f0 in Hz: infinite (the default) is the plain
    1/f law, None has a fit estimate it, a number is a start for the fit (hold it with `hold`).

    The thesis's (4.44) has the wrong sign, Ci(x) = −∫ₓ^∞ cos t/t dt; (4.46)–(4.48) use the right one.
    """

    coefficient: Value = parameter("B", time_exponent=0.0)
    cutoff_frequency: Value = parameter("f0", "frequency", default=math.inf)

    def _has_no_cutoff(self) -> bool:
        """Whether the noise is flicker at all frequencies."""
        return isinstance(self.cutoff_frequency, float) and math.isinf(self.cutoff_frequency)

    @property
    def oscillates(self) -> bool:
        return not self._has_no_cutoff()

    def phase_covariance(self, lag: Reals) -> Reals:
        xp = namespace(self, lag)
        B2 = self.coefficient**2
        if self._has_no_cutoff():
            t = xp.where(lag > 0.0, lag, 1.0)
            return B2 / (2.0 * np.pi) * t**2 * xp.log(t) * (lag > 0.0)
        w0 = 2.0 * np.pi * self.cutoff_frequency
        return B2 / (np.pi * w0**2) * _cutoff_flicker(w0 * lag)

    def parts(self, rate: float) -> Parts:
        if not self._has_no_cutoff():
            return super().parts(rate)
        B2 = self.coefficient**2
        parts, xp = _flicker_parts(), namespace(self, rate)
        poles = Poles(xp.asarray(parts.poles.pole), B2 * xp.asarray(parts.poles.weight))
        return Parts(B2 * parts.white, B2 * parts.difference, 0.0, poles)

    def state_block(self, rate: float, duration: float | None) -> Block:
        """States of Gauss–Markov processes whose sum is flicker noise up to a duration [s]."""
        if not self._has_no_cutoff():
            raise AllanjaxError(
                f"{self.name()} with a cutoff has no finite state space: fit it without one, or Markov()"
            )
        return gauss_markov_sum(self, rate, duration)

    @np.errstate(divide="ignore")
    def psd(self, frequency: RealsLike) -> Reals:
        xp, f = as_array(frequency, self)
        passes = xp.abs(f) <= self.cutoff_frequency
        return xp.where(passes, self.coefficient**2 / (2.0 * np.pi * xp.abs(f)), 0.0)

    def at_low_frequencies(self) -> BiasInstability:
        return self.replace(cutoff_frequency=math.inf)

    @np.errstate(divide="ignore", invalid="ignore")
    def sampled_psd(self, frequency: RealsLike, rate: float) -> Reals:
        """PSD with aliases, Σ_m psd(f + m·rate)·sinc²: without a cutoff a sum of Hurwitz's zeta."""
        xp = namespace(self, frequency, rate)
        u = xp.asarray(frequency, float) / rate
        sine = (xp.sin(np.pi * u) / np.pi) ** 2 * self.coefficient**2 / (2.0 * np.pi * rate)
        if self._has_no_cutoff():
            zeta = special_functions(xp).zeta
            return sine * (zeta(3.0, u) + zeta(3.0, 1.0 - u))
        f = xp.abs(u[..., None] + np.arange(-_ALIASES, _ALIASES + 1))
        return sine * xp.sum(xp.where(f * rate <= self.cutoff_frequency, f**-3.0, 0.0), axis=-1)


# Decay rates per sample, uniform in the logarithm, of Markov processes of variance B²/π whose sum is flicker
# noise; the trapezoidal rule converges exponentially. Filters leave those slower than the first as they are.
_STEP = 0.5
_DECAY = np.exp(np.arange(-25.0, 45.0, _STEP))


@functools.cache
def _flicker_parts() -> Parts:
    """Parts of flicker noise with B = 1, but for what is slower than any filter."""
    each = [Markov(math.sqrt(2.0 * x), 1.0 / x).parts(1.0) for x in _DECAY]
    share = _STEP / math.pi
    pole, weight = (np.concatenate(x) for x in zip(*(p.poles for p in each), strict=True))
    white, difference = (share * sum(getattr(p, name) for p in each) for name in ("white", "difference"))
    there = weight != 0.0
    return Parts(white, difference, 0.0, Poles(pole[there], share * weight[there]))


def _cutoff_flicker(x: Reals) -> Reals:
    """Scaled G of flicker noise with a cutoff at x = 2πf0·t, in a gauge that vanishes like x⁴.

    ½ − cos(x)/2 + x sin(x)/2 + x² Cin(x)/2 − ¾x².

    Cin(x) = ∫₀ˣ (1 − cos t)/t dt = γ + ln x − Ci(x). Power series: ½ Σ_{k≥2} (−1)^k x^{2k}/((k−1)(2k)!).
    """
    xp = namespace(x)
    near = x < 3.0
    y = xp.where(near, x, 0.0) ** 2
    series = xp.zeros_like(x)
    for k in range(16, 1, -1):
        series = series * y + (-1) ** k / ((k - 1) * math.factorial(2 * k))
    far = xp.where(near, 3.0, x)
    cin = np.euler_gamma + xp.log(far) - special_functions(xp).sici(far)[1]
    closed = 0.5 - xp.cos(far) / 2.0 + far * xp.sin(far) / 2.0 + far**2 * (cin / 2.0 - 0.75)
    return xp.where(near, 0.5 * series * y**2, closed)


# Distance of the exponent from 1 within which G is computed in the gauge of flicker noise.
_NEAR = 0.1
# Terms of Hurwitz's series that are summed one by one; the error is then below 1e-9 of the sum.
_SINGLE = 10


class PowerLaw(NoiseTerm):
    """Noise of PSD S(f) = A²·(f/1 Hz)^(−α), −1 < α < 3 (Mandelbrot & Van Ness 1968, SIAM Rev. 10:422).

    `amplitude` A in rad/√s or m/s/√s, the root PSD at 1 Hz; `exponent` α. α = 0 is an angle random walk
    N = A, α = 1 bias instability B = √(2π)·A, α = 2 rate random walk K = 2π·A. The Allan variance goes as
    T^(α−1); for exponents outside of these bounds it does not exist.
    """

    amplitude: Value = parameter("A", time_exponent=0.5)
    exponent: Value = parameter("α", "number", lower=-1.0, upper=3.0)

    def phase_covariance(self, lag: Reals) -> Reals:
        """Phase covariance −A²(2π)^α·t^(α+1)/[2Γ(α+2) cos(πα/2)], less a multiple of t² infinite at α = 1."""
        # cos(πα/2) = −sin(πε/2), ε = α − 1, and ε/sin(πε/2) = 2Γ(1 + ε/2)Γ(1 − ε/2)/π, smooth at zero.
        xp = namespace(self, lag)
        gammaln = special_functions(xp).gammaln
        e = xp.asarray(self.exponent, float) - 1.0
        reflected = gammaln(1.0 + e / 2.0) + gammaln(1.0 - e / 2.0)
        scale = 2.0 * xp.exp(e * np.log(2.0 * np.pi) + reflected - gammaln(3.0 + e))
        log = xp.log(xp.where(lag > 0.0, lag, 1.0))
        near = xp.abs(e) < _NEAR
        # t^ε/ε, or (t^ε − 1)/ε. Far from α = 1 the t² of the second would dominate the digits of t^(α+1).
        power = xp.where(near, log * _relative_expm1(xp.where(near, e, 0.0) * log), 0.0)
        power += xp.where(near, 0.0, xp.exp(e * log) / xp.where(near, 1.0, e))
        return self.amplitude**2 * scale * power * lag**2 * (lag > 0.0)

    @np.errstate(divide="ignore")
    def psd(self, frequency: RealsLike) -> Reals:
        xp, f = as_array(frequency, self)
        return self.amplitude**2 * xp.abs(f) ** -self.exponent

    @np.errstate(divide="ignore", invalid="ignore")
    def sampled_psd(self, frequency: RealsLike, rate: float) -> Reals:
        """PSD with aliases: A²·rate^−α·sin²(πu)/π²·[ζ(α+2, u) + ζ(α+2, 1−u)], u = f/rate."""
        xp, f = as_array(frequency, self, rate)
        u = f / rate
        aliases = _hurwitz(2.0 + self.exponent, u) + _hurwitz(2.0 + self.exponent, 1.0 - u)
        return self.amplitude**2 * rate**-self.exponent * (xp.sin(np.pi * u) / np.pi) ** 2 * aliases

    def state_block(self, rate: float, duration: float | None) -> Block:
        """States of Gauss–Markov processes whose sum is the noise up to a duration [s]."""
        return gauss_markov_sum(self, rate, duration)


def _relative_expm1(x: Reals) -> Reals:
    """Quotient (e^x − 1)/x, smooth at zero."""
    xp = namespace(x)
    small = xp.abs(x) < 1e-2
    series = 1.0 + x / 2.0 * (1.0 + x / 3.0 * (1.0 + x / 4.0 * (1.0 + x / 5.0 * (1.0 + x / 6.0))))
    far = xp.where(small, 1.0, x)
    return xp.where(small, series, xp.expm1(far) / far)


def _hurwitz(s: Value, q: Reals) -> Reals:
    """Hurwitz's zeta Σ_k (q + k)^(−s), s > 1, by Euler–Maclaurin: JAX's has no derivative by s."""
    k = np.arange(_SINGLE)
    x = q + _SINGLE
    tail = x / (s - 1.0) + 0.5 + s / (12.0 * x) * (1.0 - (s + 1.0) * (s + 2.0) / (60.0 * x**2))
    return namespace(s, q).sum((q[..., None] + k) ** -s, axis=-1) + tail * x**-s


# Flicker noise and other power laws as sums of Gauss–Markov processes, for a Kalman filter.
#
# Correlation times are equally far apart in the logarithm, and the variances fit the spectrum of the samples
# and their Allan variance (Keshner 1982, Proc. IEEE 70:212, on how few processes per decade suffice).

#: Largest relative error of the spectrum and of the Allan variance.
TOLERANCE = 0.03
# The error that the fit aims at, and processes per decade to try: few states make fast filters.
_AIM = 0.02
_DENSITIES = (0.8, 1.0, 1.25, 1.5, 2.0, 3.0)
# Longest correlation time in durations, and shortest in samples.
_LONGEST, _SHORTEST = 10.0, 0.1


def gauss_markov_sum(term: NoiseTerm, rate: float, duration: float | None) -> Block:
    """Block of Gauss–Markov processes, means over sample intervals, whose sum is a term with a power law.

    Raises:
        AllanjaxError: no duration [s]; or no such sum has its spectrum and its Allan variance within 3 %.
    """
    from scipy.optimize import nnls

    if duration is None:
        raise AllanjaxError(
            f"{term.name()} has a finite state space only for a limited time: give the duration in s, e.g. "
            "state_space(rate, duration=3600.0)"
        )
    samples = max(duration * rate, 16.0)
    frequency = rate * np.geomspace(1.0 / samples, 0.5, 160)
    time = np.unique(np.round(np.geomspace(1.0, samples / 2.0, 80))) / rate

    def curves(of: NoiseTerm) -> Float[np.ndarray, " f+m"]:
        """Spectrum of the samples, and Allan variance."""
        parts = (of.sampled_psd(frequency, rate), of.allan_variance(time))
        return np.concatenate([np.asarray(part, float) for part in parts])

    target = curves(term)
    white = np.concatenate([np.ones(len(frequency)), 1.0 / time]) / target
    longest, shortest, worst = _LONGEST * samples / rate, _SHORTEST / rate, math.inf
    for density in _DENSITIES:
        count = math.ceil(density * math.log10(longest / shortest)) + 1
        processes = [Markov(1.0, float(T_c)) for T_c in np.geomspace(shortest, longest, count)]
        columns = np.column_stack([*(curves(p) / target for p in processes), white])
        scale = np.linalg.norm(columns, axis=0)
        found = nnls(columns / scale, np.ones(len(columns)))[0] / scale
        worst = float(np.abs(columns @ found - 1.0).max())
        if worst <= _AIM:
            break
    if not worst <= TOLERANCE:
        raise AllanjaxError(
            f"no sum of Gauss–Markov processes approximates {term!r} to {100.0 * TOLERANCE:.0f} % (best: "
            f"{100.0 * worst:.0f} %); fit bias_instability, rate_random_walk or Markov() instead"
        )
    squares = zip(processes, found[:-1], strict=True)
    blocks = [p.replace(amplitude=math.sqrt(v)).state_block(rate, None) for p, v in squares if v > 0.0]
    return together([_with_one_mean(blocks), white_block(float(found[-1]) * rate)])


def _with_one_mean(blocks: list[Block]) -> Block:
    """Sum of processes whose samples are means: one state for the sum of the means, one each for the ends."""
    joined = together(blocks)
    merge = np.zeros((len(blocks) + 1, joined.size))
    merge[0, ::2] = 1.0
    merge[np.arange(len(blocks)) + 1, 2 * np.arange(len(blocks)) + 1] = 1.0
    # No state depends on a mean.
    ends = merge @ joined.transition[:, 1::2]
    transition = np.column_stack([np.zeros(len(ends)), ends])
    names = ("mean", *(f"end_{k + 1}" for k in range(len(blocks))))
    return Block(
        transition,
        [1.0, *(0.0,) * len(blocks)],
        merge @ joined.noise @ merge.T,
        merge @ joined.start @ merge.T,
        names,
        joined.white,
    )
