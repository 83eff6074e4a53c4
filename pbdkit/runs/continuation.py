"""A run that has not begun goes on from where another one stood."""

from __future__ import annotations

from typing import Any

from pbdkit.errors import StorageError
from pbdkit.results.recorder import Recorder, Seen
from pbdkit.runs.drivers import Driver
from pbdkit.runs.processes import Processes
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State
from pbdkit.storage.standing import Arrays, Standing, put_together, taken_apart

KINDS: dict[str, type] = {"State": State, "Seen": Seen}


def take_up(
    driver: Driver,
    recorder: Recorder,
    standing: Standing | None,
    processes: Processes,
    recorded: int | None = None,
) -> None:
    """Lets a run that has not begun go on from a standing that the first process has; `recorded` is
    the last step recorded, where that is another one than was kept. Raises StorageError for the
    standing of another scene."""
    own, parts = driver.standing(), dict[str, Any]()
    with processes.agreeing():
        if standing:
            parts = _parts(driver.scene, own, standing)
            _refuse_unfit(driver.scene, own["state"], parts)
            if recorded is not None:
                parts["kept"] = parts["seen"].recorded = recorded
    recorder.seen = processes.told(parts.get("seen"))
    driver.take_up(parts)


def _refuse_unfit(scene: Scene, like: State, parts: dict[str, Any]) -> None:
    state, seen = parts.get("state"), parts.get("seen")
    if not isinstance(seen, Seen) or not isinstance(state, State) or not state.fits(like):
        raise StorageError("the state that was kept is not one of this experiment")
    if not _is_possible(scene, state, seen, parts):
        raise StorageError("the state that was kept is damaged: it is none that a run comes to")


def _is_possible(scene: Scene, state: State, seen: Seen, parts: dict[str, Any]) -> bool:
    """Whether steps follow each other, so that a run that goes on comes to its end."""
    now, steps = state.step, scene.experiment.steps
    guard, pace = parts.get("guard", {"good_step": 0, "next_look": now + 1}), parts.get("pace")
    try:
        past = [seen.step, seen.recorded, parts.get("kept", -1), guard["good_step"]]
        coming = [guard["next_look"], pace.next_look if pace else now, steps]
        whole = all(isinstance(step, int) for step in (now, *past[2:], *coming))
        # An equilibrium may be recorded within a step, and that of steps that are yet to be made.
        latest = max(now, parts.get("moment", 0.0))
        in_order = min(past) >= -1 and max(past) <= latest and now <= min(coming)
        in_order = in_order and 0.0 <= parts.get("moment", 0.0) <= steps
        return whole and in_order and (now < guard["next_look"] or now == steps)
    except (KeyError, TypeError, AttributeError):
        return False


def _is_like(found: Any, own: Any) -> bool:
    """Whether facts are of the kinds of a run's own; what it does not know yet may be a number, an
    array, or numbers."""
    if isinstance(own, dict) and "array" not in own:
        same = isinstance(found, dict) and found.keys() == own.keys()
        return same and all(_is_like(found[key], part) for key, part in own.items())
    if isinstance(found, list):
        return (own is None or isinstance(own, list)) and all(
            _is_like(part, None) for part in found
        )
    if isinstance(found, dict):
        return found.keys() == {"array"} and (own is None or isinstance(own, dict))
    if isinstance(own, str) or isinstance(found, str):
        return isinstance(own, str) and isinstance(found, str)
    if isinstance(found, float):
        return not isinstance(own, int)  # infinite is what a run may find, and no step
    return found is None or (isinstance(found, int) and abs(found) < 2**63)


def _parts(scene: Scene, own_standing: dict[str, Any], standing: Standing) -> dict[str, Any]:
    kinds = dict(KINDS)
    own = taken_apart(own_standing, "run", Arrays())
    if scene.experiment.stepping.settle:
        from pbdkit.equilibrium.settlement import Pace

        kinds["Pace"] = Pace
    try:
        facts = {**standing.facts["run"], "seen": standing.facts["seen"]}
    except (KeyError, TypeError) as error:
        raise StorageError(f"the state that was kept is damaged: {error}") from None
    if not _is_like(standing.facts["run"], own):
        raise StorageError("the state that was kept is damaged: it is of other kinds")
    found: dict[str, Any] = put_together(facts, standing.arrays, kinds)
    return found
