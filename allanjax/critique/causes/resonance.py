"""Narrow-band noise: a damped oscillator, a structure or a loop that rings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float
from scipy.special import gammaincc

from allanjax import terms
from allanjax.critique.bank import any_of
from allanjax.critique.causes.spectral import fine_bins, sums
from allanjax.critique.noise import Noise
from allanjax.critique.view import Candidate, Cause, Quantity, View, coefficient_folds
from allanjax.linalg import solve

_NARROWEST = 8
# Independent windows a width, and how many more for each e-fold that what they show is rarer; widest windows
# that see nothing of their own.
_INDEPENDENT, _WIDE = (1.9, 0.11), 3.0
_WORTH = 8.0
# The noise has taken part of the bump for its own, and gives it back bit by bit.
_ROUNDS, _SETTLED = 8, 0.2
# A wider one than the second is no bump but an edge, as of a filter; the fit may pass through such.
_LEAST_Q, _BUMP_Q = 0.6, 1.0
# Coefficients below this one have drift in them; a bump narrower than this many is a line.
_LOWEST, _LINE = 16, 4.0
# Of the scoring: steps, a change of likelihood [nats] that ends it, a damping that gets nowhere.
_STEPS, _CONVERGED, _STUCK = 60, 1e-3, 1e6
_PADDED = 512


class Resonance(Cause):
    """A bump of the spectrum, which passes a filter that was found as all noise does."""

    name = "resonance"
    joint = "at last"

    def p_value(self, view: View) -> float:
        window = _conspicuous(view.c**2 / view.variance())
        return window[2]

    def detect(self, view: View) -> Candidate | None:
        window = _conspicuous(view.c**2 / view.variance())
        middle, width, *_ = window
        spacing = view.rate / (2.0 * view.n)
        start = [middle * spacing, np.clip(middle / max(width, 1.0), 1.0, max(middle / _LINE / 2.0, 1.0))]
        return self._near(view, window, start, view.noise)

    def again(self, view: View, found: Candidate) -> Candidate | None:
        start = [float(np.asarray(found.parameters[x].value)) for x in ("frequency", "quality_factor")]
        return self._near(view, _conspicuous(view.c**2 / view.variance()), start, found.after.noise)

    def _near(
        self, view: View, window: tuple[float, ...], about: Sequence[float], noise: Noise
    ) -> Candidate | None:
        """The bump of about this frequency and quality factor, in about this noise, if a window shows one."""
        _, width, p_value, windows, net = window
        if net < _WORTH:
            return None
        start, theta = np.log(about), np.full(3, np.inf)
        for _ in range(_ROUNDS):
            v, before = view.variance(noise), theta
            theta, covariance = _fitted(view, v, start, width)
            if not np.isfinite(covariance).all():
                return None
            after = view.behind(1.0 + _density(theta, view) / v)
            start, noise = theta[:2], after.noise
            if np.all(abs(theta - before) < _SETTLED * np.sqrt(np.diag(covariance))):
                break
        if np.exp(theta[1]) < _BUMP_Q:
            return None
        gain = after.noise.log_evidence - view.noise.log_evidence
        # Where it is, how wide and how strong: each a share of what might have been.
        widths = np.log(len(view.c) / _NARROWEST)
        gain -= np.log(windows) + np.log(widths) + 2.0
        f0, Q, amplitude = np.exp(theta)
        if view.passes is not None:
            # As it is recorded, behind the filter.
            amplitude *= np.sqrt(np.interp(f0, view.family.frequency, view.passes))
        deviation = np.sqrt(np.diag(covariance)) * [f0, Q, amplitude]
        parameters = {
            "frequency": Quantity(float(f0), float(deviation[0]), "Hz"),
            "quality_factor": Quantity(float(Q), float(deviation[1]), "1"),
            "amplitude": view.own(float(amplitude), float(deviation[2])),
        }
        half = f0 / Q
        return Candidate(
            self.name,
            parameters,
            float(gain),
            p_value,
            after,
            lambda: _held_out(view, after, theta, width),
            (max(f0 - 2.0 * half, 0.0), min(f0 + 2.0 * half, view.rate / 2.0)),
            "frequency",
            lambda model: model + terms.Resonance(float(amplitude), float(f0), float(Q)),
        )


def _density(theta: Float[np.ndarray, " 3"], view: View) -> Float[np.ndarray, " n-1"]:
    f0, Q, amplitude = (float(x) for x in np.exp(theta))
    density = view.family.spectrum(terms.Resonance(amplitude, f0, Q).sampled(view.rate))
    return density if view.passes is None else density * view.passes


def _conspicuous(ratio: Float[np.ndarray, " n-1"]) -> tuple[float, float, float, float, float]:
    """The window with most excess: middle, width [coefficients], p-value, count of such windows, gain.

    Of a width, windows a quarter apart are worth two to four independent ones each width, the more the rarer
    what they show, as simulated (`_INDEPENDENT`).
    """
    total = np.concatenate([[0.0], np.cumsum(ratio)])
    best = (-np.inf, 0.0, 0.0, 0.0, 0.0)
    width, widths = _NARROWEST, 0.0
    least = 1.0
    while width <= (len(ratio) - _LOWEST) // 4:
        step = max(width // 4, 1)
        excess = total[_LOWEST + width :: step] - total[_LOWEST : len(total) - width : step]
        k = int(np.argmax(excess))
        level = float(excess[k]) / width
        windows = len(ratio) / width
        gain = 0.5 * width * (level - 1.0 - np.log(level)) if level > 1.0 else 0.0
        tail = min(max(float(gammaincc(width / 2.0, level * width / 2.0)), 1e-300), 1.0 - 1e-12)
        independent = min(_INDEPENDENT[0] - _INDEPENDENT[1] * np.log(tail), 4.0)
        least, widths = min(least, any_of(tail, independent * windows)), widths + 1.0
        if gain - np.log(windows) > best[0]:
            best = (
                gain - np.log(windows),
                _LOWEST + k * step + width / 2.0 + 1.0,
                float(width),
                windows,
                gain,
            )
        width *= 2
    # Every width is a search of its own, but that the widest ones see what narrower ones have seen.
    return best[1], best[2], any_of(least, max(widths - _WIDE, 1.0)), best[3], best[4]


def _fitted(
    view: View,
    v: Float[np.ndarray, " n-1"],
    start: Float[np.ndarray, " 2"],
    width: float,
    fold: np.ndarray | None = None,
) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "3 3"]]:
    """Logarithms of frequency, quality factor and amplitude by maximum likelihood, and their covariance."""
    n, rate = view.n, view.rate
    before_filter = v if view.passes is None else v / view.passes
    spacing = rate / (2.0 * n)
    f0 = float(np.exp(start[0]))
    first = fine_bins(n, f0 / spacing, max(width, 2.0))
    # What is not in the fold counts for nothing.
    some, count = (lambda x: x, np.ones(n - 1)) if fold is None else (lambda x: fold * x, fold.astype(float))
    size, squares, level = (sums(x, first) for x in (count, some(view.c**2 / v), some(before_filter)))
    real = size > 0
    size, squares, level = size[real], squares[real], (level[real] / size[real])
    frequency = (sums(some(np.arange(1.0, n)), first)[real] / size) * spacing
    # Compiled once for all bumps of records about as long.
    pad = -len(size) % _PADDED
    bins = _Bins(
        np.append(frequency, np.full(pad, frequency[-1])),
        np.append(size, np.zeros(pad)),
        np.append(squares, np.zeros(pad)),
        np.append(level, np.ones(pad)),
    )
    near = abs(np.log(bins.frequency / f0)) < max(1.5 / np.exp(start[1]), 4.0 * spacing / f0)
    limits = np.array([_LOWEST * spacing, rate / 2.0, _LINE * spacing])
    found, information = (np.asarray(x) for x in _maximum(start, bins, near, limits, rate))
    if not np.isfinite(information).all():
        return found, np.full((3, 3), np.nan)
    values, vectors = np.linalg.eigh(information)
    return found, vectors @ np.diag(1.0 / np.maximum(values, 1e-4)) @ vectors.T


class _Bins(NamedTuple):
    """Whitened squares in fine bins: where, how many, their sum, and the level they were whitened by."""

    frequency: Any
    size: Any
    squares: Any
    level: Any


# Steps done, θ, its loss, the damping, and what a further step promises.
_Scoring = tuple[Array, Array, Array, Array, Array]


@eqx.filter_jit
def _maximum(
    start: Float[ArrayLike, " 2"],
    bins: _Bins,
    near: Bool[ArrayLike, " bins"],
    limits: Float[ArrayLike, " 3"],
    rate: float,
) -> tuple[Float[Array, " 3"], Float[Array, "3 3"]]:
    """The most likely logarithms of frequency, quality factor and amplitude, and their observed information.

    Fisher's scoring, damped (Levenberg & Marquardt). The amplitude starts where the excess is that `near`.
    """
    bins = _Bins(*map(jnp.asarray, bins))
    limits = jnp.asarray(limits)

    def shape(theta: Array) -> Array:
        term = terms.Resonance(1.0, jnp.exp(theta[0]), jnp.exp(theta[1])).sampled(rate)
        return rate * term.sampled_psd(bins.frequency, rate) / bins.level

    def log_ratio(theta: Array) -> Array:
        return jnp.log1p(jnp.exp(2.0 * theta[2]) * shape(theta))

    def loss(theta: Array) -> Array:
        u = log_ratio(theta)
        f, Q = jnp.exp(theta[0]), jnp.exp(theta[1])
        inside = (limits[0] < f) & (f < limits[1]) & (Q > _LEAST_Q) & (limits[2] * Q < f)
        return jnp.where(inside, 0.5 * jnp.sum(bins.size * u + bins.squares * jnp.exp(-u)), jnp.inf)

    def step(state: _Scoring) -> _Scoring:
        k, theta, value, damping, _ = state
        J = jax.jacfwd(log_ratio)(theta)
        gradient = 0.5 * (bins.size - bins.squares * jnp.exp(-log_ratio(theta))) @ J
        information = 0.5 * (J.T * bins.size) @ J
        damped = information + damping * jnp.diag(jnp.diag(information)) + 1e-9 * jnp.eye(3)
        change = solve(damped, gradient)
        tried = loss(theta - change)
        better = tried < value
        promise = jnp.where(better, value - tried, jnp.where(damping > _STUCK, 0.0, jnp.inf))
        return (
            k + 1,
            jnp.where(better, theta - change, theta),
            jnp.where(better, tried, value),
            damping * jnp.where(better, 0.2, 5.0),
            promise,
        )

    excess = jnp.sum(jnp.where(near, bins.squares - bins.size, 0.0))
    unit = jnp.sum(jnp.where(near, bins.size * shape(jnp.append(start, 0.0)), 0.0))
    first = jnp.append(start, 0.5 * jnp.log(jnp.maximum(excess, 1.0) / unit))
    state = (jnp.asarray(0), first, loss(first), jnp.asarray(1e-2), jnp.asarray(jnp.inf))
    _, theta, _, _, _ = jax.lax.while_loop(lambda s: (s[0] < _STEPS) & (s[4] > _CONVERGED), step, state)
    return theta, jax.hessian(loss)(theta)


def _held_out(view: View, after: View, theta: Float[np.ndarray, " 3"], width: float) -> float:
    """Gain on every other coefficient by the bump fitted to the others, both ways.

    It is sought from where all of them have it, and in the noise that the others show behind that one.
    """
    gain = -view.foretold
    for fold in coefficient_folds(view.n):
        v = view.variance(view.family.of(view.c, after.factor, fold).best(view.allowed))
        found, _ = _fitted(view, v, theta[:2], width, fold)
        factor = 1.0 + _density(found, view) / v
        noise = view.family.of(view.c, view.combined(factor), fold).best(view.allowed)
        gain += view.log_likelihood(noise, ~fold, factor)
    return gain
