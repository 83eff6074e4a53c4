"""Fit parameters to measurements: sensitivities, observations, least squares and uncertainty."""
