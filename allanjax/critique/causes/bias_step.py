"""The bias jumps, once."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from allanjax import terms
from allanjax.critique.bank import Bank, step_bank, step_coefficients
from allanjax.critique.causes.additive import additive, mean_and_std
from allanjax.critique.view import Candidate, Cause, Quantity, View

_FINER = 64


class BiasStep(Cause):
    """A jump of the bias; several are found one after the other."""

    name = "bias_step"

    def detect(self, view: View) -> Candidate | None:
        bank, places = step_bank(view.n)
        found = self._in(view, bank, places, 0.0)
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
            refined = self._in(view, finer, fine, float(np.log(len(places) * spacing / np.ptp(fine))))
            if refined is not None and refined.gain > found.gain:
                return Candidate(**{**vars(refined), "p_value": found.p_value, "held_out": found.held_out})
        return found

    def p_value(self, view: View) -> float:
        return step_bank(view.n)[0].p_value(view, view.noise)

    def _in(self, view: View, bank: Bank, places: np.ndarray, more: float) -> Candidate | None:
        def parameters(k: int, a: float, std: float, likelihood: np.ndarray) -> Mapping[str, Quantity]:
            place, spread = mean_and_std(places, likelihood)
            spread = np.hypot(spread, (places[1] - places[0]) / np.sqrt(12.0))
            return {
                "time": Quantity(place / view.rate, float(spread) / view.rate, "s"),
                "amplitude": view.own(a, std),
            }

        return additive(
            view,
            self.name,
            bank,
            lambda k: (np.arange(view.n) >= places[k]).astype(float),
            parameters,
            lambda k: (places[k] / view.rate, view.duration),
            more,
            lambda k, a: terms.BiasStep(abs(a), float(places[k] / view.rate)),
        )
