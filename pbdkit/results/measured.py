"""What a scene's parts remember and its diagnostics measure, as columns of the dataset."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np

from pbdkit.errors import PluginError
from pbdkit.interfaces import Diagnostic, Moment, RenewsBonds, RenewsParticles, Variable
from pbdkit.interfaces.component import as_values
from pbdkit.registry.blame import blaming
from pbdkit.results import layout
from pbdkit.results.layout import Column, Values, When
from pbdkit.results.physical import Physical
from pbdkit.scene.declarations import bond_numbers, particle_numbers
from pbdkit.scene.scene import Scene


class Measured:
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
                        _refuse_infinite(variable, value, now, self._scene.raster.before)
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
