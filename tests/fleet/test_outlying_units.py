"""Which units of a fleet are unlike the others: marks, false marks, and groups that nobody named."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm
from scipy.stats import t as student

from allanjax.fleet import outlying_units as outliers
from allanjax.fleet.outlying_units import FALSE_ALARMS, log_values, outlying
from allanjax.fleet.summary import judged
from allanjax.fleet.table import table_of

ARW = "angle_random_walk"


def values_of(value, error, limit=None):
    """Estimates with relative standard errors; a limit stands in for what was not detected."""
    value = np.asarray(value, float)
    error = np.broadcast_to(error, len(value))
    ratio = np.exp(1.96 * error)
    limit = np.full(len(value), np.nan) if limit is None else np.asarray(limit, float)
    detected = np.isnan(limit)
    shown = np.where(detected, value, 0.0)
    return log_values(shown, shown / ratio, shown * ratio, limit, detected)


def marks(value, error, probability=FALSE_ALARMS, limit=None):
    """Marked units of one axis."""
    return list(np.flatnonzero(outlying([values_of(value, error, limit)], probability, ARW)))


def unit_rows(sensor, coefficient, value, error=0.03, group=None):
    """Rows of a fleet's table for values [units, axes]."""
    rows = []
    for (u, k), v in np.ndenumerate(value):
        rows.append(
            {
                "recording": f"unit_{u}",
                "file": f"unit_{u}.csv",
                "group": "" if group is None else str(group[u]),
                "axis": f"{sensor}_{'xyz'[k]}",
                "sensor": sensor,
                "coefficient": coefficient,
                "value": v,
                "std": error * v,
                "lower_95": v * np.exp(-1.96 * error),
                "upper_95": v * np.exp(1.96 * error),
                "unit": "deg/√h",
                "detected": True,
                "upper_limit_95": None,
                "measured": True,
                "p_value": 0.5,
                "terms": coefficient,
                "outlying": False,
                "warnings": "",
            }
        )
    return rows


def two_grades(seed, ratio=6.0, scatter=0.1, bad=(4.0, 3.0), sizes=(4, 8)):
    """N of two grades of units, the first unit of each bad on all axes."""
    rng = np.random.default_rng(seed)
    grade = np.repeat([0, 1], sizes)
    value = np.exp(np.log(ratio) * grade[:, None] + scatter * rng.standard_normal((len(grade), 3)))
    value[[0, sizes[0]]] *= np.array(bad)[:, None]
    return value, grade


def marked_axes(table):
    """How many axes of each unit are marked, of those that have a mark."""
    counts = table.groupby("recording", sort=False)["outlying"].sum()
    return counts[counts > 0].to_dict()


def test_the_probability_is_the_integral_over_centre_and_scatter():
    """Against quadrature over τ of the predictive law, with the prior written down anew."""
    x, s = np.array([0.1, -0.05, 0.02, 1.1]), np.array([0.03, 0.05, 0.02, 0.04])
    values = values_of(np.exp(x), s)

    def weight(width):
        w = 1.0 / (width**2 + s[:3] ** 2)
        mean = np.sum(w * x[:3]) / w.sum()
        density = np.prod(norm.pdf(x[:3], mean, 1.0 / np.sqrt(w))) / np.sqrt(w.sum())
        return student.pdf(width / 0.12, 8) * density, mean, w.sum()

    def tail(width):
        density, mean, total = weight(width)
        return density * norm.sf((x[3] - mean) / np.sqrt(width**2 + s[3] ** 2 + 1.0 / total))

    exact = quad(tail, 0.0, 3.0, epsabs=0.0, limit=200)[0] / quad(lambda w: weight(w)[0], 0.0, 3.0)[0]
    found = outliers._tail(values, 3, np.arange(3), outliers.log_prior_of(ARW))
    # A sum over 49 widths.
    assert found == pytest.approx(exact, rel=0.02)


@pytest.mark.parametrize("units", [3, 4, 6, 12, 24])
def test_fleets_of_like_units_are_marked_at_most_as_often_as_they_say(units):
    """At one mark in ten fleets; at one in a hundred see benchmarks/studies/fleet_outliers.py."""
    rng = np.random.default_rng(units)
    fleets, alarms = 150, 0
    for _ in range(fleets):
        scatter, error = rng.uniform(0.0, 0.15), rng.uniform(0.01, 0.1, (units, 3))
        # Of the unit, or of each axis.
        shared = rng.random() < 0.5
        value = np.exp(scatter * rng.standard_normal((units, 1 if shared else 3)) * np.ones(3))
        value *= np.exp(error * rng.standard_normal((units, 3)))
        axes = [values_of(value[:, k], error[:, k]) for k in range(3)]
        alarms += bool(outlying(axes, 0.1, ARW).any())
    # Three standard errors.
    assert alarms <= fleets * 0.1 + 3.0 * np.sqrt(fleets * 0.1 * 0.9)


def test_a_unit_at_four_times_the_median_is_marked_on_all_its_axes():
    for units in (3, 4, 8):
        value = np.exp(0.05 * np.random.default_rng(units).standard_normal((units, 3)))
        value[1] *= 4.0
        marked = outlying([values_of(value[:, k], 0.03) for k in range(3)], FALSE_ALARMS, ARW)
        assert marked[1].all()
        assert marked.sum() == 3


def test_axes_together_show_what_one_alone_does_not():
    value = np.exp(0.1 * np.random.default_rng(4).standard_normal((12, 3)))
    value[5] = 1.5
    axes = [values_of(value[:, k], 0.03) for k in range(3)]
    assert not np.any([outlying([axis], FALSE_ALARMS / 3.0, ARW) for axis in axes])
    marked = outlying(axes, FALSE_ALARMS, ARW)
    assert list(np.flatnonzero(marked.any(axis=1))) == [5]


def test_a_single_bad_axis_is_the_only_one_marked():
    value = np.exp(0.05 * np.random.default_rng(2).standard_normal((8, 3)))
    value[3, 1] *= 4.0
    marked = outlying([values_of(value[:, k], 0.03) for k in range(3)], FALSE_ALARMS, ARW)
    assert np.argwhere(marked).tolist() == [[3, 1]]


def test_several_odd_units_do_not_hide_each_other():
    value = np.exp(0.05 * np.random.default_rng(3).standard_normal(20))
    value[[2, 7, 11, 13]] *= [2.5, 3.0, 3.0, 0.3]
    assert marks(value, 0.01) == [2, 7, 11, 13]


def test_an_interval_excuses_a_value():
    value = np.exp(0.03 * np.random.default_rng(4).standard_normal(16))
    value[[3, 8]] = 2.5
    error = np.full(16, 0.02)
    error[8] = 0.5
    assert marks(value, error) == [3]


def test_limits_are_never_marked_but_what_is_far_above_them_is():
    rng = np.random.default_rng(5)
    limit = np.exp(0.2 * rng.standard_normal(12))
    limit[0], limit[1] = np.nan, 50.0
    value = np.full(12, 20.0)
    assert marks(value, 0.1, limit=limit) == [0]
    # Far below limits nothing is unusual.
    assert marks(value / 400.0, 0.1, limit=limit) == []


def test_few_units_are_judged_as_far_as_they_can_be():
    assert marks([1.0, 100.0], 0.01) == []
    assert marks([1.0, 1.1, 100.0], 0.01) == [2]
    # Three units may scatter so.
    assert marks([1.0, 1.1, 1.5], 0.01) == []
    assert marks([2.0] * 5, 0.01) == []


def test_what_has_no_error_is_neither_marked_nor_compared_with():
    value = np.array([1.0, 1.02, 0.97, 1.01, 0.99, 8.0])
    lower, upper, none = 0.95 * value, 1.05 * value, np.full(6, np.nan)
    detected = np.ones(6, bool)
    assert outlying([log_values(value, lower, upper, none, detected)], 0.01, ARW)[5, 0]
    # Not a measurement; held; and more of these than others, so that their value would be the usual one.
    for low, high in ((np.nan, np.nan), (1.0, 1.0)):
        spoilt = [np.append(a, [b] * 9) for a, b in ((value, 8.0), (lower, 8.0 * low), (upper, 8.0 * high))]
        axis = log_values(*spoilt, np.full(15, np.nan), np.ones(15, bool))
        assert np.flatnonzero(outlying([axis], 0.01, ARW)).tolist() == [5]


# ---------------------------------------------------------------------------- groups
@pytest.mark.parametrize(("seed", "ratio"), [(1, 4.0), (2, 6.0), (3, 10.0)])
def test_bad_units_are_found_in_their_groups_and_no_grade_is(seed, ratio):
    value, grade = two_grades(seed, ratio)
    table, notes = judged(table_of(unit_rows("gyro", ARW, value, group=grade)))
    assert marked_axes(table) == {"unit_0": 3, "unit_4": 3}
    assert notes == ()


@pytest.mark.parametrize(("seed", "ratio"), [(1, 4.0), (2, 6.0), (3, 10.0)])
def test_a_fleet_of_two_grades_is_said_to_be_one(seed, ratio):
    value, grade = two_grades(seed, ratio, bad=(1.0, 3.0))
    table, notes = judged(table_of(unit_rows("gyro", ARW, value)))
    (note,) = notes
    assert note.startswith("gyro angle random walk falls into two groups, ")
    apart = float(note.split("two groups, ")[1].split(" times")[0])
    assert apart == pytest.approx(ratio, rel=0.15)
    assert "1 (4 units: unit_0, unit_1, unit_2, unit_3), 2 (8 units: unit_4," in note
    assert "group= (--group)" in note
    groups = table.groupby("recording", sort=False)["group"].unique().map(list)
    assert groups.tolist() == [[str(g + 1)] for g in grade]
    assert marked_axes(table) == {"unit_4": 3}


def test_two_good_units_and_a_bad_one_are_no_outliers_below_nine_others():
    value, grade = two_grades(5, ratio=7.0, scatter=0.05, bad=(2.0, 3.0), sizes=(3, 9))
    table, notes = judged(table_of(unit_rows("gyro", ARW, value)))
    assert "falls into two groups" in notes[0]
    assert marked_axes(table) == {"unit_3": 3}
    groups = table.groupby("recording", sort=False)["group"].first()
    assert groups.tolist() == [str(g + 1) for g in grade]


def test_a_bad_coefficient_does_not_carry_a_unit_into_another_grade():
    """N of a gyro at four times its grade's is that of the other grade; others say which it is."""
    value, _ = two_grades(5, ratio=4.0, bad=(4.0, 1.0))
    others, _ = two_grades(6, ratio=5.0, bad=(1.0, 1.0))
    drift, _ = two_grades(7, ratio=3.0, bad=(1.0, 1.0))
    rows = unit_rows("gyro", ARW, value) + unit_rows("accel", ARW, others)
    table, notes = judged(table_of(rows + unit_rows("gyro", "rate_random_walk", drift)))
    assert len(notes) == 1
    assert set(table.loc[table["recording"] == "unit_0", "group"]) == {"1"}
    assert marked_axes(table) == {"unit_0": 3}


def test_like_units_with_some_odd_ones_are_one_group():
    """In one of these 80 fleets a group may be seen that is none."""
    rng = np.random.default_rng(8)
    said = 0
    for _ in range(80):
        units = int(rng.choice([4, 6, 8, 12, 24]))
        value = np.exp(rng.uniform(0.0, 0.15) * rng.standard_normal((units, 3)))
        value[: units // 8] *= rng.uniform(1.5, 5.0, (units // 8, 1))
        _, notes = judged(table_of(unit_rows("gyro", ARW, value)))
        said += any("groups" in note for note in notes)
    assert said <= 1


def test_a_group_too_small_to_judge_is_named():
    value = np.exp(0.1 * np.random.default_rng(1).standard_normal((12, 3)))
    _, (note,) = judged(table_of(unit_rows("gyro", ARW, value, group=["a"] * 2 + ["b"] * 10)))
    assert note.startswith("group a (2): too few to say whether one is unlike the others, which takes 3")


def test_three_bad_units_may_be_a_grade():
    value = np.exp(0.05 * np.random.default_rng(3).standard_normal((20, 3)))
    value[[2, 7, 11]] *= [[2.0], [3.5], [5.0]]
    table, notes = judged(table_of(unit_rows("gyro", ARW, value)))
    assert marked_axes(table) == {"unit_2": 3, "unit_7": 3, "unit_11": 3}
    assert [note.split(":")[0] for note in notes] == ["3 of 20 units are outlying in gyro angle random walk"]


def test_warnings_and_what_is_no_measurement_are_told():
    rows = unit_rows("gyro", ARW, np.ones((4, 2)))
    for row in rows[:2]:
        row.update(measured=False, detected=False, std=None, lower_95=None, upper_95=None, value=9.0)
    rows[2]["warnings"] = rows[3]["warnings"] = "too short for B and K"
    rows[4]["warnings"] = rows[5]["warnings"] = "0–5 s are 170 times noisier\ntoo short for B and K"
    table, notes = judged(table_of(rows))
    assert not table["outlying"].any()
    assert notes[:3] == (
        "2 recordings with warnings",
        "  unit_1, unit_2: too short for B and K",
        "  unit_2: 0–5 s are 170 times noisier",
    )
    assert "not a measurement of the sensor: unit_0 gyro_x, gyro_y. They are not compared" in notes[3]
