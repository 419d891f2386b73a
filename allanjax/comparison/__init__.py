"""Comparison of sensors, grades and days: with one another and with a specification."""
