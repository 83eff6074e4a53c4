"""Which components are installed, and where each comes from."""

BUILTIN = GROUP = "pbdkit"
"""The distribution of the built-in components, and the entry-point group of plugins, which is the
project name of their hook markers too."""
