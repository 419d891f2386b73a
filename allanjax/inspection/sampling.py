"""Facts about the samples' times and about other columns: jitter, gaps, and what follows the temperature."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

from allanjax.base.wording import duration, plain
from allanjax.inspection.facts import Fact
from allanjax.inspection.words import amount
from allanjax.record.completion import widening
from allanjax.record.io.timestamps import told_jitter
from allanjax.record.recording import DeadAxis, Recording

# Jitter, as a share of the interval, up to which samples are as good as even; readers refuse a fifth.
_JITTER = 0.05
# Stretches whose means are compared with the temperature's, and fewest that tell anything.
_STRETCHES, _FEWEST = 64, 12
# Chance of an axis that seems to follow a temperature that it does not feel.
_CHANCE = 0.01


def sampling_facts(recording: Recording) -> Iterator[Fact]:
    """Facts about times, missing samples and dead axes."""
    if (share := jitter_share(recording)) is not None and share > _JITTER:
        remedy = (
            "samples are taken as evenly spaced; if the stamps are right, read those of the sensor's clock"
        )
        text = f"{jitter_in_words(recording)}: {remedy}"
        yield Fact("jitter", text, recording.names, size=recording.jitter, unit="s")
    if recording.gaps:
        yield _gaps(recording)
    yield from dead_facts(recording.dead)


def dead_facts(dead: Sequence[DeadAxis]) -> Iterator[Fact]:
    """Facts about axes that do not change, or are without samples."""
    for d in dead:
        yield Fact("dead axes", f"{d.axis.name}: {d.reason}", (d.axis.name,), "not a measurement")


def _gaps(recording: Recording) -> Fact:
    """Fact about missing samples, which have been drawn, or are between stretches."""
    gaps, rate = recording.gaps or (), recording.rate
    lost, longest = sum(gap.samples for gap in gaps), max(gap.samples for gap in gaps)
    count = f"{len(gaps)} gaps of at most" if len(gaps) > 1 else "a gap of"
    text = f"{lost} samples are missing, in {count} {duration(longest / rate)}"
    spans = tuple((gap.first / rate, (gap.first + gap.samples) / rate) for gap in gaps)
    if recording.missing is None:
        rest = f"{text}: {1 + len(recording.others)} stretches between them are used"
        return Fact("gaps", rest, recording.names, "none", lost / rate, "s", spans)
    drawn = tuple(name for name, x in zip(recording.names, recording.missing.T, strict=True) if x.any())
    wider = 100.0 * (float(widening(recording.missing).max()) - 1.0)
    text = f"{text}: drawn given the others, which makes intervals {plain(wider, 2)} % wider"
    return Fact("gaps", text, drawn, "widened", lost / rate, "s", spans)


def jitter_share(recording: Recording) -> float | None:
    """Rms jitter of the time stamps as a share of the interval; None without any."""
    return None if recording.jitter is None else recording.jitter * recording.rate


def jitter_in_words(recording: Recording) -> str:
    """The jitter in s and as a share of the interval."""
    jitter = recording.jitter or 0.0
    share = plain(100.0 * max(jitter, 1e-9) * recording.rate, 2)
    return f"{told_jitter(jitter)}, {share} % of the interval"


def temperatures(recording: Recording) -> dict[str, Float[np.ndarray, " n"]]:
    """Channels of temperature by their names."""
    return {key: z for key, z in recording.auxiliary.items() if "temp" in key.lower()}


def temperature_facts(recording: Recording) -> Iterator[Fact]:
    """Axes whose mean changes in proportion to a temperature, from one stretch of the record to the next.

    Changes of a random walk are independent of each other, and those of white noise and flicker add up to
    less: so the t test of a proportion between changes is right for the one and cautious for the others. One
    between the means themselves would find a slope between any two walks.
    """
    size = recording.n // _STRETCHES or 1
    whole = recording.n // size * size
    if whole // size < _FEWEST:
        return
    from scipy.special import stdtr

    channels = temperatures(recording)
    for key, z in channels.items():
        dz = np.diff(z[:whole].reshape(-1, size).mean(axis=1))
        if not (np.isfinite(dz).all() and dz.any()):
            continue
        for axis, column in zip(recording.axes, recording.values.T, strict=True):
            dx = np.diff(column[:whole].reshape(-1, size).mean(axis=1))
            slope = float(dz @ dx / (dz @ dz))
            dof = len(dz) - 1
            t = slope / np.sqrt(np.sum((dx - slope * dz) ** 2) / dof / (dz @ dz))
            if 2.0 * stdtr(dof, -abs(t)) < _CHANCE / len(recording.axes):
                drift = amount(abs(slope) * float(np.ptp(z)), axis)
                remedy = f"fit with --objective whittle --regressors {','.join(channels)}"
                text = f"{axis.name} follows {key}, by {drift} over its range: {remedy}"
                yield Fact("temperature", text, (axis.name,))
