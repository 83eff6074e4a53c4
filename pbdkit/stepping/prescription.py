"""What the leaders prescribe in a step, and for how many steps that stays so."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pbdkit.errors import ExperimentError
from pbdkit.experiment.newton import Newton
from pbdkit.interfaces.frame import Indices
from pbdkit.scene.leader_groups import Leading
from pbdkit.scene.obstacles import Barrier
from pbdkit.scene.scene import Scene
from pbdkit.stepping.newton_forces import NewtonForces
from pbdkit.stepping.state import Floats, State


class Placed(NamedTuple):
    """Particles that lead: their places, and their displacements u (axis, particle) along those
    axes."""

    place: Indices
    u: Floats
    axes: tuple[int, ...]


Led = list[Placed]
Starts = tuple[Floats | None, ...]


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
        raise ExperimentError(
            f"two groups move particle {raster.before + row + 1} differently in step {step}; "
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
