"""Built-in components of earlier versions, and the ones that they are read as until version 1.0."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pbdkit.errors import ExperimentError
from pbdkit.interfaces import INTERFACES
from pbdkit.registry import BUILTIN


@dataclass(frozen=True)
class Retired:
    """A built-in component that was removed: its `type` in a `field` of an experiment, the type
    that takes its place, and how results differ. `renumbers` is true where particles get other
    numbers."""

    field: str
    type: str
    successor: str
    difference: str
    renumbers: bool = False

    @property
    def advice(self) -> str:
        """The warning of experiments that name it."""
        return (
            f"'{self.type}' is retired and read as '{self.successor}' until version 1.0; "
            f"{self.difference}; write {self.field}: {{type: {self.successor}}}"
        )


RETIRED = (
    Retired(
        field="frame",
        type="traction-free",
        successor="natural",
        difference="the body then ends at its outermost particles, not half a spacing outside "
        "them, and no frame points are numbered",
        renumbers=True,
    ),
)


def retired_parts(parts: Mapping[str, Any]) -> list[Retired]:
    """Return the retired components that the parts of an experiment name."""
    found = []
    for one in RETIRED:
        part = parts.get(one.field)
        name = part.get("type") if isinstance(part, Mapping) else None
        if name in (one.type, f"{BUILTIN}:{one.type}"):
            found.append(one)
    return found


def with_successors(parts: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parts with the successors of retired components in their places."""
    renewed = {
        one.field: {**parts[one.field], "type": one.successor} for one in retired_parts(parts)
    }
    return {**parts, **renewed}


def refuse_retired(parts: Mapping[str, Any], what: str) -> None:
    """Raise ExperimentError where a scene that was run cannot be built again, since the parts of
    its experiment name a retired component; `what` needs the scene."""
    for one in retired_parts(parts):
        raise ExperimentError(
            f"{what} needs the scene that was run, and its {one.field} '{one.type}' is retired; "
            f"run the experiment anew, with {one.field}: {{type: {one.successor}}}"
        )


def is_retired(interface: type | None, name: str) -> bool:
    """Return whether a type is the name of a retired component of an interface."""
    return any(name == one.type and INTERFACES[one.field] is interface for one in RETIRED)
