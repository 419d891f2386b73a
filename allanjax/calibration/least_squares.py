"""Generalized least squares of means on the parameters of a calibration, and which ones they determine."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from allanjax.base.errors import FitError

# Least singular value, relative to the largest, of a direction that the positions determine: for known
# orientations, beyond rounding; for estimated ones, beyond what errors of scale and alignment may simulate.
KNOWN, FREE = 1e-6, 2e-2
# Part of a parameter in undetermined directions above which it counts as undetermined itself.
_PART = 1e-6
_ITERATIONS = 50


class Solution(NamedTuple):
    """Parameters with their covariance.

    Attributes:
        values: the parameters; meaningless where not determined.
        covariance: covariance of the parameters.
        determined: which of them the observations determine.
        residuals: observations less fitted values.
        residual_covariance: covariance of the residuals.
        weight: Q with residuals'·Q·residuals = χ².
        dof: observations less determined directions.
    """

    values: Float[np.ndarray, " p"]
    covariance: Float[np.ndarray, "p p"]
    determined: Bool[np.ndarray, " p"]
    residuals: Float[np.ndarray, " m"]
    residual_covariance: Float[np.ndarray, "m m"]
    weight: Float[np.ndarray, "m m"]
    dof: int

    @property
    def chi2(self) -> float:
        """Sum of the weighted squares of the residuals."""
        return float(self.residuals @ self.weight @ self.residuals)

    def gain_without(self, rows: Bool[np.ndarray, " m"]) -> float:
        """How much χ² falls if these observations are left out."""
        pull, Q = (self.weight @ self.residuals)[rows], self.weight[np.ix_(rows, rows)]
        return float(pull @ np.linalg.pinv(Q, 1e-9, hermitian=True) @ pull)


def determined_directions(X: Float[np.ndarray, "m p"], tolerance: float) -> Float[np.ndarray, "r p"]:
    """Orthonormal directions of the parameters that the rows of X, in equal units, determine."""
    _, size, directions = np.linalg.svd(X, full_matrices=False)
    return directions[size > tolerance * size.max(initial=1e-300)]


def is_determined(directions: Float[np.ndarray, "r p"]) -> Bool[np.ndarray, " p"]:
    """Which parameters lie entirely in these directions."""
    return 1.0 - (directions**2).sum(axis=0) < _PART


def least_squares(
    X: Float[np.ndarray, "m p"],
    y: Float[np.ndarray, " m"],
    C: Float[np.ndarray, "m m"],
    unit: Float[np.ndarray, " p"],
    bias: Bool[np.ndarray, " p"],
    tolerance: float = KNOWN,
) -> Solution:
    """Parameters β of y = Xβ + e with the least variance, for noise e of covariance C.

    Args:
        X: the design.
        y: observations.
        C: their covariance; may be singular along the columns of biases.
        unit: size of each column of X, by which it is divided.
        bias: which parameters are biases: adding their columns to C does not change the estimate.
        tolerance: see `determined_directions`.

    Raises:
        FitError: C is singular in other directions than those of biases: the model has too little noise.
    """
    V = determined_directions(X / unit, tolerance)
    Z = X / unit @ V.T
    level = X[:, bias]
    try:
        inverse = np.linalg.inv(np.linalg.cholesky(C + C.diagonal().max() * level @ level.T))
    except np.linalg.LinAlgError as error:
        raise FitError(
            "some combination of the means has no noise under the noise model: add white noise (N) to it"
        ) from error
    P = inverse.T @ inverse
    estimator = np.linalg.solve(Z.T @ P @ Z, Z.T @ P)
    W = V.T @ estimator / unit[:, None]
    left = np.eye(len(y)) - Z @ estimator
    return Solution(
        values=W @ y,
        covariance=W @ C @ W.T,
        determined=is_determined(V),
        residuals=left @ y,
        residual_covariance=left @ C @ left.T,
        weight=left.T @ P @ left,
        dof=len(y) - len(V),
    )


class Triad(NamedTuple):
    """Errors of three axes: I = M·f + b + q·f² + e, by axis (2.22, 2.23)."""

    M: Float[np.ndarray, "3 3"]
    b: Float[np.ndarray, 3]
    q: Float[np.ndarray, 3]

    def inputs(self, readings: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """The inputs f that give these readings."""
        inverse = np.linalg.inv(self.M).T
        f = (readings - self.b) @ inverse
        if self.q.any():
            # Each round gains as many digits as the second-order part is small.
            for _ in range(8):
                f = (readings - self.b - self.q * f**2) @ inverse
        return f


def by_norm(
    readings: Float[np.ndarray, "k 3"],
    noise: Float[np.ndarray, "3 k k"],
    g: Float[np.ndarray, " k"],
    unit: Float[np.ndarray, "3 p"],
) -> Solution:
    """Errors of three axes from positions of unknown orientation: the norm of the inputs is g.

    The axes of reference are those of the sensor: the first is the sensor's x, and the sensor's y is in the
    plane of the first two. So the misalignments of x towards y and z and of y towards z are zero.

    Args:
        readings: means of the three axes in each position [m/s²].
        noise: covariance of the means of each axis.
        g: gravity in each position [m/s²].
        unit: see `least_squares`; the parameters of each axis: bias, row of M − 1, and, perhaps, q.

    Raises:
        FitError: no convergence, because the readings are not those of a triad at rest.
    """
    p = unit.shape[1]
    free = np.array([[True, *(j <= i for j in range(3)), *(True for _ in range(p - 4))] for i in range(3)])
    bias = np.zeros((3, p), bool)
    bias[:, 0] = True
    values = np.zeros((3, p))
    for _ in range(_ITERATIONS):
        M, b, q = np.eye(3) + values[:, 1:4], values[:, 0], values[:, 4] if p > 4 else np.zeros(3)
        f = Triad(M, b, q).inputs(readings)
        size = np.linalg.norm(f, axis=1)
        # How the norm of the inputs depends on each reading.
        slopes = [M + np.diag(2.0 * q * x) for x in f]
        n = np.stack([np.linalg.solve(D.T, x / s) for D, x, s in zip(slopes, f, size, strict=True)])
        columns = np.concatenate([np.ones((len(f), 1)), f], axis=1)
        rows = n[:, :, None] * np.repeat(columns[:, None, :], 3, axis=1)
        if p > 4:
            rows = np.concatenate([rows, (n * f**2)[:, :, None]], axis=2)
        C = np.einsum("ki,li,ikl->kl", n, n, noise)
        solution = least_squares(rows[:, free], size - g, C, unit[free], bias[free], FREE)
        values[free] += solution.values
        if np.all(np.abs(solution.values * unit[free]) < 1e-9 * g.mean()):
            break
        if not np.all(np.abs(values * unit) < g.mean()):
            values[:] = np.nan
            break
    else:
        values[:] = np.nan
    if not np.isfinite(values).all():
        raise FitError(
            "the orientations could not be estimated: check the unit and that each position is different and "
            "at rest, or give the orientations"
        )
    covariance, determined = np.zeros((3 * p, 3 * p)), np.ones(3 * p, bool)
    covariance[np.ix_(free.ravel(), free.ravel())] = solution.covariance
    determined[free.ravel()] = solution.determined
    return solution._replace(values=values.ravel(), covariance=covariance, determined=determined)
