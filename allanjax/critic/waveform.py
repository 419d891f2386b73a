"""Effects with a known waveform: matched filters, with the noise estimated anew without the effect."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Float

from allanjax.critic.bank import SLOW, Bank, Scan
from allanjax.critic.effect import Effect
from allanjax.critic.model_evidence import SETS, odds
from allanjax.critic.noise import Noise, centred
from allanjax.critic.parameters import Detail, Limit
from allanjax.critic.view import Candidate, View
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model
from allanjax.noise.terms import NoiseTerm

#: Gain in the approximate noise [nats] below which an effect is given up. Gains in the exact noise were half
#: a nat larger on average, and up to four nats larger where both were far below zero.
HOPELESS = -1.5
# Most rounds in which the shape and the noise are estimated in turn.
_ROUNDS = 3
# Likelihood relative to the best shape above which an end of the bank is within two standard deviations; and
# the probability beyond a limit.
_LIKELY, _BEYOND = float(np.exp(-2.0)), 0.05


class Match(NamedTuple):
    """Shape of a bank that explains a view best, its amplitude, and the noise without it.

    `scan` has the outputs of the bank in that noise.
    """

    shape: int
    amplitude: float
    noise: Noise
    scan: Scan

    def gain(self, view: View) -> float:
        """Log evidence for the shape [nats], in the most probable noise without it and in that with it."""
        return self.noise.log_evidence - view.noise.log_evidence - self.scan.log_price

    @classmethod
    def of(cls, bank: Bank, view: View, scan: Scan, without: Callable[[int, float], Noise]) -> Match:
        """Match found from a scan in a first guess of the noise; `without` estimates it without a shape.

        The shape and the noise are estimated in turn. All results are from the same round, even if the shape
        still changes in the last one.
        """
        for _ in range(_ROUNDS):
            k = scan.best
            a = float(scan.amplitude[k])
            noise = without(k, a)
            scan = bank.scan(view, noise)
            if scan.best == k:
                break
        return cls(k, a, noise, scan)


def additive(
    view: View,
    cause: str,
    bank: Bank,
    shape: Callable[[int], Float[np.ndarray, " n"]],
    parameters: Callable[[int, float, float, Float[np.ndarray, " shapes"]], Sequence[Estimate]],
    span: Callable[[int], tuple[float, float]] | None = None,
    log_trials: float = 0.0,
    term: Callable[[int, float], NoiseTerm] | None = None,
    details: Mapping[str, Detail] | None = None,
    coarse: Candidate | None = None,
) -> Candidate | None:
    """Best candidate of a bank, with the noise estimated anew without it.

    Args:
        view: view of the axis.
        cause: name of the cause.
        bank: bank of shapes.
        shape: function of an index that returns the complete shape, for n samples.
        parameters: function of index, amplitude, its standard deviation and the probability of each shape
            that returns the parameters.
        span: function of the index that returns start and end [s], by default those of the record.
        log_trials: further log trials factor of the search [nats].
        term: function of index and amplitude [SI] that returns the noise term, if there is one.
        details: words and lists of numbers by name.
        coarse: candidate of a coarser bank. The search starts from the noise without it, and its p-value and
            held-out gain are kept.

    Returns:
        The candidate, or None.
    """
    # The noise without a shape as in the bank is approximate, but costs no transform.
    noises = view.noises if coarse is None else (coarse.after.noise,)
    scans = (bank.scan(view, noise) for noise in noises)
    rough = (
        Match.of(bank, view, scan, lambda k, a: view.noise_without(a * bank.shapes[k])) for scan in scans
    )
    first = max(rough, key=lambda match: match.gain(view))
    if first.gain(view) - log_trials < HOPELESS:
        return None
    after: list[View] = []

    def exact(k: int, a: float) -> Noise:
        after[:] = [view.with_samples(view.samples - a * shape(k))]
        return after[0].noise

    match = Match.of(bank, view, first.scan, exact)
    gain = after[0].log_evidence - view.log_evidence - match.scan.log_price - log_trials
    if not gain > 0.0:
        return None
    k, amplitude = match.shape, float(match.scan.amplitude[match.shape])
    found = Candidate(
        cause,
        parameters(k, amplitude, *marginal(view, after[0], bank, k, amplitude)),
        gain,
        None,
        after[0],
        functools.partial(bank.held_out, view, after[0]),
        span(k) if span else (0.0, view.duration),
        add_to_model=adding(term and term(k, amplitude)),
        has_waveform=True,
        details=details or {},
    )
    if coarse is not None:
        return dataclasses.replace(
            found, p_value=coarse.p_value, bound=coarse.bound, held_out=coarse.held_out
        )
    # Noise alone has an evidence of e^gain against it with no more than this probability.
    p_value = bank.p_value(view, match.noise, float(match.scan.snr[k]))
    return dataclasses.replace(found, p_value=p_value, bound=float(np.exp(-gain)))


class Template(Effect):
    """Waveform `amplitude`·`shape`(time, value), searched for at given values of its parameter.

        def sawtooth(time, period):
            return time / period % 1.0

        heater = Template("heater", sawtooth, np.geomspace(20.0, 60.0, 200), "period", "s")
        aj.critique(recording, effects=[*allanjax.critic.EFFECTS, heater])

    The waveform must be slow: some thousand cosine coefficients have to describe it. Choose the values so
    densely that neighbouring waveforms have a correlation of at least 0.9.
    """

    refit = "at once"

    def __init__(
        self,
        name: str,
        shape: Callable[[Float[np.ndarray, " n"], float], Float[np.ndarray, " n"]],
        values: Float[ArrayLike, " shapes"] | Sequence[float],
        parameter: str,
        unit: str = "1",
    ) -> None:
        """Make a cause.

        Args:
            name: name of the cause.
            shape: function of times since the record's start [s] and a value that returns the waveform.
            values: values of the parameter to compare, increasing.
            parameter: name of the parameter.
            unit: unit of the parameter.
        """
        self.name, self.shape, self.parameter, self.unit = name, shape, parameter, unit
        self.values = np.asarray(values, float)

    def p_value(self, view: View) -> float:
        return self._bank(view.n, view.rate).p_value(view, view.noise)

    def detect(self, view: View) -> Candidate | None:
        time = (np.arange(view.n) + 0.5) / view.rate

        def parameters(k: int, a: float, std: float, likelihood: np.ndarray) -> list[Estimate]:
            amplitude = view.amplitude_estimate("amplitude", a, std)
            if len(self.values) == 1:
                return [amplitude]
            value, spread, limit = spaced_parameter(self.values, likelihood)
            return [amplitude, view.estimate(self.parameter, value, spread, self.unit, limit)]

        bank = self._bank(view.n, view.rate)
        return additive(view, self.name, bank, lambda k: self.shape(time, self.values[k]), parameters)

    @functools.lru_cache(maxsize=4)  # noqa: B019 - effects are few
    def _bank(self, n: int, rate: float) -> Bank:
        """The waveforms for all values."""
        time = (np.arange(n) + 0.5) / rate
        return Bank(np.stack([centred(self.shape(time, float(x)))[:SLOW] for x in self.values]))


def marginal(
    view: View, after: View, bank: Bank, k: int, amplitude: float
) -> tuple[float, Float[np.ndarray, " shapes"]]:
    """Standard deviation of the amplitude and probability of each shape, averaged over plausible noise.

    In drifting noise a step is determined by the samples next to it, in white noise by all samples; both
    count if the record does not determine the noise.
    """
    sets = after.model_evidence.likely(after.allowed, most=SETS)
    variance, likelihood = 0.0, np.zeros(len(bank.shapes))
    for noise, share in zip(sets, odds(sets), strict=True):
        if share > 0.0:
            scan = bank.scan(view, noise)
            half = 0.5 * scan.snr**2
            weight = np.exp(half - half.max())
            weight /= weight.sum()
            # The amplitude is known no better than its shape.
            off = scan.std[k] ** 2 + weight @ (scan.amplitude - amplitude) ** 2
            variance, likelihood = variance + share * off, likelihood + share * weight
    return float(np.sqrt(variance)), likelihood


def adding(term: NoiseTerm | None) -> Callable[[Model], Model]:
    """Function that adds a term, if any, to a model."""
    return lambda model: model if term is None else model + term


def shape_parameter(
    values: Float[np.ndarray, " shapes"],
    likelihood: Float[np.ndarray, " shapes"],
    spacing: float | Float[np.ndarray, " shapes"] = 1.0,
) -> tuple[float, float, Limit]:
    """Mean and standard deviation of a shape's parameter, or a limit if an end of the bank is likely.

    Args:
        values: values of the parameter, increasing.
        likelihood: likelihood of each.
        spacing: spacing of the values, their weights under a flat prior.

    Returns:
        The mean, the standard deviation and ""; or the 95 % limit, nan, and its side.
    """
    weight = likelihood * spacing / np.sum(likelihood * spacing)
    ends = likelihood[[0, -1]] / likelihood.max()
    if ends.max() < _LIKELY:
        return *mean_and_std(values, weight), ""
    share = np.cumsum(weight)
    # Interpolated between two values of the bank.
    between = np.convolve(np.pad(values, 1, mode="edge"), [0.5, 0.5], "valid")
    if ends[1] >= ends[0]:
        return float(between[np.searchsorted(share, _BEYOND)]), float("nan"), "above"
    return float(between[np.searchsorted(share, 1.0 - _BEYOND) + 1]), float("nan"), "below"


def spaced_parameter(
    values: Float[np.ndarray, " shapes"], likelihood: Float[np.ndarray, " shapes"]
) -> tuple[float, float, Limit]:
    """Like `shape_parameter`, for values of any spacing; it is known no better than this spacing."""
    spacing = np.gradient(values)
    value, spread, limit = shape_parameter(values, likelihood, spacing)
    return value, float(np.hypot(spread, np.interp(value, values, spacing) / np.sqrt(12.0))), limit


def mean_and_std(
    values: Float[np.ndarray, " shapes"], likelihood: Float[np.ndarray, " shapes"]
) -> tuple[float, float]:
    """Mean and standard deviation of a shape's parameter, under a flat prior over the bank."""
    weight = likelihood / likelihood.sum()
    mean = float(weight @ values)
    return mean, float(np.sqrt(weight @ (values - mean) ** 2))
