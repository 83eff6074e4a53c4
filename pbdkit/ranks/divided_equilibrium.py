"""The driver of a part for the solver `equilibrium`."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from typing import Any

from pbdkit.equilibrium.certificate import Certificate
from pbdkit.equilibrium.increments import Way
from pbdkit.equilibrium.system import StuckError
from pbdkit.errors import NotSharedError
from pbdkit.ranks.divided_driver import CHANGING_FRAME, DividedWatch, Division, refuse
from pbdkit.ranks.divided_rows import DividedRows, strip_of
from pbdkit.results.progress import Watch
from pbdkit.runs.drivers import Straight
from pbdkit.scene.scene import Scene
from pbdkit.scene.solver_sizes import asks_for_grids
from pbdkit.stepping.state import State, initial_state

STUCK = "the iteration that several processes share gets nowhere; run it in one process"


class DividedStraight(Straight):
    """Finds the equilibrium of a part with the others: of rules that are linear, without bonds that
    break and without obstacles, on the stencils of a lattice with one site a cell."""

    def __init__(self, division: Division, scene: Scene, watch: Watch) -> None:
        ranks, self._division = division.ranks, division
        refuse(scene, [(ranks.any(scene.frame_changes), ("frame",), CHANGING_FRAME)])
        _refuse(scene)
        start, anew = division.begun(scene)
        super().__init__(division.scene, start, DividedWatch(ranks, watch))
        self._start = None if anew else start.copy()
        strip = strip_of(scene, division.part.subdomain, ranks.size)
        self._rows = DividedRows(ranks, division.halo, strip)

    def standing(self) -> dict[str, Any]:
        """With the state of the whole, as it is joined."""
        return self._division.standing(super().standing())

    def take_up(self, standing: Mapping[str, Any]) -> None:
        """From the state of the whole, which the first process has."""
        super().take_up(self._division.taken_up(standing))

    def _way(self, state: State) -> Way:
        from pbdkit.equilibrium.finder import finder_of
        from pbdkit.equilibrium.increments import increments

        scene, start = self.scene, self._start or initial_state(self.scene)
        try:
            finder = finder_of(scene, start, self.watch, rows=self._rows)
            way = increments(scene, state, self.watch, self.moment, finder, self._stops)
            certificate = yield from self._renewed(way)
        except StuckError:
            raise NotSharedError(STUCK, ("solver",)) from None
        self._division.halo.renew(state)
        return certificate

    def _renewed(self, way: Way) -> Way:
        """The same with what frame points show at each equilibrium."""
        while True:
            try:
                reached = next(way)
            except StopIteration as end:
                certificate: Certificate = end.value
                return certificate
            if reached.at_rest:
                self._division.halo.renew(reached.state)
            yield reached


def _refuse(scene: Scene) -> None:
    from pbdkit.equilibrium.grids.primitive_raster import PrimitiveRaster

    experiment, rule = scene.experiment, f"the equilibrium of rule '{scene.experiment.rule.type}'"
    method, grid = experiment.solver.sought.method, PrimitiveRaster.of(scene)
    refuse(
        scene,
        [
            (scene.has_fracture, ("fracture",), "an equilibrium with bonds that break"),
            (bool(scene.barriers), ("obstacles",), "an equilibrium before obstacles"),
            (not experiment.rule.linear, ("rule",), f"{rule}, which is not linear"),
            (scene.inner is not None, ("rule",), f"{rule}, which applies twice"),
            (
                bool(experiment.neighbours.nearness()) or grid is None,
                ("neighbours",),
                "an equilibrium whose neighbours lie farther away than in the next cell",
            ),
            (
                grid is None or not grid.is_the_scenes,
                ("lattice",),
                "the equilibrium of a lattice with several sites a cell",
            ),
            (
                method not in ("auto", "multigrid"),
                ("solver", "method"),
                f"an equilibrium by method '{method}'",
            ),
            (not find_spec("numba"), ("solver",), "an equilibrium without numba"),
            (
                not asks_for_grids(experiment, method, scene.raster.total),
                ("solver", "method"),
                "an equilibrium so small that factors of a matrix find it",
            ),
        ],
    )
