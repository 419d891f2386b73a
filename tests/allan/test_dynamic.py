"""Allan deviations in windows against allantools, and the test of their constancy."""

import allantools
import numpy as np
import pytest
from scipy.stats import kstest

import allanjax as aj


def record(x: np.ndarray) -> aj.Recording:
    return aj.Recording.from_array(x, 50.0, gyro_unit="rad/s", names=["gyro_x"], name="long")


def test_each_window_has_the_overlapping_allan_deviation_of_its_samples():
    x = np.random.default_rng(3).normal(size=9_999)
    found = aj.dynamic_allan(record(x), window=20.0)
    # Nine windows of a thousand samples; the rest fills none.
    assert found.time == pytest.approx(10.0 + 20.0 * np.arange(9))
    for k in (0, 5, 8):
        own = x[1000 * k : 1000 * (k + 1)]
        _, expected, *_ = allantools.oadev(own, 50.0, data_type="freq", taus=found.cluster_time)
        np.testing.assert_allclose(found.deviation[k, :, 0], expected, rtol=1e-9)
    low, high = found.confidence_interval()
    assert (low < found.deviation).all()
    assert (found.deviation < high).all()


def test_p_values_of_constancy_are_uniform_for_white_noise():
    rng = np.random.default_rng(4)
    p = np.array([aj.dynamic_allan(record(rng.normal(size=12_000))).constancy[:3, 0] for _ in range(60)])
    # The logarithms of χ² variates are nearly normal where there are many degrees of freedom.
    for own in p.T:
        assert kstest(own, "uniform").pvalue > 1e-3


def test_noise_that_grows_by_a_tenth_is_seen_where_and_when_it_does():
    x = np.random.default_rng(5).normal(size=24_000)
    x[12_000:] *= 1.1
    found = aj.dynamic_allan(record(x))
    assert found.constancy[0, 0] < 1e-6
    first = found.deviation[:, 0, 0]
    assert first[12:].min() > np.median(first[:12])
    assert "p of constancy" in str(found)


def test_windows_that_are_too_short_or_too_few_are_refused(tmp_path):
    x = np.random.default_rng(6).normal(size=2_000)
    for window in (1.0, 30.0):
        with pytest.raises(aj.AllanjaxError, match="window="):
            aj.dynamic_allan(record(x), window=window)
    figure = aj.dynamic_allan(record(x), window=4.0).plot(tmp_path / "d.png")
    # One panel, whose colours are those of ten windows, and their scale.
    panel, _ = figure.axes
    assert panel.collections[0].get_array().shape[1] == 10
