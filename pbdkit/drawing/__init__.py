"""Pictures of datasets, over matplotlib: bodies, histories, curves, cracks, movies."""

from pbdkit.drawing.comparison import compare
from pbdkit.drawing.movie import animate, animation
from pbdkit.drawing.picture import plot

__all__ = ["animate", "animation", "compare", "plot"]
