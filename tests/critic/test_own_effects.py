"""Causes of a user's own, and by them the rule that decides what is a finding."""

import dataclasses

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import multivariate_normal

import allanjax as aj
from allanjax.critic import EFFECTS, Bank, Candidate, Effect, Range, Template, View, additive, centred

N, RATE = 16_384, 50.0
NAN = float("nan")


def critique(x, effects, **options):
    return aj.critique(x, rate=RATE, gyro_unit="deg/s", names=["gyro_x"], effects=effects, **options)


def white(seed):
    return np.random.default_rng(seed).standard_normal(N)


class Claim(Effect):
    """A cause that offers what it is made with, once."""

    def __init__(self, name, gain, p_value=None, bound=1.0, held_out=1.0):
        self.name, self.offer, self.bound, self.held_out = name, (gain, p_value), bound, held_out
        # What is visible directly in the samples has no odds.
        self.is_preprocessing = np.isnan(gain)

    def detect(self, view: View) -> Candidate | None:
        if self.name in view.found:
            return None
        size = [view.amplitude_estimate("amplitude", 0.5, 0.1)]
        return Candidate(self.name, size, *self.offer, view, lambda: self.held_out, bound=self.bound)


#: What is just enough. A p-value counts by the cause's share, a fifteenth of one per cent; e^-gain, or any
#: other bound, stands for a larger one, or for none; then there are odds that each kind of cause needs.
ENOUGH = [
    Claim("variance_change", 50.0, 6.6e-4),
    Claim("temperature", 7.4, 0.5, np.exp(-7.4)),
    Claim("warm_up", 1.01, 6.6e-4),
    Claim("telegraph", 3.01, None, np.exp(-3.01)),
    Claim("power_law", 4.61, None, np.exp(-4.61)),
    Claim("markov", 1.51, 0.9),
    Claim("my own", 3.01, 6.6e-4),
    Claim("rounding", NAN, None, 0.0, NAN),
]
#: What is just too little, or does not hold on data that it was not estimated from.
TOO_LITTLE = [
    Claim("variance_change", 50.0, 6.7e-4),
    Claim("temperature", 7.3, 0.5, np.exp(-7.3)),
    Claim("warm_up", 0.99, 1e-9),
    Claim("telegraph", 2.99, None, np.exp(-2.99)),
    Claim("power_law", 4.6, None, np.exp(-4.6)),
    Claim("markov", 1.49, 1e-9),
    Claim("bias_step", 50.0, 0.0101),
    Claim("disturbance", 11.9, 1e-9),
    Claim("my own", 2.99, 6.6e-4),
    Claim("saturation", NAN, None, 1e-2, NAN),
    Claim("repeated_samples", NAN, None, 0.0, -1.0),
    Claim("outliers", 20.0, 1e-9, 1.0, -1.0),
    Claim("rate_random_walk", 20.0, 1e-9, 1.0, NAN),
]


def test_what_is_just_enough_is_a_finding():
    found = critique(white(1), ENOUGH).findings
    assert {f.cause for f in found} == {effect.name for effect in ENOUGH}
    own = next(f for f in found if f.cause == "my own")
    assert (own.evidence, own.p_value, own.gain) == (3.01, 6.6e-4, 1.0)
    assert own.odds == pytest.approx(np.exp(3.01))
    assert own.size.value == pytest.approx(0.5 * 180.0 / np.pi)
    # What no cause's own odds are compared with has none.
    seen = next(f for f in found if f.cause == "rounding")
    assert (seen.evidence, seen.gain, seen.odds) == (None, None, None)


def test_what_is_just_too_little_is_none():
    assert critique(white(1), TOO_LITTLE).findings == ()


def test_one_tenth_of_the_false_alarms_needs_ten_times_the_odds_and_a_tenth_of_the_p_value():
    enough = [Claim("warm_up", 3.31, 6.6e-5), Claim("telegraph", 5.31, None, np.exp(-5.31))]
    less = [Claim("markov", 3.8, 0.9), Claim("my own", 50.0, 6.7e-5), Claim("bias_step", 3.3, 1e-9)]
    found = critique(white(1), [*enough, *less], false_alarms=0.001).findings
    assert {f.cause for f in found} == {effect.name for effect in enough}


def test_causes_of_ones_own_share_what_is_reserved_for_them_and_change_no_other():
    own = [Claim("one", 9.0, 3.3e-4), Claim("other", 9.0, 3.4e-4), Claim("outliers", 9.0, 6.6e-4)]
    assert {f.cause for f in critique(white(1), own).findings} == {"one", "outliers"}


class Broken(Claim):
    """A cause with a fault that shows in the axes of its name."""

    def detect(self, view: View) -> None:
        if view.axis.name in self.name:
            raise IndexError("no such bin")


def test_a_fault_in_one_axis_is_reported_for_it_and_the_others_are_given():
    def critique_of(name):
        x = np.stack([white(1), white(2)], axis=1)
        options = {"names": ["gyro_x", "gyro_y"], "effects": [Broken(name, 0.0)]}
        return aj.critique(x, rate=RATE, gyro_unit="deg/s", **options)

    found = critique_of("gyro_y")
    assert found["gyro_x"].after[0] == critique_of("none")["gyro_x"].after[0]
    ((axis, reason),) = [(dead.axis.name, dead.reason) for dead in found.dead]
    assert (axis, [*found]) == ("gyro_y", ["gyro_x"])
    assert all(word in reason for word in ("IndexError", "test_own_effects.py", "no such bin", "report"))
    assert any(reason in note for note in found.to_dict()["notes"])
    assert "gyro_y: not compared: its critique failed" in str(found)
    with pytest.raises(aj.FitError, match=r"gyro_x: .*IndexError.*gyro_y: "):
        critique_of("gyro_x, gyro_y")


def test_rivals_are_what_else_was_offered_with_their_odds_against_it():
    claims = [Claim("temperature", 12.0, 1e-9), Claim("warm_up", 9.0, 0.5), Claim("power_law", 4.0, None)]
    (found,) = critique(white(1), claims).findings
    assert found.cause == "temperature"
    # Shorter than a thousand to one.
    assert {r.cause: r.odds for r in found.rivals} == {"warm_up": pytest.approx(np.exp(3.0))}


def hump(n):
    return np.exp(-0.5 * ((np.arange(n) / n - 0.5) / 0.03) ** 2)


class Hump(Effect):
    """The bias is off for a while in the middle of the record."""

    name = "hump"

    def detect(self, view: View) -> Candidate | None:
        shape = hump(view.n)
        return additive(
            view,
            self.name,
            Bank(centred(shape)[None, :1024]),
            lambda k: shape,
            lambda k, amplitude, std, likelihood: [view.amplitude_estimate("amplitude", amplitude, std)],
            lambda k: (0.4 * view.duration, 0.6 * view.duration),
        )


def sawtooth(time, period):
    """A heater that switches on and off, and a bias that follows."""
    return time / period % 1.0


HEATER = Template("heater", sawtooth, np.geomspace(20.0, 60.0, 200), "period", "s")
STEP = next(effect for effect in EFFECTS if effect.name == "bias_step")


class Fickle(Bank):
    """Of two shapes, the best one is the other one in every scan."""

    def scan(self, view, noise):
        scan = super().scan(view, noise)
        turns.append(len(turns) % 2)
        loud = np.where(np.arange(2) == turns[-1], scan.snr, 1e-9 * scan.snr)
        return dataclasses.replace(scan, snr=loud)


turns: list[int] = []


class Unsettled(Effect):
    """A bump of unknown place, between two of which the search never settles."""

    name = "unsettled"
    seen: list[tuple[Candidate, np.ndarray, int]]

    def detect(self, view: View) -> Candidate | None:
        turns.clear()
        shapes = [np.roll(hump(view.n), lag) for lag in (0, view.n // 100)]
        bank = Fickle(np.stack([centred(shape)[:1024] for shape in shapes]))
        told = []

        def parameters(k, amplitude, std, likelihood):
            told.append((k, amplitude))
            return [view.amplitude_estimate("amplitude", amplitude, std)]

        found = additive(view, self.name, bank, lambda k: shapes[k], parameters)
        if found is not None:
            ((k, amplitude),) = told
            self.seen.append((found, (view.samples - found.after.samples), amplitude * shapes[k]))
        return found


def test_what_is_told_is_what_is_subtracted_though_place_and_noise_do_not_settle():
    cause = Unsettled()
    cause.seen = []
    critique(white(2) + 0.6 * hump(N), [cause])
    assert cause.seen
    for _, subtracted, told in cause.seen:
        np.testing.assert_allclose(subtracted, told, atol=0.1 * np.max(abs(told)))


class Spy(Effect):
    """The candidates of a known cause, of which none becomes a finding."""

    def __init__(self, name):
        self.name, self.cause = name, next(effect for effect in EFFECTS if effect.name == name)
        self.seen = []

    def detect(self, view: View) -> Candidate | None:
        found = self.cause.detect(view)
        self.seen.append((view, found))
        return None


def smoothed(seed):
    return np.convolve(white(seed), [0.25, 0.5, 0.25], "same")


def test_the_gain_of_a_spectral_shape_is_measured_on_data_that_it_was_not_fitted_to():
    first, other = Spy("spectral_shape"), Spy("spectral_shape")
    critique(smoothed(11), [first])
    critique(smoothed(12), [other])
    (view, found), (another, _) = first.seen[0], other.seen[0]
    there = another.with_structure(found.after.structure)
    gain = there.log_likelihood(found.after.noise) - another.log_likelihood(view.noise)
    # The scatter of a gain is its root.
    assert abs(found.held_out() - gain) < 4.0 * np.sqrt(2.0 * gain)
    assert found.held_out() != found.gain


class Placed(Claim):
    """A claim with a parameter that has a range, of which its search may have reached a bound."""

    def __init__(self, label, value, limit=""):
        super().__init__(f"{label} {value} {limit}", 50.0, 1e-9)
        self.parameter = label, value, limit
        ranges = {"time_constant": ("interval", "duration"), "frequency": ("resolution", "nyquist")}
        self.sensible = {label: Range(*ranges[label])}

    def detect(self, view: View) -> Candidate | None:
        found = super().detect(view)
        label, value, limit = self.parameter
        own = view.estimate(label, value, 0.1 * value, "s", limit)
        return found and dataclasses.replace(found, estimates=[*found.estimates, own])


def test_parameters_of_a_finding_make_sense():
    """Not beyond half the sample rate or the record, nor at a bound of the search."""
    good = [("time_constant", 0.021), ("time_constant", 300.0), ("frequency", 24.9)]
    bad = [("time_constant", 0.019), ("time_constant", 330.0), ("frequency", 25.1), ("frequency", 0.002)]
    bad += [("time_constant", 10.0, "above"), ("frequency", 10.0, "below")]
    effects = [Placed(*each) for each in good + bad]
    found = critique(white(1), effects).findings
    assert {f.cause for f in found} == {effect.name for effect in effects[: len(good)]}


def test_a_waveform_of_ones_own_is_found_among_all_causes_with_its_size():
    x = white(2) + 0.35 * hump(N)
    (found,) = critique(x, [*EFFECTS, Hump()]).findings
    assert found.cause == "hump"
    assert found.span == pytest.approx((0.4 * N / RATE, 0.6 * N / RATE))
    std = 1.0 / np.linalg.norm(hump(N) - hump(N).mean())
    assert found.size.unit == "deg/s"
    assert found.size.std == pytest.approx(std, rel=0.25)
    assert abs(found.size.value - 0.35) < 4.0 * std
    # The matched filter's output is normal without the effect; two-sided.
    assert critique(white(3), [Hump()]).findings == ()


def test_a_family_of_waveforms_is_found_with_its_parameter_and_not_where_it_is_not():
    time, period, truth = (np.arange(N) + 0.5) / RATE, 31.0, 0.28
    x = white(4) + truth * sawtooth(time, period)
    (found,) = critique(x, [STEP, HEATER]).findings
    assert found.cause == "heater"
    wave, near = sawtooth(time, period), sawtooth(time, period + 0.01)
    columns = np.stack([wave - wave.mean(), truth * (near - wave - (near - wave).mean()) / 0.01])
    bound = np.sqrt(np.diag(np.linalg.inv(columns @ columns.T)))
    for label, value, std in (("amplitude", truth, bound[0]), ("period", period, bound[1])):
        e = found.parameters[label]
        assert abs(e.value - value) < 4.0 * e.std
        # A saw's edge is sharper than the lowest coefficients show, and periods of the bank are 0.17 s apart.
        assert std < 1.25 * e.std < 0.375
    assert found.parameters["period"].unit == "s"
    nothing = critique(white(4), [STEP, HEATER])
    assert (nothing.findings, nothing["gyro_x"].tests.keys()) == ((), {"bias_step", "heater"})


def test_a_p_value_counts_the_places_of_a_bank():
    """Of the largest of all matched filters, by our own draws of white noise; the package's are 400."""
    x = white(5)
    places = np.unique(np.rint(np.linspace(0.0, N, 1_026)[1:-1])).astype(int)

    def largest(y):
        return np.max(abs(np.cumsum(y - y.mean())[places - 1]) / np.sqrt(places * (1.0 - places / N)))

    draws = [largest(row) for row in np.random.default_rng(6).standard_normal((1_500, N))]
    expected = np.mean(draws > largest(x))
    found = critique(x, [STEP])["gyro_x"].tests["bias_step"]
    assert found == pytest.approx(expected, abs=4.0 * np.sqrt(expected * (1.0 - expected) / 320.0))


def test_the_last_bits_of_a_record_change_nothing():
    """Numbers are the same within rounding for records that differ by a few units in the last place."""
    x = 0.3 + white(7) + 0.4 * (np.arange(N) > 6_000)
    warm_up = next(effect for effect in EFFECTS if effect.name == "warm_up")
    first, again = (critique(x * (1.0 + k * 2.2e-16), [STEP, warm_up]) for k in (0, 3))
    assert first["gyro_x"].tests == pytest.approx(again["gyro_x"].tests, rel=1e-9)
    numbers = [
        [f.gain, np.log(f.p_value), *(x for e in f.parameters.values() for x in (e.value, e.std))]
        for (f,) in (first.findings, again.findings)
    ]
    assert numbers[0] == pytest.approx(numbers[1], rel=1e-6)


def test_the_best_of_several_channels_is_corrected_for_their_number():
    rng = np.random.default_rng(9)
    x = white(8)
    channels = {name: np.convolve(rng.standard_normal(N + 600), np.hanning(601), "valid") for name in "abc"}
    cause = [c for c in EFFECTS if c.name == "temperature"]

    def p_value(*names):
        auxiliary = {name: channels[name] for name in names}
        recording = aj.Recording.from_array(x, RATE, gyro_unit="deg/s", names=["gyro_x"], auxiliary=auxiliary)
        return aj.critique(recording, effects=cause)["gyro_x"].tests["temperature"]

    least = min(p_value(name) for name in channels)
    # Draws of a bank are those of the record, so that its p-value is the same whatever else there is.
    assert p_value(*channels) == pytest.approx(1.0 - (1.0 - least) ** 3, rel=0.02)


def test_a_likelihood_on_held_out_coefficients_knows_a_ramp_only_from_the_others():
    """The predictive density is a quotient of two normal densities, with any slope as likely as another."""
    seen = []

    class Witness(Claim):
        def detect(self, view):
            seen.append(view)

    x = white(2)[:1024] + 0.002 * np.arange(1024)
    critique(x, [Witness("witness", 0.0)])
    (view,) = seen[:1]
    assert view.noise.ramp
    given = []

    def fitted(fold):
        given.append(fold)
        return view.noise

    found = view.cross_validated(fitted)
    c, h, v = view.coefficients, view.family.ramp, view.variance()

    def density(some):
        covariance = np.diag(v[some]) + 0.1**2 * np.outer(h[some], h[some])
        return multivariate_normal(cov=covariance).logpdf(c[some])

    everything = np.ones(1023, bool)
    expected = sum(density(everything) - density(fold) for fold in given)
    # Without the constants of normal densities; the prior of the slope, 0.1 rad/s², is nearly flat.
    assert found == pytest.approx(expected + 0.5 * 1023 * np.log(2.0 * np.pi), abs=0.01)


def test_a_resonance_that_predicts_nothing_is_not_reported():
    """Of two weak resonances, each half of the spectrum shows one at the same place, but not the other."""
    rng = np.random.default_rng(68)
    x = rng.standard_normal(N)
    for _ in range(2):
        f, quality = rng.uniform(0.05, 0.4), rng.uniform(5.0, 60.0)
        r = np.exp(-np.pi * f / quality)
        y = lfilter([1.0], [1.0, -2.0 * r * np.cos(2.0 * np.pi * f), r * r], rng.standard_normal(N))
        x += y * rng.uniform(0.03, 0.15) / y.std()
    found = critique(x, [effect for effect in EFFECTS if effect.name == "spectral_shape"]).findings
    assert [f.cause for f in found] == ["resonance"]
    assert all(f.gain > 0.0 for f in found)
