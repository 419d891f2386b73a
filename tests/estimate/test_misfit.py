"""How far a fitted curve is off, and what is said of coefficients that are no measurement."""

import copy
import dataclasses
import json
import pickle
from importlib.resources import files

import jsonschema
import numpy as np
import pandas as pd
import pytest
from scipy.signal import lfilter
from scipy.stats import chi2, norm

import allanjax as aj
from allanjax.estimate.as_json import to_dict
from allanjax.estimate.axis_fits import fit_allan, result_of
from allanjax.estimate.coefficients import _within
from allanjax.estimate.deterministic import AxisSpectrum
from allanjax.estimate.misfit import LIMIT, OCTAVE, deviation, misfit_of, spectral_misfit
from allanjax.estimate.whittle import fit_spectrum
from allanjax.fleet.table import mark_outlying, rows_of, table_of
from allanjax.noise.estimate import Estimate
from allanjax.noise.terms import basic_terms
from allanjax.record.recording import Axis, Recording
from allanjax.report.files import write_coefficients_csv, write_json, write_results
from allanjax.spectrum.cosine import Bins, cosine_transform

RATE, N, FEWER, WHITE = 100.0, 60_000, 20_000, 1e-3
AXIS = Axis("gyro_x", "gyro", "rad/s")
TERMS = aj.AngleRandomWalk() + aj.RateRandomWalk()
ACTIVE = np.ones((1, 2), bool)


def noise(seed, n):
    """Angle random walk of 1e-3 rad/√s and rate random walk of 1e-5 rad/s/√s."""
    rng = np.random.default_rng(seed)
    white, walk = rng.normal(size=(2, n))
    return WHITE * np.sqrt(RATE) * white + 1e-5 / np.sqrt(RATE) * np.cumsum(walk)


def hump(octaves, height):
    """One plus a raised cosine, an octave wide at half its height."""
    return 1.0 + height * np.where(abs(octaves) < 1.0, 0.5 + 0.5 * np.cos(np.pi * octaves), 0.0)


def by_allan(height, place=0.08):
    """The fit of Allan deviations with a hump at 0.08 s."""
    curve = aj.allan_deviation(noise(1, FEWER)[:, None], RATE, cluster_times=4)
    off = hump(np.log2(curve.cluster_time / place), height)
    curve = dataclasses.replace(curve, deviation=curve.deviation * off[:, None])
    return fit_allan(curve, [AXIS], TERMS, ACTIVE)[0][0]


def by_spectrum(height, place=20.0):
    """The fit of a spectrum whose root has a hump at 20 Hz."""
    x = noise(1, N)
    c = cosine_transform(x - x.mean())
    c = c * hump(np.log2(np.arange(1, N) * RATE / (2.0 * N) / place), height)
    spectrum = AxisSpectrum.of(Bins.of(N, RATE), c, [], {})
    return result_of(fit_spectrum(TERMS.sampled(RATE), AXIS, spectrum, ACTIVE[0]), TERMS, AXIS, ACTIVE[0])


def test_a_hump_of_ten_per_cent_is_said_to_be_one():
    """The fit gives way to the hump by some two per cent."""
    found = by_allan(0.1), by_spectrum(0.1)
    for result, place, unit in zip(found, (0.08, 20.0), ("s", "Hz"), strict=True):
        assert result.measured
        assert 0.07 < result.misfit.largest < 0.12
        assert abs(np.log2(result.misfit.at / place)) < 0.35
        assert result.misfit.unit == unit
    # The mean square of a raised cosine of a tenth, two octaves long, over the octaves that there are.
    known = [0.1 * np.sqrt(0.75 / np.log2(octaves)) for octaves in (FEWER / 2, N)]
    for result, rms in zip(found, known, strict=True):
        # Some is bent away; and three standard deviations of scatter, up to 3.6 %, are taken off in squares.
        assert 0.5 * rms < result.misfit.rms < 1.15 * rms
        assert 0.6 * rms < result.discrepancy < 1.15 * rms
    assert found[0].discrepancy == pytest.approx(found[1].discrepancy, rel=0.3)
    off = 100.0 * found[0].misfit.largest
    assert (
        f"; model incomplete: its Allan deviation is off by up to {off:.2g} % at 0.08" in found[0].verdict()
    )
    assert f"; model incomplete: its root PSD is off by up to {100 * found[1].misfit.largest:.2g} % at" in (
        found[1].verdict()
    )
    # Without the hump the errors are less than half of those with it.
    for bad, good in zip(found, (by_allan(0.0), by_spectrum(0.0)), strict=True):
        assert (good.discrepancy, good.misfit) == (0.0, None)
        assert bad["angle_random_walk"].std > 2.0 * good["angle_random_walk"].std


def test_the_deviation_is_that_of_a_search_through_all_places():
    """Each place by itself: how far the model is outside the estimate's 99.7 % interval."""
    rng = np.random.default_rng(3)
    place = np.geomspace(0.01, 100.0, 40)
    edf = np.geomspace(1e4, 1.2, 40)
    # By chance alone, but for a stretch in the middle that is off, and one at the end that might be.
    ratio = np.sqrt(rng.chisquare(edf) / edf)
    ratio[10:14] *= [1.2, 1.9, 0.4, 1.1]
    ratio[-1] = 0.2
    sizes, certain = [], []
    for r, k in zip(ratio, edf, strict=True):
        lower, upper = (r * np.sqrt(k / chi2.ppf(p, k)) for p in (0.9985, 0.0015))
        surely = np.log(lower) if lower > 1.0 else -np.log(upper) if upper < 1.0 else 0.0
        certain.append(surely)
        half = abs(np.log(r)) - surely
        sizes.append(np.log(r) ** 2 - half**2 if surely > 0.0 else 0.0)
    found = misfit_of(place, ratio, edf, "s")
    worst = int(np.argmax(certain))
    assert worst == 12
    assert found.at == place[worst]
    assert found.largest == pytest.approx(ratio[worst] - 1.0)
    assert found.rms == pytest.approx(np.expm1(np.sqrt(np.mean(sizes))))
    assert found.sustained == pytest.approx(np.expm1(max(certain)))
    assert np.log1p(found.scatter) == pytest.approx(abs(np.log(ratio[worst])) - max(certain))
    # Of an estimate that may be off by a factor 3 by chance, that is said.
    rare = misfit_of(place[-8:], np.full(8, 4.0), np.full(8, 3.0), "s")
    assert " (by chance up to a factor " in str(rare)
    assert "by chance" not in str(found)
    # What scatter explains counts for nothing, however far it is.
    alone = misfit_of(place[-8:], np.full(8, 0.2), np.full(8, 1.2), "s")
    assert (alone.largest, alone.rms, alone.excessive) == (0.0, 0.0, False)
    assert str(alone) == "its Allan deviation is off, nowhere by more than single estimates scatter"


def test_levels_are_compared_in_thirds_of_octaves_and_over_octaves():
    """A line is a deviation of its third of an octave only; a band of two octaves is one of both."""
    frequency = np.arange(1.0, 4096.0)
    dof = np.ones(4095)
    level = np.random.default_rng(4).chisquare(1.0, 4095)
    third = np.floor(3.0 * np.log2(frequency)).astype(int)
    line, band = level.copy(), level.copy()
    line[third == 30] *= 9.0
    band[(third >= 27) & (third < 33)] *= 9.0
    for levels in (line, band):
        found = spectral_misfit(frequency, levels, np.ones(4095), dof)
        k = int(np.argmin(abs(found.at - frequency)))
        own = third == third[k]
        assert found.largest == pytest.approx(np.sqrt(levels[own].mean()) - 1.0)
        assert found.at == pytest.approx(np.exp(np.log(frequency[own]).mean()))
    alone, wide = (spectral_misfit(frequency, x, np.ones(4095), dof) for x in (line, band))
    assert alone.sustained < 0.05
    # Three, less what 500 levels of one degree of freedom scatter at most.
    assert 1.5 < wide.sustained < 2.0
    assert not alone.excessive
    assert wide.excessive


SAID = {
    0.468: "47 %",
    -0.3: "30 %",
    0.017: "1.7 %",
    0.6: "a factor 1.6",
    17.0: "a factor 18",
    -0.95: "a factor 20",
    -0.995: "a factor 200",
    2999.0: "a factor 3,000",
}


@pytest.mark.parametrize(("relative", "said"), SAID.items())
def test_small_deviations_are_told_in_per_cent_and_large_ones_as_factors(relative, said):
    assert deviation(relative) == said


# --- What is no measurement ---------------------------------------------------------------------------------


# Four axes and the basic terms, for which programs are compiled by other tests.
BASIC = basic_terms()


@pytest.fixture(scope="module")
def recording():
    """Handled for two seconds; under a line of thrice the noise; at rest; with a small line."""
    x = np.stack([noise(seed, FEWER) for seed in (5, 6, 7, 7)], axis=1)
    x[:200, 0] += np.cumsum(np.random.default_rng(8).normal(size=200)) * 0.02
    t = np.arange(FEWER) / RATE
    x[:, 1] += 3.0 * WHITE * np.sqrt(RATE) * np.sin(2.0 * np.pi * 3.0 * t)
    x[:, 3] += 0.4 * WHITE * np.sqrt(RATE) * np.sin(2.0 * np.pi * 5.0 * t)
    names = ["gyro_x", "gyro_y", "gyro_z", "gyro"]
    return Recording.from_array(x, RATE, gyro_unit="rad/s", names=names, name="bench")


@pytest.fixture(scope="module")
def fit(recording):
    return aj.fit(recording, BASIC, as_is=True, vibrating=True)


@pytest.mark.parametrize("objective", ["allan", "whittle"])
def test_a_curve_that_is_far_off_is_no_measurement(recording, fit, objective):
    found = fit if objective == "allan" else aj.fit(recording, BASIC, "whittle", as_is=True, vibrating=True)
    assert [result.measured for result in found.values()] == [False, False, True, True]
    assert found["gyro_z"].misfit is None
    N = found["gyro_z"]["angle_random_walk"]
    assert N.interval[0] < WHITE < N.interval[1]
    for axis in ("gyro_x", "gyro_y"):
        result = found[axis]
        assert max(result.misfit.rms / LIMIT, result.misfit.sustained / OCTAVE) > 1.0
        assert result.verdict().startswith(
            "not a measurement of this sensor: the model does not follow the data"
        )
        assert str(result.misfit) in result.verdict()
        assert np.isnan(result.covariance).all()
        for c in result.coefficients.values():
            assert np.isnan([c.std, *c.interval, *c.interval_68]).all()
            assert (c.detected, c.upper_limit, c.measured) == (False, None, False)
            assert "±" not in str(c)
            assert "not a measurement of this sensor (fitted: " in str(c)
            assert "not a measurement of this sensor" in c.in_unit().describe()
    assert "±" not in "".join(line for line in str(found).splitlines() if "gyro_x" in line)
    assert found.warnings[-1].startswith("gyro_x, gyro_y: not a measurement of this sensor")
    for word in ("allanjax critique FILE", "--start and --stop", "--terms"):
        assert word in found.warnings[-1]


def test_the_largest_deviation_is_the_one_in_the_picture(fit):
    """Compared with the curve and the model themselves."""
    result, curve = fit["gyro_x"], fit.curve
    k = list(curve.cluster_time).index(result.misfit.at)
    model = fit.model_deviation("gyro_x", result.misfit.at)
    assert curve.deviation[k, 0] / model - 1.0 == pytest.approx(result.misfit.largest, rel=1e-6)
    # A walk of two seconds under a model of one of 200 s: by far.
    assert "off by up to a factor" in result.verdict()


def test_what_was_held_stays_as_it_was_given(fit):
    result = fit["gyro_z"]
    found = dataclasses.replace(result["angle_random_walk"], value=WHITE, interval=(WHITE, WHITE), held=True)
    held = found.unmeasured()
    assert (held.value, held.held, held.measured, held.interval) == (WHITE, True, True, (WHITE, WHITE))
    assert held.describe().endswith("(held)")


def test_files_and_tables_have_no_errors_of_what_is_no_measurement(fit, recording, tmp_path):
    document = to_dict(fit)
    schema = json.loads(files("allanjax.report").joinpath("fit.schema.json").read_text(encoding="utf-8"))
    jsonschema.validate(document, schema)
    json.dumps(document, allow_nan=False)
    axis, _, good, _ = document["axes"]
    misfit = fit["gyro_x"].misfit
    assert axis["misfit"] == {
        "of": "Allan deviation",
        "largest_deviation": misfit.largest,
        "at": misfit.at,
        "at_unit": "s",
        "rms_deviation": misfit.rms,
        "octave_deviation": misfit.sustained,
        "scatter": misfit.scatter,
    }
    assert (axis["measured"], good["measured"], good["misfit"]) == (False, True, None)
    for c in axis["coefficients"]:
        assert (c["measured"], c["std"], c["interval_95"], c["si"]["upper_limit_95"]) == (
            False,
            None,
            [None, None],
            None,
        )
    assert axis["covariance"]["values"] == [[None] * 5] * 5
    write_coefficients_csv(fit, tmp_path / "c.csv")
    table = pd.read_csv(tmp_path / "c.csv")
    own = table[table["axis"] == "gyro_x"]
    assert own[["std", "lower_95", "upper_95", "upper_limit_95"]].isna().all(axis=None)
    assert not own["measured"].any()
    assert not own["detected"].any()
    assert own["reason"].str.contains("not a measurement of this sensor: .* its Allan deviation is off").all()
    assert table[table["axis"] == "gyro_z"]["measured"].all()
    write_json(fit, tmp_path / "fit.json")
    loaded = aj.load(tmp_path / "fit.json")
    assert [result.measured for result in loaded.results] == [False, False, True, True]
    assert loaded["gyro_x"].misfit == misfit
    assert str(loaded["gyro_x"]["angle_random_walk"]) == str(fit["gyro_x"]["angle_random_walk"])
    assert str(loaded) == str(fit)
    assert fit.to_dataframe()["measured"].tolist() == [False] * 10 + [True] * 10
    assert fit.to_dataframe()["std"].isna().tolist() == [True] * 10 + [False] * 10
    assert all(path.exists() for path in write_results(fit, aj.power_spectrum(recording), tmp_path, "x"))


def test_fits_compare_and_pickle(fit):
    c = fit["gyro_x"]["angle_random_walk"]
    assert pickle.loads(pickle.dumps(c)).value == copy.copy(c).value == c.value
    assert pickle.loads(pickle.dumps(fit["gyro_x"].misfit)) == fit["gyro_x"].misfit


def test_a_fleet_marks_no_unit_by_what_is_no_measurement(fit):
    """Eleven units of one kind and one that was handled: its values are no outlier, they are none."""
    document = to_dict(fit)
    good = document["axes"][2]
    rows = []
    for k in range(11):
        like = copy.deepcopy(good) | {"name": "gyro_x"}
        for c in like["coefficients"]:
            for name in ("value", "std", "upper_limit_95"):
                c[name] = None if c[name] is None else c[name] * (1.0 + 0.01 * k)
            c["interval_95"] = [None if x is None else x * (1.0 + 0.01 * k) for x in c["interval_95"]]
        rows += rows_of(document | {"axes": [like]}, f"unit{k}", f"{k}.csv")
    rows += rows_of(document | {"axes": document["axes"][:1]}, "handled", "handled.csv")
    table = mark_outlying(table_of(rows))
    assert not table["outlying"].any()
    handled = table[table["recording"] == "handled"]
    assert not handled["measured"].any()
    assert handled["std"].isna().all()
    assert table["measured"].sum() == 11 * 5


def test_there_is_no_posterior_of_what_is_no_measurement(fit):
    with pytest.raises(aj.FitError, match=r"gyro_x: no posterior, not a measurement .* the data, its Allan"):
        aj.sample(fit, progress=False)


def test_noise_is_not_told_as_deviation(fit):
    """A small line makes the model incomplete; beyond its octaves long clusters scatter by far more."""
    result, curve = fit["gyro"], fit.curve
    assert result.discrepancy > 0.0
    ratio = curve.deviation[:, 3] / fit.model_deviation("gyro", curve.cluster_time)
    assert abs(np.log(ratio)).max() > 1.5 * abs(np.log1p(result.misfit.largest))
    # Half a period of 5 Hz, within half an octave.
    assert abs(np.log2(result.misfit.at / 0.1)) <= 0.5
    assert result.misfit.rms < 0.5 * np.expm1(np.sqrt(np.mean(np.log(ratio) ** 2)))


# --- Shapes beyond what a record can show -------------------------------------------------------------------


def process(time):
    """A Markov process with this correlation time over white noise, and its fit."""
    step = np.exp(-1.0 / (RATE * time))
    drive = np.random.default_rng(30).standard_normal(2 * FEWER)
    markov = lfilter([np.sqrt(1.0 - step**2)], [1.0, -step], drive)[FEWER:]
    x = noise(31, FEWER) + WHITE * np.sqrt(RATE) * np.sqrt(max(time, 1.0)) * markov
    found = aj.fit(
        Recording.from_array(x[:, None], RATE, gyro_unit="rad/s", names=["gyro_x"]),
        aj.AngleRandomWalk() + aj.Markov(),
        as_is=True,
        vibrating=True,
    )
    return found, found["gyro_x"]["markov_correlation_time"]


def test_a_correlation_time_beyond_the_record_is_above_a_limit():
    """200 s are a hundredth of it: what is seen is a random walk, of any longer time as well."""
    fit, time = process(20_000.0)
    assert fit["gyro_x"].measured
    assert np.isnan(time.std)
    assert time.upper_limit is None
    assert 1.0 < time.lower_limit < 20_000.0
    assert time.interval[1] == np.inf
    assert time.describe().startswith("above ")
    assert time.describe().endswith(" s (95 %)")
    assert "±" not in str(time)
    document = to_dict(fit)
    jsonschema.validate(
        document, json.loads(files("allanjax.report").joinpath("fit.schema.json").read_text(encoding="utf-8"))
    )
    (told,) = (c for c in document["axes"][0]["coefficients"] if c["label"] == "markov_correlation_time")
    assert (told["std"], told["lower_limit_95"], told["interval_95"][1]) == (None, time.lower_limit, None)


def test_a_correlation_time_within_the_record_has_an_error():
    _, time = process(2.0)
    assert (time.lower_limit, time.upper_limit) == (None, None)
    assert time.interval[0] < 2.0 < time.interval[1]
    assert "±" in time.describe()


EXPONENT = aj.PowerLaw().parameters()[1]


@pytest.mark.parametrize(
    ("parameter", "value", "std", "limit"),
    [
        (aj.Markov().parameters()[1], 30.0, 3.0, ""),
        (aj.Markov().parameters()[1], 30.0, 40.0, "above"),
        (aj.Markov().parameters()[1], 0.05, 0.06, "below"),
        (aj.LowPass().parameters()[1], 48.0, 3.0, "above"),
        (aj.LowPass().parameters()[1], 20.0, 3.0, ""),
        (EXPONENT, 2.96, 0.001, "above"),
        (EXPONENT, -0.96, 0.001, "below"),
        (EXPONENT, 1.2, 0.1, ""),
        (aj.Markov().parameters()[1], 1.0, 20.0, "neither"),
    ],
)
def test_shapes_whose_intervals_leave_what_a_record_can_show_have_limits(parameter, value, std, limit):
    """20,000 samples at 100 Hz: times from 0.02 to 200 s, frequencies from 0.005 to 50 Hz."""
    distance = value - parameter.lower
    ratio = np.exp(1.96 * std / distance)
    c = Estimate(
        label="x",
        term="x",
        parameter=parameter,
        axis=AXIS,
        value=value,
        std=std,
        interval=(
            parameter.lower + distance / ratio,
            min(parameter.lower + distance * ratio, parameter.upper),
        ),
        interval_68=(value - std, value + std),
        upper_limit=None,
        detected=True,
    )
    found = _within(c, parameter, FEWER, RATE)
    if not limit:
        assert found is c
        return
    assert np.isnan(found.std)
    one_sided = np.exp(norm.ppf(0.95) * std / distance)
    if limit == "above":
        assert found.lower_limit == pytest.approx(parameter.lower + distance / one_sided)
    if limit == "below":
        assert found.upper_limit == pytest.approx(parameter.lower + distance * one_sided)
    assert found.describe().startswith("not determined by these data" if limit == "neither" else f"{limit} ")
