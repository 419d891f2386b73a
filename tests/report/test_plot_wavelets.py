"""Pictures of autocorrelations, wavelet variances and decompositions show the numbers of their results."""

import numpy as np
import pytest
from figures import check_texts_apart, panels

import allanjax as aj

pytestmark = pytest.mark.usefixtures("no_windows")
HOUR = np.pi / 180.0 / 3600.0


def test_autocorrelations_are_drawn_with_the_band_of_the_model(small_recording):
    found = aj.autocorrelation(small_recording, model=aj.AngleRandomWalk(6e-5) + aj.Markov(3e-4, 2.0))
    figure = found.plot()
    drawn = panels(figure)
    assert set(drawn) == {"gyro_x", "gyro_y", "gyro_z", "accel_z"}
    line = next(line for line in drawn["gyro_x"].get_lines() if line.get_label() == "estimate")
    np.testing.assert_allclose(line.get_ydata(), found.value[:, 0] / HOUR**2)
    (band,) = drawn["gyro_x"].collections
    top = band.get_paths()[0].vertices[:, 1].max()
    assert top == pytest.approx((found.value[0, 0] + 1.959964 * found.standard_error[0, 0]) / HOUR**2)


def test_an_axis_is_drawn_into_axes_of_the_callers(small_recording):
    import matplotlib.pyplot as plt

    found = aj.autocorrelation(small_recording)
    figure, ax = plt.subplots()
    assert found.plot("gyro_y", ax=ax) is figure
    assert ax.get_ylabel() == "autocorrelation\n[(deg/h)²]"
    with pytest.raises(aj.AllanjaxError, match="room for one axis"):
        found.plot(ax=ax)


def test_wavelet_variances_are_drawn_over_their_scale(small_recording):
    found = aj.wavelet_variance(small_recording, wavelet="db2")
    figure = found.plot(["gyro_x", "accel_z"])
    drawn = panels(figure)
    assert set(drawn) == {"gyro_x", "accel_z"}
    line = drawn["accel_z"].get_lines()[0]
    np.testing.assert_allclose(line.get_xdata(), found.scale)
    np.testing.assert_allclose(line.get_ydata(), found.variance[:, 3] / 9.80665e-6**2)
    check_texts_apart(figure)


def test_a_decomposition_is_drawn_part_by_part(small_recording, tmp_path):
    found = aj.wavelet_decomposition(small_recording, levels=6)
    figure = found.plot("gyro_z", [5, 6], tmp_path / "parts.png")
    labels = [axes.get_ylabel() for axes in figure.axes]
    assert labels == ["measured", "level 5\n1.6–3.1 Hz", "level 6\n0.78–1.6 Hz", "below\n0.78 Hz"]
    (drawn,) = figure.axes[2].collections
    assert drawn.get_paths()[0].vertices[:, 1].max() == pytest.approx(
        found.details(6).values[:, 2].max() / HOUR
    )
    assert (tmp_path / "parts.png").stat().st_size > 10_000
    with pytest.raises(aj.AllanjaxError, match="no axis 'gyro_w'"):
        found.plot("gyro_w")
