"""NumPy or JAX, so that what is only evaluated compiles nothing; and seeds of draws that belong to data."""

from types import ModuleType
from typing import Any
from zlib import crc32

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float


def namespace(*values: Any) -> ModuleType:
    """`jax.numpy` if a value is an array of JAX, traced or not, or contains one; else `numpy`."""
    return jnp if any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(values)) else np


def special_functions(xp: ModuleType) -> ModuleType:
    """Special functions, `gammaln` and others, for the arrays of a namespace."""
    if xp is np:
        from scipy import special
    else:
        from jax.scipy import special
    return special


# Levels in the range of the values to which they are rounded. Its irrational factor keeps the steps of an
# output from falling halfway between two levels.
_LEVELS = 1e3 * np.sqrt(3.0)


def seed_of(values: Float[np.ndarray, " n"]) -> int:
    """Seed that depends on the values, but neither on their unit nor on their last bits."""
    levels = np.rint((values - values.min()) / max(np.ptp(values), 1e-300) * _LEVELS)
    return crc32(levels.astype("<i4").tobytes())
