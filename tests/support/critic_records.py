"""Records that hide an effect of known strength, and how well anybody could measure it.

Nothing here comes from allanjax but the container of the samples. At its limit, a multiple of 1, an effect
has an expected log-likelihood ratio of 12.5 nats, against no effect, or against the best basic terms if it
is noise: a detector that knows all but the amplitude sees it at five deviations.

Noise is white noise and a random walk, whose covariance the cosine transform makes exactly diagonal; so
generalized least squares with the true dense covariance is a division by `variances`. The mean is its lowest
coefficient, and left out. Means and powers are independent in a Gaussian likelihood: the bound of a
waveform's parameters needs no powers, that of a spectrum's parameters has them as nuisances.
"""

import dataclasses
import functools
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from typing import Any

import bench
import golden_records
import numpy as np
from scipy import signal
from scipy.fft import dct
from scipy.optimize import brentq, nnls
from scipy.stats import norm

import allanjax as aj

N = 16_384
DETECTABLE = 12.5


@dataclasses.dataclass(frozen=True)
class Hidden:
    """One axis and the truth about it, in the recording's unit.

    Attributes:
        cause: as the critic names it.
        values: [n] samples.
        noise: deviations of the white noise of a sample, and of the steps of the random walk.
        truth: parameters by label.
        bound: least possible standard deviations of some of them, as functions of the basic terms that are
            estimated besides those that there are.
        expected: expected squares of the cosine coefficients, the effect included if it is noise.
        path: the waveform, if the effect is one.
        details: further truths.
        known: basic terms of the noise besides these two.
    """

    cause: str
    values: np.ndarray
    noise: tuple[float, float]
    truth: Mapping[str, float]
    bound: Callable[[Collection[str]], Mapping[str, float]]
    expected: np.ndarray
    path: np.ndarray | None = None
    details: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    known: tuple[str, ...] = ()

    @property
    def terms(self) -> set[str]:
        """Basic terms of its noise."""
        names = ("angle_random_walk", "rate_random_walk")
        return {*self.known} | {name for name, size in zip(names, self.noise, strict=True) if size}


def coefficients(x: np.ndarray) -> np.ndarray:
    """Cosine coefficients along the last axis, but for the mean."""
    return dct(x, norm="ortho")[..., 1:]


def angles(n: int = N) -> np.ndarray:
    """Phase per sample of the cosine coefficients."""
    return np.pi * np.arange(1, n) / n


def variances(white: float, walk: float, n: int = N) -> np.ndarray:
    """Expected squares of the coefficients of white noise and a random walk, exactly."""
    return white**2 + walk**2 / (4.0 * np.sin(angles(n) / 2.0) ** 2)


def noise(rng: np.random.Generator, white: float, walk: float, n: int = N) -> np.ndarray:
    """White noise and a random walk."""
    return white * rng.standard_normal(n) + walk * np.cumsum(rng.standard_normal(n))


# --- Bounds -------------------------------------------------------------------------------------------------


def waveform_bound(columns: Sequence[np.ndarray], v: np.ndarray) -> np.ndarray:
    """Covariance of the coefficients of some waveforms, by generalized least squares."""
    whitened = coefficients(np.stack(columns)) / np.sqrt(v)
    return np.linalg.inv(whitened @ whitened.T)


def spectral_bound(
    levels: Callable[..., np.ndarray], theta: Mapping[str, float], rate: float, beside: Collection[str] = ()
) -> dict[str, float]:
    """Least standard deviations of positive parameters by the Fisher information ½ Σ ∂ln v ∂ln v'.

    `beside` names further basic terms, whose powers are not known either, though they are zero.
    """
    rows = []
    for label, x in theta.items():
        high, low = (levels(**{**theta, label: x * (1.0 + s * 1e-4)}) for s in (1.0, -1.0))
        rows.append(np.log(high / low) / 2e-4)
    v = levels(**theta)
    rows += [
        level / v / np.max(level / v) for k, level in enumerate(basic_levels(rate)) if BASIC[k] in beside
    ]
    covariance = np.linalg.inv(0.5 * np.array(rows) @ np.array(rows).T)
    return {label: x * np.sqrt(covariance[k, k]) for k, (label, x) in enumerate(theta.items())}


def always(bound: Mapping[str, float]) -> Callable[[Collection[str]], Mapping[str, float]]:
    """A bound for which it is the same what else is estimated."""
    return lambda beside: bound


def posterior(log_weight: np.ndarray, values: np.ndarray) -> float:
    """Standard deviation of a parameter that may have any of these values."""
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    return float(np.sqrt(weight @ (values - weight @ values) ** 2))


# --- What basic terms make of it ----------------------------------------------------------------------------


BASIC = ("quantization", "angle_random_walk", "bias_instability", "rate_random_walk")


def basic_levels(rate: float, n: int = N, times: Sequence[float] = ()) -> np.ndarray:
    """Shapes of quantization, white, flicker and walking noise, and of Gauss–Markov noise of these times."""
    a = angles(n)
    sine = 4.0 * np.sin(a / 2.0) ** 2
    processes = [1.0 / (1.0 + (a * rate * time) ** 2) for time in times]
    return np.stack([sine, np.ones(n - 1), 1.0 / a, 1.0 / sine, *processes])


def best_basic(squares: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Levels of the most likely sum of these columns, by Fisher scoring in logarithmic bins."""
    edges = np.unique(np.geomspace(1, len(squares) + 1, 400).astype(int)) - 1
    count = np.diff(edges)
    level = np.add.reduceat(squares, edges[:-1]) / count
    shape = np.add.reduceat(columns, edges[:-1], axis=1) / count
    unit = shape.mean(axis=1)
    model, power = np.maximum(level, 1e-3 * np.median(level)), unit
    for _ in range(40):
        weight = np.sqrt(count) / model
        power = nnls((shape * weight / unit[:, None]).T, level * weight)[0] / unit
        model = power @ shape
    return power @ columns


def log_likelihood(squares: np.ndarray, v: np.ndarray) -> float:
    """Gaussian log-likelihood of coefficients with these squares [nats]."""
    return -0.5 * float(np.sum(np.log(v) + squares / v))


def basic_likelihood(c: np.ndarray, rate: float, terms: Collection[str] | None = None) -> float:
    """Log-likelihood of another record [nats] under the basic terms that explain this one best.

    Of each number of terms, with and without a ramp and a Gauss–Markov process, or of these `terms` alone:
    the likelihood of these coefficients less a nat for each parameter (Akaike 1973).
    """
    n = len(c) + 1
    ramp = coefficients(np.arange(n, dtype=float))
    some = [k for k, name in enumerate(BASIC) if terms is None or name in terms]
    best = -np.inf
    for time in (None, *np.geomspace(4.0, n / 4.0, 30 * (terms is None)) / rate):
        columns = basic_levels(rate, n, () if time is None else (time,))
        columns = columns[[*some, *range(len(BASIC), len(columns))]]
        for tilted in (False, True) if terms is None else (False,):
            v, d = best_basic(c**2, columns), c
            for _ in range(2 * tilted):
                d = c - (ramp @ (c / v)) / (ramp @ (ramp / v)) * ramp
                v = best_basic(d**2, columns)
            power = np.linalg.lstsq((columns / v).T, np.ones(n - 1), rcond=None)[0]
            count = np.sum(power * columns.mean(axis=1) > 1e-9 * v.min()) + tilted + (time is not None)
            best = max(best, log_likelihood(d**2, v) - float(count))
    return best


def log_ratio(expected: np.ndarray, truth: np.ndarray, other: np.ndarray) -> float:
    """Expected log-likelihood ratio of true levels to others."""
    return 0.5 * float(np.sum(np.log(other / truth) + expected / other - expected / truth))


def solved(llr: Callable[[float], float], multiple: float, low: float, high: float) -> float:
    """The x, between bounds, at which a growing llr(x) reaches that of a multiple of the limit."""
    wanted = np.log(DETECTABLE * multiple**2)
    return float(
        np.exp(
            brentq(
                lambda u: np.log(max(llr(np.exp(u)), 1e-12)) - wanted, np.log(low), np.log(high), xtol=1e-5
            )
        )
    )


# --- Effects in white noise of deviation 1 ------------------------------------------------------------------

WALK = 1e-3


def times(rate: float) -> np.ndarray:
    """Times of the samples [s]."""
    return np.arange(N) / rate


def added(
    rng: np.random.Generator, path: np.ndarray, multiple: float, walk: float = WALK
) -> tuple[float, np.ndarray, np.ndarray]:
    """Amplitude that makes a waveform so many times detectable, the samples, and the levels of the noise."""
    v = variances(1.0, walk)
    amplitude = multiple * np.sqrt(2.0 * DETECTABLE / np.sum(coefficients(path) ** 2 / v))
    return amplitude, noise(rng, 1.0, walk) + amplitude * path, v


def sinusoid(rng: np.random.Generator, rate: float, multiple: float) -> Hidden:
    """A line at a frequency that is no multiple of the resolution."""
    f, phase, t = 3.2171, 0.7, times(rate)
    wave = np.sin(2.0 * np.pi * f * t + phase)
    a, x, v = added(rng, wave, multiple)
    other = np.cos(2.0 * np.pi * f * t + phase)
    covariance = waveform_bound([wave, other, a * 2.0 * np.pi * t * other], v)
    bound = dict(zip(("amplitude", "", "frequency"), np.sqrt(np.diag(covariance)), strict=True))
    return Hidden("sinusoid", x, (1.0, WALK), {"frequency": f, "amplitude": a}, always(bound), v, a * wave)


def bias_step(rng: np.random.Generator, rate: float, multiple: float) -> Hidden:
    """A step down; its place has no regular bound: it is the posterior of all places near it."""
    place = 10_001
    a, x, v = added(rng, np.arange(N) >= place, multiple, 0.0)
    x, a = x - 2.0 * a * (np.arange(N) >= place), -a
    near = place + np.arange(-1_000, 1_001)
    shapes = step_coefficients(near) / np.sqrt(v)
    square, product = np.sum(shapes**2, axis=1), shapes @ (coefficients(x) / np.sqrt(v))
    log_weight, each = 0.5 * product**2 / square, product / square
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    spread = np.sqrt(weight @ (1.0 / square + (each - weight @ each) ** 2))
    bound = {"time": posterior(log_weight, near / rate), "amplitude": spread}
    truth = {"time": place / rate, "amplitude": a}
    return Hidden("bias_step", x, (1.0, 0.0), truth, always(bound), v, a * (np.arange(N) >= place))


def step_coefficients(places: np.ndarray) -> np.ndarray:
    """Cosine coefficients of unit steps at these samples, as a geometric sum."""
    a = angles()
    return -np.sqrt(2.0 / N) * np.sin(np.outer(places, a)) / (2.0 * np.sin(a / 2.0))


def warm_up(rng: np.random.Generator, rate: float, multiple: float) -> Hidden:
    """An exponential."""
    t, T = times(rate), 0.12 * N / rate
    wave = np.exp(-t / T)
    a, x, v = added(rng, wave, multiple, 0.0)
    covariance = waveform_bound([wave, a * t / T**2 * wave], v)
    bound = dict(zip(("amplitude", "time_constant"), np.sqrt(np.diag(covariance)), strict=True))
    return Hidden("warm_up", x, (1.0, 0.0), {"amplitude": a, "time_constant": T}, always(bound), v, a * wave)


def telegraph(rng: np.random.Generator, rate: float, multiple: float) -> Hidden:
    """Two levels; the amplitude's bound is that of a known path, a dwell time's that of so many jumps."""
    dwell = N / rate / 14.0
    switches = np.cumsum(rng.exponential(dwell, 200))
    path = (np.searchsorted(switches, times(rate)) % 2).astype(float)
    a, x, v = added(rng, path, multiple, 0.0)
    jumps = int(np.sum(switches < N / rate))
    bound = {"amplitude": np.sqrt(waveform_bound([path], v)[0, 0]), "dwell_time": dwell / np.sqrt(jumps)}
    truth = {"amplitude": a, "dwell_time": dwell, "jumps": jumps}
    return Hidden("telegraph", x, (1.0, 0.0), truth, always(bound), v, a * path)


def channel() -> np.ndarray:
    """Degrees, of two periods."""
    t = np.arange(N) / (N / 5.3)
    return 25.0 + 2.0 * np.sin(2.0 * np.pi * t) + 1.3 * np.sin(2.0 * np.pi * t / 0.37 + 1.0)


def temperature(rng: np.random.Generator, rate: float, multiple: float) -> Hidden:
    """The channel, later."""
    degrees, lag = channel(), 310
    late = np.r_[np.full(lag, degrees[0]), degrees[:-lag]]
    a, x, v = added(rng, late, multiple, 0.0)
    slope = np.gradient(late) * rate
    covariance = waveform_bound([late, -a * slope], v)
    bound = dict(zip(("coefficient", "lag"), np.sqrt(np.diag(covariance)), strict=True))
    truth = {"coefficient": a, "lag": lag / rate}
    return Hidden("temperature", x, (1.0, 0.0), truth, always(bound), v, a * late, {"temperature": degrees})


def outliers(rng: np.random.Generator, rate: float, multiple: float) -> Hidden:
    """Twenty normal errors; the bound is that of their deviation by those above five deviations."""
    places = np.sort(rng.choice(N, 20, replace=False))
    scale = 12.0 * multiple**2
    sizes = scale * rng.standard_normal(20)
    path = np.zeros(N)
    path[places] = sizes
    seen = abs(sizes) > 5.0
    u = np.linspace(5.0 / scale, 5.0 / scale + 9.0, 20_001)
    density = norm.pdf(u) / norm.pdf(u).sum()
    information = density @ u**4 - (density @ u**2) ** 2
    bound = {"scale": scale / np.sqrt(max(seen.sum(), 1) * information)}
    truth = {"count": int(seen.sum()), "scale": scale}
    x = noise(rng, 1.0, WALK) + path
    more = {"times": places[seen] / rate, "sizes": sizes[seen]}
    return Hidden("outliers", x, (1.0, WALK), truth, always(bound), variances(1.0, WALK), path, more)


def disturbance(rng: np.random.Generator, rate: float, multiple: float) -> Hidden:
    """Six seconds of motion between 0.3 and 3 Hz that begins and ends softly."""
    start, length = 7_000, round(6.0 * rate)
    band = signal.butter(2, (0.3, 3.0), "bandpass", fs=rate, output="sos")
    motion = signal.sosfilt(band, rng.standard_normal(length + 2_000))[2_000:] * np.hanning(length)
    path = np.zeros(N)
    path[start : start + length] = motion
    a, x, v = added(rng, path, 2.0 * multiple)
    truth = {"start": start / rate, "end": (start + length) / rate, "peak": a * np.max(np.abs(motion))}
    return Hidden("disturbance", x, (1.0, WALK), truth, always({"peak": 1.0}), v, a * path)


def variance_change(rng: np.random.Generator, rate: float, multiple: float) -> Hidden:
    """White noise that is louder for a while; the bound of an end is the posterior of all places."""
    first, last = 5_200, 9_900
    m = last - first
    excess = solved(lambda x: 0.5 * m * (x - np.log1p(x)), multiple, 1e-4, 1e3)
    inside = (np.arange(N) >= first) & (np.arange(N) < last)
    loud = rng.standard_normal(N) * np.where(inside, np.sqrt(1.0 + excess), 1.0)
    bound = {"ratio": np.sqrt(1.0 + excess) * np.sqrt(0.5 / m + 0.5 / (N - m))}
    for label, place, sign in (("start", first, 1.0), ("end", last, -1.0)):
        near = place + np.arange(-1_500, 1_500)
        # The likelihood of each sample inside, less that outside: added up to the place from either side.
        each = 0.5 * (loud[near] ** 2 * excess / (1.0 + excess) - np.log1p(excess))
        bound[label] = posterior(-sign * np.cumsum(each), near / rate)
    truth = {"start": first / rate, "end": last / rate, "ratio": np.sqrt(1.0 + excess)}
    x = loud + WALK * np.cumsum(rng.standard_normal(N))
    return Hidden("variance_change", x, (1.0, WALK), truth, always(bound), variances(1.0, WALK))


def resonance(rng: np.random.Generator, rate: float, multiple: float) -> Hidden:
    """A damped oscillator that is read at the sample instants."""
    f, quality = 0.137 * rate, 11.0

    def shape(f: float, quality: float) -> np.ndarray:
        damping, lag = np.pi * f / quality, np.arange(1, 4_000) / rate
        ringing = np.sqrt((2.0 * np.pi * f) ** 2 - damping**2)
        r = np.exp(-damping * lag) * (np.cos(ringing * lag) + damping / ringing * np.sin(ringing * lag))
        return 1.0 + 2.0 * np.real(np.fft.rfft(np.r_[0.0, r], 2 * N)[1:N])

    def levels(
        frequency: float, quality_factor: float, amplitude: float, white: float, walk: float
    ) -> np.ndarray:
        return amplitude**2 * shape(frequency, quality_factor) + variances(white, walk)

    own, v = shape(f, quality), variances(1.0, WALK)
    power = multiple**2 * limit_power(v, own, basic_levels(rate))
    theta = {"frequency": f, "quality_factor": quality, "amplitude": np.sqrt(power)}
    known = theta | {"white": 1.0, "walk": WALK}
    x = noise(rng, 1.0, WALK) + stationary(rng, power * own)
    return Hidden(
        "resonance", x, (1.0, WALK), theta, partial(spectral_bound, levels, known, rate), v + power * own
    )


def limit_power(v: np.ndarray, shape: np.ndarray, columns: np.ndarray) -> float:
    """Power of a noise of this shape that is at the limit, beside what these columns can make of it."""

    def llr(power: float) -> float:
        w = v + power * shape
        return log_ratio(w, w, best_basic(w, columns))

    return solved(llr, 1.0, 1e-9 * v.min() / shape.max(), 1e4 * v.max() / shape.min())


def stationary(rng: np.random.Generator, levels: np.ndarray) -> np.ndarray:
    """Noise of this density, the middle of a periodic record that is twice as long."""
    e = rng.standard_normal((2, N - 1))
    lines = np.sqrt(levels * N) * (e[0] + 1j * e[1]) / np.sqrt(2.0)
    return np.fft.irfft(np.r_[0.0, lines * np.sqrt(2.0), 0.0], 2 * N)[:N]


def low_pass(rng: np.random.Generator, rate: float, multiple: float) -> Hidden:
    """Exponential smoothing, y = w·y + (1 − w)·x; its bandwidth is where the power has fallen by half."""
    columns = basic_levels(rate)

    def kept_of(bandwidth: float) -> float:
        memory = 2.0 - np.cos(2.0 * np.pi * bandwidth / rate)
        return memory - np.sqrt(memory**2 - 1.0)

    def passed(kept: float) -> np.ndarray:
        return (1.0 - kept) ** 2 / (1.0 - 2.0 * kept * np.cos(angles()) + kept**2)

    def levels(bandwidth: float, white: float, walk: float) -> np.ndarray:
        return passed(kept_of(bandwidth)) * variances(white, walk)

    def llr(kept: float) -> float:
        w = passed(kept) * variances(1.0, WALK)
        return log_ratio(w, w, best_basic(w, columns))

    kept = solved(llr, multiple, 1e-4, 0.4)
    x = signal.lfilter([1.0 - kept], [1.0, -kept], noise(rng, 1.0, WALK, N + 512))[512:]
    # Where the filter keeps less than that, its power does not fall by half.
    bandwidth = rate * np.arccos(max(2.0 - np.cosh(np.log(kept)), -0.999)) / (2.0 * np.pi)
    theta = {"bandwidth": bandwidth, "white": 1.0, "walk": WALK}
    bound = partial(spectral_bound, levels, theta, rate)
    truth = {"bandwidth": bandwidth, "order": 1.0}
    return Hidden("low_pass", x, (1.0, WALK), truth, bound, levels(**theta))


def power_law(rng: np.random.Generator, rate: float, multiple: float) -> Hidden:
    """Noise between white noise and flicker, beside white noise: means over the sample interval."""
    u = angles() / (2.0 * np.pi) + np.arange(-40, 41)[:, None]

    def shape(exponent: float) -> np.ndarray:
        return rate * np.sum(np.abs(u * rate) ** -exponent * np.sinc(u) ** 2, axis=0)

    def levels(exponent: float, amplitude: float, white: float) -> np.ndarray:
        return white**2 + amplitude**2 * shape(exponent)

    density = multiple**2 * limit_power(np.ones(N - 1), shape(0.5), basic_levels(rate))
    theta = {"exponent": 0.5, "amplitude": np.sqrt(density)}
    bound = partial(spectral_bound, levels, theta | {"white": 1.0}, rate)
    x = rng.standard_normal(N) + stationary(rng, density * shape(0.5))
    return Hidden("power_law", x, (1.0, 0.0), theta, bound, levels(**theta, white=1.0))


# --- Effects in the samples themselves, and between axes ----------------------------------------------------


def plain(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """White noise of deviation 1 with a weak random walk, and its levels."""
    return noise(rng, 1.0, WALK), variances(1.0, WALK)


def rounding(rng: np.random.Generator, rate: float, multiple: float) -> Hidden:
    """Multiples of a step; at a third of the limit it is harmless, a ninth of the noise."""
    x, v = plain(rng)
    step = 0.35 * multiple
    x = step * np.round(x / step)
    return Hidden("rounding", x, (1.0, WALK), {"step": step}, always({}), v)


def repeated_samples(rng: np.random.Generator, rate: float, multiple: float) -> Hidden:
    """Lost values that the one before stands for, up to four in a row; at a third of the limit none."""
    x, v = plain(rng)
    held = np.zeros(N, bool)
    for start in rng.choice(N // 5 - 1, int(150 * (multiple - 1.0 / 3.0)), replace=False) * 5 + 3:
        held[start : start + rng.integers(1, 5)] = True
    x = x[np.maximum.accumulate(np.where(held, 0, np.arange(N)))]
    share = held.mean()
    truth = {"fraction": share, "longest": 4.0}
    bound = {"fraction": np.sqrt(share * (1.0 - share) / N)}
    return Hidden("repeated_samples", x, (1.0, WALK), truth, always(bound), v)


def saturation(rng: np.random.Generator, rate: float, multiple: float) -> Hidden:
    """A range that is too small, more on one side; at a third of the limit it is never reached."""
    x, v = plain(rng)
    low, high = np.array([-5.2, 4.8]) / multiple
    inside = (x > low) & (x < high)
    truth = {"upper_level": high, "lower_level": low, "fraction": 1.0 - inside.mean()}
    return Hidden("saturation", np.clip(x, low, high), (1.0, WALK), truth, always({}), v)


def common_mode(rng: np.random.Generator, rate: float, multiple: float) -> Hidden:
    """Noise of which a part is, with a minus sign, that of the `twin` axis, too."""
    r = np.sqrt(-np.expm1(-2.0 * DETECTABLE * multiple**2 / N))
    one, other, shared = rng.standard_normal((3, N))
    x, y = (np.sqrt(1.0 - r) * own + sign * np.sqrt(r) * shared for own, sign in ((one, 1.0), (other, -1.0)))
    bound = {"correlation": (1.0 - r**2) / np.sqrt(N)}
    details = {"twin": y}
    return Hidden(
        "common_mode", x, (1.0, 0.0), {"correlation": r}, always(bound), np.ones(N - 1), None, details
    )


def twin(rng: np.random.Generator, rate: float, multiple: float) -> Hidden:
    """Stands for the other axis of a common mode."""
    return Hidden("", np.zeros(N), (1.0, 0.0), {}, always({}), np.ones(N - 1))


# --- Recordings ---------------------------------------------------------------------------------------------

Make = Callable[[np.random.Generator, float, float], Hidden]
#: Rate, units of gyros and accelerometers, and the effect of each axis.
SCENES: dict[str, tuple[float, str, str, dict[str, Make]]] = {
    "waves": (
        50.0,
        "deg/s",
        "g",
        {"gyro_x": sinusoid, "accel_x": bias_step, "gyro_y": warm_up, "accel_z": telegraph},
    ),
    "moments": (
        100.0,
        "rad/s",
        "mg",
        {"accel_y": temperature, "gyro_z": variance_change, "accel_x": outliers, "gyro_x": disturbance},
    ),
    "samples": (
        50.0,
        "deg/h",
        "mg",
        {
            "gyro_z": rounding,
            "gyro_x": repeated_samples,
            "accel_x": saturation,
            "accel_y": common_mode,
            "accel_z": twin,
        },
    ),
    "spectra": (200.0, "mdeg/s", "m/s²", {"gyro_y": resonance, "accel_z": low_pass, "gyro_z": power_law}),
}
#: Parameters in the recording's unit.
SIZES = ("amplitude", "coefficient", "peak", "scale", "sizes", "step", "upper_level", "lower_level", "twin")
# Strength beside that of the others: a filter must be strong for its bandwidth to be below half the rate.
STRONGER = {low_pass: 1.45}


@functools.cache
def scene(name: str, multiple: float, seed: int = 0) -> dict[str, Hidden]:
    """What is hidden in each axis of a recording, in its unit; the axes are unequal."""
    rate, *_, axes = SCENES[name]
    rng = np.random.default_rng([list(SCENES).index(name), seed])
    found: dict[str, Hidden] = {}
    for k, (axis, make) in enumerate(axes.items()):
        size, bias = 0.02 * 1.7**k, 0.3 * (-1.0) ** k
        found[axis] = scaled(make(rng, rate, multiple * STRONGER.get(make, 1.0)), size, bias)
        if make is twin:
            other = list(found.values())[-2]
            found[axis] = dataclasses.replace(other, values=other.details["twin"] + bias)
    return found


def scaled(hidden: Hidden, size: float, bias: float) -> Hidden:
    """The same in noise of another deviation, about a bias."""

    def larger(values: Mapping[str, Any]) -> dict[str, Any]:
        shift = {label: bias for label in values if label.endswith("level")}
        return {
            label: x * size + shift.get(label, 0.0) if label in SIZES else x for label, x in values.items()
        }

    return Hidden(
        hidden.cause,
        hidden.values * size + bias,
        (hidden.noise[0] * size, hidden.noise[1] * size),
        larger(hidden.truth),
        lambda beside: larger(hidden.bound(beside)),
        hidden.expected * size**2,
        None if hidden.path is None else hidden.path * size,
        larger(hidden.details),
    )


def recording(name: str, multiple: float, seed: int = 0) -> aj.Recording:
    """The recording that a user would have read; nothing of the truth is in it."""
    rate, gyro, accel, _ = SCENES[name]
    axes = scene(name, multiple, seed)
    auxiliary = {label: x for h in axes.values() for label, x in h.details.items() if label == "temperature"}
    return aj.Recording.from_array(
        np.column_stack([h.values for h in axes.values()]),
        rate,
        names=list(axes),
        gyro_unit=gyro,
        accel_unit=accel,
        auxiliary=auxiliary or None,
        name=name,
    )


# --- Basic terms that a given model lacks -------------------------------------------------------------------

#: N of the axes [rad/√s], rate [Hz], and correlation time of the Gauss–Markov process [s].
WHITE_NOISE, LACKING_RATE, CORRELATION = 2e-5, 50.0, 4.0
LACKING = {
    "gyro_1": "quantization",
    "gyro_2": "bias_instability",
    "gyro_3": "rate_random_walk",
    "gyro_4": "markov",
    "gyro_5": "drift_ramp",
}


def term_levels(term: str, time: float = CORRELATION) -> np.ndarray:
    """Expected squares of the coefficients of a basic term of unit coefficient, in SI."""
    rate, a = LACKING_RATE, angles()
    sine, frequency = 4.0 * np.sin(a / 2.0) ** 2, a * rate / (2.0 * np.pi)
    return {
        "quantization": rate**2 * (sine + (4.0 - sine) / N),
        "angle_random_walk": np.full(N - 1, rate),
        "bias_instability": rate / (2.0 * np.pi * frequency),
        "rate_random_walk": 1.0 / (rate * sine),
        "markov": rate * time**2 / (1.0 + (2.0 * np.pi * frequency * time) ** 2),
    }[term]


def term_noise(rng: np.random.Generator, term: str, size: float) -> np.ndarray:
    """Samples of a basic term of this coefficient, in SI."""
    if term == "markov":
        return golden_records.gauss_markov(
            rng, N, size * np.sqrt(CORRELATION / 2.0), CORRELATION, LACKING_RATE
        )
    letter = {label: letter for letter, label in golden_records.LABELS.items()}[term]
    return golden_records.sensor(rng, N, LACKING_RATE, **{letter: size})


def beside(rng: np.random.Generator, term: str, known: str, size: float, multiple: float) -> Hidden:
    """A term beside a known one of this coefficient, in SI."""
    v = size**2 * term_levels(known)
    x = term_noise(rng, known, size)
    if term == "drift_ramp":
        column = times(LACKING_RATE)
        std = np.sqrt(waveform_bound([column], v)[0, 0])
        slope = 5.0 * multiple * std
        path = slope * column
        return Hidden(
            term, x + path, (0.0, 0.0), {"coefficient": slope}, always({"coefficient": std}), v, path
        )
    shape = term_levels(term)
    power = multiple**2 * limit_power(v, shape, v[None] / v.mean())
    label = "amplitude" if term == "markov" else "coefficient"
    truth = {label: np.sqrt(power)} | ({"correlation_time": CORRELATION} if term == "markov" else {})

    def levels(other: float, correlation_time: float = CORRELATION, **amplitude: float) -> np.ndarray:
        own = amplitude[label] ** 2 * term_levels(term, correlation_time)
        return own + other**2 * term_levels(known)

    bound = partial(spectral_bound, levels, truth | {"other": size}, LACKING_RATE)
    values = x + term_noise(rng, term, np.sqrt(power))
    return Hidden(term, values, (0.0, 0.0), truth, bound, v + power * shape, known=(known, term))


@functools.cache
def lacking(name: str, multiple: float) -> dict[str, Hidden]:
    """Axes of a known term and a further one that a fit is not told of, in SI.

    Those of "white" are known to have quantization, those of "other" white noise.
    """
    rng = np.random.default_rng([77, name == "white"])
    if name == "white":
        return {"gyro_6": beside(rng, "angle_random_walk", "quantization", 1e-6, multiple)}
    return {
        axis: beside(rng, term, "angle_random_walk", WHITE_NOISE * 1.5**k, multiple)
        for k, (axis, term) in enumerate(LACKING.items())
    }


def lacking_recording(name: str, multiple: float) -> aj.Recording:
    """The recording of these axes, in degrees per second."""
    axes = lacking(name, multiple)
    values = np.column_stack([hidden.values for hidden in axes.values()]) * 180.0 / np.pi
    return aj.Recording.from_array(values, LACKING_RATE, names=list(axes), gyro_unit="deg/s")


#: What the fits of axes know that lack a basic term.
KNOWN = {"other": "N", "white": "Q"}


def hidden_in(name: str, multiple: float = 4.0) -> dict[str, Hidden]:
    """What is in the axes of a recording."""
    return lacking(name, multiple) if name in KNOWN else scene(name, multiple)


def critique(name: str, multiple: float = 4.0) -> aj.Critique:
    """The critique of a recording, made once per run."""

    def make() -> aj.Critique:
        if name not in KNOWN:
            return aj.critique(recording(name, multiple))
        given = lacking_recording(name, multiple)
        return aj.critique(given, aj.fit(given, KNOWN[name]))

    return bench.once(f"critique of what is hidden: {name} {multiple}", make)
