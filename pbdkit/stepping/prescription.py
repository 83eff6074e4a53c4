"""What the leaders prescribe in a step, and for how many steps that stays so."""

from __future__ import annotations

import math

import numpy as np

from pbdkit.errors import ExperimentError
from pbdkit.interfaces.frame import Indices
from pbdkit.scene.leader_groups import Leading
from pbdkit.scene.obstacles import Barrier
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import Floats, State

Led = list[tuple[Indices, Floats]]
"""(place, u) of the particles that lead, u as (axis, particle)."""
Starts = tuple[Floats | None, ...]


def prescribe(scene: Scene, state: State, moment: float) -> tuple[Led, Starts]:
    """The leaders of a step with their displacements at its end, or at a moment within it, and
    where each motion has started."""
    led: Led = []
    starts: list[Floats | None] = []
    step = math.ceil(moment)
    for leading, begun in zip(scene.leading, state.starts, strict=True):
        if leading.group.leads(step):
            if begun is None:
                begun = state.u.reshape(scene.axes, -1)[:, leading.place].copy()
            n_th = moment - leading.group.from_ + 1
            offset = leading.group.motion.offset(n_th, leading.reference + begun.T)
            led.append((leading.place, begun + np.atleast_2d(offset).T))
        starts.append(begun)
    if scene.leaders_overlap and len(led) > 1:
        _refuse_contradiction(scene, led, step)
    return led, tuple(starts)


def _refuse_contradiction(scene: Scene, led: Led, step: int) -> None:
    """What could not be known before: groups that move one particle differently from where it
    stands."""
    places = np.concatenate([p for p, _ in led])
    u = np.concatenate([v for _, v in led], axis=1)
    order = np.argsort(places, kind="stable")
    apart = np.abs(np.diff(u[:, order], axis=1)).max(axis=0) > 1e-9 * max(1.0, np.abs(u).max())
    clashes = np.flatnonzero((np.diff(places[order]) == 0) & apart)
    if len(clashes):
        place = places[order[clashes[:1]]]
        number = int(scene.raster.rows_at(*np.unravel_index(place, scene.raster.shape))[0]) + 1
        raise ExperimentError(
            f"two groups move particle {number} differently in step {step}; select it in one of "
            "them only, or let one end before the other begins",
            ("leaders",),
        )


def steady_steps(scene: Scene, step: int, most: int) -> int:
    """How many steps from `step` on have the same leaders and obstacles at the same places, at most
    `most`, at least 1."""
    for leading in scene.driven:
        group = leading.group
        begins, ends = group.from_, group.last(step + most)
        if begins <= step <= ends:
            most = min(most, ends - step + 1)
            rests = group.motion.rests_after()
            if rests is None or step - begins + 1 < rests:
                return 1
        elif step < begins:
            most = min(most, begins - step)
    return most


def last_event(scene: Scene) -> int:
    """The last step within the run at which leaders or obstacles move or roles change, at least
    1."""
    steps, events = scene.experiment.steps, [1]
    for leading in scene.driven:
        first, last = leading.group.from_, leading.group.last(steps)
        rests = leading.group.motion.rests_after() or 0
        moments = (first, last + 1, min(last, first - 1 + rests))
        events += [step for step in moments if step <= steps]
    return max(events)


def is_cut_short(leading: Leading | Barrier, steps: int) -> bool:
    """Whether a group leads in the last step, and its motion is not over then."""
    rests = leading.group.motion.rests_after()
    over = rests is not None and leading.group.from_ - 1 + rests <= steps
    return leading.group.leads(steps) and not over


def place(u: Floats, led: Led) -> None:
    """Puts leaders where they are prescribed."""
    flat = u.reshape(len(u), -1)
    for places, values in led:
        flat[:, places] = values
