"""The bodies of docs/model.md, section 3, in plain loops (see plain_loops.py).

Every outline is defined by its depth at a point: positive inside, negative outside, 0 on it, and
near it the distance to it (at a corner no more than a factor short of it). A grid has no outline:
its sites are in, all others out.
"""

import math
from itertools import pairwise

from plain_lattice import Lattice, Part, Point, Site, distance, minus, plus, point, side, site_point

Box = tuple[Point, Point]
SETS = ("union", "intersection", "difference")
NOWHERE = (0.0, 0.0)


def rectangle_depth(shape: Part, p: Point) -> float:
    (x0, y0), (x1, y1) = rectangle_box(shape, "width", "height")
    return min(p[0] - x0, x1 - p[0], p[1] - y0, y1 - p[1])


def disc_depth(shape: Part, p: Point) -> float:
    return float(shape["radius"]) - distance(p, point(shape["centre"]))


def ring_depth(shape: Part, p: Point) -> float:
    from_centre = distance(p, point(shape["centre"]))
    return min(float(shape["outer"]) - from_centre, from_centre - float(shape["inner"]))


def edges_of(shape: Part) -> list[tuple[Point, Point]]:
    """The edges of a polygon, the last of them back to its first vertex."""
    vertices = [point(vertex) for vertex in shape["vertices"]]
    return list(pairwise([*vertices, vertices[0]]))


def distance_to_edge(p: Point, a: Point, b: Point) -> float:
    along, length = minus(b, a), distance(a, b)
    if length == 0.0:
        return distance(p, a)
    foot = ((p[0] - a[0]) * along[0] + (p[1] - a[1]) * along[1]) / (length * length)
    if foot <= 0.0:
        return distance(p, a)
    return distance(p, b) if foot >= 1.0 else abs(side(a, b, p)) / length


def right_of_edge(p: Point, a: Point, b: Point) -> bool:
    """Return whether the ray from p to +x meets the edge: a is above p and b is not, or b and not
    a."""
    if (a[1] > p[1]) == (b[1] > p[1]):
        return False
    lower, upper = (a, b) if a[1] < b[1] else (b, a)
    return side(lower, upper, p) > 0


def polygon_depth(shape: Part, p: Point) -> float:
    """Inside where a ray meets an odd number of edges."""
    to_outline = min(distance_to_edge(p, a, b) for a, b in edges_of(shape))
    meets = sum(right_of_edge(p, a, b) for a, b in edges_of(shape))
    return to_outline if meets % 2 == 1 else -to_outline


def notch_depth(shape: Part, s: float, t: float) -> float:
    """Return the depth in the part of its box that a dogbone lacks, at distances s along and t
    across from its centre.

    Above the gauge's straight edge as far as it goes, then the inside of the fillet's circle, with
    its centre above that edge's end by the radius, and above that centre as far as the quarter
    circle reached. The box cuts it off at half its width.
    """
    radius = float(shape["radius"])
    s_centre, t_edge = shape["gauge_length"] / 2, shape["gauge_width"] / 2
    t_centre, s_jump = t_edge + radius, s_centre + radius
    if s <= s_centre:
        return float(min(t - t_edge, s_jump - s))
    if t <= t_centre:
        return radius - distance((s, t), (s_centre, t_centre))
    return float(s_jump - s)


def dogbone_depth(shape: Part, p: Point) -> float:
    (x0, y0), (x1, y1) = rectangle_box(shape, "length", "width")
    s, t = abs(p[0] - (x0 + x1) / 2), abs(p[1] - (y0 + y1) / 2)
    box_depth = min(p[0] - x0, x1 - p[0], p[1] - y0, y1 - p[1])
    return min(box_depth, -notch_depth(shape, s, t))


def rectangle_box(shape: Part, width: str, height: str) -> Box:
    corner = point(shape.get("origin", NOWHERE))
    return corner, plus(corner, (float(shape[width]), float(shape[height])))


def round_box(shape: Part, radius: str) -> Box:
    centre, r = point(shape["centre"]), float(shape[radius])
    return minus(centre, (r, r)), plus(centre, (r, r))


def polygon_box(shape: Part) -> Box:
    xs = [float(x) for x, _ in shape["vertices"]]
    ys = [float(y) for _, y in shape["vertices"]]
    return (min(xs), min(ys)), (max(xs), max(ys))


def depth(shape: Part, p: Point) -> float:
    """Return the depth of p inside the outline, below 0 outside it."""
    if shape["type"] == "rectangle":
        return rectangle_depth(shape, p)
    if shape["type"] == "disc":
        return disc_depth(shape, p)
    if shape["type"] == "ring":
        return ring_depth(shape, p)
    if shape["type"] == "polygon":
        return polygon_depth(shape, p)
    if shape["type"] == "dogbone":
        return dogbone_depth(shape, p)
    raise ValueError(f"body type {shape['type']!r}")


def box_of(shape: Part) -> Box:
    """The corners of a box with sides along the axes around the outline."""
    if shape["type"] == "rectangle":
        return rectangle_box(shape, "width", "height")
    if shape["type"] == "disc":
        return round_box(shape, "radius")
    if shape["type"] == "ring":
        return round_box(shape, "outer")
    if shape["type"] == "polygon":
        return polygon_box(shape)
    if shape["type"] == "dogbone":
        return rectangle_box(shape, "length", "width")
    raise ValueError(f"body type {shape['type']!r}")


def grid_sites(shape: Part) -> list[Site]:
    return [(i, j) for i in range(shape["columns"]) for j in range(shape["rows"])]


def sites_in_box(lattice: Lattice, box: Box) -> list[Site]:
    """Return all sites in the box, and some around it."""
    (x0, y0), (x1, y1) = box
    row_ends = sorted((y - lattice.origin[1]) / lattice.second[1] for y in (y0, y1))
    sites = []
    for j in range(math.floor(row_ends[0]) - 1, math.ceil(row_ends[1]) + 2):
        row_start = site_point(lattice, (0, j))[0]
        first = math.floor((x0 - row_start) / lattice.a) - 1
        last = math.ceil((x1 - row_start) / lattice.a) + 1
        sites += [(i, j) for i in range(first, last + 1)]
    return sites


def candidates(lattice: Lattice, shape: Part) -> set[Site]:
    """Sites among which all of the body are."""
    if shape["type"] in SETS:
        return {site for member in shape["of"] for site in candidates(lattice, member)}
    if shape["type"] == "grid":
        return set(grid_sites(shape))
    return set(sites_in_box(lattice, box_of(shape)))


def holds(lattice: Lattice, shape: Part, site: Site, with_outline: bool) -> bool:
    """Section 3: inside, or on the outline within 1e-9 a if that counts as well.

    A difference has lost what is inside the others, and keeps what is on their outlines; that is
    on its own outline then.
    """
    if shape["type"] == "union":
        return any(holds(lattice, member, site, with_outline) for member in shape["of"])
    if shape["type"] == "intersection":
        return all(holds(lattice, member, site, with_outline) for member in shape["of"])
    if shape["type"] == "difference":
        kept, *cut_out = shape["of"]
        lost = any(holds(lattice, member, site, not with_outline) for member in cut_out)
        return holds(lattice, kept, site, with_outline) and not lost
    if shape["type"] == "grid":
        return site[0] in range(shape["columns"]) and site[1] in range(shape["rows"])
    tolerance = 1e-9 * math.hypot(*lattice.first)
    at = depth(shape, site_point(lattice, site))
    return at >= -tolerance if with_outline else at > tolerance


def body_sites(lattice: Lattice, shape: Part) -> set[Site]:
    """Section 3: the sites of a body, of any shape; they may be negative."""
    found = candidates(lattice, shape)
    return {site for site in found if holds(lattice, shape, site, with_outline=True)}
