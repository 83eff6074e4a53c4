"""The few words in which elementwise functions are written.

A rule's functions are called with whole arrays, with single numbers or with probes, always one
value a component. They use + - * / and the functions of numpy, and choose with `where`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np


class Vector(NamedTuple):
    """A vector by components; each is a number or an array, all of one shape."""

    x: Any
    y: Any


def where(condition: Any, yes: Any, no: Any) -> Any:
    """`yes` where the condition holds, else `no`, elementwise.

    Elementwise functions choose with this and not with `numpy.where`: a compiled engine knows it.
    """
    return np.where(condition, yes, no)


def squared_length(v: Vector) -> Any:
    """x² + y²; the same to the last bit for v and -v."""
    return v.x * v.x + v.y * v.y


def length(v: Vector) -> Any:
    """√(x² + y²)."""
    return np.sqrt(squared_length(v))
