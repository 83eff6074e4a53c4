"""The recorder: takes from the states of a run what the dataset holds, and hands it to a sink."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib import import_module
from importlib.metadata import version
from itertools import chain, compress
from typing import TYPE_CHECKING, Any

import numpy as np

from pbdkit.results import layout
from pbdkit.results.layout import Column, Values, When
from pbdkit.results.measured import Measured
from pbdkit.results.moment import StateMoment
from pbdkit.results.tables import Tables
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State

if TYPE_CHECKING:
    import xarray


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


class MemorySink(Sink):
    """Grows every column in memory."""

    def begin(self, columns: list[Column], sizes: dict[str, int], planned: dict[str, int]) -> None:
        """Nothing is allocated before it comes."""
        self._columns, self._sizes = columns, sizes
        self._entries: dict[str, list[Any]] = {c.name: [] for c in columns}

    def put(self, values: Values) -> None:
        """Keeps what it is given."""
        for name, value in values.items():
            self._entries[name].append(value)

    def finish(self, attributes: dict[str, str]) -> None:
        """Keeps the attributes."""
        self._attributes = attributes

    def abandon(self) -> None:
        """Forgets everything."""
        self._entries = {}

    def dataset(self) -> xarray.Dataset:
        """The dataset as in the file."""
        import xarray

        import_module("pbdkit.results.accessor")  # gives every dataset its `pbd`
        variables = {c.name: (c.dims, self._values(c), c.attributes) for c in self._columns}
        coordinates = [c.name for c in self._columns if c.coordinate]
        return xarray.Dataset(variables, attrs=self._attributes).set_coords(coordinates)

    def _values(self, column: Column) -> Any:
        entries = self._entries[column.name]
        if column.grows:
            shape = (len(entries), *(self._sizes[d] for d in column.dims[1:]))
            return np.array(entries, column.dtype).reshape(shape)
        dtype = None if column.dtype == "str" else column.dtype
        return np.asarray(entries[0] if entries else [], dtype)


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
        self._scene, self._sink = scene, sink
        self._tables, self._measured = Tables(scene), Measured(scene)
        self._last_recorded = -1
        self.warnings: tuple[str, ...] = ()

    def begin(self) -> None:
        """Hands over the columns and everything that is known before the first step."""
        steps, recording = self._scene.experiment.steps, self._scene.experiment.recording
        planned = {"time": recording.count(steps), "step": steps + 1}
        self._sink.begin(self._columns(), self._measured.sizes, planned)
        for values in self._known():
            self._sink.put(values)

    def _known(self) -> Iterator[Values]:
        """What is known before the first step; made one after the other, and not all at once."""
        raster, scene = self._scene.raster, self._scene
        numbers = np.arange(1, raster.count + 1)
        yield {"particle": numbers, "number": numbers}
        yield {"axis": np.array(list("xyz"[: scene.axes]))}
        yield {"site": raster.site_table()}
        yield {"reference": raster.reference()}
        if scene.experiment.shows_bonds:
            yield {"bond": scene.bonds.ends, "shell": scene.bonds.shell}
        if self._measured.shows_leaders:
            yield {"leader_group": np.arange(len(scene.leading))}
        yield self._measured.coordinates

    @np.errstate(all="ignore")
    def observe(self, state: State, *, last: bool = False) -> None:
        """Takes what is wanted of this step; positions too of the `last` of a run that stops before
        its end, which may have come before without that. Raises FloatingPointError where a recorded
        value has left the finite numbers; nothing of that step is kept."""
        moment, experiment = StateMoment(state, self._tables), self._scene.experiment
        values: Values = {}
        late = last and state.step > self._last_recorded
        if late or (not last and experiment.records(state.step)):
            position = moment.position()
            if not np.isfinite(position).all():
                row = int(np.flatnonzero(~np.isfinite(position).all(axis=1))[0])
                raise FloatingPointError(f"particle {row + 1} at step {state.step}")
            values = {"time": state.step, "position": position, "kind": moment.kind()}
            values |= self._measured.remembered(moment, first=self._last_recorded < 0)
            values |= self._measured.diagnosed(When.RECORD, moment)
            self._last_recorded = state.step
        if self._measured.every_step and not last:
            values |= {"step": state.step} | self._measured.diagnosed(When.STEP, moment)
        if values:
            self._sink.put(values)

    def finish(self, state: State, outcome: Outcome, prediction: dict[str, Any]) -> None:
        """Hands over what is known at the end, and the attributes, with what was predicted before
        the first step; `warnings` says what the user should know of the last state."""
        # Where a run diverged, what broke since the last record is no result.
        diverged = outcome.status == "diverged"
        moment = StateMoment(state, self._tables, self._last_recorded if diverged else state.step)
        if not diverged and (warning := moment.cells.inside_out()):
            self.warnings = (warning,)
        if self._scene.has_fracture:
            steps, strains = moment.broken_step(), moment.broken_strain()
            self._sink.put({"broken_step": steps, "broken_strain": strains})
        with np.errstate(all="ignore"):
            self._sink.put(self._measured.diagnosed(When.END, moment))
        self._sink.finish(self._attributes(outcome, prediction))

    def _columns(self) -> list[Column]:
        scene, measured = self._scene, self._measured
        wanted = (
            scene.experiment.shows_bonds,
            scene.has_fracture,
            measured.every_step,
            measured.shows_leaders,
        )
        some = chain(*compress(layout.optional_columns(), wanted))
        columns = [*layout.base_columns(), *some, *measured.columns()]
        if self._scene.experiment.record.dtype == "float64":
            return columns
        return [replace(c, dtype="f4") if c.grows and c.dtype == "f8" else c for c in columns]

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
