"""Deviation of the measured curve from the fitted one, beyond the scatter of the measured one.

The relative error that brings χ² to its degrees of freedom (`AxisFit.discrepancy`) widens intervals rightly
while it is small. Of a model that misses by a factor it says nothing: it is counted in units of the model,
below which nothing is farther than one. Here the two curves are compared as a ratio, place by place.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Float

from allanjax.base.chi_squared import quantile
from allanjax.base.wording import plain

if TYPE_CHECKING:
    from allanjax.estimate.gls import Solution

LIMIT, OCTAVE = 0.3, 0.5
"""Deviations beyond which coefficients are no measurement: root mean square, and over an octave.

Of 30 % in the deviation, 69 % in the variances, which are what is fitted. Standard deviations propagate the
model's error to first order, as small and of either sign; of one so large nothing that is linear in it holds.
A coefficient is read from an octave or two, of which one off by a factor 1.5 leaves none. (Static sensors
with resonances, two ADIS16405 on a bench, are off by up to 45 % at a place and 20 % rms.)
"""

# Curves differ for certain where the model is outside this central interval of all estimates (χ²).
_SURE = 0.997
# Parts of an octave that the levels of a spectrum are averaged over.
_PARTS = 3
# Deviations from this ratio on are told as a factor.
_FACTOR = 1.5
# Root mean square deviations from which on one is mentioned beside another curve's, and where that one has
# none, so that chance hardly ever does: judgements.
_NOTABLE, _CLEAR = 0.02, 0.06
# Scatter that is so large a share of a deviation is told with it.
_MUCH = 0.3


@dataclasses.dataclass(frozen=True)
class Misfit:
    """The deviation of an axis's measured curve from the fitted one, where scatter does not explain it.

    Attributes:
        largest: measured over model less one at the place where the two differ most for certain; 0 if they
            differ nowhere by more than single estimates scatter.
        at: that place, a cluster time [s] or a frequency [Hz]; nan if there is none.
        unit: its unit: "s" of an Allan deviation, "Hz" of a root PSD.
        rms: root mean square over all places of ln(measured/model) less scatter, as a relative deviation.
        sustained: what the deviation certainly exceeds over some octave, of which each Allan deviation is an
            average, and of a root PSD over most of one; as a relative deviation.
        scatter: how far from the model an estimate at that place may be by chance, as a relative deviation.
    """

    largest: float
    at: float
    unit: Literal["s", "Hz"]
    rms: float
    sustained: float
    scatter: float = 0.0

    @property
    def excessive(self) -> bool:
        """Whether the curve is off by so much that its coefficients are not a measurement."""
        return self.rms > LIMIT or self.sustained > OCTAVE

    def beside(self, other: Misfit | None) -> Misfit | None:
        """The misfit, if it is worth mentioning beside another curve's, or where that one suffices."""
        return self if self.rms > (_CLEAR if other is None else _NOTABLE) else None

    @property
    def curve(self) -> str:
        """Name of the curve that the misfit is of."""
        return "Allan deviation" if self.unit == "s" else "root PSD"

    def __str__(self) -> str:
        if self.largest == 0.0:
            return f"its {self.curve} is off, nowhere by more than single estimates scatter"
        chance = ""
        if np.log1p(self.scatter) > _MUCH * abs(np.log1p(self.largest)):
            chance = f" (by chance up to {deviation(self.scatter)} there)"
        place = f"{plain(self.at, 3)} {self.unit}{chance}"
        return (
            f"its {self.curve} is off by up to {deviation(self.largest)} at {place}, "
            f"{deviation(self.rms)} rms"
        )


def misfit_of(
    place: Float[np.ndarray, " m"],
    ratio: Float[np.ndarray, " m"],
    edf: Float[np.ndarray, " m"],
    unit: Literal["s", "Hz"],
) -> Misfit:
    """Misfit of estimated deviations.

    Args:
        place: cluster times [s] or frequencies [Hz], increasing.
        ratio: measured over model, of the deviation.
        edf: degrees of freedom of the estimates' squares under the model.
        unit: of the places.
    """
    log = np.log(np.maximum(ratio, 1e-300))
    beyond = (1.0 - _SURE) / 2.0 / len(log)
    ends = quantile(np.array([[1.0 - beyond], [beyond]]), edf)
    low, high = log + 0.5 * np.log(edf / np.maximum(ends, 1e-300))
    certain = np.maximum(np.maximum(low, -high), 0.0)
    k = int(np.argmax(certain))
    if certain[k] == 0.0:
        return Misfit(0.0, float("nan"), unit, 0.0, 0.0)
    # In squares, less the half width of the interval on the model's side.
    rms = np.sqrt(np.mean(certain * (2.0 * abs(log) - certain)))
    sustained = certain[k] if unit == "s" else _over_octaves(place, certain)
    scatter = abs(log[k]) - certain[k]
    largest, rms, sustained, scatter = np.expm1([log[k], rms, sustained, scatter]).tolist()
    return Misfit(largest, float(place[k]), unit, rms, sustained, scatter)


def widened(solution: Solution, misfits: Sequence[Misfit | None]) -> Solution:
    """Solutions [axes] whose discrepancy is no less than their curves' rms deviation.

    That brings χ² to its degrees of freedom which bends to what it cannot follow; scatter that is said of
    coefficients must not bend.
    """
    rms = np.array([0.0 if misfit is None else misfit.rms for misfit in misfits])
    # Of powers it is twice that of deviations.
    return solution._replace(power_error=np.maximum(np.asarray(solution.power_error), 2.0 * rms))


def _over_octaves(place: Float[np.ndarray, " m"], certain: Float[np.ndarray, " m"]) -> float:
    """The largest of the medians over octaves; of an even number of places the lower one."""
    almost = 1.0 + 1e-6
    found = 0.0
    for start in place[2.0 * place <= place[-1] * almost]:
        inside = np.sort(certain[(place >= start) & (place <= 2.0 * start * almost)])
        found = max(found, float(inside[(len(inside) - 1) // 2]))
    return found


def spectral_misfit(
    frequency: Float[np.ndarray, " m"],
    level: Float[np.ndarray, " m"],
    mean: Float[np.ndarray, " m"],
    dof: Float[np.ndarray, " m"],
) -> Misfit:
    """Misfit of a root PSD: levels, averaged over thirds of octaves, to their means under the model.

    Args:
        frequency: middle of each bin [Hz].
        level, mean: measured and expected level of each.
        dof: degrees of freedom of the levels; those without any do not count.
    """
    known = dof > 0.0
    frequency, ratio, dof = frequency[known], (level / mean)[known], dof[known]
    part = np.floor(_PARTS * np.log2(frequency / frequency.min()) + 1e-9).astype(int)
    total, power, place = (np.bincount(part, w) for w in (dof, dof * ratio, dof * np.log(frequency)))
    there = total > 0.0
    total, power, place = total[there], power[there], place[there]
    return misfit_of(np.exp(place / total), np.sqrt(power / total), total, "Hz")


def deviation(relative: float) -> str:
    """A relative deviation in words: "47 %", or of large ones the factor, whichever way: "a factor 18"."""
    factor = max(1.0 + relative, 1.0 / max(1.0 + relative, 1e-300))
    if factor < _FACTOR:
        return f"{100.0 * abs(relative):.2g} %"
    return f"a factor {factor:.2g}" if factor < 99.5 else f"a factor {factor:,.0f}"
