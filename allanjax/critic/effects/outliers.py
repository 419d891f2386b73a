"""Outliers: single samples far from their prediction by all others."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.fft import dct, dst
from scipy.optimize import minimize
from scipy.stats import binom, norm

from allanjax.base.normal import bulk_std
from allanjax.critic.bank import PARTS, any_of, owners, shape_parameter
from allanjax.critic.effect import Candidate, Effect, View
from allanjax.critic.finding import Limit, values_of
from allanjax.critic.imputation import impute_gaussian
from allanjax.critic.noise import Noise
from allanjax.critic.policy import judged
from allanjax.record.completion import GAPS_AT_ONCE, in_time, inverses, lags_of

# Scales of outliers, in standard deviations of the noise, and shares of samples that are compared.
_SCALES = np.geomspace(3.0, 3e4, 25)
_SHARES = np.geomspace(1e-7, 0.1, 40)
# Scores at the ends below this could be noise as well.
_NOTICED = 3.0
# Width and number of the bins of scores. The last one, from 10 on, has only outliers.
_FINE, _BINS = 0.02, 501
# Smallest gain in log-likelihood that is examined more closely [nats], before the trials factor.
_WORTH = 8.0
_ODDS, _APART, _LONGEST, _GROUPS, _CHANCE = (
    judged("outliers", name) for name in ("odds", "apart", "longest", "groups", "chance")
)
# Samples at each end of the record whose scatter is computed; most rounds of the search for neighbours.
_END, _ROUNDS = 16, 5
# Neighbouring samples that are held out together.
_FOLD_BLOCK = 16
# Scales over which the posterior of the scale is computed.
_WEIGHED = 201


class Outliers(Effect):
    """Errors in a share of the samples that are much larger than the noise."""

    name = "outliers"
    is_event = True
    refit = "at last"

    def p_value(self, view: View) -> float:
        left, scale = view.loo_residuals
        return _p_value(_scores(view, left / scale))

    def detect(self, view: View) -> Candidate | None:
        # A robust scale: that of the fit includes the outliers.
        left = view.loo_residuals[0]
        bulk = bulk_std(left)
        if bulk == 0.0:
            return None
        z = _scores(view, left / bulk)
        bins = _binned(z)
        mixture = _mixture(*bins.sum(axis=-1))
        if mixture.gain < _WORTH:
            return None
        found = _found(view, z, bulk, mixture.threshold)
        if found is None:
            return None
        scores, after = found
        times = np.flatnonzero(scores)
        # Share and scale may be anywhere in their grids.
        gain = mixture.gain - float(np.log(len(_SCALES)) + np.log(np.log(view.n)))
        # For all outliers, including those too small to be detected.
        log_scale, spread, limit = _log_scale(scores[times], mixture.threshold)
        log_scale += float(np.log(bulk / view.scale))
        sizes = view.samples[times] - after.samples[times]
        return Candidate(
            self.name,
            [
                # Of those that are seen one in twenty may be noise.
                view.estimate("count", len(times), np.sqrt(len(times) * 0.05), "1"),
                view.log_estimate("scale", log_scale, spread, limit, view.axis.unit),
            ],
            gain,
            _p_value(z),
            after,
            lambda: _held_out(bins),
            (times[0] / view.rate, times[-1] / view.rate),
            details={
                "times": tuple(view.estimate("time", k / view.rate, 1.0 / view.rate, "s") for k in times),
                "sizes": tuple(view.amplitude_estimate("size", size, bulk) for size in sizes),
            },
            bound=float(np.exp(-max(gain, 0.0))),
            doubt=_doubt(times, view.n),
        )

    def again(self, view: View, found: Candidate) -> Candidate:
        """Finding of the same samples, imputed with the present noise."""
        missing = np.zeros(view.n, bool)
        times = np.array(values_of(found.details["times"])[0], float)
        missing[np.rint(times * view.rate).astype(int)] = True
        return dataclasses.replace(found, after=impute_gaussian(view, missing))


def _found(
    view: View, z: Float[np.ndarray, " n"], bulk: float, threshold: float
) -> tuple[Float[np.ndarray, " n"], View] | None:
    """Scores above a threshold, zero for all other samples, and a view in which these samples are imputed.

    A large outlier hides others next to it, which are seen once its excess over its prediction from all other
    samples is subtracted, in the noise without it. None without any, or if a train of them is too long.
    """
    v, scores = view.variance(), np.zeros(view.n)
    lags, pulls = lags_of(1.0 / v), view.loo_residuals[0] * float(np.mean(1.0 / v))
    for _ in range(_ROUNDS):
        loud = np.flatnonzero(abs(z) > threshold)
        if len(loud) == 0:
            break
        groups = np.split(loud, np.flatnonzero(np.diff(loud) > _APART) + 1)
        if max(group[-1] - group[0] for group in groups) > _LONGEST:
            return None
        peaks = [group[np.argmax(abs(z[group]))] for group in groups]
        scores[peaks] = z[peaks]
        times, excess = np.flatnonzero(scores), np.zeros(view.n)
        parts = np.split(pulls[times], range(GAPS_AT_ONCE, len(times), GAPS_AT_ONCE))
        each = (inverse @ part for inverse, part in zip(inverses(times, lags), parts, strict=True))
        excess[times] = np.concatenate([*each])
        c = dct(excess, norm="ortho", workers=-1)[1:]
        noise = view.noise_without(c)
        v = view.variance(noise)
        left = in_time((view.residual - c) / v) / (float(np.mean(1.0 / v)) * bulk)
        z = _scores(view, left, noise)
        z[times] = 0.0
    return (scores, impute_gaussian(view, scores != 0.0)) if scores.any() else None


def _p_value(z: Float[np.ndarray, " n"]) -> float:
    """Probability that one of as many normal scores is larger than the largest of these."""
    return any_of(2.0 * float(norm.sf(np.max(abs(z)))), len(z))


def _doubt(times: Int[np.ndarray, " k"], n: int) -> str:
    """Why large errors at these samples are hardly outliers: they come in groups, unlike independent ones.

    A few groups may be knocks, and what lasts a few samples is one outlier.
    """
    starts = times[:1].tolist()
    for time in times.tolist():
        if time - starts[-1] > _APART:
            starts.append(time)
    gaps = np.diff(starts)
    for longest in _APART * 2.0 ** np.arange(1.0, np.log2(n / _APART)):
        near = gaps <= longest
        # Of independent outliers, the next one is so near with this probability.
        chance = binom.sf(np.count_nonzero(near) - 1, len(gaps), -np.expm1(-len(starts) * longest / n))
        groups = np.count_nonzero(np.diff(near.astype(int), prepend=0) > 0)
        if chance < _CHANCE and groups > _GROUPS:
            return "they come in groups"
    return ""


class _Mixture(NamedTuple):
    """Scores of which a share has a wider law: its gain over noise alone [nats], the share and the scale."""

    gain: float
    share: float
    scale: float

    @property
    def threshold(self) -> float:
        """Score above which a sample counts as drawn from the wider of the two laws."""
        s2 = self.scale**2
        least = _ODDS - np.log(self.share / (1.0 - self.share)) + 0.5 * np.log1p(s2)
        return float(np.sqrt(2.0 * max(least, 0.0) * (1.0 + s2) / s2))


def _log_ratio(
    squares: Float[np.ndarray, " k"], share: float, scale: Float[np.ndarray, " scales"] | float
) -> Float[np.ndarray, " k *scales"]:
    """Log-likelihood ratio of the mixture to noise at squared z: ln[(1 − ε) + ε·N(0, 1 + s²)/N(0, 1)]."""
    s2 = np.square(scale)
    exponent = np.multiply.outer(squares, 0.5 * s2 / (1.0 + s2)) - 0.5 * np.log1p(s2)
    return np.logaddexp(np.log1p(-share), np.log(share) + exponent)


def _binned(z: Float[np.ndarray, " n"]) -> Float[np.ndarray, "2 bins parts"]:
    """Number of scores in each bin of their magnitudes and each held-out part, and sums of their squares.

    The log-likelihood ratio is nearly linear in the squares within a bin, and beyond the last edge.
    """
    cell = np.minimum(abs(z) / _FINE, _BINS - 1).astype(int) * PARTS + owners(len(z), _FOLD_BLOCK)
    sums = [np.bincount(cell, weights, _BINS * PARTS) for weights in (None, z**2)]
    return np.reshape(sums, (2, _BINS, PARTS))


def _occupied(
    counts: Float[np.ndarray, " bins"], squares: Float[np.ndarray, " bins"]
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Number of scores in the bins that have some, and their mean squares."""
    some = counts > 0.0
    return counts[some], squares[some] / counts[some]


def _mixture(counts: Float[np.ndarray, " bins"], squares: Float[np.ndarray, " bins"]) -> _Mixture:
    """Best mixture; the share is zero if noise alone explains as much."""
    n = counts.sum()
    counts, squares = _occupied(counts, squares)
    shares = _SHARES[_SHARES * n > 0.3]
    values = np.stack([counts @ _log_ratio(squares, share, _SCALES) for share in shares])
    i, j = np.unravel_index(int(np.argmax(values)), values.shape)
    if values[i, j] <= 0.0:
        return _Mixture(0.0, 0.0, 1.0)
    best = minimize(
        lambda u: -float(counts @ _log_ratio(squares, *np.exp(u))),
        np.log([shares[i], _SCALES[j]]),
        method="Nelder-Mead",
        bounds=[(None, np.log(0.5)), (None, None)],
        options={"xatol": 0.01, "fatol": 0.01},
    )
    return _Mixture(-float(best.fun), *np.exp(best.x).tolist())


def _held_out(bins: Float[np.ndarray, "2 bins parts"]) -> float:
    """Gain in log-likelihood [nats] on parts of the samples with the mixture from the other parts.

    If the others have none, outliers are taken to be rare and of any scale: a single one can be predicted.
    """
    gain = 0.0
    for part in range(PARTS):
        others = bins.sum(axis=-1) - bins[..., part]
        counts, squares = _occupied(*bins[..., part])
        _, share, scale = _mixture(*others)
        if share > 0.0:
            gain += float(counts @ _log_ratio(squares, share, scale))
        else:
            each = _log_ratio(squares, 0.5 / others[0].sum(), _SCALES)
            gain += float(counts @ (np.logaddexp.reduce(each, axis=1) - np.log(len(_SCALES))))
    return gain


def _log_scale(found: Float[np.ndarray, " k"], threshold: float) -> tuple[float, float, Limit]:
    """Log scale of outliers, whose law is truncated at a threshold, and its deviation; or a limit."""
    root = np.sqrt(np.mean(found**2))
    log = np.linspace(np.log(0.1), np.log(10.0), _WEIGHED) + np.log(root)
    width = np.sqrt(1.0 + np.exp(2.0 * log))
    total = len(found) * (norm.logpdf(root / width) - np.log(width) - norm.logsf(threshold / width))
    return shape_parameter(log, np.exp(total - total.max()))


def _scores(view: View, left: Float[np.ndarray, " n"], noise: Noise | None = None) -> Float[np.ndarray, " n"]:
    """Leave-one-out residuals over their scale, near the ends over that there; 0 for imputed samples."""
    z = np.where(view.imputed, 0.0, left)
    for k in (*range(_END), *range(view.n - _END, view.n)):
        if abs(z[k]) > _NOTICED:
            z[k] /= view.once(_excess_scatter, k) if noise is None else _excess_scatter(view, k, noise)
    return z


def _excess_scatter(view: View, place: int, noise: Noise | None = None) -> float:
    """Scatter of the leave-one-out residual of a sample near an end, over that of others; 1 at least.

    Quantization noise at the ends differs from that of the mirrored record, so residuals scatter more.
    """
    v, sample = view.variance(noise), np.zeros(view.n)
    sample[place] = 1.0
    even = dct(sample, norm="ortho", workers=-1)[1:] / v
    odd = dst(in_time(even), norm="ortho", workers=-1)[:-1]
    # Its variance from the density, in a record so long that the ends do not interact.
    response = 0.5 * float((even**2 + odd**2) @ v)
    return max(1.0, float(np.sqrt(response / np.mean(1.0 / v))))
