"""What a scene's parts remember and its diagnostics measure, as columns of the dataset."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cached_property, partial
from typing import Any

import numpy as np

from pbdkit.errors import PluginError
from pbdkit.interfaces import Diagnostic, Moment, RenewsBonds, RenewsParticles, Variable
from pbdkit.registry.blame import blaming
from pbdkit.results import layout
from pbdkit.results.layout import Column, Values
from pbdkit.scene.declarations import bond_numbers, particle_numbers
from pbdkit.scene.scene import Scene

Numbered = tuple[int, Diagnostic]
"""A diagnostic with its place in the experiment."""


class Measured:
    """The numbers and diagnostics of a scene that go into its dataset."""

    def __init__(self, scene: Scene) -> None:
        experiment = scene.experiment
        bonds_change = isinstance(experiment.fracture, RenewsBonds)
        particles_change = isinstance(experiment.rule, RenewsParticles)
        self._scene = scene
        self._diagnostics = list(enumerate(experiment.diagnostics))
        numbers = [
            *((n, "bond", bonds_change) for n in bond_numbers(experiment)),
            *((n, "particle", particles_change) for n in particle_numbers(experiment)),
        ]
        self._remembered = [layout.remembered_column(*n) for n in numbers if n[0].recorded]

    @cached_property
    def every_step(self) -> bool:
        """Whether anything is measured at every step."""
        return any(d.every_step for _, d in self._diagnostics)

    @cached_property
    def shows_leaders(self) -> bool:
        """Whether anything is measured of each leader group."""
        variables = (v for _, d in self._diagnostics for v in d.variables())
        return any("leader_group" in variable.dims for variable in variables)

    @cached_property
    def sizes(self) -> dict[str, int]:
        """The lengths of the dimensions that are known before the first step."""
        scene = self._scene
        sizes = {"particle": scene.raster.count, "axis": scene.axes, "index": scene.axes}
        if scene.shows_bonds:
            sizes |= {"bond": len(scene.bonds.ends), "end": 2}
        if self.shows_leaders:
            sizes["leader_group"] = len(scene.leading)
        return sizes | {
            n: len(values) for _, d in self._diagnostics for n, values in d.coordinates().items()
        }

    def columns(self) -> list[Column]:
        """Theirs. Raises PluginError for names that are taken, and for dimensions that nobody gives
        a length."""
        taken, columns = layout.reserved_names(), list(self._remembered)
        for column in columns:
            _refuse_taken(
                column.name, taken, f"a part remembers '{column.name}' of each {column.dims[-1]}"
            )
        for _, diagnostic in self._diagnostics:
            own, whose = diagnostic.coordinates(), f"Diagnostic '{diagnostic.type}' declares"
            for name in (*own, *filter(None, [diagnostic.own_dimension])):
                _refuse_taken(name, taken, f"{whose} the dimension '{name}'")
            columns += [layout.own_coordinate(n, v.dtype.str[1:]) for n, v in own.items()]
            known = {*self.sizes, "time", "step", diagnostic.own_dimension}
            for variable in diagnostic.variables():
                _refuse_taken(variable.name, taken, f"{whose} the variable '{variable.name}'")
                if unknown := [dim for dim in variable.dims if dim not in known]:
                    raise PluginError(
                        f"{whose} the variable '{variable.name}' with the dimension "
                        f"'{unknown[0]}', which it gives no values"
                    )
                columns.append(layout.diagnostic_column(variable, diagnostic))
        return columns

    def coordinates(self) -> dict[str, Callable[[], Any]]:
        """Those of the diagnostics, by name."""
        return {
            name: partial(np.asarray, values)
            for _, d in self._diagnostics
            for name, values in d.coordinates().items()
        }

    def at_start(self, now: Moment) -> Values:
        """What is remembered and stays."""
        return {c.name: now.remembered(c.name) for c in self._remembered if not c.grows}

    def at_record(self, now: Moment) -> Values:
        """What changes, at a step that is recorded. Raises FloatingPointError for what is not
        finite; so does `at_step`."""
        values = {c.name: now.remembered(c.name) for c in self._remembered if c.grows}
        for name, value in values.items():
            if not np.isfinite(value).all():
                raise FloatingPointError(f"{name} at step {now.step}")
        recorded = (nd for nd in self._diagnostics if not (nd[1].every_step or nd[1].at_end))
        return values | self._of(recorded, now, f"at step {now.step}")

    def at_step(self, now: Moment) -> Values:
        """What is measured at every step."""
        stepped = (nd for nd in self._diagnostics if nd[1].every_step)
        return self._of(stepped, now, f"at step {now.step}")

    def at_end(self, now: Moment) -> Values:
        """What is measured once, after the last step; values that are not finite stay: the run may
        have ended because of them."""
        return self._of((nd for nd in self._diagnostics if nd[1].at_end), now, "at the end")

    def _of(self, wanted: Iterable[Numbered], now: Moment, when: str) -> Values:
        """By variable. Raises PluginError for another shape than declared."""
        values: Values = {}
        for n, diagnostic in wanted:
            sizes, own = dict(self.sizes), diagnostic.own_dimension
            with blaming(diagnostic, when, "diagnostics", n):
                found = diagnostic.measure(now)
                for variable, value in zip(diagnostic.variables(), found, strict=True):
                    if own in variable.dims and np.ndim(value) == len(variable.dims):
                        # The first variable that has it gives its length, the others keep to it.
                        sizes.setdefault(own, np.shape(value)[variable.dims.index(own)])
                    shape = tuple(sizes.get(dim, -1) for dim in variable.dims)
                    if np.shape(value) != shape:
                        raise ValueError(
                            f"'{variable.name}' has the shape {np.shape(value)}, not {shape}"
                        )
                    if not diagnostic.at_end:
                        _refuse_infinite(variable, value, now)
                    values[variable.name] = np.array(value)
        return values


def _refuse_taken(name: str, taken: set[str], what: str) -> None:
    """Raises PluginError for a name that stands in the dataset already; afterwards it does."""
    if name in taken:
        raise PluginError(f"{what}, and that name is taken in the dataset; give it another")
    taken.add(name)


def _refuse_infinite(variable: Variable, value: Any, now: Moment) -> None:
    fine = variable.is_recordable(value, now.body)
    if not fine.all():
        place = np.argwhere(~fine)[0]
        whose = f"particle {place[0] + 1}" if variable.dims[:1] == ("particle",) else "the run"
        raise FloatingPointError(f"{variable.name} of {whose} at step {now.step}")
