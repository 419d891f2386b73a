"""NumPy for what is NumPy's and JAX for what is JAX's, so that what is only evaluated compiles nothing."""

from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


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
