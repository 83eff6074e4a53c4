"""Pictures over matplotlib: set-ups of experiments, bodies, histories, curves, cracks, movies."""

from __future__ import annotations

from pbdkit.plotting.configuration import compare, plot, plot_experiment
from pbdkit.plotting.movie import animate, animation

__all__ = ["animate", "animation", "compare", "plot", "plot_experiment"]
