"""Properties, and the subject to which they are applied.

A subject is a component in small scenes, on every lattice with every neighbourhood, and contains
calls of its functions. A `FunctionCall` contains its arguments, so that the call can be repeated
with changed ones. Arguments and results are trees of arrays and numbers in vectors, tuples, lists
and dicts; results can also contain dataclasses.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, is_dataclass
from functools import cached_property, partial, singledispatch
from itertools import product
from typing import Any

import numpy as np
from pydantic import ValidationError

from pbdkit.errors import ExperimentError, PluginError
from pbdkit.model.experiment import Experiment
from pbdkit.plugin import (
    INTERFACES,
    LISTS,
    CellStress,
    Component,
    Diagnostic,
    Draws,
    FollowerRule,
    FractureModel,
    FramePolicy,
    Here,
    Lattice,
    Loadable,
    NeighbourMetric,
    ParticleOperation,
    RenewsBonds,
    RenewsParticles,
    Softens,
    SoftensCells,
    UsesAngles,
    UsesStiffness,
    Vector,
)
from pbdkit.plugin.component import as_vector
from pbdkit.plugin.discovery import interface_of
from pbdkit.plugin.rule import material_of, shares_particles
from pbdkit.plugin.units import is_needed
from pbdkit.scene.frame import sites_of_frame
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.seeds import component_generator
from pbdkit.stepping.rule_evaluation import Evaluator
from pbdkit.testing.mechanics import Solid, solids_of
from pbdkit.testing.states import (
    SEED,
    SHAPE,
    Shown,
    applied,
    differences,
    frame_showing,
    gathered,
    here,
    here_of,
    measured_by,
    moment_of,
    owners,
    paired,
    remembers,
    shared,
    stressed,
    totals,
)

Arrays = dict[str, Any]
"""Arrays and numbers by name: `d0.x`, `own1`."""


def flat(tree: Any, name: str = "") -> Arrays:
    """Return the arrays and numbers of a tree by name."""
    if isinstance(tree, Vector):
        parts = {f"{name}.{c}".lstrip("."): v for c, v in zip("xyz", tree, strict=False)}
    elif isinstance(tree, dict) or is_dataclass(tree):
        named = tree if isinstance(tree, dict) else vars(tree)
        parts = {f"{name}.{key}".lstrip("."): part for key, part in named.items()}
    elif isinstance(tree, (tuple, list)):
        parts = {f"{name}{n}": v for n, v in enumerate(tree)}
    else:
        return {name: tree}
    return {n: value for key, part in parts.items() for n, value in flat(part, key).items()}


def each(change: Callable[[Any], Any], tree: Any) -> Any:
    """Return the tree with a function applied to every array and number."""
    if isinstance(tree, Vector):
        return tree.each(change)
    if isinstance(tree, dict):
        return {name: each(change, part) for name, part in tree.items()}
    if isinstance(tree, (tuple, list)):
        return type(tree)(each(change, part) for part in tree)
    return change(tree)


@dataclass(frozen=True)
class FunctionCall:
    """A call of a function of a component.

    Parameters
    ----------
    function
        Name of the function in messages.
    inputs
        Arguments by name.
    compute
        Function of these arguments.
    elementwise
        Whether the arrays have one shape, with a value for each particle or bond.
    """

    function: str
    inputs: dict[str, Any]
    compute: Callable[..., Any]
    elementwise: bool = False

    def evaluate(self, change: Callable[[Any], Any] = np.array) -> Any:
        """Return the result for inputs that are copied, or changed by a function."""
        with np.errstate(all="ignore"):
            return self.compute(**each(change, self.inputs))

    def answer(self, change: Callable[[Any], Any] = np.array) -> Arrays:
        """Return copies of the arrays of the result by name."""
        return {name: np.array(value) for name, value in flat(self.evaluate(change)).items()}


@singledispatch
def calls_of(component: Component, scene: Scene, seed: int) -> list[FunctionCall]:
    """Return calls of all functions that the interface of a component defines."""
    raise TypeError(f"{type(component).__name__} does not implement an interface")


@calls_of.register
def _to_rule(rule: FollowerRule, scene: Scene, seed: int) -> list[FunctionCall]:
    """Return calls of `gather` and `apply`, also with r + d = 0 along every slot, and of
    `gather_pair`, `remember`, `force`, `loaded` and `draw` if the rule has them.
    """
    d, at, evaluator = differences(scene, seed), here(scene, seed), Evaluator(scene)
    inputs = {"d": d, "shared": shared(scene, at["own"])}
    gather = [FunctionCall("gather", inputs, partial(gathered, scene), elementwise=True)]
    if isinstance(rule, UsesAngles):
        gather.append(FunctionCall("gather_pair", {"d": d}, partial(paired, scene), True))
    for function in (gathered, paired):
        if len({len(flat(parts)) for parts in function(scene, each(np.array, d))}) > 1:
            return gather  # They cannot be summed, which another property reports.
    sums = totals(scene, each(np.array, d))
    total = each(lambda t: np.broadcast_to(t, SHAPE).copy(), sums)
    functions: dict[str, Callable[[Any, Here], Any]] = {"apply": evaluator.move}
    if isinstance(rule, RenewsParticles):
        functions["remember"] = evaluator.remember
    if material_of(rule) is not None:
        functions["force"] = evaluator.force

    def call(function: str) -> FunctionCall:
        def compute(total: Any, **to: Any) -> Any:
            return functions[function](total, here_of(scene, **to))

        return FunctionCall(function, {"total": total} | at, compute, elementwise=True)

    loads: list[FunctionCall] = []
    if isinstance(rule, Loadable) and material_of(rule) is not None:
        inputs = {"total": total, "load": here(scene, seed + 1)["u"]}
        loads.append(
            FunctionCall("loaded", inputs, partial(rule.loaded, p=scene.constants.rule), True)
        )
    slots = zip(d, scene.neighbourhood.slots[0], strict=True)
    meeting = {"d": [v.each(lambda x, r: np.full_like(x, -r), slot.rest) for v, slot in slots]}
    name = "apply with all neighbours at the position of the particle"

    def coincident_move(d: Any, **to: Any) -> Any:
        return applied(scene, totals(scene, d), **to)

    coincident = FunctionCall(name, meeting | at, coincident_move)
    return [*gather, *map(call, functions), *loads, coincident, *_to_draw(rule, scene)]


@calls_of.register
def _to_fracture_model(model: FractureModel, scene: Scene, seed: int) -> list[FunctionCall]:
    """Return calls of `breaks` and `fictitious`, and of `update`, `seen` and `draw`."""
    slots, evaluator = scene.neighbourhood.slots[0], Evaluator(scene)
    p, limits = scene.constants.fracture, scene.constants.limits

    def call(function: str, compute: Callable[..., Any], **inputs: Any) -> FunctionCall:
        """Return a call of a function that is evaluated for every slot, with the difference `d`
        along that slot if it takes one."""

        def along(d: Any = slots, **arguments: Any) -> Any:
            pairs = zip(d, slots, strict=True)
            return [compute(v, slot.rest, limits[slot], **arguments) for v, slot in pairs]

        return FunctionCall(function, inputs, along, elementwise=True)

    def fictitious(_: Any, r: Any, __: Any, u: Any) -> Any:
        return as_vector(model.fictitious(u, r, p), "fictitious", u)

    def seen(d: Any, r: Any, limits: Any, own: Any, lost: Any) -> Any:
        assert isinstance(model, Softens)
        c = scene.constants.of_bond(*limits, *own)
        return as_vector(model.seen(d, lost, r, c, p), "seen", lost)

    def update(d: Any, r: Any, limits: Any, own: Any, cells: Any) -> Any:
        return evaluator.update(d, r, limits, own, tuple(CellStress(*cell) for cell in cells))

    bonds = {"d": differences(scene, seed, share=2.0), "own": remembers(model, scene, seed)}
    u, lost = here(scene, seed)["u"], here(scene, seed + 3)["u"]
    calls = [
        call("breaks", evaluator.breaks, **bonds),
        call("fictitious", fictitious, u=u),
    ]
    if isinstance(model, RenewsBonds):
        calls.append(call("update", update, **bonds, cells=stressed(model, seed)))
    if isinstance(model, Softens):
        calls.append(call("seen", seen, **bonds, lost=lost))
    return [*calls, *_to_draw(model, scene)]


def _to_draw(part: Component, scene: Scene) -> list[FunctionCall]:
    if not isinstance(part, Draws):
        return []
    rows = owners(part, scene)

    def draw(**columns: Any) -> Any:
        return part.draw(type(rows)(**columns), component_generator(SEED, "fracture"))

    return [FunctionCall("draw", dict(vars(rows)), draw)]


@calls_of.register
def _to_frame(policy: FramePolicy, scene: Scene, _: int) -> list[FunctionCall]:
    sites = sites_of_frame(scene.raster, scene.experiment.rule)
    if sites is None:
        return []
    point, body = sites.nearest()

    def follow(**tables: Any) -> Any:
        return policy.follow(frame_showing(sites, **tables))

    return [FunctionCall("follow", {"site": sites.site, "point": point, "body": body}, follow)]


@calls_of.register
def _to_diagnostic(diagnostic: Diagnostic, scene: Scene, seed: int) -> list[FunctionCall]:
    moment = moment_of(scene, seed)

    def measure(**tables: Any) -> Any:
        measured = measured_by(diagnostic, Shown(moment, tables=tables))
        for variable in diagnostic.variables():
            values = np.asarray(measured[variable.name])
            sizes = dict(zip(variable.dims, values.shape, strict=False))
            if values.dtype.kind == "f" and sizes.get("particle") == len(moment.body):
                # NaN is permitted at frame points and outside the outline.
                allowed = np.isnan(values) & variable.is_recordable(values, moment.inside)
                measured[variable.name] = np.where(allowed, 0.0, values)
        return measured

    return [FunctionCall("measure", Shown(moment).tables, measure)]


@calls_of.register
def _to_operation(operation: ParticleOperation, scene: Scene, seed: int) -> list[FunctionCall]:
    operated = scene.operations[0]

    def displaced(u: Any, new: Any) -> Any:
        vector = operation.displacement(u, new, operated.parameters)
        return as_vector(vector, "displacement", u)

    inputs = {"u": here(scene, seed)["u"], "new": here(scene, seed + 1)["u"]}
    return [FunctionCall("displacement", inputs, displaced, elementwise=True)]


@calls_of.register
def _to_lattice(lattice: Lattice, _: Scene, __: int) -> list[FunctionCall]:
    return [FunctionCall("cell", {}, lattice.cell)]


@calls_of.register
def _to_metric(metric: NeighbourMetric, scene: Scene, _: int) -> list[FunctionCall]:
    cell = scene.experiment.lattice.cell()

    def shells() -> Any:
        return [metric.shells_around(cell, s) for s in range(len(cell.sites))]

    return [FunctionCall("shells_around", {}, shells)]


LATTICES: dict[str, dict[str, Any]] = {
    "square": {"type": "square", "a": 1.0},
    "rectangular": {"type": "rectangular", "a": 1.0, "b": 1.3},
    "centred-rectangular": {"type": "centred-rectangular", "a": 1.0, "b": 1.2},
    "hexagonal": {"type": "hexagonal", "a": 0.7},
    "oblique": {"type": "oblique", "a": 1.1, "b": 0.9, "angle": 65.0},
}
"""Lattices of the scenes."""
NEIGHBOURS: dict[str, dict[str, Any]] = {
    f"{name}-{shells}": {"type": name, "shells": shells}
    for name, shells in product(("coordination", "chebyshev"), (1, 2))
}
"""Neighbour metrics of the scenes."""
PARTNERS = ({"type": "barycentre"}, {"type": "distance-weighted"})
"""Rules with which lattices and neighbour metrics are tested: a linear and a nonlinear one."""
MEAN = {"type": "mean"}
"""Frame of the scenes."""
NATURAL = {"type": "natural"}
"""Frame with traction-free edges."""
ELASTIC = {"type": "elastic", "poisson_ratio": 0.3}
"""Rule with which frames with traction-free edges are tested."""
BODY = {"type": "grid", "columns": 6, "rows": 5}
"""Body of the scenes."""
PULLED = [
    {"select": {"edge": "left"}, "motion": {"type": "hold"}},
    {"select": {"edge": "right"}, "motion": {"type": "displace", "displacement": [0.3, 0.1]}},
]
"""Leaders of the scenes that diagnostics measure."""
LOADED = [
    {"select": {"edge": "top"}, "force": [0.02, 0.05]},
    {"select": {"edge": "right"}, "body_force": [0.01, -0.03], "from": 2},
]
"""Loads of the scenes for diagnostics of loads."""
CUTS = [{"from": [-2.0, 1.6], "to": [2.3, 1.6]}]
"""Cuts of the scenes for diagnostics of cracks."""
PRESSING = {
    "shape": {"half_plane": {"point": [0.0, -0.1], "normal": [0.0, 1.0]}},
    "motion": {"type": "displace", "displacement": [0.0, 0.3]},
}
"""Obstacle of the scenes for diagnostics of obstacles."""
TEARING = {"type": "threshold", "thresholds": [1.6]}
"""Fracture model of the scenes."""


def experiments_with(component: Component, parts: Mapping[str, Any]) -> Iterator[Experiment]:
    """Yield small experiments with a component.

    Rules, frames and fracture models are combined with each of the five lattices and each of four
    neighbourhoods. Lattices are combined with all of these neighbourhoods, and neighbour metrics
    with all of these lattices, each with two rules. Components that sum over cells are combined
    with frames or rules for cells.

    Parameters
    ----------
    component
        Component.
    parts
        Parts of the experiments, each one or a list, that replace the usual ones.
    """
    field = next(f for f, i in INTERFACES.items() if i is interface_of(type(component)))
    neighbours = list(NEIGHBOURS.values())
    base: dict[str, Any] = {"name": "conformance", "body": BODY, "steps": 6, **parts}
    if isinstance(component, Diagnostic):
        base |= {"leaders": PULLED, "fracture": parts.get("fracture", TEARING)}
        with suppress(Exception):  # Another property reports the failure.
            if any("obstacle" in v.dims for v in component.variables()):
                base |= {"obstacles": [PRESSING]}
        neighbours = [n for n in neighbours if n["shells"] == 1]  # The model has one threshold.
        needs = getattr(component, "needs", ())
        base |= {"loads": LOADED} if "loads" in needs else {}
        base |= {"cuts": CUTS} if "cracks" in needs else {}
    choices = {
        "lattice": list(LATTICES.values()),
        "neighbours": neighbours,
        "rule": _rules(component),
        "frame": _frames(component),
    }
    base[field] = [component] if field in LISTS else component
    for name in choices.keys() & base.keys():
        part = base[name]
        choices[name] = list(part) if isinstance(part, (list, tuple)) else [part]
    for choice in product(*choices.values()):
        yield Experiment(**base | dict(zip(choices, choice, strict=True)))


def _frames(component: Component) -> list[dict[str, Any]]:
    if shares_particles(component):
        return [{"type": "none"}]
    if isinstance(component, SoftensCells):
        return [NATURAL]
    return [MEAN, NATURAL] if getattr(component, "uses_cells", False) else [MEAN]


def _rules(component: Component) -> list[dict[str, Any]]:
    if isinstance(component, Diagnostic) and component.needs & {"material", "forces", "loads"}:
        return [ELASTIC]
    if isinstance(component, FramePolicy) and component.edges_are_free:
        return [ELASTIC]
    if isinstance(component, UsesStiffness):
        return [ELASTIC]
    return list(PARTNERS if isinstance(component, (Lattice, NeighbourMetric)) else PARTNERS[:1])


def place_of(experiment: Experiment) -> str:
    """Describe lattice and neighbourhood of an experiment for messages."""
    lattice, neighbours = experiment.lattice, experiment.neighbours
    shells = getattr(neighbours, "shells", None)
    around = f"{neighbours.type} neighbours" + (f" in {shells} shells" if shells else "")
    return f"on the {lattice.type} lattice with {around}"


class PropertyError(Exception):
    """A property does not hold; the text states the fault, and the remedy if there is one."""


class NotApplicableError(Exception):
    """A property does not apply to a component; the text is the reason."""


class Subject:
    """A component under test. Its scenes and calls are built once for all properties."""

    def __init__(self, component: Component, parts: Mapping[str, Any]) -> None:
        self.component: Any = component
        self.parts = parts

    @cached_property
    def scenes(self) -> list[Scene]:
        """Scenes with the component.

        Scenes that the component refuses by an ExperimentError are omitted.

        Raises
        ------
        PropertyError
            If the component refuses all scenes.
        """
        scenes: list[Scene] = []
        refusals: list[ExperimentError] = []
        for experiment in experiments_with(self.component, self.parts):
            try:
                scenes.append(build_scene(experiment))
            except ExperimentError as error:
                refusals.append(error)
        if not scenes:
            raise PropertyError(
                "the component is incompatible with every tested scene; the first error: "
                f"{refusals[0]}; give compatible components, `conformance(..., lattice=..., "
                "neighbours=...)`"
            )
        return scenes

    @cached_property
    def solids(self) -> list[Solid]:
        """Small solids in which the component is used.

        Raises
        ------
        NoSolidError
            If there are none.
        """
        every = {"lattice": [*LATTICES.values()], "neighbours": [*NEIGHBOURS.values()]}
        return solids_of(self.component, every | dict(self.parts))

    @property
    def scene(self) -> Scene:
        """First scene with the component."""
        return self.scenes[0]

    def calls(self, n: int = 0) -> list[FunctionCall]:
        """Return the calls of the functions of the component in its n-th scene, with seed n."""
        return calls_of(self.component, self.scenes[n], n % 1000)


Check = Callable[[Subject], None]


@dataclass(frozen=True)
class Property:
    """A property that every component of some interfaces has.

    Parameters
    ----------
    name : str
        Name, in lower case with hyphens.
    interfaces : tuple of type
        Interfaces of the components.
    check : callable
        Function that raises PropertyError if the property does not hold.
    is_needed : bool
        Whether later properties presuppose this one: if it fails they are skipped, so that a fault
        is reported once.
    """

    name: str
    interfaces: tuple[type[Component], ...]
    check: Check
    is_needed: bool = False

    @property
    def description(self) -> str:
        """The property in a sentence: the first paragraph of the check's docstring."""
        return " ".join((inspect.getdoc(self.check) or "").split("\n\n")[0].split())


def property_of(
    *interfaces: type[Component], is_needed: bool = False
) -> Callable[[Check], Property]:
    """Return a decorator that registers a check as a property of the given interfaces, by default
    of all interfaces.

    The name of the property is that of the function.
    """
    classes = interfaces or tuple(INTERFACES.values())

    def make(check: Check) -> Property:
        return Property(check.__name__.replace("_", "-"), classes, check, is_needed)

    return make


def examples_of(component: type[Component]) -> list[Component]:
    """Return examples of a component class.

    The first component has the first example of each parameter without default. Each further
    example of a parameter gives a further component, of which all other parameters are unchanged.

    Parameters
    ----------
    component : type
        Class of components.

    Returns
    -------
    list of Component
        Components with the examples of their fields, or their defaults.

    Raises
    ------
    PluginError
        If a parameter has neither default nor example, an example is refused, or the class lacks a
        method of its interface.
    """
    base: dict[str, Any] = {}
    variants: list[dict[str, Any]] = [{}]
    for name, field in component.model_fields.items():
        key, examples = field.alias or name, list(field.examples or [])
        if is_needed(field):
            if not examples:
                fault = f"{component.__name__}.{name} has neither a default nor an example"
                remedy = f"write `{name}: ... = Field(description=..., examples=[...])`"
                raise PluginError(f"{fault}: {remedy}")
            base[key] = examples.pop(0)
        variants += [{key: value} for value in examples]
    return [_made(component, base | variant) for variant in variants]


def _made(component: type[Component], parameters: dict[str, Any]) -> Component:
    try:
        return component.model_validate(parameters)
    except TypeError as error:  # An abstract method is missing.
        raise PluginError(f"{component.__name__} cannot be created: {error}") from None
    except ValidationError as error:
        fault = error.errors()[0]
        detail = f"{'.'.join(map(str, fault['loc'])) or 'the whole'}: {fault['msg']}"
        text = f"{component.__name__} rejects its examples {parameters}: {detail}"
        raise PluginError(text) from None


def full_name(component: Component) -> str:
    """Return interface and type of a component, with parameters that differ from their defaults."""
    dumped = component.model_dump(exclude_defaults=True, exclude={"type"}, mode="json")
    parameters = ", ".join(f"{k}={v}" for k, v in dumped.items())
    name = f"{interface_of(type(component)).__name__} {component.type}"
    return f"{name} ({parameters})" if parameters else name
