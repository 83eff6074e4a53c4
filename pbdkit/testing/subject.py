"""Properties and their subject: one component in small scenes, of every lattice with every
neighbourhood, and the calls that are made of it.

A `Question` is one call whose arguments are kept, so that it is made again with other arguments.
Arguments and answers are trees: arrays and numbers in vectors, tuples, lists and dicts; answers
also in dataclasses.
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
    KnowsStiffness,
    Lattice,
    Loadable,
    NeighbourMetric,
    ParticleOperation,
    RenewsBonds,
    RenewsParticles,
    Softens,
    SoftensCells,
    Vector,
)
from pbdkit.plugin.component import as_vector
from pbdkit.plugin.discovery import interface_of
from pbdkit.plugin.rule import material_of, shares_particles
from pbdkit.plugin.units import is_needed
from pbdkit.scene.frame import sites_of_frame
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.stepping.rule_evaluation import Evaluator, summed
from pbdkit.stepping.state import generator_for
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
    measured_by,
    moment_of,
    owners,
    remembers,
    shared,
    standing,
    stressed,
)

Arrays = dict[str, Any]
"""Arrays and numbers by name: `d0.x`, `own1`."""


def flat(tree: Any, name: str = "") -> Arrays:
    """The arrays and numbers of a tree by name."""
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
    """The tree of what a function makes of every array and number."""
    if isinstance(tree, Vector):
        return tree.each(change)
    if isinstance(tree, dict):
        return {name: each(change, part) for name, part in tree.items()}
    if isinstance(tree, (tuple, list)):
        return type(tree)(each(change, part) for part in tree)
    return change(tree)


@dataclass(frozen=True)
class Question:
    """One call: `what` is called, with which inputs by name, and how.

    An `elementwise` one is asked with arrays of one shape, a value a particle or bond.
    """

    what: str
    inputs: dict[str, Any]
    ask: Callable[..., Any]
    elementwise: bool = False

    def asked(self, change: Callable[[Any], Any] = np.array) -> Any:
        """The answer as it comes, to inputs that are copied, or changed."""
        with np.errstate(all="ignore"):
            return self.ask(**each(change, self.inputs))

    def answer(self, change: Callable[[Any], Any] = np.array) -> Arrays:
        """The answer by name, as it was at that moment."""
        return {name: np.array(value) for name, value in flat(self.asked(change)).items()}


@singledispatch
def questions_of(component: Component, scene: Scene, seed: int) -> list[Question]:
    """Those that its interface allows."""
    raise TypeError(f"{type(component).__name__} is of no interface")


@questions_of.register
def _to_rule(rule: FollowerRule, scene: Scene, seed: int) -> list[Question]:
    """`gather` and `apply`, also where r + d = 0 along every slot; `remember`, `force`, `loaded`
    and `draw` where it has them."""
    d, at, evaluator = differences(scene, seed), here(scene, seed), Evaluator(scene)
    contributions = gathered(scene, each(np.array, d))
    given = {"d": d, "shared": shared(scene, at["own"])}
    gather = Question("gather", given, partial(gathered, scene), elementwise=True)
    if len({len(flat(parts)) for parts in contributions}) > 1:
        return [gather]  # they cannot be summed, which is found elsewhere
    sums = summed((c, None) for c in contributions)
    total = each(lambda t: np.broadcast_to(t, SHAPE).copy(), sums)
    asks: dict[str, Callable[[Any, Here], Any]] = {"apply": evaluator.move}
    if isinstance(rule, RenewsParticles):
        asks["remember"] = evaluator.remember
    if material_of(rule) is not None:
        asks["force"] = evaluator.force

    def question(what: str) -> Question:
        def ask(total: Any, **to: Any) -> Any:
            return asks[what](total, standing(scene, **to))

        return Question(what, {"total": total} | at, ask, elementwise=True)

    loads: list[Question] = []
    if isinstance(rule, Loadable) and material_of(rule) is not None:
        given = {"total": total, "load": here(scene, seed + 1)["u"]}
        loads.append(Question("loaded", given, partial(rule.loaded, p=scene.constants.rule), True))
    slots = zip(d, scene.neighbourhood.slots[0], strict=True)
    meeting = {"d": [v.each(lambda x, r: np.full_like(x, -r), slot.rest) for v, slot in slots]}
    what = "apply, where all neighbours meet in the particle,"
    met = Question(what, meeting | at, lambda d, **to: applied(scene, gathered(scene, d), **to))
    return [gather, *map(question, asks), *loads, met, *_to_draw(rule, scene)]


@questions_of.register
def _to_fracture_model(model: FractureModel, scene: Scene, seed: int) -> list[Question]:
    """`breaks` and `fictitious`; `update`, `seen` and `draw` where it has them."""
    slots, evaluator = scene.neighbourhood.slots[0], Evaluator(scene)
    p, limits = scene.constants.fracture, scene.constants.limits

    def question(what: str, ask: Callable[..., Any], **inputs: Any) -> Question:
        """One that is asked along every slot, with the difference along it where there are `d`."""

        def along(d: Any = slots, **given: Any) -> Any:
            return [ask(v, s.rest, limits[s], **given) for v, s in zip(d, slots, strict=True)]

        return Question(what, inputs, along, elementwise=True)

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
    questions = [
        question("breaks", evaluator.breaks, **bonds),
        question("fictitious", fictitious, u=u),
    ]
    if isinstance(model, RenewsBonds):
        questions.append(question("update", update, **bonds, cells=stressed(model, seed)))
    if isinstance(model, Softens):
        questions.append(question("seen", seen, **bonds, lost=lost))
    return [*questions, *_to_draw(model, scene)]


def _to_draw(part: Component, scene: Scene) -> list[Question]:
    if not isinstance(part, Draws):
        return []
    rows = owners(part, scene)

    def draw(**given: Any) -> Any:
        return part.draw(type(rows)(**given), generator_for(SEED, "fracture"))

    return [Question("draw", dict(vars(rows)), draw)]


@questions_of.register
def _to_frame(policy: FramePolicy, scene: Scene, _: int) -> list[Question]:
    sites = sites_of_frame(scene.raster, scene.experiment.rule)
    if sites is None:
        return []
    point, body = sites.nearest()

    def follow(**tables: Any) -> Any:
        return policy.follow(frame_showing(sites, **tables))

    return [Question("follow", {"site": sites.site, "point": point, "body": body}, follow)]


@questions_of.register
def _to_diagnostic(diagnostic: Diagnostic, scene: Scene, seed: int) -> list[Question]:
    moment = moment_of(scene, seed)

    def measure(**tables: Any) -> Any:
        found = measured_by(diagnostic, Shown(moment, tables=tables))
        for variable in diagnostic.variables():
            values = np.asarray(found[variable.name])
            sizes = dict(zip(variable.dims, values.shape, strict=False))
            if values.dtype.kind == "f" and sizes.get("particle") == len(moment.body):
                # NaN may stand at frame points, and beyond the outline.
                allowed = np.isnan(values) & variable.is_recordable(values, moment.inside)
                found[variable.name] = np.where(allowed, 0.0, values)
        return found

    return [Question("measure", Shown(moment).tables, measure)]


@questions_of.register
def _to_operation(operation: ParticleOperation, scene: Scene, seed: int) -> list[Question]:
    """`displacement`."""
    operated = scene.operations[0]

    def displaced(u: Any, new: Any) -> Any:
        found = operation.displacement(u, new, operated.parameters)
        return as_vector(found, "displacement", u)

    inputs = {"u": here(scene, seed)["u"], "new": here(scene, seed + 1)["u"]}
    return [Question("displacement", inputs, displaced, elementwise=True)]


@questions_of.register
def _to_lattice(lattice: Lattice, _: Scene, __: int) -> list[Question]:
    return [Question("cell", {}, lattice.cell)]


@questions_of.register
def _to_metric(metric: NeighbourMetric, scene: Scene, _: int) -> list[Question]:
    cell = scene.experiment.lattice.cell()

    def shells() -> Any:
        return [metric.shells_around(cell, s) for s in range(len(cell.sites))]

    return [Question("shells_around", {}, shells)]


LATTICES: dict[str, dict[str, Any]] = {
    "square": {"type": "square", "a": 1.0},
    "rectangular": {"type": "rectangular", "a": 1.0, "b": 1.3},
    "centred-rectangular": {"type": "centred-rectangular", "a": 1.0, "b": 1.2},
    "hexagonal": {"type": "hexagonal", "a": 0.7},
    "oblique": {"type": "oblique", "a": 1.1, "b": 0.9, "angle": 65.0},
}
NEIGHBOURS: dict[str, dict[str, Any]] = {
    f"{name}-{shells}": {"type": name, "shells": shells}
    for name, shells in product(("coordination", "chebyshev"), (1, 2))
}
PARTNERS = ({"type": "barycentre"}, {"type": "distance-weighted"})
"""The rules with which lattices and neighbours are tried: a linear one, and one that is not."""
MEAN, NATURAL = {"type": "mean"}, {"type": "natural"}
ELASTIC = {"type": "elastic", "poisson_ratio": 0.3}
"""The rule with which frames are tried whose edges are free of stress."""
BODY = {"type": "grid", "columns": 6, "rows": 5}
PULLED = [
    {"select": {"edge": "left"}, "motion": {"type": "hold"}},
    {"select": {"edge": "right"}, "motion": {"type": "displace", "displacement": [0.3, 0.1]}},
]
"""The leaders of the scenes that diagnostics measure."""
LOADED = [
    {"select": {"edge": "top"}, "force": [0.02, 0.05]},
    {"select": {"edge": "right"}, "body_force": [0.01, -0.03], "from": 2},
]
"""The loads of those that measure loads."""
PRESSING = {
    "shape": {"half_plane": {"point": [0.0, -0.1], "normal": [0.0, 1.0]}},
    "motion": {"type": "displace", "displacement": [0.0, 0.3]},
}
"""The obstacle of the scenes that diagnostics of obstacles measure."""
TEARING = {"type": "threshold", "thresholds": [1.6]}


def experiments_with(component: Component, parts: Mapping[str, Any]) -> Iterator[Experiment]:
    """Small experiments that a component takes part in; `parts`, each one or a list of them, stand
    in for those tried.

    Rules, frames and fracture models meet each of the five lattices with each of four
    neighbourhoods, lattices and neighbour metrics each of the other with two rules; what works cell
    by cell meets frames or rules that do.
    """
    field = next(f for f, i in INTERFACES.items() if i is interface_of(type(component)))
    neighbours = list(NEIGHBOURS.values())
    given: dict[str, Any] = {"name": "conformance", "body": BODY, "steps": 6, **parts}
    if isinstance(component, Diagnostic):
        given |= {"leaders": PULLED, "fracture": parts.get("fracture", TEARING)}
        with suppress(Exception):  # what fails is asked about directly, and named there
            if any("obstacle" in v.dims for v in component.variables()):
                given |= {"obstacles": [PRESSING]}
        neighbours = [n for n in neighbours if n["shells"] == 1]  # the model has one threshold
        given |= {"loads": LOADED} if "loads" in getattr(component, "needs", ()) else {}
    choices = {
        "lattice": list(LATTICES.values()),
        "neighbours": neighbours,
        "rule": _rules(component),
        "frame": _frames(component),
    }
    given[field] = [component] if field in LISTS else component
    for name in choices.keys() & given.keys():
        part = given[name]
        choices[name] = list(part) if isinstance(part, (list, tuple)) else [part]
    for choice in product(*choices.values()):
        yield Experiment(**given | dict(zip(choices, choice, strict=True)))


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
    if isinstance(component, KnowsStiffness):
        return [ELASTIC]
    return list(PARTNERS if isinstance(component, (Lattice, NeighbourMetric)) else PARTNERS[:1])


def place_of(experiment: Experiment) -> str:
    """Where something was found, for messages."""
    lattice, neighbours = experiment.lattice, experiment.neighbours
    shells = getattr(neighbours, "shells", None)
    around = f"{neighbours.type} neighbours" + (f" in {shells} shells" if shells else "")
    return f"on the {lattice.type} lattice with {around}"


class PropertyError(Exception):
    """A property does not hold; the text names the fault, and the remedy where there is one."""


class NotAskedError(Exception):
    """A property says nothing about this component; the text is the reason."""


class Subject:
    """One component; what is asked of it is made once and shared by the properties."""

    def __init__(self, component: Component, parts: Mapping[str, Any]) -> None:
        self.component: Any = component
        self.parts = parts

    @cached_property
    def scenes(self) -> list[Scene]:
        """The scenes that it takes part in; ExperimentErrors are its right to refuse.

        Raises PropertyError where it refuses all of them.
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
                f"no scene that was tried takes it; the first: {refusals[0]}; name the parts that "
                "go with it, `conformance(..., lattice=..., neighbours=...)`"
            )
        return scenes

    @cached_property
    def solids(self) -> list[Solid]:
        """The small solids that it takes part in. Raises NoSolidError without any."""
        every = {"lattice": [*LATTICES.values()], "neighbours": [*NEIGHBOURS.values()]}
        return solids_of(self.component, every | dict(self.parts))

    @property
    def scene(self) -> Scene:
        """The first of the scenes."""
        return self.scenes[0]

    def questions(self, n: int = 0) -> list[Question]:
        """What can be asked of the component directly, on its n-th scene and with seed n."""
        return questions_of(self.component, self.scenes[n], n % 1000)


Check = Callable[[Subject], None]


@dataclass(frozen=True)
class Property:
    """One thing that is asked of every component of some interfaces.

    Where one that `is_needed` does not hold, those after it are not judged: their answers would
    mean nothing, and a fault is reported once and by its own name.
    """

    name: str
    interfaces: tuple[type[Component], ...]
    check: Check
    is_needed: bool = False

    @property
    def asks(self) -> str:
        """What is asked, in one sentence: the first paragraph of the check's docstring."""
        return " ".join((inspect.getdoc(self.check) or "").split("\n\n")[0].split())


def asked_of(*interfaces: type[Component], is_needed: bool = False) -> Callable[[Check], Property]:
    """Makes a property of a check, asked of these interfaces, or of all; its name is that of the
    function."""
    asked = interfaces or tuple(INTERFACES.values())

    def make(check: Check) -> Property:
        return Property(check.__name__.replace("_", "-"), asked, check, is_needed)

    return make


def examples_of(component: type[Component]) -> list[Component]:
    """One with the first example of each parameter that has no default, and one for each further
    example, all else being the same.

    Raises PluginError where a parameter has neither default nor example, an example is refused, or
    the class lacks a method of its interface.
    """
    base: dict[str, Any] = {}
    others: list[dict[str, Any]] = [{}]
    for name, field in component.model_fields.items():
        key, examples = field.alias or name, list(field.examples or [])
        if is_needed(field):
            if not examples:
                fault = f"{component.__name__}.{name} has neither default nor example"
                remedy = f"write `{name}: ... = Field(description=..., examples=[...])`"
                raise PluginError(f"{fault}: {remedy}")
            base[key] = examples.pop(0)
        others += [{key: value} for value in examples]
    return [_made(component, base | other) for other in others]


def _made(component: type[Component], given: dict[str, Any]) -> Component:
    try:
        return component.model_validate(given)
    except TypeError as error:  # an abstract method is missing
        raise PluginError(f"{component.__name__} cannot be made: {error}") from None
    except ValidationError as error:
        fault = error.errors()[0]
        told = f"{'.'.join(map(str, fault['loc'])) or 'the whole'}: {fault['msg']}"
        raise PluginError(f"{component.__name__} refuses its examples {given}: {told}") from None


def full_name(component: Component) -> str:
    """Its interface and type, with the parameters that are not at their defaults."""
    dumped = component.model_dump(exclude_defaults=True, exclude={"type"}, mode="json")
    given = ", ".join(f"{k}={v}" for k, v in dumped.items())
    name = f"{interface_of(type(component)).__name__} {component.type}"
    return f"{name} ({given})" if given else name
