"""What is compiled is of use to the next recording: programs do not depend on numbers of samples."""

import bench
import numpy as np
import pytest
from compilations import compilations

import allanjax as aj


def in_sevenths(recording):
    accumulator = aj.AllanAccumulator(recording.rate, recording.axes)
    for piece in np.array_split(recording.values, 7):
        accumulator.update(piece)


CURVES = (aj.allan_deviation, aj.power_spectrum, aj.autocorrelation, aj.wavelet_variance)


def test_a_second_length_compiles_nothing():
    recording = bench.recording("small")
    for call in (*CURVES, aj.inspect, in_sevenths):
        call(recording)
        with compilations() as compiled:
            call(recording.between(0.0, 94.77))
        assert compiled == [], call


@pytest.mark.usefixtures("no_windows")
def test_what_is_made_of_a_fit_compiles_nothing(tmp_path):
    fit, spectrum = bench.fit("small"), aj.power_spectrum(bench.recording("small"))
    with compilations() as compiled:
        aj.plot_psd(spectrum, fit)
        aj.write_json(fit, tmp_path / "a.json")
        aj.write_curve_csv(fit, tmp_path / "a.csv")
        told = f"{fit}{spectrum}{fit.to_dataframe()}{fit.plot()}"
        fit.model_deviation("gyro_x", np.geomspace(0.05, 7.0, 13))
        aj.export(fit, "kalibr")
        aj.navigate(fit, [3.0])
        fit["accel_z"].model.state_space(100.0)
    assert compiled == []
    assert "gyro_y" in told
