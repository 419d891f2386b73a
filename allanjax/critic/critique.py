"""The function `critique`."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from allanjax.base.cache import release_programs
from allanjax.critic.cause import Cause
from allanjax.critic.policy import FALSE_ALARMS
from allanjax.critic.result import Critique
from allanjax.estimate.result import Fit
from allanjax.record.io.given import RecordingLike, as_recording
from allanjax.record.io.options import GapChoice


def critique(
    recording: RecordingLike,
    fit: Fit | None = None,
    *,
    causes: Sequence[Cause] | None = None,
    false_alarms: float = FALSE_ALARMS,
    vibrating: bool = False,
    progress: Callable[[str], None] | None = None,
    rate: float | None = None,
    gyro_unit: str | None = None,
    accel_unit: str | None = None,
    names: Sequence[str] | None = None,
    gaps: GapChoice | None = None,
) -> Critique:
    """Say what a simulation of the fitted noise model gets wrong, why, and what mending it gains.

    Every axis is whitened by its model; each cause looks in the residuals for its own signature with the best
    filter for it. Competing explanations, among them other basic noise terms, are compared by their evidence.
    The best one is accepted if it is significant and predicts data that it was not estimated from; it is
    subtracted, and the search begins anew. Earlier findings are refitted conditional on it where that
    matters, and dropped where nothing is left of them. What disturbs the beginning and the end of the
    recording is left out, see `inspect`. See `allanjax.critic` for writing a cause of your own.

    Args:
        recording: what `read` returns, or what else `allanjax.fit` takes.
        fit: the baseline; by default `fit(recording)`. If its terms were given, basic terms that it lacks
            are causes too; if they were chosen, the choice is made anew with every finding.
        causes: what to look for; by default `allanjax.critic.causes.CAUSES`.
        false_alarms: probability that a recording without any effect has a finding; it is shared by its
            axes. Basic terms that a given model lacks come on top, as often again (`critic.policy`).
        vibrating: whether the platform is meant to move or vibrate: it is not tested for rest.
        progress: called with a text that says what is being done.
        rate, gyro_unit, accel_unit, names: needed for an array, see `allanjax.fit`.
        gaps: what to do about missing samples, as in `read`; of an array those that are nan.

    Raises:
        AllanjaxError: `fit` is of other axes; `false_alarms` is not between 0 and 1.
        FitError: a record of fewer than 1024 samples, or an axis without a fit.
    """
    # What it needs takes half a second to load.
    from threadpoolctl import threadpool_limits

    from allanjax.critic.causes import CAUSES
    from allanjax.critic.criticize import criticize

    recording = as_recording(recording, rate, gyro_unit, accel_unit, names, gaps)
    # Sooner than a fit would, so that it does not happen while axes are criticized.
    release_programs(0.5)
    causes, tell = CAUSES if causes is None else causes, progress or (lambda text: None)
    # Axes are criticized in parallel, with one BLAS thread each: idle BLAS threads spin and take the cores.
    with threadpool_limits(limits=1, user_api="blas"):
        return criticize(recording, fit, causes, false_alarms, vibrating, tell)
