"""Matched filters: banks of shapes, the trials factor of searching through them, and effects found by them.

In the whitened record an effect a·h in noise of covariance C has the signal-to-noise ratio
a·√(h'C⁻¹h), and no detector does better than its matched filter. The law of the largest output of a bank is
simulated; beyond the simulated range it is that of N independent filters, where N may grow with the level.
The noise is estimated anew without the effect.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import ArrayLike, Bool, Float, Int
from scipy.fft import dct, idct
from scipy.linalg.blas import dger
from scipy.special import log_ndtr
from scipy.stats import norm

from allanjax.critic.effect import Candidate, Effect, View
from allanjax.critic.finding import Detail, Limit
from allanjax.critic.noise import SETS, Noise, centred, odds
from allanjax.estimate.evidence import LOG_PRIOR_RANGE
from allanjax.noise.estimate import Estimate
from allanjax.noise.terms import NoiseTerm

# Draws of noise from which the law of the largest output is extrapolated.
_DRAWS = 400
# Number of bands in which that noise is known, and the resolution of its log levels.
_LEVELS, _COARSE = 6, 0.5
# Largest growth of the logarithm of the number of independent filters per unit of the output.
_GROWTH = 0.6
# Outputs below this share of the largest one cannot be the largest without an eighth of the data.
_RIVALS = 0.7
# Smallest share of a shape's squared norm that is left after projection; less is rounding.
_NOTHING = 1e-12
#: Parts of a record, each held out in turn.
PARTS = 8
#: Number of lowest coefficients in which slow effects are looked for: noise hides the others.
SLOW = 4096
#: Number of lowest coefficients of the finest bank, that of strong steps.
FINEST = 8 * SLOW


@dataclasses.dataclass(frozen=True, eq=False)
class Scan:
    """Outputs of matched filters: the signed snr, the amplitude and its standard deviation of each shape."""

    snr: Float[np.ndarray, " shapes"]
    amplitude: Float[np.ndarray, " shapes"]
    std: Float[np.ndarray, " shapes"]

    @property
    def best(self) -> int:
        """Index of the shape with the largest output."""
        return int(np.argmax(abs(self.snr)))

    @property
    def log_price(self) -> float:
        """Log trials and Occam factors of the best shape [nats]."""
        return log_trials_factor(0.5 * self.snr**2) + float(log_occam_factor(self.snr[self.best]))


def log_trials_factor(gains: Float[np.ndarray, " k"]) -> float:
    """Log trials factor of a search [nats]: the largest of some gains over their mean."""
    return float(gains.max() - np.logaddexp.reduce(gains) + np.log(len(gains)))


def log_occam_factor(snr: Float[ArrayLike, "*k"]) -> Float[np.ndarray, "*k"]:
    """Log Occam factor of an amplitude of either sign [nats], under the prior of `evidence`."""
    return np.log((np.abs(snr) + 1.0) * 2.0 * LOG_PRIOR_RANGE / np.sqrt(2.0 * np.pi))


class Matched:
    """Whitened shapes and record, after projecting out the nuisance directions (ramp, other accepted shapes).

    The shapes are not copied, which would cost more than the sums over them.

    Attributes:
        shapes: cosine coefficients, one row per shape.
        root: standard deviation of the coefficients.
        nuisances: orthonormal basis of the nuisance directions.
        common: products of the whitened shapes with these.
        lengths: norms of the whitened and projected shapes.
    """

    def __init__(
        self,
        bank: Bank,
        v: Float[np.ndarray, " slow"],
        nuisances: Sequence[Float[np.ndarray, " slow"]],
        c: Float[np.ndarray, " slow"],
    ) -> None:
        """Matched filters for coefficients c whose expected squares are v."""
        self.shapes, self.root = bank.shapes, np.sqrt(v)
        e, own = c / self.root, bank.squares @ (1.0 / v)
        basis = np.zeros((len(v), 0))
        if nuisances:
            columns = [h / self.root for h in nuisances]
            basis = np.linalg.qr(np.stack([h / np.linalg.norm(h) for h in columns], axis=1))[0]
        self.common = self.shapes @ (basis / self.root[:, None])
        self.whitened, self.nuisances = e - basis @ (e @ basis), basis
        self.lengths = np.sqrt(np.maximum(own - np.sum(self.common**2, axis=1), _NOTHING * own))

    def products(self, z: Float[np.ndarray, " slow"]) -> Float[np.ndarray, " shapes"]:
        """Product of every projected shape with whitened coefficients."""
        return self.shapes @ (z / self.root) - self.common @ (z @ self.nuisances)

    def rows(self, some: slice | Int[np.ndarray, " some"] = slice(None)) -> Float[np.ndarray, "some slow"]:
        """Selected shapes, whitened and projected."""
        rows = self.shapes[some] / self.root
        for k, q in enumerate(self.nuisances.T):
            # In place, as another array of this size would cost more than the product.
            rows = dger(-1.0, q, self.common[some, k], a=rows.T, overwrite_a=True).T
        return rows


@dataclasses.dataclass(frozen=True, eq=False)
class Bank:
    """Shapes to search for, each as its lowest `SLOW` cosine coefficients: one row per shape."""

    shapes: Float[np.ndarray, "shapes slow"]
    _nulls: dict[tuple[tuple[float, ...], bool], np.ndarray] = dataclasses.field(
        default_factory=dict, init=False, repr=False
    )

    @functools.cached_property
    def squares(self) -> Float[np.ndarray, "shapes slow"]:
        """Squares of the coefficients."""
        return self.shapes**2

    def matched(self, view: View, noise: Noise) -> Matched:
        """Matched filters in this noise, whose ramp and the shapes in `view.nuisances` are projected out."""
        J = self.shapes.shape[1]
        nuisances = [*([view.family.ramp] if noise.ramp else []), *view.nuisances]
        return Matched(self, view.lowest(noise, J), [h[:J] for h in nuisances], view.coefficients[:J])

    def scan(self, view: View, noise: Noise) -> Scan:
        """Outputs of all matched filters, and their estimates of the amplitude."""
        matched = self.matched(view, noise)
        projected, norms = matched.products(matched.whitened), matched.lengths
        return Scan(projected / norms, projected / norms**2, 1.0 / norms)

    def gain(self, view: View, noise: Noise) -> float:
        """Gain in log-likelihood of the best shape in a noise [nats]."""
        return 0.5 * float(np.max(self.scan(view, noise).snr ** 2))

    def held_out(self, view: View, after: View, noise: Noise | None = None) -> float:
        """Gain in log-likelihood on held-out data by the effect that is missing in `after` [nats].

        The bank is searched without the held-out part, in the noise of the view or of `after`. Parts are of a
        random rotation of the whitened coefficients, which are independent after it, too: whitened shapes may
        be in a few samples, as a step in a random walk is, or in a few coefficients.
        """
        noise = noise or after.noise
        matched = self.matched(view, noise)
        signs = np.random.default_rng(1).choice([-1.0, 1.0], len(matched.whitened))
        snr = abs(matched.products(matched.whitened)) / matched.lengths
        both = signs * matched.rows(np.flatnonzero(snr >= _RIVALS * snr.max())), signs * matched.whitened
        bank, e = (idct(z, norm="ortho", axis=-1, workers=-1) for z in both)
        parts = folds(len(e), 1)
        projected = np.stack([bank[:, part] @ e[part] for part in parts], axis=1)
        squares = np.stack([np.sum(bank[:, part] ** 2, axis=1) for part in parts], axis=1)
        whole = projected.sum(axis=1) ** 2 / np.maximum(squares.sum(axis=1), 1e-300)
        gain = 0.0
        for k in range(len(parts)):
            p, s = (z.sum(axis=1) - z[:, k] for z in (projected, squares))
            best = int(np.argmax(p**2 / np.maximum(s, 1e-300)))
            a = p[best] / max(s[best], 1e-300)
            gain += float(a * projected[best, k] - 0.5 * a**2 * squares[best, k])
        return view.held_out_gain(after, 0.5 * float(whole.max()), gain)

    def p_value(self, view: View, noise: Noise, snr: float | None = None) -> float:
        """Probability of an output as large as `snr` in noise alone, by default the view's largest."""
        if snr is None:
            snr = float(np.max(abs(self.scan(view, noise).snr)))
        v = view.lowest(noise, self.shapes.shape[1])
        edges = np.unique(np.rint(np.geomspace(1.0, len(v) + 1.0, _LEVELS + 1)).astype(int)) - 1
        level = np.add.reduceat(np.log(v), edges[:-1]) / np.diff(edges)
        coarse = tuple(np.rint((level - level[-1]) / _COARSE).tolist())
        ramp = view.family.ramp[: len(v)] if noise.ramp else None
        if (coarse, noise.ramp) not in self._nulls:
            self._nulls[coarse, noise.ramp] = self._null(edges, coarse, ramp)
        return extrapolated(self._nulls[coarse, noise.ramp], abs(snr))

    def _null(
        self,
        edges: Int[np.ndarray, " k"],
        coarse: tuple[float, ...],
        ramp: Float[np.ndarray, " slow"] | None,
    ) -> Float[np.ndarray, " draws"]:
        """Draws of the largest output in noise alone, whose spectrum is known by coarse levels in bands.

        The law depends little on the spectrum. Each spectrum has its own draws; shared draws would give all
        p-values the same error.
        """
        middle = 0.5 * np.log(np.maximum(edges[:-1], 0.5) * edges[1:])
        v = np.exp(np.interp(np.log(np.arange(1, edges[-1] + 1)), middle, _COARSE * np.array(coarse)))
        matched = Matched(self, v, [] if ramp is None else [ramp], np.zeros(len(v)))
        # Seven digits suffice for draws, at half the work.
        rng = np.random.default_rng([len(v), *(int(level) % 2**32 for level in coarse)])
        draws = rng.standard_normal((len(v), _DRAWS), np.float32)
        shapes, common, nuisances, root = (
            x.astype(np.float32) for x in (self.shapes, matched.common, matched.nuisances, matched.root)
        )
        outputs = shapes @ (draws / root[:, None]) - common @ (nuisances.T @ draws)
        return np.max(abs(outputs) / matched.lengths[:, None], axis=0)


def owners(n: int, block: int) -> Int[np.ndarray, " n"]:
    """Number of the part that each of n samples belongs to, in a random partition into `PARTS`.

    Each part has blocks from the whole record and is predicted from the others. With eight parts these are
    seven eighths of the data; with halves an effect would have to be twice as strong to be detected.
    """
    owner = np.random.default_rng(1).permutation(np.arange(-(-n // block)) % PARTS)
    return np.repeat(owner, block)[:n]


def folds(n: int, block: int) -> list[Bool[np.ndarray, " n"]]:
    """Samples of each part of the partition, see `owners`."""
    owner = owners(n, block)
    return [owner == k for k in range(PARTS)]


def extrapolated(largest: Float[np.ndarray, " draws"], value: float) -> float:
    """Tail probability P(max > value) from draws of the maximum of many standard normal magnitudes.

    P = 1 − exp(−N(u)·2Q(u)) with ln N linear in u, fitted to the upper half of the draws.
    """
    u = np.sort(largest)
    anchor = float(np.quantile(u, 0.9))
    if value < anchor:
        return float((1.0 + np.sum(u >= value)) / (1.0 + len(u)))
    below = (np.arange(len(u)) + 0.5) / len(u)
    upper = slice(len(u) // 2, None)
    log_count = np.log(-np.log(below[upper])) - np.log(2.0) - norm.logsf(u[upper])
    slope, level = np.polyfit(u[upper], log_count, 1, w=np.sqrt(1.0 - below[upper]))
    # Far out the number of independent filters grows no faster than u², as for a rough process.
    growth = float(np.clip(slope, 0.0, _GROWTH)) * (min(value, anchor + 3.0) - anchor)
    return float(-np.expm1(-np.exp(level + slope * anchor + growth + np.log(2.0) + log_ndtr(-value))))


def any_of(p: float, count: float) -> float:
    """Probability of a p-value below p in any of `count` independent tests (Šidák 1967)."""
    return float(-np.expm1(count * np.log1p(-min(p, 1.0 - 1e-16))))


@functools.lru_cache(maxsize=4)
def step_bank(n: int, every: int = 1) -> tuple[Bank, np.ndarray]:
    """Bank of steps at `SLOW`/4 places, or at `every` so many of these, and the places [samples]."""
    J = min(SLOW, n - 1)
    places = np.unique(np.rint(np.linspace(0.0, n, min(SLOW // 4, n // 4) + 2)[1:-1]))
    places = places[every // 2 :: every]
    return Bank(step_coefficients(places, n, J)), places


def sampled_bank(shapes: Float[np.ndarray, "shapes points"], n: int, most: int | None = None) -> Bank:
    """Bank for n samples, of shapes at fewer even points; the `most` lowest coefficients are compared."""
    scale = np.sqrt(n / shapes.shape[1])
    return Bank(scale * dct(shapes, norm="ortho", axis=1)[:, 1 : most and most + 1])


def step_coefficients(places: np.ndarray, n: int, J: int) -> np.ndarray:
    """Coefficients of unit steps from sample k on: −√(2/n) sin(a_j·k)/(2 sin(a_j/2))."""
    a = np.pi * np.arange(1, J + 1) / n
    return -np.sqrt(2.0 / n) * np.sin(np.outer(places, a)) / (2.0 * np.sin(a / 2.0))


#: Gain in the approximate noise [nats] below which an effect is given up. Gains in the exact noise were half
#: a nat larger on average, and up to four nats larger where both were far below zero.
HOPELESS = -1.5
# Most rounds in which the shape and the noise are estimated in turn.
_ROUNDS = 3
# Likelihood relative to the best shape above which an end of the bank is within two standard deviations; and
# the probability beyond a limit.
_LIKELY, _BEYOND = float(np.exp(-2.0)), 0.05


def _settled(
    bank: Bank, view: View, scan: Scan, without: Callable[[int, float], Noise]
) -> tuple[int, Noise, Scan]:
    """Best shape, the noise without it and the outputs in that, from a scan in a first guess of the noise.

    The shape and the noise `without` it are estimated in turn. All results are from the same round, even if
    the shape still changes in the last one.
    """
    for _ in range(_ROUNDS):
        k = scan.best
        noise = without(k, float(scan.amplitude[k]))
        scan = bank.scan(view, noise)
        if scan.best == k:
            break
    return k, noise, scan


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
        span: function of the index that returns start and end [s]; by default, those of the record.
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
    rough = [
        _settled(bank, view, scan, lambda k, a: view.noise_without(a * bank.shapes[k])) for scan in scans
    ]
    gains = [noise.log_evidence - view.noise.log_evidence - scan.log_price for _, noise, scan in rough]
    first = int(np.argmax(gains))
    if gains[first] - log_trials < HOPELESS:
        return None
    after: list[View] = []

    def exact(k: int, a: float) -> Noise:
        after[:] = [view.with_samples(view.samples - a * shape(k))]
        return after[0].noise

    k, noise, scan = _settled(bank, view, rough[first][2], exact)
    gain = after[0].log_evidence - view.log_evidence - scan.log_price - log_trials
    if not gain > 0.0:
        return None
    amplitude = float(scan.amplitude[k])
    added = term and term(k, amplitude)
    found = Candidate(
        cause,
        parameters(k, amplitude, *marginal(view, after[0], bank, k, amplitude)),
        gain,
        None,
        after[0],
        functools.partial(bank.held_out, view, after[0]),
        span(k) if span else (0.0, view.duration),
        add_to_model=lambda model: model if added is None else model + added,
        has_waveform=True,
        details=details or {},
    )
    if coarse is not None:
        return dataclasses.replace(
            found, p_value=coarse.p_value, bound=coarse.bound, held_out=coarse.held_out
        )
    # Noise alone has an evidence of e^gain against it with no more than this probability.
    p_value = bank.p_value(view, noise, float(scan.snr[k]))
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
