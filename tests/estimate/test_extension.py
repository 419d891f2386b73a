"""Fits of axes that the plain terms do not follow, and of models with a response."""

import dataclasses
import re

import bench
import golden_records as golden
import numpy as np
import pytest
from dense_fits import recording
from scipy.signal import butter, freqz, lfilter

import allanjax as aj

RATE, N = 100.0, 16_384


@pytest.mark.parametrize("name", ["one_pole", "resonance", "filtered"])
def test_an_axis_that_the_plain_terms_do_not_follow_is_corrected(name):
    """N is within four standard deviations; of the plain fit these are wider, or it is no measurement."""
    fit, record = bench.fit(name), bench.truth(name)
    for k, (axis, result) in enumerate(fit.items()):
        truth, plain, c = record.truth[axis], result.plain, result["N"]
        assert result.measured
        assert abs(c.value - truth["angle_random_walk"]) < 4.0 * c.std
        assert not plain.measured or plain["N"].std > 1.2 * c.std
        assert (plain.own_template, plain.widening) == (None, 1.0)
        # The model is what was measured, up to a hundredth and four standard errors.
        ratio = fit.curve.deviation[:, k] / fit.model_deviation(axis, fit.curve.cluster_time)
        edf = fit.curve.edf[:, k]
        assert (abs(ratio - 1.0) < 4.0 / np.sqrt(2.0 * edf) + 0.01)[edf > 50.0].all()
        # Filter, resonances and lines are told apart from the terms of the sensor.
        assert set(result.further) == {c.term for c in result.coefficients.values()} - set(plain.coefficients)
        response, text = result.own_template.response, result.correction
        assert (response is None) == (name == "resonance")
        assert text.startswith("corrected for a ")
        if response is not None:
            (bandwidth,) = re.findall(r"([\d.]+) Hz bandwidth", text)
            assert float(bandwidth) == pytest.approx(result.model.response.half_power, rel=5e-3)
        if found := result.coefficients.get("low_pass1_bandwidth"):
            assert abs(found.value - truth["low_pass1_bandwidth"]) < 4.0 * found.std
        if name != "one_pole":
            place = next(c for k, c in result.coefficients.items() if re.match(r"resonance\w*_freq", k))
            assert f"{place.value:.3g}" in text
            assert abs(place.value - truth["resonance_frequency"]) < 4.0 * place.std
        # From the plain N to that of the whole model.
        told, units = re.search(r"([\d.]+) → ([\d.]+)", text), [plain["N"].in_unit(), c.in_unit()]
        assert [float(x) for x in told.groups()] == pytest.approx([u.value for u in units], rel=0.01)
        assert text.endswith(units[1].unit)
    assert str(fit).count("corrected for") == len(fit)
    assert "resonance quality" not in str(fit)
    assert not any(r.own_template for r in bench.fit("small").results)


def test_without_extensions_it_is_the_plain_fit():
    fit, again = bench.fit("filtered"), bench.fit("filtered", plain=True)
    for name, result in fit.without_extensions().items():
        assert result.own_template is None
        assert result["N"].value == again[name]["N"].value == fit[name].plain["N"].value
        assert result.mean == fit[name].mean
        assert again[name].own_template is None
    for name in fit.axes:
        assert fit.as_for(name).objective == "whittle"
        assert fit.as_for(name).template == fit[name].own_template
    # Terms that the user gave are what is fitted.
    assert bench.fit("filtered", "N + K", plain=False)[fit.axes[0]].own_template is None


def test_regressors_leave_the_terms_plain():
    """A fit with regressors has no extension, which would be without them."""
    record = bench.recording("one_pole")
    slow = np.sin(np.arange(record.n) / 5000.0) + np.arange(record.n) / record.n
    whole = dataclasses.replace(record, auxiliary={"temperature": slow})
    found = aj.fit(whole, None, "whittle", regressors="temperature", as_is=True)
    assert all(result.own_template is None and result.regression for result in found.results)


@pytest.mark.parametrize("inside", [True, False])
def test_a_resonance_inside_a_filter_is_told_from_one_after_it(inside):
    rng = np.random.default_rng(31)
    white, wave = rng.standard_normal(N), golden.oscillator(rng, N, 0.6, 20.0, 15.0)
    w = np.exp(-2.0 * np.pi * 15.0 / RATE)
    x = lfilter([1.0 - w], [1.0, -w], white + wave * inside) + wave * (not inside)
    (result,) = aj.fit(recording(0.01 * x, RATE), as_is=True, vibrating=True).results
    flags = dict(zip(result.own_template.term_labels, result.own_template.inside, strict=True))
    assert (flags["resonance"], flags["angle_random_walk"]) == (inside, True)
    # White noise is known to a per cent beside a filter.
    assert result["N"].value == pytest.approx(0.001, rel=0.04)
    assert result["resonance_frequency"].value == pytest.approx(20.0, rel=0.006)


def test_resonances_take_nothing_from_white_noise_and_are_no_filter():
    """Of three records that chance has made look otherwise; 0.01 is four standard deviations."""
    n, x = 2**17, []
    for seed, std, places in ((163, 0.75, [11.0]), (5, 0.7, [2.0, 11.0]), (12, 0.7, [2.0, 11.0])):
        rng = np.random.default_rng(seed)
        waves = [(f, 10.0 if f < 5.0 else 9.0) for f in places]
        x.append(rng.standard_normal(n) + sum(golden.oscillator(rng, n, std, *wave) for wave in waves))
    fit = aj.fit(
        np.transpose(x), rate=RATE, gyro_unit="rad/s", names=["gyro_x", "gyro_y", "gyro_z"], as_is=True
    )
    for result, count in zip(fit.results, (1, 2, 2), strict=True):
        assert result.model.response is None
        assert sum(label.startswith("resonance") for label in result.model.term_labels) == count
        assert result["N"].value == pytest.approx(0.1, rel=0.01)


@pytest.mark.parametrize("seed", [1, 3])
def test_a_motor_whose_speed_wanders_is_one_resonance_and_no_filter(seed):
    """A tone whose frequency is a Gauss–Markov process of 3 s; its flanks are no resonance's."""
    rng, n, spread = np.random.default_rng(seed), 2**17, 0.6
    kept = np.exp(-1.0 / (3.0 * RATE))
    drive = np.sqrt(1.0 - kept**2) * rng.standard_normal(n)
    speed = 31.0 + spread * lfilter([1.0], [1.0, -kept], drive)
    x = rng.standard_normal(n) + 0.8 * np.sin(2.0 * np.pi * np.cumsum(speed) / RATE)
    (result,) = aj.fit(recording(0.01 * x, RATE), as_is=True).results
    assert result.model.response is None
    (peak,) = [term for term in result.model.terms if isinstance(term, aj.WanderingResonance)]
    # The record holds some 440 times of correlation: the mean is known to 0.04 Hz. The width of the
    # oscillators, a third of the spread, takes a part of it.
    assert peak.frequency == pytest.approx(31.0, abs=0.15)
    assert peak.spread == pytest.approx(spread, rel=0.25)
    # White noise is known to 0.3 %; the flanks leave as much.
    assert result["N"].value == pytest.approx(0.001, rel=0.012)
    assert result.fits


def test_noise_after_a_mean_is_found_where_that_is_zero():
    """Without it, N was up to seven of its standard deviations off in these records."""
    n, x = 2**18, []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        mean = lfilter(np.ones(5) / 5.0, [1.0], rng.standard_normal(n + 5))[5:]
        x.append(mean + 0.024 * rng.standard_normal(n))
    for result in aj.fit(recording(np.transpose(x), RATE), as_is=True, vibrating=True).results:
        assert isinstance(result.model.response, aj.MovingAverage)
        assert abs(result["N"].value - 0.1 * np.hypot(1.0, 0.024)) < 4.0 * result["N"].std
        # A mean of five samples, whose bandwidth is known to about a thousandth.
        assert result.model.response.half_power == pytest.approx(0.4429465 * RATE / 5.0, rel=4e-3)


def test_a_line_in_a_deep_stop_band_leaves_a_fit():
    """Levels 80 dB below those of the pass band, most of which the ends of the record cause."""
    rng, n = np.random.default_rng(6), 118_042
    x = lfilter(*butter(4, 0.25), rng.standard_normal(n))
    line = 2.0 * np.cos(2.0 * np.pi * 18.3 / RATE * np.arange(n) + 1.0)
    (result,) = aj.fit(recording(x + line, RATE), as_is=True, vibrating=True).results
    # Four standard deviations of white noise in the pass band.
    assert result["N"].value == pytest.approx(0.1, rel=0.03)
    assert isinstance(result.model.response, aj.Butterworth)


def test_steep_filters_are_found_with_their_order():
    """Of a sixth and of an eighth order, and three means, rounded to a deviation or not."""
    n, rng = 2**16, np.random.default_rng(14)
    means = np.convolve(np.convolve(np.ones(4), np.ones(4)), np.ones(4)) / 64.0
    filters = [(*butter(6, 0.7),), (*butter(8, 0.35),), (means, [1.0])]
    x = np.transpose([lfilter(*own, rng.standard_normal(n + 999))[999:] for own in filters])
    for step in (0.0, x.std(axis=0)):
        rounded = step * np.rint(x / step) if np.any(step) else x
        found = aj.fit(recording(rounded, RATE), as_is=True, vibrating=True).results
        responses = [result.model.response for result in found]
        assert [type(r) for r in responses] == [aj.Butterworth, aj.Butterworth, aj.MovingAverage]
        # Rounding hides the zeros of means, and with them whether there are three or four.
        assert [r.order for r in responses] in ([6, 8, 3], [6, 8, 4 if np.any(step) else 3])
        half = [35.0, 17.5, 0.2619382 * RATE / 4.0]
        # With four means in place of three it is 2 % off.
        assert [r.half_power for r in responses] == pytest.approx(half, rel=0.03)
        # White noise that the rounding adds, of step²/12.
        truth = 0.1 * np.hypot(1.0, step * np.ones(3) / np.sqrt(12.0))
        assert [abs(r["N"].value - N) < 4.0 * r["N"].std for r, N in zip(found, truth, strict=True)] == [
            1
        ] * 3


def test_a_deep_stop_band_has_what_the_ends_of_a_record_add():
    """It scatters as two numbers do, in all levels alike; these did not fit then."""
    n = 2**16
    x = [lfilter(*butter(4, 0.14), np.random.default_rng(s).standard_normal(n + 999))[999:] for s in range(6)]
    found = aj.fit(recording(np.transpose(x), RATE), as_is=True, vibrating=True).results
    assert [result.discrepancy for result in found] == [0.0] * 6
    # Four standard deviations; of the mean square of six, 1 ± 0.58, it is 3.3.
    pulls = np.array([(result["N"].value - 0.1) / result["N"].std for result in found])
    assert abs(pulls).max() < 4.0
    assert np.mean(pulls**2) < 3.3


def test_weak_noise_after_a_steep_filter_is_found():
    """A thousandth of what is before it, a millionth of the power; two of these did not fit then."""
    n, x, section = 2**17, [], butter(2, 0.225)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        filtered = lfilter(*section, rng.standard_normal(n + 999))[999:]
        x.append(filtered + 1e-3 * rng.standard_normal(n))
    # From 46 Hz on there is little else. It may be rounding as well, which has the same spectrum there.
    f = np.linspace(46.0, 49.0, 5)
    exact = 0.01 * (1e-6 + abs(freqz(*section, worN=f, fs=RATE)[1]) ** 2)
    for result in aj.fit(recording(np.transpose(x), RATE), as_is=True, vibrating=True).results:
        assert result.discrepancy == 0.0
        assert abs(result["N"].value - 0.1) < 4.0 * result["N"].std
        # There are 10,000 coefficients: four standard deviations are 6 %.
        np.testing.assert_allclose(result.model.sampled(RATE).sampled_psd(f, RATE), exact, rtol=0.06)


def test_white_noise_is_as_uncertain_as_the_place_of_a_resonance():
    """Inside the filter or after it, χ² is the same within 2, but N differs by 1.8 % of it."""
    rng, n, w = np.random.default_rng(0), 2**17, 1.7
    filtered = lfilter([1.0 - np.exp(-w)], [1.0, -np.exp(-w)], rng.standard_normal(n + 999))[999:]
    record = recording(filtered + golden.oscillator(rng, n, 0.8, 20.0, 13.0), RATE)
    (result,) = aj.fit(record, as_is=True, vibrating=True).results
    of, each = result.own_template, []
    for inside in (True, False):
        flags = [
            inside if k.startswith("resonance") else own
            for k, own in zip(of.term_labels, of.inside, strict=True)
        ]
        model = dataclasses.replace(of, inside=tuple(flags))
        each.append(aj.fit(record, model, "whittle", as_is=True, vibrating=True).results[0])
    values, stds = np.transpose([(one["N"].value, one["N"].std) for one in each])
    assert abs(each[0].chi2 - each[1].chi2) < 2.0
    assert abs(np.diff(values)) > 3.0 * max(stds)
    # Of such odds at least a twentieth is for the other place.
    assert result["N"].std > np.hypot(max(stds), abs(np.diff(values)[0]) * np.sqrt(0.05))
    assert abs(result["N"].value - 0.1) < 3.0 * result["N"].std


@pytest.mark.parametrize("quality", [3.0, 4.0])
def test_a_resonance_that_is_measured_is_not_white_noise(quality):
    """At low frequencies it has 1/Q² of the density at its peak, which counts as N below Q = 2.5 only."""
    rng, n = np.random.default_rng(9), 2**18
    x = rng.standard_normal(n) + golden.oscillator(rng, n, 2.0, 25.0, quality)
    (result,) = aj.fit(recording(x, RATE), as_is=True, vibrating=True).results
    assert result["resonance_quality_factor"].value == pytest.approx(quality, rel=0.04)
    assert abs(result["N"].value - 0.1) < 4.0 * result["N"].std


def test_a_mean_over_many_samples_is_found():
    """White noise, twenty times as fast as the samples: each zero of the response is a trap."""
    # The record tells 28 samples' duration to a thousandth; 0.05 is a tenth of the way to a next maximum.
    fine, width, rng = 20, 560, np.random.default_rng(5)
    total = np.cumsum(rng.standard_normal((N + 28) * fine))
    x = (total[width:] - total[:-width])[::fine][:N] / width
    (result,) = aj.fit(recording(x, RATE), "moving_average * N", "whittle", as_is=True).results
    assert abs(0.4429465 * RATE / result["moving_average_bandwidth"].value - 28.0) < 0.05
    assert result.misfit is None


def test_a_butterworth_filter_stays_below_half_the_sample_rate():
    """White noise alone: there is no filter, and none beyond what there can be."""
    x = np.random.default_rng(2).standard_normal(2048)
    model = aj.Butterworth(45.0) * (aj.AngleRandomWalk() + aj.RateRandomWalk())
    (result,) = aj.fit(recording(x, RATE), model, "whittle", as_is=True).results
    assert 40.0 < result["butterworth_bandwidth"].value < RATE / 2.0


NOISE = aj.AngleRandomWalk(1e-3) + aj.BiasInstability(2e-5)
ROUNDED = aj.Butterworth(23.0) * NOISE + aj.Quantization(1.7e-5)


@pytest.mark.parametrize(
    "truth",
    [aj.MovingAverage(37.0) * NOISE, aj.LowPass2(45.0, 0.57) * NOISE, ROUNDED],
    ids=["mean", "two poles", "rounded"],
)
def test_quantization_is_told_from_the_shape_of_a_filter(truth):
    """Three sensors each: quantization is detected where there is some, within three of its deviations."""
    # At half the sample rate two poles and a mean have nearly the same response: the whole density holds to 4
    # %, three deviations of a sixth of an octave of 65,536 samples and of N. Bandwidths hold to four.
    f, label = np.geomspace(2.0, 48.0, 12), "_".join(truth.response.name().split())
    x = np.stack([aj.simulate(truth, 2**16, RATE, seed) for seed in (1, 2, 3)], axis=1)
    for result in aj.fit(recording(x, RATE), as_is=True, vibrating=True).results:
        assert abs(result["N"].value - 1e-3) < 3.0 * result["N"].std
        rounding = result["quantization"]
        assert rounding.detected == (truth is ROUNDED)
        if truth is ROUNDED:
            assert abs(rounding.value - 1.7e-5) < 3.0 * rounding.std
            assert result.model.response.order == 2
        else:
            assert rounding.value == 0.0
        if label != "low_pass2":
            bandwidth = result[f"{label}_bandwidth"]
            assert abs(bandwidth.value - truth.response.bandwidth) < 4.0 * bandwidth.std
        found, exact = (model.sampled(RATE).sampled_psd(f, RATE) for model in (result.model, truth))
        np.testing.assert_allclose(found, exact, rtol=0.04)


@pytest.mark.parametrize("seed", [3, 4])
def test_axes_of_one_sensor_have_one_kind_of_filter(seed):
    """Alone, the axis with a resonance that wanders has two means, or two poles, in its place."""
    noise = aj.AngleRandomWalk(7e-4) + aj.BiasInstability(2e-4)
    plain = aj.MovingAverage(36.0) * noise
    moving = aj.MovingAverage(36.0) * (noise + aj.WanderingResonance(4e-3, 20.0, 100.0, 0.5))
    models = {"gyro_x": plain, "gyro_y": plain, "gyro_z": moving}
    found = aj.fit(aj.simulate_recording(models, 1 << 17, RATE, seed))
    for result in found.results:
        bandwidth = result["moving_average_bandwidth"]
        assert result.model.response.order == 1
        assert abs(bandwidth.value - 36.0) < 4.0 * bandwidth.std
        assert abs(result["N"].value - 7e-4) < 4.0 * result["N"].std
