"""What the public interface says of the golden records, as flat tables of numbers, and how they are compared.

A number's kind decides by how much it may differ (see `distance`): numbers without an estimator in them by
1e-9, estimates by a share of their own standard error, decisions not at all.
"""

import contextlib
import dataclasses
import math
import re
from typing import Any

import bench
import numpy as np
from golden_records import CLEAN, EFFECTS, PLAIN, SHAPED

import allanjax as aj

#: Records of which these are computed as well, each for one more reason to notice a change.
EXACT = ("many", "short")
CHOSEN = (
    *("small", "quantized", "drifting", "edge", "one_pole", "resonance"),
    *("handled", "lossy", "stretches", "dead", "real_1", "real_2"),
)
POSTERIORS = {"small": ("gyro_x", "accel_z"), "edge": ("gyro_x",)}
CRITIQUES = (*EFFECTS, *CLEAN)
RANKED = ("small", "quantized", "markov_fast")
TARGETS = ("kalibr", "vins-mono", "gtsam")


@dataclasses.dataclass(frozen=True)
class Number:
    """A number with what it is compared by: its kind, and the standard error that its kind may need."""

    kind: str
    value: Any
    scale: float = 1.0

    def plain(self):
        """For JSON, with the digits that matter."""
        digits = 15 if self.kind == "exact" else 9
        return [self.kind, _rounded(self.value, digits), _rounded(self.scale, 6)]


def _rounded(value, digits):
    if isinstance(value, list | tuple | np.ndarray):
        return [_rounded(v, digits) for v in value]
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, float | int | np.number):
        return float(f"{value:.{digits}g}") if math.isfinite(value) else None
    return value


def numbers_of(name: str) -> dict[str, Number]:
    """All numbers of one record by their place, e.g. "whittle/gyro_x/angle_random_walk/std"."""
    parts = [part for part, names in _PARTS.items() if names is None or name in names]
    return {place: number for part in parts for place, number in part(name)}


def _curves(name):
    """Numbers without an estimator in them: the record's curves, and those of its true model."""
    record, recording = bench.truth(name), bench.recording(name)
    yield "record", Number("exact", record.fingerprint)
    curve = aj.allan_deviation(recording)
    spectrum = aj.power_spectrum(recording)
    places = np.unique(np.linspace(1, len(spectrum.frequency) - 2, 8).astype(int))
    for k, axis in enumerate(curve.names):
        yield f"curve/{axis}/deviation", Number("exact", curve.deviation[:, k])
        yield f"curve/{axis}/edf", Number("exact", curve.edf[:, k])
        yield f"curve/{axis}/psd", Number("exact", spectrum.density[places, k])
    if name in (*PLAIN, *SHAPED):
        axis = recording.names[0]
        template = bench.fit(name, record.model, "whittle").template
        model = template.with_values(**record.truth[axis])
        amplitudes = [p for p in model.parameters if p.parameter.is_amplitude]
        lacking = [p.term_label for p in amplitudes if model.values[p.label] is None]
        model = model.without(lacking).sampled(record.rate)
        frequency = record.rate * np.array([0.003, 0.05, 0.23, 0.41])
        yield "model/variance", Number("exact", model.allan_variance(np.array([2, 16, 256]) / record.rate))
        yield "model/psd", Number("exact", model.sampled_psd(frequency, record.rate))


def _given(name):
    """Fits of the model that the record has, by every objective that can fit it."""
    record = bench.truth(name)
    objectives = ["whittle"] if name in SHAPED else ["allan", "whittle"]
    if name in EXACT:
        objectives.append("exact")
    for objective in objectives:
        yield from _of_fit(objective, bench.fit(name, record.model, objective))


def _chosen(name):
    """The fit that chooses its terms."""
    fit = bench.fit(name)
    yield from _of_fit("chosen", fit)
    yield "chosen/warnings", Number("same", len(fit.warnings))
    yield "chosen/dead", Number("same", [axis.axis.name for axis in fit.dead])
    stretch = [-1.0, -1.0] if fit.longest_part is None else list(fit.longest_part)
    yield "chosen/stretch", Number("seconds", stretch)


def _of_fit(label, fit):
    """Coefficients, their uncertainty, and how well the model fits."""
    for result in fit.results:
        place = f"{label}/{result.axis.name}"
        yield f"{place}/converged", Number("same", result.converged)
        if not result.converged:
            continue
        yield f"{place}/measured", Number("same", result.measured)
        yield f"{place}/p_value", Number("p_value", result.p_value)
        yield f"{place}/discrepancy", Number("misfit", result.discrepancy)
        yield f"{place}/chi2", Number("chi2", result.chi2, math.sqrt(2.0 * max(result.dof, 1)))
        yield f"{place}/terms", Number("same", sorted(result.model.term_labels))
        # Which of two like terms is the first, the last bits decide: here the one of the shorter time.
        found = result.coefficients
        times = sorted((c.value, x[:8]) for x, c in found.items() if x[8:] == "_correlation_time")
        rank = {first: f"markov_{k}" for k, (_, first) in enumerate(times, 1)}
        for name, c in found.items():
            yield from of_estimate(f"{place}/{rank.get(name[:8], name[:8])}{name[8:]}", c)


def of_estimate(place, c):
    """Value, standard deviation, intervals and limit of one coefficient."""
    yield f"{place}/detected", Number("same", c.detected)
    if c.detected and np.isfinite(c.std) and c.std > 0.0:
        least_squares = place.startswith(("allan", "chosen"))
        yield f"{place}/value", Number("fitted" if least_squares else "likely", c.value, c.std)
        yield f"{place}/std", Number("std", c.std)
        yield f"{place}/interval", Number("end", c.interval, c.std)
        yield f"{place}/interval_68", Number("end", c.interval_68, c.std)
    elif c.upper_limit is not None:
        yield f"{place}/upper_limit", Number("limit", c.upper_limit)


def _ranking(name):
    """Log evidences of the best sets of terms, relative to the best one, and how probable each term is."""
    for result in bench.selection(name).results:
        place = f"selection/{result.axis.name}"
        yield f"{place}/chosen", Number("same", sorted(result.chosen.terms))
        best = result.ranking[:3]
        differences = [s.log_evidence - best[0].log_evidence for s in best]
        yield f"{place}/log_evidence", Number("log_evidence", differences)
        yield f"{place}/inclusion", Number("probability", [p for _, p in sorted(result.inclusion.items())])


def _posterior(name):
    """Medians, ends of intervals and limits of a posterior."""
    for result in bench.posterior(name, POSTERIORS[name]).results:
        for label, c in result.coefficients.items():
            place = f"posterior/{result.axis.name}/{label}"
            if c.detected and np.isfinite(c.std):
                yield f"{place}/value", Number("drawn", c.value, c.std)
                yield f"{place}/interval", Number("drawn_end", c.interval, c.std)
            elif c.upper_limit is not None:
                yield f"{place}/upper_limit", Number("limit", c.upper_limit)


def _critique(name):
    """Findings with their axes, parameters, odds and gain."""
    critique = bench.critique(name)
    # Like findings are told apart by their first parameter.
    first = lambda f: next((e.value for e in f.parameters.values()), 0.0)  # noqa: E731
    found = sorted(critique.findings, key=lambda f: (f.cause, f.axes, first(f)))
    yield "critique/findings", Number("same", [[f.cause, *f.axes] for f in found])
    for k, finding in enumerate(found):
        place = f"critique/{k} {finding.cause}"
        for label, e in finding.parameters.items():
            if e.std > 0.0 and np.isfinite(e.std):
                yield f"{place}/{label}/value", Number("parameter", e.value, e.std)
                yield f"{place}/{label}/std", Number("parameter_std", e.std)
            else:
                yield f"{place}/{label}/value", Number("limit", e.value)
        for what in ("evidence", "gain"):
            if (value := getattr(finding, what)) is not None:
                yield f"{place}/{what}", Number(what, value)


def _uses(name):
    """What is made of a fit: filter numbers, growth of errors, lengths, exports."""
    fit = bench.fit(name)
    for result in aj.horizon(fit, 10.0).results:
        place = f"horizon/{result.axis.name}"
        yield f"{place}/white", Number("share_2", result.white.value)
        yield f"{place}/walk", Number("share_2", result.walk.value)
    for quantity, growth in aj.navigate(fit, [1.0, 10.0, 100.0]).items():
        numbers = growth.to_dataframe().select_dtypes(float).to_numpy().ravel()
        yield f"navigation/{quantity}", Number("share_2", numbers)
    for line in aj.check(bench.recording(name)).lines:
        yield f"check/{line.name}", Number("same", line.verdict)
    for target in TARGETS:
        values = []
        for word in re.sub(r"#.*|[,\[\]]", " ", aj.export(fit, target)).split():
            with contextlib.suppress(ValueError):
                values.append(float(word))
        yield f"export/{target}", Number("share_2", sorted(values))


_PARTS = {
    _curves: None,
    _given: (*PLAIN, *SHAPED),
    _chosen: CHOSEN,
    _ranking: RANKED,
    _posterior: POSTERIORS,
    _critique: CRITIQUES,
    _uses: ("small",),
}


#: By how much numbers of a kind may differ.
# Estimates: a tenth of σ between maximizers of one likelihood, three tenths where only the target is fixed
# (least squares on the Allan curve; a search for structure), 0.15 σ for what is drawn, 4.5 of its errors.
_IN_SIGMA = {"likely": 0.1, "fitted": 0.3, "end": 0.15, "drawn": 0.15, "drawn_end": 0.2}
_IN_SIGMA |= {"parameter": 0.3, "chi2": 0.3}
# Ratios: a limit is known to a fifth itself; σ of a finding to a quarter.
_RATIOS = {"std": 1.07, "limit": 1.18, "parameter_std": 1.25, "share_2": 1.02, "misfit": 1.1}
# Absolute: nats, probabilities, seconds (a window of the first look is 2.56 s).
_ABSOLUTE = {"evidence": 1.0, "gain": 1.5, "log_evidence": 0.3, "probability": 0.05, "seconds": 2.6}
# Where the numbers are large, a share of them.
_SHARES = {"evidence": 0.1, "gain": 0.15}


def distance(before: Any, now: Number) -> float:
    """How far a number is from what it was, in units of what it may; above 1 the meaning has changed."""
    was, is_ = before[1], now.plain()[1]
    if now.kind == "same" or before[0] != now.kind or np.shape(was) != np.shape(is_):
        return 0.0 if was == is_ and before[0] == now.kind else math.inf
    a, b = (np.atleast_1d(np.array(x, dtype=float)) for x in (was, is_))
    if not np.array_equal(np.isnan(a), np.isnan(b)):
        return math.inf
    a, b = a[~np.isnan(a)], b[~np.isnan(b)]
    return float(np.max(_distances(a, b, now.kind, before[2] or 1.0), initial=0.0))


def _distances(a, b, kind, scale):
    if kind == "exact":
        return np.abs(b - a) / (1e-9 * np.maximum(np.abs(a), 1e-6 * np.max(np.abs(a))))
    if kind in _IN_SIGMA:
        return np.abs(b - a) / (_IN_SIGMA[kind] * scale)
    if kind == "p_value":
        low = np.log10(np.clip([a, b], 1e-6, 1.0))
        return np.abs(low[1] - low[0]) / 0.3
    if kind in _ABSOLUTE:
        return np.abs(b - a) / np.maximum(_ABSOLUTE[kind], _SHARES.get(kind, 0.0) * np.abs(a))
    if kind == "misfit":
        # What was sufficient stays so; small ones are noise.
        a, b = np.maximum(a, 1e-3), np.maximum(b, 1e-3)
    same = (a == b) | (a * b <= 0.0)
    ratio = np.abs(np.log(np.where(same, 1.0, np.abs(b)) / np.where(same, 1.0, np.abs(a))))
    return np.where(a * b < 0.0, np.inf, ratio) / math.log(_RATIOS[kind])


def overall(before: dict[str, Any], now: dict[str, Number]) -> tuple[list[float], list[float]]:
    """Differences of all estimates over their σ, and logarithms of the ratios of all σ."""
    both = [(before[p], now[p]) for p in now if p in before and before[p][0] == now[p].kind]
    moved = [(new.value - old[1]) / old[2] for old, new in both if new.kind in ("likely", "fitted")]
    return moved, [math.log(new.value / old[1]) for old, new in both if new.kind == "std"]
