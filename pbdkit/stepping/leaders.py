"""Leaders: what they prescribe in a step, and what guided particles do along the other axes.

Clamped leaders prescribe their directions as they prescribe their places.

A rule's move is S⁻¹ · force for some 2 × 2 matrix S of the particle. Where a guided particle is
held along some axes l, and free along others f, the move along f that has no force there is

    m_f + S_ff⁻¹ S_fl m_l:

what the rule moves along l is what pushes at the guide. S is computed for calibrated rules; others
are taken at their word. On straight edges S_fl is zero, at corners and in cut cells it is not.

Forces on leaders that move by Newton's law are computed at their single places, by numpy in every
engine.
"""

from __future__ import annotations

import math
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
from pbdkit.stepping.contact import Contact, stiffnesses
from pbdkit.stepping.followers import SlotFollowers
from pbdkit.stepping.kernel import KernelWriter
from pbdkit.stepping.rule_evaluation import Evaluator, Surroundings
from pbdkit.stepping.state import State
from pbdkit.stepping.step import (
    PUSHED_BY_COURSES,
    Hindrance,
    Led,
    Mode,
    Operation,
    Placed,
    Starts,
    Step,
)


class Clamps:
    """Those of a scene, which may have none; `numbers` are the places of the numbers that they
    prescribe among those that are remembered."""

    def __init__(self, scene: Scene) -> None:
        self._leading = [leading for leading in scene.leading if leading.group.clamped]
        self._rotations = rotations_of(scene.experiment) if self._leading else ()
        self.numbers = tuple(m for rotation in self._rotations for m in rotation)

    def turn(self, state: State, step: int) -> Indices:
        """Turns the directions of those who are clamped in a step, in place, by what their motion
        turns in it; returns their flat places."""
        found = [np.zeros(0, np.intp)]
        for leading in self._leading:
            if leading.group.leads(step):
                fresh = np.setdiff1d(leading.place, np.concatenate(found))
                found.append(fresh)
                self._turn(state, fresh, _angle(leading, step))
        return np.concatenate(found)

    def turning(self, step: int) -> bool:
        """Whether anybody who is clamped in a step turns in it."""
        return any(_angle(each, step) != 0.0 for each in self._leading if each.group.leads(step))

    def directions(self, state: State) -> list[Array]:
        """Flat views of what they prescribe."""
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
    """By what a group's motion turns in a step."""
    motion, n_th = leading.group.motion, step - leading.group.from_ + 1
    return motion.turned(n_th) - motion.turned(n_th - 1)


STRAIGHT = 1e-12
"""Shares below this are rounding."""
Slants = dict[tuple[int, int], tuple[Indices, Floats]]
"""By (free axis, led axis): at these flat places, the share of the move along the one that adds to
the move along the other."""


class Guidance:
    """The guided particles of a scene, step by step; what is known stays as long as roles do."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self.some = has_guides(scene.leading)
        """Whether there are any."""
        self.slanted = self.some and material_of(scene.experiment.rule) is not None
        """Whether a move along one axis may add to that along another."""
        self._known: dict[tuple[bool, ...], tuple[Guided, Slants]] = {}

    def at(self, step: int) -> Guided:
        """Those of a step."""
        return self._at(step)[0]

    def slants(self, step: int) -> Slants:
        """Their shares, for every pair of axes."""
        return self._at(step)[1]

    def correct(self, new: Floats, u: Floats, step: int) -> None:
        """Adds, in place, to where the particles go from u."""
        if not self.slanted:
            return
        flat, here = new.reshape(len(new), -1), u.reshape(len(u), -1)
        for (to, of), (place, share) in self.slants(step).items():
            flat[to, place] = flat[to, place] + share * (flat[of, place] - here[of, place])

    def _at(self, step: int) -> tuple[Guided, Slants]:
        roles = tuple(leading.group.leads(step) for leading in self._scene.leading)
        if roles not in self._known:
            guided = guided_at(self._scene.raster, self._scene.leading, step)
            self._known[roles] = guided, self._slants_of(guided)
        return self._known[roles]

    def _slants_of(self, guided: Guided) -> Slants:
        shares = self.shares(guided)
        found = {}
        for to, of in np.ndindex(shares.shape[1:]):
            some = np.flatnonzero(np.abs(shares[:, to, of]) > STRAIGHT)
            if to != of:
                found[to, of] = guided.place[some], shares[some, to, of].astype(self._real)
        return found

    def shares(self, guided: Guided) -> Floats:
        """(particle, free axis, led axis): S_ff⁻¹ S_fl, zero elsewhere."""
        axes = self._scene.axes
        shares = np.zeros((len(guided.place), axes, axes))
        if not self.slanted or not len(guided.place):
            return shares
        pulls = stiffnesses(self._scene, guided.place)
        for pattern in np.unique(guided.lead_axes, axis=1).T:
            some = np.flatnonzero((pattern == guided.lead_axes.T).all(axis=1))
            f, of = np.flatnonzero(~pattern), np.flatnonzero(pattern)
            own, across = (pulls[np.ix_(some, f, axis)] for axis in (f, of))
            shares[np.ix_(some, f, of)] = np.linalg.pinv(own) @ across
        return shares

    @property
    def _real(self) -> str:
        return self._scene.experiment.stepping.precision


TURNS = 60
"""Of the power iteration that finds the stiffest way."""


class NewtonForces:
    """The forces on the particles of a scene's groups, by the group's number."""

    def __init__(self, scene: Scene) -> None:
        self._scene, self._evaluator = scene, Evaluator(scene)
        groups = enumerate(scene.leading)
        some = {n: each for n, each in groups if isinstance(each.group.motion, Newton)}
        self.numbers = tuple(some)
        """Of the groups that move so."""
        self._parts = {n: _parts(scene, each.place) for n, each in some.items()}
        self._contact = Contact(scene) if some and scene.barriers else None
        # A rule that works on the moves of another is asked everywhere.
        self._whole = SlotFollowers(scene) if some and scene.inner else None

    def share(self, n: int) -> Floats:
        """(particle,): of the force in all."""
        share = self._scene.leading[n].share
        assert share is not None
        return share

    def on(self, n: int, state: State) -> Floats:
        """(particle, axis), over Young's modulus and thickness."""
        place = self._scene.leading[n].place
        if self._whole:
            whole = self._whole.forces(state.u, state)
            return np.asarray(whole.reshape(len(whole), -1)[:, place].T, float)
        found = np.zeros((len(place), self._scene.axes))
        for some, around in self._parts[n]:
            total = around.sums(self._evaluator.contribution, state.u, state)
            force = self._evaluator.force(total, around.here(state.u, state))
            movable = True if around.movable is None else around.movable
            for axis, component in enumerate(force):
                found[some, axis] = np.where(movable, component, 0.0)
        return found

    def stopped(self, n: int, velocity: Floats, u: Floats, step: int) -> tuple[Floats, Floats]:
        """Return the velocities of a group's particles and their displacements at the end of a
        step, (axis, particle), out of the obstacles: what they go less they lose of their velocity,
        unless an obstacle appears where they are."""
        leading = self._scene.leading[n]
        if self._contact is None or len(leading.axes) < self._scene.axes:
            return velocity, u
        way = self._contact.ways_of_masses(u, leading.place, step)
        if not any(barrier.group.from_ == step for barrier in self._scene.barriers):
            velocity = velocity + way
        return velocity, u + way

    def stiffness(self, n: int, state: State, nudge: float) -> float:
        """By how much the force on the group grows, at most, for a unit way of its particles, along
        the axes along which they lead, others standing still."""
        leading, here = self._scene.leading[n], state.copy()
        flat, still, found = here.u.reshape(len(here.u), -1), self.on(n, state), 0.0
        way = np.random.default_rng(0).uniform(-1.0, 1.0, still.shape)
        for _ in range(TURNS):
            way[:, [a for a in range(self._scene.axes) if a not in leading.axes]] = 0.0
            way /= np.linalg.norm(way)
            flat[:, leading.place] += nudge * way.T
            pull = (still - self.on(n, here)) / nudge
            flat[:, leading.place] = state.u.reshape(len(flat), -1)[:, leading.place]
            found, way = float((way * pull).sum()), pull
            if not way.any():
                break
        return found


def _parts(scene: Scene, place: Indices) -> list[tuple[Indices, Surroundings]]:
    """By sublattice the numbers of its particles, with what is around them."""
    each = scene.raster.kind.size // len(scene.raster.kind)
    found = []
    for s in np.unique(place // each).tolist():
        some = np.flatnonzero(place // each == s)
        found.append((some, Surroundings(scene, Places(scene.raster.shape, place[some]), s)))
    return found


def prescribe(
    scene: Scene, state: State, moment: float, forces: NewtonForces | None = None
) -> tuple[Led, Starts]:
    """The leaders of a step with their displacements at its end, or at a moment within it, and
    where each motion has started; by Newton's law, with the forces at the end of the step before,
    the velocities reached."""
    led: Led = []
    starts: list[Floats | None] = []
    step = math.ceil(moment)
    for n, (leading, begun) in enumerate(zip(scene.leading, state.starts, strict=True)):
        if leading.group.leads(step) and forces and n in forces.numbers:
            begun, u = _pushed(scene, state, forces, n)
            led.append(Placed(leading.place, u, leading.axes))
        elif leading.group.leads(step):
            if begun is None:
                begun = state.u.reshape(scene.axes, -1)[:, leading.place].copy()
            n_th = moment - leading.group.from_ + 1
            motion, at = leading.group.motion, leading.reference
            offset = motion.offset(n_th, at if motion.of_reference else at + begun.T)
            u = (begun + np.atleast_2d(offset).T)[list(leading.axes)]
            led.append(Placed(leading.place, u, leading.axes))
        starts.append(begun)
    if scene.leaders_overlap and len(led) > 1:
        _refuse_contradiction(scene, led, step)
    return led, tuple(starts)


def _pushed(scene: Scene, state: State, forces: NewtonForces, n: int) -> tuple[Floats, Floats]:
    """The velocities of a group (axis, particle), and where they lead along its axes."""
    leading, velocity = scene.leading[n], state.starts[n]
    motion, axes = leading.group.motion, list(leading.axes)
    assert isinstance(motion, Newton)
    if velocity is None:
        velocity = np.outer(motion.velocity, np.ones(len(leading.place)))
    faster = motion.faster(state.step + 1, velocity.T, forces.on(n, state), forces.share(n)).T
    reached = np.zeros_like(faster)
    reached[axes] = faster[axes]
    here = state.u.reshape(scene.axes, -1)[:, leading.place]
    reached, u = forces.stopped(n, reached, here + reached, state.step + 1)
    return reached, u[axes]


def _refuse_contradiction(scene: Scene, led: Led, step: int) -> None:
    """What could not be known before: groups that move one particle differently from where it
    stands."""
    size = scene.raster.kind.size
    components = np.concatenate([a * size + at for at, _, axes in led for a in axes])
    u = np.concatenate([each.u.ravel() for each in led])
    order = np.argsort(components, kind="stable")
    apart = np.abs(np.diff(u[order])) > 1e-9 * max(1.0, np.abs(u).max())
    clashes = np.flatnonzero((np.diff(components[order]) == 0) & apart)
    if len(clashes):
        place = components[order[clashes]].min(keepdims=True) % size
        raster = scene.raster
        row = int(raster.rows_at(*np.unravel_index(place, raster.shape))[0])
        number = raster.particle_offset + row + 1
        raise ExperimentError(
            f"two groups move particle {number} differently in step {step}; "
            "select it in one of them only, or let one end before the other begins",
            ("leaders",),
        )


def steady_steps(scene: Scene, step: int, most: int, moving: bool = False) -> int:
    """How many steps from `step` on have the same leaders and obstacles at the same places, the
    same loads and numbers and no cut but those that the first begins with, at most `most`, at least
    1. Where leaders may be `moving`, they are elsewhere in every step, as is known beforehand."""
    most = min([most, *(cut.at - step for cut in scene.experiment.cuts if cut.at > step)])
    for leading in scene.driven:
        group = leading.group
        begins, ends = group.from_, group.last(step + most)
        if begins <= step <= ends:
            most = min(most, ends - step + 1)
            rests = group.motion.rests_after()
            known = moving and not isinstance(group.motion, Newton)
            if not known and (rests is None or step - begins + 1 < rests):
                return 1
        elif step < begins:
            most = min(most, begins - step)
    changes = [scene.loads.next_change(step)] if scene.loads else []
    changes += [course.next_change(step) for course in scene.experiment.courses.values()]
    return int(min([most, *(change - step for change in changes)]))


def last_event(scene: Scene) -> int:
    """The last step within the run at which leaders or obstacles move, roles, loads or numbers
    change or bonds are cut, at least 1."""
    steps, events = scene.experiment.steps, [1, *(cut.at for cut in scene.experiment.cuts)]
    events += scene.loads.changes(steps) if scene.loads else []
    events += bends_of(scene)
    for leading in scene.driven:
        first, last = leading.group.from_, leading.group.last(steps)
        if first <= steps:
            rests = leading.group.motion.rests_after() or 0
            events += [first, min(last, first - 1 + rests)]
            events += [last + 1] if last < steps else []
    return max(events)


def bends_of(scene: Scene) -> list[int]:
    """The moments within the run between which numbers and forces change evenly; its end is one
    where they still change there. The course of a load counts while the load acts."""
    steps, every = scene.experiment.steps, list(scene.experiment.courses.values())
    found = [bend for course in every for bend in course.bends_within(0, steps)]
    for load in scene.loads.each if scene.loads else ():
        begin, end = load.load.from_, load.load.last(steps)
        found += [bend for each in load.load.courses for bend in each.bends_within(begin, end)]
    return found


def is_cut_short(leading: Leading | Barrier, steps: int) -> bool:
    """Whether a group leads in the last step, and its motion is not over then."""
    rests = leading.group.motion.rests_after()
    over = rests is not None and leading.group.from_ - 1 + rests <= steps
    return leading.group.leads(steps) and not over


def place(u: Floats, led: Led) -> None:
    """Puts leaders where they are prescribed."""
    flat = u.reshape(len(u), -1)
    for places, values, axes in led:
        for axis, value in zip(axes, values, strict=True):
            flat[axis, places] = value


def placed(u: Floats, led: Led) -> Led:
    """Where the same particles stand, along the same axes."""
    flat = u.reshape(len(u), -1)
    return [Placed(at, np.array([flat[a, at] for a in axes]), axes) for at, _, axes in led]


def leader_lists(scene: Scene) -> dict[str, str]:
    """Return the lists of leaders in kernels by the ending of their names, with the axes along
    which they lead: one for all, or where some are guided one for each axis."""
    axes = "xyz"[: scene.axes]
    if not scene.leading:
        return {}
    return {f"_{c}": c for c in axes} if has_guides(scene.leading) else {"": axes}


class PlaceLeaders(Operation):
    """Put the leaders where they are prescribed: the intermediate configuration."""

    @cached_property
    def _forces(self) -> NewtonForces:
        return NewtonForces(self.scene)

    @classmethod
    def is_needed(cls, scene: Scene) -> bool:
        """Where there are leader groups."""
        return bool(scene.leading)

    def apply(self, step: Step) -> None:
        """Before anybody moves; where the leaders stood is noted."""
        step.led, step.starts = prescribe(self.scene, step.state, step.number, self._forces)
        step.stood = placed(step.u, step.led)
        place(step.u, step.led)

    def emit(self, kernel: KernelWriter) -> None:
        """The places are prescribed for as many steps as a call makes."""
        for end, axes in leader_lists(self.scene).items():
            if kernel.keeps_before:
                stood = kernel.each(f"led_kept{end}[#, e] = flat_u_@[led{end}[e]]", axes)
                kernel.listed(f"led{end}", *stood, ahead=True)
            put = kernel.each(f"flat_u_@[led{end}[e]] = held{end}[#, e]", axes)
            kernel.listed(f"led{end}", *put, ahead=True)

    def hindrance(self, mode: Mode) -> Hindrance | None:
        """Forces on masses are computed on the host, by numbers as they are in its arrays."""
        if not any(isinstance(leading.group.motion, Newton) for leading in self.scene.leading):
            return None
        reasons = {Mode.GPU: "leaders move by Newton's law", Mode.COURSES: PUSHED_BY_COURSES}
        return Hindrance(reasons[mode], "leaders") if mode in reasons else None


class GuideLeaders(Operation):
    """Put guided particles where they are prescribed after the step, too: along those axes they
    make no way that memory could carry on."""

    @classmethod
    def is_needed(cls, scene: Scene) -> bool:
        """Where particles may be guided."""
        return has_guides(scene.leading)

    def apply(self, step: Step) -> None:
        """In the displacements after the step."""
        place(step.new, step.led)

    def emit(self, kernel: KernelWriter) -> None:
        """The same."""
        for end, axes in leader_lists(self.scene).items():
            put = kernel.each(f"flat_v_@[led{end}[e]] = held{end}[#, e]", axes)
            kernel.listed(f"led{end}", *put)

    def hindrance(self, mode: Mode) -> Hindrance | None:
        """How particles give way is known for the numbers at the beginning."""
        reasons = {Mode.GPU: "leaders lead along an axis", Mode.COURSES: PUSHED_BY_COURSES}
        return Hindrance(reasons[mode], "leaders") if mode in reasons else None


class GuideToObstacles(GuideLeaders):
    """Put guided particles where obstacles find them."""

    @classmethod
    def is_needed(cls, scene: Scene) -> bool:
        """Where particles may be guided, and pushed."""
        return bool(scene.barriers) and super().is_needed(scene)


class TurnDirections(Operation):
    """Turn the directions of clamped leaders as their motions turn."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        self._clamps = Clamps(scene)

    @classmethod
    def is_needed(cls, scene: Scene) -> bool:
        """Where leaders are clamped."""
        return bool(Clamps(scene).numbers)

    def apply(self, step: Step) -> None:
        """Before particles move; what is prescribed is noted."""
        clamped = self._clamps.turn(step.state, step.number)
        values = self._clamps.directions(step.state)
        step.turned = [(value, clamped, value[clamped]) for value in values]

    def emit(self, kernel: KernelWriter) -> None:
        """Nothing: directions are turned before a call, and a call goes on while none turns."""

    def hindrance(self, mode: Mode) -> Hindrance | None:
        """Directions that are turned on the host are not sent to a GPU."""
        return Hindrance("leaders are clamped", "leaders") if mode is Mode.GPU else None


class HoldDirections(TurnDirections):
    """Let clamped leaders have the directions that they prescribe, whatever the rule makes of
    them."""

    def apply(self, step: Step) -> None:
        """After particles have moved."""
        for values, clamped, prescribed in step.turned:
            values[clamped] = prescribed

    def emit(self, kernel: KernelWriter) -> None:
        """They are those before the step."""
        lines = (f"flat_own{m}[clamped[e]] = flat_was{m}[clamped[e]]" for m in self._clamps.numbers)
        kernel.listed("clamped", *lines)


class CorrectGuided(Operation):
    """Add what guided particles make of the moves along the axes along which they lead."""

    makes_moves = True

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        self._guidance = Guidance(scene)

    @classmethod
    def is_needed(cls, scene: Scene) -> bool:
        """Where moves along one axis may add to those along another."""
        return Guidance(scene).slanted

    def apply(self, step: Step) -> None:
        """After particles have moved."""
        with np.errstate(all="ignore", invalid=step.invalid):
            self._guidance.correct(step.new, step.u, step.number)

    def emit(self, kernel: KernelWriter) -> None:
        """Pair of axes by pair of axes."""
        for to, of in permutations(kernel.each("@"), 2):
            way = f"(flat_v_{of}[p] - flat_u_{of}[p])"
            moved = f"flat_v_{to}[p] = flat_v_{to}[p] + share_{to}{of}[e] * {way}"
            kernel.listed(f"slant_{to}{of}", f"p = slant_{to}{of}[e]", moved)


class HoldLeaders(Operation):
    """Let the leaders be where they are prescribed, whatever the rule makes of them, and put back
    where they stood in the displacements before the step."""

    @classmethod
    def is_needed(cls, scene: Scene) -> bool:
        """Where there are leader groups."""
        return bool(scene.leading)

    def apply(self, step: Step) -> None:
        """After all particles have moved."""
        place(step.new, step.led)
        place(step.u, step.stood)

    def emit(self, kernel: KernelWriter) -> None:
        """After all particles have moved."""
        for end, axes in leader_lists(self.scene).items():
            lines = kernel.each(f"flat_v_@[led{end}[e]] = held{end}[#, e]", axes)
            if kernel.keeps_before:
                lines += kernel.each(f"flat_u_@[led{end}[e]] = led_kept{end}[#, e]", axes)
            kernel.listed(f"led{end}", *lines)
