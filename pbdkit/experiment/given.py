"""Classes that were handed over in Python, which only this process knows."""

from __future__ import annotations

from pbdkit.experiment.model import Experiment
from pbdkit.interfaces import Component
from pbdkit.registry.registry import GIVEN


def given_classes(experiment: Experiment) -> tuple[type[Component], ...]:
    """Those that the parts of an experiment are of."""
    types = experiment.distributions().get(GIVEN, "").split(", ")
    return tuple({type(part): None for part in experiment.components() if part.type in types})
