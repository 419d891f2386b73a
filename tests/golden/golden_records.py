"""Some forty records whose truth is known, made by NumPy recursions; nothing here comes from allanjax.

Noise follows the field's definitions: N, B, K, Q and R as in IEEE 952, a Gauss–Markov process
dx/dt = −x/T_c + q_c·w, all as means over the sample interval, so that spectra and Allan variances are those
of the continuous noise. Flicker noise and power laws are sums of Gauss–Markov processes whose correlation
times are an octave apart: the ripple of such a sum is below 1e-5. Everything is in rad/s and m/s² here, and
in the recording's own units for the package.
"""

import dataclasses
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

# Not its submodules, which are loaded when they are used: `signal` takes seconds.
import scipy
from places import DATA

import allanjax as aj

DEG, G = np.pi / 180.0, 9.80665
RATE = 100.0
SHORT, MIDDLE, LONG = 2_048, 16_384, 65_536
UNITS = {"gyro": ("deg/s", DEG), "accel": ("g", G)}


@dataclasses.dataclass(frozen=True)
class Effect:
    """Something hidden in a record: its cause as the critic names it, its axes, its parameters in SI."""

    cause: str
    axes: tuple[str, ...]
    parameters: Mapping[str, Any] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Record:
    """Samples and the truth about them.

    values: [n, axes] in rad/s or m/s²; nan where a sample was lost.
    truth: coefficients in SI by axis and label; the terms that are not named are absent.
    model: the terms of the truth, as a model is written on the command line.
    options: what a user would tell `aj.Recording.from_array` beside units and names.
    """

    values: np.ndarray
    names: tuple[str, ...]
    truth: Mapping[str, Mapping[str, float]]
    rate: float = RATE
    model: str | None = None
    effects: tuple[Effect, ...] = ()
    auxiliary: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    name: str = ""

    @property
    def fingerprint(self):
        """Sums, sums of squares and a few samples of the axes: that it is the same record, to rounding."""
        x = np.nan_to_num(self.values)
        return [*x.sum(axis=0), *(x**2).sum(axis=0), *x[:: max(len(x) // 4, 1)].ravel()]

    def recording(self):
        """The recording as a file would have given it."""
        sensors = [name.split("_")[0] for name in self.names]
        values = self.values / [UNITS[s][1] for s in sensors]
        more = {f"{s}_unit": UNITS[s][0] for s in sensors} | dict(self.options)
        more["auxiliary"] = dict(self.auxiliary) or None
        return aj.Recording.from_array(values, self.rate, names=list(self.names), name=self.name, **more)


def white(rng, n, N, rate=RATE):
    return N * np.sqrt(rate) * rng.standard_normal(n)


def quantization(rng, n, Q, rate=RATE):
    """Differences of a phase that is rounded: errors of deviation Q, independent from sample to sample."""
    return Q * rate * np.diff(rng.standard_normal(n + 1))


def walk(rng, n, K, rate=RATE):
    """Rate random walk: of a Wiener process, exactly."""
    h = 1.0 / rate
    step, inside = rng.standard_normal((2, n)) * np.sqrt([[h], [h / 12.0]])
    return K * (np.cumsum(step) - step / 2.0 + inside)


def gauss_markov(rng, n, std, time, rate=RATE):
    """Of a Gauss–Markov process of this deviation, exactly."""
    a = 1.0 / (rate * time)
    lost = -np.expm1(-a)
    end, cross = lost * (2.0 - lost), lost**2 / a
    mean = max((2.0 * (a - lost) - lost**2) / a**2 - cross**2 / end, 0.0)
    first, second = rng.standard_normal((2, n))
    start = rng.standard_normal()
    state = scipy.signal.lfilter([1.0], [1.0, lost - 1.0], np.r_[start, np.sqrt(end) * first])[:-1]
    return std * (lost / a * state + cross / np.sqrt(end) * first + np.sqrt(mean) * second)


def power_law(rng, n, density, exponent, rate=RATE):
    """Noise of two-sided PSD density·f^−exponent, 0 < exponent < 2, as a sum over correlation times."""
    times = 2.0 ** np.arange(np.log2(1e-3 / rate), np.log2(64.0 * n / rate))
    # ∫ 2cT^p/(1 + ω²T²) dlnT = πc ω^−p/sin(pπ/2), of which a sum over octaves is 1/ln 2.
    weight = density * (2.0 * np.pi) ** exponent * np.log(2.0) * np.sin(exponent * np.pi / 2.0) / np.pi
    stds = np.sqrt(weight * times ** (exponent - 1.0))
    return sum(gauss_markov(rng, n, s, t, rate) for s, t in zip(stds, times, strict=True))


def flicker(rng, n, B, rate=RATE):
    """Bias instability, S(f) = B²/(2πf)."""
    return power_law(rng, n, B**2 / (2.0 * np.pi), 1.0, rate)


def oscillator(rng, n, std, frequency, quality, rate=RATE):
    """A damped oscillator driven by white noise, read at the sample instants, by its mode z: exact."""
    w = 2.0 * np.pi * frequency
    pole = -w / (2.0 * quality) + 1j * (w * np.sqrt(1.0 - 1.0 / (4.0 * quality**2)))
    # Position x = Re z and velocity v = Re(pole·z); their stationary covariance is diag(1, w²).
    back = np.linalg.inv([[1.0, 0.0], [pole.real, -pole.imag]])
    stationary = back @ np.diag([1.0, w**2]) @ back.T
    turn = np.exp(pole / rate)
    F = np.array([[turn.real, -turn.imag], [turn.imag, turn.real]])
    driven = np.linalg.cholesky(stationary - F @ stationary @ F.T) @ rng.standard_normal((2, n))
    driven[:, 0] = np.linalg.cholesky(stationary) @ rng.standard_normal(2)
    return std * scipy.signal.lfilter([1.0 + 0j], [1.0, -turn], driven[0] + 1j * driven[1]).real


def line(amplitude, frequency, phase):
    """A sinusoid, read at the sample instants."""
    return amplitude * np.sin(2.0 * np.pi * frequency * np.arange(MIDDLE) / RATE + phase)


_BASIC = "quantization angle_random_walk bias_instability rate_random_walk drift_ramp"
LABELS = dict(zip("QNBKR", _BASIC.split(), strict=True))
MAKERS = {"Q": quantization, "N": white, "B": flicker, "K": walk}


def sensor(rng, n, rate=RATE, **coefficients):
    """One axis with the basic terms of these coefficients."""
    x = np.zeros(n)
    for letter, c in coefficients.items():
        x += c * (np.arange(n) + 0.5) / rate if letter == "R" else MAKERS[letter](rng, n, c, rate)
    return x


def labelled(**coefficients):
    """The same coefficients by the package's labels."""
    return {LABELS[letter]: value for letter, value in coefficients.items()}


def crossing(N, **times):
    """N and coefficients whose Allan deviations meet that of N at these times [s]."""
    at = {
        "Q": lambda t: N * np.sqrt(t / 3.0),
        "B": lambda t: N / np.sqrt(t * 2.0 * np.log(2.0) / np.pi),
        "K": lambda t: N * np.sqrt(3.0) / t,
        "R": lambda t: N * np.sqrt(2.0) / t**1.5,
    }
    return {"N": N} | {letter: float(at[letter](time)) for letter, time in times.items()}


# N of a tactical gyro, and of an accelerometer of consumer grade.
GYRO, ACCEL = 0.15 * DEG / 60.0, 0.12 / 60.0


def basic(seed, n, *axes, rate=RATE):
    """A record of basic terms: name and coefficients of each axis; a bias of its own on each."""
    rng, columns = np.random.default_rng(seed), []
    for k, (name, c) in enumerate(axes):
        # The z axis of an accelerometer carries gravity.
        bias = 0.01 * DEG * (k + 1) if name.startswith("gyro") else G * name.endswith("z") - 0.1
        columns.append(sensor(rng, n, rate, **c) + bias)
    letters = sorted({letter for _, c in axes for letter in c}, key="QNBKR".index)
    truth = {name: labelled(**c) for name, c in axes}
    return Record(np.column_stack(columns), tuple(truth), truth, rate, " + ".join(letters))


def single(name, x, model, truth):
    """A record of one axis."""
    return Record(x[:, None], (name,), {name: truth}, model=model)


def with_markov(seed, n, *processes):
    """N and Gauss–Markov processes: their deviation over that of the white noise in 1 s, and T_c [s]."""
    rng = np.random.default_rng(seed)
    x, truth = white(rng, n, GYRO), {"angle_random_walk": GYRO}
    for k, (ratio, time) in enumerate(processes):
        x = x + gauss_markov(rng, n, ratio * GYRO, time)
        label = "markov" if len(processes) == 1 else f"markov_{k + 1}"
        amplitude = ratio * GYRO * np.sqrt(2.0 / time)
        truth |= {f"{label}_amplitude": amplitude, f"{label}_correlation_time": time}
    model = " + ".join(["N", *["markov"] * len(processes)])
    return single("gyro_x", x, model, truth)


PLAIN = {
    "white": partial(basic, 1, MIDDLE, ("gyro_x", {"N": GYRO})),
    "walk": partial(basic, 2, MIDDLE, ("gyro_x", crossing(GYRO, K=3)), ("gyro_y", crossing(3 * GYRO, K=6))),
    "flicker": partial(basic, 3, MIDDLE, ("accel_z", crossing(ACCEL, B=0.5))),
    "quantized": partial(basic, 4, MIDDLE, ("gyro_z", crossing(GYRO, Q=0.3, K=8.0))),
    "small": partial(
        *(basic, 5, MIDDLE, ("gyro_x", crossing(GYRO, B=0.4)), ("gyro_y", crossing(1.7 * GYRO, B=0.8))),
        *(("gyro_z", crossing(0.6 * GYRO, B=0.5)), ("accel_z", crossing(ACCEL, K=5.0))),
    ),
    "drifting": partial(basic, 6, LONG, ("gyro_x", crossing(GYRO, B=1.0, K=30.0, R=100.0))),
    "edge": partial(basic, 10, MIDDLE, ("gyro_x", crossing(GYRO, K=60)), ("accel_x", crossing(ACCEL, K=40))),
    "many": partial(
        basic, 11, SHORT, *((f"gyro_{k}", {"N": GYRO * (1.0 + 0.1 * k)}) for k in range(1, 10)), rate=50.0
    ),
    "short": partial(basic, 12, 64, ("gyro_x", {"N": GYRO}), rate=20.0),
    "markov_fast": partial(with_markov, 7, MIDDLE, (4.0, 0.3)),
    "markov_slow": partial(with_markov, 8, LONG, (3.0, 10.0)),
    "two_markovs": partial(with_markov, 9, LONG, (4.0, 0.2), (1.0, 20.0)),
}

LEAD = 512


def filtered(seed, name, N, K, b, a, response, **shape):
    """N and K whose samples a filter of transfer b/a has passed."""
    c = crossing(N, K=K)
    x = scipy.signal.lfilter(b, a, sensor(np.random.default_rng(seed), MIDDLE + LEAD, **c))[LEAD:]
    return single(name, x, f"{response} * (N + K)", labelled(**c) | shape)


def smoothing(bandwidth):
    """Exponential smoothing, y = w·y + (1 − w)·x with w = exp(−2πf_c/rate)."""
    w = np.exp(-2.0 * np.pi * bandwidth / RATE)
    return [1.0 - w], [1.0, -w]


def averaged():
    """Means over 3.33 samples: of noise at thirty times the rate, every thirtieth of a mean of a hundred."""
    rng, fine, width, c = np.random.default_rng(15), 30, 100, crossing(GYRO, K=5.0)
    x = sensor(rng, (MIDDLE + 8) * fine, RATE * fine, **c)
    means = scipy.signal.lfilter(np.full(width, 1.0 / width), [1.0], x)[8 * fine :: fine]
    # The power of a mean over T is halved at 0.443/T.
    truth = labelled(**c) | {"moving_average_bandwidth": 0.442946 * fine * RATE / width}
    return single("gyro_z", means, "moving_average * (N + K)", truth)


def biquad():
    """A second-order section, the bilinear transform of an analog low pass."""
    f0, quality = 15.0, 0.9
    k = np.tan(np.pi * f0 / RATE)
    norm = 1.0 + k / quality + k**2
    b = np.array([1.0, 2.0, 1.0]) * k**2 / norm
    a = [1.0, 2.0 * (k**2 - 1.0) / norm, (1.0 - k / quality + k**2) / norm]
    shape = {"biquad_bandwidth": f0, "biquad_quality_factor": quality}
    return filtered(16, "accel_x", ACCEL, 5.0, b, a, "biquad", **shape)


def ringing(std, frequency, quality):
    """Parameters of an oscillator by the package's labels."""
    values = {"amplitude": std, "frequency": frequency, "quality_factor": quality}
    return {f"resonance_{label}": value for label, value in values.items()}


def resonance():
    """White noise and an oscillator."""
    rng, of = np.random.default_rng(17), (1.2 * GYRO * np.sqrt(RATE), 23.0, 12.0)
    x = white(rng, MIDDLE, GYRO) + oscillator(rng, MIDDLE, *of)
    return single("gyro_x", x, "N + resonance", ringing(*of) | {"angle_random_walk": GYRO})


def behind_a_filter():
    """N, K and an oscillator behind exponential smoothing, on two unequal axes."""
    rng, columns, truth = np.random.default_rng(18), [], {}
    for name, size, std in (("gyro_x", GYRO, 1.5), ("accel_y", ACCEL, 2.5)):
        c, of = crossing(size, K=5.0), (std * size * np.sqrt(RATE), 31.0, 20.0)
        x = sensor(rng, MIDDLE + LEAD, **c) + oscillator(rng, MIDDLE + LEAD, *of)
        columns.append(scipy.signal.lfilter(*smoothing(14.0), x)[LEAD:])
        truth[name] = labelled(**c) | ringing(*of) | {"low_pass1_bandwidth": 14.0}
    return Record(np.column_stack(columns), tuple(truth), truth, model="low_pass1 * (N + K + resonance)")


def one_line():
    """N, K and a sinusoid."""
    c, amplitude = crossing(GYRO, K=5.0), 0.35 * GYRO * np.sqrt(RATE)
    x = sensor(np.random.default_rng(19), MIDDLE, **c) + line(amplitude, 3.21, 0.7)
    truth = labelled(**c) | {"sinusoid_amplitude": amplitude, "sinusoid_frequency": 3.21}
    return single("gyro_x", x, "N + K + sinusoid", truth)


def long_memory():
    """N and a power law."""
    rng, density = np.random.default_rng(20), (2.0 * GYRO) ** 2
    x = white(rng, MIDDLE, GYRO) + power_law(rng, MIDDLE, density, 1.5)
    truth = {"angle_random_walk": GYRO, "power_law_amplitude": np.sqrt(density), "power_law_exponent": 1.5}
    return single("gyro_x", x, "N + power_law", truth)


def butterworth():
    """N and K behind a Butterworth filter."""
    b, a = scipy.signal.butter(4, 21.0, fs=RATE)
    return filtered(14, "gyro_y", GYRO, 4.0, b, a, "butterworth(order=4)", butterworth_bandwidth=21.0)


_ONE_POLE = (13, "gyro_x", GYRO, 5.0, *smoothing(18.0), "low_pass1")
SHAPED = {
    "one_pole": partial(filtered, *_ONE_POLE, low_pass1_bandwidth=18.0),
    "butterworth": butterworth,
    "averaged": averaged,
    "biquad": biquad,
    "resonance": resonance,
    "filtered": behind_a_filter,
    "line": one_line,
    "power_law": long_memory,
}

GYROS = ("gyro_x", "gyro_y", "gyro_z")
ACCELS = ("accel_x", "accel_y", "accel_z")
TIME = np.arange(MIDDLE) / RATE
EFFECTS, TROUBLED = {}, {}


def hides(seed, *names, among=EFFECTS, **more):
    """Add a record of N + K of unequal size on these axes, in which the function hides something."""
    # It changes the axes x by name, of which it gets the truth, and returns the effects.

    def make(hide, seed=seed):
        rng, x, truth = np.random.default_rng(seed), {}, {}
        for k, name in enumerate(names):
            c = crossing((1.0 + 0.3 * k) * (GYRO if name.startswith("gyro") else ACCEL), K=20.0)
            x[name], truth[name] = sensor(rng, MIDDLE, **c), labelled(**c)
        effects = hide(rng, x, truth) or ()
        return Record(np.column_stack(list(x.values())), names, truth, effects=effects, **more)

    def added(hide):
        among[hide.__name__] = partial(make, hide)
        return hide

    return added


def level(truth, name):
    """Deviation of the white noise of an axis, from sample to sample."""
    return truth[name]["angle_random_walk"] * np.sqrt(RATE)


@hides(21, *GYROS, *ACCELS)
def lines(_, x, truth):
    """One vibration with a harmonic on four of six axes, of unequal size."""
    sizes = {"gyro_x": 0.25, "gyro_z": 0.4, "accel_x": 0.3, "accel_y": 0.55}
    for k, (name, size) in enumerate(sizes.items()):
        amplitude = size * level(truth, name)
        x[name] = x[name] + line(amplitude, 7.3, 0.5 * k) + line(0.5 * amplitude, 14.6, 1.0 + k)
    return (Effect("sinusoid", tuple(sizes), {"frequency": 7.3}),)


@hides(22, "gyro_x", "gyro_y")
def hum(rng, x, truth):
    told = {"frequency": 27.0, "quality_factor": 30.0, "amplitude": 0.5 * level(truth, "gyro_y")}
    x["gyro_y"] += oscillator(rng, MIDDLE, told["amplitude"], 27.0, 30.0)
    return (Effect("resonance", ("gyro_y",), told),)


@hides(23, "gyro_x", "accel_x")
def steps(_, x, truth):
    """Two, one after the other."""
    first, second = 0.5 * level(truth, "gyro_x"), -0.35 * level(truth, "gyro_x")
    x["gyro_x"] = x["gyro_x"] + first * (TIME >= 47.0) + second * (TIME >= 112.0)
    told = ({"time": 47.0, "amplitude": first}, {"time": 112.0, "amplitude": second})
    return tuple(Effect("bias_step", ("gyro_x",), p) for p in told)


@hides(24, "gyro_x", "gyro_z")
def telegraph(rng, x, truth):
    amplitude, dwell = 0.9 * level(truth, "gyro_z"), 9.0
    switches = np.cumsum(rng.exponential(dwell, 200))
    x["gyro_z"] += amplitude * (np.searchsorted(switches, TIME) % 2)
    told = {"amplitude": amplitude, "dwell_time": dwell, "switches": switches[switches < TIME[-1]]}
    return (Effect("telegraph", ("gyro_z",), told),)


@hides(25, "accel_y", "gyro_x")
def warm_up(_, x, truth):
    amplitude, time = 0.8 * level(truth, "accel_y"), 25.0
    x["accel_y"] += amplitude * np.exp(-TIME / time)
    return (Effect("warm_up", ("accel_y",), {"amplitude": amplitude, "time_constant": time}),)


_since = np.maximum(np.arange(MIDDLE + 300) - 300, 0) / RATE
_TWO = 2.0 * np.sin(2.0 * np.pi * _since / 55.0), 1.5 * np.sin(2.0 * np.pi * _since / 23.0 + 1.0)
DEGREES = 25.0 + _TWO[0] + _TWO[1]


@hides(26, "gyro_x", "accel_z", auxiliary={"temperature": DEGREES[300:]})
def temperature(_, x, truth):
    """A bias that follows the temperature 3 s later; it begins to change when the record begins."""
    coefficient = 0.3 * level(truth, "gyro_x")
    x["gyro_x"] += coefficient * DEGREES[:MIDDLE]
    return (Effect("temperature", ("gyro_x",), {"coefficient": coefficient, "lag": 3.0}),)


@hides(27, "gyro_y", "accel_x")
def outliers(rng, x, truth):
    places = np.sort(rng.choice(MIDDLE, 12, replace=False))
    sizes = rng.choice([-1.0, 1.0], 12) * rng.uniform(12.0, 30.0, 12) * level(truth, "gyro_y")
    x["gyro_y"][places] += sizes
    told = {"count": 12, "times": places / RATE, "scale": np.sqrt(np.mean(sizes**2))}
    return (Effect("outliers", ("gyro_y",), told),)


@hides(28, *GYROS, *ACCELS)
def knock(rng, x, truth):
    """Someone touches the table for three seconds: four of six axes shake."""
    start, length, axes = 6_000, 300, ("gyro_x", "gyro_y", "accel_x", "accel_z")
    band = scipy.signal.butter(2, (1.0, 8.0), "bandpass", fs=RATE, output="sos")
    for name in axes:
        shake = scipy.signal.sosfilt(band, rng.standard_normal(length + 500))[500:] * np.hanning(length)
        x[name][start : start + length] += 12.0 * level(truth, name) * shake / np.max(np.abs(shake))
    return (Effect("disturbance", axes, {"start": start / RATE, "end": (start + length) / RATE}),)


@hides(29, "gyro_x", "gyro_y")
def louder(rng, x, truth):
    """White noise that is half as loud again for forty seconds."""
    x["gyro_x"][10_000:14_000] += np.sqrt(1.5**2 - 1.0) * level(truth, "gyro_x") * rng.standard_normal(4_000)
    return (Effect("variance_change", ("gyro_x",), {"start": 100.0, "end": 140.0, "ratio": 1.5}),)


@hides(30, *GYROS)
def rounded(_, x, truth):
    """Coarse steps on one axis, a range that is too small on another, nothing on the third."""
    step = 1.8 * level(truth, "gyro_x")
    x["gyro_x"] = step * np.round(x["gyro_x"] / step)
    centre, std = np.mean(x["gyro_y"]), np.std(x["gyro_y"])
    low, high = centre - 1.4 * std, centre + 1.1 * std
    x["gyro_y"] = np.clip(x["gyro_y"], low, high)
    limits = {"upper_level": high, "lower_level": low}
    limits["fraction"] = np.mean((x["gyro_y"] == low) | (x["gyro_y"] == high))
    return (Effect("rounding", ("gyro_x",), {"step": step}), Effect("saturation", ("gyro_y",), limits))


@hides(31, *GYROS)
def common(rng, x, truth):
    """Noise that two of three axes share, with opposite signs: of the white noise of both 40 %."""
    shared = rng.standard_normal(MIDDLE)
    for name, sign in (("gyro_x", 1.0), ("gyro_z", -1.0)):
        N, K = truth[name].values()
        own = white(rng, MIDDLE, N) / np.sqrt(RATE)
        mixed = np.sqrt(0.6) * own * np.sqrt(RATE) + np.sqrt(0.4) * sign * level(truth, name) * shared
        x[name] = mixed + walk(rng, MIDDLE, K)
    return (Effect("common_mode", ("gyro_x", "gyro_z"), {"correlation": 0.4}),)


@hides(32, "gyro_x", "accel_z")
def two_effects(_, x, truth):
    """A step in one axis, a line in the other."""
    amplitude, height = 0.3 * level(truth, "accel_z"), 0.5 * level(truth, "gyro_x")
    x["gyro_x"] += height * (np.arange(MIDDLE) >= 9_000)
    x["accel_z"] += line(amplitude, 11.7, 2.0)
    wave = Effect("sinusoid", ("accel_z",), {"frequency": 11.7, "amplitude": amplitude, "phase": 2.0})
    return (Effect("bias_step", ("gyro_x",), {"time": 90.0, "amplitude": height}), wave)


CLEAN = {
    "clean_1": partial(basic, 33, MIDDLE, *((x, crossing(GYRO * k, B=1)) for k, x in enumerate(GYROS, 1))),
    "clean_2": partial(
        basic, 34, MIDDLE, ("accel_x", crossing(ACCEL, K=12)), ("gyro_y", crossing(GYRO, Q=0.05))
    ),
}


@hides(35, *GYROS, among=TROUBLED)
def handled(rng, x, truth):
    """Carried for a few seconds at both ends."""
    for name in x:
        for part, count in ((slice(600), 600), (slice(-400, None), 400)):
            noise = scipy.signal.lfilter([0.2], [1.0, -0.8], rng.standard_normal(count))
            x[name][part] += 40.0 * level(truth, name) * noise


@hides(36, "gyro_x", "accel_y", among=TROUBLED, options={"gaps": "fill"})
def lossy(rng, x, _):
    """A tenth of the samples were lost, in bursts of ten, on all axes at once."""
    for start in rng.choice(MIDDLE // 10 - 2, MIDDLE // 100, replace=False) * 10 + 10:
        for values in x.values():
            values[start : start + 10] = np.nan


@hides(37, "gyro_x", "gyro_y", among=TROUBLED, options={"gaps": "segments"})
def stretches(_, x, __):
    """Three, between pauses of 20 s."""
    for values in x.values():
        values[4_000:6_000] = values[11_000:13_000] = np.nan


@hides(38, *GYROS, among=TROUBLED)
def dead(_, x, truth):
    """An axis that says nothing between two that do."""
    x["gyro_y"] = np.full(MIDDLE, 0.01)
    del truth["gyro_y"]


def real(unit):
    """The first eleven minutes of a real unit, whose truth nobody knows."""
    # Raises FileNotFoundError without the data.
    import pandas as pd

    frame = pd.read_parquet(DATA / f"adis16405_unit{unit}.parquet")[:LONG]
    names = tuple(name for name in frame.columns if name.split("_")[0] in UNITS)
    scales = [UNITS[name.split("_")[0]][1] for name in names]
    return Record(frame[list(names)].to_numpy(float) * scales, names, {})


REAL = {f"real_{k}": partial(real, k) for k in (1, 2)}
RECORDS = PLAIN | SHAPED | EFFECTS | CLEAN | TROUBLED | REAL


def record(name):
    """The record of this name."""
    return dataclasses.replace(RECORDS[name](), name=name)
