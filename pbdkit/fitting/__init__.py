"""Fit parameters of an experiment to measurements.

- `fit_file` reads the description of a fit: its parameters and its measurements.
- `observations` predicts measured fields, tracks and curves.
- `sensitivity` and `parameter` compute the derivatives of these predictions.
- `problem` solves the least-squares problem.
- `correlation` estimates the correlation of residuals, which increases standard errors.
- `specimens` combines the fits of several specimens of one material.
- `uncertainty` computes confidence intervals and compares models.
- `strength` fits the strengths of bonds to repeated tests.
"""
