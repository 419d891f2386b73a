"""Static sensors of any grade, their noise and what can be detected in it; from NumPy and SciPy alone.

A sensor is a dict of its coefficients in SI: N, and where present Q, B, K, M and Tc (Markov amplitude q and
correlation time), R (ramp). Spectra are two-sided: N², K²/(2πf)², B²/(2πf), (2πf)² Ts Q² and
(M Tc)²/(1 + (2πf Tc)²). Limits are computed in the record's cosine basis (DCT-II), whose squared
coefficients have about the expectation rate·S(f_j) at f_j = j·rate/(2n); j = 0, the bias, is unknown to
every detector. Limits of known paths are exact. For those of noise the coefficients count as independent,
which they are of N and K and nearly of the others.
"""

import functools

import numpy as np
import scipy.fft
import scipy.interpolate
import scipy.optimize
import scipy.signal
import scipy.sparse.linalg

from benchmarks.common.truth import cosine_variances

DETECTABLE_LLR = 12.5  # expected log-likelihood ratio at the limit, nats
DETECTABLE_SNR = np.sqrt(2.0 * DETECTABLE_LLR)
DEG = np.pi / 180.0
# Log-uniform ranges of N [rad/√s or m/s/√s] and the standard deviation of the bias.
GRADES = {
    ("gyro", "navigation"): ((0.001 * DEG / 60.0, 0.01 * DEG / 60.0), 0.01 * DEG / 3600.0),
    ("gyro", "tactical"): ((0.01 * DEG / 60.0, 0.2 * DEG / 60.0), 5.0 * DEG / 3600.0),
    ("gyro", "consumer"): ((0.2 * DEG / 60.0, 2.0 * DEG / 60.0), 0.5 * DEG),
    ("accel", "navigation"): ((0.001 / 60.0, 0.01 / 60.0), 9.8),
    ("accel", "tactical"): ((0.01 / 60.0, 0.1 / 60.0), 9.8),
    ("accel", "consumer"): ((0.1 / 60.0, 0.6 / 60.0), 9.8),
}


def log_uniform(rng, low, high):
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def draw_sensor(rng, duration, rate, without=(), certain=()):
    """A sensor whose terms cross its white noise at log-uniform times, `certain` ones and none `without`."""
    kind, grade = list(GRADES)[rng.integers(len(GRADES))]
    white = log_uniform(rng, *GRADES[kind, grade][0])
    odds = {"Q": 0.25, "B": 0.5, "K": 0.5, "M": 0.2, "R": 0.2}
    present = {c for c, p in odds.items() if rng.random() < p}
    crossing = {
        "Q": log_uniform(rng, 2.0, 30.0) / rate,
        "B": log_uniform(rng, min(5.0, duration / 20.0), duration / 5.0),
        "K": log_uniform(rng, min(20.0, duration / 5.0), duration),
        "R": log_uniform(rng, duration / 20.0, duration),
    }
    correlation_time = log_uniform(rng, duration / 1000.0, duration / 10.0)
    coefficients = {
        "N": white,
        "Q": white * np.sqrt(crossing["Q"] / 3.0),
        "B": white / np.sqrt(crossing["B"] * 2.0 * np.log(2.0) / np.pi),
        "K": white * np.sqrt(3.0) / crossing["K"],
        "M": white / correlation_time * np.sqrt(log_uniform(rng, 1.0, 100.0)),
        "R": rng.choice([-1.0, 1.0]) * white * np.sqrt(2.0) / crossing["R"] ** 1.5,
    }
    chosen = ({"N"} | present | set(certain)) - set(without)
    sensor = {"kind": kind, "grade": grade, "bias": GRADES[kind, grade][1] * rng.uniform(-1.0, 1.0)}
    sensor |= {c: float(coefficients[c]) for c in "NQBKMR" if c in chosen}
    return sensor | ({"Tc": correlation_time} if "M" in chosen else {})


def autocovariance(term, n, rate, correlation_time=np.nan):
    """At lags 0 … n−1, of a stationary term whose coefficient is one."""
    match term:
        case "N":
            return np.concatenate([[rate], np.zeros(n - 1)])
        case "Q":
            return rate**2 * np.concatenate([[2.0, -1.0], np.zeros(n - 2)])
        case "B":
            size = scipy.fft.next_fast_len(2 * n, real=True)  # of synthesize()
            lines = size / (2.0 * np.pi * np.arange(1, size // 2 + 1))
            return scipy.fft.irfft(np.concatenate([[0.0], lines]), size)[:n]
        case "M":
            return 0.5 * correlation_time * np.exp(-np.arange(n) / (rate * correlation_time))
    raise ValueError(term)


@functools.lru_cache(maxsize=16)
def term_variances(term, n, rate, correlation_time=np.nan):
    """Expected squared cosine coefficients j = 1 … n−1 of a term whose coefficient is one."""
    half_angle = np.pi * np.arange(1, n) / (2.0 * n)
    sine = 4.0 * np.sin(half_angle) ** 2
    match term:
        case "N":
            return np.full(n - 1, rate)
        case "Q":  # the second summand: the two ends of the record
            return rate**2 * (sine + 4.0 * np.cos(half_angle) ** 2 / n)
        case "K":
            return 1.0 / (rate * sine)
    return cosine_variances(autocovariance(term, n, rate, correlation_time))


def variances(sensor, n, rate):
    """Expected squared cosine coefficients j = 1 … n−1 of a sensor's noise."""
    terms = [c for c in "NQBKM" if c in sensor]
    return sum(sensor[c] ** 2 * term_variances(c, n, rate, sensor.get("Tc")) for c in terms)


def white_std(sensor, rate):
    """Standard deviation from sample to sample: of white noise and quantization."""
    return float(np.sqrt(sensor.get("N", 0.0) ** 2 * rate + 2.0 * (sensor.get("Q", 0.0) * rate) ** 2))


def synthesize(density, n, rate, rng):
    """Stationary noise [n] of a two-sided density (a function of frequency in Hz), by a twice as long FFT."""
    size = scipy.fft.next_fast_len(2 * n, real=True)
    frequencies = np.arange(1, size // 2 + 1) * rate / size
    normal = rng.standard_normal((2, len(frequencies)))
    lines = np.sqrt(density(frequencies) * rate * size / 2.0) * (normal[0] + 1j * normal[1])
    lines[-1] *= np.sqrt(2.0 - size % 2)  # at the Nyquist frequency there is a real part only
    return scipy.fft.irfft(np.concatenate([[0.0], lines]), size)[:n]


def term_noise(term, n, rate, rng, correlation_time=np.nan):
    """Noise [n] of a term whose coefficient is one."""
    match term:
        case "N":
            return np.sqrt(rate) * rng.standard_normal(n)
        case "Q":
            return rate * np.diff(rng.standard_normal(n + 1))
        case "B":
            return synthesize(lambda f: 1.0 / (2.0 * np.pi * f), n, rate, rng)
        case "K":
            return np.cumsum(rng.standard_normal(n)) / np.sqrt(rate)
        case "M":
            decay = np.exp(-1.0 / (rate * correlation_time))
            innovations = rng.standard_normal(n)
            innovations[1:] *= np.sqrt(1.0 - decay**2)
            return np.sqrt(correlation_time / 2.0) * scipy.signal.lfilter([1.0], [1.0, -decay], innovations)
    raise ValueError(term)


def coloured_noise(sensor, n, rate, rng):
    """All of a sensor's noise [n] but the white one."""
    terms = [c for c in "QBKM" if c in sensor]
    return sum((sensor[c] * term_noise(c, n, rate, rng, sensor.get("Tc")) for c in terms), np.zeros(n))


def covariance_product(sensor, n, rate):
    """The function that multiplies a vector [n] by the covariance matrix of a sensor's noise."""
    terms = [c for c in "NQBM" if c in sensor]
    lagged = sum(sensor[c] ** 2 * autocovariance(c, n, rate, sensor.get("Tc")) for c in terms)
    circulant = scipy.fft.rfft(np.concatenate([lagged, [0.0], lagged[:0:-1]])).real
    walk = sensor.get("K", 0.0) ** 2 / rate

    def product(x):
        later = np.cumsum(x[::-1])[::-1]
        return scipy.fft.irfft(circulant * scipy.fft.rfft(x, 2 * n), 2 * n)[:n] + walk * np.cumsum(later)

    return product


def matched_filter_snr(sensor, n, rate, shape):
    """Signal-to-noise ratio to a detector that knows the noise and the shape [n], but not the bias.

    By conjugate gradients, for which the cosine basis all but diagonalizes the covariance.
    """
    product = covariance_product(sensor, n, rate)
    weights = np.concatenate([[0.0], 1.0 / variances(sensor, n, rate)])

    def centred_product(x):
        y = product(x)
        return y - np.mean(y)

    def approximate_inverse(x):
        return scipy.fft.idct(weights * scipy.fft.dct(x, norm="ortho"), norm="ortho")

    matrix, preconditioner = (
        scipy.sparse.linalg.LinearOperator((n, n), f, dtype=float)
        for f in (centred_product, approximate_inverse)
    )
    shape = shape - np.mean(shape)
    filtered, _ = scipy.sparse.linalg.cg(matrix, shape, rtol=1e-3, maxiter=30, M=preconditioner)
    return float(np.sqrt(shape @ filtered))


def matched_filter_limit(sensor, n, rate, shape):
    """The factor of the shape [n] that makes it detectable."""
    return DETECTABLE_SNR / matched_filter_snr(sensor, n, rate, shape)


def solve(llr):
    """The x > 0 at which the growing function llr(x) reaches what is detectable."""

    def excess(log_x):
        return np.log(max(llr(np.exp(log_x)), 1e-300) / DETECTABLE_LLR)

    low = high = 0.0
    while excess(low) > 0.0:
        low -= 3.0
    while excess(high) < 0.0:
        high += 3.0
    return float(np.exp(scipy.optimize.brentq(excess, low, high, xtol=1e-6)))


def power_limit(ratio, share=1.0):
    """The detectable power of a stochastic effect in a share of the record.

    ratio: its squared cosine coefficients at unit power over those of the noise.
    """
    return solve(lambda x: 0.5 * share * np.sum(x * ratio - np.log1p(x * ratio)))


def basic_model_limit(sensor, n, rate, power):
    """The detectable factor of the power [n−1] where its alternative is the best sum of N, Q, B and K."""
    bins = np.unique(np.geomspace(1, n, 300).astype(int)) - 1
    counts = np.diff(bins)
    noise, power = (np.add.reduceat(p, bins[:-1]) / counts for p in (variances(sensor, n, rate), power))
    basis = np.stack([np.add.reduceat(term_variances(c, n, rate), bins[:-1]) / counts for c in "NQBK"], 1)
    basis /= np.exp(np.mean(np.log(basis), 0))

    def divergence(x):
        truth = noise + x * power
        model = truth
        for _ in range(15):  # Fisher scoring of the Gaussian likelihood
            weights = np.sqrt(counts) / model
            model = basis @ scipy.optimize.nnls(basis * weights[:, None], truth * weights)[0]
        return 0.5 * np.sum(counts * (truth / model - 1.0 - np.log(truth / model)))

    unit = np.min(noise) / np.median(power)
    return solve(lambda x: divergence(x * unit)) * unit


def draw_temperature(n, rate, rng):
    """A few degrees [n + n // 20]: a slow sinusoid, a smooth random walk and a warm-up."""
    t = np.arange(n + n // 20) / n
    weights = rng.exponential(1.0, 3)
    knots = np.linspace(0.0, t[-1], 31)
    walk = scipy.interpolate.CubicSpline(knots, np.cumsum(rng.standard_normal(31)) / np.sqrt(30.0))(t)
    slow = np.sin(2.0 * np.pi * (rng.uniform(0.5, 4.0) * t + rng.random()))
    settling = -np.exp(-t / log_uniform(rng, 0.05, 0.5))
    return rng.uniform(15.0, 40.0) + np.array([slow, walk, 2.0 * settling]).T @ weights


def draw_length(rng, duration, rate):
    """Number of samples, at most 400 000, and rate: 10–60 min at 50–400 Hz where not given."""
    duration = duration or log_uniform(rng, 600.0, 3600.0)
    rate = rate or log_uniform(rng, 50.0, min(400.0, 400_000 / duration))
    return round(duration * rate), rate
