"""Causes by users: waveforms that are known except for their amplitude and one parameter."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import ArrayLike, Float

from allanjax.critic.additive import additive, shape_parameter
from allanjax.critic.bank import SLOW, Bank
from allanjax.critic.cause import Cause
from allanjax.critic.noise import centred
from allanjax.critic.view import Candidate, View
from allanjax.noise.estimate import Estimate


class Template(Cause):
    """Waveform `amplitude`·`shape`(time, value), searched for at given values of its parameter.

        def sawtooth(time, period):
            return time / period % 1.0

        heater = Template("heater", sawtooth, np.geomspace(20.0, 60.0, 200), "period", "s")
        aj.critique(recording, causes=[*allanjax.critic.CAUSES, heater])

    The waveform must be slow: some thousand cosine coefficients have to describe it. Choose the values so
    densely that neighbouring waveforms have a correlation of at least 0.9.
    """

    refit = "at once"

    def __init__(
        self,
        name: str,
        shape: Callable[[Float[np.ndarray, " n"], float], Float[np.ndarray, " n"]],
        values: Float[ArrayLike, " shapes"] | Sequence[float],
        parameter: str,
        unit: str = "1",
    ) -> None:
        """Make a cause.

        Args:
            name: name of the cause.
            shape: function of times since the record's start [s] and a value that returns the waveform.
            values: values of the parameter to compare, increasing.
            parameter: name of the parameter.
            unit: unit of the parameter.
        """
        self.name, self.shape, self.parameter, self.unit = name, shape, parameter, unit
        self.values = np.asarray(values, float)

    def p_value(self, view: View) -> float:
        return self._bank(view.n, view.rate).p_value(view, view.noise)

    def detect(self, view: View) -> Candidate | None:
        time = (np.arange(view.n) + 0.5) / view.rate

        def parameters(k: int, a: float, std: float, likelihood: np.ndarray) -> list[Estimate]:
            amplitude = view.amplitude_estimate("amplitude", a, std)
            if len(self.values) == 1:
                return [amplitude]
            spacing = np.gradient(self.values)
            value, spread, limit = shape_parameter(self.values, likelihood, spacing)
            # It is known no better than the spacing of its values.
            spread = float(np.hypot(spread, np.interp(value, self.values, spacing) / np.sqrt(12.0)))
            return [amplitude, view.estimate(self.parameter, value, spread, self.unit, limit)]

        bank = self._bank(view.n, view.rate)
        return additive(view, self.name, bank, lambda k: self.shape(time, self.values[k]), parameters)

    @functools.lru_cache(maxsize=4)  # noqa: B019 - causes are few
    def _bank(self, n: int, rate: float) -> Bank:
        """The waveforms for all values."""
        time = (np.arange(n) + 0.5) / rate
        return Bank(np.stack([centred(self.shape(time, float(x)))[:SLOW] for x in self.values]))
