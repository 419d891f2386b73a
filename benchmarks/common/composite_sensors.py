"""Six-axis recordings with a handful of effects on top of each other, and what was put into them.

In NumPy and SciPy alone and in physical terms. An effect's strength is drawn first, and the amplitude follows
from it; see `composite_scene.py`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter
from scipy.signal.windows import tukey

from benchmarks.common.composite_scene import (
    ANALOG,
    GRADES,
    NAMES,
    AxisTruth,
    Effect,
    Filter,
    Resonance,
    Scene,
    drawn_truth,
    exponential,
    exponential_spectrum,
    level_free,
    noise,
    spectrum,
)

#: Probabilities of 0 to 6 effects.
COUNTS = (0.05, 0.15, 0.20, 0.20, 0.20, 0.10, 0.10)
#: Of each kind of effect: how likely the next one is of it, in parts, and how many there may be.
KINDS: dict[str, tuple[float, int]] = {
    "filter": (4.0, 2),
    "resonance": (4.0, 2),
    "line": (3.0, 2),
    "wandering line": (1.5, 1),
    "knock": (1.5, 2),
    "event": (1.0, 1),
    "rounding": (1.0, 1),
    "rounding behind a matrix": (1.0, 1),
    "variance": (1.5, 1),
    "periodic outliers": (1.0, 1),
    "random outliers": (1.0, 1),
    "repeats": (1.0, 1),
    "temperature": (1.5, 1),
    "step": (1.5, 2),
}
#: What is not drawn where one of the same set was.
EXCLUSIVE = ({"rounding", "rounding behind a matrix"}, {"periodic outliers", "random outliers"})


@dataclass(frozen=True)
class Composite:
    """Samples [n, axes] in their units, auxiliary channels, and the truth."""

    values: np.ndarray
    rate: float
    names: tuple[str, ...]
    gyro_unit: str
    accel_unit: str
    auxiliary: dict[str, np.ndarray]
    effects: tuple[Effect, ...]
    axes: dict[str, AxisTruth]
    grade: str


# --- Filters and resonances --------------------------------------------------------------------------------


def drawn_filter(scene: Scene) -> Filter:
    rng, rate = scene.rng, scene.rate
    kind = str(rng.choice([*ANALOG, "moving average", "digital IIR"]))
    if kind == "moving average":
        length = int(rng.integers(2, 9))
        return Filter(kind, 0.443 * rate / length, length, rate)
    order = {"one pole": 1, "two poles": 2, "digital IIR": int(rng.integers(1, 3))}.get(
        kind, int(rng.integers(2, 5))
    )
    cutoff = rate * scene.log_uniform(0.12 if order > 2 else 0.05, 0.4)
    return Filter(kind, cutoff, order, rate, quality=scene.log_uniform(0.5, 1.2))


def add_filters_and_resonances(scene: Scene, filters: int, resonances: int) -> None:
    rng, rate = scene.rng, scene.rate
    for sensor in rng.permutation(["gyro", "accel"])[:filters]:
        scene.filters[str(sensor)] = drawn_filter(scene)
    base = [spectrum(scene, k) for k in range(6)]
    scene.std = np.sqrt([np.mean(P[len(P) // 1000 :]) for P in base])
    drives = []
    for _ in range(resonances):
        axes = scene.some_axes(1, 4)
        f_of = scene.filter_of(axes[0])
        same = all(scene.filter_of(k) is f_of for k in axes)
        inside = f_of if f_of and same and rng.random() < 0.5 else None
        f0 = scene.log_uniform(max(2.0, rate / 60.0), 0.4 * rate)
        resonance = Resonance(f0, scene.log_uniform(2.0, 60.0), rate, inside)
        g, shape = scene.gains_of(axes), resonance.spectrum(scene.f)[1:]
        strongest = int(np.argmax(g))
        ratio = (g[strongest] * scene.std[axes[strongest]]) ** 2 * shape / base[axes[strongest]][1:]
        s = scene.scale("resonance", lambda s, r=ratio: level_free(1.0 + s * s * r))
        scene.resonances.append(
            (resonance, {int(k): s * a * scene.std[k] for k, a in zip(axes, g, strict=True)})
        )
        drives.append("common" if rng.random() < 0.5 else "own")
    scene.spectrum = np.stack([spectrum(scene, k) for k in range(6)])
    for i, ((r, rms), drive) in enumerate(zip(scene.resonances, drives, strict=True)):
        ks = np.array(list(rms))
        gain = np.array([level_free((scene.spectrum[k] / spectrum(scene, k, without=i))[1:]) for k in ks])
        over = np.array([rms[k] / scene.std[k] for k in ks])
        place = "inside" if r.inside else "behind"
        scene.tell("resonance", ks, gain, over, frequency=r.f0, quality=r.quality, place=place, drive=drive)
    for sensor, f_of in scene.filters.items():
        ks = np.array([k for k in range(6) if NAMES[k].startswith(sensor)])
        gain = np.array(
            [level_free((scene.spectrum[k] / spectrum(scene, k, filtered=False))[1:]) for k in ks]
        )
        more = {"filter": f_of.kind, "cutoff": f_of.cutoff, "order": float(f_of.order)}
        scene.tell("filter", ks, gain, np.ones(3), **more)


def add_noise(scene: Scene, variance: bool) -> None:
    """All stationary noise, where the white one may be of another variance in a stretch."""
    rng, n = scene.rng, scene.n
    envelopes: dict[int, np.ndarray] = {}
    if variance:
        axes = scene.some_axes(1, 1) if rng.random() < 0.5 else scene.some_axes(3, 3)
        factor = float(rng.choice([rng.uniform(0.6, 0.92), rng.uniform(1.08, 1.7)]))
        share = scene.log_uniform(0.02, 0.5)
        start = float(rng.uniform(0.0, 1.0 - share))
        first, last = int(start * n), int((start + share) * n)
        v = np.ones(n)
        v[first:last] = factor
        envelopes = {int(k): v for k in axes}
        span = (first / scene.rate, last / scene.rate)
        gain = np.full(len(axes), level_free(v**2))
        scene.tell("variance", axes, gain, np.full(len(axes), factor), span=span)
        for k in axes:
            scene.truth[k].one_level = False
    scene.x = np.stack([noise(scene, k, envelopes.get(k)) for k in range(6)], axis=1)
    told = [e for e in scene.effects if e.kind == "resonance"]
    for (resonance, rms), effect in zip(scene.resonances, told, strict=True):
        common = resonance.draw(rng, n) if effect.parameters["drive"] == "common" else None
        for k, a in rms.items():
            scene.x[:, k] += a * (resonance.draw(rng, n) if common is None else common)
    for k in range(6):
        if f_of := scene.filter_of(k):
            # What the samples show at low frequencies, with the aliases of what the filter lets through.
            scene.truth[k].N *= float(np.sqrt(f_of.white_spectrum(np.zeros(1))[0] / scene.rate))


# --- Lines, knocks, events, steps, temperature -------------------------------------------------------------


def add_line(scene: Scene) -> None:
    rng, n, rate = scene.rng, scene.n, scene.rate
    axes, f0 = scene.some_axes(1, 6), scene.log_uniform(0.3, 0.45 * rate)
    parts = [1.0, *rng.uniform(0.1, 0.6, int(rng.integers(0, 4)))]
    parts = [a for h, a in enumerate(parts, 1) if h * f0 < 0.48 * rate]
    bins = [round(2.0 * h * f0 / rate * n) for h in range(1, len(parts) + 1)]
    g = scene.gains_of(axes)
    density = scene.spectrum[np.ix_(axes, bins)]
    unit = n * np.sum((np.outer(g * scene.std[axes], parts)) ** 2 / (4.0 * density), axis=1)
    s = scene.scale("line", lambda s: s * s * unit.max())
    for k, a in zip(axes, s * g * scene.std[axes], strict=True):
        for h, part in enumerate(parts, 1):
            phase = rng.uniform(0.0, 2.0 * np.pi)
            scene.x[:, k] += a * part * np.cos(2.0 * np.pi * h * f0 * scene.t + phase)
    scene.tell("line", axes, s * s * unit, s * g, frequency=f0, harmonics=float(len(parts) - 1))


def add_wandering_line(scene: Scene) -> None:
    rng, n, rate = scene.rng, scene.n, scene.rate
    axes, f0 = scene.some_axes(1, 6), scene.log_uniform(2.0, 0.4 * rate)
    spread, wander = f0 * scene.log_uniform(1e-4, 1e-2), scene.log_uniform(20.0, 300.0)
    parts = [1.0, *rng.uniform(0.1, 0.6, int(rng.integers(0, 4)))]
    parts = [a for h, a in enumerate(parts, 1) if h * f0 < 0.45 * rate]
    f = f0 + spread * exponential(rng, n, 1.0 / (rate * wander))
    phase = 2.0 * np.pi * np.cumsum(f) / rate
    g = scene.gains_of(axes)
    shape = np.zeros(n)
    for h, part in enumerate(parts, 1):
        width = h * max(spread, 2.0 * rate / n)
        bell = np.exp(-0.5 * ((scene.f - h * f0) / width) ** 2) / (np.sqrt(2.0 * np.pi) * width)
        shape += 0.25 * part**2 * rate * bell
    ratios = [
        (a * scene.std[k]) ** 2 * shape[1:] / scene.spectrum[k, 1:] for k, a in zip(axes, g, strict=True)
    ]
    ratios = [r[r > 1e-12 * r.max()] for r in ratios]

    def gain(s: float) -> np.ndarray:
        return np.array([0.5 * np.sum(s * s * r - np.log1p(s * s * r)) for r in ratios])

    s = scene.scale("wandering line", lambda s: float(gain(s).max()))
    for k, a in zip(axes, s * g * scene.std[axes], strict=True):
        for h, part in enumerate(parts, 1):
            scene.x[:, k] += a * part * np.cos(h * phase + rng.uniform(0.0, 2.0 * np.pi))
    more = {"frequency": f0, "spread": spread, "wandering time": wander, "harmonics": float(len(parts) - 1)}
    scene.tell("wandering line", axes, gain(s), s * g, **more)


def add_waveform(scene: Scene, kind: str, axes: np.ndarray, w: np.ndarray, **more: object) -> None:
    """A waveform with a gain and a sign on each of some axes."""
    g = scene.gains_of(axes) * scene.std[axes]
    unit = np.array([a * a * scene.of_waveform(w, k) for k, a in zip(axes, g, strict=True)])
    s = scene.scale(kind, lambda s: s * s * unit.max())
    scene.x[:, axes] += w[:, None] * (s * g * scene.rng.choice([-1.0, 1.0], len(axes)))
    scene.tell(kind, axes, s * s * unit, s * g / scene.std[axes], **more)


def add_knock(scene: Scene) -> None:
    start = float(scene.rng.uniform(0.05, 0.95) * scene.t[-1])
    f0, decay = scene.log_uniform(3.0, min(30.0, 0.4 * scene.rate)), scene.log_uniform(0.2, 2.0)
    after = np.maximum(scene.t - start, 0.0)
    w = np.exp(-after / decay) * np.sin(2.0 * np.pi * f0 * after)
    more = {"frequency": f0, "decay": decay, "span": (start, start + 3.0 * decay)}
    add_waveform(scene, "knock", np.arange(6), w, **more)


def add_step(scene: Scene) -> None:
    start = float(scene.rng.uniform(0.1, 0.9) * scene.t[-1])
    w = (scene.t >= start).astype(float)
    add_waveform(scene, "step", scene.some_axes(1, 3), w, span=(start, start))


def add_event(scene: Scene) -> None:
    """Broadband shaking of a few seconds, the same on several axes or of each its own."""
    rng, rate = scene.rng, scene.rate
    axes, seconds, cutoff = (
        scene.some_axes(2, 6),
        scene.log_uniform(0.5, 20.0),
        scene.log_uniform(2.0, 0.3 * rate),
    )
    m = int(seconds * rate)
    first = int(rng.uniform(0.02, 0.95) * (scene.n - m))
    interval = 2.0 * np.pi * cutoff / rate
    coarse = np.linspace(0.0, scene.n - 1.0, 4001).astype(int)[1:]
    shape = exponential_spectrum(scene.f[coarse], rate, interval)
    g = scene.gains_of(axes)
    ratios = [
        (a * scene.std[k]) ** 2 * shape / scene.spectrum[k, coarse] for k, a in zip(axes, g, strict=True)
    ]

    def gain(s: float) -> np.ndarray:
        return np.array([0.5 * m * np.mean(s * s * r - np.log1p(s * s * r)) for r in ratios])

    s = scene.scale("event", lambda s: float(gain(s).max()))
    common = bool(rng.random() < 0.5)
    w = exponential(rng, m, interval)
    for k, a in zip(axes, s * g * scene.std[axes], strict=True):
        w = w if common else exponential(rng, m, interval)
        scene.x[first : first + m, k] += a * tukey(m, 0.1) * w
    more = {"cutoff": cutoff, "common": str(common), "span": (first / rate, (first + m) / rate)}
    scene.tell("event", axes, gain(s), s * g, **more)


def add_temperature(scene: Scene, effect: bool) -> None:
    """The channel, in °C; with the effect, axes follow it behind a first-order lag."""
    rng, n, rate, t = scene.rng, scene.n, scene.rate, scene.t
    D = t[-1]
    T = rng.uniform(20.0, 30.0) + rng.uniform(1.0, 8.0) * (1.0 - np.exp(-t / (D * rng.uniform(0.05, 0.3))))
    for _ in range(2):
        T += rng.uniform(0.2, 1.0) * np.sin(2.0 * np.pi * (t / D * rng.uniform(1.0, 8.0) + rng.random()))
    T += 0.3 * exponential(rng, n, 1.0 / (rate * D / 10.0))
    scene.auxiliary["temperature"] = T + 0.01 * rng.standard_normal(n)
    if effect:
        lag = scene.log_uniform(10.0, 500.0)
        keep = np.exp(-1.0 / (rate * lag))
        w = lfilter([1.0 - keep], [1.0, -keep], T - T[0])
        add_waveform(scene, "temperature", scene.some_axes(1, 6), w - w.mean(), lag=lag)


# --- What happens to samples -------------------------------------------------------------------------------


def add_outliers(scene: Scene, periodic: bool) -> None:
    rng, n, rate = scene.rng, scene.n, scene.rate
    axes = scene.some_axes(1, 3)
    if periodic:
        period = float(rng.choice([1.0, 2.0, 5.0, 10.0, 30.0, 60.0]))
        where = np.arange(int(rng.integers(round(period * rate))), n, round(period * rate))
        sizes = np.full((len(where), len(axes)), rng.uniform(4.0, 30.0)) * rng.choice([-1.0, 1.0], len(axes))
    else:
        where = np.flatnonzero(rng.random(n) < scene.log_uniform(1e-5, 1e-3))
        period = n / rate / max(len(where), 1)
        sizes = rng.uniform(5.0, 20.0) * rng.standard_normal((len(where), len(axes)))
    # A random one has to be found among the samples; that of a train is where the train says.
    price = 0.0 if periodic else np.log(n / max(len(where), 1))
    gain = []
    for j, k in enumerate(axes):
        each = 0.5 * (sizes[:, j] * scene.std[k]) ** 2 * np.mean(1.0 / scene.floored(k))
        gain.append(float(np.sum(np.maximum(each - price, 0.0))))
        scene.x[where, k] += sizes[:, j] * scene.std[k]
    over = np.sqrt(np.mean(sizes**2, axis=0)) if len(where) else np.zeros(len(axes))
    kind = "periodic outliers" if periodic else "random outliers"
    scene.tell(kind, axes, np.array(gain), over, period=period, count=float(len(where)))


def add_rounding(scene: Scene, units: np.ndarray, matrix: bool) -> None:
    """Samples of one sensor as whole counts, or these times a matrix of scales and misalignments."""
    rng = scene.rng
    axes = np.arange(3) + 3 * int(rng.integers(2))
    ratio = scene.log_uniform(0.2, 1.5)
    step = ratio * float(np.median(scene.std[axes] / units[axes])) * units[axes]
    M = np.eye(3)
    if matrix:
        M = M * rng.uniform(0.97, 1.03, 3) + 0.03 * rng.standard_normal((3, 3)) * (1.0 - np.eye(3))
    counts = np.round(np.linalg.solve(M, (scene.x[:, axes] / step).T))
    scene.x[:, axes] = (M @ counts).T * step
    over = step / scene.std[axes]
    for k in axes:
        scene.truth[k].one_level = False
    kind = "rounding behind a matrix" if matrix else "rounding"
    scene.tell(kind, axes, np.full(3, np.inf), over, step=float(step[0]))


def add_repeats(scene: Scene) -> None:
    """Packets that were lost, up to five in a row, filled by the sample before on all axes."""
    rng, n = scene.rng, scene.n
    lost = np.zeros(n, bool)
    starts = np.flatnonzero(rng.random(n) < scene.log_uniform(3e-5, 3e-3))
    for start, length in zip(starts, rng.integers(1, 6, len(starts)), strict=True):
        lost[max(start, 1) : start + length] = True
    chance = n * np.mean(np.diff(scene.x, axis=0) == 0.0, axis=0) + 1e-6
    scene.x = scene.x[np.maximum.accumulate(np.where(lost, 0, np.arange(n)))]
    k = float(lost.sum())
    gain = (chance + k) * np.log1p(k / chance) - k
    scene.tell("repeats", np.arange(6), gain, np.full(6, k / n), count=k)


# --- The whole ---------------------------------------------------------------------------------------------


def drawn_kinds(rng: np.random.Generator) -> list[str]:
    kinds: list[str] = []
    for _ in range(int(rng.choice(len(COUNTS), p=COUNTS))):
        closed = set().union(*(others for others in EXCLUSIVE if others & set(kinds)))
        open_to = [k for k, (_, most) in KINDS.items() if kinds.count(k) < most and k not in closed]
        parts = np.array([KINDS[k][0] for k in open_to])
        kinds.append(str(rng.choice(open_to, p=parts / parts.sum())))
    return kinds


def composite(seed: int, clean: bool = False, samples: int | None = None) -> Composite:
    """The recording of a seed: of a grade, a rate and a length of its own, with 0 to 6 effects or none."""
    rng = np.random.default_rng([seed, int(clean), 20260])
    grade = str(rng.choice(list(GRADES)))
    rate = float(rng.choice([50.0, 100.0, 125.0, 200.0, 250.0, 400.0]))
    drawn = int(np.exp(rng.uniform(np.log(2e5), np.log(1e6))))
    n = samples or drawn
    gyro_unit, accel_unit = str(rng.choice(["rad/s", "deg/s"])), str(rng.choice(["m/s²", "g"]))
    units = np.repeat(
        [np.pi / 180.0 if gyro_unit == "deg/s" else 1.0, 9.80665 if accel_unit == "g" else 1.0], 3
    )
    kinds = [] if clean else drawn_kinds(rng)
    scene = Scene(rng, n, rate, drawn_truth(rng, grade, n / rate))
    add_filters_and_resonances(scene, kinds.count("filter"), kinds.count("resonance"))
    add_noise(scene, "variance" in kinds)
    scene.x += np.concatenate([0.01 * rng.standard_normal(3), 0.2 * rng.standard_normal(2), [9.81]])
    adding = {"line": add_line, "wandering line": add_wandering_line, "knock": add_knock, "step": add_step}
    for kind, add in {**adding, "event": add_event}.items():
        for _ in range(kinds.count(kind)):
            add(scene)
    if "temperature" in kinds or rng.random() < 0.5:
        add_temperature(scene, "temperature" in kinds)
    for kind in ("periodic outliers", "random outliers"):
        if kind in kinds:
            add_outliers(scene, kind == "periodic outliers")
    for kind in ("rounding", "rounding behind a matrix"):
        if kind in kinds:
            add_rounding(scene, units, kind != "rounding")
    if "repeats" in kinds:
        add_repeats(scene)
    axes = dict(zip(NAMES, scene.truth, strict=True))
    more = (scene.auxiliary, tuple(scene.effects), axes, grade)
    return Composite(scene.x / units, rate, NAMES, gyro_unit, accel_unit, *more)
