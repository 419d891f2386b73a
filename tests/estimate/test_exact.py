"""Fits by the exact likelihood, beside a maximum of the dense Gaussian likelihood found by scipy."""

import dataclasses

import numpy as np
import pytest
from scipy.optimize import minimize

import allanjax as aj

RATE, N, WHITE, WALK = 10.0, 300, 1e-3, 4e-4


@pytest.fixture(scope="module")
def record():
    model = aj.AngleRandomWalk(WHITE) + aj.RateRandomWalk(WALK)
    return aj.simulate_recording({"gyro_x": model}, N, RATE, 8, bias={"gyro_x": 0.02})


@pytest.fixture(scope="module")
def fit(record):
    return aj.fit(record, "N + K", "exact", as_is=True)


def minus_log_likelihood(logs, z, there):
    """Dense, of the differences of the samples that are there: white noise and means of a walk."""
    n, h = len(z), 1.0 / RATE
    white, walk = np.exp(2.0 * np.asarray(logs))
    k = np.arange(n, dtype=float)
    means = walk * h * (np.minimum(k[:, None], k) + 0.5 + np.where(k[:, None] == k, -1.0 / 6.0, 0.0))
    C = white / h * np.eye(n) + means
    D = np.diff(np.eye(n)[there], axis=0)
    C, d = D @ C @ D.T, D @ z
    return 0.5 * np.linalg.slogdet(C)[1] + 0.5 * d @ np.linalg.solve(C, d)


def test_the_maximum_is_that_of_the_dense_likelihood(record, fit):
    """To the step at which the climb ends: a gain of 10⁻⁵ nats is 0.5 % of a standard deviation."""
    z = record.values[:, 0]
    best = minimize(minus_log_likelihood, np.log([WHITE, WALK]), (z, np.ones(N, bool)), method="Nelder-Mead")
    for name, expected in zip(("N", "K"), np.exp(best.x), strict=True):
        c = fit["gyro_x"][name]
        assert c.value == pytest.approx(expected, abs=0.01 * c.std)


def test_intervals_are_where_the_likelihood_ratio_has_fallen(record, fit):
    """By the profile of the dense likelihood; the fit's goes along a line, through few hypotheses."""
    z, there = record.values[:, 0], np.ones(N, bool)
    c = fit["gyro_x"]["K"]
    N_hat = np.log(fit["gyro_x"]["N"].value)
    least = minus_log_likelihood([N_hat, np.log(c.value)], z, there)
    for end in c.interval:
        profile = minimize(
            lambda n, end=end: minus_log_likelihood([n[0], np.log(end)], z, there),
            [N_hat],
            method="Nelder-Mead",
        ).fun
        assert np.sqrt(2.0 * (profile - least)) == pytest.approx(1.96, abs=0.2)


def test_missing_samples_are_left_out(record):
    lost = np.zeros(N, bool)
    lost[100:160] = True
    spoilt = np.where(lost, record.values[:, 0].mean(), record.values[:, 0])
    holey = dataclasses.replace(record, values=spoilt[:, None], missing=lost[:, None])
    found = aj.fit(holey, "N + K", "exact", as_is=True)["gyro_x"]
    best = minimize(minus_log_likelihood, np.log([WHITE, WALK]), (spoilt, ~lost), method="Nelder-Mead")
    assert found["N"].value == pytest.approx(np.exp(best.x[0]), abs=0.01 * found["N"].std)


@pytest.mark.parametrize(
    ("model", "n", "message"),
    [
        (None, N, "chooses no terms"),
        ("N + R", N, "drift_ramp is none"),
        ("N + power_law", N, "hold it"),
        ("N", 100_001, "up to 100,000 samples"),
    ],
)
def test_what_it_is_not_for_is_said_with_a_remedy(model, n, message):
    z = np.random.default_rng(1).standard_normal(n)
    with pytest.raises(aj.FitError, match=message):
        aj.fit(z, model, "exact", rate=RATE, gyro_unit="rad/s", as_is=True)
