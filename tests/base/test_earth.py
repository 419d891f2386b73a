"""Normal gravity is that of WGS 84."""

import pytest

import allanjax as aj
from allanjax.base.earth import normal_gravity


# NIMA TR8350.2, table 3.4: theoretical gravity at the equator and the poles; at 45 degrees Moritz's series
# for GRS 80, 9.806199203, less the difference of the two systems, which is below 2e-6 everywhere.
@pytest.mark.parametrize(
    ("latitude", "expected", "within"),
    [
        (0.0, 9.7803253359, 1e-9),
        (90.0, 9.8321849378, 2e-9),
        (-90.0, 9.8321849378, 2e-9),
        (45.0, 9.806199203, 2e-6),
    ],
)
def test_on_the_ellipsoid(latitude, expected, within):
    assert normal_gravity(latitude) == pytest.approx(expected, abs=within)


def test_it_falls_with_the_height_by_the_free_air_gradient():
    """0.3086 mGal a metre is the value in textbooks, rounded to its last digit, at middle latitudes."""
    fall = (normal_gravity(45.0) - normal_gravity(45.0, 100.0)) / 100.0
    assert fall == pytest.approx(0.3086e-5, abs=0.0002e-5)


@pytest.mark.parametrize("latitude", [91.0, float("nan")])
def test_a_latitude_that_is_none_is_an_error(latitude):
    with pytest.raises(aj.AllanjaxError, match="latitude in deg"):
        normal_gravity(latitude)
