"""The sheets that are stepped, and rules as a third party writes them."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Literal

import numpy as np

import pbdkit
from pbdkit.model.reading import Source
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.numba_engine.engine import CompiledStepper
from pbdkit.stepping.state import initial_state


class OwnBarycentre(pbdkit.FollowerRule):
    """The barycentre, from outside."""

    type: Literal["own-barycentre"] = "own-barycentre"

    @staticmethod
    def gather(d, r, w, p):
        return d, r, 1.0

    @staticmethod
    def apply(total, here, p):
        return (total[0] + total[1]) / total[2]


class OwnElastic(pbdkit.FollowerRule):
    """Plane-stress elasticity on the square lattice with eight neighbours: 2×2 weights a slot.

    The weights' sum is the identity and rest offsets cancel, so the move is Σ W d.
    """

    type: Literal["own-elastic"] = "own-elastic"
    poisson_ratio: float = 0.3

    def weights(self, slot: pbdkit.plugin.Slot, setting: pbdkit.plugin.Setting) -> dict[str, float]:
        nu = self.poisson_ratio
        x, y = np.sign(slot.rest.x), np.sign(slot.rest.y)
        if x and y:
            w = (1 + nu) / (4 * (5 - 3 * nu))
            return {"xx": w, "xy": w * x * y, "yy": w}
        along, across = ((3 - nu) / (2 * (5 - 3 * nu)), (1 - 3 * nu) / (2 * (5 - 3 * nu)))
        along, across = (along, across) if x else (across, along)
        return {"xx": along, "xy": 0.0, "yy": across}

    @staticmethod
    def gather(d, r, w, p):
        return (pbdkit.plugin.Vector(w.xx * d.x + w.xy * d.y, w.xy * d.x + w.yy * d.y),)

    @staticmethod
    def apply(total, here, p):
        return total[0]


HOLD = {"type": "hold"}
DISTANCE = {
    "rule": {"type": "distance-weighted"},
    "solver": {"type": "stepping", "relaxation": 0.6},
}
ELASTIC = {"rule": {"type": "own-elastic"}, "neighbours": {"type": "chebyshev", "shells": 1}}
CELLS = {
    "rule": {"type": "elastic", "poisson_ratio": 0.3},
    "neighbours": {"type": "chebyshev", "shells": 1},
}
NATURAL = CELLS | {"frame": {"type": "natural"}}
COMPOSITE = {
    "regions": {"inclusion": {"type": "disc", "radius": 300.0, "centre": [499.5, 499.5]}},
    "rule": {
        "type": "elastic",
        "poisson_ratio": 0.3,
        "stiffness": {"otherwise": 1.0, "inclusion": 10.0},
    },
    "neighbours": {"type": "chebyshev", "shells": 1},
    "frame": {"type": "natural"},
}
"""Stiffer in a disc, laminates along its border."""
SCATTERED = {"fracture": {"type": "strain", "failure": 2.0, "scatter": 0.1}}
DAMAGE = {"fracture": {"type": "damage", "onset": 0.5, "failure": 2.0}}
FRACTURE = {"fracture": {"type": "threshold", "thresholds": [3.0]}}
SWUNG = {"solver": {"type": "stepping", "relaxation": 0.6, "memory": 0.2}}
RULES = {
    "barycentre": {},
    "mean-displacement": {"rule": {"type": "mean-displacement"}},
    "distance-weighted": DISTANCE,
    "mixed-coordinate": {"rule": {"type": "mixed-coordinate", "K": -0.004}},
    "springs": CELLS | {"rule": {"type": "springs"}},
    "elastic": CELLS,
    "orthotropic": CELLS
    | {
        "rule": {
            "type": "orthotropic",
            "poisson_ratio": 0.3,
            "modulus_ratio": 2.0,
            "shear_ratio": 0.4,
        },
        "solver": {"type": "stepping", "relaxation": 0.5},
    },
    "strain-gradient": CELLS
    | {
        "rule": {"type": "strain-gradient", "poisson_ratio": 0.3, "length": 0.5},
        "solver": {"type": "stepping", "relaxation": 0.05},
    },
}
"""Parts of an experiment for every shipped rule."""
OWN = {"rule": {"type": "own-barycentre"}}


def stiffened(scene: Any) -> None:
    """A stiffness of its own for every cell, from .02 to 1."""
    share = scene.cells.share
    share *= np.random.default_rng(0).uniform(0.02, 1.0, share.shape)


def moving(size: int, **parts: Any) -> dict[str, Any]:
    """A square sheet in which everything moves, both ends held."""
    sheet = {
        "name": "sheet",
        "lattice": {"type": "square", "a": 1.0},
        "body": {"type": "grid", "columns": size, "rows": size},
        "rule": {"type": "barycentre"},
        "initial": {"type": "noise", "amplitude": 0.01},
        "leaders": [
            {"select": {"edge": "left"}, "motion": HOLD},
            {"select": {"edge": "right"}, "motion": HOLD},
        ],
        "steps": 10**6,
        "record": {"every": 10**6},
    }
    return sheet | parts


def pulled(size: int) -> dict[str, Any]:
    """Return the same sheet at rest, pulled at its right edge for ten steps."""
    pull = {"type": "velocity", "velocity": [0.35, 0.0], "steps": 10}
    leaders = [{"select": {"edge": "right"}, "motion": pull, "until": 10}]
    return moving(size, leaders=leaders, initial={"type": "reference"})


def scene_of(parts: dict[str, Any]):
    source = Source(data=parts)
    own = [OwnBarycentre, OwnElastic]
    return build_scene(pbdkit.Experiment.build(source, own))


class Running:
    """A sheet in motion; a call makes further steps."""

    def __init__(
        self,
        parts: dict[str, Any],
        steps: int,
        threads: int = 1,
        engine: Any = None,
        changed: Callable[[Any], None] | None = None,
    ):
        self.scene = scene_of(parts)
        if changed:
            changed(self.scene)
        self.engine = engine(self.scene) if engine else CompiledStepper(self.scene, threads)
        self.state = initial_state(self.scene)
        self.steps = steps

    def __call__(self) -> None:
        self.state = self.engine.advance(self.state, self.steps)


class Moved(Running):
    """A call makes its steps in newly allocated arrays, and `seconds` is their time. The place of
    arrays in memory has more effect than the differences to be measured; the best of many calls is
    free of it."""

    seconds = 0.0

    def __call__(self) -> None:
        self.state = self.engine.advance(
            self.state.copy()
        )  # the first step looks at all it is given
        begun = time.perf_counter()
        super().__call__()
        self.seconds = time.perf_counter() - begun


class Afresh(Running):
    """A call runs the sheet from its beginning."""

    def __call__(self) -> None:
        self.state = initial_state(self.scene)
        super().__call__()


class Sharing:
    """A call steps the state of one sheet with the engine of another."""

    def __init__(self, whose: Running, by: Running):
        self.whose, self.by = whose, by

    def __call__(self) -> None:
        self.whose.state = self.by.engine.advance(self.whose.state, self.by.steps)


class Everywhere:
    """Replaces the extent of motion of the compiled engine: all has been reached from the start."""

    def __init__(self, extent: Any):
        self._whole = extent._whole
        self.begin()

    def begin(self, *state: Any) -> None:
        self.box, self.growth = self._whole.copy(), np.zeros_like(self._whole)

    def take_in_call(self, call: Any, count: int) -> int:
        return count

    take_in_moves = begin
