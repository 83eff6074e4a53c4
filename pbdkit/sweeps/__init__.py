"""Sweeps: many runs of one experiment with varied parameters, combined into one dataset.

`specification` reads the sweep file, and `execute` runs the members in parallel. `store` stores
their results, so that an interrupted sweep can be continued. `combine` combines the results into a
dataset with the parameters as dimensions.
"""
