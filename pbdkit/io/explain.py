"""Status of bonds, computed from a dataset and the scene of its experiment. The status is intact,
broken or cut; intact bonds also have a distance from breaking."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Floats
from pbdkit.components.fracture import Cohesive
from pbdkit.components.stress_intensity import StressIntensity
from pbdkit.errors import AnswerError, ExperimentError, StorageError
from pbdkit.io.layout import OF_FRAME, as_step
from pbdkit.lattice.raster import Places
from pbdkit.model.experiment import Experiment
from pbdkit.plugin import Bonds, BreaksAtStrain, FractureModel
from pbdkit.plugin.fracture_model import breaking_order
from pbdkit.plugin.units import FRACTURE_ENERGY
from pbdkit.scene.constants import bond_numbers
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import describe_bonds

if TYPE_CHECKING:
    import xarray


Rows = NDArray[np.intp]
PLACES = ("body", "outside the outline", "frame")
"""Places of bonds. A bond belongs to the frame if one of its ends is a frame point, and is outside
the outline if one of its ends is a particle of a cut cell outside the outline."""


@dataclass(frozen=True)
class BondStatus:
    """Status of one bond. It contains the numbers of its particles, its shell and rest length, and
    whether it broke.

    `state` is "intact", "broken", "cut", "broken from the start" or "cannot break". `step` is the
    step of breaking, `order` the position among the broken bonds, counted from 1, and
    `strain_at_break` the strain; they are None if they are unknown. `breaks_above` is the strain
    above which the bond breaks, and None if the fracture model does not define it. `strain` is the
    strain at the recorded step `at_step`. `place` is one of PLACES.
    """

    bond: tuple[int, int]
    shell: int
    rest_length: float
    state: str
    step: int | None
    order: int | None
    strain_at_break: float | None
    breaks_above: float | None
    strain: float
    at_step: float
    place: str

    @property
    def share(self) -> float | None:
        """Strain at `at_step` divided by the breaking strain. The bond breaks when it reaches 1."""
        return self.strain / self.breaks_above if self.breaks_above else None


@dataclass(frozen=True)
class TipStatus:
    """Status of a crack tip at the last recorded step, in the units of the dataset.

    `release` is the energy release rate, and `critical` the fracture energy of the fracture model;
    they are None if they are unknown.
    """

    tip: int
    place: tuple[float, float]
    at_step: float
    K_I: float | None
    K_II: float | None
    release: float | None
    critical: float | None
    units: str

    @property
    def share(self) -> float | None:
        """Energy release rate divided by its critical value; the crack grows when it reaches 1."""
        return self.release / self.critical if self.critical and self.release is not None else None

    @property
    def load_factor(self) -> float | None:
        """Factor by which the load of a linear body must be multiplied until the crack grows."""
        return self.share**-0.5 if self.share else None


def tip_statuses(dataset: xarray.Dataset, experiment: Experiment) -> list[TipStatus]:
    """Return the status of each crack tip; empty if the run has no `stress-intensity`."""
    parts = [d for d in experiment.diagnostics if isinstance(d, StressIntensity)]
    names = ("K_I", "K_II", "G", "J")
    if not parts or not {*names, "crack_tip_position"} <= {*dataset.variables}:
        return []
    last = dataset.isel(time=-1)
    model, units = experiment.fracture, str(last["J"].attrs["units"])
    critical = None
    if isinstance(model, Cohesive) and "energy" not in model.varying:
        critical = parts[0].youngs_modulus * model.energy
        if experiment.units and units == FRACTURE_ENERGY.unit:
            critical *= experiment.units.length_mm
    rows = np.stack([np.asarray(last[name].values, float) for name in names], axis=1)
    places = last["crack_tip_position"].values.tolist()
    return [
        TipStatus(
            n, (x, y), as_step(last["time"].values), _known(K_I), _known(K_II),
            _known(J if np.isnan(G) else G), critical, units,
        )
        for n, ((K_I, K_II, G, J), (x, y)) in enumerate(zip(rows.tolist(), places, strict=True))
    ]  # fmt: skip


class BondRecords:
    """The bonds of a dataset and their histories. Raises ExperimentError if the dataset has no
    table of bonds."""

    def __init__(self, dataset: xarray.Dataset, scene: Scene) -> None:
        if "bond_ends" not in dataset.variables:
            raise ExperimentError(
                "has no table of bonds, since no bond can break in this run; run the experiment "
                "with `fracture`, or with a diagnostic that uses bonds, such as pe1"
            )
        self._dataset, self._scene = dataset, scene
        self.model: FractureModel = scene.experiment.fracture
        self._remembered = [number.name for number in bond_numbers(scene.experiment)]
        self.bonds: Bonds = describe_bonds(scene)
        self.steps = self._of_bonds("broken_step", np.int32(-1))
        """(bond,): the step in which each bond broke; -1 if it is intact."""
        self.strains_at_break: Floats = self._of_bonds("broken_strain", np.nan)
        """(bond,): strain at breaking; NaN if it is unknown."""
        has_strains = "broken_strain" in dataset.variables
        self.cut = has_strains & (self.steps > 0) & np.isnan(self.strains_at_break)
        """(bond,): whether the bond was cut after the first step had begun."""
        self.order: Rows = breaking_order(self.steps, self.strains_at_break)
        """Rows of the broken bonds, in the order of breaking."""
        if not np.array_equal(self.bonds.ends, dataset["bond_ends"].values):
            raise ExperimentError(
                "its bonds are not those of its experiment: the file was changed, or was written "
                "with another version of a component"
            )

    def _of_bonds(self, name: str, unknown: Any) -> NDArray[Any]:
        variable = self._dataset.variables.get(name)
        return (
            np.full(len(self.bonds), unknown) if variable is None else np.asarray(variable.values)
        )

    @cached_property
    def limits(self) -> Floats:
        """(bond,): strain at which each broken bond broke, and strain at which each intact bond
        would break at the last recorded step. NaN if the model does not define it."""
        limits, last = np.full(len(self.bonds), np.nan), math.ceil(self._dataset["time"].values[-1])
        moments = np.where(self.steps > 0, self.steps, last)
        if not self._scene.experiment.time_dependent:
            moments[:] = last
        for moment in np.unique(moments).tolist():
            at = moments == moment
            limits[at] = self._limits_at(moment)[at]
        return limits

    def _limits_at(self, moment: int) -> Floats:
        limits, constants = np.full(len(self.bonds), np.nan), self._scene.at(moment).constants
        has_all = all(name in self._dataset for name in self._remembered)
        model = self.model
        if not (has_all and model.can_break and isinstance(model, BreaksAtStrain)):
            return limits
        memories = [_last(self._dataset[name]).astype(float) for name in self._remembered]
        for n, plane in enumerate(self._scene.neighbourhood.planes):
            rows = np.flatnonzero(self._scene.bonds.plane == n)
            owner = Places(self._scene.raster.shape, self._scene.bonds.place[rows])
            fixed = constants.limits_at(plane.slot, n, owner)
            c = constants.of_bond(*fixed, *(values[rows] for values in memories))
            strains = np.asarray(model.breaking_strain(plane.slot.rest, c, constants.fracture))
            if strains.shape not in ((), limits[rows].shape):
                raise AnswerError(
                    f"`breaking_strain` returned the shape {strains.shape} for "
                    f"{limits[rows].size} bonds; return one number for each bond"
                )
            limits[rows] = strains
        return limits

    @cached_property
    def spared(self) -> NDArray[np.bool_]:
        """(bond,): whether the bond cannot break."""
        if not self.model.can_break:
            return np.ones(len(self.bonds), np.bool_)
        frame = self._dataset["role"].values == OF_FRAME
        touches = frame[self.bonds.ends - 1].any(axis=1)
        return np.asarray(touches & (not self.model.breaks_frame_bonds()))

    @cached_property
    def places(self) -> Rows:
        """(bond,): place of the bond, as an index of PLACES."""
        outside = np.zeros(self._dataset.sizes["particle"], np.bool_)
        if "inside" in self._dataset.variables:
            outside = self._dataset["inside"].values == 0
        of_particles = np.where(self._dataset["role"].values == OF_FRAME, 2, outside)
        return np.asarray(of_particles[self.bonds.ends - 1].max(axis=1), np.intp)

    def strains(self, rows: Rows, time: int | slice = -1) -> Floats:
        """Return the strains of some bonds, (..., bond), at recorded times. `time` is an index
        along the dimension of this name."""
        particles = np.unique(self.bonds.ends[rows] - 1)
        at = {"time": time, "particle": particles}
        if "u" in self._dataset:
            u = self._dataset["u"].isel(at).values
        else:
            reference = self._dataset["reference"].isel(particle=particles).values
            u = self._dataset["position"].isel(at).values - reference
        if not np.isfinite(u).all():
            raise StorageError("is damaged, or was changed: it has positions that are not finite")
        a, b = (np.searchsorted(particles, self.bonds.ends[rows, end] - 1) for end in (0, 1))
        rest = self.bonds.rest[rows]
        current = rest + (u[..., b, :] - u[..., a, :])
        return np.asarray(np.hypot(current[..., 0], current[..., 1]) / np.hypot(*rest.T) - 1.0)

    def statuses(self, rows: Rows, until: int | None = None) -> list[BondStatus]:
        """Return the status of some bonds, with the strain at the last recorded step. If a step
        `until` is given, the last recorded step up to it is used."""
        place = {row: n + 1 for n, row in enumerate(self.order.tolist())}
        times = self._dataset["time"].values
        time = int(np.searchsorted(times, times[-1] if until is None else until, "right")) - 1
        strains = self.strains(rows, time).tolist()
        return [
            BondStatus(
                bond=tuple(self.bonds.ends[row].tolist()),
                shell=int(self.bonds.shell[row]),
                rest_length=float(np.hypot(*self.bonds.rest[row])),
                state=self._state(row),
                step=int(self.steps[row]) if row in place else None,
                order=place.get(row),
                strain_at_break=_known(self.strains_at_break[row]),
                breaks_above=None if self.spared[row] else _known(self.limits[row]),
                strain=strain,
                at_step=as_step(times[time]),
                place=PLACES[self.places[row]],
            )
            for row, strain in zip(rows.tolist(), strains, strict=True)
        ]

    def _state(self, row: int) -> str:
        if self.steps[row] < 0:
            return "cannot break" if self.spared[row] else "intact"
        if self.steps[row] == 0:
            return "broken from the start"
        return "cut" if self.cut[row] else "broken"

    def nearest(self) -> BondStatus | None:
        """Return the bond closest to breaking at the last recorded step, or None if no limits are
        known."""
        rows = np.flatnonzero((self.steps < 0) & ~self.spared & np.isfinite(self.limits))
        if not len(rows):
            return None
        share = self.strains(rows) / self.limits[rows]
        return self.statuses(rows[[np.argmax(share)]])[0]

    def row(self, a: int, b: int) -> int:
        """Return the row of the bond between two particle numbers. Raises ExperimentError if there
        is no such bond."""
        count = int(self._dataset.sizes["particle"])
        for number in (a, b):
            if not 1 <= number <= count:
                raise ExperimentError(
                    f"there is no particle {number}; they are numbered 1 to {count}"
                )
        rows = np.flatnonzero((self.bonds.ends == sorted((a, b))).all(axis=1))
        if len(rows):
            return int(rows[0])
        ends = self.bonds.ends[(self.bonds.ends == a).any(axis=1)]
        partners = ", ".join(map(str, sorted(ends[ends != a].tolist()))) or "none"
        raise ExperimentError(f"no bond joins {a} and {b}; the bonds of {a} are to {partners}")

    def around(self, row: int) -> Rows:
        """Return the other bonds of both ends of a bond. Broken bonds are returned first, in the
        order of breaking."""
        touches = np.asarray(np.isin(self.bonds.ends, self.bonds.ends[row]).any(axis=1))
        touches[row] = False
        broken = self.order[touches[self.order]]
        touches[broken] = False
        return np.append(broken, np.flatnonzero(touches))

    def most_strained(self, row: int) -> tuple[float, float]:
        """Return the recorded step at which a bond was longest, and its strain at that step."""
        history = self.strains(np.array([row]), slice(None))[:, 0]
        largest = int(np.argmax(history))
        return as_step(self._dataset["time"].values[largest]), float(history[largest])

    def remembered(self, row: int) -> dict[str, float]:
        """Return the state variables of a bond at the last recorded step."""
        names = [name for name in self._remembered if name in self._dataset]
        return {name: float(_last(self._dataset[name])[row]) for name in names}


def _last(variable: xarray.DataArray) -> NDArray[Any]:
    return np.asarray(variable.isel(time=-1, missing_dims="ignore").values)


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
