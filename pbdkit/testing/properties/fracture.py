"""What is asked of fracture models."""

from __future__ import annotations

import numpy as np

from pbdkit.interfaces import FractureModel, Slot, Vector
from pbdkit.scene.scene import Scene
from pbdkit.testing.properties.answers import REPEATABLE
from pbdkit.testing.property import PropertyError, asked_of
from pbdkit.testing.questions import differences, vector
from pbdkit.testing.subject import Subject


@asked_of(FractureModel, needs=REPEATABLE)
def is_seen_alike_from_both_ends(subject: Subject) -> None:
    """A bond breaks for both ends or for none: `breaks` answers the same for (-d, -r) as for
    (d, r), and `constants` for a slot and its opposite; it is called for one end only."""
    model, scene = _model(subject), subject.scene()
    for plane in scene.neighbourhood.planes:
        here, there = model.constants(plane.slot), model.constants(plane.opposite)
        if here != there:
            raise PropertyError(
                f"`constants` are {here} for the slot {plane.slot.site} and {there} for its "
                "opposite: take lengths and shells, not directions"
            )
    for k, slot in enumerate(scene.neighbourhood.slots[0]):
        d = vector(differences(scene, 0, share=2.0), f"d{k}")
        back = Vector(-d.x, -d.y), Vector(-slot.rest.x, -slot.rest.y)
        if not np.array_equal(_breaks(model, scene, slot, d), _breaks(model, scene, slot, *back)):
            raise PropertyError(
                f"`breaks` answers otherwise for (-d, -r) than for (d, r) along {slot.site}"
            )


@asked_of(FractureModel, needs=REPEATABLE)
def breaks_as_declared(subject: Subject) -> None:
    """Where it declares `can_break = False` nothing breaks, however long: the scene then has no
    bond state."""
    model, scene = _model(subject), subject.scene()
    for k, slot in enumerate(scene.neighbourhood.slots[0]):
        d = vector(differences(scene, 0, share=1e3), f"d{k}")
        if not model.can_break and np.any(_breaks(model, scene, slot, d)):
            raise PropertyError("it declares `can_break = False`, and `breaks` says yes")


def _model(subject: Subject) -> FractureModel:
    assert isinstance(subject.component, FractureModel)
    return subject.component


def _breaks(
    model: FractureModel, scene: Scene, slot: Slot, d: Vector, r: Vector | None = None
) -> np.ndarray:
    c, p = model.constants(slot), scene.constants.fracture
    return np.asarray(model.breaks(d, slot.rest if r is None else r, c, p))
