"""Outliers: single samples far from their prediction by all others."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float, Int
from scipy.fft import dct, rfft
from scipy.optimize import minimize
from scipy.stats import norm

from allanjax.critic.bank import any_of, folds
from allanjax.critic.effect import Effect
from allanjax.critic.gap_filling import impute_gaussian
from allanjax.critic.parameters import Limit, values_of
from allanjax.critic.policy import judged
from allanjax.critic.view import Candidate, View
from allanjax.critic.waveform import shape_parameter
from allanjax.noise.estimate import Estimate
from allanjax.record.completion import GAPS_AT_ONCE, in_time, inverses, lags_of

# Scales of outliers, in standard deviations of the noise, and shares of samples that are compared.
_SCALES = np.geomspace(3.0, 3e4, 25)
_SHARES = np.geomspace(1e-7, 0.1, 40)
# Scores below this could be noise as well.
_NOTICED = 3.0
# Score above which samples count singly; below it they count in bins of this width.
_LOUD, _FINE = 8.0, 0.02
# Smallest gain in log-likelihood that is examined more closely [nats], before the trials factor.
_WORTH = 8.0
_ODDS, _APART, _LONGEST = (judged("outliers", name) for name in ("odds", "apart", "longest"))
# Samples at each end of the record whose scatter is computed; most rounds of the search for neighbours.
_END, _ROUNDS = 16, 5
# Neighbouring samples that are held out together.
_FOLD_BLOCK = 16
# Scales over which the posterior of the scale is computed.
_WEIGHED = 201


class Outliers(Effect):
    """Errors in a share of the samples that are much larger than the noise."""

    name = "outliers"
    refit = "at last"

    def p_value(self, view: View) -> float:
        return _p_value(float(np.max(abs(_scores(view, view.loo_residuals[1])))), view.n)

    def detect(self, view: View) -> Candidate | None:
        # A robust scale: that of the fit includes the outliers.
        bulk = 1.4826 * float(np.median(abs(view.loo_residuals[0])))
        if bulk == 0.0:
            return None
        z = _scores(view, bulk)
        gain, share, scale = _mixture(z)
        if gain < _WORTH:
            return None
        threshold = _threshold(share, scale)
        found = _found(view, z, bulk, threshold)
        if found is None or len(found[0]) == 0:
            return None
        times, scores = found
        missing = np.zeros(view.n, bool)
        missing[times] = True
        after = impute_gaussian(view, missing)
        gain -= _log_trials_factor(view.n)
        # For all outliers, including those too small to be detected.
        log_scale, spread, limit = _log_scale(scores, threshold)
        estimates = [
            view.estimate("count", len(times), np.sqrt(len(times) * 0.05), "1"),
            view.log_estimate("scale", log_scale + np.log(bulk / view.scale), spread, limit, view.axis.unit),
        ]
        p_value = _p_value(float(np.max(abs(z))), view.n)
        sizes = view.samples[times] - after.samples[times]
        return Candidate(
            self.name,
            estimates,
            float(gain),
            p_value,
            after,
            lambda: _held_out(z),
            (times[0] / view.rate, times[-1] / view.rate),
            details={
                "times": _each(view.estimate("time", 0.0, 1.0 / view.rate, "s"), times / view.rate),
                "sizes": _each(view.amplitude_estimate("size", 0.0, bulk), sizes / view.scale),
            },
            bound=float(np.exp(-max(gain, 0.0))),
        )

    def again(self, view: View, found: Candidate) -> Candidate:
        """Finding of the same samples, imputed with the present noise."""
        missing = np.zeros(view.n, bool)
        times = np.array(values_of(found.details["times"])[0], float)
        missing[np.rint(times * view.rate).astype(int)] = True
        return dataclasses.replace(found, after=impute_gaussian(view, missing))


def _each(first: Estimate, values: Float[np.ndarray, " k"]) -> tuple[Estimate, ...]:
    """Estimates like one of zero, of other values with the same error."""
    (low, high), (inner, outer) = first.interval, first.interval_68
    return tuple(
        dataclasses.replace(first, value=x, interval=(x + low, x + high), interval_68=(x + inner, x + outer))
        for x in values.tolist()
    )


def _found(
    view: View, z: Float[np.ndarray, " n"], bulk: float, threshold: float
) -> tuple[Int[np.ndarray, " k"], Float[np.ndarray, " k"]] | None:
    """Samples above a threshold and their scores; None if a train of them is too long for outliers.

    A large outlier hides others next to it, which are seen once it is replaced by its prediction from all
    other samples, in the noise without it.
    """
    v, scores, seen = view.variance(), np.zeros(view.n), z
    lags, pulls = lags_of(1.0 / v), view.loo_residuals[0] * float(np.mean(1.0 / v))
    for _ in range(_ROUNDS):
        loud = np.flatnonzero(abs(seen) > threshold)
        if len(loud) == 0:
            break
        peaks = _peaks(seen, loud)
        if peaks is None:
            return None
        scores[peaks] = seen[peaks]
        times = np.flatnonzero(scores)
        parts = np.split(pulls[times], range(GAPS_AT_ONCE, len(times), GAPS_AT_ONCE))
        excess = [inverse @ part for inverse, part in zip(inverses(times, lags), parts, strict=True)]
        seen = _without(view, times, np.concatenate(excess), bulk)
    times = np.flatnonzero(scores)
    return times, scores[times]


def _without(
    view: View, times: Int[np.ndarray, " k"], excess: Float[np.ndarray, " k"], bulk: float
) -> Float[np.ndarray, " n"]:
    """Scores of a record without the excess of some samples over their prediction from all others."""
    spikes = np.zeros(view.n)
    spikes[times] = excess
    c = dct(spikes, norm="ortho", workers=-1)[1:]
    v = view.variance(view.noise_without(c))
    seen = in_time((view.residual - c) / v) / (float(np.mean(1.0 / v)) * bulk)
    seen[times] = 0.0
    return _at_ends(np.where(view.imputed, 0.0, seen), v)


def _p_value(largest: float, n: int) -> float:
    """Probability that one of n normal scores is larger."""
    return any_of(2.0 * float(norm.sf(largest)), n)


def _peaks(z: Float[np.ndarray, " n"], loud: np.ndarray) -> np.ndarray | None:
    """Largest score of each group of neighbours; None if a group is longer than that of an outlier."""
    groups = np.split(loud, np.flatnonzero(np.diff(loud) > _APART) + 1)
    if max(g[-1] - g[0] for g in groups) > _LONGEST:
        return None
    return np.array([g[np.argmax(abs(z[g]))] for g in groups])


def _log_trials_factor(n: int) -> float:
    """Log trials factor of share and scale [nats], each of which may be anywhere in its grid."""
    return float(np.log(len(_SCALES)) + np.log(np.log(n)))


def _log_ratio(
    z: Float[np.ndarray, " k"], share: float, scale: Float[np.ndarray, " scales"] | float
) -> Float[np.ndarray, "k scales"]:
    """Log-likelihood ratio of the mixture to noise at z: ln[(1 − ε) + ε·N(0, 1 + s²)/N(0, 1)]."""
    s2 = np.asarray(scale) ** 2
    exponent = 0.5 * z[:, None] ** 2 * s2 / (1.0 + s2) - 0.5 * np.log1p(s2)
    return np.logaddexp(np.log1p(-share), np.log(share) + exponent)


def _mixture(z: Float[np.ndarray, " n"]) -> tuple[float, float, float]:
    """Log-likelihood ratio of the best mixture to noise alone [nats], its share and scale."""
    size = abs(z)
    if not np.any(size > _NOTICED):
        return 0.0, 0.0, 1.0
    # A coarse histogram suffices for the quiet ones; the few loud ones count singly.
    parts = (60, 0.0, _NOTICED), (round((_LOUD - _NOTICED) / _FINE), _NOTICED, _LOUD)
    found = [np.histogram(size, count, (low, high)) for count, low, high in parts]
    counts = np.concatenate([count for count, _ in found])
    centres = np.concatenate([0.5 * (edges[1:] + edges[:-1]) for _, edges in found])
    few = size[size > _LOUD]

    def values(share: float, scale: Float[np.ndarray, " scales"]) -> Float[np.ndarray, " scales"]:
        return _log_ratio(few, share, scale).sum(axis=0) + counts @ _log_ratio(centres, share, scale)

    best = (0.0, 0.0, 1.0)
    for share in _SHARES[_SHARES * len(z) > 0.3]:
        value = values(share, _SCALES)
        k = int(np.argmax(value))
        if value[k] > best[0]:
            best = (float(value[k]), float(share), float(_SCALES[k]))
    gain, share, scale = best
    if gain == 0.0:
        return 0.0, 0.0, 1.0
    refined = minimize(
        lambda u: -float(values(min(np.exp(u[0]), 0.5), np.exp(u[1:]))[0]),
        np.log([share, scale]),
        method="Nelder-Mead",
        options={"xatol": 0.01, "fatol": 0.01},
    )
    share, scale = np.exp(refined.x)
    return -float(refined.fun), float(min(share, 0.5)), float(scale)


def _log_scale(found: Float[np.ndarray, " k"], threshold: float) -> tuple[float, float, Limit]:
    """Log scale of outliers, whose law is truncated at a threshold, and its deviation; or a limit."""
    log = np.linspace(np.log(0.1), np.log(10.0), _WEIGHED) + np.log(np.sqrt(np.mean(found**2)))
    width = np.sqrt(1.0 + np.exp(2.0 * log))
    each = norm.logpdf(found[:, None] / width) - np.log(width) - norm.logsf(threshold / width)
    total = each.sum(axis=0)
    return shape_parameter(log, np.exp(total - total.max()))


def _threshold(share: float, scale: float) -> float:
    """Score above which a sample counts as drawn from the wider of the two laws."""
    s2 = scale**2
    least = _ODDS - np.log(share / (1.0 - share)) + 0.5 * np.log1p(s2)
    return float(np.sqrt(2.0 * max(least, 0.0) * (1.0 + s2) / s2))


def _scores(view: View, scale: float) -> Float[np.ndarray, " n"]:
    """Leave-one-out residuals over their scale, zero where samples were imputed."""
    return _at_ends(np.where(view.imputed, 0.0, view.loo_residuals[0] / scale), view.variance())


def _at_ends(z: Float[np.ndarray, " n"], v: Float[np.ndarray, " n-1"]) -> Float[np.ndarray, " n"]:
    """Scores, of which those that stand out at the ends are compared with the scatter there.

    Quantization noise at the ends differs from that of the mirrored record, so residuals scatter more.
    """
    n = len(z)
    for k in (*range(_END), *range(n - _END, n)):
        if abs(z[k]) > _NOTICED:
            sample = np.zeros(n)
            sample[k] = 1.0
            weight = in_time(dct(sample, norm="ortho", workers=-1)[1:] / v) / float(np.mean(1.0 / v))
            # Its variance from the density, in a record so long that the ends do not interact.
            response = np.abs(rfft(weight, 2 * n, workers=-1)[1:n]) ** 2
            z[k] /= max(1.0, np.sqrt(float(response @ v) / n * np.mean(1.0 / v)))
    return z


def _held_out(z: Float[np.ndarray, " n"]) -> float:
    """Gain in log-likelihood [nats] on parts of the samples with the mixture from the other parts.

    If the others have none, outliers are taken to be rare and of any scale: a single one can be predicted.
    """
    gain = 0.0
    for part in folds(len(z), _FOLD_BLOCK):
        _, share, scale = _mixture(z[~part])
        if share > 0.0:
            gain += float(_log_ratio(z[part], share, scale).sum())
        else:
            each = _log_ratio(z[part], 0.5 / np.sum(~part), _SCALES)
            gain += float(np.sum(np.logaddexp.reduce(each, axis=1) - np.log(len(_SCALES))))
    return gain
