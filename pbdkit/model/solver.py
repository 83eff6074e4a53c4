"""Settings of the solver (stepping or equilibrium), and of recording."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator
from functools import cache
from typing import Annotated, Any, ClassVar, Literal

from pydantic import (
    Discriminator,
    Field,
    SerializeAsAny,
    SerializerFunctionWrapHandler,
    Tag,
    model_serializer,
    model_validator,
)

from pbdkit.errors import ExperimentError
from pbdkit.model.validation import closed_part, fault
from pbdkit.plugin import Component
from pbdkit.plugin.component import Strict
from pbdkit.plugin.schedule import PLAIN, TIME_DEPENDENT, WORD, TimeDependent, form_of, last
from pbdkit.plugin.units import ENERGY, LENGTH, Place

Steps = Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(strict=False, min_length=1)]
"""Type of a list of recorded steps."""


class Record(Strict):
    """Recorded steps: every n-th, or a list; time 0 and the last step are always recorded.

    With `solver: {type: equilibrium}` an equilibrium is computed and recorded for each of these
    steps; with `increments` equilibria between them are recorded too. `dtype` is the data type of
    recorded positions and diagnostics and does not affect the computation. `compression` is the
    compression of the file: zlib makes the file smaller and writing slower.
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
                raise ValueError("`every` and `at` exclude each other; give one of them")
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
        """Return whether a step of a run of `steps` is recorded."""
        return step in (0, self.next_after(step - 1, steps))

    def steps_before(self, steps: int) -> Iterator[int]:
        """Generate the recorded steps of a run of `steps` between its start and its last step."""
        step = self.next_after(0, steps)
        while step < steps:
            yield step
            step = self.next_after(step, steps)

    def next_after(self, step: int, steps: int) -> int:
        """Return the first recorded step after `step`, in a run of `steps`."""
        if self.at is None:
            return min(steps, (step // self.every + 1) * self.every)
        place = bisect_right(self.at, step)
        return min([steps, *self.at[place : place + 1]])

    def count(self, steps: int) -> int:
        """Return the number of recorded steps of a run of `steps`."""
        if self.at is None:
            return steps // self.every + 1 + (steps % self.every > 0)
        return len({0, steps, *(step for step in self.at if step <= steps)})


def _form_of(value: object) -> str:
    """Return the form of a value: a number, a time-dependent number, or the word `auto`."""
    return WORD if isinstance(value, str) else form_of(value)


Word = Annotated[Literal["auto"], Tag(WORD)]
"""Type of the word `auto`."""
Threads = Annotated[
    Word | Annotated[int, Field(ge=1, le=1024), Tag(PLAIN)], Discriminator(_form_of)
]
"""Type of a number of threads, or `auto`."""
_Relaxation = Annotated[float, Field(gt=0.0, le=1e6)]


class TimeDependentRelaxation(TimeDependent[_Relaxation]):
    """Relaxation that depends on time."""


Relaxation = Annotated[
    Word
    | Annotated[_Relaxation, Tag(PLAIN)]
    | Annotated[TimeDependentRelaxation, Tag(TIME_DEPENDENT)],
    Discriminator(_form_of),
]
"""Type of the relaxation: a number, time-dependent, or `auto`."""
_Memory = Annotated[float, Field(ge=-1e6, le=1e6)]


class TimeDependentMomentum(TimeDependent[_Memory]):
    """Momentum coefficient that depends on time."""


Memory = Annotated[
    Word | Annotated[_Memory, Tag(PLAIN)] | Annotated[TimeDependentMomentum, Tag(TIME_DEPENDENT)],
    Discriminator(_form_of),
]
"""Type of the momentum coefficient: a number, time-dependent, or `auto`."""


class SteadyStateCriterion(Strict):
    """Settings that end a run before its last step if it has converged.

    A run has converged if the distance of every follower from equilibrium is below a tolerance.

    `tolerance` is relative to the largest prescribed displacement.
    """

    tolerance: Annotated[float, Field(gt=0.0, lt=1.0)] = 1e-6


class Solver(Component):
    """Method that advances a scene from its start to its end."""

    makes_steps: ClassVar[bool] = True
    """True if every step is computed."""

    @property
    def stepping(self) -> Stepping:
        """Settings of a single step. They are the defaults unless this solver is `stepping`."""
        return _stepping()

    @property
    def equilibrium(self) -> Equilibrium:
        """Settings of an equilibrium. They are the defaults unless this solver is `equilibrium`."""
        return _equilibrium()

    @property
    def time_dependent(self) -> dict[str, TimeDependent[float]]:
        """Time-dependent parameters by name."""
        return {}


@cache
def _stepping() -> Stepping:
    return Stepping()


@cache
def _equilibrium() -> Equilibrium:
    return Equilibrium()


class Stepping(Solver):
    """Compute one step after the other.

    `relaxation` w and `memory` b modify the move of any rule, for followers only: x(t+1) = m + w ·
    move + b · (x(t) - x(t-1)). Both can be time-dependent. With `auto`, their values are chosen so
    that the slowest mode of the scene decays fastest; results contain these values. `engine` is
    numpy, compiled or gpu; `auto` selects the faster one of numpy and compiled. `precision` is the
    precision of the computation, and `threads` the number of threads of the compiled engine. With
    `settle`, the run ends when it has converged, at the latest after `steps`.
    """

    type: Literal["stepping"] = "stepping"
    engine: Literal["auto", "numpy", "compiled", "gpu"] = "auto"
    precision: Literal["float64", "float32"] = "float64"
    threads: Threads = "auto"
    relaxation_setting: Relaxation = Field(default=1.0, alias="relaxation")
    memory_setting: Memory = Field(default=0.0, alias="memory")
    settle: SteadyStateCriterion | None = None

    @property
    def stepping(self) -> Stepping:
        """This solver itself, because it has these settings."""
        return self

    @property
    def is_open(self) -> bool:
        """True if a parameter has yet to be selected for the scene."""
        return bool(self.open_parameters)

    @property
    def open_parameters(self) -> tuple[str, ...]:
        """Names of the parameters that have yet to be selected for the scene."""
        settings = {"relaxation": self.relaxation_setting, "memory": self.memory_setting}
        return tuple(name for name, setting in settings.items() if setting == "auto")

    @property
    def time_dependent(self) -> dict[str, TimeDependent[float]]:
        """Time-dependent relaxation and momentum, by name."""
        settings = {"relaxation": self.relaxation_setting, "memory": self.memory_setting}
        return {name: value for name, value in settings.items() if isinstance(value, TimeDependent)}

    def at(self, moment: float) -> Stepping:
        """Return the settings with the values of their parameters at a time, in steps."""
        values = {
            f"{name}_setting": number.at(moment) for name, number in self.time_dependent.items()
        }
        return self.model_copy(update=values)

    @property
    def relaxation(self) -> float:
        """Last value of the relaxation w.

        Raises
        ------
        ExperimentError
            If it is `auto`.
        """
        return _number(self.relaxation_setting, "relaxation")

    @property
    def memory(self) -> float:
        """Last value of the momentum coefficient b.

        Raises
        ------
        ExperimentError
            If it is `auto`.
        """
        return _number(self.memory_setting, "memory")

    def with_weights(self, relaxation: float, memory: float) -> Stepping:
        """Return the settings with the given values of relaxation and momentum."""
        values = {"relaxation_setting": relaxation, "memory_setting": memory}
        return self.model_copy(update=values)


def _number(setting: Literal["auto"] | float | TimeDependent[float], name: str) -> float:
    if setting == "auto":
        text = "'auto' has no value yet; select it with pbdkit.stability.relaxation.tuned"
        raise ExperimentError(text, ("solver", name))
    return last(setting)


Toward = Annotated[tuple[float, float], Field(strict=False)]
"""Type of a direction; its length does not matter."""


class Control(Component):
    """Quantity that is prescribed in place of the load."""


class OpeningControl(Control):
    """Prescribe the relative displacement of two points; the load follows from it.

    The points are the body particles nearest to `between`. The opening is the component of the
    displacement of the second one, minus that of the first one, along `direction`; by default this
    is the direction from the first point to the second one. It grows from 0 to `to` in equal parts,
    one for each step. The prescribed displacements and the loads of the last step are multiplied by
    the load factor that causes the opening.
    """

    type: Literal["opening"] = "opening"
    between: Annotated[tuple[Place, Place], Field(strict=False)] = Field(
        description="Two points; the nearest particles are used.",
        examples=[((9.0, 0.0), (11.0, 0.0))],
    )
    direction: Toward | None = Field(
        None, description="Direction of the opening; by default from the first point to the second."
    )
    to: Annotated[float, Field(ge=-1e100, le=1e100), LENGTH] = Field(
        description="Opening in the last step.", examples=[0.1]
    )

    @model_validator(mode="after")
    def _has_direction(self) -> OpeningControl:
        if self.to == 0.0:
            raise fault("the opening in the last step is 0; give a length other than 0", key="to")
        if self.direction is not None and not any(self.direction):
            raise fault("the direction is zero; give one, such as [1, 0]", key="direction")
        return self


class DissipationControl(Control):
    """Prescribe the dissipated energy; the load follows from it.

    The first step ends at the load at which damage begins. In each further step the same energy is
    dissipated, up to `to` in the last one. The prescribed displacements and the loads of the last
    step are multiplied by the load factor at which this energy has been dissipated.
    """

    type: Literal["dissipation"] = "dissipation"
    to: Annotated[float, Field(gt=0.0, le=1e100), ENERGY] = Field(
        description="Energy that has been dissipated in the last step, divided by Young's modulus "
        "and thickness (lattice units); with a unit also the energy.",
        examples=[1e-4],
    )


AnyControl = Annotated[
    SerializeAsAny[Control], closed_part(Control, OpeningControl, DissipationControl)
]
"""Type of the control of an equilibrium branch."""


class Equilibrium(Solver):
    """Compute the limit of the steps directly, with leaders at their last prescribed positions.

    Particles are leaders or followers as in the last step. `tolerance` is the largest distance from
    equilibrium, relative to the largest prescribed displacement. If bonds can break, the motion of
    the leaders is divided into `increments`, which can be shorter than a step, and an equilibrium
    is computed for each. With nonlinear rules, the number of increments is adaptive. `method` is
    the method for linear systems: lu, multigrid (as the preconditioner of an iteration) or
    conjugate-gradients (without preconditioner); auto selects a method by the size of the system.
    With `control` the load is an unknown: the equilibria of a branch are computed for prescribed
    openings or dissipated energies, one for each step, beyond the peak of the load too.
    """

    makes_steps: ClassVar[bool] = False
    type: Literal["equilibrium"] = "equilibrium"
    method: Literal["auto", "lu", "multigrid", "conjugate-gradients"] = "auto"
    tolerance: Annotated[float, Field(gt=0.0, lt=1.0)] = 1e-8
    increments: Annotated[int, Field(ge=1, le=100_000)] = 100
    control: AnyControl | None = None

    @model_serializer(mode="wrap")
    def _as_written(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Omit `control` from the serialised solver if there is none."""
        result: dict[str, Any] = serialize(self)
        if self.control is None:
            result.pop("control", None)
        return result

    @property
    def equilibrium(self) -> Equilibrium:
        """This solver itself, because it has these settings."""
        return self


AnySolver = Annotated[
    SerializeAsAny[Stepping | Equilibrium], closed_part(Solver, Stepping, Equilibrium)
]
"""Type of the solver in an experiment."""
