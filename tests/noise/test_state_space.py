"""State spaces: A, H, Q, R and P0 make samples of the model's dense covariance; files hold the matrices."""

import re
import shutil
import subprocess

import dense
import numpy as np
import pytest
from noise_terms import DETERMINISTIC, RANDOM, RATE, RESPONSES
from numpy.testing import assert_allclose, assert_array_equal

import allanjax as aj

# Flicker and power laws have none that is exact.
EXACT = {n: t for n, t in RANDOM.items() if not n.startswith(("flicker", "power law"))} | DETERMINISTIC
SUM = aj.AngleRandomWalk(1e-4) + aj.RateRandomWalk(1e-4) + aj.Quantization(2e-6) + aj.Markov(1e-3, 0.15)
WAVE = aj.Resonance(1e-3, 7.0, 20.0)
MODELS = {
    **{name: aj.Model((term,)) for name, term in EXACT.items()},
    "sum": SUM + WAVE,
    **{name: r * (SUM + WAVE) + aj.Sinusoid(1e-4, 3.3) for name, r in RESPONSES.items()},
}


@pytest.mark.parametrize("name", MODELS)
def test_samples_have_the_covariance_of_the_model(name):
    """From the first sample on; what is a line or stationary by instants, with its true variance."""
    model, space = MODELS[name], MODELS[name].state_space(RATE)
    found, expected = dense.of_states(space, 64)[0], dense.covariance(model, 64, RATE)
    steps, own = (np.diff(np.diff(C, axis=0), axis=1) for C in (expected, found))
    assert_allclose(own, steps, rtol=0.0, atol=1e-9 * abs(steps).max())
    if not re.search("walk|ramp|sum", name) and name not in RESPONSES:
        assert_allclose(found, expected, rtol=0.0, atol=1e-9 * abs(expected).max())
    if name == "walk":
        # It begins at zero: the mean over the first interval has K²/(3·rate), and its end K²/rate.
        assert_allclose(np.diag(space.P0) * RATE / 6.2e-6**2, [1 / 3, 1.0], rtol=1e-12)
    # Its own curves, of the matrices alone; the Allan variance by sums over samples.
    m = np.array([1, 2, 7, 32])
    allan = [dense.allan_variance(expected, k) for k in m]
    assert_allclose(space.allan_variance(m / RATE), allan, rtol=1e-7)
    f = np.array([0.011, 0.31, 3.0, 7.1, 19.0])
    assert_allclose(space.spectrum(f), model.sampled(RATE).sampled_psd(f, RATE), rtol=1e-8)


@pytest.mark.parametrize("term", [aj.BiasInstability(1e-4), aj.PowerLaw(1e-4, 0.5), aj.PowerLaw(1e-4, 1.9)])
def test_flicker_is_within_three_percent(term):
    for rate, duration in ((50.0, 3600.0), (1000.0, 1e5)):
        space = aj.Model((term,)).state_space(rate, duration=duration)
        time = np.unique(np.geomspace(1.0, duration * rate / 2.0, 97).round()) / rate
        f = np.geomspace(1.0 / duration, rate / 2.0, 401)
        assert_allclose(space.allan_variance(time), term.allan_variance(time), rtol=0.03)
        assert_allclose(space.spectrum(f), term.sampled_psd(f, rate), rtol=0.03)


def test_names_and_units_are_those_of_the_sensor():
    model = aj.AngleRandomWalk(1e-3) + aj.Quantization(1e-5) + aj.Markov(1e-3, 3.0) + aj.DriftRamp(1e-6)
    space = model.state_space(RATE, sensor="accel")
    names = "quantization_now quantization_before markov_mean markov_end drift_ramp_value drift_ramp_slope"
    assert space.names == tuple(names.split())
    assert space.units == ("m/s", "m/s", "m/s²", "m/s²", "m/s²", "m/s³")
    assert model.state_space(RATE).units[::5] == ("rad", "rad/s²")
    assert (space.rate, space.sensor, space.size) == (RATE, "accel", 6)


MATRICES = ("A", "H", "Q", "R", "P0")


def test_files_hold_the_matrices(tmp_path):
    space = MODELS["sum"].state_space(RATE)
    space.to_numpy(tmp_path / "noise.npz")
    text = space.to_matlab()
    with np.load(tmp_path / "noise.npz") as file:
        for name in MATRICES:
            rows = re.search(rf"^{name} = \[(.*?)\];$", text, re.M | re.S)[1].split(";")
            for found in (file[name], np.array([row.split() for row in rows], float)):
                assert_array_equal(found, getattr(space, name))
        told = tuple(file["names"]), tuple(file["units"]), file["rate"]
        assert told == (space.names, space.units, RATE)
    names = re.findall(r"'([^']*)'", re.search(r"^names = {(.*)};$", text, re.M)[1])
    assert tuple(names) == space.names
    assert "A = zeros(0, 0);" in MODELS["white"].state_space(RATE).to_matlab()


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
def test_a_c_header_compiles_and_holds_the_matrices(tmp_path):
    space = MODELS["sum"].state_space(RATE)
    (tmp_path / "imu.h").write_text(space.to_c_header("imu"), encoding="utf-8")
    loops = "".join(
        f'for (int i = 0; i < {getattr(space, name).size}; i++) printf("%.17g\\n", (&imu_{name}[0][0])[i]);'
        for name in MATRICES
    )
    returned = f"return IMU_STATES != {space.size} || IMU_RATE != {RATE};"
    source = f'#include <stdio.h>\n#include "imu.h"\nint main(void) {{ {loops} {returned} }}'
    (tmp_path / "main.c").write_text(source, encoding="utf-8")
    subprocess.run(["cc", "-std=c99", "-Wall", "-Werror", "main.c"], cwd=tmp_path, check=True)
    printed = subprocess.run([tmp_path / "a.out"], check=True, capture_output=True, text=True).stdout
    expected = np.concatenate([getattr(space, name).ravel() for name in MATRICES])
    assert_array_equal(np.array(printed.split(), float), expected)


class Bare(aj.NoiseTerm):
    coefficient: float | None = aj.parameter("c", time_exponent=0.0)


REFUSED = [
    (aj.BiasInstability(1e-4), {}, "duration"), (aj.BiasInstability(1e-4, 3.0), {"duration": 9.0}, "cutoff"),
    (aj.PowerLaw(1e-4, -0.5), {"duration": 100.0}, "PowerLaw"), (aj.WarmUp(1e-4, 3.0), {}, "warm_up"),
    (aj.BiasStep(1e-4, 3.0), {}, "bias_step"), (Bare(1.0), {}, "bare"),
    (aj.AngleRandomWalk(), {}, "angle_random_walk"),
    (aj.AngleRandomWalk(1.0), {"duration": -1.0}, "duration"),
    (aj.AngleRandomWalk(1.0), {"rate": 0.0}, "rate"),
]  # fmt: skip


def test_what_has_no_state_space_is_named():
    for model, options, word in REFUSED:
        with pytest.raises(aj.AllanjaxError, match=word):
            (aj.Model(()) + model).state_space(**({"rate": RATE} | options))
    # Clusters are of whole samples.
    for T in (0.4 / RATE, 1.5 / RATE):
        with pytest.raises(aj.AllanjaxError, match="multiples"):
            MODELS["sum"].state_space(RATE).allan_variance(T)
