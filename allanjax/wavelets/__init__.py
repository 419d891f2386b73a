"""Wavelet decomposition of records, wavelet variance and its covariance."""
