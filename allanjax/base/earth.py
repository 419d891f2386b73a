"""Gravity, rotation and size of the Earth."""

import math

from allanjax.base.errors import AllanjaxError

EARTH_RATE = 7.292115e-5
"""Rate of the Earth's rotation [rad/s] (WGS 84)."""

EARTH_RADIUS = 6_371_000.0
"""Mean radius of the Earth [m]."""

STANDARD_GRAVITY = 9.80665
"""Standard acceleration of gravity [m/s²], by definition the unit g."""

GRAVITY_ANOMALY = 3.5e-4
"""Standard deviation of gravity about normal gravity [m/s²]: 35 mGal, about its rms over the Earth."""

# WGS 84 (NIMA TR8350.2, third edition, tables 3.1 to 3.4).
_EQUATOR, _SOMIGLIANA, _ECCENTRICITY2 = 9.7803253359, 0.00193185265241, 6.69437999014e-3
_SEMI_MAJOR, _FLATTENING, _RATIO = 6378137.0, 1.0 / 298.257223563, 0.00344978650684


def normal_gravity(latitude: float, height: float = 0.0) -> float:
    """Normal gravity [m/s²] at a latitude [deg] and a height above the ellipsoid [m].

    Uses Somigliana's closed formula on the WGS 84 ellipsoid and the second-order series in the height (NIMA
    TR8350.2, 4-1 and 4-3). True gravity differs by the anomaly δg of (2.23).

    Raises:
        AllanjaxError: the latitude is beyond ±90 deg, or the height is not finite.
    """
    if not (abs(latitude) <= 90.0 and math.isfinite(height)):
        raise AllanjaxError(
            f"latitude {latitude}, height {height}: give degrees from -90 to 90 and a height in m"
        )
    s2 = math.sin(math.radians(latitude)) ** 2
    surface = _EQUATOR * (1.0 + _SOMIGLIANA * s2) / math.sqrt(1.0 - _ECCENTRICITY2 * s2)
    h = height / _SEMI_MAJOR
    return surface * (1.0 - 2.0 * (1.0 + _FLATTENING + _RATIO - 2.0 * _FLATTENING * s2) * h + 3.0 * h**2)
