"""Comparison of sensors: tests of equality by hand, tables of the thesis, drift by closed forms."""

import dataclasses
import json
import math
import re

import bench
import numpy as np
import pytest
from commands import run, schema
from scipy.stats import binom, norm

import allanjax as aj

ARW, RRW = "angle_random_walk", "rate_random_walk"
DEG = math.pi / 180

# Hou (2004), values of x and their errors: tables 5.2, 5.4 and 5.5.
TABLES = {
    ("cimu", "gyro_x"): {"Q": (0.9732, 0.0738, "arcsec"), "N": (0.0015, 0.0005, "deg/√h")},
    ("cimu", "accel_x"): {"Q": (1.6801, 0.1275, "m/h"), "R": (2.6364, 0.8795, "m/s/h²")},
    ("hg1700", "gyro_x"): {"Q": (5.1154, 0.0683, "arcsec"), "N": (0.0936, 0.0312, "deg/√h")},
    ("hg1700", "accel_x"): {"Q": (2.1188, 0.0673, "m/h"), "K": (0.7637, 0.2548, "m/s/h/√h")},
    ("motionpak2", "gyro_x"): {"N": (0.5121, 0.0068, "deg/√h"), "B": (13.58, 1.36, "deg/h")},
    ("motionpak2", "accel_x"): {"N": (0.01664, 0.00003, "m/s/√h"), "B": (4.36, 0.04, "m/s/h")},
}


def with_values(fit: aj.Fit, logs: dict[str, float], std: float) -> aj.Fit:
    """The fit with coefficients of these logarithms, known to this relative standard deviation."""
    (result,) = fit.results
    found = {}
    for label, c in result.coefficients.items():
        value = math.exp(logs[label]) if label in logs else 0.0
        ends = (value * math.exp(-1.96 * std), value * math.exp(1.96 * std))
        about = {"value": value, "std": std * value, "interval": ends, "interval_68": ends}
        found[label] = dataclasses.replace(c, detected=label in logs, upper_limit=None, **about)
    return dataclasses.replace(fit, results=(result.with_estimates(found),))


@pytest.fixture(scope="module")
def thesis():
    return aj.compare("cimu", "hg1700", "motionpak2")


def test_the_tables_of_the_thesis_come_out_in_their_units(thesis):
    frame = thesis.to_dataframe()
    for (unit, axis), expected in TABLES.items():
        own = {row.label: row for row in thesis.rows if row.axis == axis}
        at = thesis.labels.index(unit)
        known = [e.in_unit() for row in own.values() if (e := row.estimates[at]) is not None]
        found = {e.symbol: e for e in known if e.symbol}
        assert {s: (round(e.value, 5), round(e.std, 5), e.unit) for s, e in found.items()} == expected
    # Table 5.6: which terms are there.
    there = frame.groupby(["sensor", "axis"])["coefficient"].agg(set)
    assert there["hg1700", "accel_x"] == {"quantization", RRW}
    assert there["cimu", "accel_x"] == {"quantization", "drift_ramp"}
    assert set(frame["sensor"]) == {"cimu", "hg1700", "motionpak2"}


def test_ratios_and_p_values_are_those_of_the_logarithms_corrected_by_holm(thesis):
    p_values, rows = [], []
    for row in thesis.rows:
        base = row.estimates[0]
        for k in (1, 2):
            c, d = row.estimates[k], row.differences[k]
            if c is None or base is None:
                assert d is None
                continue
            low, high = (x.interval for x in (c, base))
            # Widths of the intervals on a logarithmic scale.
            s = math.hypot(*(math.log(b / a) / 3.919928 if a > 0 else math.inf for a, b in (low, high)))
            if not math.isfinite(s):
                continue
            log = math.log(c.value / base.value)
            assert d.ratio == pytest.approx(math.exp(log))
            assert d.interval == pytest.approx((math.exp(log - 1.96 * s), math.exp(log + 1.96 * s)), rel=1e-3)
            assert d.p_value == pytest.approx(2 * norm.sf(abs(log) / s), rel=1e-3)
            p_values.append(d.p_value)
            rows.append(d)
    count = len(p_values)
    # Holm: the smallest times their number, the next times one less, …, never decreasing.
    highest = 0.0
    for rank, k in enumerate(np.argsort(p_values)):
        highest = max(highest, min(1.0, (count - rank) * p_values[k]))
        assert rows[k].corrected == pytest.approx(highest, rel=1e-9)


def test_equal_sensors_differ_in_one_comparison_of_twenty_and_unequal_ones_nearly_always():
    rng, fit, std = np.random.default_rng(17), bench.fit("white"), 0.05
    logs = {ARW: math.log(1e-4), RRW: math.log(1e-6)}

    def differs(shift: float) -> bool:
        drawn = [{k: v + std * rng.normal() + i * shift for k, v in logs.items()} for i in (0, 1)]
        found = aj.compare(*(with_values(fit, own, std) for own in drawn))
        return any(d.differs for row in found.rows for d in row.differences if d is not None)

    # The probability of more than this many of 60 at 5 % is 10⁻³.
    assert sum(differs(0.0) for _ in range(60)) <= binom.isf(1e-3, 60, 0.05)
    # Six standard errors of the difference.
    assert all(differs(6 * std * math.sqrt(2)) for _ in range(10))


def test_what_is_not_detected_is_compared_by_its_limit():
    fit = bench.fit("white")
    both = with_values(fit, {ARW: math.log(1e-4), RRW: math.log(1e-6)}, 0.02)
    one = with_values(fit, {ARW: math.log(1e-4)}, 0.02)
    (result,) = one.results
    label = {**result.coefficients}
    far, near = (
        dataclasses.replace(one, results=(result.with_estimates(label | {RRW: limited}),))
        for limited in (dataclasses.replace(label[RRW], upper_limit=limit) for limit in (1e-7, 3e-6))
    )
    assert aj.compare(both, far)["gyro_x", RRW].differences[1].differs is True
    assert aj.compare(both, near)["gyro_x", RRW].differences[1].differs is False
    found = aj.compare(both, far)["gyro_x", RRW].differences[1]
    assert found.interval == (0.0, pytest.approx(1e-7 / (1e-6 * math.exp(-1.96 * 0.02)), rel=1e-6))


def test_what_is_detected_is_larger_than_what_is_not_even_if_its_lower_end_is_below_the_limit():
    def fitted(seed, K):
        rng = np.random.default_rng(seed)
        x = rng.normal(0.0, 1e-2, 60_000) + K / 10.0 * np.cumsum(rng.normal(size=60_000))
        return aj.fit(aj.Recording.from_array(x, 100.0, names=["gyro_x"], gyro_unit="rad/s"), "N + K")

    without, with_walk = fitted(2, 0.0), fitted(32, 5e-5)
    low, limit = with_walk["gyro_x"]["K"].interval[0], without["gyro_x"]["K"].upper_limit
    assert low < limit
    for pair, verdict in (((without, with_walk), "larger"), ((with_walk, without), "smaller")):
        (row,) = (row for row in aj.compare(*pair).rows if row.label == "rate_random_walk")
        assert row.differences[1].verdict == verdict


def test_a_changed_sensor_is_found_and_its_repetition_is_not():
    def record(N: float, seed: int) -> aj.Recording:
        return aj.simulate_recording({"gyro_x": f"N={N} deg/√h"}, 16_384, 100.0, seed, name=f"{N}-{seed}")

    before, again, after = (aj.fit(record(*x), "N + K", plain=True) for x in ((0.1, 1), (0.1, 2), (0.11, 3)))
    found = aj.compare(before, again, after, labels=["before", "again", "after"])
    row = found["gyro_x", "N"]
    # N is known to √(1/2n), half a per cent.
    assert [d and d.differs for d in row.differences] == [None, False, True]
    assert row.differences[2].ratio == pytest.approx(1.1, abs=0.03)


def test_drift_follows_the_closed_forms_and_data_sheets_are_exact():
    sheet = {"name": "one", "gyro": {"random_walk": "0.5 deg/√h", "rate_random_walk": "3 deg/h/√h"}}
    other = {"name": "two", "gyro": {"random_walk": "0.25 deg/√h"}}
    found = aj.compare(aj.datasheet(sheet), aj.datasheet(other))
    N, K = 0.5 * DEG / 60, 3 * DEG / 3600 / 60
    t = np.array([60.0, 600.0, 3600.0])
    # √2·t·σ(t) with σ² = N²/t + K²t/3, Hou (4.33) and (4.43).
    expected = np.sqrt(2) * t * np.sqrt(N**2 / t + K**2 * t / 3)
    own = next(g for g in found.growths if g.sensor == 0)
    np.testing.assert_allclose(own.value, expected, rtol=1e-6)
    assert np.isnan(own.lower).all()
    row = found["gyro", ARW]
    assert (row.differences[1].ratio, row.differences[1].differs) == (pytest.approx(0.5), None)


def test_the_command_takes_names_files_and_results_and_draws_them(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    aj.write_json(bench.fit("small"), "imu.json")
    out = ["--out", "c.png", "--out", "c.html", "--out", "c.csv"]
    done = run(
        "compare", "imu.json", "BMI088", "cimu", "--label", "mine", "--label", "sheet", "--label", "C", *out
    )
    assert done.exit_code == 0, done.stderr
    assert "mine: fit of" in done.stdout
    assert (tmp_path / "c.png").is_file()
    assert "mine – sheet – C" in (tmp_path / "c.html").read_text(encoding="utf-8")
    assert (tmp_path / "c.csv").read_text(encoding="utf-8").startswith("axis,")
    document = json.loads(run("compare", "imu.json", "BMI088", "--json").stdout)
    assert [one["name"] for one in document["sensors"]] == ["imu", "BMI088"]
    assert document["horizons_s"] == [60.0, 600.0, 3600.0]
    aj.write_curve_csv(bench.fit("white"), "curve.csv")
    shown = run("compare", "cimu", "--curve", "curve.csv, 100 Hz, 163.84 s")
    assert "curve: fit of" in shown.stdout
    assert "is not a rate" in run("compare", "cimu", "--curve", "curve.csv, fast, 3 h").stderr
    unknown = run("compare", "imu.json", "BMI8800")
    assert unknown.exit_code == 1
    assert "BMI088" in unknown.stderr
    assert run("compare", "none.csv", "cimu").exit_code == 1


@pytest.mark.parametrize(
    ("arguments", "options", "words"),
    [
        (("cimu",), {}, "two or more"),
        (("cimu", "hg1700"), {"labels": ["a"]}, "one for each"),
        (("cimu", "hg1700"), {"reference": "x"}, "no sensor 'x'"),
        (("cimu", "hg1700"), {"reference": 2}, "0 to 1"),
    ],
)
def test_what_cannot_be_compared_is_refused(arguments, options, words):
    with pytest.raises(aj.AllanjaxError, match=words):
        aj.compare(*arguments, **options)


@pytest.mark.parametrize("seed", [1, 6, 10])
def test_a_drift_lies_within_its_interval_where_an_unlikely_set_of_terms_has_far_more(seed):
    """White noise of 205 s, which hardly tells a ramp or random walk from none, over three times that."""
    values = 0.02 * np.random.default_rng(seed).standard_normal((20_480, 3))
    names = ["accel_x", "accel_y", "accel_z"]
    fit = aj.fit(aj.Recording.from_array(values, 100.0, accel_unit="m/s^2", names=names))
    for growth in aj.compare(fit, "STIM300").growths:
        if growth.sensor == 0 and growth.name != "position":
            # An hour is beyond three times the record.
            assert growth.reasons == ("", "", "record too short")
            assert np.isnan([growth.value[2], growth.lower[2], growth.upper[2]]).all()
            assert (growth.lower[:2] <= growth.value[:2]).all()
            assert (growth.value[:2] <= growth.upper[:2]).all()


def test_what_a_data_sheet_lacks_is_not_zero():
    """BMI088's sheet has N alone, STIM300's N and B."""
    found = aj.compare("BMI088", "STIM300")
    growths = {(g.name, found.labels[g.sensor]): g for g in found.growths}
    for name in ("gyro", "accel"):
        assert growths[name, "BMI088"].reasons == ("not given",) * 3
        assert np.isnan(growths[name, "BMI088"].value).all()
        assert growths[name, "STIM300"].is_bound
        assert found[name, "K"].estimates == (None, None)
    # √2·t·σ(t) of N and B, with the least deviation of the sheet, 0.664 B: no K, so at least that.
    t, N, B = 60.0, 0.15 * DEG / 60, 0.3 / 0.664283 * DEG / 3600
    # σ² of flicker noise is (2 ln2/π)·B² at all times that are long against a sample.
    drift = math.sqrt(2) * t * math.hypot(N / math.sqrt(t), 0.664283 * B)
    assert growths["gyro", "STIM300"].value[0] == pytest.approx(drift, rel=0.02)
    assert all(growths[name, "BMI088"].is_bound for name in ("heading", "position"))
    lines = str(found).splitlines()
    # Once for the gyro and once for the accelerometer; no sheet gives K, so the table leaves it out.
    for row, times in {"B +BMI088": 2, "min σ +BMI088": 2, "K +BMI088": 0, "K +STIM300": 0}.items():
        assert sum(bool(re.search(f"{row} +not given", line)) for line in lines) == times
    grades = [line.split() for line in lines[lines.index(next(x for x in lines if "grade of" in x)) :]]
    assert ["accel", "BMI088", "not", "given"] in grades
    document = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    schema("compare").validate(document)
    absent = [c for c in document["coefficients"] if c["value"] is None]
    assert {(c["sensor"], c["coefficient"]) for c in absent} == {
        *(("BMI088", name) for name in ("bias_instability", RRW, "least_allan_deviation")),
        ("STIM300", RRW),
    }
    assert {c["reason"] for c in absent} == {"not given"}
    drifts = [g for g in document["growth"] if (g["sensor"], g["of"]) == ("BMI088", "gyro")]
    assert (drifts[0]["value"], drifts[0]["reasons"]) == ([None] * 3, ["not given"] * 3)
    # The picture has bounds, dotted.
    for panel in (ax for ax in found.plot().axes if ax.get_title("left")):
        lines = [line for line in panel.get_lines() if len(line.get_xdata()) > 100]
        assert {line.get_linestyle() for line in lines} - {"None"} == {":"}


def test_a_fit_of_white_noise_alone_has_no_drift():
    fit = aj.fit(bench.recording("white"), "N", plain=True)
    found = aj.compare(fit, "cimu")
    own = [g for g in found.growths if g.sensor == 0 and "_" in g.name]
    assert own
    assert all(g.reasons[0] == "not given" for g in own)
    assert found["gyro_x", "K"].estimates[0] is None
    grown = aj.navigate(fit, [10.0])["attitude"]
    assert set(grown.bounds) == set(grown.channels)
    assert np.isinf(grown.upper).all()
    assert any("B and K not given" in note for note in aj.navigate(fit, [10.0]).notes)
