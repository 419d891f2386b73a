"""Deterministic parts of a record in the cosine spectrum: ramps and steps, lines of unknown phase, known
regressors.

Given the noise, each enters linearly: least squares with the noise's levels as weights estimates it, and
taking it out costs degrees of freedom where it has its power (its leverage), which the levels that are
left account for. So the noise is estimated from what no choice of these parts could have changed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from allanjax.base.equality import ByValue
from allanjax.noise.model import Model
from allanjax.noise.terms import DriftRamp, NoiseTerm
from allanjax.spectrum.cosine import Bins, CosineBins, cosine_transform

# A line is fitted to so many coefficients on both sides of it; beyond, its best fit is subtracted.
LINE_REACH = 64
_GRID = 4
# A searched line is sought within so many coefficients of the most conspicuous places.
_SEARCH = 4.0
_CORE = 5
_CANDIDATES = 8
_LEVEL_REACH = 512
_MEDIAN = 0.4549  # of χ² with one degree of freedom
_OUTLYING = 16.0  # beyond which it is once in 16 000


def needs_record(term: NoiseTerm) -> bool:
    """Whether a term is estimated from the record itself: lines, resonances, transients; not a ramp."""
    return term.narrow_band or (term.deterministic and not isinstance(term, DriftRamp))


def line_columns(
    frequency: ArrayLike, j: Int[np.ndarray, " k"], n: int, rate: float, numpy: Any = np
) -> Float[Array, "k 2"]:
    """Coefficients j of cos and sin(2πf·(k + ½)/rate), in closed form: sums of geometric series.

    `numpy` is NumPy or jax.numpy, whichever is to compute them.
    """
    w, a = 2.0 * np.pi * frequency / rate, np.pi * j / n

    def sums(x: Any) -> tuple[Any, Any]:
        """Σ_k cos and Σ_k sin of x(k + ½), k = 0 … n−1."""
        regular = abs(numpy.sin(x / 2.0)) > 1e-13
        x = numpy.where(regular, x, 1.0)
        cosines = numpy.sin(n * x) / (2.0 * numpy.sin(x / 2.0))
        sines = numpy.sin(n * x / 2.0) ** 2 / numpy.sin(x / 2.0)
        return numpy.where(regular, cosines, float(n)), numpy.where(regular, sines, 0.0)

    above, below = sums(w + a), sums(w - a)
    return numpy.stack([above[0] + below[0], above[1] + below[1]], axis=-1) / np.sqrt(2.0 * n)


@dataclasses.dataclass(frozen=True, eq=False)
class Line:
    """A line found in a record.

    Attributes:
        frequency: its frequency [Hz]; `frequency_std` its standard deviation, 0 if it was given.
        gain: log-likelihood gained by it.
        amplitude, amplitude_std: of the samples [rate], by least squares, and its standard deviation.
        first: index of the first coefficient of its neighbourhood.
        coefficients: the record's coefficients there, the line included, other lines taken out.
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
        """Indices of the coefficients."""
        return self.first + np.arange(len(self.coefficients))


def lines_of(model: Model) -> tuple[list[int], list[tuple[float | None, bool]]]:
    """Indices of a model's lines (deterministic terms with a line's frequency), and what to look for."""
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
    """Find lines, strongest first, and take them out of a record's coefficients.

    Args:
        x: the samples.
        rate: sample rate [Hz].
        wanted: for each line a frequency to start from, or None, and whether it is held there.

    Returns:
        The coefficients, and the lines in the order wanted. Near a line the coefficients still have it.
    """
    n = len(x)
    rest = np.array(x, float)
    angle = 2.0 * np.pi * (np.arange(n) + 0.5) / rate if len(wanted) else None
    found: dict[int, tuple[Line, np.ndarray]] = {}
    # Those with a frequency first, then the strongest.
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
    phase = np.asarray(angle) * frequency
    return beta[0] * np.cos(phase) + beta[1] * np.sin(phase)


def _conspicuous(c: Float[np.ndarray, " n-1"], n: int, rate: float) -> list[float]:
    """Frequencies where a few neighbouring coefficients have most power, compared with what is around."""
    from scipy.ndimage import median_filter, uniform_filter1d

    # A line of any phase has nine tenths of its power in so many coefficients.
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
    """The best line within `reach` coefficients of a frequency, and its two amplitudes."""
    from scipy.optimize import minimize_scalar

    spacing = rate / (2.0 * n)
    centre = int(np.clip(np.rint(start / spacing), 1, n - 1))
    first = max(centre - LINE_REACH, 1)
    indices = np.arange(first, min(centre + LINE_REACH, n - 1) + 1)
    data = c[indices - 1]
    # The noise there: the mean without what no noise would do (a line, say).
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
    """Levels of the noise with deterministic parts taken out, and these parts' amplitudes.

    Attributes:
        level: mean square of the coefficients [rate²] in each bin, per degree of freedom.
        dof: degrees of freedom in each bin.
        amplitude: of each column, by weighted least squares; zero for those not in use.
        covariance: of these amplitudes.
    """

    level: Float[np.ndarray, " m"]
    dof: Float[np.ndarray, " m"]
    amplitude: Float[np.ndarray, " columns"]
    covariance: Float[np.ndarray, "columns columns"]


@dataclasses.dataclass(frozen=True, eq=False)
class AxisSpectrum(ByValue):
    """Sufficient statistics of one axis: sums over bins of products of coefficients.

    Attributes:
        bins: where they are.
        squares: of the record's coefficients with themselves.
        overlap: what `squares` have of two lines at once.
        cross: with those of the deterministic columns.
        gram: of the columns among themselves.
        owners: what each column is: a regressor's name, or the index of its term.
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
        bins: CosineBins,
        c: Float[np.ndarray, " n-1"],
        columns: Sequence[tuple[str | int, Float[np.ndarray, " n-1"]]],
        lines: dict[int, Line],
    ) -> AxisSpectrum:
        """Sums for coefficients c, columns that reach everywhere, and lines, which do not."""
        everywhere = list(columns)
        present, apart = np.zeros(bins.n - 1), np.zeros(bins.n - 1)
        for term, line in lines.items():
            near = line.indices - 1
            own = line_columns(line.frequency, line.indices, bins.n, bins.rate)
            # The part of the others is what a line's own coefficients lack.
            fitted = own @ np.linalg.lstsq(own, line.coefficients, rcond=None)[0]
            apart[near] += fitted**2
            present[near] += fitted
            for column in own.T:
                whole = np.zeros(bins.n - 1)
                whole[near] = column
                everywhere.append((term, whole))
        q = len(everywhere)
        cross = np.zeros((len(bins.first), q))
        gram = np.zeros((len(bins.first), q, q))
        for a, (_, one) in enumerate(everywhere):
            cross[:, a] = bins.sums(c * one)
            for b, (_, other) in enumerate(everywhere[: a + 1]):
                gram[:, a, b] = gram[:, b, a] = bins.sums(one * other)
        owners = tuple(owner for owner, _ in everywhere)
        return cls(bins, bins.sums(c**2), bins.sums(present**2 - apart), cross, gram, owners, lines)

    def used(self, absent: Sequence[int] = ()) -> np.ndarray:
        """Which columns are in use where the terms `absent` are not in the model."""
        return np.array([owner not in absent for owner in self.owners], bool)

    def project(self, variance: Float[np.ndarray, " m"], used: np.ndarray) -> Projection:
        """Take the columns in use out, the noise having this variance in each bin."""
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
        # A level that is not known is what is expected, and counts for nothing.
        level = np.where(known, np.maximum(rss, 0.0) / np.where(known, dof, 1.0), variance)
        return Projection(level, dof, amplitude, covariance)


def amplitude_quantile(square: float, degrees: int, probability: float) -> float:
    """The amplitude, in standard deviations, for which a square as small as this one has that probability.

    The estimate of an amplitude of `degrees` components (a ramp has one, a line two) in units of its standard
    deviation has a square with a noncentral χ² law. A confidence limit follows for any amplitude, zero
    included. Upper limits (a probability below one half) never use a square below the median of pure noise:
    data that have less than noise would have say nothing about an amplitude.
    """
    from scipy.optimize import brentq
    from scipy.stats import chi2, ncx2, norm

    if not np.isfinite(square):
        return float("nan")
    if probability < 0.5:
        square = max(square, float(chi2.ppf(0.5, degrees)))
    if square > 400.0:
        # Where the law is normal; the mean of the estimate is (degrees − 1)/(2·amplitude) above.
        return float(np.sqrt(square) - norm.ppf(probability) - (degrees - 1) / (2.0 * np.sqrt(square)))
    if ncx2.cdf(square, degrees, 1e-12) <= probability:
        return 0.0
    return float(
        brentq(lambda a: ncx2.cdf(square, degrees, a**2) - probability, 1e-6, np.sqrt(square) + 10.0)
    )
