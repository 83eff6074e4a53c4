"""The driver of a part: what all processes decide together about a run."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pbdkit.equilibrium.certificate import Certificate
from pbdkit.equilibrium.settlement import Settling
from pbdkit.errors import NotSharedError
from pbdkit.experiment.solvers import Settle
from pbdkit.interfaces import Draws
from pbdkit.ranks.communicator import Ranks
from pbdkit.ranks.divided_stepper import DividedStepper
from pbdkit.ranks.halo import Halo, part_of_state
from pbdkit.ranks.part import part_of
from pbdkit.ranks.subdomain import Subdomain
from pbdkit.results.progress import StoppedError, Watch
from pbdkit.runs.drivers import SECONDS_A_VALUE, Driver, Stepwise
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.stepping.choice import Choice, choose, make_engine
from pbdkit.stepping.guard import EVERY, Guard, most_of, size_of
from pbdkit.stepping.numpy_engine import Engine
from pbdkit.stepping.state import State, initial_state


def whole_of(ranks: Ranks, scene: Scene) -> Scene | None:
    """The scene that processes have parts of, in the first of them."""
    if not ranks.first:
        return None
    return build_scene(scene.experiment) if scene.raster.extent else scene


class Division:
    """A scene cut up among processes: this one's part, and how a state of it is put together with
    those of the others. The first process keeps the `whole` scene where somebody looks at that."""

    def __init__(self, ranks: Ranks, scene: Scene, parts: list[Subdomain]) -> None:
        self.ranks, self.count, self.subdomains = ranks, scene.raster.total, parts
        self.part = part_of(scene, self.subdomains[ranks.rank])
        self.scene, experiment = self.part.scene, scene.experiment
        self.halo = Halo(ranks, self.subdomains, self.part)
        self.whole: Scene | None = None
        measured = any(not each.local for each in experiment.diagnostics)
        with ranks.agreeing():
            if measured or experiment.stepping.settle:
                self.whole = self.whole_of(scene)

    def whole_of(self, scene: Scene) -> Scene | None:
        """The scene that others have parts of, in the first process."""
        return self.whole or whole_of(self.ranks, scene)

    def begun(self, scene: Scene) -> tuple[State, bool]:
        """The part of the state at time 0, and whether it can be made again from the part alone:
        random numbers are drawn for the whole, by the first process."""
        experiment, whole = scene.experiment, None
        draws = any(isinstance(part, Draws) for part in (experiment.rule, experiment.fracture))
        if not (experiment.initial.is_drawn or draws):
            state, at_rest = initial_state(self.scene), experiment.initial.at_rest
            if not at_rest:
                self.halo.renew(state)
            return state, at_rest
        with self.ranks.agreeing():
            if found := self.whole_of(scene):
                whole = initial_state(found)
        return self.dealt(whole), False

    def dealt(self, whole: State | None) -> State:
        """The part of a state that the first process has."""
        members = self.ranks.every(self.halo.members)
        if whole is None or not self.ranks.first:
            return self._state(None)
        axes = self.scene.axes
        parts = zip(self.subdomains, members, strict=True)
        return self._state(part_of_state(whole, axes, own, some) for own, some in parts)

    def _state(self, each: Iterable[State] | None) -> State:
        found: State = self.ranks.dealt(each)
        return found

    def gathered(self, state: State) -> State | None:
        """The whole state, in the first process."""
        return self.halo.gathered(state)

    def standing(self, own: dict[str, Any]) -> dict[str, Any]:
        """That of a driver of the part with the state of the whole, as it is joined."""
        return own | {"state": self.halo.joined(own["state"])}

    def taken_up(self, standing: Mapping[str, Any]) -> dict[str, Any]:
        """For the part, where the first process has that of the whole."""
        rest = self.ranks.told({key: part for key, part in standing.items() if key != "state"})
        state = self.dealt(standing.get("state") if self.ranks.first else None)
        return {**rest, "state": state}

    def stepper(self, choice: Choice) -> tuple[Engine, Choice]:
        """Of the part: a thread a process, unless more are asked for."""
        if self.scene.experiment.stepping.threads == "auto":
            choice = replace(choice, threads=1)
        with self.ranks.agreeing():
            engine, choice = make_engine(self.scene, choice)
        steps = self.part.subdomain.steps
        return DividedStepper(self.ranks, self.scene, engine, self.halo, steps), choice


class DividedWatch(Watch):
    """All stop where one is asked to; the first shows how far the run is."""

    def __init__(self, ranks: Ranks, watch: Watch) -> None:
        super().__init__(lambda: ranks.any(watch.stopping()), watch.show)


@dataclass
class DividedGuard(Guard):
    """Looks at all parts."""

    ranks: Ranks

    def most(self, state: State) -> float:
        """The largest of all."""
        return self.ranks.most(super().most(state))

    def worst(self, scene: Scene, state: State) -> int:
        """That of the part with the largest, the first on ties."""
        found = self.ranks.every((super().most(state), super().worst(scene, state)))
        return int(found[int(np.argmax([most for most, _ in found]))][1])  # NaN is largest


class DividedSettling(Settling):
    """The first process looks whether the whole has settled."""

    def __init__(self, division: Division, settle: Settle) -> None:
        self._division, self._settling = division, None
        if whole := division.whole:
            self._settling = Settling(whole, settle, initial_state(whole), Watch())
        self._agree(None)

    def _agree(self, found: Certificate | None) -> Certificate | None:
        """On what the first process has found."""
        own = self._settling
        told = self._division.ranks.told(own and (found, own.pace, own.obstacle))
        certificate: Certificate | None = told[0]
        self.pace, self.obstacle = told[1:]
        return certificate

    def look(self, state: State) -> Certificate | None:
        """As one process does. Raises StoppedError in all."""
        whole, found, ranks = self._division.gathered(state), None, self._division.ranks
        error: Exception | None = None
        if self._settling and whole is not None:
            self._settling.pace, self._settling.obstacle = self.pace, self.obstacle
            try:
                found = self._settling.look(whole)
            except StoppedError as stopped:
                error = stopped
        ranks.raise_first(error)
        return self._agree(found)


class DividedStepwise(Stepwise):
    """Steps a part; decides with the others."""

    def __init__(self, division: Division, scene: Scene, watch: Watch) -> None:
        ranks, self._division = division.ranks, division
        nearness = scene.experiment.neighbours.nearness()
        refuse(
            scene,
            [
                (bool(nearness), ("neighbours",), "neighbours are found anew in every step"),
                (ranks.any(scene.frame_changes), ("frame",), CHANGING_FRAME),
            ],
        )
        start, anew = division.begun(scene)
        Driver.__init__(self, division.scene, start, DividedWatch(ranks, watch))
        self._engine, self.choice = division.stepper(ranks.told(choose(scene)))
        self._patience = self._steps_in(SECONDS_A_VALUE * scene.raster.total / ranks.size)
        size = size_of(scene) + ranks.most(most_of(start))
        self.guard = DividedGuard(size, 0, EVERY, None if anew else start.copy(), ranks)
        self.settling, self.kept = None, -1
        if asked := scene.experiment.stepping.settle:
            self.settling = DividedSettling(division, asked)

    def _steps_in(self, seconds_a_step: float) -> int:
        """As the first process finds it."""
        return int(self._division.ranks.told(super()._steps_in(seconds_a_step)))

    def standing(self) -> dict[str, Any]:
        """With the state of the whole, as it is joined."""
        return self._division.standing(super().standing())

    def take_up(self, standing: Mapping[str, Any]) -> None:
        """From the state of the whole, which the first process has."""
        super().take_up(self._division.taken_up(standing))


CHANGING_FRAME = "a frame whose map follows numbers of the rule that change in time"


def refuse(scene: Scene, unfit: Iterable[tuple[bool, tuple[str, ...], str]]) -> None:
    """Raises NotSharedError for the first clash of what does not fit, of a field."""
    for clash, field, text in unfit:
        if clash:
            refusal = f"{text}, which several processes cannot share yet; run it in one process"
            raise scene.experiment.located(NotSharedError(refusal, field))
