"""Fit parameters of an experiment to measurements.

`fit_file` reads what is fitted to which data; `observations` predicts measured fields, tracks and
curves with derivatives (`sensitivity`, `parameter`); `problem` solves the least-squares problem,
`uncertainty` evaluates intervals and compares models, and `strength` fits strengths of bonds to
repeated tests.
"""
