"""Whether a sensor meets its specification: limits in a YAML file against the estimates of a fit."""

from __future__ import annotations

import dataclasses
import functools
import math
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np

from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError
from allanjax.base.late import presented
from allanjax.base.normal import ONE_SIDED_95
from allanjax.base.tables import Column, Tabled, columns_from
from allanjax.base.wording import duration, percent, significant
from allanjax.estimate.as_json import in_both_units, in_json
from allanjax.estimate.check import length_for, random_terms, trial_lengths
from allanjax.estimate.least_deviation import least_deviation
from allanjax.estimate.result import AxisFit, Fit, detail
from allanjax.noise.datasheet import LEAST, Figures
from allanjax.noise.estimate import SYMBOLS, Estimate, is_called
from allanjax.noise.model import Model
from allanjax.noise.notation import term_classes
from allanjax.record.units import SENSORS, Sensor, default_coefficient_unit, unit_scale

SCHEMA_VERSION = 1
Verdict = Literal["pass", "fail", "undecided", "typical"]
#: Probability from which a limit is met, and up to which it is not.
MET, MISSED = 0.95, 0.05
NO_AXIS = "the record has no such axis"
# Keys of a section that answer what a figure leaves open, and figures that are no limits.
_ANSWERS = ("meaning", "sided", "bandwidth", "bandwidth_is", "reading")
_NO_LIMITS = ("lsb", "rate", "conditions")


class Limit(NamedTuple):
    """A limit: its key, the sensor or axis it is for, label, value [SI], usual unit, and meaning."""

    figure: str
    section: str
    label: str
    value: float
    unit: str
    meaning: str

    @property
    def title(self) -> str:
        """The key in words."""
        return self.figure.replace("_", " ")


#: A specification as `check_spec` takes it: a YAML file, or the same as a dictionary.
SpecLike: TypeAlias = str | os.PathLike[str] | Mapping[str, Any]


@functools.cache
def _exponents() -> dict[str, float]:
    """Exponent of time in the unit of the amplitude of every noise term, by its label."""
    every = (p for made in term_classes().values() for p in Model((made(),)).parameters)
    return {p.label: p.parameter.time_exponent for p in every if p.parameter.is_amplitude}


def read_spec(sheet: SpecLike) -> tuple[str, list[Limit]]:
    """Name and limits of a sheet, see `check_spec`; AllanjaxError or UnitError if it cannot be read."""
    where, document = "specification" if isinstance(sheet, Mapping) else str(sheet), read_sheet(sheet)
    limits: list[Limit] = []
    for section, given in document.items():
        sensor = str(section).partition("_")[0]
        if sensor in SENSORS:
            limits += _limits(str(section), sensor, given, f"{where}: {section}")
        elif section not in ("name", "source"):
            raise AllanjaxError(
                f"{where}: unknown key {section!r}; the keys are name, source, gyro, accel, and axes such as "
                "gyro_x"
            )
    if not limits:
        raise AllanjaxError(
            f"{where}: no limit; write gyro: or accel: and below it e.g. random_walk: 1 deg/√h"
        )
    return str(document.get("name", "specification")), limits


def read_sheet(sheet: SpecLike) -> Mapping[str, Any]:
    """Contents of a YAML file, or of what a dictionary has in place of it."""
    if isinstance(sheet, Mapping):
        return sheet
    import yaml

    class Loader(yaml.SafeLoader):
        """Refuses a key that is given twice, of which YAML would keep the last without a word."""

        def construct_mapping(self, node: Any, deep: bool = False) -> Any:
            seen = set[str]()
            for key, _ in node.value:
                name = str(key.value)
                if name in seen:
                    raise yaml.YAMLError(f"{name} is given twice, again in line {key.start_mark.line + 1}")
                seen.add(name)
            return super().construct_mapping(node, deep)

    try:
        document = yaml.load(Path(sheet).read_text(encoding="utf-8"), Loader)
    except (OSError, UnicodeDecodeError, RecursionError, yaml.YAMLError) as error:
        why = error.strerror if isinstance(error, OSError) else " ".join(str(error).split())
        raise AllanjaxError(f"{sheet}: {why}; give a YAML file with limits of gyro or accel") from error
    if not isinstance(document, Mapping):
        raise AllanjaxError(f"{sheet}: not a table; write gyro: or accel: and its limits below")
    return {"name": Path(sheet).stem, **document}


def _limits(section: str, sensor: Sensor, given: Any, where: str) -> Iterator[Limit]:
    """Yield the limits of a section: a text each, or a table with `limit` and what is said of it alone."""
    if not isinstance(given, Mapping):
        raise AllanjaxError(f"{where} is not a table: write its limits below {section}:")
    shared = {key: given[key] for key in _ANSWERS if key in given}
    for key, value in given.items():
        if key in shared:
            continue
        if key in _NO_LIMITS:
            raise AllanjaxError(f"{where} {key} is not a limit of noise: leave it out")
        own = {**shared, **(value if isinstance(value, Mapping) else {"limit": value})}
        if "limit" not in own:
            raise AllanjaxError(f"{where} {key} needs limit: 1 UNIT")
        limit, meaning = own.pop("limit"), own.pop("meaning", None)
        if meaning not in ("maximum", "typical"):
            raise AllanjaxError(
                f"{where} {key} needs meaning: maximum (of this unit) or meaning: typical (of many units, so "
                f"reported only), not {meaning!r}"
            )
        known = _exponents()
        # A usual name of the coefficient, such as N or VRW.
        usual = (x for x in known if SYMBOLS.get(x) == key or is_called(str(key), x, sensor))
        name = next(usual, str(key))
        label, size = Figures(sensor, {**own, name: limit}, where, known).one(name)
        unit = default_coefficient_unit(sensor, known.get(label, 0.0))
        yield Limit(str(key), section, label, size, unit, meaning)


@dataclasses.dataclass(frozen=True, eq=False)
class LimitCheck(ByValue):
    """One limit against the estimate of one axis.

    Attributes:
        axis: name of the axis; of the sensor if the record has none of its axes.
        limit: the limit.
        estimate: the estimate [SI]; None if there is none.
        probability: least and greatest probability that the true value is below the limit. They are equal for
            an estimate with an interval; of what is not detected, or still falls at the end of the record,
            the greatest is 1, or that of the models extrapolated.
        seconds: length of record [s] that would decide if it gave the same value, infinite beyond a month;
            None if it is unknown.
        reason: why it is undecided, or how far the estimate is from a typical value, in words.
    """

    axis: str
    limit: Limit
    estimate: Estimate | None = None
    probability: tuple[float, float] = (math.nan, math.nan)
    seconds: float | None = None
    reason: str = ""

    @property
    def verdict(self) -> Verdict:
        """ "pass" if the least probability is 95 % or more, "fail" if the greatest is 5 % or less.

        Else it is "undecided"; "typical" for a typical value, which is no limit for one unit.
        """
        if self.limit.meaning == "typical" and self.estimate is not None and not self.estimate.held:
            return "typical"
        least, greatest = self.probability
        if least >= MET:
            return "pass"
        return "fail" if greatest <= MISSED else "undecided"

    @property
    def ratio(self) -> float:
        """The estimate over the limit; nan without an estimate that is detected."""
        c = self.estimate
        return c.value / self.limit.value if c is not None and c.detected else math.nan

    @property
    def score(self) -> float:
        """How many standard errors of its logarithm the estimate is above the limit; nan as for `ratio`."""
        c = self.estimate
        return -c.score(self.limit.value) if c is not None and c.detected else math.nan

    @property
    def margin(self) -> str:
        """How far the estimate is below the limit, with its 95 % interval, or at least; "" if unknown."""
        c = self.estimate
        if c is None or c.held:
            return ""

        def below(x: float) -> str:
            return percent(1.0 - x / self.limit.value)

        if not c.detected:
            return "" if c.upper_limit is None else f"≥ {below(c.upper_limit)}"
        if math.isnan(c.interval[1]):
            return below(c.value)
        most, least = (below(end).removesuffix(" %") for end in c.interval)
        return f"{below(c.value)} ({least} … {most})"

    def row(self) -> tuple[str, ...]:
        """The row of the printed table."""
        limit = self.limit
        shown = "" if self.estimate is None else detail(self.estimate, limit.unit)[2]
        least, most = (percent(round(p, 3), 3) if p >= 0.0 else "" for p in self.probability)
        chances = least
        if least and least != most:
            chances = f"{least} … {most}" if self.probability[1] < 1.0 else f"≥ {least}"
        return (
            self.axis,
            limit.title,
            shown.removesuffix(f" {limit.unit}"),
            f"{limit.meaning[:3]} {significant(limit.value / unit_scale(limit.unit))}",
            limit.unit,
            self.margin,
            chances,
            self.verdict,
        )

    def to_dict(self) -> dict[str, Any]:
        """The check as plain dictionaries; None for what there is not."""
        limit = self.limit
        told = {
            "axis": self.axis,
            **{key: getattr(limit, key) for key in ("figure", "label", "meaning", "unit")},
            "limit": limit.value / unit_scale(limit.unit),
            "limit_si": limit.value,
            "estimate": self.estimate and in_both_units(self.estimate),
            "ratio": self.ratio,
            "standard_errors_above": self.score,
            "probability": self.probability,
            "verdict": self.verdict,
            "needed_s": self.seconds,
            "reason": self.reason,
        }
        return in_json(told)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class SpecCheck(ByValue, Tabled):
    """A sensor against its specification.

    Attributes:
        name: the recording's name.
        sheet: name of the specification.
        results: one for each limit and axis.
    """

    name: str
    sheet: str
    results: tuple[LimitCheck, ...]

    @property
    def verdict(self) -> Verdict:
        """That of all limits: "fail" if any is not met, else "undecided" if any is, else "pass"."""
        found = [result.verdict for result in self.results]
        if "fail" in found:
            return "fail"
        return "undecided" if "undecided" in found else "pass"

    def to_dict(self) -> dict[str, Any]:
        """The checks as plain dictionaries, for JSON."""
        return {
            "schema_version": SCHEMA_VERSION,
            "recording": {"name": self.name},
            "specification": self.sheet,
            "verdict": self.verdict,
            "limits": [result.to_dict() for result in self.results],
        }

    @presented
    def to_junit(self) -> str:
        """The checks as JUnit XML for continuous integration: a test case for each limit and axis.

        A limit that is not met is a failure, one that is undecided is skipped.
        """
        raise NotImplementedError

    def _title(self) -> str:
        return f"{self.verdict}, against {self.sheet}"

    def _tables(self) -> list[list[Column]]:
        heads = ("axis", "figure", "estimate ± 1σ", "limit", "unit", "margin", "probability", "verdict")
        return [columns_from(heads, [result.row() for result in self.results])]

    def _notes(self) -> Iterator[str]:
        yield (
            "max: maximum, typ: typical; margin: how far the estimate is below the limit (95 % interval); "
            f"probability: that the true value is below it; pass from {percent(MET)} on, fail up to "
            f"{percent(MISSED)}"
        )
        told: dict[tuple[str, str], list[str]] = {}
        for r in self.results:
            told.setdefault((r.axis, r.reason), []).append(r.limit.title)
        yield from (f"{axis} {', '.join(titles)}: {why}" for (axis, why), titles in told.items() if why)


def check_spec(fit: Fit, sheet: SpecLike) -> SpecCheck:
    """Check a sensor against the limits of its specification, with the probability that each is met.

    The sheet is a YAML file, or the same as a dictionary, with the keys of a data sheet (see `datasheet`) and
    the usual names of coefficients, such as `quantization`, `N` or `VRW`. Each limit has a meaning:

        name: acceptance test
        gyro:
          meaning: maximum          # the true value of this unit must be below it
          noise_density: 0.008 deg/s/√Hz
          sided: one
          in_run_bias_instability: {limit: 8 deg/h, reading: minimum, meaning: typical}
        gyro_z:                     # replaces the gyro's limit of the same coefficient
          random_walk: {limit: 0.4 deg/√h, meaning: maximum}

    A `typical` value is that of many units, so that half of them are above it: how far is reported, and it
    neither passes nor fails. The probability is that of the estimate's distribution, normal in the logarithm
    of an amplitude; what is not detected can pass by its upper limit, but not fail. The reading `minimum` is
    the least Allan deviation of the likely models. If that is at the end of the record, the true minimum may
    be lower, and the limit is missed only if the models extrapolated without end are above it.

    Raises:
        AllanjaxError: the file cannot be read; a key is unknown; a figure is ambiguous or has no meaning.
        UnitError: a unit of another dimension.
    """
    title, limits = read_spec(sheet)
    results = []
    axes = [*(of.axis for of in fit.results), *(of.axis for of in fit.dead)]
    for axis in axes:
        own = {limit.label for limit in limits if limit.section == axis.name}
        for limit in limits:
            if limit.section == axis.name or (limit.section == axis.sensor and limit.label not in own):
                results.append(_checked(fit, axis.name, limit))
    there = {name for axis in axes for name in (axis.name, axis.sensor)}
    for limit in limits:
        if limit.section not in there:
            results.append(LimitCheck(limit.section, limit, reason=NO_AXIS))
    return SpecCheck(fit.name, title, tuple(results))


def _checked(fit: Fit, name: str, limit: Limit) -> LimitCheck:
    """A limit against the estimate of an axis."""
    if name in fit.without_result:
        return LimitCheck(name, limit, reason=f"no result: {fit.without_result[name]}")
    of = fit[name]
    if not of.measured:
        return LimitCheck(name, limit, reason=of.verdict)
    c = floor = of.coefficients.get(limit.label)
    if limit.label == LEAST:
        c, floor = least_deviation(fit, of)
    if c is None or floor is None:
        return LimitCheck(name, limit, reason="this term was not fitted; fit it with terms= (--terms)")
    if c.held:
        return LimitCheck(name, limit, c, reason="the value was given and not estimated")
    if not fit.curve.determined:
        return LimitCheck(name, limit, c, reason=fit.curve.unknown[0])
    least = c.probability_below(limit.value)
    # The laws of the two differ, so that the greatest may come out below the least.
    greatest = max(least, floor.probability_below(limit.value)) if floor.detected else 1.0
    found = LimitCheck(name, limit, c, (least, greatest))
    if found.verdict == "typical" and c.detected:
        why = f"{significant(found.ratio)} times typical, {found.score:+.1f} standard errors"
    elif found.verdict != "undecided":
        return found
    elif c is not floor:
        why = "the Allan deviation still falls at the end: record longer"
    else:
        seconds = _length(fit, of, limit, c)
        return dataclasses.replace(found, seconds=seconds, reason=would_decide(seconds))
    return dataclasses.replace(found, reason=why)


def would_decide(seconds: float | None) -> str:
    """How long a record would decide, in words; None if that is unknown."""
    if seconds is None:
        return "record longer; how much is unknown for this model"
    if seconds == math.inf:
        return "not even a month would decide if it gave the same value"
    # Of some minutes no one needs the tenths.
    text = f"{math.ceil(seconds / 60.0)} min" if 120.0 < seconds < 7200.0 else duration(seconds)
    return f"a record of {text} would decide if it gave the same value"


def _length(fit: Fit, of: AxisFit, limit: Limit, c: Estimate) -> float | None:
    """Length of record [s] that would decide, infinite beyond a month; None if unknown for these terms."""
    terms = {term.name(): term for term in random_terms()}
    basic = limit.label in (*terms, LEAST) and terms.keys() >= set(of.model.term_labels)
    if not basic or not of.fits or of.further or not c.power_std < math.inf:
        return None
    rate, gradient = fit.curve.rate, [float(name == limit.label) for name in terms]
    if limit.label == LEAST:
        time = fit.curve.cluster_time
        at = time[np.argmin(fit.model_deviation(of.axis.name, time))]
        units = (term.sampled(rate) for term in terms.values())
        gradient = [float(unit.with_unit_amplitude().allan_variance(at)) for unit in units]
    values = {label: x.value for label, x in of.coefficients.items() if x.detected}
    power = np.array([values.get(name, 0.0) ** 2 for name in terms])
    target = c.power_std * abs(c.score(limit.value)) / ONE_SIDED_95
    trials = list(trial_lengths(list(terms.values()), rate, fit.curve.n))
    return length_for(target, c.power_std, np.array(gradient), power, trials) or math.inf
