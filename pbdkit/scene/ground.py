"""What a scene is built on: who is whose neighbour, and which sites the body and its frame take."""

from __future__ import annotations

from dataclasses import replace

from pbdkit.errors import ExperimentError
from pbdkit.experiment.model import Experiment
from pbdkit.interfaces import MixesCells
from pbdkit.registry.blame import blaming
from pbdkit.scene.cells import WeighedCells, whole_cells
from pbdkit.scene.cut_cells import fill_with_cells, margin_of
from pbdkit.scene.neighbourhood import build_neighbourhood, checked_cell
from pbdkit.scene.others import ALONE, Others
from pbdkit.scene.places import LeftOut
from pbdkit.scene.raster import Extent, Raster
from pbdkit.scene.sites import Filling, Lines, build_raster, fill, framed, window
from pbdkit.scene.sizes import refuse_too_large


class Ground:
    """The neighbourhood, how many `layers` the frame has, and what they have to warn of; then the
    raster of all sites, and the cells `left_out` at narrow voids. Nothing of the size of the body
    is made before it is asked for.

    Raises ExperimentError where parts do not go together, and for bodies too large for the memory.
    """

    def __init__(self, experiment: Experiment, others: Others = ALONE) -> None:
        self.left_out = LeftOut()
        self.experiment, self._others, lattice = experiment, others, experiment.lattice
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
        refuse_too_large(experiment, self.neighbourhood, extent, self.layers, others)

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
        lattice, stretch = self.experiment.lattice, self._others.stretch
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
            extent = Extent(stretch.rows, raster.first[0] - stretch.first)
            raster = replace(raster, before=stretch.before, extent=extent, others=self._others)
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
