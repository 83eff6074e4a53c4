"""The compiled engine: the same elementwise functions, inlined into generated kernels (numba)."""
