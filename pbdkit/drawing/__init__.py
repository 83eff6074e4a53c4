"""Pictures over matplotlib: set-ups of experiments, bodies, histories, curves, cracks, movies."""

from pbdkit.drawing.comparison import compare
from pbdkit.drawing.movie import animate, animation
from pbdkit.drawing.picture import plot, plot_experiment

__all__ = ["animate", "animation", "compare", "plot", "plot_experiment"]
