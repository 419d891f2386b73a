"""Coefficients of noise terms read off a spectrum, each where the spectrum has the term's slope.

IEEE Std 952 and Hou (2004) section 3.4.2 tell the terms by the slopes of the log-log plot: +2 quantization, 0
angle (velocity) random walk, −1 bias instability, −2 rate random walk, −3 the flicker rate ramp that stands
for a drift ramp (4.58). A coefficient is the value of a line of that slope at the term's frequency: the
density over that of the term with coefficient 1, (4.28), (3.41), (4.38), (4.52), (4.58), averaged where it is
constant.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from allanjax.noise.terms import (
    AngleRandomWalk,
    BiasInstability,
    DriftRamp,
    NoiseTerm,
    Quantization,
    RateRandomWalk,
)
from allanjax.spectrum.flat_band import component_densities, flattest

#: The terms that slopes tell, by falling slope, and these slopes.
SLOPES: dict[type[NoiseTerm], int] = {
    Quantization: 2,
    AngleRandomWalk: 0,
    BiasInstability: -1,
    RateRandomWalk: -2,
    DriftRamp: -3,
}
# Of the lowest ordinates the record's straight line has taken a part.
_TAKEN = 2
# A term is read where it contributes more than this share.
_SHARE = 0.5


def unit_densities(frequency: Float[np.ndarray, " m"], rate: float) -> Float[np.ndarray, "m terms"]:
    """One-sided density of each of these terms with coefficient 1, at frequencies [Hz].

    It is that of samples, means over their intervals, with aliases: near the Nyquist frequency it leaves the
    straight line, as a real spectrum does. Quantization has 8 sin²(πf/rate)·rate (4.28).
    """
    terms = [term().with_unit_amplitude() for term in SLOPES]
    densities = [t.psd(frequency) if t.deterministic else t.sampled_psd(frequency, rate) for t in terms]
    return np.stack([2.0 * np.asarray(density) for density in densities], axis=1)


def slope_stretch(
    frequency: Float[np.ndarray, " m"],
    density: Float[np.ndarray, " m"],
    count: Int[np.ndarray, " m"],
    dof: Float[np.ndarray, " m"],
    share: Float[np.ndarray, " m"],
    rate: float,
    term: type[NoiseTerm],
) -> tuple[slice, float, float] | None:
    """Stretch of frequencies with a term's slope, by the rule of `PowerSpectrum.readings`; None if none.

    Returns:
        The stretch, and in it the mean of the squared coefficient and of what other terms contribute to it.
        The arguments are those of `flattest`; `rate` is the sample rate [Hz].
    """
    shapes = unit_densities(frequency, rate)
    parts = component_densities(density, dof, shapes)
    k = list(SLOPES).index(term)
    square = density / shapes[:, k]
    others = (parts.sum(axis=1) - parts[:, k]) / shapes[:, k]
    found = flattest(*(x[_TAKEN:] for x in (frequency, square, others, count, dof, share)))
    if found is None:
        return None
    stretch = slice(found[0] + _TAKEN, found[1] + _TAKEN + 1)
    weight = count[stretch] / count[stretch].sum()
    mean, rest = float(weight @ square[stretch]), float(weight @ others[stretch])
    return (stretch, mean, rest) if rest < _SHARE * mean else None
