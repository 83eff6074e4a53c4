"""Steps a script: by the engines of any run, with the scene as the script has it at each step."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

from pbdkit.errors import ExperimentError
from pbdkit.experiment.model import Experiment
from pbdkit.runs.tuning import tuned
from pbdkit.scene.leader_groups import Leading, build_leading
from pbdkit.scene.scene import Scene, build_scene, renumbered
from pbdkit.sessions.judgement import LARGEST
from pbdkit.sessions.script import NEVER, Led, Script
from pbdkit.stepping.choice import Choice, choose, make_engine
from pbdkit.stepping.numpy_engine import Engine
from pbdkit.stepping.state import State, unmoved_state

SMALL = 20_000
"""Particles up to which numpy steps: kernels would be compiled anew for some turns of numbers, and
each takes seconds."""


class Stage:
    """The scene of a script from one change of it to the next, and the engine that steps it."""

    def __init__(self, script: Script, scene: Scene) -> None:
        self.script, self.scene = script, scene
        self.choice = Choice("numpy", 1, "")
        self._engine: Engine | None = None
        self._since, self._until = 0, -1

    def changed(self) -> None:
        """The script says something else than before."""
        self._until = -1

    def set(self, state: State) -> State:
        """Makes the scene that of the step after a state; returns the state as one of it. Raises
        ExperimentError for what cannot be."""
        if not self._since <= state.step < self._until:
            experiment = self.script.experiment.of_parts(self.script.playing(state.step))
            if experiment.parts_bonds != self.scene.has_fracture:
                scene = build_scene(experiment)
            else:
                scene = renumbered(self.scene, experiment)
            scene = replace(scene, leading=_led(scene, self.script.groups))
            engine, choice = make_engine(scene, _chosen(scene))
            self.scene, self._engine, self.choice = scene, engine, choice
            self._since, self._until = state.step, self.script.next_turn(state.step)
        return fitted(state, self.scene)

    def advance(self, state: State, steps: int) -> State:
        """The state so many steps on; it takes over the arrays of `state`."""
        end = min(state.step + steps, NEVER)
        while state.step < end:
            state = self.set(state)
            assert self._engine
            state = self._engine.advance(state, min(end, self._until) - state.step)
        return state


def stepped(experiment: Experiment) -> Scene:
    """The scene of an experiment, to be stepped, with numbers for relaxation and memory. In place
    of an equilibrium it takes the relaxation that leads there fastest, where that is soon known."""
    scene = build_scene(experiment)
    if experiment.solver.makes_steps:
        return tuned(scene)
    parts = experiment.model_dump(mode="json", by_alias=True)
    plain, best = (
        experiment.of_parts(parts | {"solver": {"type": "stepping", "relaxation": relaxation}})
        for relaxation in (1.0, "auto")
    )
    with suppress(ExperimentError):
        if scene.raster.count <= LARGEST:
            return tuned(build_scene(best))
    return build_scene(plain)


def _led(scene: Scene, groups: Sequence[Led]) -> tuple[Leading, ...]:
    """The scene's groups, with hands for the motions of those that are led by hand."""
    found = []
    for leading, led in zip(build_leading(scene.raster, scene.experiment), groups, strict=True):
        motion = led.hand or leading.group.motion
        group = leading.group.model_copy(update={"motion": motion})
        found.append(replace(leading, group=group))
    return tuple(found)


def _chosen(scene: Scene) -> Choice:
    if scene.experiment.stepping.engine == "auto" and scene.raster.count <= SMALL:
        return Choice("numpy", 1, "the body is small")
    return choose(scene)


def fitted(state: State, scene: Scene) -> State:
    """A state as one of a scene with more or fewer groups, or whose bonds can break by now."""
    missing = len(scene.leading) - len(state.starts)
    if missing:
        starts = (*state.starts, *(None,) * missing)[: len(scene.leading)]
        state = replace(state, starts=starts)
    if (state.broken_step is not None) == scene.has_fracture:
        return state
    fresh = unmoved_state(scene, scene.raster.shape[1:])
    bonds = {name: getattr(fresh, name) for name in ("broken_step", "broken_length", "bond_values")}
    return replace(state, **bonds)
