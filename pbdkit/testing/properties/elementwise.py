"""What is asked of functions that are called with whole arrays, single numbers or probes."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import BreaksAtStrain, Draws, FollowerRule, FractureModel, RenewsBonds
from pbdkit.scene.scene import Scene
from pbdkit.stepping.evaluator import Evaluator
from pbdkit.testing.fault import NotAskedError, PropertyError
from pbdkit.testing.property import asked_of
from pbdkit.testing.question import Question, applied, flat, gathered
from pbdkit.testing.states import SEED, SHAPE, differences, here, owners, remembers
from pbdkit.testing.subject import Subject

ROUNDING = 1e-12
"""Some thousand roundings: functions of numpy may differ in the last digit from place to place."""


@asked_of(FollowerRule, FractureModel, is_needed=True)
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
    contributions, at = gathered(scene, differences(scene, 0)), here(scene, 0)
    one = applied(scene, contributions, **at)
    other = applied(scene, contributions[::-1], **at)
    for name, value in one._asdict().items():
        if _apart(np.asarray(value), np.asarray(getattr(other, name))) is not None:
            raise PropertyError(
                f"the move depends on the order in which neighbours are summed ({name}): do not "
                "sum large numbers that cancel"
            )


@asked_of(FollowerRule, FractureModel, is_needed=True)
def is_local(subject: Subject) -> None:
    """A particle that is asked about alone, with plain numbers, gets the answer that it gets among
    the others: only itself and its neighbours count."""
    for question in _elementwise(subject):
        whole = question.answer()
        for place in [(0, 0), (2, 1), (3, 2)]:
            try:
                alone = flat(question.asked(partial(_item, place)))
            except Exception as error:
                raise PropertyError(
                    f"`{question.what}` fails with plain numbers in the place of arrays: "
                    f"{type(error).__name__}: {error}"
                ) from None
            for name, value in alone.items():
                among = np.broadcast_to(whole[name], SHAPE)[place]
                if np.shape(value) or _apart(np.asarray(value), np.asarray(among)) is not None:
                    raise PropertyError(
                        f"`{question.what}` gives a particle another answer alone than among "
                        f"others ({name}: {value} and {among}): it is not elementwise"
                    )


def _item(place: tuple[int, int], value: NDArray[Any]) -> Any:
    return value[place].item()


def _single(value: NDArray[Any]) -> NDArray[Any]:
    return value.astype(np.float32) if value.dtype.kind == "f" else value.copy()


CLOSE = 1e-9
"""How near to its breaking strain a bond is tried, as a share of its length."""


@asked_of(FractureModel, is_needed=True)
def is_seen_alike_from_both_ends(subject: Subject) -> None:
    """A bond breaks for both ends or for none: `breaks` and `update` answer the same for (-d, -r)
    as for (d, r), and `constants` for a slot and its opposite; they are called for one end only."""
    model, scene = subject.component, subject.scene()
    for plane in scene.neighbourhood.planes:
        here, there = model.constants(plane.slot), model.constants(plane.opposite)
        if here != there:
            raise PropertyError(
                f"`constants` are {here} for the slot {plane.slot.site} and {there} for its "
                "opposite: take lengths and shells, not directions"
            )
    evaluator, own = Evaluator(scene), remembers(model, scene, 0)
    asks = {"breaks": evaluator.breaks}
    if isinstance(model, RenewsBonds):
        asks["update"] = evaluator.update
    slots = scene.neighbourhood.slots[0]
    for slot, d in zip(slots, differences(scene, 0, share=2.0), strict=True):
        limits = scene.constants.limits[slot]
        for what, ask in asks.items():
            one, other = ask(d, slot.rest, limits, own), ask(-d, -slot.rest, limits, own)
            if not np.array_equal(np.asarray(one), np.asarray(other)):
                raise PropertyError(
                    f"`{what}` answers otherwise for (-d, -r) than for (d, r) along {slot.site}"
                )


@asked_of(FractureModel)
def breaks_as_declared(subject: Subject) -> None:
    """Where it declares `can_break = False` nothing breaks, however long: the scene then has no
    bond state."""
    model, scene = subject.component, subject.scene()
    if model.can_break:
        return
    slots, breaks = scene.neighbourhood.slots[0], Evaluator(scene).breaks
    for slot, d in zip(slots, differences(scene, 0, share=1e3), strict=True):
        if np.any(breaks(d, slot.rest, scene.constants.limits[slot], ())):
            raise PropertyError("it declares `can_break = False`, and `breaks` says yes")


@asked_of(FractureModel)
def breaks_beyond_its_strain(subject: Subject) -> None:
    """Where it tells a `breaking_strain`, a bond that is drawn out along itself breaks a little
    above it and, if it has not broken, not a little below: `pbdkit explain` tells users so."""
    model, scene = subject.component, subject.scene()
    tells = isinstance(model, BreaksAtStrain)
    if not tells:
        raise NotAskedError("it tells no `breaking_strain`")
    evaluator, own, p = Evaluator(scene), remembers(model, scene, 0), scene.constants.fracture
    for slot in scene.neighbourhood.slots[0]:
        r, limits = slot.rest, scene.constants.limits[slot]
        c = scene.constants.of_bond(*limits, *own)
        told = model.breaking_strain(r, c, p)
        limit = np.broadcast_to(told, SHAPE)
        for side, expected in ((CLOSE, True), (-CLOSE, False)):
            stretch = limit + side * (1.0 + np.abs(limit))
            d = r * stretch
            now = [np.array(value) for value in own]
            evaluator.renew_bonds(d, r, limits, now, np.ones(SHAPE, bool))
            wrong = np.broadcast_to(evaluator.breaks(d, r, limits, now), SHAPE) != expected
            if wrong.any():
                at = float(stretch[wrong][0])
                raise PropertyError(
                    f"`breaking_strain` and `breaks` disagree: at strain {at:.6g} along "
                    f"{slot.site} the bond {'stays' if expected else 'breaks'}"
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
