"""Small linear algebra against NumPy and SciPy."""

import jax
import numpy as np
from scipy.optimize import nnls

from allanjax.base.linalg import inverse, non_negative_least_squares, solve, whiten


def positive_definite(rng: np.random.Generator, m: int) -> np.ndarray:
    A = rng.standard_normal((m, 2 * m))
    return A @ A.T / m


def test_whitening_is_forward_substitution_with_the_cholesky_factor() -> None:
    rng = np.random.default_rng(1)
    C, X = positive_definite(rng, 30), rng.standard_normal((30, 4))
    L = np.linalg.cholesky(C)
    whitened = whiten(C, X)
    np.testing.assert_allclose(whitened.values, np.linalg.solve(L, X), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(2.0 * whitened.log_det, np.linalg.slogdet(C)[1], rtol=1e-12)


def test_whitening_of_an_indefinite_matrix_is_not_a_number() -> None:
    C = np.diag([1.0, -1.0, 1.0])
    assert np.isnan(np.asarray(whiten(C, np.ones((3, 1))).values)).any()


def test_inverse_and_solve_in_batches() -> None:
    rng = np.random.default_rng(2)
    C = np.stack([positive_definite(rng, 6) for _ in range(50)])
    b = rng.standard_normal((50, 6))
    np.testing.assert_allclose(jax.vmap(inverse)(C), np.linalg.inv(C), rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(
        jax.vmap(solve)(C, b), np.linalg.solve(C, b[..., None])[..., 0], rtol=1e-8, atol=1e-10
    )


def test_non_negative_least_squares_equals_scipy() -> None:
    rng = np.random.default_rng(3)
    A = rng.standard_normal((300, 12, 5)) + rng.standard_normal(
        (300, 12, 1)
    )  # columns that resemble each other
    A *= 10.0 ** rng.uniform(-6, 6, (300, 1, 5))
    b = rng.standard_normal((300, 12))
    allowed = rng.random((300, 5)) < 0.8
    found = np.asarray(jax.jit(jax.vmap(non_negative_least_squares))(A, b, allowed))
    expected = np.zeros_like(found)
    for k in range(300):
        if allowed[k].any():
            expected[k, allowed[k]] = nnls(A[k][:, allowed[k]], b[k])[0]
    scale = np.linalg.norm(A, axis=1)
    np.testing.assert_allclose(found * scale, expected * scale, atol=1e-8)
    # Some must end at the boundary, some inside, or the test shows nothing.
    assert 0.1 < np.mean(expected[allowed] == 0.0) < 0.9


def test_rows_beyond_those_asked_for_are_zero() -> None:
    rng = np.random.default_rng(4)
    C, X = positive_definite(rng, 5), rng.standard_normal((5, 2))
    few, whole = whiten(C, X, 3), whiten(C[:3, :3], X[:3])
    np.testing.assert_allclose(few.values[:3], whole.values, rtol=1e-12)
    np.testing.assert_array_equal(few.values[3:], 0.0)
    np.testing.assert_allclose(few.log_det, whole.log_det, rtol=1e-12)


def test_a_column_of_zeros_has_no_part_in_least_squares() -> None:
    rng = np.random.default_rng(5)
    A, b = rng.standard_normal((12, 3)), rng.standard_normal(12)
    with_nothing = np.insert(A, 1, 0.0, axis=1)
    found = non_negative_least_squares(with_nothing, b, np.array([True, False, True, True]))
    np.testing.assert_allclose(np.delete(found, 1), nnls(A, b)[0], rtol=1e-9, atol=1e-12)
    assert found[1] == 0.0
