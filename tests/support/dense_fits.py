"""Fits of short records, written out: dense covariances, scipy's optimum, Fisher's information.

But for `fitted`, nothing of the package is used but the values of a model's parameters (see `dense`).
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from dense import autocovariance, covariance
from scipy.fft import dct
from scipy.optimize import minimize
from scipy.stats import chi2, norm

import allanjax as aj

# Step of the logarithm of a parameter in a derivative.
_STEP = 1e-3


def recording(columns: np.ndarray, rate: float, unit: str = "rad/s", **auxiliary: np.ndarray) -> aj.Recording:
    """A recording of gyros with these columns [SI]."""
    x = np.asarray(columns, float).reshape(len(columns), -1)
    axes = tuple(aj.Axis(f"gyro_{k}", "gyro", unit) for k in range(x.shape[1]))
    return aj.Recording(x, rate, axes, auxiliary, name="record")


def drawn(model: aj.Model, n: int, rate: float, seed: int, axes: int = 1) -> np.ndarray:
    """Records of a model [n, axes], by the root of the dense covariance of their deviations from the mean."""
    # The root is symmetric: it does not depend on which eigenvectors stand for equal eigenvalues.
    centre = np.eye(n) - 1.0 / n
    power, vectors = np.linalg.eigh(centre @ covariance(model, n, rate) @ centre)
    root = (vectors * np.sqrt(np.maximum(power, 0.0))) @ vectors.T
    return root @ np.random.default_rng(seed).standard_normal((n, axes))


def fitted(
    model: aj.Model, x: np.ndarray, objective: str, rate: float, **options: Any
) -> tuple[aj.AxisFit, aj.Model, list[str]]:
    """Fit of one axis that is complete, the model with the values found, and the labels of those not held."""
    result = aj.fit(recording(x, rate), model, objective, as_is=True, **options).results[0]
    assert result.converged, result.reason
    assert result.discrepancy == 0.0
    found = {label: c.value for label, c in result.coefficients.items()}
    return result, model.with_values(**found), [k for k, c in result.coefficients.items() if not c.held]


class Objective:
    """Minus the logarithm of a likelihood as a function of a model, with its optimum and information."""

    # Parameters are the logarithms of amplitudes and of the distances of shapes from their lower bounds.
    #: Minus the log-likelihood [nats], but for a constant.
    value: Callable[[aj.Model], float]
    #: Fisher's information about the parameters of a model with these labels.
    information: Callable[[aj.Model, list[str]], np.ndarray]

    def maximum(self, model: aj.Model, labels: list[str]) -> aj.Model:
        """The most likely model, found from this one by a general minimizer."""
        move = mover(model, labels)
        simplex = move.start + 0.3 * np.eye(len(labels) + 1, len(labels), -1)
        options = {"xatol": 1e-4, "fatol": 1e-6, "maxfev": 2000, "maxiter": 2000, "initial_simplex": simplex}
        found = minimize(lambda u: self.value(move(u)), move.start, method="Nelder-Mead", options=options)
        assert found.success
        return move(found.x)

    def std(self, model: aj.Model, labels: list[str]) -> dict[str, float]:
        """Standard deviation of each parameter [SI], by the inverse of the information about all."""
        errors = np.sqrt(np.diag(np.linalg.inv(self.information(model, labels))))
        distance = np.exp(mover(model, labels).start)
        return dict(zip(labels, errors * distance, strict=True))

    def ratio(self, model: aj.Model, label: str, end: float) -> float:
        """Root of twice the fall of the likelihood from this model to where a parameter is at this end."""
        others = [p.label for p in model.parameters if p.free and p.label != label and p.start]
        at = self.maximum(model.with_values(**{label: end}), others)
        return float(np.sqrt(2.0 * max(self.value(at) - self.value(model), 0.0)))


def mover(model: aj.Model, labels: list[str]) -> Callable[[np.ndarray], aj.Model]:
    """What makes a model from the logarithms of its parameters; `start` are those of the model itself."""
    lower = {p.label: p.parameter.lower for p in model.parameters}
    bounds, values = (np.array([of[label] for label in labels], float) for of in (lower, model.values))

    def move(u: np.ndarray) -> aj.Model:
        moved = bounds + np.exp(np.clip(u, -40.0, 40.0))
        return model.with_values(**dict(zip(labels, moved.tolist(), strict=True)))

    move.start = np.log(np.maximum(values - bounds, 1e-12))
    return move


def slopes(of: Callable[[aj.Model], np.ndarray], model: aj.Model, labels: list[str]) -> np.ndarray:
    """Derivatives of what a model gives by logarithms of its parameters, by five points, [params, ...]."""
    move, found = mover(model, labels), []
    for unit in _STEP * np.eye(len(labels)):
        a, b, c, d = (of(move(move.start + k * unit)) for k in (-2.0, -1.0, 1.0, 2.0))
        found.append((a - 8.0 * b + 8.0 * c - d) / (12.0 * _STEP))
    return np.array(found)


class Spectrum(Objective):
    """Levels of the cosine spectrum as independent χ² variates about the diagonal of the dense covariance."""

    def __init__(self, x: np.ndarray, rate: float, edges: np.ndarray) -> None:
        self.n, self.rate, self.edges = len(x), rate, np.asarray(edges)
        rows = dct(np.eye(self.n), norm="ortho", axis=0)[1:]
        self.c = rows @ x
        lags = np.fft.irfft(np.abs(np.fft.rfft(rows, 2 * self.n)) ** 2)[:, : self.n]
        #: Expected squares are these weights times the covariance at each lag.
        self.weights = lags * np.where(np.arange(self.n) == 0, 1.0, 2.0)
        self.count = np.diff(self.edges)
        self.level = self.averaged(self.c**2)

    def averaged(self, squares: np.ndarray) -> np.ndarray:
        """Means over bins of coefficients 1 … n − 1."""
        return np.add.reduceat(squares, self.edges[:-1] - 1) / self.count

    def squares(self, model: aj.Model) -> np.ndarray:
        """Expected square of every coefficient."""
        return self.weights @ autocovariance(model, self.n, self.rate)

    def means(self, model: aj.Model) -> np.ndarray:
        """Expected levels."""
        return self.averaged(self.squares(model))

    def value(self, model: aj.Model) -> float:
        mean = self.means(model)
        return 0.5 * float(np.sum(self.count * (np.log(mean) + self.level / mean)))

    def information(self, model: aj.Model, labels: list[str]) -> np.ndarray:
        D = slopes(lambda m: np.log(self.means(m)), model, labels)
        return 0.5 * (D * self.count) @ D.T

    def chi2(self, model: aj.Model) -> float:
        """Squares of the levels' normal scores, by their law."""
        squares = self.count * self.level / self.means(model)
        return float(np.sum(norm.isf(chi2.sf(squares, self.count)) ** 2))


class Gaussian(Objective):
    """The Gaussian law of the samples' differences, which no mean influences; no constant is left out."""

    def __init__(self, x: np.ndarray, rate: float, missing: np.ndarray | None = None) -> None:
        self.n, self.rate = len(x), rate
        self.D = np.diff(np.eye(self.n)[slice(None) if missing is None else ~missing], axis=0)
        self.z = self.D @ x

    def covariance(self, model: aj.Model) -> np.ndarray:
        """Covariance of the differences."""
        return self.D @ covariance(model, self.n, self.rate) @ self.D.T

    def value(self, model: aj.Model) -> float:
        L = np.linalg.cholesky(self.covariance(model))
        u = np.linalg.solve(L, self.z)
        return float(0.5 * (u @ u + len(u) * np.log(2.0 * np.pi)) + np.sum(np.log(np.diag(L))))

    def information(self, model: aj.Model, labels: list[str]) -> np.ndarray:
        inverse = np.linalg.inv(self.covariance(model))
        parts = [inverse @ D for D in slopes(self.covariance, model, labels)]
        return np.array([[0.5 * np.sum(a * b.T) for b in parts] for a in parts])


class Variances:
    """Means of squares of linear forms, such as Allan variances: their moments by quadratic forms."""

    # Forms are matrices [coefficients, samples] whose rows' squares are averaged.
    def __init__(self, x: np.ndarray, rate: float, forms: list[np.ndarray], factor: float = 1.0) -> None:
        self.n, self.rate, self.forms, self.factor = len(x), rate, forms, factor
        self.found = factor * np.array([np.mean((A @ x) ** 2) for A in forms])

    @classmethod
    def of_allan(cls, x: np.ndarray, rate: float, sizes: np.ndarray, strides: Any = 1) -> "Variances":
        """Overlapping Allan variances, whose clusters begin at every stride-th sample."""
        forms, n = [], len(x)
        for m, stride in np.broadcast(sizes, strides):
            at = np.arange(n) - np.arange(0, n - 2 * m + 1, stride)[:, None]
            forms.append((1.0 * ((at >= m) & (at < 2 * m)) - ((at >= 0) & (at < m))) / m)
        return cls(x, rate, forms, 0.5)

    def moments(self, model: aj.Model) -> tuple[np.ndarray, np.ndarray]:
        """Expectations and covariance of the variances."""
        C = covariance(model, self.n, self.rate)
        both = np.array([[2.0 * np.mean((A @ C @ B.T) ** 2) for B in self.forms] for A in self.forms])
        return self.mean(model), self.factor**2 * both

    def mean(self, model: aj.Model) -> np.ndarray:
        """Expectations of the variances."""
        C = covariance(model, self.n, self.rate)
        return self.factor * np.array([np.mean(np.sum(A * (A @ C), axis=1)) for A in self.forms])

    def step(self, model: aj.Model, labels: list[str]) -> tuple[np.ndarray, np.ndarray, float]:
        """The step of generalized least squares from a model, its standard deviations in ln, and χ² there."""
        # Variances are raised by 10⁻⁴, as the package does, lest their covariance be singular.
        mean, C = self.moments(model)
        P = np.linalg.inv(C + 1e-4 * np.diag(np.diag(C)))
        D, left = slopes(self.mean, model, labels), self.found - mean
        inverse = np.linalg.inv(D @ P @ D.T)
        return inverse @ D @ P @ left, np.sqrt(np.diag(inverse)), float(left @ P @ left)
