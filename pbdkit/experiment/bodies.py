"""Bodies: which sites of the lattice are particles (model.md, section 3). A closed family."""

from __future__ import annotations

from abc import abstractmethod
from typing import Annotated, Literal

from pydantic import Field, SerializeAsAny

from pbdkit.experiment.parts import closed_part
from pbdkit.interfaces import Component, Lattice
from pbdkit.interfaces.lattice import Index

Count = Annotated[int, Field(ge=1, le=2**31)]


class Body(Component):
    """An outline that is filled with the sites of a lattice."""

    @abstractmethod
    def window(self, lattice: Lattice) -> tuple[Index, Index]:
        """The smallest and the largest site index (i, j); sites between that exist are the body."""


class Grid(Body):
    """`columns` × `rows` sites from (0, 0)."""

    type: Literal["grid"] = "grid"
    columns: Count
    rows: Count

    def window(self, lattice: Lattice) -> tuple[Index, Index]:
        """(0, 0) to (columns - 1, rows - 1)."""
        return (0, 0), (self.columns - 1, self.rows - 1)


AnyBody = Annotated[SerializeAsAny[Body], closed_part(Body, Grid)]
