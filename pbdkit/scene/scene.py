"""Scene of an experiment, and its construction: neighbours, body and frame on rasters, leaders,
loads, obstacles.

Only the parts that the experiment uses are built.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from pbdkit.communicator import SERIAL, Communicator
from pbdkit.errors import ExperimentError
from pbdkit.lattice.cells import Patch, WeighedCells, patches, whole_cells
from pbdkit.lattice.fill import (
    Filling,
    Lines,
    build_raster,
    fill,
    fill_with_cells,
    framed,
    margin_of,
    window,
)
from pbdkit.lattice.neighbourhood import (
    BondTable,
    Neighbourhood,
    build_bond_table,
    build_neighbourhood,
    checked_cell,
    missing_segments,
    setting_of,
)
from pbdkit.lattice.raster import OmittedCells, Raster, Restriction, RowLayout, RowRange, distinct
from pbdkit.model.bodies import Difference
from pbdkit.model.experiment import Experiment
from pbdkit.plugin import (
    AppliesTwice,
    Diagnostic,
    MixesCells,
    Remembers,
    Setting,
    TearsCells,
    Vector,
)
from pbdkit.plugin.discovery import errors_attributed_to
from pbdkit.plugin.lattice import Index
from pbdkit.plugin.schedule import TimeDependent
from pbdkit.scene import checks
from pbdkit.scene.constants import SceneConstants, check_diagnostics, scene_constants, with_fields
from pbdkit.scene.crack_ends import diagnostics_at_cracks, segments_of
from pbdkit.scene.frame import Frame, build_frame
from pbdkit.scene.leader_groups import Leading, build_leading, check_directions
from pbdkit.scene.loads import Loads, build_loads
from pbdkit.scene.materials import weighed
from pbdkit.scene.memory_estimate import refuse_too_large
from pbdkit.scene.obstacles import Barrier, build_obstacles, collisions
from pbdkit.scene.operations import Operated, build_operations


class LatticeSetup:
    """Neighbours, frame layers and body of an experiment. They are the first stage in the
    construction of its scene.

    Arrays of the size of the body are created only on request.

    Parameters
    ----------
    experiment
        The experiment.
    communicator
        Processes that share the lattice.

    Attributes
    ----------
    neighbourhood
        Neighbours on the lattice.
    layers
        Number of layers of the frame.
    warnings
        Warnings of the fracture model.
    left_out
        Cells omitted at narrow voids. Available after a call of `raster`.

    Raises
    ------
    ExperimentError
        If parts of the experiment are incompatible, or the body is too large for the memory.
    """

    def __init__(
        self,
        experiment: Experiment,
        communicator: Communicator = SERIAL,
        row_range: RowRange | None = None,
    ) -> None:
        self.left_out = OmittedCells()
        self.experiment, self._communicator, self._row_range = experiment, communicator, row_range
        lattice, neighbours = experiment.lattice, experiment.neighbours
        fracture, frame = experiment.fracture, experiment.frame
        with errors_attributed_to(lattice, "to return its cell", "lattice"):
            self.cell = checked_cell(lattice)
        with errors_attributed_to(neighbours, "to return the neighbours", "neighbours"):
            self.neighbourhood = build_neighbourhood(self.cell, neighbours)
        with errors_attributed_to(fracture, "to check the rest lengths", "fracture"):
            self.warnings = tuple(fracture.check(self.neighbourhood.shells()))
        with errors_attributed_to(frame, "to return its depth", "frame"):
            self.layers = frame.depth(self.neighbourhood.reach)
        low, high = window(experiment.body, lattice)
        extent = tuple(b - a + 1 for a, b in zip(low, high, strict=True))
        refuse_too_large(experiment, self.neighbourhood, extent, self.layers, communicator)

    @property
    def spill(self) -> int:
        """Maximum number of lines outside the window of the body on which it can have particles."""
        return margin_of(self.neighbourhood.tiling) if self.experiment.frame.weighs_cells else 0

    def filled(self, lines: Lines | None = None) -> Filling:
        """Return the sites of the body on the lines, by default on all lines."""
        experiment, tiling = self.experiment, self.neighbourhood.tiling
        if not experiment.frame.weighs_cells:
            return fill(experiment.body, experiment.lattice, lines)
        self._refuse_without_cells()
        return fill_with_cells(experiment.body, experiment.lattice, tiling, lines)

    def raster(self) -> tuple[Raster, WeighedCells | None]:
        """Return the raster, and the weighted cells if the frame weights cells."""
        lattice, stretch = self.experiment.lattice, self._row_range and self._row_range.stretch
        filling = self.filled((stretch.low[0], stretch.high[0]) if stretch else None)
        self.left_out = stretch.left_out if stretch else filling.left_out_on()
        box = (stretch.low, stretch.high) if stretch else filling.box
        if not box:
            raise self.nothing()
        filling = filling.within(*box)
        low, sites = framed(lattice, filling, self.layers)
        if stretch:
            (first, last), (start, *rest) = stretch.lines, low
            low, sites = (first, *rest), sites[first - start : last - start]
        raster = build_raster(lattice, low, sites, self.neighbourhood.reach_in_cells)
        if stretch:
            extent = RowLayout(stretch.rows, raster.first[0] - stretch.first)
            raster = replace(
                raster,
                particle_offset=stretch.particle_offset,
                extent=extent,
                communicator=self._communicator,
                row_range=self._row_range,
            )
        cells, tiling = filling.on(raster, self.neighbourhood.tiling), self.neighbourhood.tiling
        # Without frame points, a cell with a missing corner is omitted, because the forces between
        # its other corners would not balance.
        if not (cells or self.layers) and isinstance(self.experiment.rule, MixesCells):
            cells = whole_cells(raster, tiling) if tiling.beside else None
        return raster, cells

    def nothing(self) -> ExperimentError:
        """Return the error for a body without particles."""
        frame, body = self.experiment.frame, self.experiment.body
        text = f"contains no {'cell' if frame.weighs_cells else 'site'} of the lattice; "
        if isinstance(body, Difference):
            text += "make the parts that are subtracted smaller, or the first part larger"
        else:
            text += "enlarge it, or move it"
        if frame.weighs_cells:
            text += ", or use a frame that does not weight cells"
        return ExperimentError(text, ("body",))

    def _refuse_without_cells(self) -> None:
        frame, rule = self.experiment.frame, self.experiment.rule
        if not rule.uses_cells:
            raise ExperimentError(
                f"'{frame.type}' weights the cells between neighbours, but the rule '{rule.type}' "
                "is not defined by cells; use a calibrated rule ('elastic' with poisson_ratio -1 "
                "is the barycentre), or another frame",
                ("frame",),
            )
        if not self.neighbourhood.tiling.beside:
            raise ExperimentError(
                "the neighbours of a site are not the corners of the cells around it: use 8 on "
                "the square or the rectangular lattice ({type: chebyshev, shells: 1}), 6 on the "
                "hexagonal one ({type: coordination, shells: 1})",
                ("neighbours",),
            )


@dataclass(frozen=True)
class Scene:
    """Experiment on its lattice.

    Parameters
    ----------
    experiment
        The experiment.
    neighbourhood
        Neighbours on the lattice.
    raster
        Raster of the particles.
    constants
        Constants of the rule and the fracture model.
    frame
        Frame points; None if there are none.
    cells
        Weighted cells; None if cells are not weighted.
    inner
        Scene of the inner rule; None if the rule has no inner rule.
    leading
        Leader groups.
    loads
        Loads; None if there are none.
    setting
        Lattice context from which rules derive constants.
    middle
        Centre of the bounding box of the body, relative to site (0, 0) of the lattice.
    warnings
        Warnings for the user.
    barriers
        Obstacles.
    operations
        Operations of particles.
    diagnostics
        Diagnostics as they are measured.
    """

    experiment: Experiment
    neighbourhood: Neighbourhood
    raster: Raster
    constants: SceneConstants
    frame: Frame | None
    cells: WeighedCells | None
    inner: Scene | None
    leading: tuple[Leading, ...]
    loads: Loads | None
    setting: Setting
    middle: Vector[float]
    warnings: tuple[str, ...]
    barriers: tuple[Barrier, ...] = ()
    operations: tuple[Operated, ...] = ()
    diagnostics: tuple[Diagnostic, ...] = ()

    @property
    def driven(self) -> tuple[Leading | Barrier, ...]:
        """Leader groups and obstacles. The movement of both is described by motions."""
        return (*self.leading, *self.barriers)

    def at(self, moment: float) -> Scene:
        """Return the scene with its time-dependent parameters at the end of a step, or at a moment
        within it.

        `self` has the final values of its time-dependent parameters.
        """
        time_dependent = self._time_dependent
        if all(number.at(moment) == number.last for number in time_dependent):
            return self
        values = tuple(number.at(moment) for number in time_dependent)
        if values not in self._cache:
            self._cache.clear()
            self._cache[values] = renumbered(self, self.experiment.at(moment))
        return self._cache[values]

    @cached_property
    def _time_dependent(self) -> tuple[TimeDependent[float], ...]:
        """Time-dependent parameters, by their path in the file."""
        return tuple(self.experiment.time_dependent.values())

    @cached_property
    def _cache(self) -> dict[tuple[float, ...], Scene]:
        """Last scene that `at` returned, with the values of the time-dependent parameters as its
        key."""
        return {}

    @cached_property
    def bare(self) -> Scene:
        """The scene without obstacles and operations of particles."""
        if not (self.barriers or self.operations):
            return self
        return replace(self, barriers=(), operations=())

    def restrict(self, to: Restriction) -> Scene:
        """Return the scene restricted to some rows of the lattice. The method `restrict` of each
        feature is called."""
        values = {each.name: _restricted(getattr(self, each.name), to) for each in fields(self)}
        return replace(self, **values | {"raster": to.part})

    @property
    def has_fracture(self) -> bool:
        """True if bonds can break or be cut, so that their state is stored."""
        return self.experiment.parts_bonds

    @property
    def tears(self) -> bool:
        """True if bonds can break and the rule computes the forces of torn cells."""
        return self.has_fracture and isinstance(self.experiment.rule, TearsCells)

    @cached_property
    def owner_reach(self) -> tuple[Index, Index]:
        """Largest differences in repeat cells, backward and forward, between a particle and the
        places that store the bonds on which the move of the particle depends.

        These are the bonds of the particle or, if cells can be torn, of all cells around it.
        """
        if not self.tears:
            return self.neighbourhood.owner_reach
        cells = (cell for around in self.neighbourhood.cells_around for cell in around.cells)
        owners = {bond.owner for cell in cells for bond in cell}
        steps = np.array([owner.cell if owner else (0,) * self.axes for owner in owners])
        low, high = np.minimum(steps.min(axis=0), 0), np.maximum(steps.max(axis=0), 0)
        return tuple((-low).tolist()), tuple(high.tolist())

    @property
    def frame_delay(self) -> int:
        """Delay of the frame in steps."""
        return self.frame.map.delay if self.frame else 0

    @property
    def axes(self) -> int:
        """Number of axes of space, which is the number of axes of the lattice."""
        return len(self.raster.cell.vectors)

    @property
    def frame_changes(self) -> bool:
        """True if the map of the frame depends on time-dependent parameters of the rule."""
        is_variable = bool(self.experiment.rule.time_dependent)
        return is_variable and self.frame is not None and self.frame.depends_on_rule

    @cached_property
    def leaders_overlap(self) -> bool:
        """True if a particle belongs to two leader groups."""
        rows = [leading.rows for leading in self.leading]
        return bool(rows) and len(distinct(np.concatenate(rows))) < sum(map(len, rows))

    @cached_property
    def bonds(self) -> BondTable:
        """Table of all bonds."""
        return build_bond_table(self.raster, self.neighbourhood)

    @cached_property
    def patches(self) -> tuple[Patch, ...]:
        """Cells with all corners in the body."""
        return patches(self.raster, self.neighbourhood.tiling)


def _restricted(value: Any, to: Restriction) -> Any:
    if type(value) is tuple:
        return tuple(_restricted(part, to) for part in value)
    return value.restrict(to) if hasattr(value, "restrict") else value


def build_scene(
    experiment: Experiment,
    communicator: Communicator = SERIAL,
    row_range: RowRange | None = None,
) -> Scene:
    """Build the scene of an experiment.

    Parameters
    ----------
    experiment
        The experiment.
    communicator
        Processes that share the lattice.
    row_range
        Range of rows that this process builds; all by default.

    Raises
    ------
    ExperimentError
        If no scene can be built, with file and line if they are known.
    """
    try:
        return _build(experiment, LatticeSetup(experiment, communicator, row_range))
    except ExperimentError as error:
        raise experiment.located(error) from None


def _build(experiment: Experiment, ground: LatticeSetup) -> Scene:
    neighbours = experiment.neighbours
    neighbourhood, layers = ground.neighbourhood, ground.layers
    raster, cells = ground.raster()
    box = raster.body_box()
    warnings = [
        *ground.warnings,
        *checks.lattice_warnings(experiment, neighbourhood, raster, layers),
    ]
    warnings += check_diagnostics(experiment, raster, neighbourhood)
    warnings += [
        *checks.without_effect(experiment, raster),
        *checks.far_from_the_body(experiment, raster),
        *checks.wide_sections(experiment, raster, box),
        *checks.groups_without_reaction(experiment),
    ]
    warnings += [*checks.angles_in_radians(experiment), *checks.locking(experiment, raster, box)]
    warnings += checks.coarse_arcs(experiment, raster)
    warnings += checks.narrow_voids(experiment.lattice, ground.left_out)
    segments = {name: part.segment for name, part in segments_of(experiment).items()}
    warnings += missing_segments(raster, neighbourhood, segments)
    setting = setting_of(raster, neighbourhood, box)
    constants = scene_constants(experiment, setting)
    constants = with_fields(constants, experiment, raster, neighbourhood, setting)
    if neighbours.nearness() and any(constants.weights.values()):
        raise ExperimentError(
            f"'{experiment.rule.type}' has weights for each slot, which re-evaluated neighbours "
            "do not have; set neighbours.reevaluate: false",
            ("neighbours",),
        )
    leading = build_leading(raster, experiment)
    following = _frame_of(raster, experiment)
    check_directions(experiment, has_frame=raster.communicator.any(following is not None))
    cells = weighed(experiment, raster, setting, cells)
    loads = build_loads(raster, neighbourhood.tiling, cells, experiment)
    barriers = build_obstacles(raster, experiment)
    warnings += collisions(raster, leading, barriers, experiment.steps)
    warnings += checks.carried_by_leaders(raster, leading, loads, experiment.steps)
    if not loads:
        warnings += checks.never_near(raster, barriers, leading, experiment.steps)
    parts = (neighbourhood, raster, constants, following, cells, None, leading)
    lower, upper = box
    facts = loads, setting, (lower + upper) / 2
    operations = build_operations(raster, experiment)
    measured = operations, diagnostics_at_cracks(experiment)
    return with_inner(Scene(experiment, *parts, *facts, tuple(warnings), barriers, *measured))


def renumbered(scene: Scene, experiment: Experiment) -> Scene:
    """Return the scene of an experiment that differs only in the values of parameters."""
    constants = scene_constants(experiment, scene.setting)
    parts = (experiment, scene.raster, scene.neighbourhood, scene.setting)
    constants = with_fields(constants, *parts)
    cells, frame = weighed(experiment, scene.raster, scene.setting, scene.cells), scene.frame
    if frame and frame.depends_on_rule and experiment.rule is not scene.experiment.rule:
        frame = _frame_of(scene.raster, experiment)
    scene = replace(scene, experiment=experiment, constants=constants, cells=cells, frame=frame)
    return with_inner(scene)


def _frame_of(raster: Raster, experiment: Experiment) -> Frame | None:
    with errors_attributed_to(experiment.frame, "to map the frame points", "frame"):
        return build_frame(raster, experiment.frame, experiment.rule)


def with_inner(scene: Scene) -> Scene:
    """Add the scene of the inner rule if the rule is applied to the moves of an inner rule.

    Raises
    ------
    ExperimentError
        If the frame has a delay, bonds can break, neighbours are re-evaluated or a rule has state
        variables, because the moves of the inner rule are not defined in these cases.
    """
    experiment, rule = scene.experiment, scene.experiment.rule
    if not isinstance(rule, AppliesTwice):
        return scene
    with errors_attributed_to(rule, "to return its inner rule", "rule"):
        inner = rule.inner()
    remembers = isinstance(rule, Remembers) or isinstance(inner, Remembers)
    for clash, part, remedy in (
        (scene.frame_delay, "frame", "lag: 0"),
        (experiment.cuts, "cuts", "[]"),
        (experiment.fracture.can_break, "fracture", "{type: none}"),
        (experiment.neighbours.nearness(), "neighbours", "reevaluate: false"),
        (remembers, "rule", "one without remembered numbers"),
    ):
        if clash:
            raise ExperimentError(
                f"'{rule.type}' applies a rule to the moves of another, which is incompatible with "
                f"this setting of {part}; use {part}: {remedy}",
                (part,),
            )
    experiment = experiment.model_copy(update={"rule": inner})
    constants = scene_constants(experiment, scene.setting)
    below = replace(scene, experiment=experiment, constants=constants, inner=None, loads=None)
    return replace(scene, inner=with_inner(below))
