"""Noise as a process: one phase covariance, from which everything else follows.

Let θ(t) be the running integral of the rate output (angle of a gyro, velocity of an accelerometer). Every
random term of the thesis has stationary second differences of θ, so it is described completely by a
generalized covariance G(t): for filters a, b with Σa = Σa·t = 0,

    cov(Σ a_p θ(t_p), Σ b_q θ(t_q)) = Σ_p Σ_q a_p b_q G(t_p − t_q).

G is known only up to c0 + c1·t², which such filters remove.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import jax
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from allanjax.base.arrays import namespace
from allanjax.base.errors import AllanjaxError
from allanjax.base.module import Module
from allanjax.noise.numerics import (
    gaussian_sequence,
    increment_autocovariance,
    is_continuous,
    linear_recurrence,
    sampled_density,
)
from allanjax.noise.response import Parts, Response

# Samples of the smallest half circle on which oscillating noise is drawn: on one shorter than its memory its
# covariance would have negative eigenvalues.
_LEAST_CIRCLE = 1 << 16


@jax.jit
def _summed_density(process: Process, angle: Float[Array, " f"], rate: float) -> Float[Array, " f"]:
    """Density of the samples [rate²/Hz] at angular frequencies per sample, summed numerically."""
    return jax.vmap(lambda a: sampled_density(process.phase_covariance, a, rate))(angle)


class Process(Module):
    """A random process with a phase covariance, and its Allan variance, spectrum and simulation."""

    #: True for a line, a ramp, a step: the same in every record, so that its square does not scatter.
    deterministic: ClassVar[bool] = False
    #: True if the term oscillates for long: all its power fluctuates together, see `power_scatter`.
    narrow_band: ClassVar[bool] = False

    def phase_covariance(self, lag: Float[Array, ...]) -> Float[Array, ...]:
        """Generalized covariance G [rad² or (m/s)²] of the integrated rate at lags ≥ 0 [s].

        Known up to c0 + c1·t², two constants that the lags along the last axis of a call have in common.
        """
        raise NotImplementedError(f"{type(self).__name__} does not define phase_covariance(lag)")

    def psd(self, frequency: Float[ArrayLike, ...]) -> Float[Array, ...]:
        """Two-sided power spectral density of the rate, (rad/s)²/Hz or (m/s²)²/Hz, at frequencies [Hz].

        Zero for a line, whose power is all at its own frequency, and for what happens once.
        """
        if self.deterministic:
            return namespace(self, frequency).zeros(np.shape(frequency))
        raise NotImplementedError(f"{type(self).__name__} does not define psd(frequency)")

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
        return _summed_density(self, 2.0 * np.pi * f.ravel() / rate, rate).reshape(f.shape)

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Float[Array, " n"]:
        """Simulated samples of the rate (n means over sample intervals) at `rate` [Hz], exact in law.

        The default draws the increments of the rate, whose autocovariance is that of the second difference
        of θ, by circulant embedding (Davies & Harte 1987), and adds them up from zero: the level itself has
        no law when the term is not stationary.
        """
        from scipy.fft import next_fast_len

        half = next_fast_len(max(n, _LEAST_CIRCLE if self.oscillates else 2), real=True)
        increments = gaussian_sequence(key, increment_autocovariance(self.phase_covariance, half + 1, rate))[
            :n
        ]
        return linear_recurrence(1.0, increments)

    def parts(self, rate: float) -> Parts:
        """Parts of the density of samples at `rate` [Hz], for filtering by a `Response`."""
        name = type(self).__name__
        raise AllanjaxError(
            f"{name} cannot pass through a response: write it after the filter, response * (…) + {name}(…)"
        )

    @property
    def oscillates(self) -> bool:
        """Whether G oscillates with a period of its own, so that sums over lags need more nodes."""
        return self.narrow_band

    def end_effect(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        """Power [rate²] that a record's two ends add to its cosine spectrum, times its number of samples.

        It spreads over all frequencies, and matters for terms whose own density falls off towards low ones.
        Zero unless overridden; see `cosine` for the lowest frequencies, where it is never neglected.
        """
        return namespace(self, frequency).zeros(np.shape(frequency))

    def power_scatter(self, duration: Float[ArrayLike, ""]) -> Float[Array, ""]:
        """Relative variance of a narrow-band process's mean square over a record of this duration [s]."""
        raise NotImplementedError(f"{type(self).__name__} is narrow-band and must define power_scatter")

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
        G = self.phase_covariance(T[..., None] * xp.arange(len(weights)))
        return G @ xp.asarray(weights) / (divisor * T**2)


def numbers_as_data(processes: tuple[Process, ...]) -> tuple[Process, ...]:
    """Processes whose numbers are arrays, so that other values need no compilation of a jitted function.

    Infinite values, such as a cutoff, select a formula and stay numbers.
    """
    return jax.tree.map(lambda x: np.asarray(x) if isinstance(x, float) and abs(x) < np.inf else x, processes)


# Samples that a filter is given to settle before a simulation begins.
_SETTLING = 8192


class FilteredProcess(Process):
    """A process after a response, for samples at `rate` [Hz]; 0 if that is not known yet.

    The process must have the method `parts(rate)`, which returns the parts of its density.
    """

    process: Process
    response: Response
    rate: float

    @property
    def oscillates(self) -> bool:
        return self.process.oscillates

    @property
    def narrow_band(self) -> bool:  # type: ignore[override]  # of the process, not of the class
        return self.process.narrow_band

    def power_scatter(self, duration: Float[ArrayLike, ""]) -> Float[Array, ""]:
        return self.process.power_scatter(duration)

    def phase_covariance(self, lag: Float[Array, ...]) -> Float[Array, ...]:
        return self.response.phase_covariance(self.process, lag, self._known_rate)

    def psd(self, frequency: Float[ArrayLike, ...]) -> Float[Array, ...]:
        return self.response.power(frequency, self._known_rate) * self.process.psd(frequency)

    def sampled_psd(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        return self.response.power(frequency, rate) * self.process.sampled_psd(frequency, rate)

    def end_effect(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        return self.response.power(frequency, rate) * self.process.end_effect(frequency, rate)

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Float[Array, " n"]:
        """Simulated samples; the filter has run over thousands of samples before the first."""
        x = self.process.simulate(key, n + _SETTLING, rate)
        # It starts at rest at the first of these, which is added again: it leaves constants unchanged.
        first = _SETTLING - self.response.ahead
        return self.response.filtered(x - x[0], rate)[first : first + n] + x[0]

    @property
    def _known_rate(self) -> float:
        if is_continuous(self.rate):
            raise AllanjaxError("a response depends on the sample rate: use model.sampled(rate)")
        return self.rate
