"""The recorder: takes from the states of a run what the dataset holds, and hands it to a sink."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Any

import numpy as np

from pbdkit.errors import PluginError
from pbdkit.interfaces import Diagnostic
from pbdkit.results import layout
from pbdkit.results.layout import Column
from pbdkit.results.moment import StateMoment, Tables
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State

Values = dict[str, Any]


class Sink(ABC):
    """Where a dataset goes while it is made. `abandon` leaves nothing behind."""

    @abstractmethod
    def begin(self, columns: list[Column], sizes: dict[str, int], records: int) -> None:
        """The columns to come, the sizes of the dimensions that do not grow, and how many
        records are planned."""

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
    """How a run ended."""

    status: str
    stop_reason: str
    steps: int


class Recorder:
    """Records the run of one scene into a sink."""

    def __init__(self, scene: Scene, sink: Sink) -> None:
        self._scene = scene
        self._sink = sink
        self._tables = Tables(scene)
        diagnostics = scene.experiment.diagnostics
        self._recorded = [d for d in diagnostics if not d.every_step]
        self._stepped = [d for d in diagnostics if d.every_step]

    def begin(self) -> None:
        """Hands over the columns and everything that is known before the first step."""
        raster, columns = self._scene.raster, self._columns()
        known: Values = {
            "particle": np.arange(1, raster.count + 1),
            "number": np.arange(1, raster.count + 1),
            "axis": np.array(["x", "y"]),
            "site": raster.site,
            "reference": self._tables.reference,
        }
        if self._scene.shows_bonds:
            known |= {"bond": self._scene.bonds.ends, "shell": self._scene.bonds.shell}
        for diagnostic in self._scene.experiment.diagnostics:
            known |= diagnostic.coordinates()
        sizes = {
            dim: length
            for c in columns
            if c.name in known
            for dim, length in zip(c.dims, np.shape(known[c.name]), strict=True)
        }
        experiment = self._scene.experiment
        self._sink.begin(columns, sizes, experiment.record.count(experiment.steps))
        self._sink.put(known)

    def observe(self, state: State) -> None:
        """Takes what is wanted of this step. Raises FloatingPointError where a recorded value has
        left the finite numbers; nothing of that step is kept."""
        steps, record = self._scene.experiment.steps, self._scene.experiment.record
        moment = StateMoment(state, self._tables)
        values: Values = {}
        if record.keeps(state.step, steps):
            position = moment.position()
            if not np.isfinite(position).all():
                row = int(np.flatnonzero(~np.isfinite(position).all(axis=1))[0])
                raise FloatingPointError(f"particle {row + 1} at step {state.step}")
            values = {"time": state.step, "position": position, "kind": moment.kind()}
            values |= self._measured(self._recorded, moment)
        if self._stepped:
            values |= {"step": state.step} | self._measured(self._stepped, moment)
        if values:
            self._sink.put(values)

    def finish(self, state: State, outcome: Outcome) -> None:
        """Hands over what is known at the end, and the attributes."""
        if self._scene.has_fracture:
            self._sink.put({"broken_step": StateMoment(state, self._tables).broken_step()})
        self._sink.finish(self._attributes(outcome))

    def _columns(self) -> list[Column]:
        columns = layout.base_columns()
        if self._scene.shows_bonds:
            columns += layout.bond_columns()
        if self._scene.has_fracture:
            columns.append(layout.broken_column())
        if self._stepped:
            columns.append(layout.step_column())
        for diagnostic in self._scene.experiment.diagnostics:
            for name, values in diagnostic.coordinates().items():
                columns.append(layout.own_coordinate(name, values.dtype.str[1:]))
            for variable in diagnostic.variables():
                columns.append(layout.diagnostic_column(variable, diagnostic.every_step))
        return columns

    def _measured(self, diagnostics: list[Diagnostic], moment: StateMoment) -> Values:
        values: Values = {}
        for diagnostic in diagnostics:
            variables, measured = diagnostic.variables(), diagnostic.measure(moment)
            if len(variables) != len(measured):
                raise PluginError(
                    f"diagnostic '{diagnostic.type}' declares {len(variables)} variables and "
                    f"measured {len(measured)}"
                )
            values |= {v.name: m for v, m in zip(variables, measured, strict=True)}
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
            "status": outcome.status,
            "stop_reason": outcome.stop_reason,
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
        }
