"""Effects in records, most of them golden ones, and how well anybody could measure them, without allanjax.

The cosine transform makes the covariance of basic noise terms diagonal, so that generalized least squares
with the dense covariance are divisions by `levels`. The mean is its lowest coefficient, and left out. Means
and powers are independent in a Gaussian likelihood: the bound of a waveform's parameters needs no powers,
that of a spectrum's parameters has them as nuisances.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import bench
import golden_records as golden
import numpy as np
from golden_records import ACCEL, GYRO, MIDDLE, RATE, Effect, Record, crossing
from scipy.fft import dct

import allanjax as aj

N = MIDDLE
TIME, ANGLE = golden.TIME, np.pi * np.arange(1, N) / N


def coefficients(x):
    """Cosine coefficients along the last axis, but for the mean."""
    return dct(x, norm="ortho")[..., 1:]


def levels(truth, rate=RATE):
    """Expected squares of the coefficients of these terms."""
    sine, frequency = 4.0 * np.sin(ANGLE / 2.0) ** 2, ANGLE * rate / (2.0 * np.pi)
    time = truth.get("markov_correlation_time", 1.0)
    shapes = {
        "quantization": rate**2 * (sine + (4.0 - sine) / N),
        "angle_random_walk": np.full(N - 1, rate),
        "bias_instability": rate / (2.0 * np.pi * frequency),
        "rate_random_walk": (2.0 + np.cos(ANGLE)) / (3.0 * rate * sine),
        "markov_amplitude": rate * time**2 / (1.0 + (2.0 * np.pi * frequency * time) ** 2),
    }
    return sum(truth[label] ** 2 * shape for label, shape in shapes.items() if label in truth)


def log_likelihood(c, v):
    """Of coefficients with these expected squares [nats]."""
    return -0.5 * float(np.sum(np.log(v) + c**2 / v))


def waveform_bound(v, *columns):
    """Standard deviations of the coefficients of some waveforms, by generalized least squares."""
    whitened = coefficients(np.stack(columns)) / np.sqrt(v)
    return np.sqrt(np.diag(np.linalg.inv(whitened @ whitened.T)))


def spectral_bound(spectrum, theta, beside=()):
    """Of positive parameters by the Fisher information ½ Σ ∂ln v ∂ln v'."""
    # `beside` names further basic terms, whose powers are not known either, though they are zero.
    rows = []
    for label, x in theta.items():
        high, low = (spectrum(theta | {label: x * (1.0 + s * 1e-4)}) for s in (1.0, -1.0))
        rows.append(np.log(high / low) / 2e-4)
    others = [levels({label: 1.0}) / spectrum(theta) for label in beside]
    rows += [row / row.max() for row in others if np.any(row)]
    covariance = np.linalg.inv(0.5 * np.array(rows) @ np.array(rows).T)
    return {label: x * np.sqrt(covariance[k, k]) for k, (label, x) in enumerate(theta.items())}


def posterior(log_weight, values):
    """Standard deviation of a parameter that may have any of these values."""
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    return float(np.sqrt(weight @ (values - weight @ values) ** 2))


def sinusoid(p, v, x):
    angle = 2.0 * np.pi * p["frequency"] * TIME + p.pop("phase")
    wave, other = np.sin(angle), np.cos(angle)
    std = waveform_bound(v, wave, other, p["amplitude"] * 2.0 * np.pi * TIME * other)
    return {"amplitude": std[0], "frequency": std[2]}, wave


def bias_step(p, v, x):
    """Its place has no regular bound: it is the posterior of all places near it."""
    place = round(p["time"] * RATE)
    near = place + np.arange(-1_000, 1_001)
    # Cosine coefficients of unit steps, as a geometric sum.
    steps = -np.sqrt(2.0 / N) * np.sin(np.outer(near, ANGLE)) / (2.0 * np.sin(ANGLE / 2.0)) / np.sqrt(v)
    power = (steps @ (coefficients(x) / np.sqrt(v))) ** 2 / np.sum(steps**2, axis=1)
    wave = (np.arange(N) >= place).astype(float)
    bound = {"time": posterior(0.5 * power, near / RATE), "amplitude": waveform_bound(v, wave)[0]}
    return bound, wave


def warm_up(p, v, x):
    wave = np.exp(-TIME / p["time_constant"])
    std = waveform_bound(v, wave, p["amplitude"] * TIME / p["time_constant"] ** 2 * wave)
    return dict(zip(("amplitude", "time_constant"), std, strict=True)), wave


def telegraph(p, v, x):
    """The amplitude's bound is that of a known path, a dwell time's that of so many jumps."""
    wave = np.searchsorted(p["switches"], TIME) % 2.0
    p["jumps"] = len(p.pop("switches"))
    bound = {"amplitude": waveform_bound(v, wave)[0], "dwell_time": p["dwell_time"] / np.sqrt(p["jumps"])}
    return bound, wave


def temperature(p, v, x):
    late = golden.DEGREES[:N]
    std = waveform_bound(v, late, -p["coefficient"] * np.gradient(late) * RATE)
    return dict(zip(("coefficient", "lag"), std, strict=True)), late


def drift_ramp(p, v, x):
    return {"coefficient": waveform_bound(v, TIME)[0]}, TIME


def outliers(p, v, x):
    """Of the deviation of normal errors, all of which are seen."""
    del p["times"]
    return {"scale": p["scale"] / np.sqrt(2.0 * p["count"])}, None


def variance_change(p, v, x):
    """The bound of an end is the posterior of all places near it."""
    first, last = (round(p[label] * RATE) for label in ("start", "end"))
    m, excess, white = last - first, p["ratio"] ** 2 - 1.0, whitened(x, v)
    bound = {"ratio": p["ratio"] * np.sqrt(0.5 / m + 0.5 / (N - m))}
    for label, place, sign in (("start", first, 1.0), ("end", last, -1.0)):
        near = place + np.arange(-1_500, 1_500)
        # The likelihood of each sample inside, less that outside: added up to the place from either side.
        each = 0.5 * (white[near] ** 2 * excess / (1.0 + excess) - np.log1p(excess))
        bound[label] = posterior(-sign * np.cumsum(each), near / RATE)
    return bound, None


def whitened(x, v):
    """Samples of unit noise."""
    return dct(np.r_[0.0, coefficients(x) / np.sqrt(v)], type=3, norm="ortho")


def repeated_samples(p, v, x):
    return {"fraction": np.sqrt(p["fraction"] * (1.0 - p["fraction"]) / N)}, None


def resonance(p):
    """An oscillator that is read at the sample instants."""
    lag, w = np.arange(1, 4_000) / RATE, 2.0 * np.pi * p["frequency"]
    damping = 0.5 * w / p["quality_factor"]
    turning = np.sqrt(w**2 - damping**2)
    r = np.exp(-damping * lag) * (np.cos(turning * lag) + damping / turning * np.sin(turning * lag))
    return levels(p) + p["amplitude"] ** 2 * (1.0 + 2.0 * np.fft.rfft(np.r_[0.0, r], 2 * N)[1:N].real)


def low_pass(p):
    """Exponential smoothing, whose bandwidth is where the power has fallen by half."""
    memory = 2.0 - np.cos(2.0 * np.pi * p["bandwidth"] / RATE)
    kept = memory - np.sqrt(memory**2 - 1.0)
    return (1.0 - kept) ** 2 / (1.0 - 2.0 * kept * np.cos(ANGLE) + kept**2) * levels(p)


def power_law(p):
    u = ANGLE / (2.0 * np.pi) + np.arange(-40, 41)[:, None]
    shape = RATE * np.sum(np.abs(u * RATE) ** -p["exponent"] * np.sinc(u) ** 2, axis=0)
    return levels(p) + p["amplitude"] ** 2 * shape


def markov(p):
    return levels(p | {f"markov_{label}": p[label] for label in ("amplitude", "correlation_time")})


def basic(cause, p):
    return levels(p | {cause: p["coefficient"]})


SPECTRA = {f.__name__: f for f in (resonance, low_pass, power_law, markov)}
SPECTRA |= {
    label: functools.partial(basic, label) for label in golden.LABELS.values() if label != "drift_ramp"
}
WAVES = {f.__name__: f for f in (sinusoid, bias_step, warm_up, telegraph, temperature, drift_ramp)}
WAVES |= {f.__name__: f for f in (outliers, variance_change, repeated_samples)}


def more(seed=41):
    """In white noise about a bias: a power law, repeats of lost samples, a warm-up, louder noise."""
    rng, held, level = np.random.default_rng(seed), np.zeros(N, bool), GYRO * np.sqrt(RATE)
    x = {f"gyro_{k}": 0.01 + golden.white(rng, N, GYRO) for k in range(1, 5)}
    x["gyro_1"] += golden.power_law(rng, N, (1.5 * GYRO) ** 2, 0.5)
    for start in rng.choice(N // 5 - 1, 550, replace=False) * 5 + 3:
        held[start : start + rng.integers(1, 5)] = True
    x["gyro_2"] = x["gyro_2"][np.maximum.accumulate(np.where(held, 0, np.arange(N)))]
    x["gyro_3"] -= 0.5 * level * np.exp(-TIME / 20.0)
    x["gyro_4"][5_200:9_900] += 0.2 * (x["gyro_4"][5_200:9_900] - 0.01)
    told = {
        "power_law": {"exponent": 0.5, "amplitude": 1.5 * GYRO},
        "repeated_samples": {"fraction": held.mean(), "longest": 4.0},
        "warm_up": {"amplitude": -0.5 * level, "time_constant": 20.0},
        "variance_change": {"start": 52.0, "end": 99.0, "ratio": 1.2},
    }
    effects = tuple(Effect(c, (axis,), p) for axis, (c, p) in zip(x, told.items(), strict=True))
    truth = {name: {"angle_random_walk": GYRO} for name in x}
    return Record(np.column_stack(list(x.values())), tuple(x), truth, effects=effects, name="more")


def one_pole():
    record = golden.record("one_pole")
    w = np.exp(-2.0 * np.pi * record.truth["gyro_x"].pop("low_pass1_bandwidth") / RATE)
    bandwidth = RATE * np.arccos(2.0 - (w + 1.0 / w) / 2.0) / (2.0 * np.pi)
    effect = Effect("low_pass", ("gyro_x",), {"bandwidth": bandwidth, "order": 1.0})
    return dataclasses.replace(record, effects=(effect,))


def lacking(record, known):
    """A record of a known term and a further one that a fit is not told of."""
    effects = []
    for axis, terms in record.truth.items():
        p = {label: value for label, value in terms.items() if label != known}
        (cause, *_) = (label.removesuffix("_amplitude") for label in p)
        labels = ("amplitude", "correlation_time") if cause == "markov" else ("coefficient",)
        effects.append(Effect(cause, (axis,), dict(zip(labels, p.values(), strict=True))))
    truth = {axis: {known: terms[known]} for axis, terms in record.truth.items()}
    return dataclasses.replace(record, truth=truth, effects=tuple(effects))


def basics():
    axes = {"gyro_x": crossing(GYRO, Q=0.005), "gyro_y": crossing(GYRO, B=2.0)}
    axes |= {"gyro_z": crossing(GYRO, K=6.0), "accel_x": crossing(ACCEL, R=40.0)}
    return lacking(golden.basic(77, N, *axes.items()), "angle_random_walk")


MORE = {
    "more": more,
    "one_pole": one_pole,
    "basics": basics,
    "markov_fast": lambda: lacking(bench.truth("markov_fast"), "angle_random_walk"),
    "white": lambda: lacking(golden.basic(79, N, ("gyro_x", crossing(GYRO, Q=2.0))), "quantization"),
}


def record_of(name, seed=None):
    """One of these, or a golden one; with a seed another one of its kind."""
    if seed is not None:
        return (MORE | golden.EFFECTS)[name](seed=seed)
    return MORE[name]() if name in MORE else bench.truth(name)


#: What the fits of axes know that lack a basic term.
KNOWN = {"basics": "N", "markov_fast": "N", "white": "Q"}


def critique(name):
    """The critique of a record, made once per run."""
    if name in golden.RECORDS and name not in KNOWN:
        return bench.critique(name)

    def make():
        given = record_of(name).recording()
        return aj.critique(given, aj.fit(given, KNOWN[name]) if name in KNOWN else None)

    return bench.once(f"critique of what is hidden in {name}", make)


class Hidden(NamedTuple):
    """An effect in an axis, in SI.

    truth: parameters by label; own: coefficients of the noise; bound: of some parameters, as a function of
    basic terms that are estimated besides; levels: of all noise; path: the waveform, if it is one.
    """

    cause: str
    axis: str
    x: np.ndarray
    truth: dict[str, Any]
    own: dict[str, float]
    bound: Callable[..., dict[str, float]]
    levels: np.ndarray
    path: np.ndarray | None = None


@functools.cache
def hidden_in(name, seed=None):
    """Effects in the axes of a record."""
    record, found = record_of(name, seed), []
    for effect, axis in ((each, axis) for each in record.effects for axis in each.axes):
        own, p = dict(record.truth[axis]), dict(effect.parameters)
        x, v = record.values[:, record.names.index(axis)], levels(own)
        if spectrum := SPECTRA.get(effect.cause):
            theta = own | {label: value for label, value in p.items() if label != "order"}
            bound = functools.partial(spectral_bound, spectrum, theta)
            found.append(Hidden(effect.cause, axis, x, p, own, bound, spectrum(theta)))
            continue
        least, wave = WAVES[effect.cause](p, v, x) if effect.cause in WAVES else ({}, None)
        path = None if wave is None else p.get("amplitude", p.get("coefficient")) * wave
        found.append(Hidden(effect.cause, axis, x, p, own, lambda *_, least=least: least, v, path))
    return found
