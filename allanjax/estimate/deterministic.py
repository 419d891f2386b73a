"""Deterministic parts of a record in its cosine spectrum: ramps, steps, lines of unknown phase, regressors.

Given the noise, each enters linearly and is estimated by weighted least squares. Projecting it out costs
degrees of freedom where it has its power (its leverage), and the remaining levels are corrected for that. So
the noise is estimated from residuals that do not depend on the amplitudes of these parts.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Int

from allanjax.base.chi_squared import quantile
from allanjax.base.equality import ByValue
from allanjax.noise.model import Model
from allanjax.noise.terms import DriftRamp, NoiseTerm
from allanjax.spectrum.cosine import (
    PER_OCTAVE,
    Bins,
    SpectralStatistics,
    cosine_transform,
    fast_length,
    ramp_column,
    term_column,
)
from allanjax.spectrum.peaks import MEDIAN, level_beside, lines_in, peaks_of

#: Samples of an axis and their cosine coefficients; frequencies [Hz]; samples of auxiliary channels by name;
#: the terms in use, of one axis or several.
Samples: TypeAlias = Float[np.ndarray, " n"]
Cosines: TypeAlias = Float[np.ndarray, " n-1"]
Peaks: TypeAlias = Sequence[float] | Float[np.ndarray, " peaks"]
Regressors: TypeAlias = Mapping[str, Samples]
_Levels: TypeAlias = Float[np.ndarray, " m"]
InUse: TypeAlias = Bool[np.ndarray, "*axes terms"]

# A line is fitted to so many coefficients on either side; farther away its best fit is subtracted. Those
# farther around have the level of the noise.
LINE_REACH, _LEVEL_REACH = 64, 512
# A line is searched within so many coefficients of a conspicuous place, at so many points in each, then by
# steps to the vertex of a parabola; and the lowest coefficient where a line of unknown frequency is searched.
_SEARCH, _GRID, _STEPS, _SLOWEST = 4.0, 4, 4, 4
# Conspicuous places that are tried for a line, and frequencies that are tried for a resonance.
_PLACES, _PEAKS = 8, 4
# Bins per octave where the spectrum is not smooth: for filters.
_FINE = 24
# Samples of a line that are rotated together.
_ROTATED = 1024
# Value that χ² with one degree of freedom exceeds once in 16 000.
_OUTLYING = 16.0


def needs_record(term: NoiseTerm) -> bool:
    """Whether a term must be estimated from the record itself: lines, resonances, transients; not a ramp."""
    return term.narrow_band or (term.deterministic and not isinstance(term, DriftRamp))


def line_columns(
    frequency: float | Float[np.ndarray, "b 1"], j: Int[np.ndarray, " k"], n: int, rate: float
) -> Float[np.ndarray, "*b k 2"]:
    """Cosine coefficients j of cos and sin(2πf·(k + ½)/rate), in closed form: sums of geometric series."""
    w, a = 2.0 * np.pi * frequency / rate, np.pi * j / n
    x = np.stack([w + a, w - a])
    # Sums over k = 0 … n−1 of cos and sin of x(k + ½).
    regular = abs(np.sin(x / 2.0)) > 1e-13
    half = np.where(regular, x, 1.0) / 2.0
    cosines = np.where(regular, np.sin(2.0 * n * half) / (2.0 * np.sin(half)), n)
    sines = np.where(regular, np.sin(n * half) ** 2 / np.sin(half), 0.0)
    return np.stack([cosines.sum(axis=0), sines.sum(axis=0)], axis=-1) / np.sqrt(2.0 * n)


@dataclasses.dataclass(frozen=True, eq=False)
class Line:
    """Spectral line found in a record.

    `frequency_std` is 0 if the frequency [Hz] was given; `gain` is in log-likelihood [nats]; `beta` are the
    amplitudes of cosine and sine in the samples, and `amplitude_std` the error of each. `coefficients` are
    the record's of these `indices`, this line included and other lines subtracted.
    """

    frequency: float
    frequency_std: float
    gain: float
    beta: Float[np.ndarray, " 2"]
    amplitude_std: float
    indices: Int[np.ndarray, " k"]
    coefficients: Float[np.ndarray, " k"]

    def fitted(self, n: int, rate: float) -> Float[np.ndarray, " k"]:
        """What of them is due to the line, by least squares, in a record of n samples at `rate` [Hz]."""
        own = line_columns(self.frequency, self.indices, n, rate)
        return own @ np.linalg.lstsq(own, self.coefficients, rcond=None)[0]

    def samples(self, n: int, rate: float) -> Samples:
        """The line in n samples at `rate` [Hz]."""
        w = 2j * np.pi * self.frequency / rate
        # Rotations of one block, which are faster than cosines and sines of all phases.
        block = np.exp(w * (np.arange(_ROTATED) + 0.5)) * complex(*self.beta).conjugate()
        turns = np.exp(w * _ROTATED * np.arange(-(-n // _ROTATED)))
        return (np.c_[turns.real, -turns.imag] @ [block.real, block.imag]).ravel()[:n]


def lines_of(model: Model) -> tuple[list[int], list[tuple[float | None, bool]]]:
    """Indices of a model's lines, with the start of each frequency (or None) and whether it is held."""
    of = [p for p in model.parameters if p.parameter.kind == "line" and model.terms[p.term].deterministic]
    return [p.term for p in of], [(p.start, not p.free) for p in of]


def take_out_lines(
    x: Samples, rate: float, wanted: Sequence[tuple[float | None, bool]]
) -> tuple[Cosines, tuple[Line, ...]]:
    """Find lines, the strongest first, and subtract them from a record's cosine coefficients.

    `wanted`: for each line a frequency to start from, or None, and whether it is held there. The lines are in
    this order. Near a line the coefficients still contain it.
    """
    if not wanted:
        return cosine_transform(x), ()
    n, rest, found = len(x), np.array(x, float), dict[int, Line]()
    # Lines with a given frequency first, then the strongest; then each again without the others.
    order = sorted(range(len(wanted)), key=lambda k: wanted[k][0] is None)
    for k in order * (2 if len(order) > 1 else 1):
        start, held = wanted[k]
        starts, reach = [start or 0.0], LINE_REACH / 2.0
        if k in found:
            rest += found[k].samples(n, rate)
            starts, reach = [found[k].frequency], _SEARCH
        c = cosine_transform(rest)
        if k not in found and start is None:
            starts = [j * rate / (2.0 * n) for j in lines_in(c**2, _PLACES, _SLOWEST)] or [rate / 8.0]
            reach = _SEARCH
        options = [_refined(c, f, 0.0 if held else reach, rate) for f in starts]
        found[k] = max(options, key=lambda line: line.gain)
        rest -= found[k].samples(n, rate)
    alone = cosine_transform(rest)
    c, lines = alone.copy(), []
    for _, line in sorted(found.items()):
        own = line_columns(line.frequency, line.indices, n, rate) @ line.beta
        lines.append(dataclasses.replace(line, coefficients=alone[line.indices - 1] + own))
        c[line.indices - 1] += own
    return c, tuple(lines)


def without_lines(c: Cosines, lines: Sequence[Line], rate: float) -> Cosines:
    """Coefficients of `take_out_lines` without what they still contain of the lines."""
    c = c.copy()
    for line in lines:
        c[line.indices - 1] -= line.fitted(len(c) + 1, rate)
    return c


def _refined(c: Cosines, start: float, reach: float, rate: float) -> Line:
    """Best line within `reach` coefficients of a frequency."""
    n = len(c) + 1
    spacing = rate / (2.0 * n)
    centre = int(np.clip(np.rint(start / spacing), 1, n - 1))
    indices = np.arange(max(centre - LINE_REACH, 1), min(centre + LINE_REACH, n - 1) + 1)
    data = c[indices - 1]
    # The level of the noise: a mean without outliers, such as another line.
    around = c[max(centre - _LEVEL_REACH, 1) - 1 : centre + _LEVEL_REACH] ** 2
    level = float(np.mean(around[around < _OUTLYING * np.median(around) / MEDIAN]))

    def fitted(*f: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        D = line_columns(np.array(f)[:, None], indices, n, rate)
        right = data @ D
        beta = np.linalg.solve(D.swapaxes(1, 2) @ D + 1e-12 * np.eye(2), right[..., None])[..., 0]
        std = np.sqrt(2.0 * level / np.sum(D**2, axis=(1, 2)))
        return -np.sum(right * beta, axis=1) / (2.0 * level), beta, std

    f, std = start, 0.0
    if reach > 0.0:
        offsets = np.arange(-reach, reach + 1e-9, 1.0 / _GRID) * spacing
        grid = np.clip(start + offsets, spacing, (n - 1.0) * spacing)
        best, h = float(grid[np.argmin(fitted(*grid)[0])]), 0.05 * spacing
        f, low, high = best, best - spacing / _GRID, best + spacing / _GRID
        for _ in range(_STEPS):
            left, middle, right = fitted(f - h, f, f + h)[0].tolist()
            curvature = (left - 2.0 * middle + right) / h**2
            std = curvature**-0.5 if curvature > 0.0 else spacing
            step = 0.5 * (left - right) / (curvature * h) if curvature > 0.0 else 0.0
            f = min(max(f + step, low), high)
    (loss,), (beta,), (amplitude_std,) = fitted(f)
    return Line(f, std, -float(loss), beta, float(amplitude_std), indices, data)


class Projection(NamedTuple):
    """Levels of the noise after the projection of deterministic parts, and the amplitudes of these.

    `level` is the mean square [rate²] per degree of freedom in each bin; amplitudes are by weighted least
    squares, zero for columns not in use.
    """

    level: _Levels
    dof: _Levels
    amplitude: Float[np.ndarray, " columns"]
    covariance: Float[np.ndarray, "columns columns"]

    @property
    def estimates(self) -> int:
        """Number of levels; one with less than one degree of freedom counts as that fraction."""
        return round(float(np.sum(np.minimum(self.dof, 1.0))))


@dataclasses.dataclass(frozen=True, eq=False)
class AxisSpectrum(ByValue):
    """Sufficient statistics of one axis: sums over bins of products of cosine coefficients.

    These are the record's (`squares`), and those of deterministic columns with the record's (`cross`) and
    with each other (`gram`). A column's owner is a regressor's name or the index of a term, as of `lines`;
    `peaks` are to be tried for narrow-band terms that have no frequency.
    """

    bins: Bins
    squares: _Levels
    cross: Float[np.ndarray, "m columns"]
    gram: Float[np.ndarray, "m columns columns"]
    owners: tuple[str | int, ...]
    lines: dict[int, Line] = dataclasses.field(default_factory=dict)
    peaks: Peaks = ()

    @classmethod
    def of(
        cls, template: Model, x: Samples, rate: float, regressors: Regressors | None = None
    ) -> AxisSpectrum:
        """Statistics of one axis for a model, in bins that are finer around narrow-band terms."""
        n, (lines, wanted) = fast_length(len(x)), lines_of(template)
        c, found = take_out_lines(x[:n] - x[:n].mean(), rate, wanted)
        sharp = [p for p in template.parameters if p.parameter.kind == "line"]
        peaks: Peaks = ()
        if any(p.start is None for p in sharp):
            squares = without_lines(c, found, rate) ** 2
            highest = peaks_of(squares, level_beside(squares), _PEAKS)
            peaks = [peak.middle * rate / (2.0 * n) for peak in highest] or [rate / 8.0]
        around, unknown = [line.frequency for line in found], iter(peaks)
        for start in (p.start for p in sharp if p.term not in lines):
            around.append(float(next(unknown, rate / 8.0)) if start is None else start)
        per_octave = PER_OCTAVE if template.response is None else _FINE
        bins = Bins.of(n, rate, [(frequency, 0.0) for frequency in around], per_octave)
        return dataclasses.replace(cls.in_bins(template, bins, c, found, regressors), peaks=peaks)

    @classmethod
    def of_axes(cls, bins: Bins, statistics: SpectralStatistics, template: Model) -> list[AxisSpectrum]:
        """Statistics of all axes of a joint or averaged spectrum, for a model without lines or transients."""
        ramps = tuple(k for k, term in enumerate(template.terms) if term.deterministic)
        columns = (*np.shape(statistics.squares), len(ramps))
        cross = np.broadcast_to(np.asarray(statistics.cross)[..., None], columns)
        gram = np.broadcast_to(np.asarray(statistics.gram)[..., None, None], (*columns, len(ramps)))
        each = zip(statistics.squares, cross, gram, strict=True)
        return [cls(bins, *own, ramps) for own in each]

    @classmethod
    def in_bins(
        cls, model: Model, bins: Bins, c: Cosines, found: Sequence[Line], regressors: Regressors | None = None
    ) -> AxisSpectrum:
        """Statistics of coefficients from which the lines found were taken out."""
        n, rate, lines = bins.n, bins.rate, dict(zip(lines_of(model)[0], found, strict=True))
        columns: list[tuple[str | int, np.ndarray]] = []
        columns += [(name, cosine_transform(z[:n])) for name, z in (regressors or {}).items()]
        for k, term in enumerate(model.terms):
            if isinstance(term, DriftRamp):
                columns.append((k, term.sign * ramp_column(n, rate)))
            elif term.deterministic and k not in lines:
                columns.append((k, term_column(term, n, rate)))
        for k, line in lines.items():
            whole = np.zeros((2, n - 1))
            whole[:, line.indices - 1] = line_columns(line.frequency, line.indices, n, rate).T
            columns += [(k, column) for column in whole]
        every = [c, *(column for _, column in columns)]
        sums = np.zeros((len(bins.size), len(every), len(every)))
        for a, b in itertools.combinations_with_replacement(range(len(every)), 2):
            sums[:, a, b] = sums[:, b, a] = bins.sums(every[a] * every[b])
        owners = tuple(owner for owner, _ in columns)
        return cls(bins, sums[:, 0, 0], sums[:, 0, 1:], sums[:, 1:, 1:], owners, lines)

    @property
    def overlap(self) -> _Levels:
        """What products of two lines add to the squares."""
        if len(self.lines) < 2:
            return np.zeros(len(self.squares))
        present, apart = np.zeros((2, self.bins.n - 1))
        for line in self.lines.values():
            fitted = line.fitted(self.bins.n, self.bins.rate)
            present[line.indices - 1] += fitted
            apart[line.indices - 1] += fitted**2
        return self.bins.sums(present**2 - apart)

    def used(self, active: InUse) -> Bool[np.ndarray, " columns"]:
        """Which columns are in use if these terms are: theirs, and those of regressors."""
        return np.array([isinstance(owner, str) or active[owner] for owner in self.owners], bool)

    def project(self, variance: _Levels, used: np.ndarray) -> Projection:
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


def amplitude_quantiles(
    square: float, degrees: int, probabilities: Float[np.ndarray, " p"]
) -> Float[np.ndarray, " p"]:
    """Amplitudes, in standard deviations, under which a square as small as this has these probabilities.

    The square of an estimate with `degrees` components (a ramp has one, a line two), in units of its
    variance, has a noncentral χ² law. Upper limits (a probability below one half) never use a square below
    the median of pure noise: data with less power than noise say nothing about an amplitude.
    """
    from scipy.special import chndtr, chndtrinc, ndtri

    least = np.where(probabilities < 0.5, quantile(0.5, degrees), 0.0)
    squares = np.maximum(square, least)
    if square > 400.0:
        # Here the law is normal, and the mean estimate exceeds the amplitude by (degrees − 1)/(2·amplitude).
        root = np.sqrt(squares)
        return root - ndtri(probabilities) - (degrees - 1) / (2.0 * root)
    possible = chndtr(squares, degrees, 1e-12) > probabilities
    found = chndtrinc(np.where(possible, squares, 1e3), degrees, probabilities)
    return np.where(possible, np.sqrt(found), 0.0) + 0.0 * square
