"""Recorder of a run. It evaluates the variables of the dataset, including diagnostics and state
variables, in the states of a run, and passes them to a sink."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from itertools import chain, compress
from typing import TYPE_CHECKING, Any

import numpy as np

from pbdkit.components.diagnostics import Displacement
from pbdkit.errors import AccuracyWarning, AnswerError, PluginError, WarningText, did_you_mean
from pbdkit.hooks import pbdkit_version
from pbdkit.io import layout
from pbdkit.io.checkpoint import RecordedSteps
from pbdkit.io.layout import Column, Values, When, diagnostic_column
from pbdkit.io.physical import ConvertedCopies, Physical
from pbdkit.io.sinks import MemorySink, Sink
from pbdkit.io.snapshot import StateMoment, Tables
from pbdkit.lattice.raster import FRAME
from pbdkit.model.experiment import Experiment
from pbdkit.model.solver import OpeningControl
from pbdkit.plugin import Diagnostic, Moment, RenewsBonds, RenewsParticles, Variable
from pbdkit.plugin.component import as_values
from pbdkit.plugin.discovery import errors_attributed_to, full_description
from pbdkit.scene.constants import bond_numbers, particle_numbers
from pbdkit.scene.opening import Opening
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State

if TYPE_CHECKING:
    import xarray


Measured = tuple[int, Diagnostic, list[tuple[Variable, float]]]
"""Index of a diagnostic, the diagnostic, and its variables with the factors by which their values
are multiplied."""


class RecordedVariables:
    """The recorded state variables and diagnostics of a scene."""

    def __init__(self, scene: Scene) -> None:
        experiment = scene.experiment
        bonds_change = isinstance(experiment.fracture, RenewsBonds)
        particles_change = isinstance(experiment.rule, RenewsParticles)
        self._scene = scene
        self._diagnostics = scene.diagnostics
        self.physical = Physical(experiment.units)
        numbers = [
            *((n, "bond", bonds_change) for n in bond_numbers(experiment)),
            *((n, "particle", particles_change) for n in particle_numbers(experiment)),
        ]
        self._remembered = [layout.remembered_column(*n) for n in numbers if n[0].recorded]

    @cached_property
    def every_step(self) -> bool:
        """Return whether any diagnostic is measured at every step."""
        return any(layout.when_measured(d) is When.STEP for d in self._diagnostics)

    @cached_property
    def shows_leaders(self) -> bool:
        """Return whether any variable has a value for each leader group."""
        return self._shows("leader_group")

    @cached_property
    def shows_loads(self) -> bool:
        """Return whether any variable has a value for each load."""
        return self._shows("load")

    @cached_property
    def shows_obstacles(self) -> bool:
        """Return whether any variable has a value for each obstacle."""
        return self._shows("obstacle")

    @cached_property
    def shows_principal(self) -> bool:
        """Return whether any variable holds principal values."""
        return self._shows("principal")

    def _shows(self, dim: str) -> bool:
        return any(dim in v.dims for d in self._diagnostics for v in d.variables())

    @cached_property
    def sizes(self) -> dict[str, int]:
        """Lengths of the dimensions that are known before the first step."""
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
        """Return the columns of state variables and diagnostics. Raises PluginError if a name is
        already used, or if the length of a dimension is unknown."""
        names, columns = layout.reserved_names(), list(self._remembered)
        for column in columns:
            _reserve_name(
                column.name,
                names,
                (
                    f"a component declares the state variable '{column.name}' of each "
                    f"{column.dims[-1]}"
                ),
            )
        for diagnostic in self._diagnostics:
            coordinates, whose = (
                diagnostic.coordinates(),
                f"Diagnostic '{diagnostic.type}' declares",
            )
            for name in (*coordinates, *filter(None, [diagnostic.own_dimension])):
                _reserve_name(name, names, f"{whose} the dimension '{name}'")
            columns += [layout.coordinate(n, n, v.dtype.str[1:]) for n, v in coordinates.items()]
            if diagnostic.own_dimension:
                columns.append(layout.own_coordinate(diagnostic))
            dims = {*self.sizes, "time", "step", diagnostic.own_dimension}
            for variable, _ in self.physical.scaled(diagnostic):
                _reserve_name(variable.name, names, f"{whose} the variable '{variable.name}'")
                if unknown := [dim for dim in variable.dims if dim not in dims]:
                    raise PluginError(
                        f"{whose} the variable '{variable.name}' with the dimension "
                        f"'{unknown[0]}', for which it defines no coordinate"
                        + (did_you_mean(unknown[0], dims - {""}) or "; define it in `coordinates`")
                    )
                columns.append(layout.diagnostic_column(variable, diagnostic))
        return columns

    @cached_property
    def _scaled(self) -> dict[When, list[Measured]]:
        """Diagnostics, sorted by the time of measurement."""
        result = {when: list[Measured]() for when in When}
        for n, diagnostic in enumerate(self._diagnostics):
            variables = list(self.physical.scaled(diagnostic))
            result[layout.when_measured(diagnostic)].append((n, diagnostic, variables))
        return result

    @cached_property
    def coordinates(self) -> dict[str, Any]:
        """Coordinates of the diagnostics, by name."""
        return {n: values for d in self._diagnostics for n, values in d.coordinates().items()}

    def remembered(self, moment: Moment, *, first: bool) -> Values:
        """Return the state variables that change and, if `first` is true, also the constant ones.
        Floating-point variables are NaN at frame points. Raises FloatingPointError if a changing
        variable is not finite."""
        values: Values = {}
        for column in (c for c in self._remembered if c.grows or first):
            value = moment.remembered(column.name)
            if column.grows and not np.isfinite(value).all():
                raise FloatingPointError(f"{column.name} at step {moment.step}")
            of_body = column.dims[-1] == "particle" and value.dtype.kind == "f"
            values[column.name] = np.where(moment.body, value, np.nan) if of_body else value
        return values

    def diagnosed(
        self, when: When, moment: Moment, which: Callable[[Diagnostic], bool] = lambda _: True
    ) -> Values:
        """Evaluate the diagnostics that are measured at the time `when`, restricted to those for
        which `which` returns true. Returns values by variable.

        Raises PluginError if a shape differs from the declared one, and FloatingPointError if a
        value is not finite. At the end of a run, values that are not finite are kept, because the
        run may have ended because of them.
        """
        values: Values = {}
        occasion = "at the end" if when is When.END else f"at step {moment.step}"
        for n, diagnostic, variables in self._scaled[when]:
            if not which(diagnostic):
                continue
            sizes, dimension = dict(self.sizes), diagnostic.own_dimension
            with errors_attributed_to(diagnostic, occasion, "diagnostics", n):
                results = as_values(diagnostic.measure(moment), "measure")
                for (variable, factor), value in zip(variables, results, strict=True):
                    if dimension in variable.dims and np.ndim(value) == len(variable.dims):
                        # The first variable determines the length of the dimension. All other
                        # variables must have the same length.
                        sizes.setdefault(dimension, np.shape(value)[variable.dims.index(dimension)])
                    shape = tuple(sizes.get(dim, -1) for dim in variable.dims)
                    if np.shape(value) != shape:
                        raise AnswerError(_other_shape(variable, np.shape(value), shape))
                    if when is not When.END:
                        _refuse_infinite(
                            diagnostic, variable, value, moment, self._scene.raster.particle_offset
                        )
                    values[variable.name] = (
                        np.array(value) if factor == 1.0 else np.multiply(value, factor)
                    )
            if dimension in sizes:
                values[dimension] = np.arange(1, sizes[dimension] + 1)
        return values


def _reserve_name(name: str, names: set[str], what: str) -> None:
    """Add a name to the names that are used. Raises PluginError if it is already used."""
    if name in names:
        raise PluginError(
            f"{what}, but the dataset already has a variable or dimension of this name; rename it"
        )
    names.add(name)


def _other_shape(variable: Variable, shape: tuple[int, ...], expected: tuple[int, ...]) -> str:
    """Return the message for values of a wrong shape."""
    text = f"`measure` returned the shape {shape} for '{variable.name}', expected {expected}"
    if "particle" in variable.dims:
        return f"{text}; return a value for each particle, and NaN at frame points"
    dims = f"({', '.join(variable.dims)})" if variable.dims else "(), a single number"
    return f"{text}; it is declared with the dims {dims}"


def _refuse_infinite(
    diagnostic: Diagnostic, variable: Variable, value: Any, moment: Moment, offset: int
) -> None:
    valid = variable.is_recordable(value, moment.inside)
    if not valid.all():
        place = np.argwhere(~valid)[0]
        whose = (
            f"particle {offset + place[0] + 1}" if variable.dims[:1] == ("particle",) else "the run"
        )
        if moment.step == 0:  # Later the state may have diverged.
            raise PluginError(
                f"{full_description(type(diagnostic))} failed at step {moment.step}: `measure` "
                f"returned {np.asarray(value)[tuple(place)]:g} as '{variable.name}' of {whose}; "
                "guard divisions, or declare the variable with `may_be_nan=True`"
            )
        raise FloatingPointError(f"{variable.name} of {whose} at step {moment.step}")


@dataclass(frozen=True)
class RunOutcome:
    """Outcome of a run. `error_bound` is the error bound of an equilibrium."""

    status: str
    stop_reason: str
    steps: int
    error_bound: dict[str, Any] | None = None


class Recorder:
    """Recorder of the run of one scene into a sink. `last_steps` contains the last observed step
    and the last recorded step."""

    def __init__(self, scene: Scene, sink: Sink) -> None:
        self._scene, self.sink = scene, sink
        self._tables, self._measured = Tables(scene), RecordedVariables(scene)
        self._columns = columns_of(scene)
        self._copies = ConvertedCopies(self._columns)
        self.last_steps = RecordedSteps()
        self.warnings: tuple[str, ...] = ()

    def begin(self, history: Iterable[Values] | None = None) -> None:
        """Pass the columns and the initial values to the sink. For a run that is continued, its
        `history` is passed instead."""
        count = self._scene.experiment.record_count
        planned = {"time": count, "step": max(count, self._scene.experiment.steps + 1)}
        self.sink.begin(self._columns, self._measured.sizes, planned)
        for values in (
            map(self._copies.add_to, self.initial_values()) if history is None else history
        ):
            self.sink.put(values)

    def initial_values(self) -> Iterator[Values]:
        """Generate the values that are known before the first step, one after the other in order to
        save memory."""
        raster, scene = self._scene.raster, self._scene
        numbers = raster.particle_offset + np.arange(1, raster.count + 1)
        yield {"particle": numbers, "number": numbers}
        yield {"axis": np.array(list("xyz"[: scene.axes]))}
        site = raster.site_table()
        yield {"site": site, **dict(zip(layout.INDICES, site.T, strict=False))}
        yield {"role": np.where(raster.table_kind == FRAME, layout.OF_FRAME, layout.OF_BODY)}
        yield {"inside": self._tables.inside.astype(np.int8)}
        reference = raster.reference()
        yield {"reference": reference, **dict(zip(layout.PLACES, reference.T, strict=False))}
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
    def observe(self, state: State, *, last: bool = False, time: float | None = None) -> None:
        """Record the variables that are due at the step of the state.

        A step that was observed before is skipped. The `last` step of a run that stops early,
        however, is recorded in any case. `time` is the time of an equilibrium within a step. Raises
        FloatingPointError if a recorded value is not finite; in this case no variable of the step
        is recorded.
        """
        if (state.step if time is None else time) > self.last_steps.step or last:
            self._put(state, self._record_of(state, last, time))

    def _put(self, state: State, values: Values) -> None:
        if values:
            self.sink.put(self._copies.add_to(values))
        time = values.get("time", state.step)
        self.last_steps = RecordedSteps(
            time, time if "time" in values else self.last_steps.recorded
        )

    def _record_of(self, state: State, last: bool, time: float | None = None) -> Values:
        """Return the values to be recorded at a step."""
        moment = StateMoment(state, self._tables, time=time)
        values: Values = {}
        experiment, within_step = self._scene.experiment, time is not None
        time = state.step if time is None else time
        late = last and time > self.last_steps.recorded
        # The first state is always recorded, even if the run does not begin with step 0.
        planned = within_step or experiment.records(state.step) or self.last_steps.recorded < 0
        recorded = late or (not last and planned)
        if recorded:
            position = moment.position()
            if not np.isfinite(position).all():
                offset = self._scene.raster.particle_offset
                row = int(np.flatnonzero(~np.isfinite(position).all(axis=1))[0])
                raise FloatingPointError(f"particle {offset + row + 1} at step {state.step}")
            values = {"time": time, "position": position, "kind": moment.kind()}
            values |= self._measured.remembered(moment, first=self.last_steps.recorded < 0)
            if experiment.solver.equilibrium.control:
                values |= _of_branch(state, self._opening)
            values |= self._diagnosed(When.RECORD, moment)
        stepped = recorded or experiment.solver.makes_steps
        if self._measured.every_step and stepped and not last:
            values |= {"step": time} | self._diagnosed(When.STEP, moment)
        return values

    def _diagnosed(self, when: When, moment: StateMoment) -> Values:
        return self._measured.diagnosed(when, moment)

    def finish(self, state: State, outcome: RunOutcome, prediction: dict[str, Any]) -> None:
        """Record the final values and the attributes, including the prediction that was made before
        the first step. After this, `warnings` contains warnings about the last state."""
        # If the run diverged, bonds that broke after the last record do not belong to the result.
        diverged, recorded = outcome.status == "diverged", self.last_steps.recorded
        if state.step < recorded < state.step + 1:
            moment = StateMoment(state, self._tables, time=recorded)
        else:
            latest = int(recorded) if diverged else state.step
            moment = StateMoment(state, self._tables, latest)
        if not diverged and (warning := self._inside_out(state)):
            self.warnings = (WarningText(warning, AccuracyWarning),)
        if self._scene.has_fracture:
            steps, strains = moment.broken_step(), moment.broken_strain()
            self.sink.put({"broken_step": steps, "broken_strain": strains})
        with np.errstate(all="ignore"):
            self.sink.put(self._copies.add_to(self._diagnosed(When.END, moment)))
        self.sink.finish(self._attributes(outcome, prediction))

    @cached_property
    def _opening(self) -> Opening | None:
        """The opening that is recorded."""
        by_opening = isinstance(self._scene.experiment.solver.equilibrium.control, OpeningControl)
        return Opening.of(self._scene) if by_opening else None

    def _inside_out(self, state: State) -> str | None:
        return StateMoment(state, self._tables).cells.inside_out()

    def _attributes(self, outcome: RunOutcome, prediction: dict[str, Any]) -> dict[str, str]:
        return {
            **provenance_of(self._scene.experiment),
            "prediction": json.dumps(prediction),
            "status": outcome.status,
            "stop_reason": outcome.stop_reason,
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
        } | ({"certificate": json.dumps(outcome.error_bound)} if outcome.error_bound else {})


def _of_branch(state: State, opening: Opening | None) -> Values:
    """Return the quantities of a branch that is followed by a control."""
    values = {"load_factor": state.load_factor, "dissipated_energy": state.dissipated}
    return values | ({"opening": opening.at(state.u)} if opening else {})


def provenance_of(experiment: Experiment) -> dict[str, str]:
    """Return the attributes that contain the experiment and the versions of the software that made
    a dataset."""
    return {
        "Conventions": layout.CONVENTIONS,
        "schema_version": layout.SCHEMA_VERSION,
        "title": experiment.name,
        "pbdkit_version": pbdkit_version(),
        "experiment": experiment.model_dump_json(by_alias=True),
        "plugins": json.dumps(experiment.distributions()),
    }


class Snapshots:
    """Builder of labelled datasets for single states of a scene."""

    def __init__(self, scene: Scene) -> None:
        self._scene, self._tables = scene, Tables(scene)
        self._measured = RecordedVariables(scene)
        self._columns = {column.name: column for column in columns_of(scene)}
        displacement = diagnostic_column(Displacement().variables()[0], Displacement)
        self._columns.setdefault(displacement.name, displacement)
        initial = Recorder(scene, MemorySink()).initial_values()
        labels = {name: value for values in initial for name, value in values.items()}
        dims = {"particle", "axis", "index", "bond", "end"}
        self._labels = {
            name: self._variable(name, value)
            for name, value in labels.items()
            if {*self._columns[name].dims} <= dims
        }
        self._attributes = provenance_of(scene.experiment)

    def dataset(self, state: State) -> xarray.Dataset:
        """Return a state as a labelled dataset. The values are copies and cannot be written to."""
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
    """Return the columns of a scene's dataset."""
    measured, control = RecordedVariables(scene), scene.experiment.solver.equilibrium.control
    wanted = (
        scene.experiment.shows_bonds,
        scene.has_fracture,
        measured.every_step,
        measured.shows_leaders,
        measured.shows_loads,
        measured.shows_obstacles,
        measured.shows_principal,
        control is not None,
        isinstance(control, OpeningControl),
    )
    optional = chain(*compress(layout.optional_columns(), wanted))
    lattice_columns = [*layout.base_columns(scene.axes), *optional, *measured.columns()]
    columns = measured.physical.columns(lattice_columns)
    record = scene.experiment.record
    if record.dtype == "float32":
        columns = [replace(c, dtype="f4") if c.grows and c.dtype == "f8" else c for c in columns]
    if record.increments:
        columns = [replace(c, dtype="f8") if c.name in layout.TIMES else c for c in columns]
    return columns
