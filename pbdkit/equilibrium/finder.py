"""The finder of equilibria that a scene asks for."""

from __future__ import annotations

from pbdkit.equilibrium.certificate import scale_of
from pbdkit.equilibrium.newton import Finder
from pbdkit.equilibrium.rows import ALL, Rows
from pbdkit.results.progress import Watch
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State


def finder_of(
    scene: Scene,
    start: State,
    watch: Watch | None = None,
    *,
    compiles: bool = True,
    rows: Rows = ALL,
) -> Finder:
    """What finds the equilibrium that a scene asks for, from its initial state. Whoever asks for
    many that differ by numbers compiles none of their moves."""
    asked, scale = scene.experiment.solver.sought, scale_of(scene, start, rows)
    length = asked.tolerance * scale
    return Finder(scene, length, scale, asked.method, watch or Watch(), compiles, rows)
