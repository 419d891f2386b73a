"""Spectra: the power spectral density for people, and the cosine spectrum for the likelihood."""
