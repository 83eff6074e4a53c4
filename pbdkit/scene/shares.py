"""The cells of a body with the share of each that belongs to it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from pbdkit.scene.cells import Cells
from pbdkit.scene.mesh import MeshCell, Patch, lattice_cells, patches
from pbdkit.scene.raster import Raster

Floats = NDArray[np.float64]


def cells_with_shares(raster: Raster, cells: Cells | None) -> Iterator[tuple[Patch, Floats]]:
    """Patch by patch the share of every cell, 0 to 1: what the outline leaves of the cells that the
    rule works on, or, where no frame weighs cells, 1 where all corners are of the body."""
    if cells is None:
        for patch in patches(raster, lattice_cells(raster.lattice.cell())):
            yield patch, patch.whole.astype(float)
        return
    cell = raster.lattice.cell()
    for s, kinds in enumerate(cells.tiling.corners):
        itself = cell.offset(s, s, (0, 0))
        for kind, corners in enumerate(kinds):
            polygon = MeshCell(s, tuple(slot or itself for slot in corners))
            for patch in patches(raster, (polygon,)):
                yield patch, cells.share[(kind, *patch.corners[0].slices())] * patch.whole
