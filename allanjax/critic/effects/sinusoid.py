"""Spectral lines: sinusoids that keep their phase throughout the record."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.fft import next_fast_len, rfft
from scipy.optimize import minimize_scalar

from allanjax.base.normal import ONE_SIDED_95
from allanjax.critic.bank import PARTS, owners
from allanjax.critic.effect import FREQUENCIES, Candidate, Effect, Place, View
from allanjax.critic.policy import judged
from allanjax.estimate.deterministic import LINE_REACH, line_columns
from allanjax.estimate.evidence import LOG_PRIOR_RANGE
from allanjax.noise import terms
from allanjax.record.completion import in_time

_PERIODS = judged("sinusoid", "periods")
# Zero padding, so that frequencies are half a Fourier bin apart; between two of them a line's power may be a
# fifth larger, so peaks above this share of the highest one are refined, up to this number.
_PADDING, _SCALLOP, _PEAKS = 2, 0.8, 16
# Gain [nats] in the noise with the line below which it is given up: noise alone has some −6, and an estimate
# of the noise without so weak a line changes little.
_HOPELESS = -4.0
# Number of blocks of the record that make up the held-out parts.
_FOLD_BLOCKS = 256


class Line(NamedTuple):
    """Line in noise: frequency and its deviation [Hz], amplitudes of cosine and sine and their deviation, and
    the gain: half the squared signal-to-noise ratio."""

    frequency: float
    frequency_std: float
    beta: Float[np.ndarray, " 2"]
    std: float
    gain: float

    def log_price(self, band: float) -> float:
        """Log Occam factor [nats]: an amplitude as for `evidence`, any phase and frequency in a band [Hz]."""
        snr = np.sqrt(2.0 * self.gain)
        places = np.log(band / (self.frequency_std * np.sqrt(2.0 * np.pi)))
        return float(np.log(snr * (snr + 1.0) * LOG_PRIOR_RANGE) + max(places, 0.0))


class Sinusoid(Effect):
    """The strongest spectral line, at any frequency or at given ones; several are detected one by one."""

    name = "sinusoid"
    sensible: ClassVar = {"frequency": FREQUENCIES._replace(may_be_a_limit=True)}

    def p_value(self, view: View) -> float:
        line = view.once(_strongest, self.places)
        return 1.0 if line is None else _line_p_value(line.gain, view, self.places)

    def detect(self, view: View) -> Candidate | None:
        line = view.once(_strongest, self.places)
        band = sum(place.end - place.start for place in self.places) or 0.5 * view.rate
        if line is None or line.gain - line.log_price(band) < _HOPELESS:
            return None
        angle = 2.0 * np.pi * line.frequency * (np.arange(view.n) + 0.5) / view.rate
        cosine, sine = line.beta
        after = view.with_samples(view.samples - (cosine * np.cos(angle) + sine * np.sin(angle)))
        v = after.variance()
        line = refined(view.coefficients, v, line.frequency, view.rate)
        f, f_std, beta, std, z = line
        amplitude, phase = float(np.hypot(*beta)), np.asarray(-np.arctan2(beta[1], beta[0]))
        gain = after.noise.log_evidence - view.noise.log_evidence - line.log_price(band)
        parameters = [
            view.estimate("frequency", f, f_std, "Hz"),
            view.amplitude_estimate("amplitude", amplitude, std),
        ]
        # A line of fewer periods would appear at the edge of the search, with less power.
        if (
            f < _PERIODS / view.duration
            and refined(view.coefficients, v, f - 1.0 / view.duration, view.rate).gain > z
        ):
            least = amplitude - ONE_SIDED_95 * std
            parameters = [
                view.estimate("frequency", f, np.nan, "Hz", "below"),
                view.amplitude_estimate("amplitude", least, np.nan, limit="above"),
            ]

        def held_out() -> float:
            root = np.sqrt(v)
            kept = _held_out(in_time(view.coefficients / root), view, self.places)
            return view.held_out_gain(after, z, kept)

        width = 40.0 / view.duration
        return Candidate(
            self.name,
            parameters,
            gain,
            _line_p_value(z, view, self.places),
            after,
            held_out,
            (f - width, f + width),
            "frequency",
            lambda model: model + terms.Sinusoid(amplitude, f, phase=phase),
            is_shared=bool(self.places),
        )


def _strongest(view: View, places: Sequence[Place]) -> Line | None:
    """Strongest line of the spectrum; None if there is none at the places."""
    power, spacing = _spectrum(view.whitened, view.rate)
    searched = _searched(power, spacing, view, places)
    highest = searched.max()
    k = np.flatnonzero(searched > _SCALLOP * highest)
    k = k[(power[k] >= np.maximum(power[k - 1], power[k + 1])) | (power[k] == highest)]
    v = view.variance()
    starts = spacing * k[np.argsort(-power[k])[:_PEAKS]]
    lines = [refined(view.coefficients, v, float(start), view.rate) for start in starts]
    return max(lines, key=lambda line: line.gain, default=None)


def _searched(
    power: Float[np.ndarray, " frequencies"], spacing: float, view: View, places: Sequence[Place]
) -> Float[np.ndarray, " frequencies"]:
    """Power at the frequencies to search, all of them or only those near the given places; 0 at others."""
    first, last = int(np.ceil(_PERIODS / view.duration / spacing)), len(power) - 1
    searched = np.zeros_like(power)
    for low, high in [(place.start / spacing, place.end / spacing) for place in places] or [(first, last)]:
        near = slice(max(int(np.ceil(low)), first), min(int(high) + 1, last))
        searched[near] = power[near]
    return searched


def _line_p_value(z: float, view: View, places: Sequence[Place]) -> float:
    """Probability that the largest half squared signal-to-noise ratio of noise alone exceeds z.

    Baluev (2008), MNRAS 385:1279, eq. 6: W e^{−z} √z with W = band·√(4π var t), and 1 − e^{−z} for the start
    of each band searched.
    """
    band = sum(p.end - p.start for p in places) or view.rate / 2.0 - _PERIODS / view.duration
    expected = band * view.duration * np.sqrt(np.pi / 3.0) * np.exp(-z) * np.sqrt(z)
    return float(-np.expm1(max(len(places), 1) * np.log1p(-np.exp(-z)) - expected))


def refined(c: Float[np.ndarray, " n-1"], v: Float[np.ndarray, " n-1"], start: float, rate: float) -> Line:
    """Line near a frequency."""
    n = len(c) + 1
    spacing = rate / (2.0 * n)
    centre = int(np.clip(np.rint(start / spacing), 1, n - 1))
    near = np.arange(max(centre - LINE_REACH, 1), min(centre + LINE_REACH, n - 1) + 1)
    root = np.sqrt(v[near - 1])
    data = c[near - 1] / root

    def fitted(f: float) -> tuple[float, np.ndarray, float]:
        D = line_columns(f, near, n, rate) / root[:, None]
        gram = D.T @ D
        beta = np.linalg.solve(gram + 1e-12 * np.trace(gram) * np.eye(2), D.T @ data)
        return 0.5 * float(data @ D @ beta), beta, float(np.sqrt(2.0 / np.trace(gram)))

    grid = np.clip(start + np.arange(-2.0, 2.01, 0.25) * spacing, spacing, (n - 1.0) * spacing)
    f = max(grid.tolist(), key=lambda g: fitted(g)[0])
    bounds, options = (f - 0.25 * spacing, f + 0.25 * spacing), {"xatol": 1e-9 * spacing}
    f = float(minimize_scalar(lambda g: -fitted(g)[0], bounds=bounds, method="bounded", options=options).x)
    z, beta, std = fitted(f)
    # Cramér–Rao, of frequency with phase and amplitude unknown (Rife & Boorstyn 1974).
    # √6·σ/(πAT√n), where A²n/2σ² is the squared signal-to-noise ratio 2z.
    f_std = np.sqrt(6.0) / (np.pi * (n / rate) * 2.0 * np.sqrt(max(z, 1e-6)))
    return Line(f, float(f_std), beta, std, z)


def _spectrum(e: Float[np.ndarray, " n"], rate: float) -> tuple[Float[np.ndarray, " frequencies"], float]:
    """Half the squared signal-to-noise ratio at every frequency, and the frequencies' spacing [Hz]."""
    size = next_fast_len(_PADDING * len(e), real=True)
    spectrum = rfft(e, size, workers=-1)
    return (spectrum.real**2 + spectrum.imag**2) / np.sum(e**2), rate / size


def _held_out(e: Float[np.ndarray, " n"], view: View, places: Sequence[Place]) -> float:
    """Gain in log-likelihood [nats] on parts of the record with the line from the other parts."""
    n = len(e)
    block = max(n // _FOLD_BLOCKS, 1)
    rows = np.pad(e, (0, -n % block)).reshape(-1, block)
    owner, start, gain = owners(len(rows), 1), block * np.arange(len(rows)), 0.0
    size = np.minimum(n - start, block)
    for part in range(PARTS):
        own = owner == part
        power, spacing = _spectrum(np.where(own[:, None], 0.0, rows).ravel()[:n], view.rate)
        k = int(np.argmax(_searched(power, spacing, view, places)))
        # The peak between the frequencies of the grid, by a parabola.
        left, mid, right = power[k - 1 : k + 2]
        w = 2.0 * np.pi * spacing / view.rate * (k + 0.5 * (left - right) / (left - 2.0 * mid + right))
        sums = rows @ np.exp(-1j * w * np.arange(block)) * np.exp(-1j * w * start)
        # Its complex amplitude a: the mean square of a line of many periods is |a|²/2.
        a = 2.0 * sums[~own].sum() / size[~own].sum()
        gain += float((np.conj(a) * sums[own].sum()).real - 0.25 * abs(a) ** 2 * size[own].sum())
    return gain
