"""Estimation: which terms a recording shows, their coefficients, and how well these are known."""
