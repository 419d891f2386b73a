"""A change of the bias of no known cause: a transition, a bump, a swing, or a jump that decays."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from allanjax.critic.bank import Bank, additive, sampled_bank
from allanjax.critic.effect import Candidate, Effect, View
from allanjax.critic.noise import Noise
from allanjax.critic.policy import judged
from allanjax.noise.estimate import Estimate

# Lengths as shares of the record, and places per length.
_LENGTHS, _PER_LENGTH = 2.0 ** -np.arange(2.0, 7.0), 4
# Lengths of the changes that are compared with a step, and places of their middles, in lengths.
_SUDDEN, _MIDDLES = np.geomspace(4e-3, 0.5, 10), (-0.25, 0.0, 0.25, 0.5)
# Places at which a slope may begin or end.
_BREAKS = np.arange(0.04, 0.98, 0.04)
# Points of a record at which courses are evaluated, and number of their coefficients that are compared.
_POINTS, _COUNT = 4096, 512


class Course(NamedTuple):
    """Course of a change, its place and its length as shares of the record."""

    kind: str
    place: float
    length: float

    @property
    def span(self) -> tuple[float, float]:
        """Where the bias differs from what it was, or where it moves from one value to another."""
        if self.kind == "decay":
            return self.place, min(self.place + 3.0 * self.length, 1.0)
        return max(self.place - 0.5 * self.length, 0.0), min(self.place + 0.5 * self.length, 1.0)

    def at(self, time: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Values at times from 0 to 1, of height 1."""
        u = (time - self.place) / self.length
        if self.kind == "transition":
            return np.clip(u + 0.5, 0.0, 1.0)
        if self.kind in ("rise", "fall"):
            return np.maximum(u, 0.0) if self.kind == "rise" else np.minimum(u, 0.0)
        if self.kind == "decay":
            return np.where(u >= 0.0, np.exp(-np.maximum(u, 0.0)), 0.0)
        bump = 0.5 + 0.5 * np.cos(2.0 * np.pi * u)
        # A swing goes up and down.
        return np.where(abs(u) < 0.5, bump if self.kind == "bump" else np.sin(2.0 * np.pi * u) * bump, 0.0)


class SlowChange(Effect):
    """A change of the bias whose course no cause in the vocabulary has; it is found, but never named."""

    name = "slow_change"
    is_event = True
    refit = "at once"

    def detect(self, view: View) -> Candidate | None:
        courses, bank = _bank(view.n)
        time = (np.arange(view.n) + 0.5) / view.n

        def parameters(k: int, a: float, std: float, likelihood: np.ndarray) -> list[Estimate]:
            start, end = courses[k].span
            error = courses[k].length * view.n / _PER_LENGTH
            return [
                view.time_estimate("start", start * view.n, error),
                view.time_estimate("end", end * view.n, error),
                view.amplitude_estimate("amplitude", a, std),
            ]

        def span(k: int) -> tuple[float, float]:
            start, end = courses[k].span
            return start * view.duration, end * view.duration

        found = additive(view, self.name, bank, lambda k: courses[k].at(time), parameters, span)
        return found and found.doubted("no known cause has this course")

    def p_value(self, view: View) -> float:
        return _bank(view.n)[1].p_value(view, view.noise)


@functools.lru_cache(maxsize=2)
def _bank(n: int) -> tuple[list[Course], Bank]:
    """Courses, and a bank of their lowest coefficients for records of n samples."""
    courses = [
        Course(kind, float(place), float(length))
        for kind in ("transition", "bump", "swing", "decay")
        for length in _LENGTHS
        for place in np.arange(length / 2.0, 1.0 - length / 4.0, length / _PER_LENGTH)
    ]
    return courses, _bank_of(courses, n)


def _bank_of(courses: Sequence[Course], n: int) -> Bank:
    """Lowest coefficients of courses for records of n samples."""
    time = (np.arange(_POINTS) + 0.5) / _POINTS
    return sampled_bank(np.stack([course.at(time) for course in courses]), n, min(_COUNT, n - 1))


def is_slow(view: View, noise: Noise, place: float) -> bool:
    """Whether a change at a place [samples] rather begins slowly or decays than being a step, in a noise."""
    share = place / view.n
    courses = [Course("decay", share, length) for length in _SUDDEN]
    courses += [Course("transition", share + m * length, length) for length in _SUDDEN for m in _MIDDLES]
    step = Course("transition", share, 1.0 / view.n)
    slow, sudden = (_bank_of(each, view.n).gain(view, noise) for each in (courses, [step]))
    return slow - sudden > judged("bias_step", "clearly")


def is_broken(view: View, noise: Noise, settling: Bank) -> bool:
    """Whether a slope that begins or ends at some time explains more than a bank of `settling` courses."""
    return _breaks(view.n).gain(view, noise) - settling.gain(view, noise) > judged("warm_up", "clearly")


@functools.lru_cache(maxsize=2)
def _breaks(n: int) -> Bank:
    """Slopes that begin or end within records of n samples."""
    return _bank_of([Course(kind, float(k), 1.0) for kind in ("rise", "fall") for k in _BREAKS], n)
