"""Channels of a test: numbers that are measured in each state of a run.

A curve is one channel as a function of another one, such as the load as a function of the opening
of a crack.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pbdkit.array_types import Floats
from pbdkit.components.diagnostics import reactions
from pbdkit.components.gauges import Extensometer, Gauge
from pbdkit.errors import ExperimentError, no_such
from pbdkit.io.snapshot import StateMoment, Tables
from pbdkit.model.solver import OpeningControl
from pbdkit.plugin.units import FORCE, LENGTH, Quantity
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State


class Channel(ABC):
    """A number that is measured in each state."""

    @property
    def quantity(self) -> Quantity | None:
        """Quantity of the number; None if it has no dimension."""
        return None

    @property
    @abstractmethod
    def label(self) -> str:
        """Label of the number in figures and messages."""

    @abstractmethod
    def read(self, time: float, state: State, tables: Tables) -> float:
        """Return the number in a state, in lattice units. Forces are divided by Young's modulus and
        thickness."""

    def range_in(self, scene: Scene) -> tuple[float, float] | None:
        """Return the smallest and the largest value in a run; None if only its results contain
        them."""
        return None


@dataclass(frozen=True)
class Time(Channel):
    """Number of steps from the start of a run."""

    label = "time (step)"

    def read(self, time: float, state: State, tables: Tables) -> float:
        """Return the number of steps."""
        return time


@dataclass(frozen=True)
class DirectedChannel(Channel):
    """Component, along a direction, of a vector that belongs to a leader group or to a load.

    Parameters
    ----------
    number
        Index of the group or of the load.
    direction
        Unit vector.
    """

    number: int
    direction: tuple[float, float]
    name: ClassVar[str]

    @property
    def label(self) -> str:
        """Name with the index."""
        return f"{self.name} {self.number}"

    def read(self, time: float, state: State, tables: Tables) -> float:
        """Return the component of the vector."""
        moment = StateMoment(state, tables, time=time)
        return float(np.dot(self.direction, self.vector(moment, tables)))

    @abstractmethod
    def vector(self, moment: StateMoment, tables: Tables) -> Floats:
        """Return the vector, (axis,)."""


class GroupForce(DirectedChannel):
    """Force that a leader group exerts."""

    quantity, name = FORCE, "force on group"

    def vector(self, moment: StateMoment, tables: Tables) -> Floats:
        """Return the reaction of the group."""
        return np.asarray(reactions(moment)[self.number])


class LoadForce(DirectedChannel):
    """Resultant of a load."""

    quantity, name = FORCE, "load"

    def vector(self, moment: StateMoment, tables: Tables) -> Floats:
        """Return the resultant of the load."""
        rows = moment.loads()[self.number]
        return np.asarray(rows.share.sum() * np.asarray(rows.force))


class GroupDisplacement(DirectedChannel):
    """Mean displacement of the particles of a leader group."""

    quantity, name = LENGTH, "displacement of group"

    def vector(self, moment: StateMoment, tables: Tables) -> Floats:
        """Return the mean displacement."""
        rows = tables.scene.leading[self.number].rows
        return np.asarray(moment.displacement(rows).mean(axis=0))


class LoadDisplacement(DirectedChannel):
    """Mean displacement of the particles of a load, weighted by their shares."""

    quantity, name = LENGTH, "displacement of load"

    def vector(self, moment: StateMoment, tables: Tables) -> Floats:
        """Return the weighted mean displacement."""
        rows = moment.loads()[self.number]
        return np.asarray(rows.share @ moment.displacement(rows.rows) / rows.share.sum())


@dataclass(frozen=True)
class GaugeReading(Channel):
    """Value of a gauge."""

    gauge: Gauge

    @property
    def quantity(self) -> Quantity | None:
        """Length of an extensometer; a strain has no dimension."""
        return LENGTH if isinstance(self.gauge, Extensometer) else None

    @property
    def label(self) -> str:
        """Name of the measured quantity."""
        return self.gauge.symbol

    def read(self, time: float, state: State, tables: Tables) -> float:
        """Return the value of the gauge."""
        (value,) = self.gauge.measure(StateMoment(state, tables, time=time))
        return float(value)


@dataclass(frozen=True)
class ControlledOpening(GaugeReading):
    """Opening that the control of the solver prescribes."""

    label = "opening"

    @classmethod
    def of(cls, scene: Scene) -> ControlledOpening:
        """Return the opening of the control.

        Raises
        ------
        ExperimentError
            If the solver has no control of an opening.
        """
        control = scene.experiment.solver.equilibrium.control
        if not isinstance(control, OpeningControl):
            raise ExperimentError(
                "`opening` is the opening that the solver prescribes, but its `control` is not "
                "{type: opening, ...}; name the points: {type: extensometer, between: ...}",
                ("measured", "against"),
            )
        return cls(Extensometer(between=control.between, direction=control.direction))

    def range_in(self, scene: Scene) -> tuple[float, float] | None:
        """Return 0 and the opening of the last step, in increasing order."""
        control = scene.experiment.solver.equilibrium.control
        assert isinstance(control, OpeningControl)
        return min(0.0, control.to), max(0.0, control.to)


UNIT_VECTORS = {"x": (1.0, 0.0), "y": (0.0, 1.0)}
"""Unit vectors of the axes."""


def unit_vector(axis: str | tuple[float, float]) -> tuple[float, float]:
    """Return the unit vector of an axis, or that along a vector."""
    if isinstance(axis, str):
        return UNIT_VECTORS[axis]
    size = float(np.hypot(*axis))
    return axis[0] / size, axis[1] / size


def direction_of_load(scene: Scene, load: int) -> tuple[float, float]:
    """Return the direction of the force of a load in the last step.

    Raises
    ------
    ExperimentError
        If there is no such load, or its force is zero.
    """
    loads = scene.loads.each if scene.loads else ()
    if load >= len(loads):
        raise ExperimentError(no_such("load", load, len(loads)), ("measured", "load"))
    force: Floats = loads[load].load.force_at(scene.experiment.steps)
    if not force.any():
        raise ExperimentError(
            f"the force of load {load} is zero in the last step, so that it has no direction; "
            "give `axis`",
            ("measured", "load"),
        )
    return unit_vector((float(force[0]), float(force[1])))
