"""Calibration of sensors from static positions, with the uncertainty that the noise model implies."""
