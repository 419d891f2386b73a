"""Covariance of the means of stretches of a record, from the phase covariance G(t) of its noise.

The mean over a stretch is the difference of the phase at its ends, over its length. So the covariance of two
means is a second difference of G, however far apart they are.

Noise that has a mean has it at zero: a bias is the level about which it scatters. Noise without one (flicker
noise, random walks, ramps) takes the bias with it: then the bias is the level averaged over the whole
calibration, and what counts is how far each mean is from that average.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from allanjax.base.errors import AllanjaxError
from allanjax.estimate.likely_models import likely_models
from allanjax.estimate.result import Fit
from allanjax.noise.model import Model
from allanjax.noise.process import Process
from allanjax.noise.terms import AngleRandomWalk
from allanjax.noise.terms.transient import Transient

_DRAWS = 400
# Of a stationary process the PSD is level at low frequencies, but grows fourfold in two octaves for flicker
# noise.
_GROWTH = 2.0
# Lag, in lengths of the record, at which G of a stationary process has no part that grows with its square.
_FAR = 1e6


class Part(NamedTuple):
    """A process, and the factor of its power."""

    power: float
    process: Process

    @property
    def white(self) -> bool:
        """Whether it is white noise, be it behind a filter."""
        return isinstance(getattr(self.process, "process", self.process), AngleRandomWalk)


def parts_of_model(model: Model, rate: float) -> tuple[Part, ...]:
    """The terms of a model at a sample rate [Hz].

    Raises:
        AllanjaxError: a parameter without a value; a step or a warm-up, which are no noise.
    """
    model.check_complete()
    for term in model.terms:
        if isinstance(term, Transient):
            raise AllanjaxError(f"{term.name()} is no noise: cut it off, and leave it out of the model")
    return tuple(Part(1.0, process) for process in model.sampled(rate).seen)


def parts_of_fit(fit: Fit, axis: str, seed: int = 0) -> tuple[Part, ...]:
    """The terms of an axis's fit, with their mean powers over its intervals and its likely sets of terms.

    Raises:
        AllanjaxError: the axis is not in the fit; a step or a warm-up.
        FitError: the axis has no result.
    """
    sets = likely_models(fit, axis, _DRAWS, np.random.default_rng(seed))
    found = []
    for likely in sets:
        parts = parts_of_model(likely.model, fit.curve.rate)
        known = len(parts) - likely.limited
        power = likely.power.sum(axis=0) / sum(len(s.power) for s in sets)
        found += [Part(float(p), part.process) for p, part in zip(power[:known], parts, strict=False)]
    return tuple(found)


def covariance_of_means(
    parts: Sequence[Part], start: Float[np.ndarray, " k"], length: Float[np.ndarray, " k"]
) -> Float[np.ndarray, "k k"]:
    """Covariance [rate²] of the noise of means over stretches with these starts and lengths [s].

    Of processes that are not stationary it is that of the deviations from the mean over all of the time.
    """
    begin, end = start.min(), (start + length).max()
    # The last stretch is all of the time.
    edges = np.stack([np.append(start, begin), np.append(start + length, end)])
    size = edges[1] - edges[0]
    total = np.zeros((len(start), len(start)))
    for power, process in parts:
        # All lags and the far one in one call, since G is known up to c0 + c1·t² that each call may choose.
        lags = np.abs(edges[:, None, :, None] - edges[None, :, None, :])
        far = _FAR * (end - begin)
        G = np.asarray(process.phase_covariance(np.append(lags.ravel(), far)))  # type: ignore[arg-type]
        stationary = _is_stationary(process, end - begin)
        curvature = G[-1] / far**2 if stationary else 0.0
        at = G[:-1].reshape(lags.shape) - curvature * lags**2
        C = (at[0, 0] + at[1, 1] - at[0, 1] - at[1, 0]) / np.outer(size, size)
        if not stationary:
            C = C - C[:, -1:] - C[-1:, :] + C[-1, -1]
        total += power * C[:-1, :-1]
    return total


def white_covariance(parts: Sequence[Part], length: Float[np.ndarray, " k"]) -> Float[np.ndarray, "k k"]:
    """The part of the white noise in `covariance_of_means` [rate²]: N²/T on the diagonal."""
    white = [part for part in parts if part.white]
    return covariance_of_means(white, np.zeros(len(length)), length) * np.eye(len(length))


def _is_stationary(process: Process, duration: float) -> bool:
    """Whether the process has a mean: its PSD does not grow towards frequency zero."""
    f = 1e-5 / duration
    low, high = np.asarray(process.psd(np.array([f / 4.0, f])))
    return not low > _GROWTH * high
