"""Forces of an experiment, along x and y: they may be written with a unit, and change in time."""

from __future__ import annotations

from typing import Annotated

from pydantic import Discriminator, Field, Tag

from pbdkit.interfaces.course import COURSE, PLAIN, Course, form_of
from pbdkit.interfaces.units import BODY_FORCE, FORCE


class ForceCourse(Course[Annotated[float, FORCE]]):
    """Of a force."""


class BodyForceCourse(Course[Annotated[float, BODY_FORCE]]):
    """Of a force on a unit of area."""


OneForce = Annotated[
    Annotated[float, FORCE, Tag(PLAIN)] | Annotated[ForceCourse, Tag(COURSE)],
    Discriminator(form_of),
]
Force = Annotated[tuple[OneForce, OneForce], Field(strict=False)]
"""Two forces; an experiment file writes them as a list of two."""
OneBodyForce = Annotated[
    Annotated[float, BODY_FORCE, Tag(PLAIN)] | Annotated[BodyForceCourse, Tag(COURSE)],
    Discriminator(form_of),
]
BodyForce = Annotated[tuple[OneBodyForce, OneBodyForce], Field(strict=False)]
"""Two forces on a unit of area."""
