"""How long to record for N, B and K to be known well enough."""

import jax
import numpy as np
import pytest
import scipy.linalg

import allanjax as aj
from allanjax.base.errors import AllanjaxError
from allanjax.estimate.needed_length import TARGET, length_for, needed_lengths, relative_std
from allanjax.noise.notation import parse_model

RATE = 10.0
# Two sensors whose slow noise takes some thousand samples to be known to ± 20 %.
SENSORS = {"rate_random_walk": "N=0.2 deg/√h + K=30 deg/h/√h", "bias_instability": "N=0.2 deg/√h + B=4 deg/h"}


def exact_relative_std(N: float, K: float, n: int) -> tuple[float, float]:
    """Cramér–Rao bound for white noise and a random walk of unknown mean, from the samples' covariance.

    Means of a Brownian motion over cells of length h have the covariances h(min(i, j) + 1/2), and h(i + 1/3)
    on the diagonal, times K².
    """
    i = np.arange(n)
    walk = (np.minimum.outer(i, i) + 0.5 - np.eye(n) / 6.0) * K**2 / RATE
    white = N**2 * RATE * np.eye(n)
    A = scipy.linalg.null_space(np.ones((1, n))).T
    parts = [A @ (2.0 * part) @ A.T for part in (white, walk)]
    inverse = np.linalg.inv(sum(parts) / 2.0)
    whitened = [inverse @ part for part in parts]
    F = np.array([[0.5 * np.sum(a * b.T) for b in whitened] for a in whitened])
    return tuple(np.sqrt(np.diag(np.linalg.inv(F))))


@pytest.mark.parametrize("n", [50, 400])
@pytest.mark.parametrize("ratio", [0.1, 1.0])
def test_the_bound_is_that_of_the_samples_covariance(n: int, ratio: float) -> None:
    """Cosine levels of both terms are uncorrelated; the density at their frequencies is an approximation of
    theirs where cells are averaged, by 1/n at most."""
    model = aj.AngleRandomWalk(1.0) + aj.RateRandomWalk(ratio)
    bound = relative_std(model, n, RATE)
    expected = exact_relative_std(1.0, ratio, n)
    np.testing.assert_allclose([*bound.values()], expected, rtol=2.0 / n + 0.01)


def test_white_noise_alone_is_known_by_the_number_of_samples() -> None:
    bound = relative_std(aj.AngleRandomWalk(3e-4) + aj.DriftRamp(1e-9), 100_000, 100.0)
    # A ramp takes a level, the mean another.
    assert bound == pytest.approx({"angle_random_walk": 1.0 / np.sqrt(2.0 * 99_998)}, rel=1e-6)


def test_groups_of_levels_are_as_good_as_levels() -> None:
    """By shares w of the density: F_ab = 2 Σ w_a w_b over all levels one by one."""
    n, model = 30_000, parse_model("N=0.2 deg/√h + B=4 deg/h + K=30 deg/h/√h", "gyro")
    f = np.arange(1, n) * RATE / (2.0 * n)
    densities = [np.asarray(term.sampled(RATE).sampled_psd(f, RATE)) for term in model]
    shares = np.stack([density / sum(densities) for density in densities])
    expected = np.sqrt(np.diag(np.linalg.inv(2.0 * shares @ shares.T)))
    np.testing.assert_allclose([*relative_std(model, n, RATE).values()], expected, rtol=1e-3)


def test_held_parameters_and_orders_are_known() -> None:
    free = aj.AngleRandomWalk(1e-4) + aj.Markov(1e-6, 20.0)
    held = aj.AngleRandomWalk(1e-4) + aj.Markov(1e-6, 20.0).hold("correlation_time")
    one, other = (relative_std(model, 20_000, RATE) for model in (free, held))
    assert [*other] == ["angle_random_walk", "markov_amplitude"]
    assert other["markov_amplitude"] < one["markov_amplitude"]
    filtered = aj.Butterworth(2.0, order=4) * aj.AngleRandomWalk(1e-4)
    assert [*relative_std(filtered, 20_000, RATE)] == ["angle_random_walk", "butterworth_bandwidth"]


def test_lengths_that_cannot_be() -> None:
    tiny = parse_model("N=0.2 deg/√h + K=0.0001 deg/h/√h", "gyro")
    assert length_for(tiny, "rate_random_walk", RATE) is None
    with pytest.raises(AllanjaxError, match="no 'bias_instability' to be known; it has angle_random_walk"):
        length_for(tiny, "bias_instability", RATE)
    assert length_for(tiny, "angle_random_walk", RATE) == 64 / RATE


RECORDS = 64


@pytest.fixture(scope="module", params=SENSORS, ids=SENSORS.get)
def simulated(request: pytest.FixtureRequest) -> tuple[str, float, np.ndarray]:
    """A coefficient, its true value, and its estimates from records as long as is said to be needed."""
    label, model = request.param, parse_model(SENSORS[request.param], "gyro")
    n = round(length_for(model, label, RATE) * RATE)
    assert 500 < n < 20_000
    keys = jax.random.split(jax.random.key(5), RECORDS)
    values = np.stack([np.asarray(aj.simulate(model, n, RATE, key)) for key in keys], axis=1)
    curve = aj.allan_deviation(values, RATE, cluster_times=4)
    many = aj.fit_many(curve, aj.AngleRandomWalk() + type(model[label])())
    assert many.converged.all()
    return label, float(model.values[label]), many.value[:, 1]


def test_records_of_the_length_that_is_told_give_the_coefficient_to_20_percent(simulated) -> None:
    """The rms error of 64 records is itself known to 1/√128 = 9 %; three of these, and 10 % that the fit to
    Allan variances may lose to the bound."""
    _, true, found = simulated
    rms = np.sqrt(np.mean((found / true - 1.0) ** 2))
    assert TARGET * (1.0 - 0.27) < rms < TARGET * (1.1 + 0.27)


def test_lengths_of_a_fit(small_fit: aj.Fit) -> None:
    """Its standard deviations are those of the bound, to a few percent; limits need longer than values."""
    n, rate = small_fit.curve.n, small_fit.curve.rate
    by = {
        (r.axis.name, x.coefficient.label): x for r in small_fit.results for x in needed_lengths(r, n, rate)
    }
    assert len(by) == 3 * len(small_fit.results)
    flicker = by["gyro_x", "bias_instability"]
    bound = relative_std(small_fit["gyro_x"].model, n, rate)["bias_instability"]
    assert flicker.relative_std == pytest.approx(bound, rel=0.1)
    assert flicker.known
    assert flicker.seconds == n / rate
    walk = by["gyro_x", "rate_random_walk"]
    assert not walk.coefficient.detected
    assert np.isnan(walk.relative_std)
    c = walk.coefficient
    with_walk = small_fit["gyro_x"].model + aj.RateRandomWalk(c.upper_limit)
    at = relative_std(with_walk, round(walk.seconds * rate), rate)["rate_random_walk"]
    assert at == pytest.approx(TARGET, rel=5e-3)
    limit = f"below {c.in_unit().upper_limit:.0f} deg/h/√h (95 %)"
    assert str(walk).startswith(f"gyro_x not detected, {limit}: ± 20 % takes")


def test_an_axis_without_result_has_no_lengths(half_failed_fit: aj.Fit) -> None:
    assert needed_lengths(half_failed_fit.results[1], 20_000, 100.0) == ()
    moving = half_failed_fit.results[0].unmeasured(moving=True)
    lengths = needed_lengths(moving, 20_000, 100.0)
    assert {x.seconds for x in lengths} == {None}
    assert str(lengths[0]) == "gyro_x cannot be said: the fit is no measurement of this sensor"
