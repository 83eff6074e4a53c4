"""Experiments in other units of length, at another place, mirrored or turned.

A `Change` maps places to `factor` · M x + `shift`, with a matrix M that exchanges or reverses axes.
`changed` writes the experiment that belongs to it, for all features of `crossed_scenes`, and
`differences` measures how far its results are from those of the first.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
from crossed_scenes import experiment_from, numbered, numbers_in, places_of
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Tree = dict[str, Any]
EDGES = {"left": (-1, 0), "right": (1, 0), "bottom": (0, -1), "top": (0, 1)}
KEEP = ((1, 0), (0, 1))
AXES = {
    "mirrored in x": ((-1, 0), (0, 1)),
    "mirrored in y": ((1, 0), (0, -1)),
    "axes swapped": ((0, 1), (1, 0)),
    "turned": ((0, -1), (1, 0)),
}


@dataclass(frozen=True)
class Change:
    """x becomes factor · M x + shift."""

    factor: float = 1.0
    shift: tuple[float, float] = (0.0, 0.0)
    axes: tuple[tuple[int, int], tuple[int, int]] = KEEP

    @property
    def matrix(self) -> Floats:
        return np.array(self.axes, float)

    @property
    def swaps(self) -> bool:
        """Return whether x becomes y."""
        return self.axes[0][0] == 0

    def place(self, x: Any) -> list[float]:
        return (self.vector(x) + np.array(self.shift)).tolist()

    def rotated(self, v: Any) -> list[float]:
        return self.vector(v).tolist()

    def vector(self, v: Any) -> Floats:
        """factor · M v, of one vector or of rows."""
        return np.asarray(self.factor * (np.asarray(v, float) @ self.matrix.T))

    def turned(self, v: Any) -> list[float]:
        return (np.asarray(v, float) @ self.matrix.T).tolist()

    def axis(self, name: str) -> str:
        return "yx"["xy".index(name)] if self.swaps else name

    def reverses(self, name: str) -> bool:
        """Return whether the positive direction of the axis becomes negative."""
        return bool(self.matrix[:, "xy".index(name)].sum() < 0)


def applies_to(change: Change, experiment: Tree) -> bool:
    """Return whether the lattice, and what is drawn in an order, has a counterpart."""
    if change.axes == KEEP:
        return True
    if "scatter" in experiment.get("fracture", {}):
        return False  # strengths are drawn in the order of the bonds
    if experiment.get("initial", {}).get("type") == "noise":
        return False  # displacements are drawn in the order of the particles
    if any(one["type"] == "wind" for one in experiment.get("operations", ())):
        return False  # it blows along x
    kind, body = experiment["lattice"]["type"], experiment["body"]
    bodies = [body, *experiment.get("regions", {}).values()]
    if experiment["frame"]["type"] == "first" and body["type"] not in ("grid", "rectangle"):
        return False  # of several nearest particles, the one with the lowest number is copied
    if kind in ("oblique", "centred-rectangular"):
        return False
    if change.swaps and any(one["type"] == "dogbone" for one in bodies):
        return False  # it extends along x
    if kind != "hexagonal":
        return True
    odd = body["type"] != "grid" or body["rows"] % 2 == 1
    return change.axes == AXES["mirrored in y"] and odd


def changed(experiment: Tree, change: Change) -> Tree:
    """The experiment that belongs to the change."""
    return _Changed(experiment, change).experiment()


class _Changed:
    def __init__(self, experiment: Tree, change: Change) -> None:
        self.given, self.change = copy.deepcopy(experiment), change

    def experiment(self) -> Tree:
        given, change = self.given, self.change
        validated = experiment_from(given)
        fields = validated.rule.in_place_of_numbers()
        if numbers_in(given):
            places = places_of(given)
            for holder in numbers_in(given):
                holder["numbers"] = [places[number] for number in holder["numbers"]]
        found = given | {
            "lattice": self.lattice(),
            "body": self.body(given["body"]),
            "rule": self.rule(given["rule"], fields),
            "leaders": [self.driven(one) for one in given["leaders"]],
            "loads": [self.load(one) for one in given.get("loads", [])],
            "obstacles": [self.driven(one) for one in given.get("obstacles", [])],
            "neighbours": self.neighbours(given["neighbours"]),
        }
        for key in ("cuts",):
            found[key] = [
                one | {"from": change.place(one["from"]), "to": change.place(one["to"])}
                for one in given.get(key, [])
            ]
        if "regions" in given:
            found["regions"] = {n: self.body(one) for n, one in given["regions"].items()}
        if "fracture" in given:
            fields = validated.fracture.in_place_of_numbers()
            found["fracture"] = self.fracture(given["fracture"], fields)
        if given.get("initial", {}).get("type", "reference") != "reference":
            found["initial"] = self.initial(given["initial"])
        found["diagnostics"] = [self.diagnostic(one) for one in given["diagnostics"]]
        if "operations" in given:
            found["operations"] = [self.operation(one) for one in given["operations"]]
        return numbered(found)

    def initial(self, initial: Tree) -> Tree:
        change, found = self.change, dict(initial)
        if "amplitude" in initial:
            found["amplitude"] = change.factor * initial["amplitude"]
        if "gradient" in initial:
            M = change.matrix
            gradient = M @ np.array(initial["gradient"]) @ M.T
            shift = change.vector(initial.get("shift", (0.0, 0.0))) - gradient @ change.shift
            found |= {"gradient": gradient.tolist(), "shift": shift.tolist()}
        return found

    def diagnostic(self, diagnostic: Tree) -> Tree:
        change, found = self.change, dict(diagnostic)
        if diagnostic["type"] == "stress-strain":
            found["width"] = change.factor * diagnostic["width"]
            found["axis"] = change.axis(diagnostic.get("axis", "x"))
        if "numbers" in diagnostic:
            found["numbers"] = [change.place(x) for x in diagnostic["numbers"]]
        if "points" in diagnostic:
            found["points"] = [change.place(x) for x in diagnostic["points"]]
        return found

    def operation(self, operation: Tree) -> Tree:
        if operation["type"] != "wind":
            return operation
        return operation | {"speed": self.change.factor * operation["speed"]}

    def lattice(self) -> Tree:
        lattice, change = self.given["lattice"], self.change
        sides = [lattice["a"], lattice.get("b", lattice["a"])]
        if change.swaps:
            sides.reverse()
        found = lattice | {"a": change.factor * sides[0]}
        if "b" in lattice:
            found["b"] = change.factor * sides[1]
        corners = np.array([lattice["origin"]])
        if self.given["body"]["type"] == "grid":
            body = self.given["body"]
            rise = lattice["a"] * 0.75**0.5 if lattice["type"] == "hexagonal" else None
            step = np.array([lattice["a"], rise or lattice.get("b", lattice["a"])])
            far = corners[0] + step * [body["columns"] - 1, body["rows"] - 1]
            corners = np.array([corners[0], far])
        mapped = np.array([change.place(one) for one in corners])
        return found | {"origin": mapped.min(axis=0).tolist()}

    def body(self, body: Tree) -> Tree:
        change = self.change
        if body["type"] == "grid":
            names = ["columns", "rows"]
            sizes = [body[n] for n in (reversed(names) if change.swaps else names)]
            return body | dict(zip(names, sizes, strict=True))
        if body["type"] == "rectangle":
            low = np.array(body["origin"])
            ends = [
                change.place(low),
                change.place(low + np.array([body["width"], body["height"]])),
            ]
            low, high = np.min(ends, axis=0), np.max(ends, axis=0)
            sizes = {"width": float(high[0] - low[0]), "height": float(high[1] - low[1])}
            if not change.swaps:  # no rounding by places
                sizes = {n: change.factor * body[n] for n in ("width", "height")}
            return body | sizes | {"origin": low.tolist()}
        if body["type"] in ("union", "difference", "intersection"):
            return body | {"of": [self.body(one) for one in body["of"]]}
        if body["type"] in ("disc", "ring"):
            radii = {n: change.factor * body[n] for n in ("radius", "inner", "outer") if n in body}
            return body | radii | {"centre": change.place(body["centre"])}
        if body["type"] == "polygon":
            return body | {"vertices": [change.place(x) for x in body["vertices"]]}
        if body["type"] == "dogbone":
            low = np.array(body["origin"])
            ends = [
                change.place(low),
                change.place(low + np.array([body["length"], body["width"]])),
            ]
            names = ("length", "width", "gauge_length", "gauge_width", "radius")
            sizes = {n: change.factor * body[n] for n in names}
            return body | sizes | {"origin": np.min(ends, axis=0).tolist()}
        raise NotImplementedError(body["type"])

    def neighbours(self, near: Tree) -> Tree:
        if near["type"] != "euclidean":
            return near
        found = near | {"radius": self.change.factor * near["radius"]}
        if "weights" in near and self.change.swaps:
            found["weights"] = near["weights"][::-1]
        return found

    def rule(self, rule: Tree, fields: Tree) -> Tree:
        change, found = self.change, dict(rule)
        for name, value in fields.items():
            found[name] = self.field(rule[name], value)
        if "length" in rule:
            found["length"] = change.factor * rule["length"]
        if rule["type"] == "mixed-coordinate":
            sign = -1.0 if change.reverses(rule.get("axis", "x")) else 1.0
            found["axis"] = change.axis(rule.get("axis", "x"))
            found["K"] = scaled(found["K"], sign / change.factor)
        if rule["type"] == "orthotropic" and change.swaps:
            ratio = rule["modulus_ratio"]
            found["stiffness"] = scaled(found.get("stiffness", 1.0), ratio)
            found["modulus_ratio"] = 1.0 / ratio
            found["shear_ratio"] = rule["shear_ratio"] / ratio
            found["poisson_ratio"] = scaled(found["poisson_ratio"], ratio)
        return found

    def field(self, asked: Any, value: Any) -> Any:
        """Return the replacement of a number; random fields are as they were drawn, unless lengths
        alone change."""
        change = self.change
        is_drawn = "correlation_length" in asked
        if not is_drawn and {*asked} != {"x", "y", "values"}:
            return asked
        if is_drawn and change.axes == KEEP and change.shift == (0.0, 0.0):
            return asked | {"correlation_length": change.factor * asked["correlation_length"]}
        drawn = value["drawn"] if is_drawn else value
        values, sides = np.array(drawn["values"], float), [drawn["x"], drawn["y"]]
        table = values  # (x, y)
        if change.swaps:
            table, sides = table.T, sides[::-1]
        places = []
        for n, side in enumerate(sides):
            sign = change.matrix[n].sum()
            place = change.factor * sign * np.array(side) + change.shift[n]
            if sign < 0:
                place, table = place[::-1], np.flip(table, n)
            places.append(place.tolist())
        return {"x": places[0], "y": places[1], "values": table.tolist()}

    def fracture(self, fracture: Tree, fields: Tree) -> Tree:
        change, found = self.change, dict(fracture)
        for name, value in fields.items():
            found[name] = self.field(fracture[name], value)
        if "thresholds" in fracture:
            found["thresholds"] = [scaled(one, change.factor) for one in fracture["thresholds"]]
        if "energy" in fracture:
            found["energy"] = scaled(found["energy"], change.factor)
        if "cracks" in fracture:
            found["cracks"] = [[change.place(x) for x in crack] for crack in fracture["cracks"]]
        return found

    def driven(self, group: Tree) -> Tree:
        change, found = self.change, dict(group)
        if "select" in group:
            found["select"] = self.select(group["select"])
        if "motion" in group:
            found["motion"] = self.motion(group["motion"])
        if "axes" in group:
            found["axes"] = [change.axis(name) for name in group["axes"]]
        if "shape" in group:
            found["shape"] = self.shape(group["shape"])
        return found

    def shape(self, shape: Tree) -> Tree:
        if "half_plane" not in shape:
            return self.body(shape)
        plane = shape["half_plane"]
        return {
            "half_plane": {
                "point": self.change.place(plane["point"]),
                "normal": self.change.turned(plane["normal"]),
            }
        }

    def select(self, select: Tree) -> Tree:
        change = self.change
        if "edge" in select:
            outward = tuple(change.turned(EDGES[select["edge"]]))
            return {"edge": next(name for name, way in EDGES.items() if way == outward)}
        if "box" in select:
            ends = np.array(select["box"]).reshape(2, 2)
            mapped = np.array([change.place(x) for x in ends])
            return {"box": [*mapped.min(axis=0).tolist(), *mapped.max(axis=0).tolist()]}
        if "nearest" in select:
            return {"nearest": [change.place(x) for x in select["nearest"]]}
        if "numbers" in select:
            return {"numbers": [change.place(x) for x in select["numbers"]]}
        return select

    def motion(self, motion: Tree) -> Tree:
        change, found = self.change, dict(motion)
        for name in ("displacement", "velocity", "amplitude"):
            if name in motion:
                found[name] = change.rotated(motion[name])
        if "force" in motion:
            found["force"] = self.force(motion["force"], change.factor)
        if "displacements" in motion:
            found["displacements"] = [change.rotated(v) for v in motion["displacements"]]
        if "points" in motion:
            found["points"] = [change.place(x) for x in motion["points"]]
        if motion["type"] == "rotation":
            sense = round(float(np.linalg.det(change.matrix)))
            found |= {"centre": change.place(motion["centre"]), "angle": sense * motion["angle"]}
        return found

    def load(self, load: Tree) -> Tree:
        found = load | {"select": self.select(load["select"])}
        if "force" in load:
            found["force"] = self.force(load["force"], self.change.factor)
        if "body_force" in load:
            found["body_force"] = self.force(load["body_force"], 1.0 / self.change.factor)
        return found

    def force(self, force: Any, factor: float) -> list[Any]:
        """Return factor · M f, of which components can depend on time."""
        sources = [int(np.flatnonzero(row)[0]) for row in self.change.matrix]
        signs = self.change.matrix.sum(axis=1).tolist()
        return [scaled(force[k], sign * factor) for k, sign in zip(sources, signs, strict=True)]


def scaled(number: Any, factor: float) -> Any:
    """A number, or what stands in its place, times a factor."""
    if isinstance(number, dict):
        kept = ("steps", "x", "y", "scatter", "correlation_length")
        return {k: v if k in kept else scaled(v, factor) for k, v in number.items()}
    if isinstance(number, list):
        return [scaled(one, factor) for one in number]
    return factor * number


POWERS = {
    "u": 1,
    "track": 1,
    "reaction": 1,
    "contact_force": 1,
    "contact": 1,
    "load_resultant": 1,
    "load_displacement": 1,
    "strain_energy": 2,
    "pe1": 2,
    "pe1_intact": 2,
    "pe2": 1,
    "rotation": 0,
    "broken_bonds": 0,
    "smallest_cell_area": 0,
    "nominal_stress": 0,
    "nominal_strain": 0,
    "crack_step": 0,
    "crack_strain": 0,
}
"""The compared quantities, and their powers of length. Vectors turn with the axes."""
TENSORS = ("strain", "green_lagrange", "stress", "piola_kirchhoff")
"""Tensors in the plane, with variables for components and invariants."""
PARTS = ("xx", "yy", "xy", "von_mises", "principal")
"""Components and invariants of tensors, which are variables."""


SMALL = {0: 1e-2, 1: 1e-2, 2: 1e-4}
"""Below these, times their powers of the factor, values are those of a body at rest: leaders go
some hundredths of a spacing."""


def differences(first: Any, second: Any, change: Change) -> dict[str, float]:
    """Return the differences of the variables of two datasets, relative to their largest values;
    bonds that broke in one alone, and steps that only one has, as counts."""
    found: dict[str, float] = {"steps": float(abs(first.sizes["time"] - second.sizes["time"]))}
    if found["steps"]:
        return found
    order = _images(first, second, change)
    for name in sorted({*first.data_vars} & {*second.data_vars}):
        source, sign, power = _counterpart(str(name), change)
        if power is None:
            continue
        one, other = first[source].values.astype(float), second[name].values.astype(float)
        one, other = (_comparable(name, ds, v) for ds, v in ((first, one), (second, other)))
        if one.shape != other.shape:
            found[str(name)] = float("inf")
            continue
        if "particle" in first[name].dims:
            other = other[:, order]
        if "axis" in first[name].dims:
            one = one @ change.matrix.T
        least = SMALL[power] * change.factor**power
        expected = sign * one * change.factor**power
        size = max(np.nanmax(np.abs(expected), initial=0.0), least)
        if name == "track" and second[name].dtype == np.float32:
            # Positions in single precision are rounded relative to the distance from the origin.
            size = max(size, float(np.abs(second[name]).max()))
        found[str(name)] = float(np.nanmax(np.abs(other - expected), initial=0.0) / size)
        found[str(name)] += float((np.isnan(other) != np.isnan(expected)).sum())
    if "broken_step" in first:
        one, other = _broken(first, np.arange(len(order))), _broken(second, np.argsort(order))
        found["broken bonds"] = float(len(one ^ other))
    return found


def _counterpart(name: str, change: Change) -> tuple[str, float, int | None]:
    """Return the variable of the first dataset that corresponds to one of the second, its sign, and
    the power of length; None if it is not compared."""
    tensor = next((t for t in TENSORS if name.removeprefix(f"{t}_") in PARTS), None)
    turns = float(round(np.linalg.det(change.matrix)))
    if tensor:
        part = name.removeprefix(f"{tensor}_")
        if change.swaps and part in ("xx", "yy"):
            part = {"xx": "yy", "yy": "xx"}[part]
        # M = [[a, 0], [0, b]] or [[0, a], [b, 0]] multiplies xy by a b.
        sign = float(change.matrix.sum(axis=1).prod()) if part == "xy" else 1.0
        return f"{tensor}_{part}", sign, 0
    return name, turns if name == "rotation" else 1.0, POWERS.get(name)


def _comparable(name: Any, dataset: Any, values: Floats) -> Floats:
    """Return values that do not depend on the place of the body or the order of bonds."""
    if name == "track":
        return values - values[:1]
    return np.sort(values) if str(name).startswith("crack_") else values


def _images(first: Any, second: Any, change: Change) -> NDArray[np.intp]:
    """The row in the second of each particle of the first."""
    one, other = (ds["reference"].values.astype(float) for ds in (first, second))
    expected = change.vector(one) + np.array(change.shift)
    spans = np.abs(other[None] - expected[:, None]).max(axis=2)
    nearest: NDArray[np.intp] = spans.argmin(axis=1)
    assert len(one) == len(other) == len(set(nearest.tolist())), "the bodies differ"
    return nearest


def _broken(ds: Any, rows: NDArray[np.intp]) -> set[tuple[int, ...]]:
    """The bonds that are broken, by their particles in the first dataset, and when."""
    steps, ends = ds["broken_step"].values, ds["bond_ends"].values
    first_number = int(ds["number"].values.min())
    return {
        (*sorted(rows[np.asarray(pair) - first_number].tolist()), int(step))
        for pair, step in zip(ends, steps, strict=True)
        if step >= 0
    }
