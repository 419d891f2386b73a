"""Results of a critique: every number by its definition, models that can be simulated, and refusals."""

import dataclasses

import critic_truth as ct
import numpy as np
import pytest
from bench import critique, fit, recording, truth

import allanjax as aj
from allanjax.critic import Discrepancy

DEG, N = np.pi / 180.0, ct.N
SI = {"deg/s": DEG, "g": 9.80665, "deg": DEG, "m/s": 1.0, "µg": 9.80665e-6}
SI |= {"arcsec": DEG / 3600.0, "deg/√h": DEG / 60.0, "deg/h": DEG / 3600.0, "deg/h/√h": DEG / 216_000.0}
SI |= {"m/s/√h": 1.0 / 60.0, "m/s/h/√h": 1.0 / 216_000.0}


def single():
    """Findings of single axes, each with its critique and its place in the axis."""
    for name in ("two_effects", "steps", "telegraph", "temperature", "outliers", "louder", "hum", "more"):
        found = ct.critique(name)
        for axis in found.results:
            for k, finding in enumerate(axis.findings):
                yield found, axis, k, finding


def squares(x, m):
    """Half the mean square difference of successive means of m samples; a mirror image continues them."""
    total = np.cumsum(np.r_[0.0, np.tile(np.r_[x, x[::-1]], 2)])
    d = total[2 * m :] - 2.0 * total[m:-m] + total[: -2 * m]
    return 0.5 * np.mean(d[: 2 * len(x)] ** 2) / m**2


def weights(m):
    """Weight of each coefficient's square in such a mean square."""
    return 2.0 * np.sin(m * ct.ANGLE / 2.0) ** 4 / (N * (m * np.sin(ct.ANGLE / 2.0)) ** 2)


def of_finding(stages, finding, m):
    """Allan variance of clusters of m samples with a finding and without it, the rest as it is at last."""
    whole, lacking = stages[-1], stages[finding.stage]
    noise = weights(m) @ whole.variance
    if lacking.x is whole.x:
        return noise, weights(m) @ lacking.variance
    if finding.cause in ("bias_step", "warm_up", "telegraph", "temperature"):
        return noise + squares(lacking.x - whole.x, m), noise
    return noise + squares(lacking.x - lacking.x.mean(), m) - squares(whole.x - whole.x.mean(), m), noise


def test_a_change_is_the_share_that_a_finding_alone_has():
    """At the cluster time where it is largest; where it is notable, as far as a fourth of the record."""
    times = np.unique(np.rint(2.0 ** np.arange(0.0, np.log2(N / 4.0) + 0.01, 0.25)))
    for found, axis, k, finding in single():
        change = finding.change
        if axis.stages[-1].ramp:
            continue

        def share(m, axis=axis, finding=finding):
            having, missing = of_finding(axis.stages, finding, m)
            return (having - missing) / max(having, missing)

        at, first, last = (x * found.rate for x in (change.time, change.first, change.last))
        # Weights are constant in bins of two thousandths.
        assert change.share == pytest.approx(share(round(at)), abs=5e-3), (axis.axis.name, finding.cause)
        every = {m: abs(share(int(m))) for m in times}
        assert max(every.values()) < change.size + 0.02
        notable = [m for m, size in every.items() if size > 0.025]
        if notable:
            assert first <= 1.2 * min(notable)
            assert last >= max(notable) / 1.2
        assert finding.stage == k + 1
        assert at <= N / 4


NAMES = ["two_effects", "telegraph", "temperature", "hum", "louder", "warm_up", "one_pole", "more"]


@pytest.mark.parametrize("name", NAMES)
def test_a_change_is_that_by_the_true_effect(name):
    """Its share of the Allan variance of the true noise, with its true course or spectrum and without it."""
    found = ct.critique(name)
    for h in ct.hidden_in(name):
        (finding,) = [f for f in found[h.axis].findings if f.cause == h.cause]
        change, own = finding.change, ct.levels(h.own)
        m = round(change.time * found.rate)
        having, missing = (weights(m) @ v for v in (h.levels, own))
        if h.path is not None:
            having += squares(h.path, m)
        if h.cause == "variance_change":
            inside = (h.truth["end"] - h.truth["start"]) * found.rate / N
            having = missing * (1.0 + inside * (h.truth["ratio"] ** 2 - 1.0))
        if h.cause == "repeated_samples":
            continue
        true = (having - missing) / max(having, missing)
        # Sizes of effects are known to a tenth or better, and noise at long times to a third.
        assert change.share == pytest.approx(true, abs=0.08), (h.axis, h.cause)


def test_effects_have_no_change_where_they_cannot_be_alone():
    (shared,) = critique("common").shared_findings
    assert shared.change is None
    assert np.isnan(Discrepancy("psd", 1.0, "Hz", 0.0, 1.0, "g", 0.5).size)


def test_stages_are_the_record_without_any_finding_without_each_and_with_all():
    for _, axis, _, finding in single():
        assert len(axis.stages) == len(axis.findings) + 2
        path = axis.stages[finding.stage].x - axis.stages[-1].x
        if finding.cause == "warm_up":
            model = axis.model["warm_up"]
            shape = model.sign * np.exp(-ct.TIME / model.time_constant)
            np.testing.assert_allclose(path / model.amplitude, shape, atol=2e-2)
        elif finding.cause == "sinusoid":
            assert np.std(path) * np.sqrt(2.0) == pytest.approx(axis.model["sinusoid"].amplitude, rel=0.01)
        elif finding.domain == "frequency" or finding.cause == "power_law":
            np.testing.assert_array_equal(path, 0.0)


def test_a_critique_keeps_no_arrays_that_can_be_recomputed():
    """Stages are many and as long as the record; a figure makes what it needs anew."""
    found = aj.critique(recording("two_effects").select("accel_z"))
    found.plot()
    (axis,) = found.results
    assert len(axis.stages) == 3
    for stage in axis.stages:
        assert set(vars(stage)) == {field.name for field in dataclasses.fields(stage)}


def test_the_sum_of_gains_is_that_of_the_critique():
    for found in (ct.critique("more"), critique("common"), critique("lines")):
        own = [f for axis in found.results for f in axis.findings] + list(found.shared_findings)
        assert found.gain == pytest.approx(sum(f.gain for f in own if f.gain is not None))


@pytest.mark.parametrize("name", ["two_effects", "rounded", "lines"])
def test_plain_data_have_every_number(name):
    found = critique(name)
    data = found.to_dict()
    assert data["gain_nats"] == pytest.approx(found.gain)
    assert list(data["recording"].values()) == [name, N, 100.0, pytest.approx(N / 100.0)]
    for written, finding in zip(data["findings"], found.findings, strict=True):
        assert (written["cause"], written["gain_nats"]) == (finding.cause, finding.gain)
        sizes = {axis: [e["value"], e["unit"]] for axis, e in written["amplitudes"].items()}
        assert sizes == {axis: [e.value, e.unit] for axis, e in finding.amplitudes.items()}
    for axis, written in zip(found.results, data["axes"], strict=True):
        assert [written[key] for key in ("axis", "sensor", "unit")] == [*dataclasses.astuple(axis.axis)]
        assert written["tests"] == dict(axis.tests)
        assert written["extended"]["terms"] == list(axis.model.term_labels)
        white = written["extended"]["parameters"]["angle_random_walk"]
        assert white["value"] * SI[white["unit"]] == pytest.approx(axis.model.values["angle_random_walk"])
        assert written["baseline"]["terms"] == list(axis.baseline.term_labels)
        after = {d.statistic: d for d in axis.after}
        for d, own in zip(axis.before, written["discrepancies"], strict=True):
            for same, numbers in ((d, own), (after[d.statistic], own["after"])):
                assert numbers["p_value"] == same.p_value
                assert (numbers["measured"], numbers["simulated"]) == (same.measured, same.simulated)
        for finding, own in zip(axis.findings, written["findings"], strict=True):
            for label, e in finding.parameters.items():
                numbers = [own["parameters"][label][key] for key in ("value", "unit", "std")]
                assert numbers == [e.value, e.unit, e.std if np.isfinite(e.std) else None]
            assert own["rivals"] == [{"cause": r.cause, "odds": r.odds} for r in finding.rivals]
            keys = ("axes", "p_value", "evidence_nats", "gain_nats", "span")
            numbers = [[*finding.axes], finding.p_value, finding.evidence, finding.gain, [*finding.span]]
            assert [own[key] for key in keys] == numbers
            change = [own["change"][key] for key in ("share", "time_s", "psd_share", "frequency_hz")]
            c = finding.change
            assert change == [c.share, c.time, c.density, c.frequency]


def test_a_table_has_a_row_for_each_parameter_of_each_axis():
    found = critique("two_effects")
    table = found.to_dataframe()
    numbers = ["value", "std", "unit", "limit"]
    assert list(table.columns) == ["axes", "cause", "parameter", *numbers, "p_value", "gain"]
    assert len(table) == sum(len(f.parameters) + len(f.details) for f in found.findings)
    for f in found.findings:
        rows = table[table.cause == f.cause].set_index("parameter")
        for label, e in f.parameters.items():
            assert list(rows.loc[label, ["value", "std", "unit", "gain"]]) == [e.value, e.std, e.unit, f.gain]
    shared = critique("lines").to_dataframe()
    (line,) = critique("lines").findings
    assert set(shared["axes"]) == {", ".join(line.axes), *line.axes}
    for axis, e in line.amplitudes.items():
        own = shared[(shared["axes"] == axis) & (shared.parameter == "amplitude")].iloc[0]
        assert (own["value"], own["std"], own["unit"]) == (e.value, e.std, e.unit)
    assert len(found["gyro_x"].to_dataframe()) == 2


@pytest.mark.parametrize("name", ["two_effects", "more", "hum", "telegraph"])
def test_a_simulation_is_like_the_record(name):
    """Bias, step, warm-up and the phase of a line are as recorded, in the recording's units; noise is not."""
    found, given = ct.critique(name), ct.record_of(name).recording()
    again = found.simulate(5)
    assert (again.names, again.axes) == (given.names, given.axes)
    assert (again.rate, again.n, again.notes[0]) == (given.rate, given.n, "simulated")
    for h in ct.hidden_in(name):
        k, white = given.names.index(h.axis), h.own["angle_random_walk"] * np.sqrt(given.rate)
        simulated, recorded = (r.values[:, k] for r in (again, given))
        assert np.std(simulated) == pytest.approx(np.std(recorded), rel=0.15)
        if h.path is not None and name != "telegraph":
            left, path = simulated - h.path, h.path - h.path.mean()
            # N is known to half a per cent, and the path to a twentieth of its size.
            assert np.std(np.diff(left)) / np.sqrt(2.0) == pytest.approx(white, rel=0.03)
            # Of the noise of both records, and of the path as it was found.
            scale = np.linalg.norm(ct.coefficients(path) / np.sqrt(h.levels))
            error = ct.coefficients(left) @ (ct.coefficients(path) / h.levels) / scale
            assert abs(error) < 4.0 * np.sqrt(2.0), h.axis
            if name == "more":
                assert simulated.mean() == pytest.approx(recorded.mean(), abs=5.0 * white / np.sqrt(N))
    assert found.simulate(5, n=2_000).n == 2_000


def test_what_has_no_term_or_no_channel_is_left_out_with_a_note():
    for name, axis, cause in (("outliers", "gyro_y", "outliers"), ("louder", "gyro_x", "variance change")):
        assert f"{axis}: not simulated: {cause}" in " ".join(critique(name).simulate(1).notes)
        assert critique(name)[axis].left_out == (cause.replace(" ", "_"),)
    assert "gyro_x, gyro_z" in " ".join(critique("common").simulate(1).notes)
    found, given = critique("temperature"), recording("temperature")
    again, without = (found.simulate(6, auxiliary=channels) for channels in (given.auxiliary, None))
    assert "temperature" in " ".join(without.notes)
    assert "temperature" not in " ".join(again.notes)
    effect, (hidden,) = again.values - without.values, ct.hidden_in("temperature")
    np.testing.assert_array_equal(effect[:, 1:], 0.0)
    # The coefficient is known to a sixtieth, the lag to a hundredth of a period.
    assert np.corrcoef(effect[:, 0], hidden.path)[0, 1] > 0.995
    assert np.std(effect[:, 0]) == pytest.approx(np.std(hidden.path), rel=4.0 / 60.0)
    with pytest.raises(aj.RecordingError, match="temperature"):
        found.simulate(6, auxiliary={"temperature": given.auxiliary["temperature"][:-1]})


def test_what_no_cause_explains_is_reported_once_for_each_axis():
    found = aj.critique(recording("two_effects"), effects=[])
    for axis in found.results:
        worst = min(axis.after, key=lambda d: d.p_value)
        if worst.p_value >= 1e-6:
            assert axis.findings == ()
            continue
        (left,) = axis.findings
        assert (left.cause, left.axes) == ("unexplained", (axis.axis.name,))
        assert left.details["statistic"] == worst.statistic
        assert left.p_value == worst.p_value < 1e-6
        numbers = {"measured": worst.measured, "simulated": worst.simulated, "where": worst.where}
        assert {label: left.parameters[label].value for label in numbers} == numbers
        # The place: a frequency that the record resolves.
        (low, high), spacing = left.span, 1.0 / found.duration
        assert low < worst.where < high
        assert high - low == pytest.approx(2.0 * spacing, rel=1e-3)
        assert left.rest == worst
        assert left.domain == ("time" if worst.where_unit == "s" else "frequency")
    assert len(found["accel_z"].findings) == 1
    assert found.gain == 0.0
    assert all(axis.before == axis.after for axis in found.results)
    # With its effects nothing is left.
    whole = critique("two_effects")
    assert all(d.p_value > 1e-6 for axis in whole.results for d in axis.after)


def test_terms_of_a_given_fit_that_are_no_basic_ones_stay_in_the_model():
    given, known = recording("line"), fit("line", truth("line").model, "whittle")
    found = aj.critique(given, known)
    assert found.findings == ()
    assert found.fit.axes == known.axes
    assert set(found.models["gyro_x"].term_labels) == {"angle_random_walk", "rate_random_walk", "sinusoid"}
    simulated = found.simulate(1).values[:, 0]
    wave = np.exp(2j * np.pi * 3.21 * np.arange(given.n) / given.rate)
    lines = [2.0 / given.n * abs(np.vdot(wave, x - x.mean())) for x in (simulated, given.values[:, 0])]
    assert lines[0] == pytest.approx(lines[1], rel=0.15)


def test_what_cannot_be_criticized_is_refused():
    x, known = np.random.default_rng(1).standard_normal(N), fit("line", truth("line").model, "whittle")
    failed = dataclasses.replace(known.results[0], converged=False, reason="no luck")
    response = dataclasses.replace(known, template=aj.LowPass1() * aj.AngleRandomWalk())
    for options, error, word in (
        ({"recording": x[:1023]}, aj.FitError, "1024"),
        ({"false_alarms": 0.0}, aj.AllanjaxError, "false_alarms"),
        ({"false_alarms": 1.0}, aj.AllanjaxError, "false_alarms"),
        ({"fit": known, "names": ["gyro_y"]}, aj.AllanjaxError, "gyro_y"),
        ({"fit": dataclasses.replace(known, results=(failed,))}, aj.FitError, "no luck"),
        ({"fit": response}, aj.FitError, "response"),
        ({"rate": None}, aj.AllanjaxError, "rate"),
    ):
        given = {"recording": x, "rate": 100.0, "gyro_unit": "deg/s", "names": ["gyro_x"]} | options
        with pytest.raises(error, match=word):
            aj.critique(**given)
