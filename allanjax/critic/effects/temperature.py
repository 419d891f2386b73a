"""Effects of an auxiliary channel, such as temperature, on the rate."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.fft import dct, idct

from allanjax.critic.bank import SLOW, Bank, additive, any_of, spaced_parameter
from allanjax.critic.effect import Candidate, Effect, View
from allanjax.critic.noise import centred
from allanjax.critic.policy import judged
from allanjax.noise import terms
from allanjax.noise.estimate import Estimate

# Largest number of lags that are compared.
_LAGS = 48
_CLOCK = judged("temperature", "clock")


class Temperature(Effect):
    """Effect coefficient · channel(t − lag) of an auxiliary channel; lags up to a tenth of the record."""

    name = "temperature"
    refit = "at once"

    def detect(self, view: View) -> Candidate | None:
        found = (self._of(view, name, np.asarray(z, float)) for name, z in view.auxiliary.items())
        return max((c for c in found if c is not None), key=lambda c: c.gain, default=None)

    def p_value(self, view: View) -> float | None:
        banks = [_bank(np.asarray(channel, float)) for channel in view.auxiliary.values()]
        p = [bank[1].p_value(view, view.noise) for bank in banks if bank is not None]
        # The best of several channels, corrected for their number.
        return any_of(min(p), len(p)) if p else None

    def _of(self, view: View, name: str, z: Float[np.ndarray, " n"]) -> Candidate | None:
        """Best candidate of one channel."""
        found = _bank(z)
        if found is None:
            return None
        lags, bank = found
        step = view.n / min(SLOW, view.n - 1)

        def delayed(k: int) -> np.ndarray:
            return _delayed(z, round(lags[k] * step))

        def term(k: int, a: float) -> terms.ChannelEffect:
            return terms.ChannelEffect(
                abs(a),
                round(lags[k] * step) / view.rate,
                sign=int(np.copysign(1.0, a)),
                channel=name,
                reference=np.mean(delayed(k)),
            )

        def parameters(k: int, a: float, std: float, likelihood: np.ndarray) -> list[Estimate]:
            lag, spread, limit = spaced_parameter(lags * step / view.rate, likelihood)
            return [
                view.amplitude_estimate("coefficient", a, std, f"/[{name}]"),
                view.estimate("lag", lag, spread, "s", limit),
            ]

        return additive(
            view,
            self.name,
            bank,
            lambda k: delayed(k) - z.mean(),
            parameters,
            log_trials=float(np.log(len(view.auxiliary))),
            term=term,
            details={"channel": name},
        )


def _bank(z: Float[np.ndarray, " n"]) -> tuple[Int[np.ndarray, " lags"], Bank] | None:
    """Lags [bank samples] and a bank of the channel at these; None if the channel can have no influence."""
    n = len(z)
    if not np.isfinite(z).all() or np.ptp(z) == 0.0:
        return None
    if 1.0 - np.corrcoef(z, np.arange(n))[0, 1] ** 2 < _CLOCK:
        return None
    # Lags are applied to the channel at the bank's resolution.
    J = min(SLOW, n - 1)
    slow = idct(np.concatenate([[0.0], centred(z)[: J - 1]]), norm="ortho")
    lags = np.concatenate([np.arange(8.0), np.geomspace(8.0, J / 10.0, _LAGS - 8)])
    lags = np.unique(np.rint(lags)).astype(int)
    return lags, Bank(dct(np.stack([_delayed(slow, k) for k in lags]), norm="ortho", axis=1)[:, 1:])


def _delayed(z: Float[np.ndarray, " n"], samples: int) -> Float[np.ndarray, " n"]:
    """Channel delayed by some samples; before its start it has its first value."""
    return z[np.maximum(np.arange(len(z)) - samples, 0)]
