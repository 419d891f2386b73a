"""Fits of one model to the Allan variances of many axes of equal length at once.

The solver and the inference are those of `fit`, compiled once for blocks of a fixed number of axes, whatever
their number; the blocks share the cores.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import jax
import numpy as np
from jaxtyping import Bool, Float

from allanjax.allan.clusters import Spacing
from allanjax.allan.deviation import AllanDeviation, allan_deviation
from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError, FitError
from allanjax.base.tables import text_table
from allanjax.base.wording import significant
from allanjax.estimate.allan_design import AllanDesign
from allanjax.estimate.axis_fits import estimated, solve_and_infer
from allanjax.estimate.coefficients import estimates_of, reported
from allanjax.estimate.design import free_powers, model_to_fit
from allanjax.estimate.deterministic import needs_record
from allanjax.estimate.fit import check_length
from allanjax.estimate.gls import Solution
from allanjax.estimate.inference import Inference
from allanjax.estimate.starts import find_starts
from allanjax.noise.estimate import usual_unit
from allanjax.noise.model import Model
from allanjax.noise.notation import ModelLike
from allanjax.record.recording import Recording
from allanjax.record.units import unit_scale

if TYPE_CHECKING:
    import pandas as pd

# Axes of a block: what the compiled programs hold for so many stays in a core's cache.
_BLOCK = 64
# The arrays have room for a multiple of so many cluster sizes: at octaves, two programs serve all records.
_CAPACITY = 8


@dataclasses.dataclass(frozen=True, eq=False)
class BulkFit(ByValue):
    """The fit of one model to many axes: arrays [axes] or [axes, coefficients], in SI.

    Axes that did not converge have NaN for their coefficients and detect nothing.

    Attributes:
        template: the model as asked for.
        curve: the Allan deviations it was fitted to.
        value: the estimates; zero for an amplitude that the data do not call for.
        std: their standard deviations.
        lower, upper: ends of the 95 % intervals; the lower one is zero where zero is not excluded.
        upper_limit: one-sided 95 % limits of amplitudes; NaN for other coefficients.
        detected: whether zero is excluded.
        converged: whether the axis has a result.
        chi2, dof: misfit of the Allan variances to the model within their own scatter.
        discrepancy: as in `AxisFit`.
        measured: whether the coefficients are a measurement: not where the fitted curve is far off (see
            `AxisFit.misfit`), where they have no standard deviation, no interval and no limit, and nothing is
            detected.
    """

    template: Model
    curve: AllanDeviation
    value: Float[np.ndarray, "axes coefficients"]
    std: Float[np.ndarray, "axes coefficients"]
    lower: Float[np.ndarray, "axes coefficients"]
    upper: Float[np.ndarray, "axes coefficients"]
    upper_limit: Float[np.ndarray, "axes coefficients"]
    detected: Bool[np.ndarray, "axes coefficients"]
    converged: Bool[np.ndarray, " axes"]
    chi2: Float[np.ndarray, " axes"]
    dof: int
    discrepancy: Float[np.ndarray, " axes"]
    measured: Bool[np.ndarray, " axes"]

    @property
    def coefficients(self) -> tuple[str, ...]:
        """Labels of the coefficients, in the order of the arrays' columns."""
        return tuple(p.label for p in reported(self.template))

    @property
    def names(self) -> tuple[str, ...]:
        """The axes' names; their numbers where the curve is that of an array."""
        axes = self.curve.axes
        return tuple(a.name for a in axes) if axes else tuple(str(k) for k in range(len(self.value)))

    def __len__(self) -> int:
        return len(self.value)

    def to_dataframe(self) -> pd.DataFrame:
        """One row an axis and coefficient, with the columns of `Fit.to_dataframe`.

        Numbers are in the usual units; where the curve is that of an array, whose sensor is not known, in the
        array's own unit and seconds, with an empty `unit`.
        """
        import pandas as pd

        units, scale = self._units()
        names = np.repeat(np.array(self.names, object), len(self.coefficients))
        labels = np.tile(np.array(self.coefficients, object), len(self))
        numbers = {
            "value": self.value,
            "std": self.std,
            "lower_95": self.lower,
            "upper_95": self.upper,
            "unit": units,
            "detected": self.detected,
            "upper_limit_95": self.upper_limit,
            "measured": np.broadcast_to(self.measured[:, None], self.value.shape),
        }
        flat = {key: (x / scale if x.dtype == float else x).reshape(len(names)) for key, x in numbers.items()}
        return pd.DataFrame({"axis": names, "coefficient": labels, **flat})

    def _units(self) -> tuple[np.ndarray, Float[np.ndarray, "axes coefficients"]]:
        """The usual unit of each coefficient of each axis, and what it is in SI."""
        sensors = [a.sensor for a in self.curve.axes] if self.curve.axes else [None] * len(self)
        of_sensor = {
            s: ["" if s is None else usual_unit(p.parameter, s) for p in reported(self.template)]
            for s in set(sensors)
        }
        scales = {s: [unit_scale(u, s) if u else 1.0 for u in units] for s, units in of_sensor.items()}
        return np.array([of_sensor[s] for s in sensors], object), np.array([scales[s] for s in sensors])

    def __str__(self) -> str:
        rows = []
        for (label, unit), of_label in self.to_dataframe().groupby(["coefficient", "unit"], sort=False):
            seen = of_label["value"][of_label["detected"]]
            ends = [significant(x, 4) for x in seen.quantile([0.05, 0.5, 0.95])] if len(seen) else [""] * 3
            rows.append([str(label), str(unit), *ends, f"{len(seen)} of {len(of_label)} axes"])
        title = (
            f"{len(self)} axes of {self.curve.n:,} samples at {self.curve.rate:g} Hz, "
            f"{np.count_nonzero(self.converged)} converged; values where detected"
        )
        return text_table(title, ("coefficient", "unit", "5 %", "median", "95 %", "detected"), rows)

    __repr__ = __str__


def fit_many(
    data: AllanDeviation | Sequence[Recording], model: ModelLike, *, cluster_times: Spacing = "octave"
) -> BulkFit:
    """Estimate the coefficients of one noise model from each of many axes, thousands a second.

    Every axis gets what `fit` with `objective="allan"` makes of the same Allan variances, by default at
    octaves of the cluster time: some 5 % less precise in the middle of the curve than `fit` with its four an
    octave, and twenty times faster.

    Args:
        data: a curve of any number of axes, e.g. `allan_deviation(x, rate)` of an array [samples, units]; or
            recordings of equal length and rate, whose axes are then named "recording/axis".
        model: the terms; their starts and what is held as in `fit`.
        cluster_times: spacing of the cluster times of recordings, see `allan_deviation`; a curve has its own.

    Raises:
        FitError: a line, a resonance or a transient, which need the record itself; too few cluster times.
        AllanjaxError: recordings that differ in length or rate, or none; a modified or Hadamard curve.
    """
    curve = _curve_of(data, cluster_times)
    template = model_to_fit(model, curve.axes or ())
    _check_terms(template)
    check_length(curve, template, "the curve")
    return _bulk_fit(curve, template, *_in_blocks(curve, template))


def _check_terms(template: Model) -> None:
    for term in template.terms:
        if needs_record(term):
            raise FitError(
                f"{term.name()} is found in the record itself, not in Allan variances: "
                "leave it out, or fit each recording with allanjax.fit"
            )


def _curve_of(data: AllanDeviation | Sequence[Recording], cluster_times: Spacing) -> AllanDeviation:
    """The Allan deviations of all axes."""
    if isinstance(data, AllanDeviation):
        if data.kind != "allan":
            raise AllanjaxError(f"a fit needs the Allan deviation, not a {data.kind} one: leave out kind")
        if not (isinstance(cluster_times, str) and cluster_times == "octave"):
            raise AllanjaxError("a curve has its own cluster times: leave out cluster_times")
        return data
    if isinstance(data, Recording) or not all(isinstance(r, Recording) for r in data) or not len(data):
        raise AllanjaxError("give an AllanDeviation or a sequence of recordings, e.g. [recording]")
    names = [recording.name or str(k) for k, recording in enumerate(data)]
    first = data[0]
    for name, recording in zip(names, data, strict=True):
        if (recording.n, recording.rate) != (first.n, first.rate):
            raise AllanjaxError(
                f"{name} has {recording.n} samples at {recording.rate:g} Hz, but {names[0]} {first.n} at "
                f"{first.rate:g} Hz: cut them to one length with between(), or fit it on its own"
            )
    alone = (dataclasses.replace(recording, others=()) for recording in data)
    curves = [allan_deviation(recording, cluster_times=cluster_times) for recording in alone]
    axes = (
        dataclasses.replace(axis, name=f"{name}/{axis.name}")
        for name, recording in zip(names, data, strict=True)
        for axis in recording.axes
    )
    return dataclasses.replace(
        curves[0],
        deviation=np.concatenate([curve.deviation for curve in curves], axis=1),
        edf=np.concatenate([curve.edf for curve in curves], axis=1),
        axes=tuple(axes),
    )


def _in_blocks(
    curve: AllanDeviation, template: Model
) -> tuple[Solution, Inference, Bool[np.ndarray, " axes"]]:
    """Solution and inference of every axis, and whether the curve is near enough to the data."""
    capacity = -(-len(curve.cluster_size) // _CAPACITY) * _CAPACITY
    design = AllanDesign.of(template, curve.n, curve.rate, curve.cluster_size, curve.strides, (capacity, 0))
    free = free_powers(template)
    active = np.ones((_BLOCK, len(template)), bool)
    variance = curve.variance.T

    def of_block(first: int) -> tuple[Solution, Inference, Bool[np.ndarray, " block"]]:
        V = variance[first : first + _BLOCK]
        # The last block is filled up with its last axis.
        V = np.pad(V, ((0, _BLOCK - len(V)), (0, 0)), mode="edge")
        starts = find_starts(template, design, V, active, [None] * _BLOCK, curve.n, curve.rate)
        solution, inference, misfits = solve_and_infer(design, V, free, active, starts)
        return solution, inference, np.array([m is None or not m.excessive for m in misfits])

    # Compiled programs run without Python's lock.
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        blocks = list(pool.map(of_block, range(0, len(variance), _BLOCK)))
    return jax.tree.map(lambda *parts: np.concatenate(parts)[: len(variance)], *blocks)


def _bulk_fit(
    curve: AllanDeviation,
    template: Model,
    solution: Solution,
    inference: Inference,
    near: Bool[np.ndarray, " axes"],
) -> BulkFit:
    """The result made of solutions and inferences."""
    active = np.ones((len(solution.power), len(template)), bool)
    estimates = estimates_of(template, active, solution, inference)
    converged = np.asarray(solution.converged)
    dof = len(curve.cluster_size) - estimated(template, active[0])

    measured = converged & near

    def known(
        x: Float[np.ndarray, "axes coefficients"], where: Bool[np.ndarray, " axes"] = measured
    ) -> Float[np.ndarray, "axes coefficients"]:
        return np.where(where[:, None], x, np.nan)

    return BulkFit(
        template=template,
        curve=curve,
        value=known(estimates.value, converged),
        std=known(estimates.std),
        lower=known(estimates.interval[..., 0]),
        upper=known(estimates.interval[..., 1]),
        upper_limit=known(estimates.upper_limit),
        detected=estimates.detected & measured[:, None],
        converged=converged,
        chi2=np.asarray(solution.chi2),
        dof=dof,
        discrepancy=np.asarray(solution.discrepancy),
        measured=measured,
    )
