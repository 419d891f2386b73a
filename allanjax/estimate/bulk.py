"""`fit_many`: one noise model fitted to the Allan variances of many axes, in blocks that share the cores."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from jaxtyping import Bool, Float

from allanjax.allan.deviation import AllanDeviation, CurveOptions, allan_of
from allanjax.allan.estimators import Spacing
from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError
from allanjax.base.tables import Column, Tabled, columns_from
from allanjax.base.threads import for_each
from allanjax.base.wording import significant
from allanjax.estimate.axis_fits import check_count, check_terms, solve_and_infer
from allanjax.estimate.design import AllanDesign, check_no_response
from allanjax.estimate.inference import count_estimated, reported
from allanjax.noise.estimate import usual_unit
from allanjax.noise.model import Model
from allanjax.noise.notation import ModelLike, as_model
from allanjax.record.recording import Recording
from allanjax.record.units import unit_scale

if TYPE_CHECKING:
    import pandas as pd

# Axes per block: for so many, the data of the compiled programs stay in a core's cache.
_TOGETHER = 64
# Arrays are padded to a multiple of so many cluster sizes: at octaves, two programs serve all records.
_CAPACITY = 8
_Table: TypeAlias = Float[np.ndarray, "axes coefficients"]
_PerAxis: TypeAlias = Float[np.ndarray, " axes"]
_Flags: TypeAlias = Bool[np.ndarray, " axes"]


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class BulkFit(ByValue, Tabled):
    """The fit of one model to many axes: arrays [axes] or [axes, coefficients], in SI.

    Axes that did not converge have NaN for their coefficients and detect nothing.

    Attributes:
        template: the model whose terms were fitted.
        curve: the Allan deviations it was fitted to.
        value: the estimates; zero for the amplitude of a term that improves nothing.
        std: their standard deviations.
        lower, upper: ends of the 95 % intervals; the lower one is zero where zero is not excluded.
        upper_limit: one-sided 95 % limits of amplitudes; NaN for other coefficients.
        detected: whether zero is excluded.
        converged: whether the axis has a result.
        chi2, dof: misfit of the Allan variances to the model within their own scatter.
        discrepancy: as in `AxisFit`.
        measured: whether the coefficients are a measurement. They are not where the fitted curve is far off
            (see `AxisFit.misfit`): there is then no standard deviation, interval or limit.
    """

    template: Model
    curve: AllanDeviation
    value: _Table
    std: _Table
    lower: _Table
    upper: _Table
    upper_limit: _Table
    detected: Bool[np.ndarray, "axes coefficients"]
    converged: _Flags
    chi2: _PerAxis
    dof: int
    discrepancy: _PerAxis
    measured: _Flags

    @property
    def coefficients(self) -> tuple[str, ...]:
        """Labels of the coefficients, in the order of the arrays' columns."""
        return tuple(p.label for p in reported(self.template))

    @property
    def names(self) -> tuple[str, ...]:
        """The axes' names; their numbers where the curve is that of an array."""
        return self.curve.names

    def __len__(self) -> int:
        return len(self.value)

    def to_dataframe(self) -> pd.DataFrame:
        """One row per axis and coefficient, with the columns of `Fit.to_dataframe`.

        Numbers are in the usual units; for the curve of an array, whose sensor is unknown, in the array's own
        unit and seconds, with an empty `unit`.
        """
        import pandas as pd

        sensors = [a.sensor for a in self.curve.axes] if self.curve.axes else [None] * len(self)
        parameters = [p.parameter for p in reported(self.template)]
        usual = {s: [usual_unit(p, s) if s else "" for p in parameters] for s in set(sensors)}
        scales = {s: [unit_scale(u, s) if u else 1.0 for u in units] for s, units in usual.items()}
        unit, scale = np.array([usual[s] for s in sensors], object), np.array([scales[s] for s in sensors])
        columns: dict[str, Any] = {
            "axis": np.array(self.names, object)[:, None],
            "coefficient": np.array(self.coefficients, object),
            "value": self.value / scale,
            "std": self.std / scale,
            "lower_95": self.lower / scale,
            "upper_95": self.upper / scale,
            "unit": unit,
            "detected": self.detected,
            "upper_limit_95": self.upper_limit / scale,
            "measured": self.measured[:, None],
        }
        return pd.DataFrame({key: np.broadcast_to(x, unit.shape).ravel() for key, x in columns.items()})

    def _tables(self) -> list[list[Column]]:
        rows = []
        for (label, unit), of_label in self.to_dataframe().groupby(["coefficient", "unit"], sort=False):
            seen = of_label["value"][of_label["detected"]]
            ends = [significant(x, 4) for x in seen.quantile([0.05, 0.5, 0.95])] if len(seen) else [""] * 3
            rows.append([str(label), str(unit), *ends, f"{len(seen)} of {len(of_label)} axes"])
        return [columns_from(("coefficient", "unit", "5 %", "median", "95 %", "detected"), rows)]

    def _title(self) -> str:
        return (
            f"{len(self)} axes of {self.curve.n:,} samples at {self.curve.rate:g} Hz, "
            f"{np.count_nonzero(self.converged)} converged; values where detected"
        )


def fit_many(
    data: AllanDeviation | Sequence[Recording], model: ModelLike, *, cluster_times: Spacing = "octave"
) -> BulkFit:
    """Estimate the coefficients of one noise model for each of many axes, thousands per second.

    The result for an axis is that of `fit` with `objective="allan"` for the same Allan variances, by default
    at octaves of the cluster time: some 5 % less precise in the middle of the curve than `fit`, which has
    four cluster times per octave, and twenty times faster.

    Args:
        data: a curve of any number of axes, e.g. `allan_deviation(x, rate)` of an array [samples, units]; or
            recordings of equal length and rate, whose axes are then named "recording/axis".
        model: the terms, with start values and held parameters as in `fit`.
        cluster_times: spacing of the cluster times of recordings, see `allan_deviation`; a curve has its own.

    Raises:
        FitError: a line, resonance or transient, which needs the record itself; too few cluster times.
        AllanjaxError: no recordings, or of different lengths or rates; a modified or Hadamard curve.
    """
    curve = _curve_of(data, cluster_times)
    template, variance = as_model(model, curve.axes or ()), curve.variance.T
    check_no_response(template)
    own = "is estimated from the record itself, not from Allan variances"
    check_terms(template, f"{own}; leave it out, or fit each recording with allanjax.fit")
    check_count(len(curve.cluster_size), "Allan variances", curve.n, template, "the curve")
    capacity = -(-len(curve.cluster_size) // _CAPACITY) * _CAPACITY
    design = AllanDesign.of(template, curve, (capacity, 0))
    blocks = for_each(
        lambda k: _of_block(template, design, variance[k : k + _TOGETHER]),
        range(0, len(variance), _TOGETHER),
    )
    arrays = {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}
    dof = len(curve.cluster_size) - count_estimated(template, np.ones(len(template), bool))
    return BulkFit(template=template, curve=curve, dof=dof, **arrays)


def _of_block(template: Model, design: AllanDesign, variance: Float[np.ndarray, "axes m"]) -> dict[str, Any]:
    """Arrays of a `BulkFit` for at most `_TOGETHER` axes; a smaller block is filled up with its last axis."""
    count, active = len(variance), np.ones((_TOGETHER, len(template)), bool)
    V = np.pad(variance, ((0, _TOGETHER - count), (0, 0)), mode="edge")
    solution, found, misfits = solve_and_infer(template, design, V, active)
    converged = solution.converged
    measured = converged & [m is None or not m.excessive for m in misfits]
    lower, upper, _, _, limit = found.ends.transpose(2, 0, 1)
    known = {"std": found.std, "lower": lower, "upper": upper, "upper_limit": limit}
    arrays = {name: np.where(measured[:, None], x, np.nan) for name, x in known.items()} | {
        "value": np.where(converged[:, None], found.value, np.nan),
        "detected": found.detected & measured[:, None],
        "converged": converged,
        "chi2": solution.chi2,
        "discrepancy": solution.discrepancy,
        "measured": measured,
    }
    return {name: x[:count] for name, x in arrays.items()}


def _curve_of(data: AllanDeviation | Sequence[Recording], cluster_times: Spacing) -> AllanDeviation:
    """The Allan deviations of all axes."""
    if isinstance(data, AllanDeviation):
        if data.kind != "allan":
            raise AllanjaxError(f"a fit needs the Allan deviation, not a {data.kind} one; leave out kind")
        if not (isinstance(cluster_times, str) and cluster_times == "octave"):
            raise AllanjaxError("a curve has its own cluster times; leave out cluster_times")
        return data
    if isinstance(data, Recording) or not all(isinstance(r, Recording) for r in data) or not len(data):
        raise AllanjaxError("pass an AllanDeviation or a sequence of recordings, e.g. [recording]")
    names, curves = [recording.name or str(k) for k, recording in enumerate(data)], []
    for name, recording in zip(names, data, strict=True):
        if (recording.n, recording.rate) != (data[0].n, data[0].rate):
            raise AllanjaxError(
                f"{name} has {recording.n} samples at {recording.rate:g} Hz, but {names[0]} {data[0].n} at "
                f"{data[0].rate:g} Hz; cut them to one length with between(), or fit it separately"
            )
        axes = [dataclasses.replace(axis, name=f"{name}/{axis.name}") for axis in recording.axes]
        alone = dataclasses.replace(recording, axes=tuple(axes), others=())
        curves.append(allan_of(alone, CurveOptions(cluster_times=cluster_times)))
    deviation, edf = (np.hstack([getattr(curve, name) for curve in curves]) for name in ("deviation", "edf"))
    every = tuple(axis for curve in curves for axis in curve.axes or ())
    return dataclasses.replace(curves[0], deviation=deviation, edf=edf, axes=every)
