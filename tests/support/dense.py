"""Covariance of samples, written out: from G(t) of each term by mpmath, and from the pulses of filters.

Nothing of the package is used but the values of a model's parameters. With θ the integral of the rate, a
covariance of means over intervals h is minus the second difference of the phase covariance G over h². It is
known up to a constant: right for filters that sum to zero. Lines and ramps have the covariance of records
whose phase or sign is random. Terms that are read at the instants of the samples have that of these.
"""

import dataclasses
import functools
from collections.abc import Callable

import mpmath as mp
import numpy as np
import scipy
from scipy.linalg import toeplitz

import allanjax as aj

# Digits of mpmath: differences of t⁴ at a thousand lags, and of exponentials at small ones, lose some ten.
DIGITS = 40
# What is left of a filter's pulse where it is cut off.
_GONE = 1e-18


def covariance(model: aj.Model | aj.NoiseTerm, n: int, rate: float) -> np.ndarray:
    """Covariance [rate²] of n samples, up to a constant; of a stationary model it is the true one."""
    return toeplitz(autocovariance(model, n, rate))


def autocovariance(model: aj.Model | aj.NoiseTerm, n: int, rate: float) -> np.ndarray:
    """Covariance [rate²] of samples that are 0 … n − 1 apart, up to a constant."""
    model = aj.Model(()) + model
    inside = model.inside or (False,) * len(model.terms)
    total = np.zeros(n)
    for term, passes in zip(model.terms, inside, strict=True):
        if not passes:
            total += of_samples(term, n, rate)
            continue
        pulse = pulse_autocorrelation(model.response, rate)
        R = of_samples(term, n + len(pulse) - 1, rate)
        # From −(q − 1) to n + q − 2, of which the convolution leaves 0 … n − 1.
        both = np.concatenate([R[len(pulse) - 1 : 0 : -1], R])
        total += np.convolve(both, np.concatenate([pulse[:0:-1], pulse]), "valid")
    return total


def allan_variance(C: np.ndarray, m: int) -> float:
    """Allan variance of clusters of m samples under the covariance of 2m or more."""
    w = np.repeat([-1.0, 1.0], m) / m
    return float(w @ C[: 2 * m, : 2 * m] @ w / 2.0)


def of_states(space: aj.StateSpace, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Covariance of n samples, [n, n], and of all their states, [n·states, n·states], by the recursion."""
    size, P = space.size, space.P0
    joint = np.zeros((n * size, n * size))
    for j in range(n):
        column = P
        for k in range(j, n):
            joint[k * size : (k + 1) * size, j * size : (j + 1) * size] = column
            joint[j * size : (j + 1) * size, k * size : (k + 1) * size] = column.T
            column = space.A @ column
        P = space.A @ P @ space.A.T + space.Q
    H = np.kron(np.eye(n), space.H)
    return H @ joint @ H.T + space.R[0, 0] * np.eye(n), joint


def allan_variance_of_states(space: aj.StateSpace, m: int) -> float:
    """Allan variance of clusters of m samples: that of the difference of two sums of m."""
    transition, added = space.sum_covariance(m)
    covariance = np.zeros_like(transition)
    covariance[:-1, :-1] = space.P0
    covariance = transition @ covariance @ transition.T + added
    transition = transition * np.append(np.ones(space.size), -1.0)
    return float((transition @ covariance @ transition.T + added)[-1, -1]) / (2.0 * m**2)


def spectrum_of_states(space: aj.StateSpace, f: np.ndarray) -> np.ndarray:
    """Two-sided PSD of the samples at frequencies [Hz], without lines and ramps."""
    # The states that noise reaches.
    driven = np.diag(space.Q) > 0.0
    for _ in range(space.size):
        driven = driven | (space.A[:, driven] != 0.0).any(axis=1)
    A, H, Q = space.A[np.ix_(driven, driven)], space.H[:, driven], space.Q[np.ix_(driven, driven)]
    turn = np.exp(2j * np.pi * f.reshape(-1, 1, 1) / space.rate)
    row = np.broadcast_to(H.T.astype(complex), (f.size, len(A), 1))
    gain = np.linalg.solve(np.swapaxes(turn * np.eye(len(A)) - A, 1, 2), row)[..., 0]
    power = np.einsum("fi,ij,fj->f", gain, Q, gain.conj()).real
    return (power + space.R[0, 0]) / space.rate


def of_samples(term: aj.NoiseTerm, n: int, rate: float) -> np.ndarray:
    """Covariance of samples of a term that are 0 … n − 1 apart."""
    kind = type(term).__name__
    if kind in AT_INSTANTS:
        return AT_INSTANTS[kind](term, np.arange(n) / rate)
    name = next((p.name for p in term.parameters() if p.is_amplitude and kind in PHASE), None)
    if name is None or not (size := getattr(term, name)):
        return _second_differences(term, n, rate)
    # Amplitudes are what maximizers mostly move.
    return size**2 * _second_differences(dataclasses.replace(term, **{name: 1.0}), n, rate)


@functools.lru_cache(maxsize=256)
def _second_differences(term: aj.NoiseTerm, n: int, rate: float) -> np.ndarray:
    """Of G at multiples of the interval, over its square."""
    with mp.workdps(DIGITS):
        h = 1 / mp.mpf(rate)
        G_of_lag = PHASE.get(type(term).__name__, _of_its_own)(term)
        G = [G_of_lag(k * h) for k in range(n + 1)]
        G = [G[1], *G]
        return np.array([float(-(G[k] - 2 * G[k + 1] + G[k + 2]) / h**2) for k in range(n)])


def _of_its_own(term: aj.NoiseTerm) -> Callable:
    """G of a user's term."""
    return lambda t: mp.mpf(float(term.phase_covariance(np.asarray(float(t)))))


def _flicker(term: aj.NoiseTerm) -> Callable:
    """B²/(2π)·t² ln t; up to a cutoff B²/π·t² ∫₀^{2πf₀t} (cos x − 1 + x²/2)/x³ dx, by parts."""
    B2, f0 = mp.mpf(term.coefficient) ** 2, term.cutoff_frequency
    if np.isinf(f0):
        return lambda t: B2 / (2 * mp.pi) * t**2 * mp.log(t) if t else mp.mpf(0)

    def of_lag(t: mp.mpf) -> mp.mpf:
        x = 2 * mp.pi * mp.mpf(f0) * t
        if not x:
            return mp.mpf(0)
        cin = mp.euler + mp.log(x) - mp.ci(x)
        ends = (mp.cos(x) - 1 + x**2 / 2) / x**2 + (x - mp.sin(x)) / x
        return B2 / mp.pi * t**2 * (cin - ends) / 2

    return of_lag


def _markov(term: aj.NoiseTerm) -> Callable:
    """Of R(t) = σ²e^{−t/T}, σ² = q²T/2: −σ²T²(e^{−t/T} − 1 + t/T)."""
    T = mp.mpf(term.correlation_time)
    scale = mp.mpf(term.amplitude) ** 2 * T**3 / 2
    return lambda t: -scale * (mp.exp(-t / T) - 1 + t / T)


def _power_law(term: aj.NoiseTerm) -> Callable:
    """Of A²f^(−α): −A²(2π)^α t^(α+1)/(2Γ(α + 2)cos(πα/2)), from ∫₀^∞ f^(−s) cos(2πft) df."""
    alpha, A2 = mp.mpf(term.exponent), mp.mpf(term.amplitude) ** 2
    if alpha == 1:
        return lambda t: A2 * t**2 * mp.log(t) if t else mp.mpf(0)
    scale = A2 * (2 * mp.pi) ** alpha / (2 * mp.gamma(alpha + 2) * mp.cos(mp.pi * alpha / 2))
    return lambda t: -scale * t ** (alpha + 1)


PHASE: dict[str, Callable] = {
    "Quantization": lambda term: lambda t: mp.mpf(term.coefficient) ** 2 * (t == 0),
    "AngleRandomWalk": lambda term: lambda t: -(mp.mpf(term.coefficient) ** 2) * t / 2,
    "BiasInstability": _flicker,
    "RateRandomWalk": lambda term: lambda t: mp.mpf(term.coefficient) ** 2 * t**3 / 12,
    "DriftRamp": lambda term: lambda t: mp.mpf(term.coefficient) ** 2 * t**4 / 24,
    "Markov": _markov,
    "PowerLaw": _power_law,
    "BiasStep": lambda term: lambda t: mp.mpf(0),
    "WarmUp": lambda term: lambda t: mp.mpf(0),
    "ChannelEffect": lambda term: lambda t: mp.mpf(0),
}


def oscillator(t: np.ndarray, frequency: float, quality_factor: float) -> np.ndarray:
    """Autocovariance of a damped oscillator of unit variance, driven by white noise."""
    w0 = 2.0 * np.pi * frequency
    a = w0 / (2.0 * quality_factor)
    wd = np.sqrt(w0**2 - a**2)
    return np.exp(-a * t) * (np.cos(wd * t) + a / wd * np.sin(wd * t))


def _low_pass(term: aj.NoiseTerm, t: np.ndarray) -> np.ndarray:
    """White noise N² after a filter has the variance N²ω/2 by one pole, N²ω/√8 by Butterworth's two."""
    w = 2.0 * np.pi * term.bandwidth
    if term.order == 1:
        return term.coefficient**2 * w / 2.0 * np.exp(-w * t)
    return term.coefficient**2 * w / np.sqrt(8.0) * oscillator(t, term.bandwidth, np.sqrt(0.5))


def _wandering(term: aj.NoiseTerm, t: np.ndarray) -> np.ndarray:
    x = np.arange(-10, 11) * 0.3
    each = zip(np.exp(-(x**2) / 2.0), term.frequency + x * term.spread, strict=True)
    Q = 0.5 + ((term.quality_factor - 0.5) ** -4 + (0.35 * term.spread / term.frequency) ** 4) ** -0.25
    return (
        term.amplitude**2
        * sum(s * oscillator(t, max(f, 0.01 * term.frequency), Q) for s, f in each)
        / np.sum(np.exp(-(x**2) / 2.0))
    )


AT_INSTANTS: dict[str, Callable] = {
    "Sinusoid": lambda term, t: term.amplitude**2 / 2.0 * np.cos(2.0 * np.pi * term.frequency * t),
    "Resonance": lambda term, t: term.amplitude**2 * oscillator(t, term.frequency, term.quality_factor),
    "WanderingResonance": _wandering,
    "LowPass": _low_pass,
    "Telegraph": lambda term, t: term.amplitude**2 / 4.0 * np.exp(-2.0 * t / term.dwell_time),
}


def pulse_autocorrelation(response: aj.Response, rate: float) -> np.ndarray:
    """Autocorrelation of a filter's pulse at lags 0 … q − 1; together with those below zero it sums to 1."""
    kind, f = type(response).__name__, response.bandwidth / rate
    if kind == "MovingAverage":
        # sinc²(x) = 1/2 at x = 0.44295, so that the mean is over 0.44295/f samples.
        half = float(mp.findroot(lambda x: mp.sincpi(x) ** 2 - 0.5, 0.443))
        once = np.maximum(half / f - abs(np.arange(-70, 71)), 0.0)
        every = functools.reduce(np.convolve, [once] * response.order)
        found = every[len(every) // 2 :]
    elif kind == "LowPass1":
        found = np.exp(-2.0 * np.pi * f * np.arange(_lasting(f)))
    elif kind == "LowPass2":
        Q = response.quality_factor
        found = oscillator(np.arange(_lasting(f / (2.0 * Q))), f, Q)
    else:
        one = np.append(1.0, np.zeros(_lasting(f / 8.0)))
        designed = kind in ("Butterworth", "Biquad")
        pulse = (
            scipy.signal.lfilter(*design(response, rate), one) if designed else response.filtered(one, rate)
        )
        found = scipy.signal.correlate(pulse, pulse, "full", "direct")[len(pulse) - 1 :]
    found = found[: np.flatnonzero(abs(found) > _GONE * found[0])[-1] + 1]
    return found / (2.0 * found.sum() - found[0])


def _lasting(cycles: float) -> int:
    """Samples after which e^{−2π·cycles·samples} is nothing."""
    return int(42.0 / (2.0 * np.pi * min(cycles, 0.5))) + 16


def design(response: aj.Response, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients b and a of a digital filter, as SciPy designs it."""
    if type(response).__name__ == "Butterworth":
        return scipy.signal.butter(response.order, response.bandwidth, fs=rate)
    # An analog filter ω²/(s² + ωs/Q + ω²), prewarped.
    w = 2.0 * rate * np.tan(np.pi * response.bandwidth / rate)
    return scipy.signal.bilinear([w**2], [1.0, w / response.quality_factor, w**2], rate)
