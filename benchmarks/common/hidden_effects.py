"""Static records of sensors of any grade that hide an effect, for tests of what finds and names effects.

Nothing here comes from allanjax. An effect's `multiple` tells how far it is above its detection limit,
the amplitude at which a detector that knows the noise and the effect's shape expects a log-likelihood
ratio of 12.5 (see hidden_sensors). For effects that are added as a known path it is their matched-filter
SNR over 5. It is NaN where an effect has no such limit.
"""

import dataclasses

import numpy as np
import scipy.signal

from benchmarks.common.hidden_sensors import (
    DETECTABLE_SNR,
    basic_model_limit,
    coloured_noise,
    draw_length,
    draw_sensor,
    draw_temperature,
    log_uniform,
    matched_filter_limit,
    matched_filter_snr,
    power_limit,
    solve,
    synthesize,
    term_noise,
    term_variances,
    variances,
    white_std,
)

SETTLING = 64  # samples that a low-pass filter sees before the record begins


@dataclasses.dataclass(frozen=True)
class Effect:
    """The truth about an effect; parameters in SI (°C for temperatures), times from the first sample."""

    cause: str
    parameters: dict[str, float | tuple[float, ...]]
    multiple: float
    axes: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Hidden:
    """A record [n, axes] in SI, its auxiliary channels, and the truth about it.

    sensor: coefficients of the first axis, terms that are the hidden effect included; `axis_scale`: of all
    axes' noise, relative to the first one.
    """

    values: np.ndarray
    rate: float
    names: tuple[str, ...]
    auxiliary: dict[str, np.ndarray]
    sensor: dict
    effects: tuple[Effect, ...]


@dataclasses.dataclass(frozen=True)
class Scene:
    """What effects are made from. temperature: [n + n // 20], of which the last n samples are recorded."""

    sensor: dict
    n: int
    rate: float
    rng: np.random.Generator
    multiple: float
    temperature: np.ndarray

    @property
    def times(self):
        return np.arange(self.n) / self.rate

    @property
    def duration(self):
        return self.n / self.rate

    @property
    def white_std(self):
        return white_std(self.sensor, self.rate)

    @property
    def frequencies(self):
        return np.arange(1, self.n) * self.rate / (2.0 * self.n)

    def sign(self):
        return float(self.rng.choice([-1.0, 1.0]))

    def over_noise(self, power):
        return power / variances(self.sensor, self.n, self.rate)


# Known paths. Each returns a shape [n], its parameters, and those that grow with it, at factor one.


def sinusoid(s):
    frequency = log_uniform(s.rng, 20.0 / s.duration, 0.45 * s.rate)
    harmonic = 0.5 if s.rng.random() < 0.2 and frequency < 0.22 * s.rate else 0.0
    first, second = s.rng.uniform(0.0, 2.0 * np.pi, 2)
    angle = 2.0 * np.pi * frequency * s.times
    shape = np.sin(angle + first) + harmonic * np.sin(2.0 * angle + second)
    return shape, {"frequency": frequency, "harmonic": harmonic}, {"amplitude": 1.0}


def warm_up(s):
    time_constant = log_uniform(s.rng, s.duration / 30.0, s.duration / 3.0)
    return np.exp(-s.times / time_constant), {"time_constant": time_constant}, {"amplitude": s.sign()}


def bias_step(s):
    time, second = s.rng.uniform(0.1, 0.9, 2) * s.duration
    shape, fixed, scaled = (s.times >= time).astype(float), {"time": time}, {"amplitude": s.sign()}
    if s.rng.random() < 0.25:
        relative = s.sign() * s.rng.uniform(0.5, 1.5)
        shape += relative * (s.times >= second)
        fixed["time_2"], scaled["amplitude_2"] = second, relative * scaled["amplitude"]
    return shape, fixed, scaled


def telegraph(s):
    dwell_time = log_uniform(s.rng, s.duration / 20.0, s.duration / 4.0)
    switches = np.zeros(0)
    while len(switches) < 3:
        switches = np.cumsum(s.rng.exponential(dwell_time, 400))
        switches = switches[switches < s.duration]
    shape = (np.searchsorted(switches, s.times) % 2).astype(float)
    return shape, {"dwell_time": dwell_time, "switches": tuple(switches)}, {"amplitude": s.sign()}


def temperature(s):
    lag = int(s.rng.integers(s.n // 20 + 1))
    end = len(s.temperature) - lag
    return s.temperature[end - s.n : end], {"lag": lag / s.rate}, {"coefficient": s.sign()}


def drift_ramp(s):
    return s.times, {}, {"coefficient": s.sign()}


def add_path(cause, make, s):
    shape, fixed, scaled = make(s)
    factor = s.multiple * matched_filter_limit(s.sensor, s.n, s.rate, shape)
    sign = np.sign(next(iter(scaled.values())))
    return sign * factor * shape, fixed | {c: factor * v for c, v in scaled.items()}, s.multiple


PATHS = {f.__name__: f for f in (sinusoid, warm_up, bias_step, telegraph, temperature, drift_ramp)}

# Paths that are plain to see, many white standard deviations. Each returns the path and its parameters.


def outliers(s):
    magnitudes, times = np.zeros(0), np.zeros(0, int)
    while not np.any(np.abs(magnitudes) > 1.0):
        magnitudes = s.rng.standard_normal(s.rng.integers(3, 41))
        times = np.sort(s.rng.choice(s.n, len(magnitudes), replace=False))
    path = np.zeros(s.n)
    path[times] = magnitudes
    scale = max(6.0 * s.white_std, s.multiple * matched_filter_limit(s.sensor, s.n, s.rate, path))
    plain = times[scale * np.abs(magnitudes) > 5.0 * s.white_std]
    parameters = {"count": len(plain), "times": tuple(plain / s.rate), "scale": scale}
    return scale * path, parameters | {"all_times": tuple(times / s.rate)}


def disturbance(s):
    length = int(min(s.rng.uniform(2.0, 20.0), s.duration / 3.0) * s.rate)
    start = int(s.rng.integers(s.n - length))
    lead = int(10.0 * s.rate)
    band = scipy.signal.butter(2, (0.3, 5.0), "bandpass", fs=s.rate, output="sos")
    motion = scipy.signal.sosfilt(band, s.rng.standard_normal(lead + length))[lead:] * np.hanning(length)
    peak = 8.0 * s.white_std * s.multiple / 1.5
    path = np.zeros(s.n)
    path[start : start + length] = peak * motion / np.max(np.abs(motion))
    return path, {"start": start / s.rate, "end": (start + length) / s.rate, "amplitude": peak}


def add_plain(cause, make, s):
    path, parameters = make(s)
    return path, parameters, matched_filter_snr(s.sensor, s.n, s.rate, path) / DETECTABLE_SNR


PLAIN = {f.__name__: f for f in (outliers, disturbance)}

# Noise of unit amplitude. Each returns it, its power over the sensor's, parameters, the amplitude's name.


def resonance(s):
    """A damped oscillator that white noise drives, of which the poles are sampled exactly."""
    frequency = s.rng.uniform(0.02, 0.4) * s.rate
    quality = log_uniform(s.rng, 5.0, 80.0)
    angle, damping = 2.0 * np.pi * frequency / s.rate, 0.5 / quality
    pole = np.exp(angle * (-damping + 1j * np.sqrt(1.0 - damping**2)))
    first, second = 2.0 * pole.real, -(abs(pole) ** 2)
    gain = np.sqrt((1.0 + second) * ((1.0 - second) ** 2 - first**2) / (1.0 - second))
    filtering = [gain], [1.0, -first, -second]
    lead = int(5.0 * quality / frequency * s.rate)
    noise = scipy.signal.lfilter(*filtering, s.rng.standard_normal(lead + s.n))[lead:]
    power = np.abs(scipy.signal.freqz(*filtering, s.frequencies, fs=s.rate)[1]) ** 2
    return noise, s.over_noise(power), {"frequency": frequency, "quality_factor": quality}, "amplitude"


def term(letter):
    def draw_term(s):
        time = log_uniform(s.rng, s.duration / 1000.0, s.duration / 10.0)
        power = term_variances(letter, s.n, s.rate, time)
        parameters, name = ({"correlation_time": time}, "amplitude") if letter == "M" else ({}, "coefficient")
        return term_noise(letter, s.n, s.rate, s.rng, time), s.over_noise(power), parameters, name

    return draw_term


def add_noise(cause, make, s):
    noise, ratio, fixed, name = make(s)
    amplitude = np.sqrt(power_limit(ratio)) * s.multiple
    return amplitude * noise, fixed | {name: amplitude}, s.multiple


TERMS = {
    "quantization": "Q",
    "angle_random_walk": "N",
    "bias_instability": "B",
    "rate_random_walk": "K",
    "markov": "M",
    "drift_ramp": "R",
}
NOISES = {"resonance": resonance} | {c: term(x) for c, x in TERMS.items() if x != "R"}


def power_law(cause, make, s):
    """Its limit is that against the best basic model; `multiple_of_true`: against the sensor's."""
    exponent = float(s.rng.choice([0.5, 1.5, 2.6]))
    noise = synthesize(lambda f: f**-exponent, s.n, s.rate, s.rng)
    power = s.rate * s.frequencies**-exponent
    amplitude = s.multiple * np.sqrt(basic_model_limit(s.sensor, s.n, s.rate, power))
    against_true = amplitude / np.sqrt(power_limit(s.over_noise(power)))
    parameters = {"exponent": exponent, "density_at_1_hz": amplitude**2, "multiple_of_true": against_true}
    return amplitude * noise, parameters, s.multiple


def variance_change(cause, make, s):
    """ratio: of the white noise's standard deviations, inside over outside; multiple: of ratio² − 1."""
    share = s.rng.uniform(0.2, 0.6)
    start = s.rng.choice([1.0 - share, s.rng.uniform(0.05, 1.0 - share)]) * s.duration
    end = start + share * s.duration
    white = s.sensor["N"] ** 2 * s.rate
    excess = s.multiple * power_limit(s.over_noise(white), share)
    noise = np.sqrt(excess * white) * s.rng.standard_normal(s.n)
    parameters = {"start": start, "end": end, "ratio": np.sqrt(1.0 + excess)}
    return np.where((s.times >= start) & (s.times < end), noise, 0.0), parameters, s.multiple


# What happens to a finished axis, in this order. Each takes its values and returns them with the parameters.


def saturation(values, s):
    centre, std = np.mean(values), np.std(values)
    lower, upper = centre + std * s.rng.uniform(0.8, 2.0, 2) * [-1.0, 1.0]
    if s.rng.random() < 0.5:
        return np.minimum(values, upper), {"level": upper}
    return np.clip(values, lower, upper), {"level": upper, "lower": lower}


def rounding(values, s):
    step = s.rng.uniform(0.5, 4.0) * s.white_std
    return step * np.round(values / step), {"step": step}


def repeated_samples(values, s):
    """Lost values, alone or up to 20 in a row (more where two bursts meet); parameters: of the repeats."""
    lost = s.rng.uniform(0.005, 0.2) * s.n
    lengths = s.rng.integers(1, s.rng.integers(1, 21) + 1, int(lost) + 1)
    lengths = lengths[: max(1, np.searchsorted(np.cumsum(lengths), lost))]
    repeats = np.zeros(s.n, bool)
    for start, length in zip(s.rng.integers(1, s.n, len(lengths)), lengths, strict=True):
        repeats[start : start + length] = True
    values = values[np.maximum.accumulate(np.where(repeats, 0, np.arange(s.n)))]
    edges = np.flatnonzero(np.diff(values) != 0.0)
    longest = np.max(np.diff(np.concatenate([[-1], edges, [s.n - 1]]))) - 1
    return values, {"fraction": float(np.mean(np.diff(values) == 0.0)), "longest": int(longest)}


CHANGES = {f.__name__: f for f in (saturation, rounding, repeated_samples)}

# What happens to the noise itself; a filter passes what is added to it, too.


def low_pass(rate, rng):
    """Exponential smoothing or a Butterworth filter of second order; bandwidth: at −3 dB."""
    bandwidth, order = rng.uniform(0.15, 0.7) * rate / 2.0, int(rng.integers(1, 3))
    memory = 2.0 - np.cos(2.0 * np.pi * bandwidth / rate)
    memory -= np.sqrt(memory**2 - 1.0)
    smoothing = [1.0 - memory], [1.0, -memory]
    filtering = smoothing if order == 1 else scipy.signal.butter(2, bandwidth, fs=rate)
    return filtering, {"bandwidth": bandwidth, "order": order}


def passed(path, parameters, filtering, rate):
    """A path behind the filter, as if it had been for long where it begins; a line's amplitude there."""
    settled = scipy.signal.lfilter_zi(*filtering) * path[0]
    path = scipy.signal.lfilter(*filtering, path, zi=settled)[0]
    if "frequency" not in parameters:
        return path, parameters
    gain = abs(scipy.signal.freqz(*filtering, [parameters["frequency"]], fs=rate)[1][0])
    return path, parameters | {"amplitude": gain * parameters["amplitude"]}


def common_mode(white, s):
    """White noise [n, 3] of which two or all axes share a part; correlation: of two of them."""
    gains = s.rng.choice([-1.0, 1.0], 3)
    gains[s.rng.integers(3)] *= s.rng.choice([0.0, 1.0])
    share = s.over_noise(s.sensor["N"] ** 2 * s.rate)
    count = np.count_nonzero(gains)

    def llr(odds):
        r = share * odds / (1.0 + odds)
        return -0.5 * np.sum(np.log1p((count - 1) * r) + (count - 1) * np.log1p(-r))

    odds = solve(llr)
    limit = odds / (1.0 + odds)
    correlation = min(0.6, s.multiple * limit)
    shared = s.sensor["N"] * np.sqrt(s.rate) * s.rng.standard_normal((len(white), 1))
    own = np.where(gains != 0.0, np.sqrt(1.0 - correlation), 1.0)
    parameters = {"correlation": correlation, "gains": tuple(gains)}
    return own * white + np.sqrt(correlation) * gains * shared, parameters, correlation / limit


ADDED = (
    {c: (add_path, f) for c, f in PATHS.items()}
    | {c: (add_plain, f) for c, f in PLAIN.items()}
    | {c: (add_noise, f) for c, f in NOISES.items()}
    | {"power_law": (power_law, None), "variance_change": (variance_change, None)}
)
CAUSES = (*ADDED, "low_pass", "common_mode", *CHANGES)


class Split:
    """A generator whose noise has random numbers of its own, so that another noise changes nothing else."""

    def __init__(self, rng, noise):
        self.rng, self.standard_normal = rng, np.random.default_rng(noise).standard_normal

    def __getattr__(self, name):
        return getattr(self.rng, name)


def draw(seed, cause, multiple=(1.5, 5.0), *, duration=None, rate=None, without="", noise=None):
    """A record with a hidden effect, with two of them, or with none (None); the same for the same arguments.

    multiple: of the detection limit, or the range of a log-uniform draw for each effect; without: letters of
    terms that the sensor lacks; noise: a number for the noise of another record of the same sensor.
    """
    causes = () if cause is None else (cause,) if isinstance(cause, str) else tuple(cause)
    own = np.random.default_rng([seed, *(CAUSES.index(c) + 1 for c in causes)])
    rng = own if noise is None else Split(own, [seed, noise])
    n, rate = draw_length(rng, duration, rate)
    without = [TERMS[c] for c in causes if c in TERMS] + list("BKMR" if "power_law" in causes else without)
    needs = "QB" if "angle_random_walk" in causes else ""
    sensor = draw_sensor(rng, n / rate, rate, without, needs)
    multiples = {c: log_uniform(rng, *np.broadcast_to(multiple, 2)) for c in causes}
    scenes = {c: Scene(sensor, n, rate, rng, multiples[c], draw_temperature(n, rate, own)) for c in causes}

    kind, n_axes = sensor["kind"], 3 if "common_mode" in causes else 1
    names = tuple(f"{kind}_{x}" for x in ("xyz" if n_axes == 3 else rng.choice(list("xyz"))))
    size = n + SETTLING
    noise = sensor.get("N", 0.0) * np.sqrt(rate) * rng.standard_normal((size, n_axes))
    found = {}
    if "common_mode" in causes:
        noise, *found["common_mode"] = common_mode(noise, scenes["common_mode"])
    noise += np.stack([coloured_noise(sensor, size, rate, rng) for _ in names], 1)
    if "low_pass" in causes:
        filtering, parameters = low_pass(rate, rng)
        noise[:, 0] = scipy.signal.lfilter(*filtering, noise[:, 0])
        found["low_pass"] = parameters, np.nan
    scale = np.concatenate([[1.0], rng.uniform(0.8, 1.25, n_axes - 1)])
    bias = np.concatenate([[sensor["bias"]], sensor["bias"] * rng.uniform(-1.0, 1.0, n_axes - 1)])
    ramp = sensor.get("R", 0.0) * np.arange(n)[:, None] / rate
    values = scale * (noise[SETTLING:] + ramp) + bias

    for c in (c for c in causes if c in ADDED):
        add, make = ADDED[c]
        path, *found[c] = add(c, make, scenes[c])
        # Errors of single samples come after the sensor's filter.
        if "low_pass" in causes and c != "outliers":
            path, found[c][0] = passed(path, found[c][0], filtering, rate)
        values[:, 0] += path
    for c in (c for c in CHANGES if c in causes):
        values[:, 0], parameters = CHANGES[c](values[:, 0], scenes[c])
        found[c] = parameters, np.nan
    sensor["axis_scale"] = as_floats(tuple(scale))
    return assemble(values, rate, names, sensor, causes, found, scenes, rng)


def as_floats(value):
    return tuple(map(float, value)) if isinstance(value, tuple) else float(value)


def assemble(values, rate, names, sensor, causes, found, scenes, rng):
    auxiliary, effects = {}, []
    for c in causes:
        parameters, multiple = found[c]
        axes = names[:1]
        if c == "common_mode":
            axes = tuple(x for x, gain in zip(names, parameters["gains"], strict=True) if gain)
        if c in TERMS:
            size = parameters["amplitude" if c == "markov" else "coefficient"]
            sensor = sensor | {TERMS[c]: float(size)}
            sensor |= {"Tc": parameters["correlation_time"]} if c == "markov" else {}
        effects.append(Effect(c, {k: as_floats(v) for k, v in parameters.items()}, float(multiple), axes))
    if "temperature" in causes:
        auxiliary = {"temperature": scenes["temperature"].temperature[-len(values) :]}
    elif rng.random() < 1.0 / 3.0:
        auxiliary = {"temperature": draw_temperature(len(values), rate, rng)[-len(values) :]}
    return Hidden(values, rate, names, auxiliary, sensor, tuple(effects))
