"""Points, lattices and the neighbours on them, in plain loops (see plain_loops.py).

Sections of model.md: 2 lattices, `read_lattice`, `site_point`; 4 neighbours, `shells_of`,
`coordination_shells`, `chebyshev_shells`, `euclidean_shells`, `site_after`, `rest_offset`;
7 the reach of the frame, `default_layers`.
"""

import math
from typing import Any, NamedTuple

Point = tuple[float, float]
Site = tuple[int, int]
Part = dict[str, Any]

STAGGERED = ("hexagonal", "centred-rectangular")


class Lattice(NamedTuple):
    """Section 2: first and second span the primitive cell; odd rows of a staggered one shift."""

    a: float
    first: Point
    second: Point
    staggered: bool
    origin: Point


def point(pair: Any) -> Point:
    """A pair of numbers, as the experiment writes it."""
    return (float(pair[0]), float(pair[1]))


def plus(p: Point, q: Point) -> Point:
    return (p[0] + q[0], p[1] + q[1])


def minus(p: Point, q: Point) -> Point:
    return (p[0] - q[0], p[1] - q[1])


def times(c: float, p: Point) -> Point:
    return (c * p[0], c * p[1])


def distance(p: Point, q: Point) -> float:
    return math.hypot(p[0] - q[0], p[1] - q[1])


def mean(points: list[Point]) -> Point:
    n = len(points)
    return (math.fsum(p[0] for p in points) / n, math.fsum(p[1] for p in points) / n)


def side(a: Point, b: Point, p: Point) -> float:
    """Positive on the left of the line a -> b, negative on its right, 0 on it."""
    return (b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0])


def read_lattice(part: Part) -> Lattice:
    kind, a = part["type"], float(part["a"])
    if kind == "square":
        second = (0.0, a)
    elif kind == "rectangular":
        second = (0.0, part["b"])
    elif kind == "centred-rectangular":
        second = (a / 2, part["b"] / 2)
    elif kind == "hexagonal":
        second = (a / 2, a * math.sqrt(3) / 2)
    else:
        angle = math.radians(part["angle"])
        second = (part["b"] * math.cos(angle), part["b"] * math.sin(angle))
    return Lattice(a, (a, 0.0), second, kind in STAGGERED, point(part["origin"]))


def site_point(lattice: Lattice, site: Site) -> Point:
    i, j = site
    if lattice.staggered:
        shift = lattice.a / 2 if j % 2 == 1 else 0.0
        return plus(lattice.origin, (i * lattice.a + shift, j * lattice.second[1]))
    return plus(lattice.origin, rest_offset(lattice, (i, j)))


def rest_offset(lattice: Lattice, step: Site) -> Point:
    """Section 4: the offset of (dp, dq) primitive steps, the exact opposite of (-dp, -dq)."""
    return plus(times(step[0], lattice.first), times(step[1], lattice.second))


def site_after(lattice: Lattice, site: Site, step: Site) -> Site:
    """Section 4: p = i - floor(j/2), q = j on the staggered lattices, (i, j) elsewhere."""
    (i, j), (dp, dq) = site, step
    if lattice.staggered:
        p, q = i - j // 2 + dp, j + dq
        return (p + q // 2, q)
    return (i + dp, j + dq)


def steps_within(reach: int) -> list[Site]:
    span = range(-reach, reach + 1)
    return [(p, q) for p in span for q in span if (p, q) != (0, 0)]


def ranked(distance_of: dict[Site, float]) -> dict[Site, int]:
    """Section 4: the rank, from 1, of the distance of every step, equal within 1e-6 relative."""
    found: dict[Site, int] = {}
    shell, shell_distance = 0, 0.0
    for d, step in sorted((d, step) for step, d in distance_of.items()):
        if d > shell_distance * (1 + 1e-6):
            shell, shell_distance = shell + 1, d
        found[step] = shell
    return found


def chebyshev_shells(shells: int) -> dict[Site, int]:
    """Section 4: the shell of every primitive step to a neighbour."""
    return {(p, q): max(abs(p), abs(q)) for p, q in steps_within(shells)}


def coordination_shells(lattice: Lattice, shells: int) -> dict[Site, int]:
    """Section 4: shell n is no further than n times the shorter primitive vector."""
    (ax, ay), (bx, by) = lattice.first, lattice.second
    shorter, longer = sorted((math.hypot(ax, ay), math.hypot(bx, by)))
    row_spacing = abs(ax * by - ay * bx) / longer
    reach = math.ceil(shells * shorter / row_spacing) + 1
    ranks = ranked({step: math.hypot(*rest_offset(lattice, step)) for step in steps_within(reach)})
    return {step: shell for step, shell in ranks.items() if shell <= shells}


def weighted_square(offset: Point, weights: Point) -> float:
    """Section 4, euclidean: d^2 = w_x dX^2 + w_y dY^2."""
    return weights[0] * offset[0] * offset[0] + weights[1] * offset[1] * offset[1]


def within_radius(offset: Point, near: Part) -> bool:
    """Section 4, euclidean: d^2 <= (radius (1 + 1e-9))^2."""
    radius = float(near["radius"]) * (1 + 1e-9)
    return weighted_square(offset, point(near["weights"])) <= radius * radius


def euclidean_shells(lattice: Lattice, near: Part) -> dict[Site, int]:
    """Section 4: rank of the distinct weighted distances within the radius.

    The radius bounds both coordinates of an offset; q steps up the second vector reach its height,
    p steps along the first the rest of its width.
    """
    radius, weights = float(near["radius"]), point(near["weights"])
    if min(weights) <= 0:
        raise ValueError(f"weights {weights}")
    widest, highest = radius / math.sqrt(weights[0]), radius / math.sqrt(weights[1])
    q = math.ceil(highest / abs(lattice.second[1])) + 1
    p = math.ceil((widest + q * abs(lattice.second[0])) / lattice.a) + 1
    offsets = {step: rest_offset(lattice, step) for step in steps_within(max(p, q))}
    squares = {step: weighted_square(offset, weights) for step, offset in offsets.items()}
    reached = [step for step, offset in offsets.items() if within_radius(offset, near)]
    return ranked({step: math.sqrt(squares[step]) for step in reached})


def shells_of(lattice: Lattice, near: Part) -> dict[Site, int]:
    """Section 4: the shell of every primitive step to a neighbour, whatever the metric."""
    if near["type"] == "chebyshev":
        return chebyshev_shells(near["shells"])
    if near["type"] == "coordination":
        return coordination_shells(lattice, near["shells"])
    return euclidean_shells(lattice, near)


def default_layers(lattice: Lattice, shells: dict[Site, int]) -> int:
    """Section 7: what the metric reaches in index distance, from an even or an odd row."""
    reach = 0
    for row in (0, 1):
        for step in shells:
            i, j = site_after(lattice, (0, row), step)
            reach = max(reach, abs(i), abs(j - row))
    return reach
