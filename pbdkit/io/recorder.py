"""The recorder: takes the variables of the dataset from the states of a run, measured diagnostics
and remembered numbers included, and passes them to a sink.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from importlib.metadata import version
from itertools import chain, compress
from typing import TYPE_CHECKING, Any

import numpy as np

from pbdkit.components.diagnostics import Displacement
from pbdkit.errors import AccuracyWarning, PluginError, WarningText
from pbdkit.io import layout
from pbdkit.io.checkpoint import RecordedSteps
from pbdkit.io.layout import Column, Values, When, diagnostic_column
from pbdkit.io.physical import Physical, Twins
from pbdkit.io.sinks import MemorySink, Sink
from pbdkit.io.snapshot import StateMoment, Tables
from pbdkit.lattice.raster import FRAME
from pbdkit.model.experiment import Experiment
from pbdkit.plugin import Diagnostic, Moment, RenewsBonds, RenewsParticles, Variable
from pbdkit.plugin.component import as_values
from pbdkit.plugin.discovery import blaming
from pbdkit.scene.constants import bond_numbers, particle_numbers
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State

if TYPE_CHECKING:
    import xarray


class RecordedVariables:
    """The numbers and diagnostics of a scene that go into its dataset."""

    def __init__(self, scene: Scene) -> None:
        experiment = scene.experiment
        bonds_change = isinstance(experiment.fracture, RenewsBonds)
        particles_change = isinstance(experiment.rule, RenewsParticles)
        self._scene = scene
        self._diagnostics = experiment.diagnostics
        self.physical = Physical(experiment.units)
        numbers = [
            *((n, "bond", bonds_change) for n in bond_numbers(experiment)),
            *((n, "particle", particles_change) for n in particle_numbers(experiment)),
        ]
        self._remembered = [layout.remembered_column(*n) for n in numbers if n[0].recorded]

    @cached_property
    def every_step(self) -> bool:
        """Whether anything is measured at every step."""
        return any(layout.when_measured(d) is When.STEP for d in self._diagnostics)

    @cached_property
    def shows_leaders(self) -> bool:
        """Whether anything is measured of each leader group."""
        return self._shows("leader_group")

    @cached_property
    def shows_loads(self) -> bool:
        """Whether anything is measured of each load."""
        return self._shows("load")

    @cached_property
    def shows_obstacles(self) -> bool:
        """Whether anything is measured of each obstacle."""
        return self._shows("obstacle")

    @cached_property
    def shows_principal(self) -> bool:
        """Whether principal values are measured."""
        return self._shows("principal")

    def _shows(self, dim: str) -> bool:
        return any(dim in v.dims for d in self._diagnostics for v in d.variables())

    @cached_property
    def sizes(self) -> dict[str, int]:
        """The lengths of the dimensions that are known before the first step."""
        scene = self._scene
        sizes = {"particle": scene.raster.count, "axis": scene.axes, "index": scene.axes}
        if scene.experiment.shows_bonds:
            sizes |= {"bond": len(scene.bonds.ends), "end": 2}
        if self.shows_leaders:
            sizes["leader_group"] = len(scene.leading)
        if self.shows_loads:
            sizes["load"] = len(scene.experiment.loads)
        if self.shows_obstacles:
            sizes["obstacle"] = len(scene.barriers)
        if self.shows_principal:
            sizes["principal"] = 2
        return sizes | {name: len(values) for name, values in self.coordinates.items()}

    def columns(self) -> list[Column]:
        """Theirs. Raises PluginError for names that are taken, and for dimensions that nobody gives
        a length."""
        taken, columns = layout.reserved_names(), list(self._remembered)
        for column in columns:
            _refuse_taken(
                column.name, taken, f"a part remembers '{column.name}' of each {column.dims[-1]}"
            )
        for diagnostic in self._diagnostics:
            own, whose = diagnostic.coordinates(), f"Diagnostic '{diagnostic.type}' declares"
            for name in (*own, *filter(None, [diagnostic.own_dimension])):
                _refuse_taken(name, taken, f"{whose} the dimension '{name}'")
            columns += [layout.coordinate(n, n, v.dtype.str[1:]) for n, v in own.items()]
            if diagnostic.own_dimension:
                columns.append(layout.own_coordinate(diagnostic))
            known = {*self.sizes, "time", "step", diagnostic.own_dimension}
            for variable, _ in self.physical.scaled(diagnostic):
                _refuse_taken(variable.name, taken, f"{whose} the variable '{variable.name}'")
                if unknown := [dim for dim in variable.dims if dim not in known]:
                    raise PluginError(
                        f"{whose} the variable '{variable.name}' with the dimension "
                        f"'{unknown[0]}', which it gives no values"
                    )
                columns.append(layout.diagnostic_column(variable, diagnostic))
        return columns

    @cached_property
    def coordinates(self) -> dict[str, Any]:
        """Those of the diagnostics, by name."""
        return {n: values for d in self._diagnostics for n, values in d.coordinates().items()}

    def remembered(self, now: Moment, *, first: bool) -> Values:
        """What is remembered and changes and, the `first` time, what stays; of particles it is of
        the body, NaN at frame points unless whole. Raises FloatingPointError for what changes and
        is not finite."""
        values: Values = {}
        for column in (c for c in self._remembered if c.grows or first):
            value = now.remembered(column.name)
            if column.grows and not np.isfinite(value).all():
                raise FloatingPointError(f"{column.name} at step {now.step}")
            of_body = column.dims[-1] == "particle" and value.dtype.kind == "f"
            values[column.name] = np.where(now.body, value, np.nan) if of_body else value
        return values

    def diagnosed(
        self, when: When, now: Moment, which: Callable[[Diagnostic], bool] = lambda _: True
    ) -> Values:
        """What the diagnostics of that time measure, by variable; of all, or of those `which`.

        Raises PluginError for another shape than declared, and FloatingPointError for what is not
        finite; at the end such values stay: the run may have ended because of them.
        """
        values: Values = {}
        told = "at the end" if when is When.END else f"at step {now.step}"
        for n, diagnostic in enumerate(self._diagnostics):
            if layout.when_measured(diagnostic) is not when or not which(diagnostic):
                continue
            sizes, own = dict(self.sizes), diagnostic.own_dimension
            with blaming(diagnostic, told, "diagnostics", n):
                found = as_values(diagnostic.measure(now), "measure")
                for (variable, factor), value in zip(
                    self.physical.scaled(diagnostic), found, strict=True
                ):
                    if own in variable.dims and np.ndim(value) == len(variable.dims):
                        # The first variable that has it gives its length, the others keep to it.
                        sizes.setdefault(own, np.shape(value)[variable.dims.index(own)])
                    shape = tuple(sizes.get(dim, -1) for dim in variable.dims)
                    if np.shape(value) != shape:
                        raise ValueError(
                            f"'{variable.name}' has the shape {np.shape(value)}, not {shape}"
                        )
                    if when is not When.END:
                        _refuse_infinite(variable, value, now, self._scene.raster.particle_offset)
                    values[variable.name] = (
                        np.array(value) if factor == 1.0 else np.multiply(value, factor)
                    )
            if own in sizes:
                values[own] = np.arange(1, sizes[own] + 1)
        return values


def _refuse_taken(name: str, taken: set[str], what: str) -> None:
    """Raises PluginError for a name that stands in the dataset already; afterwards it does."""
    if name in taken:
        raise PluginError(f"{what}, and that name is taken in the dataset; give it another")
    taken.add(name)


def _refuse_infinite(variable: Variable, value: Any, now: Moment, before: int) -> None:
    fine = variable.is_recordable(value, now.inside)
    if not fine.all():
        place = np.argwhere(~fine)[0]
        whose = (
            f"particle {before + place[0] + 1}" if variable.dims[:1] == ("particle",) else "the run"
        )
        raise FloatingPointError(f"{variable.name} of {whose} at step {now.step}")


@dataclass(frozen=True)
class RunOutcome:
    """How a run ended; `certificate` says of an equilibrium how far it can be off."""

    status: str
    stop_reason: str
    steps: int
    certificate: dict[str, Any] | None = None


class Recorder:
    """Records the run of one scene into a sink; `seen` decides how it goes on."""

    def __init__(self, scene: Scene, sink: Sink) -> None:
        self._scene, self.sink = scene, sink
        self._tables, self._measured = Tables(scene), RecordedVariables(scene)
        self._columns = columns_of(scene)
        self._twins = Twins(self._columns)
        self.seen = RecordedSteps()
        self.warnings: tuple[str, ...] = ()

    def begin(self, history: Iterable[Values] | None = None) -> None:
        """Hands over the columns and everything that is known before the first step, or instead of
        it the `history` of a run that is gone on with."""
        count = self._scene.experiment.record_count
        planned = {"time": count, "step": max(count, self._scene.experiment.steps + 1)}
        self.sink.begin(self._columns, self._measured.sizes, planned)
        for values in map(self._twins.beside, self.known()) if history is None else history:
            self.sink.put(values)

    def known(self) -> Iterator[Values]:
        """What is known before the first step; made one after the other, and not all at once."""
        raster, scene = self._scene.raster, self._scene
        numbers = raster.particle_offset + np.arange(1, raster.count + 1)
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
                    bonds.ends, 1 + raster.particle_offset, dtype=np.int32, casting="same_kind"
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
        self.seen = RecordedSteps(now, now if "time" in values else self.seen.recorded)

    def _taken(self, state: State, last: bool, within: float | None = None) -> Values:
        """What is wanted of a step."""
        moment = StateMoment(state, self._tables, within=within)
        values: Values = {}
        experiment, now = self._scene.experiment, state.step if within is None else within
        late = last and now > self.seen.recorded
        # The first state is always recorded, of a run that does not begin with step 0 too.
        planned = within is not None or experiment.records(state.step) or self.seen.recorded < 0
        recorded = late or (not last and planned)
        if recorded:
            position = moment.position()
            if not np.isfinite(position).all():
                before = self._scene.raster.particle_offset
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

    def finish(self, state: State, outcome: RunOutcome, prediction: dict[str, Any]) -> None:
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
            self.warnings = (WarningText(warning, AccuracyWarning),)
        if self._scene.has_fracture:
            steps, strains = moment.broken_step(), moment.broken_strain()
            self.sink.put({"broken_step": steps, "broken_strain": strains})
        with np.errstate(all="ignore"):
            self.sink.put(self._twins.beside(self._diagnosed(When.END, moment)))
        self.sink.finish(self._attributes(outcome, prediction))

    def _inside_out(self, state: State) -> str | None:
        return StateMoment(state, self._tables).cells.inside_out()

    def _attributes(self, outcome: RunOutcome, prediction: dict[str, Any]) -> dict[str, str]:
        return {
            **provenance_of(self._scene.experiment),
            "prediction": json.dumps(prediction),
            "status": outcome.status,
            "stop_reason": outcome.stop_reason,
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
        } | ({"certificate": json.dumps(outcome.certificate)} if outcome.certificate else {})


def provenance_of(experiment: Experiment) -> dict[str, str]:
    """Return the attributes that say what a dataset was made of, and by which versions."""
    return {
        "Conventions": layout.CONVENTIONS,
        "schema_version": layout.SCHEMA_VERSION,
        "title": experiment.name,
        "pbdkit_version": version("pbdkit"),
        "experiment": experiment.model_dump_json(by_alias=True),
        "plugins": json.dumps(experiment.distributions()),
    }


class Snapshots:
    """Labelled states of a scene, as a dataset of its run has them at one time."""

    def __init__(self, scene: Scene) -> None:
        self._scene, self._tables = scene, Tables(scene)
        self._measured = RecordedVariables(scene)
        self._columns = {column.name: column for column in columns_of(scene)}
        shown = diagnostic_column(Displacement().variables()[0], Displacement)
        self._columns.setdefault(shown.name, shown)
        known = Recorder(scene, MemorySink()).known()
        labels = {name: value for values in known for name, value in values.items()}
        dims = {"particle", "axis", "index", "bond", "end"}
        self._labels = {
            name: self._variable(name, value)
            for name, value in labels.items()
            if {*self._columns[name].dims} <= dims
        }
        self._attributes = provenance_of(scene.experiment)

    def dataset(self, state: State) -> xarray.Dataset:
        """Return a state with its labels; its values are copies that cannot be written to."""
        import xarray

        moment = StateMoment(state, self._tables)
        values: Values = {"position": moment.position(), "u": moment.displacement()}
        values |= {"kind": moment.kind(), **self._measured.remembered(moment, first=True)}
        if self._scene.has_fracture:
            values["broken_step"] = moment.broken_step()
        variables = {name: self._variable(name, value) for name, value in values.items()}
        time = {"time": ((), state.step, self._columns["time"].attributes)}
        return xarray.Dataset(variables, {**self._labels, **time}, self._attributes)

    def _variable(self, name: str, value: Any) -> Any:
        column, values = self._columns[name], np.array(value)
        values.flags.writeable = False
        dims = tuple(dim for dim in column.dims if dim not in layout.TIMES)
        return dims, values, column.attributes


def columns_of(scene: Scene) -> list[Column]:
    """Those of the scene's dataset."""
    measured = RecordedVariables(scene)
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
