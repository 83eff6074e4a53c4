"""Pages of HTML that show a dataset: what Python gathers for them, and what a browser draws.

A body that answers to the mouse: what is done to it is what an experiment file can say.
"""

from __future__ import annotations
