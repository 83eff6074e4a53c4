"""The scene of an experiment that differs from another by numbers."""

from __future__ import annotations

from dataclasses import replace

from pbdkit.errors import ExperimentError
from pbdkit.experiment.model import Experiment
from pbdkit.scene.scene import Scene, build_scene, renumbered

GEOMETRY = ("lattice", "body", "regions", "neighbours", "frame", "initial", "loads", "cuts")
"""The parts of an experiment that its scene is built of besides numbers and motions."""


def scene_like(scene: Scene, experiment: Experiment) -> Scene:
    """The scene of an experiment that differs by numbers, as much as possible of it as it was.

    Raises ExperimentError where they decide which particles there are.
    """
    own = scene.experiment
    groups = zip(experiment.leaders, own.leaders, strict=True)
    same_leaders = all(a.select == b.select and a.axes == b.axes for a, b in groups)
    if same_leaders and all(getattr(experiment, name) is getattr(own, name) for name in GEOMETRY):
        if experiment.leaders is not own.leaders:
            pairs = zip(scene.leading, experiment.leaders, strict=True)
            leading = tuple(replace(leading, group=group) for leading, group in pairs)
            scene = replace(scene, leading=leading)
        return renumbered(scene, experiment)
    found = build_scene(experiment)
    if found.raster.shape != scene.raster.shape or (found.raster.kind != scene.raster.kind).any():
        raise ExperimentError(
            "the number decides which particles there are, one by one, and that is no smooth way; "
            "sensitivities are of rules, fields, loads and motions"
        )
    return found
