"""The bias jumps, once or several times."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np

from allanjax import terms
from allanjax.critique.bank import Bank, Scan, amplitude_price, step_bank, step_coefficients
from allanjax.critique.causes.additive import adding, additive, mean_and_std
from allanjax.critique.noise import Noise
from allanjax.critique.view import Candidate, Cause, Quantity, View

_FINER = 64
# Of pairs: places in the bank between two that are tried, and rounds in which they are moved.
_COARSER, _ROUNDS = 8, 3
# A step beside another one is looked at where so much of the most that can be is left of it.
_CLEAR = 0.1


class BiasStep(Cause):
    """A jump of the bias; several are found one after the other, or two that hide each other at once."""

    name = "bias_step"
    margin = 2.0

    def detect(self, view: View) -> Candidate | None:
        bank, places = step_bank(view.n)
        found = self._one(view, bank, places, 0.0)
        if found is None or found.gain < self.margin:
            both = self._two(view, bank, places)
            if both is not None and (found is None or both.gain > found.gain):
                return both
        if found is None:
            return None
        # Strong steps are located more finely than the bank is.
        time = found.parameters["time"]
        k = float(np.asarray(time.value)) * view.rate
        spacing = places[1] - places[0]
        if spacing > 1.0 and time.std * view.rate < spacing:
            fine = np.unique(np.rint(k + np.linspace(-2.0, 2.0, _FINER) * spacing).clip(1, view.n - 1))
            J = min(8 * bank.shapes.shape[1], view.n - 1)
            finer = Bank(step_coefficients(fine, view.n, J))
            refined = self._one(view, finer, fine, float(np.log(len(places) * spacing / np.ptp(fine))))
            if refined is not None and refined.gain > found.gain:
                return Candidate(**{**vars(refined), "p_value": found.p_value, "held_out": found.held_out})
        return found

    def p_value(self, view: View) -> float:
        return step_bank(view.n)[0].p_value(view, view.noise)

    def _one(self, view: View, bank: Bank, places: np.ndarray, more: float) -> Candidate | None:
        return additive(
            view,
            self.name,
            bank,
            lambda k: _shape(view, places[k]),
            lambda k, a, std, likelihood: _parameters(view, places, a, std, likelihood),
            lambda k: (places[k] / view.rate, view.duration),
            more,
            lambda k, a: _term(view, places[k], a),
        )

    def _two(self, view: View, bank: Bank, places: np.ndarray) -> Candidate | None:
        """Two steps that are nothing without each other: there and back, or one on top of the other."""
        best: Candidate | None = None
        for noise in view.noises:
            pair = _best_pair(bank, view, noise)
            for _ in range(_ROUNDS):
                before = pair
                # Each in turn where it fits best, the other as large as it is then.
                scans = [_beside(bank, view, noise, pair[1])]
                scans.append(_beside(bank, view, noise, scans[0].best))
                pair = scans[0].best, scans[1].best
                a = _amplitudes(bank, view, noise, pair)
                steps = [size * _shape(view, places[k]) for k, size in zip(pair, a, strict=True)]
                after = view.with_x(view.x - steps[0] - steps[1])
                noise = after.noise
                if pair == before:
                    break
            gain = noise.log_evidence - view.noise.log_evidence - _price(bank, view, noise, pair)
            gain -= sum(amplitude_price(float(scan.snr[scan.best])) for scan in scans)
            if pair[0] != pair[1] and (best is None or gain > best.gain):
                best = self._as_candidate(view, after, bank, places, pair, a, steps, gain)
        return best

    def _as_candidate(
        self,
        view: View,
        after: View,
        bank: Bank,
        places: np.ndarray,
        pair: tuple[int, int],
        amplitudes: np.ndarray,
        steps: list[np.ndarray],
        gain: float,
    ) -> Candidate:
        parts, left = [], view
        for k, a, own, other in zip(pair, amplitudes, steps, steps[::-1], strict=True):
            alone = view.with_x(view.x - other)
            scan = bank.scan(alone, after.noise)
            half = 0.5 * scan.snr**2
            left = left.with_x(left.x - own)
            part = Candidate(
                self.name,
                _parameters(view, places, float(a), float(scan.std[k]), np.exp(half - half.max())),
                after.noise.log_evidence - alone.noise.log_evidence - scan.search_price,
                bank.p_value(alone, after.noise, float(scan.snr[k])) if gain > 0.0 else 1.0,
                left,
                partial(bank.held_out, alone, after.noise),
                (places[k] / view.rate, view.duration),
                "time",
                adding(_term(view, places[k], float(a))),
            )
            parts.append(part)
        return Candidate(
            self.name,
            parts[0].parameters,
            gain,
            max(part.p_value for part in parts),
            after,
            lambda: min(part.held_out() for part in parts),
            (float(min(part.span[0] for part in parts)), view.duration),
            "time",
            parts=tuple(parts),
        )


def _shape(view: View, place: float) -> np.ndarray:
    return (np.arange(view.n) >= place).astype(float)


def _term(view: View, place: float, amplitude: float) -> terms.BiasStep:
    return terms.BiasStep(abs(amplitude), float(place / view.rate))


def _parameters(
    view: View, places: np.ndarray, amplitude: float, std: float, likelihood: np.ndarray
) -> Mapping[str, Quantity]:
    place, spread = mean_and_std(places, likelihood)
    spread = np.hypot(spread, (places[1] - places[0]) / np.sqrt(12.0))
    return {
        "time": Quantity(place / view.rate, float(spread) / view.rate, "s"),
        "amplitude": view.own(amplitude, std),
    }


def _best_pair(bank: Bank, view: View, noise: Noise) -> tuple[int, int]:
    """The two places of a coarse bank that explain most together."""
    some = np.arange(_COARSER // 2, len(bank.shapes), _COARSER)
    i, j = np.triu_indices(len(some), 1)
    best = int(np.argmax(_gains(bank, view, noise, some[i], some[j])))
    return int(some[i[best]]), int(some[j[best]])


def _price(bank: Bank, view: View, noise: Noise, pair: tuple[int, int]) -> float:
    """What not knowing the places costs [nats]: the best likelihood over the mean of all pairs."""
    some = np.arange(_COARSER // 2, len(bank.shapes), _COARSER)
    i, j = np.triu_indices(len(some), 1)
    every = _gains(bank, view, noise, np.append(some[i], pair[0]), np.append(some[j], pair[1]))
    return float(every[-1] - np.logaddexp.reduce(every[:-1]) + np.log(len(every) - 1))


def _gains(bank: Bank, view: View, noise: Noise, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Log-likelihood gained by each pair of steps."""
    shapes, e = bank.whitened(view, noise)
    used, where = np.unique(np.concatenate([first, second]), return_inverse=True)
    i, j = where[: len(first)], where[len(first) :]
    gram, p = shapes[used] @ shapes[used].T, shapes[used] @ e
    own = np.diag(gram)
    det = np.maximum(own[i] * own[j] - gram[i, j] ** 2, 1e-9 * own[i] * own[j])
    return 0.5 * (p[i] ** 2 * own[j] + p[j] ** 2 * own[i] - 2.0 * p[i] * p[j] * gram[i, j]) / det


def _beside(bank: Bank, view: View, noise: Noise, other: int) -> Scan:
    """Every step's matched filter where another step may be of any size."""
    shapes, e = bank.whitened(view, noise)
    unit = shapes[other] / np.linalg.norm(shapes[other])
    shapes, e = shapes - np.outer(shapes @ unit, unit), e - (e @ unit) * unit
    # A step next to the other one is nearly nothing beside it.
    norms = np.maximum(np.linalg.norm(shapes, axis=1), 1e-300)
    clear = norms > _CLEAR * norms.max()
    snr = np.where(clear, shapes @ e / norms, 0.0)
    return Scan(snr, snr / norms, 1.0 / norms)


def _amplitudes(bank: Bank, view: View, noise: Noise, pair: tuple[int, int]) -> np.ndarray:
    shapes, e = bank.whitened(view, noise)
    return np.linalg.lstsq(shapes[list(pair)].T, e, rcond=None)[0]
