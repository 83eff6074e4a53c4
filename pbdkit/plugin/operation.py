"""The interface ParticleOperation, and selections of body particles in experiments."""

from __future__ import annotations

from abc import abstractmethod
from typing import Annotated, Any, ClassVar, Literal

from pydantic import ConfigDict, Field, model_serializer, model_validator

from pbdkit.plugin.component import Component, Strict
from pbdkit.plugin.units import LENGTH, Place
from pbdkit.plugin.vector import Parameters, Vector

Length = Annotated[float, LENGTH]
Box = Annotated[tuple[Length, Length, Length, Length], Field(strict=False)]
Numbers = Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(strict=False, min_length=1)]
Points = Annotated[tuple[Place, ...], Field(strict=False, min_length=1)]


class Selection(Strict):
    """Selection of body particles in the reference configuration, by one of five criteria.

    - `edge`: the outermost particle of every row (left, right) or column (bottom, top).
    - `box`: the particles within [xmin, ymin, xmax, ymax], including its sides.
    - `numbers`: the particles with these numbers.
    - `nearest`: the particle nearest to each point.
    - `region`: the particles inside a region.
    """

    model_config = ConfigDict(json_schema_extra={"minProperties": 1, "maxProperties": 1})

    edge: Literal["left", "right", "bottom", "top"] | None = None
    box: Box | None = None
    numbers: Numbers | None = None
    nearest: Points | None = None
    region: str | None = None

    @model_validator(mode="after")
    def _exactly_one(self) -> Selection:
        if len(self._criteria()) != 1:
            raise ValueError("give exactly one of edge, box, numbers, nearest, region")
        return self

    def _criteria(self) -> dict[str, Any]:
        names = type(self).model_fields
        return {n: getattr(self, n) for n in names if getattr(self, n) is not None}

    @model_serializer
    def _serialize(self) -> dict[str, Any]:
        return self._criteria()


class ParticleOperation(Component):
    """Changes the displacement of selected particles in each step, after the move of their rule.

    To add an operation, write `displacement`, a static and elementwise function, like those of a
    rule. In a step it is applied after the move with relaxation and momentum and before obstacles.
    Afterwards leaders are placed at their prescribed positions, and frame points follow. Operations
    are applied in the order in which the experiment lists them.
    """

    rests: ClassVar[bool] = False
    """True if ``displacement(u, new, p)`` is exactly u for `new` = u and differs from u for any
    other `new`. The operation then does not change the equilibria of the rule. An experiment that
    computes an equilibrium can contain only such operations."""

    select: Selection | None = Field(
        None, description="The particles that are changed; by default all of the body."
    )

    def parameters(self) -> dict[str, float]:
        """Return the numbers that `displacement` receives as ``p.name``.

        By default these are the numeric fields.

        Returns
        -------
        dict of str to float
            Numbers by name.
        """
        return self.numeric_parameters()

    @staticmethod
    @abstractmethod
    def displacement(u: Vector, new: Vector, p: Parameters) -> Vector:
        """Return the displacement of a particle at the end of the step, elementwise.

        Parameters
        ----------
        u : Vector
            Displacement at the beginning of the step, in lattice units.
        new : Vector
            Displacement after the move of the rule and preceding operations.
        p : Parameters
            Parameters of the operation.

        Returns
        -------
        Vector
            Displacement, in lattice units.
        """
