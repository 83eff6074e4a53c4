"""Program of a scene: the operations of a step, in their order."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain

from pbdkit.scene.scene import Scene
from pbdkit.stepping.bond_breaking import BreakBonds, CutBonds
from pbdkit.stepping.contact import PushOut
from pbdkit.stepping.followers import MoveFollowers
from pbdkit.stepping.frame_following import FollowFrame
from pbdkit.stepping.leaders import (
    CorrectGuided,
    GuideLeaders,
    GuideToObstacles,
    HoldDirections,
    HoldLeaders,
    PlaceLeaders,
    TurnDirections,
)
from pbdkit.stepping.particle_operation import OperateOnParticles
from pbdkit.stepping.state import State
from pbdkit.stepping.step import Call, Hindrance, Mode, Operation, Reach

Program = tuple[Operation, ...]
"""Type of the operations of a step, in their order."""
ORDER: tuple[type[Operation], ...] = (
    CutBonds,
    PlaceLeaders,
    BreakBonds,
    TurnDirections,
    GuideLeaders,
    MoveFollowers,
    HoldDirections,
    CorrectGuided,
    OperateOnParticles,
    GuideToObstacles,
    PushOut,
    HoldLeaders,
    FollowFrame,
)
"""Types of operations in the order of a step. The order is defined only here."""
MAX_PRECOMPUTED = 64
"""Maximum number of steps for which the displacements of leaders are computed in advance."""
MAX_VALUES = 2**20
"""Maximum number of values of displacements that are computed in advance."""


def program_of(
    scene: Scene,
    sweep: MoveFollowers | None = None,
    kinds: Iterable[type[Operation]] = ORDER,
) -> Program:
    """Return the operations that a scene needs, in the order of a step. A given `sweep` is used as
    the operation that moves the followers."""
    operations: list[Operation] = []
    for kind in kinds:
        operations += [sweep] if sweep and kind is MoveFollowers else kind.of(scene)
    return tuple(operations)


def prepare(program: Program, state: State) -> Call:
    """Return the data with which a kernel is called to make the step after a state."""
    call = Call(state)
    for operation in program:
        operation.prepare(call)
    return call


def precompute_steps(program: Program, call: Call, end: int) -> int:
    """Prepare a call for further steps, up to `end`, as long as they need no other work on the
    host. Return the number of steps of the call."""
    step, limit = call.step, end - call.state.step
    steady = steady_steps(program, step, limit)
    if steady > 1:
        return steady
    values = sum(leaders.u.size for leaders in call.leaders[0])
    limit = min(steady_steps(program, step, limit, precomputable=True), MAX_PRECOMPUTED)
    for later in range(step + 1, step + min(limit, max(1, MAX_VALUES // max(1, values)))):
        if not all(operation.can_precompute(later) for operation in program):
            break
        for operation in program:
            operation.precompute(call, later)
    return len(call.leaders)


def reach_of(scene: Scene, axis: int) -> Reach:
    """Return the largest distances along an axis over which operations read values that other
    operations write."""
    distances = (operation.reach(axis) for operation in program_of(scene))
    return Reach(*map(max, zip(Reach(), *distances, strict=True)))


def steady_steps(program: Program, step: int, max_steps: int, precomputable: bool = False) -> int:
    """Return the number of equal steps from `step` on, from 1 to `max_steps`. Steps are equal if
    leaders and obstacles do not move, loads and parameters are constant, and no bonds are cut
    except at the beginning of the first step.

    With `precomputable`, steps also count as equal if leaders have motions that can be computed in
    advance.
    """
    change = min(operation.next_change(step, precomputable) for operation in program)
    return int(min(max_steps, change - step))


def last_event(scene: Scene) -> int:
    """Return the last step of the run, at least 1, in which something changes: leaders or obstacles
    move, roles, loads or parameters change, or bonds are cut."""
    events = (operation.events(scene.experiment.steps) for operation in program_of(scene))
    return max([1, *chain(*events), *breakpoints_of(scene)])


def breakpoints_of(scene: Scene) -> list[int]:
    """Return the steps between which parameters and forces are linear functions of the step. The
    last step of the run is included if parameters or forces still change at it. The steps at which
    the slope of a load changes are included only while the load acts."""
    breakpoints = (operation.breakpoints(scene.experiment.steps) for operation in program_of(scene))
    return [*chain(*breakpoints)]


def moves_of(scene: Scene, sweep: MoveFollowers) -> Program:
    """Return the operations that make the moves of a scene's particles, in the order of a step."""
    return program_of(scene, sweep, [kind for kind in ORDER if kind.makes_moves])


def hindrance(scene: Scene, mode: Mode) -> Hindrance | None:
    """Return the first reason why the steps of a scene do not support a mode; None if they do."""
    reasons = (operation.hindrance(mode) for operation in program_of(scene))
    return next(filter(None, reasons), None)


def reason_against(scene: Scene, mode: Mode) -> str:
    """Return the reason of `hindrance` as text; the text is empty if there is none."""
    reason = hindrance(scene, mode)
    return reason.reason if reason else ""
