"""What a dataset says of the run that made it, as JSON in its attributes."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from pbdkit.errors import ExperimentError, StorageError
from pbdkit.experiment.model import Experiment
from pbdkit.experiment.source import Source
from pbdkit.interfaces import Component
from pbdkit.registry.registry import GIVEN
from pbdkit.registry.retired import refuse_retired
from pbdkit.results.older_layout import refuse_no_dataset
from pbdkit.scene.scene import Scene, build_scene

if TYPE_CHECKING:
    import xarray


def carried(dataset: xarray.Dataset, attribute: str) -> dict[str, Any]:
    """The map in an attribute, or in the coordinate that it is for one run of several; empty where
    there is neither. Raises StorageError where it is damaged."""
    beside = dataset.coords.get(attribute)
    text = "{}" if beside is None or beside.ndim else beside.item()
    try:
        found = json.loads(dataset.attrs.get(attribute, text))
    except (ValueError, TypeError, RecursionError) as error:
        raise StorageError(f"its attribute '{attribute}' is damaged: {error}") from None
    if not isinstance(found, dict):
        raise StorageError(f"its attribute '{attribute}' is damaged: it holds no map of keys")
    return found


def scene_of(dataset: xarray.Dataset, what: str) -> Scene:
    """Build the scene of the run that made a dataset, which `what` needs.

    Raises ExperimentError where it cannot be built, as where a component of it is retired.
    """
    refuse_retired(carried(dataset, "experiment"), what)
    return build_scene(experiment_of(dataset))


def experiment_of(
    dataset: xarray.Dataset, components: Iterable[type[Component]] = ()
) -> Experiment:
    """The experiment that a dataset carries. Raises ExperimentError where there is none, or where
    it wants components that are not there."""
    refuse_no_dataset(dataset)
    parts = carried(dataset, "experiment")
    if not parts:
        raise ExperimentError("the dataset carries no experiment: pbdkit did not make it")
    source = Source("dataset", parts)
    try:
        return Experiment.build(source, components)
    except ExperimentError as error:
        given = carried(dataset, "plugins").get(GIVEN)
        if given is None or components:
            raise
        raise ExperimentError(f"{error}; it was run with components=[...]: {given}") from None
