"""A body that is stepped, and what is done to it meanwhile."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any

from pbdkit.errors import ExperimentError, PbdkitError
from pbdkit.experiment.model import Experiment
from pbdkit.interfaces.fracture_model import Segment
from pbdkit.scene.raster import FRAME
from pbdkit.sessions.cutting import across, at_rest
from pbdkit.sessions.frames import Camera, Frame
from pbdkit.sessions.hand import Way
from pbdkit.sessions.history import History
from pbdkit.sessions.saving import Saved, saved
from pbdkit.sessions.script import Script
from pbdkit.sessions.stage import Stage, stepped
from pbdkit.stepping.guard import Guard
from pbdkit.stepping.state import initial_state

LONGEST_S = 0.25
"""A picture waits for so long at most, whatever the speed."""
REPLAY_S = 0.5
"""One goes back to a step that takes no longer than this from the last state kept before it."""


@dataclass
class Held:
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
    held: Held | None = None
    step_s: float = 0.0
    pictures: int = 0
    """How many there could have been."""

    def __post_init__(self) -> None:
        scene = stepped(self.experiment)
        self.script = Script.of(scene.experiment)
        self.stage = Stage(self.script, scene)
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
        self.held = Held(found)

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

    def frame(self) -> Frame:
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

    def _take(self, held: Held) -> None:
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
