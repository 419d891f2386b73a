"""What acts on several axes is one finding, with the axes and how large it is in each of them."""

import dataclasses

import numpy as np
import pytest

import allanjax as aj
from allanjax.critic.causes import BiasStep, Disturbance, Outliers, Sinusoid, VarianceChange
from allanjax.critic.critique import critique
from allanjax.critic.finding import CoefficientChange, Discrepancy, DriftChange, Finding, Rival
from allanjax.critic.merging import merged
from allanjax.critic.parameters import parameter_estimate
from allanjax.critic.result import AxisCritique, Critique, Snapshot
from allanjax.record.recording import Axis

RATE, N = 50.0, 15_000
DURATION = N / RATE
NAMES = ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")
AXES = {name: Axis(name, name[:-2], "deg/s" if name.startswith("gyro") else "g") for name in NAMES}
NAN = float("nan")
WALK, RATE_WALK = "angle_random_walk", "rate_random_walk"


# --- Records ------------------------------------------------------------------------------------------------


def six_axes(effects, seed=0):
    """White noise of 1 deg/s and 1 g, and these effects by axis."""
    x = np.random.default_rng(seed).standard_normal((N, 6))
    for name, effect in effects.items():
        x[:, NAMES.index(name)] += effect
    return aj.Recording.from_array(x, RATE, gyro_unit="deg/s", accel_unit="g", names=NAMES)


def causes(found):
    return [f.cause for f in found.findings]


@pytest.fixture(scope="module")
def vibrating():
    """A line on four axes, of which one has its harmonic only and one has both; a step on two others."""
    t = (np.arange(N) + 0.5) / RATE
    line, harmonic = (np.cos(2.0 * np.pi * f * t + 0.3) for f in (1.37, 2.74))
    step = (t > 170.0).astype(float)
    effects = {
        "accel_x": 0.3 * line,
        "accel_y": 0.2 * line + 0.15 * harmonic,
        "accel_z": 0.5 * line,
        "gyro_x": 0.12 * harmonic,
        "gyro_y": 0.3 * step,
        "gyro_z": -0.4 * step,
    }
    return critique(six_axes(effects), causes=(Sinusoid(), BiasStep()))


def test_a_line_on_four_axes_and_its_harmonic_are_one_finding(vibrating):
    assert sorted(causes(vibrating)) == ["bias_step", "sinusoid"]
    line = next(f for f in vibrating.findings if f.cause == "sinusoid")
    assert line.axes == ("gyro_x", "accel_x", "accel_y", "accel_z")
    assert line.parameters["frequency"].value == pytest.approx(1.37, abs=1e-3)
    assert [e.value for e in line.details["harmonics"]] == [2.0]
    truth = {"gyro_x": 0.12, "accel_x": 0.3, "accel_y": 0.2, "accel_z": 0.5}
    for axis, amplitude in truth.items():
        found = line.amplitudes[axis]
        assert abs(found.value - amplitude) < 4.0 * found.std
        assert found.unit == AXES[axis].unit
        assert found.remark == ("harmonic 2" if axis == "gyro_x" else "")
    parts = [f for axis in line.axes for f in vibrating[axis].findings]
    assert line.members == tuple(parts)
    assert line.gain == pytest.approx(sum(f.gain for f in parts))


def test_a_step_on_two_axes_is_one_finding(vibrating):
    step = next(f for f in vibrating.findings if f.cause == "bias_step")
    assert step.axes == ("gyro_y", "gyro_z")
    assert abs(step.parameters["time"].value - 170.0) < 1.0
    for axis, amplitude in {"gyro_y": 0.3, "gyro_z": -0.4}.items():
        assert abs(step.amplitudes[axis].value - amplitude) < 4.0 * step.amplitudes[axis].std


def test_the_gain_of_a_critique_counts_every_finding_once(vibrating):
    assert vibrating.gain == pytest.approx(sum(f.gain for f in vibrating.findings))


def test_each_finding_of_the_recording_has_one_figure_and_each_of_an_axis_if_asked_for(vibrating):
    names = vibrating.plot()
    assert len(names) == 2
    line = next(f for f in vibrating.findings if f.cause == "sinusoid")
    (figure,) = vibrating.plot(findings=[line])
    shown = line.shown
    assert f"here in {shown}" in figure.get_suptitle()
    assert shown in line.axes
    assert len(vibrating.plot(findings=vibrating["accel_x"].findings)) == 1


@pytest.fixture(scope="module")
def knocked():
    """A knock that all axes feel, by half a second of ringing and by single samples."""
    k = np.arange(N)
    ringing = (k >= 9000) * np.exp(-np.abs(k - 9000.0) / 8.0) * np.cos(1.1 * (k - 9000.0))
    gains = {
        "gyro_x": 12.0,
        "gyro_y": 15.0,
        "gyro_z": 20.0,
        "accel_x": 30.0,
        "accel_y": 12.0,
        "accel_z": 25.0,
    }
    recording = six_axes({name: gain * ringing for name, gain in gains.items()})
    return gains, critique(recording, causes=(Outliers(), Disturbance(), VarianceChange()))


def test_a_knock_on_all_axes_is_one_event(knocked):
    gains, found = knocked
    assert len(found.findings) == 1, causes(found)
    (event,) = found.findings
    assert event.axes == NAMES
    assert event.cause in ("event", "disturbance")
    start, end = (event.parameters[label].value for label in ("start", "end"))
    assert 179.0 < start <= 180.1
    assert 180.0 <= end < 183.0
    for axis, gain in gains.items():
        peak = event.amplitudes[axis]
        assert peak.unit == AXES[axis].unit
        # The noise is 1, and a disturbance's peak includes it.
        assert abs(peak.value - gain) < 5.0


# --- Findings -----------------------------------------------------------------------------------------------


def finding(cause, axis, values, gain=50.0, span=(0.0, DURATION), domain="time", **more):
    """A finding with parameters {label: (value, std, unit)}."""
    parameters = {label: parameter_estimate(AXES[axis], label, *own) for label, own in values.items()}
    return Finding(cause, (axis,), parameters, 1e-20, gain, gain, (), span, domain, **more)


def line(axis, frequency, amplitude=1.0, std=1e-4, gain=50.0):
    values = {"frequency": (frequency, std, "Hz"), "amplitude": (amplitude, 0.1, AXES[axis].unit)}
    return finding("sinusoid", axis, values, gain, (frequency - 0.1, frequency + 0.1), "frequency")


def outliers(axis, times, size=9.0, gain=50.0):
    details = {
        "times": tuple(parameter_estimate(AXES[axis], "time", t, 0.02, "s") for t in times),
        "sizes": tuple(parameter_estimate(AXES[axis], "size", -size, 1.0, AXES[axis].unit) for _ in times),
    }
    values = {"count": (float(len(times)), 0.5, "1"), "scale": (3.0, 1.0, AXES[axis].unit)}
    return finding("outliers", axis, values, gain, (times[0], times[-1]), details=details)


def told(*findings):
    return merged(findings, (), DURATION)


def test_unrelated_lines_are_not_one():
    a, b, c = line("accel_x", 1.37), line("accel_y", 1.42), line("gyro_x", 3.3)
    assert sorted(told(a, b, c), key=id) == sorted([a, b, c], key=id)


@pytest.mark.parametrize(("high", "std", "count"), [(2.74, 1e-4, 1), (2.75, 1e-4, 2), (2.75, 4e-3, 1)])
def test_a_harmonic_is_one_within_errors_and_the_resolution(high, std, count):
    assert len(told(line("accel_x", 1.37), line("gyro_x", high, std=std))) == count


def test_a_line_of_few_periods_is_not_the_fundamental_of_all_others():
    """A multiple of 0.02 Hz is never far, beside a resolution of 0.0033 Hz."""
    assert len(told(line("accel_x", 0.02), line("gyro_x", 0.2201))) == 2


def test_one_bandwidth_of_the_sensors_of_a_kind_is_one_finding():
    bandwidths = {
        "gyro_x": 28.0,
        "gyro_y": 29.0,
        "gyro_z": 27.5,
        "accel_x": 28.2,
        "accel_y": 28.0,
        "accel_z": 12.0,
    }
    own = [finding("low_pass", axis, {"bandwidth": (f, 0.3, "Hz")}) for axis, f in bandwidths.items()]
    found = told(*own)
    assert {f.axes for f in found} == {NAMES[:3], ("accel_x", "accel_y"), ("accel_z",)}
    gyros = next(f for f in found if f.axes == NAMES[:3])
    assert gyros.amplitudes["gyro_y"].value == 29.0
    assert 27.5 < gyros.parameters["bandwidth"].value < 29.0


def test_a_resonance_is_one_where_frequency_and_width_agree():
    def resonance(axis, frequency, quality):
        own = {"frequency": (frequency, 0.02, "Hz"), "quality_factor": (quality, 1.0, "1")}
        return finding(
            "resonance", axis, own | {"amplitude": (1.0, 0.1, AXES[axis].unit)}, domain="frequency"
        )

    same = [resonance("accel_x", 11.0, 20.0), resonance("accel_y", 11.1, 22.0)]
    other = [resonance("accel_z", 13.0, 20.0), resonance("gyro_x", 11.0, 3.0)]
    assert sorted(len(f.members) for f in told(*same, *other)) == [0, 0, 2]


def test_steps_of_one_axis_are_not_one():
    step = {"time": (100.0, 0.05, "s"), "amplitude": (1.0, 0.1, "deg/s")}
    a, b = (finding("bias_step", "gyro_x", step, gain) for gain in (50.0, 40.0))
    c = finding("bias_step", "gyro_y", step)
    assert sorted(f.axes for f in told(a, b, c)) == [("gyro_x",), ("gyro_x", "gyro_y")]


def test_one_change_of_variance_is_one_finding():
    def change(axis, start, ratio):
        own = {"start": (start, 0.5, "s"), "end": (250.0, 0.5, "s"), "ratio": (ratio, 0.1, "1")}
        return finding("variance_change", axis, own, span=(start, 250.0))

    found = told(change("gyro_x", 100.0, 1.5), change("gyro_y", 100.5, 2.0), change("accel_x", 60.0, 2.0))
    assert {f.axes for f in found} == {("gyro_x", "gyro_y"), ("accel_x",)}
    both = max(found, key=lambda f: len(f.axes))
    assert (both.cause, both.amplitudes["gyro_y"].value) == ("variance_change", 2.0)


def test_outliers_of_a_knock_are_an_event_and_the_others_stay_outliers():
    scattered = [13.0, 77.0, 140.0, 201.0, 290.0]
    knock = [120.0, 120.1, 120.2]
    a = outliers("accel_x", sorted([*scattered, *knock]), size=7.0)
    b = outliers("accel_y", knock, size=9.0)
    c = finding(
        "disturbance",
        "accel_z",
        {"start": (120.0, 0.1, "s"), "end": (121.0, 0.1, "s"), "peak": (11.0, 1.0, "g")},
        span=(120.0, 121.0),
    )
    d = outliers("gyro_x", [33.0, 250.0])
    found = {f.cause: f for f in told(a, b, c, d) if f.axes != ("gyro_x",)}
    assert found.keys() == {"disturbance", "outliers"}
    event, left = found["disturbance"], found["outliers"]
    assert event.details["seen_as"] == ("outliers", "disturbance")
    assert event.axes == ("accel_x", "accel_y", "accel_z")
    assert {axis: e.value for axis, e in event.amplitudes.items()} == {
        "accel_x": 7.0,
        "accel_y": 9.0,
        "accel_z": 11.0,
    }
    assert (event.parameters["start"].value, event.parameters["end"].value) == (120.0, 121.0)
    assert [t.value for t in left.details["times"]] == scattered
    assert left.parameters["count"].value == 5.0
    # What was measured once is told once: most of accel_x's outliers are scattered.
    assert (event.gain, left.gain) == (100.0, 50.0)


def test_a_knock_that_is_seen_as_outliers_only_is_one_event():
    (event,) = told(*(outliers(axis, [120.0, 120.1], size=5.0 + k) for k, axis in enumerate(NAMES)))
    assert (event.cause, event.axes) == ("event", NAMES)
    assert [e.value for e in event.amplitudes.values()] == [5.0, 6.0, 7.0, 8.0, 9.0, 10.0]
    assert event.gain == 300.0


def test_outliers_that_coincide_by_chance_are_no_event():
    rng = np.random.default_rng(0)
    own = [outliers(axis, np.sort(rng.uniform(0.0, DURATION, 200)).tolist()) for axis in NAMES[3:]]
    (found,) = told(*own)
    assert (found.cause, found.parameters["count"].value) == ("outliers", 600.0)


def test_several_findings_of_one_axis_within_an_event_are_one():
    change = {"start": (100.0, 0.2, "s"), "end": (108.0, 0.2, "s"), "ratio": (3.0, 0.1, "1")}
    loud = finding("variance_change", "gyro_x", change, span=(100.0, 108.0))
    (found,) = told(loud, outliers("gyro_x", [101.0, 102.5, 103.0]))
    assert (found.cause, found.axes, len(found.members)) == ("variance_change", ("gyro_x",), 2)


def test_rounding_is_one_finding_with_the_step_of_each_axis():
    steps = {"gyro_x": 0.05, "gyro_y": 0.05, "accel_x": 0.00333}
    own = [finding("rounding", axis, {"step": (q, 0.0, AXES[axis].unit)}, None) for axis, q in steps.items()]
    (found,) = told(*own)
    assert {axis: (e.value, e.unit) for axis, e in found.amplitudes.items()} == {
        "gyro_x": (0.05, "deg/s"),
        "gyro_y": (0.05, "deg/s"),
        "accel_x": (0.00333, "g"),
    }
    assert (found.gain, found.evidence) == (None, None)


def test_a_cause_without_a_rule_is_not_merged():
    own = [finding("hump", axis, {"amplitude": (1.0, 0.1, AXES[axis].unit)}) for axis in NAMES[:2]]
    assert {f.axes for f in told(*own)} == {("gyro_x",), ("gyro_y",)}


def test_a_rival_is_one_in_all_axes_and_a_p_value_counts_them():
    rivals = [(Rival("warm_up", 8.0), Rival("telegraph", 2.0)), (Rival("warm_up", 30.0),)]
    step = {"time": (100.0, 0.05, "s"), "amplitude": (1.0, 0.1, "deg/s")}
    both = [
        dataclasses.replace(finding("bias_step", axis, step), rivals=own, p_value=p)
        for axis, own, p in zip(NAMES, rivals, (1e-6, 1e-3), strict=False)
    ]
    (found,) = told(*both)
    assert [(r.cause, r.odds) for r in found.rivals] == [("warm_up", 240.0)]
    assert found.p_value == pytest.approx(2e-6)


# --- What matters most --------------------------------------------------------------------------------------


def allan(simulated, measured=1.0):
    return Discrepancy("allan_deviation", 10.0, "s", measured, simulated, "deg/h", 1e-9)


@pytest.mark.parametrize(
    ("change", "size", "quantity"),
    [
        ({"coefficients": (CoefficientChange(WALK, 2.0, 1.0, "deg/√h"),)}, 1.0, WALK),
        # A term that comes.
        ({"coefficients": (CoefficientChange(RATE_WALK, NAN, 3.0, "deg/h/√h"),)}, 1.0, RATE_WALK),
        ({"coefficients": (CoefficientChange("quantization", 5.0, 1.0, "arcsec"),)}, 0.0, ""),
        ({"drift": DriftChange(64.0, 1.0, 1.0, 1.5, "deg")}, 0.5, "drift"),
        # Half as large as measured before, and as large after.
        ({"discrepancies": ((allan(0.5), allan(1.0)),)}, 1.0, "allan_deviation"),
        # What is no better after is no effect of the finding.
        ({"discrepancies": ((allan(0.5), allan(0.5)),)}, 0.0, "allan_deviation"),
        ({}, 0.0, ""),
    ],
)  # fmt: skip
def test_the_effect_of_a_finding_is_the_largest_change_of_what_simulations_are_for(change, size, quantity):
    effect = dataclasses.replace(line("gyro_x", 1.0), **change).effect
    assert effect.size == pytest.approx(size)
    assert effect.quantity in (quantity, "")
    assert effect.quantity == quantity or size == 0.0


def test_findings_are_sorted_by_what_they_change_and_what_is_unexplained_is_last():
    def of(frequency, factor):
        return dataclasses.replace(
            line("gyro_x", frequency), drift=DriftChange(64.0, 1.0, 1.0, factor, "deg")
        )

    small, large = of(1.0, 1.1), of(1.6, 1 / 3.0)
    left = dataclasses.replace(large, cause="unexplained")
    assert told(left, small, large) == (large, small, left)


def critique_of(findings):
    """Critique of a gyro with these findings."""
    model = aj.Model((aj.AngleRandomWalk(1e-3),))
    stage = Snapshot(
        np.zeros(N), np.ones(N - 1), ("angle_random_walk",), {"angle_random_walk": 1e-6}, NAN, 0.0
    )
    axis = AxisCritique(AXES["gyro_x"], findings, (), (), {}, (stage,) * (len(findings) + 1), model, model)
    return Critique("bench", RATE, None, (axis,), ())


def test_the_first_screen_has_ten_findings_at_most_in_a_line_each():
    own = tuple(
        dataclasses.replace(
            line("gyro_x", 0.5 + 0.711 * k), drift=DriftChange(64.0, 1.0, 1.0, 2.0 + k, "deg")
        )
        for k in range(30)
    )
    found = critique_of(own)
    lines = str(found).splitlines()
    told_lines = [text for text in lines if text.startswith("  - ")]
    assert len(told_lines) == 10
    assert all("sinusoid" in text and len(text) <= 108 for text in told_lines)
    # The largest first.
    assert f"sinusoid {0.5 + 0.711 * 29:.4g} Hz" in told_lines[0]
    assert any(text.startswith("  and 20 more: see ") for text in lines)
    # A screen has 24 lines.
    assert len(lines) <= 24
    assert len(found.findings) == len(found.to_dict()["findings"]) == 30
    assert found.details().count("Gain 50 nats") == 30


def test_long_lists_are_not_on_the_screen_but_in_the_table_and_the_json():
    times = [0.1 * k for k in range(1268)]
    found = critique_of((outliers("gyro_x", times),))
    assert "126.7" not in found.details()
    assert "1,268" in str(found)
    assert max(len(text) for text in found.details().splitlines()) <= 108
    table = found.to_dataframe().set_index("parameter")
    assert len(table.loc["times", "value"]) == 1268
    (own,) = found.to_dict()["axes"][0]["findings"]
    assert len(own["parameters"]["times"]["value"]) == 1268
