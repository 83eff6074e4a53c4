"""What is kept of a run."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator
from typing import Annotated, Any, Literal

from pydantic import Field, model_serializer, model_validator

from pbdkit.interfaces.component import Strict

Steps = Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(strict=False, min_length=1)]


class Record(Strict):
    """Every so many steps, or at chosen ones; time 0 and the last step always.

    Under `solver: {type: equilibrium}` each of these steps is an equilibrium; `increments` also
    records those found between them. `dtype` is that of recorded positions and diagnostics; the run
    itself is not affected.
    `compression` is that of the file: zlib makes it smaller, and writing it slower.
    """

    every: Annotated[int, Field(ge=1)] = 1
    at: Steps | None = None
    increments: bool = False
    dtype: Literal["float64", "float32"] = "float64"
    compression: Literal["none", "zlib"] = "none"

    @model_validator(mode="after")
    def _one_way(self) -> Record:
        if self.at is not None:
            if "every" in self.model_fields_set:
                raise ValueError("give `every` or `at`, not both")
            if any(a >= b for a, b in zip(self.at, self.at[1:], strict=False)):
                raise ValueError(f"`at` must increase, got {list(self.at[:8])}")
        return self

    @model_serializer
    def _serialize(self) -> dict[str, Any]:
        which: dict[str, Any] = {"every": self.every}
        if self.at is not None:
            which = {"at": list(self.at)}
        which |= {"increments": True} if self.increments else {}
        return which | {"dtype": self.dtype, "compression": self.compression}

    def keeps(self, step: int, steps: int) -> bool:
        """Whether that step of a run of `steps` is recorded."""
        return step in (0, self.next_after(step - 1, steps))

    def steps_before(self, steps: int) -> Iterator[int]:
        """The recorded steps of a run of `steps` between its start and its last step."""
        step = self.next_after(0, steps)
        while step < steps:
            yield step
            step = self.next_after(step, steps)

    def next_after(self, step: int, steps: int) -> int:
        """The first recorded step after `step`, in a run of `steps`."""
        if self.at is None:
            return min(steps, (step // self.every + 1) * self.every)
        place = bisect_right(self.at, step)
        return min([steps, *self.at[place : place + 1]])

    def count(self, steps: int) -> int:
        """How many steps of a run of `steps` are recorded."""
        if self.at is None:
            return steps // self.every + 1 + (steps % self.every > 0)
        return len({0, steps, *(step for step in self.at if step <= steps)})
