"""One record of each effect, made by an independent generator: the critic names it, and nothing else.

The critic is handed the samples, what was recorded beside them, and units. Seeds are not chosen.
`benchmarks/studies/critic.py` does the same for many records.
"""

import dataclasses
import importlib

import numpy as np
import pytest

import allanjax as aj
from allanjax.critic import CAUSES, Bank, Candidate, Cause, Template, View, additive, centred
from allanjax.critic.causes.bias_step import BiasStep
from allanjax.critic.critique import critique
from benchmarks.common.hidden_effects import TERMS, draw
from benchmarks.common.hidden_verdict import compared, model_without, others, recording_of, right

SMALL = {"duration": 600.0, "rate": 50.0}
SHOWN = (
    "sinusoid",
    "resonance",
    "low_pass",
    "power_law",
    "bias_step",
    "telegraph",
    "warm_up",
    "temperature",
    "outliers",
    "disturbance",
    "variance_change",
    "rounding",
    "repeated_samples",
    "saturation",
    "common_mode",
)
#: Effects that are seen in the samples themselves.
SEEN = ("rounding", "saturation", "repeated_samples")


def check(hidden, found):
    """Named, measured, and alone."""
    (effect,) = hidden.effects
    finding = right(found, effect)
    assert finding is not None, [f.cause for f in found.findings]
    assert others(found, hidden.effects) == []
    # What is seen in the samples themselves cannot be held out.
    assert (finding.gain is None) is (effect.cause in SEEN)
    assert finding.gain is None or finding.gain > 0.0
    for name, parameter in compared(finding, effect, SMALL["duration"]).items():
        assert parameter.within_3_sigma or parameter.is_near, (name, parameter)


@pytest.mark.parametrize("cause", SHOWN)
def test_a_hidden_effect_is_named_and_measured(cause):
    hidden = draw(0, cause, 4.0, **SMALL)
    check(hidden, critique(recording_of(hidden)))


@pytest.mark.parametrize("cause", TERMS)
def test_a_basic_term_that_the_fit_lacks_is_named_and_measured(cause):
    hidden = draw(0, cause, 4.0, **SMALL)
    recording = recording_of(hidden)
    check(hidden, critique(recording, aj.fit(recording, model_without(hidden))))


@pytest.mark.parametrize(
    "causes", [("sinusoid", "disturbance"), ("bias_step", "outliers"), ("resonance", "temperature")]
)
def test_two_effects_in_one_record_are_named(causes):
    hidden = draw(0, causes, 4.0, **SMALL)
    found = critique(recording_of(hidden))
    assert [effect.cause for effect in hidden.effects if right(found, effect) is None] == []
    assert others(found, hidden.effects) == []


@pytest.mark.parametrize("seed", range(4))
def test_a_clean_record_has_no_finding(seed):
    assert critique(recording_of(draw(seed, None, **SMALL))).findings == ()


def test_a_record_that_no_fit_converges_on_is_criticized_all_the_same(monkeypatch):
    """An effect may be the reason; where the terms are chosen the critic does not need the fit."""
    critic = importlib.import_module("allanjax.critic.criticize")
    recording = recording_of(draw(0, "sinusoid", 4.0, **SMALL))

    def failing(recording, **options):
        fit = aj.fit(recording, **options)
        failed = [dataclasses.replace(r, converged=False, reason="no luck") for r in fit.results]
        return dataclasses.replace(fit, results=tuple(failed))

    monkeypatch.setattr(critic, "fit_recording", failing)
    (axis,) = (found := critique(recording)).results
    assert [f.cause for f in axis.findings] == ["sinusoid"]
    assert "angle_random_walk" in axis.baseline.term_labels
    assert any("no luck" in note for note in found.notes)
    # A fit that was given is meant.
    with pytest.raises(aj.FitError, match="no luck"):
        critique(recording, failing(recording))


class Hump(Cause):
    """A user's own: the bias is off for a while in the middle of the record."""

    name = "hump"

    def detect(self, view: View) -> Candidate | None:
        shape = hump(view.n)
        slow = centred(shape)[None, :1024]
        return additive(
            view,
            self.name,
            Bank(slow),
            lambda k: shape,
            lambda k, amplitude, std, likelihood: [view.amplitude_estimate("amplitude", amplitude, std)],
            lambda k: (0.4 * view.duration, 0.6 * view.duration),
        )


def hump(n):
    return np.exp(-0.5 * ((np.arange(n) / n - 0.5) / 0.03) ** 2)


def test_a_users_own_cause_is_looked_for():
    n = 30_000
    samples = np.random.default_rng(0).standard_normal(n) + 0.3 * hump(n)
    recording = aj.Recording.from_array(samples, SMALL["rate"], gyro_unit="rad/s", names=["gyro_x"])
    (finding,) = critique(recording, causes=(*CAUSES, Hump())).findings
    assert finding.cause == "hump"
    deviation = 1.0 / np.sqrt(np.sum(hump(n) ** 2))
    assert finding.parameters["amplitude"].value == pytest.approx(0.3, abs=4.0 * deviation)


def sawtooth(time, period):
    """A user's own in ten lines: a heater that switches on and off, and a bias that follows."""
    return time / period % 1.0


HEATER = Template("heater", sawtooth, np.geomspace(20.0, 60.0, 200), "period", "s")


def test_a_users_own_cause_is_a_function_and_a_grid():
    """Found with its period, by its own share of the false alarms, and not found where it is not."""
    n, period, truth = 30_000, 31.0, 0.2
    time = (np.arange(n) + 0.5) / SMALL["rate"]
    noise = np.random.default_rng(1).standard_normal(n)
    causes = [BiasStep(), HEATER]
    for amplitude, expected in ((truth, ["heater"]), (0.0, [])):
        samples = noise + amplitude * sawtooth(time, period)
        recording = aj.Recording.from_array(samples, SMALL["rate"], gyro_unit="rad/s", names=["gyro_x"])
        found = critique(recording, causes=causes).findings
        assert [finding.cause for finding in found] == expected
        for finding in found:
            p = finding.parameters
            assert p["period"].value == pytest.approx(period, abs=4.0 * p["period"].std)
            # Of a sawtooth of the variance 1/12; the bank's nearest period is half a per cent off, at most.
            deviation = np.sqrt(12.0 / n)
            assert p["amplitude"].value == pytest.approx(truth, abs=4.0 * deviation + 0.02)


def test_a_record_of_which_half_is_silent_is_criticized():
    """Repeated samples are said, and no error of NumPy; nothing can be predicted from a silent half."""
    samples = 1e-3 * np.random.default_rng(0).standard_normal(20_000)
    samples[:10_000] = 0.0
    recording = aj.Recording.from_array(samples, 100.0, gyro_unit="rad/s", names=["gyro_x"])
    found = critique(recording).findings
    assert "repeated_samples" in {finding.cause for finding in found}
