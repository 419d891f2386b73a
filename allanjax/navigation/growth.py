"""Variance of the errors of a navigator at rest that integrates the noise of one sensor.

A level navigator that is started without error integrates a constant error once (attitude from a gyro,
velocity from an accelerometer), twice (position from an accelerometer; velocity from a gyro, times g) or
three times (position from a gyro, times g): W(t) = t, t²/2, t³/6 (Hou 2004, 2.38–2.40). With the Schuler
loop, ω² = g/R, it is sin(ωt)/ω, (1 − cos ωt)/ω², (ωt − sin ωt)/ω³; the vertical channel has −2g/R in the
place of ω², and grows exponentially.

That response to a bias is all that the errors need. The mean ε_k of the sensor's error over a sample interval
h acts from its beginning to its end, and the bias was taken to be the mean over a calibration of duration C
before the start. With the phase θ, the integral of the error,

    e(t) = Σ_k [W(t − kh) − W(t − kh − h)]/h · [θ(kh + h) − θ(kh)] − W(t)·[θ(0) − θ(−C)]/C,

a sum of phases whose weights annihilate constants and lines, so that its variance is the sum of products of
weights with the phase covariance G (`noise.process`), exactly, for any noise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from allanjax.navigation.likely import one_by_one
from allanjax.noise.model import Model

# Phase angle ωt below which the sine is taken by its series, and how many terms of it.
_SMALL, _TERMS = 1.0, 9


def bias_response(
    time: Float[np.ndarray, " t"], order: int, stiffness: float = 0.0
) -> Float[np.ndarray, " t"]:
    """Error W(t) [s^order] at times [s] that a unit constant error makes when integrated so many times.

    `stiffness` [1/s²] is ω² of the loop: 0 without it, g/R of Schuler's, −2g/R of the vertical channel.
    """
    x = stiffness * time**2
    series = np.zeros_like(time)
    for k in range(_TERMS, -1, -1):
        series = series * np.where(np.abs(x) < _SMALL, -x, 0.0) + 1.0 / math.factorial(2 * k + order)
    if np.all(np.abs(x) < _SMALL):
        return series * time**order
    w = math.sqrt(abs(stiffness))
    sine, cosine = (np.sin, np.cos) if stiffness > 0.0 else (np.sinh, np.cosh)
    far = (sine(w * time) / w, (1.0 - cosine(w * time)) / stiffness, (time - sine(w * time) / w) / stiffness)
    return np.where(np.abs(x) < _SMALL, series * time**order, far[order - 1])


class _Functional(NamedTuple):
    """An error as a sum of phases: products of weights by lag, weights, and that of the bias."""

    products: Float[np.ndarray, " lags"]
    weights: Float[np.ndarray, " phases"]
    bias: float


class ErrorVariances:
    """Variances of errors for the noise of any axis, whose common part is computed once."""

    def __init__(
        self,
        orders: Sequence[int],
        steps: Int[np.ndarray, " t"],
        calibration: int,
        rate: float,
        stiffness: float = 0.0,
    ) -> None:
        """Prepare the errors.

        Args:
            orders: how many times they are integrated: 1, 2 or 3.
            steps: numbers of samples since the start.
            calibration: number of samples before it over which the bias was averaged.
            rate: sample rate [Hz].
            stiffness: see `bias_response`.
        """
        self._orders, self._steps, self._rate = orders, steps, rate
        self._functionals = [
            [_functional(order, int(n), calibration, rate, stiffness) for n in steps] for order in orders
        ]
        whole = np.arange(steps.max() + 1)
        self._lags = np.concatenate([whole, whole + calibration]) / rate
        self._known: list[tuple[Model, np.ndarray]] = []
        #: Errors after the steps that a unit bias makes, by order.
        self.of_bias = np.array([bias_response(steps / rate, order, stiffness) for order in orders])

    def __call__(self, model: Model) -> Float[np.ndarray, "terms orders t"]:
        """Variances for each term of the model by itself."""
        found = [self._of_term(one) for one in one_by_one(model)]
        return np.stack(found) if found else np.zeros((0, len(self._orders), len(self._steps)))

    def _of_term(self, one: Model) -> Float[np.ndarray, "orders t"]:
        """Variances for a model of one term, which other axes and sets of terms may have, too."""
        for model, variance in self._known:
            if eqx.tree_equal(model, one):
                return variance
        # One call, for G is known up to a constant and t² that each call may choose.
        near, far = np.split(np.asarray(one.sampled(self._rate).phase_covariance(self._lags)), 2)
        variance = np.array([[_variance(f, near, far) for f in row] for row in self._functionals])
        self._known.append((one, variance))
        return variance


def _functional(order: int, n: int, calibration: int, rate: float, stiffness: float) -> _Functional:
    """The error after n samples."""
    response = bias_response(np.arange(n + 1) / rate, order, stiffness)
    of_samples = np.diff(response)[::-1] * rate
    weights = -np.diff(of_samples, prepend=0.0, append=0.0)
    bias = response[-1] * rate / calibration
    weights[0] -= bias
    size = 2 ** math.ceil(math.log2(2 * n + 2))
    products = np.fft.irfft(np.abs(np.fft.rfft(weights, size)) ** 2, size)[: n + 1]
    products[1:] *= 2.0
    return _Functional(products, weights, float(bias))


def _variance(f: _Functional, near: Float[np.ndarray, " lags"], far: Float[np.ndarray, " lags"]) -> float:
    """Variance of an error, from G at the lags of phases among each other and to the calibration's start."""
    n = len(f.weights)
    # Not `@`: BLAS would start threads for each of many short products.
    within = np.einsum("i,i", f.products, near[:n]) + f.bias**2 * near[0]
    return max(float(within + 2.0 * f.bias * np.einsum("i,i", f.weights, far[:n])), 0.0)
