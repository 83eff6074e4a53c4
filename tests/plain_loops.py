"""The lattice model of docs/model.md in plain loops: slow, independent, a test oracle.

Written from docs/model.md alone, in positions x (not displacements), sharing no code with pbdkit.
Sections of model.md: 1 numbering and kinds, `build_body`, `leads`; 2 lattices and 4 neighbours,
plain_lattice.py, and `neighbours_now` where they are re-evaluated; 3 bodies, plain_bodies.py;
5 the step and the rules, `simulate`, plain_motions.py, `move_follower`, `rule_target`; 6 fracture,
`too_long`, `seen_place`, and its cracks, `crosses`; 7 the frame, `framed`,
`mirrored`, `frame_position`; 8 diagnostics, `pe1`, `simulate`.
"""

import math
from typing import NamedTuple

import plain_bodies
import plain_motions
from plain_lattice import (
    STAGGERED,
    Lattice,
    Part,
    Point,
    Site,
    default_layers,
    distance,
    mean,
    minus,
    plus,
    point,
    read_lattice,
    rest_offset,
    shells_of,
    side,
    site_after,
    site_point,
    steps_within,
    times,
    within_radius,
)

LEADER, FOLLOWER, FRAME = 0, 1, 2
NEVER = -1
COVERED = {
    "lattice": ("square", "rectangular", "oblique", *STAGGERED),
    "body": (
        *("grid", "rectangle", "disc", "ring", "polygon", "dogbone"),
        *plain_bodies.SETS,
    ),
    "neighbours": ("coordination", "chebyshev", "euclidean"),
    "rule": ("barycentre", "mean-displacement", "distance-weighted", "mixed-coordinate"),
    "frame": ("mean", "first", "mirror", "none"),
    "fracture": ("none", "threshold"),
    "initial": ("reference", "noise", "affine"),
    "solver": ("stepping",),
}
DEFAULTS: dict[str, Part] = {
    "lattice": {"origin": (0.0, 0.0)},
    "body": {},
    "neighbours": {"shells": 1, "weights": (1.0, 1.0), "reevaluate": False},
    "rule": {"axis": "x"},
    "frame": {"type": "mean", "layers": None, "lag": 0},
    "fracture": {
        "type": "none",
        "placement": 1.0,
        "fictitious": "cell",
        "frame_bonds": True,
        "cracks": (),
    },
    "initial": {"type": "reference", "shift": (0.0, 0.0)},
    "solver": {"type": "stepping", "relaxation": 1.0, "memory": 0.0},
}


class Neighbour(NamedTuple):
    """The particle in a shell of another, at rest `offset` from it (R in section 6)."""

    particle: int
    offset: Point
    shell: int


class Copied(NamedTuple):
    """Section 7: the body particles that a frame point copies, and the signs it copies with."""

    particles: list[int]
    signs: Point


class Body(NamedTuple):
    """Quantities that are fixed at step 0; lists run over the particles in the order of their
    numbers."""

    lattice: Lattice
    sites: list[Site]
    X: list[Point]
    inside: list[bool]
    neighbours: list[list[Neighbour]]
    frame: dict[int, Copied]


Bond = tuple[int, int]


def nearest(place: Point, members: list[int], X: list[Point]) -> list[int]:
    """Return all members that tie for the least distance, by the tolerance of section 7."""
    least = min(distance(X[j], place) for j in members)
    return [j for j in members if distance(X[j], place) <= least * (1 + 1e-9) + 1e-12]


def completed(experiment: Part) -> Part:
    """The experiment with the contract's defaults; what is not covered here is refused."""
    parts = {name: {**DEFAULTS[name], **experiment.get(name, {})} for name in DEFAULTS}
    for name, covered in COVERED.items():
        if parts[name]["type"] not in covered:
            raise ValueError(f"{name} type {parts[name]['type']!r}")
    solver, fracture, near = parts["solver"], parts["fracture"], parts["neighbours"]
    if solver.get("settle") is not None:
        raise ValueError("a run that settles")
    breaks = fracture["type"] != "none" or fracture["cracks"]
    if near["reevaluate"] and (near["type"] != "euclidean" or breaks):
        raise ValueError("neighbours re-evaluated that are not euclidean, or with fracture")
    if solver.get("precision", "float64") != "float64" or parts["rule"]["axis"] not in ("x", "y"):
        raise ValueError("a precision other than float64, or an axis other than x and y")
    if fracture["fictitious"] not in ("cell", "reference"):
        raise ValueError(f"fictitious {fracture['fictitious']!r}")
    noise = [point(pair) for pair in experiment.get("_noise", [])]
    leaders = experiment.get("leaders", [])
    return {"steps": experiment["steps"], "leaders": leaders, "_noise": noise, **parts}


def assigned_to(f: int, X: list[Point], inside: list[bool], policy: str) -> list[int]:
    """Section 7: the nearest body particles, all that tie; `first`: the lowest number of them."""
    tied = nearest(X[f], [j for j in range(len(X)) if inside[j]], X)
    return tied[:1] if policy == "first" else tied


def mirrored(site: Site, experiment: Part) -> tuple[Site, Point]:
    """Section 7: the site reflected in the outermost row or column, and R as a sign an axis."""
    reflected, signs = list(site), [1.0, 1.0]
    for axis, length in ((0, experiment["body"]["columns"]), (1, experiment["body"]["rows"])):
        if not 0 <= site[axis] < length:
            outermost = 0 if site[axis] < 0 else length - 1
            reflected[axis], signs[axis] = 2 * outermost - site[axis], -1.0
    return (reflected[0], reflected[1]), (signs[0], signs[1])


def framed(
    experiment: Part, sites: list[Site], X: list[Point], inside: list[bool]
) -> dict[int, Copied]:
    """Section 7: what every frame point copies, by the policy of the frame."""
    policy = experiment["frame"]["type"]
    outer = [f for f in range(len(X)) if not inside[f]]
    if policy != "mirror":
        return {f: Copied(assigned_to(f, X, inside, policy), (1.0, 1.0)) for f in outer}
    lattice_type = experiment["lattice"]["type"]
    if experiment["body"]["type"] != "grid" or lattice_type not in ("square", "rectangular"):
        raise ValueError("a mirror frame of anything but a square or rectangular grid")
    frame = {}
    for f in outer:
        site, signs = mirrored(sites[f], experiment)
        if site not in sites or not inside[sites.index(site)]:
            raise ValueError(f"the mirror image of site {sites[f]} is not in the body")
        frame[f] = Copied([sites.index(site)], signs)
    return frame


def neighbours_of(
    lattice: Lattice, sites: list[Site], members: set[Site], shells: dict[Site, int]
) -> list[list[Neighbour]]:
    """Section 4: the neighbours of every particle at step 0; frame points are not each other's."""
    index_of = {site: index for index, site in enumerate(sites)}
    neighbours: list[list[Neighbour]] = []
    for site in sites:
        neighbours.append([])
        for step, shell in shells.items():
            other = site_after(lattice, site, step)
            if other in index_of and (site in members or other in members):
                offset = rest_offset(lattice, step)
                neighbours[-1].append(Neighbour(index_of[other], offset, shell))
    return neighbours


def build_body(experiment: Part) -> Body:
    """Sections 1, 3, 7: body and frame sites, numbered by i, then j, and their neighbours."""
    lattice, frame = read_lattice(experiment["lattice"]), experiment["frame"]
    fracture, shells = experiment["fracture"], shells_of(lattice, experiment["neighbours"])
    shell_count = max(shells.values(), default=0)
    if fracture["type"] == "threshold" and len(fracture["thresholds"]) != shell_count:
        raise ValueError("not one threshold a shell")
    members = plain_bodies.body_sites(lattice, experiment["body"])
    if not members:
        raise ValueError("no site in the body")
    layers = default_layers(lattice, shells) if frame["layers"] is None else frame["layers"]
    around = {(i + p, j + q) for i, j in members for p, q in steps_within(layers)} - members
    sites = sorted(members if frame["type"] == "none" else members | around)
    X = [site_point(lattice, site) for site in sites]
    inside = [site in members for site in sites]
    neighbours = neighbours_of(lattice, sites, members, shells)
    return Body(lattice, sites, X, inside, neighbours, framed(experiment, sites, X, inside))


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
    first = int(group.get("from", 1))
    return plain_motions.displaced(history[first - 1][j], group["motion"], step - first + 1)


def crosses(crack: tuple[Point, Point], P: Point, Q: Point) -> bool:
    """Return whether P and Q are on two sides of the crack's line, which counts as its left, and
    the crack's ends not strictly on one side of theirs."""
    a, b = crack
    parted = (side(a, b, P) >= 0) != (side(a, b, Q) >= 0)
    from_a, from_b = side(P, Q, a), side(P, Q, b)
    one_side = (from_a > 0 and from_b > 0) or (from_a < 0 and from_b < 0)
    return parted and not one_side


def cracked(body: Body, bonds: dict[Bond, Neighbour], fracture: Part) -> dict[Bond, int]:
    """The bonds that cross a crack, frame bonds among them: broken at step 0."""
    cracks = [(point(a), point(b)) for a, b in fracture["cracks"]]
    ends = {bond: (body.X[bond[0]], body.X[bond[1]]) for bond in bonds}
    return {bond: 0 for bond in bonds if any(crosses(crack, *ends[bond]) for crack in cracks)}


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


def neighbours_now(body: Body, near: Part, j: int, m: list[Point]) -> list[int]:
    """Section 4: fixed at step 0, or all that are within the radius in m."""
    if not near["reevaluate"]:
        return [neighbour.particle for neighbour in body.neighbours[j]]
    return [k for k in range(len(m)) if k != j and within_radius(minus(m[k], m[j]), near)]


def rule_target(
    body: Body, rule: Part, j: int, here: Point, ks: list[int], seen: list[Point]
) -> Point:
    """Section 5: the rules; seen are the places of the ks, j's neighbours, or fictitious ones."""
    X = body.X
    if rule["type"] == "mean-displacement":
        return plus(X[j], mean([minus(place, X[k]) for place, k in zip(seen, ks, strict=True)]))
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
    fracture, solver, near = (experiment[part] for part in ("fracture", "solver", "neighbours"))
    ks = neighbours_now(body, near, j, m)
    if not ks:
        return m[j]
    if near["reevaluate"]:
        seen = [m[k] for k in ks]
    else:
        seen = [seen_place(body, j, n, m, broken, fracture) for n in body.neighbours[j]]
    target = rule_target(body, experiment["rule"], j, m[j], ks, seen)
    relaxed = times(solver["relaxation"], minus(target, m[j]))
    remembered = times(solver["memory"], minus(m[j], before))
    return plus(m[j], plus(relaxed, remembered))


def frame_position(body: Body, f: int, x: list[Point]) -> Point:
    """Section 7: u_f = mean u_a, or R u_b in the mirror."""
    copied = body.frame[f]
    u_x, u_y = mean([minus(x[a], body.X[a]) for a in copied.particles])
    return plus(body.X[f], (copied.signs[0] * u_x, copied.signs[1] * u_y))


def affine(initial: Part, X: Point) -> Point:
    """u = gradient X + shift."""
    (xx, xy), (yx, yy) = initial["gradient"]
    return plus((xx * X[0] + xy * X[1], yx * X[0] + yy * X[1]), point(initial["shift"]))


def initial_positions(body: Body, experiment: Part, followers: set[int]) -> list[Point]:
    """Time 0: affine moves every body particle, noise (as drawn for every body particle) the
    followers of step 1 only; the frame stands where its policy puts it, whatever its lag."""
    initial, drawn = experiment["initial"], experiment["_noise"]
    members = [j for j, is_inside in enumerate(body.inside) if is_inside]
    x = list(body.X)
    if initial["type"] == "affine":
        for j in members:
            x[j] = plus(x[j], affine(initial, x[j]))
    if initial["type"] == "noise":
        for j, noise in zip(members, drawn, strict=True):
            x[j] = plus(x[j], noise) if j in followers else x[j]
    for f in body.frame:
        x[f] = frame_position(body, f, x)
    return x


def pe1(body: Body, j: int, x: list[Point], left_out: set[Bond]) -> float:
    """Section 8: of a body particle, over its reference neighbours but the bonds left out; NaN at
    frame points."""
    if not body.inside[j]:
        return math.nan
    ks = [near.particle for near in body.neighbours[j]]
    kept = [k for k in ks if (min(j, k), max(j, k)) not in left_out]
    return math.fsum((distance(x[j], x[k]) - distance(body.X[j], body.X[k])) ** 2 for k in kept)


def simulate(experiment: Part) -> Part:
    """Runs an experiment (as in a file, a dict) and returns every step of it in plain lists."""
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

    followers = {j for j in everyone if kind(j, 1) == FOLLOWER}
    history = [initial_positions(body, experiment, followers)]
    broken = cracked(body, bonds, fracture)
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
        for f in body.frame:
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
        "bond_ends": [[j + 1, k + 1] for j, k in bonds],
        "shell": [near.shell for near in bonds.values()],
        "broken_step": [broken.get(bond, NEVER) for bond in bonds],
        "pe1": [[pe1(body, j, x, set()) for j in everyone] for x in history],
        "pe1_intact": [[pe1(body, j, x, lost[t]) for j in everyone] for t, x in enumerate(history)],
        "pe2": [[distance(now[j], old[j]) for j in everyone] for old, now in before_and_after],
        "u": [[list(minus(x[j], body.X[j])) for j in everyone] for x in history],
        "broken_bonds": [len(lost[t]) for t in times_0_to_end],
    }
