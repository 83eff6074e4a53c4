"""Compiled engine (numba): kernels generated from the elementwise functions of the components.

`plan` describes the kernel of a scene. `emitter` and `blocking` write its source, in which `sweeps`
writes the lines that move particles. `cache` compiles and stores the kernel, and `engine` makes
steps with it. Results agree with the numpy engine to the last bit.
"""

from __future__ import annotations
