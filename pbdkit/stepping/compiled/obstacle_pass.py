"""Writes the pass that keeps particles out of obstacles, after the sweeps; where particles may be
guided, after the leaders too.

Rows whose particles reach no obstacle's box, as far as their displacements go, are passed over.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from pbdkit.scene.guides import has_guides
from pbdkit.scene.obstacles import outlines_at
from pbdkit.scene.outlines import Walls
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
    walls = [Walls.of(now) for now in moments]
    return {
        "wall_kind": walls[0].kinds,
        "wall_first": walls[0].first,
        "wall_points": np.array([now.points for now in walls]),
        "wall_radii": np.array([now.radii for now in walls]),
        "wall_box": np.array([[o.box for o in now] for now in moments]).reshape(
            len(moments), -1, 4
        ),
    }


def write_obstacle_pass(plan: Plan) -> Function:
    """The function that pushes the particles of some rows out of all obstacles."""
    out = Function(plan.shared, "push_out", "first_row", "last_row", "moment")
    out.add(0, "m = min(moment, wall_box.shape[0] - 1)")
    out.add(0, "points, edges, radii = wall_points[m], wall_box[m], wall_radii[m]")
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
    out.add(2, "near = 0", *_each_near("l", "h"))
    out.add(2, "if near == 0:", "    continue", "for j in range(width):")
    out.add(3, f"if kind[s, i, j0 + j] != {FOLLOWER}:", "    continue", *_places(plan, "A"))
    out.add(3, *plan.each("p@ = A@ + o@[j]"), "near = 0")
    out.add(3, *_each_near("p", "p"), "if near == 0:", "    continue")
    has_compliance = "compliance" in plan.shared
    own = [f"compliance[{n}, s, i, j0 + j]" for n in range(3)]
    own = own if has_compliance else ["1.0", "0.0", "1.0"]
    own.append("led_axes[s, i, j0 + j]" if has_guides(plan.scene.leading) else "0")
    walls = "wall_kind, points, wall_first, radii"
    out.add(3, f"{', '.join(plan.each('w@'))} = leave(px, py, {', '.join(own)}, {walls})")
    out.add(3, *plan.each("o@[j] = o@[j] + w@"))
    return out


def _each_near(low: str, high: str) -> list[str]:
    """A loop over the obstacles that notes whether what lies from one place to the other may be in
    the box of one; it does not where it is not a number."""
    return [
        "for w in range(wall_kind.size):",
        f"    if {_beyond(low, high)}:",
        "        continue",
        "    near = 1",
    ]


def _places(plan: Plan, name: str) -> list[str]:
    pairs = zip(plan.axes, local_places(plan, "s"), strict=True)
    return [f"{name}{c} = {place}" for c, place in pairs]


def _beyond(low: str, high: str) -> str:
    """Whether what lies from one place to the other misses a box; not where it is not a number."""
    return (
        f"{low}x > edges[w, 2] or {high}x < edges[w, 0] or "
        f"{low}y > edges[w, 3] or {high}y < edges[w, 1]"
    )
