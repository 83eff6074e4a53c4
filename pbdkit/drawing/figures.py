"""Figures: of pyplot where somebody uses that, so that they show; else without a screen."""

from __future__ import annotations

import sys
from importlib import import_module
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backend_bases import RendererBase
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from pbdkit.results.progress import in_notebook

PYPLOT = "matplotlib.pyplot"


def figure_of(ax: Axes) -> Figure:
    """The whole that axes are in."""
    found = ax.get_figure(root=True)
    assert found is not None
    return found


def renderer_of(figure: Figure) -> RendererBase:
    """What measures text: figures made here have Agg's."""
    canvas: Any = figure.canvas
    found: RendererBase = canvas.get_renderer()
    return found


def new_figure(*, alone: bool = False, **how: Any) -> Figure:
    """A figure made by matplotlib with these arguments. Where pyplot is in use, or in a notebook,
    it is pyplot's, unless it is to be `alone`: then whoever made it shows or saves it."""
    if not alone and (PYPLOT in sys.modules or in_notebook()):
        pyplot = import_module(PYPLOT)
        found: Figure = pyplot.figure(**how)
        if hasattr(found.canvas, "get_renderer"):
            return found
        pyplot.close(found)  # of a backend that cannot measure text
    found = Figure(**how)
    FigureCanvasAgg(found)
    return found
