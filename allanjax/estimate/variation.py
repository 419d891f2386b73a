"""Variation of N, B and K over a record, and what it adds to the errors of their means.

The cosine coefficients c_j of a record (see `cosine`) have the density S_j, of which a term contributes
the share w_j. The inverse transform of c_j·√(w_j/S_j) is a series whose squares are, in a window, the
score of the term's power there: slower terms, filters, lines and resonances are whitened or left out, and
windows are nearly independent. With the means m of w_j and m₂ of w_j², the mean square p in a window of L
values gives

    δ = (p/m − 1)·m/m₂,   Var δ = φ·2/(L·m₂),

the change of the power there relative to that of the record, where φ allows for heavy tails. Variation is
reported if Σ(δ − δ̄)²/Var δ, or the part of it in the slowest modes, is improbable without it. The mean of
another record as long may differ by what the two slowest modes of this one have.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from allanjax.base.chi_squared import upper_tail
from allanjax.base.normal import bulk_std
from allanjax.estimate.deterministic import Cosines, Samples, amplitude_quantiles
from allanjax.estimate.likely_models import exact_model
from allanjax.estimate.result import MAIN, AxisFit
from allanjax.estimate.spectral.components import BROAD, QUICK
from allanjax.estimate.spectral.model import peak_of
from allanjax.noise.estimate import Variation
from allanjax.noise.model import Model
from allanjax.noise.terms import AngleRandomWalk, Markov, NoiseTerm, PowerLaw, Resonance
from allanjax.spectrum.cosine import Bins, cosine_transform, fast_length, ramp_column

# The measured density is averaged over this share of the frequency, but over at least `_LEAST` coefficients,
# and over at most `_WIDEST` [Hz] or, if that is more, `_MOST` coefficients.
_RELATIVE, _LEAST, _WIDEST, _MOST = 0.15, 12, 0.05, 200
# Share of white noise in the density below which a coefficient is left out: lines and resonances vary, too.
_CLEAN = 0.7
# The same for other terms, whose coefficients are all at low frequencies.
_SOME = 0.02
# Share of the largest density below which a filter has stopped the noise.
_STOPPED = 1e-9
# Degrees of freedom of a block; windows, fewest and most; and blocks in a window at most.
_DEGREES, _FEWEST, _WINDOWS, _BLOCKS = 16, 4, 64, 16
# Standard deviations by which a burst stands above the median of so many blocks around it.
_BURST, _AROUND = 6.0, 33
# Scatter of neighbouring blocks, relative to Gaussian noise, above which it is taken into account.
_HEAVY = 1.1
# Probability below which variation is not chance; the slowest modes that are tested, and those that matter.
_CHANCE, _SLOW, _SLOWEST = 0.01, 4, 2
# Least power of a window, relative to the mean.
_NOTHING = 0.01
# Bins per octave in which a model's density is evaluated.
_FINE = 24


def with_variations(result: AxisFit, segments: Sequence[Samples], rate: float) -> AxisFit:
    """Fit of an axis with the variation of N, B and K over its segments, sampled at `rate` [Hz].

    The intervals of coefficients that vary allow for it. B and K are left out where the mean was modelled.
    """
    if not result.measured:
        return result
    cosines = [cosine_transform(x - x.mean()) for x in (x[: fast_length(len(x))] for x in segments)]
    found = dict(result.coefficients)
    for label in MAIN[:1] if result.regression else MAIN:
        c = found.get(label)
        if c is not None and c.detected and not c.held and c.std > 0.0:
            course = course_of(cosines, rate, result.model, label)
            found[label] = c if course is None else c.varying(course.variation())
    return result.with_estimates(found)


class Course(NamedTuple):
    """Relative change of a power in equal windows.

    Attributes:
        change: twice the change of the amplitude in each window, relative to its mean.
        variance: its variance without variation.
        louder: share of the record in bursts, which are left out.
        excess: relative power that these bursts add to the record.
    """

    change: Float[np.ndarray, " windows"]
    variance: float
    louder: float
    excess: float

    def variation(self) -> Variation:
        """Variation of the amplitude; its size is zero where chance explains it."""
        from scipy.fft import dct

        count, scale = len(self.change), 0.5 * np.sqrt(self.variance / len(self.change))
        modes = dct(self.change, norm="ortho")[1:] ** 2
        total, slow = modes.sum() / self.variance, modes[:_SLOW].sum() / self.variance
        chance = min(upper_tail(total, count - 1), upper_tail(slow, len(modes[:_SLOW])))
        if 2.0 * chance > _CHANCE:
            return Variation(louder=self.louder, excess=0.5 * self.excess)
        size = scale * np.sqrt(max(total - (count - 1), 0.0))
        ends = scale * amplitude_quantiles(total, count - 1, np.array([0.975, 0.025]))
        slowest = max(modes[:_SLOWEST].mean() - self.variance, 0.0)
        return Variation(
            float(size),
            (float(min(ends[0], size)), float(max(ends[1], size))),
            float(0.5 * np.sqrt(slowest / count)),
            self.louder,
            0.5 * self.excess,
        )


def course_of(cosines: Sequence[Cosines], rate: float, model: Model, label: str) -> Course | None:
    """Course of a term's power in a fitted model, given the coefficients of a record's segments.

    The first segment is the longest. There is none if the record is too short to show one.
    """
    if label == AngleRandomWalk.name():
        weights = _weights_of_white(cosines, rate, model)
    else:
        weights = _weights_at_low(len(cosines[0]) + 1, rate, model, label)
        cosines = [weights.without_ramp(c, rate) for c in cosines]
    if not weights.share.any():
        return None
    first = weights.shares(cosines[0])
    information = float(first @ first) * sum(map(len, cosines)) / len(cosines[0])
    windows = min(_WINDOWS, int(information / _DEGREES))
    if windows < _FEWEST:
        return None
    each = min(_BLOCKS, int(information / (_DEGREES * windows)))
    duration = sum(map(len, cosines)) / (windows * each)
    power = np.concatenate([weights.powers(c, int(len(c) / duration)) for c in cosines])
    power = power[: len(power) // each * each]
    squares, total = float(first @ first), float(first.sum())
    variance = 2.0 * squares / total**2 * (len(cosines[0]) / duration)
    gain = total / squares
    return None if len(power) < _FEWEST * each else _course(power, each, variance, gain)


class Weights(NamedTuple):
    """Share of a term in the density of cosine coefficients, in bins.

    Attributes:
        edges: first coefficient of each bin of the longest segment, and the one after the last.
        share: share of the term in each bin; zero where coefficients are left out.
        density: mean square of a coefficient in each bin [rate²].
    """

    edges: Int[np.ndarray, " bins+1"]
    share: Float[np.ndarray, " bins"]
    density: Float[np.ndarray, " bins"]

    def sizes(self, c: Cosines) -> Int[np.ndarray, " bins"]:
        """Number of coefficients of a segment in each bin, up to the last that is used."""
        places = np.rint(self.edges * ((len(c) + 1) / self.edges[-1])).astype(int)
        return np.diff(np.clip(places, 1, len(c) + 1)) * (np.cumsum(self.share[::-1])[::-1] > 0.0)

    def shares(self, c: Cosines) -> Float[np.ndarray, " k"]:
        """Share at each coefficient of a segment."""
        return np.repeat(self.share, self.sizes(c))

    def without_ramp(self, c: Cosines, rate: float) -> Cosines:
        """Coefficients of a segment without the best ramp in those that are used."""
        used = slice(self.sizes(c).sum())
        ramp, level = ramp_column(len(c) + 1, rate), np.repeat(self.density, self.sizes(c))
        weighed = ramp[used] / level
        return c - ramp * ((weighed @ c[used]) / (weighed @ ramp[used]))

    def powers(self, c: Cosines, blocks: int) -> Float[np.ndarray, " blocks"]:
        """Mean square of the weighed series in blocks of a segment, relative to its expectation.

        The first and the last block are left out: the kinks of the mirrored record make them louder.
        """
        from scipy.fft import idct, next_fast_len

        if blocks < 3:
            return np.zeros(0)
        root = np.repeat(np.sqrt(self.share / self.density), self.sizes(c))
        weighed = np.zeros(next_fast_len(len(root) + 1))
        weighed[1 : len(root) + 1] = root * c[: len(root)]
        squares = idct(weighed, norm="ortho") ** 2
        edges = np.rint(np.arange(blocks + 1) * (len(squares) / blocks)).astype(int)
        means = np.add.reduceat(squares, edges[:-1]) / np.diff(edges)
        return means[1:-1] * (len(squares) / self.shares(c).sum())


def _weights_of_white(cosines: Sequence[Cosines], rate: float, model: Model) -> Weights:
    """Weights of white noise, from the measured density."""
    n = len(cosines[0]) + 1
    edges, width = [1], round(max(_WIDEST * 2.0 * n / rate, _MOST))
    while _RELATIVE * edges[-1] < width and edges[-1] < n:
        edges.append(edges[-1] + max(_LEAST, round(_RELATIVE * edges[-1])))
    every = np.unique(np.minimum(np.append(edges, np.arange(edges[-1] + width, n + width, width)), n))
    power, count = np.zeros((2, len(every) - 1))
    for c in cosines:
        places = np.clip(np.rint(every * ((len(c) + 1) / n)).astype(int), 1, len(c) + 1)
        power += np.diff(np.concatenate([[0.0], np.cumsum(c * c)])[places - 1])
        count += np.diff(places)
    density = np.maximum(power / np.maximum(count, 1.0), 1e-300)
    middle = (every[:-1] + every[1:] - 1) * (rate / (4.0 * n))
    own, _ = _densities(model, AngleRandomWalk.name(), middle, rate)
    share = np.minimum(own / density, 1.0)
    # In a stop band there is nothing but rounding.
    left_out = (share < _CLEAN) | (density < _STOPPED * density.max())
    return Weights(every, np.where(left_out, 0.0, share), density)


def _weights_at_low(n: int, rate: float, model: Model, label: str) -> Weights:
    """Weights of a term that is strong at low frequencies, from the density of the model."""
    peaks = [term for term in model.terms if isinstance(term, Resonance)]
    bins = Bins.of(n, rate, [(p.frequency, p.width) for p in map(peak_of, peaks)], _FINE)
    own, total = _densities(model, label, bins.frequency, rate)
    share = own / total
    return Weights(bins.edges, np.where(share < _SOME, 0.0, share), total)


def _densities(
    model: Model, label: str, frequency: Float[np.ndarray, " m"], rate: float
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Density [rate²] of a term at frequencies [Hz], and of the model without its deterministic terms.

    White noise has that of all terms that a fit counts as N.
    """
    sampled, (own, total) = model.sampled(rate), np.full((2, len(frequency)), 1e-300)
    alone, white = exact_model(sampled), label == AngleRandomWalk.name()
    for name, unit, (power,), term in zip(
        alone.labels, alone.terms, alone.power.T, sampled.terms, strict=True
    ):
        if not term.deterministic:
            level = power * rate * np.asarray(unit.sampled_psd(frequency, rate))
            total += level
            own += level if name == label or (white and _is_white_at_low(term, rate)) else 0.0
    return own, total


def _is_white_at_low(term: NoiseTerm, rate: float) -> bool:
    """Whether a fit counts the term's density at low frequencies as N."""
    if isinstance(term, Resonance):
        return float(term.quality_factor or 0.0) < BROAD
    if isinstance(term, Markov):
        return float(term.correlation_time or 0.0) * rate < QUICK
    return isinstance(term, PowerLaw) and term.exponent == 0.0


def _course(power: Float[np.ndarray, " blocks"], each: int, variance: float, gain: float) -> Course:
    """Course in windows of so many blocks, given relative powers of the blocks and their variance.

    A relative change of the power is `gain` times as large in the term's own.
    """
    quiet, heavy = np.ones(len(power), bool), 1.0
    if each > 1:
        quiet = ~_bursts(power, variance)
        calm = power[quiet]
        heavy = float(np.mean(np.diff(calm) ** 2)) / (2.0 * variance)
    blocks, kept = power.reshape(-1, each), quiet.reshape(-1, each)
    total, count = np.where(kept, blocks, 0.0).sum(axis=1), kept.sum(axis=1)
    mean = power[quiet].mean()
    change = np.where(count > 0, total / np.maximum(count, 1) - mean, 0.0) * gain
    # Twice the change of the amplitude, which is that of the power where it is small.
    amplitude = np.sqrt(np.maximum(1.0 + change, _NOTHING))
    change = 2.0 * (amplitude / amplitude.mean() - 1.0)
    variance *= gain**2 / each * (heavy if heavy > _HEAVY else 1.0)
    excess = (power.mean() - mean) * gain
    return Course(change, variance, float(1.0 - quiet.mean()), float(excess))


def _bursts(power: Float[np.ndarray, " blocks"], variance: float) -> Bool[np.ndarray, " blocks"]:
    """Which blocks are far louder than those around them."""
    from scipy.ndimage import median_filter

    root = np.cbrt(power)
    # The cube root of a power is nearly normal.
    usual = np.sqrt(variance) / 3.0 * root.mean()
    scatter = max(usual, bulk_std(np.diff(root)) / np.sqrt(2.0))
    return root - median_filter(root, _AROUND, mode="nearest") > _BURST * scatter
