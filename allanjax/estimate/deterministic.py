"""Deterministic parts of a record in its cosine spectrum: ramps, steps, lines of unknown phase, regressors.

Given the noise, each enters linearly and is estimated by weighted least squares. Projecting it out costs
degrees of freedom where it has its power (its leverage), and the remaining levels are corrected for that. So
the noise is estimated from residuals that do not depend on the amplitudes of these parts.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from allanjax.base.arrays import namespace
from allanjax.base.chi_squared import quantile
from allanjax.base.equality import ByValue
from allanjax.noise.model import Model
from allanjax.noise.terms import DriftRamp, NoiseTerm
from allanjax.spectrum.cosine import Bins, cosine_transform

# A line is fitted to so many coefficients on either side; farther away its best fit is subtracted.
LINE_REACH = 64
# Grid points per coefficient in the search for a line's frequency.
_GRID = 4
# A line is searched within so many coefficients of a conspicuous place.
_SEARCH = 4.0
# Coefficients that hold nine tenths of the power of a line of any phase.
_CORE = 5
# Conspicuous places that are tried.
_CANDIDATES = 8
# Coefficients on either side of a line whose mean square is the noise there.
_LEVEL_REACH = 512
# Median of χ² with one degree of freedom, and a value that it exceeds once in 16 000.
_MEDIAN = 0.4549
_OUTLYING = 16.0


def needs_record(term: NoiseTerm) -> bool:
    """Whether a term must be estimated from the record itself: lines, resonances, transients; not a ramp."""
    return term.narrow_band or (term.deterministic and not isinstance(term, DriftRamp))


def line_columns(
    frequency: ArrayLike, j: Int[ArrayLike, " k"], n: ArrayLike, rate: ArrayLike
) -> Float[Array, "k 2"]:
    """Cosine coefficients j of cos and sin(2πf·(k + ½)/rate), in closed form: sums of geometric series."""
    xp = namespace(frequency, j, n, rate)
    w, a = 2.0 * np.pi * frequency / rate, np.pi * j / n

    def sums(x: Any) -> tuple[Any, Any]:
        """Sums over k = 0 … n−1 of cos and sin of x(k + ½)."""
        regular = abs(xp.sin(x / 2.0)) > 1e-13
        x = xp.where(regular, x, 1.0)
        cosines = xp.sin(n * x) / (2.0 * xp.sin(x / 2.0))
        sines = xp.sin(n * x / 2.0) ** 2 / xp.sin(x / 2.0)
        return xp.where(regular, cosines, 1.0 * n), xp.where(regular, sines, 0.0)

    above, below = sums(w + a), sums(w - a)
    return xp.stack([above[0] + below[0], above[1] + below[1]], axis=-1) / xp.sqrt(2.0 * n)


@dataclasses.dataclass(frozen=True, eq=False)
class Line:
    """Spectral line found in a record.

    Attributes:
        frequency: frequency [Hz]; `frequency_std` is its standard deviation, 0 if it was given.
        gain: log-likelihood gained by the line [nats].
        amplitude, amplitude_std: amplitude in the samples [rate] by least squares, and its standard
            deviation.
        first: index of the first cosine coefficient of its neighbourhood.
        coefficients: the record's coefficients there, this line included, other lines subtracted.
    """

    frequency: float
    frequency_std: float
    gain: float
    amplitude: float
    amplitude_std: float
    first: int
    coefficients: Float[np.ndarray, " k"]

    @property
    def indices(self) -> Int[np.ndarray, " k"]:
        """Indices of these coefficients."""
        return self.first + np.arange(len(self.coefficients))


def lines_of(model: Model) -> tuple[list[int], list[tuple[float | None, bool]]]:
    """Indices of a model's lines, with the start of each frequency (or None) and whether it is held."""
    lines: list[int] = []
    wanted: list[tuple[float | None, bool]] = []
    for k, term in enumerate(model.terms):
        for p in term.parameters():
            if term.deterministic and p.kind == "line":
                lines.append(k)
                wanted.append((getattr(term, p.name), not term.is_free(p)))
    return lines, wanted


def take_out_lines(
    x: Float[np.ndarray, " n"], rate: float, wanted: Sequence[tuple[float | None, bool]]
) -> tuple[Float[np.ndarray, " n-1"], tuple[Line, ...]]:
    """Find lines, the strongest first, and subtract them from a record's cosine coefficients.

    Args:
        x: the samples.
        rate: sample rate [Hz].
        wanted: for each line a frequency to start from, or None, and whether it is held there.

    Returns:
        The coefficients, and the lines in the order wanted. Near a line the coefficients still contain it.
    """
    n = len(x)
    rest = np.array(x, float)
    angle = 2.0 * np.pi * (np.arange(n) + 0.5) / rate if len(wanted) else None
    found: dict[int, tuple[Line, np.ndarray]] = {}
    # Lines with a given frequency first, then the strongest.
    order = sorted(range(len(wanted)), key=lambda k: wanted[k][0] is None)
    for sweep in range(2 if len(wanted) > 1 else 1):
        for k in order:
            start, held = wanted[k]
            if sweep:
                line, beta = found[k]
                rest += _wave(angle, line.frequency, beta)
                starts, reach = [line.frequency], _SEARCH
            elif start is None:
                starts, reach = _conspicuous(cosine_transform(rest), n, rate), _SEARCH
            else:
                starts, reach = [start], LINE_REACH / 2.0
            c = cosine_transform(rest)
            options = [_refined(c, f, 0.0 if held else reach, n, rate) for f in starts]
            line, beta = max(options, key=lambda option: option[0].gain)
            rest -= _wave(angle, line.frequency, beta)
            found[k] = (line, beta)
    rest_c = cosine_transform(rest)
    c, lines = rest_c.copy(), []
    for k in range(len(wanted)):
        line, beta = found[k]
        own = line_columns(line.frequency, line.indices, n, rate) @ beta
        lines.append(dataclasses.replace(line, coefficients=rest_c[line.indices - 1] + own))
        c[line.indices - 1] += own
    return c, tuple(lines)


def _wave(
    angle: Float[np.ndarray, " n"] | None, frequency: float, beta: Float[np.ndarray, " 2"]
) -> Float[np.ndarray, " n"]:
    """Line in time, β0·cos + β1·sin of 2πf·t, given 2πt."""
    phase = np.asarray(angle) * frequency
    return beta[0] * np.cos(phase) + beta[1] * np.sin(phase)


def _conspicuous(c: Float[np.ndarray, " n-1"], n: int, rate: float) -> list[float]:
    """Frequencies where a few neighbouring coefficients have most power relative to the others around."""
    from scipy.ndimage import median_filter, uniform_filter1d

    power = uniform_filter1d(c**2, _CORE, mode="nearest")
    level = median_filter(power[::_CORE], min(2 * (len(power) // (4 * _CORE)) + 1, 201), mode="nearest")
    ratio = power / np.maximum(np.repeat(level, _CORE)[: len(power)], 1e-300)
    found: list[int] = []
    for j in np.argsort(ratio)[::-1][: 16 * _CANDIDATES]:
        if all(abs(j - k) > _SEARCH for k in found):
            found.append(int(j))
        if len(found) == _CANDIDATES:
            break
    return [(j + 1) * rate / (2.0 * n) for j in found]


def _refined(
    c: Float[np.ndarray, " n-1"], start: float, reach: float, n: int, rate: float
) -> tuple[Line, Float[np.ndarray, " 2"]]:
    """Best line within `reach` coefficients of a frequency, and its cosine and sine amplitudes."""
    from scipy.optimize import minimize_scalar

    spacing = rate / (2.0 * n)
    centre = int(np.clip(np.rint(start / spacing), 1, n - 1))
    first = max(centre - LINE_REACH, 1)
    indices = np.arange(first, min(centre + LINE_REACH, n - 1) + 1)
    data = c[indices - 1]
    # The level of the noise: a mean without outliers, such as another line.
    around = c[max(centre - _LEVEL_REACH, 1) - 1 : centre + _LEVEL_REACH] ** 2
    level = float(np.mean(around[around < _OUTLYING * np.median(around) / _MEDIAN]))

    def fitted(f: float) -> tuple[float, np.ndarray, float]:
        D = line_columns(f, indices, n, rate)
        beta = np.linalg.solve(D.T @ D + 1e-12 * np.eye(2), D.T @ data)
        return float(data @ D @ beta) / (2.0 * level), beta, float(np.sqrt(2.0 * level / np.sum(D**2)))

    def loss(f: float) -> float:
        return -fitted(f)[0]

    f, std = start, 0.0
    if reach > 0.0:
        offsets = np.arange(-reach, reach + 1e-9, 1.0 / _GRID) * spacing
        grid = np.clip(start + offsets, spacing, (n - 1.0) * spacing)
        f = grid[np.argmin([loss(g) for g in grid])]
        step = spacing / _GRID
        f = float(
            minimize_scalar(
                loss, bounds=(f - step, f + step), method="bounded", options={"xatol": 1e-6 * spacing}
            ).x
        )
        h = 0.05 * spacing
        curvature = (loss(f + h) - 2.0 * loss(f) + loss(f - h)) / h**2
        std = float(1.0 / np.sqrt(curvature)) if curvature > 0.0 else spacing
    gain, beta, amplitude_std = fitted(f)
    return Line(f, std, gain, float(np.hypot(*beta)), amplitude_std, first, data), beta


@dataclasses.dataclass(frozen=True, eq=False)
class Projection:
    """Levels of the noise after the projection of deterministic parts, and the amplitudes of these.

    Attributes:
        level: mean square of the coefficients [rate²] in each bin, per degree of freedom.
        dof: degrees of freedom in each bin.
        amplitude: amplitude of each column by weighted least squares; zero for columns not in use.
        covariance: covariance of these amplitudes.
    """

    level: Float[np.ndarray, " m"]
    dof: Float[np.ndarray, " m"]
    amplitude: Float[np.ndarray, " columns"]
    covariance: Float[np.ndarray, "columns columns"]

    @property
    def estimates(self) -> float:
        """Number of levels; a level with less than one degree of freedom counts as that fraction."""
        return float(np.sum(np.minimum(self.dof, 1.0)))


@dataclasses.dataclass(frozen=True, eq=False)
class AxisSpectrum(ByValue):
    """Sufficient statistics of one axis: sums over bins of products of cosine coefficients.

    Attributes:
        bins: the bins.
        squares: sums of the record's squared coefficients.
        overlap: part of `squares` that is due to products of two lines.
        cross: sums of products of the record's coefficients with those of the deterministic columns.
        gram: sums of products of the columns' coefficients with each other.
        owners: a regressor's name, or the index of a term, for each column.
        lines: the lines, by the index of their term.
    """

    bins: Bins
    squares: Float[np.ndarray, " m"]
    overlap: Float[np.ndarray, " m"]
    cross: Float[np.ndarray, "m columns"]
    gram: Float[np.ndarray, "m columns columns"]
    owners: tuple[str | int, ...]
    lines: dict[int, Line]

    @classmethod
    def of(
        cls,
        bins: Bins,
        c: Float[np.ndarray, " n-1"],
        columns: Sequence[tuple[str | int, Float[np.ndarray, " n-1"]]],
        lines: dict[int, Line],
    ) -> AxisSpectrum:
        """Statistics of coefficients c with columns over the whole spectrum and lines, which are local."""
        everywhere = list(columns)
        present, apart = np.zeros(bins.n - 1), np.zeros(bins.n - 1)
        for term, line in lines.items():
            near = line.indices - 1
            own = line_columns(line.frequency, line.indices, bins.n, bins.rate)
            # The rest is due to other lines and is not in a line's own coefficients.
            fitted = own @ np.linalg.lstsq(own, line.coefficients, rcond=None)[0]
            apart[near] += fitted**2
            present[near] += fitted
            for column in own.T:
                whole = np.zeros(bins.n - 1)
                whole[near] = column
                everywhere.append((term, whole))
        q = len(everywhere)
        cross = np.zeros((len(bins.size), q))
        gram = np.zeros((len(bins.size), q, q))
        for a, (_, one) in enumerate(everywhere):
            cross[:, a] = bins.sums(c * one)
            for b, (_, other) in enumerate(everywhere[: a + 1]):
                gram[:, a, b] = gram[:, b, a] = bins.sums(one * other)
        owners = tuple(owner for owner, _ in everywhere)
        return cls(bins, bins.sums(c**2), bins.sums(present**2 - apart), cross, gram, owners, lines)

    def used(self, absent: Sequence[int] = ()) -> np.ndarray:
        """Which columns are in use if the model lacks the terms `absent`."""
        return np.array([owner not in absent for owner in self.owners], bool)

    def project(self, variance: Float[np.ndarray, " m"], used: np.ndarray) -> Projection:
        """Project out the columns in use, given the variance of the noise in each bin."""
        q = len(self.owners)
        amplitude, covariance = np.zeros(q), np.zeros((q, q))
        rss, dof = self.squares.copy(), self.bins.size.astype(float)
        if used.any():
            gram = self.gram[:, used][:, :, used]
            inverse = np.linalg.inv(np.einsum("mab,m->ab", gram, 1.0 / variance))
            covariance[np.ix_(used, used)] = inverse
            beta = inverse @ (self.cross[:, used].T @ (1.0 / variance))
            amplitude[used] = beta
            rss += np.einsum("mab,a,b->m", gram, beta, beta) - 2.0 * self.cross[:, used] @ beta
            dof -= np.einsum("mab,ba->m", gram, inverse) / variance
        known = dof > 1e-3
        dof = np.where(known, dof, 0.0)
        # A level without degrees of freedom is set to its expectation and has no weight.
        level = np.where(known, np.maximum(rss, 0.0) / np.where(known, dof, 1.0), variance)
        return Projection(level, dof, amplitude, covariance)


def amplitude_quantile(square: float, degrees: int, probability: float) -> float:
    """Amplitude, in standard deviations, under which a square as small as this one has this probability.

    The square of an estimate with `degrees` components (a ramp has one, a line two), in units of its
    variance, has a noncentral χ² law. A confidence limit follows for any amplitude, zero included. Upper
    limits (a probability below one half) never use a square below the median of pure noise: data with less
    power than noise say nothing about an amplitude.
    """
    from scipy.optimize import brentq
    from scipy.special import chndtr, ndtri

    if not np.isfinite(square):
        return float("nan")
    if probability < 0.5:
        square = max(square, float(quantile(0.5, degrees)))
    if square > 400.0:
        # Here the law is normal, and the mean of the estimate exceeds the amplitude by (degrees −
        # 1)/(2·amplitude).
        return float(np.sqrt(square) - ndtri(probability) - (degrees - 1) / (2.0 * np.sqrt(square)))
    if chndtr(square, degrees, 1e-12) <= probability:
        return 0.0
    return float(brentq(lambda a: chndtr(square, degrees, a**2) - probability, 1e-6, np.sqrt(square) + 10.0))
