"""What is asked of fracture models."""

from __future__ import annotations

from typing import Any

import numpy as np

from pbdkit.interfaces import BreaksAtStrain, FractureModel, RenewsBonds, Slot
from pbdkit.scene.declarations import bond_numbers
from pbdkit.scene.scene import Scene
from pbdkit.testing.calls import breaking, differences, updated, vector
from pbdkit.testing.properties.elementwise import ORDERLY
from pbdkit.testing.properties.repetition import REPEATABLE
from pbdkit.testing.property import NotAskedError, PropertyError, asked_of
from pbdkit.testing.states import SHAPE, own_of, remembered_of_bonds
from pbdkit.testing.subject import Subject

CLOSE = 1e-9
"""How near to its breaking strain a bond is tried, as a share of its length."""


@asked_of(FractureModel, needs=REPEATABLE)
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
    own = own_of(remembered_of_bonds(scene, 0))
    for k, slot in enumerate(scene.neighbourhood.slots[0]):
        d = vector(differences(scene, 0, share=2.0), f"d{k}")
        back, r = -d, -slot.rest
        asks = [("breaks", breaking)]
        if isinstance(model, RenewsBonds):
            asks.append(("update", updated))
        for what, ask in asks:
            one, other = ask(scene, slot, d, own), ask(scene, slot, back, own, r)
            if not np.array_equal(np.asarray(one), np.asarray(other)):
                raise PropertyError(
                    f"`{what}` answers otherwise for (-d, -r) than for (d, r) along {slot.site}"
                )


@asked_of(FractureModel, needs=REPEATABLE)
def breaks_as_declared(subject: Subject) -> None:
    """Where it declares `can_break = False` nothing breaks, however long: the scene then has no
    bond state."""
    model, scene = subject.component, subject.scene()
    for k, slot in enumerate(scene.neighbourhood.slots[0]):
        d = vector(differences(scene, 0, share=1e3), f"d{k}")
        if not model.can_break and np.any(breaking(scene, slot, d, ())):
            raise PropertyError("it declares `can_break = False`, and `breaks` says yes")


LOCAL = (*ORDERLY, "takes-particles-in-any-order", "is-local")


@asked_of(FractureModel, needs=(*LOCAL, "is-seen-alike-from-both-ends"))
def breaks_beyond_its_strain(subject: Subject) -> None:
    """Where it tells a `breaking_strain`, a bond that is drawn out along itself breaks a little
    above it and, if it has not broken, not a little below: `pbdkit explain` tells users so."""
    model, scene = subject.component, subject.scene()
    tells = isinstance(model, BreaksAtStrain)
    own, p = own_of(remembered_of_bonds(scene, 0)), scene.constants.fracture
    if not tells:
        raise NotAskedError("it tells no `breaking_strain`")
    for slot in scene.neighbourhood.slots[0]:
        r, c = slot.rest, scene.constants.of_bond(*scene.constants.limits[slot], *own)
        told = model.breaking_strain(r, c, p)
        limit = np.broadcast_to(told, SHAPE)
        for side, expected in ((CLOSE, True), (-CLOSE, False)):
            stretch = limit + side * (1.0 + np.abs(limit))
            d = r * stretch
            now = _renewed(model, scene, slot, d, own)
            wrong = np.broadcast_to(breaking(scene, slot, d, now), SHAPE) != expected
            if wrong.any():
                at = float(stretch[wrong][0])
                raise PropertyError(
                    f"`breaking_strain` and `breaks` disagree: at strain {at:.6g} along "
                    f"{slot.site} the bond {'stays' if expected else 'breaks'}"
                )


def _renewed(
    model: FractureModel, scene: Scene, slot: Slot, d: Any, own: tuple[Any, ...]
) -> tuple[Any, ...]:
    """The numbers of bonds after an update."""
    if not isinstance(model, RenewsBonds):
        return own
    new = iter(updated(scene, slot, d, own))
    numbers = bond_numbers(scene.experiment)
    return tuple(next(new) if n.changes else v for n, v in zip(numbers, own, strict=True))
