"""Experiments drawn at random over everything that the plain loops implement.

Steps are few and thresholds lie off round numbers, so that no unstable mode and no tie between a
length and a threshold magnifies rounding into a difference.
"""

from hypothesis import HealthCheck, settings, strategies as st

from pbdkit import Lattice, NeighbourMetric
from pbdkit.lattice.neighbourhood import build_neighbourhood
from pbdkit.plugin.registry import Registry


def samples(count, **more):
    """Return the settings for a test that draws this number of scenes if the profile draws 100,
    otherwise in proportion, but at least two."""
    return settings(
        max_examples=max(2, count * settings().max_examples // 100),
        deadline=None,
        suppress_health_check=list(HealthCheck),
        **more,
    )


AT_LENGTH = settings().max_examples > 100
"""The profile is `long`, as in `.ci/nightly`."""


def in_turn(values, every, first=0):
    """Return a share of the values of a parametrised test; all of them in the profile `long`."""
    values = list(values)
    return values if AT_LENGTH else values[first::every]


DIAGNOSTICS = [{"type": t} for t in ("pe1", "pe1-intact", "pe2", "displacement", "broken")]

one_of = st.sampled_from
spacings = one_of([1.0, 0.7, 1.9])
lattices = st.one_of(
    st.builds(lambda kind, a: {"type": kind, "a": a}, one_of(["square", "hexagonal"]), spacings),
    st.builds(
        lambda kind, a, b: {"type": kind, "a": a, "b": b},
        one_of(["rectangular", "centred-rectangular"]),
        spacings,
        spacings,
    ),
    st.builds(
        lambda a, b, angle: {"type": "oblique", "a": a, "b": b, "angle": angle},
        spacings,
        spacings,
        one_of([60.0, 75.0, 110.0]),
    ),
)
origins = one_of([[0.0, 0.0], [3.0, -2.5]])
neighbours = st.one_of(
    st.builds(
        lambda kind, shells: {"type": kind, "shells": shells},
        one_of(["coordination", "chebyshev"]),
        st.integers(1, 2),
    ),
    st.builds(
        lambda radius, weights: {"type": "euclidean", "radius": radius, "weights": weights},
        one_of([2.13, 2.87]),
        one_of([[1.0, 1.0], [1.0, 1.7]]),
    ),
)
rules = st.one_of(
    one_of([{"type": "barycentre"}, {"type": "mean-displacement"}, {"type": "distance-weighted"}]),
    st.builds(
        lambda k, axis: {"type": "mixed-coordinate", "K": k, "axis": axis},
        one_of([-0.03, 0.011]),
        one_of(["x", "y"]),
    ),
)
copying_frames = st.one_of(
    st.just({"type": "none"}),
    st.builds(
        lambda kind, lag, layers: {"type": kind, "lag": lag} | layers,
        one_of(["mean", "first"]),
        st.integers(0, 1),
        one_of([{}, {"layers": 1}, {"layers": 2}, {"layers": 3}]),
    ),
)
mirrors = st.builds(lambda layers: {"type": "mirror"} | layers, one_of([{}, {"layers": 1}]))
frames = st.one_of(copying_frames, mirrors)
amounts = one_of([-1.53, -0.171, 0.0, 0.237, 0.61, 1.13])
vectors = st.tuples(amounts, amounts).map(list)
motions = st.one_of(
    st.just({"type": "hold"}),
    st.builds(
        lambda v, n: {"type": "velocity", "velocity": v, "steps": n}, vectors, st.integers(1, 6)
    ),
    st.builds(lambda v: {"type": "displace", "displacement": v}, vectors),
    st.builds(
        lambda v, w: {"type": "path", "steps": [2, 5], "displacements": [v, w]}, vectors, vectors
    ),
    st.builds(
        lambda c, n: {"type": "rotation", "centre": c, "angle": 7.3, "steps": n},
        vectors,
        st.integers(1, 6),
    ),
    st.builds(lambda v: {"type": "oscillation", "amplitude": v, "period": 6.7}, vectors),
)
points = st.tuples(one_of([0.1, 1.0, 2.5]), one_of([-0.2, 0.5, 3.0])).map(list)
selections = st.one_of(
    st.builds(lambda e: {"edge": e}, one_of(["left", "right", "bottom", "top"])),
    st.builds(
        lambda x, y, w: {"box": [x, y, x + w, y + w]},
        st.floats(-1, 1),
        st.floats(-1, 1),
        st.floats(2, 4),
    ),
    st.builds(lambda p: {"nearest": p}, st.lists(points, min_size=1, max_size=3)),
    st.builds(
        lambda n: {"numbers": sorted(n)}, st.sets(st.integers(1, 40), min_size=1, max_size=2)
    ),
)
sides = one_of([4, 5, 6, 3, 2, 1])
grids = st.builds(lambda c, r: {"type": "grid", "columns": c, "rows": r}, sides, sides)
outlines = one_of(
    [
        {"type": "rectangle", "width": 4.0, "height": 3.1, "origin": [-1.0, 0.3]},
        {"type": "disc", "radius": 2.6, "centre": [1.0, 1.2]},
        {"type": "ring", "inner": 1.3, "outer": 3.3, "centre": [0.4, 0.0]},
        {"type": "polygon", "vertices": [[-1.0, -1.0], [4.2, 0.0], [2.0, 2.1], [3.0, 4.0]]},
        {
            "type": "dogbone",
            "length": 9.1,
            "width": 5.0,
            "gauge_length": 3.0,
            "gauge_width": 2.1,
            "radius": 2.0,
            "origin": [-2.0, -1.0],
        },
    ]
)
bodies = st.one_of(
    grids,
    outlines,
    st.builds(
        lambda kind, a, b: {"type": kind, "of": [a, b]},
        one_of(["union", "intersection", "difference"]),
        st.one_of(outlines, grids),
        st.one_of(outlines, grids),
    ),
)
initials = st.one_of(
    st.just({"type": "reference"}),
    st.builds(lambda a: {"type": "noise", "amplitude": a}, one_of([0.05, 0.3])),
    st.builds(
        lambda xx, xy, shift: {
            "type": "affine",
            "gradient": [[xx, xy], [0.02, -0.07]],
            "shift": shift,
        },
        one_of([0.11, -0.2]),
        one_of([0.0, 0.13]),
        one_of([[0.0, 0.0], [1.5, -0.4]]),
    ),
)
cracks = one_of(
    [[], [[[1.53171, -1.27133], [1.61193, 2.17317]]], [[[-2.01371, 0.87137], [1.13793, 0.93171]]]]
)


@st.composite
def leader_groups(draw):
    group = {"select": draw(selections), "motion": draw(motions)}
    begin, length = draw(st.integers(1, 5)), draw(st.none() | st.integers(0, 5))
    if begin > 1:
        group["from"] = begin
    if length is not None:
        group["until"] = begin + length
    return group


def rest_lengths(lattice, near):
    registry = Registry()
    metric = registry.find(NeighbourMetric, near["type"])(**near)
    cell = registry.find(Lattice, lattice["type"])(**lattice).cell()
    return build_neighbourhood(cell, metric).shells()


@st.composite
def pulled_apart(draw):
    """Two opposite edges, moved until bonds break, and perhaps released."""
    edges = draw(one_of([("left", "right"), ("bottom", "top")]))
    pull = {
        "type": "velocity",
        "velocity": [draw(one_of([0.9, 0.4])), draw(one_of([0.7, 1.3]))],
        "steps": draw(st.integers(2, 8)),
    }
    released = draw(one_of([{}, {"until": 5}]))
    return [
        {"select": {"edge": edges[0]}, "motion": {"type": "hold"}},
        {"select": {"edge": edges[1]}, "motion": pull} | released,
    ]


@st.composite
def thresholds(draw, lattice, near):
    factor = draw(one_of([1.031234, 1.101234, 1.331234]))
    return {
        "type": "threshold",
        "thresholds": [factor * max(lengths) for lengths in rest_lengths(lattice, near)],
        "placement": draw(one_of([1.0, 0.8, 1.25])),
        "fictitious": draw(one_of(["cell", "reference"])),
        "frame_bonds": draw(st.booleans()),
        "cracks": draw(cracks),
    }


any_leaders = st.lists(leader_groups(), max_size=3)
at_random = st.booleans()


@st.composite
def experiments(draw, leaders=any_leaders, fracturing=at_random, body=bodies, start=initials):
    rule, lattice = draw(rules), draw(lattices) | {"origin": draw(origins)}
    near, shape = draw(neighbours), draw(body)
    solver = {"type": "stepping"}
    if draw(st.booleans()):
        solver |= {"relaxation": draw(one_of([0.4, 0.9, 1.1])), "memory": draw(one_of([0.0, 0.3]))}
    fracture = {"type": "none"}
    if draw(fracturing):
        fracture = draw(thresholds(lattice, near))
    elif near["type"] == "euclidean":
        near = near | {"reevaluate": draw(st.booleans())}
    return {
        "version": 1,
        "name": "random",
        "lattice": lattice,
        "body": shape,
        "neighbours": near,
        "rule": rule,
        "frame": draw(frames if shape["type"] == "grid" else copying_frames),
        "fracture": fracture,
        "initial": draw(start),
        "leaders": draw(leaders),
        "steps": draw(st.integers(1, 6 if rule["type"] == "distance-weighted" else 12)),
        "diagnostics": DIAGNOSTICS,
        "solver": solver,
    }


AROUND_SQUARES = {"neighbours": {"type": "chebyshev", "shells": 1}}
ELASTIC = [{"type": "elastic", "poisson_ratio": nu} for nu in (-1.0, -0.2, 0.3)]
ELASTIC.append({"type": "elastic", "poisson_ratio": 0.25, "plane": "strain"})
SPRINGS = {"type": "springs"}
GRADIENT = {"type": "strain-gradient", "poisson_ratio": 0.2, "length": 0.4}
ORTHOTROPIC = {
    "type": "orthotropic",
    "poisson_ratio": 0.3,
    "modulus_ratio": 0.5,
    "shear_ratio": 0.2,
}


@st.composite
def loads(draw):
    kind, force = draw(one_of(["force", "body_force"])), draw(vectors)
    acting = {"from": draw(st.integers(1, 4))} | draw(one_of([{}, {"until": 5}]))
    return {"select": draw(selections), kind: [0.1 * f for f in force]} | acting


@st.composite
def calibrated_experiments(draw):
    """Rules of elasticity, where they go: cut cells, frames with and without free edges, fracture,
    loads; the strain gradient with the natural frame and nothing that breaks."""
    kind = draw(one_of(["square", "rectangular", "hexagonal"]))
    lattice = {"type": kind, "a": 1.0} | ({"b": 1.3} if kind == "rectangular" else {})
    rules = {"square": [*ELASTIC, SPRINGS, ORTHOTROPIC, GRADIENT], "hexagonal": [*ELASTIC, SPRINGS]}
    rule = draw(one_of(rules.get(kind, [*ELASTIC, ORTHOTROPIC])))
    changed = {"lattice": lattice, "rule": rule, "frame": {"type": "natural"}}
    changed |= {"neighbours": {"type": "coordination", "shells": 1}}
    if kind != "hexagonal":
        changed |= AROUND_SQUARES
    near = changed["neighbours"]
    experiment = draw(experiments(leaders=st.one_of(any_leaders, pulled_apart())))
    if rule.get("poisson_ratio", 0.0) > -1.0:
        experiment["loads"] = draw(st.lists(loads(), max_size=2))
    experiment |= changed | {"fracture": {"type": "none"}}
    if rule is GRADIENT:
        experiment["solver"] = {"type": "stepping", "relaxation": 0.3}
    else:
        experiment["frame"] = {"type": draw(one_of(["natural", "natural", "mean", "none"]))}
        if draw(st.booleans()):
            experiment["fracture"] = draw(of_calibrated_bonds(lattice, near))
        if draw(one_of([False, False, True])):
            ends = draw(st.tuples(vectors, vectors))
            at = draw(st.integers(0, 3))
            cut = {"from": [4 * x for x in ends[0]], "to": [4 * x for x in ends[1]], "at": at}
            experiment["cuts"] = (
                [cut] if cut["from"] != cut["to"] and at <= experiment["steps"] else []
            )
    return experiment


@st.composite
def of_calibrated_bonds(draw, lattice, near):
    """Draw a fracture model in which lost bonds exert no force."""
    spares, limit = draw(st.booleans()), draw(st.floats(0.02, 0.4))
    kind = draw(one_of(["threshold", "strain", "damage"]))
    if kind == "threshold":
        return draw(thresholds(lattice, near)) | {"placement": 1.0, "fictitious": "cell"}
    limits = {"failure": limit} if kind == "strain" else {"onset": limit / 2, "failure": 2 * limit}
    scatter = {"scatter": draw(one_of([0.0, 0.3]))}
    return {"type": kind, "frame_bonds": spares} | limits | scatter
