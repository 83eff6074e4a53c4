"""Assembles the scene of an experiment: only the parts that it uses exist."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property

from pbdkit.errors import ExperimentError
from pbdkit.experiment.model import Experiment
from pbdkit.interfaces import Setting, Vector
from pbdkit.scene.bonds import BondTable, build_bond_table
from pbdkit.scene.filling import fill, has_narrow_slot, window
from pbdkit.scene.framing import Frame, build_frame
from pbdkit.scene.leading import Leading, build_leading
from pbdkit.scene.neighbourhood import Neighbourhood, build_neighbourhood
from pbdkit.scene.raster import Raster, build_raster, positions
from pbdkit.scene.sizes import refuse_too_large


@dataclass(frozen=True)
class Scene:
    """An experiment on its lattice.

    `frame` is None without one; `leading` are the leader groups; `warnings` are for the user.
    """

    experiment: Experiment
    neighbourhood: Neighbourhood
    raster: Raster
    frame: Frame | None
    leading: tuple[Leading, ...]
    warnings: tuple[str, ...]

    @property
    def has_fracture(self) -> bool:
        """Whether any bond can break."""
        return self.experiment.fracture.can_break

    @property
    def shows_bonds(self) -> bool:
        """Whether the dataset has a table of bonds."""
        return self.has_fracture or any(d.uses_bonds for d in self.experiment.diagnostics)

    @cached_property
    def bonds(self) -> BondTable:
        """The table of bonds."""
        return build_bond_table(self.raster, self.neighbourhood)

    def setting(self) -> Setting:
        """What a rule may derive its constants from."""
        cell = self.experiment.lattice.cell()
        x, y = positions(cell, *self.raster.cells(self.raster.body_rows))
        lower, upper = Vector(x.min(), y.min()), Vector(x.max(), y.max())
        return Setting(cell, self.neighbourhood.slots, lower, upper)


def build_scene(experiment: Experiment) -> Scene:
    """The scene; ExperimentError, with file and line where they are known, if there is none."""
    try:
        return _build(experiment)
    except ExperimentError as error:
        raise experiment.located(error) from None


def _build(experiment: Experiment) -> Scene:
    cell = experiment.lattice.cell()
    neighbourhood = build_neighbourhood(cell, experiment.neighbours)
    with _blaming("fracture"):
        warnings = experiment.fracture.check(neighbourhood.shells())
    if not neighbourhood.spans_plane():
        warnings.append(
            "neighbours: they lie along one line only, so that rows do not feel each other; "
            "more shells, or chebyshev neighbours, connect them"
        )
    if experiment.neighbours.nearness() and experiment.rule.weights(neighbourhood.slots[0][0]):
        raise ExperimentError(
            f"'{experiment.rule.type}' weighs neighbours by their slots, which re-evaluated "
            "neighbours do not have; set neighbours.reevaluate: false",
            ("neighbours",),
        )
    layers = experiment.frame.depth(neighbourhood.reach)
    low, high = window(experiment.body, experiment.lattice)
    extent = (high[0] - low[0] + 1, high[1] - low[1] + 1)
    refuse_too_large(experiment, neighbourhood, extent, layers)
    body, first = fill(experiment.body, experiment.lattice)
    if layers and has_narrow_slot(body, layers):
        warnings.append(
            f"body: a slot is narrower than {2 * layers + 1} sites, so that frame points in it "
            "belong to both faces; widen it, or take fewer layers"
        )
    raster = build_raster(experiment.lattice, body, first, layers, neighbourhood.reach_in_cells)
    _check_diagnostics(experiment, raster)
    leading = build_leading(raster, experiment.leaders, experiment.steps)
    frame = build_frame(raster, experiment.frame)
    return Scene(experiment, neighbourhood, raster, frame, leading, tuple(warnings))


def _check_diagnostics(experiment: Experiment, raster: Raster) -> None:
    taken: dict[str, int] = {}
    for n, diagnostic in enumerate(experiment.diagnostics):
        with _blaming("diagnostics", n):
            diagnostic.check(raster.count)
            for variable in diagnostic.variables():
                if variable.name in taken:
                    other = f"diagnostics.{taken[variable.name]} does too"
                    raise ExperimentError(f"adds the variable '{variable.name}'; {other}")
                taken[variable.name] = n


@contextmanager
def _blaming(*part: str | int) -> Iterator[None]:
    """Errors raised inside are about this part of the experiment."""
    try:
        yield
    except ExperimentError as error:
        raise ExperimentError(str(error), (*part, *error.where)) from None
