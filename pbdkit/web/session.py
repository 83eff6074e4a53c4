"""Live session: steps of an experiment are made while leaders are moved, parameters are changed and
bonds are cut.

Steps are made with the same engines as in a run, and stability is analysed in a separate thread.
Earlier states are kept so that the user can go back. Cuts are mapped from the deformed body to the
body at rest.
"""

from __future__ import annotations

import math
import threading
from base64 import b64encode
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from copy import copy
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from pbdkit.array_types import Array, Floats
from pbdkit.errors import ExperimentError, PbdkitError, did_you_mean
from pbdkit.lattice.raster import FRAME
from pbdkit.model.experiment import Experiment
from pbdkit.plugin.fracture_model import Segment
from pbdkit.scene.leader_groups import Leading, build_leading
from pbdkit.scene.scene import Scene, build_scene, renumbered
from pbdkit.stability.analysis import Analysis
from pbdkit.stability.relaxation import tuned
from pbdkit.stepping.divergence import Guard
from pbdkit.stepping.engine_choice import Choice, choose, make_engine
from pbdkit.stepping.numpy_engine import Engine
from pbdkit.stepping.state import State, initial_state, unmoved_state
from pbdkit.web.script import NEVER, Displacement, LeaderScript, Saved, Script, save_script
from pbdkit.web.view_frames import KIND, Camera, ViewFrame

MAX_PARTICLES = 4000
"""Maximum number of particles for which the spectrum is computed in about a second."""
SLOW_STEPS = 2000
"""Number of steps to a relative distance of 1e-3 above which convergence is called slow."""


@dataclass(frozen=True)
class Judgement:
    """Result of a stability analysis in one word, "stable", "slow", "diverging" or "unknown", with
    the reason."""

    word: str
    why: str


def judged(experiment: Experiment) -> Judgement:
    """Analyse the stability of the body in its initial state."""
    try:
        scene = build_scene(experiment)
        if scene.raster.count > MAX_PARTICLES:
            size = f"the body has more than {MAX_PARTICLES} particles"
            return Judgement("unknown", f"{size}; use `pbdkit check` for larger ones")
        analysis = Analysis(scene)
        return _worded(analysis)
    except Exception as error:  # A session continues after errors of plugins.
        return Judgement("unknown", str(error) or type(error).__name__)


def _worded(analysis: Analysis) -> Judgement:
    radius, stable = analysis.spectral_radius, analysis.stable
    if radius is None:
        reasons = analysis.left_out
        return Judgement(
            "unknown", reasons[0] if reasons else ("the spectrum of these steps is not known")
        )
    if not stable:
        bound = analysis.largest_stable_relaxation
        remedy = f"; relaxation below {bound:.4g} is stable" if bound else ""
        return Judgement(
            "diverging", (f"the fastest mode grows by a factor of {radius:.4g} per step{remedy}")
        )
    steps = analysis.steps_to["1e-3"]
    if steps is None:
        return Judgement("slow", "a mode neither grows nor decays: it is not constrained")
    decay = f"the slowest mode decays to 1/1000 in {steps} steps"
    if steps <= SLOW_STEPS:
        return Judgement("stable", decay)
    best = analysis.best_memory
    memory = analysis.scene.experiment.stepping.memory
    remedy = (
        (f"; convergence is fastest with memory {best:.4g}")
        if best and not math.isclose(best, memory)
        else ""
    )
    return Judgement("slow", decay + remedy)


class Judge:
    """Stability analysis of the newest experiment in a separate thread."""

    def __init__(self, report: Callable[[Judgement], None]) -> None:
        self._report, self._requested = report, threading.Condition()
        self._newest: Experiment | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._work, name="judge", daemon=True)
        self._thread.start()

    def submit(self, experiment: Experiment) -> None:
        """Queue an experiment. It replaces an experiment that is still waiting."""
        with self._requested:
            self._newest = experiment
            self._requested.notify()

    def close(self) -> None:
        """End the thread after the analysis in progress."""
        with self._requested:
            self._closed = True
            self._requested.notify()

    def _work(self) -> None:
        while True:
            with self._requested:
                self._requested.wait_for(lambda: self._closed or self._newest is not None)
                if self._closed:
                    return
                experiment, self._newest = self._newest, None
            assert experiment
            self._report(judged(experiment))


MAX_NUMPY_PARTICLES = 20_000
"""Number of particles up to which steps are made with numpy. With compiled kernels, some changes of
parameters would require compiling again, which takes seconds."""


class LiveStepper:
    """The scene of a script between two changes, and the engine that steps it."""

    def __init__(self, script: Script, scene: Scene) -> None:
        self.script, self.scene = script, scene
        self.choice = Choice("numpy", 1, "")
        self._engine: Engine | None = None
        self._since, self._until = 0, -1

    def changed(self) -> None:
        """Invalidate the scene after a change of the script."""
        self._until = -1

    def set(self, state: State) -> State:
        """Build the scene for the step that follows a state. Return the state, adapted to this
        scene. Raises ExperimentError if that is impossible."""
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
        """Advance a state by a number of steps. The arrays of `state` are reused."""
        end = min(state.step + steps, NEVER)
        while state.step < end:
            state = self.set(state)
            assert self._engine
            state = self._engine.advance(state, min(end, self._until) - state.step)
        return state


def stepped(experiment: Experiment) -> Scene:
    """Build the scene of an experiment for stepping, with numbers for relaxation and momentum. If
    the solver computes equilibria, the relaxation is the optimal one, provided that it can be
    computed quickly."""
    scene = build_scene(experiment)
    if experiment.solver.makes_steps:
        return tuned(scene)
    parts = experiment.model_dump(mode="json", by_alias=True)
    plain, best = (
        experiment.of_parts(parts | {"solver": {"type": "stepping", "relaxation": relaxation}})
        for relaxation in (1.0, "auto")
    )
    with suppress(ExperimentError):
        if scene.raster.count <= MAX_PARTICLES:
            return tuned(build_scene(best))
    return build_scene(plain)


def _led(scene: Scene, groups: Sequence[LeaderScript]) -> tuple[Leading, ...]:
    """Return the groups of the scene. Groups that are moved by the mouse have its motion."""
    groups_of_scene = []
    for leading, group_of_script in zip(
        build_leading(scene.raster, scene.experiment), groups, strict=True
    ):
        motion = group_of_script.manual or leading.group.motion
        group = leading.group.model_copy(update={"motion": motion})
        groups_of_scene.append(replace(leading, group=group))
    return tuple(groups_of_scene)


def _chosen(scene: Scene) -> Choice:
    if scene.experiment.stepping.engine == "auto" and scene.raster.count <= MAX_NUMPY_PARTICLES:
        return Choice("numpy", 1, "the body is small")
    return choose(scene)


def fitted(state: State, scene: Scene) -> State:
    """Adapt a state to a scene with more or fewer groups, or with bonds that have become
    breakable."""
    missing = len(scene.leading) - len(state.starts)
    if missing:
        starts = (*state.starts, *(None,) * missing)[: len(scene.leading)]
        state = replace(state, starts=starts)
    if (state.broken_step is not None) == scene.has_fracture:
        return state
    fresh = unmoved_state(scene, scene.raster.shape[1:])
    bonds = {name: getattr(fresh, name) for name in ("broken_step", "broken_length", "bond_values")}
    return replace(state, **bonds)


MAX_STATE_BYTES = 256 * 2**20
"""Maximum memory of kept states in bytes."""
MIN_STATES = 4
"""Minimum number of kept states."""
MAX_STATES = 200
"""Maximum number of kept states."""


class History:
    """The initial state and kept later states. The intervals between kept states increase with the
    number of steps, so that they fit into the memory."""

    def __init__(self, start: State) -> None:
        self._states = [start.copy()]
        self._apart = 1

    @property
    def steps(self) -> list[int]:
        """Return the steps of the kept states."""
        return [state.step for state in self._states]

    def keep(self, state: State) -> None:
        """Keep a state if it is far enough from the last one."""
        if state.step < self._states[-1].step + self._apart:
            return
        self._states.append(state.copy())
        while not self._fits():
            self._apart *= 2
            self._thin()

    def copy(self) -> History:
        """Return an independent copy with the same states."""
        history = copy(self)
        history._states = [*self._states]
        return history

    def before(self, step: int) -> State:
        """Return a copy of the last kept state that is not later than a step."""
        return self._states[max(0, bisect_right(self.steps, step) - 1)].copy()

    def cut_back(self, step: int) -> None:
        """Remove the states after a step."""
        self._states = [state for state in self._states if state.step <= step] or self._states[:1]

    def _fits(self) -> bool:
        count = len(self._states)
        return count <= MIN_STATES or (
            count <= MAX_STATES and sum(map(_size, self._states)) <= MAX_STATE_BYTES
        )

    def _thin(self) -> None:
        states = self._states[:1]
        for state in self._states[1:]:
            if state.step >= states[-1].step + self._apart:
                states.append(state)
        self._states = states


def _size(state: State) -> int:
    """Return the approximate number of bytes of a state."""
    arrays = (state.broken_step, state.broken_length, *state.bond_values, *state.particle_values)
    return 2 * state.u.nbytes + sum(array.nbytes for array in arrays if array is not None)


SAMPLES = 64
"""Number of points at which a line is mapped to the body at rest."""
LINE_TOLERANCE = 0.25
"""Tolerance with which a line is replaced by a polyline, in units of the spacing."""
ALONG = 0.29
"""Position along a bond, as a fraction of its length, at which it is cut. It is not in the middle,
because bonds cross each other there."""
WIDTH = 1e-3
"""Length of the segment that cuts a single bond."""


def at_rest(line: Segment, positions: Floats, reference: Floats, spacing: float) -> list[Segment]:
    """Map a line across the deformed body to straight segments in the body at rest. From each point
    of the line the displacement of the nearest particle is subtracted."""
    a, b = np.array(line[0]), np.array(line[1])
    count = min(SAMPLES, 2 + int(2 * math.dist(*line) / spacing))
    places = a + np.linspace(0.0, 1.0, count)[:, None] * (b - a)
    margin = 2 * spacing
    low, high = np.minimum(a, b) - margin, np.maximum(a, b) + margin
    near = ((positions >= low) & (positions <= high)).all(axis=1)
    if not near.any():
        return []
    _, nearest = KDTree(positions[near]).query(places)
    places = places + (reference[near] - positions[near])[nearest]
    corners = _straightened(places, LINE_TOLERANCE * spacing)
    points = [(float(x), float(y)) for x, y in places[corners]]
    return [(a, b) for a, b in pairwise(points) if a != b]


def across(ends: Floats) -> Segment:
    """Return a short segment in the body at rest. It crosses a bond, and none of the bonds that
    cross this bond."""
    (x, y), direction = ends[0], ends[1] - ends[0]
    middle = np.array([x, y]) + ALONG * direction
    aside = WIDTH * np.array([-direction[1], direction[0]])
    (ax, ay), (bx, by) = middle - aside, middle + aside
    return (float(ax), float(ay)), (float(bx), float(by))


def _straightened(places: Floats, tolerance: float) -> list[int]:
    """Return the indices of those places that are the corners of a polyline. The distance of all
    other places from the polyline is within the tolerance."""
    first, last = places[0], places[-1]
    direction, offsets = last - first, places - first
    length = math.hypot(*direction)
    if length == 0.0:
        distance = np.hypot(*offsets.T)
    else:
        share = np.clip(offsets @ direction / length**2, 0.0, 1.0)
        distance = np.hypot(*(offsets - share[:, None] * direction).T)
    worst = int(np.argmax(distance))
    if len(places) < 3 or distance[worst] <= tolerance:
        return [0, len(places) - 1]
    corners = _straightened(places[: worst + 1], tolerance)
    return corners[:-1] + [worst + n for n in _straightened(places[worst:], tolerance)]


MAX_PICTURE_INTERVAL_S = 0.25
"""Maximum time in seconds between pictures at any speed."""
MAX_REPLAY_S = 0.5
"""Maximum time in seconds for replaying steps from a kept state."""


@dataclass
class GrabbedParticle:
    """A particle held by the mouse.

    `group` is the leader group that moves it, or None until the mouse moves. `start` is the offset
    of the group when the particle was grabbed, and `by` the displacement of the mouse since then.
    With `frees` the particle becomes a follower again when it is released.
    """

    row: int
    group: int | None = None
    start: Displacement = (0.0, 0.0)
    by: Displacement = (0.0, 0.0)
    frees: bool = False


@dataclass
class Session:
    """Experiment that is continued step by step, without a last step. Commands are executed between
    two steps.

    All changes are recorded in the script. If the user goes back and makes a change, later changes
    are removed. Messages other than pictures are passed to `notify`. Raises ExperimentError if the
    scene of the experiment cannot be built.
    """

    experiment: Experiment
    output: Path | None = None
    notify: Callable[[dict[str, Any]], None] = field(default=lambda message: None)
    running: bool = False
    due_steps: int = 0
    speed: int = 1
    grabbed: GrabbedParticle | None = None
    step_s: float = 0.0
    pictures: int = 0
    """Number of the current picture."""

    def __post_init__(self) -> None:
        scene = stepped(self.experiment)
        self.script = Script.of(scene.experiment)
        self.stage = LiveStepper(self.script, scene)
        self.state = self.stage.set(initial_state(scene))
        self.end, self.guard = 0, Guard.of(scene, self.state)
        self.camera = Camera(self.stage.scene, self.experiment.diagnostics)
        self.history = History(self.state)

    @property
    def step(self) -> int:
        """Return the last step that was made."""
        return self.state.step

    def advance(self, steps: int) -> None:
        """Advance by a number of steps, in which the grabbed group moves linearly to the mouse. If
        a step fails, the state is restored, stepping stops, and an error is reported."""
        begin = self.step
        self._lead(begin, begin + steps)
        clock = perf_counter()
        try:
            self.state = self.stage.advance(self.state, steps)
        except PbdkitError as error:
            self._undo(begin, str(error))
            return
        self.step_s = (perf_counter() - clock) / steps
        self.pictures += 1
        self.end = max(self.end, self.step)
        self.due_steps = max(0, self.due_steps - steps)
        try:
            self.guard.look(self.stage.scene, self.state)
            self.history.keep(self.state)
        except FloatingPointError as error:
            self.running, self.due_steps = False, 0
            text = f"{error} diverged; go back, and choose other parameters"
            self.notify({"is": "error", "text": text})

    @property
    def next_steps(self) -> int:
        """Return the number of steps until the next picture. It is 0 while stepping is stopped."""
        if not (self.running or self.due_steps):
            return 0
        limit = max(1, int(MAX_PICTURE_INTERVAL_S / self.step_s)) if self.step_s else 1
        return min(limit, self.speed if self.running else self.due_steps)

    def rewind(self, step: int) -> None:
        """Go to a step and stop. If repeating the steps from the last kept state would take long,
        go to this kept state instead."""
        self.running, self.due_steps, self.grabbed = False, 0, None
        step = min(step, self.end)
        snapshot = self.history.before(step)
        if (step - snapshot.step) * self.step_s > MAX_REPLAY_S:
            step = snapshot.step
        self._replay(step)

    def grab(self, row: int) -> None:
        """Grab the particle of a visible row. It becomes a leader when it is moved."""
        if row >= len(self.camera.rows):
            raise ExperimentError(f"there is no particle {row}")
        row_in_table = int(self.camera.rows[row])
        if self.stage.scene.raster.table_kind[row_in_table] == FRAME:
            raise ExperimentError("frame points follow the body, and cannot be moved")
        self.release()
        self.grabbed = GrabbedParticle(row_in_table)

    def drag(self, by: Displacement) -> None:
        """Set the displacement of the mouse since the particle was grabbed."""
        if self.grabbed is None:
            return
        if self.grabbed.group is None:
            self._take(self.grabbed)
        self.grabbed.by = by

    def release(self) -> None:
        """Release the particle. If it was a leader when it was grabbed, it stays at its place;
        otherwise it becomes a follower again."""
        grabbed, self.grabbed = self.grabbed, None
        if grabbed and grabbed.group is not None and grabbed.frees:
            with self._editing():
                self.script.let_go(grabbed.group, self.step)

    def rest(self) -> None:
        """Stop stepping, and release the grabbed particle."""
        self.running, self.due_steps = False, 0
        self.release()

    def turn(self, name: str, value: float) -> None:
        """Change a number from the next step on."""
        with self._editing():
            self.script.turn(name, self.step, value)

    def cut(self, line: tuple[Displacement, Displacement]) -> None:
        """Cut along a line across the deformed body, before the next step."""
        camera = self.camera
        positions = camera.positions(self.state)
        segments = at_rest(line, positions, camera.reference, camera.spacing)
        if not segments:
            raise ExperimentError("the cut crosses no bond; draw it across some bonds")
        self._cut(segments)

    def cut_bond(self, row: int) -> None:
        """Cut a bond, given by its row."""
        if row >= len(self.camera.bonds):
            raise ExperimentError(f"there is no bond {row}")
        ends = self.camera.reference[self.camera.bonds[row].astype(int)]
        self._cut([across(ends)])

    def save(self) -> Saved:
        """Write the session up to the current step as an experiment. Existing files are not
        overwritten."""
        result = save_script(self.script, self.step, self.output)
        self.notify(
            {"is": "saved", "path": str(result.path), "text": result.text, "steps": self.step}
        )
        return result

    def colour(self, name: str) -> None:
        """Select the field that determines the colours, or the kinds of particles."""
        if name not in (KIND, *self.camera.fields.labels):
            names = self.camera.fields.labels
            raise ExperimentError(f"there is no field '{name}'{did_you_mean(name, names)}")
        self.camera.colour = name

    def frame(self) -> ViewFrame:
        """Return a picture of the current state. If its field cannot be computed, an error is
        reported, and particles are coloured by their kinds."""
        now = self.stage.scene, self.state, self.end, self.pictures, self.step_s
        try:
            return self.camera.frame(*now)
        except PbdkitError as error:
            self.camera.colour = KIND
            self.notify({"is": "error", "text": str(error)})
            return self.camera.frame(*now)

    def plain(self) -> Experiment:
        """Return the experiment with the current values of its parameters."""
        return self.script.experiment.of_parts(self.script.playing(self.step))

    def _cut(self, segments: list[Segment]) -> None:
        if self.stage.choice.engine == "compiled" and not self.stage.scene.has_fracture:
            self.notify(
                {"is": "note", "text": ("A kernel for cuts is compiled; this takes some seconds.")}
            )
        with self._editing():
            self.script.cut(segments, self.step)

    def _take(self, grabbed: GrabbedParticle) -> None:
        # If the particle cannot be moved, it is not grabbed.
        step, self.grabbed = self.step, None
        with self._editing():
            leading = self.stage.scene.leading
            groups = [
                n
                for n, leaders in enumerate(leading)
                if leaders.group.leads(step + 1) and grabbed.row in leaders.rows
            ]
            if groups:
                grabbed.group = self.script.grab(groups[0], step)
            else:
                grabbed.group, grabbed.frees = self.script.pick(grabbed.row + 1, step), True
        self.grabbed = grabbed
        manual = self.script.groups[grabbed.group].manual
        assert manual
        grabbed.start = manual.at(step - self.script.groups[grabbed.group].begins + 1)

    def _lead(self, begin: int, end: int) -> None:
        if self.grabbed is None or self.grabbed.group is None:
            return
        group = self.script.groups[self.grabbed.group]
        target = (
            self.grabbed.start[0] + self.grabbed.by[0],
            self.grabbed.start[1] + self.grabbed.by[1],
        )
        first = begin - group.begins + 1
        if group.manual and group.manual.at(first) != target:
            self._forget_later()
            group.manual.lead(first, end - group.begins + 1, target)

    @contextmanager
    def _editing(self) -> Iterator[None]:
        """Change the script in the block. Changes after the current step are removed before. If an
        error occurs, everything is restored."""
        script, history = self.script.copy(), self.history.copy()
        state, end = self.state, self.end
        try:
            self._forget_later()
            yield
            self._changed()
        except PbdkitError:
            self.script.restore(script)
            self.history, self.state, self.end = history, state, end
            self._changed()
            raise

    def _forget_later(self) -> None:
        """Remove the changes after a step."""
        if self.step < self.end:
            self.end = self.step
            self.script.cut_back(self.step)
            self.history.cut_back(self.step)
            self._changed()

    def _changed(self) -> None:
        """Apply a change of the script. Raises PbdkitError if that is impossible."""
        self.stage.changed()
        self.state = self.stage.set(self.state)

    def _undo(self, step: int, text: str) -> None:
        self.running, self.due_steps, self.grabbed = False, 0, None
        self.end = step
        self.script.cut_back(step)
        self.history.cut_back(step)
        self._replay(step)
        self.notify({"is": "error", "text": text})

    def _replay(self, step: int) -> None:
        state = self.history.before(step)
        self.stage.changed()
        self.state = self.stage.set(self.stage.advance(state, step - state.step))


Message = dict[str, Any]


def static_message(session: Session) -> Message:
    """Return the content of a session that is constant: the body, its bonds (pairs of rows, with 32
    bits each) and triangles, its fields, and the names and ranges of its adjustable numbers."""
    camera, scene = session.camera, session.stage.scene
    return {
        "is": "scene",
        "name": session.experiment.name,
        "particles": scene.raster.count,
        "count": len(camera.rows),
        "every": camera.every,
        "spacing": camera.spacing,
        "bonds": _as_text(camera.bonds, "<u4"),
        "triangles": _as_text(camera.triangles, "<u4"),
        "beyond": _as_text(camera.beyond, "<f4"),
        "fields": camera.fields.labels,
        "numbers": [
            {
                "name": number.name,
                "span": number.span,
                "units": number.units,
                "factor": number.factor,
            }
            for number in session.script.numbers.values()
        ],
    }


def _as_text(array: Array, dtype: str) -> str:
    return b64encode(array.astype(dtype).tobytes()).decode()


def status_message(session: Session) -> Message:
    """Return the data of a session that may change at any step, for instance whether it is running.
    Pictures are sent separately."""
    choice, grabbed = session.stage.choice, session.grabbed
    threads = f" on {choice.threads} threads" if choice.threads > 1 else ""
    return {
        "is": "standing",
        "running": session.running,
        "speed": session.speed,
        "colour": session.camera.colour,
        "engine": choice.engine + threads,
        "held": grabbed is not None,
        "numbers": {
            name: number.at(session.step + 1) for name, number in session.script.numbers.items()
        },
        "cuts": len(session.script.cuts),
    }
