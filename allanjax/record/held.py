"""Channels that were rounded, or read less often than the rest of a recording."""

import numpy as np
from jaxtyping import Float

# Share of samples that differ from the one before, up to which a channel holds its values.
_HELD = 0.5
# Jumps are multiples of a rounding step if they are so within this share of it.
_WHOLE = 1e-6


def between_changes(channel: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Values of a channel that holds them, such as a rounded temperature, with a curve in place of steps.

    A slow quantity passes the middle of a rounding step when its rounded value changes, and a value that is
    read now and then is right when it changes. A curve through these points follows the quantity some ten
    times more closely than the steps do, whose remainder would pass for slow noise. A
    channel that changes with most samples is returned as it is.
    """
    from scipy.interpolate import Akima1DInterpolator

    changes = np.flatnonzero(np.diff(channel))
    if not 2 < len(changes) < _HELD * len(channel):
        return channel
    before, after = channel[changes], channel[changes + 1]
    jumps = np.abs(after - before) / np.abs(after - before).min()
    rounded = np.allclose(jumps, np.round(jumps), rtol=0.0, atol=_WHOLE)
    known = changes + 0.5 if rounded else changes + 1.0
    curve = Akima1DInterpolator(known, 0.5 * (before + after) if rounded else after)
    return curve(np.clip(np.arange(len(channel)), known[0], known[-1]))
