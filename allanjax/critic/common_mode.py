"""Noise that several axes share, e.g. from a power supply, a clock or the floor."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator, Mapping, Sequence
from typing import TypeAlias

import numpy as np
from jaxtyping import Float
from scipy.special import betainc

from allanjax.critic.bank import any_of, folds
from allanjax.critic.finding import Finding, Limit, parameter_estimate
from allanjax.critic.noise import NEARLY_ALL, WHITE
from allanjax.critic.policy import judged
from allanjax.critic.stage import Stage
from allanjax.record.recording import Axis

NAME = "common_mode"
# Correlations are searched for in all coefficients, in their lowest quarter, in its lowest quarter, ….
_SPLIT = 4
_LEAST, _WEAKEST = judged("common_mode", "least"), judged("common_mode", "weakest")
# Neighbouring coefficients that are held out together.
_FOLD_BLOCK = 32
# Largest correlation that is estimated, as no two axes are identical.
_STRONGEST = 0.999

#: Numbers of two axes.
Pair: TypeAlias = tuple[int, int]


@dataclasses.dataclass(frozen=True, eq=False)
class _Band:
    """The lowest whitened coefficients of all axes, and the share of one kind of noise in their squares."""

    noise: str
    z: Float[np.ndarray, "axes k"]
    share: Float[np.ndarray, "axes k"]

    @functools.cached_property
    def size(self) -> Float[np.ndarray, "axes axes"]:
        """Effective number of coefficients: without shared noise the correlation's variance is 1/size."""
        return self.share @ self.share.T

    @functools.cached_property
    def correlation(self) -> Float[np.ndarray, "axes axes"]:
        """Correlations of this noise; 0 for axes with too little of it."""
        own, level = self.z * np.sqrt(self.share), np.sqrt(np.mean(self.z**2, axis=1))
        enough = np.where(self.size < _LEAST, np.inf, self.size)
        return np.clip(own @ own.T / np.outer(level, level) / enough, -_STRONGEST, _STRONGEST)

    @functools.cached_property
    def p_value(self) -> Float[np.ndarray, "axes axes"]:
        """Probabilities that independent axes have a larger |r|: r² ~ Beta(½, (k−1)/2) for k pairs."""
        return betainc((np.maximum(self.size, _LEAST) - 1.0) / 2.0, 0.5, 1.0 - self.correlation**2)

    def common(self, pair: Pair) -> Float[np.ndarray, " k"]:
        """Expected products of two axes' coefficients if this noise were identical in both."""
        return np.sqrt(np.prod(self.share[list(pair)], axis=0))

    def evidence(self, pair: Pair) -> float:
        """Gain in log-likelihood by the correlation of two axes [nats]."""
        return -0.5 * float(np.sum(np.log1p(-((self.correlation[pair] * self.common(pair)) ** 2))))

    def held_out(self, pair: Pair) -> float:
        """Gain in log-likelihood of an axis given the other, with the correlation from the other folds."""
        a, b = (x / np.sqrt(np.mean(x**2)) for x in self.z[list(pair)])
        share, gain = self.common(pair), 0.0
        for part in folds(len(a), min(_FOLD_BLOCK, max(len(a) // 64, 1))):
            rest = share[~part]
            r = np.clip(rest @ (a * b)[~part] / (rest @ rest), -_STRONGEST, _STRONGEST) * share[part]
            left = (b[part] - r * a[part]) ** 2 / (1.0 - r**2)
            gain += 0.5 * float(np.sum(b[part] ** 2 - left - np.log1p(-(r**2))))
        return gain


def common_mode(records: Sequence[Stage], alpha: float) -> list[Finding]:
    """Groups of axes with correlated whitened coefficients; `alpha` is the probability of a false finding."""
    pairs = [(a, b) for a in range(len(records)) for b in range(a)]
    bands = _bands(records) if pairs else []
    linked, p_values = dict[Pair, _Band](), dict[Pair, float]()
    for pair in pairs:
        tested = [band for band in bands if band.size[pair] >= _LEAST]
        best = min(tested, key=lambda band: band.p_value[pair])
        p = any_of(float(best.p_value[pair]), len(pairs) * len(tested))
        if p < alpha and best.held_out(pair) > 0.0:
            linked[pair], p_values[pair] = best, p
    found = []
    for group in _groups({pair: abs(band.correlation[pair]) for pair, band in linked.items()}):
        p = min(p_values[pair] for pair in group)
        found.append(_finding(records, bands, {pair: linked[pair] for pair in group}, p))
    return found


def _bands(records: Sequence[Stage]) -> list[_Band]:
    """All noise and the white noise, each in all parts of the spectrum in which axes may share it."""
    z = np.stack([record.whitened_coefficients for record in records])
    white = np.stack([record.share(WHITE) for record in records])
    # If nearly all noise is white, white noise and all noise are the same.
    white[white.mean(axis=1) > NEARLY_ALL] = 0.0
    tops = [z.shape[1]]
    while tops[-1] // _SPLIT >= _LEAST:
        tops.append(tops[-1] // _SPLIT)
    shares = {"all": np.broadcast_to(1.0, z.shape), "white": white}
    return [_Band(noise, z[:, :top], share[:, :top]) for noise, share in shares.items() for top in tops]


def _groups(strength: Mapping[Pair, float]) -> Iterator[list[Pair]]:
    """Pairs linked directly or through others, the strongest first; much weaker ones are other groups."""
    left = dict(strength)
    while left:
        first = max(left, key=lambda pair: left[pair])
        near, axes = [pair for pair in left if left[pair] >= _WEAKEST * left[first]], {*first}
        for _ in near:
            axes |= {k for pair in near if axes & {*pair} for k in pair}
        yield [pair for pair in near if axes & {*pair}]
        left = {pair: size for pair, size in left.items() if not axes & {*pair}}


def _finding(
    records: Sequence[Stage], bands: Sequence[_Band], linked: Mapping[Pair, _Band], p_value: float
) -> Finding:
    """Finding of the noise that a group of axes shares, of the kind that explains most in all pairs."""
    tops = {band.z.shape[1] for band in linked.values()}
    bands = [b for b in bands if b.z.shape[1] in tops and all(b.size[pair] >= _LEAST for pair in linked)]
    # Pairs with a minus sign share noise of opposite sign.
    sizes = np.array([[abs(band.correlation[pair]) for pair in linked] for band in bands])
    # Pairs that share hardly anything in this kind of noise are left out, as they share another kind.
    strong = sizes >= _WEAKEST * sizes.max(axis=1, keepdims=True)
    evidence = np.sum(strong * [[band.evidence(pair) for pair in linked] for band in bands], axis=1)
    best, means = int(np.argmax(evidence)), np.average(sizes, axis=1, weights=strong)
    band, mean = bands[best], float(means[best])
    pairs = [pair for pair, is_strong in zip(linked, strong[best], strict=True) if is_strong]
    # Which noise is correlated is part of the uncertainty.
    spread = np.average((means - mean) ** 2, weights=np.exp(evidence - evidence[best]))
    share = np.mean([band.common(pair) for pair in pairs], axis=0)
    std = np.sqrt(_variance(mean, share, len(pairs)) + spread)
    every = [record.axis for record in records]
    axes = [every[k] for k in sorted({k for pair in linked for k in pair})]
    names = tuple(axis.name for axis in axes)
    together = Axis(" and ".join(names), axes[0].sensor, axes[0].unit)
    limit: Limit = "" if mean < _STRONGEST - 1e-9 else "above"
    signs = (
        f"{every[a].name}/{every[b].name}: {own.correlation[a, b]:+.3g}" for (a, b), own in linked.items()
    )
    spacing = records[0].rate / (2.0 * records[0].n)
    return Finding(
        cause=NAME,
        axes=names,
        parameters={"correlation": parameter_estimate(together, "correlation", mean, std, "1", limit)},
        p_value=p_value,
        evidence=float(evidence[best]),
        gain=sum(band.held_out(pair) for pair in pairs),
        rivals=(),
        span=(spacing, band.z.shape[1] * spacing),
        domain="frequency",
        details={"axes": names, "noise": band.noise, "pairs": tuple(signs)},
    )


def _variance(r: float, share: Float[np.ndarray, " k"], pairs: int) -> float:
    """Variance of the mean correlation of pairs that share axes, all correlations being about r.

    It follows from the moments of normal variates with correlations r·share, divided by estimates of their
    mean squares; for shares of 1 it is that of Olkin & Siotani (1976).
    """
    k, S = len(share), float(share @ share)
    third, fourth = (float(np.sum(share**p)) / S for p in (3, 4))
    square = r**2 * S / k
    own = (1.0 + r**2 * fourth) / S - r**2 * (3.0 - square) / k
    common = (r * third + r**2 * fourth) / S - 2.0 * r**2 * (1.0 + r * third) / k
    common += 0.5 * r**2 * (1.0 + 3.0 * square) / k
    return max(own / pairs + (1.0 - 1.0 / pairs) * common, 0.0)
