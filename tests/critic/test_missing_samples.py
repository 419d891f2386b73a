"""Records with missing samples: causes look at what was measured, and what was drawn is no finding."""

import dataclasses

import numpy as np
import pytest
from critic_views import view_of

import allanjax as aj
from allanjax.critic.causes.disturbance import Disturbance
from allanjax.critic.causes.outliers import Outliers
from allanjax.critic.causes.repeated_samples import RepeatedSamples
from allanjax.critic.causes.rounding import Rounding
from allanjax.critic.causes.saturation import Saturation
from allanjax.critic.comparison import StageResiduals
from allanjax.critic.discrepancies import discrepancies
from allanjax.estimate.check import check

N = 4096


def white(seed=1):
    return np.random.default_rng(seed).standard_normal(N)


def lost():
    """A tenth of the samples: singly, and two gaps of a hundred."""
    missing = np.random.default_rng(2).random(N) < 0.05
    missing[1000:1100] = missing[3000:3100] = True
    return missing


def filled(x, missing):
    """View of a record whose missing samples have been drawn given the others, as a reader draws them."""
    gone = np.where(missing, np.nan, x)[:, None]
    recording = aj.Recording.from_array(gone, 50.0, gyro_unit="rad/s", names=["gyro_x"], gaps="fill")
    view = view_of(recording.values[:, 0])
    return dataclasses.replace(view, imputed=missing, drawn=missing), recording


def test_a_step_of_the_output_is_found_though_drawn_samples_are_none_of_its_multiples():
    view, recording = filled(np.round(white()), lost())
    found = Rounding().detect(view)
    assert found is not None
    (step,) = found.estimates
    assert step.value == pytest.approx(1.0)
    # Drawn samples are what they were.
    assert np.array_equal(found.after.samples[view.drawn], view.samples[view.drawn])
    # Without knowing which were drawn there is no step.
    assert Rounding().detect(dataclasses.replace(view, drawn=None)) is None
    assert "1 rad/s" in check(recording)["resolution"].reason


def test_saturation_is_that_of_measured_samples():
    view, recording = filled(np.clip(white(), -1.5, 1.5), lost())
    assert view.raw[view.drawn].max() > 1.5
    found = Saturation().detect(view)
    assert found is not None
    levels = {e.label: e.value for e in found.estimates}
    assert levels["upper_level"] == 1.5
    assert levels["lower_level"] == -1.5
    # Of those that the record has, but for the drawn: 13 % are beyond 1.5 standard deviations.
    assert np.mean(abs(view.raw) == 1.5) == pytest.approx(levels["fraction"])
    assert check(recording)["saturation"].verdict == "stop"


def test_the_share_of_repeated_samples_is_of_the_measured_ones():
    x, missing = white(), lost()
    held = np.flatnonzero(np.random.default_rng(3).random(N) < 0.02)[1:]
    x[held] = x[held - 1]
    view, _ = filled(x, missing)
    found = RepeatedSamples().detect(view)
    assert found is not None
    both = ~missing[1:] & ~missing[:-1]
    inside = (x[1:] < x[~missing].max()) & (x[1:] > x[~missing].min())
    share = {e.label: e.value for e in found.estimates}["fraction"]
    assert share == pytest.approx(np.sum((np.diff(x) == 0.0) & both & inside) / np.sum(~missing))


SHAPES = {Outliers(): np.eye(1, 100, 50)[0], Disturbance(): np.sin(np.arange(100) / 5.0)}


@pytest.mark.parametrize("cause", SHAPES, ids=repr)
def test_nothing_is_looked_for_in_what_was_drawn(cause):
    """What is a finding where it was measured is none where it was drawn, by a wrong spectrum, say."""
    x, missing = white(), np.zeros(N, bool)
    missing[1000:1100] = True
    x[missing] += 30.0 * SHAPES[cause]
    view = view_of(x)
    assert cause.detect(view) is not None
    assert cause.detect(dataclasses.replace(view, imputed=missing, drawn=missing)) is None


def test_samples_that_were_drawn_are_not_among_those_that_are_counted():
    x, missing = np.round(white()), lost()
    view, _ = filled(x, missing)
    record = StageResiduals(view.axis, 1.0, view.rate, _snapshot(view))
    by_name = {d.statistic: d for d in discrepancies(record, view.recorded(view.raw))}
    assert by_name["lattice"].measured == 1.0
    # Two standard normal numbers are rounded alike with the probability 0.27, as simulated; 0.012 is 1.6 of
    # its standard errors.
    repeated = by_name["repeated_values"]
    assert repeated.measured == pytest.approx(repeated.simulated, abs=0.025)


def _snapshot(view):
    from allanjax.critic.criticize import _snapshot as of

    return of(view)


def test_parameters_are_as_uncertain_as_what_is_left_of_the_record():
    view, _ = filled(white(), lost())
    share = view.drawn.mean()
    wide = np.sqrt(1.0 / (1.0 - share) + share)
    assert view.estimate("size", 1.0, 0.1, "1").std == pytest.approx(0.1 * wide)
    assert view.time_estimate("time", 2000.0, 10.0).std == pytest.approx(0.2 * wide)
    assert view.log_estimate("scale", 0.0, 0.1, "", "1").std == pytest.approx(0.1 * wide)


def test_a_critique_of_a_filled_record_finds_what_there_is_and_no_more():
    """A tenth of the samples lost from white noise with one outlier of twelve standard deviations."""
    x = 1e-3 * white(5)
    x[2000] = 0.012
    missing = lost()
    missing[2000] = False
    values = np.where(missing, np.nan, x)[:, None]
    recording = aj.Recording.from_array(values, 50.0, gyro_unit="rad/s", names=["gyro_x"], gaps="fill")
    found = aj.critique(recording)
    assert [f.cause for f in found.findings] == ["outliers"]
    (time,) = found.findings[0].details["times"]
    assert time.value == pytest.approx(40.0)


def test_coefficients_of_what_is_left_are_as_uncertain_as_those_of_a_record_with_lost_samples():
    _, recording = filled(white(), lost())
    critique = aj.critique(recording)
    wider = critique.fit["gyro_x"].widening
    # √(1/(1 − f) + f) for a tenth that is lost.
    f = lost().mean()
    assert wider == pytest.approx(np.sqrt(1.0 / (1.0 - f) + f))
    assert critique.refit()["gyro_x"].widening == wider
    complete = aj.fit(
        np.asarray(recording.values), rate=50.0, gyro_unit="rad/s", names=["gyro_x"], as_is=True
    )
    std = [fit["gyro_x"].coefficients["angle_random_walk"].std for fit in (critique.refit(), complete)]
    assert std[0] == pytest.approx(wider * std[1])
