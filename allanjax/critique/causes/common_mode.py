"""Noise that several axes share: a supply, a clock, the floor."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from jaxtyping import Float
from scipy.special import betainc

from allanjax.critique.bank import folds
from allanjax.critique.result import Finding
from allanjax.critique.view import Quantity

NAME = "common_mode"
# Correlations are looked for in all coefficients, in the lowest quarter, its lowest quarter, and so on.
_SPLIT = 4
_LEAST = 64
_FOLD_BLOCK = 32
_WEAKEST = 0.2

#: Pairs of axes: p-value, correlation, and in how many of the lowest coefficients.
Links: TypeAlias = dict[tuple[int, int], tuple[float, float, int]]


def common_mode(
    names: Sequence[str], z: Sequence[Float[np.ndarray, " n-1"]], rate: float, alpha: float
) -> list[Finding]:
    """Groups of axes whose whitened cosine coefficients are correlated.

    Args:
        names: of the axes.
        z: their whitened coefficients.
        rate: sample rate [Hz].
        alpha: probability of a false finding.
    """
    n = len(z[0]) + 1
    tops = [n - 1]
    while tops[-1] // _SPLIT >= _LEAST:
        tops.append(tops[-1] // _SPLIT)
    pairs = [(a, b) for a in range(len(z)) for b in range(a)]
    trials = len(pairs) * len(tops)
    linked: Links = {}
    for a, b in pairs:
        found = []
        for top in tops:
            r = _correlation(z[a][:top], z[b][:top])
            found.append((_p_value(r, top), r, top))
        p, r, top = min(found)
        p = float(-np.expm1(trials * np.log1p(-min(p, 1.0 - 1e-12))))
        if p < alpha and _held_out(z[a][:top], z[b][:top]) > 0.0:
            linked[a, b] = p, r, top
    return [_finding(names, z, group, linked, rate, n) for group in _groups(linked)]


def _finding(
    names: Sequence[str],
    z: Sequence[Float[np.ndarray, " n-1"]],
    group: set[int],
    linked: Links,
    rate: float,
    n: int,
) -> Finding:
    members = {pair: link for pair, link in linked.items() if set(pair) <= group}
    strongest = max(members, key=lambda pair: abs(members[pair][1]))
    members = {k: m for k, m in members.items() if abs(m[1]) >= _WEAKEST * abs(members[strongest][1])}
    p, r, top = members[strongest]
    # The mean over the pairs, of which those with a minus sign share noise of opposite sign.
    mean = float(np.mean([abs(link[1]) for link in members.values()]))
    axes = tuple(names[k] for k in sorted(group))
    gain = sum(_held_out(z[a][: m[2]], z[b][: m[2]]) for (a, b), m in members.items())
    signs = tuple(f"{names[a]}/{names[b]}: {link[1]:+.3g}" for (a, b), link in sorted(members.items()))
    return Finding(
        cause=NAME,
        axes=axes,
        parameters={
            "axes": Quantity(axes, 0.0, ""),
            "correlation": Quantity(mean, float((1.0 - mean**2) / np.sqrt(top)), "1"),
            "pairs": Quantity(signs, 0.0, ""),
        },
        p_value=p,
        evidence=float(-0.5 * top * np.log1p(-(r**2))),
        gain=float(gain),
        rivals=(),
        span=(rate / (2.0 * n), top * rate / (2.0 * n)),
        domain="frequency",
    )


def _correlation(a: Float[np.ndarray, " k"], b: Float[np.ndarray, " k"]) -> float:
    return float(a @ b / np.sqrt((a @ a) * (b @ b)))


def _p_value(r: float, k: int) -> float:
    """P(|correlation| of k independent pairs of zero mean > |r|): (r² has the Beta(½, (k−1)/2) law)."""
    return float(betainc((k - 1.0) / 2.0, 0.5, 1.0 - r**2))


def _held_out(a: Float[np.ndarray, " k"], b: Float[np.ndarray, " k"]) -> float:
    """Log-likelihood of one axis's coefficients given the other's, by a correlation from elsewhere."""
    a, b = a / np.sqrt(np.mean(a**2)), b / np.sqrt(np.mean(b**2))
    gain = 0.0
    for part in folds(len(a), min(_FOLD_BLOCK, max(len(a) // 64, 1))):
        r = _correlation(a[~part], b[~part])
        error = (b[part] - r * a[part]) ** 2 / (1.0 - r**2)
        gain += 0.5 * float(np.sum(b[part] ** 2 - error) - part.sum() * np.log1p(-(r**2)))
    return gain


def _groups(linked: Links) -> list[set[int]]:
    """Axes that are linked, directly or through others.

    From the strongest link on; what is shared much less than that is another matter, if it is shared at all.
    """
    groups: list[set[int]] = []
    left = dict(linked)
    while left:
        strongest = max(left, key=lambda pair: abs(left[pair][1]))
        least = _WEAKEST * abs(left[strongest][1])
        group, grown = set(strongest), True
        while grown:
            near = {
                k for pair, link in left.items() if abs(link[1]) >= least and set(pair) & group for k in pair
            }
            grown = not near <= group
            group |= near
        groups.append(group)
        left = {pair: link for pair, link in left.items() if not set(pair) & group}
    return groups
