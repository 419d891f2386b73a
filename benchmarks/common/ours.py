"""The package, as the benchmarks ask it: models and labels by symbol, records as axes of one recording."""

from __future__ import annotations

from collections.abc import Iterable
from types import MappingProxyType

import numpy as np

import allanjax as aj
from benchmarks.common.truth import RATE, SHAPES, Case

TERMS = {
    "Q": aj.Quantization(),
    "N": aj.AngleRandomWalk(),
    "B": aj.BiasInstability(),
    "q": aj.Markov(),
    "K": aj.RateRandomWalk(),
    "R": aj.DriftRamp(),
    "A": aj.Sinusoid(),
}
TERM_LABELS = {symbol: aj.Model((term,)).term_labels[0] for symbol, term in TERMS.items()}
LABELS = TERM_LABELS | {"q": "markov_amplitude", "T": "markov_correlation_time"}
LABELS |= {"A": "sinusoid_amplitude", "f": "sinusoid_frequency"}
FIELDS = ("value", "std", "lower", "upper", "lower_68", "upper_68", "limit", "detected")


def model_of(symbols: Iterable[str]) -> aj.Model:
    """The model with these terms."""
    return aj.Model(tuple(TERMS[c] for c in symbols if c not in SHAPES))


def true_model(value: dict[str, float]) -> aj.Model:
    """The model with these values by symbol; a line has none of its phase."""
    labels = {LABELS[c]: v for c, v in value.items()}
    return model_of(value).with_values(**labels)


def recording_of(x: np.ndarray) -> aj.Recording:
    """One recording whose axes are the records."""
    axes = tuple(aj.Axis(f"gyro_{i}", "gyro", "rad/s") for i in range(x.shape[1]))
    return aj.Recording(x, RATE, axes, MappingProxyType({}), "", ())


def fit_all(
    recording: aj.Recording, model: aj.Model | None = None, objective: str = "allan", **options: str
) -> tuple[list[aj.AxisFit | None], aj.TermSelection | None]:
    """The fit of every axis, None where there is no result or an exception; and the ranking of terms."""
    try:
        fit = aj.fit(recording, model, objective, as_is=True, vibrating=True, **options)
    except Exception:
        # One axis may have spoilt it for all.
        singles = [recording_of(x[:, None]) for x in recording.values.T]
        found = (
            [fit_all(x, model, objective, **options)[0] for x in singles] if len(singles) > 1 else [[None]]
        )
        return [axis for (axis,) in found], None if model else aj.select_terms(recording)
    return [axis if axis.converged else None for axis in fit.results], fit.selection


def columns_of(axes: Iterable[aj.AxisFit | None], case: Case) -> dict[str, np.ndarray]:
    """What a fit says of each true coefficient, [records, params]; NaN where there is no result."""
    nothing = [(np.nan,) * len(FIELDS)] * len(case.truth)
    rows = [nothing if axis is None else [_numbers(axis[LABELS[c]]) for c in case.truth] for axis in axes]
    return dict(zip(FIELDS, np.moveaxis(np.array(rows), 2, 0), strict=True))


def _numbers(c: aj.Coefficient) -> tuple[float, ...]:
    limit = np.nan if c.upper_limit is None else c.upper_limit
    return c.value, c.std, *c.interval, *c.interval_68, limit, float(c.detected)
