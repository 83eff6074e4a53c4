"""One lattice cut into parts, each stepped by a process of its own."""
