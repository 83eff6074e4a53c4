"""Breaking the bonds that cross a crack or a cut (docs/fracture.md)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces.fracture_model import Segment
from pbdkit.scene.bonds import crossed_bonds
from pbdkit.scene.scene import Scene

BrokenSteps = NDArray[np.integer[Any]]
"""The step at which each bond broke, (plane, cell, cell), -1 where it has not."""


def break_crossed(
    scene: Scene, segments: Iterable[Segment], broken: BrokenSteps, step: int
) -> None:
    """Marks, in place, the bonds that cross a segment and are whole as broken at a step."""
    for n, block, crossed in crossed_bonds(scene.raster, scene.neighbourhood, segments):
        there = block.within(broken[n])
        there[crossed & (there < 0)] = step


def cut_bonds(scene: Scene, broken: BrokenSteps | None, step: int) -> bool:
    """Makes, in place, the cuts of the beginning of a step; whether there are any."""
    segments = [cut.segment for cut in scene.experiment.cuts if cut.at == step]
    if segments:
        assert broken is not None
        break_crossed(scene, segments, broken, step)
    return bool(segments)
