"""Load stepping: from the initial state of a scene to the equilibrium of its last step.

The load is cut into increments where bonds can break or rules are not linear; in each the body
settles, bonds that are too long break, and it settles again until nothing changes.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from pbdkit.equilibrium.certificate import (
    Certificate,
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
from pbdkit.linear.spectrum import TooDearError, excess, spectrum
from pbdkit.progress import StoppedError, Watch
from pbdkit.scene.scene import Scene
from pbdkit.stepping.bond_breaking import Fracturing
from pbdkit.stepping.divergence import Guard, most_of, size_of, way_of
from pbdkit.stepping.engine_choice import chosen_engine, obstacle
from pbdkit.stepping.leaders import bends_of, last_event, place, prescribe
from pbdkit.stepping.state import State, cut_bonds, initial_state


def finder_of(
    scene: Scene,
    start: State,
    watch: Watch | None = None,
    *,
    compiles: bool = True,
    rows: Rows = ALL,
) -> Finder:
    """What finds the equilibrium that a scene asks for, from its initial state. Whoever asks for
    many that differ by numbers compiles none of their moves."""
    asked, scale = scene.experiment.solver.equilibrium, scale_of(scene, start, rows)
    length = asked.tolerance * scale
    return Finder(scene, length, scale, asked.method, watch or Watch(), compiles, rows)


SAMPLES = 16
"""Parts of an interval in which the way of a leader counts as straight."""


def events(scene: Scene) -> list[int]:
    """The moments, from 0 on, between which each leader moves by one formula, all keep their roles
    and bonds that are not torn, and loads and numbers change evenly: the ends of steps, up to the
    last of the load."""
    steps, last = scene.experiment.steps, last_event(scene)
    found = {0, last, *bends_of(scene), *(cut.at - 1 for cut in scene.experiment.cuts)}
    for change in scene.loads.changes(steps) if scene.loads else ():
        found |= {change - 1, change}
    for leading in scene.driven:
        group = leading.group
        end = group.last(steps)
        knots = (group.from_ - 1 + n for n in group.motion.knots())
        found |= {group.from_ - 1, end, *(knot for knot in knots if knot <= end)}
    return sorted(moment for moment in found if 0 <= moment <= last)


def moments(scene: Scene, count: int) -> list[float]:
    """The ends of about `count` increments, equal parts of the way that the leaders go, as many of
    what loads and numbers do, and every event. An increment is some whole steps, or a step some
    whole increments; where nobody moves there is one."""
    ends = events(scene)
    intervals = list(pairwise(ends)) or [(0, ends[-1])]
    shares, found = _in_parts(count, [_way(scene, *i) for i in intervals]), list[float]()
    ways = [course.way for course in scene.experiment.courses.values()]
    for way in [*ways, *([scene.loads.way] if scene.loads else [])]:
        shares = list(map(max, shares, _in_parts(count, [way(*i) for i in intervals])))
    for (begin, end), parts in zip(intervals, shares, strict=True):
        a_step = round(parts / (end - begin))
        if a_step > 0:
            found += [begin + (n + 1) / a_step for n in range(a_step * (end - begin))]
        else:
            marks = np.linspace(begin, end, max(1, round(parts)) + 1).round().astype(int)
            found += np.unique(marks)[1:].tolist()
    return found


def _in_parts(count: int, ways: list[float]) -> list[float]:
    """So many increments over intervals of these ways; one each where there is no way at all."""
    whole = sum(ways)
    return [count * way / whole if whole > 0.0 else 1.0 for way in ways]


def _way(scene: Scene, begin: int, end: int) -> float:
    """How far the leader that goes farthest goes between two events."""
    most = 0.0
    for leading in scene.driven:
        group = leading.group
        if not (group.from_ - 1 <= begin and group.leads(end)):
            continue
        times = np.linspace(begin, end, SAMPLES + 1) - group.from_ + 1
        at = [leading.offset(n) for n in times.tolist()]
        ways = sum(np.hypot.reduce(abs(b - a), axis=1) for a, b in pairwise(at))
        most = max(most, float(np.max(ways)))
    return most if math.isfinite(most) else 0.0


def spacings(scene: Scene) -> int:
    """By how many lattice spacings the obstacle that goes farthest goes, at least 1."""
    ways = [way_of(barrier, scene.experiment.steps) for barrier in scene.barriers]
    return max(1, math.ceil(max(ways, default=0.0) / spacing_of(scene)))


def changes(scene: Scene, steps: int) -> list[int]:
    """The steps after which roles or loads change, within so many."""
    found = {step - 1 for step in scene.loads.changes(steps)} if scene.loads else set()
    for leading in scene.leading:
        found |= {leading.group.from_ - 1, leading.group.last(steps)}
    return sorted(step for step in found if 0 < step < steps)


VALUES_A_CALL = 200_000_000
"""An engine makes so many values' steps a call, some tenths of a second."""
GROWING = 1e-6
"""A mode grows where steps multiply it by so much more than 1."""
RECORD_LAST = "; or record that of the last step alone, `record: {{at: [{}]}}`"
MOST_SETTLINGS = 2000
"""So often bonds may change in an increment, one after the other or little by little."""
TINY, SMALLEST = 1e-9, 2.0**-12
"""The last part of a way is taken with what is left of it; no part is smaller than the other share
of its increment."""
REMEDY = (
    "To follow what comes after it take solver: {type: stepping, relaxation: auto, memory: auto} "
    "from there; record: {increments: true} keeps the equilibria within steps"
)
"""What is to be done about a body that came apart."""
MOST_ROUNDS, STEPS_A_ROUND = 40, 50
"""Of steps, where an equilibrium cannot be followed."""


class Reached(NamedTuple):
    """A moment on the way to the last equilibrium, and whether `state` is an equilibrium there.

    The moment and the state that the increments work on decide all that follows. `state` is that
    one or, under linear rules without fracture, a copy of it that has settled."""

    moment: float
    state: State
    at_rest: bool
    is_last: bool = False
    """Whether nothing remains to be computed."""


Way = Generator[Reached, None, Certificate]


class SeparatedError(Exception):
    """Bonds broke, and what remains has no equilibrium; the state is the last that had one."""


def increments(
    scene: Scene,
    state: State,
    watch: Watch,
    since: float = 0.0,
    finder: Finder | None = None,
    stops: Sequence[int] = (),
) -> Way:
    """Takes a scene, in place, from its initial state, or from one on the way, as it was at the
    moment `since`, to the equilibrium of its last step. Yields what is reached on the way; the
    `stops` are steps before the last one whose equilibria are among it.

    The body settles before each change of roles or loads: late leaders start, and parts that
    nothing holds remain, where slow loading has them; what loads push on for ever until then goes
    as far as steps take it. Where bonds can break, and for rules that
    are not linear, leaders and loads come in increments, within steps too: settle, break what is
    too long, settle again until nothing breaks.
    Raises ExperimentError where there is no equilibrium, UnconvergedError, SeparatedError, and
    StoppedError where the watch says so: then the state is the last that had been reached.
    """
    asked, steps = scene.experiment.solver.equilibrium, scene.experiment.steps
    for n, driven in enumerate(scene.driven):
        if driven.group.leads(steps) and driven.group.motion.rests_after() is None:
            count = len(scene.leading)
            field, n = ("leaders", n) if n < count else ("obstacles", n - count)
            raise ExperimentError(
                "never comes to rest, so that there is no equilibrium; take solver: "
                "{type: stepping}, or a motion that ends",
                (field, n, "motion"),
            )
    if finder is None:
        finder = finder_of(scene, initial_state(scene) if since or state.step else state, watch)
    if scene.has_fracture or not finder.linear:
        count = asked.increments if scene.experiment.fracture.can_break else spacings(scene)
        return (yield from _load(scene, state, finder, moments(scene, count), since, stops))
    return (yield from _of_linear(scene, state, finder, [s for s in stops if s > since]))


def settle(
    scene: Scene, state: State, watch: Watch | None = None, finder: Finder | None = None
) -> Certificate:
    """The same in one go, by a finder where one is at hand."""
    way = increments(scene, state, watch or Watch(), finder=finder)
    while True:
        try:
            next(way)
        except StopIteration as end:
            certificate: Certificate = end.value
            return certificate


def settle_at_step(scene: Scene, state: State, watch: Watch | None = None) -> Certificate:
    """Move a state, in place, to equilibrium with leaders, loads and numbers as they are at its
    step; bonds that are too long there break.

    Raises ExperimentError where there is no equilibrium, and UnconvergedError.
    """
    finder = finder_of(scene, initial_state(scene), watch)
    step = state.step
    return _settle_bonds_at(scene, state, finder, step, step, MOST_SETTLINGS, step)


def equilibrium_state(scene: Scene) -> tuple[State, Certificate]:
    """The equilibrium of a scene as a state of its own."""
    state = initial_state(scene)
    certificate = settle(scene, state)
    return state, certificate


def _of_linear(scene: Scene, state: State, finder: Finder, stops: Sequence[int]) -> Way:
    """The equilibria of some steps and of the last one; the state goes on by those after which
    roles or loads change."""
    steps, settled, last = scene.experiment.steps, None, last_event(scene)
    for stop in [*stops, steps]:
        for change in changes(scene, stop):
            if change <= state.step:
                continue
            if settled and settled.step == change:
                vars(state).update(vars(settled.copy()))
                continue
            before = state.copy()
            try:
                with _at_step(change):
                    _settle_at(scene, state, finder, change)
            except NoEquilibriumError:
                vars(state).update(vars(before))
                if not _steps_shrink(scene, change):
                    raise
                yield from _step_to(change, state, scene, finder)
                continue
            yield Reached(change, state, at_rest=True)
        if stop == steps:
            return _settle_at(scene, state, finder, stop)
        if settled is None or settled.step < last:
            settled = state.copy()
            try:
                with _at_step(stop, RECORD_LAST.format(steps)):
                    _settle_at(scene, settled, finder, stop)
            except UnconvergedError:
                vars(state).update(vars(settled), step=stop)
                raise
        settled.step = stop
        yield Reached(stop, settled, at_rest=True)
    raise AssertionError


def _steps_shrink(scene: Scene, step: int) -> bool:
    """Whether no mode grows by the steps with the roles of one, as far as its spectrum is known."""
    if excess(scene) or scene.experiment.neighbours.nearness():
        return True
    operator = step_operator(scene.at(step), step=step)
    try:
        return spectrum(operator.augmented().matrix()).radius < 1.0 + GROWING
    except TooDearError:
        return True


def _step_to(last: int, state: State, scene: Scene, finder: Finder) -> Iterator[Reached]:
    """Steps, in calls short enough for interruptions to be heard: where nothing holds a part that
    is pushed on, how far it goes counts."""
    watch, first, engine = finder.watch, state.step, chosen_engine(scene)
    watch.begin("stepping while loads push on what nothing holds")
    a_call = max(1, int(VALUES_A_CALL / state.u.size))
    while state.step < last:
        reached = engine.advance(state, min(a_call, last - state.step))
        state.u, state.previous, state.starts = reached.u, reached.previous, reached.starts
        state.step = reached.step
        yield Reached(state.step, state, at_rest=False)
        watch.look((state.step - first) / (last - first))


@contextmanager
def _at_step(step: int, remedy: str = "") -> Iterator[None]:
    """Add the step to the message of an equilibrium that does not exist."""
    try:
        yield
    except NoEquilibriumError as error:
        text = f"at step {step} {error}{remedy}"
        raise NoEquilibriumError(text, *error.args[1:]) from None


def _settle_at(scene: Scene, state: State, finder: Finder, moment: float) -> Certificate:
    before = state.u.copy(), state.starts
    led, state.starts = prescribe(scene, state, moment)
    place(state.u, led)
    try:
        certificate = finder.find(state, moment)
    except StoppedError:
        state.u[...], state.starts = before
        raise
    state.step = math.floor(moment)
    state.previous[...] = state.u
    return certificate


def _load(
    scene: Scene,
    state: State,
    finder: Finder,
    every: list[float],
    since: float,
    stops: Sequence[int],
) -> Way:
    """In increments up to the last motion or change of roles or loads, breaking bonds on the
    way."""
    certificate: Certificate | None = None
    last = every[-1]
    every = sorted({*every, *(stop for stop in stops if stop < last)})
    planned = [moment for moment in every if moment > since] or every[-1:]
    quick = None
    if finder.linear and scene.has_fracture and not obstacle():
        from pbdkit.equilibrium.breaking_kernel import settler_of  # imports numba

        quick = settler_of(scene, finder.tolerance, finder.watch)
    farthest = size_of(scene) + finder.scale
    for moment in planned:
        finder.watch.load = f"step {moment:.6g} of {last:g}, "
        before = state.copy()
        step = math.floor(since) + 1
        try:
            most = MOST_SETTLINGS
            if since == step - 1 and cut_bonds(scene, state.broken_step, step) and since > 0:
                # What gives way to a cut does so under the load at which it is made.
                _settle_bonds_at(scene, state, finder, since, since, most, step)
            settled, changes = quick.settle(state, moment, most) if quick else (False, 0)
            if not settled or moment == last:  # which is certified
                left = max(1, most - changes)
                certificate = _settle_bonds_at(scene, state, finder, since, moment, left)
            _refuse_thrown_off(scene, state, farthest)
        except StoppedError:
            vars(state).update(vars(before))
            raise
        except (NoEquilibriumError, UnconvergedError) as error:
            failed = state.copy()
            if _is_worth_keeping(failed, moment, finder, error):
                raise
            vars(state).update(vars(before))
            if _torn(failed):
                text = _parting(scene, before, failed, (since, moment), error)
                raise SeparatedError(text) from None
            raise
        since = moment
        if moment < last:
            yield Reached(moment, state, at_rest=True)
    # Nothing changes any more: recorded steps after that are the same equilibrium.
    for stop in (stop for stop in stops if stop >= last):
        state.step = stop
        yield Reached(stop, state, at_rest=True, is_last=True)
    state.step = scene.experiment.steps
    assert certificate is not None
    return certificate


def _torn(state: State) -> int:
    """The number of bonds broken or cut since the start."""
    return 0 if state.broken_step is None else int(np.count_nonzero(state.broken_step > 0))


def _refuse_thrown_off(scene: Scene, state: State, farthest: float) -> None:
    """Raises NoEquilibriumError where bonds broke and a particle has gone farther than the size of
    the body and all prescribed displacements together: nothing holds it there."""
    if _torn(state) and not (most := most_of(state)) <= farthest:
        number = Guard(farthest, 0, 0, None).worst(scene, state)
        raise NoEquilibriumError(
            f"particle {number} would be displaced by {most:.6g}, farther than the body is long: "
            "hardly anything holds it"
        )


def _is_worth_keeping(
    state: State, moment: float, finder: Finder, error: NoEquilibriumError | UnconvergedError
) -> bool:
    """Whether the state at a moment, where an increment has failed, is an equilibrium but for the
    tolerance: it has a certificate, and no bond breaks or changes in it."""
    if not (isinstance(error, UnconvergedError) and finder.linear and moment == int(moment)):
        return False
    if not math.isfinite(error.certificate.distance):
        return False
    scene = finder.scene
    fracturing = Fracturing.of(scene.at(moment))
    return not (fracturing and _bonds_change(scene, fracturing, state.copy(), math.ceil(moment)))


def _parting(
    scene: Scene, before: State, failed: State, between: tuple[float, float], error: Exception
) -> str:
    """The message of a body that came apart between two moments: where, why, and the remedy."""
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
    led = [flat[:, each.place] for each in scene.leading if each.group.leads(step)]
    way = max((float(np.abs(u).max(initial=0.0)) for u in led), default=0.0)
    leads = f", leaders displaced by up to {way:.6g}" if way else ""
    cause = str(error).partition("; ")[0]
    return (
        f"{what} between step {since:.6g} and step {moment:.6g}: {first}{cause}; the last "
        f"equilibrium is that of step {since:.6g}{leads}. {REMEDY}"
    )


def _settle_bonds_at(
    scene: Scene,
    state: State,
    finder: Finder,
    since: float,
    moment: float,
    most: int,
    step: int = 0,
) -> Certificate:
    """Until no bond changes any more, `most` times at most; what breaks does so in a `step`, by
    default that of the moment."""
    fracturing = Fracturing.of(scene.at(moment))
    for _ in range(most):
        if finder.linear:
            certificate = _settle_at(scene, state, finder, moment)
        else:
            certificate = _follow(scene, state, finder, since, moment)
        if not fracturing or not _bonds_change(scene, fracturing, state, step or math.ceil(moment)):
            return certificate
        since = moment
    raise UnconvergedError(
        f"bonds still change after they settled {MOST_SETTLINGS} times at step {moment:.6g}",
        certificate,
    )


def _follow(scene: Scene, state: State, finder: Finder, since: float, moment: float) -> Certificate:
    """From the equilibrium of a moment to that of a later one, in parts as large as keep to one
    way; where none is small enough, since the body snaps, by steps. Where bonds broke, by implicit
    steps at once."""
    here, part = since, moment - since
    while True:
        target = moment if here + part > moment - TINY * part else here + part
        before = state.copy()
        led, state.starts = prescribe(scene, state, target)
        place(state.u, led)
        try:
            certificate = _nearby(finder, state, target, before)
        except (NoEquilibriumError, UnconvergedError) as error:
            torn = _torn(before) and not scene.barriers
            if isinstance(error, RoundingError) and not torn:
                raise  # smaller parts come no nearer
            vars(state).update(vars(before))
            if torn:
                return _relaxed(scene, state, finder, moment)
            if isinstance(error, NoEquilibriumError):
                raise
            part /= 2.0
            if part > (moment - since) * SMALLEST:
                continue
            certificate = _stepped(scene, state, finder, target, error)
        here = target
        state.step = math.floor(target)
        state.previous[...] = state.u
        if here >= moment:
            return certificate
        part = min(2.0 * part, moment - here)


def _relaxed(scene: Scene, state: State, finder: Finder, moment: float) -> Certificate:
    """As steps would go on from a state in which bonds have broken, with leaders where they are at
    a moment."""
    led, state.starts = prescribe(scene, state, moment)
    place(state.u, led)
    certificate = finder.relax(state, moment)
    state.step = math.floor(moment)
    state.previous[...] = state.u
    return certificate


def _nearby(finder: Finder, state: State, moment: float, before: State) -> Certificate:
    if finder.scene.barriers:
        return follow_contact(finder.at(moment), state, moment)
    return finder.follow(state, moment, before)


def _stepped(
    scene: Scene, state: State, finder: Finder, moment: float, failed: UnconvergedError
) -> Certificate:
    """As stepping goes on with leaders where they are at a moment, until an equilibrium is near.
    Raises UnconvergedError where none comes near that is stable."""
    led, state.starts = prescribe(scene, state, moment)
    place(state.u, led)
    for _ in range(MOST_ROUNDS):
        for _ in range(STEPS_A_ROUND):
            state.u += finder.at(moment).moves.at(state, moment)
        if not np.isfinite(state.u).all():
            break
        found = state.copy()
        with suppress(UnconvergedError):
            certificate = _nearby(finder, found, moment, found.copy())
            vars(state).update(vars(found))
            return certificate
    raise UnconvergedError(
        f"at step {moment:.6g} the load leads no further: several equilibria meet there, as where "
        f"a body buckles, and rounding would decide between them ({failed})",
        failed.certificate,
    )


def _bonds_change(scene: Scene, fracturing: Fracturing, state: State, step: int) -> bool:
    """Whether bonds break or change in the settled state; changes within the tolerance are left
    out, so that the certificate speaks of the bonds as they are."""
    before = [value.copy() for value in state.bond_values]
    broken = broken_bonds(state)
    fracturing.break_bonds(state.u, state, step, in_turn=True)
    if broken_bonds(state) > broken:
        return True
    tolerance = scene.experiment.solver.equilibrium.tolerance
    pairs = list(zip(before, state.bond_values, strict=True))
    if any((abs(b - a) > tolerance * np.maximum(1.0, abs(a))).any() for a, b in pairs):
        return True
    for old, new in pairs:
        new[...] = old
    return False
