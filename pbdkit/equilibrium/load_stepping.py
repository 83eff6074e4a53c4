"""Load stepping from the initial state of a scene to the equilibrium of its last step.

The load is divided into increments if bonds can break or rules are not linear. In each increment
the body is moved to equilibrium and bonds that are too long break; both are repeated until no bond
changes. A moment is a time in steps; since increments may end within a step, it need not be an
integer.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from pbdkit.equilibrium.error_bound import (
    ErrorBound,
    RoundingError,
    UnconvergedError,
    broken_bonds,
    scale_of,
    spacing_of,
)
from pbdkit.equilibrium.newton import Finder, follow_contact
from pbdkit.equilibrium.system import ALL, NoEquilibriumError, Rows
from pbdkit.errors import ExperimentError
from pbdkit.linear.operator import step_operator
from pbdkit.linear.spectrum import TooExpensiveError, excess, spectrum
from pbdkit.progress import StoppedError, Watch
from pbdkit.scene.scene import Scene
from pbdkit.stepping.bond_breaking import Fracturing
from pbdkit.stepping.divergence import Guard, largest_displacement, largest_offset, size_of
from pbdkit.stepping.engine_choice import chosen_engine, obstacle
from pbdkit.stepping.leaders import place, prescribe
from pbdkit.stepping.program import breakpoints_of, last_event
from pbdkit.stepping.state import State, cut_bonds, initial_state


def finder_of(
    scene: Scene,
    start: State,
    watch: Watch | None = None,
    *,
    compiles: bool = True,
    rows: Rows = ALL,
) -> Finder:
    """Return a `Finder`, which searches for the equilibria of a scene, starting from its initial
    state. `compiles` should be false for the first of many scenes with different parameters,
    because compiling the moves of each of them takes more time than it saves."""
    settings, scale = scene.experiment.solver.equilibrium, scale_of(scene, start, rows)
    length = settings.tolerance * scale
    return Finder(scene, length, scale, settings.method, watch or Watch(), compiles, rows)


SAMPLES = 16
"""Number of straight parts by which the path of a leader in an interval is approximated."""


def events(scene: Scene) -> list[int]:
    """Return the steps at which the loading changes its form, from 0 to the last change of the
    load. Between two successive ones each leader moves according to a single formula, no role
    changes, no bond is cut, and loads and parameters are linear functions of the step."""
    steps, last = scene.experiment.steps, last_event(scene)
    steps_of_events = {
        0,
        last,
        *breakpoints_of(scene),
        *(cut.at - 1 for cut in scene.experiment.cuts),
    }
    for change in scene.loads.changes(steps) if scene.loads else ():
        steps_of_events |= {change - 1, change}
    for leading in scene.driven:
        group = leading.group
        end = group.last(steps)
        knots = (group.from_ - 1 + n for n in group.motion.knots())
        steps_of_events |= {group.from_ - 1, end, *(knot for knot in knots if knot <= end)}
    return sorted(moment for moment in steps_of_events if 0 <= moment <= last)


def moments(scene: Scene, count: int) -> list[float]:
    """Return the ends of about `count` increments, and all events.

    In each increment the leaders move by about the same length, or loads and parameters change by
    about the same amount, whichever requires more increments. An increment consists of whole steps,
    or a step of whole increments; an interval without motion is one increment.
    """
    ends = events(scene)
    intervals = list(pairwise(ends)) or [(0, ends[-1])]
    shares, ends_of_increments = (
        _in_parts(count, [_path_length(scene, *i) for i in intervals]),
        list[float](),
    )
    measures = [number.relative_change for number in scene.experiment.time_dependent.values()]
    for measure in [*measures, *([scene.loads.relative_change] if scene.loads else [])]:
        shares = list(map(max, shares, _in_parts(count, [measure(*i) for i in intervals])))
    for (begin, end), parts in zip(intervals, shares, strict=True):
        a_step = round(parts / (end - begin))
        if a_step > 0:
            ends_of_increments += [begin + (n + 1) / a_step for n in range(a_step * (end - begin))]
        else:
            marks = np.linspace(begin, end, max(1, round(parts)) + 1).round().astype(int)
            ends_of_increments += np.unique(marks)[1:].tolist()
    return ends_of_increments


def _in_parts(count: int, path_lengths: list[float]) -> list[float]:
    """Return the number of increments in each interval. It is proportional to the path of the
    leaders in the interval; if all paths are zero, it is one."""
    whole = sum(path_lengths)
    return [count * path_length / whole if whole > 0.0 else 1.0 for path_length in path_lengths]


def _path_length(scene: Scene, begin: int, end: int) -> float:
    """Return the longest path of a leader between two events."""
    longest = 0.0
    for leading in scene.driven:
        group = leading.group
        if not (group.from_ - 1 <= begin and group.leads(end)):
            continue
        times = np.linspace(begin, end, SAMPLES + 1) - group.from_ + 1
        at = [leading.offset(n) for n in times.tolist()]
        lengths = sum(np.hypot.reduce(abs(b - a), axis=1) for a, b in pairwise(at))
        longest = max(longest, float(np.max(lengths)))
    return longest if math.isfinite(longest) else 0.0


def spacings(scene: Scene) -> int:
    """Return the length of the longest path of an obstacle in lattice spacings, rounded up, and at
    least 1."""
    offsets = [largest_offset(barrier, scene.experiment.steps) for barrier in scene.barriers]
    return max(1, math.ceil(max(offsets, default=0.0) / spacing_of(scene)))


def changes(scene: Scene, steps: int) -> list[int]:
    """Return the steps after which leaders or loads change, within the first `steps`."""
    steps_of_changes = {step - 1 for step in scene.loads.changes(steps)} if scene.loads else set()
    for leading in scene.leading:
        steps_of_changes |= {leading.group.from_ - 1, leading.group.last(steps)}
    return sorted(step for step in steps_of_changes if 0 < step < steps)


VALUES_A_CALL = 200_000_000
"""Maximum of the number of values of the state times the number of steps in a call of an engine.
Such a call takes a few tenths of a second."""
GROWING = 1e-6
"""A mode grows if its eigenvalue exceeds 1 by more than this number."""
RECORD_LAST = "; or record the equilibrium of the last step only, `record: {{at: [{}]}}`"
"""Remedy if the equilibrium of an intermediate step does not exist."""
MAX_BOND_CHANGES = 2000
"""Maximum number of changes of bonds in an increment."""
TINY = 1e-9
"""Relative length up to which the remainder of a path is joined to the last part."""
SMALLEST = 2.0**-12
"""Smallest part into which an increment is divided, as a fraction of the increment."""
REMEDY = (
    "To continue from there, use solver: {type: stepping, relaxation: auto, memory: auto}; "
    "record: {increments: true} keeps the equilibria within steps"
)
"""Remedy for a body that has broken into parts."""
MAX_ROUNDS = 40
"""Maximum number of rounds of steps that are made if an equilibrium cannot be followed."""
STEPS_A_ROUND = 50
"""Number of steps in a round."""


class Reached(NamedTuple):
    """Point on the path to the last equilibrium: the moment, the state, and `at_rest`, which is
    true if the state is an equilibrium at this moment.

    The rest of the path is determined by the moment and the working state. `state` is the working
    state or, for linear rules without fracture, a copy of it at equilibrium.
    """

    moment: float
    state: State
    at_rest: bool
    is_last: bool = False
    """True for the last point of the path."""
    part: float = 1.0
    """On the branch of a control, part of a step by which the next increment advances."""
    order: tuple[int, ...] = ()
    """On the branch of a control, places in the order in which their responses were computed."""


EquilibriumPath = Generator[Reached, None, ErrorBound]


class SeparatedError(Exception):
    """Bonds broke, and the remaining body has no equilibrium; the state is the last equilibrium."""


def increments(
    scene: Scene,
    state: State,
    watch: Watch,
    since: float = 0.0,
    finder: Finder | None = None,
    stops: Sequence[int] = (),
) -> EquilibriumPath:
    """Move a scene, in place, to the equilibrium of its last step, and yield the states on the way.
    The path begins at the initial state or, if `since` is given, at the state of this moment. These
    include the equilibria at the steps `stops`, which are earlier than the last step.

    Before each change of roles or loads the body is moved to equilibrium. Floating parts, and
    particles that become leaders later, are then at the positions to which slow loading moves them.
    Floating parts under a load are moved by steps. If bonds can break or the rule is not linear,
    motions and loads are divided into increments, which may be parts of a step. In each increment
    the body is moved to equilibrium and bonds that are too long break; both are repeated until no
    bond breaks.

    Raises ExperimentError if there is no equilibrium, UnconvergedError, SeparatedError, and
    StoppedError on interruption. After an exception, `state` is the last state reached.
    """
    settings, steps = scene.experiment.solver.equilibrium, scene.experiment.steps
    if settings.control:
        raise ExperimentError(
            "the equilibrium is computed for a given load here; remove the control",
            ("solver", "control"),
        )
    for n, driven in enumerate(scene.driven):
        if driven.group.leads(steps) and driven.group.motion.rests_after() is None:
            count = len(scene.leading)
            field, n = ("leaders", n) if n < count else ("obstacles", n - count)
            raise ExperimentError(
                "never comes to rest, so that there is no equilibrium; use solver: "
                "{type: stepping}, or a motion that ends",
                (field, n, "motion"),
            )
    if finder is None:
        finder = finder_of(scene, initial_state(scene) if since or state.step else state, watch)
    if scene.has_fracture or not finder.linear:
        count = settings.increments if scene.experiment.fracture.can_break else spacings(scene)
        return (yield from _load(scene, state, finder, moments(scene, count), since, stops))
    return (yield from _of_linear(scene, state, finder, [s for s in stops if s > since]))


def equilibrate(
    scene: Scene, state: State, watch: Watch | None = None, finder: Finder | None = None
) -> ErrorBound:
    """Move a state to the last equilibrium in one call. A given `finder` is used; otherwise one is
    built."""
    path = increments(scene, state, watch or Watch(), finder=finder)
    while True:
        try:
            next(path)
        except StopIteration as end:
            error_bound: ErrorBound = end.value
            return error_bound


def equilibrate_at_step(scene: Scene, state: State, watch: Watch | None = None) -> ErrorBound:
    """Move a state, in place, to the equilibrium with the leaders, loads and parameters of its
    step, and break bonds that are too long in that equilibrium.

    Raises ExperimentError if there is no equilibrium, and UnconvergedError.
    """
    finder = finder_of(scene, initial_state(scene), watch)
    step = state.step
    return _equilibrate_bonds_at(scene, state, finder, step, step, MAX_BOND_CHANGES, step)


def equilibrium_state(scene: Scene) -> tuple[State, ErrorBound]:
    """Return the equilibrium of a scene as a new state."""
    state = initial_state(scene)
    error_bound = equilibrate(scene, state)
    return state, error_bound


def _of_linear(scene: Scene, state: State, finder: Finder, stops: Sequence[int]) -> EquilibriumPath:
    """Compute the equilibria of the steps `stops` and of the last step. Before each change of roles
    or loads, `state` is replaced in place by the equilibrium of that step; at other stops a copy is
    used."""
    steps, converged, last = scene.experiment.steps, None, last_event(scene)
    for stop in [*stops, steps]:
        for change in changes(scene, stop):
            if change <= state.step:
                continue
            if converged and converged.step == change:
                vars(state).update(vars(converged.copy()))
                continue
            start = state.copy()
            try:
                with _at_step(change):
                    _equilibrate_at(scene, state, finder, change)
            except NoEquilibriumError:
                vars(state).update(vars(start))
                if not _steps_shrink(scene, change):
                    raise
                yield from _step_to(change, state, scene, finder)
                continue
            yield Reached(change, state, at_rest=True)
        if stop == steps:
            return _equilibrate_at(scene, state, finder, stop)
        if converged is None or converged.step < last:
            converged = state.copy()
            try:
                with _at_step(stop, RECORD_LAST.format(steps)):
                    _equilibrate_at(scene, converged, finder, stop)
            except UnconvergedError:
                vars(state).update(vars(converged), step=stop)
                raise
        converged.step = stop
        yield Reached(stop, converged, at_rest=True)
    raise AssertionError


def _steps_shrink(scene: Scene, step: int) -> bool:
    """Return whether no mode grows if steps are made with the roles of the given step. Return True
    if the spectrum cannot be computed."""
    if excess(scene) or scene.experiment.neighbours.nearness():
        return True
    operator = step_operator(scene.at(step), step=step)
    try:
        return spectrum(operator.augmented().matrix()).radius < 1.0 + GROWING
    except TooExpensiveError:
        return True


def _step_to(last: int, state: State, scene: Scene, finder: Finder) -> Iterator[Reached]:
    """Make all steps up to `last`, in calls that are short enough for interruptions. All steps are
    needed because the displacement of floating parts under a load depends on their number."""
    watch, first, engine = finder.watch, state.step, chosen_engine(scene)
    watch.begin("stepping while loads act on unconstrained parts")
    a_call = max(1, int(VALUES_A_CALL / state.u.size))
    while state.step < last:
        reached = engine.advance(state, min(a_call, last - state.step))
        state.u, state.previous, state.starts = reached.u, reached.previous, reached.starts
        state.step = reached.step
        yield Reached(state.step, state, at_rest=False)
        watch.look((state.step - first) / (last - first))


@contextmanager
def _at_step(step: int, remedy: str = "") -> Iterator[None]:
    """Add the step to the message of an error about an equilibrium that does not exist."""
    try:
        yield
    except NoEquilibriumError as error:
        text = f"at step {step} {error}{remedy}"
        raise NoEquilibriumError(text, *error.args[1:]) from None


def _equilibrate_at(scene: Scene, state: State, finder: Finder, moment: float) -> ErrorBound:
    start = state.u.copy(), state.starts
    placed, state.starts = prescribe(scene, state, moment)
    place(state.u, placed)
    try:
        error_bound = finder.find(state, moment)
    except StoppedError:
        state.u[...], state.starts = start
        raise
    state.step = math.floor(moment)
    state.previous[...] = state.u
    return error_bound


def _load(
    scene: Scene,
    state: State,
    finder: Finder,
    every: list[float],
    since: float,
    stops: Sequence[int],
) -> EquilibriumPath:
    """Move in increments to the last motion or the last change of roles or loads, and break bonds
    after each increment."""
    error_bound: ErrorBound | None = None
    last = every[-1]
    every = sorted({*every, *(stop for stop in stops if stop < last)})
    planned = [moment for moment in every if moment > since] or every[-1:]
    quick = None
    if finder.linear and scene.has_fracture and not obstacle():
        from pbdkit.equilibrium.breaking_kernel import breaking_kernel_of  # imports numba

        quick = breaking_kernel_of(scene, finder.tolerance, finder.watch)
    farthest = size_of(scene) + finder.scale
    for moment in planned:
        finder.watch.load = f"step {moment:.6g} of {last:g}, "
        start = state.copy()
        step = math.floor(since) + 1
        try:
            max_changes = MAX_BOND_CHANGES
            if since == step - 1 and cut_bonds(scene, state.broken_step, step) and since > 0:
                # If a cut makes other bonds break, they break under the load at which the cut is
                # made.
                _equilibrate_bonds_at(scene, state, finder, since, since, max_changes, step)
            converged, changes = (
                quick.equilibrate(state, moment, max_changes) if quick else (False, 0)
            )
            if not converged or moment == last:  # It was an equilibrium.
                remaining = max(1, max_changes - changes)
                error_bound = _equilibrate_bonds_at(scene, state, finder, since, moment, remaining)
            _refuse_thrown_off(scene, state, farthest)
        except StoppedError:
            vars(state).update(vars(start))
            raise
        except (NoEquilibriumError, UnconvergedError) as error:
            failed = state.copy()
            if _is_worth_keeping(failed, moment, finder, error):
                raise
            vars(state).update(vars(start))
            if _torn(failed):
                text = _parting(scene, start, failed, (since, moment), error)
                raise SeparatedError(text) from None
            raise
        since = moment
        if moment < last:
            yield Reached(moment, state, at_rest=True)
    # Nothing changes after this moment: the equilibrium is the same at all later recorded steps.
    for stop in (stop for stop in stops if stop >= last):
        state.step = stop
        yield Reached(stop, state, at_rest=True, is_last=True)
    state.step = scene.experiment.steps
    assert error_bound is not None
    return error_bound


def _torn(state: State) -> int:
    """Return the number of bonds broken or cut since the start."""
    return 0 if state.broken_step is None else int(np.count_nonzero(state.broken_step > 0))


def _refuse_thrown_off(scene: Scene, state: State, farthest: float) -> None:
    """Raise NoEquilibriumError if bonds broke and a particle has moved farther than the size of the
    body plus all prescribed displacements: nothing holds the particle."""
    if _torn(state) and not (longest := largest_displacement(state)) <= farthest:
        number = Guard(farthest, 0, 0, None).worst(scene, state)
        raise NoEquilibriumError(
            f"particle {number} would be displaced by {longest:.6g}, more than the size of the "
            "body: it is hardly constrained"
        )


def _is_worth_keeping(
    state: State, moment: float, finder: Finder, error: NoEquilibriumError | UnconvergedError
) -> bool:
    """Return whether the state of a failed increment is an equilibrium of which only the error
    bound exceeds the tolerance. The error bound must exist, and no bond may break or change in the
    state."""
    if not (isinstance(error, UnconvergedError) and finder.linear and moment == int(moment)):
        return False
    if not math.isfinite(error.error_bound.distance):
        return False
    scene = finder.scene
    fracturing = Fracturing.of(scene.at(moment))
    return not (fracturing and _bonds_change(scene, fracturing, state.copy(), math.ceil(moment)))


def _parting(
    scene: Scene, before: State, failed: State, between: tuple[float, float], error: Exception
) -> str:
    """Return the message for a body that broke into parts between two moments. It contains
    position, cause and remedy."""
    since, moment = between
    assert before.broken_step is not None
    assert failed.broken_step is not None
    bonds, count = scene.bonds, _torn(failed) - _torn(before)
    fresh = (failed.broken_step >= 0) & (before.broken_step < 0)
    rows = np.flatnonzero(fresh.reshape(len(fresh), -1)[bonds.plane, bonds.place])
    parted = isinstance(error, NoEquilibriumError)
    what = "the body came apart" if parted else "no stable equilibrium was found"
    first = ""
    if len(rows):
        a, b = (bonds.ends[rows[0]] + 1).tolist()
        plural = f" and {count - 1} more" if count > 1 else ""
        first = f"the bond between particles {a} and {b}{plural} broke, and "
    flat = before.u.reshape(len(before.u), -1)
    step = max(1, math.ceil(since))
    leader_displacements = [flat[:, each.place] for each in scene.leading if each.group.leads(step)]
    displacement = max(
        (float(np.abs(u).max(initial=0.0)) for u in leader_displacements), default=0.0
    )
    leads = f", with leaders displaced by up to {displacement:.6g}" if displacement else ""
    cause = str(error).partition("; ")[0]
    return (
        f"{what} between step {since:.6g} and step {moment:.6g}: {first}{cause}; the last "
        f"equilibrium is that of step {since:.6g}{leads}. {REMEDY}"
    )


def _equilibrate_bonds_at(
    scene: Scene,
    state: State,
    finder: Finder,
    since: float,
    moment: float,
    max_changes: int,
    step: int = 0,
) -> ErrorBound:
    """Move to equilibrium until no bond changes any more, at most `max_changes` times.

    Bonds that break are recorded with `step` or, by default, with the step of the moment.
    """
    fracturing = Fracturing.of(scene.at(moment))
    for _ in range(max_changes):
        if finder.linear:
            error_bound = _equilibrate_at(scene, state, finder, moment)
        else:
            error_bound = _follow(scene, state, finder, since, moment)
        if not fracturing or not _bonds_change(scene, fracturing, state, step or math.ceil(moment)):
            return error_bound
        since = moment
    raise UnconvergedError(
        f"bonds still change after {MAX_BOND_CHANGES} equilibria at step {moment:.6g}",
        error_bound,
    )


def _follow(scene: Scene, state: State, finder: Finder, since: float, moment: float) -> ErrorBound:
    """Move from the equilibrium at one moment to the equilibrium at a later moment. The increment
    is divided into parts that are so small that the equilibrium changes continuously. If no part is
    small enough (snap-through), steps are made. If bonds have just broken, implicit steps are made
    without dividing the increment."""
    reached, part = since, moment - since
    while True:
        target = moment if reached + part > moment - TINY * part else reached + part
        start = state.copy()
        placed, state.starts = prescribe(scene, state, target)
        place(state.u, placed)
        try:
            error_bound = _nearby(finder, state, target, start)
        except (NoEquilibriumError, UnconvergedError) as error:
            torn = _torn(start) and not scene.barriers
            if isinstance(error, RoundingError) and not torn:
                raise  # Smaller parts do not reduce the error.
            vars(state).update(vars(start))
            if torn:
                return _relaxed(scene, state, finder, moment)
            if isinstance(error, NoEquilibriumError):
                raise
            part /= 2.0
            if part > (moment - since) * SMALLEST:
                continue
            error_bound = _stepped(scene, state, finder, target, error)
        reached = target
        state.step = math.floor(target)
        state.previous[...] = state.u
        if reached >= moment:
            return error_bound
        part = min(2.0 * part, moment - reached)


def _relaxed(scene: Scene, state: State, finder: Finder, moment: float) -> ErrorBound:
    """Make implicit steps from a state in which bonds have broken, with leaders at their positions
    at a moment."""
    placed, state.starts = prescribe(scene, state, moment)
    place(state.u, placed)
    error_bound = finder.relax(state, moment)
    state.step = math.floor(moment)
    state.previous[...] = state.u
    return error_bound


def _nearby(finder: Finder, state: State, moment: float, before: State) -> ErrorBound:
    if finder.scene.barriers:
        return follow_contact(finder.at(moment), state, moment)
    return finder.follow(state, moment, before)


def _stepped(
    scene: Scene, state: State, finder: Finder, moment: float, failed: UnconvergedError
) -> ErrorBound:
    """Make steps with leaders at their positions at a moment, until the state is close enough to an
    equilibrium for Newton's method.

    Raises UnconvergedError if no stable equilibrium is reached.
    """
    placed, state.starts = prescribe(scene, state, moment)
    place(state.u, placed)
    for _ in range(MAX_ROUNDS):
        for _ in range(STEPS_A_ROUND):
            state.u += finder.at(moment).moves.at(state, moment)
        if not np.isfinite(state.u).all():
            break
        candidate = state.copy()
        with suppress(UnconvergedError):
            error_bound = _nearby(finder, candidate, moment, candidate.copy())
            vars(state).update(vars(candidate))
            return error_bound
    raise UnconvergedError(
        f"at step {moment:.6g} the load path cannot be followed: it branches into several "
        f"equilibria, as in buckling, and rounding errors would select one of them ({failed})",
        failed.error_bound,
    )


def _bonds_change(scene: Scene, fracturing: Fracturing, state: State, step: int) -> bool:
    """Return whether bonds break or change at the equilibrium. Changes of state variables within
    the tolerance are discarded, so that the bonds remain those for which the error bound was
    computed."""
    values_before = [value.copy() for value in state.bond_values]
    broken = broken_bonds(state)
    fracturing.break_bonds(state.u, state, step, in_turn=True)
    if broken_bonds(state) > broken:
        return True
    tolerance = scene.experiment.solver.equilibrium.tolerance
    pairs = list(zip(values_before, state.bond_values, strict=True))
    if any((abs(b - a) > tolerance * np.maximum(1.0, abs(a))).any() for a, b in pairs):
        return True
    for old, new in pairs:
        new[...] = old
    return False
