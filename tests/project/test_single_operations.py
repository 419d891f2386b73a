"""What is compiled are whole programs of the package; what is only evaluated compiles nothing at all."""

import ast

import jax.numpy as jnp
import numpy as np
import pytest
from compilations import compilations
from places import ROOT

import allanjax as aj
from allanjax.report.files import write_results

#: All that a fit with a choice of terms may compile on a machine that has no program yet.
MOST = 10


def programs() -> set[str]:
    """The package's functions that are compiled as a whole, as JAX calls them."""
    trees = (ast.parse(path.read_text(encoding="utf-8")) for path in (ROOT / "allanjax").rglob("*.py"))
    functions = (n for tree in trees for n in ast.walk(tree) if isinstance(n, ast.FunctionDef))
    return {f"jit({f.name})" for f in functions if any("jit" in ast.unparse(d) for d in f.decorator_list)}


@pytest.fixture(scope="module")
def fitted():
    """A recording of a length that no other test has, its fit with terms chosen, and what that compiled."""
    n, rate = 3217, 50.0
    draw = np.random.default_rng(7).standard_normal((2, n, 2))
    values = 1e-3 * draw[0] + 2e-6 * np.cumsum(draw[1], axis=0)
    recording = aj.Recording.from_array(values, rate, gyro_unit="rad/s", names=["gyro_x", "gyro_y"])
    with compilations() as compiled:
        fit = aj.fit(recording)
    return recording, fit, compiled


def test_a_fit_compiles_few_programs_and_no_single_operations(fitted):
    _, _, compiled = fitted
    assert set(compiled) - programs() == set()
    assert len(compiled) <= MOST


def test_what_is_made_of_a_fit_compiles_nothing(fitted, tmp_path):
    """Tables, pictures, the model at other times, a PSD, exports."""
    recording, fit, _ = fitted
    with compilations() as compiled:
        spectrum = aj.power_spectrum(recording)
        paths = write_results(fit, spectrum, tmp_path, "one")
        told = f"{fit}{fit._repr_html_()}{spectrum}"
        deviation = fit.model_deviation("gyro_x", np.geomspace(0.05, 7.0, 13))
    assert compiled == []
    assert {path.suffix for path in paths} == {".json", ".csv", ".png"}
    assert "gyro_y" in told
    assert np.all(deviation > 0.0)


def test_a_single_operation_is_noticed():
    with compilations() as compiled:
        jnp.arctan(aj.simulate(aj.AngleRandomWalk(1.0), 1237, 1.0, 0))
    assert set(compiled) >= {"jit(_draw)", "jit(arctan)"}
    assert "jit(arctan)" in set(compiled) - programs()
    assert "jit(_draw)" in programs()
