"""Noise terms, models as their sums, notation, simulation, and estimates of a model's parameters."""
