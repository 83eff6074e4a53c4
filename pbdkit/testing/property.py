"""What a property is."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pbdkit.interfaces import Component

if TYPE_CHECKING:
    from pbdkit.testing.subject import Subject

Check = Callable[["Subject"], None]


@dataclass(frozen=True)
class Property:
    """One thing that is asked of every component of some interfaces.

    Where one that `is_needed` does not hold, those after it are not judged: their answers would
    mean nothing, and a fault is reported once and by its own name.
    """

    name: str
    interfaces: tuple[type[Component], ...]
    check: Check
    is_needed: bool = False

    @property
    def asks(self) -> str:
        """What is asked, in one sentence: the first paragraph of the check's docstring."""
        return " ".join((inspect.getdoc(self.check) or "").split("\n\n")[0].split())


def asked_of(*interfaces: type[Component], is_needed: bool = False) -> Callable[[Check], Property]:
    """Makes a property of a check; its name is that of the function."""

    def make(check: Check) -> Property:
        return Property(check.__name__.replace("_", "-"), interfaces, check, is_needed)

    return make
