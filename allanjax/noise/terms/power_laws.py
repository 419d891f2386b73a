"""Noise with power-law spectra: quantization (thesis 4.3.1), random walks (4.3.2, 4.3.4), flicker (4.3.3)."""

from __future__ import annotations

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from allanjax.base.arrays import namespace, special_functions
from allanjax.base.errors import AllanjaxError
from allanjax.noise.model import NoiseTerm
from allanjax.noise.numerics import linear_recurrence
from allanjax.noise.parameter import Value, parameter
from allanjax.noise.response import NO_POLES, Parts, Poles
from allanjax.noise.state_space import Block, together, white_block
from allanjax.noise.terms.correlated import Markov


class Quantization(NoiseTerm):
    """White error of the angle (velocity) at each reading: σ²(T) = 3Q²/T² (4.29).

    `coefficient` Q in rad or m/s. A rounding of the angle to steps S has Q = S/√12.
    """

    coefficient: Value = parameter("Q", time_exponent=1.0)
    #: Sample interval [s]; only the PSD needs it (4.28).
    sample_interval: float = 0.0

    def phase_covariance(self, lag: Float[Array, ...]) -> Float[Array, ...]:
        return namespace(self, lag).where(lag == 0.0, self.coefficient**2, 0.0)

    def psd(self, frequency: Float[ArrayLike, ...]) -> Float[Array, ...]:
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

    def sampled_psd(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        return self.sampled(rate).psd(frequency)

    def end_effect(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        """Power of the first and last reading's errors, which no neighbouring increment takes back."""
        xp = namespace(self, frequency, rate)
        a = 2.0 * np.pi * xp.asarray(frequency) / rate
        return 2.0 * (self.coefficient * rate) ** 2 * (1.0 + xp.cos(a))

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Float[Array, " n"]:
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

    def phase_covariance(self, lag: Float[Array, ...]) -> Float[Array, ...]:
        return -(self.coefficient**2) * lag / 2.0

    def psd(self, frequency: Float[ArrayLike, ...]) -> Float[Array, ...]:
        return namespace(self, frequency).full(np.shape(frequency), self.coefficient**2)

    def sampled_psd(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        return self.psd(frequency)

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Float[Array, " n"]:
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

    def phase_covariance(self, lag: Float[Array, ...]) -> Float[Array, ...]:
        return self.coefficient**2 * lag**3 / 12.0

    @np.errstate(divide="ignore")
    def psd(self, frequency: Float[ArrayLike, ...]) -> Float[Array, ...]:
        xp = namespace(self, frequency)
        return (self.coefficient / (2.0 * np.pi * xp.asarray(frequency))) ** 2

    @np.errstate(divide="ignore")
    def sampled_psd(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        """PSD of the samples, K²/rate²·(2 + cos a)/(12 sin²(a/2)), a = 2πf/rate."""
        xp = namespace(self, frequency, rate)
        a = 2.0 * np.pi * xp.asarray(frequency) / rate
        return (self.coefficient / rate) ** 2 * (2.0 + xp.cos(a)) / (12.0 * xp.sin(a / 2.0) ** 2)

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Float[Array, " n"]:
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


# Aliases on either side that are summed with a cutoff, for want of a closed form; the rest is below 0.1 %.
_ALIASES = 16


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

    def phase_covariance(self, lag: Float[Array, ...]) -> Float[Array, ...]:
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
    def psd(self, frequency: Float[ArrayLike, ...]) -> Float[Array, ...]:
        xp = namespace(self, frequency)
        f = xp.abs(xp.asarray(frequency, float))
        return xp.where(f <= self.cutoff_frequency, self.coefficient**2 / (2.0 * np.pi * f), 0.0)

    def at_low_frequencies(self) -> BiasInstability:
        return self.replace(cutoff_frequency=math.inf)

    @np.errstate(divide="ignore", invalid="ignore")
    def sampled_psd(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
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


def _cutoff_flicker(x: Float[Array, ...]) -> Float[Array, ...]:
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

    def phase_covariance(self, lag: Float[Array, ...]) -> Float[Array, ...]:
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
    def psd(self, frequency: Float[ArrayLike, ...]) -> Float[Array, ...]:
        xp = namespace(self, frequency)
        return self.amplitude**2 * xp.abs(xp.asarray(frequency, float)) ** -self.exponent

    @np.errstate(divide="ignore", invalid="ignore")
    def sampled_psd(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        """PSD with aliases: A²·rate^−α·sin²(πu)/π²·[ζ(α+2, u) + ζ(α+2, 1−u)], u = f/rate."""
        xp = namespace(self, frequency, rate)
        u = xp.asarray(frequency, float) / rate
        aliases = _hurwitz(2.0 + self.exponent, u) + _hurwitz(2.0 + self.exponent, 1.0 - u)
        return self.amplitude**2 * rate**-self.exponent * (xp.sin(np.pi * u) / np.pi) ** 2 * aliases

    def state_block(self, rate: float, duration: float | None) -> Block:
        """States of Gauss–Markov processes whose sum is the noise up to a duration [s]."""
        return gauss_markov_sum(self, rate, duration)


def _relative_expm1(x: Float[Array, ...]) -> Float[Array, ...]:
    """Quotient (e^x − 1)/x, smooth at zero."""
    xp = namespace(x)
    small = xp.abs(x) < 1e-2
    series = 1.0 + x / 2.0 * (1.0 + x / 3.0 * (1.0 + x / 4.0 * (1.0 + x / 5.0 * (1.0 + x / 6.0))))
    far = xp.where(small, 1.0, x)
    return xp.where(small, series, xp.expm1(far) / far)


def _hurwitz(s: Value, q: Float[Array, ...]) -> Float[Array, ...]:
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
    if duration is None:
        raise AllanjaxError(
            f"{term.name()} has a finite state space only for a limited time: give the duration in s, e.g. "
            "state_space(rate, duration=3600.0)"
        )
    samples = max(duration * rate, 16.0)
    frequency = rate * np.geomspace(1.0 / samples, 0.5, 160)
    time = np.unique(np.round(np.geomspace(1.0, samples / 2.0, 80))) / rate
    target = _curves(term, frequency, time, rate)
    worst = math.inf
    for density in _DENSITIES:
        processes = _processes(samples, density, rate)
        relative = np.stack([_curves(p, frequency, time, rate) / target for p in processes], axis=1)
        white = np.concatenate([np.ones(len(frequency)), 1.0 / time]) / target
        variance, white_density, worst = _fitted(relative, white)
        if worst <= _AIM:
            break
    if not worst <= TOLERANCE:
        raise AllanjaxError(
            f"no sum of Gauss–Markov processes approximates {term!r} to {100.0 * TOLERANCE:.0f} % (best: "
            f"{100.0 * worst:.0f} %); fit bias_instability, rate_random_walk or Markov() instead"
        )
    found = zip(processes, variance, strict=True)
    blocks = [p.replace(amplitude=math.sqrt(v)).state_block(rate, None) for p, v in found if v > 0.0]
    return together([_with_one_mean(blocks), white_block(white_density * rate)])


def _curves(
    term: NoiseTerm, frequency: Float[np.ndarray, " f"], time: Float[np.ndarray, " m"], rate: float
) -> Float[np.ndarray, " f+m"]:
    """Spectrum of the samples at frequencies [Hz], and Allan variance at cluster times [s]."""
    parts = (term.sampled_psd(frequency, rate), term.allan_variance(time))
    return np.concatenate([np.asarray(part, float) for part in parts])


def _processes(samples: float, density: float, rate: float) -> list[Markov]:
    """Processes of unit amplitude, this many per decade of correlation times."""
    longest, shortest = _LONGEST * samples / rate, _SHORTEST / rate
    count = math.ceil(density * math.log10(longest / shortest)) + 1
    return [Markov(1.0, float(time)) for time in np.geomspace(shortest, longest, count)]


def _fitted(
    relative: Float[np.ndarray, "rows n"], white: Float[np.ndarray, " rows"]
) -> tuple[Float[np.ndarray, " n"], float, float]:
    """Squared amplitudes of processes, density of white noise, and the largest error of their sum from 1."""
    from scipy.optimize import nnls

    columns = np.column_stack([relative, white])
    scale = np.linalg.norm(columns, axis=0)
    found = nnls(columns / scale, np.ones(len(columns)))[0] / scale
    return found[:-1], float(found[-1]), float(np.abs(columns @ found - 1.0).max())


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
