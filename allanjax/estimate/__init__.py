"""Estimation: the noise terms in a recording, their coefficients, and the uncertainty of these."""
