"""Joint spectral model of an axis: a response, noise inside and after it, and its fit to cosine levels."""
