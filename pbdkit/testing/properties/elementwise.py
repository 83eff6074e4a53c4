"""What is asked of functions that are called with whole arrays, single numbers or probes."""

from __future__ import annotations

from operator import methodcaller
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import Draws, FollowerRule, FractureModel
from pbdkit.scene.scene import Scene
from pbdkit.testing.properties.start import remembered
from pbdkit.testing.question import Question, flat
from pbdkit.testing.states import SEED, SHAPE, applied, differences, gathered, here, owners
from pbdkit.testing.subject import NotAskedError, PropertyError, Subject, asked_of

ROUNDING = 1e-12
"""Some thousand roundings: functions of numpy may differ in the last digit from place to place."""


@asked_of(FollowerRule, FractureModel, is_needed=True)
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


@asked_of(FollowerRule, FractureModel)
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


@asked_of(FollowerRule, FractureModel, is_needed=True)
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


@asked_of(FollowerRule, FractureModel, is_needed=True)
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
