"""Which units of a fleet are unlike the others: marks, false marks, ratios, and groups that nobody named."""

import re

import numpy as np
import pytest
from fleets import ARW, axis, coefficient, marks
from scipy.stats import t as student
from scipy.stats import truncnorm

import allanjax as aj

BI = "bias_instability"


def marked_axes(result):
    return result.outlying.groupby("recording", sort=False)["axis"].count().to_dict()


def p_value(x, s, unit):
    """Two-sided p-value of a unit's distance from the median, of values with known errors."""
    n = len(x)
    inner, error = min(round(0.75 * n), n - 1), s**2
    distance = abs(x - np.median(x))
    # Of the n − 1 others, all or those within the quantile of the inner ones' share.
    end = truncnorm.ppf(0.5 + 0.5 * inner / (n - 1), -9.0, 9.0)
    spread = np.mean(np.sort(distance)[:inner] ** 2) / truncnorm.var(-end, end)
    spread = max(spread, np.median(error))
    own = spread - np.median(error) + error[unit]
    degrees = min(inner - 2.0 + inner / (n - 1), 0.8 * inner) * (own / spread) ** 2
    return 2.0 * student.sf(distance[unit] / np.sqrt(own + 0.5 * np.pi * spread / n), degrees)


@pytest.mark.parametrize(("units", "sign", "further"), [(4, 1, 0), (9, -1, 0), (12, 1, 2), (24, 1, 0)])
def test_a_mark_is_as_improbable_as_it_says(fleet, units, sign, further):
    """The value at which a unit begins to be marked has the p-value that Holm's method asks of the least."""
    rng = np.random.default_rng(units)
    x, s = 0.05 * rng.standard_normal(units), rng.uniform(0.02, 0.05, units)
    others = [("accel", name, np.ones((units, 1)), 0.1) for name in (ARW, BI)[:further]]
    low, high = 0.0, 4.0 * sign
    for _ in range(9):
        x[0] = 0.5 * (low + high)
        found = marks(fleet.judged(("gyro", ARW, np.exp(x)[:, None], s[:, None]), *others))
        assert found in ([], [("unit_0", "gyro_x")])
        low, high = (low, x[0]) if found else (x[0], high)
    # An end that is known to 0.008: 2 % of the distance, which the p-value follows with a power below 8.
    assert p_value(x, s, 0) == pytest.approx(0.01 / (units * (1 + further)), rel=0.15)


@pytest.mark.parametrize("of_unit", [True, False])
def test_units_off_by_a_third_are_named_with_their_ratio_and_no_others(fleet, of_unit):
    """One of 24 units, 1.3 times off on three axes, where this is 9 times what the mean scatters or more."""
    # Errors of 1 to 4 %; a scatter of the unit by 2 %, or of each axis by 3 %: with the errors 2.2 and 2.4 %.
    for seed in range(5):
        rng = np.random.default_rng(seed)
        error = rng.uniform(0.01, 0.04, (24, 3))
        own = 0.02 * rng.standard_normal((24, 1)) if of_unit else 0.03 * rng.standard_normal((24, 3))
        value = np.exp(own + error * rng.standard_normal((24, 3)))
        others = np.exp(0.03 * rng.standard_normal((24, 3)))
        assert marks(fleet.judged(("gyro", ARW, value, error), ("accel", ARW, others, 0.03))) == []
        value[seed] *= 1.3
        result = fleet.judged(("gyro", ARW, value, error), ("accel", ARW, others, 0.03))
        assert {*marked_axes(result)} == {f"unit_{seed}"}
        ratios = result.outlying["ratio"]
        median = np.median(value, axis=0)[[int("xyz".index(name[-1])) for name in result.outlying["axis"]]]
        # The median of an even number of logarithms is the geometric mean of two.
        np.testing.assert_allclose(ratios, result.outlying["value"] / median, rtol=1e-4)


def test_like_units_are_neither_marked_nor_divided(fleet):
    for k, units in enumerate((4, 5, 6, 8, 12, 18, 24, 40)):
        rng = np.random.default_rng(k)
        width, drift = rng.uniform(0.0, 0.2), rng.uniform(0.0, 0.6)
        parts = [
            (sensor, label, np.exp(scatter * rng.standard_normal((units, 3))), 0.03)
            for sensor in ("gyro", "accel")
            for label, scatter in ((ARW, width), (BI, drift))
        ]
        result = fleet.judged(*parts)
        assert (marks(result), {*result.table["group"]}) == ([], {""})


def test_a_single_bad_axis_is_the_only_one_that_is_marked(fleet):
    for units in (6, 12, 24):
        value = np.exp(0.03 * np.random.default_rng(units).standard_normal((units, 3)))
        value[1, 1] *= 4.0
        assert marks(fleet.judged(("gyro", ARW, value, 0.03))) == [("unit_1", "gyro_y")]


def test_axes_together_show_what_none_shows_alone(fleet):
    value = np.exp(0.09 * np.random.default_rng(4).standard_normal((24, 3)))
    value[5] = 1.4
    assert {*marked_axes(fleet.judged(("gyro", ARW, value, 0.03)))} == {"unit_5"}
    assert not any(marks(fleet.judged(("gyro", ARW, value[:, [k]], 0.03))) for k in range(3))


def test_odd_units_do_not_hide_each_other_and_an_interval_excuses_one(fleet):
    value = np.exp(0.05 * np.random.default_rng(3).standard_normal((20, 3)))
    value[[2, 7, 11, 15]] *= [[2.0], [3.5], [0.2], [2.0]]
    result = fleet.judged(("gyro", ARW, value, 0.02))
    assert marked_axes(result) == {f"unit_{k}": 3 for k in (2, 7, 11, 15)}
    error = np.where(np.arange(20)[:, None] == 7, 0.7, np.full((20, 3), 0.02))
    assert marked_axes(fleet.judged(("gyro", ARW, value, error))) == {f"unit_{k}": 3 for k in (2, 11, 15)}


def test_two_bad_units_of_a_small_fleet_are_found(fleet):
    """Two grades of three units on two days: one is 1.5 times off on a day, one twice as large on both."""
    value = np.exp(0.003 * np.random.default_rng(1).standard_normal((12, 3)))
    value[6:] *= 8.0
    value[[1, 10, 11]] *= [[1.5], [2.0], [2.0]]
    parts = ("gyro", ARW, value, 0.002), ("gyro", BI, np.ones((12, 3)), 0.1)
    result = fleet.judged(*parts, group=[*"aaaaaabbbbbb"])
    assert {*marked_axes(result)} == {"unit_1", "unit_10", "unit_11"}


@pytest.mark.usefixtures("no_windows")
def test_what_is_outlying_is_named_with_its_ratio_everywhere(fleet, monkeypatch, tmp_path):
    monkeypatch.undo()
    value = np.exp(0.02 * np.random.default_rng(2).standard_normal((13, 1)))
    value[3] = 9.0
    value[3] = 2.0 * np.median(value)
    fleet.out.mkdir()
    result = fleet.judged(("gyro", ARW, value, 0.02))
    line = f"unit_3: outlying against the median of its group: gyro_x N ×{2.0:.2f}"
    assert line in str(result).splitlines()
    assert (fleet.out / "notes.txt").read_text(encoding="utf-8").splitlines()[0] == line
    assert result.outlying["ratio"].tolist() == pytest.approx([2.0])
    (panel,) = result.plot().axes
    assert [text.get_text() for text in panel.texts] == ["unit_3 ×2.00"]
    aj.report(result, tmp_path / "fleet.html")
    page = (tmp_path / "fleet.html").read_text(encoding="utf-8")
    # In the data of a chart, which are ASCII.
    assert "unit_3 \\u00d72.00" in page
    assert line in page


def test_limits_are_never_marked_but_what_is_far_above_them_is(fleet):
    limit = np.exp(0.2 * np.random.default_rng(5).standard_normal((12, 1)))
    limit[0], limit[1] = np.nan, 50.0
    value = np.full((12, 1), 20.0)
    assert marks(fleet.judged(("gyro", ARW, value, 0.1, limit))) == [("unit_0", "gyro_x")]
    # Far below limits nothing is unusual.
    assert marks(fleet.judged(("gyro", ARW, value / 400.0, 0.1, limit))) == []


def test_of_three_units_none_is_outlying(fleet):
    for values, unit in (([1.0, 1.1, 100.0], []), ([1.0, 1.1, 1.05, 100.0], ["unit_3"])):
        found = marks(fleet.judged(("gyro", ARW, np.array(values)[:, None], 0.01)))
        assert [name for name, _ in found] == unit
    value = np.exp(0.1 * np.random.default_rng(1).standard_normal((12, 3)))
    part = fleet.judged(("gyro", ARW, value, 0.03), group=["a"] * 2 + ["b"] * 10)
    assert part.notes[0].startswith("group a, 2 units: too few")
    assert fleet.judged(("gyro", ARW, value[:2], 0.1)).notes[0].startswith("2 units:")


def odd(result):
    return result.table[result.table["odd_record"]].groupby("recording")["axis"].count().to_dict()


@pytest.mark.usefixtures("no_windows")
def test_a_laboratory_with_six_units_of_two_grades_on_two_days(fleet, monkeypatch, tmp_path):
    """U3 is 1.5 times off on its second day, and U6 twice its grade on both: three units are a grade."""
    monkeypatch.undo()
    value = np.exp(0.003 * np.random.default_rng(1).standard_normal((12, 3)))
    value[6:] /= 50.0
    value[5] *= 1.5
    value[10:] *= 2.0
    parts = ("gyro", ARW, value, 0.002), ("gyro", BI, np.ones((12, 3)), 0.1)
    about = {"group": [*"aaaaaabbbbbb"], "unit": np.repeat([f"U{k}" for k in range(1, 7)], 2)}
    fleet.out.mkdir()
    result = fleet.judged(*parts, **about)
    assert (marked_axes(result), odd(result)) == ({f"unit_{k}": 3 for k in (5, 10, 11)}, {"unit_5": 3})
    lines = ["U6: outlying against the median of its group: gyro N ×", "unit_5: gyro N 1.5"]
    text, notes = str(result), (fleet.out / "notes.txt").read_text(encoding="utf-8")
    assert all(line in text and line in notes for line in lines)
    assert "its other record" in text
    assert "3 with 6 records" in text
    table = result.table.set_index(["recording", "axis"])
    of = table[table["coefficient"] == ARW]
    first, second = value[4], value[5]
    np.testing.assert_allclose(of.loc["unit_5", "record_ratio"], second / first, rtol=1e-9)
    assert of.loc["unit_10", "ratio"].tolist() == pytest.approx([2.0] * 3, rel=0.02)
    names = {text.get_text().split()[0] for panel in result.plot().axes for text in panel.texts}
    assert names == {"5", "10", "11"}
    aj.report(result, tmp_path / "fleet.html")
    page = (tmp_path / "fleet.html").read_text(encoding="utf-8")
    assert "unit_5: gyro N 1.5" in page
    assert "2 outlying unit" in page
    # Without its units, each record is one.
    assert {*marked_axes(fleet.judged(*parts, group=about["group"]))} == {"unit_5", "unit_10", "unit_11"}


@pytest.mark.parametrize(("units", "days"), [(6, 2), (12, 2), (8, 3), (24, 5)])
def test_like_records_of_like_units_are_not_named(fleet, units, days):
    """With scatter within and between units, of which neither alone is that of all records."""
    for seed in range(3):
        rng = np.random.default_rng([units, days, seed])
        between, within = rng.uniform(0.0, 0.2), rng.uniform(0.0, 0.1)
        own = np.repeat(between * rng.standard_normal((units, 3)), days, axis=0)
        value = np.exp(own + np.hypot(within, 0.02) * rng.standard_normal((units * days, 3)))
        result = fleet.judged(("gyro", ARW, value, 0.02), unit=np.repeat(np.arange(units), days))
        assert len(result.outlying) == 0


def test_an_odd_record_is_left_out_of_its_unit_and_a_unit_is_judged_by_all(fleet):
    """Of three days one is off, downwards to where the other units are; its unit is off on the two others."""
    rng = np.random.default_rng(6)
    value = np.exp(0.02 * np.repeat(rng.standard_normal((12, 3)), 3, axis=0))
    value *= np.exp(0.01 * rng.standard_normal((36, 3)))
    unit = np.repeat(np.arange(12), 3)
    value[3:6] *= 2.0
    value[4] /= 2.0
    value[10] *= 1.6
    result = fleet.judged(("gyro", ARW, value, 0.005), unit=unit)
    assert odd(result) == {"unit_4": 3, "unit_10": 3}
    assert {*result.table.loc[result.table["outlying"], "unit_name"]} == {"1"}
    # Days that scatter say less of the unit than their errors would.
    calm = np.exp(0.002 * rng.standard_normal((36, 3)))
    calm[3:6] *= np.array([1.0, 1.15, 1.3])[:, None]
    assert {*fleet.judged(("gyro", ARW, calm, 0.002), unit=unit).table.query("outlying")["unit_name"]} == {
        "1"
    }
    loud = calm * np.exp(0.15 * rng.standard_normal((36, 3)))
    assert not fleet.judged(("gyro", ARW, loud, 0.002), unit=unit).table["outlying"].any()


def test_the_scatter_within_and_between_units_is_told(fleet):
    """Of a balanced analysis of variance, by hand, where errors are negligible."""
    rng = np.random.default_rng(9)
    x = 0.1 * np.repeat(rng.standard_normal(12), 4) + 0.03 * rng.standard_normal(48)
    result = fleet.judged(("gyro", ARW, np.exp(x)[:, None], 1e-4), unit=np.repeat(np.arange(12), 4))
    by_unit = x.reshape(12, 4)
    within = by_unit.var(axis=1, ddof=1).mean()
    between = by_unit.mean(axis=1).var(ddof=1) - within / 4.0
    lines = str(result).splitlines()
    begin = next(k for k, line in enumerate(lines) if "within units" in line)
    row = next(line for line in lines[begin:] if line.startswith("gyro_x"))
    sizes = [float(size) for size in re.findall(r"([\d.]+) \([\d.]+ …", row)]
    # Two digits are printed.
    assert sizes == pytest.approx([100.0 * np.sqrt(within), 100.0 * np.sqrt(between)], rel=0.05)


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
        assert ("unit_6: gyro_x: not a measurement" in str(result)) == (spoilt is unmeasured)
    # Of an interval the end that faces the others counts.
    values = [3.0, 1.0, 1.03, 0.97, 1.01, 0.99]
    for ends, found in (([0.3, 3.1], []), ([2.8, 30.0], [("unit_0", "gyro_x")])):
        result = of_units(fleet, values, 0.03, lambda u, ends=ends: {} if u else {"interval_95": ends})
        assert marks(result) == found


def of_grades(seed, sizes, ratio=4.0):
    """N of units of two grades that scatter by 5 %, errors of 3 % with them."""
    rng = np.random.default_rng(seed)
    grade = rng.permutation(np.repeat([1, 2], sizes))
    return ratio ** (grade[:, None] - 1.0) * np.exp(0.05 * rng.standard_normal((len(grade), 3))), grade


def groups(result):
    return result.table.groupby("recording", sort=False)["group"].first().tolist()


@pytest.mark.parametrize("sizes", [(6, 6), (12, 6), (10, 20)])
def test_two_groups_are_found_where_each_has_six_units_and_a_third(fleet, sizes):
    value, grade = of_grades(1, sizes)
    odd = int(np.flatnonzero(grade == 1)[0])
    value[odd] /= 2.0
    result = fleet.judged(("gyro", ARW, value, 0.03), ("accel", ARW, np.ones_like(value), 0.03))
    assert groups(result) == [str(g) for g in grade]
    (note,) = result.notes
    assert f"1 ({sizes[0]} units: " in note
    assert f"2 ({sizes[1]} units: " in note
    # Medians of six means of three values that scatter by 5 %, as errors are in that, are known to 1.5 %.
    assert float(note.split("by a factor of ")[1].split(":")[0]) == pytest.approx(4.0, rel=0.1)
    assert marked_axes(result) == {f"unit_{odd}": 3}


@pytest.mark.parametrize("sizes", [(9, 3), (5, 6), (7, 17)])
def test_fewer_are_no_group(fleet, sizes):
    """Of a quarter or less, all are outlying; of more, whom the others do not outvote, none need be."""
    value, grade = of_grades(2, sizes)
    result = fleet.judged(("gyro", ARW, value, 0.03))
    assert {*groups(result)} == {""}
    if min(sizes) <= len(grade) // 4:
        assert {*marked_axes(result)} == {f"unit_{k}" for k in np.flatnonzero(grade == 2)}


def test_groups_of_the_user_are_never_divided(fleet):
    value, grade = of_grades(3, (12, 12))
    named = np.where(np.arange(24) < 12, "a", "b")
    result = fleet.judged(("gyro", ARW, value, 0.03), group=named)
    assert groups(result) == named.tolist()
    # Bad units are found in the groups that are named, where nobody else is.
    value[[int(np.flatnonzero(grade == g)[0]) for g in (1, 2)]] *= 2.0
    result = fleet.judged(("gyro", ARW, value, 0.03), group=grade)
    assert {*marked_axes(result)} == {f"unit_{np.flatnonzero(grade == g)[0]}" for g in (1, 2)}
    assert result.notes == ()


def test_warnings_and_what_is_no_measurement_are_told(fleet):
    for u in range(4):
        warnings = {1: ["too short"], 2: ["0–5 s are noisier", "too short"]}.get(u, [])
        spoilt = {"measured": False, "std": None, "interval_95": [None, None]} if u == 0 else {}
        both = [axis(f"gyro_{a}", [coefficient(ARW, 1.0, 0.03, **spoilt)]) for a in "xy"]
        fleet.store(f"unit_{u}", both, warnings=warnings, stretch_s=[u, 9.0])
    result = fleet.run([fleet.file(f"unit_{u}") for u in range(4)])
    assert marks(result) == []
    assert result.notes == ("unit_1 and unit_2: too short", "unit_2: 0–5 s are noisier")
    assert "unit_0: all axes: not a measurement" in str(result).splitlines()
    table = result.table.groupby("recording", sort=False).first()
    assert table["warnings"].tolist() == ["", "too short", "0–5 s are noisier\ntoo short", ""]
    assert table["start_s"].tolist() == [0.0, 1.0, 2.0, 3.0]
    assert (table["stop_s"] == 9.0).all()
