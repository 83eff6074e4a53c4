"""What every moment of a scene shares, made where somebody asks."""

from __future__ import annotations

from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from pbdkit.experiment.body import Sites
from pbdkit.interfaces import Stiffness
from pbdkit.scene.particle_materials import (
    phases_of_particles,
    stiffness_of_particles,
    through_thickness_of_particles,
)
from pbdkit.scene.raster import FOLLOWER
from pbdkit.scene.scene import Scene
from pbdkit.scene.sites import tolerance_of
from pbdkit.stepping.followers import SlotFollowers
from pbdkit.stepping.state import Floats
from pbdkit.stepping.surroundings import Surroundings, blocks

Array = TypeVar("Array", bound=NDArray[Any])


def read_only(values: Array) -> Array:
    """The same values, as diagnostics see them: nobody writes to what others read."""
    view: Array = values.view()
    view.flags.writeable = False
    return view


class Tables:
    """What every moment of a scene shares: the reference, and who is around whom."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene

    def at(self, moment: float) -> Tables:
        """The same with the numbers of a moment."""
        if (now := self.scene.at(moment)) is self.scene:
            return self
        found = Tables(now)
        vars(found).update(reference=self.reference, body=self.body, inside=self.inside)
        return found

    def add_reference(self, u: Floats) -> Floats:
        """X + u, (particle, axis), in place; X is kept where it is wanted more than twice."""
        experiment = self.scene.experiment
        if experiment.record_count > 2:
            u += self.reference
            return u
        for rows in self.scene.raster.chunks():
            u[rows[0] : rows[-1] + 1] += self.scene.raster.reference(rows)
        return u

    def of_body(self, planes: Floats) -> Floats:
        """The values of planes by particle, (particle, ...); NaN at frame points."""
        table = self.scene.raster.table(planes)
        table[~self.body] = np.nan
        return read_only(table)

    @cached_property
    def reference(self) -> Floats:
        """X, (particle, axis)."""
        return read_only(self.scene.raster.reference())

    @cached_property
    def body(self) -> NDArray[np.bool_]:
        """(particle,): which are leaders or followers."""
        return read_only(self.scene.raster.table_kind == FOLLOWER)

    @cached_property
    def inside(self) -> NDArray[np.bool_]:
        """(particle,): which particles of the body lie inside or on its outline: all but some
        corners of cells that it cuts."""
        scene, raster = self.scene, self.scene.raster
        if scene.cells is None or scene.cells.share is None:
            return self.body
        cut = np.zeros((1, *raster.shape), bool)
        for patch in scene.patches:
            share = scene.cells.of(patch)
            for corner in patch.corners:
                corner.of(cut[0])[...] |= (share > 0.0) & (share < 1.0)
        body, lattice = scene.experiment.body, scene.experiment.lattice
        rows = np.flatnonzero(self.body & raster.table(cut)[:, 0])
        sites = Sites(tuple(raster.site_of(rows).T), tuple(raster.reference(rows).T))
        found = self.body.copy()
        found[rows] = body.distance(sites) <= tolerance_of(body, lattice)
        return read_only(found)

    @cached_property
    def followers(self) -> SlotFollowers:
        """The rule on the scene, which knows forces and energy."""
        return SlotFollowers(self.scene)

    @cached_property
    def stiffness(self) -> Stiffness | None:
        """The rule's, of each particle where fields make it differ."""
        return stiffness_of_particles(self.scene.experiment, self.scene.raster)

    @cached_property
    def through_thickness(self) -> Floats | float:
        """σ_zz over σ_xx + σ_yy, of each particle where fields make it differ."""
        return through_thickness_of_particles(self.scene.experiment, self.scene.raster)

    @cached_property
    def phase(self) -> NDArray[np.int64]:
        """(particle,): of which material each is, by a number."""
        return phases_of_particles(self.scene.experiment, self.scene.raster)

    @cached_property
    def surroundings(self) -> list[Surroundings]:
        """Who is around the body's particles."""
        return blocks(self.scene)
