"""State space of a noise model: the matrices of a Kalman filter, with names and units."""

from __future__ import annotations

import dataclasses
import os

import numpy as np
from jaxtyping import ArrayLike, Float

from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError
from allanjax.base.presented import presented
from allanjax.base.tables import html_table, text_table
from allanjax.base.wording import significant
from allanjax.noise.state_block import Block
from allanjax.record.units import Sensor, default_coefficient_unit, si_unit

_HEADINGS = ("state", "unit", "initial std", "noise std per sample", "weight in a sample")


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class StateSpace(ByValue):
    """Noise of the samples as x_{k+1} = A x_k + w_k, z_k = H x_k + v_k, with x_0 of covariance P0.

    w and v are white, of covariances Q and R, and independent of each other. All is in SI: samples in rad/s
    or m/s².

    Attributes:
        A: transition from one sample to the next, (n, n).
        H: what a sample sees of the states, (1, n).
        Q: covariance of w, (n, n).
        R: variance of v, (1, 1) [rate²].
        P0: covariance of the states at the first sample, (n, n); their mean is zero.
        names: of the states.
        units: of the states.
        rate: sample rate [Hz].
        sensor: "gyro" or "accel".
        model: the noise model in words.
    """

    A: Float[np.ndarray, "n n"]
    H: Float[np.ndarray, "1 n"]
    Q: Float[np.ndarray, "n n"]
    R: Float[np.ndarray, "1 1"]
    P0: Float[np.ndarray, "n n"]
    names: tuple[str, ...]
    units: tuple[str, ...]
    rate: float
    sensor: Sensor = "gyro"
    model: str = ""

    @classmethod
    def of(cls, block: Block, rate: float, sensor: Sensor, model: str) -> StateSpace:
        """State space of a block of states at a rate [Hz]."""
        units = (si_unit(default_coefficient_unit(sensor, p)) for p in block.time_exponents)
        return cls(
            A=block.transition,
            H=block.observation[None, :],
            Q=block.noise,
            R=np.array([[block.white]]),
            P0=block.start,
            names=block.names,
            units=tuple(units),
            rate=float(rate),
            sensor=sensor,
            model=model,
        )

    @property
    def size(self) -> int:
        """Number of states."""
        return len(self.names)

    def sum_covariance(self, n: int) -> tuple[Float[np.ndarray, "n1 n1"], Float[np.ndarray, "n1 n1"]]:
        """Transition over n samples of the states and the sum of the samples, and what noise adds to it.

        The last row and column are those of the sum. It doubles the number of samples, in log₂ n steps.
        """
        transition = np.block([[self.A, np.zeros((self.size, 1))], [self.H, np.ones((1, 1))]])
        noise = np.zeros_like(transition)
        noise[:-1, :-1], noise[-1, -1] = self.Q, self.R[0, 0]
        all_of, added = np.eye(self.size + 1), np.zeros_like(transition)
        while n:
            if n % 2:
                all_of, added = transition @ all_of, transition @ added @ transition.T + noise
            transition, noise = transition @ transition, transition @ noise @ transition.T + noise
            n //= 2
        return all_of, added

    def allan_variance(self, cluster_time: Float[ArrayLike, ...]) -> Float[np.ndarray, ...]:
        """Allan variance [rate²], from the matrices alone, at cluster times [s].

        Raises:
            AllanjaxError: a cluster time that is not one or more sample intervals.
        """
        size = np.asarray(cluster_time, float) * self.rate
        whole = np.round(size)
        if np.any(whole < 1) or np.any(np.abs(size - whole) > 1e-6 * size):
            raise AllanjaxError(f"cluster times must be multiples of {1 / self.rate:g} s, a sample interval")
        return np.array([self._allan(int(m)) for m in whole.flat]).reshape(size.shape)

    def _allan(self, m: int) -> float:
        """Allan variance of clusters of m samples: that of the difference of two sums of m."""
        transition, added = self.sum_covariance(m)
        covariance = np.zeros_like(transition)
        covariance[:-1, :-1] = self.P0
        covariance = transition @ covariance @ transition.T + added
        turned = np.append(np.ones(self.size), -1.0)
        transition = transition * turned
        covariance = transition @ covariance @ transition.T + added
        return float(covariance[-1, -1]) / (2.0 * m**2)

    def spectrum(self, frequency: Float[ArrayLike, ...]) -> Float[np.ndarray, ...]:
        """Two-sided PSD of the samples [rate²/Hz], from the matrices alone, at frequencies [Hz].

        Lines and ramps have none.
        """
        f = np.asarray(frequency, float)
        driven = self._driven()
        A, H, Q = self.A[np.ix_(driven, driven)], self.H[:, driven], self.Q[np.ix_(driven, driven)]
        turn = np.exp(2j * np.pi * f.reshape(-1, 1, 1) / self.rate)
        row = np.broadcast_to(H.T.astype(complex), (f.size, len(A), 1))
        gain = np.linalg.solve(np.swapaxes(turn * np.eye(len(A)) - A, 1, 2), row)[..., 0]
        power = np.einsum("fi,ij,fj->f", gain, Q, gain.conj()).real
        return ((power + self.R[0, 0]) / self.rate).reshape(f.shape)

    def _driven(self) -> np.ndarray:
        """Indices of the states that noise reaches."""
        reached = np.diag(self.Q) > 0.0
        for _ in range(self.size):
            reached = reached | (self.A[:, reached] != 0.0).any(axis=1)
        return np.flatnonzero(reached)

    @presented
    def to_numpy(self, path: str | os.PathLike[str]) -> None:
        """Write an .npz file of A, H, Q, R, P0, names, units and rate."""
        raise NotImplementedError

    @presented
    def to_matlab(self) -> str:
        """Text of a MATLAB script that defines A, H, Q, R, P0, names, units and rate, to all digits."""
        raise NotImplementedError

    @presented
    def to_c_header(self, prefix: str = "noise") -> str:
        """Text of a C header: constants `NOISE_STATES` and `NOISE_RATE`, arrays `noise_A` to `noise_P0`."""
        raise NotImplementedError

    def _cells(self) -> list[tuple[str, ...]]:
        start, noise = (np.sqrt(np.diag(x)) for x in (self.P0, self.Q))
        numbers = zip(start, noise, self.H[0], strict=True)
        rows = zip(self.names, self.units, numbers, strict=True)
        return [(name, unit, *map(significant, map(float, x))) for name, unit, x in rows]

    def _title(self) -> str:
        unit = si_unit(default_coefficient_unit(self.sensor, 0.0))
        white = f"R = ({significant(float(np.sqrt(self.R[0, 0])))} {unit})²"
        return f"State space of {self.size} states at {self.rate:g} Hz, {white}: {self.model}"

    def __str__(self) -> str:
        return text_table(self._title(), _HEADINGS, self._cells(), right=_HEADINGS[2:])

    def __repr__(self) -> str:
        return f"<{self._title()}>"

    def _repr_html_(self) -> str:
        return html_table(self._title(), _HEADINGS, self._cells())
