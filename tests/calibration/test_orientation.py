"""Orientations by names, directions and matrices."""

import numpy as np
import pytest

import allanjax as aj
from allanjax.calibration.orientation import as_orientation, orientation_in, six_positions


@pytest.mark.parametrize(
    ("text", "up"),
    [
        ("x up", [1, 0, 0]),
        ("Y Down", [0, -1, 0]),
        ("-z", [0, 0, -1]),
        ("x+", [1, 0, 0]),
        ("down", [0, 0, -1]),
        ("imu_x-down_2", [-1, 0, 0]),
        ("2024-05-01_yup", [0, 1, 0]),
    ],
)
def test_a_name_says_what_points_up(text, up):
    found = as_orientation(text)
    assert (found.up.tolist(), found.north) == (up, None)


@pytest.mark.parametrize(
    ("text", "north"),
    [
        ("x up, y north", [0, 1, 0]),
        ("x up, y south", [0, -1, 0]),
        # With x up and y east, z = x × y is up × east, north.
        ("x up, y east", [0, 0, 1]),
        ("x up, y west", [0, 0, -1]),
    ],
)
def test_a_heading_may_be_named(text, north):
    assert as_orientation(text).north.tolist() == north


@pytest.mark.parametrize("text", ["backup", "updated", "imu", "max_load"])
def test_other_names_name_none(text):
    assert orientation_in(text) is None


def test_a_matrix_turns_the_frame_into_east_north_up():
    """Turned about the vertical by 30 degrees: x points that far from east to north."""
    c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
    found = as_orientation(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]))
    np.testing.assert_allclose([found.up, found.north], [[0, 0, 1], [s, c, 0]], atol=1e-15)


@pytest.mark.parametrize(
    "given",
    [
        "sideways",
        [1.0, 1.0, 0.0],
        np.diag([1.0, 1.0, -1.0]),
        np.ones((3, 3)),
        [[1.0], [2.0, 3.0]],
        "x up, x north",
    ],
)
def test_what_is_no_orientation_is_an_error(given):
    with pytest.raises(aj.AllanjaxError, match=r"orientation|cannot point"):
        as_orientation(given)


def test_with_headings_there_are_24():
    found = six_positions(with_heading=True)
    frames = {(*np.round(o.up).astype(int), *np.round(o.north).astype(int)) for o in found}
    assert len(frames) == 24
