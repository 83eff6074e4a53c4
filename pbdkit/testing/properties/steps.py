"""What is asked of whole steps that a component takes part in."""

from __future__ import annotations

import pickle
from contextlib import suppress

import numpy as np

from pbdkit.errors import PluginError
from pbdkit.interfaces import (
    Anchors,
    Diagnostic,
    FollowerRule,
    FractureModel,
    FramePolicy,
    Lattice,
    NeighbourMetric,
)
from pbdkit.results.moment import StateMoment
from pbdkit.results.sink import MemorySink
from pbdkit.results.tables import Tables
from pbdkit.runs.course import Run, record
from pbdkit.scene.scene import Scene
from pbdkit.stepping.choice import obstacle
from pbdkit.stepping.evaluator import Evaluator
from pbdkit.stepping.numpy_engine import Stepper
from pbdkit.stepping.state import State, initial_state
from pbdkit.testing.laws import resumed
from pbdkit.testing.properties.repetition import differing
from pbdkit.testing.question import flat
from pbdkit.testing.states import (
    Floats,
    advanced,
    displacements,
    measured_by,
    spacing,
    state_with,
)
from pbdkit.testing.subject import NotAskedError, PropertyError, Subject, asked_of, place_of

STEPPED = (FollowerRule, NeighbourMetric, Lattice, FramePolicy, FractureModel)
ROUNDING = 1e-12
"""As a share of the largest displacement; a few steps are some hundred roundings of 1e-16."""
STEPS = 4


@asked_of(*STEPPED)
def rests(subject: Subject) -> None:
    """A body at rest inside a frame stays at rest exactly, and none of its bonds breaks: what moves
    by 1e-17 has moved."""
    fracture = [(scene, scene.experiment.fracture) for scene in subject.scenes]
    quiet = [scene for scene, model in fracture if not model.check(scene.neighbourhood.shells())]
    if not quiet:
        raise NotAskedError("it warns that bonds break at rest in every scene that was tried")
    for scene in quiet:
        engine, state = Stepper(scene), initial_state(scene)
        if scene.frame is None:
            _refuse_to_leave_rest(scene)
        for _ in range(STEPS):
            state = engine.advance(state)
            where = f"in step {state.step} {place_of(scene.experiment)}"
            if state.broken_step is not None and (state.broken_step > 0).any():
                broken = int((state.broken_step > 0).sum())
                raise PropertyError(f"{broken} bonds of a body at rest break {where}")
            if scene.frame and state.u.any():
                raise PropertyError(_restless(np.abs(state.u).max(), where))


def _refuse_to_leave_rest(scene: Scene) -> None:
    """Raises PropertyError where a particle moves that has all its neighbours, at rest: without a
    frame those at edges may."""
    for slots in scene.neighbourhood.slots:
        most = max(abs(float(component)) for component in Evaluator(scene).at_rest(slots))
        if most > 0.0:
            raise PropertyError(_restless(most, place_of(scene.experiment)))


def _restless(most: float, where: str) -> str:
    wanted = "zero differences must give a move of exactly zero"
    remedy = "let terms of opposite neighbours cancel one by one"
    return f"a body at rest moves by {most:.3g} {where}: {wanted}; {remedy}"


@asked_of(FollowerRule, NeighbourMetric, Lattice, FramePolicy)
def follows_translations(subject: Subject) -> None:
    """A body that is translated as a whole moves as before, translated, to rounding; rules that
    declare `uses_reference` and frames that take on `Anchors` need not."""
    component, most = subject.component, 0.0
    anchors = isinstance(component, Anchors)
    for scene in _free(subject):
        u, shift = displacements(scene, 1), spacing(scene) * np.array([0.75, -1.5])
        moved, there = advanced(scene, u, STEPS) + shift, advanced(scene, u + shift, STEPS)
        most = max(most, _apart(there[-1], moved[-1], moved))
        if most > ROUNDING and not anchors:
            remedy = ""
            if isinstance(component, FollowerRule):
                remedy = ": use differences `d`, not `here.u`, or declare `uses_reference`"
            elif isinstance(component, FramePolicy):
                remedy = ": let the weights of each point sum to 1, or take on `pbdkit.Anchors`"
            fault = f"a translated body moves otherwise, by {most:.3g} of its displacement"
            raise PropertyError(f"{fault}, {place_of(scene.experiment)}{remedy}")
    if anchors and most <= ROUNDING:
        raise PropertyError("it says that it `anchors` the body, and follows every translation")


def _free(subject: Subject) -> list[Scene]:
    """The scenes in which nothing else counts where particles stand; NotAskedError without any."""
    free = []
    for scene in subject.scenes:
        rule, frame = scene.experiment.rule, scene.experiment.frame
        anchored = isinstance(frame, Anchors) and frame is not subject.component
        if not rule.uses_reference and not anchored:
            free.append(scene)
    if not free:
        reason = f"{_whose(subject)} declares `uses_reference`, or a frame anchors"
        raise NotAskedError(f"{reason}: where a body lies may count")
    return free


def _whose(subject: Subject) -> str:
    return "it" if isinstance(subject.component, FollowerRule) else "the rule"


@asked_of(FollowerRule, FramePolicy)
def superposes(subject: Subject) -> None:
    """Where a rule declares `linear`, and with every frame, the steps from two displacements
    together are the steps from each, added, to rounding."""
    scenes = [scene for scene in subject.scenes if scene.experiment.rule.linear]
    if not scenes:
        raise NotAskedError(f"{_whose(subject)} does not declare `linear`")
    for scene in scenes:
        one, other = displacements(scene, 2, share=0.5), displacements(scene, 3, share=0.5)
        both, a, b, none = (advanced(scene, u, STEPS) for u in (one + other, one, other, 0.0 * one))
        off = _apart((both - none)[-1], (a + b - 2 * none)[-1], np.array([both, a, b, none]))
        if not off <= ROUNDING:
            remedy = "do not declare `linear`" if _whose(subject) == "it" else ""
            fault = f"displacements do not superpose, by {off:.3g} of the largest"
            raise PropertyError(f"{fault}, {place_of(scene.experiment)}: {remedy}")


def _apart(one: Floats, other: Floats, all_of_them: Floats) -> float:
    """How far two states are apart, as a share of the largest displacement there was: what grows
    takes its roundings with it."""
    return float(np.abs(one - other).max() / max(1e-300, np.abs(all_of_them).max()))


@asked_of(is_needed=True)
def continues_where_it_stopped(subject: Subject) -> None:
    """A run that is saved, read by a component made anew from its JSON and continued is the same to
    the last bit as one that was never interrupted; so is what is recorded of one that is kept as
    the run store keeps it."""
    component, kind = subject.component, type(subject.component)
    anew = kind.model_validate_json(component.model_dump_json(by_alias=True))
    if any(getattr(anew, name) != getattr(component, name) for name in kind.model_fields):
        raise NotAskedError("it is another one after JSON")
    scenes = zip(subject.scenes, Subject(anew, subject.parts).scenes, strict=True)
    for n, (scene, again) in enumerate(scenes):
        start = displacements(scene, n, share=0.4)
        _refuse_difference(initial_state(again), initial_state(scene), "a run made anew", scene)
        whole = Stepper(scene).advance(state_with(scene, start), 2 * STEPS)
        half = Stepper(scene).advance(state_with(scene, start), STEPS)
        saved, kept = pickle.dumps(half), half.copy()
        Stepper(scene).advance(half, STEPS)
        continued = Stepper(again).advance(pickle.loads(saved), STEPS)
        _refuse_difference(continued, whole, f"a run continued at step {STEPS}", scene)
        copied = Stepper(again).advance(kept, STEPS)
        _refuse_difference(copied, whole, f"a run continued from a copy of step {STEPS}", scene)
        if isinstance(component, Diagnostic):
            one = measured_by(anew, StateMoment(continued, Tables(again)))
            other = measured_by(component, StateMoment(whole, Tables(scene)))
            for name in differing(other, one):
                raise PropertyError(f"`{name}` of a run continued at step {STEPS} is another one")
    with suppress(PluginError):  # what no dataset can be made of, other properties tell
        _refuse_other_records(subject.scene, Subject(anew, subject.parts).scene)


def _refuse_other_records(scene: Scene, again: Scene) -> None:
    """Raises PropertyError where a run that is stopped, kept as the run store keeps it, and gone on
    with in a scene made anew records something else than one that was never interrupted."""
    whole, start = MemorySink(), state_with(scene, displacements(scene, 5, share=0.4))
    record(Run(scene, start=start.copy()), whole)
    datasets = resumed(scene, again, STEPS - 1, start), whole.dataset()
    found, needed = ({str(n): v for n, v in ds.variables.items()} for ds in datasets)
    for name in differing(needed, found):
        raise PropertyError(f"`{name}` of a run gone on with after step {STEPS - 1} is another one")


@asked_of(*STEPPED)
def is_the_same_compiled(subject: Subject) -> None:
    """The compiled engine gives the numbers of the numpy engine, to the last bit; what does not
    compile is stepped by numpy, and says so."""
    scene = subject.scene
    if reason := obstacle():
        raise NotAskedError(reason)
    from pbdkit.stepping.compiled.compiled_stepper import CompiledStepper

    try:
        compiled = CompiledStepper(scene)
    except PluginError as error:
        text = str(error).splitlines()[0]
        raise NotAskedError(f"numpy alone steps it, more slowly: {text}") from None
    start = displacements(scene, 4, share=0.6)
    state, expected = state_with(scene, start), state_with(scene, start)
    for steps in (1, 2, STEPS):
        state, expected = compiled.advance(state, steps), Stepper(scene).advance(expected, steps)
        _refuse_difference(state, expected, "the compiled engine", scene)


def _refuse_difference(state: State, expected: State, whose: str, scene: Scene) -> None:
    found, needed = flat(state), flat(expected)
    for name in differing(needed, found):
        by, one, other = "", np.asarray(found.get(name)), np.asarray(needed.get(name))
        if one.shape == other.shape:
            by = f", by {np.abs(one.astype(float) - other).max():.3g} at most,"
        where = f"at step {expected.step}, {place_of(scene.experiment)}"
        raise PropertyError(f"{whose} gives another `{name}`{by} {where}")
