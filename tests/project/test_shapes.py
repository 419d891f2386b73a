"""While the tests run, arrays are checked against the shapes that annotations say."""

import jax
import numpy as np
import pytest
from jaxtyping import Array, Float, TypeCheckError, jaxtyped
from shape_checks import check_shapes

from allanjax.base.linalg import whiten


def test_functions_of_the_package_are_checked():
    with pytest.raises(TypeCheckError, match=r"allanjax.base.linalg.whiten"):
        whiten(np.eye(3), np.ones((4, 1)))


@jaxtyped(typechecker=check_shapes)
def without_ends(
    name: str, x: Float[Array, " n"], y: Float[np.ndarray, " n-2"] | None = None
) -> Float[Array, " n-2"]:
    return x[1:-1]


@pytest.mark.parametrize("array", [np.ones, jax.numpy.ones])
def test_libraries_and_other_annotations_make_no_difference(array):
    for y in (None, np.ones(3), jax.numpy.ones(3)):
        assert len(without_ends(3, array(5), y)) == 3


@jaxtyped(typechecker=check_shapes)
def length(times: list[float] | Float[np.ndarray, " n"]) -> int:
    return len(times)


def test_whole_numbers_are_numbers():
    assert length([1, 2]) == length(np.ones(2)) == 2


@jaxtyped(typechecker=check_shapes)
def total(x: Float[np.ndarray, " n"]) -> Float[np.ndarray, ""]:
    return x.sum()


def test_a_number_is_an_array_without_dimensions():
    assert total(np.ones(3)) == 3.0
    with pytest.raises(TypeCheckError):
        total(np.float64(3.0))


@pytest.mark.parametrize(
    ("x", "y"),
    [
        (np.ones((5, 1)), None),
        (np.ones(5, int), None),
        (np.ones(5), np.ones(4)),
        (np.ones(5), np.ones((3, 1))),
    ],
    ids=["two dimensions", "whole numbers", "another length", "two dimensions of a length that is computed"],
)
def test_another_shape_is_noticed(x, y):
    with pytest.raises(TypeCheckError):
        without_ends("", x, y)
