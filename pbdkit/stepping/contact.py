"""Frictionless contact with obstacles: after each step, particles inside an obstacle are projected
onto its outline.

A rule moves a particle by S⁻¹ · force, where S is a 2 × 2 matrix of the particle. For calibrated
rules S is the stiffness of the force that restores the particle if its neighbours stay; for springs
it is a multiple of the identity. A particle is projected onto the nearest point outside all
obstacles in the metric S. If n is the normal at that point, the displacement is proportional to S⁻¹
n. Where obstacles meet, it is a combination of S⁻¹ n for several normals. In equilibrium the
remaining force is therefore along the normals. If S is a multiple of the identity, the projection
is orthogonal. A guided particle is moved along its free axis only.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Floats, Indices, Mask
from pbdkit.lattice.raster import FOLLOWER, Block, Places, distinct
from pbdkit.plugin.rule import material_of
from pbdkit.plugin.vector import length, vector
from pbdkit.scene.leader_groups import guided_at, has_guides, kinds_at
from pbdkit.scene.obstacles import SLACK, Outline, Walls, contact_correction, outlines_at
from pbdkit.scene.scene import Scene
from pbdkit.stepping.kernel import Function, KernelWriter, Lines
from pbdkit.stepping.rule_evaluation import Evaluator, Surroundings
from pbdkit.stepping.state import State, unmoved_state
from pbdkit.stepping.step import (
    PUSHED_BY_TIME_DEPENDENCE,
    Call,
    Cells,
    Hindrance,
    Mode,
    Operation,
    Step,
)

NUDGE = 0.01
"""Displacement of a particle, in lattice constants, for which its restoring move is evaluated."""
SAME = 1e-9
"""Relative difference below which two entries of a matrix count as equal."""
PARTICLES = 16384
"""Number of particles that are evaluated in one block."""


def stiffnesses(scene: Scene, place: Indices) -> Floats:
    """Return an array of shape (particle, axis, axis) with S of particles at flat places if all
    bonds are intact. It is zero where a particle does not move."""
    each = scene.raster.kind.size // len(scene.raster.kind)
    S = np.zeros((len(place), scene.axes, scene.axes))
    for s in np.unique(place // each).tolist():
        rows = np.flatnonzero(place // each == s)
        for first in range(0, len(rows), PARTICLES):
            part = rows[first : first + PARTICLES]
            S[part] = _stiffnesses(scene, place[part], s)
    return S


def _stiffnesses(scene: Scene, place: Indices, sublattice: int) -> Floats:
    """Return S of particles of one sublattice, as the mean over displacements in opposite
    directions, so that mirrored scenes have mirrored matrices."""
    rest, evaluator = unmoved_state(scene, scene.raster.shape[1:]), Evaluator(scene)
    around = Surroundings(scene, Places(scene.raster.shape, place), sublattice)
    if scene.constants.by_particle:
        evaluator = evaluator.given(around.parameters)
    neighbours, values = around.neighbours(rest), around.here(rest.u, rest)
    size = NUDGE * length(scene.raster.cell.vectors[0])
    sizes = (size,) if scene.experiment.rule.linear else (size, -size)
    S = np.zeros((len(place), scene.axes, scene.axes))
    for nudge in sizes:
        answers = []
        for e in np.eye(scene.axes):
            u = vector(np.full(len(place), nudge * c) for c in e)
            total = evaluator.total([-u] * len(neighbours), u, neighbours)
            at = values._replace(u=u)
            both = evaluator.move(total, at), evaluator.force(total, at)
            answers.append([[np.broadcast_to(c, len(place)) for c in columns] for columns in both])
        move, force = np.array(answers).transpose(1, 3, 2, 0)
        S += force @ np.linalg.pinv(move) / len(sizes)
    return S


def compliance(scene: Scene) -> Floats | None:
    """Return C = S⁻¹ of every particle, scaled for each particle: (xx xy yy, sublattice, cell,
    cell).

    Returns None if C is a multiple of the identity for all particles, or if the rule defines no
    forces.
    """
    if material_of(scene.experiment.rule) is None:
        return None
    place = scene.raster.place_of(scene.raster.body_rows)
    S = stiffnesses(scene, place)
    xx, xy, yy = S[:, 0, 0], (S[:, 0, 1] + S[:, 1, 0]) / 2, S[:, 1, 1]
    mean = (xx + yy) / 2
    differs = np.maximum(abs(xx - yy), abs(xy)) > SAME * mean
    rows = np.flatnonzero(differs & (xx * yy > xy * xy))
    if not len(rows):
        return None
    C = np.ones((3, *scene.raster.shape))
    C[1] = 0.0
    C.reshape(3, -1)[:, place[rows]] = np.stack([yy, -xy, xx])[:, rows] / mean[rows]
    return C


Touching = list[tuple[Indices, Floats]]
"""Type of the rows on the outline of each obstacle, with the normals there, (row, axis)."""
FREE = 0
"""Code of particles that are free along both axes. Particles that are led along x only have the
code 1, and along y only the code 2."""
ALL_LED = 3
"""Code of particles that are led along both axes."""


class Contact:
    """Obstacles of a scene and the particles of its body.

    Only particles are evaluated that can lie in the bounding box of an obstacle, given the range of
    all displacements. The result does not depend on the order of the obstacles.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._vectors: Floats = np.array(scene.raster.cell.vectors)
        self._inverse = np.linalg.inv(self._vectors)
        ends = [end for block in self._blocks() for end in self._ends(block)]
        self.reach = float(np.abs(ends).max())
        """Largest distance of a particle at rest from the lattice's site (0, 0), along an axis."""
        self._led: dict[tuple[bool, ...], NDArray[np.int8]] = {}

    @cached_property
    def compliance(self) -> Floats | None:
        """Directional response C of the particles; None if it is isotropic."""
        return compliance(self._scene)

    def led(self, step: int) -> NDArray[np.int8] | None:
        """Return for each particle the code of the axes along which it is led in a step,
        (sublattice, cell, cell). Return None if no particle can be guided."""
        scene = self._scene
        if not has_guides(scene.leading):
            return None
        roles = tuple(leading.group.leads(step) for leading in scene.leading)
        if roles not in self._led:
            codes = np.zeros(scene.raster.kind.size, np.int8)
            for leading, leads in zip(scene.leading, roles, strict=True):
                for axis in leading.axes if leads else ():
                    codes[leading.place] |= 1 << axis
            self._led[roles] = codes.reshape(scene.raster.shape)
        return self._led[roles]

    def push_out(self, u: Floats, moment: float) -> None:
        """Push the body's particles out of the obstacles at the end of a step, or at a moment
        within it. `u` is changed in place; its guided particles are already placed along their led
        axes. Leaders may be pushed, too, and are therefore placed again afterwards."""
        outlines, places = self._outlines(moment), [np.empty(0, np.intp)]
        for outline in outlines:
            for block in self._blocks():
                near = self._near(block, block.of(u), outline.box)
                if near is not None:
                    i, j = np.nonzero(self._inside(near, u, outline))
                    at = near.sublattice, i + near.start[0], j + near.start[1]
                    places.append(np.ravel_multi_index(at, self._scene.raster.shape))
        place = distinct(np.concatenate(places))
        if len(place):
            flat = u.reshape(len(u), -1)
            flat[:, place] = flat[:, place] + self.corrections(u, place, moment)

    def corrections(self, u: Floats, place: Indices, moment: float) -> Floats:
        """Return the displacements, as an array of shape (axis, place), that push particles at flat
        places out of the obstacles."""
        codes = self.led(math.ceil(moment))
        codes_at = np.zeros(len(place), np.int8) if codes is None else codes.ravel()[place]
        return self._corrections(
            self.positions(u, place), self.compliance_at(place), codes_at, moment
        )

    def corrections_of_masses(self, u: Floats, place: Indices, moment: float) -> Floats:
        """Return the displacements, as an array of shape (axis, place), that push particles with
        isotropic response out of the obstacles. The particles have the displacements u."""
        X = self._scene.raster.reference_planes(Places(self._scene.raster.shape, place))
        at = np.stack([a + b for a, b in zip(X, u, strict=True)])
        return self._corrections(at, _alike(len(place)), np.zeros(len(place), np.int8), moment)

    def _corrections(self, at: Floats, C: Floats, led: NDArray[np.int8], moment: float) -> Floats:
        outlines = self._outlines(moment)
        walls, correction, size = Walls.of(outlines), np.zeros(at.shape), at.shape[1]
        count, obstacle = np.zeros(size, np.intp), np.zeros(size, np.intp)
        with np.errstate(all="ignore"):
            for n, outline in enumerate(outlines):
                inside = outline.facing(*at)[0] < 0.0
                count, obstacle = count + inside, np.where(inside, n, obstacle)
            for n, outline in enumerate(outlines):
                single = np.flatnonzero((count == 1) & (led == FREE) & (obstacle == n))
                correction[:, single] = outline.outline_correction(at[:, single], C[:, single])
            x, y = at + correction
            alone = (count == 1) & (led == FREE) & (walls.clearance(x, y) >= 0.0)
            for k in np.flatnonzero((count > 0) & (led != ALL_LED) & ~alone).tolist():
                correction[:, k] = walls.overlap_correction(at[:, k], C[:, k], int(led[k]))
        return correction

    def positions(self, u: Floats, place: Indices) -> Floats:
        """Return the positions of particles at flat places, relative to the lattice's site (0, 0),
        (axis, place)."""
        X = self._scene.raster.reference_planes(Places(self._scene.raster.shape, place))
        return np.stack([a + b for a, b in zip(X, u.reshape(len(u), -1)[:, place], strict=True)])

    def compliance_at(self, place: Indices) -> Floats:
        """Return the directional response C = S⁻¹ of particles at flat places, (xx xy yy, place). A
        flat place is the index of a particle in a flattened raster."""
        if self.compliance is None:
            return _alike(len(place))
        C: Floats = self.compliance.reshape(3, -1)[:, place]
        return C

    def touched_at_rest(self, moment: float) -> Iterator[tuple[NDArray[np.intp], ...]]:
        """Generate the cells of particles that obstacles would push out of their reference
        positions, one array for each axis."""
        still = np.zeros((2, *self._scene.raster.shape))
        for _, outline in outlines_at(self._scene.barriers, moment):
            for block in self._blocks():
                near = self._near(block, block.of(still), outline.box)
                if near is not None:
                    inside = self._inside(near, still, outline)
                    yield tuple(n + a for n, a in zip(np.nonzero(inside), near.start, strict=True))

    def touching(self, state: State, moment: float) -> Touching:
        """Return the followers on the outlines of obstacles at a moment. For each obstacle they are
        given by their rows in the particle table and by the normals at their positions, of shape
        (row, axis). Guided particles are included.

        A particle counts as lying on the outline if its distance is at most the rounding error plus
        1e-9 of a lattice constant. The row of a particle at a corner of two faces occurs twice.
        """
        scene, raster, step = self._scene, self._scene.raster, math.ceil(moment)
        kinds = kinds_at(raster, scene.leading, step)
        if has_guides(scene.leading):
            kinds[guided_at(raster, scene.leading, max(step, 1)).rows] = FOLLOWER
        rows = np.flatnonzero(kinds == FOLLOWER)
        at = self.positions(state.u, raster.place_of(rows))
        digits = 16.0 * float(np.finfo(state.u.dtype).eps) * self.reach
        slack = SLACK * math.hypot(*self._vectors[0]) + digits
        touching: Touching = [(rows[:0], np.zeros((0, 2)))] * len(scene.barriers)
        for n, outline in outlines_at(scene.barriers, moment):
            near = np.flatnonzero(np.abs(outline.facing(*at)[0]) <= slack)
            faces = list(outline.faces(*at[:, near]))
            on = [face.distance <= slack for face in faces]
            normals = [face.normal[:, is_on] for face, is_on in zip(faces, on, strict=True)]
            touching[n] = (
                np.concatenate([rows[near[is_on]] for is_on in on]),
                np.concatenate(normals, axis=1).T,
            )
        return touching

    def _outlines(self, moment: float) -> Sequence[Outline]:
        return [outline for _, outline in outlines_at(self._scene.barriers, moment)]

    def _blocks(self) -> list[Block]:
        blocks = (self._scene.raster.body_block(s) for s in range(self._scene.raster.shape[0]))
        return [block for block in blocks if block]

    def _near(self, block: Block, u: Floats, box: Floats) -> Block | None:
        """Return the part of a block that contains all particles that may lie in a box; `u` are
        the displacements of the block."""
        raster = self._scene.raster
        low, high = np.array([[np.fmin.reduce(p, axis=None) for p in u],
                              [np.fmax.reduce(p, axis=None) for p in u]])  # fmt: skip
        corner = np.array([box[:2] - high, box[2:] - low])
        if np.isnan(corner).any():
            return None
        at = raster.cell.basis[block.sublattice]
        low, high = self._ends(block)
        # An infinite box is replaced by the bounding box of the block, plus a margin.
        corner = np.clip(corner, low - 1.0, high + 1.0)
        corners = np.array([[corner[i, 0], corner[j, 1]] for i, j in product((0, 1), repeat=2)])
        cells = (corners - at) @ self._inverse - raster.first
        first = np.maximum(np.floor(cells.min(axis=0) - 1e-6).astype(int), block.start)
        last = np.minimum(np.ceil(cells.max(axis=0) + 1e-6).astype(int) + 1, block.stop)
        if (first >= last).any():
            return None
        return Block(block.sublattice, tuple(first.tolist()), tuple(last.tolist()))

    def _inside(self, block: Block, u: Floats, outline: Outline) -> Mask:
        """Return which of the body's particles in a block are inside an obstacle."""
        X, low = self._scene.raster.reference_planes(block), outline.box
        x, y = (a + b for a, b in zip(X, block.of(u), strict=True))
        near = (x >= low[0]) & (y >= low[1]) & (x <= low[2]) & (y <= low[3])
        near &= block.of(self._scene.raster.kind) == FOLLOWER
        inside = np.zeros(x.shape, bool)
        inside[near] = outline.facing(x[near], y[near])[0] < 0.0
        return inside

    def _ends(self, block: Block) -> tuple[Floats, Floats]:
        """Return the bounds (low, high) of the positions of a block's sites, relative to site (0,
        0)."""
        corners = product(*((a, b - 1) for a, b in zip(block.start, block.stop, strict=True)))
        sites = np.array(list(corners)) + self._scene.raster.first
        at = self._scene.raster.cell.basis[block.sublattice]
        places = sites @ self._vectors + at
        return places.min(axis=0), places.max(axis=0)


def _alike(count: int) -> Floats:
    """Return the isotropic response C of particles, (xx xy yy, particle)."""
    return np.repeat([[1.0], [0.0], [1.0]], count, axis=1)


class PushOut(Operation):
    """Push particles out of obstacles."""

    @cached_property
    def contact(self) -> Contact:
        """The obstacles and the particles that they push."""
        return Contact(self.scene)

    @classmethod
    def is_needed(cls, scene: Scene) -> bool:
        """Return whether there are obstacles."""
        return bool(scene.barriers)

    def apply(self, step: Step) -> None:
        """Push particles after the rule has moved them and guided particles have been placed."""
        self.contact.push_out(step.new, step.number)

    def emit(self, kernel: KernelWriter) -> None:
        """Write a function that moves the particles of a range of rows. It skips rows that do not
        overlap the bounding box of any obstacle."""
        kernel.over_rows("push_out", lambda out: self._write(kernel, out))

    def functions(self) -> dict[str, Callable[..., Any]]:
        """Return the displacement of a particle out of all obstacles."""
        return {"contact_correction": contact_correction}

    def arrays(self, call: Call) -> dict[str, Any]:
        """Return the outlines of the obstacles with their points and bounding boxes in each step,
        the response of the particles, and the axes along which they are led."""
        moments = [[o for _, o in outlines_at(self.scene.barriers, step)] for step in call.moments]
        walls = [Walls.of(outlines) for outlines in moments]
        boxes = np.array([[outline.box for outline in outlines] for outlines in moments])
        arrays = {
            "wall_kind": walls[0].kinds,
            "wall_first": walls[0].first,
            "wall_points": np.array([each.points for each in walls]),
            "wall_radii": np.array([each.radii for each in walls]),
            "wall_box": boxes.reshape(len(moments), -1, 4),
        }
        compliance, codes = self.contact.compliance, self.contact.led(call.step)
        arrays |= {} if compliance is None else {"compliance": compliance}
        return arrays | ({} if codes is None else {"led_axes": codes})

    def disturbances(self, call: Call) -> Iterator[Cells]:
        """Generate the cells of particles that obstacles would push out of their reference
        positions."""
        for step in call.moments:
            yield from self.contact.touched_at_rest(step)

    def next_change(self, step: int, precomputable: bool = False) -> float:
        """Return the next change of any obstacle."""
        return min(each.group.next_change(step, precomputable) for each in self.scene.barriers)

    def events(self, steps: int) -> list[int]:
        """Return the events of all obstacles."""
        return [at for each in self.scene.barriers for at in each.group.events(steps)]

    def hindrance(self, mode: Mode) -> Hindrance | None:
        """Return the reason why obstacles that push do not support a mode. Kernels do not support
        them if parameters change in time, because the response of particles is computed once, from
        initial values."""
        reasons = {
            Mode.GPU: "obstacles push",
            Mode.TIME_DEPENDENT: PUSHED_BY_TIME_DEPENDENCE,
            Mode.RANKS_AT_REST: "an equilibrium before obstacles",
        }
        return Hindrance(reasons[mode], "obstacles") if mode in reasons else None

    def _write(self, kernel: KernelWriter, out: Function) -> None:
        """Write the lines that push the particles of rows."""
        out.add(0, "m = min(moment, wall_box.shape[0] - 1)")
        out.add(0, "points, edges, radii = wall_points[m], wall_box[m], wall_radii[m]")
        out.add(0, "j0, j1 = max(0, box[2]), min(kind.shape[2], box[3])", "width = j1 - j0")
        out.add(0, "for s in range(kind.shape[0]):", "    for i in range(first_row, last_row):")
        out.add(2, "if width <= 0:", "    continue")
        out.add(2, *kernel.each(f"o@ = {kernel.row('v_@', 's')}"))
        out.add(2, *kernel.each("l@, h@ = o@[0], o@[0]"))
        out.add(2, "for j in range(width):")
        out.add(3, *kernel.each("l@ = min(l@, o@[j])"), *kernel.each("h@ = max(h@, o@[j])"))
        for name, j in (("A", "0"), ("B", "width - 1")):
            out.add(2, f"j = {j}", *_places(kernel, name))
        out.add(2, *kernel.each("l@, h@ = min(A@, B@) + l@, max(A@, B@) + h@"))
        out.add(2, "near = 0", *_each_near("l", "h"))
        out.add(2, "if near == 0:", "    continue", "for j in range(width):")
        out.add(3, f"if kind[s, i, j0 + j] != {FOLLOWER}:", "    continue", *_places(kernel, "A"))
        out.add(3, *kernel.each("p@ = A@ + o@[j]"), "near = 0")
        out.add(3, *_each_near("p", "p"), "if near == 0:", "    continue")
        compliance = ["1.0", "0.0", "1.0"]
        if kernel.is_given("compliance"):
            compliance = [f"compliance[{n}, s, i, j0 + j]" for n in range(3)]
        axes = "led_axes[s, i, j0 + j]" if has_guides(self.scene.leading) else "0"
        particle = ", ".join([*compliance, axes])
        walls = "wall_kind, points, wall_first, radii"
        out.add(
            3, f"{', '.join(kernel.each('w@'))} = contact_correction(px, py, {particle}, {walls})"
        )
        out.add(3, *kernel.each("o@[j] = o@[j] + w@"))


def _each_near(low: str, high: str) -> Lines:
    """Return the head of a loop over the obstacles. It sets `near` to whether the range between two
    positions may overlap the bounding box of the obstacle; ranges with NaN do not overlap."""
    return [
        "for w in range(wall_kind.size):",
        f"    if {low}x > edges[w, 2] or {high}x < edges[w, 0] or "
        f"{low}y > edges[w, 3] or {high}y < edges[w, 1]:",
        "        continue",
        "    near = 1",
    ]


def _places(kernel: KernelWriter, name: str) -> Lines:
    """Return lines for the reference position of particle j of a row."""
    pairs = zip(kernel.each("@"), kernel.places("s"), strict=True)
    return [f"{name}{axis} = {place}" for axis, place in pairs]
