"""Noise that has passed a filter."""

from __future__ import annotations

from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from allanjax.base.errors import AllanjaxError
from allanjax.noise.exponential import is_continuous
from allanjax.noise.process import Process
from allanjax.noise.response import Response

# Samples in which a filter settles before a simulation begins.
_SETTLING = 8192


class Filtered(Process):
    """A process after a response, for samples at `rate` [Hz]; 0 if that is not known yet.

    The process says what its density consists of, by its method `parts(rate)`.
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
        """Simulated samples; the filter has seen some thousand of them before the first."""
        x = self.process.simulate(key, n + _SETTLING, rate)
        # It starts at rest at the first of these, which it passes: constants it leaves as they are.
        first = _SETTLING - self.response.ahead
        return self.response.filtered(x - x[0], rate)[first : first + n] + x[0]

    @property
    def _known_rate(self) -> float:
        if is_continuous(self.rate):
            raise AllanjaxError("a response is that of samples: say at which rate, model.sampled(rate)")
        return self.rate
