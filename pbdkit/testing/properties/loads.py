"""What is asked of rules that take loads."""

from __future__ import annotations

import numpy as np

from pbdkit.interfaces import FollowerRule, Loadable
from pbdkit.interfaces.rule import material_of
from pbdkit.stepping.evaluator import Evaluator, summed
from pbdkit.testing.question import flat
from pbdkit.testing.states import differences, gathered, here, standing
from pbdkit.testing.subject import NotAskedError, PropertyError, Subject, asked_of

ROUNDING = 1e-9
"""As a share of the largest number: sums cancel."""


@asked_of(FollowerRule)
def bears_loads_as_forces(subject: Subject) -> None:
    """Where it takes loads, one adds itself to `force`, what it adds to the move is the same
    wherever neighbours stand, and none changes nothing."""
    rule, scene = subject.component, subject.scene
    if not isinstance(rule, Loadable):
        raise NotAskedError("it takes no loads")
    if material_of(subject.component) is None:
        raise NotAskedError("its parameters leave it without a material")
    evaluator, p = Evaluator(scene), scene.constants.rule
    load, added = here(scene, 1)["u"], []
    for seed in (0, 1):
        total = summed((c, None) for c in gathered(scene, differences(scene, seed)))
        at, under = standing(scene, **here(scene, seed)), rule.loaded(total, load, p)
        _compare(evaluator.force(under, at), evaluator.force(total, at) + load, "the force is not")
        still = flat(rule.loaded(total, 0.0 * load, p))
        if any(np.any(still[name] != value) for name, value in flat(total).items()):
            raise PropertyError("`loaded` changes the sums where the load is 0")
        added.append(evaluator.move(total, at, load) - evaluator.move(total, at))
    _compare(added[0], added[1], "what it adds to the move is not, wherever neighbours stand,")


def _compare(one: object, other: object, what: str) -> None:
    expected = flat(other)
    size = max(float(np.abs(value).max()) for value in expected.values())
    for name, value in flat(one).items():
        if not (np.abs(value - expected[name]) <= ROUNDING * size).all():
            raise PropertyError(f"`loaded`: {what} the same as without, and the load ({name})")
