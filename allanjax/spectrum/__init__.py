"""Spectra: the power spectral density for display, and the cosine spectrum for the likelihood."""
