"""Checkpoints: all data that determine how a run continues. They consist of facts, which are data
in the form of JSON, and of named arrays.

========== ====================================================================================
``about``  constant data: the experiment with its name and number of steps, the versions of pbdkit
           and of plugins, and the `origin`, the arguments of the command
``facts``  ``run``: the state of the driver. With the solver `stepping` it contains the
           attributes of `State`, the divergence guard and the steady-state monitor; with
           `equilibrium` the state and the load parameter.
           ``seen``: the last recorded steps
           ``chosen``: parameters that were `auto`
           ``step``, ``rate`` and ``at``: data for `pbdkit status`
``arrays`` the arrays to which the facts refer
========== ====================================================================================

`pbdkit.io.run_store` keeps checkpoints on the disk while a run is unfinished. The result contains
the last one as a separate group, so that the run can be continued.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import Field, dataclass, field, fields, is_dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.errors import StorageError
from pbdkit.hooks import pbdkit_version

if TYPE_CHECKING:
    from pbdkit.model.experiment import Experiment
    from pbdkit.stepping.state import State

Arrays = dict[str, Any]
"""Arrays by name. Some arrays are joined from parts when they are read."""


@dataclass
class RecordedSteps:
    """The last step that was observed, and the last step that was recorded. Each may be a fraction,
    for an equilibrium within a step."""

    step: float = -1
    recorded: float = -1


CLASSES: dict[str, type] = {"Seen": RecordedSteps}
"""Dataclasses of this module that a checkpoint contains, by their names in files."""
NAMES = {type_: name for name, type_ in CLASSES.items()}
"""Names of these dataclasses in files."""


@dataclass(frozen=True)
class Checkpoint:
    """The data that a run needs to continue, so that its result has the same bits as that of an
    uninterrupted run."""

    about: dict[str, Any]
    facts: dict[str, Any]
    arrays: Arrays = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        experiment: Experiment,
        run: Mapping[str, Any],
        recorded: RecordedSteps,
        step: int,
        chosen: Sequence[str] = (),
        rate: float = 0.0,
    ) -> Checkpoint:
        """Return the checkpoint of a run, given the state `run` of its driver. Arrays are not
        copied. `rate` is in steps per second."""
        arrays = Arrays()
        facts = {
            "run": pack(dict(run), "run", arrays),
            "seen": pack(recorded, "seen", arrays),
            "chosen": list(chosen),
            "step": step,
            "rate": rate,
            "at": time.time(),
        }
        about = {
            "name": experiment.name,
            "steps": experiment.steps,
            "experiment": experiment.model_dump_json(by_alias=True),
            "plugins": experiment.distributions(),
            "pbdkit": pbdkit_version(),
        }
        return cls(about, facts, arrays)

    def with_origin(self, origin: Mapping[str, Any]) -> Checkpoint:
        """Return the checkpoint with the arguments of the command that started the run."""
        return Checkpoint(self.about | {"origin": dict(origin)}, self.facts, self.arrays)

    def copied(self) -> Checkpoint:
        """Return a checkpoint with copies of the arrays."""
        arrays = {name: array.copy() for name, array in self.arrays.items()}
        return Checkpoint(self.about, self.facts, arrays)

    def state(self, state_class: type) -> tuple[Any, Any]:
        """Return only the state and the recorded steps. Raises KeyError, TypeError, ValueError or
        StorageError if they are damaged."""
        classes = CLASSES | {state_class.__name__: state_class}
        run = self.facts["run"]
        state = unpack(run["state"], self.arrays, classes)
        for each in fields(state_class):
            if not _is_stored(each) and each.name in run:
                setattr(state, each.name, float(run[each.name]))
        return state, unpack(self.facts["seen"], self.arrays, classes)

    def parts(
        self, like: Mapping[str, Any], steps: int, classes: Mapping[str, type]
    ) -> dict[str, Any]:
        """Return the parts of the driver's state, and the recorded steps under the key ``seen``.

        `like` is the state of the driver before its first step, `steps` the number of steps of the
        run, and `classes` are further dataclasses that the checkpoint may contain. Raises
        StorageError if the checkpoint is damaged or belongs to another scene.
        """
        try:
            facts = {**self.facts["run"], "seen": self.facts["seen"]}
        except (KeyError, TypeError) as error:
            raise StorageError(f"the stored state is damaged: {error}") from None
        if not _is_like(self.facts["run"], pack(dict(like), "run", Arrays())):
            raise StorageError(
                "the stored state is damaged: its structure differs from that of the run"
            )
        state_class = type(like["state"])
        parts: dict[str, Any] = unpack(
            facts, self.arrays, {**CLASSES, **classes, state_class.__name__: state_class}
        )
        state, recorded = parts.get("state"), parts.get("seen")
        if not (
            isinstance(state, state_class) and isinstance(recorded, RecordedSteps)
        ) or not state.fits(like["state"]):
            raise StorageError("the stored state belongs to another experiment")
        if not _is_consistent(state, recorded, parts, steps):
            raise StorageError("the stored state is damaged: its step counters are inconsistent")
        return parts


def _is_consistent(
    state: State, recorded: RecordedSteps, parts: dict[str, Any], steps: int
) -> bool:
    """Return whether the numbers of steps are in the right order. Otherwise the run might not
    end."""
    step = state.step
    guard, pace = parts.get("guard", {"good_step": 0, "next_look": step + 1}), parts.get("pace")
    try:
        earlier = [recorded.step, recorded.recorded, parts.get("kept", -1), guard["good_step"]]
        later = [guard["next_look"], pace.next_look if pace else step, steps]
        integral = all(isinstance(n, int) for n in (step, *earlier[2:], *later))
        # An equilibrium within a step may be recorded before the step is complete.
        latest = max(step, parts.get("moment", 0.0))
        in_order = min(earlier) >= -1 and max(earlier) <= latest and step <= min(later)
        in_order = in_order and 0.0 <= parts.get("moment", 0.0) <= steps
        return integral and in_order and (step < guard["next_look"] or step == steps)
    except (KeyError, TypeError, AttributeError):
        return False


def _is_like(facts: Any, template: Any) -> bool:
    """Return whether the entries of a checkpoint have the same types as those of a template, which
    describes a run before its first step.

    Where the template has None, the checkpoint may have a number, an array, or a list of numbers.
    """
    if isinstance(template, dict) and "array" not in template:
        same_keys = isinstance(facts, dict) and facts.keys() == template.keys()
        return same_keys and all(_is_like(facts[key], part) for key, part in template.items())
    if isinstance(facts, list):
        return (template is None or isinstance(template, list)) and all(
            _is_like(part, None) for part in facts
        )
    if isinstance(facts, dict):
        return facts.keys() == {"array"} and (template is None or isinstance(template, dict))
    if isinstance(template, str) or isinstance(facts, str):
        return isinstance(template, str) and isinstance(facts, str)
    if isinstance(facts, float):
        # The state of a run may contain infinity, but a number of steps must be finite.
        return not isinstance(template, int)
    return facts is None or (isinstance(facts, int) and abs(facts) < 2**63)


def _is_stored(attribute: Field[Any]) -> bool:
    """Return whether checkpoints contain an attribute as part of its object, and not only among the
    data of the driver."""
    return bool(attribute.metadata.get("checkpoint", True))


def pack(value: Any, name: str, arrays: Arrays) -> Any:
    """Convert a value to facts for JSON. Arrays in the value are added to `arrays`, with names that
    begin with `name`."""
    if hasattr(value, "dtype") and not isinstance(value, np.generic):
        arrays[name] = value
        return {"array": name}
    if is_dataclass(value):
        stored = [each.name for each in fields(value) if _is_stored(each)]
        parts = {field_name: getattr(value, field_name) for field_name in stored}
        inner = {key: pack(part, f"{name}.{key}", arrays) for key, part in parts.items()}
        return {"is": NAMES.get(type(value), type(value).__name__), **inner}
    if isinstance(value, dict):
        return {key: pack(part, f"{name}.{key}", arrays) for key, part in value.items()}
    if isinstance(value, tuple | list):
        return [pack(part, f"{name}.{n}", arrays) for n, part in enumerate(value)]
    return value.item() if isinstance(value, np.generic) else value


def unpack(facts: Any, arrays: Mapping[str, NDArray[Any]], classes: Mapping[str, type]) -> Any:
    """Return the value that was converted to facts by `pack`. `classes` are the dataclasses that
    may occur, by name. Raises StorageError for all other content."""
    if isinstance(facts, list):
        return tuple(unpack(part, arrays, classes) for part in facts)
    if not isinstance(facts, dict):
        return facts
    try:
        if "array" in facts:
            return arrays[facts["array"]]
        parts = {key: unpack(p, arrays, classes) for key, p in facts.items() if key != "is"}
        return classes[facts["is"]](**parts) if "is" in facts else parts
    except (KeyError, TypeError) as error:
        raise StorageError(f"the stored state is damaged: {error}") from None
