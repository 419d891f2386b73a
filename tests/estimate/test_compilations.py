"""Programs that fits compile: none for another recording, whatever its length, rate, axes and basic terms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import allanjax as aj
from allanjax.estimate.allan_design import AllanDesign
from allanjax.estimate.axis_fits import solve_and_infer
from allanjax.estimate.design import free_powers
from allanjax.estimate.starts import find_starts

NAMES = ["gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z"]
_compiled = [0]


def _count(event: str, seconds: float, **_: object) -> None:
    _compiled[0] += event == "/jax/core/compile/backend_compile_duration"


jax.monitoring.register_event_duration_secs_listener(_count)


@pytest.fixture
def compiled() -> list[int]:
    """Number of programs compiled since the test set it to zero."""
    return _compiled


def recording(n: int, rate: float, axes: int) -> aj.Recording:
    """White noise, a random walk and a Markov process of five seconds, by NumPy alone."""
    rng = np.random.default_rng(n)
    white, drift, drive = rng.standard_normal((3, n, axes))
    x = 1e-3 * white + np.cumsum(1e-6 * drift, axis=0)
    state = np.zeros(axes)
    for k in range(n):
        state = state * np.exp(-1.0 / (5.0 * rate)) + 3e-5 * drive[k]
        x[k] += state
    return aj.Recording.from_array(x, rate, gyro_unit="rad/s", accel_unit="m/s²", names=NAMES[:axes])


def test_the_count_counts(compiled) -> None:
    """Of two new programs, each called twice."""
    compiled[0] = 0
    for factor in (1.25, 2.5):
        program = jax.jit(lambda x, factor=factor: factor * x + 1.0)
        program(np.ones(3))
        program(np.ones(3))
    assert compiled[0] >= 2
    compiled[0] = 0
    program(np.ones(3))
    assert compiled[0] == 0


@pytest.mark.parametrize(
    ("model", "others"),
    [
        ("N + K", ["N + K", "Q + N + B + K + R", "R + B + N"]),
        ("N + markov", ["N + markov", "K + markov + N + R"]),
    ],
)
def test_another_recording_compiles_nothing(model, others, compiled) -> None:
    """Lengths of one octave: the Allan sums, one program, are compiled for each octave and number of axes."""
    for axes in (1, 3, 5):
        aj.allan_deviation(recording(2100, 100.0, axes), cluster_times=4)
    aj.fit(recording(2100, 100.0, 2), model)
    for k, other in enumerate(others):
        compiled[0] = 0
        fit = aj.fit(recording(3000 + 500 * k, 50.0 + k, 1 + 2 * k), other)
        assert compiled[0] == 0
        assert fit.converged


@pytest.mark.filterwarnings("ignore::allanjax.PosteriorWarning")
@pytest.mark.parametrize("model", ["N + B + K", "N + markov", "low_pass1 * (N + K) + resonance"])
def test_another_spectrum_compiles_nothing(model, compiled) -> None:
    """Whittle's fits and their posteriors, for another length, rate and number of axes."""
    aj.allan_deviation(recording(2100, 100.0, 3), cluster_times=4)
    found = []
    for n, rate, axes in ((2100, 100.0, 1), (3333, 60.0, 3)):
        compiled[0] = 0
        fit = aj.fit(recording(n, rate, axes), model, objective="whittle", as_is=True)
        if model == "N + B + K":
            aj.sample(fit, axes=["gyro_x"], seed=1, max_steps=60)
        found.append(compiled[0])
    assert found[1] == 0


@pytest.mark.filterwarnings("ignore::allanjax.PosteriorWarning")
def test_another_posterior_of_allan_variances_compiles_nothing(compiled) -> None:
    for n, rate in ((2100, 100.0), (3333, 60.0)):
        fit = aj.fit(recording(n, rate, 1), "N + K", as_is=True)
        compiled[0] = 0
        aj.sample(fit, seed=1, max_steps=60)
    assert compiled[0] == 0


def test_another_choice_of_terms_compiles_nothing(compiled) -> None:
    """Other sets and another record; two Markov processes are one more program."""
    aj.select_terms(recording(2100, 100.0, 1))
    compiled[0] = 0
    aj.select_terms(recording(3333, 60.0, 1))
    assert compiled[0] == 0


def test_bulk_fits_of_another_length_compile_nothing(compiled) -> None:
    for n, axes in ((2048, 3), (5000, 5)):
        curve = aj.allan_deviation(recording(n, 100.0, axes).values, 100.0)
        compiled[0] = 0
        aj.fit_many(curve, "N + K")
    assert compiled[0] == 0


def test_room_for_more_changes_no_number() -> None:
    """That the arrays of a design are longer than need be, by cluster sizes and by terms."""
    template = aj.RateRandomWalk() + aj.Markov(None, 5.0).hold("correlation_time") + aj.AngleRandomWalk()
    values = recording(1000, 10.0, 2).values
    curve = aj.allan_deviation(values, 10.0)
    active = np.array([[True] * len(template), [True] * (len(template) - 1) + [False]])
    found = []
    for capacity in ((0, 0), (32, 6)):
        design = AllanDesign.of(template, curve.n, curve.rate, curve.cluster_size, capacity=capacity)
        assert design.padded_estimates(curve.variance.T).shape[1] == (capacity[0] or len(curve.cluster_size))
        starts = find_starts(template, design, curve.variance.T, active, [None] * 2, curve.n, curve.rate)
        found.append(solve_and_infer(design, curve.variance.T, free_powers(template), active, starts)[:2])
    assert np.all(found[0][0].converged)
    for one, other in zip(jax.tree.leaves(found[0]), jax.tree.leaves(found[1]), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-7, atol=1e-30)


def test_a_design_has_the_covariance_and_means_of_its_terms() -> None:
    """Whatever their order, and whether or not they are basic ones; zero where there is no estimate."""
    n, rate, sizes = 1000, 10.0, np.array([1, 2, 5, 20, 90])
    model = aj.RateRandomWalk() + aj.Markov() + aj.DriftRamp() + aj.Telegraph(None, 3.0).hold("dwell_time")
    model = model + aj.AngleRandomWalk()
    design = AllanDesign.of(model, n, rate, sizes, capacity=(8, 7))
    amplitudes = np.array([0.02, 0.3, 0.01, 0.4, 0.7])
    terms = [t.replace(**{t.amplitude_parameter().name: a}) for t, a in zip(model, amplitudes, strict=True)]
    terms[1] = terms[1].replace(correlation_time=4.0)
    terms[3] = terms[3].sampled(rate)
    shape, power = jnp.log(jnp.array([4.0])), jnp.asarray(design.padded_terms(amplitudes**2))
    covariance = np.asarray(design.covariance(power, design.products(shape)))
    expected = np.asarray(design.geometry.of_terms(terms))
    np.testing.assert_allclose(covariance, expected, rtol=1e-10)
    np.testing.assert_array_equal(covariance[5:], 0.0)
    mean = design.mean(power, design.means(shape))[:5]
    of_terms = sum(np.asarray(term.allan_variance(sizes / rate)) for term in terms)
    np.testing.assert_allclose(mean, of_terms, rtol=1e-12)
