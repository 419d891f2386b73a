"""Estimates, intervals and limits over 120 records each with a clear walk, one at the edge, and none.

Rates are compared within four binomial standard errors, means and scatters within four of theirs: of so many
comparisons one fails by chance once in 300 sets of seeds. What 120 records cannot see is in the studies.
"""

from types import SimpleNamespace

import bench
import numpy as np
import pytest
from white_and_walk import bound, records

import allanjax as aj

RECORDS = 120
MODEL = aj.AngleRandomWalk() + aj.RateRandomWalk()
#: K of each kind, beside N = 1; at the edge half of the walks are detected.
WALKS = {"clear": 5.0, "edge": 1.0, "absent": 0.0}
OBJECTIVES = ("allan", "whittle", "wavelet")
# Of an efficient estimate the scatter is Cramér and Rao's; the Allan variances lose a tenth of it at most,
# those at octaves another twentieth.
LOSS = {"allan": 1.1, "whittle": 1.03, "wavelet": 1.15}
FIELDS = ("value", "std", "interval", "interval_68", "upper_limit", "detected", "variation")


def ensemble(kind):
    return records(1.0, WALKS[kind], RECORDS, seed=1 + list(WALKS).index(kind))


def columns(kind, objective):
    """Estimates of N and of K of all records, and the fits' p-values, each as an array."""

    def make():
        # Of so many axes at once, one that looks touched by chance would cut them all.
        fit = aj.fit(ensemble(kind), MODEL, objective, as_is=True, vibrating=True)
        assert fit.converged
        p = np.array([r.p_value for r in fit.results])
        own = [[r[label] for r in fit.results] for label in MODEL.term_labels]
        arrays = [{f: np.array([getattr(c, f) for c in all_]) for f in FIELDS} for all_ in own]
        return [SimpleNamespace(**of, p_value=p) for of in arrays]

    return bench.once(f"ensemble {kind} {objective}", make)


def spare(expected):
    return 4.0 * np.sqrt(expected * (1.0 - expected) / RECORDS)


def rate_is(hits, expected):
    return abs(np.mean(hits) - expected) < spare(expected)


def inside(ends, truth):
    return (ends[:, 0] <= truth) & (truth <= ends[:, 1])


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_of_a_clear_walk_bias_scatter_and_coverage_are_as_they_say(objective):
    for c, truth, best in zip(columns("clear", objective), (1.0, 5.0), bound(1.0, 5.0), strict=True):
        error = c.value - truth
        # K is known to a tenth: its estimate is skew by as much, which is a tenth of its deviation.
        assert abs(error.mean()) < best * (0.1 + 4.0 / np.sqrt(RECORDS))
        assert error.std() < LOSS[objective] * best * (1.0 + 4.0 / np.sqrt(2.0 * RECORDS))
        assert error.std() > best * (1.0 - 4.0 / np.sqrt(2.0 * RECORDS))
        # Standard deviations follow the estimate of K, so that only their mean is that of the bound.
        assert best * 0.97 < c.std.mean() < best * LOSS[objective] * 1.02
        assert rate_is(inside(c.interval, truth), 0.95)
        assert rate_is(inside(c.interval_68, truth), 0.68)
        assert rate_is(c.upper_limit >= truth, 0.95)
        assert c.detected.all()


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_at_the_edge_of_detection_intervals_and_limits_cover(objective):
    """One-sided coverage may exceed its level where zero is never excluded, and must not fall below."""
    white, walk = columns("edge", objective)
    assert 0.1 < walk.detected.mean() < 0.9
    assert np.mean(walk.upper_limit >= 1.0) > 0.95 - spare(0.95)
    assert np.mean(inside(walk.interval, 1.0)) > 0.95 - spare(0.95)
    assert np.mean(inside(walk.interval_68, 1.0)) > 0.68 - spare(0.68)
    assert rate_is(inside(white.interval, 1.0), 0.95)
    # And the limits say something: three times as much is excluded in nearly all.
    assert np.mean(walk.upper_limit < 3.0) > 0.9
    np.testing.assert_array_equal(walk.detected, walk.interval[:, 0] > 0.0)


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_what_is_absent_is_found_as_seldom_as_intervals_say_and_limited_by_its_information(objective):
    white, walk = columns("absent", objective)
    # One interval of forty excludes zero from above.
    assert walk.detected.mean() < 0.025 + spare(0.025)
    assert 0.3 < np.mean(walk.value == 0.0) < 0.75
    # Half of the limits are below the walk that is seen in half of the records.
    assert np.median(walk.upper_limit) < 1.2
    assert (walk.upper_limit > walk.value).all()
    assert rate_is(inside(white.interval, 1.0), 0.95)
    # A right model is rejected as often as its p-value says.
    assert rate_is(white.p_value < 0.25, 0.25)


@pytest.mark.parametrize("kind", ["clear", "absent"])
def test_a_fit_of_many_is_that_of_each(kind):
    """To rounding, which the iteration's last steps may amplify; only samples show how a term varies."""
    many = aj.fit_many(aj.allan_deviation(ensemble(kind), cluster_times=4), MODEL)
    assert (many.converged & many.measured).all()
    found = columns(kind, "allan")
    for k, c in enumerate(found):
        # Variation is found by chance in one record of a hundred.
        still = np.array([v is None or v.error == 0.0 for v in c.variation])
        assert still.mean() > 0.95
        for name in ("value", "std", "upper_limit", "detected"):
            pair = getattr(many, name)[still, k], getattr(c, name)[still]
            np.testing.assert_allclose(*pair, rtol=1e-5, atol=1e-9)
        ends = np.stack([many.lower[:, k], many.upper[:, k]], axis=1)
        np.testing.assert_allclose(ends[still], c.interval[still], rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("K", [0.0, 1.0])
def test_five_terms_have_finite_limits_that_cover(K):
    """Whatever their neighbours explain: none is below the truth more often than 5 % of 60 records allow."""
    fit = aj.fit(records(1.0, K, 60, seed=31), "Q + N + B + K + R", as_is=True, vibrating=True)
    truth = {"angle_random_walk": 1.0, "rate_random_walk": K}
    for label in fit.template.term_labels:
        found = [r[label] for r in fit.results]
        ends = np.array([[c.upper_limit, *c.interval, *c.interval_68] for c in found])
        assert np.isfinite(ends).all()
        assert np.sum(ends[:, 0] >= truth.get(label, 0.0)) >= 57.0 - 4.0 * np.sqrt(57.0 * 0.05), label
    # The record's own slope is known to N·√(12/T³) beside white noise; with three more terms that look
    # alike, to some three times that, and a limit is two or three of them.
    slope = np.sqrt(12.0 / 20.48**3)
    ramps = [r["drift_ramp"].upper_limit for r in fit.results]
    assert np.median(ramps) < (12.0 if K == 0.0 else 25.0) * slope
    assert np.max(ramps) < 60.0 * slope
