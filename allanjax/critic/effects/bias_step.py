"""Steps of the bias."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from allanjax.critic.bank import (
    FINEST,
    HOPELESS,
    Bank,
    additive,
    log_occam_factor,
    log_trials_factor,
    mean_and_std,
    shape_parameter,
    step_bank,
    step_coefficients,
)
from allanjax.critic.effect import Candidate, Effect, View
from allanjax.critic.effects.slow_change import is_slow
from allanjax.critic.noise import Noise
from allanjax.critic.policy import PRIORS
from allanjax.noise import terms
from allanjax.noise.estimate import Estimate

# Places of the finer bank around the best one.
_FINER = 64
# Spacing of the steps of the bank that may form a pair; most rounds in which it and the noise are estimated.
_COARSER, _ROUNDS = 8, 3


class BiasStep(Effect):
    """A step of the bias; several are detected one by one, or two together if they hide each other."""

    name = "bias_step"
    is_event = True
    refit = "at once"

    def detect(self, view: View) -> Candidate | None:
        found = self.again(view)
        least = 0.0 if found is None else found.gain
        return self._two(view, least - PRIORS[self.name].log_odds) or found

    def again(self, view: View, found: Candidate | None = None) -> Candidate | None:
        """Best single step, located on a finer bank if it is strong."""
        bank, places = step_bank(view.n)
        found = self._one(view, bank, places)
        if found is None:
            return None
        time = found.parameters["time"]
        spacing = places[1] - places[0]
        if spacing > 1.0 and time.std * view.rate < spacing:
            near = time.value * view.rate + np.linspace(-2.0, 2.0, _FINER) * spacing
            fine = np.unique(np.rint(near).clip(1, view.n - 1))
            finer = Bank(step_coefficients(fine, view.n, min(FINEST, view.n - 1)))
            refined = self._one(view, finer, fine, float(np.log(len(places) * spacing / np.ptp(fine))), found)
            if refined is not None and refined.gain > found.gain:
                found = refined
        slow = is_slow(view, found.after.noise, found.support[0] * view.rate)
        return found.doubted("it begins slowly or decays" if slow else "")

    def p_value(self, view: View) -> float:
        return step_bank(view.n)[0].p_value(view, view.noise)

    def _one(
        self,
        view: View,
        bank: Bank,
        places: Float[np.ndarray, " places"],
        log_trials: float = 0.0,
        coarse: Candidate | None = None,
    ) -> Candidate | None:
        """Best single step of a bank."""
        spacing = places[1] - places[0]

        def parameters(k: int, a: float, std: float, likelihood: np.ndarray) -> list[Estimate]:
            place, spread, limit = shape_parameter(places, likelihood)
            # Only at the record's ends may a step lie beyond the end of a bank.
            if limit and (places[0] if limit == "below" else view.n - places[-1]) > 2.0 * spacing:
                (place, spread), limit = mean_and_std(places, likelihood), ""
            spread = float(np.hypot(spread, spacing / np.sqrt(12.0)))
            return [
                view.estimate("time", place / view.rate, spread / view.rate, "s", limit),
                view.amplitude_estimate("amplitude", a, std),
            ]

        return additive(
            view,
            self.name,
            bank,
            lambda k: (np.arange(view.n) >= places[k]).astype(float),
            parameters,
            lambda k: (places[k] / view.rate, view.duration),
            log_trials,
            lambda k, a: terms.BiasStep(abs(a), float(places[k] / view.rate), sign=int(np.copysign(1.0, a))),
            coarse=coarse,
        )

    def _two(self, view: View, least: float) -> Candidate | None:
        """Two steps, if they gain more than the `least`, and each has a gain given the other."""
        bank, places = step_bank(view.n, _COARSER)
        gain, k, amplitude = max(
            (_pair(view, bank, noise) for noise in view.noises), key=lambda pair: pair[0]
        )
        if gain < least + HOPELESS:
            return None
        later = (np.arange(view.n) >= places[k]).astype(float)
        alone = view.with_samples(view.samples - amplitude * later)
        if (first := self.again(alone)) is None:
            return None
        rest = view.with_samples(view.samples - (alone.samples - first.after.samples))
        if (second := self.again(rest)) is None:
            return None
        each = ((first, alone), (second, rest))
        prices = (c.after.log_evidence - before.log_evidence - c.gain for c, before in each)
        # Either of them may be the first.
        gain = second.after.log_evidence - view.log_evidence - sum(prices) + float(np.log(2.0))
        if gain <= least or min(first.held_out(), second.held_out()) <= 0.0:
            return None
        return dataclasses.replace(
            second,
            gain=gain,
            p_value=max(first.chance, second.chance),
            held_out=lambda: min(first.held_out(), second.held_out()),
            bound=float(np.exp(-gain)),
            parts=(dataclasses.replace(first, after=rest), second),
        )


def _pair(view: View, bank: Bank, noise: Noise) -> tuple[float, int, float]:
    """Approximate log evidence of the best two steps of a bank [nats]; number and amplitude of the later one.

    They and the noise without them are estimated in turn.
    """
    i, j = np.triu_indices(len(bank.shapes), 1)
    best = -1
    for _ in range(_ROUNDS):
        matched = bank.matched(view, noise)
        p, rows = matched.products(matched.whitened), matched.rows()
        gram = rows @ rows.T
        own = np.diag(gram)
        det = np.maximum(own[i] * own[j] - gram[i, j] ** 2, 1e-9 * own[i] * own[j])
        gains = 0.5 * (p[i] ** 2 * own[j] + p[j] ** 2 * own[i] - 2.0 * p[i] * p[j] * gram[i, j]) / det
        before, best = best, int(np.argmax(gains))
        pair = [i[best], j[best]]
        covariance = np.linalg.pinv(gram[np.ix_(pair, pair)])
        amplitude = covariance @ p[pair]
        noise = view.noise_without(amplitude @ bank.shapes[pair])
        if best == before:
            break
    price = log_trials_factor(gains) + np.sum(log_occam_factor(amplitude / np.sqrt(np.diag(covariance))))
    gain = noise.log_evidence - view.noise.log_evidence - float(price)
    return gain, int(j[best]), float(amplitude[1])
