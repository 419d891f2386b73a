"""Effects of an auxiliary channel, such as temperature, on the rate."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.fft import dct, idct

from allanjax.critic.bank import SLOW, Bank, any_of
from allanjax.critic.effect import Effect
from allanjax.critic.noise import centred
from allanjax.critic.policy import judged
from allanjax.critic.view import Candidate, View
from allanjax.critic.waveform import additive, shape_parameter
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
        found = [self._of(view, name, channel) for name, channel in view.auxiliary.items()]
        real = [candidate for candidate in found if candidate is not None]
        return max(real, key=lambda candidate: candidate.gain, default=None)

    def p_value(self, view: View) -> float | None:
        banks = [_bank(np.asarray(channel, float)) for channel in view.auxiliary.values()]
        p = [bank[1].p_value(view, view.noise) for bank in banks if bank is not None]
        # The best of several channels, corrected for their number.
        return any_of(min(p), len(p)) if p else None

    def _of(self, view: View, name: str, channel: np.ndarray) -> Candidate | None:
        """Best candidate of one channel."""
        z = np.asarray(channel, float)
        found = _bank(z)
        if found is None:
            return None
        lags, bank = found
        step = view.n / min(SLOW, view.n - 1)

        def delay(k: int) -> int:
            return round(lags[k] * step)

        def delayed(k: int) -> np.ndarray:
            return np.concatenate([np.full(delay(k), z[0]), z[: view.n - delay(k)]])

        def shape(k: int) -> np.ndarray:
            return delayed(k) - z.mean()

        def term(k: int, a: float) -> terms.ChannelEffect:
            return terms.ChannelEffect(
                abs(a),
                delay(k) / view.rate,
                sign=int(np.copysign(1.0, a)),
                channel=name,
                reference=np.mean(delayed(k)),
            )

        def parameters(k: int, a: float, std: float, likelihood: np.ndarray) -> list[Estimate]:
            # The bank is not evenly spaced: its points are weighted by the lags that they represent.
            spacing = np.gradient(lags.astype(float))
            lag, spread, limit = shape_parameter(lags * step, likelihood, spacing)
            spread = np.hypot(spread, step * np.interp(lag, lags * step, spacing) / np.sqrt(12.0))
            return [
                view.amplitude_estimate("coefficient", a, std, f"/[{name}]"),
                view.estimate("lag", lag / view.rate, spread / view.rate, "s", limit),
            ]

        return additive(
            view,
            self.name,
            bank,
            shape,
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
    t = np.arange(n) - (n - 1) / 2.0
    if np.var(z - np.polynomial.Polynomial.fit(t, z, 1)(t)) < _CLOCK * np.var(z):
        return None
    # Lags are applied to the channel at the bank's resolution.
    J = min(SLOW, n - 1)
    slow = idct(np.concatenate([[0.0], centred(z)[: J - 1]]), norm="ortho")
    lags = np.unique(np.rint(np.concatenate([np.arange(8.0), np.geomspace(8.0, J / 10.0, _LAGS - 8)])))
    lags = lags.astype(int)
    shifted = np.stack([np.concatenate([np.full(k, slow[0]), slow[: J - k]]) for k in lags])
    return lags, Bank(dct(shifted, norm="ortho", axis=1)[:, 1:])
