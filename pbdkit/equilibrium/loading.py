"""From the start of an experiment to its equilibrium: roles, leaders, and bonds that break."""

from __future__ import annotations

import numpy as np

from pbdkit.equilibrium.certificate import Certificate, never_rests, scale_of
from pbdkit.equilibrium.finding import Finder
from pbdkit.errors import ExperimentError
from pbdkit.experiment.solvers import Equilibrium
from pbdkit.scene.scene import Scene
from pbdkit.stepping.choice import choose, make_engine
from pbdkit.stepping.fracturing import Fracturing
from pbdkit.stepping.leaders import last_event, place, prescribe
from pbdkit.stepping.state import State, initial_state


def settle(scene: Scene, state: State) -> Certificate:
    """Takes a scene, in place, from its initial state to the equilibrium of its last step.

    Until the roles change for the last time steps are made, so that leaders start, and parts that
    nothing holds remain, where stepping has them. Where bonds can break, the leaders' way is made
    in increments instead: settle, break what is too long, settle again until nothing breaks.
    Raises ExperimentError where there is no equilibrium, and UnconvergedError.
    """
    solver, steps = scene.experiment.solver, scene.experiment.steps
    assert isinstance(solver, Equilibrium)
    for n, leading in enumerate(scene.leading):
        if never_rests(leading, steps):
            raise ExperimentError(
                "never comes to rest, so that there is no equilibrium; take solver: "
                "{type: stepping}, or a motion that ends",
                ("leaders", n, "motion"),
            )
    scale = scale_of(scene, state)
    finder = Finder(scene, solver.tolerance * scale, scale, solver.method)
    if scene.has_fracture:
        return _load(scene, state, finder, solver.increments)
    engine, _ = make_engine(scene, choose(scene))
    reached = engine.advance(state, _last_change_of_roles(scene) - state.step)
    state.u, state.previous, state.starts = reached.u, reached.previous, reached.starts
    state.step = reached.step
    return _settle_at(scene, state, finder, steps)


def equilibrium_state(scene: Scene) -> tuple[State, Certificate]:
    """The equilibrium of a scene as a state of its own."""
    state = initial_state(scene)
    certificate = settle(scene, state)
    return state, certificate


def _settle_at(scene: Scene, state: State, finder: Finder, step: int) -> Certificate:
    led, state.starts = prescribe(scene, state, step)
    place(state.u, led)
    certificate = finder.find(state, step)
    state.step = step
    state.previous[...] = state.u
    return certificate


def _load(scene: Scene, state: State, finder: Finder, increments: int) -> Certificate:
    """In increments up to the last motion or change of roles, breaking bonds on the way."""
    fracturing, steps = Fracturing(scene), scene.experiment.steps
    assert state.broken_step is not None
    last = last_event(scene)
    count = min(increments, last)
    certificate = None
    for step in np.unique(np.linspace(1, last, count).round().astype(int)).tolist():
        while True:
            certificate = _settle_at(scene, state, finder, step)
            broken = np.count_nonzero(state.broken_step >= 0)
            fracturing.break_bonds(state.u, state.broken_step, step)
            if np.count_nonzero(state.broken_step >= 0) == broken:
                break
    state.step = steps
    assert certificate is not None
    return certificate


def _last_change_of_roles(scene: Scene) -> int:
    """The last step before roles change within the run; 0 where they never do."""
    steps, changes = scene.experiment.steps, [0]
    for leading in scene.leading:
        first, last = leading.group.from_, leading.group.last(steps)
        changes += [step for step in (first - 1, last) if 0 <= step < steps]
    return max(changes)
