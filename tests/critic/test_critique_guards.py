"""The critic's guards against false findings: p-values with their trials, margins, and held-out data."""

import numpy as np
import pytest
from critic_views import view_of
from scipy.special import gammaincc
from scipy.stats import kstest

from allanjax.critic.causes import CAUSES, disturbance
from allanjax.critic.causes.disturbance import Disturbance
from allanjax.critic.causes.outliers import Outliers
from allanjax.critic.causes.sinusoid import Sinusoid
from allanjax.critic.causes.temperature import Temperature
from allanjax.critic.policy import FALSE_ALARMS, JUDGEMENTS, OWN, PRIORS, AcceptanceRule
from allanjax.critic.search import _chosen
from allanjax.critic.view import Candidate

RATE = 50.0
WHITE = ("angle_random_walk",)


def smooth(rng, n):
    return np.convolve(rng.standard_normal(n + 60), np.hanning(61), "valid")


# --- p-values -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cause", "channels", "records"), [(Outliers(), 0, 200), (Sinusoid(), 0, 200), (Temperature(), 3, 60)]
)
def test_the_p_value_on_records_without_an_effect_is_uniform(cause, channels, records):
    """White noise; one in a thousand sets of uniform values is rejected.

    Without its number of trials (samples, frequencies, channels) a p-value is below 0.05 three times as
    often, at least, and the statistic of Kolmogorov & Smirnov 0.3 where 0.2 is allowed.
    """
    rng = np.random.default_rng(21)
    found = []
    for _ in range(records):
        channels_of = {f"channel_{k}": smooth(rng, 512) for k in range(channels)}
        found.append(cause.p_value(view_of(rng.standard_normal(512), WHITE, channels_of)))
    assert kstest(found, "uniform").pvalue > 1e-3
    assert np.mean(np.array(found) < 0.05) < 0.05 + 4.0 * np.sqrt(0.05 * 0.95 / records)


def windows_of(n, block):
    """All windows that are looked at: of lengths doubled from a block to a quarter, a quarter of it apart."""
    width, found = block, []
    while width <= n / 4:
        found += [(first, first + width) for first in range(0, n - width + 1, max(width // 4, 1))]
        width *= 2
    return found


def test_the_p_value_of_a_disturbance_counts_its_windows(monkeypatch):
    """Its law by simulation; and the number of windows in it by a count."""
    n, block = 2000, 5
    windows = windows_of(n, block)
    first, last = np.array(windows).T
    squares = np.random.default_rng(22).standard_normal((600, n)) ** 2
    total = np.concatenate([np.zeros((600, 1)), np.cumsum(squares, axis=1)], axis=1)
    sums = total[:, last] - total[:, first]
    p = np.min(gammaincc((last - first) / 2.0, sums / 2.0), axis=1)
    # Windows overlap, so that the sum over them is more than the probability, but not by far.
    for probability in (0.05, 0.2):
        share = np.mean(len(windows) * p < probability)
        assert 0.15 * probability < share < probability + 3.0 * np.sqrt(probability / 600)

    x = np.random.default_rng(23).standard_normal(n)
    x[900:1100] += 8.0 * np.sin(np.arange(200) / 30.0)
    monkeypatch.setattr(disturbance, "gammaincc", lambda shape, level: 1e-9)
    assert Disturbance().detect(view_of(x, WHITE)).p_value == pytest.approx(1e-9 * len(windows), rel=1e-9)


# --- Margins and held-out data ------------------------------------------------------------------------------

#: Log-evidence beyond the basic terms [nats], each by a count of false findings or for the reason it states.
MARGINS = {
    "bias_step": 1.0,
    "warm_up": 1.0,
    "temperature": 1.5,
    "quantization": 1.5,
    "angle_random_walk": 1.5,
    "bias_instability": 1.5,
    "rate_random_walk": 1.5,
    "drift_ramp": 1.5,
    "markov": 1.5,
    "power_law": np.log(100.0),
    "disturbance": 12.0,
    # Their odds are no number.
    "rounding": 0.0,
    "saturation": 0.0,
    "repeated_samples": 0.0,
}


def test_least_odds_are_those_that_false_findings_were_counted_for():
    rule = AcceptanceRule(0.01)
    assert {c.name: rule.least_log_odds(c.name) for c in CAUSES} == {
        c.name: pytest.approx(MARGINS.get(c.name, 3.0), abs=1e-12) for c in CAUSES
    }
    assert FALSE_ALARMS == 0.01
    assert MARGINS.keys() < {cause.name for cause in CAUSES}
    # Of a tenth of the false alarms, ten times the odds.
    assert AcceptanceRule(0.001).least_log_odds("outliers") == pytest.approx(3.0 + np.log(10.0))


def test_all_causes_are_in_the_table_and_share_no_more_than_all_false_alarms():
    assert PRIORS.keys() == {cause.name for cause in CAUSES} | {"common_mode"}
    shares = [prior.share for prior in PRIORS.values() if prior.share not in (None, 1.0)]
    assert sum(shares) + OWN.share <= 1.0
    everything = [*PRIORS.values(), OWN, *JUDGEMENTS.values()]
    assert all(len(entry.provenance) > 20 for entry in everything)


class Own(Outliers):
    def __init__(self, name):
        self.name = name


@pytest.mark.parametrize("count", [0, 1, 3])
def test_a_cause_of_ones_own_changes_the_threshold_of_no_other(count):
    """It is tested at the share that is reserved for such causes, which several share."""
    own = [Own(f"own_{k}") for k in range(count)]
    rule = AcceptanceRule.of(0.01, [*CAUSES, *own])
    for prior, level in (("sinusoid", 0.01 / 15.0), ("outliers", 0.01 / 15.0), ("bias_step", 0.01)):
        assert rule.level(prior) == pytest.approx(level, rel=1e-12)
    assert sum(rule.level(cause.name) for cause in own) == pytest.approx(0.01 / 15.0 if own else 0.0)


@pytest.mark.parametrize(
    ("cause", "gain", "p_value", "bound", "found"),
    [
        # p-values at the cause's share, 1/1500, whatever the odds.
        ("sinusoid", 50.0, 6.6e-4, 1.0, True),
        ("sinusoid", 50.0, 6.7e-4, 1.0, False),
        # e^-gain in the place of a larger p-value, or of none.
        ("temperature", 7.4, 0.5, np.exp(-7.4), True),
        ("temperature", 7.3, 0.5, np.exp(-7.3), False),
        ("spectral_shape", 7.4, None, np.exp(-7.4), True),
        ("spectral_shape", 7.3, None, np.exp(-7.3), False),
        # Odds that are the test.
        ("telegraph", 3.01, None, np.exp(-3.01), True),
        ("telegraph", 2.99, None, np.exp(-2.99), False),
        ("power_law", 4.61, None, np.exp(-4.61), True),
        ("power_law", 4.6, None, np.exp(-4.6), False),
        ("markov", 1.51, 0.9, 1.0, True),
        ("markov", 1.49, 1e-9, 1.0, False),
        ("disturbance", 11.9, 1e-9, 1.0, False),
        # What is seen in the samples has no odds.
        ("rounding", np.nan, None, 0.0, True),
        ("saturation", np.nan, None, 1e-2, False),
        ("of my own", 3.01, 6.6e-4, 1.0, True),
        ("of my own", 2.99, 6.6e-4, 1.0, False),
    ],
)
def test_the_rule(cause, gain, p_value, bound, found):
    view = view_of(np.random.default_rng(24).standard_normal(512), WHITE)
    candidate = Candidate(cause, (), gain, p_value, view, lambda: 1.0, bound=bound)
    assert AcceptanceRule.of(0.01, [Own("of my own")]).accepts(candidate) is found


@pytest.mark.parametrize(
    ("gain", "p_value", "held_out", "found"),
    [(20.0, 1e-9, 1.0, True), (20.0, 1e-9, -1.0, False), (20.0, 0.5, 1.0, False), (2.9, 1e-9, 1.0, False)],
    ids=["sound", "fails on held-out data", "not significant", "odds too short"],
)
def test_a_finding_is_significant_beyond_its_margin_and_holds_on_other_data(gain, p_value, held_out, found):
    view = view_of(np.random.default_rng(24).standard_normal(512), WHITE)
    cause = Outliers()
    candidate = Candidate("outliers", {}, gain, p_value, view, lambda: held_out, (0.0, 1.0), "time")
    step = _chosen([(cause, candidate)], view, AcceptanceRule.of(FALSE_ALARMS, [cause]))
    assert (step is not None) is found


def test_the_next_best_is_taken_where_the_best_does_not_hold():
    view = view_of(np.random.default_rng(25).standard_normal(512), WHITE)
    cause = Outliers()
    best, second = (
        Candidate("outliers", {}, gain, 1e-9, view, lambda held=held: held, (0.0, 1.0), "time")
        for gain, held in ((20.0, -1.0), (10.0, 4.0))
    )
    step = _chosen([(cause, second), (cause, best)], view, AcceptanceRule.of(FALSE_ALARMS, [cause]))
    assert step.candidate is second
    assert step.gain == 4.0


# --- A temperature's lag ------------------------------------------------------------------------------------


@pytest.mark.parametrize("lag", [5.0, 14.0])
def test_a_temperature_is_taken_out_with_its_lag(lag):
    """Of a slow wave of five times the noise nothing is left, in phase or a quarter of a period off.

    Taken out without its lag, of an eighth of the period, 70 % of it would be left a quarter off. Lags of
    the bank are a tenth apart, which leaves 4 % of it, or 0.2, at most; two standard deviations of noise are
    0.04.
    """
    n, rate = 6000, 10.0
    t = np.arange(n) / rate
    period = 8.0 * lag
    channel = np.sin(2.0 * np.pi * t / period)
    rng = np.random.default_rng(26)
    x = rng.standard_normal(n) + 5.0 * np.sin(2.0 * np.pi * np.maximum(t - lag, 0.0) / period)
    found = Temperature().detect(view_of(x, auxiliary={"temperature": channel}, rate=rate))
    q = found.parameters["lag"]
    assert q.value == pytest.approx(lag, abs=4.0 * q.std)
    inside = t > lag
    for shift in (0.0, np.pi / 2.0):
        wave = np.sin(2.0 * np.pi * t / period - shift)[inside]
        rest = found.after.samples[inside] - found.after.samples[inside].mean()
        amplitude = rest @ wave / (wave @ wave)
        assert abs(amplitude) < 0.25
    # What is left has the variance of the noise.
    assert found.after.samples[inside].std() == pytest.approx(1.0, abs=0.02 + 4.0 / np.sqrt(2.0 * n))
