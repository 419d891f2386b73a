"""Steps of the bias."""

from __future__ import annotations

import dataclasses
from functools import cache, partial

import numpy as np
from jaxtyping import Float, Int

from allanjax.critic.bank import (
    FINEST,
    SLOW,
    Bank,
    Matched,
    log_occam_factor,
    log_trials_factor,
    step_bank,
    step_coefficients,
)
from allanjax.critic.effect import Effect
from allanjax.critic.noise import Noise
from allanjax.critic.policy import PRIORS, judged
from allanjax.critic.view import Candidate, View
from allanjax.critic.waveform import (
    HOPELESS,
    adding,
    additive,
    marginal,
    mean_and_std,
    shape_parameter,
)
from allanjax.noise import terms
from allanjax.noise.estimate import Estimate

_SURE, _CLEAR = judged("bias_step", "sure"), judged("bias_step", "clear")
# Shortest length of a change that is compared with a step, as a share of the record; numbers of lengths and
# of steps that form one; places of its middle, in lengths.
_SUDDEN, _LENGTHS, _PIECES, _MIDDLES = 4e-3, 10, 16, np.array([-0.25, 0.0, 0.25, 0.5])
# Places of the finer bank around the best one; most rounds in which two steps and the noise are estimated in
# turn.
_FINER, _ROUNDS = 64, 3


class BiasStep(Effect):
    """A step of the bias; several are detected one by one, or two together if they hide each other."""

    name = "bias_step"
    refit = "at once"

    def detect(self, view: View) -> Candidate | None:
        found = self.again(view)
        if found is None or found.gain < _SURE:
            least = -PRIORS[self.name].log_odds + (0.0 if found is None else found.gain)
            both = self._two(view, *step_bank(view.n), least)
            # Each of the two must gain on held-out data; otherwise the single step is kept.
            if both is not None and (found is None or both.held_out() > 0.0):
                return both
        return found

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
                return refined
        return found

    def p_value(self, view: View) -> float:
        return step_bank(view.n)[0].p_value(view, view.noise)

    def _one(
        self,
        view: View,
        bank: Bank,
        places: np.ndarray,
        log_trials: float = 0.0,
        coarse: Candidate | None = None,
    ) -> Candidate | None:
        """Best single step of a bank."""
        found = additive(
            view,
            self.name,
            bank,
            lambda k: _shape(view, places[k]),
            lambda k, a, std, likelihood: _parameters(view, places, a, std, likelihood),
            lambda k: (places[k] / view.rate, view.duration),
            log_trials,
            lambda k, a: _term(view, places[k], a),
            coarse=coarse,
        )
        return found and found.doubted(_doubt(view, found.after, found.support[0] * view.rate))

    def _two(self, view: View, bank: Bank, places: np.ndarray, least: float) -> Candidate | None:
        """Best pair of steps that hide each other, if they gain more than the `least`, else None."""
        found = []
        for noise in view.noises:
            pair = best_pair(bank, view, noise)
            for _ in range(_ROUNDS):
                without = view.noise_without(pair.amplitude @ bank.shapes[list(pair.members)])
                before, pair = pair, best_pair(bank, view, without, pair.members)
                if pair.members == before.members:
                    break
            price = pair.log_trials_factor + float(np.sum(log_occam_factor(pair.snr)))
            found.append((without.log_evidence - view.noise.log_evidence - price, price, pair))
        rough, price, pair = max(found, key=lambda each: each[0])
        if rough < least + HOPELESS:
            return None
        both = [a * _shape(view, places[k]) for k, a in zip(pair.members, pair.amplitude, strict=True)]
        after = view.with_samples(view.samples - both[0] - both[1])
        gain = after.log_evidence - view.log_evidence - price
        if gain <= least:
            return None
        first = self._given_other(view, bank, places, pair.members[0], both, after)
        second = self._given_other(view, bank, places, pair.members[1], both[::-1], after)
        first = dataclasses.replace(first, after=view.with_samples(view.samples - both[0]))
        return Candidate(
            self.name,
            first.estimates,
            gain,
            max(first.chance, second.chance),
            after,
            lambda: min(first.held_out(), second.held_out()),
            (min(first.support[0], second.support[0]), view.duration),
            parts=(first, second),
            bound=float(np.exp(-gain)),
        )

    def _given_other(
        self, view: View, bank: Bank, places: np.ndarray, k: int, steps: list[np.ndarray], without: View
    ) -> Candidate:
        """First of two steps as a finding in the record without the other, with its additional gain."""
        alone = view.with_samples(view.samples - steps[1])
        scan = bank.scan(alone, without.noise)
        a = float(scan.amplitude[k])
        return Candidate(
            self.name,
            _parameters(view, places, a, *marginal(alone, without, bank, k, a)),
            without.log_evidence - alone.log_evidence - scan.log_trials_factor,
            bank.p_value(alone, without.noise, float(scan.snr[k])),
            without,
            cache(partial(bank.held_out, alone, without)),
            (float(places[k] / view.rate), view.duration),
            add_to_model=adding(_term(view, places[k], a)),
            has_waveform=True,
            doubt=_doubt(alone, without, places[k]),
        )


def _doubt(view: View, after: View, place: float) -> str:
    """Why a change of the bias at a place [samples] is hardly a step: it begins slowly, or decays."""
    share = (np.arange(_PIECES) + 0.5) / _PIECES
    # Sums of steps, as their places and heights; the quantiles of the exponential law make a decay.
    alone, even = [(np.array([place]), np.ones(1))], np.full(_PIECES, 1.0 / _PIECES)
    others = []
    for length in np.geomspace(_SUDDEN, 0.5, _LENGTHS) * view.n:
        later = place - length * np.log1p(-share)
        others.append((np.append(place, later), np.append(1.0, -even)))
        others += [(middle + length * (share - 0.5), even) for middle in place + length * _MIDDLES]
    best, own = (_gain(view, after.noise, each) for each in (others, alone))
    return "it begins slowly or decays" if best - own > judged("bias_step", "clearly") else ""


def _gain(view: View, noise: Noise, sums: list[tuple[np.ndarray, np.ndarray]]) -> float:
    """Largest gain in log-likelihood by one of these sums of steps [nats]."""
    J = min(SLOW // 4, view.n - 1)
    rows = [heights @ step_coefficients(places.clip(0.0, view.n), view.n, J) for places, heights in sums]
    return 0.5 * float(np.max(Bank(np.stack(rows)).scan(view, noise).snr ** 2))


def _shape(view: View, place: float) -> np.ndarray:
    return (np.arange(view.n) >= place).astype(float)


def _term(view: View, place: float, amplitude: float) -> terms.BiasStep:
    return terms.BiasStep(abs(amplitude), float(place / view.rate), sign=int(np.copysign(1.0, amplitude)))


def _parameters(
    view: View, places: np.ndarray, amplitude: float, std: float, likelihood: np.ndarray
) -> list[Estimate]:
    spacing = places[1] - places[0]
    place, spread, limit = shape_parameter(places, likelihood)
    # Only at the record's ends may a step lie beyond the end of a bank.
    if limit and (places[0] if limit == "below" else view.n - places[-1]) > 2.0 * spacing:
        (place, spread), limit = mean_and_std(places, likelihood), ""
    spread = np.hypot(spread, spacing / np.sqrt(12.0))
    return [
        view.estimate("time", place / view.rate, spread / view.rate, "s", limit),
        view.amplitude_estimate("amplitude", amplitude, std),
    ]


# Spacing of the shapes of the bank that are tried first.
_COARSER = 8


@dataclasses.dataclass(frozen=True, eq=False)
class Pair:
    """Most likely pair of shapes.

    Attributes:
        members: indices of the shapes in the bank.
        amplitude: amplitude of each, by generalized least squares.
        snr: signal-to-noise ratio of each given the other, with its sign.
        log_trials_factor: of the search for both [nats]: the best likelihood over the mean of all pairs.
    """

    members: tuple[int, int]
    amplitude: Float[np.ndarray, 2]
    snr: Float[np.ndarray, 2]
    log_trials_factor: float


def best_pair(bank: Bank, view: View, noise: Noise, near: tuple[int, int] | None = None) -> Pair:
    """Most likely pair of shapes: from every eighth shape first, then from all, each in turn given the other.

    Where the pair is known approximately, the search begins `near` it.
    """
    matched = bank.matched(view, noise)
    p = matched.products(matched.whitened)
    some = np.arange(_COARSER // 2, len(p), _COARSER)
    i, j = np.triu_indices(len(some), 1)
    coarse = _gains(matched.rows(some), p[some], i, j)
    if near is None:
        best = int(np.argmax(coarse))
        near = int(some[i[best]]), int(some[j[best]])
    first, _ = _best_given(matched, p, near[1])
    second, price = _best_given(matched, p, first)
    price += _best_given(matched, p, second)[1] - np.log(2.0)
    chosen, p = matched.rows(np.array([first, second])), p[[first, second]]
    covariance = np.linalg.pinv(chosen @ chosen.T)
    amplitude = covariance @ p
    # If both are located more sharply than the coarse pairs, the factor from single searches is better.
    among = 0.5 * float(p @ amplitude) - float(np.logaddexp.reduce(coarse)) + np.log(len(coarse))
    snr = amplitude / np.sqrt(np.diag(covariance))
    return Pair((first, second), amplitude, snr, min(price, float(among)))


def _gains(
    shapes: Float[np.ndarray, "shapes slow"],
    p: Float[np.ndarray, " shapes"],
    i: Int[np.ndarray, " pairs"],
    j: Int[np.ndarray, " pairs"],
) -> Float[np.ndarray, " pairs"]:
    """Gain in log-likelihood by each pair of whitened shapes, `p` being their products with the record."""
    gram = shapes @ shapes.T
    own = np.diag(gram)
    det = np.maximum(own[i] * own[j] - gram[i, j] ** 2, 1e-9 * own[i] * own[j])
    return 0.5 * (p[i] ** 2 * own[j] + p[j] ** 2 * own[i] - 2.0 * p[i] * p[j] * gram[i, j]) / det


def _best_given(matched: Matched, p: Float[np.ndarray, " shapes"], other: int) -> tuple[int, float]:
    """Most likely shape given another one, and its log trials factor [nats]; `p`: products with the data."""
    own = matched.lengths**2
    common = matched.products(matched.rows(np.array([other]))[0]) / own[other]
    left = np.maximum(own - common**2 * own[other], 0.0)
    clear = left > _CLEAR**2 * left.max()
    half = np.where(clear, 0.5 * (p - common * p[other]) ** 2 / np.where(clear, left, 1.0), 0.0)
    return int(np.argmax(half)), log_trials_factor(half)
