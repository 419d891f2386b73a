"""The least Allan deviation of a fitted axis, which data sheets call bias instability."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from allanjax.estimate.result import AxisFit, Fit
from allanjax.noise.datasheet import LEAST
from allanjax.noise.estimate import Estimate
from allanjax.record.units import default_coefficient_unit

# Draws of the least deviation, cluster times at which it is sought, and how far a model is extrapolated.
_DRAWS, _TIMES, _FAR = 2000, 100, 1e6


def least_deviation(fit: Fit, of: AxisFit) -> tuple[Estimate, Estimate]:
    """Least Allan deviation within the record, with the draws of the likely models.

    Its upper end is no lower than with terms that are not detected anywhere below their limits. Where the
    model fits, they are within what the measured curve allows. If the stated curve is least at the end of the
    record, it is an upper limit only, and the second estimate is the least of the models extrapolated, unless
    that is zero.
    """
    time, name = _times(fit), of.axis.name
    stated = fit.model_deviation(name, time)
    # The odds of undecided sets depend on what is usual: hence also all terms anywhere below their limits.
    likely = fit.stated(name)
    alone = dataclasses.replace(likely, ranking=None)
    drawn = np.stack([likely.drawn(time, _DRAWS), alone.drawn(time, _DRAWS)])

    def estimate(to: int, detected: bool) -> Estimate:
        draws = drawn[..., :to].min(axis=-1)
        # Terms that are not detected may raise the least, and need not.
        low, low_68 = np.quantile(draws, [0.025, 0.16], axis=-1).min(axis=-1).tolist()
        high_68, high, most = np.quantile(draws, [0.84, 0.975, 0.95], axis=-1).max(axis=-1).tolist()
        value = float(np.median(draws))
        found = Estimate(
            axis=of.axis,
            label=LEAST,
            value=value,
            std=(high_68 - low_68) / 2.0,
            interval=(low, high),
            interval_68=(low_68, high_68),
            usual_unit=default_coefficient_unit(of.axis.sensor, 0.0),
            upper_limit=None if detected else most,
            detected=detected,
        )
        return found.without_interval() if detected and not fit.curve.determined else found

    if int(np.argmin(stated[:_TIMES])) < _TIMES - 1:
        return (estimate(_TIMES, True),) * 2
    return estimate(_TIMES, False), estimate(2 * _TIMES, bool(stated.min() > 1e-3 * stated[_TIMES - 1]))


def _times(fit: Fit) -> Float[np.ndarray, " t"]:
    """Cluster times [s] within the record, and then as many beyond it."""
    first, last = (float(fit.curve.cluster_time[k]) for k in (0, -1))
    return np.append(np.geomspace(first, last, _TIMES), last * np.geomspace(2.0, _FAR, _TIMES))
