"""Averaged spectra of streams: fits of pieces in any grouping are those of the levels as they are defined."""

import itertools

import numpy as np
from scipy.fft import dct
from scipy.optimize import minimize

import allanjax as aj

RATE = 100.0
FACTOR, SEGMENT, LOWEST = 8, 2**13, 2**8
# Three levels, none of them a whole number of blocks or segments.
N = 2**21 + 2**18 + 12_345
# White noise, random walk, ramp, of two axes of different sensors; the ramps are eight standard deviations of
# the walks' slopes or more.
TRUTH = {"gyro_x": (0.1, 3e-3, 4e-4), "accel_z": (0.3, 0.015, 2e-3)}
LABELS = ("angle_random_walk", "rate_random_walk", "drift_ramp")


def levels(x: np.ndarray, start: int) -> tuple[np.ndarray, ...]:
    """Of every coefficient used: count, squares, products with a ramp's, its square, and expected squares.

    Level k has means of 8^k samples, whose blocks and segments begin at multiples of their length in the
    stream's numbers. The expected squares of white noise and of a random walk, of coefficients 1, are exact.
    """
    found = []
    for k in (2, 1, 0):
        block = FACTOR**k
        first = -(-start // block)
        y = x[first * block - start :]
        y = y[: len(y) // block * block].reshape(-1, block).mean(axis=1)
        length, lowest = (len(y), 1) if k == 2 else (SEGMENT, LOWEST)
        y = y if k == 2 else y[-first % SEGMENT :]
        segments = y[: len(y) // length * length].reshape(-1, length)
        stop = SEGMENT if k == 0 else int(np.ceil(LOWEST * FACTOR / SEGMENT * length))
        c = dct(segments, axis=1, norm="ortho")[:, lowest:stop]
        h = block / RATE
        ramp = dct(np.arange(length) * h, norm="ortho")[lowest:stop]
        a = np.pi * np.arange(lowest, stop) / length
        walk = h * (2.0 + np.cos(a)) / (12.0 * np.sin(a / 2.0) ** 2)
        count = np.full(len(a), len(segments))
        sums = (c**2).sum(axis=0), c.sum(axis=0) * ramp, ramp**2 * count
        found.append((count, *sums, np.full(len(a), 1.0 / h), walk))
    return tuple(map(np.concatenate, zip(*found, strict=True)))


def by_definition(x: np.ndarray, start: int, guess: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients that maximize Whittle's likelihood, and their standard errors.

    It is of every coefficient by itself, restricted: the ramp takes a degree of freedom.
    """
    count, squares, cross, gram, white, walk = levels(x, start)

    def minus_log(p: np.ndarray) -> float:
        N2, K2, R = *np.exp(2.0 * p[:2]), np.exp(p[2])
        e = N2 * white + K2 * walk
        ramp = np.log(np.sum(gram / e))
        return np.sum(count * np.log(e) + (squares - 2.0 * R * cross + R**2 * gram) / e) / 2.0 + ramp / 2.0

    options = {"xatol": 1e-7, "fatol": 1e-7, "maxiter": 4000}
    value = np.exp(minimize(minus_log, np.log(guess), method="Nelder-Mead", options=options).x)
    e = value[0] ** 2 * white + value[1] ** 2 * walk
    slopes = np.stack([2.0 * value[0] * white / e, 2.0 * value[1] * walk / e])
    covariance = np.linalg.inv((slopes * count / 2.0) @ slopes.T)
    return value, np.sqrt([*np.diag(covariance), 1.0 / np.sum(gram / e)])


def pieces_merged(x: np.ndarray, start: int) -> aj.AllanAccumulator:
    """In pieces of all sizes, of a few samples from the beginning of a block too.

    They are merged in random order; often the last two, so that a short piece meets a long one after it.
    """
    rng = np.random.default_rng(3)
    cuts = rng.integers(0, N, 9)
    blocks = FACTOR**2 * rng.integers(start // FACTOR**2 + 1, (start + N) // FACTOR**2, 9) - start
    cuts = np.unique(np.concatenate([[0, 1, 3, N - 1, N], cuts, cuts + 1, cuts + 9, blocks, blocks + 3]))
    parts = []
    for a, b in itertools.pairwise(cuts[cuts <= N].tolist()):
        parts.append(aj.AllanAccumulator(RATE, list(TRUTH), start=start + a))
        parts[-1].update(x[a:b])
    while len(parts) > 1:
        k = len(parts) - 2 if rng.random() < 0.8 else rng.integers(len(parts) - 1)
        parts[k : k + 2] = [parts[k].merge(parts[k + 1])]
    return parts[0]


def test_fits_are_those_of_the_levels_by_definition():
    """Bins of many coefficients cost some hundredths of a standard error; the truth is within four."""
    start, rng, x = 77_777, np.random.default_rng(7), np.zeros((N, 2))
    for k, (white, walk, ramp) in enumerate(TRUTH.values()):
        steps, bridge = rng.normal(size=(2, N)) / np.sqrt(RATE)
        brownian = np.cumsum(steps) - steps / 2.0 + bridge / np.sqrt(12.0)
        line = ramp * np.arange(N) / RATE
        x[:, k] = 9.8 + white * np.sqrt(RATE) * rng.normal(size=N) + walk * brownian + line
    stream = aj.AllanAccumulator(RATE, list(TRUTH), start=start)
    stream.update(x)
    model = aj.AngleRandomWalk() + aj.RateRandomWalk() + aj.DriftRamp()
    fit = stream.fit(model, "whittle", as_is=True)
    # A value that is lost between pieces would change the coefficients by 10⁻⁵.
    merged = pieces_merged(x, start).fit(model, "whittle", as_is=True)
    for name, label in itertools.product(TRUTH, LABELS):
        one, other = fit[name][label], merged[name][label]
        np.testing.assert_allclose([one.value, one.std], [other.value, other.std], rtol=1e-8)
    for k, (name, truth) in enumerate(TRUTH.items()):
        value, error = by_definition(x[:, k], start, truth)
        found = [fit[name][label] for label in LABELS]
        np.testing.assert_array_less(abs([c.value for c in found] - value), 0.05 * error)
        # The ramp's degree of freedom is missing in the walk's error, by definition.
        ratio = np.array([c.std for c in found]) / error
        np.testing.assert_array_less(abs(ratio - 1.0), [1e-4, 0.01, 0.01])
        np.testing.assert_array_less(abs(value - truth), 4.0 * error)
        assert fit[name].p_value > 1e-3
