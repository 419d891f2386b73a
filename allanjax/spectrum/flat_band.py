"""The flat band of a power spectral density, and the noise in it that is not white.

The flat part of real spectra is a shallow valley between noises that fall and noises that rise with
frequency. Its mean is above the white noise's density by what these contribute, which no test on the valley
alone can tell. So a rough sum of white and other noise is fitted to the whole spectrum, to know how much.
"""

import numpy as np
from jaxtyping import ArrayLike, Float, Int

from allanjax.base.chi_squared import quantile, upper_tail
from allanjax.base.errors import AllanjaxError
from allanjax.noise.estimate import Estimate
from allanjax.noise.terms import NoiseTerm
from allanjax.record.recording import Axis

# A flat part spans this factor in frequency, has so many points, and a slope known to be less than this.
_OCTAVE = 2.0
_FEWEST_POINTS = 5
_STEEPEST = 0.5
# Slope and curvature together lower χ² by no more than they do on average where there is neither.
_BENT = 2.0
# The points scatter around one level as their degrees of freedom say.
_SCATTER_P_VALUE = 1e-3

# Points this many standard deviations off the sum, such as lines, weigh less.
_OUTLYING = 3.0
_REWEIGHTINGS = 12


def coloured_density(
    frequency: Float[np.ndarray, " m"],
    density: Float[np.ndarray, " m"],
    dof: Float[np.ndarray, " m"],
    rate: float,
) -> Float[np.ndarray, " m"]:
    """Contribution of flicker, random walk and quantization to the density [its unit] at each frequency [Hz].

    That is c₁/f + c₂/f² + c₃ sin²(πf/rate) of their sum with a constant, see `component_densities`.
    """
    shapes = np.stack(
        [np.ones_like(frequency), 1.0 / frequency, frequency**-2.0, np.sin(np.pi * frequency / rate) ** 2],
        axis=1,
    )
    return component_densities(density, dof, shapes)[:, 1:].sum(axis=1)


def component_densities(
    density: Float[np.ndarray, " m"], dof: Float[np.ndarray, " m"], shapes: Float[np.ndarray, "m k"]
) -> Float[np.ndarray, "m k"]:
    """Densities [that of the first argument] of which a rough sum of these shapes is made.

    It is fitted with coefficients that are not negative, weighted with the degrees of freedom at the sum
    itself, robust to lines.
    """
    from scipy.optimize import nnls

    precision = np.sqrt(dof / 2.0)
    model, outlying = density, np.zeros_like(density)
    for _ in range(_REWEIGHTINGS):
        weight = precision / model / np.sqrt(np.maximum(outlying / _OUTLYING, 1.0))
        scaled = shapes * weight[:, None]
        size = np.linalg.norm(scaled, axis=0)
        coefficients = nnls(scaled / size, density * weight)[0] / size
        model = shapes @ coefficients
        outlying = abs(density / model - 1.0) * precision
    return shapes * coefficients


def flattest(
    frequency: Float[np.ndarray, " m"],
    density: Float[np.ndarray, " m"],
    coloured: Float[np.ndarray, " m"],
    count: Int[np.ndarray, " m"],
    dof: Float[np.ndarray, " m"],
    share: Float[np.ndarray, " m"],
) -> tuple[int, int] | None:
    """First and last point of the band that `PowerSpectrum.flat_band` describes; None if there is none.

    Args:
        frequency, density, dof: of the points of a spectrum.
        coloured: what is not white in the density.
        count: ordinates in each point.
        share: what each point contributes to the degrees of freedom of a long band.

    The logarithm of χ² over its ν degrees of freedom has the mean ψ(ν/2) − ln(ν/2) and the variance ψ'(ν/2).
    """
    from scipy.special import digamma, polygamma

    x = np.log(frequency / frequency[-1])
    y = np.log(density) - digamma(dof / 2.0) + np.log(dof / 2.0)
    w = share / dof / polygamma(1, dof / 2.0)
    first, last = np.triu_indices(len(x), _FEWEST_POINTS - 1)
    wide = frequency[last] >= _OCTAVE * frequency[first]
    first, last = first[wide], last[wide]
    if not first.size:
        return None

    def sums(v: Float[np.ndarray, " m"]) -> Float[np.ndarray, " bands"]:
        total = np.append(0.0, np.cumsum(v))
        return total[last + 1] - total[first]

    # Weighted sums of powers of x over every band at once, and what the fits of constant and parabola leave.
    moments = np.stack([sums(w * x**p) for p in range(5)], axis=1)
    right = np.stack([sums(w * x**p * y) for p in range(3)], axis=1)
    degree = np.arange(3)
    parabola = np.linalg.solve(moments[:, degree[:, None] + degree], right[:, :, None])[:, :, 0]
    around_level = sums(w * y**2) - right[:, 0] ** 2 / moments[:, 0]
    around_parabola = sums(w * y**2) - (parabola * right).sum(axis=1)
    spread = moments[:, 2] - moments[:, 1] ** 2 / moments[:, 0]
    slope = (right[:, 1] - moments[:, 1] * right[:, 0] / moments[:, 0]) / spread
    flat = abs(slope) + 2.0 / np.sqrt(spread) < _STEEPEST
    flat &= around_level - around_parabola <= _BENT
    flat &= upper_tail(around_level, last - first) > _SCATTER_P_VALUE
    if not flat.any():
        return None
    error = 2.0 / sums(share) + (sums(count * coloured) / sums(count * density)) ** 2
    best = np.argmin(np.where(flat, error, np.inf))
    return int(first[best]), int(last[best])


def spectral_coefficient(
    term: type[NoiseTerm], square: float, others: float, dof: float, axis: Axis, band: tuple[float, float]
) -> Estimate:
    """Coefficient of a noise term from the mean of a density over that of the term with coefficient 1.

    Of white noise the density over 2: N = √(density / 2), Hou (2004) eq. (3.41).

    Args:
        term: the term's class.
        square: that mean, the coefficient's square [SI].
        others: what other noise contributes to it.
        dof: degrees of freedom of that mean.
        axis: whose it is.
        band: lowest and highest frequency [Hz] averaged.
    """
    from scipy.special import ndtri

    value = float(np.sqrt(square))
    excess = value * (1.0 - float(np.sqrt(max(1.0 - others / square, 0.0))))

    def interval(level: float) -> tuple[float, float]:
        lower, upper = (value * float(np.sqrt(factor)) for factor in chi_squared_factors(dof, level))
        uncertainty = ndtri((1.0 + level) / 2.0) * excess / 2.0
        return max(value - excess - float(np.hypot(value - lower, uncertainty)), 0.0), upper

    return Estimate(
        source="spectrum",
        label=term.name(),
        term=term.name(),
        parameter=term.amplitude_parameter(),
        axis=axis,
        value=value,
        std=float(np.hypot(value / np.sqrt(2.0 * dof), excess)),
        interval=interval(0.95),
        interval_68=interval(0.68),
        band=(float(band[0]), float(band[1])),
        degrees_of_freedom=dof,
        excess=excess,
    )


def chi_squared_factors(
    dof: ArrayLike, level: float
) -> tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."]]:
    """Confidence limits of a variance relative to its estimate, by the χ² law."""
    if not 0 < level < 1:
        raise AllanjaxError(f"the confidence level must lie between 0 and 1, not {level}")
    nu = np.asarray(dof)
    return nu / quantile((1 + level) / 2, nu), nu / quantile((1 - level) / 2, nu)
