"""Properties of whole steps in which a component takes part, of rules that take loads, and of rules
whose particles have directions.
"""

from __future__ import annotations

import pickle
from contextlib import suppress

import numpy as np

from pbdkit.array_types import Floats
from pbdkit.errors import PluginError
from pbdkit.io.sinks import MemorySink
from pbdkit.io.snapshot import StateMoment, Tables
from pbdkit.plugin import (
    Anchors,
    Diagnostic,
    FollowerRule,
    FractureModel,
    FramePolicy,
    Lattice,
    Loadable,
    NeighbourMetric,
    ParticleOperation,
    TurnsParticles,
)
from pbdkit.plugin.rule import material_of
from pbdkit.scene.leader_groups import rotations_of
from pbdkit.scene.scene import Scene
from pbdkit.simulation import Simulation, record
from pbdkit.stepping.engine_choice import obstacle
from pbdkit.stepping.numpy_engine import Stepper
from pbdkit.stepping.rule_evaluation import Evaluator, summed
from pbdkit.stepping.state import State, initial_state
from pbdkit.testing.component_properties import differing
from pbdkit.testing.mechanics import resumed
from pbdkit.testing.states import (
    advanced,
    differences,
    displacements,
    gathered,
    here,
    measured_by,
    spacing,
    standing,
    state_with,
)
from pbdkit.testing.subject import NotAskedError, PropertyError, Subject, asked_of, flat, place_of

LOAD_ROUNDING = 1e-9
"""As a share of the largest number: sums cancel."""


@asked_of(FollowerRule)
def bears_loads_as_forces(subject: Subject) -> None:
    """Where it takes loads, one adds itself to `force`, what it adds to the move is the same
    wherever neighbours stand, and none changes nothing."""
    rule, scene = subject.component, subject.scene
    if not isinstance(rule, Loadable):
        raise NotAskedError("it takes no loads")
    if material_of(subject.component) is None:
        raise NotAskedError("its parameters leave it without a material")
    evaluator, p = Evaluator(scene), scene.constants.rule
    load, added = here(scene, 1)["u"], []
    for seed in (0, 1):
        total = summed((c, None) for c in gathered(scene, differences(scene, seed)))
        at, under = standing(scene, **here(scene, seed)), rule.loaded(total, load, p)
        _compare(evaluator.force(under, at), evaluator.force(total, at) + load, "the force is not")
        still = flat(rule.loaded(total, 0.0 * load, p))
        if any(np.any(still[name] != value) for name, value in flat(total).items()):
            raise PropertyError("`loaded` changes the sums where the load is 0")
        added.append(evaluator.move(total, at, load) - evaluator.move(total, at))
    _compare(added[0], added[1], "what it adds to the move is not, wherever neighbours stand,")


def _compare(one: object, other: object, what: str) -> None:
    expected = flat(other)
    size = max(float(np.abs(value).max()) for value in expected.values())
    for name, value in flat(one).items():
        if not (np.abs(value - expected[name]) <= LOAD_ROUNDING * size).all():
            raise PropertyError(f"`loaded`: {what} the same as without, and the load ({name})")


STEPPED = (FollowerRule, NeighbourMetric, Lattice, FramePolicy, FractureModel)
STEP_ROUNDING = 1e-12
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
        if most > STEP_ROUNDING and not anchors:
            remedy = ""
            if isinstance(component, FollowerRule):
                remedy = ": use differences `d`, not `here.u`, or declare `uses_reference`"
            elif isinstance(component, FramePolicy):
                remedy = (
                    ": let the weights of each point sum to 1, or take on `pbdkit.plugin.Anchors`"
                )
            fault = f"a translated body moves otherwise, by {most:.3g} of its displacement"
            raise PropertyError(f"{fault}, {place_of(scene.experiment)}{remedy}")
    if anchors and most <= STEP_ROUNDING:
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
        if not off <= STEP_ROUNDING:
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
    record(Simulation.of_scene(scene, start=start.copy()), whole)
    datasets = resumed(scene, again, STEPS - 1, start), whole.dataset()
    found, needed = ({str(n): v for n, v in ds.variables.items()} for ds in datasets)
    for name in differing(needed, found):
        raise PropertyError(f"`{name}` of a run gone on with after step {STEPS - 1} is another one")


@asked_of(*STEPPED, ParticleOperation)
def is_the_same_compiled(subject: Subject) -> None:
    """The compiled engine gives the numbers of the numpy engine, to the last bit; what does not
    compile is stepped by numpy, and says so."""
    scene = subject.scene
    if reason := obstacle():
        raise NotAskedError(reason)
    from pbdkit.stepping.numba_engine.engine import CompiledStepper

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


ROUNDING = 1e-11
"""As a share of the spacing; rotations sum some hundred roundings of 1e-16."""
ANGLE = 2.0


@asked_of(FollowerRule)
def follows_rotations(subject: Subject) -> None:
    """A body without frame whose particles have directions moves as before, turned, where it is
    turned as a whole, its directions with it, to rounding."""
    anywhere = not subject.component.uses_reference
    if not isinstance(subject.component, TurnsParticles):
        raise NotAskedError("its particles have no directions")
    scenes = [scene for scene in subject.scenes if anywhere and scene.frame is None]
    if not scenes:
        raise NotAskedError("a frame, or where a particle stands, may tell directions apart")
    for scene in scenes:
        start = Stepper(scene).advance(state_with(scene, displacements(scene, 6)), 2)
        turned = _turned(scene, start.copy())
        expected = _positions(scene, _turned(scene, Stepper(scene).advance(start, STEPS)))
        found = _positions(scene, Stepper(scene).advance(turned, STEPS))
        if (off := np.abs(found - expected).max() / spacing(scene)) > ROUNDING:
            fault = f"a turned body moves otherwise, by {off:.3g} of the spacing"
            remedy = "count its neighbours' places from its own direction"
            raise PropertyError(f"{fault}, {place_of(scene.experiment)}: {remedy}")


def _turned(scene: Scene, state: State) -> State:
    """The state turned about the origin, its directions with it, in place."""
    c, s = np.cos(ANGLE), np.sin(ANGLE)
    raster, rows = scene.raster, scene.raster.body_rows
    place, X = raster.place_of(rows), raster.reference(rows).T
    flat = state.u.reshape(2, -1)
    x, y = X + flat[:, place]
    flat[:, place] = np.stack([c * x - s * y, s * x + c * y]) - X
    state.previous[...] = state.u
    for pair in rotations_of(scene.experiment):
        cosine, sine = (state.particle_values[m].reshape(-1) for m in pair)
        cosine[...], sine[...] = c * cosine - s * sine, s * cosine + c * sine
    return state


def _positions(scene: Scene, state: State) -> Floats:
    rows = scene.raster.body_rows
    positions: Floats = scene.raster.reference(rows) + scene.raster.table(state.u)[rows]
    return positions
