"""The adaptive bank: its weights by Bayes' rule written out, and records whose noise changes half-way."""

import numpy as np
import pytest

import allanjax as aj

RATE = 10.0
QUIET = aj.AngleRandomWalk(1e-3) + aj.RateRandomWalk(1e-4)
NOISY = aj.AngleRandomWalk(3e-3) + aj.RateRandomWalk(1e-4)
DRIFTING = aj.AngleRandomWalk(1e-3) + aj.RateRandomWalk(1e-3)


def recording(*parts: aj.Model, n: int = 2500) -> aj.Recording:
    """Record whose noise changes: the second part goes on where the first ended."""
    z = np.zeros(0)
    for k, model in enumerate(parts):
        new = np.asarray(aj.simulate(model, n, RATE, 20 + k))
        z = np.concatenate([z, new + (z[-50:].mean() if len(z) else 0.01)])
    return aj.Recording.from_array(z, RATE, gyro_unit="rad/s", names=["gyro_x"])


def test_weights_are_bayes_rule():
    """Written out with probabilities themselves, which 40 samples do not let vanish."""
    record, change = recording(QUIET, n=40), 0.02
    found = aj.adaptive_filter(record, [QUIET, NOISY, DRIFTING], switching=change * RATE).results[0]
    filters = [aj.kalman_filter(record, model).results[0] for model in (QUIET, NOISY, DRIFTING)]
    density = np.stack(
        [np.exp(-0.5 * f.standardized**2) / (np.sqrt(2.0 * np.pi) * f.innovation_std) for f in filters],
        axis=1,
    )
    density[0] = 1.0
    transition = np.full((3, 3), change / 2.0) + (1.0 - 1.5 * change) * np.eye(3)
    weights, total = np.full(3, 1.0 / 3.0), 0.0
    for k in range(40):
        weights = transition @ weights * density[k]
        total += np.log(weights.sum())
        weights = weights / weights.sum()
        np.testing.assert_allclose(found.weights[k], weights, rtol=1e-9)
        bias = weights @ [f.bias[k] for f in filters]
        assert found.bias[k] == pytest.approx(bias, rel=1e-9)
        if k:
            variance = weights @ [f.bias_std[k] ** 2 + (f.bias[k] - bias) ** 2 for f in filters]
            assert found.bias_std[k] == pytest.approx(np.sqrt(variance), rel=1e-6)
    assert found.log_likelihood == pytest.approx(total, rel=1e-9)
    later = np.ones(3)
    for k in range(39, -1, -1):
        both = found.weights[k] * later
        np.testing.assert_allclose(found.probability[k], both / both.sum(), rtol=1e-7)
        later = transition @ (density[k] * later)


@pytest.mark.parametrize(("second", "label", "within"), [(NOISY, "noisy", 5.0), (DRIFTING, "drifting", 40.0)])
def test_a_change_half_way_is_found_and_dated(second, label, within):
    """N three times as large shows in a few seconds; a tenfold K only after N/K, some ten seconds or more."""
    record = recording(QUIET, second)
    models = {"quiet": QUIET, "noisy": NOISY, "drifting": DRIFTING}
    found = aj.adaptive_filter(record, models)["gyro_x"]
    assert [(c.before, c.after) for c in found.changes] == [("quiet", label)]
    assert found.changes[0].time == pytest.approx(250.0, abs=within)
    place = found.labels.index(label)
    assert found.weights[-1, place] > 0.95
    assert found.weights[2400, 0] > 0.95
    blended = np.asarray(aj.kalman_filter(record, second).results[0].bias)
    # Others keep a weight of a few per cent.
    assert np.abs(found.bias[-200:] - blended[-200:]).max() < 0.25 * found.bias_std[-200:].max()


def test_a_model_that_was_ruled_out_comes_back_only_if_it_may():
    record = recording(QUIET, NOISY, QUIET)
    models = {"quiet": QUIET, "noisy": NOISY}
    can = aj.adaptive_filter(record, models).results[0]
    assert [c.after for c in can.changes] == ["noisy", "quiet"]
    never = aj.adaptive_filter(record, models, switching=0.0).results[0]
    assert never.changes == ()


@pytest.mark.parametrize(
    ("models", "options", "message"),
    [
        ([QUIET], {}, "at least two models"),
        ([QUIET, NOISY], {"switching": 9.0}, "below half a sample's"),
        ([QUIET, aj.AngleRandomWalk()], {}, "angle_random_walk has no value"),
    ],
)
def test_what_is_no_bank_is_said(models, options, message):
    with pytest.raises(aj.AllanjaxError, match=message):
        aj.adaptive_filter(recording(QUIET, n=40), models, **options)


def test_words_tables_and_figures(tmp_path):
    found = aj.adaptive_filter(recording(QUIET, NOISY), {"quiet": QUIET, "noisy": NOISY})
    assert "quiet → noisy at" in str(found)
    assert list(found.to_dataframe().columns[-4:]) == [
        *("weight_quiet", "probability_quiet", "weight_noisy", "probability_noisy")
    ]
    figure = found.plot(path=tmp_path / "bank.png")
    drawn = figure.axes[1].lines[0].get_ydata()
    assert drawn[0] > 0.9
    assert drawn[-1] < 0.1
