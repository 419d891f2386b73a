"""The function `critique`."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from allanjax.base.cache import release_programs
from allanjax.critic.effect import Effect
from allanjax.critic.policy import FALSE_ALARMS
from allanjax.critic.result import Critique
from allanjax.estimate.result import Fit
from allanjax.record.io.given import RecordingLike, as_recording
from allanjax.record.io.options import GapChoice


def critique(
    recording: RecordingLike,
    fit: Fit | None = None,
    *,
    effects: Sequence[Effect] | None = None,
    false_alarms: float = FALSE_ALARMS,
    vibrating: bool = False,
    progress: Callable[[str], None] | None = None,
    rate: float | None = None,
    gyro_unit: str | None = None,
    accel_unit: str | None = None,
    names: Sequence[str] | None = None,
    gaps: GapChoice | None = None,
) -> Critique:
    """Find out what a simulation of the fitted noise model gets wrong, why, and how much a correction gains.

    The first extension of the plain noise model is what the fit has found besides its terms: a filter,
    resonances and lines. Every axis is then whitened by its model, and each cause searches the residuals for
    its signature with the best filter for it. Competing explanations, including other basic noise terms, are
    compared by their evidence. The best one is accepted if it is significant and predicts data from which it
    was not estimated; it is subtracted, and the search starts again. Earlier findings are refitted if the new
    one affects them, and dropped if nothing remains of them. At last each finding is told by what it alone
    changes (`Finding.change`): what the sensor is, and what happened. Disturbed parts at the beginning and
    the end of the recording are left out, see `inspect`. See `allanjax.critic` for your own effects.

    Args:
        recording: a recording from `read`, or anything else that `allanjax.fit` accepts.
        fit: the fit from which the critique starts; by default `fit(recording)`. If its terms were given,
            basic terms that it lacks are effects, too; if they were chosen, they are chosen again with every
            finding.
        effects: effects to look for; by default `allanjax.critic.effects.EFFECTS`.
        false_alarms: probability of any finding in a recording without an effect, shared by its axes. Basic
            terms that a given model lacks have the same probability in addition (`critic.search`).
        vibrating: whether the platform is meant to move or vibrate; the test for rest is then skipped.
        progress: called with a text that describes the current step.
        rate, gyro_unit, accel_unit, names: needed for an array, see `allanjax.fit`.
        gaps: how to treat missing samples, as in `read`; in an array these are the nan.

    Returns:
        The critique; `print` shows its findings, and `details()` all that it reports.

    Raises:
        AllanjaxError: `fit` has other axes; `false_alarms` is not between 0 and 1.
        FitError: the record has fewer than 1024 samples, or the fit of an axis failed.
    """
    # Its imports take half a second.
    from threadpoolctl import threadpool_limits

    from allanjax.critic.criticize import criticize
    from allanjax.critic.effects import EFFECTS

    recording = as_recording(recording, rate, gyro_unit, accel_unit, names, gaps)
    # Earlier than in a fit, so that it does not happen while axes are processed.
    release_programs(0.5)
    effects, tell = EFFECTS if effects is None else effects, progress or (lambda text: None)
    # Axes are processed in parallel with one BLAS thread each, as idle BLAS threads spin and occupy cores.
    with threadpool_limits(limits=1, user_api="blas"):
        return criticize(recording, fit, effects, false_alarms, vibrating, tell)
