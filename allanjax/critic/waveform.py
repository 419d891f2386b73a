"""Effects with a known waveform: matched filters, with the noise estimated anew without the effect."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import ArrayLike, Float

from allanjax.critic.bank import NOTHING, SLOW, Bank, Scan, log_occam_factor
from allanjax.critic.effect import Effect
from allanjax.critic.model_evidence import SETS, Sets, odds
from allanjax.critic.noise import Noise, centred
from allanjax.critic.parameters import Detail, Limit
from allanjax.critic.view import Candidate, View
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model
from allanjax.noise.terms import NoiseTerm

# Smallest signal-to-noise ratio that is examined more closely.
_WORTH = 3.5
#: Gain in the approximate noise [nats] below which an effect is given up. Gains in the exact noise were half
#: a nat larger on average, and up to four nats larger where both were far below zero.
HOPELESS = -1.5
# Largest difference from the best one of those that are compared in the exact noise [nats].
_ROUGH = 2.0
# Most rounds in which the shape and the noise are estimated in turn.
_ROUNDS = 3
# Likelihood relative to the best shape above which an end of the bank is within two standard deviations; and
# the probability beyond a limit.
_LIKELY, _BEYOND = float(np.exp(-2.0)), 0.05


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
    """Best candidate of a bank, with the noise marginalized.

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
    best: Candidate | None = None
    for scan in _promising(bank, view, view.noises if coarse is None else (coarse.after.noise,), log_trials):
        after: list[View] = []

        def exact(k: int, a: float, left: list[View] = after) -> Noise:
            left[:] = [view.with_samples(view.samples - a * shape(k))]
            return left[0].noise

        noise, scan, k, a = _settled(bank, view, scan, exact)
        gain = log_evidence(view, after[0], bank, k, a) - view.log_evidence - log_trials
        if best is None or gain > best.gain:
            best = Candidate(
                cause,
                (),
                gain,
                1.0,
                after[0],
                functools.partial(bank.held_out, view, after[0]),
                span(k) if span else (0.0, view.duration),
                add_to_model=adding(term and term(k, float(scan.amplitude[k]))),
                has_waveform=True,
                details=details or {},
            )
            searched, place = (noise, float(scan.snr[k])), (k, float(scan.amplitude[k]))
    if best is None or not best.gain > 0.0:
        return None
    found = parameters(*place, *marginal(view, best.after, bank, *place))
    best = dataclasses.replace(best, estimates=found)
    if coarse is not None:
        return dataclasses.replace(best, p_value=coarse.p_value, bound=coarse.bound, held_out=coarse.held_out)
    # Noise alone has an evidence of e^gain against it with no more than this probability.
    p_value = bank.p_value(view, *searched)
    return dataclasses.replace(best, p_value=p_value, bound=float(np.exp(-best.gain)))


def _promising(bank: Bank, view: View, noises: Sequence[Noise], log_trials: float) -> list[Scan]:
    """Scans in the approximate noise without their best shapes, of the shapes that may gain most.

    The noise is estimated without the shape as in the bank, which costs no transform.
    """
    found: dict[int, tuple[float, Scan]] = {}
    for noise in noises:
        scan = bank.scan(view, noise)
        if abs(scan.snr[scan.best]) < _WORTH or scan.best in found:
            continue
        without, scan, k, _ = _settled(bank, view, scan, lambda k, a: view.noise_without(a * bank.shapes[k]))
        gain = without.log_evidence - view.noise.log_evidence - log_trials - scan.log_price
        if k not in found or gain > found[k][0]:
            found[k] = gain, scan
    least = max([HOPELESS, *(gain - _ROUGH for gain, _ in found.values())])
    return [scan for gain, scan in found.values() if gain >= least]


def _settled(
    bank: Bank, view: View, scan: Scan, noise_without: Callable[[int, float], Noise]
) -> tuple[Noise, Scan, int, float]:
    """Noise without the best shape, the scan in it, the shape, and the amplitude that the noise is without.

    The shape and the noise are estimated in turn. All results are from the same round, even if the shape
    still changes in the last one.
    """
    for _ in range(_ROUNDS):
        k = scan.best
        a = float(scan.amplitude[k])
        noise = noise_without(k, a)
        scan = bank.scan(view, noise)
        if scan.best == k:
            break
    return noise, scan, k, a


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
            spacing = np.gradient(self.values)
            value, spread, limit = shape_parameter(self.values, likelihood, spacing)
            # It is known no better than the spacing of its values.
            spread = float(np.hypot(spread, np.interp(value, self.values, spacing) / np.sqrt(12.0)))
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


def mean_and_std(
    values: Float[np.ndarray, " shapes"], likelihood: Float[np.ndarray, " shapes"]
) -> tuple[float, float]:
    """Mean and standard deviation of a shape's parameter, under a flat prior over the bank."""
    weight = likelihood / likelihood.sum()
    mean = float(weight @ values)
    return mean, float(np.sqrt(weight @ (values - mean) ** 2))


def log_evidence(view: View, after: View, bank: Bank, taken: int, amplitude: float) -> float:
    """Log evidence of a record with one of a bank's shapes [nats]; without one it is `View.log_evidence`.

    The likelihood is averaged over shapes, amplitudes and plausible subsets of the noise terms. The subsets
    and their levels are those of the record without the most likely effect, the shape h (`taken`) with the
    amplitude a, as in the view `after`. Otherwise a step would be taken for a random walk.
    With p and g the products of h with the record and with itself, the likelihood of the record is that
    without a·h times exp(½a²g − ap).
    """
    sets = after.model_evidence.sets(view.allowed)
    cross, gram = _products(view, bank, sets)
    snr = cross / np.sqrt(gram)
    each = 0.5 * snr**2 - log_occam_factor(snr)
    mean = np.logaddexp.reduce(each, axis=1) - np.log(each.shape[1])
    own = amplitude * cross[:, taken] - 0.5 * amplitude**2 * gram[:, taken]
    return float(np.logaddexp.reduce(sets.log_evidence - own + mean))


def _products(
    view: View, bank: Bank, sets: Sets
) -> tuple[Float[np.ndarray, "sets shapes"], Float[np.ndarray, "sets shapes"]]:
    """Products of the shapes with the record and with themselves, in the noise of each subset.

    The nuisances, a subset's ramp and other accepted shapes, are projected out.
    """
    J = bank.shapes.shape[1]
    first = view.family.bins.edges[:-1] - 1
    first = first[first < J]
    weight = np.ones(J) if view.factor is None else 1.0 / view.factor[:J]

    def sums(z: Float[np.ndarray, "... slow"]) -> Float[np.ndarray, "... sets"]:
        return np.add.reduceat(z, first, axis=-1) @ (1.0 / sets.level[:, : len(first)]).T

    cross, gram = sums(bank.shapes * (weight * view.coefficients[:J])).T, sums(bank.squares * weight).T
    for some, others in (
        (sets.ramp, (view.family.ramp, *view.nuisances)),
        (~sets.ramp, view.nuisances),
    ):
        if not others or not some.any():
            continue
        free = np.stack([h[:J] / np.linalg.norm(h[:J]) for h in others])
        mixed = np.stack([sums(bank.shapes * (weight * h))[:, some].T for h in free], axis=-1)
        with_record = sums(free * (weight * view.coefficients[:J]))[:, some].T
        among = np.moveaxis(sums(free[:, None] * free * weight)[..., some], -1, 0)
        # Not the inverse, as two of them may be equal.
        along = mixed @ np.linalg.pinv(among, hermitian=True)
        cross[some] -= np.einsum("skf,sf->sk", along, with_record)
        gram[some] = np.maximum(gram[some] - np.sum(along * mixed, axis=-1), NOTHING * gram[some])
    return cross, gram
