"""Properties of whole steps with a component, of rules that take loads, and of particles with
directions."""

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
from pbdkit.stepping.rule_evaluation import Evaluator
from pbdkit.stepping.state import State, initial_state
from pbdkit.testing.component_properties import differing
from pbdkit.testing.mechanics import resumed
from pbdkit.testing.states import (
    DivergenceError,
    advanced,
    differences,
    displacements,
    here,
    here_of,
    measured_by,
    spacing,
    state_with,
    totals,
)
from pbdkit.testing.subject import (
    NotApplicableError,
    PropertyError,
    Subject,
    flat,
    place_of,
    property_of,
)

LOAD_ROUNDING = 1e-9
"""Tolerance relative to the largest number. Terms of the sums cancel, which increases errors."""


@property_of(FollowerRule)
def bears_loads_as_forces(subject: Subject) -> None:
    """A load increases `force` by the load; its contribution to the move does not depend on the
    positions of neighbours; a load of zero changes nothing."""
    rule, scene = subject.component, subject.scene
    if not isinstance(rule, Loadable):
        raise NotApplicableError("it does not support loads")
    if material_of(subject.component) is None:
        raise NotApplicableError("it has no material with these parameters")
    evaluator, p = Evaluator(scene), scene.constants.rule
    load, added = here(scene, 1)["u"], []
    for seed in (0, 1):
        total = totals(scene, differences(scene, seed))
        at, under = here_of(scene, **here(scene, seed)), rule.loaded(total, load, p)
        _compare(
            evaluator.force(under, at),
            evaluator.force(total, at) + load,
            ("`force` with a load is not"),
        )
        still = flat(rule.loaded(total, 0.0 * load, p))
        if any(np.any(still[name] != value) for name, value in flat(total).items()):
            raise PropertyError("`loaded` changes the sums where the load is 0")
        added.append(evaluator.move(total, at, load) - evaluator.move(total, at))
    _compare(
        added[0],
        added[1],
        ("its contribution to the move is not, for all positions of neighbours,"),
    )


def _compare(value: object, reference: object, subject: str) -> None:
    expected = flat(reference)
    size = max(float(np.abs(number).max()) for number in expected.values())
    for name, number in flat(value).items():
        if not (np.abs(number - expected[name]) <= LOAD_ROUNDING * size).all():
            raise PropertyError(
                f"`loaded`: {subject} the value without load plus the load ({name})"
            )


STEPPED = (FollowerRule, NeighbourMetric, Lattice, FramePolicy, FractureModel)
"""Interfaces of components that determine a step."""
STEP_ROUNDING = 1e-12
"""Tolerance relative to the largest displacement, for several hundred roundings of 1e-16."""
STEPS = 4
"""Number of steps in a case."""


@property_of(*STEPPED)
def rests(subject: Subject) -> None:
    """A body at rest inside a frame stays exactly at rest, and none of its bonds breaks: even a
    displacement of 1e-17 is an error."""
    fracture = [(scene, scene.experiment.fracture) for scene in subject.scenes]
    quiet = [scene for scene, model in fracture if not model.check(scene.neighbourhood.shells())]
    if not quiet:
        raise NotApplicableError("in every tested scene it warns that bonds break at rest")
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
    """Raise PropertyError if a particle with all its neighbours moves from rest.

    Without a frame, particles at edges may move.
    """
    for slots in scene.neighbourhood.slots:
        largest = max(abs(float(component)) for component in Evaluator(scene).at_rest(slots))
        if largest > 0.0:
            raise PropertyError(_restless(largest, place_of(scene.experiment)))


def _restless(largest: float, where: str) -> str:
    wanted = "zero differences must give a move of exactly zero"
    remedy = "make the terms of opposite neighbours cancel one by one"
    return f"a body at rest moves by {largest:.3g} {where}: {wanted}; {remedy}"


@property_of(FollowerRule, NeighbourMetric, Lattice, FramePolicy)
def follows_translations(subject: Subject) -> None:
    """If the initial displacements are translated, all later ones are translated alike, up to
    rounding; rules with `uses_reference` and frames that derive from `Anchors` are exempt."""
    component, largest = subject.component, 0.0
    anchors = isinstance(component, Anchors)
    for scene in _free(subject):
        u, shift = displacements(scene, 1), spacing(scene) * np.array([0.75, -1.5])
        moved, shifted = advanced(scene, u, STEPS) + shift, advanced(scene, u + shift, STEPS)
        largest = max(largest, _apart(shifted[-1], moved[-1], moved))
        if largest > STEP_ROUNDING and not anchors:
            remedy = ""
            if isinstance(component, FollowerRule):
                remedy = "; use differences `d` instead of `here.u`, or declare `uses_reference`"
            elif isinstance(component, FramePolicy):
                remedy = (
                    "; make the weights of each point sum to 1, or inherit from "
                    "`pbdkit.plugin.Anchors`"
                )
            fault = f"a translated body moves differently, by {largest:.3g} of its displacement"
            raise PropertyError(f"{fault}, {place_of(scene.experiment)}{remedy}")
    if anchors and largest <= STEP_ROUNDING:
        raise PropertyError("it inherits from `Anchors`, but follows every translation")


def _free(subject: Subject) -> list[Scene]:
    """Return the scenes in which no part other than the component depends on positions.

    Raises
    ------
    NotApplicableError
        If there are none.
    """
    free = []
    for scene in subject.scenes:
        rule, frame = scene.experiment.rule, scene.experiment.frame
        anchored = isinstance(frame, Anchors) and frame is not subject.component
        if not rule.uses_reference and not anchored:
            free.append(scene)
    if not free:
        reason = f"{_rule_name(subject)} declares `uses_reference`, or a frame anchors"
        raise NotApplicableError(f"{reason}, so that the position of the body can matter")
    return free


def _rule_name(subject: Subject) -> str:
    return "it" if isinstance(subject.component, FollowerRule) else "the rule"


@property_of(FollowerRule, FramePolicy)
def superposes(subject: Subject) -> None:
    """With a rule that declares `linear`, steps from the sum of two displacement fields give the
    sum of the results for each field, up to rounding."""
    scenes = [scene for scene in subject.scenes if scene.experiment.rule.linear]
    if not scenes:
        raise NotApplicableError(f"{_rule_name(subject)} does not declare `linear`")
    for scene in scenes:
        first, second = displacements(scene, 2, share=0.5), displacements(scene, 3, share=0.5)
        starts = first + second, first, second, 0.0 * first
        both, a, b, none = (advanced(scene, u, STEPS) for u in starts)
        deviation = _apart((both - none)[-1], (a + b - 2 * none)[-1], np.array([both, a, b, none]))
        if not deviation <= STEP_ROUNDING:
            remedy = "do not declare `linear`" if _rule_name(subject) == "it" else ""
            fault = f"displacements do not superpose, by {deviation:.3g} of the largest"
            raise PropertyError(f"{fault}, {place_of(scene.experiment)}: {remedy}")


def _apart(state: Floats, reference: Floats, states: Floats) -> float:
    """Return the largest difference between two states, relative to the largest displacement.

    The largest displacement is that of all given states.
    """
    return float(np.abs(state - reference).max() / max(1e-300, np.abs(states).max()))


@property_of(is_needed=True)
def continues_where_it_stopped(subject: Subject) -> None:
    """A run that is saved, and continued with a component that is rebuilt from its JSON, gives the
    results of an uninterrupted run to the last bit. The same holds for the records of a run that is
    stored and resumed."""
    component, kind = subject.component, type(subject.component)
    copy = kind.model_validate_json(component.model_dump_json(by_alias=True))
    if any(getattr(copy, name) != getattr(component, name) for name in kind.model_fields):
        raise NotApplicableError("the component is not equal to itself after JSON")
    copied_subject = Subject(copy, subject.parts)
    scenes = zip(subject.scenes, copied_subject.scenes, strict=True)
    for n, (scene, rebuilt) in enumerate(scenes):
        start = displacements(scene, n, share=0.4)
        _refuse_difference(initial_state(rebuilt), initial_state(scene), "a repeated run", scene)
        uninterrupted = Stepper(scene)
        half = uninterrupted.advance(state_with(scene, start), STEPS)
        saved, duplicate = pickle.dumps(half), half.copy()
        whole = uninterrupted.advance(half, STEPS)
        continued = Stepper(rebuilt).advance(pickle.loads(saved), STEPS)
        _refuse_difference(continued, whole, f"a run continued at step {STEPS}", scene)
        copied = Stepper(rebuilt).advance(duplicate, STEPS)
        _refuse_difference(copied, whole, f"a run continued from a copy of step {STEPS}", scene)
        if isinstance(component, Diagnostic):
            measured = measured_by(copy, StateMoment(continued, Tables(rebuilt)))
            expected = measured_by(component, StateMoment(whole, Tables(scene)))
            for name in differing(expected, measured):
                raise PropertyError(f"`{name}` of a run continued at step {STEPS} differs")
    with suppress(PluginError):  # Other properties report the error.
        _refuse_other_records(subject.scene, copied_subject.scene)


def _refuse_other_records(scene: Scene, rebuilt: Scene) -> None:
    """Raise PropertyError if a run that is stopped, stored and resumed in a rebuilt scene has other
    records than an uninterrupted one, and DivergenceError if that one diverges.
    """
    whole, start = MemorySink(), state_with(scene, displacements(scene, 5, share=0.4))
    outcome = record(Simulation.of_scene(scene, start=start.copy()), whole).outcome
    if outcome.status == "diverged":
        raise DivergenceError(scene, outcome.steps)
    datasets = resumed(scene, rebuilt, STEPS - 1, start), whole.dataset()
    records, expected = ({str(n): v for n, v in ds.variables.items()} for ds in datasets)
    for name in differing(expected, records):
        raise PropertyError(f"`{name}` of a run resumed after step {STEPS - 1} differs")


@property_of(*STEPPED, ParticleOperation)
def is_the_same_compiled(subject: Subject) -> None:
    """The compiled engine gives the results of the numpy engine to the last bit; if a component
    cannot be compiled, the numpy engine is used, with a warning."""
    scene = subject.scene
    if reason := obstacle():
        raise NotApplicableError(reason)
    from pbdkit.stepping.numba_engine.engine import CompiledStepper

    try:
        compiled = CompiledStepper(scene)
    except PluginError as error:
        text = str(error).splitlines()[0]
        raise NotApplicableError(
            f"only the numpy engine supports it, which is slower: {text}"
        ) from None
    start = displacements(scene, 4, share=0.6)
    state, expected = state_with(scene, start), state_with(scene, start)
    for steps in (1, 2, STEPS):
        state, expected = compiled.advance(state, steps), Stepper(scene).advance(expected, steps)
        _refuse_difference(state, expected, "the compiled engine", scene)


def _refuse_difference(state: State, expected: State, origin: str, scene: Scene) -> None:
    arrays, references = flat(state), flat(expected)
    for name in differing(references, arrays):
        difference = ""
        array, reference = np.asarray(arrays.get(name)), np.asarray(references.get(name))
        if array.shape == reference.shape:
            difference = f", by at most {np.abs(array.astype(float) - reference).max():.3g},"
        where = f"at step {expected.step}, {place_of(scene.experiment)}"
        raise PropertyError(f"{origin} computes another `{name}`{difference} {where}")


ROUNDING = 1e-11
"""Tolerance relative to the spacing; rotations sum several hundred roundings of 1e-16."""
ANGLE = 2.0
"""Angle of rotation in radians."""


@property_of(FollowerRule)
def follows_rotations(subject: Subject) -> None:
    """If a body without frame is rotated together with the directions of its particles, its motion
    is rotated alike, up to rounding."""
    anywhere = not subject.component.uses_reference
    if not isinstance(subject.component, TurnsParticles):
        raise NotApplicableError("its particles have no directions")
    scenes = [scene for scene in subject.scenes if anywhere and scene.frame is None]
    if not scenes:
        raise NotApplicableError(
            "the frame or the position of a particle can distinguish directions"
        )
    for scene in scenes:
        start = Stepper(scene).advance(state_with(scene, displacements(scene, 6)), 2)
        turned = _turned(scene, start.copy())
        expected = _positions(scene, _turned(scene, Stepper(scene).advance(start, STEPS)))
        positions = _positions(scene, Stepper(scene).advance(turned, STEPS))
        if (deviation := np.abs(positions - expected).max() / spacing(scene)) > ROUNDING:
            fault = f"a rotated body moves differently, by {deviation:.3g} of the spacing"
            remedy = "measure the positions of its neighbours from its own direction"
            raise PropertyError(f"{fault}, {place_of(scene.experiment)}: {remedy}")


def _turned(scene: Scene, state: State) -> State:
    """Rotate the state and its directions about the origin in place."""
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
