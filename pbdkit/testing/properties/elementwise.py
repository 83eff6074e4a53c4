"""What is asked of functions that are called with whole arrays, single numbers or probes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import Draws, FollowerRule, FractureModel
from pbdkit.scene.scene import Scene
from pbdkit.testing.calls import applied, differences, gathered, here
from pbdkit.testing.properties.repetition import REPEATABLE
from pbdkit.testing.property import Arrays, PropertyError, Question, asked_of
from pbdkit.testing.states import SEED, SHAPE, owners
from pbdkit.testing.subject import Subject

ROUNDING = 1e-12
"""Some thousand roundings: functions of numpy may differ in the last digit from place to place."""
ORDERLY = (*REPEATABLE, "renews-what-it-remembers", "returns-a-value-a-particle")


@asked_of(FollowerRule, FractureModel, needs=REPEATABLE)
def returns_a_value_a_particle(subject: Subject) -> None:
    """Each component of an answer is one value a particle, or one number for all of them; a rule
    contributes as many from every neighbour, and `breaks` says yes or no."""
    for question in _elementwise(subject):
        for name, value in question.answer().items():
            if value.shape not in ((), SHAPE):
                raise PropertyError(
                    f"`{question.what}` returns the shape {value.shape} for particles of shape "
                    f"{SHAPE} ({name}): it is not elementwise"
                )
    if isinstance(subject.component, FollowerRule):
        scene = subject.scene()
        counts = {len(c) for c in gathered(scene, differences(scene, 0))}
        if len(counts) > 1:
            raise PropertyError(f"`gather` returns now {min(counts)}, now {max(counts)} values")


@asked_of(FollowerRule, FractureModel, needs=(*REPEATABLE, "renews-what-it-remembers"))
def keeps_single_precision(subject: Subject) -> None:
    """Numbers of float32 get answers of float32: a run in single precision is one throughout."""
    for question in _elementwise(subject):
        single = {
            name: value.astype(np.float32) if value.dtype.kind == "f" else value.copy()
            for name, value in question.inputs.items()
        }
        with np.errstate(all="ignore"):
            found = question.ask(single)
        for name, value in found.items():
            kind = getattr(value, "dtype", None)
            if kind is not None and kind.kind == "f" and kind != np.float32:
                raise PropertyError(
                    f"`{question.what}` returns {kind} for float32 ({name}): leave the dtype to "
                    "the arithmetic, and make parameters and constants plain numbers, `float(...)`"
                )


@asked_of(FollowerRule, FractureModel, needs=ORDERLY)
def takes_particles_in_any_order(subject: Subject) -> None:
    """Particles in another order get the same answers in that order, and neighbours summed in the
    opposite order the same move, to rounding: numbering means nothing."""
    order = np.random.default_rng(0).permutation(int(np.prod(SHAPE)))
    for question in _elementwise(subject):
        mixed = {name: _in_order(value, order) for name, value in question.inputs.items()}
        whole = question.answer()
        with np.errstate(all="ignore"):
            found = question.ask(mixed)
        for name, value in found.items():
            expected = _in_order(np.broadcast_to(whole[name], SHAPE), order)
            if (place := _apart(np.broadcast_to(value, SHAPE), expected)) is not None:
                raise PropertyError(
                    f"`{question.what}` gives a particle another answer where it stands in another "
                    f"order ({name}: {value[place]} and {expected[place]})"
                )
    _refuse_an_order_of_rows(subject)
    if isinstance(subject.component, FollowerRule):
        _refuse_an_order_of_slots(subject.scene())


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
    part, scene = subject.component, subject.scene()
    if not isinstance(part, Draws):
        return
    shown = owners(subject.component, scene)
    order = np.random.default_rng(0).permutation(len(shown))
    mixed = type(shown)(**{name: table[order] for name, table in vars(shown).items()})
    one, other = (part.draw(rows, Alike(np.random.PCG64(SEED))) for rows in (shown, mixed))
    for name, values in one.items():
        if not np.array_equal(np.asarray(values)[order], other[name]):
            raise PropertyError(
                f"`draw` gives '{name}' by the row: take it from what a row holds, or from the "
                "generator"
            )


def _refuse_an_order_of_slots(scene: Scene) -> None:
    arrays = differences(scene, 0) | here(scene, 0)
    contributions = gathered(scene, arrays)
    one = applied(scene, contributions, arrays)
    other = applied(scene, contributions[::-1], arrays)
    for name, value in one.items():
        if _apart(np.asarray(value), np.asarray(other[name])) is not None:
            raise PropertyError(
                f"the move depends on the order in which neighbours are summed ({name}): do not "
                "sum large numbers that cancel"
            )


@asked_of(FollowerRule, FractureModel, needs=(*ORDERLY, "takes-particles-in-any-order"))
def is_local(subject: Subject) -> None:
    """A particle that is asked about alone, with plain numbers, gets the answer that it gets among
    the others: only itself and its neighbours count."""
    for question in _elementwise(subject):
        whole = question.answer()
        for place in [(0, 0), (2, 1), (3, 2)]:
            alone = {name: value[place].item() for name, value in question.inputs.items()}
            try:
                with np.errstate(all="ignore"):
                    found = question.ask(alone)
            except Exception as error:
                raise PropertyError(
                    f"`{question.what}` fails with plain numbers in the place of arrays: "
                    f"{type(error).__name__}: {error}"
                ) from None
            _compare_alone(question.what, found, whole, place)


def _compare_alone(what: str, found: Arrays, whole: Arrays, place: tuple[int, int]) -> None:
    for name, value in found.items():
        among = np.broadcast_to(whole[name], SHAPE)[place]
        if np.shape(value) or _apart(np.asarray(value), np.asarray(among)) is not None:
            raise PropertyError(
                f"`{what}` gives a particle another answer alone than among others "
                f"({name}: {value} and {among}): it is not elementwise"
            )


def _elementwise(subject: Subject) -> list[Question]:
    return [question for question in subject.questions() if question.elementwise]


def _in_order(value: NDArray[Any], order: NDArray[np.intp]) -> NDArray[Any]:
    return value.reshape(-1)[order].reshape(value.shape)


def _apart(one: NDArray[Any], other: NDArray[Any]) -> tuple[int, ...] | None:
    """The first place at which two answers differ by more than rounding."""
    if one.dtype == bool:
        differs = one != other
    else:
        size = max(1e-300, float(np.abs(other).max(initial=0.0)))
        differs = ~(np.abs(one - other) <= ROUNDING * size)
    places = np.argwhere(differs)
    return tuple(places[0].tolist()) if len(places) else None
