"""Fit parameters of an experiment to measurements.

- `fit_file` reads the description of a fit: its parameters and its measurements.
- `observations` predicts measured fields, tracks and curves; `channels` are quantities of curves.
- `modes` chooses the numbers of modes of measured boundaries; `crack_tip` locates crack tips.
- `sensitivity` and `parameter` compute the derivatives of these predictions.
- `problem` solves the least-squares problem; `residual_pattern` suggests remedies.
- `derived` computes quantities from a fit, with standard errors; `formula` reads their formulas.
- `correlation` estimates the correlation of residuals, which increases standard errors.
- `specimens` combines the fits of several specimens of one material.
- `uncertainty` computes confidence intervals and compares models.
- `strength` fits the strengths of bonds to repeated tests.
"""
