"""The bonds of a run as a page holds them, with what is known of how they broke."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.drawing.outline import lattice_unit
from pbdkit.errors import ExperimentError
from pbdkit.interfaces.fracture_model import breaking_order
from pbdkit.pages.naming import factor_of
from pbdkit.pages.packing import packed
from pbdkit.pages.thinning import Rows
from pbdkit.results.explanation import Explained, Standing
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import describe_bonds

if TYPE_CHECKING:
    import xarray

Array = NDArray[Any]
LISTED = 300
"""So many broken bonds stand in the ledger of a page."""
STATES = ("intact", "broken", "cut", "broken from the start", "cannot break")


@dataclass(frozen=True)
class Bonds:
    """Arrays along the bonds: `ends` the numbers of their particles, `rest` the rest offset, `step`
    of breaking or -1, `strain` at breaking and `limit`, NaN where not known, `state` of STATES; and
    what a model remembers of each at the end. `order` has the rows of the broken ones; `nearest` is
    the one that is nearest to breaking."""

    ends: Array
    rest: Array
    shell: Array
    step: Array
    strain: Array
    limit: Array
    state: Array
    order: Rows
    model: str = "none"
    remembered: dict[str, Array] = field(default_factory=dict)
    nearest: Standing | None = None

    @property
    def spacing(self) -> float:
        """The shortest rest length."""
        return float(np.linalg.norm(self.rest, axis=1).min())

    @property
    def can_break(self) -> bool:
        """Whether any has broken, or could have."""
        return self.model not in ("none", "not known") or len(self.order) > 0

    def shown(self, particles: Rows) -> dict[str, Any]:
        """Those between the particles shown, as rows of these."""
        rows = self._between(particles)
        return {
            "ends": packed(np.searchsorted(particles, self.ends[rows] - 1), "i4"),
            "rest": packed(self.rest[rows], "f8"),
            "shell": packed(self.shell[rows], "u1"),
            "limit": packed(self.limit[rows], "f8"),
            "states": STATES,
            "model": self.model,
            "remembered": {n: packed(values[rows], "f8") for n, values in self.remembered.items()},
            **self.broken(particles),
        }

    def broken(self, particles: Rows) -> dict[str, Any]:
        """Of these, how they broke."""
        rows, place = self._between(particles), np.full(len(self.ends), -1)
        place[self.order] = np.arange(1, len(self.order) + 1)
        return {
            "step": packed(self.step[rows], "i4"),
            "strain": packed(self.strain[rows], "f8"),
            "state": packed(self.state[rows], "u1"),
            "order": packed(place[rows], "i4"),
            "broken": len(self.order),
        }

    def _between(self, particles: Rows) -> Rows:
        shown = np.isin(self.ends - 1, particles, kind="table").all(axis=1)
        return np.flatnonzero(shown)

    def ledger(self) -> dict[str, Any]:
        """The bonds that broke, in their order; long ones are cut."""
        listed = self.order[:LISTED]
        counts = np.bincount(self.state, minlength=len(STATES)).tolist()
        return {
            "model": self.model,
            "bonds": len(self.ends),
            "counts": dict(zip(STATES, counts, strict=True)),
            "all": len(self.order),
            "step": self.step[listed].tolist(),
            "ends": self.ends[listed].tolist(),
            "shell": self.shell[listed].tolist(),
            "strain": packed(self.strain[listed], "f8"),
            "limit": packed(self.limit[listed], "f8"),
            "nearest": asdict(self.nearest) if self.nearest else None,
        }


def bonds_of(dataset: xarray.Dataset, scene: Scene | None) -> Bonds | None:
    """All that the dataset has; of one that has no table of bonds those of its scene, unless
    neighbours are found anew. None where neither knows any. Lengths are in the units of the page.

    Raises ExperimentError where dataset and scene do not go together.
    """
    found = _in_lattice_units(dataset, scene)
    return found and replace(found, rest=lattice_unit(dataset) * found.rest)


def _in_lattice_units(dataset: xarray.Dataset, scene: Scene | None) -> Bonds | None:
    if dataset.sizes.get("bond") == 0:  # of a body whose particles have no neighbours
        return None
    if scene is not None and "bond_ends" in dataset.variables:
        return _explained(Explained(dataset, scene), dataset)
    if "bond_ends" in dataset.variables and dataset["bond_ends"].ndim == 2:
        return _told(dataset)
    if scene is None or scene.experiment.neighbours.nearness():
        return None
    found = describe_bonds(scene)
    if not len(found):
        return None
    if scene.raster.count != dataset.sizes["particle"]:
        raise ExperimentError("its particles are not those of the experiment that it carries")
    return _whole(found.ends, found.rest, found.shell)


def _whole(ends: Array, rest: Array, shell: Array) -> Bonds:
    """Bonds of which nobody knows whether they break."""
    count = len(ends)
    unknown, never = np.full(count, np.nan), np.full(count, -1)
    state, order = np.zeros(count, np.int64), np.empty(0, np.intp)
    return Bonds(ends, rest, shell, never, unknown, unknown, state, order)


def _explained(known: Explained, dataset: xarray.Dataset) -> Bonds:
    bonds = known.bonds
    names = known.remembered(0) if len(bonds) else ()
    last = {n: dataset[n].isel(time=-1, missing_dims="ignore").values for n in names}
    return Bonds(
        bonds.ends, bonds.rest, bonds.shell, known.steps, known.strains_at_break,
        np.where(known.spared, np.nan, known.limits), _states(known.steps, known.cut, known.spared),
        known.order, known.model.type, last, known.nearest(),
    )  # fmt: skip


def _told(dataset: xarray.Dataset) -> Bonds | None:
    """By the dataset alone."""
    there = (dataset["bond_ends"].values > 0).all(axis=1)
    if not there.all():  # of a sweep, in which other members have more
        dataset = dataset.isel(bond=there)
    ends = dataset["bond_ends"].values
    if not len(ends) or "reference" not in dataset.variables:
        return None
    reference = factor_of(dataset["reference"]) * dataset["reference"].values
    reference /= lattice_unit(dataset)
    shell = dataset["shell"].values if "shell" in dataset.variables else np.ones(len(ends))
    whole = _whole(ends, reference[ends[:, 1] - 1] - reference[ends[:, 0] - 1], shell)
    return replace(broken_as(whole, dataset), model="not known")


def broken_as(bonds: Bonds, dataset: xarray.Dataset) -> Bonds:
    """The same bonds, broken as in a dataset that knows them all."""
    known = dataset.variables.get("broken_step")
    if known is None or known.shape != bonds.step.shape:
        return bonds
    step, beside = np.asarray(known.values), "broken_strain" in dataset
    strain = dataset["broken_strain"].values if beside else np.full(len(step), np.nan)
    spared = bonds.state == STATES.index("cannot break")
    state = _states(step, (step > 0) & np.isnan(strain) & beside, spared)
    order = breaking_order(step, strain)
    return replace(bonds, step=step, strain=strain, state=state, order=order)


def _states(steps: Array, cut: Array, spared: Array) -> Array:
    """Of STATES."""
    whole = np.where(spared, STATES.index("cannot break"), STATES.index("intact"))
    gone = np.where(cut, STATES.index("cut"), STATES.index("broken"))
    gone = np.where(steps == 0, STATES.index("broken from the start"), gone)
    return np.where(steps < 0, whole, gone)
