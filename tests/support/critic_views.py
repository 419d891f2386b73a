"""A record as the critic's causes see it."""

import numpy as np

from allanjax.critic.noise import family_of
from allanjax.critic.view import EVERYTHING, View
from allanjax.record.recording import Axis

GYRO = Axis("gyro_x", "gyro", "rad/s")


def view_of(x, allowed=EVERYTHING, auxiliary=None, *, rate=50.0, axis=GYRO, kind=View):
    """A view of samples that nothing is known of: none are missing, and nothing has been found."""
    n = len(x)
    return kind(axis, 1.0, rate, x, x, None, auxiliary or {}, allowed, family_of(n, rate), np.zeros(n, bool))
