"""Leaders in a step: their prescribed displacements and directions, and the free components of
guided particles.

The move of a rule is S⁻¹ · force, where S is a 2 × 2 matrix of the particle. If a guided particle
has prescribed motion along axes l and is free along axes f, its move along f is

    m_f + S_ff⁻¹ S_fl m_l.

This follows from S m = force, because the constraint along l exerts no force along f. S is computed
for calibrated rules; the moves of other rules are not corrected. S_fl is zero on straight edges,
and nonzero at corners and in cut cells.

Forces on leaders that move by Newton's law are computed by numpy, in every engine.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import permutations

import numpy as np

from pbdkit.array_types import Array, Floats, Indices
from pbdkit.errors import ExperimentError
from pbdkit.lattice.raster import Places
from pbdkit.model.motions import Newton
from pbdkit.plugin.rule import material_of
from pbdkit.scene.leader_groups import Guided, Leading, guided_at, has_guides, rotations_of
from pbdkit.scene.obstacles import Barrier
from pbdkit.scene.scene import Scene
from pbdkit.scene.selection import spacing
from pbdkit.stepping.contact import Contact, stiffnesses
from pbdkit.stepping.followers import SlotFollowers
from pbdkit.stepping.kernel import KernelWriter, Lines
from pbdkit.stepping.rule_evaluation import Evaluator, Surroundings
from pbdkit.stepping.state import State
from pbdkit.stepping.step import (
    PUSHED_BY_TIME_DEPENDENCE,
    Call,
    Cells,
    Entries,
    Hindrance,
    Leaders,
    Mode,
    Operation,
    Placed,
    Starts,
    Step,
)


class Clamps:
    """Clamped leaders of a scene.

    Attributes
    ----------
    numbers
        Indices of the state variables that store the components of the prescribed directions.
    """

    def __init__(self, scene: Scene) -> None:
        self._leading = [leading for leading in scene.leading if leading.group.clamped]
        self._rotations = rotations_of(scene.experiment) if self._leading else ()
        self.numbers = tuple(m for rotation in self._rotations for m in rotation)

    def turn(self, state: State, step: int) -> Indices:
        """Turn the directions of clamped leaders in place by the rotation of their motions in a
        step, and return their flat places. A particle that belongs to several groups is turned by
        the first of them."""
        places = [np.zeros(0, np.intp)]
        for leading in self._leading:
            if leading.group.leads(step):
                place = np.setdiff1d(leading.place, np.concatenate(places))
                places.append(place)
                self._turn(state, place, _angle(leading, step))
        return np.concatenate(places)

    def turning(self, step: int) -> bool:
        """Return whether the motion of any group of clamped leaders rotates in a step."""
        return any(_angle(each, step) != 0.0 for each in self._leading if each.group.leads(step))

    def directions(self, state: State) -> list[Array]:
        """Return flat views of the state variables that clamped leaders prescribe."""
        return [state.particle_values[m].reshape(-1) for m in self.numbers]

    def _turn(self, state: State, place: Indices, angle: float) -> None:
        if angle == 0.0:
            return
        c, s = math.cos(angle), math.sin(angle)
        flat = self.directions(state)
        for cosine, sine in zip(flat[::2], flat[1::2], strict=True):
            x, y = cosine[place], sine[place]
            cosine[place], sine[place] = c * x - s * y, s * x + c * y


def _angle(leading: Leading, step: int) -> float:
    """Return the rotation of a group's motion in a step."""
    motion, n_th = leading.group.motion, step - leading.group.from_ + 1
    return motion.turned(n_th) - motion.turned(n_th - 1)


STRAIGHT = 1e-12
"""S_ff⁻¹ S_fl is treated as zero up to this magnitude."""
Slants = dict[tuple[int, int], tuple[Indices, Floats]]
"""Type of a table by (free axis, led axis). An entry contains flat places of guided particles and a
factor for each: the move of the particle along the led axis, times the factor, is added to its move
along the free axis."""


class Guidance:
    """Guided particles of a scene in each step. They are computed once for each set of groups that
    act.

    Attributes
    ----------
    has_guides
        Whether particles may be guided.
    slanted
        Whether a prescribed move along one axis may contribute to the free move along another axis.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self.has_guides = has_guides(scene.leading)
        self.slanted = self.has_guides and material_of(scene.experiment.rule) is not None
        self._cache: dict[tuple[bool, ...], tuple[Guided, Floats, Slants]] = {}

    def at(self, step: int) -> Guided:
        """Return the guided particles of a step."""
        return self._at(step)[0]

    def shares(self, step: int) -> Floats:
        """Return an array of shape (particle, axis, axis). It contains S_ff⁻¹ S_fl for the pairs of
        a free axis f and a led axis l, and zero for all other pairs of axes."""
        return self._at(step)[1]

    def slants(self, step: int) -> Slants:
        """Return the factors by which the free moves of guided particles are corrected, for each
        pair of axes."""
        return self._at(step)[2]

    def correct(self, new: Floats, u: Floats, step: int) -> None:
        """Correct the displacements `new` of guided particles along free axes, in place. The moves
        from u to `new` along led axes are multiplied by the factors and added to the displacements
        along free axes."""
        if not self.slanted:
            return
        flat, origin = new.reshape(len(new), -1), u.reshape(len(u), -1)
        for (to, of), (place, share) in self.slants(step).items():
            flat[to, place] = flat[to, place] + share * (flat[of, place] - origin[of, place])

    def _at(self, step: int) -> tuple[Guided, Floats, Slants]:
        roles = tuple(leading.group.leads(step) for leading in self._scene.leading)
        if roles not in self._cache:
            guided = guided_at(self._scene.raster, self._scene.leading, step)
            shares = self._shares_of(guided)
            self._cache[roles] = guided, shares, self._slants_of(guided, shares)
        return self._cache[roles]

    def _slants_of(self, guided: Guided, shares: Floats) -> Slants:
        slants = {}
        for to, of in np.ndindex(shares.shape[1:]):
            rows = np.flatnonzero(np.abs(shares[:, to, of]) > STRAIGHT)
            if to != of:
                slants[to, of] = guided.place[rows], shares[rows, to, of].astype(self._real)
        return slants

    def _shares_of(self, guided: Guided) -> Floats:
        axes = self._scene.axes
        shares = np.zeros((len(guided.place), axes, axes))
        if not self.slanted or not len(guided.place):
            return shares
        S = stiffnesses(self._scene, guided.place)
        for pattern in np.unique(guided.lead_axes, axis=1).T:
            rows = np.flatnonzero((pattern == guided.lead_axes.T).all(axis=1))
            f, of = np.flatnonzero(~pattern), np.flatnonzero(pattern)
            S_ff, S_fl = (S[np.ix_(rows, f, axis)] for axis in (f, of))
            shares[np.ix_(rows, f, of)] = np.linalg.pinv(S_ff) @ S_fl
        return shares

    @property
    def _real(self) -> str:
        return self._scene.experiment.stepping.precision


MAX_ITERATIONS = 60
"""Maximum number of iterations of the power method that computes the largest stiffness."""


class NewtonForces:
    """Forces on the particles of groups that move by Newton's law.

    Attributes
    ----------
    numbers
        Indices of the groups that move by Newton's law.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene, self._evaluator = scene, Evaluator(scene)
        groups = enumerate(scene.leading)
        masses = {n: each for n, each in groups if isinstance(each.group.motion, Newton)}
        self.numbers = tuple(masses)
        self._parts = {n: _parts(scene, each.place) for n, each in masses.items()}
        self._contact = Contact(scene) if masses and scene.barriers else None
        # If a rule has an inner rule, it is evaluated at all particles of the scene.
        self._followers = SlotFollowers(scene) if masses and scene.inner else None

    def share(self, n: int) -> Floats:
        """Return the fraction of each particle's force that acts on a group, (particle,)."""
        share = self._scene.leading[n].share
        assert share is not None
        return share

    def on(self, n: int, state: State) -> Floats:
        """Return the forces on a group divided by Young's modulus and thickness, (particle,
        axis)."""
        place = self._scene.leading[n].place
        if self._followers:
            forces = self._followers.forces(state.u, state)
            return np.asarray(forces.reshape(len(forces), -1)[:, place].T, float)
        forces = np.zeros((len(place), self._scene.axes))
        for rows, around in self._parts[n]:
            total = around.total(self._evaluator, state.u, state)
            force = self._evaluator.force(total, around.here(state.u, state))
            movable = True if around.movable is None else around.movable
            for axis, component in enumerate(force):
                forces[rows, axis] = np.where(movable, component, 0.0)
        return forces

    def stopped(self, n: int, velocity: Floats, u: Floats, step: int) -> tuple[Floats, Floats]:
        """Return the velocities and displacements of shape (axis, particle) of a group's particles
        after obstacles have pushed them out at the end of a step. The displacement by the obstacles
        is also added to the velocity, unless an obstacle appears in that step."""
        leading = self._scene.leading[n]
        if self._contact is None or len(leading.axes) < self._scene.axes:
            return velocity, u
        push = self._contact.corrections_of_masses(u, leading.place, step)
        if not any(barrier.group.from_ == step for barrier in self._scene.barriers):
            velocity = velocity + push
        return velocity, u + push

    def stiffness(self, n: int, state: State, nudge: float) -> float:
        """Return the largest increase of the force on the group for a unit displacement of its
        particles along their led axes, while all other particles stay."""
        leading, copy = self._scene.leading[n], state.copy()
        flat, force, largest = copy.u.reshape(len(copy.u), -1), self.on(n, state), 0.0
        move = np.random.default_rng(0).uniform(-1.0, 1.0, force.shape)
        for _ in range(MAX_ITERATIONS):
            move[:, [a for a in range(self._scene.axes) if a not in leading.axes]] = 0.0
            move /= np.linalg.norm(move)
            flat[:, leading.place] += nudge * move.T
            pull = (force - self.on(n, copy)) / nudge
            flat[:, leading.place] = state.u.reshape(len(flat), -1)[:, leading.place]
            largest, move = float((move * pull).sum()), pull
            if not move.any():
                break
        return largest


def _parts(scene: Scene, place: Indices) -> list[tuple[Indices, Surroundings]]:
    """Return for each sublattice the indices of its particles among `place`, and the particles with
    their neighbours."""
    size = scene.raster.kind.size // len(scene.raster.kind)
    parts = []
    for s in np.unique(place // size).tolist():
        rows = np.flatnonzero(place // size == s)
        parts.append((rows, Surroundings(scene, Places(scene.raster.shape, place[rows]), s)))
    return parts


def prescribe(
    scene: Scene, state: State, moment: float, forces: NewtonForces | None = None
) -> tuple[Leaders, Starts]:
    """Return the leaders of a step with their displacements at its end, or at a moment within it,
    and the starts of the motions of all groups.

    The start of a motion is the displacement of the particles when the group began to act. For a
    group that moves by Newton's law it is replaced by the velocity, which is computed with the
    forces at the end of the previous step.
    """
    leaders: Leaders = []
    starts: list[Floats | None] = []
    step = math.ceil(moment)
    for n, (leading, start) in enumerate(zip(scene.leading, state.starts, strict=True)):
        if leading.group.leads(step) and forces and n in forces.numbers:
            start, u = _pushed(scene, state, forces, n)
            leaders.append(Placed(leading.place, u, leading.axes))
        elif leading.group.leads(step):
            if start is None:
                start = state.u.reshape(scene.axes, -1)[:, leading.place].copy()
            n_th = moment - leading.group.from_ + 1
            motion, at = leading.group.motion, leading.reference
            offset = motion.offset(n_th, at if motion.of_reference else at + start.T)
            u = (start + np.atleast_2d(offset).T)[list(leading.axes)]
            leaders.append(Placed(leading.place, u, leading.axes))
        starts.append(start)
    if scene.leaders_overlap and len(leaders) > 1:
        _refuse_contradiction(scene, leaders, step)
    return leaders, tuple(starts)


def _pushed(scene: Scene, state: State, forces: NewtonForces, n: int) -> tuple[Floats, Floats]:
    """Return the velocities of a group, as an array of shape (axis, particle), and its
    displacements along its axes."""
    leading, velocity = scene.leading[n], state.starts[n]
    motion, axes = leading.group.motion, list(leading.axes)
    assert isinstance(motion, Newton)
    if velocity is None:
        velocity = np.outer(motion.velocity, np.ones(len(leading.place)))
    faster = motion.faster(state.step + 1, velocity.T, forces.on(n, state), forces.share(n)).T
    velocity = np.zeros_like(faster)
    velocity[axes] = faster[axes]
    origin = state.u.reshape(scene.axes, -1)[:, leading.place]
    velocity, u = forces.stopped(n, velocity, origin + velocity, state.step + 1)
    return velocity, u[axes]


def _refuse_contradiction(scene: Scene, leaders: Leaders, step: int) -> None:
    """Raise ExperimentError if groups prescribe different displacements of one particle. Motions
    that start from the displacements of the state can be checked only during the run."""
    size = scene.raster.kind.size
    components = np.concatenate([a * size + at for at, _, axes in leaders for a in axes])
    u = np.concatenate([each.u.ravel() for each in leaders])
    order = np.argsort(components, kind="stable")
    largest = max(spacing(scene.raster), np.abs(u).max())
    differs = np.abs(np.diff(u[order])) > 1e-9 * largest
    clashes = np.flatnonzero((np.diff(components[order]) == 0) & differs)
    if len(clashes):
        place = components[order[clashes]].min(keepdims=True) % size
        raster = scene.raster
        row = int(raster.rows_at(*np.unravel_index(place, raster.shape))[0])
        number = raster.particle_offset + row + 1
        raise ExperimentError(
            f"two groups move particle {number} differently in step {step}; "
            "select it in one of them only, or end one before the other begins",
            ("leaders",),
        )


def is_cut_short(leading: Leading | Barrier, steps: int) -> bool:
    """Return whether the last of `steps` steps lies before the end of a group's motion."""
    rests = leading.group.motion.rests_after()
    has_ended = rests is not None and leading.group.from_ - 1 + rests <= steps
    return leading.group.leads(steps) and not has_ended


def place(u: Floats, leaders: Leaders) -> None:
    """Set the displacements of leaders to the prescribed values, in place."""
    flat = u.reshape(len(u), -1)
    for places, values, axes in leaders:
        for axis, value in zip(axes, values, strict=True):
            flat[axis, places] = value


def placed(u: Floats, leaders: Leaders) -> Leaders:
    """Return the leaders at the same places and along the same axes, with the displacements of u at
    these places."""
    flat = u.reshape(len(u), -1)
    return [Placed(at, np.array([flat[a, at] for a in axes]), axes) for at, _, axes in leaders]


class LeaderOperation(Operation):
    """Base class of operations on leaders.

    A kernel has a single list of leaders or, if particles may be guided, a list for each axis. The
    names of these lists differ in their endings.
    """

    @classmethod
    def is_needed(cls, scene: Scene) -> bool:
        """Return whether there are leader groups."""
        return bool(scene.leading)

    @property
    def endings(self) -> dict[str, str]:
        """Endings of the names of the lists of leaders. To each ending belong the axes along which
        the particles of the list are led."""
        axes = "xyz"[: self.scene.axes]
        return {f"_{c}": c for c in axes} if has_guides(self.scene.leading) else {"": axes}


class PlaceLeaders(LeaderOperation):
    """Place the leaders at their prescribed displacements. The result is the intermediate
    configuration."""

    @cached_property
    def _forces(self) -> NewtonForces:
        return NewtonForces(self.scene)

    def apply(self, step: Step) -> None:
        """Place the leaders before particles move, and keep their displacements before the step."""
        step.leaders, step.starts = prescribe(self.scene, step.state, step.number, self._forces)
        step.origins = placed(step.u, step.leaders)
        place(step.u, step.leaders)

    def emit(self, kernel: KernelWriter) -> None:
        """Write a loop that places the leaders from the arrays of the call."""
        for end, axes in self.endings.items():
            if kernel.keeps_before:
                lines = kernel.each(f"origins{end}[#, e] = flat_u_@[leaders{end}[e]]", axes)
                kernel.listed(f"leaders{end}", *lines, ahead=True)
            lines = kernel.each(f"flat_u_@[leaders{end}[e]] = target{end}[#, e]", axes)
            kernel.listed(f"leaders{end}", *lines, ahead=True)

    def opening(self, step: str) -> Lines:
        """Return lines for the prescribed displacements of the step."""
        return [
            f"target{end} = targets{end}[min({step}, targets{end}.shape[0] - 1)]"
            for end in self.endings
        ]

    def end_pass(self, kernel: KernelWriter) -> None:
        """Write lines that place the leaders as prescribed in the last step but one, because the
        displacements in that step are read after the pass."""
        for end, axes in self.endings.items():
            lines = kernel.each(f"flat_v_@[leaders{end}[e]] = target{end}[#, e]", axes)
            kernel.listed(f"leaders{end}", *lines)

    def reads(self, state: State) -> bool:
        """Return whether a motion begins in the next step, because its start is then read from the
        state."""
        groups = zip(self.scene.leading, state.starts, strict=True)
        return any(begin is None and each.group.leads(state.step + 1) for each, begin in groups)

    def prepare(self, call: Call) -> None:
        """Compute the prescribed displacements and the starts of motions."""
        leaders, call.starts = prescribe(self.scene, call.state, call.step, self._forces)
        call.leaders, call.state = [leaders], replace(call.state, starts=call.starts)

    def can_precompute(self, step: int) -> bool:
        """Return whether no particle belongs to two groups. Otherwise displacements are not
        computed in advance, so that a contradiction is reported in the step in which it occurs."""
        return not self.scene.leaders_overlap

    def precompute(self, call: Call, step: int) -> None:
        """Compute the prescribed displacements in a later step."""
        call.leaders.append(prescribe(self.scene, call.state, step)[0])

    def entries(self, call: Call) -> dict[str, Entries]:
        """Return for each list its leaders, their prescribed displacements (step, axis, leader),
        and an array for their displacements before the step."""
        lists, real = {}, call.state.u.dtype
        for end, names in self.endings.items():
            axes = tuple("xyz".index(name) for name in names)
            at, u = _along(axes, call.leaders)
            if self.scene.leaders_overlap:  # The last group of a particle places it.
                last = len(at) - 1 - np.unique(at[::-1], return_index=True)[1]
                at, u = at[np.sort(last)], u[..., np.sort(last)]
            u = np.asarray(u, real)
            values = {f"targets{end}": u, f"origins{end}": np.empty(u.shape[1:], real)}
            lists[f"leaders{end}"] = Entries(at, values)
        return lists

    def disturbances(self, call: Call) -> Iterator[Cells]:
        """Generate the cells of leaders with nonzero displacements."""
        for leaders in call.leaders:
            for at, u, _ in leaders:
                moved = at[(u != 0.0).any(axis=0)]
                yield np.unravel_index(moved, self.scene.raster.shape)[1:]

    def fixed_places(self) -> Indices:
        """Return the places of all leaders, which may be out of equilibrium."""
        return np.concatenate([leading.place for leading in self.scene.leading])

    def sweeps(self) -> int:
        """Return 1 if groups move by Newton's law, because the forces on them are evaluated before
        particles move."""
        return int(any(leading.share is not None for leading in self.scene.leading))

    def next_change(self, step: int, precomputable: bool = False) -> float:
        """Return the next step in which any group changes."""
        return min(each.group.next_change(step, precomputable) for each in self.scene.leading)

    def events(self, steps: int) -> list[int]:
        """Return the events of all groups."""
        return [at for each in self.scene.leading for at in each.group.events(steps)]

    def hindrance(self, mode: Mode) -> Hindrance | None:
        """Return the reason why groups that move by Newton's law do not support a mode. The forces
        on them are computed on the host and from state variables that are on the host."""
        if not any(isinstance(leading.group.motion, Newton) for leading in self.scene.leading):
            return None
        reasons = {
            Mode.GPU: "leaders move by Newton's law",
            Mode.TIME_DEPENDENT: PUSHED_BY_TIME_DEPENDENCE,
        }
        return Hindrance(reasons[mode], "leaders") if mode in reasons else None


def _along(axes: tuple[int, ...], steps: Sequence[Leaders]) -> tuple[Indices, Floats]:
    """Return the places of the particles that are led along all of `axes`, and their prescribed
    displacements, (step, axis, leader)."""

    def along(each: Placed) -> Floats:
        return each.u if each.axes == axes else each.u[[each.axes.index(a) for a in axes]]

    lists = [[each for each in leaders if set(axes).issubset(each.axes)] for leaders in steps]
    at = np.concatenate([np.empty(0, np.intp), *(each.place for each in lists[0])])
    empty = np.empty((len(axes), 0))
    return at, np.array([np.concatenate([empty, *map(along, each)], axis=1) for each in lists])


class GuideLeaders(LeaderOperation):
    """Set the new displacements of guided particles along their led axes to the prescribed ones.
    Momentum then does not change them along these axes."""

    @classmethod
    def is_needed(cls, scene: Scene) -> bool:
        """Return whether particles may be guided."""
        return has_guides(scene.leading)

    def apply(self, step: Step) -> None:
        """Set the prescribed components of the displacements after the step."""
        place(step.new, step.leaders)

    def emit(self, kernel: KernelWriter) -> None:
        """Write a loop that places the guided particles."""
        for end, axes in self.endings.items():
            lines = kernel.each(f"flat_v_@[leaders{end}[e]] = target{end}[#, e]", axes)
            kernel.listed(f"leaders{end}", *lines)

    def hindrance(self, mode: Mode) -> Hindrance | None:
        """Return the reason why leaders along an axis do not support a mode. Kernels do not support
        them if parameters change in time, because the response of particles is computed once, from
        initial values."""
        reasons = {
            Mode.GPU: "leaders lead along an axis",
            Mode.TIME_DEPENDENT: PUSHED_BY_TIME_DEPENDENCE,
        }
        return Hindrance(reasons[mode], "leaders") if mode in reasons else None


class GuideToObstacles(GuideLeaders):
    """Place guided particles along their led axes before obstacles push the particles out."""

    @classmethod
    def is_needed(cls, scene: Scene) -> bool:
        """Return whether particles may be guided and the scene has obstacles."""
        return bool(scene.barriers) and super().is_needed(scene)


class DirectionOperation(Operation):
    """Base class of operations on the directions of clamped leaders."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        self._clamps = Clamps(scene)

    @classmethod
    def is_needed(cls, scene: Scene) -> bool:
        """Return whether leaders are clamped."""
        return bool(Clamps(scene).numbers)


class TurnDirections(DirectionOperation):
    """Rotate the directions of clamped leaders with their motions."""

    def apply(self, step: Step) -> None:
        """Rotate the directions before particles move, and keep the prescribed values."""
        places = self._clamps.turn(step.state, step.number)
        values = self._clamps.directions(step.state)
        step.directions = [(value, places, value[places]) for value in values]

    def emit(self, kernel: KernelWriter) -> None:
        """Write no lines. A call of the kernel makes several steps, and only in the first of them
        may directions rotate. They are rotated on the host before the call."""

    def prepare(self, call: Call) -> None:
        """Rotate the directions in the first step of a call."""
        call.clamps = self._clamps.turn(call.state, call.step)

    def can_precompute(self, step: int) -> bool:
        """Return whether no direction rotates in the step."""
        return not self._clamps.turning(step)

    def hindrance(self, mode: Mode) -> Hindrance | None:
        """Return a reason if directions rotate, because directions that change on the host are not
        copied to the GPU."""
        return Hindrance("leaders are clamped", "leaders") if mode is Mode.GPU else None


class HoldDirections(DirectionOperation):
    """Restore the prescribed directions of clamped leaders after the rule has changed them."""

    def apply(self, step: Step) -> None:
        """Restore the directions after particles have moved."""
        for values, places, prescribed in step.directions:
            values[places] = prescribed

    def emit(self, kernel: KernelWriter) -> None:
        """Write a loop that restores the directions."""
        numbers = self.prescribed_numbers()
        lines = (f"flat_own{m}[clamps[e]] = flat_was{m}[clamps[e]]" for m in numbers)
        kernel.listed("clamps", *lines)

    def entries(self, call: Call) -> dict[str, Entries]:
        """Return the clamped leaders."""
        return {"clamps": Entries(call.clamps, {})}

    def prescribed_numbers(self) -> tuple[int, ...]:
        """Return the indices of the state variables that are components of directions."""
        return self._clamps.numbers


class CorrectGuided(Operation):
    """Correct the moves of guided particles. The prescribed component of a move has an effect on
    the free component, which is added."""

    makes_moves = True

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        self._guidance = Guidance(scene)

    @classmethod
    def is_needed(cls, scene: Scene) -> bool:
        """Return whether a prescribed move along one axis may contribute to the free move along
        another axis."""
        return Guidance(scene).slanted

    def apply(self, step: Step) -> None:
        """Add the correction after particles have moved."""
        with np.errstate(all="ignore", invalid=step.invalid):
            self._guidance.correct(step.new, step.u, step.number)

    def emit(self, kernel: KernelWriter) -> None:
        """Write a loop for each pair of axes."""
        for to, of in permutations(kernel.each("@"), 2):
            move = f"(flat_v_{of}[p] - flat_u_{of}[p])"
            line = f"flat_v_{to}[p] = flat_v_{to}[p] + share_{to}{of}[e] * {move}"
            kernel.listed(f"slant_{to}{of}", f"p = slant_{to}{of}[e]", line)

    def entries(self, call: Call) -> dict[str, Entries]:
        """Return the guided particles with nonzero factors, for each pair of axes."""
        slants, real = (
            self._guidance.slants(call.step) if call.leaders[0] else {},
            call.state.u.dtype,
        )
        lists = {}
        for to, of in permutations(range(self.scene.axes), 2):
            place, share = slants.get((to, of), (np.empty(0, np.intp), np.empty(0, real)))
            name = "xyz"[to] + "xyz"[of]
            lists[f"slant_{name}"] = Entries(place, {f"share_{name}": share})
        return lists


class HoldLeaders(LeaderOperation):
    """Place the leaders again after the rule has moved them. Also restore the displacements that
    they had before the step, since `PlaceLeaders` has overwritten them."""

    def apply(self, step: Step) -> None:
        """Place the leaders, and restore their displacements before the step, after all particles
        have moved."""
        place(step.new, step.leaders)
        place(step.u, step.origins)

    def emit(self, kernel: KernelWriter) -> None:
        """Write loops that place the leaders and restore their displacements before the step."""
        for end, axes in self.endings.items():
            lines = kernel.each(f"flat_v_@[leaders{end}[e]] = target{end}[#, e]", axes)
            if kernel.keeps_before:
                lines += kernel.each(f"flat_u_@[leaders{end}[e]] = origins{end}[#, e]", axes)
            kernel.listed(f"leaders{end}", *lines)
