"""Sections of a page about a comparison of sensors."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from allanjax.allan.deviation import rate_unit
from allanjax.comparison.compare import Comparison, axes_of
from allanjax.presentation.draw import SENSORS
from allanjax.presentation.page.blocks import Chart, Row, Section, Table, Text, Trace, View
from allanjax.record.recording import Axis
from allanjax.record.units import SI

# Cluster times at which models without a record are drawn [s].
_TIMES = np.geomspace(0.01, 1e4, 150)


def of_comparison(comparison: Comparison) -> Iterator[Section]:
    """Curves over one another, the table of coefficients, drift and growth of errors."""
    tested = [
        d for row in comparison.rows for d in row.differences if d is not None and d.differs is not None
    ]
    different = sum(bool(d.differs) for d in tested)
    reference = comparison.labels[comparison.reference]
    verdict = f"{different} of {len(tested)} coefficients differ from those of {reference}."
    coefficients, terms, graded, *growths = (Table.of(columns) for columns in comparison._tables())
    names = axes_of(comparison.sensors)
    charts = [
        Chart(SENSORS[sensor].capitalize(), views)
        for sensor in SENSORS
        if (views := [_view(comparison, name, sensor) for name in names if name.startswith(sensor)])
    ]
    yield Section("Comparison", [Text(verdict, "verdict"), Row(charts), coefficients, terms, graded])
    yield Section("Drift and growth of errors", growths)
    yield Section("Sensors", [Text(line, "note") for line in comparison._notes()])


def _view(comparison: Comparison, name: str, sensor: Any) -> View:
    """Measured deviations with intervals, and models, of all sensors on an axis."""
    traces, axis = list[Trace](), Axis(name, sensor, SI[sensor]["rate"])
    for group, one in enumerate(comparison.sensors):
        time = _TIMES
        if one.curve is not None and name in one.curve.names:
            k, time = one.curve.names.index(name), one.curve.cluster_time
            low, high = (end[:, k] for end in one.curve.confidence_interval(0.95))
            traces.append(Trace(group, "measured", time, one.curve.deviation[:, k], low, high))
        if (model := one.model(name)) is not None:
            variance = np.asarray(model.sampled(one.rate).allan_variance(time))
            traces.append(Trace(group, "model", time, np.sqrt(variance), look="line"))
    units = (rate_unit(axis), (SI[sensor]["rate"], 1.0))
    return View(name, "cluster time τ", "s", "σ", units=units, groups=comparison.labels, traces=traces)
