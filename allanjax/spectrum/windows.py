"""Windows of periodograms, and the correlation between ordinates that they make."""

import numpy as np
from jaxtyping import Float

from allanjax.base.errors import AllanjaxError

# Distance from which on ordinates are taken as uncorrelated under any window.
_CORRELATED = 32
# Correlations of ordinates depend on the window's shape alone: a short one shows them.
_SHORT_WINDOW = 4096


def window_weights(name: str, length: int) -> Float[np.ndarray, " length"]:
    """Weights of a window by its name in `scipy.signal`; AllanjaxError if there is none."""
    if name == "hann":
        # The one that is usual, as `scipy.signal` has it, which takes half a second to load.
        return np.sin(np.pi * np.arange(length) / length) ** 2
    from scipy.signal import get_window

    try:
        return get_window(name, length)
    except (ValueError, TypeError) as error:
        raise AllanjaxError(
            f"unknown window {name!r}: expected one that scipy.signal.get_window knows by name, e.g. 'hann'"
        ) from error


def without_line(x: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " samples"]:
    """Samples minus their least-squares straight line, in far less time than `scipy.signal.detrend`."""
    t = np.arange(len(x)) - (len(x) - 1) / 2.0
    x = x - x.mean()
    return x - (t @ x) / (t @ t) * t


def ordinate_correlation(window: str, length: int, segments: int) -> Float[np.ndarray, " lags"]:
    """Squared correlation of ordinates d = 0, 1, 2, … apart, summed over the segments.

    c(d) = Σ_m (1 − |m|/segments) |Σ_t w(t) w(t + m·step) e^{2πi·d·t/length}|² / (Σ w²)² with a step of half
    the length. Welch (1967) has d = 0. Only neighbouring segments overlap, m = ±1.
    """
    short = min(length, _SHORT_WINDOW) // 2 * 2
    w = window_weights(window, short)
    half = short // 2
    squares = abs(np.fft.rfft(w**2)) ** 2
    if segments > 1:
        squares = squares + 2.0 * (1.0 - 1.0 / segments) * abs(np.fft.rfft(w[:half] * w[half:], short)) ** 2
    return squares[:_CORRELATED] / (w @ w) ** 2
