"""Properties of components that are tested without whole steps.

They concern parameters, lattices, neighbour metrics, the scenes that can be built with a component,
and the results of its functions. Functions are called with whole arrays and with single numbers;
their results must depend on their arguments only.
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
    paired,
    remembers,
    stressed,
    totals,
)
from pbdkit.testing.subject import (
    Arrays,
    FunctionCall,
    NotApplicableError,
    PropertyError,
    Subject,
    each,
    experiments_with,
    flat,
    place_of,
    property_of,
)

WORD = r"[a-z][a-z0-9]*(-[a-z0-9]+)*"
"""Pattern of the type of a component."""


@property_of()
def names_itself(subject: Subject) -> None:
    """The `type` is one literal in lower case, words joined by hyphens: experiments refer to it,
    schemas distinguish components by it, and `distribution:type` is unambiguous."""
    component = type(subject.component)
    field, name = component.model_fields["type"], component.type_name()
    if not re.fullmatch(WORD, name):
        raise PropertyError(f"the type '{name}' is not in lower case with hyphens, as in 'my-rule'")
    if getattr(field.annotation, "__args__", None) != (name,):
        remedy = f'declare it as `type: Literal["{name}"] = "{name}"`'
        raise PropertyError(f"`type` accepts other words, too: {remedy}")


@property_of()
def is_documented(subject: Subject) -> None:
    """The class has a docstring and every parameter a description: the JSON Schema contains them,
    and editors show them."""
    component = type(subject.component)
    if not (component.__dict__.get("__doc__") or "").strip():
        raise PropertyError(f"{component.__name__} has no docstring; describe what it computes")
    for name, field in component.model_fields.items():
        if name != "type" and not (field.description or "").strip():
            remedy = f'`{name}: ... = Field(..., description="what it is, with units")`'
            raise PropertyError(f"the parameter `{name}` has no description; write {remedy}")


@property_of()
def is_frozen(subject: Subject) -> None:
    """Parameters cannot be changed and the component is hashable: scenes and engines share
    components and compare them by value."""
    component = subject.component
    for name in type(component).model_fields:
        with suppress(AttributeError):
            setattr(component, name, getattr(component, name))
            raise PropertyError(
                f"`{name}` can be assigned; do not change `frozen` in `model_config`"
            )
    try:
        same = hash(component) == hash(component.model_copy())
    except TypeError as error:
        raise PropertyError(
            f"{error}; use tuples instead of lists, and named fields instead of dicts"
        ) from None
    if not same or component != component.model_copy():
        raise PropertyError("a copy of the component is not equal to it, or has another hash")


@property_of()
def refuses_unknown_keys(subject: Subject) -> None:
    """Unknown parameters raise an error: a misspelt one is never ignored."""
    parameters = subject.component.model_dump(by_alias=True) | {"no_such_parameter": 1}
    with suppress(ValidationError):
        type(subject.component).model_validate(parameters)
        raise PropertyError('it accepts unknown keys; keep `extra` in `model_config` at "forbid"')


@property_of()
def survives_json(subject: Subject) -> None:
    """A component that is written as JSON and read again is equal to the original: every dataset
    contains its experiment as JSON."""
    component = subject.component
    text, kind = component.model_dump_json(by_alias=True), type(component)
    for copy in (kind.model_validate_json(text), kind.model_validate(json.loads(text))):
        for name in kind.model_fields:
            original, restored = getattr(component, name), getattr(copy, name)
            if original != restored:
                raise PropertyError(f"`{name}` is {original!r}, but {restored!r} after JSON")


@property_of()
def survives_pickling(subject: Subject) -> None:
    """A component that is pickled and unpickled is equal to the original: worker processes receive
    components by pickle."""
    try:
        copy = pickle.loads(pickle.dumps(subject.component))
    except Exception as error:
        kind = type(subject.component)
        importable = inspect.getmodule(kind) is not None and "<locals>" not in kind.__qualname__
        remedy = "" if importable else "; define the class at the top of a module"
        raise PropertyError(f"{type(error).__name__}: {error}{remedy}") from None
    if copy != subject.component:
        raise PropertyError("the component is not equal to itself after pickling")


@property_of(Lattice, is_needed=True)
def has_a_sound_cell(subject: Subject) -> None:
    """The cell vectors span an area. No two basis sites have the same index, position or primitive
    index. The indices of basis sites lie within the period, and their positions near those of their
    indices. Equal offsets have equal differences in `primitive`, without gaps."""
    try:
        cell = checked_cell(subject.component)
    except ExperimentError as error:
        raise PropertyError(str(error)) from None
    for n, site in enumerate(cell.sites):
        cells = np.array(site.at) @ np.linalg.inv(np.array(cell.vectors))
        if (np.abs(cells - np.divide(site.index, cell.period)) > 1.0 - 1e-9).any():
            fault = (
                f"basis site {n} lies a cell or more from the position of its index {site.index}"
            )
            raise PropertyError(f"{fault}; subtract whole cell vectors from its `at`")
    _refuse_miscounted(cell)


def _refuse_miscounted(cell: Cell) -> None:
    """Raise PropertyError if the primitive indices of a cell are inconsistent.

    They are inconsistent if equal steps have different indices, if two sites have the same index,
    or if there is no site at an index between others.
    """
    if np.linalg.det(cell.primitive) == 0.0:
        raise PropertyError(f"the cell vectors {cell.primitive} of `primitive` are parallel")
    for (m, site), (n, other_site) in combinations(enumerate(cell.sites), 2):
        between = np.subtract(other_site.primitive, site.primitive).astype(float)
        cells = np.linalg.solve(np.transpose(cell.primitive), between)
        if np.abs(cells - np.round(cells)).max() < 1e-9:
            fault = f"basis sites {m} and {n} have the same primitive index {site.primitive}"
            raise PropertyError(f"{fault}, up to whole cells; they must differ")
    counted: dict[tuple[float, ...], tuple[int, ...]] = {}
    lengths = [math.hypot(*vector) for vector in cell.vectors]
    for offset in chain(*(cell.offsets(s, 1.5 * sum(lengths)) for s in range(len(cell.sites)))):
        step = tuple((np.round(np.divide(tuple(offset.rest), lengths[0]), 6) + 0.0).tolist())
        if (count := counted.setdefault(step, offset.primitive)) != offset.primitive:
            twice = f"as {count} and from another as {offset.primitive}"
            counts = f"`primitive` counts the step {tuple(offset.rest)}"
            raise PropertyError(f"{counts} from one site {twice}")
    first, *further = cell.sites
    steps = [*cell.primitive, *(np.subtract(s.primitive, first.primitive) for s in further)]
    spanned = [np.linalg.det(np.array(basis)) for basis in combinations(steps, len(cell.vectors))]
    if np.gcd.reduce(np.rint(spanned).astype(int)) != 1:
        raise PropertyError(
            "`primitive` counts steps that do not occur between sites; count whole ones only"
        )


@property_of(Lattice)
def keeps_its_cell_wherever_it_lies(subject: Subject) -> None:
    """The `origin` moves the lattice but does not change its cell: the position of the body does
    not change the results of a run, not even their last digit."""
    moved = subject.component.model_copy(update={"origin": (1000.3, -77.1)})
    if moved.cell() != subject.component.cell():
        raise PropertyError("`cell` depends on the origin; remove `self.origin` from it")


@property_of(NeighbourMetric, is_needed=True)
def is_mutual(subject: Subject) -> None:
    """Neighbours are mutual, in the same shell, and occur once: bonds have two ends, and a body at
    rest stays at rest."""
    for where, cell, _, _ in _tried(subject):
        try:
            build_neighbourhood(cell, subject.component)
        except ExperimentError as error:
            raise PropertyError(f"{where}: {error}") from None


@property_of(NeighbourMetric)
def takes_offsets_of_the_cell(subject: Subject) -> None:
    """Every offset that the metric selects is one of the offsets of the cell: all its fields, such
    as the difference of site indices, equal those of `cell.offset`."""
    for where, cell, s, shells in _tried(subject):
        for offset in chain(*shells):
            if offset != cell.offset(s, offset.target, offset.cell):
                remedy = "return offsets of `cell.offsets(sublattice, radius)` unchanged"
                fault = f"the offset {offset.rest} is not an offset of the cell"
                raise PropertyError(f"{where} {fault}: {remedy}")


@property_of(NeighbourMetric)
def takes_sublattices_in_any_order(subject: Subject) -> None:
    """The order of the basis sites does not change neighbours: it is a matter of notation."""
    for where, cell, s, shells in _tried(subject):
        backwards = replace(cell, sites=cell.sites[::-1])
        shells_backwards = subject.component.shells_around(backwards, len(cell.sites) - 1 - s)
        if [_sites(shell) for shell in shells] != [_sites(shell) for shell in shells_backwards]:
            fault = f"basis site {s} has other neighbours if the order of the sites is reversed"
            raise PropertyError(f"{where} {fault}")


@property_of(NeighbourMetric, is_needed=True)
def finds_the_same_anew(subject: Subject) -> None:
    """If neighbours are re-evaluated in every step, those found in the reference configuration are
    the neighbours on the lattice: a body at rest keeps its neighbours."""
    near = subject.component.nearness()
    if near is None:
        raise NotApplicableError("its neighbours do not change")
    scale = np.sqrt(near.weights)
    far, limit = near.radius / scale.min() * (1 + 1e-6), near.radius * (1 + 1e-9)
    for where, cell, s, shells in _tried(subject):
        offsets = (o for o in cell.offsets(s, far) if np.hypot(*(scale * tuple(o.rest))) <= limit)
        if _sites(offsets) != _sites(chain(*shells)):
            fault = "`nearness` selects other neighbours in the reference configuration"
            raise PropertyError(f"{where} {fault} than `shells_around`")


def _tried(subject: Subject) -> Iterator[tuple[str, Cell, int, Sequence[Sequence[Offset]]]]:
    """Yield each basis site of the tested lattices, as (place, cell, sublattice, shells).

    Lattices for which the metric raises an ExperimentError are skipped.
    """
    metric = subject.component
    experiments = experiments_with(metric, subject.parts)
    for lattice in dict.fromkeys(experiment.lattice for experiment in experiments):
        cell = lattice.cell()
        with suppress(ExperimentError):
            around = [metric.shells_around(cell, s) for s in range(len(cell.sites))]
            for s, shells in enumerate(around):
                yield f"on the {lattice.type} lattice", cell, s, shells


def _sites(offsets: Iterable[Offset]) -> set[tuple[int, ...]]:
    """Return the differences of repeat cell and sublattice of offsets."""
    return {offset.site for offset in offsets}


NAME = r"[a-z][a-z0-9_]*"
"""Pattern of the name of a state variable."""
SYMBOLIC_NAME = r"(?:[a-z][a-z0-9]*|[A-Z])(?:_(?:[a-z0-9]*|[A-Z]|I{2,3}))*"
"""Pattern of the name of a variable of a diagnostic: words in lower case, or symbols of one letter
and Roman numerals, as in `K_II`."""


@property_of(Diagnostic)
def labels_its_variables(subject: Subject) -> None:
    """Every variable has a name in lower case, apart from symbols such as `K_I`, that the dataset
    does not reserve, a long name, and units ("1" if it has none): the dataset can be read without
    the program."""
    diagnostic = subject.component
    variables = {variable.name: variable for variable in diagnostic.variables()}
    for name in (*diagnostic.coordinates(), diagnostic.own_dimension, *variables):
        if name in reserved_names():
            raise PropertyError(f"the dataset already has a variable '{name}'; rename it")
    for name, variable in variables.items():
        what = f"the variable '{name}'"
        _refuse_unlabelled(variable, what, "my_quantity", SYMBOLIC_NAME)


def _refuse_unlabelled(quantity: Any, description: str, example: str, name: str = NAME) -> None:
    if not re.fullmatch(name, quantity.name):
        raise PropertyError(f"{description} is not named as `{example}` is")
    for what in ("long_name", "units"):
        if not getattr(quantity, what).strip():
            raise PropertyError(f"{description} has no {what}")


@property_of(is_needed=True)
def takes_part(subject: Subject) -> None:
    """At least one of the tested scenes can be built with the component: for the others it may
    raise an ExperimentError, and no other exception."""
    assert subject.scenes


@property_of(FollowerRule, FractureModel, is_needed=True)
def declares_what_it_remembers(subject: Subject) -> None:
    """Every state variable has a name in lower case that the dataset does not reserve, a long name,
    units ("1" if it has none), and an initial value that its dtype can hold."""
    for scene in subject.scenes:
        numbers = remembered(subject, scene)
        remembered_names(scene.experiment)  # Raises an error for names that are declared twice.
        for number in numbers:
            if number.name in reserved_names():
                raise PropertyError(f"every dataset has a variable '{number.name}'; rename it")
            _refuse_unlabelled(number, f"'{number.name}'", "my_number")
            _refuse_unheld(number, number.initial, "starts at")
        # Raises an error for rotations that are not state variables.
        rotations_of(scene.experiment)


def remembered(subject: Subject, scene: Scene) -> tuple[Remembered, ...]:
    """Return the state variables of a rule or a fracture model.

    Raises
    ------
    NotApplicableError
        If there are none.
    """
    if numbers := numbers_of(subject.component, scene):
        return numbers
    owners_name = "particles" if isinstance(subject.component, FollowerRule) else "bonds"
    raise NotApplicableError(f"it has no state variables of {owners_name}")


@property_of(FollowerRule, FractureModel, is_needed=True)
def draws_what_it_remembers(subject: Subject) -> None:
    """For the name of a state variable `draw` returns one finite value for each bond or particle.
    The dtype of the variable can hold these values. `draw` takes random numbers from the given
    generator only.
    """
    part = subject.component
    for scene in subject.scenes:
        numbers = {number.name: number for number in remembered(subject, scene)}
        if not isinstance(subject.component, Draws):
            raise NotApplicableError("its state variables start at their `initial` values")
        rows = owners(part, scene)
        for name, values in part.draw(rows, np.random.default_rng(SEED)).items():
            if name not in numbers:
                declared = ", ".join(numbers)
                raise PropertyError(f"`draw` returns '{name}'; expected {declared}")
            if (shape := np.shape(values)) != (len(rows),):
                needed = f"not ({len(rows)},)"
                raise PropertyError(f"`draw` returns '{name}' with the shape {shape}, {needed}")
            if not np.isfinite(values).all():
                raise PropertyError(f"`draw` returns values of '{name}' that are not finite")
            _refuse_unheld(numbers[name], values, "is drawn as")


def _refuse_unheld(number: Remembered, values: Any, verb: str) -> None:
    """Raise PropertyError if the dtype of a number would change the values."""
    array = np.asarray(values)
    with np.errstate(all="ignore"):
        lost = array[array.astype(number.dtype) != array]
    if lost.size:
        fault = f"'{number.name}' {verb} {lost.flat[0]}, which {number.dtype} does not represent"
        raise PropertyError(f"{fault}; declare another `dtype`")


UNUSUAL = 918273645
"""Seed that no other code uses."""


def differing(first: Arrays, second: Arrays) -> list[str]:
    """Return the names of arrays that are not equal to the last bit."""
    shared = first.keys() & second.keys()
    return [n for n in first | second if n not in shared or not _same(first[n], second[n])]


def _same(first: Any, second: Any) -> bool:
    a, b = np.asarray(first), np.asarray(second)
    return a.dtype == b.dtype and np.array_equal(a, b, equal_nan=a.dtype.kind in "fc")


@property_of(
    FollowerRule, FractureModel, FramePolicy, ParticleOperation, Diagnostic, is_needed=True
)
def changes_no_input(subject: Subject) -> None:
    """Functions do not change their arguments: the arrays belong to the state of the run."""
    for call in subject.calls():
        inputs = each(np.array, call.inputs)
        try:
            with np.errstate(all="ignore"):
                call.compute(**inputs)
        except ValueError as error:
            if "read-only" not in str(error):
                raise
            raise PropertyError(_written(call.function, "its arguments")) from error
        if names := differing(flat(call.inputs), flat(inputs)):
            raise PropertyError(_written(call.function, _listed(names)))


def _written(function: str, where: str) -> str:
    return f"`{function}` writes into {where}; make new arrays, `x = x + 1` instead of `x += 1`"


@property_of(is_needed=True)
def remembers_nothing(subject: Subject) -> None:
    """Results do not depend on previous calls: a component must store values in the state of the
    run only, because a resumed run would differ otherwise."""
    for call, other in zip(subject.calls(0), subject.calls(-1), strict=False):
        reachable = reached_by(subject.component)
        _, first, second = (call.answer() for _ in range(3))
        other.answer()
        call.answer(lambda v: 10.0 * v if v.dtype.kind == "f" else v.copy())
        third, reachable_later = call.answer(), reached_by(subject.component)
        names = reachable | reachable_later
        changes = sorted(n for n in names if reachable.get(n) != reachable_later.get(n))
        if differing(second, third) and (changes or not differing(first, second)):
            what = f", and changes {_listed(changes)} between calls" if changes else ""
            fault = f"`{call.function}` returns another value after a call with other arguments"
            raise PropertyError(fault + what)


@property_of(is_needed=True)
def answers_the_same(subject: Subject) -> None:
    """Equal calls return equal results to the last bit and leave the global generators of random
    numbers unchanged: every run can be repeated."""
    for call in subject.calls():
        saved = random.getstate(), np.random.get_state()
        random.seed(UNUSUAL)
        np.random.seed(UNUSUAL)
        initial = _shared_generators()
        names = differing(call.answer(), call.answer())
        final = _shared_generators()
        random.setstate(saved[0])
        np.random.set_state(saved[1])
        if names:
            fault = f"returns another value in the second of two equal calls ({_listed(names)})"
            cause = "it draws random numbers from its own generator, or reads a clock"
            raise PropertyError(f"`{call.function}` {fault}: {cause}")
        if final != initial:
            fault = "seeds or uses the global generator of random numbers"
            raise PropertyError(f"`{call.function}` {fault}")


def _shared_generators() -> bytes:
    return pickle.dumps((random.getstate(), np.random.get_state()))


def _listed(names: list[str]) -> str:
    text = ", ".join(f"`{name}`" for name in names[:3])
    return text + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def reached_by(component: Component) -> dict[str, bytes]:
    """Return every value that the component's functions can read and change, by name, as bytes."""
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
    """Yield globals, closures, defaults and attributes of a function and of its helpers."""
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
"""Relative tolerance, equal to several thousand rounding errors.

It is needed because the last digit of a numpy function may depend on the position in an array.
"""


@property_of(FollowerRule, FractureModel, ParticleOperation, is_needed=True)
def returns_a_value_a_particle(subject: Subject) -> None:
    """Results have one value for each particle, or one number for all; a rule returns the same
    number of contributions for every neighbour and for every pair, and `breaks` returns
    booleans."""
    for call in _elementwise(subject):
        for name, value in call.answer().items():
            if value.shape not in ((), SHAPE):
                fault = (
                    f"returns the shape {value.shape} for particles of the shape {SHAPE} ({name})"
                )
                raise PropertyError(f"`{call.function}` {fault}; it is not elementwise")
    if isinstance(subject.component, FollowerRule):
        scene = subject.scene
        for name, function in (("gather", gathered), ("gather_pair", paired)):
            counts = {len(c) for c in function(scene, differences(scene, 0))}
            if len(counts) > 1:
                few, many = min(counts), max(counts)
                raise PropertyError(f"`{name}` returns between {few} and {many} values")


@property_of()
def is_finite(subject: Subject) -> None:
    """Finite arguments give finite results, for a rule also if all neighbours coincide with the
    particle: one NaN spreads over the body within a few steps."""
    for call in subject.calls():
        for name, value in call.answer().items():
            if value.dtype.kind in "fc" and not np.isfinite(value).all():
                worst = value[~np.isfinite(value)].flat[0]
                remedy = "guard the division, as in `a / where(b > 0.0, b, 1.0)`"
                raise PropertyError(f"`{call.function}` returns {worst} ({name}); {remedy}")


@property_of(FollowerRule, FractureModel, is_needed=True)
def renews_what_it_remembers(subject: Subject) -> None:
    """`update`, or `remember`, returns one value for each state variable that changes, in the order
    of declaration, and integers for variables of an integer dtype."""
    changing = [number for number in remembered(subject, subject.scene) if number.changes]
    renewals = [call for call in subject.calls() if call.function in ("update", "remember")]
    if not renewals:
        raise NotApplicableError("its state variables do not change")
    what, answer = renewals[0].function, renewals[0].evaluate()
    for values in answer if what == "update" else [answer]:
        if len(values) != len(changing):
            returned = f"{len(values)} value{'s' * (len(values) != 1)}"
            fault = f"`{what}` returns {returned} for {len(changing)} changing state variables"
            raise PropertyError(f"{fault}; declare `changes=False` for constant ones")
        for number, value in zip(changing, map(np.asarray, values), strict=True):
            if not np.can_cast(value.dtype, number.dtype, "same_kind"):
                fault = f"`{what}` returns {value.dtype} for '{number.name}', which is declared"
                raise PropertyError(f"{fault} as {number.dtype}; fractions would be lost")


OF_REST_OFFSETS = {
    "gather": "; compute what depends on r alone, such as `length(r)`, in `weights`",
    "gather_pair": "; this also applies to what depends on r1 and r2 alone",
}
"""Remedies for numbers of double precision that are computed from rest offsets, by function."""


@property_of(FollowerRule, FractureModel, ParticleOperation)
def keeps_single_precision(subject: Subject) -> None:
    """Arguments of float32 give results of float32: a run in single precision must not change to
    double precision."""
    for call in _elementwise(subject):
        for name, value in flat(call.evaluate(_single)).items():
            kind = getattr(value, "dtype", None)
            if kind is not None and kind.kind == "f" and kind != np.float32:
                raise PropertyError(
                    f"`{call.function}` returns {kind} for float32 ({name}); set no dtype, and "
                    "convert parameters and constants to plain numbers by `float(...)`"
                    + OF_REST_OFFSETS.get(call.function, "")
                )


@property_of(FollowerRule, FractureModel, ParticleOperation, is_needed=True)
def takes_particles_in_any_order(subject: Subject) -> None:
    """Results do not depend on the order of particles; up to rounding, the move does not depend on
    the order in which neighbours are summed: numbering has no meaning."""
    order = np.random.default_rng(0).permutation(int(np.prod(SHAPE)))
    for call in _elementwise(subject):
        whole = call.answer()
        mixed = call.answer(lambda value: _in_order(value, order))
        for name, value in mixed.items():
            expected = _in_order(np.broadcast_to(whole[name], SHAPE), order)
            if (place := _apart(np.broadcast_to(value, SHAPE), expected)) is not None:
                fault = "returns another value for a particle if the particles are in another order"
                values = f"({name}: {value[place]} and {expected[place]})"
                raise PropertyError(f"`{call.function}` {fault} {values}")
    _refuse_an_order_of_rows(subject)
    if isinstance(subject.component, FollowerRule):
        _refuse_an_order_of_slots(subject.scene)


class Alike(np.random.Generator):
    """Generator that returns the same number in every call, so that results depend on arguments
    only."""

    def __getattribute__(self, name: str) -> Any:
        """Return a method that generates numbers and returns the first one repeatedly."""
        if name.startswith("_") or not callable(getattr(np.random.Generator, name)):
            return super().__getattribute__(name)

        def draw(*given: Any, **named: Any) -> Any:
            values = getattr(np.random.default_rng(SEED), name)(*given, **named)
            if name == "shuffle":
                given[0][...] = given[0][0]
            return np.full_like(values, values.flat[0]) if np.size(values) > 1 else values

        return draw


def _refuse_an_order_of_rows(subject: Subject) -> None:
    part = subject.component
    if not isinstance(part, Draws):
        return
    table = owners(subject.component, subject.scene)
    order = np.random.default_rng(0).permutation(len(table))
    mixed = type(table)(**{name: column[order] for name, column in vars(table).items()})
    first, second = (part.draw(rows, Alike(np.random.PCG64(SEED))) for rows in (table, mixed))
    for name, values in first.items():
        if not np.array_equal(np.asarray(values)[order], second[name]):
            remedy = "derive it from the content of a row, or from the generator"
            raise PropertyError(f"`draw` derives '{name}' from the number of the row; {remedy}")


def _refuse_an_order_of_slots(scene: Scene) -> None:
    d, at = differences(scene, 0), here(scene, 0)
    forwards, backwards = (flat(applied(scene, totals(scene, d, n), **at)) for n in (1, -1))
    for name, value in forwards.items():
        if _apart(value, backwards[name]) is not None:
            fault = f"the move depends on the order in which neighbours are summed ({name})"
            raise PropertyError(f"{fault}; do not sum large numbers that cancel")


@property_of(FollowerRule, FractureModel, ParticleOperation, is_needed=True)
def is_local(subject: Subject) -> None:
    """A call with the plain numbers of a single particle gives the same result as a call with the
    arrays of all particles: a result depends on the particle and its neighbours only."""
    for call in _elementwise(subject):
        whole = call.answer()
        for place in [(0, 0), (2, 1), (3, 2)]:
            try:
                alone = flat(call.evaluate(methodcaller("item", *place)))
            except Exception as error:
                fault = f"`{call.function}` fails with plain numbers instead of arrays"
                raise PropertyError(f"{fault}: {type(error).__name__}: {error}") from None
            for name, value in alone.items():
                among = np.broadcast_to(whole[name], SHAPE)[place]
                if np.shape(value) or _apart(value, among) is not None:
                    fault = "returns different values for a particle alone and among others"
                    values = f"({name}: {value} and {among}); it is not elementwise"
                    raise PropertyError(f"`{call.function}` {fault} {values}")


def _single(value: NDArray[Any]) -> NDArray[Any]:
    return value.astype(np.float32) if value.dtype.kind == "f" else value.copy()


def _elementwise(subject: Subject) -> list[FunctionCall]:
    return [call for call in subject.calls() if call.elementwise]


def _in_order(value: NDArray[Any], order: NDArray[np.intp]) -> NDArray[Any]:
    return value.reshape(-1)[order].reshape(value.shape)


def _apart(value: Any, expected: Any) -> tuple[int, ...] | None:
    """Return the first index at which two results differ by more than rounding."""
    answer, reference = np.asarray(value), np.asarray(expected)
    if answer.dtype == bool:
        differs = answer != reference
    else:
        size = max(1e-300, float(np.abs(reference).max(initial=0.0)))
        differs = ~(np.abs(answer - reference) <= ROUNDING * size)
    return next(map(tuple, np.argwhere(differs).tolist()), None)


CLOSE = 1e-9
"""A bond is tested at this distance from its breaking strain, relative to its length."""


@property_of(FractureModel, is_needed=True)
def is_seen_alike_from_both_ends(subject: Subject) -> None:
    """A bond breaks for both ends or for none: `breaks` and `update` return the same for (-d, -r)
    as for (d, r), and `constants` returns the same for a slot and for its opposite, because these
    functions are called for one end only."""
    model, scene = subject.component, subject.scene
    for plane in scene.neighbourhood.planes:
        constants, opposite = model.constants(plane.slot), model.constants(plane.opposite)
        if constants != opposite:
            fault = f"{constants} for the slot {plane.slot.site} and {opposite} for its opposite"
            raise PropertyError(f"`constants` are {fault}; use lengths and shells, not directions")
    evaluator, numbers = Evaluator(scene), remembers(model, scene, 0)
    cells = tuple(CellStress(*cell) for cell in stressed(model, 0))
    sides = _from_the_other_end([number.name for number in bond_numbers(scene.experiment)])
    numbers_opposite = tuple(numbers[n] for n in sides)
    functions: dict[str, list[tuple[CellStress, ...]]] = {"breaks": []}
    if isinstance(model, RenewsBonds):
        functions["update"] = [cells] if cells else []
    tried = differences(scene, 0, share=2.0)
    for slot, d in zip(scene.neighbourhood.slots[0], tried, strict=True):
        limits = scene.constants.limits[slot]
        for name, stresses in functions.items():
            function = getattr(evaluator, name)
            answer = function(d, slot.rest, limits, numbers, *stresses)
            opposite_stresses = (cells[::-1] for cells in stresses)
            answer_opposite = function(-d, -slot.rest, limits, numbers_opposite, *opposite_stresses)
            if stresses:
                answer_opposite = tuple(answer_opposite[n] for n in sides)
            if not np.array_equal(np.asarray(answer), np.asarray(answer_opposite)):
                along = f"for (-d, -r) than for (d, r) along {slot.site}"
                raise PropertyError(f"`{name}` returns other values {along}")


def _from_the_other_end(names: list[str]) -> list[int]:
    """Return the index of each state variable as seen from the other end of a bond.

    From the other end, left and right are exchanged.
    """
    turned = {"_left": "_right", "_right": "_left"}
    swapped = [
        next((n.removesuffix(a) + b for a, b in turned.items() if n.endswith(a)), n) for n in names
    ]
    return [names.index(n) for n in swapped]


@property_of(FractureModel)
def breaks_as_declared(subject: Subject) -> None:
    """With `can_break = False`, no bond breaks at any length: the scene then has no bond state."""
    scene = subject.scene
    if subject.component.can_break:
        return
    slots, breaks = scene.neighbourhood.slots[0], Evaluator(scene).breaks
    for slot, d in zip(slots, differences(scene, 0, share=1e3), strict=True):
        if np.any(breaks(d, slot.rest, scene.constants.limits[slot], ())):
            raise PropertyError("it declares `can_break = False`, but `breaks` returns True")


@property_of(FractureModel)
def breaks_beyond_its_strain(subject: Subject) -> None:
    """A bond that is extended along itself breaks slightly above the `breaking_strain` that the
    model declares, and does not break slightly below it unless it was broken before: `pbdkit
    explain` prints it."""
    model, scene = subject.component, subject.scene
    if not isinstance(subject.component, BreaksAtStrain):
        raise NotApplicableError("it does not declare `breaking_strain`")
    evaluator, numbers, p = Evaluator(scene), remembers(model, scene, 0), scene.constants.fracture
    for slot in scene.neighbourhood.slots[0]:
        r, limits = slot.rest, scene.constants.limits[slot]
        strain = model.breaking_strain(r, scene.constants.of_bond(*limits, *numbers), p)
        limit = np.broadcast_to(strain, SHAPE)
        for side, expected in ((CLOSE, True), (-CLOSE, False)):
            stretch = limit + side * (1.0 + np.abs(limit))
            d, renewed = r * stretch, [np.array(value) for value in numbers]
            evaluator.renew_bonds(d, r, limits, renewed, np.ones(SHAPE, bool))
            wrong = np.broadcast_to(evaluator.breaks(d, r, limits, renewed), SHAPE) != expected
            if wrong.any():
                where = f"at strain {stretch[wrong][0]:.6g} along {slot.site} the bond"
                fault = f"{where} {'does not break' if expected else 'breaks'}"
                raise PropertyError(f"`breaking_strain` and `breaks` disagree: {fault}")


@property_of(ParticleOperation)
def rests_as_declared(subject: Subject) -> None:
    """With `rests`, a particle that the rule does not move has exactly the same position after the
    operation, and any other particle moves: the operation does not change the equilibria of the
    rule."""
    if not subject.component.rests:
        raise NotApplicableError("it does not declare `rests`")
    (call,) = subject.calls()
    u, new = call.inputs["u"], call.inputs["new"]
    if differing(flat(call.compute(u, u)), flat(u)):
        raise PropertyError(
            "`displacement` moves a particle at rest; write it as `new` plus terms that vanish "
            "with `new - u`, or remove `rests`"
        )
    stays = np.all([a == b for a, b in zip(call.compute(u, new), u, strict=True)], axis=0)
    if stays.any():
        fault = "`displacement` holds a particle that the rule moves; remove `rests`"
        raise PropertyError(fault)


@property_of(FramePolicy)
def takes_every_point_alone(subject: Subject) -> None:
    """A frame point follows the same particles if `follow` is called with all frame points and if
    it is called with some of them. Ranks and tests require this, because they compute frame points
    separately."""
    policy, reason = subject.component, "it has no points"
    for scene in subject.scenes:
        frame = sites_of_frame(scene.raster, scene.experiment.rule)
        if frame is None:
            continue
        point, body = frame.nearest()
        whole = policy.follow(frame_showing(frame, frame.site, point, body))
        for points in (np.arange(0, len(frame.site), 2), np.array([len(frame.site) - 1])):
            is_in_points = np.isin(point, points)
            indices = np.searchsorted(points, point[is_in_points])
            try:
                subset = frame_showing(frame, frame.site[points], indices, body[is_in_points])
                part = policy.follow(subset)
            except ExperimentError as refusal:
                reason = reason and f"it accepts complete frames only: {refusal}"
                continue
            reason = ""
            for n, number in enumerate(points):
                if _followed(part, n) != _followed(whole, int(number)):
                    fault = (
                        f"frame point {number} follows another particle if there are fewer points"
                    )
                    raise PropertyError(f"{fault} ({place_of(scene.experiment)})")
    if reason:
        raise NotApplicableError(reason)


@property_of(FramePolicy)
def follows_nearby_particles(subject: Subject) -> None:
    """Points of a `local` frame follow only particles near them: the nearest ones, or those of
    which the site index differs by at most twice the number of layers."""
    policy = subject.component
    if not policy.local:
        raise NotApplicableError("it does not declare itself `local`")
    for scene in subject.scenes:
        raster = scene.raster
        frame = sites_of_frame(raster, scene.experiment.rule)
        if frame is None:
            continue
        follow, layers = policy.follow(frame), policy.depth(scene.neighbourhood.reach)
        distance = np.abs(raster.site_of(follow.body) - frame.site[follow.point]).max(axis=1)
        nearest = {*zip(*(each.tolist() for each in frame.nearest()), strict=True)}
        for entry in np.flatnonzero(distance > 2 * layers).tolist():
            point, body = int(follow.point[entry]), int(follow.body[entry])
            if (point, body) not in nearest:
                raise PropertyError(
                    f"frame point {point} follows a particle {distance[entry]} sites away, in a "
                    f"frame of {layers} layers ({place_of(scene.experiment)}); remove `local`"
                )


def _followed(follow: FrameMap, point: int) -> tuple[list[int], list[Any]]:
    """Return the body particles that a point follows, and their weights."""
    entries = follow.point == point
    return follow.body[entries].tolist(), follow.weight[entries].tolist()


@property_of(Diagnostic, is_needed=True)
def measures_what_it_declares(subject: Subject) -> None:
    """`measure` returns one array for each variable. The array has the shape of the variable's
    `dims`, and its values can be stored in the declared dtype without a change of kind."""
    diagnostic, scene = subject.component, subject.scene
    own_dimension = diagnostic.own_dimension
    sizes = {"particle": scene.raster.count, "axis": 2, "leader_group": len(scene.leading)}
    sizes |= {"load": len(scene.experiment.loads)}
    sizes |= {"obstacle": len(scene.barriers), "principal": 2}
    sizes |= {name: len(values) for name, values in diagnostic.coordinates().items()}
    variables = diagnostic.variables()
    measured = [np.asarray(value) for value in diagnostic.measure(moment_of(scene, 0))]
    if len(variables) != len(measured):
        raise PropertyError(f"{len(measured)} arrays for {len(variables)} variables")
    if own_dimension and not diagnostic.at_end:
        remedy = "requires `at_end`"
        raise PropertyError(f"its `own_dimension` '{own_dimension}' {remedy}")
    for variable, value in zip(variables, measured, strict=True):
        if own_dimension in variable.dims and value.ndim == len(variable.dims):
            # the length of the first variable with that dimension
            sizes.setdefault(own_dimension, value.shape[variable.dims.index(own_dimension)])
    for variable, value in zip(variables, measured, strict=True):
        for dim in variable.dims:
            if dim not in sizes:
                what = f"the dimension '{dim}', which is not in `coordinates`"
                raise PropertyError(f"'{variable.name}' has {what}")
        shape = tuple(sizes[dim] for dim in variable.dims)
        if value.shape != shape:
            raise PropertyError(f"'{variable.name}' has the shape {value.shape}, not {shape}")
        if not np.can_cast(value.dtype, variable.dtype, "same_kind"):
            fault = f"is declared as {variable.dtype}, but measured as {value.dtype}"
            raise PropertyError(f"'{variable.name}' {fault}; digits would be lost")


@property_of(Diagnostic)
def takes_rows_in_any_order(subject: Subject) -> None:
    """If rows are permuted, the values are permuted alike, up to rounding: the row of a particle
    is that of `now.rows(numbers)`, and no value depends on the order of rows."""
    diagnostic, scene = subject.component, subject.scene
    moment, order = moment_of(scene, 0), np.random.default_rng(0).permutation(scene.raster.count)
    values, permuted = diagnostic.measure(moment), diagnostic.measure(Shown(moment, order))
    variables = diagnostic.variables()
    for variable, value, permuted_value in zip(variables, values, permuted, strict=True):
        expected = np.asarray(value)
        for axis, dim in enumerate(variable.dims):
            expected = np.take(expected, order, axis) if dim == "particle" else expected
        size = float(np.nanmax(np.abs(expected), initial=1e-300))
        atol = ROUNDING * size
        if not np.allclose(permuted_value, expected, rtol=0.0, atol=atol, equal_nan=True):
            remedy = "use the rows of `now.rows(numbers)`"
            raise PropertyError(f"'{variable.name}' depends on the order of the rows; {remedy}")
