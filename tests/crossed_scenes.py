"""Experiments in which the features of pbdkit meet: few and small, and any two that go together.

A feature is a word such as 'rule: elastic' or 'cuts'. `experiment_of` writes the experiment of a
set of them, with what they leave open drawn from a seed; `covering` chooses sets so that every pair
of features that is not refused (`REFUSALS`) meets in one of them.
"""

from __future__ import annotations

import random
from collections.abc import Iterable, Iterator
from itertools import combinations
from typing import Any

Features = frozenset[str]

CALIBRATED = ("elastic", "orthotropic", "springs", "strain-gradient")
AVERAGING = ("barycentre", "mean-displacement", "distance-weighted", "mixed-coordinate")
KINDS = {
    "rule": (*CALIBRATED, *AVERAGING),
    "frame": ("natural", "mean", "first", "none", "mirror"),
    "fracture": ("threshold", "strain", "damage", "cohesive"),
}
"""The features of which a scene has one, or at most one."""
OPTIONS = (
    "rule random field",
    "rule field by region",
    "rule number in time",
    "fracture field by region",
    "fracture number in time",
    "scatter",
    "cracks",
    "cuts",
    "loads",
    "body force",
    "obstacles",
    "rollers",
    "late group",
    "released group",
    "motion: measured",
    "motion: newton",
    "motion: rotation",
    "memory",
    "memory auto",
    "precision: float32",
    "reevaluate",
    "solver settle",
    "solver: equilibrium",
    "units",
)
FEATURES = (*(f"{part}: {name}" for part, names in KINDS.items() for name in names), *OPTIONS)
PAIRS = frozenset(
    frozenset(pair)
    for pair in combinations(FEATURES, 2)
    if len({name.split(": ")[0] for name in pair} & KINDS.keys()) == 2
    or not all(name.split(": ")[0] in KINDS for name in pair)
)
"""Features except those of two rules, two frames or two fracture models."""

FRACTURES = tuple(f"fracture: {name}" for name in KINDS["fracture"])
OF_FRACTURE = ("fracture field by region", "fracture number in time", "scatter", "cracks")
SOFTENING = ("fracture: damage", "fracture: cohesive")
UNCALIBRATED = tuple(f"rule: {name}" for name in AVERAGING)
NUMBERLESS = tuple(f"rule: {name}" for name in AVERAGING[:3])
FIELDS_OF_RULE = ("rule random field", "rule field by region", "rule number in time")
OF_STEPS = ("memory", "memory auto", "precision: float32", "solver settle")

UNITS = {"length": "0.25 mm", "youngs_modulus": "200 MPa", "thickness": "2 mm"}
NUMBERS = {
    "elastic": ("stiffness", "poisson_ratio"),
    "orthotropic": ("stiffness", "poisson_ratio"),
    "springs": ("stiffness",),
    "strain-gradient": ("stiffness", "poisson_ratio"),
    "mixed-coordinate": ("K",),
}
"""Parameters of rules that fields and time-dependent values can replace."""


ANEW = "reevaluate"
REFUSALS: tuple[tuple[tuple[str, ...], tuple[str, ...], str], ...] = (
    ((ANEW,), (*FRACTURES, *OF_FRACTURE), "bonds cannot break if neighbours are re-evaluated"),
    ((ANEW,), ("cuts",), "bonds cannot be cut if neighbours are re-evaluated"),
    (
        (ANEW,),
        ("loads", "body force"),
        "loads: loads require fixed neighbours; set neighbours.reeval",
    ),
    ((ANEW,), ("solver: equilibrium",), "an equilibrium is not defined if neighbours are"),
    ((ANEW,), ("solver settle",), "the distance from equilibrium has no bound if neighbours are"),
    ((ANEW,), FIELDS_OF_RULE[:2], "fixed neighbours for varying parameters; set"),
    (
        (ANEW,),
        ("frame: natural", "motion: newton", *(f"rule: {name}" for name in CALIBRATED)),
        "has weights for each slot, which re-evaluated neighbours do not have",
    ),
    (
        ("memory auto",),
        ("rule number in time", "fracture number in time"),
        "'auto' requires constant parameters, but some depend on time",
    ),
    (
        ("memory auto",),
        (ANEW,),
        "'auto' requires a spectrum, which does not exist if neighbours are",
    ),
    (
        UNCALIBRATED,
        ("loads", "body force"),
        r"loads: the rule '[a-z-]+' .* defines moves, but no forces",
    ),
    (
        UNCALIBRATED,
        ("motion: newton",),
        "leaders that move by Newton's law require forces, which '",
    ),
    (UNCALIBRATED, ("fracture: cohesive",), "'cohesive' requires a rule that is calibrated"),
    (
        ("fracture: cohesive",),
        ("frame: mean", "frame: first", "frame: none", "frame: mirror"),
        "'cohesive' softens the cells of the body, which the frame",
    ),
    (UNCALIBRATED, ("frame: natural",), "the rule '[a-z-]+' is not defined by cells; use a"),
    (NUMBERLESS, FIELDS_OF_RULE, "rule.stiffness: unknown key"),
    (("rule: strain-gradient",), FIELDS_OF_RULE[:2], "applies a rule to the moves of another"),
    (
        ("rule: strain-gradient",),
        (*FRACTURES, *OF_FRACTURE),
        "the moves of another, which is incompatible with this setting of fracture",
    ),
    (
        ("rule: strain-gradient",),
        ("cuts",),
        "which is incompatible with this setting of cuts; use cuts:",
    ),
    (
        ("fracture: threshold",),
        ("fracture field by region",),
        "fracture.failure: unknown key",
    ),
    (
        ("fracture: threshold", "fracture: cohesive"),
        ("scatter",),
        "fracture.scatter: unknown key",
    ),
    (
        ("scatter",),
        ("fracture field by region",),
        "draws a random number for each bond from its parameters; 'failure' must be a single",
    ),
    (
        ("scatter",),
        ("fracture number in time",),
        "so that it cannot depend on time; give a single number",
    ),
    (
        SOFTENING,
        ("solver settle",),
        "depends on the history, so that the distance from equilibrium has no bound",
    ),
    (("motion: newton",), ("solver settle", "solver: equilibrium"), "have no final position that"),
    (("solver: equilibrium",), OF_STEPS, r"solver\.[a-z]+: unknown key"),
)
"""Features of two groups of which no two can be combined, and the message of the refusal."""


def refusal_of(pair: Iterable[str]) -> str | None:
    """Return the message that refuses two features; None if they can be combined."""
    one, other = pair
    for first, second, words in REFUSALS:
        if (one in first and other in second) or (other in first and one in second):
            return words
    return None


def name_of(part: str, features: Features) -> str | None:
    """The rule, frame or fracture model among the features."""
    found = [f.split(": ")[1] for f in features if f.startswith(f"{part}: ")]
    return found[0] if found else None


def completed(features: Iterable[str]) -> Features:
    """With a rule and a frame that go with them, and a fracture model where a feature needs one."""
    all_of = frozenset(features)
    if name_of("fracture", all_of) is None and all_of & {*OF_FRACTURE}:
        both = {"fracture field by region", "fracture number in time"} <= all_of
        all_of |= {"fracture: damage" if both else "fracture: strain"}
    if name_of("rule", all_of) is None:
        all_of |= {_rule_for(all_of)}
    if name_of("frame", all_of) is None:
        natural = name_of("rule", all_of) in CALIBRATED and "reevaluate" not in all_of
        all_of |= {"frame: natural" if natural else "frame: mean"}
    return all_of


def placement_changes(features: Features) -> bool:
    """Return whether the one number left to change in time is the placement of fictitious points,
    which does not exist under rules of forces."""
    models = {"fracture: threshold"}
    if "fracture field by region" in features:
        models |= {"fracture: strain"}
    return "fracture number in time" in features and not models.isdisjoint(features)


def _rule_for(features: Features) -> str:
    if placement_changes(features):
        return "rule: barycentre"
    if "reevaluate" in features and not features & {"frame: natural", "motion: newton"}:
        return "rule: barycentre" if not features & {*FIELDS_OF_RULE} else "rule: mixed-coordinate"
    return "rule: elastic"


def experiment_of(features: Iterable[str], seed: int = 0) -> dict[str, Any]:
    """An experiment that has these features; the seed draws what they leave open."""
    return _Writer(completed(features), random.Random(f"scene {seed}")).experiment()


class _Writer:
    """Writes the experiment of a set of features."""

    def __init__(self, features: Features, draw: random.Random) -> None:
        self.features, self.draw = features, draw
        self.rule_name = name_of("rule", features)
        self.frame_name = name_of("frame", features)
        self.fracture_name = name_of("fracture", features)
        self.jumps = "solver: equilibrium" in features
        isotropic = self.rule_name in ("elastic", "springs", "strain-gradient", *AVERAGING)
        shapes = ["square", "square"]
        shapes += ["hexagonal"] * (isotropic and self.frame_name != "mirror")
        shapes += ["rectangular"] * (self.rule_name not in ("springs", "strain-gradient"))
        self.lattice_name = self.draw.choice(shapes)
        self.columns, self.rows = self.draw.choice([(6, 4), (7, 5), (5, 4), (8, 4)])
        self.height = {"square": 1.0, "rectangular": 1.25, "hexagonal": 0.75**0.5}[
            self.lattice_name
        ]
        self.outline: dict[str, Any] | None = None
        if self.frame_name == "natural" and self.draw.random() < 0.4:
            sides = {"width": self.columns - 0.6, "height": (self.rows - 1) * self.height + 0.3}
            self.outline = {"type": "rectangle", **sides, "origin": [0.3, -0.4]}
        self.amount = self.draw.choice([0.0613, 0.0471, 0.0837])
        """Displacement of the leaders, which breaks some of the bonds with low limits."""

    def has(self, *features: str) -> bool:
        return not self.features.isdisjoint(features)

    def experiment(self) -> dict[str, Any]:
        lattice: dict[str, Any] = {"type": self.lattice_name, "a": 1.0, "origin": [0.5, -0.25]}
        if self.lattice_name == "rectangular":
            lattice["b"] = self.height
        written = {
            "name": "crossed",
            "seed": self.draw.randrange(100),
            "lattice": lattice,
            "body": self.body(),
            "neighbours": self.neighbours(),
            "rule": self.rule(),
            "frame": {"type": self.frame_name},
            "leaders": self.leaders(),
            "steps": 8,
            "solver": self.solver(),
            "diagnostics": self.diagnostics(),
        }
        written |= {"units": UNITS} if self.has("units") else {}
        if self.fracture_name:
            written["fracture"] = self.fracture()
        if self.has("rule field by region", "fracture field by region"):
            written["regions"] = {"part": self.region()}
        if self.has("cuts"):
            x, y = self.at(0.45, 0.6)
            written["cuts"] = [{"from": [x, y - 9.0], "to": [x, y], "at": self.draw.choice([0, 2])}]
        if self.has("loads", "body force"):
            written["loads"] = self.loads()
        if self.has("obstacles"):
            written["obstacles"] = [self.obstacle()]
        return written

    def at(self, along: float, across: float) -> list[float]:
        """A point of the body's box, by shares of its sides, off the sites."""
        x, y = (self.columns - 1) * along, (self.rows - 1) * self.height * across
        return [round(x + 0.5123, 4), round(y - 0.2634, 4)]

    def body(self) -> dict[str, Any]:
        if self.outline:
            return self.outline
        return {"type": "grid", "columns": self.columns, "rows": self.rows}

    def region(self) -> dict[str, Any]:
        x, y = self.at(0.55, 0.35)
        return {"type": "rectangle", "width": 40.0, "height": 40.0, "origin": [x, y]}

    def neighbours(self) -> dict[str, Any]:
        if self.has("reevaluate"):
            return {"type": "euclidean", "radius": 1.73, "reevaluate": True}
        if self.rule_name in CALIBRATED and self.lattice_name != "hexagonal":
            return {"type": "chebyshev", "shells": 1}
        if self.lattice_name == "rectangular":
            return {"type": "coordination", "shells": 2}
        return {"type": "coordination", "shells": 1}

    def rule(self) -> dict[str, Any]:
        base: dict[str, dict[str, Any]] = {
            "elastic": {"poisson_ratio": self.draw.choice([0.2, 0.3, -0.2, 0.4])},
            "orthotropic": {"poisson_ratio": 0.2, "modulus_ratio": 0.5, "shear_ratio": 0.3},
            "strain-gradient": {"poisson_ratio": 0.2, "length": 0.4},
            "mixed-coordinate": {"K": -0.004, "axis": self.draw.choice(["x", "y"])},
        }
        written = {"type": self.rule_name} | base.get(str(self.rule_name), {})
        if self.rule_name == "elastic":
            written |= {"plane": self.draw.choice(["stress", "strain"])}
        names = list(NUMBERS.get(str(self.rule_name), ("stiffness",)))
        values = {"stiffness": 1.0, "poisson_ratio": 0.2, "K": -0.004}
        for feature in FIELDS_OF_RULE:
            if self.has(feature):
                name = names.pop(0) if names else "stiffness"
                written[name] = self.field(feature, values[name])
        return written

    def field(self, feature: str, value: float) -> dict[str, Any]:
        """Return the replacement of a number."""
        if feature.endswith("in time"):
            return {"steps": [0, 5], "values": [value, 0.75 * value]}
        if feature.endswith("by region"):
            return {"otherwise": value, "part": 0.75 * value}
        return {"mean": abs(value), "scatter": 0.2, "correlation_length": 2.0}

    def fracture(self) -> dict[str, Any]:
        limit = self.draw.choice([0.0317, 0.0173, 0.2, 0.0071])
        if self.jumps and self.has("loads", "body force", "obstacles"):
            limit = 0.6  # what comes off would be loaded, but not constrained
        base: dict[str | None, dict[str, Any]] = {
            "strain": {"failure": limit},
            "damage": {"onset": limit / 3, "failure": limit},
            "cohesive": {"onset": limit / 3, "energy": limit},
            "threshold": {"thresholds": [n * (1.0 + limit) for n in self.rests()]},
        }
        written = {"type": self.fracture_name} | base[self.fracture_name]
        number = {"damage": "failure", "cohesive": "energy"}.get(str(self.fracture_name), "failure")
        if self.has("fracture field by region"):
            value = written.get(number, limit)
            written[number] = {"otherwise": value, "part": 1.5 * value}
        if self.has("fracture number in time"):
            if placement_changes(self.features):
                written["placement"] = {"steps": [0, 5], "values": [1.0, 1.02]}
            elif self.has("fracture field by region"):
                written["onset"] = {"steps": [0, 5], "values": [limit / 3, limit / 4]}
            else:
                written[number] = {"steps": [0, 5], "values": [2 * limit, limit]}
        if self.has("scatter"):
            written["scatter"] = 0.2
        if self.has("cracks"):
            x, y = self.at(0.7, 0.55)
            written["cracks"] = [[[x, y], [x, y + 9.0]]]
        return written

    def rests(self) -> list[float]:
        """The longest rest length of each shell."""
        near, diagonal = self.neighbours(), (1.0 + self.height**2) ** 0.5
        if near["type"] == "euclidean":
            return sorted({1.0, self.height, diagonal})
        if near["type"] == "chebyshev":
            return [diagonal]
        if self.lattice_name == "rectangular":
            return [1.0, self.height]
        return [1.0]

    def leaders(self) -> list[dict[str, Any]]:
        left: dict[str, Any] = {"select": {"edge": "left"}, "motion": {"type": "hold"}}
        if self.has("motion: measured") and self.has("motion: rotation"):
            left["motion"] = self.rotation() | {"centre": self.at(0.0, 0.5)}
        right: dict[str, Any] = {"select": {"edge": "right"}, "motion": self.motion()}
        groups = [left, right]
        if self.has("rollers"):
            # Held at one corner besides, so that nothing is free to slide.
            left |= {"axes": ["x"]}
            groups.append({"select": {"nearest": [self.at(0.0, 0.0)]}, "motion": left["motion"]})
        if self.has("released group") and self.jumps:
            # A corner alone: what nothing holds any more has no equilibrium under obstacles.
            corner = {"select": {"nearest": [self.at(1.0, 1.0)]}, "motion": right["motion"]}
            right["select"] = {"nearest": [self.at(1.0, 0.0)]}
            groups.append(corner | {"until": 5})
        elif self.has("released group"):
            right["until"] = 5
        if self.has("late group"):
            late: dict[str, Any] = {"type": "displace", "displacement": [0.0, -self.amount / 2]}
            groups.append({"select": {"nearest": [self.at(0.5, 1.0)]}, "motion": late, "from": 3})
        if self.has("motion: newton"):
            mass = {"type": "newton", "mass": 9.0, "force": [0.003, -0.01], "damping": 0.5}
            groups.append({"select": {"nearest": [self.at(0.5, 0.0)]}, "motion": mass})
        return groups

    def motion(self) -> dict[str, Any]:
        way = [self.amount, round(self.amount / 3, 4)]
        if self.has("motion: rotation") and not self.has("motion: measured"):
            return self.rotation()
        if self.has("motion: measured"):
            corners = [self.at(x, y) for x in (0.7, 1.3) for y in (-0.6, 1.6)]
            moves = [[way[0], 0.01], [way[0], -0.02], [way[0], 0.01], [way[0], -0.02]]
            return {"type": "measured", "points": corners, "displacements": moves, "ramp": 2}
        if self.draw.random() < 0.5:
            return {"type": "displace", "displacement": way}
        return {"type": "velocity", "velocity": [way[0] / 4, way[1] / 4], "steps": 4}

    def rotation(self) -> dict[str, Any]:
        return {"type": "rotation", "centre": self.at(1.0, 0.5), "angle": 0.9, "steps": 4}

    def loads(self) -> list[dict[str, Any]]:
        force = [0.0011, -0.0023]
        found: list[dict[str, Any]] = []
        if self.has("loads"):
            found.append({"select": {"edge": "top"}, "force": force})
        if self.has("body force"):
            x, y = self.at(0.4, -0.1)
            box = [x, y, x + 40.0, y + 40.0]
            found.append({"select": {"box": box}, "body_force": [-0.0004, 0.0007], "from": 2})
        return found

    def obstacle(self) -> dict[str, Any]:
        x, y = self.at(0.5, 0.0)
        # Outlines have cells that are cut, with particles outside by up to a row.
        below = 0.11 if self.outline is None else 0.11 + self.height
        return {
            "shape": {"half_plane": {"point": [x, y - below], "normal": [0.0, 1.0]}},
            "motion": {"type": "displace", "displacement": [0.0, 0.1431]},
        }

    def solver(self) -> dict[str, Any]:
        relaxation = 0.07 if self.rule_name == "strain-gradient" else self.draw.choice([0.6, 0.8])
        written: dict[str, Any] = {"type": "stepping", "relaxation": relaxation}
        if self.jumps:
            written = {"type": "equilibrium", "increments": 4}
        written |= {"memory": 0.2} if self.has("memory") else {}
        if self.has("memory auto"):
            written |= {"memory": "auto"} | ({} if self.jumps else {"relaxation": "auto"})
        written |= {"precision": "float32"} if self.has("precision: float32") else {}
        written |= {"settle": {"tolerance": 1e-2}} if self.has("solver settle") else {}
        return written

    def diagnostics(self) -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = [{"type": "displacement"}]
        modulus = {} if self.has("units") else {"youngs_modulus": 1.0}
        if self.rule_name in CALIBRATED and not self.has("reevaluate"):
            found += [{"type": "strain-energy"} | modulus, {"type": "reaction"} | modulus]
            found += [{"type": "contact"} | modulus] if self.has("obstacles") else []
            if self.has("loads", "body force"):
                found.append({"type": "load-displacement"} | modulus)
        return found


def fits(features: Features) -> bool:
    """Return whether a scene can have all of them, besides what is refused in pairs."""
    complete = completed(features)
    for part in KINDS:
        if sum(f.startswith(f"{part}: ") for f in complete) > 1:
            return False
    if placement_changes(complete) and name_of("rule", complete) in CALIBRATED:
        return False
    numbers = NUMBERS.get(str(name_of("rule", complete)), ())
    if len(complete & {*FIELDS_OF_RULE}) > len(numbers):
        return False
    return all(refusal_of(pair) is None for pair in combinations(complete, 2))


LARGEST = 9
"""Number of features of a scene: with more, few laws hold."""


def covering(seed: int = 0, tries: int = 12) -> Iterator[Features]:
    """Sets of features in which every pair meets that is not refused, found greedily."""
    draw, names = random.Random(f"covering {seed}"), sorted(FEATURES)
    left = {pair for pair in PAIRS if refusal_of(pair) is None}
    while left:
        start = min(left, key=sorted)
        best = max((_grown(start, left, names, draw) for _ in range(tries)), key=_met(left))
        left -= {frozenset(pair) for pair in combinations(best, 2)}
        yield best


def _grown(start: Features, left: set[Features], names: list[str], draw: random.Random) -> Features:
    """A pair, and others that meet most of what has not met."""
    found = completed(start)
    assert fits(found), sorted(found)
    while len(found) < LARGEST:
        gains = {
            name: sum(frozenset((name, other)) in left for other in found)
            for name in names
            if name not in found
        }
        order = sorted(gains, key=lambda name: (-gains[name], draw.random()))
        chosen = next((n for n in order if gains[n] and fits(found | {n})), None)
        if chosen is None:
            break
        found |= {chosen}
    return found


def _met(left: set[Features]) -> Any:
    return lambda found: len(left & {frozenset(pair) for pair in combinations(found, 2)})
