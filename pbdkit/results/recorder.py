"""The recorder: takes from the states of a run what the dataset holds, and hands it to a sink."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import version
from typing import Any

import numpy as np

from pbdkit.analysis.forecast import prediction
from pbdkit.interfaces import Diagnostic
from pbdkit.registry.blame import blaming
from pbdkit.results import layout
from pbdkit.results.inversion import inside_out
from pbdkit.results.layout import Column
from pbdkit.results.measuring import measured_at_end, refuse_unfit, refuse_unknown
from pbdkit.results.moment import StateMoment
from pbdkit.results.remembered import RememberedColumns
from pbdkit.results.tables import Tables
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State

Values = dict[str, Any]


class Sink(ABC):
    """Where a dataset goes while it is made. It may keep what it is given: nobody changes that
    afterwards. `abandon` leaves nothing behind."""

    @abstractmethod
    def begin(self, columns: list[Column], sizes: dict[str, int], planned: dict[str, int]) -> None:
        """The columns to come, the sizes of the dimensions that do not grow, and how many entries
        are planned along those that do."""

    @abstractmethod
    def put(self, values: Values) -> None:
        """One entry for each column that grows, or the whole of a column that does not."""

    @abstractmethod
    def finish(self, attributes: dict[str, str]) -> None:
        """Nothing more comes."""

    @abstractmethod
    def abandon(self) -> None:
        """The run failed: what was put is not wanted."""


@dataclass(frozen=True)
class Outcome:
    """How a run ended; `certificate` says of an equilibrium how far it can be off."""

    status: str
    stop_reason: str
    steps: int
    certificate: dict[str, Any] | None = None


class Recorder:
    """Records the run of one scene into a sink."""

    def __init__(self, scene: Scene, sink: Sink) -> None:
        self._scene = scene
        self._sink = sink
        self._tables = Tables(scene)
        self.last_recorded = -1
        """The last step of which positions were taken."""
        self.warnings: tuple[str, ...] = ()
        self._remembered = RememberedColumns(scene)
        diagnostics = scene.experiment.diagnostics
        self._recorded = [d for d in diagnostics if not (d.every_step or d.at_end)]
        self._stepped = [d for d in diagnostics if d.every_step]
        self._last = [d for d in diagnostics if d.at_end]
        wanted = {dim for d in diagnostics for v in d.variables() for dim in v.dims}
        self._shows_leaders = "leader_group" in wanted

    def begin(self) -> None:
        """Hands over the columns and everything that is known before the first step."""
        columns, experiment = self._columns(), self._scene.experiment
        known = self._known()
        sizes = {
            "particle": self._scene.raster.count,
            "axis": self._scene.axes,
            "index": self._scene.axes,
        }
        if self._scene.shows_bonds:
            sizes |= {"bond": len(self._scene.bonds.ends), "end": 2}
        if self._shows_leaders:
            sizes["leader_group"] = len(self._scene.leading)
        for diagnostic in experiment.diagnostics:
            sizes |= {name: len(values) for name, values in diagnostic.coordinates().items()}
        self._shapes = {c.name: tuple(sizes[d] for d in c.dims[1:]) for c in columns if c.grows}
        records = experiment.recording.count(experiment.steps)
        self._sizes = sizes
        self._sink.begin(columns, sizes, {"time": records, "step": experiment.steps + 1})
        for name, values in known.items():
            self._sink.put({name: values()})

    def _known(self) -> dict[str, Callable[[], Any]]:
        """What is known before the first step; made one after the other, and not all at once."""
        raster, scene = self._scene.raster, self._scene
        numbers = np.arange(1, raster.count + 1)
        known: dict[str, Callable[[], Any]] = {
            "particle": lambda: numbers,
            "number": lambda: numbers,
            "axis": lambda: np.array(list("xyz"[: scene.axes])),
            "site": raster.site_table,
            "reference": raster.reference,
        }
        if scene.shows_bonds:
            known |= {"bond": lambda: scene.bonds.ends, "shell": lambda: scene.bonds.shell}
        if self._shows_leaders:
            known["leader_group"] = lambda: np.arange(len(scene.leading))
        for diagnostic in scene.experiment.diagnostics:
            for name, values in diagnostic.coordinates().items():
                known[name] = partial(np.asarray, values)
        return known

    def observe(self, state: State) -> None:
        """Takes what is wanted of this step. Raises FloatingPointError where a recorded value has
        left the finite numbers; nothing of that step is kept."""
        with np.errstate(all="ignore"):
            self._observe(state, self.records(state.step), bool(self._stepped))

    def records(self, step: int) -> bool:
        """Whether positions are recorded at that step."""
        experiment = self._scene.experiment
        return experiment.recording.keeps(step, experiment.steps)

    def next_after(self, step: int) -> int:
        """The next step after `step` at which something is taken."""
        experiment = self._scene.experiment
        if self._stepped:
            return step + 1
        return experiment.recording.next_after(step, experiment.steps)

    def observe_last(self, state: State) -> None:
        """Records the step at which a run stops before its end."""
        if state.step > self.last_recorded:
            with np.errstate(all="ignore"):
                self._observe(state, recorded=True, stepped=False)

    def _observe(self, state: State, recorded: bool, stepped: bool) -> None:
        moment = StateMoment(state, self._tables)
        values: Values = {}
        if recorded:
            position = moment.position()
            if not np.isfinite(position).all():
                row = int(np.flatnonzero(~np.isfinite(position).all(axis=1))[0])
                raise FloatingPointError(f"particle {row + 1} at step {state.step}")
            values = {"time": state.step, "position": position, "kind": moment.kind()}
            values |= self._remembered.at(moment) | self._measured(self._recorded, moment)
            if self.last_recorded < 0:
                values |= self._remembered.once(moment)
            self.last_recorded = state.step
        if stepped:
            values |= {"step": state.step} | self._measured(self._stepped, moment)
        if values:
            self._sink.put(values)

    def finish(self, state: State, outcome: Outcome) -> None:
        """Hands over what is known at the end, and the attributes; `warnings` says what the user
        should know of the last state."""
        # Where a run diverged, what broke since the last record is no result.
        diverged = outcome.status == "diverged"
        moment = StateMoment(state, self._tables, self.last_recorded if diverged else state.step)
        if not diverged and (warning := inside_out(moment)):
            self.warnings = (warning,)
        if self._scene.has_fracture:
            steps, strains = moment.broken_step(), moment.broken_strain()
            self._sink.put({"broken_step": steps, "broken_strain": strains})
        for diagnostic in self._last:
            with np.errstate(all="ignore"):
                self._sink.put(measured_at_end(diagnostic, moment, self._sizes))
        self._sink.finish(self._attributes(outcome))

    def _columns(self) -> list[Column]:
        columns = layout.base_columns()
        if self._scene.shows_bonds:
            columns += layout.bond_columns()
        if self._scene.has_fracture:
            columns += layout.broken_columns()
        columns += self._remembered.checked({c.name for c in columns})
        if self._stepped:
            columns.append(layout.step_column())
        if self._shows_leaders:
            columns.append(layout.leader_column())
        for diagnostic in self._scene.experiment.diagnostics:
            for name, values in diagnostic.coordinates().items():
                columns.append(layout.own_coordinate(name, values.dtype.str[1:]))
            known = {d for c in columns for d in c.dims} | {diagnostic.own_dimension} - {""}
            for variable in diagnostic.variables():
                refuse_unknown(diagnostic, variable, known, {c.name for c in columns})
                columns.append(layout.diagnostic_column(variable, diagnostic))
        return [self._as_recorded(column) for column in columns]

    def _as_recorded(self, column: Column) -> Column:
        """The column with the dtype that the experiment asks for."""
        short = self._scene.experiment.record.dtype == "float32"
        return (
            replace(column, dtype="f4")
            if short and column.grows and column.dtype == "f8"
            else column
        )

    def _measured(self, diagnostics: list[Diagnostic], moment: StateMoment) -> Values:
        values: Values = {}
        for diagnostic in diagnostics:
            place = self._scene.experiment.diagnostics.index(diagnostic)
            with blaming(diagnostic, f"at step {moment.step}", "diagnostics", place):
                measured = diagnostic.measure(moment)
                for variable, value in zip(diagnostic.variables(), measured, strict=True):
                    refuse_unfit(variable, value, self._shapes[variable.name], moment.step)
                    values[variable.name] = np.array(value)
        return values

    def _attributes(self, outcome: Outcome) -> dict[str, str]:
        experiment = self._scene.experiment
        return {
            "Conventions": layout.CONVENTIONS,
            "schema_version": layout.SCHEMA_VERSION,
            "title": experiment.name,
            "pbdkit_version": version("pbdkit"),
            "experiment": experiment.model_dump_json(by_alias=True),
            "plugins": json.dumps(experiment.distributions()),
            "prediction": json.dumps(prediction(self._scene)),
            "status": outcome.status,
            "stop_reason": outcome.stop_reason,
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
        } | ({"certificate": json.dumps(outcome.certificate)} if outcome.certificate else {})
