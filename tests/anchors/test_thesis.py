"""Numbers printed in H. Hou, "Modeling Inertial Sensors Errors Using Allan Variance", Calgary 2004."""

import numpy as np
import pytest

import allanjax as aj

HOUR = 3600.0
GYRO = aj.Axis("gyro_x", "gyro", "rad/s")

# What needs the thesis's recordings cannot be had; all here follows from what is printed beside it.
# Samples, rate, cluster size, and the error [%] printed.
ERRORS = [
    (20_000, 100.0, 5000, "41"),  # "approximately 40 %", section 4.5
    (20_000, 100.0, 100, "5.0"),  # "about 5 %"
    (1_440_000, 200.0, 2**14, "7.59"),  # 7.58 % at "T = 100 s", section 5.2.1: that octave begins at 82 s
    (1_440_000, 200.0, 2**11, "2.67"),  # 2.7 % "till T = 10 s"
    (1_440_000, 200.0, 2**18, "33.36"),  # 33.36 % at long cluster times
    (720_000, 100.0, 2**8, "1.33"),  # 0.0068 of 0.5121, table 5.5
]
# Coefficients and their errors in tables 5.2 and 5.4. CIMU: quantization of gyro X [arcsec] and of the
# accelerometers [m/h]; ramps of the accelerometers X and Y [m/s/h²]; HG1700, their rate random walks.
ROWS = {
    2**14: "0.9732 0.0738 1.6801 0.1275 1.2980 0.0985 0.8785 0.0666",
    2**18: "2.6364 0.8795 0.8915 0.2974 0.7637 0.2548 1.1572 0.3860 3.3514 1.1180",
}


def test_errors_of_deviations_and_coefficients():
    """Of all coefficients that are read at a cluster size the same share, to the last digit printed."""

    def error(n, rate, m):
        data = {"cluster_time": np.array([m / rate]), "cluster_size": np.array([m]), "n": n, "rate": rate}
        one = np.ones((1, 1))
        curve = aj.AllanDeviation(deviation=one, count=np.array([n + 1 - 2 * m]), edf=one, **data)
        return curve.thesis_relative_error[0]

    for *case, percent in ERRORS:
        assert f"{100.0 * error(*case):.{len(percent.partition('.')[2])}f}" == percent
    for m, row in ROWS.items():
        coefficients, printed = np.array(row.split(), float).reshape(-1, 2).T
        assert coefficients * error(1_440_000, 200.0, m) == pytest.approx(printed, abs=1.1e-4)


ARCSEC, DEG = np.pi / 180.0 / 3600.0, np.pi / 180.0
READINGS = [
    # 1.60e-4 deg at √3 h is 0.5770″, the text before (5.1).
    (aj.Quantization(0.5770 * ARCSEC), 3**0.5 * HOUR, 1.60e-4 * DEG / HOUR),
    # N is read at 1 h, (5.2).
    (aj.AngleRandomWalk(0.0018 * DEG / HOUR**0.5), HOUR, 0.0018 * DEG / HOUR),
    # The flat part is 0.664 B: 11.1488 is 16.79 deg/h, (5.5).
    (aj.BiasInstability(16.79 * DEG / HOUR), HOUR, 11.1488 * DEG / HOUR),
    # K is read at 3 h, (5.4), and R at √2 h, (5.3).
    (aj.RateRandomWalk(3.3514 / HOUR**1.5), 3.0 * HOUR, 3.3514 / HOUR),
    (aj.DriftRamp(0.3915 / HOUR**2), 2**0.5 * HOUR, 0.3915 / HOUR),
]


def test_coefficients_are_where_the_thesis_reads_them():
    """To the three or four digits printed."""
    for term, time, deviation in READINGS:
        assert float(term.allan_variance(time)) ** 0.5 == pytest.approx(deviation, rel=2e-3)


TABLE_3_3 = [
    (1.22e-3, 58, 12.69), (7.05e-5, 72, 14.14), (5.70e-3, 33, 9.57), (545.05, 355, 31.40),
    (235.11, 512, 37.71), (749.58, 690, 43.78),
]  # fmt: skip


def test_table_3_3():
    """Variance [(deg/h)²], correlation time [s] and accuracy [%] of two hours, read off the curve (3.30)."""
    lag = np.arange(0.0, 720.0)
    for variance, time, accuracy in TABLE_3_3:
        value = variance * (DEG / HOUR) ** 2 * np.exp(-lag / time)[:, None]
        curve = aj.Autocorrelation(lag, value, np.full_like(value, np.nan), ("",), 7200, 1.0, (GYRO,))
        found = curve.markov()["gyro_x"].estimates
        for label, expected in (("markov variance", variance), ("markov correlation time", time)):
            estimate = found[label].in_unit()
            assert estimate.value == pytest.approx(expected, rel=1e-3)
            assert round(100.0 * estimate.std / estimate.value, 2) == pytest.approx(accuracy, abs=0.011)
        assert [e.usual_unit for e in found.values()] == ["(deg/h)²", "s"]


# First and last ordinate, ordinates averaged, points that gives.
TABLE_3_4 = [(1, 32, 1, 32)] + [(2**k + 1, 2 ** (k + 1), 2 ** (k - 4), 16) for k in range(5, 15)]


def test_table_3_4():
    """Of 32,768 ordinates, which 65,538 samples have beside those at zero and at the Nyquist frequency."""
    assert TABLE_3_4[1] == (33, 64, 2, 16)
    assert TABLE_3_4[-1] == (16385, 32768, 1024, 16)
    n, rate = 65_538, 100.0
    found = aj.power_spectrum(np.random.default_rng(0).normal(size=n), rate)
    last = np.cumsum(found.count)
    first = last - found.count + 1
    np.testing.assert_allclose(found.frequency, (first + last) / 2.0 * rate / n, rtol=1e-12)
    rows = [(first >= low) & (last <= high) for low, high, *_ in TABLE_3_4]
    for row, (_, _, averaged, points) in zip(rows, TABLE_3_4, strict=True):
        assert row.sum() == points
        assert set(found.count[row]) == {averaged}
    assert np.sum(rows) == len(found.count)
