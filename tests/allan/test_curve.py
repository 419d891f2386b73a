"""Allan curves without their records: files of other programs, and fits that agree with the records'."""

import json
import re

import bench
import numpy as np
import pytest
from commands import run, schema
from places import DATA
from refusals import refuses

import allanjax as aj

DEG = np.pi / 180.0


def written(path, head, *columns, separator=","):
    lines = [separator.join(f"{x:.6g}" for x in row) for row in zip(*columns, strict=True)]
    path.write_text("\n".join([*([head] if head else []), *lines]) + "\n", encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def curve():
    return aj.allan_deviation(bench.recording("small"))


def columns_of(curve, unit=DEG / 3600.0):
    return curve.cluster_time, *(curve.deviation[:, :3] / unit).T


@pytest.mark.parametrize(
    ("head", "power", "unit"),
    [
        ("tau [s],gyro_x [deg/h],gyro_y [deg/h],gyro_z [deg/h]", 1, DEG / 3600.0),
        ("taus,gyro_x adev [deg/s],gyro_y adev [deg/s],gyro_z adev [deg/s]", 1, DEG),
        ("T,gx avar [(rad/s)^2],gy avar [(rad/s)^2],gz avar [(rad/s)^2]", 2, 1.0),
        ("period,wx sigma^2 [(deg/h)²],wy sigma^2 [(deg/h)²],wz sigma^2 [(deg/h)²]", 2, DEG / 3600.0),
        ("cluster_time [s],gyro_x deviation [deg/h],gyro_y [deg/h],gyro_z [deg/h]", 1, DEG / 3600.0),
    ],
)
def test_columns_are_recognised_by_their_names_and_units(curve, tmp_path, head, power, unit):
    tau, *values = columns_of(curve, unit)
    path = written(tmp_path / "c.csv", head, tau, *(x**power for x in values))
    found = aj.read_curve(path, 100.0, "163.84 s")
    assert found.names == ("gyro_x", "gyro_y", "gyro_z")
    assert (found.n, found.rate, found.name, found.determined) == (16_384, 100.0, "c", True)
    np.testing.assert_array_equal(found.cluster_size, curve.cluster_size)
    np.testing.assert_array_equal(found.count, curve.count)
    np.testing.assert_allclose(found.deviation, curve.deviation[:, :3], rtol=1e-5)
    # The degrees of freedom of white noise, as of the record itself.
    np.testing.assert_allclose(found.edf, curve.edf[:, :3], rtol=1e-12)
    assert any("overlapping" in note for note in found.notes)


def test_tables_of_other_programs_are_read(curve, tmp_path):
    tau, *values = columns_of(curve)
    # Stable32: sizes and counts tell rate and length; the ends of its intervals are left out.
    head = "AF,Tau,#,Alpha,Min Sigma,Sigma,Max Sigma"
    numbers = curve.cluster_size, tau, curve.count, 0 * tau, 0.9 * values[0], values[0], 1.1 * values[0]
    found = aj.read_curve(written(tmp_path / "s.csv", head, *numbers), gyro_unit="deg/h")
    assert (found.names, found.n, found.rate, found.determined) == (("gyro",), 16_384, 100.0, True)
    np.testing.assert_allclose(found.deviation[:, 0], curve.deviation[:, 0], rtol=1e-5)
    # A unit tells the sensor of a deviation without an axis.
    path = written(tmp_path / "u.csv", "tau,adev [µg],ade,n", tau, values[0], values[0], curve.count)
    assert aj.read_curve(path, 100.0).names == ("accel",)
    # allan_variance_ros has no header: accelerometers come first, in m/s², then gyros in deg/s.
    gyros = [x / 3600.0 for x in values]
    path = written(tmp_path / "r.csv", "", tau, *[0.01 * x for x in gyros], *gyros, separator=" ")
    found = aj.read_curve(path, 100.0, 163.84)
    assert found.names == ("accel_x", "accel_y", "accel_z", "gyro_x", "gyro_y", "gyro_z")
    np.testing.assert_allclose(found.deviation[:, 3:], curve.deviation[:, :3], rtol=1e-5)
    # What characterize writes itself, and what to_dataframe() gives.
    fit = bench.fit("small")
    aj.write_curve_csv(fit, path := tmp_path / "small_allan.csv")
    for source in (path, tmp_path / "frame.csv"):
        if source != path:
            fit.curve.to_dataframe().to_csv(source, index=False)
        found = aj.read_curve(source, 100.0, 163.84)
        assert found.names == fit.axes
        np.testing.assert_allclose(found.deviation, fit.curve.deviation, rtol=1e-9)


STABLE32 = """\
# Stable32 1.60
# Sigma Type: Overlapping Allan
# Confidence Factor = 0.683
#
#  AF        Tau        #    Alpha  Min Sigma      Sigma         Max Sigma
    1   1.0000e+00      999     0   2.8515e-01    2.9223e-01     2.9987e-01
    2   2.0000e+00      997     0   1.9520e-01    2.0102e-01     2.0738e-01
    4   4.0000e+00      993     0   1.3931e-01    1.4479e-01     1.5098e-01
"""


def test_headers_in_comments_are_read(tmp_path):
    # Stable32's own file, whose names have blanks; the ends of its intervals are left out.
    (path := tmp_path / "s.txt").write_text(STABLE32)
    found = aj.read_curve(path, gyro_unit="deg/h")
    assert (found.n, found.rate, found.determined) == (1000, 1.0, True)
    np.testing.assert_allclose(found.deviation[:, 0] / (DEG / 3600.0), [0.29223, 0.20102, 0.14479])
    # numpy.savetxt writes its header as a comment.
    np.savetxt(path := tmp_path / "n.txt", [[0.01, 0.2], [0.02, 0.1]], header="tau adev")
    found = aj.read_curve(path, 100.0, 60.0, gyro_unit="deg/h")
    np.testing.assert_allclose(found.deviation[:, 0] / (DEG / 3600.0), [0.2, 0.1])


def test_deviations_that_are_not_overlapping_are_refused(tmp_path):
    # Counts of disjoint clusters of 1,000 samples: 1000 / m - 1.
    disjoint = STABLE32.replace("997", "499").replace("993", "249")
    for text, words in ((disjoint, "do not overlap"), (STABLE32.replace("  Sigma  ", "Mod Sigma "), "Mod")):
        (path := tmp_path / "s.txt").write_text(text)
        with pytest.raises(aj.RecordingError, match=words):
            aj.read_curve(path, gyro_unit="deg/h")


def test_a_curve_is_no_recording(tmp_path):
    path = written(tmp_path / "c.csv", "tau [s],gyro_x [deg/s]", np.arange(1.0, 9.0), np.ones(8))
    with pytest.raises(aj.RecordingError, match=r"'tau \[s\]' has cluster times.*--curve"):
        aj.read(path, rate=100.0)


def test_a_fit_of_the_curve_agrees_with_that_of_the_record(curve, tmp_path):
    path = written(tmp_path / "c.csv", "tau,gyro_x,gyro_y,gyro_z", *columns_of(curve))
    found = aj.fit(aj.read_curve(path, 100.0, 163.84, gyro_unit="deg/h"), "N + B")
    # The same estimates from the samples; there at four times per octave, by which B is 5 % more precise.
    expected = aj.fit_many([bench.recording("small")], "N + B")
    truth = bench.truth("small").truth
    for k, name in enumerate(found.axes):
        for j, label in enumerate(expected.coefficients):
            c = found[name][label]
            numbers = [getattr(expected, x)[k, j] for x in ("value", "lower", "upper")]
            np.testing.assert_allclose([c.value, *c.interval], numbers, rtol=1e-3)
            assert c.interval[0] < truth[name][label] < c.interval[1]
    same = aj.fit(curve, "N + B + K")
    assert same.axes == curve.names
    assert same["gyro_x"]["N"].detected
    with pytest.raises(aj.AllanjaxError, match="omit rate, regressors"):
        aj.fit(curve, "N", rate=100.0, regressors="temperature")


def test_without_rate_or_length_there_are_values_but_no_intervals(curve, tmp_path):
    path = written(tmp_path / "c.csv", "tau,gyro_x,gyro_y,gyro_z", *columns_of(curve))
    known = aj.fit(aj.read_curve(path, 100.0, 163.84, gyro_unit="deg/h"), "N + B")
    for rate, duration, word in ((100.0, None, "--duration"), (None, 163.84, "--rate")):
        fit = aj.fit(aj.read_curve(path, rate, duration, gyro_unit="deg/h"), "N + B")
        assert any(word in note for note in fit.notes)
        for axis in fit.axes:
            for label in ("N", "B"):
                c = fit[axis][label]
                assert c.measured
                assert np.isnan([c.std, *c.interval]).all()
                assert c.value == pytest.approx(known[axis][label].value, rel=0.05)
        assert not fit.not_measured
        assert "(" not in str(fit).splitlines()[3]
        # Errors that follow are values, too, and what needs an interval is not decided.
        attitude = aj.navigate(fit, [10.0], at_rest=10.0)["attitude"]
        expected = aj.navigate(known, [10.0], at_rest=10.0)["attitude"]
        assert attitude.error == pytest.approx(expected.error, rel=0.05)
        assert np.isnan([attitude.lower, attitude.upper]).all()
        limit = {"gyro": {"meaning": "maximum", "N": "1000 deg/√h"}}
        assert aj.check_spec(fit, limit).verdict == "undecided"
        assert np.isnan(aj.horizon(fit, 10.0, axes="gyro_x")["gyro_x"].bounding_white)
        refuses("no posterior", aj.sample, fit)
        refuses("no interval", aj.joint_fit, [fit, fit], "N + B")


def test_cluster_times_are_rounded_to_samples_and_thinned(curve, tmp_path):
    tau, x, *_ = columns_of(curve)
    # As read from a picture: 1 % off.
    path = written(tmp_path / "c.csv", "tau,gyro_x [deg/h]", 1.01 * tau[3:], x[3:])
    found = aj.read_curve(path, 100.0, "3 min")
    np.testing.assert_array_equal(found.cluster_size[:4], [8, 16, 32, 65])
    assert any("rounded" in note for note in found.notes)
    every = np.arange(1, 2000) / 100.0
    path = written(tmp_path / "d.csv", "tau,gyro_x [deg/h]", every, every**-0.5)
    found = aj.read_curve(path, 100.0, "1 h")
    assert np.all(np.diff(np.log2(found.cluster_size[4:])) > 0.13)
    assert len(found.cluster_size) < 45
    assert found.n == 360_000


@pytest.mark.parametrize(
    ("head", "word", "options"),
    [
        ("tau,gyro_x,gyro_y,gyro_z", "'gyro_x' has no unit; give gyro_unit=", {"gyro_unit": None}),
        ("a,gyro_x,gyro_y,gyro_z", "cluster times", {}),
        ("tau,x,y,z", "no column of deviations", {}),
        ("tau,gyro_x,gyro_x,gyro_z", "same axis", {}),
        ("tau,gyro_x mdev,gyro_y,gyro_z", "'gyro_x mdev' is no Allan deviation", {}),
        ("tau,gyro_x [furlong],gyro_y,gyro_z", "'gyro_x .furlong.'", {"gyro_unit": None}),
        ("tau,gyro_x [rad],gyro_y,gyro_z", "not a unit of deviations", {"gyro_unit": None}),
        ("tau,gyro_x,gyro_y,gyro_z", "longer than 60 s; correct duration=", {"duration": "1 min"}),
        ("tau,gyro_x,gyro_y,gyro_z", "shorter than a sample", {"rate": 1.0}),
        ("tau,gyro_x,gyro_y,gyro_z", "must be a time such as 3h", {"duration": "long"}),
        ("tau,gyro_x,gyro_y,gyro_z", "4 columns, but columns= .* names 2", {"columns": "tau,gyro_x"}),
    ],
)
def test_what_cannot_be_is_refused_by_file_column_and_remedy(curve, tmp_path, head, word, options):
    path = written(tmp_path / "c.csv", head, *columns_of(curve))
    refuses(word, aj.read_curve, path, **{"rate": 100.0, "duration": 163.84, "gyro_unit": "deg/h", **options})


def test_a_curve_is_fitted_by_terms_that_it_determines(curve):
    refuses("needs the record", aj.fit, curve, "N + sinusoid(frequency=1 Hz)")
    refuses("leave it out for a curve", aj.fit, curve, "N", "whittle")
    refuses("hadamard", aj.fit, aj.allan_deviation(bench.recording("small"), kind="hadamard"), "N")


def test_the_command_takes_curves(curve, tmp_path):
    path = written(tmp_path / "c.csv", "tau,gyro_x,gyro_y,gyro_z", *columns_of(curve))
    words = ["characterize", path, "--curve", "--rate", 100, "--gyro-unit", "deg/h", "--terms", "N + B"]
    done = run(*words, "--duration", "163.84", "--out", tmp_path / "out")
    assert done.exit_code == 0, done.stderr
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [
        *("c.json", "c_allan.csv", "c_allan.png", "c_coefficients.csv")
    ]
    assert "overlapping Allan deviations are assumed" in done.stdout
    loaded = aj.load(tmp_path / "out" / "c.json")
    fit = aj.fit(aj.read_curve(path, 100.0, 163.84, gyro_unit="deg/h"), "N + B")
    assert loaded["gyro_y"]["B"].interval == pytest.approx(fit["gyro_y"]["B"].interval)
    bare = run(*words, "--out", tmp_path / "bare")
    assert bare.exit_code == 0, bare.stderr
    assert "no intervals without duration= (--duration)" in bare.stdout
    assert "not a measurement" not in bare.stdout + bare.stderr
    saved = tmp_path / "bare" / "c.json"
    schema("fit").validate(json.loads(saved.read_text(encoding="utf-8")))
    again = aj.load(saved)["gyro_y"]["B"]
    assert again.value == pytest.approx(fit["gyro_y"]["B"].value, rel=0.05)
    assert np.isnan([again.std, *again.interval]).all()
    exported = run("export", saved, "--to", "kalibr")
    assert exported.exit_code == 0, exported.stderr
    density = re.search(r"^gyroscope_noise_density: (.*)$", exported.stdout, re.M)
    largest = max(fit[axis]["N"].value for axis in fit.axes)
    assert float(density[1]) == pytest.approx(largest, rel=0.05)
    assert "95 %" not in exported.stdout
    document = json.loads(run(*words, "--duration", "3 min", "--json").stdout)
    assert document["fits"][0]["recording"]["n"] == 18_000
    assert run(*words, "--duration", "3 min", "--stream").exit_code == 2


def test_published_curves_of_real_sensors_are_fitted_sensibly():
    """N of each gyro is σ(1 s) of its curve where that falls as 1/√T; the accelerometers' Q is σ(T)·T/√3."""
    if not (DATA / "allan_curves").exists():
        pytest.skip("the published curves are not there")
    for name, rate, n, unit in (("adis", 100.0, 10**6, "deg/s"), ("ln200", 400.0, 8_640_000, "rad/s")):
        path, accel = DATA / "allan_curves" / f"{name}.csv", "g" if name == "adis" else "m/s²"
        curve = aj.read_curve(path, rate, n / rate, gyro_unit=unit, accel_unit=accel)
        fit = aj.fit(curve)
        near = np.argmin(abs(np.log(curve.cluster_time / 1.0)))
        for k, axis in enumerate(("gyro_x", "gyro_y", "gyro_z")):
            N = curve.deviation[near, k] * np.sqrt(curve.cluster_time[near])
            assert fit[axis]["N"].value == pytest.approx(N, rel=0.12), (name, axis)
    Q = curve.deviation[2:8, 4] * curve.cluster_time[2:8] / np.sqrt(3.0)
    assert fit["accel_y"]["Q"].value == pytest.approx(np.median(Q), rel=0.15)


# Units of the numbers and of the labels; what is said of each sensor: named, not a word, or not refused.
CURVE_UNITS = [
    (("deg/s", "g"), ("deg/h", "g"), {"gyro unit": "deg/s"}),
    (("deg/h", "m/s²"), ("deg/s", "m/s²"), {"gyro unit": "deg/h"}),
    (("deg/s", "g"), ("rad/s", "m/s²"), {"gyro unit": "deg/s", "accel unit": "g"}),
    (("deg/h", "µg"), ("deg/h", "µg"), {}),
    (("rad/s", "m/s²"), ("rad/s", "m/s²"), {}),
]


@pytest.mark.parametrize(("true", "label", "named"), CURVE_UNITS)
def test_a_curve_in_another_unit_is_no_measurement(tmp_path, true, label, named):
    """White noise of 0.3 deg/√h and 0.1 m/s/√h, of which the deviation at 1 s follows by √3600 = 60."""
    scale = {"deg/s": np.pi / 180.0, "deg/h": np.pi / 648_000.0, "rad/s": 1.0}
    scale |= {"m/s²": 1.0, "g": 9.80665, "µg": 9.80665e-6}
    tau = 2.0 ** np.arange(-6, 5)
    white = np.array([0.3 / 60.0 * scale["deg/s"], 0.1 / 60.0]) / np.sqrt(tau)[:, None]
    header = f"tau [s],gyro_x [{label[0]}],accel_x [{label[1]}]"
    path = tmp_path / "curve.csv"
    table = np.column_stack([tau, white / [scale[unit] for unit in true]])
    np.savetxt(path, table, "%.9g", ",", header=header, comments="", encoding="utf-8")
    fit = aj.fit(aj.read_curve(path, 64.0, 3600.0), "N")
    assert {fact.kind for fact in fit.facts} == {*named}
    assert [fit[axis].measured for axis in ("gyro_x", "accel_x")] == [
        f"{sensor} unit" not in named for sensor in ("gyro", "accel")
    ]
    for fact in fit.facts:
        assert fact.grave
        assert f"pass --{fact.kind.replace(' ', '-')} {named[fact.kind]}" in fact.text
    # What the text proposes is right.
    units = {kind.replace(" ", "_"): unit for kind, unit in named.items()}
    assert aj.fit(aj.read_curve(path, 64.0, 3600.0, **units), "N").facts == ()
