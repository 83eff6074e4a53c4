"""What a run remembers from one step to the next. This, and nothing else, is a checkpoint."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import Pair, StartsCracked
from pbdkit.scene.bonds import bonds_in, crosses, plane_block
from pbdkit.scene.leader_groups import kinds_at
from pbdkit.scene.raster import LEADER
from pbdkit.scene.scene import Scene
from pbdkit.stepping.remembered_values import Values, initial_bond_values, initial_particle_values

Floats = NDArray[np.floating[Any]]


@dataclass
class State:
    """The run at the end of a step.

    `u` is the displacement, (axis, sublattice, cell, cell), zero where no particle is, and
    `previous` the same at the end of the step before: memory needs it, PE2 shows it, and the next
    step is written into it. `broken_step` holds, for each plane of bonds (plane, cell, cell), the
    step at which each broke and -1 where none did, and `broken_length` its length just then in the
    intermediate configuration, 0 where none broke; None where nothing can break. `starts` has for
    each leader group that has begun the displacements from which its motion counts, (axis,
    particle). `bond_values` and `particle_values` are what the fracture model remembers of each
    bond, as `broken_step` lies, and the rule of each particle, (sublattice, cell, cell).
    """

    step: int
    u: Floats
    previous: Floats
    broken_step: NDArray[np.int32] | None
    broken_length: Floats | None
    starts: tuple[Floats | None, ...]
    bond_values: Values = ()
    particle_values: Values = ()

    def copy(self, over: State | None = None) -> State:
        """The same state in arrays of its own, or in those of a state of the same scene that
        nobody needs any more: memory that is new costs several times as much as what is copied."""
        if over is None:
            over = replace(self, **{name: _copied(getattr(self, name)) for name in _CARRIED})
        else:
            for name in _CARRIED:
                _copy(getattr(self, name), getattr(over, name))
        return replace(over, step=self.step, starts=self.starts)


_CARRIED = ("u", "previous", "broken_step", "broken_length", "bond_values", "particle_values")
"""What steps are written into."""


def _copied(value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple(array.copy() for array in value)
    return None if value is None else value.copy()


def _copy(value: Any, over: Any) -> None:
    if value is not None:
        for array, target in zip(_each(value), _each(over), strict=True):
            np.copyto(target, array)


def _each(value: Any) -> tuple[Any, ...]:
    return value if isinstance(value, tuple) else (value,)


def initial_state(scene: Scene) -> State:
    """The state at time 0: the body as the experiment starts it, the frame following, bonds across
    the given cracks broken at step 0. Nothing has moved before."""
    shape, precision = (scene.axes, *scene.raster.shape), scene.experiment.stepping.precision
    u, previous = np.zeros(shape, precision), np.zeros(shape, precision)
    if not scene.experiment.initial.at_rest:
        _displace(scene, u.reshape(scene.axes, -1))
        previous[...] = u
    broken = _broken_by_cracks(scene) if scene.has_fracture else None
    lengths = None if broken is None else np.zeros(broken.shape, precision)
    bonds, particles = initial_bond_values(scene), initial_particle_values(scene)
    return State(0, u, previous, broken, lengths, (None,) * len(scene.leading), bonds, particles)


def _displace(scene: Scene, u: Floats) -> None:
    """Writes the body's and the frame's displacements, (axis, flat place)."""
    raster, body = scene.raster, scene.raster.body_rows
    leads = kinds_at(raster, scene.leading, 0)[body] == LEADER
    generator = np.random.default_rng(scene.experiment.seed)
    initial = scene.experiment.initial.displacement(raster.reference(body), leads, generator)
    u[:, raster.place_of(body)] = initial.T
    if scene.frame:
        scene.frame.follow(u, u)


def _broken_by_cracks(scene: Scene) -> NDArray[np.int32]:
    """(plane, cell, cell): 0 where a bond crosses a crack of the experiment, else -1."""
    raster, planes, model = scene.raster, scene.neighbourhood.planes, scene.experiment.fracture
    cracks = model.segments() if isinstance(model, StartsCracked) else ()
    broken = np.full((len(planes), *raster.shape[1:]), -1, np.int32)
    for n, plane in enumerate(planes):
        block = plane_block(raster, plane)
        for a, b in cracks if block else ():
            assert block is not None
            crack = (_from_origin(scene, a), _from_origin(scene, b))
            start = raster.reference_planes(block)
            end = start + plane.slot.rest
            crossed = crosses(start, end, crack) & bonds_in(raster, block, plane, frame_too=True)
            broken[(n, *block.slices()[1:])][crossed] = 0
    return broken


def _from_origin(scene: Scene, point: Pair) -> Pair:
    """A point as the rasters count: from the lattice's site (0, 0)."""
    x, y = scene.experiment.lattice.origin
    return point[0] - x, point[1] - y
