"""The recorder: takes from the states of a run what the dataset holds, and hands it to a sink."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from itertools import chain, compress
from typing import Any

import numpy as np

from pbdkit.results import layout
from pbdkit.results.layout import Column, Values, When
from pbdkit.results.measured import Measured
from pbdkit.results.moment import StateMoment
from pbdkit.results.physical import Twins
from pbdkit.results.sink import Sink
from pbdkit.results.tables import Tables
from pbdkit.scene.raster import FRAME
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State


@dataclass(frozen=True)
class Outcome:
    """How a run ended; `certificate` says of an equilibrium how far it can be off."""

    status: str
    stop_reason: str
    steps: int
    certificate: dict[str, Any] | None = None


@dataclass
class Seen:
    """The last moments, in steps, of which anything was taken, and of which a record was made."""

    step: float = -1
    recorded: float = -1


class Recorder:
    """Records the run of one scene into a sink; `seen` decides how it goes on."""

    def __init__(self, scene: Scene, sink: Sink) -> None:
        self._scene, self.sink = scene, sink
        self._tables, self._measured = Tables(scene), Measured(scene)
        self._columns = columns_of(scene)
        self._twins = Twins(self._columns)
        self.seen = Seen()
        self.warnings: tuple[str, ...] = ()

    def begin(self, history: Iterable[Values] | None = None) -> None:
        """Hands over the columns and everything that is known before the first step, or instead of
        it the `history` of a run that is gone on with."""
        count = self._scene.experiment.record_count
        planned = {"time": count, "step": max(count, self._scene.experiment.steps + 1)}
        self.sink.begin(self._columns, self._measured.sizes, planned)
        for values in map(self._twins.beside, self._known()) if history is None else history:
            self.sink.put(values)

    def _known(self) -> Iterator[Values]:
        """What is known before the first step; made one after the other, and not all at once."""
        raster, scene = self._scene.raster, self._scene
        numbers = raster.before + np.arange(1, raster.count + 1)
        yield {"particle": numbers, "number": numbers}
        yield {"axis": np.array(list("xyz"[: scene.axes]))}
        site = raster.site_table()
        yield {"site": site, **dict(zip(layout.INDICES, site.T, strict=False))}
        yield {"role": np.where(raster.table_kind == FRAME, layout.OF_FRAME, layout.OF_BODY)}
        yield {"inside": self._tables.inside.astype(np.int8)}
        yield {"reference": raster.reference()}
        if scene.experiment.shows_bonds:
            bonds = scene.bonds
            yield {"bond": np.arange(1, len(bonds.ends) + 1, dtype=np.int32), "shell": bonds.shell}
            yield {
                "bond_ends": np.add(
                    bonds.ends, 1 + raster.before, dtype=np.int32, casting="same_kind"
                )
            }
        if self._measured.shows_leaders:
            yield {"leader_group": np.arange(len(scene.leading))}
        if self._measured.shows_loads:
            yield {"load": np.arange(len(scene.experiment.loads))}
        if self._measured.shows_obstacles:
            yield {"obstacle": np.arange(len(scene.barriers))}
        if self._measured.shows_principal:
            yield {"principal": np.array([1, 2])}
        yield self._measured.coordinates

    @np.errstate(all="ignore")
    def observe(self, state: State, *, last: bool = False, within: float | None = None) -> None:
        """Takes what is wanted of this step; positions too of the `last` of a run that stops before
        its end, which may have come before without that; else a step that was seen is left out.
        An equilibrium `within` a step is recorded with that moment as its time. Raises
        FloatingPointError where a recorded value has left the finite numbers; nothing of that step
        is kept."""
        if (state.step if within is None else within) > self.seen.step or last:
            self._put(state, self._taken(state, last, within))

    def _put(self, state: State, values: Values) -> None:
        if values:
            self.sink.put(self._twins.beside(values))
        now = values.get("time", state.step)
        self.seen = Seen(now, now if "time" in values else self.seen.recorded)

    def _taken(self, state: State, last: bool, within: float | None = None) -> Values:
        """What is wanted of a step."""
        moment = StateMoment(state, self._tables, within=within)
        values: Values = {}
        experiment, now = self._scene.experiment, state.step if within is None else within
        late = last and now > self.seen.recorded
        planned = within is not None or experiment.records(state.step)
        recorded = late or (not last and planned)
        if recorded:
            position = moment.position()
            if not np.isfinite(position).all():
                before = self._scene.raster.before
                row = int(np.flatnonzero(~np.isfinite(position).all(axis=1))[0])
                raise FloatingPointError(f"particle {before + row + 1} at step {state.step}")
            values = {"time": now, "position": position, "kind": moment.kind()}
            values |= self._measured.remembered(moment, first=self.seen.recorded < 0)
            values |= self._diagnosed(When.RECORD, moment)
        stepped = recorded or experiment.solver.makes_steps
        if self._measured.every_step and stepped and not last:
            values |= {"step": now} | self._diagnosed(When.STEP, moment)
        return values

    def _diagnosed(self, when: When, moment: StateMoment) -> Values:
        return self._measured.diagnosed(when, moment)

    def finish(self, state: State, outcome: Outcome, prediction: dict[str, Any]) -> None:
        """Hands over what is known at the end, and the attributes, with what was predicted before
        the first step; `warnings` says what the user should know of the last state."""
        # Where a run diverged, what broke since the last record is no result.
        diverged, recorded = outcome.status == "diverged", self.seen.recorded
        if state.step < recorded < state.step + 1:
            moment = StateMoment(state, self._tables, within=recorded)
        else:
            known = int(recorded) if diverged else state.step
            moment = StateMoment(state, self._tables, known)
        if not diverged and (warning := self._inside_out(state)):
            self.warnings = (warning,)
        if self._scene.has_fracture:
            steps, strains = moment.broken_step(), moment.broken_strain()
            self.sink.put({"broken_step": steps, "broken_strain": strains})
        with np.errstate(all="ignore"):
            self.sink.put(self._twins.beside(self._diagnosed(When.END, moment)))
        self.sink.finish(self._attributes(outcome, prediction))

    def _inside_out(self, state: State) -> str | None:
        return StateMoment(state, self._tables).cells.inside_out()

    def _attributes(self, outcome: Outcome, prediction: dict[str, Any]) -> dict[str, str]:
        experiment = self._scene.experiment
        return {
            "Conventions": layout.CONVENTIONS,
            "schema_version": layout.SCHEMA_VERSION,
            "title": experiment.name,
            "pbdkit_version": version("pbdkit"),
            "experiment": experiment.model_dump_json(by_alias=True),
            "plugins": json.dumps(experiment.distributions()),
            "prediction": json.dumps(prediction),
            "status": outcome.status,
            "stop_reason": outcome.stop_reason,
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
        } | ({"certificate": json.dumps(outcome.certificate)} if outcome.certificate else {})


def columns_of(scene: Scene) -> list[Column]:
    """Those of the scene's dataset."""
    measured = Measured(scene)
    wanted = (
        scene.experiment.shows_bonds,
        scene.has_fracture,
        measured.every_step,
        measured.shows_leaders,
        measured.shows_loads,
        measured.shows_obstacles,
        measured.shows_principal,
    )
    some = chain(*compress(layout.optional_columns(), wanted))
    all_of_them = [*layout.base_columns(scene.axes), *some, *measured.columns()]
    columns = measured.physical.columns(all_of_them)
    record = scene.experiment.record
    if record.dtype == "float32":
        columns = [replace(c, dtype="f4") if c.grows and c.dtype == "f8" else c for c in columns]
    if record.increments:
        columns = [replace(c, dtype="f8") if c.name in layout.TIMES else c for c in columns]
    return columns
