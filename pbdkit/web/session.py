"""The verdict of the spectrum on the numbers as they are: stable, slow or diverging, and why.

Steps a script: by the engines of any run, with the scene as the script has it at each step.

States that are kept, so that one can go back.

Cuts as they are drawn, across the body as it stands, put back to where they are at rest.

A body that is stepped, and what is done to it meanwhile.

What a page has to know of a session besides pictures.
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

from pbdkit.array_types import Floats
from pbdkit.errors import ExperimentError, PbdkitError
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
from pbdkit.web.script import NEVER, Led, Saved, Script, Way, saved
from pbdkit.web.view_frames import COLOURS, Camera, ViewFrame

LARGEST = 4000
"""Particles of which the spectrum is found in about a second."""
SLOW = 2000
"""Steps to a thousandth from which on a body is called slow."""


@dataclass(frozen=True)
class Judgement:
    """In one word, "stable", "slow", "diverging" or "unknown", and why."""

    word: str
    why: str


def judged(experiment: Experiment) -> Judgement:
    """Of the body as it starts, at rest unless the experiment says otherwise."""
    try:
        scene = build_scene(experiment)
        if scene.raster.count > LARGEST:
            size = f"the body has more than {LARGEST} particles"
            return Judgement("unknown", f"{size}; `pbdkit check` tells of larger ones")
        analysis = Analysis(scene)
        return _worded(analysis)
    except Exception as error:  # whatever a plugin raises, the session goes on
        return Judgement("unknown", str(error) or type(error).__name__)


def _worded(analysis: Analysis) -> Judgement:
    radius, stable = analysis.spectral_radius, analysis.stable
    if radius is None:
        left = analysis.left_out
        return Judgement("unknown", left[0] if left else "these steps have no spectrum")
    if not stable:
        bound = analysis.largest_stable_relaxation
        remedy = f"; relaxation below {bound:.4g} is stable" if bound else ""
        return Judgement("diverging", f"the fastest mode grows {radius:.4g} times a step{remedy}")
    steps = analysis.steps_to["1e-3"]
    if steps is None:
        return Judgement("slow", "a mode neither grows nor shrinks: nothing holds it")
    fading = f"the slowest mode shrinks to a thousandth in {steps} steps"
    if steps <= SLOW:
        return Judgement("stable", fading)
    best = analysis.best_memory
    own = analysis.scene.experiment.stepping.memory
    remedy = f"; memory {best:.4g} is fastest" if best and not math.isclose(best, own) else ""
    return Judgement("slow", fading + remedy)


class Judge:
    """Judges in a thread of its own, the newest experiment that it was given."""

    def __init__(self, tell: Callable[[Judgement], None]) -> None:
        self._tell, self._asked = tell, threading.Condition()
        self._newest: Experiment | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._work, name="judge", daemon=True)
        self._thread.start()

    def ask(self, experiment: Experiment) -> None:
        """Of this experiment, unless another is asked of before its turn."""
        with self._asked:
            self._newest = experiment
            self._asked.notify()

    def close(self) -> None:
        """Ends the thread once it has judged what it is at."""
        with self._asked:
            self._closed = True
            self._asked.notify()

    def _work(self) -> None:
        while True:
            with self._asked:
                self._asked.wait_for(lambda: self._closed or self._newest is not None)
                if self._closed:
                    return
                experiment, self._newest = self._newest, None
            assert experiment
            self._tell(judged(experiment))


SMALL = 20_000
"""Particles up to which numpy steps: kernels would be compiled anew for some turns of numbers, and
each takes seconds."""


class LiveStepper:
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


ROOM = 256 * 2**20
"""Bytes that kept states may take."""
FEWEST, MOST = 4, 200
"""Of states."""


class History:
    """The start, and later states ever farther apart the more there are: never more than fit."""

    def __init__(self, start: State) -> None:
        self._states = [start.copy()]
        self._apart = 1

    @property
    def steps(self) -> list[int]:
        """Those of which the state is kept."""
        return [state.step for state in self._states]

    def keep(self, state: State) -> None:
        """Notes a state, if it is far enough from the last."""
        if state.step < self._states[-1].step + self._apart:
            return
        self._states.append(state.copy())
        while not self._fits():
            self._apart *= 2
            self._thin()

    def copy(self) -> History:
        """The same states, kept on their own."""
        found = copy(self)
        found._states = [*self._states]
        return found

    def before(self, step: int) -> State:
        """A copy of the last state kept that is not after a step."""
        return self._states[max(0, bisect_right(self.steps, step) - 1)].copy()

    def cut_back(self, step: int) -> None:
        """Forgets the states after a step."""
        self._states = [state for state in self._states if state.step <= step] or self._states[:1]

    def _fits(self) -> bool:
        count = len(self._states)
        return count <= FEWEST or (count <= MOST and sum(map(_size, self._states)) <= ROOM)

    def _thin(self) -> None:
        kept = self._states[:1]
        for state in self._states[1:]:
            if state.step >= kept[-1].step + self._apart:
                kept.append(state)
        self._states = kept


def _size(state: State) -> int:
    """Its bytes, about."""
    more = (state.broken_step, state.broken_length, *state.bond_values, *state.particle_values)
    return 2 * state.u.nbytes + sum(array.nbytes for array in more if array is not None)


SAMPLES = 64
NEAR = 0.25
"""By so many spacings a line may be straightened."""
ALONG, WIDTH = 0.29, 1e-3
"""Where a bond is cut, and how wide: bonds cross each other in the middle."""


def at_rest(line: Segment, positions: Floats, reference: Floats, spacing: float) -> list[Segment]:
    """A line across the body as straight segments at rest, each place moved back as the particle
    next to it."""
    from scipy.spatial import cKDTree

    a, b = np.array(line[0]), np.array(line[1])
    count = min(SAMPLES, 2 + int(2 * math.dist(*line) / spacing))
    places = a + np.linspace(0.0, 1.0, count)[:, None] * (b - a)
    margin = 2 * spacing
    low, high = np.minimum(a, b) - margin, np.maximum(a, b) + margin
    near = ((positions >= low) & (positions <= high)).all(axis=1)
    if not near.any():
        return []
    _, nearest = cKDTree(positions[near]).query(places)
    places = places + (reference[near] - positions[near])[nearest]
    corners = _straightened(places, NEAR * spacing)
    points = [(float(x), float(y)) for x, y in places[corners]]
    return [(a, b) for a, b in pairwise(points) if a != b]


def across(ends: Floats) -> Segment:
    """A short segment at rest that crosses a bond and, of those that cross it, no other."""
    (x, y), way = ends[0], ends[1] - ends[0]
    middle = np.array([x, y]) + ALONG * way
    aside = WIDTH * np.array([-way[1], way[0]])
    (ax, ay), (bx, by) = middle - aside, middle + aside
    return (float(ax), float(ay)), (float(bx), float(by))


def _straightened(places: Floats, tolerance: float) -> list[int]:
    """The corners of a line that nowhere lies farther than that from these places."""
    first, last = places[0], places[-1]
    way, apart = last - first, places - first
    length = math.hypot(*way)
    if length == 0.0:
        distance = np.hypot(*apart.T)
    else:
        share = np.clip(apart @ way / length**2, 0.0, 1.0)
        distance = np.hypot(*(apart - share[:, None] * way).T)
    worst = int(np.argmax(distance))
    if len(places) < 3 or distance[worst] <= tolerance:
        return [0, len(places) - 1]
    before = _straightened(places[: worst + 1], tolerance)
    return before[:-1] + [worst + n for n in _straightened(places[worst:], tolerance)]


LONGEST_S = 0.25
"""A picture waits for so long at most, whatever the speed."""
REPLAY_S = 0.5
"""One goes back to a step that takes no longer than this from the last state kept before it."""


@dataclass
class GrabbedParticle:
    """A particle that the mouse holds: the group that is led, None until it is moved, where that
    was when it was grabbed, and how far the mouse has come since. `frees` tells that it follows
    again once it is let go."""

    row: int
    group: int | None = None
    start: Way = (0.0, 0.0)
    by: Way = (0.0, 0.0)
    frees: bool = False


@dataclass
class Session:
    """Steps an experiment without end, and does what it is asked between two steps.

    All of it goes into the script. Whoever goes back and does something forgets what came after.
    `says` is told what is to be known besides pictures. Raises ExperimentError for an experiment
    of which there is no scene.
    """

    experiment: Experiment
    output: Path | None = None
    says: Callable[[dict[str, Any]], None] = field(default=lambda message: None)
    running: bool = False
    owed: int = 0
    speed: int = 1
    held: GrabbedParticle | None = None
    step_s: float = 0.0
    pictures: int = 0
    """How many there could have been."""

    def __post_init__(self) -> None:
        scene = stepped(self.experiment)
        self.script = Script.of(scene.experiment)
        self.stage = LiveStepper(self.script, scene)
        self.state = self.stage.set(initial_state(scene))
        self.end, self.guard = 0, Guard.of(scene, self.state)
        self.camera, self.history = Camera(self.stage.scene), History(self.state)

    @property
    def step(self) -> int:
        """The last that was made."""
        return self.state.step

    def advance(self, steps: int) -> None:
        """So many steps, with what is held led evenly to where the mouse is. Where they cannot be
        made all is as before, the body rests, and it is said why."""
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
        self.owed = max(0, self.owed - steps)
        try:
            self.guard.look(self.stage.scene, self.state)
            self.history.keep(self.state)
        except FloatingPointError as error:
            self.running, self.owed = False, 0
            text = f"{error} left all bounds; go back, and take other numbers"
            self.says({"is": "error", "text": text})

    @property
    def next_steps(self) -> int:
        """How many steps the next picture is away; 0 where the body rests."""
        if not (self.running or self.owed):
            return 0
        most = max(1, int(LONGEST_S / self.step_s)) if self.step_s else 1
        return min(most, self.speed if self.running else self.owed)

    def rewind(self, step: int) -> None:
        """To that step, or to a state kept before it where it is a long way from there; the body
        rests then."""
        self.running, self.owed, self.held = False, 0, None
        step = min(step, self.end)
        kept = self.history.before(step)
        if (step - kept.step) * self.step_s > REPLAY_S:
            step = kept.step
        self._replay(step)

    def grab(self, row: int) -> None:
        """Takes hold of the particle of a row that is shown; nothing is done until it is moved."""
        if row >= len(self.camera.rows):
            raise ExperimentError(f"there is no particle {row}")
        self.release()
        found = int(self.camera.rows[row])
        if self.stage.scene.raster.table_kind[found] == FRAME:
            raise ExperimentError("points of the frame follow others, and cannot be led")
        self.held = GrabbedParticle(found)

    def drag(self, by: Way) -> None:
        """How far the mouse has come since the particle was grabbed."""
        if self.held is None:
            return
        if self.held.group is None:
            self._take(self.held)
        self.held.by = by

    def release(self) -> None:
        """Lets go: who led before stays there, others follow again."""
        held, self.held = self.held, None
        if held and held.group is not None and held.frees:
            with self._editing():
                self.script.let_go(held.group, self.step)

    def rest(self) -> None:
        """Steps no more, and lets go of what is held."""
        self.running, self.owed = False, 0
        self.release()

    def turn(self, name: str, value: float) -> None:
        """Another value of a number, from the next step on."""
        with self._editing():
            self.script.turn(name, self.step, value)

    def cut(self, line: tuple[Way, Way]) -> None:
        """Cuts along a line across the body as it stands, before the next step."""
        camera = self.camera
        positions = camera.positions(self.state)
        found = at_rest(line, positions, camera.reference, camera.spacing)
        if not found:
            raise ExperimentError("the cut lies beside the body; draw it across some bonds")
        self._cut(found)

    def cut_bond(self, row: int) -> None:
        """Cuts a bond by its row."""
        if row >= len(self.camera.bonds):
            raise ExperimentError(f"there is no bond {row}")
        ends = self.camera.reference[self.camera.bonds[row].astype(int)]
        self._cut([across(ends)])

    def save(self) -> Saved:
        """Writes all that was done until now as an experiment, beside what is there already."""
        found = saved(self.script, self.step, self.output)
        self.says({"is": "saved", "path": str(found.path), "text": found.text, "steps": self.step})
        return found

    def frame(self) -> ViewFrame:
        """A picture of the body as it stands."""
        return self.camera.frame(self.stage.scene, self.state, self.end, self.pictures, self.step_s)

    def plain(self) -> Experiment:
        """The experiment with its numbers as they are now."""
        return self.script.experiment.of_parts(self.script.playing(self.step))

    def _cut(self, segments: list[Segment]) -> None:
        if self.stage.choice.engine == "compiled" and not self.stage.scene.has_fracture:
            self.says({"is": "note", "text": "A kernel is made for cuts: some seconds."})
        with self._editing():
            self.script.cut(segments, self.step)

    def _take(self, held: GrabbedParticle) -> None:
        step, self.held = self.step, None  # nothing is, where it cannot be led
        with self._editing():
            leading = self.stage.scene.leading
            groups = [
                n
                for n, of in enumerate(leading)
                if of.group.leads(step + 1) and held.row in of.rows
            ]
            if groups:
                held.group = self.script.grab(groups[0], step)
            else:
                held.group, held.frees = self.script.pick(held.row + 1, step), True
        self.held = held
        hand = self.script.groups[held.group].hand
        assert hand
        held.start = hand.at(step - self.script.groups[held.group].begins + 1)

    def _lead(self, begin: int, end: int) -> None:
        if self.held is None or self.held.group is None:
            return
        led = self.script.groups[self.held.group]
        target = self.held.start[0] + self.held.by[0], self.held.start[1] + self.held.by[1]
        first = begin - led.begins + 1
        if led.hand and led.hand.at(first) != target:
            self._forget_later()
            led.hand.lead(first, end - led.begins + 1, target)

    @contextmanager
    def _editing(self) -> Iterator[None]:
        """Lets something be done to the script after what came after this step is forgotten. Where
        it cannot be done all is as before, what came after too."""
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
        """What came after this step."""
        if self.step < self.end:
            self.end = self.step
            self.script.cut_back(self.step)
            self.history.cut_back(self.step)
            self._changed()

    def _changed(self) -> None:
        """The script says something else. Raises PbdkitError where it cannot."""
        self.stage.changed()
        self.state = self.stage.set(self.state)

    def _undo(self, step: int, text: str) -> None:
        self.running, self.owed, self.held = False, 0, None
        self.end = step
        self.script.cut_back(step)
        self.history.cut_back(step)
        self._replay(step)
        self.says({"is": "error", "text": text})

    def _replay(self, step: int) -> None:
        state = self.history.before(step)
        self.stage.changed()
        self.state = self.stage.set(self.stage.advance(state, step - state.step))


Message = dict[str, Any]


def scenery(session: Session) -> Message:
    """What stays as it is: the body, its bonds (pairs of rows, 32 bits each), its numbers."""
    camera, scene = session.camera, session.stage.scene
    return {
        "is": "scene",
        "name": session.experiment.name,
        "particles": scene.raster.count,
        "count": len(camera.rows),
        "every": camera.every,
        "spacing": camera.spacing,
        "bonds": b64encode(camera.bonds.astype("<u4").tobytes()).decode(),
        "colours": COLOURS,
        "numbers": [
            {"name": number.name, "span": number.span} for number in session.script.numbers.values()
        ],
    }


def standing(session: Session) -> Message:
    """What may change at any step, but for what pictures tell."""
    choice, held = session.stage.choice, session.held
    threads = f" on {choice.threads} threads" if choice.threads > 1 else ""
    return {
        "is": "standing",
        "running": session.running,
        "speed": session.speed,
        "colour": session.camera.colour,
        "engine": choice.engine + threads,
        "held": held is not None,
        "numbers": {
            name: number.at(session.step + 1) for name, number in session.script.numbers.items()
        },
        "cuts": len(session.script.cuts),
    }
