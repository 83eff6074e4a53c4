"""The numbers that parts remember, as they declare them."""

from __future__ import annotations

from pbdkit.errors import ExperimentError, PluginError
from pbdkit.experiment.model import Experiment
from pbdkit.interfaces import Diagnostic, FollowerRule, FractureModel, Remembered, Remembers
from pbdkit.interfaces.component import as_values
from pbdkit.interfaces.rule import material_of
from pbdkit.registry.blame import blaming
from pbdkit.scene.cells import patches
from pbdkit.scene.neighbourhood import Neighbourhood
from pbdkit.scene.raster import FRAME, Raster

Declared = tuple[Remembered, ...]


def bond_numbers(experiment: Experiment) -> Declared:
    """What the fracture model remembers of each bond; nothing where bonds cannot break."""
    return _declared(experiment.fracture, "fracture") if experiment.fracture.can_break else ()


def particle_numbers(experiment: Experiment) -> Declared:
    """What the rule remembers of each particle."""
    return _declared(experiment.rule, "rule")


def _declared(part: FollowerRule | FractureModel, field: str) -> Declared:
    if not isinstance(part, Remembers):
        return ()
    with blaming(part, "when asked what it remembers", field):
        return as_values(part.remembered(), "remembered")


def remembered_names(experiment: Experiment) -> dict[str, str]:
    """Each number's name with the field of the part that remembers it.

    Raises PluginError for a name that is declared twice.
    """
    bonds, particles = bond_numbers(experiment), particle_numbers(experiment)
    names = [number.name for number in (*bonds, *particles)]
    for name in names:
        if (count := names.count(name)) > 1:
            raise PluginError(
                f"the number '{name}' is declared {count} times, by FractureModel "
                f"'{experiment.fracture.type}' and FollowerRule '{experiment.rule.type}'; "
                "each needs a name of its own"
            )
    return {n.name: "fracture" for n in bonds} | {n.name: "rule" for n in particles}


def check_diagnostics(
    experiment: Experiment, raster: Raster, neighbourhood: Neighbourhood
) -> list[str]:
    """Raises ExperimentError for diagnostics that do not go with the scene or each other; returns
    warnings about them."""
    taken = remembered_names(experiment)
    for n, diagnostic in enumerate(experiment.diagnostics):
        with blaming(diagnostic, "when asked what it measures", "diagnostics", n):
            diagnostic.check(raster.total, len(experiment.leaders))
            diagnostic.coordinates()
            if "cells" in diagnostic.needs and not raster.others.any(
                patches(raster, neighbourhood.tiling)
            ):
                raise ExperimentError(
                    f"'{diagnostic.type}' needs cells, and nowhere do the corners of one all "
                    "belong to the body; make it wider, or leave the diagnostic out"
                )
            if "loads" in diagnostic.needs and not experiment.loads:
                raise ExperimentError(f"'{diagnostic.type}' is of loads, and there is none")
            if diagnostic.needs & {"material", "forces"}:
                _refuse_without_material(diagnostic, experiment)
            for variable in diagnostic.variables():
                ours = diagnostic.own_dimension != "obstacle" and not diagnostic.coordinates()
                if "obstacle" in variable.dims and ours and not experiment.obstacles:
                    raise ExperimentError(f"'{diagnostic.type}' is of obstacles, and there is none")
                if variable.name in taken:
                    other = f"{taken[variable.name]} does too"
                    raise ExperimentError(f"adds the variable '{variable.name}'; {other}")
                taken[variable.name] = f"diagnostics.{n}"
    return _doubts(experiment, raster)


def _doubts(experiment: Experiment, raster: Raster) -> list[str]:
    has_frame = raster.others.any((raster.table_kind == FRAME).any())
    return [
        f"diagnostics.{n}: '{diagnostic.type}' counts what frame points pull at leaders, which at "
        "the corners of held edges is no force of the body (the reaction of a clamped cantilever "
        "with 10 cells over its height is 8 times that of the body under 'mean', and 1.6 % off "
        "under 'natural'); take frame: {type: natural}"
        for n, diagnostic in enumerate(experiment.diagnostics)
        if has_frame and "forces" in diagnostic.needs
    ]


def _refuse_without_material(diagnostic: Diagnostic, experiment: Experiment) -> None:
    rule = experiment.rule
    if material_of(rule) is None:
        raise ExperimentError(
            f"'{diagnostic.type}' needs a rule that is calibrated to a material ('elastic', "
            f"'orthotropic', 'springs', 'strain-gradient'), which '{rule.type}' with these "
            "parameters is not; take one of those, or leave the diagnostic out"
        )
    if experiment.neighbours.nearness():
        raise ExperimentError(
            f"'{diagnostic.type}' needs neighbours that stay; set neighbours.reevaluate: false"
        )
