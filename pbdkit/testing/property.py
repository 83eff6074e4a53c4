"""What a property is: a name, the interfaces it is asked of, and a check that raises."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pbdkit.interfaces import Component

if TYPE_CHECKING:
    from pbdkit.testing.subject import Subject

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
