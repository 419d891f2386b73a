"""Which sample rate a sensor needs: its noise at several rates, aliasing, bandwidth (Hou 2004, Fig. 5.10)."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Float

from allanjax.allan.deviation import AllanDeviation, allan_of
from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError
from allanjax.base.late import presented
from allanjax.base.normal import TWO_SIDED_95
from allanjax.base.tables import PerAxis
from allanjax.base.wording import plain, significant
from allanjax.estimate.as_json import in_json
from allanjax.estimate.fit import fit
from allanjax.estimate.result import AxisFit
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model, NoiseTerm
from allanjax.noise.response import Butterworth, LowPass1
from allanjax.noise.simulate import simulate_recording
from allanjax.noise.terms import AngleRandomWalk, Quantization, RateRandomWalk
from allanjax.record.io.given import RecordingLike, as_recording
from allanjax.record.recording import Axis, Recording
from allanjax.record.units import Sensor, default_coefficient_unit, unit_scale

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

# Samples of a cluster at which curves are compared, and the fewest samples at a rate.
_CLUSTER, _FEWEST = 8, 500
# Factors between the rates of a recording by default, and how many.
_FACTORS = np.array([1, 2, 5, 10, 20, 50])
# Sample rate over bandwidth (Hou 2004, section 5.3).
_NEEDED = (3.0, 5.0)
# Share of a power up to which curves are taken to agree.
_AGREE = 0.05


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class AxisRates(ByValue):
    """Noise of one axis at several rates.

    A level is the Allan variance of clusters of eight samples times their duration, N² of white noise
    [rad²/s or m²/s³]. The excess of picked samples over means is aliased.

    Attributes:
        axis: the axis.
        rates: sample rates [Hz], falling; the first is that of the recording.
        picked, averaged: levels of picked samples, and of means over as many.
        aliased: share of the picked level that is aliased, and `aliased_interval`, 95 %, (rates, 2).
        from_quantization: share of the picked level that is aliased quantization, nan if that is not
            detected: the rounding of picked increments does not cancel.
        bandwidth: half-power frequency of the filter [Hz], or a lower limit; None if there is no sign of a
            filter.
        quantization: Q, from its slope of −1 at the recording's rate; None if it was not fitted.
        reason: reason why there is neither.
    """

    axis: Axis
    rates: Float[np.ndarray, " r"]
    picked: Float[np.ndarray, " r"]
    averaged: Float[np.ndarray, " r"]
    aliased: Float[np.ndarray, " r"]
    aliased_interval: Float[np.ndarray, "r 2"]
    from_quantization: Float[np.ndarray, " r"]
    bandwidth: Estimate | None
    quantization: Estimate | None
    reason: str = ""

    @property
    def agree_from(self) -> float:
        """The lowest rate [Hz] from which on less than 5 % is aliased."""
        parted = np.flatnonzero(self.aliased > _AGREE)
        return float(self.rates[max(int(parted[0]) - 1, 0)] if parted.size else self.rates[-1])

    @property
    def needed(self) -> tuple[float, float] | None:
        """Three and five times the bandwidth [Hz]; None if the bandwidth is not known."""
        if self.bandwidth is None or self.bandwidth.lower_limit is not None:
            return None
        return _NEEDED[0] * self.bandwidth.value, _NEEDED[1] * self.bandwidth.value

    def __repr__(self) -> str:
        bandwidth = "unknown" if self.bandwidth is None else self.bandwidth.describe()
        first, last = (plain(float(self.rates[k]), 4) for k in (0, -1))
        return f"<AxisRates {self.axis.name}: {first} Hz down to {last} Hz, bandwidth {bandwidth}>"

    def rows(self) -> list[tuple[str, ...]]:
        """Rows of the printed table, one per rate: level, aliased share with its interval, quantization."""
        scale = unit_scale(default_coefficient_unit(self.axis.sensor, 0.5), self.axis.sensor)
        cells: list[tuple[str, ...]] = []
        for k, rate in enumerate(self.rates):
            low, high = 100.0 * self.aliased_interval[k]
            shares = (f"{100.0 * self.aliased[k]:.1f}", f"{low:.1f} … {high:.1f}") if k else ("", "")
            folded = f"{100.0 * self.from_quantization[k]:.0f}" if self.from_quantization[k] > 0.005 else ""
            level = significant(float(np.sqrt(self.picked[k])) / scale)
            cells.append((self.axis.name, plain(float(rate), 4), level, *shares, folded))
        return cells

    def describe(self) -> str:
        """Bandwidth, quantization and the rate that is needed, in words."""
        if self.bandwidth is None:
            nyquist = plain(float(self.rates[0]) / 2.0, 4)
            words = [f"no bandwidth: {self.reason or f'there is no sign of a filter below {nyquist} Hz'}"]
        else:
            words = [f"bandwidth {self.bandwidth.describe()}"]
        if self.needed is not None:
            words.append("needs a sample rate of {} to {} Hz".format(*(plain(x, 3) for x in self.needed)))
        if self.quantization is not None:
            words.append(f"quantization {self.quantization.in_unit().describe()}")
        return "; ".join([*words, f"less than 5 % is aliased from {plain(self.agree_from, 4)} Hz on"])

    def _columns(self) -> dict[str, Any]:
        low, high = self.aliased_interval.T
        names = ("picked", "averaged", "aliased", "from_quantization")
        own = {name: getattr(self, name) for name in names}
        return {"rate": self.rates, **own, "aliased_lower_95": low, "aliased_upper_95": high}

    def to_dataframe(self) -> pd.DataFrame:
        """One row per rate; levels in SI."""
        import pandas as pd

        return pd.DataFrame({"axis": self.axis.name, **self._columns()})

    def to_dict(self) -> dict[str, Any]:
        """The numbers as plain dictionaries, in SI; None for undefined numbers."""
        numbers = self._columns() | {"agree_from": self.agree_from}
        for name, e in (("bandwidth", self.bandwidth), ("quantization", self.quantization)):
            numbers[name] = e and {"value": e.value, "interval_95": e.interval}
        return {"axis": self.axis.name, **in_json(numbers)}


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class SampleRates(ByValue, PerAxis[AxisRates]):
    """Noise of a recording at several sample rates.

    Attributes:
        name: the recording's name.
        picked, averaged: Allan deviations at each rate, of picked samples and of means.
        results: one per axis.
    """

    name: str
    picked: tuple[AllanDeviation, ...]
    averaged: tuple[AllanDeviation, ...]
    results: tuple[AxisRates, ...]

    @presented
    def plot(
        self,
        axes: Sequence[str] | str | None = None,
        path: str | os.PathLike[str] | None = None,
        *,
        how: Literal["picked", "averaged"] = "picked",
    ) -> Figure:
        """Draw the Allan deviations at all rates in one panel per axis; see `plot_allan`."""
        raise NotImplementedError

    def to_dict(self) -> dict[str, Any]:
        """The result as plain dictionaries, in SI."""
        return {"name": self.name, "axes": [result.to_dict() for result in self.results]}

    def _title(self) -> str:
        first, last = self.picked[0].rate, self.picked[-1].rate
        return f"sample rates from {plain(first, 4)} Hz down to {plain(last, 4)} Hz"

    def _heads(self, sensor: Sensor) -> tuple[str, ...]:
        level = f"level ({default_coefficient_unit(sensor, 0.5)})"
        return "axis", "picked at (Hz)", level, "aliased (%)", "95 % interval (%)", "from quantization (%)"

    def _notes(self) -> list[str]:
        return [f"{result.axis.name}: {result.describe()}" for result in self.results]


def sample_rates(
    data: RecordingLike | Model | NoiseTerm,
    rates: Sequence[float] | None = None,
    *,
    rate: float | None = None,
    duration: float = 600.0,
    sensor: Sensor = "gyro",
    seed: int = 0,
    gyro_unit: str | None = None,
    accel_unit: str | None = None,
    names: Sequence[str] | None = None,
) -> SampleRates:
    """Noise at several sample rates, the aliased share at each, and the rate that the bandwidth needs.

    Samples are picked, as a slower converter would take them, and averaged, as a counter would: noise from
    beyond half the new rate is folded into the first, S(f) = Σ_k S(f + k·rate), and hardly into the second.
    The bandwidth is that of a one-pole or a Butterworth filter, which is fitted to the recording's spectrum
    together with quantization after it, whose density rises with frequency as its Allan deviation falls as
    1/T. If neither fits, it is the bandwidth of the filter that `fit` finds. The rate that is needed is three
    to five times the bandwidth (Hou 2004, section 5.3).

    Args:
        data: a recording, or data that `fit` takes; or a model behind a response, which is simulated.
        rates: sample rates [Hz], each the recording's rate divided by an integer; by default down to 1/50.
        rate: sample rate of an array or of the model's simulation [Hz].
        duration: length of the simulation [s].
        sensor: sensor of the model.
        seed: seed of the simulation.
        gyro_unit, accel_unit, names: units and names of an array, as for `Recording.from_array`.

    Raises:
        AllanjaxError: a rate that does not divide the recording's, or is too low; a model without a rate.
        RecordingError, UnitError: as `fit` raises them.
    """
    if isinstance(data, Model | NoiseTerm):
        if rate is None or not 0.0 < rate < np.inf:
            raise AllanjaxError("the simulation of a model needs a sample rate: give rate in Hz")
        recording = simulate_recording({sensor: data}, max(int(duration * rate), 1), rate, seed)
    else:
        recording = as_recording(data, rate, gyro_unit, accel_unit, names)
    factors = _factors(recording, rates)
    picked = tuple(_curve(recording, m, recording.values[::m]) for m in factors)
    averaged = tuple(_curve(recording, m, _means(recording.values, m)) for m in factors)
    fits = _filtered_fits(recording)
    results = tuple(_of_axis(picked, averaged, k, fits[k]) for k in range(len(recording.axes)))
    return SampleRates(recording.name, picked, averaged, results)


def _filtered_fits(recording: Recording) -> list[AxisFit]:
    """Fits with a filter and quantization after it; if none of them fits, the result of `fit`."""
    inside = AngleRandomWalk() + RateRandomWalk()
    templates = [kind() * inside + Quantization() for kind in (LowPass1, Butterworth)]
    fits = [fit(recording, template, objective="whittle", as_is=True) for template in templates]
    best: dict[int, AxisFit] = {}
    for k in range(len(recording.axes)):
        fair = [f.results[k] for f in fits if f.results[k].measured and f.results[k].discrepancy == 0.0]
        if fair:
            best[k] = min(fair, key=lambda result: result.chi2)
    if len(best) < len(recording.axes):
        best = dict(enumerate(fit(recording, as_is=True).results)) | best
    return list(best.values())


def _factors(recording: Recording, rates: Sequence[float] | None) -> list[int]:
    """Numbers of samples that become one, increasing from 1."""
    most = recording.n // _FEWEST
    if most < 1:
        raise AllanjaxError(f"the recording has {recording.n} samples; {_FEWEST} are needed at each rate")
    if rates is None:
        return [int(m) for m in _FACTORS if m <= most]
    factors = {1}
    for rate in rates:
        ratio = recording.rate / rate if rate > 0.0 else np.inf
        if not (np.isfinite(ratio) and round(ratio) >= 1 and abs(ratio - round(ratio)) < 1e-6 * ratio):
            raise AllanjaxError(
                f"the recording's rate, {recording.rate:g} Hz, is not a multiple of {rate:g} Hz"
            )
        if round(ratio) > most:
            raise AllanjaxError(
                f"{rate:g} Hz leaves only {recording.n // round(ratio)} samples: use at least "
                f"{plain(recording.rate / most, 3)} Hz or a longer recording"
            )
        factors.add(round(ratio))
    return sorted(factors)


def _means(values: Float[np.ndarray, "n axes"], m: int) -> Float[np.ndarray, "k axes"]:
    count = len(values) // m
    return values[: count * m].reshape(count, m, -1).mean(axis=1)


def _curve(recording: Recording, m: int, values: Float[np.ndarray, "k axes"]) -> AllanDeviation:
    return allan_of(Recording(values, recording.rate / m, recording.axes))


def _of_axis(
    picked: Sequence[AllanDeviation], averaged: Sequence[AllanDeviation], k: int, of_axis: AxisFit
) -> AxisRates:
    def levels(curves: Sequence[AllanDeviation]) -> tuple[np.ndarray, np.ndarray]:
        """Levels of the axis, and their variances, by rate."""
        at = [int(np.flatnonzero(c.cluster_size == _CLUSTER)[0]) for c in curves]
        pairs = list(zip(at, curves, strict=True))
        level = np.array([c.variance[j, k] * c.cluster_time[j] for j, c in pairs])
        return level, np.array([2.0 / c.edf[j, k] for j, c in pairs])

    (above, above_scatter), (below, below_scatter) = levels(picked), levels(averaged)
    rates = np.array([curve.rate for curve in picked])
    ratio = below / above
    # As if independent: some of the scatter is common to both.
    spread = TWO_SIDED_95 * np.sqrt(above_scatter + below_scatter)
    spread[0] = 0.0
    ends = np.stack([1.0 - ratio * np.exp(spread), 1.0 - ratio * np.exp(-spread)], axis=1)
    Q = of_axis.coefficients.get("quantization") if of_axis.measured else None
    folded = np.full(len(rates), np.nan)
    if Q is not None and Q.detected:
        # Of picked increments 2(Q·rate)², white; of means 3Q²/T².
        folded = (2.0 * (Q.value * rates[0]) ** 2 / rates - 3.0 * Q.value**2 * rates / _CLUSTER) / above
        folded[0] = 0.0
    return AxisRates(
        axis=of_axis.axis,
        rates=rates,
        picked=above,
        averaged=below,
        aliased=1.0 - ratio,
        aliased_interval=ends,
        from_quantization=folded,
        bandwidth=_bandwidth(of_axis),
        quantization=Q,
        reason="" if of_axis.measured else of_axis.verdict,
    )


def _bandwidth(of_axis: AxisFit) -> Estimate | None:
    """Half-power frequency of the filter of a fit [Hz], which may be only a limit."""
    response = of_axis.model.response if of_axis.measured else None
    if response is None:
        return None
    own = of_axis[f"{response.name()}_bandwidth"]
    if not np.isfinite(own.std) and own.lower_limit is None:
        return None
    # The nominal frequency of a filter of two poles is not that of half the power.
    return own.times(response.half_power / own.value)
