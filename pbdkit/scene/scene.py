"""Build the scene of an experiment: neighbourhood, body and frame on rasters, and only those parts
that the experiment uses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

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
    body_box,
    build_bond_table,
    build_neighbourhood,
    checked_cell,
    missing_segments,
    setting_of,
)
from pbdkit.lattice.raster import LeftOut, Raster, RowLayout, RowRange, distinct
from pbdkit.model.experiment import Experiment
from pbdkit.plugin import (
    AppliesTwice,
    MixesCells,
    Remembers,
    Setting,
    StartsCracked,
    TearsCells,
    Vector,
)
from pbdkit.plugin.discovery import blaming
from pbdkit.plugin.fracture import Segment
from pbdkit.plugin.lattice import Index
from pbdkit.plugin.schedule import Course
from pbdkit.scene.checks import (
    angles_in_radians,
    carried_by_leaders,
    doubts_of,
    far_from_the_body,
    locking,
    narrow_voids,
    never_near,
    without_effect,
)
from pbdkit.scene.constants import SceneConstants, ask_for_constants, check_diagnostics, with_fields
from pbdkit.scene.frame import Frame, build_frame
from pbdkit.scene.leaders import Leading, build_leading, check_directions
from pbdkit.scene.loads import Loads, build_loads
from pbdkit.scene.materials import weighed
from pbdkit.scene.memory_estimate import refuse_too_large
from pbdkit.scene.obstacles import Barrier, build_obstacles, collisions
from pbdkit.scene.operations import Operated, build_operations


class Ground:
    """The neighbourhood, how many `layers` the frame has, and what they have to warn of; then the
    raster of all sites, and the cells `left_out` at narrow voids. Nothing of the size of the body
    is made before it is asked for.

    Raises ExperimentError where parts do not go together, and for bodies too large for the memory.
    """

    def __init__(
        self,
        experiment: Experiment,
        communicator: Communicator = SERIAL,
        row_range: RowRange | None = None,
    ) -> None:
        self.left_out = LeftOut()
        self.experiment, lattice = experiment, experiment.lattice
        self._communicator, self._row_range = communicator, row_range
        neighbours, fracture, frame = experiment.neighbours, experiment.fracture, experiment.frame
        with blaming(lattice, "when asked for its cell", "lattice"):
            self.cell = checked_cell(lattice)
        with blaming(neighbours, "when asked for the neighbours", "neighbours"):
            self.neighbourhood = build_neighbourhood(self.cell, neighbours)
        with blaming(fracture, "when asked about the rest lengths", "fracture"):
            self.warnings = tuple(fracture.check(self.neighbourhood.shells()))
        with blaming(frame, "when asked for its depth", "frame"):
            self.layers = frame.depth(self.neighbourhood.reach)
        low, high = window(experiment.body, lattice)
        extent = tuple(b - a + 1 for a, b in zip(low, high, strict=True))
        refuse_too_large(experiment, self.neighbourhood, extent, self.layers, communicator)

    @property
    def spill(self) -> int:
        """So many lines beyond its window the body can have particles."""
        return margin_of(self.neighbourhood.tiling) if self.experiment.frame.weighs_cells else 0

    def filled(self, lines: Lines | None = None) -> Filling:
        """The body, of those sites that are on some lines."""
        experiment, tiling = self.experiment, self.neighbourhood.tiling
        if not experiment.frame.weighs_cells:
            return fill(experiment.body, experiment.lattice, lines)
        self._refuse_without_cells()
        return fill_with_cells(experiment.body, experiment.lattice, tiling, lines)

    def raster(self) -> tuple[Raster, WeighedCells | None]:
        """The raster, and the cells where the frame weighs them."""
        lattice, stretch = self.experiment.lattice, self._row_range and self._row_range.stretch
        filling = self.filled((stretch.low[0], stretch.high[0]) if stretch else None)
        self.left_out = stretch.left_out if stretch else filling.left_out_on()
        box = (stretch.low, stretch.high) if stretch else filling.box
        if not box:
            raise self.nothing()
        filling = filling.within(*box)
        low, sites = framed(lattice, filling, self.layers)
        if stretch:
            (first, last), (before, *rest) = stretch.lines, low
            low, sites = (first, *rest), sites[first - before : last - before]
        raster = build_raster(lattice, low, sites, self.neighbourhood.reach_in_cells)
        if stretch:
            extent = RowLayout(stretch.rows, raster.first[0] - stretch.first)
            raster = replace(
                raster,
                before=stretch.before,
                extent=extent,
                communicator=self._communicator,
                row_range=self._row_range,
            )
        cells, tiling = filling.on(raster, self.neighbourhood.tiling), self.neighbourhood.tiling
        # Without frame points a cell that misses a corner is none: what the other corners exert on
        # each other would not balance.
        if not (cells or self.layers) and isinstance(self.experiment.rule, MixesCells):
            cells = whole_cells(raster, tiling) if tiling.beside else None
        return raster, cells

    def nothing(self) -> ExperimentError:
        """Where the body has no particle."""
        text = "holds no site of the lattice; make it larger, or move it"
        if self.experiment.frame.weighs_cells:
            text = (
                "holds no cell of the lattice; make it larger, or take a frame that does not weigh "
                "cells"
            )
        return ExperimentError(text, ("body",))

    def _refuse_without_cells(self) -> None:
        frame, rule = self.experiment.frame, self.experiment.rule
        if not rule.uses_cells:
            raise ExperimentError(
                f"'{frame.type}' weighs the cells between neighbours, and the rule '{rule.type}' "
                "does not work cell by cell; take a calibrated rule ('elastic' with poisson_ratio "
                "-1 is the barycentre), or another frame",
                ("frame",),
            )
        if not self.neighbourhood.tiling.beside:
            raise ExperimentError(
                "the neighbours of a site are not the corners of the cells around it: take 8 on "
                "the square or the rectangular lattice ({type: chebyshev, shells: 1}), 6 on the "
                "hexagonal one ({type: coordination, shells: 1})",
                ("neighbours",),
            )


@dataclass(frozen=True)
class Scene:
    """An experiment on its lattice.

    `constants` are what the elementwise functions are called with. `frame`, `cells`, `inner` (the
    scene with the rule's inner rule) and `loads` are None where the scene has none. `leading` are
    the leader groups; `setting` is what a rule may derive its constants from, `middle` that of the
    body's box, from the lattice's site (0, 0); `warnings` are for the user, `barriers` the
    obstacles, `operations` those of the experiment.
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

    @property
    def driven(self) -> tuple[Leading | Barrier, ...]:
        """All that motions drive."""
        return (*self.leading, *self.barriers)

    def at(self, moment: float) -> Scene:
        """The scene with its numbers as they are at the end of a step, or at a moment within it; in
        itself they are as in the end."""
        courses = self._courses
        if all(course.at(moment) == course.last for course in courses):
            return self
        now = tuple(course.at(moment) for course in courses)
        if now not in self._known:
            self._known.clear()
            self._known[now] = renumbered(self, self.experiment.at(moment))
        return self._known[now]

    @cached_property
    def _courses(self) -> tuple[Course[float], ...]:
        """The numbers that change in time."""
        return tuple(self.experiment.courses.values())

    @cached_property
    def _known(self) -> dict[tuple[float, ...], Scene]:
        """The scene of the last moment, by its numbers."""
        return {}

    @cached_property
    def bare(self) -> Scene:
        """The same without obstacles and operations of particles."""
        if not (self.barriers or self.operations):
            return self
        return replace(self, barriers=(), operations=())

    @property
    def has_fracture(self) -> bool:
        """Whether bonds can come to be broken, torn or cut, so that their state is kept."""
        return self.experiment.parts_bonds

    @property
    def tears(self) -> bool:
        """Whether cells can be torn: bonds can break, and the rule computes what torn cells
        exert."""
        return self.has_fracture and isinstance(self.experiment.rule, TearsCells)

    @cached_property
    def home_reach(self) -> tuple[Index, Index]:
        """How many repeat cells before and after a particle's own, along each axis, the bonds are
        kept on which its move depends: its own, or where cells can be torn all of the cells around
        it."""
        if not self.tears:
            return self.neighbourhood.home_reach
        cells = (cell for of in self.neighbourhood.cells_around for cell in of.cells)
        homes = {bond.home for cell in cells for bond in cell}
        steps = np.array([home.cell if home else (0,) * self.axes for home in homes])
        low, high = np.minimum(steps.min(axis=0), 0), np.maximum(steps.max(axis=0), 0)
        return tuple((-low).tolist()), tuple(high.tolist())

    @property
    def lag(self) -> int:
        """By how many steps the frame trails whom it follows."""
        return self.frame.map.lag if self.frame else 0

    @property
    def axes(self) -> int:
        """How many axes space has: the lattice says so."""
        return len(self.raster.lattice.cell().vectors)

    @property
    def frame_changes(self) -> bool:
        """Whether the frame's map follows numbers of the rule that change in time."""
        changing = bool(self.experiment.rule.courses)
        return changing and self.frame is not None and self.frame.depends_on_rule

    @cached_property
    def leaders_overlap(self) -> bool:
        """Whether any particle belongs to two leader groups."""
        rows = [leading.rows for leading in self.leading]
        return bool(rows) and len(distinct(np.concatenate(rows))) < sum(map(len, rows))

    @cached_property
    def bonds(self) -> BondTable:
        """The table of bonds."""
        return build_bond_table(self.raster, self.neighbourhood)

    @cached_property
    def patches(self) -> tuple[Patch, ...]:
        """The cells of the body."""
        return patches(self.raster, self.neighbourhood.tiling)


def build_scene(
    experiment: Experiment,
    communicator: Communicator = SERIAL,
    row_range: RowRange | None = None,
) -> Scene:
    """Return the scene of an experiment, or of a range of its rows, which the processes of a
    `communicator` build together. Raises ExperimentError, with file and line where they are known,
    if there is none."""
    try:
        return _build(experiment, Ground(experiment, communicator, row_range))
    except ExperimentError as error:
        raise experiment.located(error) from None


def _build(experiment: Experiment, ground: Ground) -> Scene:
    neighbours = experiment.neighbours
    neighbourhood, layers = ground.neighbourhood, ground.layers
    raster, cells = ground.raster()
    warnings = [*ground.warnings, *doubts_of(experiment, neighbourhood, raster, layers)]
    warnings += check_diagnostics(experiment, raster, neighbourhood)
    warnings += [*without_effect(experiment, raster), *far_from_the_body(experiment, raster)]
    warnings += [*angles_in_radians(experiment), *locking(experiment, raster)]
    warnings += narrow_voids(experiment.lattice, ground.left_out)
    warnings += missing_segments(raster, neighbourhood, _segments(experiment))
    setting = setting_of(raster, neighbourhood)
    constants = ask_for_constants(experiment, setting)
    constants = with_fields(constants, experiment, raster, neighbourhood, setting)
    if neighbours.nearness() and any(constants.weights.values()):
        raise ExperimentError(
            f"'{experiment.rule.type}' weighs neighbours by their slots, which re-evaluated "
            "neighbours do not have; set neighbours.reevaluate: false",
            ("neighbours",),
        )
    leading = build_leading(raster, experiment)
    following = _frame_of(raster, experiment)
    check_directions(experiment, has_frame=raster.communicator.any(following is not None))
    cells = weighed(experiment, raster, setting, cells)
    loads = build_loads(raster, neighbourhood.tiling, cells, experiment)
    barriers = build_obstacles(raster, experiment)
    warnings += collisions(raster, leading, barriers, experiment.steps)
    warnings += carried_by_leaders(raster, leading, loads, experiment.steps)
    if not loads:
        warnings += never_near(raster, barriers, leading, experiment.steps)
    parts = (neighbourhood, raster, constants, following, cells, None, leading)
    lower, upper = body_box(raster)
    facts = loads, setting, (lower + upper) / 2
    operations = build_operations(raster, experiment)
    return with_inner(Scene(experiment, *parts, *facts, tuple(warnings), barriers, operations))


def _segments(experiment: Experiment) -> dict[str, Segment]:
    """The cuts, and the cracks that are there from the start, by their fields."""
    found = {f"cuts.{n}": cut.segment for n, cut in enumerate(experiment.cuts)}
    if isinstance(model := experiment.fracture, StartsCracked):
        with blaming(model, "when asked for its cracks", "fracture"):
            found |= {f"fracture.cracks.{n}": s for n, s in enumerate(model.segments())}
    return found


def renumbered(scene: Scene, experiment: Experiment) -> Scene:
    """The scene with the numbers of an experiment that is like its own but for them."""
    constants = ask_for_constants(experiment, scene.setting)
    parts = (experiment, scene.raster, scene.neighbourhood, scene.setting)
    constants = with_fields(constants, *parts)
    cells, frame = weighed(experiment, scene.raster, scene.setting, scene.cells), scene.frame
    if frame and frame.depends_on_rule and experiment.rule is not scene.experiment.rule:
        frame = _frame_of(scene.raster, experiment)
    found = replace(scene, experiment=experiment, constants=constants, cells=cells, frame=frame)
    return with_inner(found)


def _frame_of(raster: Raster, experiment: Experiment) -> Frame | None:
    with blaming(experiment.frame, "when asked whom its points follow", "frame"):
        return build_frame(raster, experiment.frame, experiment.rule)


def with_inner(scene: Scene) -> Scene:
    """The scene with that of its inner rule, where the rule works on the moves of another.

    Raises ExperimentError for frames that lag, for bonds that break, neighbours that come and go
    and rules that remember: what the moves of the inner rule are is not told there.
    """
    experiment, rule = scene.experiment, scene.experiment.rule
    if not isinstance(rule, AppliesTwice):
        return scene
    with blaming(rule, "when asked for its inner rule", "rule"):
        inner = rule.inner()
    remembers = isinstance(rule, Remembers) or isinstance(inner, Remembers)
    for unfit, part, remedy in (
        (scene.lag, "frame", "lag: 0"),
        (experiment.cuts, "cuts", "[]"),
        (experiment.fracture.can_break, "fracture", "{type: none}"),
        (experiment.neighbours.nearness(), "neighbours", "reevaluate: false"),
        (remembers, "rule", "one that remembers nothing"),
    ):
        if unfit:
            raise ExperimentError(
                f"'{rule.type}' applies a rule to the moves of another, which does not go with "
                f"{'such' if part == 'cuts' else 'this'} {part}; take {part}: {remedy}",
                (part,),
            )
    experiment = experiment.model_copy(update={"rule": inner})
    constants = ask_for_constants(experiment, scene.setting)
    below = replace(scene, experiment=experiment, constants=constants, inner=None, loads=None)
    return replace(scene, inner=with_inner(below))
