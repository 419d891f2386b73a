"""Several axes, on which one finding acts with a size in each, and samples that are missing in some."""

import functools

import critic_truth as ct
import golden_records as golden
import numpy as np
import pytest
from bench import critique, recording, truth
from scipy.stats import beta

import allanjax as aj
from allanjax.critic import EFFECTS

RATE, N = 50.0, ct.N


def only(*names):
    return [effect for effect in EFFECTS if effect.name in names]


def white_of(record, axis):
    """Deviation of the white noise of an axis in the recording's unit."""
    return golden.level(record.truth, axis) / golden.UNITS[axis.split("_")[0]][1]


def line(amplitude, frequency=3.2173):
    return amplitude * np.sin(2.0 * np.pi * frequency * np.arange(N) / RATE + 0.4)


#: Amplitude of a line in unit white noise that gains 17.5 nats: too little where it might be anywhere.
WEAK = np.sqrt(17.5 * 4.0 / N)
#: Deviation of an amplitude of a line, and of a step in the middle of a record.
LINE_STD, STEP_STD = np.sqrt(2.0 / N), 2.0 / np.sqrt(N)


def six_axes():
    """Lines and steps in white noise, some of them in several axes at once."""
    x = np.random.default_rng(41).standard_normal((N, 6))
    place = np.arange(N)
    x[:, 0] += line(5.0 * WEAK)
    # Whatever the noise has of this line does not count.
    both = np.exp(2j * np.pi * 3.2173 * place / RATE)
    x[:, 1] += line(WEAK) - 2.0 / N * np.real(np.vdot(both, x[:, 1]) * both)
    x[:, 2] += 11.0 * STEP_STD * (place >= 8_000)
    x[:, 3] -= 13.0 * STEP_STD * (place >= 8_000)
    x[:, 4] += 11.0 * STEP_STD * (place >= 9_500)
    x[:, 5] += line(9.0 * LINE_STD, 4.4)
    return x


@functools.cache
def moved():
    """Their critique."""
    options = {"effects": only("sinusoid", "bias_step"), "false_alarms": 0.06}
    names = golden.GYROS + golden.ACCELS
    return aj.critique(six_axes(), rate=RATE, gyro_unit="deg/s", accel_unit="g", names=names, **options)


def together(*axes):
    """What acts on these axes."""
    return next(f for f in moved().findings if f.axes == axes)


def test_what_acts_on_several_axes_is_one_finding_and_what_does_not_is_not():
    found = {(f.cause, f.axes) for f in moved().findings}
    assert found == {
        ("sinusoid", ("gyro_x", "gyro_y")),
        ("bias_step", ("gyro_z", "accel_x")),
        ("bias_step", ("accel_y",)),
        ("sinusoid", ("accel_z",)),
    }
    # What the sensor is comes first, then what happened, in each the largest change.
    order = [(f.is_event, -f.change.size) for f in moved().findings]
    assert order == sorted(order)
    assert {f.cause for f in moved().findings if f.is_event} == {"bias_step"}


def test_a_weak_line_is_found_where_another_axis_has_a_strong_one_and_not_alone():
    options = {"rate": RATE, "gyro_unit": "deg/s", "names": ["gyro_y"], "effects": only("sinusoid")}
    assert aj.critique(six_axes()[:, 1], **options).findings == ()
    both = together("gyro_x", "gyro_y")
    for axis, amplitude in (("gyro_x", 5.0 * WEAK), ("gyro_y", WEAK)):
        e = both.amplitudes[axis]
        assert (e.unit, e.std) == ("deg/s", pytest.approx(LINE_STD, rel=0.03))
        assert abs(e.value - amplitude) < 4.0 * LINE_STD
    # By Baluev's law: at the places of two lines of other axes, four resolved frequencies wide; or anywhere.
    strong, weak = both.members
    for found, count, resolved in ((weak, 2.0, 8.0), (strong, 1.0, N / 2.0 - 6.0)):
        z = 0.5 * (found.size.value / found.size.std) ** 2
        expected = np.log(count + resolved * np.sqrt(np.pi / 3.0 * z)) - z
        assert np.log(found.p_value) == pytest.approx(expected, abs=0.02 + 3e-4 * z)


@pytest.mark.parametrize("axes", [("gyro_x", "gyro_y"), ("gyro_z", "accel_x")])
def test_numbers_of_a_finding_in_several_axes_are_those_of_its_members_together(axes):
    both = together(*axes)
    parts = [f for axis in axes for f in moved()[axis].findings]
    assert both.members == tuple(parts)
    assert both.gain == pytest.approx(sum(f.gain for f in parts))
    assert both.evidence == pytest.approx(sum(f.evidence for f in parts))
    assert both.p_value == pytest.approx(2.0 * min(f.p_value for f in parts), abs=0.0)
    assert both.span == (min(f.span[0] for f in parts), max(f.span[1] for f in parts))
    (label,) = both.parameters
    value, std = np.array([(f.parameters[label].value, f.parameters[label].std) for f in parts]).T
    weight = 1.0 / std**2
    mean = weight @ value / weight.sum()
    scatter = max(1.0, np.sqrt(weight @ (value - mean) ** 2))
    assert both.parameters[label].value == pytest.approx(mean)
    assert both.parameters[label].std == pytest.approx(scatter / np.sqrt(weight.sum()))
    strongest = max(parts, key=lambda f: (f.change.size, f.gain))
    assert (both.shown, both.change) == (strongest.axes[0], strongest.change)


def test_steps_at_one_time_have_the_size_of_each_axis():
    step = together("gyro_z", "accel_x")
    assert abs(step.parameters["time"].value - 8_000 / RATE) < 4.0 * step.parameters["time"].std
    for axis, size, unit in (("gyro_z", 11.0, "deg/s"), ("accel_x", -13.0, "g")):
        e = step.amplitudes[axis]
        assert e.unit == unit
        assert abs(e.value - size * STEP_STD) < 4.0 * STEP_STD


def test_a_line_and_its_harmonic_on_four_of_six_axes():
    found, hidden = critique("lines"), truth("lines")
    (vibration,) = found.findings
    assert (vibration.cause, vibration.axes) == ("sinusoid", hidden.effects[0].axes)
    assert abs(vibration.parameters["frequency"].value - 7.3) < 4.0 * vibration.parameters["frequency"].std
    assert [e.value for e in vibration.details["harmonics"]] == [2.0]
    sizes = {"gyro_x": 0.25, "gyro_z": 0.4, "accel_x": 0.3, "accel_y": 0.55}
    for member in vibration.members:
        (axis,) = member.axes
        white = white_of(hidden, axis)
        amplitudes = [member.size, *member.details["harmonic_amplitudes"]]
        for e, size in zip(amplitudes, (sizes[axis], 0.5 * sizes[axis]), strict=True):
            assert e.std == pytest.approx(white * LINE_STD, rel=0.05)
            assert abs(e.value - size * white) < 4.0 * e.std
        assert vibration.amplitudes[axis] == member.size
        # Fundamental and harmonic: A²n/4 of unit noise each, with their scatter A√(n/2) and a few parameters.
        expected = 1.25 * sizes[axis] ** 2 * N / 4.0
        assert abs(member.gain - expected) < 4.0 * sizes[axis] * np.sqrt(1.25 * N / 2.0) + 10.0


def test_a_knock_is_one_event_with_the_peak_of_each_axis():
    found, hidden = critique("knock"), truth("knock")
    (knock,) = found.findings
    (effect,) = hidden.effects
    assert (knock.cause, knock.axes) == ("disturbance", effect.axes)
    for label, first in (("start", min), ("end", max)):
        e = knock.parameters[label]
        assert abs(e.value - effect.parameters[label]) < 4.0 * e.std
        assert e.value == first(f.parameters[label].value for f in knock.members)
    for axis in effect.axes:
        white = white_of(hidden, axis)
        # The largest of some samples near the peak, each with the noise.
        assert 11.0 < knock.amplitudes[axis].value / white < 17.0
        # By the noise before the finding, with some of the motion in it.
        assert knock.amplitudes[axis].std == pytest.approx(white, rel=0.1)
    assert knock.gain == pytest.approx(sum(f.gain for f in knock.members))


def test_a_weak_knock_is_found_where_another_axis_has_a_strong_one_and_not_alone():
    """Motions that a matched filter finds with 300, 45 and 0 nats."""
    x = np.random.default_rng(46).standard_normal((N, 3))
    after = np.maximum(np.arange(N) - 9_000, 0) / RATE
    motion = np.exp(-after / 0.8) * np.sin(2.0 * np.pi * 2.0 * after)
    for k, nats in enumerate((300.0, 45.0)):
        x[:, k] += motion * np.sqrt(2.0 * nats / np.sum(motion**2))
    options = {"rate": RATE, "gyro_unit": "deg/s", "effects": only("disturbance")}
    assert aj.critique(x[:, 1], names=["gyro_y"], **options).findings == ()
    (knock,) = aj.critique(x, **options).findings
    assert (knock.cause, knock.axes) == ("disturbance", ("gyro_x", "gyro_y"))
    assert knock.span[0] == pytest.approx(9_000 / RATE, abs=0.5)


def test_what_is_left_of_an_event_is_reported_with_it_and_another_event_within_a_loud_half_is_not():
    """A tenth of the record is three times louder on two axes, its middle third thrice as loud again."""
    x = np.random.default_rng(45).standard_normal((N, 3))
    x[4_000:5_700, :2] *= 3.0
    x[4_600:5_100, :2] *= 3.0
    x[N // 2 :, 2] *= 1.5
    x[12_000:12_100, 2] *= 6.0
    options = {"rate": RATE, "gyro_unit": "deg/s", "effects": only("variance_change")}
    found = aj.critique(x, **options)
    several = [f for f in found.findings if f.axes == ("gyro_x", "gyro_y")]
    alone = sorted((f for f in found.findings if f.axes == ("gyro_z",)), key=lambda f: f.span[1] - f.span[0])
    (event,), (knock, half) = several, alone
    assert all(len(found[axis].findings) > 1 for axis in event.axes)
    assert event.span == pytest.approx((4_000 / RATE, 5_700 / RATE), abs=1.0)
    assert event.gain == pytest.approx(sum(f.gain for axis in event.axes for f in found[axis].findings))
    for f, start, end in ((knock, 12_000, 12_100), (half, N // 2, N)):
        assert f.span == pytest.approx((start / RATE, end / RATE), abs=1.0)
    ends = "cause == 'variance_change' and axes == 'gyro_z' and parameter == 'end'"
    table = found.to_dataframe().query(ends)
    assert dict(zip(table.value > 300.0, table.limit, strict=True)) == {True: "above", False: ""}
    assert "allanjax critique" not in "".join((found.details(), *found.to_dict()["warnings"]))
    assert not any(word in str(found.refit()) for word in ("as requested", "all samples are used"))


def test_single_samples_of_several_axes_at_one_time_are_an_event_and_the_others_stay_outliers():
    x = np.random.default_rng(43).standard_normal((N, 3))
    scattered = [700, 3_100, 9_000, 12_500]
    x[scattered, 0] += 14.0
    for k in range(3):
        x[6_000 + 4 * k, k] += 20.0 + 5.0 * k
    found = aj.critique(x, rate=RATE, gyro_unit="deg/s", effects=only("outliers"))
    event, left = sorted(found.findings, key=lambda f: f.cause)
    assert (event.cause, event.axes) == ("event", ("gyro_x", "gyro_y", "gyro_z"))
    assert (event.parameters["start"].value, event.parameters["end"].value) == (120.0, 120.16)
    for k, peak in enumerate(event.amplitudes.values()):
        assert abs(peak.value - 20.0 - 5.0 * k) < 4.0 * peak.std
    assert (left.cause, left.axes) == ("outliers", ("gyro_x",))
    assert [t.value for t in left.details["times"]] == [k / RATE for k in scattered]
    assert left.parameters["count"].value == 4.0
    # What was measured once is reported once: most of that axis's outliers are scattered.
    assert found.gain == pytest.approx(event.gain + left.gain)
    assert left.gain == found["gyro_x"].findings[0].gain


def test_the_p_value_of_shared_noise_counts_pairs_and_bands():
    """Three pairs of axes, each in all coefficients, the lowest quarter, its lowest quarter, and so on."""
    x = np.random.default_rng(44).standard_normal((N, 3))
    x[:, 2] -= 0.15 * x[:, 0]
    found = aj.critique(x, rate=RATE, gyro_unit="deg/s", effects=only("common_mode"))
    (shared,) = found.shared_findings
    stages = [found[axis].stages[-1] for axis in shared.axes]
    whites = [ct.coefficients(stage.x) / np.sqrt(stage.variance) for stage in stages]
    p = []
    for top in (N - 1, 4_095, 1_023, 255):
        r = np.corrcoef(*(np.r_[white[:top], -white[:top]] for white in whites))[0, 1]
        p.append(beta.sf(r**2, 0.5, (top - 1) / 2.0))
    assert shared.p_value == pytest.approx(3 * len(p) * min(p), rel=1e-3, abs=0.0)
    assert shared.gain == pytest.approx(found.gain)


@pytest.mark.parametrize("name", ["lines", "two_effects", "steps", "knock", "lossy", "clean_1", "clean_2"])
def test_what_is_left_of_each_axis_is_its_noise(name):
    """Axes without an effect have no finding, and of all of them N and K are the true ones."""
    found, hidden = critique(name), truth(name)
    for axis in found:
        concerned = any(axis in effect.axes for effect in hidden.effects)
        assert bool(found[axis].findings) is concerned
        model, own = found.models[axis], hidden.truth[axis]
        # Of n samples N is known to 1/√(2n), a little worse beside other terms.
        near = pytest.approx(own["angle_random_walk"], rel=4.0 * 1.3 / np.sqrt(2.0 * N))
        assert model["angle_random_walk"].coefficient == near
        if "rate_random_walk" in model.term_labels and set(own) == {"angle_random_walk", "rate_random_walk"}:
            others = {*model.term_labels} - {*own}
            std = ct.spectral_bound(ct.levels, own, others)["rate_random_walk"]
            assert abs(model["rate_random_walk"].coefficient - own["rate_random_walk"]) < 4.0 * std


def test_coefficients_with_intervals_are_those_of_what_is_left():
    """Of the samples less a step and a line; without that, they are far off."""
    found, hidden = critique("two_effects"), truth("two_effects")
    again = found.refit()
    assert again.axes == recording("two_effects").names
    for axis in again:
        coefficients, own = again[axis].coefficients, hidden.truth[axis]
        white, walk = coefficients["angle_random_walk"], coefficients["rate_random_walk"]
        assert abs(white.value - own["angle_random_walk"]) < 4.0 * white.std
        # By Allan variances a little worse than by all data; other sets of terms are nearly as probable.
        assert 1.0 < white.std / (own["angle_random_walk"] / np.sqrt(2.0 * N)) < 1.5
        # A random walk at the edge of detection is below its limit.
        assert walk.value < own["rate_random_walk"] + 4.0 * walk.std + 1e-12
        assert own["rate_random_walk"] < walk.upper_limit
    # Of the record with its step the walk is far too large.
    with_step = found["gyro_x"].baseline["rate_random_walk"].coefficient
    assert with_step > 4.0 * hidden.truth["gyro_x"]["rate_random_walk"]


OPTIONS = {"rate": RATE, "gyro_unit": "deg/s", "names": ["gyro_x", "gyro_z"], "gaps": "fill"}
#: A tenth of the samples: singly, and two gaps of two hundred.
LOST = np.random.default_rng(2).random(N) < 0.078
LOST[2_000:2_200] = LOST[9_000:9_200] = True
LOST[5_000] = False
SHARE = LOST.mean()
# Errors of coefficients grow by this factor.
WIDE = np.sqrt(1.0 / (1.0 - SHARE) + SHARE)


@functools.cache
def gappy():
    """Critique of a line and an outlier in white noise, of which a tenth is missing, and of noise alone."""
    x = np.random.default_rng(11).standard_normal((N, 2)) + 0.3
    x[:, 0] += 0.25 * np.sin(2.0 * np.pi * 3.2171 * np.arange(N) / RATE)
    x[5_000, 0] += 15.0
    return [aj.critique(values, **OPTIONS) for values in (np.where(LOST[:, None], np.nan, x), x)]


def test_what_is_found_is_what_there_is_with_a_tenth_less_known_of_it():
    lossy, whole = gappy()
    for found in (lossy, whole):
        assert sorted(f.cause for f in found["gyro_x"].findings) == ["outliers", "sinusoid"]
        assert found["gyro_z"].findings == ()
        assert all(d.p_value > 1e-4 for axis in found.results for d in axis.after)
    (line, full), (spot, _) = (
        [next(f for f in found["gyro_x"].findings if f.cause == cause) for found in (lossy, whole)]
        for cause in ("sinusoid", "outliers")
    )
    assert full.size.std == pytest.approx(np.sqrt(2.0 / N), rel=0.03)
    # What is drawn between is noise: it shows nothing of what it was, and adds to the errors.
    for label, true in (("amplitude", 0.25), ("frequency", 3.2171)):
        e, other = (f.parameters[label] for f in (line, full))
        # A frequency is known the better the larger its line is.
        larger = 1.0 if label == "amplitude" else full.size.value / line.size.value
        assert e.std == pytest.approx(WIDE * larger * other.std, rel=0.03)
        assert abs(e.value - true) < 4.0 * e.std
    # A record of nine tenths of the length gains nine tenths.
    assert 0.8 * (1.0 - SHARE) * full.gain < line.gain < 1.1 * full.gain
    (time,) = spot.details["times"]
    assert time.value == 5_000 / RATE
    assert spot.parameters["count"].value == 1.0


def test_noise_is_as_loud_where_it_was_drawn_and_is_known_less_well():
    lossy, whole = gappy()
    for axis in lossy:
        left = lossy[axis].stages[-1].x * 180.0 / np.pi
        for some, error in ((left, WIDE / np.sqrt(2.0 * N)), (left[LOST], 1.0 / np.sqrt(2.0 * LOST.sum()))):
            assert np.std(some) == pytest.approx(1.0, abs=4.0 * error)
        assert lossy.fit[axis].widening == pytest.approx(WIDE)
        assert whole.fit[axis].widening == 1.0


def test_coefficients_of_what_is_left_are_as_uncertain_as_if_the_record_were_shorter():
    given, found = recording("lossy"), critique("lossy")
    assert any("filled in" in note for note in found.notes)
    wide = np.sqrt(1.0 / (1.0 - given.missing.mean()) + given.missing.mean())
    units = {"gyro_unit": "rad/s", "accel_unit": "m/s²"}
    drawn = aj.fit(given.values, rate=given.rate, **units, names=given.names, as_is=True)
    again = found.refit()
    for axis in again:
        assert again[axis].widening == pytest.approx(wide)
        for label, e in again[axis].coefficients.items():
            if e.detected:
                assert e.std == pytest.approx(wide * drawn[axis].coefficients[label].std, rel=1e-6)


def test_coefficients_of_what_is_left_are_of_the_given_model_and_know_less_by_outliers():
    rng = np.random.default_rng(3)
    x, spoilt = rng.standard_normal(N), rng.random(N) < 0.05
    x += 30.0 * spoilt * rng.choice([-1, 1], N)
    record = aj.Recording.from_array(x, RATE, gyro_unit="deg/s", names=["gyro_x"])
    given = aj.fit(record, "N + K", as_is=True)
    again = aj.critique(record, given).refit()
    assert again.template == given.template
    share = spoilt.mean()
    assert again["gyro_x"].widening == pytest.approx(np.sqrt(1.0 / (1.0 - share) + share), rel=1e-3)


def test_lines_and_steps_of_the_given_model_are_fitted_again_to_what_is_left():
    """Only what the critique itself has found is taken out: here an outlier, beside a step and a line."""
    x, place = np.random.default_rng(4).standard_normal(N), np.arange(N)
    x += line(0.5) + 0.4 * (place >= 8_000)
    x[5_000] += 25.0
    record = aj.Recording.from_array(x, RATE, gyro_unit="deg/s", names=["gyro_x"])
    model = aj.AngleRandomWalk() + aj.Sinusoid() + aj.BiasStep(time=8_000 / RATE)
    given = aj.fit(record, model, "whittle", as_is=True)
    found = aj.critique(record, given)
    assert [f.cause for f in found.findings] == ["outliers"]
    old, new = (fit["gyro_x"].coefficients for fit in (given, found.refit()))
    assert list(new) == list(old)
    deg = np.pi / 180.0
    for label, true in (("sinusoid_amplitude", 0.5 * deg), ("sinusoid_frequency", 3.2173)):
        assert abs(new[label].value - true) < 4.0 * new[label].std
    step = new["bias_step_amplitude"]
    assert abs(step.value - 0.4 * deg) < 4.0 * step.std
    # Without the outlier the white noise is at its level.
    assert new["angle_random_walk"].value < old["angle_random_walk"].value


BEHIND = [("rounded", "gyro_x", 0.06), ("more", "gyro_2", 0.025), ("rounded", "gyro_y", 0.04)]


@pytest.mark.parametrize(("name", "axis", "tolerance"), BEHIND)
def test_noise_behind_rounding_repeats_and_a_range_has_its_level(name, axis, tolerance):
    """What was rounded, repeated or clipped is drawn within what is known of it, with its noise."""
    # Steps of 1.8 deviations, a twelfth of the samples repeated, a fifth of them clipped: without their noise
    # N would be 13 % too large, 4 % and 20 % too small. Draws between limits are about a local mean of 200
    # samples, which costs some per cent.
    found = ct.critique(name)
    (true,) = (h.own["angle_random_walk"] for h in ct.hidden_in(name) if h.axis == axis)
    level = np.std(np.diff(found[axis].stages[-1].x)) / np.sqrt(2.0 * found.rate)
    assert level == pytest.approx(true, rel=tolerance)
    assert found.models[axis]["angle_random_walk"].coefficient == pytest.approx(true, rel=tolerance)


def test_steps_of_the_output_and_a_range_are_those_of_measured_samples():
    """What was drawn is no multiple of a step, and may be beyond a range."""
    x = np.random.default_rng(12).standard_normal((N, 2))
    x = np.column_stack([np.round(x[:, 0]), np.clip(x[:, 1], -1.5, 1.5)])
    effects = [c for c in EFFECTS if c.name in ("rounding", "saturation", "repeated_samples")]
    found = aj.critique(np.where(LOST[:, None], np.nan, x), **OPTIONS, effects=effects)
    (step,), (limits,) = ([f for f in found[axis].findings if f.cause != "unexplained"] for axis in found)
    assert step.parameters["step"].value == pytest.approx(1.0)
    assert limits.parameters["upper_level"].value == pytest.approx(1.5)
    assert limits.parameters["lower_level"].value == pytest.approx(-1.5)
    clipped = np.sum(abs(x[~LOST, 1]) == 1.5)
    assert limits.parameters["fraction"].value == pytest.approx(clipped / N)


def test_a_critique_of_segments_starts_from_a_fit_of_all_of_them():
    """No estimate from n samples of white noise is better than one part in √(2n) (Cramér and Rao)."""
    lengths = 2_000, 3_000, 2_500, 2_500, 2_000
    x = np.random.default_rng(8).standard_normal((sum(lengths), 1))
    lost = np.zeros(len(x), bool)
    lost[np.cumsum(lengths)[:-1]] = True
    x[lost] = np.nan
    found = aj.critique(x, rate=RATE, gyro_unit="deg/s", gaps="segments", effects=only("sinusoid"))
    N = found.fit["gyro"]["N"]
    assert 1.0 / np.sqrt(2.0 * sum(lengths)) < N.std / N.value < 0.9 / np.sqrt(2.0 * max(lengths))
    assert any("longest segment" in note for note in found.notes)
