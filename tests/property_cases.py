"""Small experiments, all combinations, and states made by hand, which the property tests share."""

from collections.abc import Iterable
from itertools import combinations, product
from typing import Any

import numpy as np
from scene_strategies import AT_LENGTH

import pbdkit
from pbdkit import Experiment
from pbdkit.lattice.raster import FOLLOWER, FRAME
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.stepping.numpy_engine import Stepper
from pbdkit.stepping.state import State, initial_state
from pbdkit.testing.subject import LATTICES, NEIGHBOURS

RULES: dict[str, dict[str, Any]] = {
    "barycentre": {"type": "barycentre"},
    "mean-displacement": {"type": "mean-displacement"},
    "distance-weighted": {"type": "distance-weighted"},
    "mixed-coordinate": {"type": "mixed-coordinate", "K": -0.004},
    "mixed-coordinate-y": {"type": "mixed-coordinate", "K": 0.01, "axis": "y"},
}
LINEAR_RULES = [name for name in RULES if name != "distance-weighted"]
FRAMES: dict[str, dict[str, Any]] = {
    "mean": {"type": "mean"},
    "first": {"type": "first"},
    "lag": {"type": "mean", "lag": 1},
    "wide": {"type": "mean", "layers": 3},
}
LATTICES_AND_NEIGHBOURS = list(product(LATTICES, NEIGHBOURS))


def all_pairs(*values: Iterable[Any]) -> list[tuple[Any, ...]]:
    """Cases for a parametrised test in which any two values of two arguments meet, and not any
    three: about as many as the two longest lists have pairs, found greedily. The profile `long` has
    the whole product."""
    given = [list(of_argument) for of_argument in values]
    if AT_LENGTH:
        return list(product(*given))
    cases = {
        case: frozenset(combinations(enumerate(case), 2))
        for case in product(*(range(len(of_argument)) for of_argument in given))
    }
    left, found = frozenset().union(*cases.values()), []
    while left:
        best = max(cases, key=lambda case: len(left & cases[case]))
        left -= cases[best]
        found.append(best)
    return [tuple(of[n] for of, n in zip(given, case, strict=True)) for case in sorted(found)]


HOLD_LEFT = {"select": {"edge": "left"}, "motion": {"type": "hold"}}
HOLD_RIGHT = {"select": {"edge": "right"}, "motion": {"type": "hold"}}
BOTH_ENDS_HELD = [HOLD_LEFT, HOLD_RIGHT]


def pull_right(x: float, y: float, steps: int = 5) -> dict[str, Any]:
    """The right edge moves by (x, y) in each of some steps, then holds."""
    motion = {"type": "velocity", "velocity": [x, y], "steps": steps}
    return {"select": {"edge": "right"}, "motion": motion}


def displace(numbers: list[int], x: float, y: float) -> dict[str, Any]:
    """Some particles move by (x, y) in the first step, then hold."""
    motion = {"type": "displace", "displacement": [x, y]}
    return {"select": {"numbers": numbers}, "motion": motion}


def experiment(columns: int = 6, rows: int = 5, **parts: Any) -> dict[str, Any]:
    """A small square body without leaders that shows its displacements; parts as they are given,
    lattice, neighbours, rule and frame also by a name of the tables above."""
    tables = {"lattice": LATTICES, "neighbours": NEIGHBOURS, "rule": RULES, "frame": FRAMES}
    named = {k: tables[k][v] if isinstance(v, str) and k in tables else v for k, v in parts.items()}
    base = {
        "name": "small",
        "lattice": LATTICES["square"],
        "body": {"type": "grid", "columns": columns, "rows": rows},
        "rule": RULES["barycentre"],
        "steps": 30,
        "diagnostics": [{"type": "displacement"}],
    }
    return base | named


def displacements(columns: int = 6, rows: int = 5, **parts: Any) -> Any:
    """u of a run, (time, particle, axis)."""
    return pbdkit.run(experiment(columns, rows, **parts), progress=False).u.values


def scene_of(columns: int = 6, rows: int = 5, **parts: Any) -> Scene:
    """The scene of a small experiment."""
    return build_scene(Experiment(**experiment(columns, rows, **parts)))


def state_with(scene: Scene, u: Any) -> State:
    """Return the state, at step 0 and at rest, in which the body has displacements u, (body
    particle, axis); the frame follows by its map."""
    state = initial_state(scene)
    raster, frame = scene.raster, scene.frame
    for axis in (0, 1):
        plane = state.u[axis].reshape(-1)
        plane[raster.place_of(raster.body_rows)] = np.asarray(u)[:, axis]
        if frame:
            values = frame.map.weight * plane[frame.body_place]
            plane[frame.place] = np.bincount(frame.map.point, values, len(frame.place))
    state.previous[...] = state.u
    return state


def body_of(scene: Scene, state: State) -> Any:
    """u of the body, (body particle, axis), of a state."""
    return state.u.reshape(2, -1)[:, scene.raster.place_of(scene.raster.body_rows)].T.copy()


def advanced(scene: Scene, u: Any, steps: int) -> Any:
    """The body's displacements some steps after those given, (step, body particle, axis)."""
    stepper, state = Stepper(scene), state_with(scene, u)
    history = [body_of(scene, state)]
    for _ in range(steps):
        state = stepper.advance(state)
        history.append(body_of(scene, state))
    return np.array(history)


def body_sites(scene: Scene) -> Any:
    """Return the sites of the body, (body particle, index)."""
    return scene.raster.site_of(scene.raster.body_rows)


def followers_of(scene: Scene) -> Any:
    """Return the body particles that no group leads in step 1, as positions among the body."""
    led = [leading.rows for leading in scene.leading]
    return np.flatnonzero(~np.isin(scene.raster.body_rows, np.concatenate([[], *led])))


def step_map(scene: Scene) -> Any:
    """The program's own one-step map of the followers' x displacements, column by column: what a
    unit displacement of each becomes."""
    stepper, followers = Stepper(scene), followers_of(scene)
    columns = []
    for one in followers:
        u = np.zeros((len(scene.raster.body_rows), 2))
        u[one, 0] = 1.0
        columns.append(body_of(scene, stepper.advance(state_with(scene, u)))[followers, 0])
    return np.array(columns).T


def layers_from(scene: Scene, row: int) -> Any:
    """Return the distance of each body particle, in layers, from the leader in that row. A layer is
    one bond, or a frame point that follows the one and is a neighbour of the other (model.md,
    section 5). The frame moves last in a step: from a leader, which moves first, it is one layer
    more."""
    kind, ends = scene.raster.table_kind, scene.bonds.ends
    near = np.zeros((len(kind), len(kind)), bool)
    near[ends[:, 0], ends[:, 1]] = near[ends[:, 1], ends[:, 0]] = True
    adjoin = near.copy()
    if scene.frame:
        frame_rows = np.flatnonzero(kind == FRAME)
        for point, body in zip(scene.frame.map.point, scene.frame.map.body, strict=True):
            adjoin[body] |= near[frame_rows[point]]
    inside = kind == FOLLOWER
    distance = np.where(np.arange(len(kind)) == row, 0, -1)
    for k in range(len(kind)):
        reached = near[distance == 0] if k == 0 else adjoin[distance >= 0]
        reached = reached.any(axis=0) & inside & (distance < 0)
        distance[reached] = k + 1
    return distance[inside]
