"""Properties of components by themselves: parameters, lattices, neighbour metrics, the scenes that
they take part in, and the answers of their functions.

Functions are called with whole arrays, single numbers and probes; their answers follow from their
arguments alone.
"""

from __future__ import annotations

import inspect
import json
import math
import pickle
import random
import re
import types
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from itertools import chain, combinations
from operator import methodcaller
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from pbdkit.errors import ExperimentError
from pbdkit.io.layout import reserved_names
from pbdkit.lattice.neighbourhood import build_neighbourhood, checked_cell
from pbdkit.plugin import (
    BreaksAtStrain,
    Cell,
    CellStress,
    Component,
    Diagnostic,
    Draws,
    FollowerRule,
    FractureModel,
    FrameMap,
    FramePolicy,
    Lattice,
    NeighbourMetric,
    Offset,
    ParticleOperation,
    Remembered,
    RenewsBonds,
)
from pbdkit.scene.constants import bond_numbers, remembered_names
from pbdkit.scene.frame import sites_of_frame
from pbdkit.scene.leader_groups import rotations_of
from pbdkit.scene.scene import Scene
from pbdkit.stepping.rule_evaluation import Evaluator
from pbdkit.testing.states import (
    SEED,
    SHAPE,
    Shown,
    applied,
    differences,
    frame_showing,
    gathered,
    here,
    moment_of,
    numbers_of,
    owners,
    remembers,
    stressed,
)
from pbdkit.testing.subject import (
    Arrays,
    NotAskedError,
    PropertyError,
    Question,
    Subject,
    asked_of,
    each,
    experiments_with,
    flat,
    place_of,
)

WORD = r"[a-z][a-z0-9]*(-[a-z0-9]+)*"


@asked_of()
def names_itself(subject: Subject) -> None:
    """Its `type` is one literal in lower case, words joined by hyphens, so that experiments name
    it, schemas tell it apart and `distribution:type` can be read."""
    component = type(subject.component)
    field, name = component.model_fields["type"], component.type_name()
    if not re.fullmatch(WORD, name):
        raise PropertyError(f"the type '{name}' is not in lower case with hyphens, as 'my-rule' is")
    if getattr(field.annotation, "__args__", None) != (name,):
        remedy = f'declare it as `type: Literal["{name}"] = "{name}"`'
        raise PropertyError(f"any other word passes as its type too: {remedy}")


@asked_of()
def is_documented(subject: Subject) -> None:
    """The class has a docstring and every parameter a description: the schema shows them, and with
    it every editor."""
    component = type(subject.component)
    if not (component.__dict__.get("__doc__") or "").strip():
        raise PropertyError(f"{component.__name__} has no docstring: say what it computes")
    for name, field in component.model_fields.items():
        if name != "type" and not (field.description or "").strip():
            remedy = f'`{name}: ... = Field(..., description="what it is, with units")`'
            raise PropertyError(f"the parameter `{name}` has no description: write {remedy}")


@asked_of()
def is_frozen(subject: Subject) -> None:
    """Its parameters cannot be set after it is made, and it can be hashed: the same component is
    shared by scenes and engines, and told from others by value."""
    component = subject.component
    for name in type(component).model_fields:
        with suppress(ValidationError):
            setattr(component, name, getattr(component, name))
            raise PropertyError(f"`{name}` can be set: leave `frozen` in `model_config` as it is")
    try:
        same = hash(component) == hash(component.model_copy())
    except TypeError as error:
        raise PropertyError(f"{error}: take tuples for lists and named fields for dicts") from None
    if not same or component != component.model_copy():
        raise PropertyError("a copy of it is not equal to it, or has another hash")


@asked_of()
def refuses_unknown_keys(subject: Subject) -> None:
    """A parameter that it does not have is refused, so that a misspelt one is never ignored."""
    given = subject.component.model_dump(by_alias=True) | {"no_such_parameter": 1}
    with suppress(ValidationError):
        type(subject.component).model_validate(given)
        raise PropertyError('it takes any key: leave `extra` in `model_config` at "forbid"')


@asked_of()
def survives_json(subject: Subject) -> None:
    """Written as JSON and read again it is equal: every dataset carries its experiment as JSON, and
    is run again from that."""
    component = subject.component
    text, kind = component.model_dump_json(by_alias=True), type(component)
    for again in (kind.model_validate_json(text), kind.model_validate(json.loads(text))):
        for name in kind.model_fields:
            before, after = getattr(component, name), getattr(again, name)
            if before != after:
                raise PropertyError(f"`{name}` is {before!r}, and {after!r} after JSON")


@asked_of()
def survives_pickling(subject: Subject) -> None:
    """Pickled and unpickled it is equal, so that worker processes can be given it."""
    try:
        again = pickle.loads(pickle.dumps(subject.component))
    except Exception as error:
        kind = type(subject.component)
        importable = inspect.getmodule(kind) is not None and "<locals>" not in kind.__qualname__
        remedy = "" if importable else "; define the class at the top of a module"
        raise PropertyError(f"{type(error).__name__}: {error}{remedy}") from None
    if again != subject.component:
        raise PropertyError("it is another one after pickling")


@asked_of(Lattice, is_needed=True)
def has_a_sound_cell(subject: Subject) -> None:
    """The cell vectors span an area, no two basis sites share an index, a place or a primitive
    index, all lie within the period and near where their index says, and `primitive` counts equal
    steps alike and leaves none out."""
    try:
        cell = checked_cell(subject.component)
    except ExperimentError as error:
        raise PropertyError(str(error)) from None
    for n, site in enumerate(cell.sites):
        cells = np.array(site.at) @ np.linalg.inv(np.array(cell.vectors))
        if (np.abs(cells - np.divide(site.index, cell.period)) > 1.0 - 1e-9).any():
            fault = f"basis site {n} lies a cell or more from where its index {site.index} says"
            raise PropertyError(f"{fault}: take whole cell vectors from its `at`")
    _refuse_miscounted(cell)


def _refuse_miscounted(cell: Cell) -> None:
    """Raises where `primitive` tells one step from another that leads the same way, or two sites
    alike, or counts in steps that no site takes."""
    if np.linalg.det(cell.primitive) == 0.0:
        raise PropertyError(f"`primitive` gives the cell vectors {cell.primitive}: in line")
    for (m, one), (n, other) in combinations(enumerate(cell.sites), 2):
        between = np.subtract(other.primitive, one.primitive).astype(float)
        apart = np.linalg.solve(np.transpose(cell.primitive), between)
        if np.abs(apart - np.round(apart)).max() < 1e-9:
            fault = f"basis sites {m} and {n} have the same primitive index {one.primitive}"
            raise PropertyError(f"{fault}, up to whole cells: they must differ")
    counted: dict[tuple[float, ...], tuple[int, ...]] = {}
    lengths = [math.hypot(*vector) for vector in cell.vectors]
    for offset in chain(*(cell.offsets(s, 1.5 * sum(lengths)) for s in range(len(cell.sites)))):
        step = tuple((np.round(np.divide(tuple(offset.rest), lengths[0]), 6) + 0.0).tolist())
        if (known := counted.setdefault(step, offset.primitive)) != offset.primitive:
            twice = f"as {known} and from another as {offset.primitive}"
            counts = f"`primitive` counts the step {tuple(offset.rest)}"
            raise PropertyError(f"{counts} from one site {twice}")
    first, *others = cell.sites
    steps = [*cell.primitive, *(np.subtract(s.primitive, first.primitive) for s in others)]
    spanned = [np.linalg.det(np.array(some)) for some in combinations(steps, len(cell.vectors))]
    if np.gcd.reduce(np.rint(spanned).astype(int)) != 1:
        raise PropertyError("`primitive` counts steps that no site takes: count whole ones only")


@asked_of(Lattice)
def keeps_its_cell_wherever_it_lies(subject: Subject) -> None:
    """The origin moves the lattice and does not enter its cell: no digit of a run depends on where
    the body lies."""
    moved = subject.component.model_copy(update={"origin": (1000.3, -77.1)})
    if moved.cell() != subject.component.cell():
        raise PropertyError("another origin gives another cell: leave `self.origin` out of `cell`")


@asked_of(NeighbourMetric, is_needed=True)
def is_mutual(subject: Subject) -> None:
    """Whoever is a neighbour has this particle as its own neighbour, in the same shell, once: bonds
    have two ends, and a body at rest stays at rest."""
    for where, cell, _, _ in _tried(subject):
        try:
            build_neighbourhood(cell, subject.component)
        except ExperimentError as error:
            raise PropertyError(f"{where}: {error}") from None


@asked_of(NeighbourMetric)
def takes_offsets_of_the_cell(subject: Subject) -> None:
    """Every offset is one that the cell itself gives, so that its site index and its opposite
    agree with the lattice's."""
    for where, cell, s, shells in _tried(subject):
        for offset in chain(*shells):
            if offset != cell.offset(s, offset.target, offset.cell):
                remedy = "take those of `cell.offsets(sublattice, radius)` as they are"
                fault = f"the offset {offset.rest} is none of the cell's"
                raise PropertyError(f"{where} {fault}: {remedy}")


@asked_of(NeighbourMetric)
def takes_sublattices_in_any_order(subject: Subject) -> None:
    """The basis sites in another order have the same neighbours: how a cell is written down means
    nothing."""
    for where, cell, s, shells in _tried(subject):
        backwards = replace(cell, sites=cell.sites[::-1])
        others = subject.component.shells_around(backwards, len(cell.sites) - 1 - s)
        if [_sites(shell) for shell in shells] != [_sites(shell) for shell in others]:
            fault = f"basis site {s} has other neighbours where the sites are listed backwards"
            raise PropertyError(f"{where} {fault}")


@asked_of(NeighbourMetric, is_needed=True)
def finds_the_same_anew(subject: Subject) -> None:
    """Neighbours that are found anew at every step are, in the reference configuration, those that
    it chooses on the lattice."""
    near = subject.component.nearness()
    if near is None:
        raise NotAskedError("its neighbours stay as they are")
    scale = np.sqrt(near.weights)
    far, limit = near.radius / scale.min() * (1 + 1e-6), near.radius * (1 + 1e-9)
    for where, cell, s, shells in _tried(subject):
        met = (o for o in cell.offsets(s, far) if np.hypot(*(scale * tuple(o.rest))) <= limit)
        if _sites(met) != _sites(chain(*shells)):
            fault = "`nearness` finds other neighbours in the reference configuration"
            raise PropertyError(f"{where} {fault} than `shells_around` chooses")


def _tried(subject: Subject) -> Iterator[tuple[str, Cell, int, Sequence[Sequence[Offset]]]]:
    """Each basis site of the lattices to try, but for those that the metric refuses: where it is,
    in which cell, and the shells around it."""
    metric = subject.component
    experiments = experiments_with(metric, subject.parts)
    for lattice in dict.fromkeys(experiment.lattice for experiment in experiments):
        cell = lattice.cell()
        with suppress(ExperimentError):
            around = [metric.shells_around(cell, s) for s in range(len(cell.sites))]
            for s, shells in enumerate(around):
                yield f"on the {lattice.type} lattice", cell, s, shells


def _sites(offsets: Iterable[Offset]) -> set[tuple[int, ...]]:
    """The steps between sites."""
    return {offset.site for offset in offsets}


NAME = r"[a-z][a-z0-9_]*"


@asked_of(Diagnostic)
def labels_its_variables(subject: Subject) -> None:
    """Every variable has a name in lower case, a long name and units ("1" where it has none), so
    that a dataset can be read without the program; none is a name that the dataset has already."""
    diagnostic = subject.component
    variables = {variable.name: variable for variable in diagnostic.variables()}
    for name in (*diagnostic.coordinates(), diagnostic.own_dimension, *variables):
        if name in reserved_names():
            raise PropertyError(f"the dataset has '{name}' already: give it another name")
    for name, variable in variables.items():
        _refuse_unlabelled(variable, f"the variable '{name}'", "my_quantity")


def _refuse_unlabelled(quantity: Any, told: str, example: str) -> None:
    if not re.fullmatch(NAME, quantity.name):
        raise PropertyError(f"{told} is not named as `{example}` is")
    for what in ("long_name", "units"):
        if not getattr(quantity, what).strip():
            raise PropertyError(f"{told} has no {what}")


@asked_of(is_needed=True)
def takes_part(subject: Subject) -> None:
    """A scene can be built with it: at least one of those tried takes it, and none makes it fail
    with anything but an ExperimentError."""
    assert subject.scenes


@asked_of(FollowerRule, FractureModel, is_needed=True)
def declares_what_it_remembers(subject: Subject) -> None:
    """Every number that it remembers has a name in lower case that is free in the dataset, a long
    name, units ("1" where it has none), and an initial value that its dtype holds."""
    for scene in subject.scenes:
        numbers = remembered(subject, scene)
        remembered_names(scene.experiment)  # refuses what is declared twice
        for number in numbers:
            if number.name in reserved_names():
                raise PropertyError(f"every dataset has a '{number.name}': give it another name")
            _refuse_unlabelled(number, f"'{number.name}'", "my_number")
            _refuse_unheld(number, number.initial, "starts at")
        rotations_of(scene.experiment)  # refuses what is not remembered


def remembered(subject: Subject, scene: Scene) -> tuple[Remembered, ...]:
    """The numbers that a rule or a fracture model remembers; NotAskedError where there are none."""
    if numbers := numbers_of(subject.component, scene):
        return numbers
    whose = "particles" if isinstance(subject.component, FollowerRule) else "bonds"
    raise NotAskedError(f"it remembers nothing of {whose}")


@asked_of(FollowerRule, FractureModel, is_needed=True)
def draws_what_it_remembers(subject: Subject) -> None:
    """`draw` gives one finite value a bond or particle, by the name of a number that it remembers,
    such as its dtype holds; all numbers at random are of the generator that it is given."""
    part = subject.component
    for scene in subject.scenes:
        numbers = {number.name: number for number in remembered(subject, scene)}
        if not isinstance(subject.component, Draws):
            raise NotAskedError("all that it remembers starts at its `initial`")
        rows = owners(part, scene)
        for name, values in part.draw(rows, np.random.default_rng(SEED)).items():
            if name not in numbers:
                known = ", ".join(numbers)
                raise PropertyError(f"`draw` gives '{name}'; what it remembers is {known}")
            if (shape := np.shape(values)) != (len(rows),):
                needed = f"not ({len(rows)},)"
                raise PropertyError(f"`draw` gives '{name}' with the shape {shape}, {needed}")
            if not np.isfinite(values).all():
                raise PropertyError(f"`draw` gives '{name}' that is not finite")
            _refuse_unheld(numbers[name], values, "is drawn as")


def _refuse_unheld(number: Remembered, values: Any, how: str) -> None:
    """PropertyError where writing the values into arrays of the dtype would change them."""
    given = np.asarray(values)
    with np.errstate(all="ignore"):
        lost = given[given.astype(number.dtype) != given]
    if lost.size:
        fault = f"'{number.name}' {how} {lost.flat[0]}, which {number.dtype} does not hold"
        raise PropertyError(f"{fault}: declare another `dtype`")


UNUSUAL = 918273645
"""A seed that nobody else takes."""


def differing(one: Arrays, other: Arrays) -> list[str]:
    """The names of the answers that are not the same to the last bit."""
    shared = one.keys() & other.keys()
    return [n for n in one | other if n not in shared or not _same(one[n], other[n])]


def _same(one: Any, other: Any) -> bool:
    a, b = np.asarray(one), np.asarray(other)
    return a.dtype == b.dtype and np.array_equal(a, b, equal_nan=a.dtype.kind in "fc")


@asked_of(FollowerRule, FractureModel, FramePolicy, ParticleOperation, Diagnostic, is_needed=True)
def changes_no_input(subject: Subject) -> None:
    """What it is given it leaves as it is: the arrays belong to the state of the run."""
    for question in subject.questions():
        given = each(np.array, question.inputs)
        try:
            with np.errstate(all="ignore"):
                question.ask(**given)
        except ValueError as error:
            if "read-only" not in str(error):
                raise
            raise PropertyError(_written(question.what, "what it is given")) from error
        if names := differing(flat(question.inputs), flat(given)):
            raise PropertyError(_written(question.what, _listed(names)))


def _written(function: str, where: str) -> str:
    return f"`{function}` writes into {where}: make new arrays, `x = x + 1` and not `x += 1`"


@asked_of(is_needed=True)
def remembers_nothing(subject: Subject) -> None:
    """What it was asked before does not matter: whatever must be remembered belongs to the state of
    the run, or a run that is continued would differ from one that was never interrupted."""
    for question, other in zip(subject.questions(0), subject.questions(-1), strict=False):
        before = reached_by(subject.component)
        _, one, again = (question.answer() for _ in range(3))
        other.answer()
        question.answer(lambda v: 10.0 * v if v.dtype.kind == "f" else v.copy())
        later, after = question.answer(), reached_by(subject.component)
        kept = sorted(n for n in before | after if before.get(n) != after.get(n))
        if differing(again, later) and (kept or not differing(one, again)):
            what = f", and keeps {_listed(kept)} from call to call" if kept else ""
            told = f"`{question.what}` answers the same question otherwise after another one"
            raise PropertyError(told + what)


@asked_of(is_needed=True)
def answers_the_same(subject: Subject) -> None:
    """The same question gets the same answer to the last bit, and the generators of random numbers
    that all share stay as they are, so that every run can be repeated."""
    for question in subject.questions():
        kept = random.getstate(), np.random.get_state()
        random.seed(UNUSUAL)
        np.random.seed(UNUSUAL)
        before = _shared_generators()
        names = differing(question.answer(), question.answer())
        after = _shared_generators()
        random.setstate(kept[0])
        np.random.set_state(kept[1])
        if names:
            fault = f"answers the same question otherwise the second time ({_listed(names)})"
            cause = "it draws numbers at random that nobody gave it, or looks at a clock"
            raise PropertyError(f"`{question.what}` {fault}: {cause}")
        if after != before:
            fault = "seeds or uses the generator of random numbers that all share"
            raise PropertyError(f"`{question.what}` {fault}")


def _shared_generators() -> bytes:
    return pickle.dumps((random.getstate(), np.random.get_state()))


def _listed(names: list[str]) -> str:
    shown = ", ".join(f"`{name}`" for name in names[:3])
    return shown + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def reached_by(component: Component) -> dict[str, bytes]:
    """Every value that the component's functions can reach and change, by name, as bytes."""
    return {name: _content(value) for name, value in _reached(component)}


def _reached(component: Component) -> Iterator[tuple[str, Any]]:
    yield "private attributes", dict(component.__pydantic_private__ or {})
    cached = {n for k in type(component).__mro__ for n, v in vars(k).items()
              if isinstance(v, cached_property)}  # fmt: skip
    yield from ((name, value) for name, value in vars(component).items() if name not in cached)
    for owner in type(component).__mro__:
        if owner.__module__.startswith(("pbdkit.plugin", "pydantic", "builtins", "abc")):
            continue
        for name, value in list(vars(owner).items()):
            if name.startswith(("__", "_abc_", "model_")):
                continue
            function = inspect.unwrap(getattr(value, "__func__", value))
            if isinstance(function, types.FunctionType):
                yield from _of_function(function)
            else:
                yield f"{owner.__name__}.{name}", value


def _of_function(function: types.FunctionType, helpers: bool = True) -> Iterator[tuple[str, Any]]:
    """Globals, closures, defaults and attributes of a function; helpers one call away."""
    yield f"defaults of {function.__name__}", (function.__defaults__, function.__kwdefaults__)
    yield f"attributes of {function.__name__}", vars(function)
    reached = inspect.getclosurevars(function)
    for name, value in {**reached.globals, **reached.nonlocals}.items():
        if not isinstance(value, types.FunctionType):
            yield name, value
        elif helpers and not value.__module__.startswith(("pbdkit.", "numpy")):
            yield from _of_function(value, helpers=False)


def _content(value: Any) -> bytes:
    if isinstance(value, (types.FunctionType, type, types.ModuleType)):
        return b""
    try:
        return pickle.dumps(value)
    except Exception:
        return repr(value).encode()


ROUNDING = 1e-12
"""Some thousand roundings: functions of numpy may differ in the last digit from place to place."""


@asked_of(FollowerRule, FractureModel, ParticleOperation, is_needed=True)
def returns_a_value_a_particle(subject: Subject) -> None:
    """Each component of an answer is one value a particle, or one number for all of them; a rule
    contributes as many from every neighbour, and `breaks` says yes or no."""
    for question in _elementwise(subject):
        for name, value in question.answer().items():
            if value.shape not in ((), SHAPE):
                fault = f"returns the shape {value.shape} for particles of shape {SHAPE} ({name})"
                raise PropertyError(f"`{question.what}` {fault}: it is not elementwise")
    if isinstance(subject.component, FollowerRule):
        scene = subject.scene
        counts = {len(c) for c in gathered(scene, differences(scene, 0))}
        if len(counts) > 1:
            raise PropertyError(f"`gather` returns now {min(counts)}, now {max(counts)} values")


@asked_of()
def is_finite(subject: Subject) -> None:
    """Finite numbers get finite answers, for a rule also where all neighbours meet in the particle:
    one NaN spreads over the body within a few steps."""
    for question in subject.questions():
        for name, value in question.answer().items():
            if value.dtype.kind in "fc" and not np.isfinite(value).all():
                worst = value[~np.isfinite(value)].flat[0]
                remedy = "guard the division, as in `a / where(b > 0.0, b, 1.0)`"
                raise PropertyError(f"`{question.what}` answers {worst} ({name}): {remedy}")


@asked_of(FollowerRule, FractureModel, is_needed=True)
def renews_what_it_remembers(subject: Subject) -> None:
    """`update`, or `remember`, returns one value for each number that changes, in their order, and
    a whole number where one is declared."""
    changing = [number for number in remembered(subject, subject.scene) if number.changes]
    asked = [q for q in subject.questions() if q.what in ("update", "remember")]
    if not asked:
        raise NotAskedError("what it remembers stays as it starts")
    what, answer = asked[0].what, asked[0].asked()
    for values in answer if what == "update" else [answer]:
        if len(values) != len(changing):
            returned = f"{len(values)} value{'s' * (len(values) != 1)}"
            fault = f"`{what}` returns {returned}, and {len(changing)} of the numbers change"
            raise PropertyError(f"{fault}: declare `changes=False` for those that stay")
        for number, value in zip(changing, map(np.asarray, values), strict=True):
            if not np.can_cast(value.dtype, number.dtype, "same_kind"):
                fault = f"`{what}` returns {value.dtype} for '{number.name}', which is declared"
                raise PropertyError(f"{fault} as {number.dtype}: fractions would be lost")


@asked_of(FollowerRule, FractureModel, ParticleOperation)
def keeps_single_precision(subject: Subject) -> None:
    """Numbers of float32 get answers of float32: a run in single precision is one throughout."""
    for question in _elementwise(subject):
        for name, value in flat(question.asked(_single)).items():
            kind = getattr(value, "dtype", None)
            if kind is not None and kind.kind == "f" and kind != np.float32:
                raise PropertyError(
                    f"`{question.what}` returns {kind} for float32 ({name}): leave the dtype to "
                    "the arithmetic, and make parameters and constants plain numbers, `float(...)`"
                )


@asked_of(FollowerRule, FractureModel, ParticleOperation, is_needed=True)
def takes_particles_in_any_order(subject: Subject) -> None:
    """Particles in another order get the same answers in that order, and neighbours summed in the
    opposite order the same move, to rounding: numbering means nothing."""
    order = np.random.default_rng(0).permutation(int(np.prod(SHAPE)))
    for question in _elementwise(subject):
        whole = question.answer()
        mixed = question.answer(lambda value: _in_order(value, order))
        for name, value in mixed.items():
            expected = _in_order(np.broadcast_to(whole[name], SHAPE), order)
            if (place := _apart(np.broadcast_to(value, SHAPE), expected)) is not None:
                fault = "gives a particle another answer where it stands in another order"
                told = f"({name}: {value[place]} and {expected[place]})"
                raise PropertyError(f"`{question.what}` {fault} {told}")
    _refuse_an_order_of_rows(subject)
    if isinstance(subject.component, FollowerRule):
        _refuse_an_order_of_slots(subject.scene)


class Alike(np.random.Generator):
    """Draws the same for everybody: what then differs differs by what the part was shown."""

    def __getattribute__(self, name: str) -> Any:
        """Every method draws anew, and the first draw counts for all."""
        if name.startswith("_") or not callable(getattr(np.random.Generator, name)):
            return super().__getattribute__(name)

        def draw(*given: Any, **named: Any) -> Any:
            found = getattr(np.random.default_rng(SEED), name)(*given, **named)
            if name == "shuffle":
                given[0][...] = given[0][0]
            return np.full_like(found, found.flat[0]) if np.size(found) > 1 else found

        return draw


def _refuse_an_order_of_rows(subject: Subject) -> None:
    part = subject.component
    if not isinstance(part, Draws):
        return
    shown = owners(subject.component, subject.scene)
    order = np.random.default_rng(0).permutation(len(shown))
    mixed = type(shown)(**{name: table[order] for name, table in vars(shown).items()})
    one, other = (part.draw(rows, Alike(np.random.PCG64(SEED))) for rows in (shown, mixed))
    for name, values in one.items():
        if not np.array_equal(np.asarray(values)[order], other[name]):
            remedy = "take it from what a row holds, or from the generator"
            raise PropertyError(f"`draw` gives '{name}' by the row: {remedy}")


def _refuse_an_order_of_slots(scene: Scene) -> None:
    contributions, at = gathered(scene, differences(scene, 0)), here(scene, 0)
    one, other = (flat(applied(scene, c, **at)) for c in (contributions, contributions[::-1]))
    for name, value in one.items():
        if _apart(value, other[name]) is not None:
            fault = f"the move depends on the order in which neighbours are summed ({name})"
            raise PropertyError(f"{fault}: do not sum large numbers that cancel")


@asked_of(FollowerRule, FractureModel, ParticleOperation, is_needed=True)
def is_local(subject: Subject) -> None:
    """A particle that is asked about alone, with plain numbers, gets the answer that it gets among
    the others: only itself and its neighbours count."""
    for question in _elementwise(subject):
        whole = question.answer()
        for place in [(0, 0), (2, 1), (3, 2)]:
            try:
                alone = flat(question.asked(methodcaller("item", *place)))
            except Exception as error:
                fault = f"`{question.what}` fails with plain numbers in the place of arrays"
                raise PropertyError(f"{fault}: {type(error).__name__}: {error}") from None
            for name, value in alone.items():
                among = np.broadcast_to(whole[name], SHAPE)[place]
                if np.shape(value) or _apart(value, among) is not None:
                    fault = "gives a particle another answer alone than among others"
                    told = f"({name}: {value} and {among}): it is not elementwise"
                    raise PropertyError(f"`{question.what}` {fault} {told}")


def _single(value: NDArray[Any]) -> NDArray[Any]:
    return value.astype(np.float32) if value.dtype.kind == "f" else value.copy()


def _elementwise(subject: Subject) -> list[Question]:
    return [question for question in subject.questions() if question.elementwise]


def _in_order(value: NDArray[Any], order: NDArray[np.intp]) -> NDArray[Any]:
    return value.reshape(-1)[order].reshape(value.shape)


def _apart(value: Any, expected: Any) -> tuple[int, ...] | None:
    """The first place at which two answers differ by more than rounding."""
    one, other = np.asarray(value), np.asarray(expected)
    if one.dtype == bool:
        differs = one != other
    else:
        size = max(1e-300, float(np.abs(other).max(initial=0.0)))
        differs = ~(np.abs(one - other) <= ROUNDING * size)
    return next(map(tuple, np.argwhere(differs).tolist()), None)


CLOSE = 1e-9
"""How near to its breaking strain a bond is tried, as a share of its length."""


@asked_of(FractureModel, is_needed=True)
def is_seen_alike_from_both_ends(subject: Subject) -> None:
    """A bond breaks for both ends or for none: `breaks` and `update` answer the same for (-d, -r)
    as for (d, r), and `constants` for a slot and its opposite; they are called for one end only."""
    model, scene = subject.component, subject.scene
    for plane in scene.neighbourhood.planes:
        here, there = model.constants(plane.slot), model.constants(plane.opposite)
        if here != there:
            fault = f"{here} for the slot {plane.slot.site} and {there} for its opposite"
            raise PropertyError(f"`constants` are {fault}: take lengths and shells, not directions")
    evaluator, own = Evaluator(scene), remembers(model, scene, 0)
    cells = tuple(CellStress(*cell) for cell in stressed(model, 0))
    sides = _from_the_other_end([number.name for number in bond_numbers(scene.experiment)])
    theirs = tuple(own[n] for n in sides)
    asks: dict[str, list[tuple[CellStress, ...]]] = {"breaks": []}
    if isinstance(model, RenewsBonds):
        asks["update"] = [cells] if cells else []
    tried = differences(scene, 0, share=2.0)
    for slot, d in zip(scene.neighbourhood.slots[0], tried, strict=True):
        limits = scene.constants.limits[slot]
        for what, beside in asks.items():
            ask = getattr(evaluator, what)
            one = ask(d, slot.rest, limits, own, *beside)
            other = ask(-d, -slot.rest, limits, theirs, *(cells[::-1] for cells in beside))
            if beside:
                other = tuple(other[n] for n in sides)
            if not np.array_equal(np.asarray(one), np.asarray(other)):
                along = f"for (-d, -r) than for (d, r) along {slot.site}"
                raise PropertyError(f"`{what}` answers otherwise {along}")


def _from_the_other_end(names: list[str]) -> list[int]:
    """The place of each number that is seen from the other end of a bond: left for right."""
    turned = {"_left": "_right", "_right": "_left"}
    swapped = [
        next((n.removesuffix(a) + b for a, b in turned.items() if n.endswith(a)), n) for n in names
    ]
    return [names.index(n) for n in swapped]


@asked_of(FractureModel)
def breaks_as_declared(subject: Subject) -> None:
    """Where it declares `can_break = False` nothing breaks, however long: the scene then has no
    bond state."""
    scene = subject.scene
    if subject.component.can_break:
        return
    slots, breaks = scene.neighbourhood.slots[0], Evaluator(scene).breaks
    for slot, d in zip(slots, differences(scene, 0, share=1e3), strict=True):
        if np.any(breaks(d, slot.rest, scene.constants.limits[slot], ())):
            raise PropertyError("it declares `can_break = False`, and `breaks` says yes")


@asked_of(FractureModel)
def breaks_beyond_its_strain(subject: Subject) -> None:
    """Where it tells a `breaking_strain`, a bond that is drawn out along itself breaks a little
    above it and, if it has not broken, not a little below: `pbdkit explain` tells users so."""
    model, scene = subject.component, subject.scene
    if not isinstance(subject.component, BreaksAtStrain):
        raise NotAskedError("it tells no `breaking_strain`")
    evaluator, own, p = Evaluator(scene), remembers(model, scene, 0), scene.constants.fracture
    for slot in scene.neighbourhood.slots[0]:
        r, limits = slot.rest, scene.constants.limits[slot]
        told = model.breaking_strain(r, scene.constants.of_bond(*limits, *own), p)
        limit = np.broadcast_to(told, SHAPE)
        for side, expected in ((CLOSE, True), (-CLOSE, False)):
            stretch = limit + side * (1.0 + np.abs(limit))
            d, now = r * stretch, [np.array(value) for value in own]
            evaluator.renew_bonds(d, r, limits, now, np.ones(SHAPE, bool))
            wrong = np.broadcast_to(evaluator.breaks(d, r, limits, now), SHAPE) != expected
            if wrong.any():
                where = f"at strain {stretch[wrong][0]:.6g} along {slot.site} the bond"
                fault = f"{where} {'stays' if expected else 'breaks'}"
                raise PropertyError(f"`breaking_strain` and `breaks` disagree: {fault}")


@asked_of(ParticleOperation)
def rests_as_declared(subject: Subject) -> None:
    """Where it declares `rests`, a particle that the rule leaves where it is stays there, exactly,
    and any other moves: equilibria are then those of the rule alone."""
    if not subject.component.rests:
        raise NotAskedError("it does not declare `rests`")
    (question,) = subject.questions()
    u, new = question.inputs["u"], question.inputs["new"]
    if differing(flat(question.ask(u, u)), flat(u)):
        raise PropertyError(
            "`displacement` moves a particle that rests: write it as `new` plus what vanishes with "
            "`new - u`, or leave `rests` out"
        )
    stays = np.all([a == b for a, b in zip(question.ask(u, new), u, strict=True)], axis=0)
    if stays.any():
        told = "`displacement` holds a particle that the rule moves: leave `rests` out"
        raise PropertyError(told)


@asked_of(FramePolicy)
def takes_every_point_alone(subject: Subject) -> None:
    """Whom a frame point follows does not depend on which other points there are."""
    policy, reason = subject.component, "it has no points"
    for scene in subject.scenes:
        frame = sites_of_frame(scene.raster, scene.experiment.rule)
        if frame is None:
            continue
        point, body = frame.nearest()
        whole = policy.follow(frame_showing(frame, frame.site, point, body))
        for some in (np.arange(0, len(frame.site), 2), np.array([len(frame.site) - 1])):
            kept = np.isin(point, some)
            anew = np.searchsorted(some, point[kept])
            try:
                part = policy.follow(frame_showing(frame, frame.site[some], anew, body[kept]))
            except ExperimentError as refusal:
                reason = reason and f"it takes whole frames only: {refusal}"
                continue
            reason = ""
            for n, one in enumerate(some):
                if _followed(part, n) != _followed(whole, int(one)):
                    fault = "follows somebody else where fewer points are asked about"
                    raise PropertyError(f"frame point {one} {fault} ({place_of(scene.experiment)})")
    if reason:
        raise NotAskedError(reason)


@asked_of(FramePolicy)
def follows_who_is_near(subject: Subject) -> None:
    """Where it declares itself `local`, points follow particles that are nearest to them, or no
    farther off than twice the layers in site index."""
    policy = subject.component
    if not policy.local:
        raise NotAskedError("it does not declare itself `local`")
    for scene in subject.scenes:
        raster = scene.raster
        frame = sites_of_frame(raster, scene.experiment.rule)
        if frame is None:
            continue
        follow, layers = policy.follow(frame), policy.depth(scene.neighbourhood.reach)
        way = np.abs(raster.site_of(follow.body) - frame.site[follow.point]).max(axis=1)
        nearest = {*zip(*(each.tolist() for each in frame.nearest()), strict=True)}
        for entry in np.flatnonzero(way > 2 * layers).tolist():
            point, body = int(follow.point[entry]), int(follow.body[entry])
            if (point, body) not in nearest:
                raise PropertyError(
                    f"frame point {point} follows a particle {way[entry]} sites away, beside "
                    f"{layers} layers ({place_of(scene.experiment)}): leave out `local`"
                )


def _followed(follow: FrameMap, point: int) -> tuple[list[int], list[Any]]:
    """The body particles that a point follows, and their weights."""
    entries = follow.point == point
    return follow.body[entries].tolist(), follow.weight[entries].tolist()


@asked_of(Diagnostic, is_needed=True)
def measures_what_it_declares(subject: Subject) -> None:
    """`measure` returns one array for each of its variables, shaped as their `dims` say, of numbers
    that go into the declared dtype without loss of kind."""
    diagnostic, scene, own = subject.component, subject.scene, subject.component.own_dimension
    sizes = {"particle": scene.raster.count, "axis": 2, "leader_group": len(scene.leading)}
    sizes |= {"load": len(scene.experiment.loads)}
    sizes |= {"obstacle": len(scene.barriers), "principal": 2}
    sizes |= {name: len(values) for name, values in diagnostic.coordinates().items()}
    variables = diagnostic.variables()
    measured = [np.asarray(value) for value in diagnostic.measure(moment_of(scene, 0))]
    if len(variables) != len(measured):
        raise PropertyError(f"{len(measured)} arrays for {len(variables)} variables")
    if own and not diagnostic.at_end:
        remedy = "has a length only where it declares `at_end` too"
        raise PropertyError(f"its `own_dimension` '{own}' {remedy}")
    for variable, value in zip(variables, measured, strict=True):
        if own in variable.dims and value.ndim == len(variable.dims):
            sizes.setdefault(own, value.shape[variable.dims.index(own)])  # as the first has it
    for variable, value in zip(variables, measured, strict=True):
        for dim in variable.dims:
            if dim not in sizes:
                what = f"the dimension '{dim}', which `coordinates` does not give"
                raise PropertyError(f"'{variable.name}' has {what}")
        shape = tuple(sizes[dim] for dim in variable.dims)
        if value.shape != shape:
            raise PropertyError(f"'{variable.name}' has the shape {value.shape}, not {shape}")
        if not np.can_cast(value.dtype, variable.dtype, "same_kind"):
            fault = f"is declared as {variable.dtype} and measured as {value.dtype}"
            raise PropertyError(f"'{variable.name}' {fault}: digits would be lost without a word")


@asked_of(Diagnostic)
def takes_rows_in_any_order(subject: Subject) -> None:
    """Particles in another order have the same values in that order, and all else stays, to
    rounding: rows are found by `now.rows(numbers)` and mean nothing else."""
    diagnostic, scene = subject.component, subject.scene
    moment, order = moment_of(scene, 0), np.random.default_rng(0).permutation(scene.raster.count)
    values, seen = diagnostic.measure(moment), diagnostic.measure(Shown(moment, order))
    for variable, one, other in zip(diagnostic.variables(), values, seen, strict=True):
        expected = np.asarray(one)
        for axis, dim in enumerate(variable.dims):
            expected = np.take(expected, order, axis) if dim == "particle" else expected
        size = float(np.nanmax(np.abs(expected), initial=1e-300))
        if not np.allclose(other, expected, rtol=0.0, atol=ROUNDING * size, equal_nan=True):
            remedy = "ask `now.rows(numbers)` for particles by number"
            raise PropertyError(f"'{variable.name}' depends on the order of the rows: {remedy}")
