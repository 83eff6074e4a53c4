"""The lattice model of model.md in plain loops: slow, independent, a test oracle.

Written from model.md alone, in positions x (not displacements), sharing no code with the package.
Sections of model.md: 1 numbering and kinds, `build_body`, `leads`; 2 lattices, `read_lattice`,
`site_point`; 3 grid bodies, `build_body`; 4 neighbours, `coordination_shells`,
`chebyshev_shells`, `site_after`, `rest_offset`; 5 the step and the rules, `simulate`,
`leader_position`, `move_follower`, `rule_target`; 6 fracture, `too_long`, `seen_place`; 7 the
frame, `default_layers`, `assigned_to`, `frame_position`; 8 diagnostics, `pe1`, `simulate`.
"""

import math
from typing import Any, NamedTuple

Point = tuple[float, float]
Site = tuple[int, int]
Part = dict[str, Any]

LEADER, FOLLOWER, FRAME = 0, 1, 2
NEVER = -1
STAGGERED = ("hexagonal", "centred-rectangular")
COVERED = {
    "lattice": ("square", "rectangular", "oblique", *STAGGERED),
    "body": ("grid",),
    "neighbours": ("coordination", "chebyshev"),
    "rule": ("barycentre", "mean-displacement", "distance-weighted", "mixed-coordinate"),
    "frame": ("mean", "first", "none"),
    "fracture": ("none", "threshold"),
    "initial": ("reference",),
    "solver": ("stepping",),
}
DEFAULTS: dict[str, Part] = {
    "lattice": {"origin": (0.0, 0.0)},
    "body": {},
    "neighbours": {"shells": 1, "reevaluate": False},
    "rule": {"axis": "x"},
    "frame": {"type": "mean", "layers": None, "lag": 0},
    "fracture": {"type": "none", "placement": 1.0, "fictitious": "cell", "frame_bonds": True},
    "initial": {"type": "reference"},
    "solver": {"type": "stepping", "relaxation": 1.0, "memory": 0.0},
}


class Lattice(NamedTuple):
    """Section 2: first and second span the primitive cell; odd rows of a staggered one shift."""

    a: float
    first: Point
    second: Point
    staggered: bool
    origin: Point


class Neighbour(NamedTuple):
    """The particle in a shell of another, at rest `offset` from it (R in section 6)."""

    particle: int
    offset: Point
    shell: int


class Body(NamedTuple):
    """All that is fixed at step 0; lists run over the particles in the order of their numbers."""

    lattice: Lattice
    sites: list[Site]
    X: list[Point]
    inside: list[bool]
    neighbours: list[list[Neighbour]]
    assigned: dict[int, list[int]]


Bond = tuple[int, int]


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


def nearest(place: Point, members: list[int], X: list[Point]) -> list[int]:
    """All members that tie for the least distance, by the tolerance of section 7."""
    least = min(distance(X[j], place) for j in members)
    return [j for j in members if distance(X[j], place) <= least * (1 + 1e-9) + 1e-12]


def completed(experiment: Part) -> Part:
    """The experiment with the contract's defaults; what is not covered here is refused."""
    parts = {name: {**DEFAULTS[name], **experiment.get(name, {})} for name in DEFAULTS}
    for name, covered in COVERED.items():
        if parts[name]["type"] not in covered:
            raise ValueError(f"{name} type {parts[name]['type']!r}")
    solver, fracture, shells = parts["solver"], parts["fracture"], parts["neighbours"]["shells"]
    if parts["neighbours"]["reevaluate"] or solver.get("settle") is not None:
        raise ValueError("neighbours re-evaluated, or a run that settles")
    if solver.get("precision", "float64") != "float64" or parts["rule"]["axis"] not in ("x", "y"):
        raise ValueError("a precision other than float64, or an axis other than x and y")
    if fracture["type"] == "threshold" and len(fracture["thresholds"]) != shells:
        raise ValueError("not one threshold a shell")
    if fracture["fictitious"] not in ("cell", "reference"):
        raise ValueError(f"fictitious {fracture['fictitious']!r}")
    return {"steps": experiment["steps"], "leaders": experiment.get("leaders", []), **parts}


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
    origin = (float(part["origin"][0]), float(part["origin"][1]))
    return Lattice(a, (a, 0.0), second, kind in STAGGERED, origin)


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


def chebyshev_shells(shells: int) -> dict[Site, int]:
    """Section 4: the shell of every primitive step to a neighbour."""
    return {(p, q): max(abs(p), abs(q)) for p, q in steps_within(shells)}


def coordination_shells(lattice: Lattice, shells: int) -> dict[Site, int]:
    """Section 4: shell n is no further than n times the shorter primitive vector."""
    (ax, ay), (bx, by) = lattice.first, lattice.second
    shorter, longer = sorted((math.hypot(ax, ay), math.hypot(bx, by)))
    row_spacing = abs(ax * by - ay * bx) / longer
    reach = math.ceil(shells * shorter / row_spacing) + 1
    by_distance = sorted((math.hypot(*rest_offset(lattice, s)), s) for s in steps_within(reach))
    found: dict[Site, int] = {}
    shell, shell_distance = 0, 0.0
    for d, step in by_distance:
        if d > shell_distance * (1 + 1e-6):
            shell, shell_distance = shell + 1, d
        if shell <= shells:
            found[step] = shell
    return found


def default_layers(lattice: Lattice, shells: dict[Site, int]) -> int:
    """Section 7: what the metric reaches in index distance, from an even or an odd row."""
    reach = 0
    for row in (0, 1):
        for step in shells:
            i, j = site_after(lattice, (0, row), step)
            reach = max(reach, abs(i), abs(j - row))
    return reach


def assigned_to(f: int, X: list[Point], inside: list[bool], policy: str) -> list[int]:
    """Section 7: the nearest body particles, all that tie; `first`: the lowest number of them."""
    tied = nearest(X[f], [j for j in range(len(X)) if inside[j]], X)
    return tied[:1] if policy == "first" else tied


def build_body(experiment: Part) -> Body:
    """Sections 1, 3, 7: body and frame sites, numbered by i, then j; who neighbours whom."""
    lattice, near = read_lattice(experiment["lattice"]), experiment["neighbours"]
    frame = experiment["frame"]
    chebyshev = near["type"] == "chebyshev"
    n = near["shells"]
    shells = chebyshev_shells(n) if chebyshev else coordination_shells(lattice, n)
    columns, rows = experiment["body"]["columns"], experiment["body"]["rows"]
    grid = {(i, j) for i in range(columns) for j in range(rows)}
    layers = default_layers(lattice, shells) if frame["layers"] is None else frame["layers"]
    around = {(i + p, j + q) for i, j in grid for p, q in steps_within(layers)} - grid
    sites = sorted(grid if frame["type"] == "none" else grid | around)
    X = [site_point(lattice, site) for site in sites]
    inside = [site in grid for site in sites]
    index_of = {site: index for index, site in enumerate(sites)}
    neighbours: list[list[Neighbour]] = []
    for site in sites:
        neighbours.append([])
        for step, shell in shells.items():
            other = site_after(lattice, site, step)
            if other in index_of and (site in grid or other in grid):
                offset = rest_offset(lattice, step)
                neighbours[-1].append(Neighbour(index_of[other], offset, shell))
    outer = [f for f in range(len(X)) if not inside[f]]
    assigned = {f: assigned_to(f, X, inside, frame["type"]) for f in outer}
    return Body(lattice, sites, X, inside, neighbours, assigned)


def bonds_of(body: Body) -> dict[Bond, Neighbour]:
    """Every bond once, lower end first, sorted; frame points are not bonded to each other."""
    both_ends = [((j, near.particle), near) for j, ns in enumerate(body.neighbours) for near in ns]
    return dict(sorted((bond, near) for bond, near in both_ends if bond[0] < bond[1]))


def selected(body: Body, select: Part) -> set[int]:
    members = [j for j, is_inside in enumerate(body.inside) if is_inside]
    ((how, what),) = select.items()
    edges = {"left": (0, -1), "right": (0, 1), "bottom": (1, -1), "top": (1, 1)}
    if how == "edge" and what in edges:
        axis, sign = edges[what]
        ends: dict[int, int] = {}
        for j in sorted(members, key=lambda j: sign * body.sites[j][axis]):
            ends[body.sites[j][1 - axis]] = j
        return set(ends.values())
    if how == "box":
        slack = 1e-9 * body.lattice.a
        x0, y0, x1, y1 = what[0] - slack, what[1] - slack, what[2] + slack, what[3] + slack
        return {j for j in members if x0 <= body.X[j][0] <= x1 and y0 <= body.X[j][1] <= y1}
    if how == "numbers" and all(number - 1 in members for number in what):
        return {number - 1 for number in what}
    if how == "nearest":
        return {min(nearest((place[0], place[1]), members, body.X)) for place in what}
    raise ValueError(f"select {select}")


def leads(group: Part, step: int) -> bool:
    until = group.get("until")
    return bool(group.get("from", 1) <= step and (until in (None, "always") or step <= until))


def leader_position(group: Part, j: int, step: int, history: list[list[Point]]) -> Point:
    """Section 5.1: the motion counts from `from` and starts where the particle then is."""
    first, motion = int(group.get("from", 1)), group["motion"]
    start, count = history[first - 1][j], step - first + 1
    if motion["type"] == "hold":
        return start
    if motion["type"] == "velocity":
        return plus(start, times(min(count, motion["steps"]), motion["velocity"]))
    if motion["type"] == "displace":
        return plus(start, motion["displacement"])
    raise ValueError(f"motion type {motion['type']!r}")


def too_long(body: Body, j: int, near: Neighbour, m: list[Point], fracture: Part) -> bool:
    """Section 6: |R + (u_k - u_j)|^2 > threshold^2."""
    k = near.particle
    to_frame = not (body.inside[j] and body.inside[k])
    if to_frame and not fracture["frame_bonds"]:
        return False
    u_j, u_k = minus(m[j], body.X[j]), minus(m[k], body.X[k])
    bond_x, bond_y = plus(near.offset, minus(u_k, u_j))
    threshold = float(fracture["thresholds"][near.shell - 1])
    return bond_x * bond_x + bond_y * bond_y > threshold * threshold


def seen_place(
    body: Body, j: int, near: Neighbour, m: list[Point], broken: dict[Bond, int], fracture: Part
) -> Point:
    """Section 6: where j sees its neighbour; the fictitious point once the bond is broken."""
    k = near.particle
    if (min(j, k), max(j, k)) not in broken:
        return m[k]
    if fracture["fictitious"] == "reference":
        return body.X[k]
    return plus(m[j], times(fracture["placement"], near.offset))


def rule_target(body: Body, rule: Part, j: int, here: Point, seen: list[Point]) -> Point:
    """Section 5: the rules; seen are the places of j's neighbours, fictitious ones among them."""
    X = body.X
    if rule["type"] == "mean-displacement":
        rest = [X[near.particle] for near in body.neighbours[j]]
        return plus(X[j], mean([minus(place, X_k) for place, X_k in zip(seen, rest, strict=True)]))
    if rule["type"] == "distance-weighted":
        weights = [distance(place, here) for place in seen]
        total = math.fsum(weights)
        if total == 0.0:
            return here
        weighted = mean([times(d, place) for d, place in zip(weights, seen, strict=True)])
        return times(len(seen) / total, weighted)
    x, y = mean(seen)
    if rule["type"] == "mixed-coordinate":
        across = 1 if rule["axis"] == "x" else 0
        width = [X[k][across] for k in range(len(X)) if body.inside[k]]
        K_da = float(rule["K"]) * (X[j][across] - (min(width) + max(width)) / 2)
        if across == 1:
            return (x, K_da * (x - X[j][0]) + y)
        return (K_da * (y - X[j][1]) + x, y)
    return (x, y)


def move_follower(
    body: Body, experiment: Part, j: int, m: list[Point], before: Point, broken: dict[Bond, int]
) -> Point:
    """Section 5: m_j + w (target - m_j) + b (x_j(t) - x_j(t-1)); with no neighbours it stays."""
    if not body.neighbours[j]:
        return m[j]
    fracture, solver = experiment["fracture"], experiment["solver"]
    seen = [seen_place(body, j, near, m, broken, fracture) for near in body.neighbours[j]]
    target = rule_target(body, experiment["rule"], j, m[j], seen)
    relaxed = times(solver["relaxation"], minus(target, m[j]))
    remembered = times(solver["memory"], minus(m[j], before))
    return plus(m[j], plus(relaxed, remembered))


def frame_position(body: Body, f: int, x: list[Point]) -> Point:
    """Section 7: u_f = mean u_a."""
    return plus(body.X[f], mean([minus(x[a], body.X[a]) for a in body.assigned[f]]))


def pe1(body: Body, j: int, x: list[Point], left_out: set[Bond]) -> float:
    """Section 8: of a body particle, over its reference neighbours but the bonds left out."""
    if not body.inside[j]:
        return 0.0
    ks = [near.particle for near in body.neighbours[j]]
    kept = [k for k in ks if (min(j, k), max(j, k)) not in left_out]
    return math.fsum((distance(x[j], x[k]) - distance(body.X[j], body.X[k])) ** 2 for k in kept)


def simulate(experiment: dict[str, Any]) -> dict[str, Any]:
    """Runs an experiment (contract.md, as a dict) and returns every step of it in plain lists."""
    experiment = completed(experiment)
    fracture, lag, steps = experiment["fracture"], experiment["frame"]["lag"], experiment["steps"]
    body = build_body(experiment)
    bonds = bonds_of(body)
    groups = [(group, selected(body, group["select"])) for group in experiment["leaders"]]
    everyone, times_0_to_end = range(len(body.X)), range(steps + 1)

    def leading(j: int, step: int) -> Part | None:
        return next((group for group, chosen in groups if j in chosen and leads(group, step)), None)

    def kind(j: int, step: int) -> int:
        in_body = LEADER if leading(j, step) is not None else FOLLOWER
        return in_body if body.inside[j] else FRAME

    history: list[list[Point]] = [list(body.X)]
    broken: dict[Bond, int] = {}
    for step in range(1, steps + 1):
        x, before = history[-1], history[max(step - 2, 0)]
        m = list(x)
        for j in everyone:
            group = leading(j, step)
            if group is not None:
                m[j] = leader_position(group, j, step, history)
        for (j, k), near in bonds.items() if fracture["type"] == "threshold" else ():
            if (j, k) not in broken and too_long(body, j, near, m, fracture):
                broken[(j, k)] = step
        new = list(m)
        for j in everyone:
            if kind(j, step) == FOLLOWER:
                new[j] = move_follower(body, experiment, j, m, before[j], broken)
        for f in body.assigned:
            new[f] = frame_position(body, f, x if lag == 1 else new)
        history.append(new)

    lost = [{bond for bond, s in broken.items() if s <= t} for t in times_0_to_end]
    before_and_after = list(zip([history[0], *history], history, strict=False))
    return {
        "number": [j + 1 for j in everyone],
        "site": [list(site) for site in body.sites],
        "reference": [list(p) for p in body.X],
        "position": [[list(p) for p in x] for x in history],
        "kind": [[kind(j, max(t, 1)) for j in everyone] for t in times_0_to_end],
        "bond": [list(bond) for bond in bonds],
        "shell": [near.shell for near in bonds.values()],
        "broken_step": [broken.get(bond, NEVER) for bond in bonds],
        "pe1": [[pe1(body, j, x, set()) for j in everyone] for x in history],
        "pe1_intact": [[pe1(body, j, x, lost[t]) for j in everyone] for t, x in enumerate(history)],
        "pe2": [[distance(now[j], old[j]) for j in everyone] for old, now in before_and_after],
        "u": [[list(minus(x[j], body.X[j])) for j in everyone] for x in history],
        "broken_bonds": [len(lost[t]) for t in times_0_to_end],
    }
