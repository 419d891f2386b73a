"""A fit that was written to a file comes back as it was."""

import dataclasses
import json
import math
from importlib.resources import files

import jax.numpy as jnp
import jsonschema
import numpy as np
import pytest

import allanjax as aj
from allanjax.estimate.axis_fits import with_misfit
from allanjax.estimate.misfit import Misfit
from allanjax.posterior.likelihood import likelihood_of
from allanjax.record.recording import DeadAxis

SCHEMA = json.loads(files("allanjax.report").joinpath("fit.schema.json").read_text(encoding="utf-8"))


def reloaded(fit, tmp_path, **options):
    path = tmp_path / "fit.json"
    aj.write_json(fit, path)
    jsonschema.validate(json.loads(path.read_text(encoding="utf-8")), SCHEMA)
    return aj.load(path, **options)


def drawn(figure):
    """All texts and all coordinates of a picture."""
    lines = [np.asarray(line.get_xydata()) for axes in figure.axes for line in axes.get_lines()]
    return [t.get_text() for axes in figure.axes for t in axes.texts], lines


@pytest.fixture(scope="module")
def whittle(small_recording):
    """A fit of the spectrum with a held time, an infinite cutoff, and a regressor."""
    t = small_recording.time
    recording = dataclasses.replace(small_recording["gyro_x"], auxiliary={"temperature": np.sin(t / 9.0)})
    model = aj.AngleRandomWalk() + aj.BiasInstability() + aj.Markov().hold(correlation_time=3.0)
    return aj.fit(recording, model, "whittle", regressors=["temperature"])


def test_the_order_of_a_filter_is_kept(small_recording, tmp_path):
    model = aj.AngleRandomWalk() + aj.LowPass(bandwidth=2.0, order=2)
    fit = aj.fit(small_recording["gyro_x"], model, "whittle", as_is=True)
    again = reloaded(fit, tmp_path)
    assert again.template == fit.template
    assert again["gyro_x"].model["low_pass"].order == 2


def off(fit, sustained):
    """The fit, had its second axis's curve been off by so much, and a third axis been dead."""
    first, second, *others = fit.results
    misfit = Misfit(largest=0.41, at=3.0, unit="s", rms=0.21, sustained=sustained)
    second = with_misfit(dataclasses.replace(second, discrepancy=0.1), misfit)
    dead = (DeadAxis.of(aj.Axis("accel_x", "accel", "g"), 0.0),)
    seen = {"warnings": ("it was moved", "the unit is wrong"), "stretch": (1.5, 198.0)}
    return dataclasses.replace(fit, results=(first, second, *others), dead=dead, **seen)


@pytest.mark.parametrize("kind", ["chosen", "half_failed", "whittle", "off", "far_off"])
def test_it_says_and_holds_the_same(kind, small_fit, half_failed_fit, whittle, tmp_path):
    fit = {
        "chosen": small_fit,
        "half_failed": half_failed_fit,
        "whittle": whittle,
        "off": off(small_fit, 0.2),
        "far_off": off(small_fit, 0.9),
    }[kind]
    for result in fit.results:
        assert repr(result).count("not a measurement") == (kind == "far_off" and result.axis.name == "gyro_y")
    assert [result.measured for result in fit.values()].count(False) == (kind in ("half_failed", "far_off"))
    again = reloaded(fit, tmp_path)
    assert aj.to_dict(again) == aj.to_dict(fit)
    assert str(again) == str(fit)
    assert again.curve == fit.curve
    assert again.template == fit.template
    assert (again.dead, again.warnings, again.stretch) == (fit.dead, fit.warnings, fit.stretch)
    for result, other in zip(fit.results, again.results, strict=True):
        assert other.verdict() == result.verdict()
        assert repr(other) == repr(result)
        if result.converged:
            assert other.model == result.model
            assert other.coefficients == result.coefficients
            assert other.regression == result.regression
            assert other.misfit == result.misfit
            np.testing.assert_array_equal(other.covariance, result.covariance)


def test_coefficients_are_in_the_units_asked_for(small_fit, tmp_path):
    again = reloaded(small_fit, tmp_path)
    c, other = (fit["gyro_x"]["angle_random_walk"].in_unit("deg/h/√Hz") for fit in (small_fit, again))
    assert (other.value, other.interval, other.unit) == (c.value, c.interval, "deg/h/√Hz")
    assert (
        again["gyro_x"]["angle_random_walk"].in_unit() == small_fit["gyro_x"]["angle_random_walk"].in_unit()
    )


def test_it_draws_the_same(small_fit, tmp_path):
    again = reloaded(small_fit, tmp_path)
    texts, lines = drawn(small_fit.plot())
    other_texts, other_lines = drawn(again.plot())
    assert other_texts == texts
    assert len(other_lines) == len(lines) > 20
    for line, other in zip(lines, other_lines, strict=True):
        np.testing.assert_array_equal(other, line)


def test_the_ranking_keeps_what_is_probable_and_what_there_was_to_choose_from(small_fit, tmp_path):
    again = reloaded(small_fit, tmp_path)
    for axis, other in zip(small_fit.selection.results, again.selection.results, strict=True):
        assert other.chosen.terms == axis.chosen.terms
        assert [s.terms for s in other.indistinguishable] == [s.terms for s in axis.indistinguishable]
        assert other.ambiguities() == axis.ambiguities()
        # What is left out are at most 64 sets of a probability below 1e-6 each.
        assert other.inclusion == pytest.approx(axis.inclusion, abs=64e-6)
        assert len(other.ranking) < len(axis.ranking)


def test_its_posterior_is_that_of_the_fit(small_fit, whittle, tmp_path):
    again = reloaded(small_fit, tmp_path)
    values = jnp.array([c.value + c.upper_limit / 9.0 for c in small_fit["gyro_x"].coefficients.values()])
    expected = likelihood_of(small_fit, "gyro_x")(values)
    assert np.isfinite(expected)
    assert likelihood_of(again, "gyro_x")(values) == expected
    with pytest.raises(aj.FitError, match="spectrum that was fitted is not in the file"):
        aj.sample(reloaded(whittle, tmp_path))


def test_what_is_not_finite_comes_back(small_fit, tmp_path):
    nan, inf = math.nan, math.inf
    first, *others = small_fit.results
    changed = dict(first.coefficients)
    for label, numbers in {
        "quantization": {"interval": (0.0, inf), "interval_68": (0.0, inf), "upper_limit": inf},
        "drift_ramp": {"std": nan, "interval": (nan, nan), "interval_68": (nan, nan)},
    }.items():
        changed[label] = dataclasses.replace(changed[label], **numbers)
    covariance = first.covariance.copy()
    covariance[0, :] = nan
    first = dataclasses.replace(first, _coefficients=changed, _covariance=covariance, chi2=nan)
    fit = dataclasses.replace(small_fit, results=(first, *others))
    again = reloaded(fit, tmp_path)
    assert again["gyro_x"].coefficients == changed
    np.testing.assert_array_equal(again["gyro_x"].covariance, covariance)
    assert math.isnan(again["gyro_x"].chi2)
    assert aj.to_dict(again) == aj.to_dict(fit)


class Half(aj.NoiseTerm):
    coefficient: float | None = aj.parameter("H", time_exponent=0.25)

    def phase_covariance(self, lag):
        return -(self.coefficient**2) * lag**1.5 / 2


def test_a_term_of_ones_own_is_asked_for(small_recording, tmp_path):
    fit = aj.fit(small_recording["gyro_x"], aj.AngleRandomWalk() + Half())
    with pytest.raises(aj.AllanjaxError, match=r"fit.json: its term 'half' .* terms=\[…\]"):
        reloaded(fit, tmp_path)
    again = reloaded(fit, tmp_path, terms=[Half])
    assert aj.to_dict(again) == aj.to_dict(fit)
    assert again["gyro_x"]["half"] == fit["gyro_x"]["half"]


def test_the_files_of_other_commands(small_fit, half_failed_fit, tmp_path):
    bundle = {
        "schema_version": 1,
        "fits": [{"file": f, **aj.to_dict(x)} for f, x in (("a.csv", small_fit), ("b.csv", half_failed_fit))],
        "errors": [],
    }
    path = tmp_path / "fits.json"
    path.write_text(json.dumps(bundle), encoding="utf-8")
    fits = aj.load(path)
    assert list(fits) == ["a.csv", "b.csv"]
    assert [fit.converged for fit in fits.values()] == [True, False]
    path.write_text(json.dumps({"key": {}, "fit": aj.to_dict(small_fit)}), encoding="utf-8")
    assert str(aj.load(path)) == str(small_fit)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.pop("curve"), "without its curve; characterize the recording again"),
        (lambda d: d.update(schema_version=2), "of schema version 2, this allanjax reads 1; load it with"),
        (
            lambda d: d.pop("axes"),
            "not a fit that allanjax wrote; such a file comes from",
        ),
        (lambda d: d["axes"][0]["coefficients"][0].pop("si"), "or damaged: KeyError('si')"),
        (lambda d: d["curve"]["deviation"].pop("gyro_y"), "or damaged"),
    ],
)
def test_what_is_no_fit_is_refused(change, message, small_fit, tmp_path):
    document = aj.to_dict(small_fit)
    change(document)
    path = tmp_path / "fit.json"
    path.write_text(json.dumps(document), encoding="utf-8")
    with pytest.raises(aj.AllanjaxError) as raised:
        aj.load(path)
    assert str(raised.value).startswith(f"{path}: ")
    assert message in str(raised.value)


@pytest.mark.parametrize("text", ["{", "[1, 2]", "3", '{"rows": []}', ""])
def test_files_of_something_else_are_refused(text, tmp_path):
    path = tmp_path / "x.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(aj.AllanjaxError, match=r"x\.json: not a"):
        aj.load(path)
    with pytest.raises(aj.AllanjaxError, match="no such file; check the path"):
        aj.load(tmp_path / "y.json")
