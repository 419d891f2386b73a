"""The posterior distribution of a fit's coefficients: priors, sampling and derived quantities."""
