"""NumPy or JAX as needed, so that mere evaluation compiles nothing; and random seeds derived from data."""

import sys
from types import ModuleType
from typing import Any
from zlib import crc32

import numpy as np
from jaxtyping import Float


def namespace(*values: Any) -> ModuleType:
    """`jax.numpy` if a value is or contains a JAX array, traced or not; otherwise `numpy`."""
    # JAX takes long to load, and without it there are no arrays of it.
    if "jax" not in sys.modules:
        return np
    import jax

    return jax.numpy if any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(values)) else np


def as_array(x: Any, *others: Any) -> tuple[ModuleType, Any]:
    """Namespace of x and other values, see `namespace`, and x as an array of floats in it."""
    xp = namespace(x, *others)
    return xp, xp.asarray(x, float)


def special_functions(xp: ModuleType) -> ModuleType:
    """Module of special functions, such as `gammaln`, for the arrays of a namespace."""
    if xp is np:
        from scipy import special
    else:
        from jax.scipy import special
    return special


# Number of levels to which values are rounded. The irrational factor keeps quantized outputs from falling
# halfway between two levels.
_LEVELS = 1e3 * np.sqrt(3.0)


def seed_of(values: Float[np.ndarray, " n"]) -> int:
    """Seed that depends on the values, but not on their unit or their last bits."""
    levels = np.rint((values - values.min()) / max(np.ptp(values), 1e-300) * _LEVELS)
    return crc32(levels.astype("<i4").tobytes())
