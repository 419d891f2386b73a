"""How numbers are written for people: values with errors, and intervals."""

import numpy as np


def format_with_error(value: float, std: float) -> str:
    """Value and 1-σ to two digits of the latter, e.g. "0.5121 ± 0.0068" or "(1.680 ± 0.013)e-05"."""
    if not (np.isfinite(std) and std > 0.0 and np.isfinite(value)):
        return f"{value:.6g}"
    exponent = int(np.floor(np.log10(max(abs(value), std))))
    scale = 10.0**exponent if not -4 <= exponent < 6 else 1.0
    digits = max(0, 1 - int(np.floor(np.log10(std / scale))))
    text = f"{value / scale:.{digits}f} ± {std / scale:.{digits}f}"
    return text if scale == 1.0 else f"({text})e{exponent:+03d}"


def format_interval(lower: float, upper: float) -> str:
    """Both ends with as many digits as it takes to tell them apart, at least four."""
    width = upper - lower
    digits = 4
    if np.isfinite(width) and width > 0.0:
        digits = max(4, 3 + int(np.ceil(np.log10(max(abs(lower), abs(upper)) / width))))
    largest = max(abs(lower), abs(upper))
    if 1e4 <= largest < 1e9:
        digits = max(digits, 1 + int(np.log10(largest)))  # rather than an exponent
    return f"{lower:.{digits}g} … {upper:.{digits}g}"
