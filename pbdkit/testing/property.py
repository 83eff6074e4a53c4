"""What a property is, and a question: one call of a component with arrays that are kept."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pbdkit.interfaces import Component

if TYPE_CHECKING:
    from pbdkit.testing.subject import Subject
from dataclasses import replace
from typing import Any

import numpy as np

Check = Callable[["Subject"], None]


class PropertyError(Exception):
    """A property does not hold; the text names the fault, and the remedy where there is one."""


class NotAskedError(Exception):
    """A property says nothing about this component; the text is the reason."""


@dataclass(frozen=True)
class Property:
    """One thing that is asked of every component of some interfaces.

    `needs` names the properties without which its answer would mean nothing: where one of them
    does not hold, this one is not judged, so that a fault is reported once and by its own name.
    """

    name: str
    interfaces: tuple[type[Component], ...]
    check: Check
    needs: tuple[str, ...] = ()

    @property
    def asks(self) -> str:
        """What is asked, in one sentence: the first paragraph of the check's docstring."""
        return " ".join((inspect.getdoc(self.check) or "").split("\n\n")[0].split())

    def is_asked_of(self, component: type[Component]) -> bool:
        """Whether the component implements one of the interfaces."""
        return issubclass(component, self.interfaces)


def asked_of(
    *interfaces: type[Component], needs: tuple[str, ...] = ()
) -> Callable[[Check], Property]:
    """Makes a property of a check; its name is that of the function."""

    def make(check: Check) -> Property:
        return Property(check.__name__.replace("_", "-"), interfaces, check, needs)

    return make


Arrays = dict[str, Any]


@dataclass(frozen=True)
class Question:
    """One call: `what` is called, with which arrays, and how; answers are values by name.

    An `elementwise` one is asked with arrays of one shape, a value a particle or bond.
    """

    what: str
    inputs: Arrays
    ask: Callable[[Arrays], Arrays]
    elementwise: bool = False

    def answer(self) -> Arrays:
        """The answer to fresh copies of the inputs, as it was at that moment."""
        with np.errstate(all="ignore"):
            found = self.ask({name: np.array(value) for name, value in self.inputs.items()})
        return {name: np.array(value) for name, value in found.items()}

    def larger(self) -> Question:
        """The same with all that is no index ten times as large."""
        return replace(
            self,
            inputs={n: 10.0 * v if v.dtype.kind == "f" else v for n, v in self.inputs.items()},
        )
