"""Fitting: priors, losses, optimisers, the filter over time."""
