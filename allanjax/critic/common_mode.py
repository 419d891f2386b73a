"""Noise that several axes share, e.g. from a power supply, a clock or the floor."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import betainc

from allanjax.critic.bank import any_of, folds
from allanjax.critic.finding import Finding
from allanjax.critic.noise import NEARLY_ALL, WHITE
from allanjax.critic.parameters import Limit, parameter_estimate
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


@dataclasses.dataclass(frozen=True, eq=False)
class _Link:
    """Correlation between two axes, of all their noise or of the white noise only.

    `share` is the expectation of the products of their whitened coefficients a and b if this noise were
    identical in both.
    """

    noise: str
    a: Float[np.ndarray, " k"]
    b: Float[np.ndarray, " k"]
    share: Float[np.ndarray, " k"]

    @classmethod
    def of(cls, one: _Member, other: _Member, noise: str, top: int) -> _Link:
        """Link between two axes in the `top` lowest coefficients."""
        share = np.ones(top)
        if noise == "white" and one.white is not None and other.white is not None:
            share = np.sqrt(one.white[:top] * other.white[:top])
        return cls(noise, one.z[:top], other.z[:top], share)

    @property
    def top(self) -> int:
        """Number of coefficients."""
        return len(self.a)

    @functools.cached_property
    def size(self) -> float:
        """Effective number of coefficients: without shared noise the correlation's variance is 1/size."""
        return float(self.share @ self.share)

    @functools.cached_property
    def correlation(self) -> float:
        """Correlation of this noise in the two axes."""
        return self.among(slice(None))

    def among(self, some: Bool[np.ndarray, " k"] | slice) -> float:
        """Correlation from some of the coefficients: Σ share·ab / Σ share²."""
        share = self.share[some]
        r = float(share @ (self.a[some] * self.b[some]) / (share @ share)) / np.prod(self.levels)
        return float(np.clip(r, -_STRONGEST, _STRONGEST))

    @functools.cached_property
    def levels(self) -> tuple[float, float]:
        """Root mean squares of a and b."""
        a, b = (float(np.sqrt(x @ x / self.top)) for x in (self.a, self.b))
        return a, b

    @property
    def p_value(self) -> float:
        """Probability that the |correlation| of independent axes is larger.

        For k pairs of zero mean r² ~ Beta(½, (k−1)/2).
        """
        return float(betainc((self.size - 1.0) / 2.0, 0.5, 1.0 - self.correlation**2))

    @property
    def evidence(self) -> float:
        """Gain in log-likelihood by the correlation [nats]."""
        return -0.5 * float(np.sum(np.log1p(-((self.correlation * self.share) ** 2))))

    @property
    def held_out(self) -> float:
        """Gain in log-likelihood of an axis given the other, with the correlation from the other folds."""
        gain = 0.0
        for part in folds(self.top, min(_FOLD_BLOCK, max(self.top // 64, 1))):
            a, b = (x[part] / level for x, level in zip((self.a, self.b), self.levels, strict=True))
            r = self.among(~part) * self.share[part]
            gain += 0.5 * float(np.sum(b**2 - (b - r * a) ** 2 / (1.0 - r**2) - np.log1p(-(r**2))))
        return gain


class _Member(NamedTuple):
    """Axis, its whitened coefficients, and the share of white noise in each of them; None if unknown."""

    axis: Axis
    z: Float[np.ndarray, " n-1"]
    white: Float[np.ndarray, " n-1"] | None

    @classmethod
    def of(cls, record: Stage) -> _Member:
        """An axis at a stage; if nearly all noise is white, white noise and all noise are the same."""
        white = record.share(WHITE)
        if white is not None and np.mean(white) > NEARLY_ALL:
            white = None
        return cls(record.axis, record.whitened_coefficients, white)


#: Pairs of axes, their links and p-values.
Links: TypeAlias = dict[tuple[int, int], tuple[_Link, float]]


def common_mode(records: Sequence[Stage], alpha: float) -> list[Finding]:
    """Groups of axes whose whitened cosine coefficients are correlated.

    `alpha` is the probability of a false finding.
    """
    members = [_Member.of(record) for record in records] if len(records) > 1 else []
    pairs = [(a, b) for a in range(len(members)) for b in range(a)]
    linked: Links = {}
    tops = [records[0].n - 1]
    while tops[-1] // _SPLIT >= _LEAST:
        tops.append(tops[-1] // _SPLIT)
    for a, b in pairs:
        noises = _noises([members[a], members[b]])
        links = [_Link.of(members[a], members[b], noise, top) for noise in noises for top in tops]
        link = min((link for link in links if link.size >= _LEAST), key=lambda link: link.p_value)
        p = any_of(link.p_value, len(pairs) * len(links))
        if p < alpha and link.held_out > 0.0:
            linked[a, b] = link, p
    return [_finding(members, group, linked, records[0].rate) for group in _groups(linked)]


def _noises(members: Sequence[_Member]) -> Sequence[str]:
    """Kinds of noise that these axes may share."""
    return ["all"] if any(member.white is None for member in members) else ["all", "white"]


def _finding(members: Sequence[_Member], group: set[int], linked: Links, rate: float) -> Finding:
    """Finding of the noise that a group of axes shares."""
    within = {pair: link for pair, (link, _) in linked.items() if set(pair) <= group}
    strong = _strong(list(within.values()))
    pairs = sorted(pair for pair, link in within.items() if link in strong)
    both = [(members[a], members[b]) for a, b in pairs]
    # One kind of noise for all of them, the one that explains most.
    noises = _noises([member for pair in both for member in pair])
    tops = {link.top for link in within.values()}
    sharing = [[_Link.of(*pair, noise, top) for pair in both] for noise in noises for top in tops]
    # Pairs that share hardly anything in this kind of noise are left out, as they share another kind.
    possible = [_strong(links) for links in sharing if all(link.size >= _LEAST for link in links)]
    evidence = np.array([sum(link.evidence for link in links) for links in possible])
    # The mean over the pairs; those with a minus sign share noise of opposite sign.
    means = np.array([np.mean([abs(link.correlation) for link in links]) for links in possible])
    best = int(np.argmax(evidence))
    links, mean = possible[best], float(means[best])
    likelihood = np.exp(evidence - evidence[best])
    # Which noise is correlated is part of the uncertainty.
    spread = likelihood @ (means - mean) ** 2 / likelihood.sum()
    top, shared = links[0].top, [members[k].axis for k in sorted(group)]
    names = tuple(axis.name for axis in shared)
    together = Axis(" and ".join(names), shared[0].sensor, shared[0].unit)
    signs = tuple(
        f"{a.axis.name}/{b.axis.name}: {within[pair].correlation:+.3g}"
        for pair, (a, b) in zip(pairs, both, strict=True)
    )
    spacing = rate / (2.0 * len(members[0].z) + 2.0)
    limit: Limit = "" if mean < _STRONGEST - 1e-9 else "above"
    std = np.hypot(_error(mean, links), np.sqrt(spread))
    return Finding(
        cause=NAME,
        axes=names,
        parameters={
            "correlation": parameter_estimate(
                together, "correlation", _STRONGEST if limit else mean, std, "1", limit
            )
        },
        p_value=min(linked[pair][1] for pair in pairs),
        evidence=float(evidence[best]),
        gain=float(sum(link.held_out for link in links)),
        rivals=(),
        span=(spacing, top * spacing),
        domain="frequency",
        details={"axes": names, "noise": links[0].noise, "pairs": signs},
    )


def _strong(links: Sequence[_Link]) -> list[_Link]:
    """Links whose correlation is not much smaller than the largest one."""
    least = _WEAKEST * max(abs(link.correlation) for link in links)
    return [link for link in links if abs(link.correlation) >= least]


def _error(r: float, links: Sequence[_Link]) -> float:
    """Standard deviation of the mean correlation of pairs that share axes, all correlations being about r.

    It follows from the moments of normal variates with correlations r·share, divided by estimates of their
    mean squares; for shares of 1 it is that of Olkin & Siotani (1976).
    """
    share, k = np.mean([link.share for link in links], axis=0), links[0].top
    S = float(share @ share)
    third, fourth = (float(np.sum(share**p)) / S for p in (3, 4))
    square = r**2 * S / k
    own = (1.0 + r**2 * fourth) / S - r**2 * (3.0 - square) / k
    common = (r * third + r**2 * fourth) / S - 2.0 * r**2 * (1.0 + r * third) / k
    common += 0.5 * r**2 * (1.0 + 3.0 * square) / k
    return float(np.sqrt(max(own / len(links) + (1.0 - 1.0 / len(links)) * common, 0.0)))


def _groups(linked: Links) -> list[set[int]]:
    """Groups of axes that are linked, directly or through others.

    They are built from the strongest link onwards; much weaker links belong to other groups.
    """
    groups: list[set[int]] = []
    left = {pair: link.correlation for pair, (link, _) in linked.items()}
    while left:
        strongest = max(left, key=lambda pair: abs(left[pair]))
        least = _WEAKEST * abs(left[strongest])
        group, grown = set(strongest), True
        while grown:
            near = {k for pair, r in left.items() if abs(r) >= least and set(pair) & group for k in pair}
            grown = not near <= group
            group |= near
        groups.append(group)
        left = {pair: r for pair, r in left.items() if not set(pair) & group}
    return groups
