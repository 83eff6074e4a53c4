"""The same scene at another size, as settings such as ``--set`` takes."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

from pbdkit.errors import ExperimentError
from pbdkit.experiment.body import Grid
from pbdkit.experiment.model import Experiment


def resized(experiment: Experiment, size: int) -> tuple[str, ...]:
    """The settings that make about `size` sites lie along the body's longer side.

    A grid gets `size` columns and rows in proportion; what is placed by coordinates keeps its
    place relative to the body. Of any other body the lattice becomes finer, and with it the lengths
    that count in lattice constants: thresholds and the radius of the neighbours.

    Raises ExperimentError where leaders are chosen by number, for numbers change with the size.
    """
    for n, group in enumerate(experiment.leaders):
        if group.select.numbers is not None:
            raise _refusal(
                experiment,
                "leaders chosen by number cannot be resized: numbers change with the size; choose "
                "them by edge, box or nearest, or leave --sizes out to run it as it is",
                *("leaders", n, "select", "numbers"),
            )
    change = _larger_grid if isinstance(experiment.body, Grid) else _finer_lattice
    return tuple(f"{path}={json.dumps(value)}" for path, value in change(experiment, size))


def _refusal(experiment: Experiment, why: str, *where: str | int) -> ExperimentError:
    return experiment.located(ExperimentError(why, where))


def _larger_grid(experiment: Experiment, size: int) -> Iterator[tuple[str, Any]]:
    grid = experiment.body
    assert isinstance(grid, Grid)
    yield "body.columns", size
    yield "body.rows", max(1, round(grid.rows * size / grid.columns))
    factor = (size - 1) / max(1, grid.columns - 1)
    (x, y) = experiment.lattice.origin

    def placed(point: Any) -> list[float]:
        return [x + factor * (point[0] - x), y + factor * (point[1] - y)]

    for n, group in enumerate(experiment.leaders):
        if box := group.select.box:
            yield f"leaders.{n}.select.box", [*placed(box[:2]), *placed(box[2:])]
        if nearest := group.select.nearest:
            yield f"leaders.{n}.select.nearest", [placed(point) for point in nearest]
        if centre := getattr(group.motion, "centre", None):
            yield f"leaders.{n}.motion.centre", placed(centre)
    if cracks := getattr(experiment.fracture, "cracks", None):
        yield "fracture.cracks", [[placed(a), placed(b)] for a, b in cracks]


def _finer_lattice(experiment: Experiment, size: int) -> Iterator[tuple[str, Any]]:
    boxes = experiment.body.boxes()
    if any(box.in_sites for box in boxes):
        raise _refusal(
            experiment,
            "a grid within another body cannot be resized: its outline moves with the lattice; "
            "write a rectangle, or leave --sizes out to run it as it is",
            "body",
        )
    sides = [max(box.high[n] for box in boxes) - min(box.low[n] for box in boxes) for n in (0, 1)]
    constants = {name: getattr(experiment.lattice, name, None) for name in ("a", "b")}
    along = constants["b"] if sides[1] > sides[0] and constants["b"] else constants["a"]
    if along is None:
        what = f"the lattice '{experiment.lattice.type}' has no constant `a` to divide"
        raise _refusal(experiment, f"{what}; leave --sizes out", "lattice")
    factor = max(sides) / max(1, size - 1) / along
    for name, value in constants.items():
        if value is not None:
            yield f"lattice.{name}", value * factor
    if radius := getattr(experiment.neighbours, "radius", None):
        yield "neighbours.radius", radius * factor
    if thresholds := getattr(experiment.fracture, "thresholds", None):
        yield "fracture.thresholds", [threshold * factor for threshold in thresholds]
