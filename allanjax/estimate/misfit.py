"""The misfit: how far a measured curve is off the fitted one, beyond chance.

The relative error that brings χ² to its degrees of freedom (`AxisFit.discrepancy`) widens intervals correctly
while it is small, not for a model that is off by a factor, as data below the model are off by one at most.
The misfit therefore compares the ratio of the two curves, place by place.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np
from jaxtyping import Float

from allanjax.base.chi_squared import quantile
from allanjax.base.wording import percent, plain, significant
from allanjax.inspection.facts import listed

if TYPE_CHECKING:
    from allanjax.estimate.design import Solution

#: Root mean square deviation, and one over an octave, beyond which coefficients are not a measurement, as
#: errors are propagated to first order only, and a coefficient is determined by one or two octaves. (Two
#: ADIS16405 on a bench, which have resonances, are off by up to 45 % at a place and 20 % rms.)
LIMIT, OCTAVE = 0.3, 0.5
# Curves differ for certain where the model is outside this central interval of all estimates (χ²), and by
# more than a trifle; relative deviation that is certain, and one that is likely, up to which a model fits.
_SURE, _TRIFLE, _TOLERATED, _LARGE = 0.997, 0.005, 0.1, 0.25
# Number of parts per octave over which the levels of a spectrum are averaged.
_PARTS = 3
# Octaves over which a spectrum is averaged besides: what no single place shows for certain, all of them may.
# (An Allan variance contains nearly all that those at longer times tell.)
_OCTAVES = 1.0, 3.0
# Words: deviations above this ratio are a factor, and a scatter above this share of a deviation is reported.
_FACTOR, _MUCH = 1.5, 0.3
# One, to rounding.
_ALMOST = 1.0 + 1e-6
_Places: TypeAlias = Float[np.ndarray, " m"]


@dataclasses.dataclass(frozen=True)
class Misfit:
    """The deviation of an axis's measured curve from the fitted one beyond its scatter.

    Attributes:
        largest: measured/model − 1 at the place where the certain difference is largest; 0 if the two differ
            nowhere by more than single estimates scatter.
        at: that place, a cluster time [s] or a frequency [Hz]; nan if there is none.
        unit: its unit: "s" of an Allan deviation, "Hz" of a root PSD.
        rms: root mean square of ln(measured/model) over all places, less scatter, as a relative deviation.
        sustained: relative deviation that is certainly exceeded over an octave (each Allan deviation averages
            over one), in a root PSD over most of an octave.
        scatter: relative deviation that chance may cause at that place.
        felt: which of N, B and K have a notable share of the model's power there.
    """

    largest: float
    at: float
    unit: Literal["s", "Hz"]
    rms: float
    sustained: float
    scatter: float = 0.0
    felt: tuple[str, ...] = ()

    @property
    def excessive(self) -> bool:
        """Whether the curve is so far off that the coefficients are not a measurement."""
        return self.rms > LIMIT or self.sustained > OCTAVE

    @property
    def matters(self) -> bool:
        """Whether the model does not fit: it is off by more than a tenth for certain, or by a quarter."""
        return self.certain > _TOLERATED or self.sure > _LARGE

    @property
    def certain(self) -> float:
        """Relative deviation at that place that chance does not explain."""
        return float(np.expm1(abs(np.log1p(self.largest)) - np.log1p(self.scatter)))

    @property
    def sure(self) -> float:
        """Relative deviation at that place, less what may be chance, in squares."""
        square = np.log1p(self.largest) ** 2 - np.log1p(self.scatter) ** 2
        return float(np.expm1(np.sqrt(max(square, 0.0))))

    @property
    def size(self) -> str:
        """The largest deviation in words, e.g. "2.7 %" or "×4.3"."""
        return deviation(self.largest)

    @property
    def curve(self) -> str:
        """Name of the curve."""
        return "Allan deviation" if self.unit == "s" else "root PSD"

    def __str__(self) -> str:
        certain = np.log1p(self.scatter) <= _MUCH * abs(np.log1p(self.largest))
        chance = "" if certain else f" (up to {deviation(self.scatter)} may be chance)"
        side = "above" if self.largest > 0.0 else "below"
        place = f"{self.curve} {self.size} {side} the model at {plain(self.at, 3)} {self.unit}{chance}"
        felt = f"{listed(self.felt)} may feel it" if self.felt else "N, B and K do not feel it"
        return f"{place}; {felt}"


def misfit_of(place: _Places, ratio: _Places, edf: _Places, unit: Literal["s", "Hz"]) -> Misfit | None:
    """Misfit of deviations at increasing places, by measured/model and the squares' degrees of freedom.

    There is none if they differ nowhere by more than single estimates scatter, or by a trifle.
    """
    count, octave = len(place), np.log2(place)
    after, windows = octave - octave[:, None], [np.eye(count)]
    if unit == "Hz":
        windows += [(after >= 0.0) & (after <= width) for width in _OCTAVES]
    weight = np.concatenate(windows) * edf
    total = weight.sum(axis=1)
    log = 0.5 * np.log(np.maximum(weight @ ratio**2 / total, 1e-300))
    beyond = (1.0 - _SURE) / 2.0 / len(log)
    ends = quantile(np.array([[1.0 - beyond], [beyond]]), total)
    low, high = log + 0.5 * np.log(total / np.maximum(ends, 1e-300))
    certain = np.maximum(np.maximum(low, -high), 0.0)
    if certain.max() <= _TRIFLE:
        return None
    # In squares, less the half width of the interval on the model's side.
    square = certain * (2.0 * abs(log) - certain)
    k = int(np.argmax(square))
    at = np.exp(weight[k] @ np.log(place) / total[k])
    largest, scatter = log[k], abs(log[k]) - certain[k]
    rms = np.sqrt(np.mean(square[:count]))
    certain = certain[:count]
    sustained = certain.max()
    if unit == "Hz":
        # The largest of the medians over octaves; of an even number of places the lower one.
        starts = place[2.0 * place <= place[-1] * _ALMOST]
        octaves = (certain[(place >= f) & (place <= 2.0 * f * _ALMOST)] for f in starts)
        sustained = max((np.sort(x)[(len(x) - 1) // 2] for x in octaves), default=0.0)
    largest, rms, sustained, scatter = np.expm1([largest, rms, sustained, scatter]).tolist()
    return Misfit(largest, float(at), unit, rms, sustained, scatter)


def widened(solution: Solution, misfits: Sequence[Misfit | None]) -> Solution:
    """Solutions [axes] whose discrepancy is no less than their curves' rms deviation.

    The discrepancy alone would be too small, as the fit bends towards data that it cannot follow.
    """
    # In powers it is twice that of deviations.
    least = [0.0 if misfit is None else 2.0 * misfit.rms for misfit in misfits]
    return solution._replace(power_error=np.maximum(np.asarray(solution.power_error), least))


def spectral_misfit(frequency: _Places, level: _Places, mean: _Places, dof: _Places) -> Misfit | None:
    """Misfit of a root PSD: levels at frequencies [Hz], averaged over thirds of octaves, to their means."""
    known = dof > 0.0
    frequency, ratio, dof = frequency[known], (level / mean)[known], dof[known]
    part = np.floor(_PARTS * np.log2(frequency / frequency.min()) + 1e-9).astype(int)
    sums = np.array([np.bincount(part, w) for w in (dof, dof * ratio, dof * np.log(frequency))])
    total, power, place = sums[:, sums[0] > 0.0]
    return misfit_of(np.exp(place / total), np.sqrt(power / total), total, "Hz")


def deviation(relative: float) -> str:
    """A relative deviation in words: "47 %", or a large one as a factor in either direction, "×18"."""
    factor = np.exp(abs(np.log(max(1.0 + relative, 1e-300))))
    if factor < _FACTOR:
        return percent(abs(relative))
    return f"×{significant(factor, 2)}" if factor < 99.5 else f"×{factor:,.0f}"
