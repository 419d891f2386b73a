"""Which units of a fleet are unlike the others: marks, false marks, and grades that nobody named."""

import numpy as np
import pytest
from fleets import ARW, axis, coefficient, marks
from scipy.integrate import quad
from scipy.stats import norm
from scipy.stats import t as student

BI = "bias_instability"


def marked_axes(result):
    return result.outlying.groupby("recording", sort=False)["axis"].count().to_dict()


def integral(x, s, unit, scale):
    """Probability of a unit at least so far out on its side: over scatter and centre of the others."""
    # Prior of the scatter: Student's t with 8 degrees of freedom, folded at zero; of the centre: flat.
    others = np.arange(len(x)) != unit
    sign = np.sign(x[unit] - np.median(x[others]))

    def density(width, tail):
        w = 1.0 / (width**2 + s[others] ** 2)
        mean = np.sum(w * x[others]) / w.sum()
        of = student.pdf(width / scale, 8) / np.sqrt(w.sum())
        of *= np.prod(norm.pdf(x[others], mean, 1.0 / np.sqrt(w)))
        z = sign * (x[unit] - mean) / np.sqrt(width**2 + s[unit] ** 2 + 1.0 / w.sum())
        return of * (norm.sf(z) if tail else 1.0)

    ends = [quad(density, 0.0, 5.0, (tail,), epsabs=0.0, limit=200)[0] for tail in (True, False)]
    return ends[0] / ends[1]


@pytest.mark.parametrize(
    ("label", "scale", "units", "top", "further"),
    [(ARW, 0.12, 4, 3.0, 0), (ARW, 0.12, 9, -3.0, 0), (BI, 0.4, 6, 3.0, 0), (ARW, 0.12, 6, 3.0, 2)],
)
def test_a_mark_is_as_improbable_as_it_says(fleet, label, scale, units, top, further):
    """The value at which a unit begins to be marked is where its probability is what each test may have."""
    # In all one like fleet in a hundred may have a mark; half of that is for tests of several suspects, the
    # rest is shared by the coefficients, the two sides, and the units of which it is the most extreme.
    rng = np.random.default_rng(units)
    x, s = 0.05 * rng.standard_normal(units), rng.uniform(0.02, 0.05, units)
    others = [("accel", name, np.ones((units, 1)), 0.1) for name in (ARW, BI)[:further]]
    low = 0.0
    for _ in range(9):
        x[0] = 0.5 * (low + top)
        found = marks(fleet.judged(("gyro", label, np.exp(x)[:, None], s[:, None]), *others))
        assert found in ([], [("unit_0", "gyro_x")])
        low, top = (low, x[0]) if found else (x[0], top)
    # A sum over 49 widths, and an end that is known to 0.006.
    allowed = 0.01 * 0.5 / (1 + further) / (2.0 * units)
    assert integral(x, s, 0, scale) == pytest.approx(allowed, rel=0.08)


def test_like_units_with_some_odd_ones_are_one_group(fleet):
    rng = np.random.default_rng(8)
    for units in (3, 4, 6, 8, 12, 24, 24):
        value = np.exp(rng.uniform(0.0, 0.15) * rng.standard_normal((units, 3)))
        assert marks(fleet.judged(("gyro", ARW, value, 0.03))) == []
        value[: units // 8] *= rng.uniform(1.5, 5.0, (units // 8, 1))
        assert not any("groups" in note for note in fleet.judged(("gyro", ARW, value, 0.03)).notes)


def test_units_at_several_times_the_median_are_marked_on_all_their_axes(fleet):
    for units in (3, 4, 8):
        value = np.exp(0.05 * np.random.default_rng(units).standard_normal((units, 3)))
        value[1] *= 4.0
        assert marks(fleet.judged(("gyro", ARW, value, 0.03))) == [("unit_1", f"gyro_{a}") for a in "xyz"]
        # A single bad axis is the only one that is.
        value[1, [0, 2]] /= 4.0
        assert marks(fleet.judged(("gyro", ARW, value, 0.03))) == [("unit_1", "gyro_y")]
    # Axes together show what one alone does not.
    value = np.exp(0.1 * np.random.default_rng(4).standard_normal((12, 3)))
    value[5] = 1.5
    assert {*marked_axes(fleet.judged(("gyro", ARW, value, 0.03)))} == {"unit_5"}
    assert not any(marks(fleet.judged(("gyro", ARW, value[:, [k]], 0.03))) for k in range(3))
    # Several odd units do not hide each other, and an interval excuses one; an eighth may be a grade.
    value = np.exp(0.05 * np.random.default_rng(3).standard_normal((20, 3)))
    value[[2, 7, 11]] *= [[2.0], [3.5], [0.2]]
    result = fleet.judged(("gyro", ARW, value, 0.02))
    assert marked_axes(result) == {"unit_2": 3, "unit_7": 3, "unit_11": 3}
    assert any(note.startswith("3 of 20 units") for note in result.notes)
    error = np.where(np.arange(20)[:, None] == 7, 0.7, np.full((20, 3), 0.02))
    assert marked_axes(fleet.judged(("gyro", ARW, value, error))) == {"unit_2": 3, "unit_11": 3}


def test_limits_are_never_marked_but_what_is_far_above_them_is(fleet):
    limit = np.exp(0.2 * np.random.default_rng(5).standard_normal((12, 1)))
    limit[0], limit[1] = np.nan, 50.0
    value = np.full((12, 1), 20.0)
    assert marks(fleet.judged(("gyro", ARW, value, 0.1, limit))) == [("unit_0", "gyro_x")]
    # Far below limits nothing is unusual.
    assert marks(fleet.judged(("gyro", ARW, value / 400.0, 0.1, limit))) == []


def test_few_units_are_judged_as_far_as_they_can_be(fleet):
    for values, unit in (([1.0, 100.0], None), ([1.0, 1.1, 100.0], "unit_2"), ([1.0, 1.1, 1.5], None)):
        found = marks(fleet.judged(("gyro", ARW, np.array(values)[:, None], 0.01)))
        assert [name for name, _ in found] == ([unit] if unit else [])
    value = np.exp(0.1 * np.random.default_rng(1).standard_normal((12, 3)))
    part = fleet.judged(("gyro", ARW, value, 0.03), group=["a"] * 2 + ["b"] * 10)
    assert part.notes[0].startswith("group a (2):")
    assert fleet.judged(("gyro", ARW, value[:2], 0.1)).notes[0].startswith("2 units:")


def of_units(fleet, values, error, more):
    """The result for units of these values; `more` tells what else the coefficient of each unit has."""
    for u, value in enumerate(values):
        fleet.store(f"unit_{u}", [axis("gyro_x", [coefficient(ARW, value, error, **more(u))])])
    return fleet.run([fleet.file(f"unit_{u}") for u in range(len(values))])


def test_what_has_no_error_is_neither_marked_nor_compared_with(fleet):
    """Not a measurement, or held: also if there are more of these, whose value would be the usual one."""
    values = [1.0, 1.02, 0.97, 1.01, 0.99, *10 * [8.0]]
    unmeasured = {"measured": False, "std": None, "interval_95": [None, None]}
    for spoilt in (unmeasured, {"interval_95": [8.0, 8.0]}):
        result = of_units(fleet, values, 0.025, lambda u, spoilt=spoilt: spoilt if u > 5 else {})
        assert marks(result) == [("unit_5", "gyro_x")]
        assert any("unit_6 (gyro_x)" in note for note in result.notes) == (spoilt is unmeasured)
    # Of an interval the end that faces the others counts.
    values = [3.0, 1.0, 1.03, 0.97, 1.01, 0.99]
    for ends, found in (([0.3, 3.1], []), ([2.8, 30.0], [("unit_0", "gyro_x")])):
        result = of_units(fleet, values, 0.03, lambda u, ends=ends: {} if u else {"interval_95": ends})
        assert marks(result) == found


def two_grades(seed, ratio=6.0, scatter=0.1, bad=(4.0, 3.0), sizes=(4, 8)):
    """N of two grades of units, the first unit of each bad on all axes."""
    rng = np.random.default_rng(seed)
    grade = np.repeat([0, 1], sizes)
    value = np.exp(np.log(ratio) * grade[:, None] + scatter * rng.standard_normal((len(grade), 3)))
    value[[0, sizes[0]]] *= np.array(bad)[:, None]
    return value, grade


def groups(result):
    return result.table.groupby("recording", sort=False)["group"].first().tolist()


@pytest.mark.parametrize(("seed", "ratio", "sizes"), [(1, 4.0, (4, 8)), (3, 10.0, (4, 8)), (5, 7.0, (3, 9))])
def test_a_fleet_of_two_grades_is_said_to_be_one(fleet, seed, ratio, sizes):
    """Three of which one is bad are a grade below nine others; and no outliers."""
    value, grade = two_grades(seed, ratio, 0.07, (2.0 if sizes[0] == 3 else 1.0, 3.0), sizes)
    result = fleet.judged(("gyro", ARW, value, 0.03))
    (note,) = result.notes
    apart = float(note.split("by a factor of ")[1].split(":")[0])
    medians = np.median(np.log(value[grade == 1])), np.median(np.log(value[grade == 0]))
    assert apart == pytest.approx(np.exp(medians[0] - medians[1]), rel=0.15)
    assert f"1 ({sizes[0]} units: unit_0, unit_1" in note
    assert f"2 ({sizes[1]} units: unit_{sizes[0]}," in note
    assert groups(result) == [str(g + 1) for g in grade]
    assert marked_axes(result) == {f"unit_{sizes[0]}": 3}
    if sizes[0] == 4:
        # Where groups are named, bad units are found in them.
        value, grade = two_grades(seed, ratio)
        result = fleet.judged(("gyro", ARW, value, 0.03), group=grade)
        assert marked_axes(result) == {"unit_0": 3, "unit_4": 3}
        assert result.notes == ()


def test_a_bad_coefficient_does_not_carry_a_unit_into_another_grade(fleet):
    """N of a gyro at four times its grade's is that of the other grade; others say which it is."""
    of = ((5, 4.0, 4.0), (7, 3.0, 1.0), (6, 5.0, 1.0))
    walk, drift, other = (two_grades(seed, ratio, bad=(bad, 1.0))[0] for seed, ratio, bad in of)
    parts = ("gyro", "rate_random_walk", drift, 0.03), ("accel", ARW, other, 0.03)
    result = fleet.judged(("gyro", ARW, walk, 0.03), *parts)
    assert len(result.notes) == 1
    assert groups(result)[0] == "1"
    assert marked_axes(result) == {"unit_0": 3}


def test_warnings_and_what_is_no_measurement_are_told(fleet):
    for u in range(4):
        warnings = {1: ["too short"], 2: ["0–5 s are noisier", "too short"]}.get(u, [])
        spoilt = {"measured": False, "std": None, "interval_95": [None, None]} if u == 0 else {}
        both = [axis(f"gyro_{a}", [coefficient(ARW, 1.0, 0.03, **spoilt)]) for a in "xy"]
        fleet.store(f"unit_{u}", both, warnings=warnings, stretch_s=[u, 9.0])
    result = fleet.run([fleet.file(f"unit_{u}") for u in range(4)])
    assert marks(result) == []
    words = "2 recordings|unit_1 and unit_2: too short|unit_2: 0–5 s are noisier|unit_0 (gyro_x, gyro_y)"
    assert all(word in note for word, note in zip(words.split("|"), result.notes[:4], strict=True))
    table = result.table.groupby("recording", sort=False).first()
    assert table["warnings"].tolist() == ["", "too short", "0–5 s are noisier\ntoo short", ""]
    assert table["start_s"].tolist() == [0.0, 1.0, 2.0, 3.0]
    assert (table["stop_s"] == 9.0).all()
