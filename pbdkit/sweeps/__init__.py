"""Sweeps: many runs of one experiment with varied parameters, combined into one dataset.

`specification` reads the sweep file, `execute` runs the members in parallel, `store` keeps their
results so that a sweep can be continued, and `combine` joins them with the parameters as
dimensions.
"""
