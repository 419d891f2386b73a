"""Days that repeat: statistics of values, and joint fits of recordings of known scatter."""

import itertools
import json

import numpy as np
import pytest
from commands import run
from golden_records import GYRO, MIDDLE, Record, crossing, labelled, sensor
from refusals import refuses
from scipy import integrate, stats

import allanjax as aj

# Hou (2004), tables 5.1 and 5.3 (quantization of seven days) with the STD printed there, and the error of the
# first day in tables 5.2 and 5.4 [arcsec].
CIMU = {
    "x": ([0.9732, 0.9601, 0.9193, 0.9472, 0.9577, 0.9589, 0.9450], 0.0170, 0.0738),
    "y": ([0.5174, 0.5357, 0.5059, 0.4982, 0.4992, 0.5065, 0.5068], 0.0129, 0.0197),
    "z": ([0.5770, 0.6023, 0.5745, 0.5693, 0.5592, 0.5624, 0.5785], 0.0141, 0.0155),
}
HG1700 = {
    "x": ([5.1154, 5.1117, 5.1113, 5.1239, 5.0312, 5.1051, 5.0487], 0.0366, 0.0683),
    "y": ([1.2742, 1.2842, 1.2801, 1.3065, 1.2864, 1.3054, 1.2954], 0.0124, 0.0032),
    "z": ([1.2316, 1.2025, 1.2227, 1.2256, 1.2193, 1.2065, 1.2226], 0.0104, 0.0028),
}


@pytest.mark.parametrize("table", [CIMU, HG1700])
@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_the_thesis_s_days_have_the_std_that_it_prints(table, axis):
    days, std, error = table[axis]
    found = aj.random_effects(days, error)
    # The table cuts the digits after the fourth decimal off.
    assert np.floor(1e4 * found.sample_std) / 1e4 == pytest.approx(std)
    # "The standard deviation is smaller than the estimation error": so of the CIMU. The errors of the
    # HG1700's y and z axes do not explain theirs.
    repeats = table is CIMU or axis == "x"
    assert (found.p_value > 0.05) is repeats
    assert ("the values repeat" in found.verdict) is repeats
    assert (found.scatter_interval[0] > 0.0) is not repeats
    # Values without errors: the textbook's intervals of a mean and of a standard deviation.
    alone = aj.random_effects(days)
    np.testing.assert_allclose(
        alone.interval, stats.t.interval(0.95, 6, np.mean(days), stats.sem(days)), 1e-9
    )
    ends = np.std(days, ddof=1) * np.sqrt(6.0 / stats.chi2.ppf([0.975, 0.025], 6))
    np.testing.assert_allclose(alone.scatter_interval, ends, rtol=1e-6)
    assert np.isnan(alone.p_value)
    assert alone.scatter == pytest.approx(alone.sample_std, rel=1e-9)


def test_values_with_equal_errors_have_the_classic_statistics():
    rng = np.random.default_rng(0)
    x, s = 3.0 + rng.standard_normal(8), 0.5
    found = aj.random_effects(x, s, list("abcdefgh"))
    Q = np.sum((x - x.mean()) ** 2) / s**2
    assert found.p_value == pytest.approx(stats.chi2.sf(Q, 7), rel=1e-9)
    assert found.common == pytest.approx(x.mean())
    assert found.scatter == pytest.approx(np.sqrt(x.var(ddof=1) - s**2), rel=1e-9)
    # The upper end is where a lower Q is 40 times less probable than without scatter.
    squares = np.sum((x - x.mean()) ** 2) / stats.chi2.ppf([0.975, 0.025 * stats.chi2.cdf(Q, 7)], 7)
    ends = np.sqrt(np.maximum(squares - s**2, 0.0))
    np.testing.assert_allclose(found.scatter_interval, ends, rtol=1e-9)
    # The variance of a value is Q's over a χ² variate, but not below that of the errors; see Iyer et al.
    # (2004). The integral over that variate is accurate to 1e-6.
    reach = found.interval[1] - x.mean()

    def beyond(p):
        return stats.norm.sf(reach * np.sqrt(8.0) / s / np.sqrt(max(Q / stats.chi2.ppf(p, 7), 1.0)))

    missed = integrate.quad(beyond, 0.0, 1.0, points=[stats.chi2.cdf(Q, 7)])[0]
    assert missed == pytest.approx(0.025, rel=1e-5)
    assert x.mean() - found.interval[0] == pytest.approx(reach, rel=1e-9)
    # The odd one by the two-sample t-test of one value against the others, corrected for eight; the variance
    # of the others is not below that of the errors.
    chances = []
    for k, y in enumerate(x):
        others = np.delete(x, k)
        scale = np.sqrt(max(others.var(ddof=1), s**2) * (1.0 + 1.0 / 7.0))
        chances.append(2.0 * stats.t.sf(abs(y - others.mean()) / scale, 6))
    assert found.odd_p_value == pytest.approx(min(8.0 * min(chances), 1.0), rel=1e-6)
    assert aj.random_effects([*x, 30.0], s, list("abcdefghi")).odd_one == "i"


# τ², the common value and its standard error, by combine_effects(values, errors**2, method_re="iterated",
# rtol=1e-14, tau2_start=1e-3) of statsmodels 0.15.0.
STATSMODELS = [
    (HG1700["y"][0], [0.0032] * 7, (0.00014511476190476148, 1.290314285714286, 0.00471100174219517)),
    (
        [2.4296, 2.4203, 2.5567, 2.235, 2.193],
        [0.034, 0.034, 0.036, 0.017, 0.043],
        (0.021348100230827977, 2.3666674783000605, 0.06706124493012305),
    ),
    ([18.43, 14.2], [1.9, 1.1], (6.536450000000002, 16.031312056737587, 2.0958879146670855)),
    # Values that lie closer than their errors: the error is that of the weighted mean.
    ([18.43, 18.42, 18.5], [1.9, 1.91, 1.0], (0.0, 18.4733613716759, 0.8029283581323784)),
]


@pytest.mark.parametrize(("values", "errors", "known"), STATSMODELS)
def test_common_value_and_scatter_are_those_of_statsmodels(values, errors, known):
    found = aj.random_effects(values, errors)
    np.testing.assert_allclose([found.scatter**2, found.common, found.std], known, rtol=1e-9)


def test_values_that_happen_to_lie_close_are_not_more_certain_than_their_errors():
    """Two days of 18.43 ± 1.90 and 18.42 ± 1.91: the mean has the error of a mean of two such values."""
    found = aj.random_effects([18.43, 18.42], [1.90, 1.91])
    assert found.std == pytest.approx(1.905 / np.sqrt(2.0), rel=1e-3)
    low, high = found.interval
    assert (high - low) / 2.0 == pytest.approx(1.96 * found.std, rel=0.02)
    # Any scatter of at least that of the errors leads to such values in more than 5 % of cases.
    assert found.scatter_limit > 1.91
    size, (low, high) = found.difference
    assert size == pytest.approx(-0.01)
    assert (low, high) == pytest.approx((-0.01 - 1.96 * np.hypot(1.90, 1.91), -0.01 + 1.96 * 2.694), rel=1e-3)
    assert "difference" in str(found)
    # Equal values, too, allow as much.
    assert aj.random_effects([5.0] * 4, 1.0).scatter_limit > 1.0


@pytest.mark.parametrize("k", [2, 3, 4, 10])
def test_intervals_cover_where_values_happen_to_lie_close(k):
    """Of 400 sets without scatter those with the lower half of Q; 0.92 is 2 standard errors below 0.95."""
    x = np.random.default_rng(k).standard_normal((400, k))
    q = x.var(axis=1)
    close = [aj.random_effects(row, 1.0).interval for row in x[q < np.median(q)]]
    assert np.mean([low < 0.0 < high for low, high in close]) >= 0.92


@pytest.mark.parametrize(("k", "tau"), [(3, 0.0), (3, 1.0), (10, 0.3), (10, 2.0)])
def test_intervals_cover_common_value_and_scatter(k, tau):
    """In 400 sets of values the shares scatter by 0.011: 0.03 off is improbable in twelve shares."""
    rng = np.random.default_rng([k, int(10 * tau)])
    s, hits = np.geomspace(0.7, 1.4, k), []
    for _ in range(400):
        found = aj.random_effects(tau * rng.standard_normal(k) + s * rng.standard_normal(k), s)
        low, high = found.scatter_interval
        hits.append(
            (found.interval[0] < 0.0 < found.interval[1], low <= tau <= high, found.odd_p_value < 0.05)
        )
    common, scatter, odd = np.mean(hits, axis=0)
    # Where there is no scatter to be seen, intervals are as long as the errors allow, and cover more.
    assert 0.92 < common < (0.98 if tau else 1.0)
    assert scatter > 0.92
    assert odd < 0.08


def test_skewed_errors_are_allowed_for():
    """Means of gamma variates: of ten, Student's interval covers 89 %, as it is short where they are low."""
    rng, q = np.random.default_rng(3), 0.8
    hits = []
    for _ in range(120):
        x = rng.gamma(q**-2, q**2, 10)
        low, high = aj.random_effects(x, np.full(10, q * x.mean()), skewness=2.0 * q).interval
        hits.append(low < 1.0 < high)
    assert np.mean(hits) > 0.92


def day(seed, name, scale=1.0, n=MIDDLE, **c):
    c = {letter: scale * x for letter, x in c.items()}
    rng = np.random.default_rng(seed)
    return Record(sensor(rng, n, **c)[:, None], ("gyro_x",), {"gyro_x": labelled(**c)}, name=name).recording()


@pytest.fixture(scope="module")
def days():
    """Days with a scatter of 15 % in all coefficients."""
    rng, c = np.random.default_rng(1), crossing(GYRO, B=1.0)
    return [day(k, f"day {k}", np.exp(0.15 * rng.standard_normal()), **c) for k in range(1, 7)]


def test_a_joint_fit_gives_common_value_and_scatter(days):
    joint, c = aj.joint_fit(days, "N + B", as_is=True), crossing(GYRO, B=1.0)
    axis = joint["gyro_x"]
    assert set(axis.coefficients) == set(labelled(**c))
    for label, true in labelled(**c).items():
        found = axis[label]
        assert found.common.interval[0] < true < found.common.interval[1]
        assert found.scatter.interval[0] < 0.15 * true < found.scatter.interval[1]
        assert list(found.records) == list(joint.names) == [d.name for d in days]
        # Each recording's value is that of its own fit by the same terms.
        alone = [aj.fit_many([d], "N + B", cluster_times=4) for d in days[:2]]
        k = alone[0].coefficients.index(label)
        values = [found.records[d.name].value for d in days[:2]]
        np.testing.assert_allclose(values, [of.value[0, k] for of in alone], rtol=2e-3)
        std = np.std([x.value for x in found.records.values()], ddof=1)
        assert found.sample_std == pytest.approx(std)
    assert axis["N"].scatter.detected
    assert axis["N"].effects.p_value < 1e-6
    # Numbers are as in the data frame, in usual units, and the document is JSON.
    frame = joint.to_dataframe()
    row = frame[(frame["recording"] == "common") & (frame["coefficient"] == "angle_random_walk")].iloc[0]
    assert row["value"] == pytest.approx(axis["N"].common.in_unit("deg/√h").value)
    assert row["scatter_value"] == pytest.approx(axis["N"].scatter.in_unit("deg/√h").value)
    json.dumps(joint.to_dict(), allow_nan=False)
    text = str(joint)
    assert all(word in text for word in ("day 6", "common", "scatter", "STD", "odd one", "deg/√h"))


def test_a_term_that_no_recording_shows_is_found_by_all_together():
    """K that no single one of ten recordings detects beside N."""
    c = crossing(GYRO, K=35.0)
    fits = [aj.fit(day(2100 + k, f"{k}", **c)) for k in range(10)]
    alone = [f["gyro_x"]["K"].detected for f in fits]
    axis = (joint := aj.joint_fit(fits))["gyro_x"]
    assert not any(alone)
    K = axis["K"].common
    assert K.interval[0] < labelled(**c)["rate_random_walk"] < K.interval[1]
    # A Bayes factor above 1000 over N alone. B alone has nearly as much, a ramp of one slope far less.
    assert axis.found_jointly["rate_random_walk"] > np.log(1000.0)
    longer = [aj.fit(day(2110 + k, f"longer {k}", n=MIDDLE + 500, **c)) for k in range(4)]
    assert aj.joint_fit([*fits, *longer])["gyro_x"].found_jointly.keys() == axis.found_jointly.keys()
    assert list(axis.coefficients) == ["angle_random_walk", "rate_random_walk"]
    assert axis.rivals == {"rate_random_walk": ("bias_instability",)}
    assert "rate random walk: all recordings together show it, none of them alone" in str(joint)
    without = aj.joint_fit([aj.fit(day(200 + k, f"{k}", N=GYRO)) for k in range(4)])["gyro_x"]
    assert list(without.coefficients) == ["angle_random_walk"]
    assert not without.found_jointly


def test_the_command_takes_recordings_and_results_and_names_the_odd_one(days, tmp_path):
    # Four equal days of N, and one of twice that.
    paths = [tmp_path / f"d{k}.csv" for k in range(5)]
    for k, path in enumerate(paths):
        aj.write(day(300 + k, "", 2.0 if k == 4 else 1.0, N=GYRO), path)
    aj.write_json(aj.fit(aj.read(paths[0]), "N"), saved := tmp_path / "saved.json")
    done = run("repeat", saved, *paths[1:], "--terms", "N", "--out", tmp_path / "out")
    assert done.exit_code == 0, done.stderr
    assert "d4, p" in done.stdout
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"repeat.json", "repeat.csv", "repeat.png"}
    document = json.loads(run("repeat", saved, *paths[1:], "--terms", "N", "--json").stdout)
    assert document == json.loads((tmp_path / "out" / "repeat.json").read_text())
    (axis,) = document["axes"]
    assert document["names"] == ["saved", "d1", "d2", "d3", "d4"]
    assert axis["coefficients"]["angle_random_walk"]["effects"]["odd"] == "d4"
    assert run("repeat", paths[0]).exit_code == 1


def test_the_figure_has_a_panel_for_each_coefficient(days):
    figure = aj.joint_fit(days[:3], "N + B").plot()
    labels = [panel.get_xlabel().partition(" [")[0] for panel in figure.axes]
    assert labels == ["angle random walk", "bias instability"]
    lines = figure.axes[0].get_yticklabels()
    assert [line.get_text() for line in lines] == ["day 1", "day 2", "day 3", "common"]


def test_the_figure_is_as_wide_as_the_values_and_wider_intervals_end_in_arrows():
    """Two days of N that differ by half, each known to 0.3 %: the common value's interval is far wider."""
    fits = [
        aj.fit(day(40 + k, f"day {k}", scale, N=GYRO), "N", plain=True) for k, scale in ((1, 1.0), (2, 1.5))
    ]
    joint = aj.joint_fit(fits, "N")
    common = joint["gyro_x"]["N"].common.in_unit()
    values = [f["gyro_x"]["N"].in_unit().value for f in fits]
    (panel,) = joint.plot().axes
    low, high = panel.get_xlim()
    assert common.interval[0] < low < min(values)
    assert max(values) < high < common.interval[1]
    # Not wider than three times what the values span.
    assert high - low < 3.0 * (max(values) - min(values))
    arrows = {line.get_marker(): float(line.get_xdata()[0]) for line in panel.get_lines()}
    assert (arrows["<"], arrows[">"]) == (low, high)
    panel.figure.canvas.draw()
    shown = [tick for tick in panel.get_xticklabels() if low <= tick.get_position()[0] <= high]
    boxes = sorted((tick.get_window_extent().x0, tick.get_window_extent().x1) for tick in shown)
    assert 2 <= len(boxes) <= 5
    assert all(end < start for (_, end), (start, _) in itertools.pairwise(boxes))


def test_what_cannot_be_compared_is_refused(days):
    refuses("at least two", aj.random_effects, [1.0])
    refuses("positive", aj.random_effects, [1.0, 2.0], [1.0, 0.0])
    refuses("names", aj.random_effects, [1.0, 2.0], None, ["a"])
    refuses("at least two recordings", aj.joint_fit, days[:1], "N")
    refuses("names", aj.joint_fit, days[:2], "N", names=["a"])
    refuses("model=", aj.joint_fit, [aj.fit(d, "N + B") for d in days[:2]])
    refuses("no common coefficient", aj.joint_fit(days[:2], "N + B")["gyro_x"].__getitem__, "K")


def test_equal_values_without_errors_have_a_common_value_and_no_scatter():
    found = aj.random_effects([2.0, 2.0, 2.0])
    assert (found.common, found.scatter) == (pytest.approx(2.0), pytest.approx(0.0, abs=1e-6))
