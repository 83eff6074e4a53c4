"""All that the page of one run holds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.drawing.outline import lattice_unit
from pbdkit.errors import ExperimentError, PbdkitError
from pbdkit.pages.bonds import Bonds, bonds_of
from pbdkit.pages.curves import curves, fewer_points
from pbdkit.pages.lattice import bytes_a_particle, in_units, moving, resting, spacing_of
from pbdkit.pages.naming import factor_of
from pbdkit.pages.origin import experiment_text, facts, file_name, title_of
from pbdkit.pages.settling import settling
from pbdkit.pages.thinning import thinned
from pbdkit.results.carried import carried, scene_of
from pbdkit.scene.raster import LEADER
from pbdkit.scene.scene import Scene

if TYPE_CHECKING:
    import xarray


@dataclass(frozen=True)
class Origin:
    """The scene of the experiment that a dataset carries, None where it cannot be built here, and
    why it cannot."""

    scene: Scene | None
    fault: str = ""


def origin_of(dataset: xarray.Dataset) -> Origin:
    """Of a dataset: a page can be made without it, and then says what is missing."""
    try:
        return Origin(scene_of(dataset, "the lattice of a page"))
    except PbdkitError as error:
        return Origin(None, str(error))


class RunContent:
    """What `report.js` shows of a run. Raises ExperimentError for a dataset without positions."""

    def __init__(self, dataset: xarray.Dataset) -> None:
        _refuse_no_motion(dataset)
        origin = origin_of(dataset)
        parts = carried(dataset, "experiment")
        title = title_of(dataset)
        self._dataset = dataset
        self._reference = reference_of(dataset, origin.scene)
        self._bonds, self._notes = _bonds(dataset, origin)
        self._whole = {
            "what": "run",
            "title": title,
            "file": file_name(title),
            "facts": facts(dataset),
            "experiment": experiment_text(parts) if parts else "",
            "settling": settling(dataset, origin.scene),
            "ledger": self._bonds.ledger() if self._bonds and self._bonds.can_break else None,
        }

    def within(self, budget: int) -> dict[str, Any]:
        """All of it, where the moving lattice takes about `budget` bytes before it is packed."""
        dataset, reference, bonds = self._dataset, self._reference, self._bonds
        shown = thinned(dataset, leaders_of(dataset), bytes_a_particle(dataset), budget)
        spacing = bonds.spacing if bonds else spacing_of(reference)
        run = {
            "lattice": resting(dataset, reference, shown, spacing)
            | moving(dataset, reference, shown),
            "bonds": bonds.shown(shown.particles) if bonds else None,
            "curves": curves(dataset),
        }
        left_out = [*shown.left_out(), *fewer_points(dataset), *self._notes]
        return self._whole | {"run": run, "left_out": left_out, "thinned": shown.is_thinner}


def _refuse_no_motion(dataset: xarray.Dataset) -> None:
    """Raises ExperimentError unless there are positions of one run in the plane."""
    if "position" not in dataset:
        raise ExperimentError("has no positions: keep `position` to have them in a page")
    position = dataset["position"]
    if {*position.dims} != {"time", "particle", "axis"} or position.sizes["axis"] != 2:
        raise ExperimentError(
            f"position has the dimensions {dict(position.sizes)}: a page needs time, particle and "
            "two axes; isel picks one of several runs"
        )
    if not position.size:
        raise ExperimentError("has no step or no particle: a page needs one of each")


def _bonds(dataset: xarray.Dataset, origin: Origin) -> tuple[Bonds | None, list[str]]:
    """Those that are known, and sentences about what is not."""
    notes = []
    if origin.fault:
        notes.append(f"The experiment cannot be built here: {origin.fault}")
    count = dataset.sizes["particle"]
    if "number" in dataset and not np.array_equal(dataset["number"], np.arange(1, count + 1)):
        return None, [*notes, "Bonds are not shown: some particles of the run are missing."]
    try:
        return bonds_of(dataset, origin.scene), notes
    except PbdkitError as error:
        return bonds_of(dataset, None), [*notes, f"Of its bonds less is known: the file {error}"]


def leaders_of(dataset: xarray.Dataset) -> NDArray[np.bool_]:
    """Who leads at the first or at the last recorded step, (particle,)."""
    if "kind" not in dataset or "time" not in dataset["kind"].dims:
        return np.zeros(dataset.sizes["particle"], np.bool_)
    ends = dataset["kind"].isel(time=[0, -1]).values
    return np.asarray((ends == LEADER).any(axis=0))


def reference_of(dataset: xarray.Dataset, scene: Scene | None) -> NDArray[np.float64]:
    """Where displacements are counted from, (particle, axis), in the units of the page: the
    reference, or the first recorded step where nobody knows it."""
    if "reference" in dataset.variables and dataset["reference"].ndim == 2:
        return in_units(dataset["reference"].values, factor_of(dataset["reference"]))
    if scene is not None and scene.raster.count == dataset.sizes["particle"]:
        return in_units(scene.raster.reference(), lattice_unit(dataset))
    first = dataset["position"].isel(time=0, missing_dims="ignore")
    return in_units(first.transpose("particle", "axis").values, factor_of(first))
