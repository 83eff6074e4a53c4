"""What a rule may derive its constants from."""

from __future__ import annotations

from operator import add

from pbdkit.interfaces import Components, Setting
from pbdkit.interfaces.vector import vector
from pbdkit.scene.neighbourhood import Neighbourhood
from pbdkit.scene.raster import Raster, positions


def setting_of(raster: Raster, neighbourhood: Neighbourhood) -> Setting:
    """What a rule may derive its constants from."""
    lower, upper = (end.each(add, raster.lattice.origin) for end in body_box(raster))
    cell, slots = raster.lattice.cell(), neighbourhood.slots
    return Setting(cell, slots, lower, upper, neighbourhood.tiling)


def body_box(raster: Raster) -> tuple[Components, Components]:
    """(lower, upper) of the body's reference configuration, from the lattice's site (0, 0)."""
    ends = (raster.ends_of_rows(s) for s in range(raster.shape[0]))
    at = [positions(raster.lattice.cell(), s, *cells) for s, cells in enumerate(ends)]
    lower, upper = raster.others.hull(
        (tuple(x.min() for x in here), tuple(x.max() for x in here)) for here in at if here[0].size
    )
    return vector(map(float, lower)), vector(map(float, upper))
