"""The posterior distribution of a fit's coefficients: priors, sampling, and what follows from the draws."""
