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
from pbdkit.errors import ExperimentError
from pbdkit.io.snapshot import StateMoment, Tables
from pbdkit.model.solver import OpeningControl
from pbdkit.plugin.units import FORCE, LENGTH, Quantity
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State


class Channel(ABC):
    """A number that is measured in each state."""

    quantity: ClassVar[Quantity | None] = None
    """Quantity of the number; None if it has no dimension."""

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
class GroupForce(Channel):
    """Force that a leader group exerts along a direction."""

    quantity = FORCE
    group: int
    direction: tuple[float, float]

    @property
    def label(self) -> str:
        """Label with the index of the group."""
        return f"force on group {self.group}"

    def read(self, time: float, state: State, tables: Tables) -> float:
        """Return the component of the reaction of the group."""
        moment = StateMoment(state, tables)
        return float(np.dot(self.direction, reactions(moment)[self.group]))


@dataclass(frozen=True)
class LoadForce(Channel):
    """Component of a load along a direction."""

    quantity = FORCE
    load: int
    direction: tuple[float, float]

    @property
    def label(self) -> str:
        """Label with the index of the load."""
        return f"load {self.load}"

    def read(self, time: float, state: State, tables: Tables) -> float:
        """Return the component of the resultant of the load."""
        rows = StateMoment(state, tables, time=time).loads()[self.load]
        return float(rows.share.sum() * np.dot(self.direction, rows.force))


@dataclass(frozen=True)
class GroupDisplacement(Channel):
    """Mean displacement of a leader group along a direction."""

    quantity = LENGTH
    group: int
    direction: tuple[float, float]

    @property
    def label(self) -> str:
        """Label with the index of the group."""
        return f"displacement of group {self.group}"

    def read(self, time: float, state: State, tables: Tables) -> float:
        """Return the mean displacement of the particles of the group."""
        place = tables.scene.leading[self.group].place
        flat = state.u.reshape(len(state.u), -1)[:, place]
        return float(np.dot(self.direction, flat.mean(axis=1)))


@dataclass(frozen=True)
class LoadDisplacement(Channel):
    """Mean displacement of the particles of a load along a direction, weighted by their shares."""

    quantity = LENGTH
    load: int
    direction: tuple[float, float]

    @property
    def label(self) -> str:
        """Label with the index of the load."""
        return f"displacement of load {self.load}"

    def read(self, time: float, state: State, tables: Tables) -> float:
        """Return the weighted mean displacement."""
        moment = StateMoment(state, tables, time=time)
        rows = moment.loads()[self.load]
        mean = rows.share @ moment.displacement(rows.rows) / rows.share.sum()
        return float(np.dot(self.direction, mean))


@dataclass(frozen=True)
class GaugeReading(Channel):
    """Value of a gauge."""

    gauge: Gauge

    @property
    def quantity(self) -> Quantity | None:  # type: ignore[override]  # depends on the gauge
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
        raise ExperimentError(f"there is no load {load}", ("measured", "load"))
    force: Floats = loads[load].load.force_at(scene.experiment.steps)
    if not force.any():
        raise ExperimentError(
            f"the force of load {load} is zero in the last step, so that it has no direction; "
            "give `axis`",
            ("measured", "load"),
        )
    return unit_vector((float(force[0]), float(force[1])))
