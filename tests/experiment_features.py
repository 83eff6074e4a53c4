"""Features of experiments, taken from the schema of experiments.

A feature is a component (`rule: elastic`), a value of an option other than its default
(`solver.precision: float32`), the use of an option (`leaders.axes`), or a form in which a number of
a part is given (`rule by region`). A component or an option that is added to pbdkit is a feature
from then on, because the schema contains it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator
from itertools import combinations
from typing import Any

import pbdkit
from pbdkit.model.schema import experiment_schema
from pbdkit.plugin import Component
from pbdkit.plugin.registry import Registry

Features = frozenset[str]
Pair = frozenset[str]
Tree = dict[str, Any]

LEFT_OUT = {
    "name": "names files only",
    "seed": "affects only what is drawn at random, which other features stand for",
    "solver.engine: gpu": "requires a GPU, on which tests/gpu_cases.py compares it with numpy",
    "leaders.clamped": "requires a rule with directions, which plugins alone provide",
    "rule from a file": "is read into values on a grid",
    "fracture from a file": "is read into values on a grid",
    "regions: grid": "is refused: a grid counts sites",
    "obstacles.motion: measured": "is refused: an obstacle is rigid",
    "obstacles.motion: newton": "is refused: an obstacle is rigid",
    "fracture.law": "points are those of any law: components/test_fracture_cohesive",
    "diagnostics: stress-intensity": "requires larger bodies: components/test_stress_intensity",
    "diagnostics.tips": "is an option of `stress-intensity`",
    "diagnostics.radius": "is an option of `stress-intensity`",
    "diagnostics: extensometer": "requires two particles: fitting/test_channels",
    "diagnostics: strain-gauge": "requires a place inside the body: fitting/test_channels",
    "diagnostics.direction": "is an option of `extensometer`",
    "diagnostics.angle": "is an option of `strain-gauge`",
    "solver.control: opening": "multiplies the whole load: equilibrium/test_branch",
    "solver.control: dissipation": "multiplies the whole load: equilibrium/test_branch",
    "solver.control.direction": "is an option of the control by an opening",
}
"""Features that are not combined with others, and the reason."""
MERGED = ("leaders.select.edge", "loads.select.edge")
"""Settings of which the values count as one, because they are each other's mirror images."""
WITHOUT_OPTIONS = ("body.of", "regions.of", "obstacles.motion", "obstacles.shape", "operations")
"""Parts of which only the types count; their options are those of the same class elsewhere."""
FORMS = {
    frozenset({"steps", "values"}): "in time",
    frozenset({"x", "y", "values"}): "on a grid",
    frozenset({"file", "variable"}): "from a file",
    frozenset({"mean", "scatter", "correlation_length", "drawn"}): "random",
}
"""Forms of numbers, by the keys with which they are written."""
LISTS = ("leaders", "loads", "obstacles", "diagnostics", "operations", "regions", "cuts")
"""Parts of which an experiment can have several, so that two kinds of them can meet."""
ALL = object()
"""Stands for every value that the schema permits."""


class Catalogue:
    """The features that experiments can have, with the built-in and the given components.

    Attributes
    ----------
    found
        All features of the schema.
    features
        Those that are not left out.
    owners
        The components that have an option, by option.
    pairs
        Pairs of features that one experiment can name: not two values of one setting, and not an
        option together with a component that does not have it.
    """

    def __init__(self, components: Iterable[type[Component]] = ()) -> None:
        self._schema = experiment_schema(Registry(components), installed=False)
        self.owners: defaultdict[str, set[str]] = defaultdict(set)
        self._owner: list[str] = []
        self.found: Features = frozenset(self._part("", self._schema, ALL))
        self.features: Features = self.found - LEFT_OUT.keys()
        self.pairs: frozenset[Pair] = frozenset(
            frozenset(pair)
            for pair in combinations(sorted(self.features), 2)
            if self.can_be_named(*pair)
        )

    def of(self, experiment: pbdkit.Experiment) -> Features:
        """Return the features of an experiment."""
        dump = experiment.model_dump(mode="json", by_alias=True, warnings=False)
        return frozenset(self._part("", self._schema, dump)) & self.features

    def can_be_named(self, first: str, second: str) -> bool:
        """Return whether the schema permits both in one experiment."""
        components = [self.owners.get(feature) or {feature} for feature in (first, second)]
        return any(
            one == other or not _exclude(one, other)
            for one in components[0]
            for other in components[1]
        ) and (first == second or not _exclude(first, second))

    def _part(self, name: str, node: Tree, value: Any) -> Iterator[str]:
        """Yield the features of a value at a place; those of all values for `ALL`."""
        branches = [b for b in self._branches(node) if not b.get("deprecated")]
        for branch in branches:
            properties = branch.get("properties", {})
            kind = properties.get("type", {}).get("const")
            if form := FORMS.get(frozenset(properties)):
                feature = f"{name.partition('.')[0]} {form}"
                fits = value is ALL or (isinstance(value, dict) and {*value} <= {*properties})
                yield from self._noted(feature) if fits else ()
            elif kind is not None:
                if value is ALL or (isinstance(value, dict) and value.get("type") == kind):
                    yield from self._noted(f"{name}: {kind}")
                    self._owner.append(f"{name}: {kind}")
                    yield from self._options(name, branch, value)
                    self._owner.pop()
            elif properties:
                if value is ALL or (isinstance(value, dict) and {*value} <= {*properties}):
                    if len(branches) > 1 and name.endswith("shape"):
                        yield f"{name}: {next(iter(properties))}"
                    yield from self._options(name, branch, value)
            else:
                yield from self._items(name, branch, value)

    def _items(self, name: str, branch: Tree, value: Any) -> Iterator[str]:
        """Yield the features of the items of a list or map."""
        others, values = branch.get("additionalProperties"), value
        if branch.get("required") == ["otherwise"]:
            if value is ALL or (isinstance(value, dict) and "otherwise" in value):
                yield from self._noted(f"{name.partition('.')[0]} by region")
            return
        if isinstance(others, dict):
            values = list(value.values()) if isinstance(value, dict) else value
            items = [others]
        else:
            items = branch.get("prefixItems") or [branch["items"]] if "items" in branch else []
            items = branch.get("prefixItems", items)
        if value is ALL:
            for item in items:
                yield from self._part(name, item, ALL)
        elif isinstance(values, list) and items:
            for n, one in enumerate(values):
                yield from self._part(name, items[min(n, len(items) - 1)], one)

    def _options(self, name: str, branch: Tree, value: Any) -> Iterator[str]:
        required = {*branch.get("required", ())}
        required |= {key for way in branch.get("anyOf", ()) for key in way["required"]}
        for key, node in branch["properties"].items():
            place = f"{name}.{key}" if name else key
            default = node.get("default")
            given = ALL if value is ALL else value.get(key, default)
            if key == "type" or place in WITHOUT_OPTIONS[:2] or name in WITHOUT_OPTIONS:
                continue
            if given is None:
                continue
            yield from self._part(place, node, given)
            if given == default or key in required or "default" not in node:
                continue
            if place == "cuts" or place not in LISTS:
                yield from self._setting(place, node, given, default)

    def _setting(self, place: str, node: Tree, given: Any, default: Any) -> Iterator[str]:
        """Yield the feature of an option that is not a component."""
        branches = [b for b in self._branches(node) if b.get("type") != "null"]
        if any("type" in b.get("properties", {}) for b in branches):
            return
        words = {word for branch in branches for word in _words(branch)}
        if place in MERGED:
            yield place
            return
        for word in sorted(word for word in words if word != default):
            if given is ALL or given == word:
                yield from self._noted(f"{place}: {word}")
        is_plain = any(not _words(branch) for branch in branches)
        if is_plain and not _is_form(given) and not (isinstance(given, str) and given in words):
            yield from self._noted(place)

    def _noted(self, feature: str) -> Iterator[str]:
        """Yield a feature, and note the components that have it."""
        self.owners[feature] |= {*self._owner[-1:]}
        yield feature

    def _branches(self, node: Tree | bool) -> Iterator[Tree]:
        """Yield the alternatives of a schema."""
        if not isinstance(node, dict):
            return  # no component is registered
        if "$ref" in node:
            yield from self._branches(self._schema["$defs"][node["$ref"].rsplit("/", 1)[-1]])
        elif "properties" not in node and (choice := node.get("oneOf", node.get("anyOf"))):
            for one in choice:
                yield from self._branches(one)
        else:
            yield node


def _exclude(first: str, second: str) -> bool:
    """Return whether two features are different values of one setting."""
    setting = first.partition(": ")[0]
    is_one = setting == second.partition(": ")[0] and first != second
    return is_one and setting.partition(".")[0] not in LISTS


def _words(branch: Tree) -> list[str]:
    """Return the words that a schema permits."""
    return list(branch.get("enum") or ([branch["const"]] if "const" in branch else []))


def _is_form(value: Any) -> bool:
    """Return whether a value stands in the place of a number."""
    keys = {*value} if isinstance(value, dict) else set()
    return "otherwise" in keys or any(keys and keys <= form for form in FORMS)
