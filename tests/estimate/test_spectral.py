"""The joint spectral model: expected levels and derivatives by dense covariances, maxima by scipy."""

import functools

import numpy as np
import pytest
from dense_fits import Spectrum, mover, recording, slopes
from numpy.testing import assert_allclose
from scipy.optimize import minimize

import allanjax as aj
from allanjax.estimate.evidence import power_fits
from allanjax.estimate.spectral.fit import Arrangement
from allanjax.estimate.spectral.model import maximize

# Of so many samples every level is one coefficient, of which expectations are exact.
RATE, N = 10.0, 65
WHITE = aj.AngleRandomWalk(0.1)
AFTER = aj.Markov(0.02, 1.5) + aj.Resonance(0.03, 2.0, 6.0) + aj.RateRandomWalk(0.002)
AFTER += aj.WanderingResonance(0.02, 3.0, 9.0, 0.4)
RESPONSES = [None, aj.LowPass1(1.5), aj.LowPass2(1.5, 0.8), aj.MovingAverage(2.0), aj.Biquad(1.5, 0.8)]
RESPONSES += [aj.Butterworth(1.7, order) for order in (1, 2, 3, 4, 8)]
RESPONSES += [aj.MovingAverage(2.0, order) for order in (2, 4)]


class Dense(Spectrum):
    """Mean squares of so many coefficients of simulated records, under R · Σ terms inside + Σ terms after."""

    # R is what becomes of white noise, the record's ends included.
    def __init__(self, model, count, seed):
        super().__init__(np.zeros(N), RATE, np.arange(1, N + 1))
        self.count = count
        self.level = self.means(model) * np.random.default_rng(seed).chisquare(count, N - 1) / count

    def means(self, model):
        return self.squares(model)

    def squares(self, model):
        filtered = model.response * aj.AngleRandomWalk(1.0) if model.response else aj.AngleRandomWalk(1.0)
        passed = super().squares(filtered) / RATE
        inside = model.inside or (False,) * len(model)
        terms = zip(model.terms, inside, strict=True)
        return sum(super(Dense, self).squares(term) * (passed if within else 1.0) for term, within in terms)


@functools.cache
def bins():
    x = np.random.default_rng(0).standard_normal(N)
    return aj.fit(recording(x, RATE), "N", "whittle", as_is=True).results[0].spectrum.bins


def prepared(model, dense, free):
    """Arrangement, joint model and parameters of a model with values; `free`: whether all are estimated."""
    model = aj.Model(()) + model
    arrangement = Arrangement.of(model, bins()).with_data(dense.level, np.full(N - 1, dense.count))
    theta = arrangement.composition.parameters
    theta[: len(model)] = squared_amplitudes(model) * arrangement.unit_power(theta)
    return arrangement, arrangement.joint(free), theta


def squared_amplitudes(model):
    return np.array([getattr(term, term.amplitude_parameter().name) ** 2 for term in model.terms])


@pytest.mark.parametrize("response", RESPONSES, ids=str)
def test_expected_levels_and_their_derivatives_are_those_of_dense_covariances(response):
    """In logarithms: levels to 10⁻¹⁰; derivatives to the error of five points, 10⁻⁷ for a resonance."""
    # Those by a filter's shape are differences with a step of 10⁻⁴, of a power of up to the eighth order:
    # they are off by 10⁻⁸/6 · 8³ at most.
    model = (response * WHITE if response else WHITE) + AFTER
    dense, power, labels = Dense(model, 1, 0), squared_amplitudes(model), list(model.values)
    mean, (arrangement, joint, theta) = dense.means(model), prepared(model, dense, False)
    found = maximize(theta, joint, arrangement.levels, arrangement.levels.level)
    assert_allclose(found.mean[: N - 1], mean, rtol=1e-10)
    base, by_shape = arrangement.unit_levels(found)
    amplitudes, shapes = iter(2.0 * power[:, None] * base), iter(np.einsum("t,tms->sm", power, by_shape))
    expected = slopes(lambda m: np.log(dense.means(m)), model, labels)
    for p, exact in zip(model.parameters, expected, strict=True):
        own = next(amplitudes if p.parameter.is_amplitude else shapes)[: N - 1] / mean
        assert_allclose(own, exact, rtol=0.0, atol=1e-6 if p.term == len(model) else 1e-7, err_msg=p.label)


def test_the_maximum_is_that_of_a_general_minimizer():
    """White noise, flicker and a resonance behind a filter: the same loss, and the same standard errors."""
    # Levels of fifty records determine every parameter; the general minimizer is off by 10⁻³ of its error.
    truth = aj.LowPass1(1.5) * (WHITE + aj.BiasInstability(0.2) + aj.Resonance(0.3, 2.0, 6.0))
    dense, labels = Dense(truth, 50, 3), [p.label for p in truth.parameters if p.free]
    start = truth.with_values(**{k: 1.3 * v for k, v in truth.values.items()})
    arrangement, joint, theta = prepared(start, dense, True)
    found = maximize(theta, joint, arrangement.levels, arrangement.levels.level)
    move = mover(truth, labels)
    # In units of the expected errors.
    root = np.linalg.inv(np.linalg.cholesky(dense.information(truth, labels))).T
    best = minimize(lambda z: dense.value(move(move.start + root @ z)), np.zeros(len(labels)), method="BFGS")
    assert found.converged
    assert float(found.loss) == pytest.approx(best.fun, abs=1e-6)
    inside, count = np.array(found.interior), len(truth)
    errors = 1.0 / np.sqrt(np.diag(np.linalg.inv(np.asarray(found.information)[np.ix_(inside, inside)])))
    # Of powers in ln(p + scale), as errors of amplitudes in ln.
    by_amplitude = np.ones(len(inside))
    by_amplitude[:count] = 2.0 * found.theta[:count] / (found.theta[:count] + found.scale)
    exact = np.linalg.inv(dense.information(move(move.start + root @ best.x), labels))
    own = 1.0 / errors / by_amplitude[inside]
    assert_allclose(sorted(own), sorted(np.sqrt(np.diag(exact))), rtol=1e-3)


def test_a_moving_average_of_whole_samples_is_found():
    """There the slope of the likelihood jumps; by a general minimizer nothing beside it is more likely."""
    noise, start = WHITE + aj.Resonance(0.3, 2.0, 6.0), aj.AngleRandomWalk(0.13) + aj.Resonance(0.4, 2.2, 9.0)
    dense = Dense(aj.MovingAverage.of(3.0 / RATE) * noise, 50, 4)
    arrangement, joint, theta = prepared(aj.MovingAverage.of(2.4 / RATE) * start, dense, True)
    found = maximize(theta, joint, arrangement.levels, arrangement.levels.level)
    duration = aj.MovingAverage(float(np.exp(found.theta[-2])) * RATE / (2.0 * np.pi)).duration
    assert (found.converged, duration * RATE) == (True, pytest.approx(3.0, abs=1e-9))
    for samples in (2.99, 3.0, 3.01):
        move = mover(aj.MovingAverage.of(samples / RATE) * noise, [p.label for p in noise.parameters])
        best = minimize(lambda z, move=move: dense.value(move(move.start + z)), np.zeros(4)).fun
        assert best == pytest.approx(found.loss, abs=1e-4) if samples == 3.0 else best > found.loss + 1e-4


def test_powers_are_those_of_a_bounded_minimizer():
    """Three batches, of models with a term that is not there, whose power ends at zero, or without one."""
    # To 10⁻³ nats: models that do not describe the levels are allowed no more than the usual steps.
    rng, f = np.random.default_rng(4), np.geomspace(1e-3, 0.5, 60)
    every, shape, at_zero = np.stack([f**k for k in (0.0, -1.0, -2.0, 2.0)]), np.geomspace(0.5, 200.0, 60), 0
    used = np.array([[1, 1, 0, 0], [1, 0, 1, 0], [1, 1, 1, 0], [1, 1, 1, 1]], bool)
    for truth in ([1.0, 0.03, 0.0, 0.0], [1.0, 0.0, 1e-4, 3.0], [0.5, 0.02, 1e-4, 0.0]):
        rough = truth @ every
        level = rough * rng.gamma(shape) / shape
        power, loss = power_fits(level, shape, rough, np.stack([every] * 4), used=used)
        for p, value, own in zip(power, loss, used, strict=True):
            scale = 1.0 / np.sqrt((every[own] / rough) ** 2 @ shape)

            def minus_log(x, unit=every[own] * scale[:, None], level=level):
                mean = np.maximum(x @ unit, 1e-12)
                return shape @ (np.log(mean) + level / mean), unit @ (shape / mean * (1.0 - level / mean))

            how = {"jac": True, "method": "L-BFGS-B", "options": {"ftol": 1e-15, "gtol": 1e-8}}
            found = minimize(minus_log, [30.0] * len(scale), bounds=[(0.0, None)] * len(scale), **how)
            assert value == pytest.approx(found.fun, abs=1e-3)
            # An error of 10⁻³ nats is one of √0.002 standard deviations.
            assert_allclose(p[own] / scale, found.x, rtol=0.0, atol=0.05)
            assert (p[~own] == 0.0).all()
            at_zero += np.sum(found.x == 0.0)
    assert at_zero == 3


def test_a_search_takes_few_joint_fits(monkeypatch):
    """Of a filter and two resonances: some 40, about three for each component and a third of them swaps.

    Six of these show whether halves of the record need the filter.
    """
    inside = aj.AngleRandomWalk(1e-3) + aj.RateRandomWalk(1e-5)
    after = aj.Resonance(3e-3, 9.0, 15.0) + aj.Resonance(2e-3, 33.0, 20.0)
    x, calls = aj.simulate(aj.LowPass1(20.0) * inside + after, 2**16, 100.0, 1), []
    place = "allanjax.estimate.spectral.model.maximize"
    monkeypatch.setattr(place, lambda *args: calls.append(1) or maximize(*args))
    (result,) = aj.fit(recording(x, 100.0), as_is=True, vibrating=True).results
    assert {"low_pass1_bandwidth", "resonance_1_frequency", "resonance_2_frequency"} <= {*result.coefficients}
    assert 5 < len(calls) <= 48
