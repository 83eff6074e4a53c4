"""Experiments in which the features of pbdkit meet: few and small, and any two that go together.

Features are those of `experiment_features`, which takes them from the schema. `experiment_of`
writes the experiment of a set of them, with what they leave open drawn from a seed; `covering`
chooses sets so that every pair of features that is not refused (`REFUSALS`) meets in one of them.
"""

from __future__ import annotations

import random
from collections.abc import Iterable, Iterator
from functools import lru_cache
from itertools import combinations
from typing import Any

import numpy as np
from experiment_features import Catalogue, Features, Pair, Tree
from particle_operations import Drag, Wind

import pbdkit
from pbdkit.scene.scene import build_scene

OPERATIONS = {"drag": Drag, "wind": Wind}

CATALOGUE = Catalogue([Drag, Wind])
FEATURES, PAIRS = CATALOGUE.features, CATALOGUE.pairs

CALIBRATED = ("elastic", "orthotropic", "springs", "strain-gradient")
AVERAGING = ("barycentre", "mean-displacement", "distance-weighted", "mixed-coordinate")
KINDS = {
    "solver": ("stepping", "equilibrium"),
    "rule": (
        *("elastic", "barycentre", "mixed-coordinate", "springs", "orthotropic"),
        *("distance-weighted", "mean-displacement", "strain-gradient"),
    ),
    "lattice": ("square", "hexagonal", "rectangular", "centred-rectangular", "oblique"),
    "neighbours": ("chebyshev", "coordination", "euclidean"),
    "frame": ("natural", "mean", "none", "first", "mirror"),
    "fracture": ("strain", "damage", "threshold", "cohesive", "none"),
    "body": (
        *("grid", "rectangle", "disc", "polygon", "dogbone"),
        *("union", "difference", "ring", "intersection"),
    ),
    "initial": ("reference", "noise", "affine"),
}
"""The parts of which a scene has one; the first that goes with the others is taken where a set of
features leaves it open."""
NEEDS = {
    "diagnostics: contact": "obstacles.shape: half_plane",
    "diagnostics: load-displacement": "loads.force",
    "cuts.at": "cuts",
    "solver.settle.tolerance": "solver.settle",
    "units.thickness": "units",
    "units.youngs_modulus": "units",
    "leaders in time": "leaders.motion.force",
}
"""The feature that another requires, besides the component that has it."""


def group(prefix: str, *but: str) -> tuple[str, ...]:
    """Return the features that begin with a prefix."""
    return tuple(sorted(f for f in FEATURES if f.startswith(prefix) and f not in but))


def of(setting: str, *values: str) -> tuple[str, ...]:
    return tuple(f"{setting}: {value}" for value in values)


FRACTURES = group("fracture", "fracture: none")
SOFTENING = of("fracture", "damage", "cohesive")
UNCALIBRATED, MATERIALS = of("rule", *AVERAGING), of("rule", *CALIBRATED)
VARYING = ("by region", "on a grid", "random")
FIELDS_OF_RULE = tuple(f"rule {form}" for form in VARYING)
FIELDS_OF_FRACTURE = tuple(f"fracture {form}" for form in VARYING)
LOADS = (*group("loads"), "diagnostics: load-displacement")
OF_FORCES = of("diagnostics", "strain-energy", "reaction", "stress", "stress-strain", "contact")
NEWTON = ("leaders.motion: newton", "leaders.motion.force", "leaders.motion.damping")
NEWTON += ("leaders.motion.velocity", "leaders in time")
ANEW = "neighbours.reevaluate"

UNITS = {"length": "0.25 mm"}
NUMBERS = {
    "elastic": ("stiffness", "poisson_ratio"),
    "orthotropic": ("stiffness", "poisson_ratio"),
    "springs": ("stiffness",),
    "strain-gradient": ("stiffness", "poisson_ratio"),
    "mixed-coordinate": ("K",),
    "strain": ("failure",),
    "damage": ("failure", "onset"),
    "cohesive": ("energy", "onset"),
    "threshold": ("placement",),
}
"""Parameters of rules and fracture models that fields and time-dependent values can replace."""

AUTO = ("solver.memory: auto", "solver.relaxation: auto")
LOOSE = ("fracture.placement", "fracture.fictitious: reference")
BRIEF = "the distance from equilibrium has no bound"
REFUSALS: tuple[tuple[tuple[str, ...], tuple[str, ...], str], ...] = (
    ((ANEW,), of("neighbours", "chebyshev", "coordination"), "cannot be re-evaluated"),
    ((ANEW,), FRACTURES, "bonds cannot break if neighbours are re-evaluated"),
    ((ANEW,), ("cuts",), "bonds cannot be cut if neighbours are re-evaluated"),
    ((ANEW,), LOADS, "loads: loads require fixed neighbours; set neighbours.reeval"),
    ((ANEW,), ("solver.settle",), f"{BRIEF} if neighbours are re-evaluated"),
    ((ANEW,), ("solver: equilibrium",), "an equilibrium is not defined if neighbours are"),
    ((ANEW,), FIELDS_OF_RULE, "fixed neighbours for varying parameters; set"),
    (
        (ANEW,),
        ("frame: natural", "leaders.motion: newton", *MATERIALS),
        "has weights for each slot, which re-evaluated neighbours do not have",
    ),
    ((ANEW,), OF_FORCES, "requires fixed neighbours; set neighbours.reevaluate: false"),
    (
        AUTO,
        ("rule in time", "fracture in time", "solver in time"),
        "'auto' requires constant parameters, but some depend on time",
    ),
    (AUTO, (ANEW,), "'auto' requires a spectrum, which does not exist if neighbours are"),
    (AUTO, ("frame.lag",), "'auto' requires steps that depend on the last one only"),
    (UNCALIBRATED, LOADS, r"loads: the rule '[a-z-]+' .* defines moves, but no forces"),
    (
        UNCALIBRATED,
        ("leaders.motion: newton",),
        "leaders that move by Newton's law require forces, which '",
    ),
    (
        UNCALIBRATED,
        ("fracture: cohesive",),
        "'cohesive' requires a rule that is calibrated|the rule '[a-z-]+' is not defined by cells",
    ),
    (UNCALIBRATED, OF_FORCES, "requires a rule that is calibrated to a material"),
    (
        ("fracture: cohesive",),
        of("frame", "mean", "first", "none", "mirror"),
        "'cohesive' softens the cells of the body, which the frame",
    ),
    (UNCALIBRATED, ("frame: natural",), "the rule '[a-z-]+' is not defined by cells; use a"),
    (MATERIALS, ("neighbours.shells",), "requires the |are not the corners of the cells"),
    (
        MATERIALS,
        of("lattice", "centred-rectangular", "oblique"),
        "requires the |is not isotropic and requires|are not the corners of the cells",
    ),
    (of("rule", "springs"), of("lattice", "rectangular"), "'springs' requires the hexagonal"),
    (
        of("rule", "strain-gradient"),
        of("lattice", "rectangular"),
        "'strain-gradient' requires cells of equal sides",
    ),
    (
        of("rule", "orthotropic"),
        of("lattice", "hexagonal"),
        "'orthotropic' is not isotropic and requires",
    ),
    (
        of("rule", "orthotropic"),
        of("neighbours", "coordination"),
        "are not the corners of the cells|'orthotropic' is not isotropic and requires",
    ),
    (MATERIALS, LOOSE, "places fictitious points that exert forces at broken bonds"),
    (
        ("fracture: cohesive",),
        LOOSE,
        "fracture.placement: should be less than or equal|fracture.fictitious: should be",
    ),
    (("rule: strain-gradient",), FIELDS_OF_RULE, "applies a rule to the moves of another"),
    (
        ("rule: strain-gradient",),
        FRACTURES,
        "the moves of another, which is incompatible with this setting of fracture",
    ),
    (
        ("rule: strain-gradient",),
        ("cuts",),
        "which is incompatible with this setting of cuts; use cuts:",
    ),
    (
        ("rule: strain-gradient",),
        ("frame.lag",),
        "which is incompatible with this setting of frame; use frame: lag: 0",
    ),
    (
        ("fracture: threshold",),
        FIELDS_OF_FRACTURE,
        "'placement' of 'threshold' is not a limit of bonds|places fictitious points that exert",
    ),
    (
        ("fracture.scatter",),
        FIELDS_OF_FRACTURE,
        "draws a random number for each bond from its parameters; 'failure' must be a single",
    ),
    (
        ("fracture.scatter",),
        ("fracture in time",),
        "so that it cannot depend on time; give a single number",
    ),
    (SOFTENING, ("solver.settle",), f"depends on the history, so that {BRIEF}"),
    (
        ("leaders.motion: newton",),
        ("solver: equilibrium", "solver.settle"),
        "have no final position that",
    ),
    (
        ("leaders.motion: oscillation", "obstacles.motion: oscillation"),
        ("solver: equilibrium",),
        "never comes to rest, so that there is no equilibrium",
    ),
    (
        ("operations: wind",),
        ("solver: equilibrium", "solver.settle"),
        "'wind' can move particles at rest, so that the equilibrium is not determined",
    ),
    (
        ("frame: mirror",),
        of("lattice", "hexagonal", "centred-rectangular", "oblique"),
        "a mirror frame requires a square or rectangular lattice",
    ),
    (
        ("frame: mirror",),
        of("body", "disc", "ring", "dogbone", "union"),
        "a mirror frame requires a rectangular body",
    ),
    (("record.increments",), ("solver: stepping",), "increments of load exist only for an"),
    (("record.every",), ("record.at",), "`every` and `at` exclude each other"),
    (("diagnostics.points",), ("diagnostics.numbers",), "has both points and numbers"),
)
"""Features of two groups of which no two can be combined, and the message of the refusal."""


@lru_cache(None)
def refused_pairs() -> dict[Pair, str]:
    """Return the message for each pair of features that is refused.

    An option is refused with what all components that have it are refused with.
    """
    found: dict[Pair, str] = {}
    for first, second, words in REFUSALS:
        for pair in (frozenset((a, b)) for a in first for b in second):
            if pair in PAIRS:
                found.setdefault(pair, words)
    owned = {option: owners for option, owners in CATALOGUE.owners.items() if owners}
    owned |= {feature: {needed} for feature, needed in NEEDS.items()}
    size = -1
    while size < len(found):
        size = len(found)
        for option, owners in owned.items():
            for other in FEATURES - owners - {option}:
                _refuse_if_none_goes((option, other), sorted(owners), found)
        for pair in PAIRS - found.keys():
            for part, names in KINDS.items():
                _refuse_if_none_goes(tuple(sorted(pair)), of(part, *names), found)
    return found


def _refuse_if_none_goes(
    pair: tuple[str, ...], components: Iterable[str], found: dict[Pair, str]
) -> None:
    """Note that two features are refused if each of the components is refused with one of them."""
    reasons = []
    for component in components:
        pairs = [frozenset((feature, component)) for feature in pair if feature != component]
        words = [found.get(one, " " if one not in PAIRS else "") for one in pairs]
        if not any(words):
            return
        reasons += [word for word in words if word.strip()]
    if frozenset(pair) in PAIRS:
        found.setdefault(frozenset(pair), "|".join(dict.fromkeys(reasons)))


def refusal_of(pair: Iterable[str]) -> str | None:
    """Return the message that refuses two features; None if they can be combined."""
    return refused_pairs().get(frozenset(pair))


def goes_with(feature: str, features: Iterable[str]) -> bool:
    """Return whether a feature can be combined with each of the others, in pairs."""
    refused = refused_pairs()
    pairs = (frozenset((feature, other)) for other in features if other != feature)
    return all(pair in PAIRS and pair not in refused for pair in pairs)


def name_of(part: str, features: Iterable[str]) -> str | None:
    """The component of a part among the features."""
    return next((f.split(": ")[1] for f in features if f.startswith(f"{part}: ")), None)


def completed(features: Iterable[str], draw: random.Random | None = None) -> Features:
    """With what features require, and with one component for each part."""
    found = set(features)
    for feature in sorted(found):
        found |= {NEEDS[feature]} if feature in NEEDS else set()
    for feature in sorted(found):
        owners = CATALOGUE.owners.get(feature, set())
        if owners and not owners & found:
            order = sorted(owners, key=_preference)
            fitting = [one for one in order if fits_with(one, found)]
            found.add((fitting or order)[0])
    for part, names in KINDS.items():
        if name_of(part, found) is None:
            order = [f"{part}: {name}" for name in names]
            if part == "fracture":
                order = order[::-1]
            if draw:
                draw.shuffle(order)
            fitting = [one for one in order if fits_with(one, found)]
            found.add((fitting or order)[0])
    return frozenset(found)


def _preference(component: str) -> tuple[int, str]:
    part, name = component.split(": ")
    names = KINDS.get(part, ())
    return (names.index(name) if name in names else 0, component)


def fits_with(component: str, features: set[str]) -> bool:
    return goes_with(component, features) and fits(frozenset({*features, component}))


def fits(features: Features) -> bool:
    """Return whether features can be combined, besides what is refused in pairs."""
    rule, lattice, near = (name_of(part, features) for part in ("rule", "lattice", "neighbours"))
    is_hexagonal = lattice == "hexagonal"
    if rule in CALIBRATED and lattice and near == ("chebyshev" if is_hexagonal else "coordination"):
        return False
    if rule in CALIBRATED and lattice == "rectangular" and "neighbours.weights" in features:
        return False  # the weights are those of the neighbours of a square
    for part in ("rule", "fracture"):
        forms = sum(f"{part} {form}" in features for form in (*VARYING, "in time"))
        forms += f"{part}.stiffness" in features
        name = name_of(part, features)
        if name and forms > len(NUMBERS.get(name, ())):
            return False
    changes = any(f"{part} in time" in features for part in ("rule", "fracture"))
    in_time = changes or "solver in time" in features
    varies = not features.isdisjoint({*FIELDS_OF_RULE, *FIELDS_OF_FRACTURE, ANEW})
    pushes = any(f.startswith(("obstacles", "leaders.axes", *NEWTON)) for f in features)
    if "solver.engine: compiled" in features and ((in_time and varies) or (changes and pushes)):
        return False  # kernels have one of both
    if features >= {"solver.engine: compiled", "rule in time"} and rule == "springs":
        return False  # its stiffness is a constant of kernels
    if features >= {"solver in time", "solver.memory", "solver.relaxation"}:
        return False
    several = ("leaders.motion: ", "obstacles.shape: ", "obstacles.motion: ", "regions: ")
    most = (4, 2, 2, 3)
    return all(
        sum(f.startswith(prefix) for f in features) <= number
        for prefix, number in zip(several, most, strict=True)
    )


def experiment_of(features: Iterable[str], seed: int = 0) -> Tree:
    """An experiment that has these features; the seed draws what they leave open."""
    return numbered(_Writer(completed(features), random.Random(f"scene {seed}")).experiment())


def experiment_from(tree: Tree) -> pbdkit.Experiment:
    """Return the validated experiment of a tree, with the operations of these tests."""
    if "operations" not in tree:
        return pbdkit.Experiment(**tree)
    parts = [OPERATIONS[one["type"]](**one) for one in tree["operations"]]
    return pbdkit.Experiment(**tree | {"operations": parts})


def numbers_in(tree: Tree) -> list[Tree]:
    """Return the selections and diagnostics that name particles by number."""
    groups = [*tree["leaders"], *tree.get("loads", [])]
    holders = [*(one["select"] for one in groups), *tree["diagnostics"]]
    return [one for one in holders if "numbers" in one]


def places_of(tree: Tree) -> dict[int, list[float]]:
    """Return the reference positions of the particles of the body, by number."""
    plain = {key: tree[key] for key in ("lattice", "body", "neighbours", "frame", "rule")}
    raster = build_scene(
        pbdkit.Experiment(**plain, steps=1, regions=tree.get("regions", {}))
    ).raster
    rows = raster.body_rows
    places = raster.reference(rows).tolist()
    return dict(zip((rows + 1).tolist(), places, strict=True))


def numbered(tree: Tree) -> Tree:
    """Replace points in the place of numbers by the numbers of the nearest particles."""
    holders = numbers_in(tree)
    if holders:
        try:
            places = places_of(tree)
        except pbdkit.ExperimentError:
            places = {1: [0.0, 0.0]}  # The error is raised again when the experiment is run.
        numbers, at = list(places), np.array(list(places.values()))
        for one in holders:
            distances = (np.hypot(*(at - np.array(x)).T) for x in one["numbers"])
            one["numbers"] = [numbers[int(each.argmin())] for each in distances]
    return tree


HEIGHTS = {
    "square": 1.0,
    "rectangular": 1.25,
    "hexagonal": 0.75**0.5,
    "centred-rectangular": 0.8,
    "oblique": 1.0625,
}
"""The distance of the rows of each lattice."""


ROUND = ("disc", "ring", "union", "intersection")
"""Bodies with a row of one particle, which is at the left and at the right edge."""
FORCED = ("strain-energy", "reaction", "contact", "load-displacement", "stress", "stress-strain")
"""Diagnostics with a modulus; the first four with a thickness besides."""


class _Writer:
    """Writes the experiment of a set of features."""

    def __init__(self, features: Features, draw: random.Random) -> None:
        self.features, self.draw = features, draw
        names = (name_of(part, features) or "" for part in KINDS)
        self.names = dict(zip(KINDS, names, strict=True))
        self.jumps = self.names["solver"] == "equilibrium"
        self.columns, self.rows = self.draw.choice([(6, 4), (5, 4)])
        self.height = HEIGHTS[self.names["lattice"]]
        self.amount = self.draw.choice([0.0613, 0.0471, 0.0837])
        """Displacement of the leaders, which breaks some of the bonds with low limits."""

    def has(self, *features: str) -> bool:
        return not self.features.isdisjoint(features)

    def listed(self, prefix: str) -> list[str]:
        """Return the types among features such as 'leaders.motion: hold'."""
        return sorted(f.split(": ")[1] for f in self.features if f.startswith(f"{prefix}: "))

    def experiment(self) -> Tree:
        written: Tree = {
            "name": "crossed",
            "seed": self.draw.randrange(100),
            "lattice": self.lattice(),
            "body": self.body(self.names["body"]),
            "neighbours": self.neighbours(),
            "rule": self.rule(),
            "frame": self.frame(),
            "initial": self.initial(),
            "leaders": self.leaders(),
            "steps": 8,
            "solver": self.solver(),
            "diagnostics": self.diagnostics(),
        }
        if self.has("units"):
            written["units"] = UNITS | (
                {"youngs_modulus": "200 MPa"} if self.has("units.youngs_modulus") else {}
            )
            written["units"] |= {"thickness": "2 mm"} if self.has("units.thickness") else {}
        if self.names["fracture"] != "none":
            written["fracture"] = self.fracture()
        if regions := self.regions():
            written["regions"] = regions
        if self.has("cuts"):
            x, y = self.at(0.45, 0.6)
            cut = {"from": [x, y - 9.0], "to": [x, y]}
            written["cuts"] = [cut | ({"at": 2} if self.has("cuts.at") else {})]
        if loads := self.loads():
            written["loads"] = loads
        if obstacles := self.obstacles():
            written["obstacles"] = obstacles
        if operations := self.operations():
            written["operations"] = operations
        if record := self.record():
            written["record"] = record
        return written

    def at(self, along: float, across: float) -> list[float]:
        """A point of the body's box, by shares of its sides, off the sites."""
        x, y = (self.columns - 1) * along, (self.rows - 1) * self.height * across
        return [round(x + 0.5123, 4), round(y - 0.2634, 4)]

    def lattice(self) -> Tree:
        name = self.names["lattice"]
        sides: dict[str, Tree] = {
            "rectangular": {"b": 1.25},
            "centred-rectangular": {"b": 1.6},
            "oblique": {"b": 1.1, "angle": 75.0},
        }
        return {"type": name, "a": 1.0, "origin": [0.5, -0.25]} | sides.get(name, {})

    def body(self, kind: str) -> Tree:
        """Return a body of a type that fills most of the box of the grid."""
        (x, y), (width, height) = self.at(0.0, 0.0), self.sides()
        middle = self.at(0.5, 0.5)
        box = {"type": "rectangle", "width": width + 0.4, "height": height + 0.3}
        box |= {"origin": [round(x - 0.2123, 4), round(y - 0.1366, 4)]}
        disc = {"type": "disc", "radius": 3.07, "centre": middle}
        corners = [self.at(-0.05, -0.06), self.at(1.05, -0.03), self.at(1.02, 1.06)]
        bodies: dict[str, Tree] = {
            "grid": {"type": "grid", "columns": self.columns, "rows": self.rows},
            "rectangle": box,
            "disc": disc,
            "ring": {"type": "ring", "inner": 0.57, "outer": 3.37, "centre": middle},
            "polygon": {"type": "polygon", "vertices": [*corners, self.at(-0.03, 1.04)]},
            "dogbone": {
                "type": "dogbone",
                "length": width + 0.43,
                "width": height + 0.37,
                "gauge_length": 1.5,
                "gauge_width": height - 0.31,
                "radius": 0.6,
                "origin": [round(x - 0.2123, 4), round(y - 0.1366, 4)],
            },
            "union": {"type": "union", "of": [box, disc]},
            "intersection": {"type": "intersection", "of": [box, disc | {"radius": 3.63}]},
            "difference": {"type": "difference", "of": [box, disc | {"radius": 0.37}]},
        }
        return bodies[kind]

    def sides(self) -> tuple[float, float]:
        return self.columns - 1.0, round((self.rows - 1) * self.height, 4)

    def regions(self) -> Tree:
        x, y = self.at(0.55, 0.35)
        part = {"type": "rectangle", "width": 40.0, "height": 40.0, "origin": [x, y]}
        found: Tree = {}
        if self.has("rule by region", "fracture by region", "loads.select.region"):
            found["part"] = part
        if self.has("leaders.select.region"):
            disc = {"type": "disc", "radius": 0.9, "centre": self.at(0.0, 0.5)}
            found["clamp"] = disc
        for kind in self.listed("regions"):
            if kind not in [one["type"] for one in found.values()]:
                found[f"region-{kind}"] = self.body(kind)
        return found

    def neighbours(self) -> Tree:
        kind = self.names["neighbours"]
        if kind == "euclidean":
            radius = {"hexagonal": 1.13, "rectangular": 1.67, "oblique": 1.31}
            written = {"type": kind, "radius": radius.get(self.names["lattice"], 1.43)}
            if self.has("neighbours.weights"):
                written |= {"radius": 1.73, "weights": [1.0, 1.7]}
            return written | ({"reevaluate": True} if self.has(ANEW) else {})
        written = {"type": kind, "shells": 2 if self.has("neighbours.shells") else 1}
        return written | ({"reevaluate": True} if self.has(ANEW) else {})

    def rule(self) -> Tree:
        name = self.names["rule"]
        base: dict[str, Tree] = {
            "elastic": {"poisson_ratio": self.draw.choice([0.2, 0.3, -0.2, 0.4])},
            "orthotropic": {"poisson_ratio": 0.2, "modulus_ratio": 0.5, "shear_ratio": 0.3},
            "strain-gradient": {"poisson_ratio": 0.2, "length": 0.4},
            "mixed-coordinate": {"K": -0.004},
        }
        written = {"type": name} | base.get(name, {})
        written |= {"axis": "y"} if self.has("rule.axis: y") else {}
        written |= {"plane": "strain"} if self.has("rule.plane: strain") else {}
        names = list(NUMBERS.get(name, ("stiffness",)))
        if self.has("rule.stiffness"):
            names.remove("stiffness")
            written["stiffness"] = 1.7
        values = {"stiffness": 1.0, "poisson_ratio": 0.2, "K": -0.004}
        for form in (*VARYING, "in time"):
            if self.has(f"rule {form}"):
                number = names.pop(0) if names else "stiffness"
                written[number] = self.form(form, values[number])
        return written

    def form(self, form: str, value: float) -> Tree:
        """Return the replacement of a number."""
        if form == "in time":
            return {"steps": [0, 5], "values": [value, 0.75 * value]}
        if form == "by region":
            return {"otherwise": value, "part": 0.75 * value}
        if form == "random":
            return {"mean": abs(value), "scatter": 0.2, "correlation_length": 2.0}
        (x0, y0), (x1, y1) = self.at(-2.0, -3.0), self.at(3.0, 4.0)
        xm, ym = self.at(0.53, 0.57)
        rows = [[0.9, 1.0, 0.8], [1.1, 0.7, 1.0], [0.8, 1.0, 1.2]]
        values = [[share * value for share in row] for row in rows]
        return {"x": [x0, xm, x1], "y": [y0, ym, y1], "values": values}

    def frame(self) -> Tree:
        written: Tree = {"type": self.names["frame"]}
        written |= {"layers": 3} if self.has("frame.layers") else {}
        return written | ({"lag": 1} if self.has("frame.lag") else {})

    def initial(self) -> Tree:
        kind = self.names["initial"]
        if kind == "noise":
            return {"type": kind, "amplitude": 0.0117}
        if kind == "affine":
            gradient = [[0.0113, 0.0021], [-0.0017, -0.0071]]
            shift = {"shift": [0.0231, -0.0172]} if self.has("initial.shift") else {}
            return {"type": kind, "gradient": gradient} | shift
        return {"type": kind}

    def fracture(self) -> Tree:
        name = self.names["fracture"]
        limit = self.draw.choice([0.0317, 0.0173, 0.2, 0.0071])
        if self.jumps and (self.loads() or self.obstacles()):
            limit = 0.6  # what comes off would be loaded, but not constrained
        if self.names["initial"] != "reference":
            limit = max(limit, 0.0317)
        base: dict[str, Tree] = {
            "strain": {"failure": limit},
            "damage": {"onset": limit / 3, "failure": limit},
            "cohesive": {"onset": limit / 3, "energy": limit},
            "threshold": {},
        }
        written = {"type": name} | base[name]
        if name == "threshold":
            lengths = [n * (1.0 + limit) for n in self.rests()]
            written["thresholds"] = lengths
            if self.has("fracture in time"):
                values = [2.0 * lengths[0], lengths[0]]
                written["thresholds"] = [{"steps": [0, 5], "values": values}, *lengths[1:]]
        numbers = list(NUMBERS[name])
        forms = [*VARYING, *(["in time"] if name != "threshold" else [])]
        for form in forms:
            if self.has(f"fracture {form}"):
                number = numbers.pop(0) if numbers else "failure"
                written[number] = self.form(form, 1.5 * base[name].get(number, 1.0))
        if laws := self.listed("fracture.law"):
            written["law"] = laws[0]
        written |= {"scatter": 0.2} if self.has("fracture.scatter") else {}
        written |= {"placement": 1.02} if self.has("fracture.placement") else {}
        written |= {"frame_bonds": False} if self.has("fracture.frame_bonds") else {}
        if self.has("fracture.fictitious: reference"):
            written["fictitious"] = "reference"
        if self.has("fracture.cracks"):
            x, y = self.at(0.7, 0.55)
            written["cracks"] = [[[x, y], [x, y + 9.0]]]
        return written

    def rests(self) -> list[float]:
        """The longest rest length of each shell."""
        from pbdkit import Lattice, NeighbourMetric
        from pbdkit.lattice.neighbourhood import build_neighbourhood
        from pbdkit.plugin.registry import Registry

        registry, lattice, near = Registry(), self.lattice(), self.neighbours()
        metric = registry.find(NeighbourMetric, near["type"])(**near)
        cell = registry.find(Lattice, lattice["type"])(**lattice).cell()
        return [max(lengths) for lengths in build_neighbourhood(cell, metric).shells()]

    def leaders(self) -> list[Tree]:
        motions = [name for name in self.listed("leaders.motion") if name != "hold"]
        singles = [name for name in motions if name == "newton"]
        motions = [name for name in motions if name != "newton"] or ["displace"]
        left: Tree = {"select": {"edge": "left"}, "motion": {"type": "hold"}}
        right: Tree = {"select": {"edge": "right"}, "motion": self.motion(motions[0])}
        if self.has("leaders.select.box") or self.names["body"] in ROUND:
            (x, y), far = self.at(0.83, -1.3), self.at(2.4, 2.4)
            right["select"] = {"box": [x, y, *far]}
        groups = [left, right]
        if self.has("leaders.axes"):
            # Held at one corner besides, so that nothing is free to slide.
            left["axes"] = ["x"]
            groups.append({"select": {"nearest": [self.at(0.0, 0.0)]}, "motion": left["motion"]})
        if self.has("leaders.until") and self.jumps:
            # A corner alone: what nothing holds any more has no equilibrium under obstacles.
            corner = {"select": {"nearest": [self.at(1.0, 1.0)]}, "motion": right["motion"]}
            right["select"] = {"nearest": [self.at(1.0, 0.0)]}
            groups.append(corner | {"until": 5})
        elif self.has("leaders.until"):
            right["until"] = 5
        if self.has("leaders.from"):
            late: Tree = {"type": "displace", "displacement": [0.0, -self.amount / 2]}
            groups.append({"select": {"nearest": [self.at(0.5, 1.0)]}, "motion": late, "from": 3})
        places = iter([self.at(0.5, 0.4), self.at(0.35, 0.7), self.at(0.65, 0.7)])
        for name in [*singles, *motions[1:]]:
            select = {"nearest": [next(places)]}
            groups.append({"select": select, "motion": self.motion(name)})
        if self.has("leaders.select.nearest") and len(groups) == 2:
            select = {"nearest": [self.at(0.5, 0.4)]}
            groups.append({"select": select, "motion": {"type": "hold"}})
        if self.has("leaders.select.region"):
            groups.append({"select": {"region": "clamp"}, "motion": {"type": "hold"}})
        if self.has("leaders.select.numbers"):
            select = {"numbers": [self.at(0.0, 0.5)]}
            groups.append({"select": select, "motion": {"type": "hold"}})
        return groups

    def motion(self, name: str) -> Tree:
        way = [self.amount, round(self.amount / 3, 4)]
        if name == "newton":
            written: Tree = {"type": name, "mass": 9.0}
            force: list[Any] = [0.003, -0.01]
            if self.has("leaders in time"):
                force[0] = {"steps": [0, 5], "values": [0.003, 0.001]}
            if self.has("leaders.motion.force", "leaders in time"):
                written["force"] = force
            written |= {"damping": 0.5} if self.has("leaders.motion.damping") else {}
            return written | (
                {"velocity": [0.004, -0.003]} if self.has("leaders.motion.velocity") else {}
            )
        if name == "measured":
            corners = [self.at(x, y) for x in (-0.7, 1.6) for y in (-1.2, 2.2)]
            moves = [[way[0], 0.01], [way[0], -0.02], [way[0], 0.01], [way[0], -0.02]]
            written = {"type": name, "points": corners, "displacements": moves}
            written |= {"ramp": 2} if self.has("leaders.motion.ramp") else {}
            return written | (
                {"outside": "nearest"} if self.has("leaders.motion.outside: nearest") else {}
            )
        return self.rigid(name, way)

    def rigid(self, name: str, way: list[float]) -> Tree:
        motions: dict[str, Tree] = {
            "hold": {},
            "displace": {"displacement": way},
            "velocity": {"velocity": [way[0] / 4, way[1] / 4], "steps": 4},
            "path": {"steps": [2, 5], "displacements": [[way[0] / 2, 0.0], way]},
            "table": {"steps": [3, 4], "displacements": [[way[0] / 3, way[1]], way]},
            "rotation": {"centre": self.at(1.0, 0.5), "angle": 0.9, "steps": 4},
            "oscillation": {"amplitude": way, "period": 11.7},
        }
        return {"type": name} | motions[name]

    def loads(self) -> list[Tree]:
        if not any(f.startswith("loads") for f in self.features):
            return []
        x, y = self.at(0.4, -0.1)
        clip: Tree = {
            "box": {"box": [x, y, x + 40.0, y + 40.0]},
            "edge": {"edge": "top"},
            "nearest": {"nearest": [self.at(0.4, 0.7), self.at(0.6, 0.4)]},
            "numbers": {"numbers": [self.at(0.4, 0.9), self.at(0.7, 0.3)]},
            "region": {"region": "part"},
        }
        selects = [clip[f.split(".")[-1]] for f in group("loads.select.") if self.has(f)]
        kinds = []
        kinds += ["force"] if self.has("loads.force") or not self.has("loads.body_force") else []
        kinds += ["body_force"] if self.has("loads.body_force") else []
        selects += [clip["edge"], clip["box"]][: max(0, len(kinds) - len(selects))]
        found = []
        for n, select in enumerate(selects):
            kind = kinds[n % len(kinds)]
            force: list[Any] = [0.0011, -0.0023] if kind == "force" else [-0.0004, 0.0007]
            if self.has("loads in time") and n == 0:
                force[1] = {"steps": [0, 6], "values": [0.0, force[1]]}
            found.append({"select": select, kind: force})
        found[-1] |= {"from": 2} if self.has("loads.from") else {}
        found[0] |= {"until": 6} if self.has("loads.until") else {}
        return found

    def obstacles(self) -> list[Tree]:
        if not any(f.startswith("obstacles") for f in self.features):
            return []
        shapes = self.listed("obstacles.shape") or ["half_plane"]
        motions = self.listed("obstacles.motion") or ["displace"]
        count = max(len(shapes), len(motions))
        found = [
            self.obstacle(n, shapes[n % len(shapes)], motions[n % len(motions)])
            for n in range(count)
        ]
        found[0] |= {"from": 2} if self.has("obstacles.from") else {}
        found[-1] |= {"until": 6} if self.has("obstacles.until") else {}
        return found

    def obstacle(self, n: int, shape: str, motion: str) -> Tree:
        """Return the first below the body, and the second above it."""
        box = self.body(self.names["body"])
        # Outlines have cells that are cut, with particles outside by up to a row.
        gap = 0.11 if box["type"] == "grid" else 0.11 + 1.25 * self.height
        if box["type"] in ROUND:
            gap += 1.9
        x, y = self.at(0.5, float(n))
        side = 1.0 if n == 0 else -1.0
        top = y - side * gap
        low = top - 3.0 if n == 0 else top
        shapes: dict[str, Tree] = {
            "half_plane": {"half_plane": {"point": [x, top], "normal": [0.0, side]}},
            "disc": {"type": "disc", "radius": 9.0, "centre": [x, top - side * 9.0]},
            "ring": {"type": "ring", "inner": 4.0, "outer": 9.0, "centre": [x, top - side * 9.0]},
            "rectangle": {
                "type": "rectangle",
                "width": 40.0,
                "height": 3.0,
                "origin": [x - 20.0, low],
            },
            "polygon": {
                "type": "polygon",
                "vertices": [
                    *([x - 20.0, low], [x + 20.0, low]),
                    *([x + 20.0, low + 3.0], [x - 20.0, low + 3.0]),
                ],
            },
        }
        way = [0.0, side * 0.1431 + side * (gap - 0.11)]
        return {"shape": shapes[shape], "motion": self.rigid(motion, way)}

    def operations(self) -> list[Tree]:
        found: list[Tree] = []
        if self.has("operations: drag"):
            found.append({"type": "drag", "factor": 0.25})
        if self.has("operations: wind"):
            found.append({"type": "wind", "speed": 0.0019})
        return found

    def record(self) -> Tree:
        written: Tree = {}
        written |= {"at": [0, 3, 4]} if self.has("record.at") else {}
        written |= {"every": 3} if self.has("record.every") else {}
        if self.jumps and not written:
            written = {"every": 8}  # each record is an equilibrium
        written |= {"increments": True} if self.has("record.increments") else {}
        written |= {"dtype": "float32"} if self.has("record.dtype: float32") else {}
        return written | ({"compression": "zlib"} if self.has("record.compression: zlib") else {})

    def solver(self) -> Tree:
        if self.jumps:
            return self.equilibrium()
        written: Tree = {"type": "stepping"}
        relaxation: Any = 0.07 if self.names["rule"] == "strain-gradient" else 0.6
        written["relaxation"] = "auto" if self.has("solver.relaxation: auto") else relaxation
        written |= {"memory": 0.2} if self.has("solver.memory") else {}
        if self.has("solver in time"):
            free = self.has("solver.relaxation", "solver.relaxation: auto")
            name, value = ("memory", 0.2) if free else ("relaxation", relaxation)
            written[name] = {"steps": [0, 5], "values": [value, 0.9 * value]}
        written |= {"memory": "auto"} if self.has("solver.memory: auto") else {}
        written |= {"precision": "float32"} if self.has("solver.precision: float32") else {}
        written |= {"threads": 2} if self.has("solver.threads") else {}
        for engine in self.listed("solver.engine"):
            written["engine"] = engine
        if self.has("solver.settle"):
            tolerance = {"tolerance": 1e-2} if self.has("solver.settle.tolerance") else {}
            written["settle"] = tolerance
        return written

    def equilibrium(self) -> Tree:
        written: Tree = {"type": "equilibrium", "increments": 2}
        written |= {"tolerance": 1e-9} if self.has("solver.tolerance") else {}
        for method in self.listed("solver.method"):
            written["method"] = method
        return written

    def diagnostics(self) -> list[Tree]:
        modulus = {} if self.has("units.youngs_modulus") else {"youngs_modulus": 1.0}
        thickness = self.has("units") and not self.has("units.thickness")
        kinds = [name for name in self.listed("diagnostics") if name != "green-lagrange"]
        found: list[Tree] = [] if "displacement" in kinds else [{"type": "displacement"}]
        for name in kinds:
            written: Tree = {"type": name}
            if name in FORCED:
                written |= modulus
            if name in FORCED[:4] and thickness:
                written["thickness"] = 1.0
            if name in ("strain", "stress") and self.has("diagnostics.measure: green-lagrange"):
                written["measure"] = "green-lagrange"
            if name == "track":
                written["numbers"] = [self.at(0.3, 0.8), self.at(0.9, 0.2)]
            if name == "stress-strain":
                written |= self.stress_strain()
            found.append(written)
        return found

    def stress_strain(self) -> Tree:
        written: Tree = {"width": 3.7}
        written |= {"axis": "y"} if self.has("diagnostics.axis: y") else {}
        written |= {"group": 0} if self.has("diagnostics.group") else {}
        written |= {"against": 1} if self.has("diagnostics.against") else {}
        by_leaders = not self.has("diagnostics.axis: y")
        by_leaders &= self.has("diagnostics.group") == self.has("diagnostics.against")
        by_leaders |= self.has("diagnostics.numbers")
        # The middle of the gauge is below those of the edges, which are pulled along y.
        gauge = [self.at(0.2, 0.1), self.at(0.8, 0.3)]
        written |= {"points": gauge} if self.has("diagnostics.points") or not by_leaders else {}
        written |= {"numbers": gauge} if self.has("diagnostics.numbers") else {}
        return written


LARGEST = 26
"""Number of features at which a scene is no longer extended."""


def covering(seed: int = 0, tries: int = 4) -> Iterator[Features]:
    """Sets of features in which every pair meets that is not refused, found greedily."""
    draw, names = random.Random(f"covering {seed}"), sorted(FEATURES)
    index = {name: n for n, name in enumerate(names)}
    refused, size = refused_pairs(), len(names)
    forbidden = [0] * size
    left = [0] * size
    for a, b in combinations(names, 2):
        i, j, pair = index[a], index[b], frozenset((a, b))
        if pair not in PAIRS or pair in refused:
            forbidden[i] |= 1 << j
            forbidden[j] |= 1 << i
        else:
            left[i] |= 1 << j
            left[j] |= 1 << i
    while any(left):
        first = max(range(size), key=lambda n: left[n].bit_count())
        second = (left[first] & -left[first]).bit_length() - 1
        best: Features = frozenset()
        most = -1
        for _ in range(tries):
            found = _grown({names[first], names[second]}, names, index, left, forbidden, draw)
            bits = sum(1 << index[name] for name in found)
            gain = sum((left[index[name]] & bits).bit_count() for name in found)
            if gain > most:
                best, most = found, gain
        bits = sum(1 << index[name] for name in best)
        for name in best:
            left[index[name]] &= ~bits
        assert not left[first] >> second & 1, (names[first], names[second], sorted(best))
        yield best


def _grown(
    start: set[str],
    names: list[str],
    index: dict[str, int],
    left: list[int],
    forbidden: list[int],
    draw: random.Random,
) -> Features:
    """A pair, and others that meet most of what has not met."""
    found = set(completed(start, draw))
    bits = sum(1 << index[name] for name in found)
    tried = bits
    while len(found) < LARGEST:
        candidates = [
            (-(left[n] & bits).bit_count(), draw.random(), n)
            for n in range(len(names))
            if not tried >> n & 1 and not forbidden[n] & bits and left[n] & bits
        ]
        if not candidates:
            break
        n = min(candidates)[2]
        tried |= 1 << n
        wider = set(completed({*found, names[n]}))
        wide = sum(1 << index[name] for name in wider)
        if any(forbidden[index[name]] & wide for name in wider) or not fits(frozenset(wider)):
            continue
        found, bits = wider, wide
        tried |= bits
    return frozenset(found)


def refusing(pair: Iterable[str]) -> str | None:
    """Return the message with which a pair is refused; None if it is not."""
    try:
        scene = build_scene(experiment_from(experiment_of(pair)))
        if {*pair} & {*AUTO} or not scene.experiment.solver.makes_steps:
            pbdkit.run(scene.experiment, progress=False)
    except pbdkit.ExperimentError as error:
        return str(error)
    return None
