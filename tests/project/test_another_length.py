"""What is compiled is of use to the next recording, and a fit takes few programs and little memory."""

import tracemalloc

import bench
import jax
import numpy as np
import pytest
from compilations import compilations
from dense_fits import recording

import allanjax as aj

RATE = 100.0
NOISE = aj.AngleRandomWalk(1e-3) + aj.RateRandomWalk(1e-5)
FILTERED = aj.LowPass1(20.0) * NOISE + aj.Resonance(3e-3, 9.0, 15.0) + aj.Resonance(2e-3, 33.0, 20.0)


def in_sevenths(recording):
    accumulator = aj.AllanAccumulator(recording.rate, recording.axes)
    for piece in np.array_split(recording.values, 7):
        accumulator.update(piece)


CURVES = (aj.allan_deviation, aj.power_spectrum, aj.autocorrelation, aj.wavelet_variance)


def test_a_second_length_compiles_nothing():
    whole = bench.recording("small")
    for call in (*CURVES, aj.inspect, aj.select_terms, in_sevenths):
        call(whole)
        with compilations() as compiled:
            call(whole.between(0.0, 94.77))
        assert compiled == [], call


def simulated(model, n, seed):
    return recording(aj.simulate(model, n, RATE, seed), RATE)


def drawn_from(fit):
    with pytest.warns(aj.PosteriorWarning):
        aj.sample(fit, max_steps=20, progress=False)


def test_memory_of_a_fit_is_some_records():
    """NumPy's arrays at the peak: 6.3 records, of which the transform, its squares and phases are four."""
    n = 10**6
    white, walk = np.random.default_rng(5).normal(size=(2, n))
    x = 1e-2 * white + 1e-6 * np.cumsum(walk)
    whole = recording(x, RATE)
    # Modules and traces of programs do not grow with the record.
    aj.fit(recording(x[: n // 2], RATE))
    tracemalloc.start()
    aj.fit(whole)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 7.5 * whole.values.nbytes


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


def test_a_first_fit_compiles_few_programs_and_a_second_one_none():
    """Of other terms and another length, and its posterior: they are data of the same programs."""
    # Allan variances and a fit by them. Samples of up to the same power of two share one of Allan variances.
    # This is the last test, as it forgets all.
    resonant = NOISE + aj.Resonance(3e-3, 25.0, 15.0)
    first, second = simulated(FILTERED, 60_000, 1), simulated(resonant, 41_234, 2)
    jax.clear_caches()
    with compilations() as compiled:
        drawn_from(aj.fit(first, as_is=True, vibrating=True))
        aj.fit(first, "N + K + markov", "whittle", as_is=True)
    assert 1 <= len(compiled) <= 3, compiled
    with compilations() as compiled:
        drawn_from(fit := aj.fit(second, as_is=True, vibrating=True))
        aj.fit(second, "Q + N + B + markov", "whittle", as_is=True)
    assert compiled == []
    assert "resonance_frequency" in fit.results[0].coefficients
