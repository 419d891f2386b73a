"""What `jaxtyping` checks while the tests run: arrays have the shapes that annotations say.

Of the annotations with a shape only. Whether an array is NumPy's or JAX's makes no difference: what takes one
takes the other, and a number of NumPy's is an array without dimensions. A length such as `n-1` is compared
with other lengths `n-1`, not with `n`, which need not be among the arguments.
"""

import functools
import operator
import re
import types
from collections.abc import Callable
from typing import Any, Literal, TypeVar, Union, get_args, get_origin

import jax
import numpy as np
from beartype import BeartypeConf, beartype
from jaxtyping import AbstractArray

# Whole numbers are numbers, too.
_checked = beartype(conf=BeartypeConf(is_pep484_tower=True))
_F = TypeVar("_F", bound=Callable[..., Any])


def check_shapes(function: _F) -> _F:
    """The function, which raises if an argument or a result has not the shape that it is annotated with."""
    hints = {name: _shape(hint) for name, hint in function.__annotations__.items()}
    function.__annotations__ = hints
    return _checked(function) if any(hint is not Any for hint in hints.values()) else function


def _shape(hint: Any) -> Any:
    """What of an annotation is checked; Any if it has no shape."""
    if isinstance(hint, type) and issubclass(hint, AbstractArray):
        lengths = " ".join(map(_length, hint.dim_str.split()))
        arrays = hint.dtype[jax.Array | np.ndarray | np.generic, lengths]
        return arrays if hint.array_type in (jax.Array, np.ndarray) else hint
    of, parts = get_origin(hint), get_args(hint)
    shapes = tuple(map(_shape, parts))
    if all(shape is Any for shape in shapes):
        return Any
    # A text that is none of those allowed is for the function to refuse.
    others = (str if get_origin(part) is Literal else part for part in parts)
    kept = [part if shape is Any else shape for part, shape in zip(others, shapes, strict=True)]
    return functools.reduce(operator.or_, kept) if of in (Union, types.UnionType) else of[tuple(kept)]


def _length(text: str) -> str:
    """A length that is computed becomes one with a name of its own."""
    return f"computed_{text.translate(_SIGNS)}" if re.search(r"\w[-+*/]", text) else text


_SIGNS = str.maketrans({"-": "_minus_", "+": "_plus_", "*": "_times_", "/": "_over_"})
