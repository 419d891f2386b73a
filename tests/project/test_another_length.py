"""What is compiled is of use to the next recording, and a fit is few programs, few runs, little memory."""

import tracemalloc

import bench
import equinox as eqx
import jax
import numpy as np
import pytest
from compilations import compilations
from dense_fits import recording
from jax.extend.core import ClosedJaxpr, Jaxpr

import allanjax as aj
from allanjax.estimate.spectral import model as spectral
from allanjax.estimate.spectral.components import levels_of
from allanjax.spectrum.cosine import Bins

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
    for call in (*CURVES, aj.inspect, in_sevenths):
        call(whole)
        with compilations() as compiled:
            call(whole.between(0.0, 94.77))
        assert compiled == [], call


def simulated(model, n, seed):
    return recording(aj.simulate(model, n, RATE, seed), RATE)


def drawn_from(fit):
    with pytest.warns(aj.PosteriorWarning):
        aj.sample(fit, max_steps=20, progress=False)


def equations(jaxpr):
    """Number of equations, with those of loops, branches and functions within."""
    if isinstance(jaxpr, ClosedJaxpr):
        return equations(jaxpr.jaxpr)
    if isinstance(jaxpr, tuple | list):
        return sum(map(equations, jaxpr))
    if not isinstance(jaxpr, Jaxpr):
        return 0
    return sum(1 + equations(list(e.params.values())) for e in jaxpr.eqns)


def test_the_main_program_is_small():
    """Compilation takes a second for some hundred equations; 20,861 they were, and are 1,600."""
    at = spectral.FULL
    slots = spectral.Slots.of(at, np.ones(at.parameters, bool), np.zeros(at.components, bool))
    levels = levels_of(Bins.of(1000, RATE), np.zeros((0, 2, 0)), at.columns)
    made, *_ = eqx.filter_make_jaxpr(spectral.maximize)(slots.usual(), slots, levels, levels.level)
    assert 500 < equations(made) <= 1700


def test_a_search_takes_few_joint_fits(monkeypatch):
    """Of a filter and two resonances: some 23, about three for each component and a third of them swaps."""
    calls, run = [], spectral._maximize
    monkeypatch.setattr(spectral, "_maximize", lambda *args: calls.append(1) or run(*args))
    (result,) = aj.fit(simulated(FILTERED, 2**16, 1), as_is=True, vibrating=True).results
    assert {"low_pass1_bandwidth", "resonance_1_frequency", "resonance_2_frequency"} <= set(
        result.coefficients
    )
    assert 5 < len(calls) <= 35


def test_memory_of_a_fit_is_some_records():
    """NumPy's arrays at the peak: 6.3 records, of which the transform, its squares and phases are four."""
    n = 10**6
    white, walk = np.random.default_rng(5).normal(size=(2, n))
    whole = recording(1e-2 * white + 1e-6 * np.cumsum(walk), RATE)
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
    """Of other terms and another length, and its posterior: they are data of the same programs.

    Seven for choice of terms, Allan variances, their moments and a fit by them, and six of spectra. Samples
    of up to the same power of two share one of Allan variances. This is the last test, as it forgets all.
    """
    resonant = NOISE + aj.Resonance(3e-3, 25.0, 15.0)
    first, second = simulated(FILTERED, 60_000, 1), simulated(resonant, 41_234, 2)
    jax.clear_caches()
    with compilations() as compiled:
        drawn_from(aj.fit(first, as_is=True, vibrating=True))
        aj.fit(first, "N + K + markov", "whittle", as_is=True)
    assert 5 < len(compiled) <= 14, compiled
    with compilations() as compiled:
        drawn_from(fit := aj.fit(second, as_is=True, vibrating=True))
        aj.fit(second, "Q + N + B + markov", "whittle", as_is=True)
    assert compiled == []
    assert "resonance_frequency" in fit.results[0].coefficients
