"""Sensors at rest in several orientations, by NumPy from (2.22) and (2.23), and their dense least squares."""

from typing import NamedTuple

import numpy as np

import allanjax as aj

G = 9.8118
#: The six positions: which axis points up or down, and the upward direction.
SIX = {f"{a} {way}": s * np.eye(3)[i] for i, a in enumerate("xyz") for way, s in (("up", 1), ("down", -1))}
_DIAGONALS = np.array([[1, 1, 0], [1, 0, 1], [0, 1, 1], [1, -1, 0], [1, 0, -1], [0, 1, -1]]) / np.sqrt(2.0)
#: The six, and twelve between them.
EIGHTEEN = np.concatenate([np.stack(list(SIX.values())), _DIAGONALS, -_DIAGONALS])


class Errors(NamedTuple):
    """Scale factors and non-orthogonality S + N (3 × 3), biases, and second-order scale factors, SI."""

    SN: np.ndarray
    b: np.ndarray
    S2: np.ndarray

    def readings(self, f: np.ndarray) -> np.ndarray:
        """I = f + b + S·f + N·f + S2·f² (2.23), of inputs in rows."""
        return f + self.b + f @ self.SN.T + self.S2 * f**2


SN = 1e-6 * np.array([[1200.0, 350.0, -240.0], [110.0, -640.0, 420.0], [-70.0, 90.0, 800.0]])
BIAS = np.array([0.012, -0.021, 0.033])
ERRORS = Errors(SN, BIAS, np.zeros(3))


def at_rest(means, n, rate, unit="m/s²", name="", axes="xyz") -> aj.Recording:
    """A recording that has exactly these means of its axes, and a scatter that nothing depends on."""
    scatter = np.tile([1.0, -1.0], n)[:n, None] * np.arange(1.0, n + 1.0)[:, None] % 7.0
    values = np.asarray(means, float) + 1e-6 * np.abs(means).max() * (scatter - scatter.mean())
    sensor = "accel" if unit.startswith("m") else "gyro"
    names = [f"{sensor}_{a}" for a in axes]
    return aj.Recording.from_array(values, rate, names=names, name=name, **{f"{sensor}_unit": unit})


def dense(kernel, start, length, step: float, contrast: bool) -> np.ndarray:
    """Covariance of means over stretches from that of the rate at times t and s, over pairs of midpoints."""
    # With `contrast` of the deviations from the mean over all of the time.
    start, length = np.asarray(start, float)[:, None], np.asarray(length, float)[:, None]
    time = np.arange(step / 2.0, (start + length).max(), step)
    rows = ((time >= start) & (time < start + length)).astype(float)
    rows = rows / rows.sum(axis=1, keepdims=True) - contrast / len(time)
    return rows @ kernel(time[:, None], time[None, :]) @ rows.T


class Dense(NamedTuple):
    """Generalized least squares by the textbook: values, covariance, residuals with theirs, χ²."""

    values: np.ndarray
    covariance: np.ndarray
    residuals: np.ndarray
    residual_covariance: np.ndarray
    chi2: float


def least_squares(X: np.ndarray, y: np.ndarray, C: np.ndarray) -> Dense:
    """y = X·β + e with e of covariance C: β by the normal equations with the inverse of C."""
    P = np.linalg.inv(C)
    covariance = np.linalg.inv(X.T @ P @ X)
    left = y - X @ covariance @ X.T @ P @ y
    return Dense(covariance @ X.T @ P @ y, covariance, left, C - X @ covariance @ X.T, float(left @ P @ left))


def jacobian(function, at: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Derivatives of a vector by central differences."""
    return np.stack([(function(at + s) - function(at - s)) / (2.0 * s.sum()) for s in np.diag(step)], axis=-1)
