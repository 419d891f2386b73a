"""Limits against estimates: by hand, by brute force, and by records whose truth is known."""

import dataclasses
import json
from xml.etree import ElementTree

import bench
import numpy as np
import pytest
from altered_fits import without_result
from commands import run, schema
from refusals import refuses
from scipy.stats import norm

import allanjax as aj

DEG, HOUR = np.pi / 180.0, 3600.0
WALK = "angle_random_walk"


def sheet(limit, figure="random_walk", meaning="maximum", section="gyro", **more):
    return {section: {"meaning": meaning, figure: limit, **more}}


def one(fit, *given, **more):
    (found,) = aj.check_spec(fit, sheet(*given, **more)).results
    return found


def walk_limit(value):
    return f"{value / DEG * 60.0:.17g} deg/√h"


@pytest.fixture(scope="module")
def white():
    return bench.fit("white", "N")


@pytest.fixture(scope="module")
def walk():
    return bench.fit("walk", "N + K")


def test_the_probability_is_that_of_the_logarithm_and_white_noise_needs_the_square_of_the_time(white):
    """With standard errors on the side of the limit; 1/√T brings the score to 1.645."""
    c, length = white["gyro_x"]["N"], bench.recording("white").duration
    for score, verdict in ((-2.0, "fail"), (-0.7, "undecided"), (0.5, "undecided"), (1.7, "pass")):
        sigma = abs(np.log(c.interval[int(score > 0)] / c.value)) / norm.ppf(0.975)
        found = one(white, walk_limit(c.value * np.exp(score * sigma)))
        assert found.verdict == verdict
        assert found.probability == pytest.approx([norm.cdf(score)] * 2, rel=1e-5)
        assert found.ratio == pytest.approx(np.exp(-score * sigma))
        assert found.score == pytest.approx(-score, rel=1e-5)
        if verdict == "undecided":
            assert found.seconds == pytest.approx(length * (1.644854 / score) ** 2, rel=0.05)
            assert "would decide" in found.reason


def test_figures_have_the_meaning_of_data_sheets(white):
    """√2·N one-sided, N two-sided; an rms in a bandwidth; B for 0.664 B; other labels in their own units."""
    N = white["gyro_x"]["N"].value
    density = f"{N / DEG:.17g} deg/s/√Hz"
    values = [one(white, density, "noise_density", sided=sided).limit.value for sided in ("one", "two")]
    assert values == pytest.approx([N / np.sqrt(2.0), N])
    rms = one(white, "0.05 deg/s", "rms_noise", bandwidth="30 Hz", bandwidth_is="first-order").limit
    assert (rms.label, rms.value) == (WALK, pytest.approx(0.05 * DEG / np.sqrt(np.pi * 30.0)))
    B = one(white, "8 deg/h", "in_run_bias_instability", reading="B").limit
    assert (B.label, B.value) == ("bias_instability", pytest.approx(8.0 * DEG / HOUR))
    Q = one(white, "2 arcsec", "quantization").limit
    assert (Q.label, Q.value) == ("quantization", pytest.approx(2.0 * DEG / HOUR))
    assert {one(white, "1 deg/√h", name).limit.label for name in ("N", "ARW", "angle random walk")} == {WALK}
    markov = one(white, "2 deg/h/√h", "markov_amplitude")
    assert markov.limit.value == pytest.approx(2.0 * DEG / HOUR / 60.0)
    assert (markov.verdict, "--terms" in markov.reason) == ("undecided", True)


def test_the_least_deviation_is_that_of_the_model_with_its_covariance_propagated(walk):
    """By central differences of the least over 2,000 cluster times; medians and widths of draws to 8 %."""
    time = np.geomspace(0.05, 80.0, 2000)
    for name, result in walk.items():
        model = result.model

        def least(values, model=model):
            N, K = values
            moved = model.with_values(angle_random_walk=N, rate_random_walk=K).sampled(100.0)
            return np.sqrt(np.asarray(moved.allan_variance(time)).min())

        value = np.array([result["N"].value, result["K"].value])
        step = 1e-4 * value
        slope = [(least(value + s) - least(value - s)) / (2.0 * s.sum()) for s in np.diag(step)]
        assert list(result.coefficients) == [WALK, "rate_random_walk"]
        std = np.sqrt(slope @ result.covariance @ slope)
        options = {"figure": "in_run_bias_instability", "reading": "minimum", "section": name}
        c = one(walk, "9 deg/h", **options).estimate
        assert c.value == pytest.approx(least(value), rel=0.02)
        assert c.std == pytest.approx(std, rel=0.08)
        ends = np.array(c.interval) / c.value
        assert np.log(ends) == pytest.approx(std / least(value) * norm.ppf([0.025, 0.975]), rel=0.15)
        close = one(walk, f"{0.95 * c.value / DEG * HOUR} deg/h", **options)
        assert close.verdict == "undecided"
        assert close.seconds > bench.recording("walk").duration


def test_a_curve_that_still_falls_can_pass_but_hardly_fail(white):
    """Of white noise the minimum is zero somewhere; N + B never falls below 0.664 B."""
    N = white["gyro_x"]["N"].value
    end = N / np.sqrt(white.curve.cluster_time[-1]) / DEG * HOUR
    for factor, verdict in ((1.2, "pass"), (0.9, "undecided"), (0.01, "undecided")):
        found = one(white, f"{factor * end} deg/h", "in_run_bias_instability", reading="minimum")
        assert (found.verdict, found.estimate.detected, found.seconds) == (verdict, False, None)
        assert (found.probability[1], "falls" in found.reason) == (1.0, verdict == "undecided")
    both = bench.fit("small", "N + B")["gyro_y"]
    B, fit = both["B"].in_unit("deg/h"), bench.fit("small", "N + B")
    options = {"figure": "in_run_bias_instability", "reading": "minimum", "section": "gyro_y"}
    for limit, verdict in ((0.664 * 0.9 * B.interval[0], "fail"), (0.67 * B.value, "undecided")):
        assert one(fit, f"{limit} deg/h", **options).verdict == verdict


def test_what_is_not_detected_passes_by_its_limit_and_never_fails():
    """The square is normal about that of the value, and 95 % of it is below the limit."""
    fit = bench.fit("small", "N + B + K")
    c = fit["gyro_x"]["K"]
    assert not c.detected
    for factor, verdict in ((1.01, "pass"), (0.8, "undecided"), (1e-3, "undecided")):
        limit = factor * c.upper_limit
        found = one(fit, f"{limit / DEG * HOUR * 60.0:.17g} deg/h/√h", "rate_random_walk", section="gyro_x")
        z = 1.644854 * (limit**2 - c.value**2) / (c.upper_limit**2 - c.value**2)
        assert found.probability == pytest.approx([norm.cdf(z), 1.0], rel=1e-6)
        assert (found.verdict, np.isnan(found.ratio)) == (verdict, True)


def test_typical_values_are_reported_and_axes_replace_their_sensor(walk):
    limits = sheet("0.14 deg/√h", meaning="typical")
    limits |= {"gyro_y": {"noise_density": {"limit": "1 deg/s/√Hz", "sided": "two", "meaning": "maximum"}}}
    limits |= {"accel": {"meaning": "maximum", "random_walk": "1 m/s/√h"}, "name": "test"}
    found = aj.check_spec(walk, limits)
    x, y, accel = found.results
    assert [r.verdict for r in found.results] == ["typical", "pass", "undecided"]
    assert (x.axis, y.axis, y.limit.figure, accel.axis) == ("gyro_x", "gyro_y", "noise_density", "accel")
    assert x.ratio == pytest.approx(walk["gyro_x"]["N"].in_unit("deg/√h").value / 0.14)
    assert "no such axis" in accel.reason
    assert found.verdict == "undecided"
    del limits["accel"]
    assert aj.check_spec(walk, limits).verdict == "pass"
    assert "typ 0.140" in str(found)
    lost = without_result(walk, "gyro_x")
    moved = dataclasses.replace(lost.results[1], not_measured=("at rest",))
    lost = dataclasses.replace(lost, results=(lost.results[0], moved))
    reasons = {r.axis: r.reason for r in aj.check_spec(lost, limits).results}
    assert "hopeless" in reasons["gyro_x"]
    assert "not a measurement" in reasons["gyro_y"]


HOSTILE = [
    ("gyro: {random_walk: 0.1 deg/√h}", "random_walk needs meaning"),
    ("gyro: {meaning: minimum, random_walk: 0.1 deg/√h}", "'minimum'"),
    ("gyro: {meaning: maximum, vrw: 0.1 deg/√h}", "unknown key 'vrw'"),
    ("gyro: {meaning: maximum, random_walk: {limit: 0.1 deg/√h, side: one}}", "unknown key 'side'"),
    ("gyro: {meaning: maximum, random_walk: {sided: one}}", "needs limit"),
    ("gyro: {meaning: maximum, random_walk: 0.1}", "with its unit"), ("[" * 5000, "a YAML file"),
    ("gyro: {meaning: maximum, random_walk: [1, 2]}", "with its unit"),
    ("gyro: {meaning: maximum, random_walk: -1 deg/√h}", "positive"),
    ("gyro: {meaning: maximum, random_walk: .nan deg/√h}", "positive"),
    ("gyro: {meaning: maximum, random_walk: 1 deg/h}", "random_walk: cannot convert"),
    ("gyro: {meaning: maximum, quantization: 1 m/s}", "accelerometer"),
    ("gyro: {meaning: maximum, noise_density: 1 deg/s/√Hz}", "sided"),
    ("gyro: {meaning: maximum, in_run_bias_instability: 1 deg/h}", "reading"),
    ("gyro: {meaning: maximum, lsb: 1 deg/s}", "lsb is not a limit"),
    ("gyro: 5", "not a table"), ("gyros: {}", "unknown key 'gyros'"), ("- 1", "not a table"),
    ("name: x", "no limit"), ("gyro: {", "a YAML file"),
    ("gyro: !!python/object:os.system {}", "a YAML file"), ("\x00", "YAML"),
    ("gyro:\n  meaning: maximum\n  N: 1 deg/√h\n  N: 9 deg/√h", "N is given twice, again in line 4"),
    ("gyro: {? [N, B] : 1}", "unhashable key"),
]  # fmt: skip


def test_hostile_files_are_refused_by_file_key_and_remedy(white, tmp_path):
    path = tmp_path / "limits.yaml"
    for text, word in HOSTILE:
        path.write_text(text, encoding="utf-8")
        with pytest.raises(aj.AllanjaxError, match=word) as caught:
            aj.check_spec(white, path)
        assert str(path) in str(caught.value)
    refuses("No such file", aj.check_spec, white, tmp_path / "none.yaml")


def test_probabilities_at_the_truth_are_uniform():
    """Eight records of nine axes with N + K: of N, K and the least deviation; 72 values each."""
    rate, n, N = 50.0, 2048, 1e-4
    K = N * np.sqrt(3.0) / 2.0
    model = aj.AngleRandomWalk(N) + aj.RateRandomWalk(K)
    time = np.geomspace(0.02, 20.0, 1000)
    least = np.sqrt(np.asarray(model.sampled(rate).allan_variance(time)).min())
    limits = {"gyro": {"meaning": "maximum", "random_walk": walk_limit(N), "reading": "minimum"}}
    limits["gyro"]["rate_random_walk"] = f"{K / DEG * HOUR * 60.0:.17g} deg/h/√h"
    limits["gyro"]["in_run_bias_instability"] = f"{least / DEG * HOUR:.17g} deg/h"
    found = {}
    for seed in range(8):
        columns = [aj.simulate(model, n, rate, 100 * seed + k) for k in range(9)]
        names = [f"gyro_{k}" for k in range(9)]
        record = aj.Recording.from_array(np.stack(columns, axis=1), rate, names=names, gyro_unit="rad/s")
        for r in aj.check_spec(aj.fit(record, "N + K", as_is=True), limits).results:
            if r.verdict != "undecided" or r.estimate is not None:
                found.setdefault(r.limit.figure, []).append(r.probability[0])
    for figure, p in found.items():
        p = np.array(p)
        # Of a uniform law 0.5 ± 0.034, and 0.05 ± 0.026 beyond either threshold.
        assert len(p) > 65, figure
        assert abs(p.mean() - 0.5) < 0.1, (figure, p.mean())
        assert np.mean(p <= 0.05) < 0.13, (figure, np.mean(p <= 0.05))
        assert np.mean(p >= 0.95) < 0.13, (figure, np.mean(p >= 0.95))


def test_what_does_not_show_may_still_raise_the_least_deviation():
    """Records of 41 s with N, and B and K that few of them show: limits 10 % below the truth."""
    rate, n = 100.0, 4096
    model = aj.AngleRandomWalk(1e-4) + aj.BiasInstability(6e-5) + aj.RateRandomWalk(2e-5)
    time = np.geomspace(0.01, n / rate / 2.0, 2000)
    least = 0.9 * np.sqrt(np.asarray(model.sampled(rate).allan_variance(time)).min())
    limits = {"gyro": {"meaning": "maximum", "reading": "minimum"}}
    limits["gyro"]["in_run_bias_instability"] = f"{least / DEG * HOUR:.17g} deg/h"
    verdicts = []
    for seed in range(5):
        columns = [aj.simulate(model, n, rate, 50 * seed + k) for k in range(9)]
        names = [f"gyro_{k}" for k in range(9)]
        record = aj.Recording.from_array(np.stack(columns, axis=1), rate, names=names, gyro_unit="rad/s")
        verdicts += [r.verdict for r in aj.check_spec(aj.fit(record, as_is=True), limits).results]
    # Of 45, 2 are expected at the truth itself, and 5 or more in 7 % of such sets.
    assert verdicts.count("pass") < 5, verdicts


def test_it_is_written_for_people_and_for_continuous_integration(walk):
    limits = sheet("0.2 deg/√h", rate_random_walk="290 deg/h/√h") | {"name": "a <b> & c"}
    odd = dataclasses.replace(aj.check_spec(walk, limits), name="a\x01\udcff")
    assert "a??" in ElementTree.fromstring(odd.to_junit().encode()).find("testsuite").get("name")
    found = aj.check_spec(walk, limits)
    document = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    verdicts = {(r["axis"], r["figure"]): r["verdict"] for r in document["limits"]}
    assert document["verdict"] == found.verdict == "fail"
    assert verdicts["gyro_x", "random_walk"] == "pass"
    suite = ElementTree.fromstring(found.to_junit()).find("testsuite")
    assert suite.get("name") == "walk against a <b> & c"
    cases = {(c.get("classname"), c.get("name").partition(" (")[0].replace(" ", "_")): c for c in suite}
    marks = {"pass": None, "fail": "failure", "undecided": "skipped"}
    for key, verdict in verdicts.items():
        assert [child.tag for child in cases[key] if child.tag != "system-out"] == [marks[verdict]] * (
            verdict != "pass"
        )
    counts = [int(suite.get(key)) for key in ("tests", "failures", "skipped")]
    assert counts == [4, *([*verdicts.values()].count(v) for v in ("fail", "undecided"))]
    c = walk["gyro_y"]["N"].in_unit()
    (told,) = [r for r in document["limits"] if (r["axis"], r["figure"]) == ("gyro_y", "random_walk")]
    assert (told["limit"], told["estimate"]["value"]) == (pytest.approx(0.2), pytest.approx(c.value))


@pytest.mark.usefixtures("elsewhere")
def test_commands_end_with_the_code_of_the_verdict(tmp_path):
    fit, recording = bench.fit("white"), bench.recording("white")
    aj.write(recording, "imu.csv")
    aj.write_json(fit, "imu.json")
    c = fit["gyro_x"]["N"]
    for score, code in ((5.0, 0), (0.0, 3), (-5.0, 1)):
        limits = tmp_path / "limits.yaml"
        limits.write_text(
            f"gyro: {{meaning: maximum, random_walk: {walk_limit(c.value + score * c.std)}}}",
            encoding="utf-8",
        )
        done = run("spec", "imu.json", limits, "--out", "imu.xml", "--json")
        document = json.loads(done.stdout)
        assert (done.exit_code, document["specification"]) == (code, "limits")
        assert document["limits"][0]["verdict"] == {0: "pass", 3: "undecided", 1: "fail"}[code]
        assert ElementTree.parse("imu.xml").getroot().find("testsuite/testcase") is not None
    done = run("characterize", "imu.csv", "--spec", limits, "--out", "out")
    assert (done.exit_code, "fail, against limits" in done.stdout) == (1, True)
    assert int(ElementTree.parse("out/imu_spec.xml").getroot().get("failures")) == 1
    written = json.loads((tmp_path / "out/imu.json").read_text(encoding="utf-8"))
    schema("fit").validate(written)
    assert written["spec"]["verdict"] == "fail"
    assert aj.load("out/imu.json")["gyro_x"]["N"].value == pytest.approx(c.value, rel=1e-3)
    limits.write_text("gyro: {arw: 1}", encoding="utf-8")
    done = run("characterize", "imu.csv", "--spec", limits)
    assert (done.exit_code, "limits.yaml" in done.stderr) == (1, True)
