"""Some forty records whose truth is known, made by NumPy recursions; nothing here comes from allanjax.

Noise follows the field's definitions: N, B, K, Q and R as in IEEE 952, a Gauss–Markov process
dx/dt = −x/T_c + q_c·w, all as means over the sample interval, so that spectra and Allan variances are those
of the continuous noise. Flicker noise and power laws are sums of Gauss–Markov processes whose correlation
times are an octave apart: the ripple of such a sum is below 1e-5. Everything is in rad/s and m/s² here, and
in the recording's own units for the package.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from places import DATA
from scipy import signal

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
    def fingerprint(self) -> list[float]:
        """Sums, sums of squares and a few samples of the axes: that it is the same record, to rounding."""
        x = np.nan_to_num(self.values)
        return [*x.sum(axis=0), *(x**2).sum(axis=0), *x[:: max(len(x) // 4, 1)].ravel()]

    def recording(self) -> aj.Recording:
        """The recording as a file would have given it."""
        sensors = [name.split("_")[0] for name in self.names]
        units = {f"{s}_unit": UNITS[s][0] for s in sensors}
        values = self.values / [UNITS[s][1] for s in sensors]
        options = {"auxiliary": dict(self.auxiliary)} if self.auxiliary else {}
        return aj.Recording.from_array(
            values, self.rate, names=list(self.names), name=self.name, **units, **options, **self.options
        )


# --- Noise --------------------------------------------------------------------------------------------------


def white(rng: np.random.Generator, n: int, N: float, rate: float = RATE) -> np.ndarray:
    """Angle or velocity random walk of coefficient N."""
    return N * np.sqrt(rate) * rng.standard_normal(n)


def quantization(rng: np.random.Generator, n: int, Q: float, rate: float = RATE) -> np.ndarray:
    """Differences of a phase that is rounded: errors of deviation Q, independent from sample to sample."""
    return Q * rate * np.diff(rng.standard_normal(n + 1))


def walk(rng: np.random.Generator, n: int, K: float, rate: float = RATE) -> np.ndarray:
    """Rate random walk: means over the sample interval of a Wiener process, exactly."""
    h = 1.0 / rate
    step, inside = rng.standard_normal((2, n)) * np.sqrt([[h], [h / 12.0]])
    end = np.cumsum(step)
    return K * (end - step / 2.0 + inside)


def gauss_markov(rng: np.random.Generator, n: int, std: float, time: float, rate: float = RATE) -> np.ndarray:
    """Means over the sample interval of a Gauss–Markov process of this deviation, exactly."""
    a = 1.0 / (rate * time)
    lost = -np.expm1(-a)
    end, cross = lost * (2.0 - lost), lost**2 / a
    mean = max((2.0 * (a - lost) - lost**2) / a**2 - cross**2 / end, 0.0)
    first, second = rng.standard_normal((2, n))
    start = rng.standard_normal()
    state = signal.lfilter([1.0], [1.0, lost - 1.0], np.r_[start, np.sqrt(end) * first])[:-1]
    return std * (lost / a * state + cross / np.sqrt(end) * first + np.sqrt(mean) * second)


def power_law(
    rng: np.random.Generator, n: int, density: float, exponent: float, rate: float = RATE
) -> np.ndarray:
    """Noise of two-sided PSD density·f^−exponent, 0 < exponent < 2, as a sum over correlation times."""
    times = 2.0 ** np.arange(np.log2(1e-3 / rate), np.log2(64.0 * n / rate))
    # ∫ 2cT^p/(1 + ω²T²) dlnT = πc ω^−p/sin(pπ/2), of which a sum over octaves is 1/ln 2.
    weight = density * (2.0 * np.pi) ** exponent * np.log(2.0) * np.sin(exponent * np.pi / 2.0) / np.pi
    stds = np.sqrt(weight * times ** (exponent - 1.0))
    return sum(gauss_markov(rng, n, s, t, rate) for s, t in zip(stds, times, strict=True))


def flicker(rng: np.random.Generator, n: int, B: float, rate: float = RATE) -> np.ndarray:
    """Bias instability, S(f) = B²/(2πf)."""
    return power_law(rng, n, B**2 / (2.0 * np.pi), 1.0, rate)


def oscillator(
    rng: np.random.Generator, n: int, std: float, frequency: float, quality: float, rate: float = RATE
) -> np.ndarray:
    """A damped oscillator driven by white noise, read at the sample instants, by its mode z: exact."""
    w = 2.0 * np.pi * frequency
    damping = w / (2.0 * quality)
    ringing = w * np.sqrt(1.0 - 1.0 / (4.0 * quality**2))
    pole = -damping + 1j * ringing
    # Position x = Re z and velocity v = Re(pole·z); their stationary covariance is diag(1, w²).
    back = np.linalg.inv([[1.0, 0.0], [pole.real, -pole.imag]])
    stationary = back @ np.diag([1.0, w**2]) @ back.T
    turn = np.exp(pole / rate)
    F = np.array([[turn.real, -turn.imag], [turn.imag, turn.real]])
    driven = np.linalg.cholesky(stationary - F @ stationary @ F.T) @ rng.standard_normal((2, n))
    driven[:, 0] = np.linalg.cholesky(stationary) @ rng.standard_normal(2)
    return std * signal.lfilter([1.0 + 0j], [1.0, -turn], driven[0] + 1j * driven[1]).real


def ramp(n: int, R: float, rate: float = RATE) -> np.ndarray:
    """Rate ramp."""
    return R * (np.arange(n) + 0.5) / rate


def line(n: int, amplitude: float, frequency: float, phase: float, rate: float = RATE) -> np.ndarray:
    """A sinusoid, read at the sample instants."""
    return amplitude * np.sin(2.0 * np.pi * frequency * np.arange(n) / rate + phase)


LABELS = {
    "Q": "quantization",
    "N": "angle_random_walk",
    "B": "bias_instability",
    "K": "rate_random_walk",
    "R": "drift_ramp",
}
MAKERS: dict[str, Callable[..., np.ndarray]] = {"Q": quantization, "N": white, "B": flicker, "K": walk}


def sensor(rng: np.random.Generator, n: int, rate: float = RATE, **coefficients: float) -> np.ndarray:
    """One axis with the basic terms of these coefficients."""
    x = np.zeros(n)
    for letter, value in coefficients.items():
        x += ramp(n, value, rate) if letter == "R" else MAKERS[letter](rng, n, value, rate)
    return x


def labelled(**coefficients: float) -> dict[str, float]:
    """The same coefficients by the package's labels."""
    return {LABELS[letter]: value for letter, value in coefficients.items()}


def crossing(N: float, **times: float) -> dict[str, float]:
    """N and coefficients whose Allan deviations meet that of N at these times [s]."""
    at = {
        "Q": lambda t: N * np.sqrt(t / 3.0),
        "B": lambda t: N / np.sqrt(t * 2.0 * np.log(2.0) / np.pi),
        "K": lambda t: N * np.sqrt(3.0) / t,
        "R": lambda t: N * np.sqrt(2.0) / t**1.5,
    }
    return {"N": N} | {letter: float(at[letter](time)) for letter, time in times.items()}


# The power of a mean over T is halved at SINC/T.
SINC = 0.442946
# N of a tactical gyro, and of an accelerometer of consumer grade.
GYRO, ACCEL = 0.15 * DEG / 60.0, 0.12 / 60.0


def basic(seed: int, n: int, *axes: tuple[str, dict[str, float]], rate: float = RATE, **more: Any) -> Record:
    """A record of basic terms: name and coefficients of each axis; a bias of its own on each."""
    rng = np.random.default_rng(seed)
    names = tuple(name for name, _ in axes)
    # The z axis of an accelerometer carries gravity.
    biases = [
        0.01 * DEG * (k + 1) if x.startswith("gyro") else G * x.endswith("z") - 0.1
        for k, x in enumerate(names)
    ]
    columns = [sensor(rng, n, rate, **c) + bias for (_, c), bias in zip(axes, biases, strict=True)]
    letters = sorted({letter for _, c in axes for letter in c}, key="QNBKR".index)
    truth = {name: labelled(**c) for name, c in axes}
    return Record(np.column_stack(columns), names, truth, rate, " + ".join(letters), **more)


# --- Plain records ------------------------------------------------------------------------------------------

PLAIN: dict[str, Callable[[], Record]] = {
    "white": lambda: basic(1, MIDDLE, ("gyro_x", {"N": GYRO})),
    "walk": lambda: basic(
        2, MIDDLE, ("gyro_x", crossing(GYRO, K=3.0)), ("gyro_y", crossing(3.0 * GYRO, K=6.0))
    ),
    "flicker": lambda: basic(3, MIDDLE, ("accel_z", crossing(ACCEL, B=0.5))),
    "quantized": lambda: basic(4, MIDDLE, ("gyro_z", crossing(GYRO, Q=0.3, K=8.0))),
    "small": lambda: basic(
        5,
        MIDDLE,
        ("gyro_x", crossing(GYRO, B=0.4)),
        ("gyro_y", crossing(1.7 * GYRO, B=0.8)),
        ("gyro_z", crossing(0.6 * GYRO, B=0.5)),
        ("accel_z", crossing(ACCEL, K=5.0)),
    ),
    "drifting": lambda: basic(6, LONG, ("gyro_x", crossing(GYRO, B=1.0, K=30.0, R=100.0))),
    "edge": lambda: basic(
        10, MIDDLE, ("gyro_x", crossing(GYRO, K=60.0)), ("accel_x", crossing(ACCEL, K=40.0))
    ),
    "many": lambda: basic(
        11, SHORT, *((f"gyro_{k}", {"N": GYRO * (1.0 + 0.1 * k)}) for k in range(1, 10)), rate=50.0
    ),
    "short": lambda: basic(12, 64, ("gyro_x", {"N": GYRO}), rate=20.0),
}


def with_markov(seed: int, n: int, *processes: tuple[float, float]) -> Record:
    """N and Gauss–Markov processes: their deviation over that of the white noise in 1 s, and T_c [s]."""
    rng = np.random.default_rng(seed)
    x, truth = white(rng, n, GYRO), {"angle_random_walk": GYRO}
    for k, (ratio, time) in enumerate(processes):
        x = x + gauss_markov(rng, n, ratio * GYRO, time)
        label = "markov" if len(processes) == 1 else f"markov_{k + 1}"
        amplitude = ratio * GYRO * np.sqrt(2.0 / time)
        truth |= {f"{label}_amplitude": amplitude, f"{label}_correlation_time": time}
    model = " + ".join(["N", *["markov"] * len(processes)])
    return Record(x[:, None], ("gyro_x",), {"gyro_x": truth}, model=model)


PLAIN |= {
    "markov_fast": lambda: with_markov(7, MIDDLE, (4.0, 0.3)),
    "markov_slow": lambda: with_markov(8, LONG, (3.0, 10.0)),
    "two_markovs": lambda: with_markov(9, LONG, (4.0, 0.2), (1.0, 20.0)),
}


# --- Filters, resonances, lines -----------------------------------------------------------------------------


def filtered(
    seed: int,
    b: np.ndarray,
    a: np.ndarray,
    model: str,
    axes: Mapping[str, dict[str, float]],
    shape: Mapping[str, float],
) -> Record:
    """Basic terms whose samples a filter of transfer b/a has passed."""
    rng = np.random.default_rng(seed)
    lead = 512
    columns = [signal.lfilter(b, a, sensor(rng, MIDDLE + lead, **c))[lead:] for c in axes.values()]
    truth = {name: labelled(**c) | dict(shape) for name, c in axes.items()}
    return Record(np.column_stack(columns), tuple(axes), truth, model=model)


def one_pole() -> Record:
    """Exponential smoothing, y = w·y + (1 − w)·x with w = exp(−2πf_c/rate)."""
    w = np.exp(-2.0 * np.pi * 18.0 / RATE)
    axes = {"gyro_x": crossing(GYRO, K=5.0)}
    return filtered(13, [1.0 - w], [1.0, -w], "low_pass1 * (N + K)", axes, {"low_pass1_bandwidth": 18.0})


def butterworth() -> Record:
    """The digital Butterworth filter of fourth order."""
    b, a = signal.butter(4, 21.0, fs=RATE)
    axes = {"gyro_y": crossing(GYRO, K=4.0)}
    return filtered(14, b, a, "butterworth(order=4) * (N + K)", axes, {"butterworth_bandwidth": 21.0})


def averaged() -> Record:
    """Means over 3.33 samples: of noise at thirty times the rate, every thirtieth of a mean of a hundred."""
    rng = np.random.default_rng(15)
    fine, width = 30, 100
    c = crossing(GYRO, K=5.0)
    x = sensor(rng, (MIDDLE + 8) * fine, RATE * fine, **c)
    means = signal.lfilter(np.full(width, 1.0 / width), [1.0], x)[8 * fine :: fine]
    truth = labelled(**c) | {"moving_average_bandwidth": SINC * fine * RATE / width}
    return Record(means[:, None], ("gyro_z",), {"gyro_z": truth}, model="moving_average * (N + K)")


def biquad() -> Record:
    """A second-order section, the bilinear transform of an analog low pass with Q = 0.9."""
    f0, quality = 15.0, 0.9
    k = np.tan(np.pi * f0 / RATE)
    norm = 1.0 + k / quality + k**2
    b, a = (
        np.array([1.0, 2.0, 1.0]) * k**2 / norm,
        [1.0, 2.0 * (k**2 - 1.0) / norm, (1.0 - k / quality + k**2) / norm],
    )
    axes = {"accel_x": crossing(ACCEL, K=5.0)}
    shape = {"biquad_bandwidth": f0, "biquad_quality_factor": quality}
    return filtered(16, b, a, "biquad * (N + K)", axes, shape)


def resonance() -> Record:
    """White noise and an oscillator of Q = 12 at 23 Hz."""
    rng = np.random.default_rng(17)
    std = 1.2 * GYRO * np.sqrt(RATE)
    x = white(rng, MIDDLE, GYRO) + oscillator(rng, MIDDLE, std, 23.0, 12.0)
    truth = {"resonance_amplitude": std, "resonance_frequency": 23.0, "resonance_quality_factor": 12.0}
    truth |= {"angle_random_walk": GYRO}
    return Record(x[:, None], ("gyro_x",), {"gyro_x": truth}, model="N + resonance")


def behind_a_filter() -> Record:
    """N, K and an oscillator behind exponential smoothing, on two unequal axes."""
    rng = np.random.default_rng(18)
    w, lead = np.exp(-2.0 * np.pi * 14.0 / RATE), 512
    columns, truth = [], {}
    for name, size, std in (("gyro_x", GYRO, 1.5), ("accel_y", ACCEL, 2.5)):
        c = crossing(size, K=5.0)
        level = std * size * np.sqrt(RATE)
        x = sensor(rng, MIDDLE + lead, **c) + oscillator(rng, MIDDLE + lead, level, 31.0, 20.0)
        columns.append(signal.lfilter([1.0 - w], [1.0, -w], x)[lead:])
        own = {"resonance_amplitude": level, "resonance_frequency": 31.0, "resonance_quality_factor": 20.0}
        truth[name] = labelled(**c) | own | {"low_pass1_bandwidth": 14.0}
    model = "low_pass1 * (N + K + resonance)"
    return Record(np.column_stack(columns), ("gyro_x", "accel_y"), truth, model=model)


def one_line() -> Record:
    """N, K and a sinusoid."""
    rng = np.random.default_rng(19)
    c = crossing(GYRO, K=5.0)
    amplitude = 0.35 * GYRO * np.sqrt(RATE)
    x = sensor(rng, MIDDLE, **c) + line(MIDDLE, amplitude, 3.21, 0.7)
    truth = labelled(**c) | {"sinusoid_amplitude": amplitude, "sinusoid_frequency": 3.21}
    return Record(x[:, None], ("gyro_x",), {"gyro_x": truth}, model="N + K + sinusoid")


def long_memory() -> Record:
    """N and a power law of exponent 1.5."""
    rng = np.random.default_rng(20)
    density = (2.0 * GYRO) ** 2
    x = white(rng, MIDDLE, GYRO) + power_law(rng, MIDDLE, density, 1.5)
    truth = {"angle_random_walk": GYRO, "power_law_amplitude": np.sqrt(density), "power_law_exponent": 1.5}
    return Record(x[:, None], ("gyro_x",), {"gyro_x": truth}, model="N + power_law")


SHAPED: dict[str, Callable[[], Record]] = {
    "one_pole": one_pole,
    "butterworth": butterworth,
    "averaged": averaged,
    "biquad": biquad,
    "resonance": resonance,
    "filtered": behind_a_filter,
    "line": one_line,
    "power_law": long_memory,
}


# --- Effects for the critic ---------------------------------------------------------------------------------

GYROS = ("gyro_x", "gyro_y", "gyro_z")
ACCELS = ("accel_x", "accel_y", "accel_z")


def quiet(seed: int, *names: str) -> tuple[np.random.Generator, dict[str, np.ndarray], dict[str, Any]]:
    """Axes of N + K of unequal size, by name, to hide something in; the generator and the truth."""
    rng = np.random.default_rng(seed)
    columns, truth = {}, {}
    for k, name in enumerate(names):
        c = crossing((1.0 + 0.3 * k) * (GYRO if name.startswith("gyro") else ACCEL), K=20.0)
        columns[name] = sensor(rng, MIDDLE, **c)
        truth[name] = labelled(**c)
    return rng, columns, truth


def level(truth: Mapping[str, Mapping[str, float]], name: str) -> float:
    """Deviation of the white noise of an axis, from sample to sample."""
    return truth[name]["angle_random_walk"] * np.sqrt(RATE)


def hidden(columns: Mapping[str, np.ndarray], truth: Any, *effects: Effect, **more: Any) -> Record:
    """The record of these axes."""
    return Record(np.column_stack(list(columns.values())), tuple(columns), truth, effects=effects, **more)


def lines() -> Record:
    """One vibration with a harmonic on four of six axes, of unequal size."""
    _, x, truth = quiet(21, *GYROS, *ACCELS)
    sizes = {"gyro_x": 0.25, "gyro_z": 0.4, "accel_x": 0.3, "accel_y": 0.55}
    for k, (name, size) in enumerate(sizes.items()):
        amplitude = size * level(truth, name)
        x[name] = (
            x[name] + line(MIDDLE, amplitude, 7.3, 0.5 * k) + line(MIDDLE, 0.5 * amplitude, 14.6, 1.0 + k)
        )
    return hidden(x, truth, Effect("sinusoid", tuple(sizes), {"frequency": 7.3}))


def hum() -> Record:
    """A resonance in one of two axes."""
    rng, x, truth = quiet(22, "gyro_x", "gyro_y")
    amplitude = 0.5 * level(truth, "gyro_y")
    x["gyro_y"] = x["gyro_y"] + oscillator(rng, MIDDLE, amplitude, 27.0, 30.0)
    told = {"frequency": 27.0, "quality_factor": 30.0, "amplitude": amplitude}
    return hidden(x, truth, Effect("resonance", ("gyro_y",), told))


def steps() -> Record:
    """Two steps of the bias, one after the other, in one of two axes."""
    _, x, truth = quiet(23, "gyro_x", "accel_x")
    t = np.arange(MIDDLE) / RATE
    first, second = 0.5 * level(truth, "gyro_x"), -0.35 * level(truth, "gyro_x")
    x["gyro_x"] = x["gyro_x"] + first * (t >= 47.0) + second * (t >= 112.0)
    told = ({"time": 47.0, "amplitude": first}, {"time": 112.0, "amplitude": second})
    return hidden(x, truth, *(Effect("bias_step", ("gyro_x",), p) for p in told))


def telegraph() -> Record:
    """A bias that jumps between two levels."""
    rng, x, truth = quiet(24, "gyro_x", "gyro_z")
    amplitude, dwell = 0.9 * level(truth, "gyro_z"), 9.0
    switches = np.cumsum(rng.exponential(dwell, 200))
    state = np.searchsorted(switches, np.arange(MIDDLE) / RATE) % 2
    x["gyro_z"] = x["gyro_z"] + amplitude * state
    return hidden(x, truth, Effect("telegraph", ("gyro_z",), {"amplitude": amplitude, "dwell_time": dwell}))


def warm_up() -> Record:
    """An exponential settling of the bias."""
    _, x, truth = quiet(25, "accel_y", "gyro_x")
    amplitude, time = 0.8 * level(truth, "accel_y"), 25.0
    x["accel_y"] = x["accel_y"] + amplitude * np.exp(-np.arange(MIDDLE) / RATE / time)
    return hidden(x, truth, Effect("warm_up", ("accel_y",), {"amplitude": amplitude, "time_constant": time}))


def temperature() -> Record:
    """A bias that follows the temperature 3 s later; it begins to change when the record begins."""
    _, x, truth = quiet(26, "gyro_x", "accel_z")
    t = np.maximum(np.arange(MIDDLE + 300) - 300, 0) / RATE
    degrees = 25.0 + 2.0 * np.sin(2.0 * np.pi * t / 55.0) + 1.5 * np.sin(2.0 * np.pi * t / 23.0 + 1.0)
    coefficient = 0.3 * level(truth, "gyro_x")
    x["gyro_x"] = x["gyro_x"] + coefficient * degrees[:MIDDLE]
    told = {"coefficient": coefficient, "lag": 3.0}
    effect = Effect("temperature", ("gyro_x",), told)
    return hidden(x, truth, effect, auxiliary={"temperature": degrees[300:]})


def outliers() -> Record:
    """A dozen single samples that are far off."""
    rng, x, truth = quiet(27, "gyro_y", "accel_x")
    places = np.sort(rng.choice(MIDDLE, 12, replace=False))
    sizes = rng.choice([-1.0, 1.0], 12) * rng.uniform(12.0, 30.0, 12) * level(truth, "gyro_y")
    x["gyro_y"] = x["gyro_y"].copy()
    x["gyro_y"][places] += sizes
    return hidden(x, truth, Effect("outliers", ("gyro_y",), {"count": 12, "times": tuple(places / RATE)}))


def knock() -> Record:
    """Someone touches the table for three seconds: four of six axes shake."""
    rng, x, truth = quiet(28, *GYROS, *ACCELS)
    start, length = 6_000, 300
    band = signal.butter(2, (1.0, 8.0), "bandpass", fs=RATE, output="sos")
    axes = ("gyro_x", "gyro_y", "accel_x", "accel_z")
    for name in axes:
        shake = signal.sosfilt(band, rng.standard_normal(length + 500))[500:] * np.hanning(length)
        x[name] = x[name].copy()
        x[name][start : start + length] += 12.0 * level(truth, name) * shake / np.max(np.abs(shake))
    told = {"start": start / RATE, "end": (start + length) / RATE}
    return hidden(x, truth, Effect("disturbance", axes, told))


def louder() -> Record:
    """White noise that is half as loud again for forty seconds."""
    rng, x, truth = quiet(29, "gyro_x", "gyro_y")
    inside = slice(10_000, 14_000)
    x["gyro_x"] = x["gyro_x"].copy()
    x["gyro_x"][inside] += np.sqrt(1.5**2 - 1.0) * level(truth, "gyro_x") * rng.standard_normal(4_000)
    told = {"start": 100.0, "end": 140.0, "ratio": 1.5}
    return hidden(x, truth, Effect("variance_change", ("gyro_x",), told))


def rounded() -> Record:
    """Coarse steps on one axis, a range that is too small on another, nothing on the third."""
    _, x, truth = quiet(30, *GYROS)
    step = 1.8 * level(truth, "gyro_x")
    x["gyro_x"] = step * np.round(x["gyro_x"] / step)
    centre, std = np.mean(x["gyro_y"]), np.std(x["gyro_y"])
    low, high = centre - 1.4 * std, centre + 1.1 * std
    x["gyro_y"] = np.clip(x["gyro_y"], low, high)
    rounding = Effect("rounding", ("gyro_x",), {"step": step})
    return hidden(
        x, truth, rounding, Effect("saturation", ("gyro_y",), {"upper_level": high, "lower_level": low})
    )


def common() -> Record:
    """Noise that two of three axes share, with opposite signs."""
    rng, x, truth = quiet(31, *GYROS)
    # Of the white noise of both axes 40 % is one and the same.
    shared = rng.standard_normal(MIDDLE)
    for name, sign in (("gyro_x", 1.0), ("gyro_z", -1.0)):
        c = dict(zip(("N", "K"), truth[name].values(), strict=True))
        own = white(rng, MIDDLE, c["N"]) / np.sqrt(RATE)
        mixed = np.sqrt(0.6) * own * np.sqrt(RATE) + np.sqrt(0.4) * sign * level(truth, name) * shared
        x[name] = mixed + walk(rng, MIDDLE, c["K"])
    return hidden(x, truth, Effect("common_mode", ("gyro_x", "gyro_z"), {"correlation": 0.4}))


def two_effects() -> Record:
    """A step in one axis, a line in the other."""
    _, x, truth = quiet(32, "gyro_x", "accel_z")
    amplitude, height = 0.3 * level(truth, "accel_z"), 0.5 * level(truth, "gyro_x")
    x["gyro_x"] = x["gyro_x"] + height * (np.arange(MIDDLE) >= 9_000)
    x["accel_z"] = x["accel_z"] + line(MIDDLE, amplitude, 11.7, 2.0)
    step = Effect("bias_step", ("gyro_x",), {"time": 90.0, "amplitude": height})
    return hidden(
        x, truth, step, Effect("sinusoid", ("accel_z",), {"frequency": 11.7, "amplitude": amplitude})
    )


EFFECTS: dict[str, Callable[[], Record]] = {
    f.__name__: f
    for f in (
        lines,
        hum,
        steps,
        telegraph,
        warm_up,
        temperature,
        outliers,
        knock,
        louder,
        rounded,
        common,
        two_effects,
    )
}
CLEAN: dict[str, Callable[[], Record]] = {
    "clean_1": lambda: basic(
        33, MIDDLE, *((x, crossing(GYRO * (k + 1), B=1.0)) for k, x in enumerate(GYROS))
    ),
    "clean_2": lambda: basic(
        34, MIDDLE, ("accel_x", crossing(ACCEL, K=12.0)), ("gyro_y", crossing(GYRO, Q=0.05))
    ),
}


# --- Records in trouble -------------------------------------------------------------------------------------


def handled() -> Record:
    """Carried for a few seconds at both ends."""
    rng, x, truth = quiet(35, *GYROS)
    for name in x:
        x[name] = x[name].copy()
        for part in (slice(0, 600), slice(MIDDLE - 400, MIDDLE)):
            count = part.stop - part.start
            x[name][part] += (
                40.0 * level(truth, name) * signal.lfilter([0.2], [1.0, -0.8], rng.standard_normal(count))
            )
    return hidden(x, truth)


def lossy() -> Record:
    """A tenth of the samples were lost, in bursts of ten, on all axes at once."""
    rng, x, truth = quiet(36, "gyro_x", "accel_y")
    lost = np.zeros(MIDDLE, bool)
    for start in rng.choice(MIDDLE // 10 - 2, MIDDLE // 100, replace=False) * 10 + 10:
        lost[start : start + 10] = True
    x = {name: np.where(lost, np.nan, values) for name, values in x.items()}
    return hidden(x, truth, options={"gaps": "fill"})


def stretches() -> Record:
    """Three stretches between pauses of 20 s."""
    _, x, truth = quiet(37, "gyro_x", "gyro_y")
    paused = np.zeros(MIDDLE, bool)
    paused[4_000:6_000] = paused[11_000:13_000] = True
    x = {name: np.where(paused, np.nan, values) for name, values in x.items()}
    return hidden(x, truth, options={"gaps": "segments"})


def dead() -> Record:
    """An axis that says nothing between two that do."""
    _, x, truth = quiet(38, *GYROS)
    x["gyro_y"] = np.full(MIDDLE, 0.01)
    del truth["gyro_y"]
    return hidden(x, truth)


TROUBLED: dict[str, Callable[[], Record]] = {f.__name__: f for f in (handled, lossy, stretches, dead)}


def real(unit: int) -> Record:
    """The first eleven minutes of a real unit, whose truth nobody knows.

    Raises FileNotFoundError without the data.
    """
    import pandas as pd

    frame = pd.read_parquet(DATA / f"adis16405_unit{unit}.parquet")[:LONG]
    names = tuple(name for name in frame.columns if name.split("_")[0] in UNITS)
    scales = [UNITS[name.split("_")[0]][1] for name in names]
    return Record(frame[list(names)].to_numpy(float) * scales, names, {}, effects=())


REAL: dict[str, Callable[[], Record]] = {f"real_{k}": functools.partial(real, k) for k in (1, 2)}
RECORDS = PLAIN | SHAPED | EFFECTS | CLEAN | TROUBLED | REAL


def record(name: str) -> Record:
    """The record of this name."""
    return dataclasses.replace(RECORDS[name](), name=name)
