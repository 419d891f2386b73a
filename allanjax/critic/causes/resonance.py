"""Narrow-band noise, as of a damped oscillator, a structure or a loop that rings."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import gammaincc

from allanjax.critic.bank import any_of
from allanjax.critic.causes.bump import LINE, LOWEST, Spectrum
from allanjax.critic.causes.spectral import limited
from allanjax.critic.noise import Noise
from allanjax.critic.view import Candidate, Cause, View
from allanjax.noise import terms
from allanjax.noise.estimate import Estimate

# Narrowest window [coefficients].
_NARROWEST = 8
# Independent windows for each width, and how many more for each e-fold of a smaller p-value; number of the
# widest windows that show nothing new. Measured on simulated spectra.
_INDEPENDENT, _WIDE = (1.9, 0.11), 3.0
# Smallest gain of a window [nats]: a judgement.
_WORTH = 8.0
# Most rounds in which bump and noise are estimated in turn, and the change, in deviations, that ends them.
_ROUNDS, _SETTLED = 8, 0.2
# Smallest quality factor: a wider bump is an edge, as of a filter.
_BUMP_Q = 1.0


class Resonance(Cause):
    """A bump of the spectrum, filtered as all noise is if a filter was found before."""

    name = "resonance"
    refit = "at last"

    def p_value(self, view: View) -> float:
        return _conspicuous(view.squared_whitened)[2]

    def detect(self, view: View) -> Candidate | None:
        middle, width, *_ = window = _conspicuous(view.squared_whitened)
        spacing = view.rate / (2.0 * view.n)
        Q = np.clip(middle / max(width, 1.0), 1.0, max(middle / LINE / 2.0, 1.0))
        return self._near(view, window, np.log([middle * spacing, Q]), view.noise)

    def again(self, view: View, found: Candidate) -> Candidate | None:
        about = [found.parameters[x].value for x in ("frequency", "quality_factor")]
        return self._near(view, _conspicuous(view.squared_whitened), np.log(about), found.after.noise)

    def _near(
        self, view: View, window: tuple[float, ...], start: Float[np.ndarray, " 2"], noise: Noise
    ) -> Candidate | None:
        """Bump fitted from e^start in frequency and quality factor, and from this noise.

        None if even the most conspicuous window shows nothing.
        """
        _, width, p_value, windows, net = window
        if net < _WORTH:
            return None
        spectrum, theta = Spectrum(view, start, width), np.append(start, np.inf)
        for _ in range(_ROUNDS):
            before, background = theta, noise
            theta, covariance = spectrum.fitted(noise, theta[:2])
            if not np.isfinite(covariance).all():
                return None
            noise = spectrum.noise_given(theta, background)
            if np.all(abs(theta - before) < _SETTLED * np.sqrt(np.diag(covariance))):
                after = view.with_factor(1.0 + _density(theta, view) / view.variance(background))
                if after.noise.terms == noise.terms:
                    break
                # Another set of noise terms suits the record better now.
                noise = after.noise
        else:
            after = view.with_factor(1.0 + _density(theta, view) / view.variance(background))
        if np.exp(theta[1]) < _BUMP_Q:
            return None
        gain = after.noise.log_evidence - view.noise.log_evidence
        # Trials factors of frequency and width, and the Occam factor of the amplitude, 2: a judgement.
        widths = np.log(len(view.coefficients) / _NARROWEST)
        gain -= np.log(windows) + np.log(widths) + 2.0
        f0, Q, amplitude = np.exp(theta)
        if view.filter_response is not None:
            # The amplitude as it is recorded, after the filter.
            amplitude *= np.sqrt(np.interp(f0, view.family.frequency, view.filter_response))
        relative = np.sqrt(np.diag(covariance))
        # A narrower one is a line, a wider one an edge; below and above there is nothing to see of one.
        spacing = view.rate / (2.0 * view.n)
        band, shapes = (LOWEST * spacing, view.rate / 2.0), (_BUMP_Q, f0 / (LINE * spacing))
        parameters = [
            _between(view, "frequency", theta[0], relative[0], band, "Hz"),
            _between(view, "quality_factor", theta[1], relative[1], shapes, "1"),
            view.amplitude_estimate("amplitude", amplitude, relative[2] * amplitude),
        ]
        half = f0 / Q
        return Candidate(
            self.name,
            parameters,
            float(gain),
            p_value,
            after,
            lambda: _held_out(view, after, theta, width),
            (max(f0 - 2.0 * half, 0.0), min(f0 + 2.0 * half, view.rate / 2.0)),
            "frequency",
            lambda model: model + terms.Resonance(float(amplitude), float(f0), float(Q)),
        )


def _between(
    view: View, label: str, u: float, std: float, bounds: tuple[float, float], unit: str
) -> Estimate:
    """Estimate of e^u between bounds; at either of them a limit."""
    return view.log_estimate(label, *limited(u, std, (np.log(bounds[0]), np.log(bounds[1]))), unit)


def _density(theta: Float[np.ndarray, " 3"], view: View) -> Float[np.ndarray, " n-1"]:
    """Expected squares of a bump, filtered if a filter was found before."""
    f0, Q, amplitude = (float(x) for x in np.exp(theta))
    density = view.family.spectrum(terms.Resonance(amplitude, f0, Q).sampled(view.rate))
    return density if view.filter_response is None else density * view.filter_response


def _conspicuous(ratio: Float[np.ndarray, " n-1"]) -> tuple[float, float, float, float, float]:
    """Window with most excess: middle and width [coefficients], p-value, number of such windows, gain.

    Windows a quarter of a width apart count as two to four independent ones for each width, the more the
    smaller the p-value (`_INDEPENDENT`).
    """
    total = np.concatenate([[0.0], np.cumsum(ratio)])
    best = (-np.inf, 0.0, 0.0, 0.0, 0.0)
    width, widths = _NARROWEST, 0.0
    least = 1.0
    while width <= (len(ratio) - LOWEST) // 4:
        step = max(width // 4, 1)
        excess = total[LOWEST + width :: step] - total[LOWEST : len(total) - width : step]
        k = int(np.argmax(excess))
        level = float(excess[k]) / width
        windows = len(ratio) / width
        gain = 0.5 * width * (level - 1.0 - np.log(level)) if level > 1.0 else 0.0
        tail = min(max(float(gammaincc(width / 2.0, level * width / 2.0)), 1e-300), 1.0 - 1e-12)
        independent = min(_INDEPENDENT[0] - _INDEPENDENT[1] * np.log(tail), 4.0)
        least, widths = min(least, any_of(tail, independent * windows)), widths + 1.0
        if gain - np.log(windows) > best[0]:
            best = (
                gain - np.log(windows),
                LOWEST + k * step + width / 2.0 + 1.0,
                float(width),
                windows,
                gain,
            )
        width *= 2
    # Every width is a search of its own, but that the widest ones see what narrower ones have seen.
    return best[1], best[2], any_of(least, max(widths - _WIDE, 1.0)), best[3], best[4]


def _held_out(view: View, after: View, theta: Float[np.ndarray, " 3"], width: float) -> float:
    """Gain in log-likelihood [nats] on each half of the coefficients by the bump fitted to the other half.

    Each fit starts from that of all coefficients, in the noise of its half conditional on that bump.
    """

    def fitted(fold: Bool[np.ndarray, " n-1"]) -> tuple[Noise, Float[np.ndarray, " n-1"]]:
        background = after.model_evidence_of(fold).approximate_map(view.allowed, after.model_evidence)
        found, _ = Spectrum(view, theta[:2], width, fold).fitted(background, theta[:2])
        factor = 1.0 + _density(found, view) / view.variance(background)
        noise = view.model_evidence_of(fold, factor).approximate_map(view.allowed, after.model_evidence)
        return noise, factor

    return view.cross_validated(fitted) - view.cv_log_likelihood
