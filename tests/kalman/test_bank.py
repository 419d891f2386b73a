"""The adaptive bank: its weights by Bayes' rule written out, and records whose noise changes half-way."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import allanjax as aj

# Three models and one padded length: one program.
RATE, N = 10.0, 240
QUIETLY, LOUDLY, DRIFTINGLY = (1e-3, 1e-4), (4e-3, 1e-4), (1e-3, 1e-2)
MODELS = {
    name: aj.AngleRandomWalk(n) + aj.RateRandomWalk(k)
    for name, (n, k) in {"quiet": QUIETLY, "noisy": LOUDLY, "drifting": DRIFTINGLY}.items()
}
QUIET, NOISY, _ = MODELS.values()


def recording(*parts: tuple[float, float]) -> aj.Recording:
    """Record of parts of equal length, each of an N and a K; the walk goes on through all."""
    rng, each = np.random.default_rng(1), N // len(parts)
    white = np.concatenate([n * np.sqrt(RATE) * rng.standard_normal(each) for n, _ in parts])
    steps = np.concatenate([k / np.sqrt(RATE) * rng.standard_normal(each) for _, k in parts])
    return aj.Recording.from_array(0.01 + white + np.cumsum(steps), RATE, gyro_unit="rad/s", names=["gyro_x"])


def test_weights_are_bayes_rule():
    """Written out with probabilities, normalized at each sample; so are bias and its spread."""
    change, record = 0.02, recording(QUIETLY, LOUDLY)
    lost = np.arange(N) == 100
    bank = aj.adaptive_filter(record, MODELS, switching=change * RATE, missing=lost)
    found, frame = bank.results[0], bank.to_dataframe()
    assert found.labels == tuple(MODELS)
    for k, label in enumerate(MODELS):
        assert_array_equal(frame[f"weight_{label}"], found.weights[:, k])
        assert_array_equal(frame[f"probability_{label}"], found.probability[:, k])
    filters = [aj.kalman_filter(record, model, missing=lost).results[0] for model in MODELS.values()]
    density = [np.exp(-0.5 * f.standardized**2) / (np.sqrt(2.0 * np.pi) * f.innovation_std) for f in filters]
    density = np.where(np.isnan(density), 1.0, density).T
    transition = np.full((3, 3), change / 2.0) + (1.0 - 1.5 * change) * np.eye(3)
    weights, total = np.full(3, 1.0 / 3.0), 0.0
    for k in range(N):
        weights = transition @ weights * density[k]
        total += np.log(weights.sum())
        weights = weights / weights.sum()
        assert_allclose(found.weights[k], weights, rtol=1e-8)
        bias = weights @ [f.bias[k] for f in filters]
        assert found.bias[k] == pytest.approx(bias, rel=1e-9)
        if k:
            variance = weights @ [f.bias_std[k] ** 2 + (f.bias[k] - bias) ** 2 for f in filters]
            assert found.bias_std[k] == pytest.approx(np.sqrt(variance), rel=1e-6)
    assert found.log_likelihood == pytest.approx(total, rel=1e-9)
    later = np.ones(3)
    for k in range(N - 1, -1, -1):
        both = found.weights[k] * later
        assert_allclose(found.probability[k], both / both.sum(), rtol=1e-7)
        later = transition @ (density[k] * later)
        later = later / later.sum()
    low, high = found.bias_interval
    assert_allclose(high - low, 2.0 * 1.959964 * found.bias_std, rtol=1e-6)


@pytest.mark.parametrize(("second", "label"), [(LOUDLY, "noisy"), (DRIFTINGLY, "drifting")])
def test_a_change_half_way_is_found_and_dated(second, label):
    """N four times as large, K a hundred times: both show in a second or two."""
    found = aj.adaptive_filter(recording(QUIETLY, second), MODELS)["gyro_x"]
    assert [(c.before, c.after) for c in found.changes] == [("quiet", label)]
    assert found.changes[0].time == pytest.approx(12.0, abs=2.0)
    assert found.weights[110, 0] > 0.95
    assert found.weights[-1, found.labels.index(label)] > 0.9
    assert found.switching == 1e-3


def test_a_model_that_was_ruled_out_comes_back_only_if_it_may():
    record = recording(QUIETLY, LOUDLY, QUIETLY)
    can = aj.adaptive_filter(record, MODELS).results[0]
    assert [c.after for c in can.changes] == ["noisy", "quiet"]
    never = aj.adaptive_filter(record, MODELS, switching=0.0).results[0]
    assert never.changes == ()
    # Without a change the probability by all samples is the last weight.
    assert_allclose(never.probability, np.tile(never.weights[-1], (N, 1)), atol=1e-9)


REFUSED = [
    ([QUIET], {}, "two models"), ([QUIET, NOISY], {"switching": 5.0}, "change"),
    ([QUIET, NOISY], {"switching": -0.1}, "change"), ([QUIET, aj.AngleRandomWalk()], {}, "angle_random_walk"),
    ([QUIET, NOISY], {"missing": np.zeros(3, bool)}, "missing"),
    ([QUIET, NOISY], {"missing": np.ones(N, bool)}, "all samples are missing"),
]  # fmt: skip


def test_what_is_no_bank_is_said():
    for models, options, word in REFUSED:
        with pytest.raises(aj.AllanjaxError, match=word):
            aj.adaptive_filter(recording(QUIETLY), models, **options)
