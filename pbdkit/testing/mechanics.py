"""Laws of mechanics: the deviation of a scene from each law, relative to the largest stiffness.

Four laws are tested by the stiffness matrix K = -∂force/∂u of the particles of the body, including
leaders. It is computed from the forces of the stepper, for small solids with free edges:

- a rigid motion of a body stores no energy;
- the stiffness is symmetric (Maxwell and Betti);
- no deformation has a negative energy;
- a broken bond increases no stiffness.

Two laws connect the forces with what a rule declares:

- forces are the negative derivative of the strain energy;
- under a strain with a constant gradient, the force on a particle is the divergence of the stress
  of the declared material, times the area of the particle.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np

from pbdkit.array_types import Floats
from pbdkit.communicator import SERIAL
from pbdkit.errors import ExperimentError
from pbdkit.io.checkpoint import Checkpoint
from pbdkit.io.recorder import Recorder
from pbdkit.io.sinks import MemorySink
from pbdkit.model.experiment import Experiment
from pbdkit.plugin import Component, FollowerRule, FramePolicy, Stiffness, StoresEnergy
from pbdkit.plugin.component import as_vector
from pbdkit.plugin.rule import material_of
from pbdkit.plugin.vector import vector
from pbdkit.restart import restore
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.simulation import Simulation, checkpoint_of, record
from pbdkit.stepping.followers import SlotFollowers
from pbdkit.stepping.numpy_engine import Stepper
from pbdkit.stepping.state import State, initial_state
from pbdkit.testing.states import displacements, spacing, state_with

SHARE_BROKEN = 0.2
"""Fraction of bonds that are broken at random."""
NUDGE = 1e-5
"""Displacement of central differences for nonlinear rules, relative to the lattice constant.

The error is of the order of its square.
"""
DIRECTIONS = 3
"""Number of displacements for which work and energy are compared."""


def whole_state(scene: Scene) -> State:
    """Return the scene at rest with all bonds that are not broken by cracks and cuts."""
    state = initial_state(scene)
    state.u[...] = state.previous[...] = 0.0
    return state


def torn_state(scene: Scene, seed: int, initial: State) -> State:
    """Return a state at rest with further bonds broken at random."""
    state = initial.copy()
    state.u[...] = state.previous[...] = 0.0
    if state.broken_step is not None:
        generator, bonds = np.random.default_rng(seed), scene.bonds
        chosen = generator.random(len(bonds.plane)) < SHARE_BROKEN
        planes = state.broken_step.reshape(len(state.broken_step), -1)
        planes[bonds.plane[chosen], bonds.place[chosen]] = 1
    return state


def softened_state(scene: Scene, seed: int) -> State:
    """Return the state at rest after a random displacement that has been reversed.

    During the displacement, bonds have broken and softened according to the fracture model. Further
    bonds are broken at random.
    """
    state = Stepper(scene).advance(state_with(scene, displacements(scene, seed, share=0.3)), 1)
    return torn_state(scene, seed, state)


def stiffness(scene: Scene, state: State) -> Floats:
    """Return K at rest, divided by Young's modulus and thickness, with the bonds of a state.

    The matrix has two rows and two columns for each particle of the body, for x and y.
    """
    followers, raster = SlotFollowers(scene), scene.raster
    place = raster.place_of(raster.body_rows)
    is_linear = not isinstance(scene.experiment.rule, StoresEnergy)
    unit = scene.neighbourhood.nudge_unit
    step = unit if is_linear else NUDGE * unit
    u = np.zeros_like(state.u, dtype=float)
    flat = u.reshape(len(u), -1)

    def pulled(particle: int, axis: int, displacement: float) -> Floats:
        flat[...] = 0.0
        if particle >= 0:
            flat[axis, place[particle]] = displacement
        if scene.frame:
            scene.frame.follow(flat, flat)
        forces = followers.forces(u, state).reshape(len(u), -1)[:, place]
        return np.asarray(forces.T.ravel(), float)

    still = pulled(-1, 0, 0.0)
    columns = []
    for particle in range(len(place)):
        for axis in range(len(u)):
            ahead = pulled(particle, axis, step)
            if is_linear:
                columns.append((still - ahead) / step)
            else:
                columns.append((pulled(particle, axis, -step) - ahead) / (2.0 * step))
    return np.array(columns).T


def pulls_at_rest(scene: Scene, state: State) -> bool:
    """Return whether particles at rest exert forces.

    They exert forces if fictitious points are displaced. These points rotate with the body, so that
    a rotation changes the forces.
    """
    u = np.zeros_like(state.u, dtype=float)
    return bool(np.abs(SlotFollowers(scene).forces(u, state)).max() > 0.0)


def rigid_motions(scene: Scene) -> Floats:
    """Return the two translations and the small rotation about the middle. Each is a column of the
    result, with two rows for each particle.

    Their largest displacement is 1.
    """
    raster = scene.raster
    X = raster.reference(raster.body_rows)
    x, y = (X - X.mean(axis=0)).T
    ones, zeros = np.ones(len(X)), np.zeros(len(X))
    motions = np.array([[ones, zeros], [zeros, ones], [-y, x]]).transpose(0, 2, 1)
    motions = motions.reshape(3, -1)
    largest = np.abs(motions).max(axis=1, keepdims=True)
    return np.asarray((motions / np.where(largest > 0.0, largest, 1.0)).T)


def resistance_to_rigid_motions(scene: Scene, K: Floats) -> float:
    """Return the largest force that a rigid motion causes.

    If K is symmetric and this is zero, no deformation has a resultant or a moment.
    """
    return _share(np.abs(K @ rigid_motions(scene)).max(), K)


def asymmetry(K: Floats) -> float:
    """Return the largest difference between K and its transpose."""
    return _share(np.abs(K - K.T).max(), K)


def energy_given_back(K: Floats) -> float:
    """Return the magnitude of the smallest eigenvalue of the symmetric part of K if it is
    negative."""
    return _share(-np.linalg.eigvalsh((K + K.T) / 2)[0], K)


def stiffening(K: Floats, K_damaged: Floats) -> float:
    """Return the largest eigenvalue of the damaged stiffness minus the original stiffness."""
    increase = K_damaged - K
    return _share(np.linalg.eigvalsh((increase + increase.T) / 2)[-1], K)


def work_and_energy(scene: Scene, share: float) -> Floats:
    """Return the work of the forces for some small displacements from a deformed state, and the
    decrease of the strain energy, as two rows.

    Both are relative to the product of the norms of force and displacement. The displacements of
    the deformed state are at most a fraction `share` of the lattice constant.
    """
    followers, state = SlotFollowers(scene), whole_state(scene)
    place, nudge = scene.raster.place_of(scene.raster.body_rows), NUDGE * spacing(scene)

    def placed(table: Floats) -> Floats:
        u = np.zeros_like(state.u, dtype=float)
        flat = u.reshape(len(u), -1)
        flat[:, place] = table.T
        if scene.frame:
            scene.frame.follow(flat, flat)
        return u

    u = displacements(scene, 10, share)
    forces = followers.forces(placed(u), state).reshape(2, -1)[:, place].T
    pairs = []
    for direction in np.random.default_rng(11).uniform(-1.0, 1.0, (DIRECTIONS, *u.shape)):
        size = np.linalg.norm(forces) * np.linalg.norm(direction)
        behind, ahead = (
            followers.energy(placed(u + sign * nudge * direction), state) for sign in (-1.0, 1.0)
        )
        work = float((forces * direction).sum())
        pairs.append((work / size, (behind - ahead) / (2.0 * nudge * size)))
    return np.array(pairs).T


def force_constants(scene: Scene) -> Floats:
    """Return the force on the middle particle per area, under displacements with a constant second
    derivative at rest.

    Returns
    -------
    NDArray
        Array of shape (pair, axis of the displacement, axis of the force), for the second
        derivatives in xx, in yy and in xy.
    """
    followers, state, raster = SlotFollowers(scene), whole_state(scene), scene.raster
    place, X = raster.place_of(raster.body_rows), raster.reference(raster.body_rows)
    middle = int(np.abs(X - X.mean(axis=0)).max(axis=1).argmin())
    x, y = (X - X[middle]).T
    result = np.empty((3, 2, 2))
    for pair, field in enumerate((x * x / 2.0, y * y / 2.0, x * y)):
        size = NUDGE * spacing(scene) / np.abs(field).max()
        for axis in range(2):
            u = np.zeros_like(state.u, dtype=float)
            u.reshape(2, -1)[axis, place] = size * field
            difference = followers.forces(u, state) - followers.forces(-u, state)
            result[pair, axis] = difference.reshape(2, -1)[:, place[middle]] / (2.0 * size)
    cell = scene.experiment.lattice.cell()
    return result * len(cell.sites) / abs(float(np.linalg.det(np.array(cell.vectors))))


def declared_constants(c: Stiffness) -> Floats:
    """Return the divergence of the stress that a material has under the displacements of
    `force_constants`."""
    C = np.array(
        [[c.xx, c.xy, c.x_shear], [c.xy, c.yy, c.y_shear], [c.x_shear, c.y_shear, c.shear]]
    )[np.array([[0, 2], [2, 1]])[:, :, None, None], np.array([[0, 2], [2, 1]])]
    second = np.array(
        [[[1.0, 0.0], [0.0, 0.0]], [[0.0, 0.0], [0.0, 1.0]], [[0.0, 1.0], [1.0, 0.0]]]
    )
    return np.asarray(np.einsum("ijkl,pjl->pki", C, second))


def _share(value: float, K: Floats) -> float:
    largest = np.abs(K).max()
    return max(0.0, float(value)) / float(largest) if largest > 0.0 else 0.0


def resumed(scene: Scene, rebuilt: Scene, step: int, start: State | None = None) -> Any:
    """Return the dataset of a run that is stopped, stored, and resumed in a rebuilt scene."""
    sink = MemorySink()
    stopped, recorder = Simulation.of_scene(scene, start=start), Recorder(scene, sink)
    recorder.begin()
    for state in stopped:
        recorder.observe(state)
        if state.step >= step:
            break
    saved = checkpoint_of(stopped.driver, recorder)
    facts = json.loads(json.dumps(saved.facts))
    continued, recorder = Simulation.of_scene(rebuilt), Recorder(rebuilt, sink)
    checkpoint = Checkpoint(saved.about, facts, saved.copied().arrays)
    restore(continued.driver, recorder, checkpoint, SERIAL)
    record(continued, sink, recorder=recorder)
    return sink.dataset()


BODY = {"type": "grid", "columns": 4, "rows": 4}
"""Body of the solids."""
LARGER_BODY = {"type": "grid", "columns": 9, "rows": 9}
"""Body in which a particle is far from the edges."""
TEARS = {"type": "strain", "failure": 0.1}
"""Fracture model of the solids."""
SPRINGS = {"type": "springs"}
"""Rule of the solids."""
MAX_SOLIDS = 2
"""Maximum number of lattices."""


class NoSolidError(Exception):
    """A component has no scene with known forces and free edges; the text is the reason."""


@dataclass(frozen=True)
class Solid:
    """A scene with known forces and free edges, and its stiffness.

    The stiffness is computed in three states: with all bonds, with the bonds that have broken or
    softened after random displacements, and with further bonds broken at random.
    """

    scene: Scene

    @cached_property
    def whole(self) -> Floats:
        """Stiffness with all bonds."""
        return stiffness(self.scene, whole_state(self.scene))

    @cached_property
    def softened(self) -> Floats:
        """Stiffness with some bonds softened or broken."""
        return stiffness(self.scene, self._softened)

    @cached_property
    def torn(self) -> Floats:
        """Stiffness with further bonds broken."""
        return stiffness(self.scene, torn_state(self.scene, 4, self._softened))

    @cached_property
    def larger(self) -> Scene:
        """The scene with a larger body, in which the middle particle is far from the edges."""
        experiment = self.scene.experiment
        body = type(experiment.body).model_validate(LARGER_BODY)
        return build_scene(experiment.model_copy(update={"body": body}))

    @property
    def stages(self) -> list[tuple[str, Floats]]:
        """Name and stiffness of each stage of damage, in order."""
        if not self.scene.has_fracture:
            return [("whole", self.whole)]
        return [("whole", self.whole), ("softened", self.softened), ("torn", self.torn)]

    @cached_property
    def _softened(self) -> State:
        return softened_state(self.scene, 3)


def solids_of(component: Component, around: Mapping[str, Any]) -> list[Solid]:
    """Return the solids of a component, one for each lattice.

    Raises
    ------
    NoSolidError
        If there are none.
    """
    solids: dict[str, Solid] = {}
    for experiment in _experiments(component, around):
        name = experiment.lattice.type
        if name not in solids and len(solids) < MAX_SOLIDS:
            with suppress(ExperimentError):
                solid = Solid(build_scene(experiment))
                if not (_is_tied(solid.scene) or pulls_at_rest(solid.scene, solid._softened)):
                    solids[name] = solid
    if not solids:
        raise NoSolidError("there is no scene with known forces, free edges, and no forces at rest")
    return list(solids.values())


def _experiments(component: Component, around: Mapping[str, Any]) -> Iterator[Experiment]:
    base: dict[str, Any] = {"name": "conformance", "body": BODY, "steps": 4}
    lattices, neighbours = (
        list(part) if isinstance(part := around[name], (list, tuple)) else [part]
        for name in ("lattice", "neighbours")
    )
    for parts, lattice, metric in product(_parts(component), lattices, neighbours):
        with suppress(ExperimentError):
            yield Experiment(**base, **parts, lattice=lattice, neighbours=metric)


def _parts(component: Component) -> list[dict[str, Any]]:
    """Return combinations of rule, frame and fracture for the tests of a component.

    Combinations with fracture come first.
    """
    if isinstance(component, FollowerRule):
        if material_of(component) is None:
            raise NoSolidError("it defines no forces")
        frame = {"type": "natural" if component.uses_cells else "none"}
        plain = {"rule": component, "frame": frame}
        return [plain | {"fracture": TEARS}, plain]
    if isinstance(component, FramePolicy):
        if not component.edges_are_free:
            raise NoSolidError("its points exert forces on the edges, which are not free")
        return [{"rule": SPRINGS, "frame": component, "fracture": TEARS}]
    return [{"rule": SPRINGS, "frame": {"type": "natural"}, "fracture": component}]


def _is_tied(scene: Scene) -> bool:
    """Return whether fictitious neighbours are fixed in space.

    Translations of the body then change forces.
    """
    model, slot = scene.experiment.fracture, scene.neighbourhood.slots[0][0]
    u, p = vector([0.1] * scene.axes), scene.constants.fracture
    points = (model.fictitious(u * share, slot.rest, p) for share in (0.0, 1.0))
    first, second = (as_vector(each, "fictitious", u) for each in points)
    return any(float(a) != float(b) for a, b in zip(first, second, strict=True))
