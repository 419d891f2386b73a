"""The evidence of one hidden effect, as exactly as can be: what the critic's is to be compared with.

Shares no code with the package. A record is what its lowest cosine coefficients are, in bins; the likelihood
is integrated over all levels that each set of noise terms may have (adaptive importance sampling, log-uniform
over two to four decades), and the amplitude of a path and that of a ramp in closed form.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.fft import dct
from scipy.special import log_ndtr, logsumexp
from scipy.stats import multivariate_t

from benchmarks.common.hidden_effects import Hidden
from benchmarks.common.hidden_sensors import DETECTABLE_SNR, term_variances

DURATION, RATE = 600.0, 100.0
#: The coefficients above these see white noise and quantization alone.
LOWEST, BINS = 3000, 120
#: An effect's size is log-uniform within this factor of the truth.
SIZE_WITHIN = 30.0
DRAWS, ROUNDS, FREEDOM = 1000, 4, 5.0

Evidence = Callable[[np.ndarray], np.ndarray]


# --- The law of the noise ----------------------------------------------------------------------------------


class Ground:
    """What is common to all records of a length: bins, spectra of the terms in units of white noise."""

    def __init__(self, n: int, rate: float) -> None:
        self.n, self.rate, self.duration = n, rate, n / rate
        edges = np.unique(np.geomspace(1, LOWEST + 1, BINS).astype(int)) - 1
        self.starts, self.size = edges[:-1], np.diff(edges).astype(float)
        self.unit = {x: self.mean(term_variances(x, n, rate)) / rate for x in "QBK"}
        self.times = np.geomspace(self.duration / 3000.0, self.duration / 3.0, 64)
        self.markov = np.log([self.mean(term_variances("M", n, rate, t)) / rate for t in self.times])
        self.ramp = self.coefficients(np.arange(n) / rate)
        self.bounds = {  # of the times at which a term crosses the white noise
            "B": (self.duration / 2000.0, self.duration),
            "K": (self.duration / 600.0, 3.0 * self.duration),
            "R": (self.duration / 60.0, 3.0 * self.duration),
        }

    def coefficients(self, x: np.ndarray) -> np.ndarray:
        """The lowest cosine coefficients of a record but the bias."""
        return dct(x, norm="ortho")[1 : LOWEST + 1]

    def sums(self, z: np.ndarray) -> np.ndarray:
        return np.add.reduceat(z, self.starts, axis=-1)

    def mean(self, variances: np.ndarray) -> np.ndarray:
        return self.sums(variances[:LOWEST]) / self.size

    def markov_level(self, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Levels [draws, bins] of Markov noise of unit amplitude, and its correlation times, from 0 to 1."""
        place = np.clip(position, 0.0, 1.0) * (len(self.times) - 1)
        k = np.minimum(place.astype(int), len(self.times) - 2)
        part = (place - k)[:, None]
        level = np.exp((1.0 - part) * self.markov[k] + part * self.markov[k + 1])
        return level, np.exp(np.interp(place, np.arange(len(self.times)), np.log(self.times)))

    def levels(self, letters: str, u: np.ndarray) -> np.ndarray:
        """Of these terms [draws, bins], over white noise: u [draws, parameters] in the unit cube."""
        total, column = np.zeros((len(u), len(self.size))), iter(u.T)
        for x in letters:
            value = next(column)
            if x == "M":
                level, time = self.markov_level(next(column))
                total += (0.1 * 1e5**value / time**2)[:, None] * level
                continue
            low, high = self.bounds[x]
            crossing = low * (high / low) ** value
            power = {"B": np.pi / (2.0 * np.log(2.0)) / crossing, "K": 3.0 / crossing**2}[x]
            total += power[:, None] * self.unit[x]
        return total

    @staticmethod
    def count(letters: str) -> int:
        """Number of their parameters."""
        return len(letters) + letters.count("M")


@functools.cache
def ground() -> Ground:
    return Ground(round(DURATION * RATE), RATE)


# --- Evidence ----------------------------------------------------------------------------------------------


def log_mean(log_likelihood: Evidence, count: int, rng: np.random.Generator) -> float:
    """Logarithm of the mean of a likelihood over the unit cube, by adaptive importance sampling."""
    if count == 0:
        return float(log_likelihood(np.zeros((1, 0)))[0])
    u = rng.random((2 * DRAWS, count))
    log_weight = log_likelihood(u)
    estimates = []
    for _ in range(ROUNDS):
        # Tempered until enough draws count, or a single one would be the proposal.
        for heat in 0.8 ** np.arange(40.0):
            weight = np.exp(heat * (log_weight - log_weight.max()))
            weight /= weight.sum()
            if 1.0 / np.sum(weight**2) > 15.0 * count:
                break
        centre = weight @ u
        spread = 1.5 * (weight * (u - centre).T) @ (u - centre) + 1e-6 * np.eye(count)
        proposal = multivariate_t(centre, spread, df=FREEDOM, seed=rng)
        u = np.where(rng.random((DRAWS, 1)) < 0.1, rng.random((DRAWS, count)), _drawn(proposal, count))
        inside = np.all((u >= 0.0) & (u <= 1.0), axis=1)
        density = 0.1 * inside + 0.9 * np.atleast_1d(proposal.pdf(u))
        log_weight = np.where(inside, log_likelihood(np.clip(u, 0.0, 1.0)) - np.log(density), -np.inf)
        estimates.append(logsumexp(log_weight) - np.log(DRAWS))
    return float(logsumexp(estimates[-2:]) - np.log(2.0))


def _drawn(proposal: Any, count: int) -> np.ndarray:
    return np.reshape(proposal.rvs(DRAWS), (DRAWS, count))


def log_amplitudes(cross: np.ndarray, gram: np.ndarray, low: Any, high: Any) -> np.ndarray:
    """Log of the mean of exp(a·cross − a²·gram/2) over amplitudes of both signs, log-uniform in a range."""
    std, total = 1.0 / np.sqrt(gram), []
    for sign in (-1.0, 1.0):
        estimate = sign * cross / gram
        first, last = (low - estimate) / std, (high - estimate) / std
        upper = first > 0.0
        more = log_ndtr(np.where(upper, -first, last))
        less = log_ndtr(np.where(upper, -last, first))
        mass = more + np.log1p(-np.exp(np.minimum(less - more, -1e-12)))
        peak = 0.5 * cross**2 / gram + np.log(np.sqrt(2.0 * np.pi) * std)
        total.append(peak + mass - np.log(np.clip(estimate, low, high)))
    return np.logaddexp(*total) - np.log(2.0 * np.log(high / low))


class Shapes(NamedTuple):
    """Known paths beside a record, in units of white noise: sums in bins, and amplitudes at the limits."""

    cross: np.ndarray  # [shapes, bins], with the record
    gram: np.ndarray  # with themselves
    mixed: np.ndarray  # with a ramp
    limits: np.ndarray  # [shapes]


class Judge:
    """One record as the judge sees it."""

    def __init__(self, hidden: Hidden, multiple: float, seed: int) -> None:
        g, sensor = ground(), hidden.sensor
        self.multiples, self.seed = (multiple / SIZE_WITHIN, multiple * SIZE_WITHIN), seed
        self.white = sensor["N"] * np.sqrt(RATE)
        self.base = 1.0 + (sensor.get("Q", 0.0) / sensor["N"]) ** 2 * g.unit["Q"]
        self.c = g.coefficients(hidden.values[:, 0] / self.white)
        self.powers = g.sums(self.c**2)
        self.letters = "".join(x for x in "BKM" if x in sensor)
        self.has_ramp = "R" in sensor

    def noise(self, sensor: dict[str, Any], without: str = "") -> np.ndarray:
        """The true levels in the bins."""
        g, total = ground(), self.base.copy()
        for x in (x for x in self.letters if x not in without):
            level = g.mean(term_variances(x, g.n, RATE, sensor.get("Tc", np.nan))) / RATE
            total += (sensor[x] / sensor["N"]) ** 2 * level
        return total

    def beside(self, coefficients: np.ndarray, noise: np.ndarray) -> Shapes:
        """Of these shapes [shapes, lowest], for the true levels of the noise."""
        g, gram = ground(), ground().sums(coefficients**2)
        cross, mixed = (g.sums(coefficients * x) for x in (self.c, g.ramp))
        return Shapes(cross, gram, mixed, DETECTABLE_SNR / np.sqrt(gram @ (1.0 / noise)))

    def evidence(
        self,
        sets: dict[str, float],
        ramp_odds: float,
        shapes: Shapes | None = None,
        extra: Callable[[np.ndarray], np.ndarray] | None = None,
        extras: int = 0,
    ) -> float:
        """Of the record [nats].

        Args:
            sets: letters of terms, and the odds of each set.
            ramp_odds: of a ramp.
            shapes: known paths, one of which is there.
            extra: levels of a further term [draws, bins] from its parameters.
            extras: their number.
        """
        rng = np.random.default_rng(self.seed)
        found = [
            np.log(odds)
            + log_mean(
                lambda u, x=letters: self._log_likelihood(u, x, ramp_odds, shapes, extra),
                ground().count(letters) + extras,
                rng,
            )
            for letters, odds in sets.items()
        ]
        return float(logsumexp(found))

    def _log_likelihood(
        self,
        u: np.ndarray,
        letters: str,
        ramp_odds: float,
        shapes: Shapes | None,
        extra: Callable[[np.ndarray], np.ndarray] | None,
    ) -> np.ndarray:
        g, own = ground(), ground().count(letters)
        v = self.base + g.levels(letters, u[:, :own])
        if extra is not None:
            v = v + extra(u[:, own:])
        precision, total = 1.0 / v, []
        plain = -0.5 * (np.log(v) @ g.size + precision @ self.powers)
        for ramp, odds in ((False, 1.0 - ramp_odds), (True, ramp_odds)):
            if odds == 0.0:
                continue
            value = plain + np.log(odds)
            if ramp:
                along = precision @ g.sums(g.ramp * self.c)
                own_gram = precision @ g.sums(g.ramp**2)
                low, high = (np.sqrt(2.0) / t**1.5 / np.sqrt(RATE) for t in reversed(g.bounds["R"]))
                value = value + log_amplitudes(along, own_gram, low, high)
            if shapes is not None:
                cross, gram = precision @ shapes.cross.T, precision @ shapes.gram.T
                if ramp:
                    mixed = precision @ shapes.mixed.T
                    cross = cross - mixed * (along / own_gram)[:, None]
                    gram = gram - mixed**2 / own_gram[:, None]
                low, high = (m * shapes.limits for m in self.multiples)
                each = log_amplitudes(cross, np.maximum(gram, 1e-12), low, high)
                value = value + logsumexp(each, axis=1) - np.log(len(shapes.limits))
            total.append(value)
        return functools.reduce(np.logaddexp, total)
