"""Warm-up: a bias that settles exponentially after power-on."""

from __future__ import annotations

import functools
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from allanjax.base.normal import ONE_SIDED_95
from allanjax.critic.bank import SLOW, Bank, additive, spaced_parameter
from allanjax.critic.effect import TIMES, Candidate, Effect, View
from allanjax.critic.effects.slow_change import is_broken
from allanjax.critic.finding import Limit
from allanjax.noise import terms
from allanjax.noise.estimate import Estimate

# Number of time constants that are compared.
_TIMES = 48


class WarmUp(Effect):
    """Exponential a·exp(−t/T), T from 1/500 to 1/2 of the record; a slower one is a ramp."""

    name = "warm_up"
    is_event = True
    refit = "at once"
    sensible: ClassVar = {"time_constant": TIMES._replace(may_be_a_limit=True)}

    def p_value(self, view: View) -> float:
        return _bank(view.n, view.rate)[1].p_value(view, view.noise)

    def detect(self, view: View) -> Candidate | None:
        t = np.arange(view.n) / view.rate
        times, bank = _bank(view.n, view.rate)

        def parameters(k: int, a: float, std: float, likelihood: np.ndarray) -> list[Estimate]:
            log_time, spread, limit = spaced_parameter(np.log(times), likelihood)
            amplitude = view.amplitude_estimate("amplitude", a, std)
            if limit:
                # Slower or faster ones are mostly outside the record or between its samples.
                least = a - np.sign(a) * ONE_SIDED_95 * std
                side: Limit = "above" if a > 0.0 else "below"
                amplitude = view.amplitude_estimate("amplitude", least, np.nan, limit=side)
            return [amplitude, view.log_estimate("time_constant", log_time, spread, limit, "s")]

        found = additive(
            view,
            self.name,
            bank,
            lambda k: np.exp(-t / times[k]),
            parameters,
            lambda k: (0.0, min(3.0 * times[k], view.duration)),
            term=lambda k, a: terms.WarmUp(abs(a), float(times[k]), sign=int(np.copysign(1.0, a))),
        )
        broken = found is not None and is_broken(view, found.after.noise, bank)
        return found and found.doubted("a slope that begins or ends explains more" if broken else "")


@functools.lru_cache(maxsize=2)
def _bank(n: int, rate: float) -> tuple[Float[np.ndarray, " times"], Bank]:
    """Time constants [s], and a bank of exponentials with these."""
    times = np.geomspace(n / 500.0, n / 2.0, _TIMES)
    # Coefficients of e^{−k/T}, T in samples, from the real part of a geometric series.
    a = np.pi * np.arange(1, min(SLOW, n - 1) + 1) / n
    ratio = np.exp(1j * a - 1.0 / times[:, None])
    last = np.exp(1j * np.pi * np.arange(1, len(a) + 1) - n / times[:, None])
    shapes = np.sqrt(2.0 / n) * np.real(np.exp(0.5j * a) * (1.0 - last) / (1.0 - ratio))
    return times / rate, Bank(shapes)
