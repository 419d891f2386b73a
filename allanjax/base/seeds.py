"""Seeds of random draws that belong to data: the same data are always given the same draws."""

from zlib import crc32

import numpy as np
from jaxtyping import Float

# Levels in the range of the values to which they are rounded. Its irrational factor keeps the steps of an
# output from falling halfway between two levels.
_LEVELS = 1e3 * np.sqrt(3.0)


def seed_of(values: Float[np.ndarray, " n"]) -> int:
    """Seed that depends on the values, but neither on their unit nor on their last bits."""
    levels = np.rint((values - values.min()) / max(np.ptp(values), 1e-300) * _LEVELS)
    return crc32(levels.astype("<i4").tobytes())
