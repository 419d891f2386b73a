"""Whether a recording is fit for its purpose, line by line, and how long it would have to be.

For the rough fits Whittle's likelihood of the cosine spectrum is maximized by Fisher scoring with
non-negative powers; errors are those of the Fisher information. Nothing is compiled, no terms are chosen, no
structure is looked for.

The levels c_j² of the cosine spectrum (see `spectrum.cosine`) are independent and χ² with one degree of
freedom around the density S(f_j), f_j = j·rate/2n, j = 1 … n−1. So the Fisher information that n samples have
of the logarithms of the parameters θ is

    F_ab = ½ Σ_j (∂ ln S_j/∂ ln θ_a)(∂ ln S_j/∂ ln θ_b),

and no unbiased estimate of θ_a has a relative standard deviation below √[F⁻¹]_aa. More length means lower
frequencies, where slow terms show, and more levels at all others.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import nnls

from allanjax.base.chi_squared import upper_tail
from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError, RecordingError
from allanjax.base.normal import ONE_SIDED_95, TWO_SIDED_68, TWO_SIDED_95
from allanjax.base.tables import html_table, text_table
from allanjax.base.wording import duration, finite_or_none, plain, significant
from allanjax.estimate.evidence import without_ramp
from allanjax.estimate.result import AxisFit, fitted_model
from allanjax.estimate.spectral.components import columns_of
from allanjax.estimate.spectral.fit import chi_squared, error_of_powers
from allanjax.inspection import Inspection, inspect
from allanjax.inspection.checklist import Line, Verdict, lines_of, worst
from allanjax.inspection.spectral import bandwidth_in, spectrum_of
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model, ModelParameter, NoiseTerm
from allanjax.noise.terms import AngleRandomWalk, BiasInstability, DriftRamp, RateRandomWalk, basic_terms
from allanjax.record.io.given import RecordingLike, as_recording
from allanjax.record.io.options import GapChoice
from allanjax.record.recording import Axis, Recording
from allanjax.spectrum.cosine import Bins, SpectralStatistics, cosine_transform, ramp_column

# Steps of Fisher scoring, and scatter of a level beyond which it holds a line and is left out.
_STEPS, _LINE = 30, 6.0
# p-value below which the terms do not follow the spectrum.
_REJECTED = 1e-6
#: Relative standard deviation at which a coefficient is taken to be known.
TARGET = 0.2
#: Longest recording that is proposed [s]: a month.
LONGEST = 30.0 * 86400.0
# Coefficients that a length is told for.
_ASKED: tuple[type[NoiseTerm], ...] = (AngleRandomWalk, BiasInstability, RateRandomWalk)
# Levels up to this one count one by one, further ones in so many groups an octave.
_SINGLE, _PER_OCTAVE = 256, 32
# Step of the logarithm of a parameter in a derivative: downwards, for some bandwidths have an upper bound.
_STEP = 1e-4
# Samples of the shortest record that is considered, and the relative accuracy of a length.
_SHORTEST, _ACCURACY = 64, 1e-3
SCHEMA_VERSION = 1
# Fewest samples that say how long to record.
_FEWEST = 64
_HEADINGS = ("check", "verdict", "reason")
_SYMBOLS = {"angle_random_walk": "N", "bias_instability": "B", "rate_random_walk": "K"}


def rough_fits(recording: Recording, below: Float[np.ndarray, " axes"]) -> tuple[AxisFit, ...]:
    """Rough fit of every axis, to frequencies up to its `below` [Hz]; inf for all of them."""
    n, rate = recording.n, recording.rate
    bins = Bins.of(n, rate)
    model = Model(tuple(term for term in basic_terms().terms if not term.deterministic))
    columns = columns_of([term.sampled(rate) for term in model.terms], bins).mean(axis=1)
    c = cosine_transform(recording.values - recording.values.mean(axis=0))
    statistics = bins.statistics(c, ramp_column(n, rate))
    found = []
    for k, axis in enumerate(recording.axes):
        inside = bins.frequency <= below[k]
        own = SpectralStatistics(*(x[k][inside] for x in statistics))
        found.append(_fit(own, bins.size[inside].astype(float), columns[:, inside], model, axis))
    return tuple(found)


def _fit(
    statistics: SpectralStatistics,
    size: Float[np.ndarray, " m"],
    columns: Float[np.ndarray, "terms m"],
    model: Model,
    axis: Axis,
) -> AxisFit:
    """Rough fit of one axis."""
    mean, used = np.maximum(statistics.squares / size, 1e-300), np.ones(len(size), bool)
    # A first level of its neighbours, as single ones scatter.
    mean = np.exp(np.convolve(np.log(np.pad(mean, 3, mode="edge")), np.ones(7) / 7.0, "valid"))
    power = np.zeros(len(columns))
    scale = np.median(mean) / np.median(columns, axis=1)
    for step in range(_STEPS):
        squares, dof = (np.asarray(x) for x in without_ramp(statistics, size, mean, True))
        dof = np.maximum(dof, 1e-3)
        if step in (_STEPS // 3, 2 * _STEPS // 3):
            used = (squares / dof / mean - 1.0) * np.sqrt(dof / 2.0) < _LINE
            used |= size == 1.0
        weight = np.sqrt(dof / 2.0) / mean * used
        power = nnls((columns * scale[:, None] * weight).T, squares / dof * weight)[0] * scale
        mean = np.maximum(power @ columns, 1e-300)
    squares, dof = (np.asarray(x) for x in without_ramp(statistics, size, mean, True))
    dof = np.maximum(dof, 1e-3)
    ratio, degrees = (squares / dof / mean)[used], max(float(used.sum() - 3), 1.0)
    chi2 = float(chi_squared(ratio, dof[used]))
    p_value = float(upper_tail(chi2, degrees))
    wide = p_value < _REJECTED
    off = float(error_of_powers(ratio, dof[used], np.ones(int(used.sum())), degrees)) / 2.0 if wide else 0.0
    scaled = columns * scale[:, None] / mean * used
    information, present = (scaled * dof / 2.0) @ scaled.T, power > 0.0
    std = np.zeros(len(power))
    for k in range(len(power)):
        # Beside the terms that are there.
        own = present | (np.arange(len(power)) == k)
        inverse = np.linalg.pinv(information[np.ix_(own, own)], hermitian=True)
        std[k] = np.sqrt(inverse[own[:k].sum(), own[:k].sum()]) * scale[k]
    coefficients = _coefficients(model, axis, power, std)
    covariance = np.diag([c.std**2 for c in coefficients.values()])
    own = fitted_model(model, coefficients)
    return AxisFit(axis, True, "", chi2, int(degrees), p_value, off, coefficients, covariance, own)


def _coefficients(
    model: Model, axis: Axis, power: Float[np.ndarray, " terms"], std: Float[np.ndarray, " terms"]
) -> dict[str, Estimate]:
    """Amplitudes of the terms from their powers, with errors and limits."""
    found = {}
    for term, p, s in zip(model.terms, power, std, strict=True):
        detected, value = bool(p > ONE_SIDED_95 * s), float(np.sqrt(p))
        levels = (-TWO_SIDED_95, TWO_SIDED_95, -TWO_SIDED_68, TWO_SIDED_68)
        ends = [float(np.sqrt(max(p + z * s, 0.0))) for z in levels]
        found[term.name()] = Estimate(
            axis=axis,
            label=term.name(),
            value=value if detected else 0.0,
            std=float(s / 2.0 / value) if detected else float("nan"),
            interval=(ends[0], ends[1]),
            interval_68=(ends[2], ends[3]),
            parameter=term.amplitude_parameter(),
            term=term.name(),
            upper_limit=float(np.sqrt(p + ONE_SIDED_95 * s)),
            detected=detected,
        )
    return found


@dataclasses.dataclass(frozen=True, eq=False)
class NeededLength(ByValue):
    """How well a coefficient is known, and the length of a recording that makes it known to ± 20 % (1 σ).

    Attributes:
        coefficient: the estimate of N, B or K [SI].
        relative_std: its relative standard deviation now; nan where it is not detected, or not measured.
        now: length [s] that was fitted.
        seconds: length [s] at which the Cramér–Rao bound is 20 %, of a coefficient that is not detected one
            as large as its 95 % limit; None if that is more than a month, or cannot be said.
        reason: why it cannot be said; "" if it can.
    """

    coefficient: Estimate
    relative_std: float
    now: float
    seconds: float | None
    reason: str = ""

    @property
    def known(self) -> bool:
        """Whether the coefficient is known to ± 20 % already."""
        return self.relative_std <= TARGET

    def __str__(self) -> str:
        return f"{self.coefficient.axis.name} {self.told()}"

    def told(self) -> str:
        """What it takes, in words without the axis's name."""
        takes = f"± {100.0 * TARGET:.0f} % takes " + (
            duration(self.seconds) if self.seconds else "over a month"
        )
        if not math.isnan(self.relative_std):
            known = f"known to ± {plain(100.0 * self.relative_std, 2)} %"
            return known if self.known else f"{known}, {self.reason or takes}"
        if self.reason:
            return f"cannot be said: {self.reason}"
        c = self.coefficient.in_unit()
        below = f"not detected, below {significant(c.upper_limit or 0.0)} {c.unit} (95 %)"
        if self.seconds is not None and self.seconds <= self.now:
            return f"{below}: one so large would usually show by now"
        return f"{below}: {takes} if it is so large"


def needed_lengths(result: AxisFit, n: int, rate: float) -> tuple[NeededLength, ...]:
    """What it takes to know N, B and K of an axis, given its fit to n samples at `rate` [Hz].

    Where the fit's standard deviation exceeds the bound at its own length, lengths allow for the ratio.
    """
    if not result.converged:
        return ()
    wanted = (term.name() for term in _ASKED)
    return tuple(_needed(result, result[label], n, rate) for label in wanted if label in result.coefficients)


def _needed(result: AxisFit, c: Estimate, n: int, rate: float) -> NeededLength:
    """What it takes to know one coefficient of an axis."""
    now = n / rate
    if not result.measured:
        return NeededLength(c, math.nan, now, None, "the fit is no measurement of this sensor")
    if c.detected and c.value > 0.0 and np.isfinite(c.std):
        std = c.std / c.value
        if std <= TARGET:
            return NeededLength(c, std, now, now)
        if result.discrepancy > 0.0:
            why = "the noise terms do not follow the data: how long ± 20 % takes cannot be said"
            return NeededLength(c, std, now, None, why)
        # The fit cannot do better than the bound, and at longer lengths is as much worse as here.
        target = TARGET * min(relative_std(result.model, n, rate)[c.label] / std, 1.0)
        return NeededLength(c, std, now, length_for(result.model, c.label, rate, target))
    if c.upper_limit is None or not c.upper_limit > 0.0:
        return NeededLength(c, math.nan, now, None, "there is no limit to it")
    term = next(term for term in _ASKED if term.name() == c.term)
    name = term.amplitude_parameter().name
    there = result.model.without([c.term]) if c.term in result.model.term_labels else result.model
    at_limit = there + term().replace(**{name: c.upper_limit})
    return NeededLength(c, math.nan, now, length_for(at_limit, c.term, rate))


def length_for(model: Model, label: str, rate: float, target: float = TARGET) -> float | None:
    """Length [s] at which the bound of a parameter's relative standard deviation is `target`.

    None if that is more than `LONGEST`.

    Raises:
        AllanjaxError: the model has no such parameter with a value.
    """

    def bound(n: float) -> float:
        found = relative_std(model, round(n), rate)
        if label not in found:
            raise AllanjaxError(f"the model has no {label!r} to be known; it has {', '.join(found)}")
        return found[label]

    low, high = float(_SHORTEST), max(LONGEST * rate, _SHORTEST + 1.0)
    if bound(low) <= target:
        return low / rate
    if bound(high) > target:
        return None
    while high / low > 1.0 + _ACCURACY:
        middle = math.sqrt(low * high)
        low, high = (low, middle) if bound(middle) <= target else (middle, high)
    return high / rate


def relative_std(model: Model, n: int, rate: float) -> dict[str, float]:
    """Cramér–Rao bound of the relative standard deviation of each parameter, from n samples at `rate` [Hz].

    All parameters with a value are taken as unknown, but for held ones, and those of lines and of other
    deterministic terms, which take at most a level each. It is inf for what n samples say nothing of.
    """
    first, last = _groups(n, 2 if any(isinstance(term, DriftRamp) for term in model.terms) else 1)
    frequency, count = (first + last) * rate / (4.0 * n), last - first + 1
    random = model.without(
        [label for label, term in zip(model.term_labels, model.terms, strict=True) if term.deterministic]
    )
    values = {
        p.label: float(p.start) for p in random.parameters if p.start is not None and _counts(random, p)
    }
    labels = list(values)

    def log_density(label: str, factor: float) -> Float[np.ndarray, " m"]:
        moved = random.with_values(**{label: values[label] * factor})
        return np.log(np.asarray(moved.sampled(rate).sampled_psd(frequency, rate)))

    here = log_density(labels[0], 1.0)
    D = np.stack([(here - log_density(label, math.exp(-_STEP))) / _STEP for label in labels], axis=1)
    return dict(zip(labels, _bound(0.5 * (D.T * count) @ D), strict=True))


def _counts(model: Model, p: ModelParameter) -> bool:
    """Whether a parameter is unknown: finite, not zero, not held; numbers such as an order are known."""
    owner = model.response if p.term == len(model.terms) else model.terms[p.term]
    known = owner is None or p.parameter.name in owner.held or p.parameter.kind == "number"
    return not known and bool(np.isfinite(p.start or 0.0) and p.start)


def _bound(F: Float[np.ndarray, "params params"]) -> Float[np.ndarray, " params"]:
    """Square roots of the diagonal of the inverse of a Fisher matrix; inf where it has no information."""
    size = np.sqrt(np.diag(F))
    informed = size > 1e-6
    bound = np.full(len(F), np.inf)
    scaled = F[np.ix_(informed, informed)] / np.outer(size[informed], size[informed])
    values, vectors = np.linalg.eigh(scaled)
    variance = (vectors**2 / np.maximum(values, 1e-12)).sum(axis=1)
    bound[informed] = np.sqrt(variance) / size[informed]
    return bound


def _groups(n: int, first: int) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
    """First and last of the levels in each group, from level `first` to n − 1."""
    single = np.arange(first, min(_SINGLE, n - 1) + 1)
    octaves = max(math.log2(n / _SINGLE), 0.0)
    further = (_SINGLE + 1) * 2.0 ** np.arange(0.0, octaves, 1.0 / _PER_OCTAVE)
    starts = np.unique(np.concatenate([single, np.rint(further).astype(int)]))
    starts = starts[starts < n]
    return starts, np.append(starts[1:] - 1, n - 1)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Check(ByValue):
    """Whether a recording is fit for the estimation of noise coefficients.

    Attributes:
        name, n, rate: the recording's name, number of samples and sample rate [Hz]; 0 if it cannot be read.
        lines: the checks, each with its name, a verdict "fine", "look" or "stop", and the reason in words.
        lengths: how long to record for N, B and K of each axis to be known to ± 20 %.
    """

    name: str
    n: int
    rate: float
    lines: tuple[Line, ...]
    lengths: tuple[NeededLength, ...] = ()

    @property
    def verdict(self) -> Verdict:
        """The worst verdict of the lines."""
        return worst(self.lines)

    @property
    def stops(self) -> tuple[Line, ...]:
        """The lines that say stop."""
        return tuple(line for line in self.lines if line.verdict == "stop")

    def __getitem__(self, name: str) -> Line:
        """The line of this name; AllanjaxError if there is none."""
        for line in self.lines:
            if line.name == name:
                return line
        raise AllanjaxError(f"no line {name!r}; there are {', '.join(line.name for line in self.lines)}")

    def summary(self) -> str:
        """One line of text: which checks say stop or look, and how many are fine."""
        parts = []
        for verdict in ("stop", "look"):
            names = [line.name for line in self.lines if line.verdict == verdict]
            parts += [f"{verdict}: {', '.join(names)}"] if names else []
        fine = sum(line.verdict == "fine" for line in self.lines)
        return "; ".join([*parts, f"{fine} of {len(self.lines)} checks are fine"])

    def to_dict(self) -> dict[str, Any]:
        """The check as plain dictionaries, lists, numbers and strings, for JSON."""
        return {
            "schema_version": SCHEMA_VERSION,
            "recording": {
                "name": self.name,
                "n": self.n,
                "rate_hz": self.rate,
                "duration_s": self.n / self.rate if self.rate else 0.0,
            },
            "verdict": self.verdict,
            "lines": [dataclasses.asdict(line) for line in self.lines],
            "lengths": [_length(length) for length in self.lengths],
        }

    def _title(self) -> str:
        name = f"{self.name}: " if self.name else ""
        if not self.rate:
            return f"{name}cannot be read as a recording"
        return f"{name}{self.n:,} samples at {self.rate:g} Hz ({duration(self.n / self.rate)})"

    def _cells(self) -> list[tuple[str, str, str]]:
        return [(line.name, line.verdict, line.reason) for line in self.lines]

    def __str__(self) -> str:
        return text_table(self._title(), _HEADINGS, self._cells())

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return html_table(self._title(), _HEADINGS, self._cells())


def check(
    recording: RecordingLike,
    *,
    vibrating: bool = False,
    rate: float | None = None,
    gyro_unit: str | None = None,
    accel_unit: str | None = None,
    names: Sequence[str] | None = None,
    gaps: GapChoice | None = None,
) -> Check:
    """Say line by line whether a recording is fit for the estimation of noise coefficients.

    Looked at are time stamps, repeated and interpolated samples, resolution, saturation, dead axes, motion,
    disturbances, lines, units by their plausibility, temperature, bandwidth, and the length that N, B and K
    need, for which these are estimated roughly. No structure is searched for: it takes seconds.

    Args:
        recording: what `read` returns; or samples [samples, axes], a data frame, or a file's path.
        vibrating: whether the platform is meant to move or vibrate: motion is no reason to stop then.
        rate, gyro_unit, accel_unit, names: of an array, as `Recording.from_array` takes them; a data frame
            and a file may state their own.
        gaps: what to do about missing samples, as in `read`; of an array those that are nan.

    Returns:
        The lines. A file whose time stamps, or whose axes, allow no recording has one line, which says why.

    Raises:
        RecordingError, UnitError: what is given cannot be read for another reason, such as a missing unit.
    """
    try:
        given = as_recording(recording, rate, gyro_unit, accel_unit, names, gaps)
    except RecordingError as error:
        name = Path(recording).name if isinstance(recording, str | os.PathLike) else ""
        return unreadable(error, name)
    return check_of(given, inspect(given, vibrating=vibrating))


def unreadable(error: RecordingError, name: str) -> Check:
    """Check of what cannot be read because of its samples or time stamps; other errors are raised again."""
    if not error.about:
        raise error
    return Check(name, 0, 0.0, (Line(error.about, "stop", str(error)),))


def check_of(recording: Recording, seen: Inspection) -> Check:
    """Check of a recording that was inspected."""
    quiet = recording if seen.refusal else seen.quiet(recording)
    spectrum = spectrum_of(quiet.values, quiet.rate)
    widths = {name: spectrum and bandwidth_in(spectrum, k) for k, name in enumerate(quiet.names)}
    lengths = () if seen.refusal or quiet.n < _FEWEST else _lengths(quiet, seen, widths)
    lines = (*lines_of(recording, seen, widths), *_of_length(seen, lengths))
    return Check(recording.name, recording.n, recording.rate, lines, lengths)


def _lengths(
    quiet: Recording, seen: Inspection, widths: Mapping[str, float | None]
) -> tuple[NeededLength, ...]:
    """How long to record for N, B and K of each axis."""
    # Up to half of the bandwidth a filter passes nearly all.
    below = np.array([np.inf if width is None else width / 2.0 for width in widths.values()])
    results = (
        result.unmeasured(not_measured=why) if (why := seen.why_not(result.axis.name)) else result
        for result in rough_fits(quiet, below)
    )
    return tuple(length for result in results for length in needed_lengths(result, quiet.n, quiet.rate))


def _of_length(seen: Inspection, lengths: Sequence[NeededLength]) -> Iterator[Line]:
    """Lines on the length that N, B and K need."""
    for label, symbol in _SYMBOLS.items():
        own = [length for length in lengths if length.coefficient.label == label]
        name = f"length for {symbol}"
        if not own:
            short = f"fewer than {_FEWEST} samples"
            told = "there are no coefficients, see disturbances" if seen.refusal else short
            yield Line(name, "look", f"cannot be said: {told}")
        elif all(length.known for length in own):
            poorest = max(own, key=lambda length: length.relative_std)
            yield Line(name, "fine", f"{poorest}, other axes better" if len(own) > 1 else str(poorest))
        else:
            yield Line(name, "look", _together([length for length in own if not length.known]))


def _together(lengths: Sequence[NeededLength]) -> str:
    """Lengths in words, axes of which the same is told together."""
    axes: dict[str, list[str]] = {}
    for length in lengths:
        axes.setdefault(length.told(), []).append(length.coefficient.axis.name)
    return "; ".join(f"{', '.join(names)} {told}" for told, names in axes.items())


def _length(length: NeededLength) -> dict[str, Any]:
    """A needed length as a dictionary."""
    c = length.coefficient
    return {
        "axis": c.axis.name,
        "coefficient": c.label,
        "detected": c.detected,
        "relative_std": finite_or_none(length.relative_std),
        "target": TARGET,
        "needed_s": length.seconds,
        "of_size_si": c.value if c.detected else c.upper_limit,
        "reason": length.reason,
    }
