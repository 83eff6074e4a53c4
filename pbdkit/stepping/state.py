"""State of a run, passed from step to step. It is complete, so that a run continued from it has the
same results as an uninterrupted run."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Array, Floats
from pbdkit.errors import PluginError, did_you_mean
from pbdkit.lattice.neighbourhood import crossed_bonds
from pbdkit.lattice.raster import LEADER
from pbdkit.plugin import (
    Bonds,
    Draws,
    FollowerRule,
    FractureModel,
    Particles,
    Remembered,
    StartsCracked,
)
from pbdkit.plugin.discovery import errors_attributed_to
from pbdkit.plugin.fracture_model import Segment
from pbdkit.scene.constants import bond_numbers, particle_numbers
from pbdkit.scene.leader_groups import kinds_at
from pbdkit.scene.scene import Scene
from pbdkit.seeds import component_generator, initial_generator

BrokenSteps = NDArray[np.integer[Any]]
"""Type of an array of shape (plane, cell, cell) with the step at which each bond broke; -1 for
intact bonds."""


def break_crossed(
    scene: Scene, segments: Iterable[Segment], broken: BrokenSteps, step: int
) -> None:
    """Mark the intact bonds that cross a segment as broken at a step, in place."""
    for n, block, crossed in crossed_bonds(scene.raster, scene.neighbourhood, segments):
        steps = block.within(broken[n])
        steps[crossed & (steps < 0)] = step


def cut_bonds(scene: Scene, broken: BrokenSteps | None, step: int) -> bool:
    """Cut the bonds that are cut at the beginning of a step, in place. Return whether there are any
    cuts in this step."""
    segments = [cut.segment for cut in scene.experiment.cuts if cut.at == step]
    if segments:
        assert broken is not None
        break_crossed(scene, segments, broken, step)
    return bool(segments)


NUMBERS = ("step", "load_factor", "dissipated")
"""Attributes of a state that are numbers."""
BY_DRIVER = {"checkpoint": False}
"""Metadata of attributes that checkpoints contain only among the data of the driver. The states in
checkpoints are then those of earlier versions."""
Values = tuple[Array, ...]
"""Type of state variables: one array each, in the order of their declarations."""


@dataclass
class State:
    """State of a run at the end of a step.

    `u` of shape (axis, sublattice, cell, cell) is the displacement; it is zero at places without
    particles. `previous` is the displacement at the end of the previous step, from which momentum
    and PE2 are computed; the next step is written into this array. `broken_step` of shape (plane,
    cell, cell) is the step at which each bond broke, and -1 for intact bonds. `broken_length` is
    the length of the bond in the intermediate configuration of that step, and 0 for intact and cut
    bonds. Both arrays are None if no bond can break. `starts` contains an entry for each leader
    group: the displacements at which its motion started, as an array of shape (axis, particle), or
    the velocities of a group that moves by Newton's law. The entry is None if the group has not
    begun. `bond_values` are the state variables of the fracture model for each bond, with the shape
    of `broken_step`. `particle_values` are the state variables of the rule for each particle,
    (sublattice, cell, cell). If the solver has a `control`, `load_factor` multiplies the loads, and
    `dissipated` is the dissipated energy, divided by Young's modulus and thickness.
    """

    step: int
    u: Floats
    previous: Floats
    broken_step: NDArray[np.int32] | None
    broken_length: Floats | None
    starts: tuple[Floats | None, ...]
    bond_values: Values = ()
    particle_values: Values = ()
    load_factor: float = field(default=1.0, metadata=BY_DRIVER)
    dissipated: float = field(default=0.0, metadata=BY_DRIVER)

    def copy(self, over: State | None = None) -> State:
        """Return a copy. If another state `over` of the same scene is given, its arrays are
        overwritten and used for the copy, because allocating memory takes several times as long as
        copying."""
        if over is None:
            return replace(self, **{name: _copied(part) for name, part in vars(self).items()})
        for source, target in zip(self.arrays(), over.arrays(), strict=True):
            np.copyto(target, source)
        numbers = {name: getattr(self, name) for name in NUMBERS}
        return replace(over, starts=self.starts, **numbers)

    def fits(self, other: State) -> bool:
        """Return whether both states can belong to the same scene. The data types and the shapes of
        their arrays are compared."""
        layouts = [[(a.dtype, a.shape) for a in state.arrays()] for state in (self, other)]
        return layouts[0] == layouts[1] and len(self.starts) == len(other.starts)

    def map(self, function: Callable[[Any], Any], starts: tuple[Any, ...]) -> State:
        """Return a state in which each array is replaced by the result of a function of it. The
        starts are replaced by `starts`."""
        names = [each.name for each in fields(self) if each.name not in ("starts", *NUMBERS)]
        parts = {name: _mapped(function, getattr(self, name)) for name in names}
        return replace(self, starts=starts, **parts)

    def arrays(self) -> list[Array]:
        """Return the arrays that steps write."""
        bonds = (self.broken_step, self.broken_length, *self.bond_values)
        arrays_of_state = (self.u, self.previous, *bonds, *self.particle_values)
        return [array for array in arrays_of_state if array is not None]


def _mapped(function: Callable[[Any], Any], part: Any) -> Any:
    if isinstance(part, tuple):
        return tuple(_mapped(function, each) for each in part)
    return None if part is None else function(part)


def _copied(part: Any) -> Any:
    if isinstance(part, tuple):
        return tuple(map(_copied, part))
    return part.copy() if isinstance(part, np.ndarray) else part


def unmoved_state(scene: Scene, cells: Sequence[int]) -> State:
    """Return a state at time 0 on rasters of the given number of cells, without displacements,
    broken bonds or random numbers."""
    experiment, sites = scene.experiment, (scene.raster.shape[0], *cells)
    bonds, precision = (len(scene.neighbourhood.planes), *cells), experiment.stepping.precision
    u, previous = (np.zeros((scene.axes, *sites), precision) for _ in range(2))
    broken, lengths = None, None
    if scene.has_fracture:
        broken, lengths = np.full(bonds, -1, np.int32), np.zeros(bonds, precision)
    numbers = bond_numbers(experiment), particle_numbers(experiment)
    of_bonds, of_particles = (
        started(scene, *of) for of in zip(numbers, (bonds, sites), strict=True)
    )
    starts = (None,) * len(scene.leading)
    return State(0, u, previous, broken, lengths, starts, of_bonds, of_particles)


def started(scene: Scene, numbers: Sequence[Remembered], shape: Sequence[int]) -> Values:
    """Return arrays of state variables with their initial values."""
    precision = scene.experiment.stepping.precision
    dtypes = [precision if number.dtype == "f8" else number.dtype for number in numbers]
    return tuple(np.full(shape, n.initial, d) for n, d in zip(numbers, dtypes, strict=True))


def initial_state(scene: Scene) -> State:
    """Return the state at time 0: the body has its initial displacements, frame points follow, and
    bonds across cracks and initial cuts are broken at step 0. The displacements of the previous
    step are set equal to the initial ones. With a control the load factor is 0."""
    experiment, state = scene.experiment, unmoved_state(scene, scene.raster.shape[1:])
    if experiment.solver.equilibrium.control:
        state.load_factor = 0.0
    if not experiment.initial.at_rest:
        _displace(scene, state.u.reshape(scene.axes, -1))
        state.previous[...] = state.u
    if state.broken_step is not None and isinstance(experiment.fracture, StartsCracked):
        break_crossed(scene, experiment.fracture.segments(), state.broken_step, 0)
    cut_bonds(scene, state.broken_step, 0)
    _draw(scene, "fracture", bond_numbers(experiment), state.bond_values)
    _draw(scene, "rule", particle_numbers(experiment), state.particle_values)
    return state


def _displace(scene: Scene, u: Floats) -> None:
    """Write the displacements of body and frame into u. Their shape is (axis, flat place)."""
    raster, body = scene.raster, scene.raster.body_rows
    leads = kinds_at(raster, scene.leading, 0)[body] == LEADER
    generator = initial_generator(scene.experiment.seed)
    initial = scene.experiment.initial.displacement(raster.reference(body), leads, generator)
    u[:, raster.place_of(body)] = initial.T
    if scene.frame:
        scene.frame.follow(u, u)


def _draw(scene: Scene, field: str, numbers: Sequence[Remembered], values: Values) -> None:
    """Draw the random initial values of the state variables of a component. No values are drawn for
    frame points."""
    part: FractureModel | FollowerRule = getattr(scene.experiment, field)
    if not (numbers and isinstance(part, Draws)):
        return
    owners: Bonds | Particles = describe_particles(scene)
    place = scene.raster.place_of(scene.raster.body_rows)
    if field == "fracture":
        owners, bonds = describe_bonds(scene), scene.bonds
        place = bonds.plane * math.prod(scene.raster.shape[1:]) + bonds.place
    generator = component_generator(scene.experiment.seed, field)
    with errors_attributed_to(part, "to draw its initial values", field):
        array_of = {number.name: value for number, value in zip(numbers, values, strict=True)}
        for name, value in part.draw(owners, generator).items():
            if name not in array_of:
                raise PluginError(
                    f"'{part.type}' draws '{name}', which is not among its state variables"
                    f"{did_you_mean(name, array_of)}"
                )
            if np.shape(value) != (len(owners),) or not np.isfinite(value).all():
                raise PluginError(
                    f"'{part.type}' draws '{name}' with the shape {np.shape(value)}, finite: "
                    f"{bool(np.isfinite(value).all())}; expected ({len(owners)},) finite numbers, "
                    "one for each of `owners`"
                )
            array_of[name].reshape(-1)[place] = value


def describe_particles(scene: Scene) -> Particles:
    """Return the particles of the body with their places."""
    rows = scene.raster.body_rows
    return Particles(rows.astype(np.int64) + 1, scene.raster.reference(rows))


def describe_bonds(scene: Scene) -> Bonds:
    """Return the table of bonds with their places."""
    table, raster = scene.bonds, scene.raster
    rests = np.array([plane.slot.rest for plane in scene.neighbourhood.planes])
    rest = rests[table.plane]
    return Bonds(table.ends + 1, table.shell, rest, raster.reference(table.ends[:, 0]) + rest / 2)


def renew(
    numbers: Sequence[Remembered], own: Sequence[Array], new: Sequence[Any], where: Array | None
) -> None:
    """Write the new values of the state variables that change, in place, where a mask is true.

    Raises ValueError if the number of values differs, TypeError if an integer variable would get a
    fraction.
    """
    old = [value for number, value in zip(numbers, own, strict=True) if number.changes]
    if len(new) != len(old):
        raise ValueError(
            f"it returned {len(new)} value{'s' * (len(new) != 1)} for {len(old)} changing state "
            "variables; declare `changes=False` for constant ones"
        )
    fresh = [
        np.array(value) if where is None else np.where(where, value, plane)
        for plane, value in zip(old, new, strict=True)
    ]
    for plane, value in zip(old, fresh, strict=True):
        np.copyto(plane, value)


def shown(values: Iterable[Any]) -> tuple[Any, ...]:
    """Return read-only views of arrays, which are passed to components. Other values are returned
    unchanged."""
    return tuple(_read_only(value) if isinstance(value, np.ndarray) else value for value in values)


def _read_only(value: Array) -> Array:
    view = value.view()
    view.flags.writeable = False
    return view
