"""Writes the pass that keeps particles out of obstacles, after the sweeps and before the leaders.

Rows whose particles reach no obstacle's box, as far as their displacements go, are passed over.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from pbdkit.scene.obstacles import outlines_at
from pbdkit.scene.raster import FOLLOWER
from pbdkit.scene.scene import Scene
from pbdkit.stepping.compiled.arguments import Arrays
from pbdkit.stepping.compiled.particle import local_places
from pbdkit.stepping.compiled.plan import Function, Plan


def wall_arrays(scene: Scene, steps: Iterable[int]) -> Arrays:
    """The outlines of the obstacles that are there in some steps, always the same, one after the
    other; by step their points and boxes."""
    if not scene.barriers:
        return {}
    moments = [[outline for _, outline in outlines_at(scene.barriers, step)] for step in steps]
    found = moments[0]
    points = [np.empty((0, 2)), *(outline.points for outline in found)]
    return {
        "wall_kind": np.array([outline.kind for outline in found], np.int64),
        "wall_first": np.cumsum([len(own) for own in points]),
        "wall_points": np.array(
            [np.concatenate([points[0], *(o.points for o in now)]) for now in moments]
        ),
        "wall_radii": np.array([(o.inner, o.outer) for o in found]).reshape(-1, 2),
        "wall_box": np.array([[o.box for o in now] for now in moments]).reshape(
            len(moments), -1, 4
        ),
    }


def write_obstacle_pass(plan: Plan) -> Function:
    """The function that pushes the particles of some rows out of every obstacle, one after the
    other."""
    has_compliance = "compliance" in plan.shared
    out = Function(plan.shared, "push_out", "first_row", "last_row", "moment")
    out.add(0, "m = min(moment, wall_box.shape[0] - 1)")
    out.add(0, "points, edges = wall_points[m], wall_box[m]")
    out.add(0, "j0, j1 = max(0, box[2]), min(kind.shape[2], box[3])", "width = j1 - j0")
    out.add(0, "for s in range(kind.shape[0]):", "    for i in range(first_row, last_row):")
    out.add(2, "if width <= 0:", "    continue")
    out.add(2, *plan.each(f"o@ = {plan.row('v_@', 's')}"))
    out.add(2, *plan.each("l@, h@ = o@[0], o@[0]"))
    out.add(2, "for j in range(width):")
    out.add(3, *plan.each("l@ = min(l@, o@[j])"), *plan.each("h@ = max(h@, o@[j])"))
    for name, j in (("A", "0"), ("B", "width - 1")):
        out.add(2, f"j = {j}", *_places(plan, name))
    out.add(2, *plan.each("l@, h@ = min(A@, B@) + l@, max(A@, B@) + h@"))
    out.add(2, "near = 0", "for w in range(wall_kind.size):")
    out.add(3, f"if {_beyond('l', 'h')}:", "    continue", "near = 1")
    out.add(2, "if near == 0:", "    continue", "for j in range(width):")
    out.add(3, f"if kind[s, i, j0 + j] != {FOLLOWER}:", "    continue", *_places(plan, "A"))
    out.add(3, *plan.each("p@ = A@ + o@[j]"), "for w in range(wall_kind.size):")
    out.add(4, f"if {_beyond('p', 'p')}:", "    continue")
    given = "wall_first[w], wall_first[w + 1], wall_radii[w, 0], wall_radii[w, 1]"
    out.add(4, f"gap, nx, ny, _ = facing(px, py, wall_kind[w], points, {given})")
    out.add(4, "if gap < 0.0:")
    if has_compliance:
        own = ", ".join(f"compliance[{n}, s, i, j0 + j]" for n in range(3))
        out.add(5, f"sx, sy = slide(gap, nx, ny, {own})")
        out.add(5, *plan.each("o@[j] = o@[j] - s@"), *plan.each("p@ = A@ + o@[j]"))
        out.add(5, f"gap, nx, ny, _ = facing(px, py, wall_kind[w], points, {given})")
    out.add(5, *plan.each("o@[j] = o@[j] - gap * n@"), *plan.each("p@ = A@ + o@[j]"))
    return out


def _places(plan: Plan, name: str) -> list[str]:
    pairs = zip(plan.axes, local_places(plan, "s"), strict=True)
    return [f"{name}{c} = {place}" for c, place in pairs]


def _beyond(low: str, high: str) -> str:
    """Whether what lies from one place to the other misses a box; not where it is not a number."""
    return (
        f"{low}x > edges[w, 2] or {high}x < edges[w, 0] or "
        f"{low}y > edges[w, 3] or {high}y < edges[w, 1]"
    )
