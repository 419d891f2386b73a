"""Kalman filters and smoothers that a noise model drives, and the exact likelihood."""
