"""Check, line by line, whether a recording is suitable for estimation, and how long it should be.

Rough fits maximize Whittle's likelihood of the cosine spectrum by Fisher scoring with non-negative powers;
errors follow from the Fisher information. Nothing is compiled, no terms are chosen, no structure is searched.

The levels c_j² of the cosine spectrum (see `spectrum.cosine`) are independent and χ² with one degree of
freedom around the density S(f_j), f_j = j·rate/2n, j = 1 … n−1. So the Fisher information of n samples on
the logarithms of the parameters θ is

    F_ab = ½ Σ_j (∂ ln S_j/∂ ln θ_a)(∂ ln S_j/∂ ln θ_b),

and no unbiased estimate of θ_a has a relative standard deviation below √[F⁻¹]_aa. A longer recording adds
lower frequencies, where slow terms dominate, and more levels at all others.
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
from allanjax.base.renamed import renamed
from allanjax.base.tables import Column, Tabled, columns_from
from allanjax.base.wording import duration, finite_or_none, plain, record_size, significant
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

# Steps of Fisher scoring, and the scatter beyond which a level contains a line and is left out.
_STEPS, _LINE = 30, 6.0
# p-value below which the terms do not fit the spectrum.
_REJECTED = 1e-6
#: Relative standard deviation at which a coefficient counts as known.
TARGET = 0.2
_TARGET_WORDS = f"±{100.0 * TARGET:.0f} %"
#: Longest recording that is proposed [s]: a month.
LONGEST = 30.0 * 86400.0
# Coefficients for which a length is reported.
_ASKED: dict[str, type[NoiseTerm]] = {"N": AngleRandomWalk, "B": BiasInstability, "K": RateRandomWalk}
# Levels up to this one count individually, further ones in so many groups per octave.
_SINGLE, _PER_OCTAVE = 256, 32
# Step of the logarithm of a parameter in a derivative, downwards because some bandwidths have an upper bound.
_STEP = 1e-4
# Samples of the shortest record considered, and the relative accuracy of a length.
_SHORTEST, _ACCURACY = 64, 1e-3
SCHEMA_VERSION = 1
# Fewest samples from which a length is determined.
_FEWEST = 64
# Characters of a finding that the table has room for; a longer one is cut, and printed in full below.
_CELL = 71


def rough_fits(recording: Recording, below: Float[np.ndarray, " axes"]) -> tuple[AxisFit, ...]:
    """Return a rough fit of every axis to frequencies up to its `below` [Hz]; inf for all frequencies."""
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
    """Return the rough fit of one axis."""
    mean, used = np.maximum(statistics.squares / size, 1e-300), np.ones(len(size), bool)
    # The first level is an average over neighbours, as single levels scatter.
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
        # Beside the terms that are present.
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
    """Return the amplitudes of the terms from their powers, with errors and limits."""
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
    """How well a coefficient is known, and how long to record for a standard deviation of 20 %.

    Attributes:
        coefficient: the estimate of N, B or K [SI].
        relative_std: its relative standard deviation now; nan if it is not detected or not measured.
        now: length [s] that was fitted.
        seconds: length [s] at which the Cramér–Rao bound is 20 %, for an undetected coefficient if it were at
            its 95 % upper limit; None if that is more than a month, or unknown.
        reason: why it is unknown; "" if it is known.
    """

    coefficient: Estimate
    relative_std: float
    now: float
    seconds: float | None
    reason: str = ""

    told = renamed("describe")

    @property
    def known(self) -> bool:
        """Whether the coefficient is known to ±20 % already."""
        return self.relative_std <= TARGET

    def __str__(self) -> str:
        return f"{self.coefficient.axis.name}: {self.describe()}"

    def describe(self) -> str:
        """Return what is known and how long to record, in words, without the name of the axis."""
        needed = f"{_in_words(self.seconds)} would give {_TARGET_WORDS}"
        if not math.isnan(self.relative_std):
            known = f"known to ±{plain(100.0 * self.relative_std, 2)} %"
            return known if self.known else f"{known}, {self.reason or needed}"
        if self.reason:
            return f"unknown, {self.reason}"
        c = self.coefficient.in_unit()
        below = f"not detected (< {significant(c.upper_limit or 0.0)} {c.unit}, 95 %)"
        if self.seconds is not None and self.seconds <= self.now:
            return f"{below}, at that limit it would usually be detected by now"
        return f"{below}; if it were at that limit, {needed}"


def needed_lengths(result: AxisFit, n: int, rate: float) -> tuple[NeededLength, ...]:
    """Return how long to record for N, B and K of an axis, given its fit to n samples at `rate` [Hz].

    If the fit's standard deviation exceeds the bound at its own length, lengths are scaled accordingly.
    """
    if not result.converged:
        return ()
    wanted = (term.name() for term in _ASKED.values())
    return tuple(_needed(result, result[label], n, rate) for label in wanted if label in result.coefficients)


def _needed(result: AxisFit, c: Estimate, n: int, rate: float) -> NeededLength:
    """Return how long to record for one coefficient of an axis."""
    now = n / rate
    if not result.measured:
        return NeededLength(c, math.nan, now, None, "the fit does not describe this sensor")
    if c.detected and c.value > 0.0 and np.isfinite(c.std):
        std = c.std / c.value
        if std <= TARGET:
            return NeededLength(c, std, now, now)
        if result.discrepancy > 0.0:
            why = "the length is unknown as the model does not fit the data"
            return NeededLength(c, std, now, None, why)
        # The fit cannot be better than the bound; longer ones are assumed to be worse by the same factor.
        target = TARGET * min(relative_std(result.model, n, rate)[c.label] / std, 1.0)
        return NeededLength(c, std, now, length_for(result.model, c.label, rate, target))
    if c.upper_limit is None or not c.upper_limit > 0.0:
        return NeededLength(c, math.nan, now, None, "there is no upper limit")
    term = next(term for term in _ASKED.values() if term.name() == c.term)
    name = term.amplitude_parameter().name
    there = result.model.without([c.term]) if c.term in result.model.term_labels else result.model
    at_limit = there + term().replace(**{name: c.upper_limit})
    return NeededLength(c, math.nan, now, length_for(at_limit, c.term, rate))


def length_for(model: Model, label: str, rate: float, target: float = TARGET) -> float | None:
    """Return the length [s] at which the bound of a parameter's relative standard deviation is `target`.

    None if that is more than `LONGEST`.

    Raises:
        AllanjaxError: the model has no such parameter with a value.
    """

    def bound(n: float) -> float:
        bounds = relative_std(model, round(n), rate)
        if label not in bounds:
            raise AllanjaxError(f"the model has no parameter {label!r}; it has {', '.join(bounds)}")
        return bounds[label]

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
    """Return the Cramér–Rao bound of each parameter's relative standard deviation, for n samples at `rate`.

    All parameters with a value count as unknown except held ones and those of deterministic terms, which
    affect at most one level each. The bound is inf if n samples hold no information on the parameter.
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
    """Return whether a parameter is unknown: finite, nonzero, not held; numbers such as orders are known."""
    owner = model.response if p.term == len(model.terms) else model.terms[p.term]
    known = owner is None or p.parameter.name in owner.held or p.parameter.kind == "number"
    return not known and bool(np.isfinite(p.start or 0.0) and p.start)


def _bound(F: Float[np.ndarray, "params params"]) -> Float[np.ndarray, " params"]:
    """Return the roots of the diagonal of an inverse Fisher matrix; inf where it has no information."""
    size = np.sqrt(np.diag(F))
    informed = size > 1e-6
    bound = np.full(len(F), np.inf)
    scaled = F[np.ix_(informed, informed)] / np.outer(size[informed], size[informed])
    values, vectors = np.linalg.eigh(scaled)
    variance = (vectors**2 / np.maximum(values, 1e-12)).sum(axis=1)
    bound[informed] = np.sqrt(variance) / size[informed]
    return bound


def _groups(n: int, first: int) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
    """Return the first and last level of each group, from level `first` to n − 1."""
    single = np.arange(first, min(_SINGLE, n - 1) + 1)
    octaves = max(math.log2(n / _SINGLE), 0.0)
    further = (_SINGLE + 1) * 2.0 ** np.arange(0.0, octaves, 1.0 / _PER_OCTAVE)
    starts = np.unique(np.concatenate([single, np.rint(further).astype(int)]))
    starts = starts[starts < n]
    return starts, np.append(starts[1:] - 1, n - 1)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Check(ByValue, Tabled):
    """Whether a recording is suitable for the estimation of noise coefficients.

    Attributes:
        name, n, rate: the recording's name, number of samples and sample rate [Hz]; 0 if it cannot be read.
        lines: the checks, each with its name, a verdict "fine", "look" or "stop", and the reason in words.
        lengths: how long to record for N, B and K of each axis to be known to ±20 %.
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
        """The lines whose verdict is stop."""
        return tuple(line for line in self.lines if line.verdict == "stop")

    def __getitem__(self, name: str) -> Line:
        """Return the line of this name; AllanjaxError if there is none."""
        for line in self.lines:
            if line.name == name:
                return line
        raise AllanjaxError(f"no line {name!r}; lines are {', '.join(line.name for line in self.lines)}")

    def summary(self) -> str:
        """Return one line of text: which checks read stop or look, and how many are fine."""
        parts = [f"{verdict}: {names}" for verdict in ("stop", "look") if (names := self._names(verdict))]
        return "; ".join([*parts, f"{len(self._of('fine'))} of {len(self.lines)} checks are fine"])

    def to_dict(self) -> dict[str, Any]:
        """Return the check as plain dictionaries, lists, numbers and strings, for JSON."""
        seconds = self.n / self.rate if self.rate else 0.0
        return {
            "schema_version": SCHEMA_VERSION,
            "recording": {"name": self.name, "n": self.n, "rate_hz": self.rate, "duration_s": seconds},
            "verdict": self.verdict,
            "lines": [dataclasses.asdict(line) for line in self.lines],
            "lengths": [_length(length) for length in self.lengths],
        }

    def _title(self) -> str:
        return record_size(self.n, self.rate) if self.rate else "cannot be read as a recording"

    def _of(self, verdict: str) -> list[Line]:
        return [line for line in self.lines if line.verdict == verdict]

    def _names(self, verdict: str) -> str:
        return ", ".join(line.name for line in self._of(verdict))

    def _tables(self) -> list[list[Column]]:
        lines = (*self._of("stop"), *self._of("look"))
        rows = [(line.name, line.verdict, line.reason.partition("; ")[0]) for line in lines]
        return [columns_from(("check", "verdict", "reason"), rows)] if rows else []

    def _notes(self) -> Iterator[str]:
        for line in (*self._of("stop"), *self._of("look")):
            finding, _, rest = line.reason.partition("; ")
            more = line.reason if len(finding) > _CELL else rest
            # The lengths of all axes are in `lengths`, and in JSON.
            if more and not line.name.startswith("length for"):
                yield f"{line.name}: {more}"
        yield f"fine: {self._names('fine') or 'none'}"


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
    """Check, line by line, whether a recording is suitable for the estimation of noise coefficients.

    The lines are on time stamps, repeated and interpolated samples, resolution, saturation, dead axes,
    motion, disturbances, spectral lines, plausible units, temperature, bandwidth, and the length needed for
    N, B and K, which are estimated roughly. No structure is searched, so this takes seconds.

    Args:
        recording: what `read` returns; or samples [samples, axes], a data frame, or a file's path.
        vibrating: whether the platform is meant to move or vibrate; then motion is not a reason to stop.
        rate, gyro_unit, accel_unit, names: as in `Recording.from_array` for an array; a data frame and a
            file may state their own.
        gaps: what to do about missing samples, as in `read`; in an array these are nan.

    Returns:
        The check. For a file with unusable time stamps or axes it has a single line with the reason.

    Raises:
        RecordingError, UnitError: the data cannot be read for another reason, such as a missing unit.
    """
    try:
        given = as_recording(recording, rate, gyro_unit, accel_unit, names, gaps)
    except RecordingError as error:
        name = Path(recording).name if isinstance(recording, str | os.PathLike) else ""
        return unreadable(error, name)
    return check_of(given, inspect(given, vibrating=vibrating))


def unreadable(error: RecordingError, name: str) -> Check:
    """Return the check of data with unusable samples or time stamps; other errors are raised again."""
    if not error.about:
        raise error
    return Check(name, 0, 0.0, (Line(error.about, "stop", str(error)),))


def check_of(recording: Recording, inspection: Inspection) -> Check:
    """Return the check of a recording that was inspected."""
    quiet = recording if inspection.refusal else inspection.quiet(recording)
    spectrum = spectrum_of(quiet.values, quiet.rate)
    widths = {name: spectrum and bandwidth_in(spectrum, k) for k, name in enumerate(quiet.names)}
    lengths = () if inspection.refusal or quiet.n < _FEWEST else _lengths(quiet, inspection, widths)
    lines = (*lines_of(recording, inspection, widths), *_of_length(inspection, lengths))
    return Check(recording.name, recording.n, recording.rate, lines, lengths)


def _lengths(
    quiet: Recording, inspection: Inspection, widths: Mapping[str, float | None]
) -> tuple[NeededLength, ...]:
    """Return how long to record for N, B and K of each axis."""
    # Up to half of its bandwidth a filter passes nearly everything.
    below = np.array([np.inf if width is None else width / 2.0 for width in widths.values()])
    results = (
        result.unmeasured(not_measured=why) if (why := inspection.why_not(result.axis.name)) else result
        for result in rough_fits(quiet, below)
    )
    return tuple(length for result in results for length in needed_lengths(result, quiet.n, quiet.rate))


def _of_length(inspection: Inspection, lengths: Sequence[NeededLength]) -> Iterator[Line]:
    """Yield lines on the length needed for N, B and K."""
    for symbol, term in _ASKED.items():
        own = [length for length in lengths if length.coefficient.label == term.name()]
        name = f"length for {symbol}"
        if not own:
            short = f"fewer than {_FEWEST} samples"
            yield Line(name, "look", f"unknown, {'see disturbances' if inspection.refusal else short}")
        elif all(length.known for length in own):
            poorest = max(own, key=lambda length: length.relative_std)
            yield Line(name, "fine", f"{poorest}{', other axes better' * (len(own) > 1)}")
        else:
            left = [length for length in own if not length.known]
            yield Line(name, "look", "; ".join([_in_short(left), *map(str, left)]))


def _in_short(lengths: Sequence[NeededLength]) -> str:
    """Return how many axes lack a coefficient, and the longest recording that any of them needs."""
    states: dict[str, list[NeededLength]] = {}
    for x in lengths:
        state = "not detected" if math.isnan(x.relative_std) else f"known to worse than {_TARGET_WORDS}"
        states.setdefault("unknown" if x.reason else state, []).append(x)
    if len(states) > 1:
        # Axes whose fit does not describe the sensor have a line of their own.
        states.pop("unknown", None)
    names = [x[0].coefficient.axis.name if len(x) == 1 else f"{len(x)} axes" for x in states.values()]
    head = ", ".join(f"{axes} {state}" for axes, state in zip(names, states, strict=True))
    if "unknown" in states:
        return head
    left = [x for of in states.values() for x in of]
    longest = max(left, key=lambda x: x.seconds or math.inf)
    at_limit = "at the limit, " * (states.keys() == {"not detected"})
    where = f" ({longest.coefficient.axis.name})" * (len(left) > 1)
    return f"{head}; {at_limit}{_in_words(longest.seconds)} would give {_TARGET_WORDS}{where}"


def _in_words(seconds: float | None) -> str:
    return duration(seconds) if seconds else "more than a month"


def _length(length: NeededLength) -> dict[str, Any]:
    """Return a needed length as a dictionary."""
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
