"""Datasets of runs in memory and in files.

`recorder` takes the variables of a dataset from the states of a run (`layout`, `snapshot`) and
passes them to a sink (`sinks`, `netcdf`). `seal` adds checksums to result files. `checkpoint` and
`run_store` keep unfinished runs for `resume`. `open` and `save` read and write results, and
`vtkhdf` exports to ParaView.
"""

from __future__ import annotations
