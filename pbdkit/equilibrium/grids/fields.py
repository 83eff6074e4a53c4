"""Planes of a scene's raster as fields of a matrix of stencils, (axis, row, place), and back."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.equilibrium.grids.stencil_matrix import StencilMatrix

Floats = NDArray[np.floating[Any]]


def field_of(matrix: StencilMatrix, planes: Floats) -> Floats:
    """What planes are there."""
    if matrix.at is None:
        return planes.reshape(2, *matrix.code.shape)
    out = np.zeros((2, *matrix.code.shape))
    out.reshape(2, -1)[:, matrix.at] = planes.reshape(2, -1)[:, matrix.place]
    return out


def free_field_of(matrix: StencilMatrix, planes: Floats) -> Floats:
    """The same of who is free alone."""
    return np.where(matrix.code >= 0, field_of(matrix, planes), 0.0)


def planes_of(matrix: StencilMatrix, field: Floats, shape: tuple[int, ...]) -> Floats:
    """What a field is on the scene's raster, of a shape."""
    if matrix.at is None:
        return field.reshape(shape)
    planes = np.zeros(shape)
    planes.reshape(2, -1)[:, matrix.place] = field.reshape(2, -1)[:, matrix.at]
    return planes
