"""From the start of an experiment to its equilibrium: roles, leaders, and bonds that break."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterator
from contextlib import suppress

import numpy as np

from pbdkit.equilibrium.breaking.choice import settler_of
from pbdkit.equilibrium.certificate import Certificate, UnconvergedError, broken_bonds
from pbdkit.equilibrium.contact_search import follow_contact
from pbdkit.equilibrium.finder import finder_of
from pbdkit.equilibrium.load_path import last_change, moments, spacings
from pbdkit.equilibrium.newton import Finder
from pbdkit.errors import ExperimentError
from pbdkit.results.progress import StoppedError, Watch
from pbdkit.scene.scene import Scene
from pbdkit.stepping.bond_breaker import Fracturing
from pbdkit.stepping.choice import chosen_engine
from pbdkit.stepping.cutting import cut_bonds
from pbdkit.stepping.numpy_engine import Engine
from pbdkit.stepping.prescription import place, prescribe
from pbdkit.stepping.state import State, initial_state

VALUES_A_CALL = 200_000_000
"""An engine makes so many values' steps a call, some tenths of a second."""
MOST_SETTLINGS = 2000
"""So often bonds may change in an increment, one after the other or little by little."""
TINY, SMALLEST = 1e-9, 2.0**-12
"""The last part of a way is taken with what is left of it; no part is smaller than the other share
of its increment."""
MOST_ROUNDS, STEPS_A_ROUND = 40, 50
"""Of steps, where an equilibrium cannot be followed."""
Way = Generator[float, None, Certificate]


def increments(
    scene: Scene,
    state: State,
    watch: Watch,
    since: float = 0.0,
    finder: Finder | None = None,
    engine: Callable[[Scene], Engine] = chosen_engine,
) -> Way:
    """Takes a scene, in place, from its initial state, or from one on the way, as it was at the
    moment `since`, to the equilibrium of its last step. Gives out the moments reached: they and
    the state decide all that follows.

    Until roles or loads change for the last time steps are made, so that leaders start, and parts
    that nothing holds remain, where stepping has them. Where bonds can break, and for rules that
    are not linear, leaders and loads come in increments instead, within steps too: settle, break
    what is too long, settle again until nothing breaks.
    Raises ExperimentError where there is no equilibrium, UnconvergedError, and StoppedError where
    the watch says so: then the state is the last that had been reached.
    """
    asked, steps = scene.experiment.solver.sought, scene.experiment.steps
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
        return (yield from _load(scene, state, finder, moments(scene, count), since))
    if (last := last_change(scene)) > state.step:
        yield from _step_to(last, engine(scene), state, finder)
    return _settle_at(scene, state, finder, steps)


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


def equilibrium_state(scene: Scene) -> tuple[State, Certificate]:
    """The equilibrium of a scene as a state of its own."""
    state = initial_state(scene)
    certificate = settle(scene, state)
    return state, certificate


def _step_to(last: int, engine: Engine, state: State, finder: Finder) -> Iterator[float]:
    """Steps, in calls short enough for interruptions to be heard."""
    watch, first = finder.watch, state.step
    watch.begin("stepping until roles and loads change no more")
    a_call = max(1, int(VALUES_A_CALL / finder.rows.most(state.u.size)))
    while state.step < last:
        reached = engine.advance(state, min(a_call, last - state.step))
        state.u, state.previous, state.starts = reached.u, reached.previous, reached.starts
        state.step = reached.step
        yield state.step
        watch.look((state.step - first) / (last - first))


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


def _load(scene: Scene, state: State, finder: Finder, every: list[float], since: float) -> Way:
    """In increments up to the last motion or change of roles or loads, breaking bonds on the
    way."""
    certificate: Certificate | None = None
    planned = [moment for moment in every if moment > since] or every[-1:]
    quick = settler_of(scene, finder.tolerance, finder.watch) if finder.linear else None
    for moment in planned:
        finder.watch.load = f"step {moment:.6g} of {planned[-1]:g}, "
        before = state.copy()
        step = math.floor(since) + 1
        try:
            most = MOST_SETTLINGS
            if since == step - 1 and cut_bonds(scene, state.broken_step, step) and since > 0:
                # What gives way to a cut does so under the load at which it is made.
                _settle_bonds_at(scene, state, finder, since, since, most, step)
            settled, changes = quick.settle(state, moment, most) if quick else (False, 0)
            if not settled or moment == planned[-1]:  # which is certified
                left = max(1, most - changes)
                certificate = _settle_bonds_at(scene, state, finder, since, moment, left)
        except StoppedError:
            vars(state).update(vars(before))
            raise
        since = moment
        if moment < planned[-1]:
            yield moment
    state.step = scene.experiment.steps
    assert certificate is not None
    return certificate


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
    way; where none is small enough, since the body snaps or bonds broke, by steps."""
    here, part = since, moment - since
    while True:
        target = moment if here + part > moment - TINY * part else here + part
        before = state.copy()
        led, state.starts = prescribe(scene, state, target)
        place(state.u, led)
        try:
            certificate = _nearby(finder, state, target, before)
        except UnconvergedError as error:
            vars(state).update(vars(before))
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
    fracturing.break_bonds(state.u, state, step)
    if broken_bonds(state) > broken:
        return True
    tolerance = scene.experiment.solver.sought.tolerance
    pairs = list(zip(before, state.bond_values, strict=True))
    if any((abs(b - a) > tolerance * np.maximum(1.0, abs(a))).any() for a, b in pairs):
        return True
    for old, new in pairs:
        new[...] = old
    return False
