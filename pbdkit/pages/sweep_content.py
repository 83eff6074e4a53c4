"""All that the page of a sweep holds: a map over its parameters, and the members below."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.errors import PbdkitError
from pbdkit.pages.bonds import Bonds, bonds_of, broken_as
from pbdkit.pages.curves import curves
from pbdkit.pages.lattice import bytes_a_particle, moving, resting, spacing_of
from pbdkit.pages.origin import experiment_text, file_name, made_by, title_of
from pbdkit.pages.run_content import leaders_of, reference_of
from pbdkit.pages.sweep_numbers import numbers
from pbdkit.pages.thinning import Thinning, thinned
from pbdkit.results.carried import carried, scene_of
from pbdkit.results.members import STATUS, TEXT, type_alone
from pbdkit.scene.scene import Scene
from pbdkit.sweeps.grid import CASE, MESSAGE
from pbdkit.sweeps.worker import KEPT

if TYPE_CHECKING:
    import xarray

Array = NDArray[Any]
FEWEST_STEPS, FEWEST_POINTS = 6, 50
"""Of each member at least, as far as they are recorded."""
POINTS = 100_000
"""Of the curves of all members together."""


class SweepContent:
    """What `report.js` shows of a sweep."""

    def __init__(self, dataset: xarray.Dataset) -> None:
        grid = [str(dim) for dim in dataset[STATUS].dims]
        asked = carried(dataset, "sweep")
        title = title_of(dataset)
        places = product(*(range(dataset.sizes[dim]) for dim in grid))
        self._members = [dataset.isel(dict(zip(grid, place, strict=True))) for place in places]
        self._scene = _scene(asked)
        self._whole = {
            "what": "sweep",
            "title": title,
            "file": file_name(title),
            "facts": _facts(dataset),
            "experiment": experiment_text(asked),
            "grid": [{"name": dim, "labels": _labels(dataset, dim)} for dim in grid],
            "status": dataset[STATUS].values.ravel().tolist(),
            "message": dataset[MESSAGE].values.ravel().tolist(),
            "scalars": list(numbers(dataset, grid)),
        }

    def within(self, budget: int) -> dict[str, Any]:
        """All of it, where the moving lattices of all members together take about `budget` bytes
        before they are packed."""
        each = self._members
        points = max(FEWEST_POINTS, POINTS // len(each))
        good = [str(member[STATUS].item()) in KEPT for member in each]
        if "position" not in each[0] or not any(good):
            note = "No lattices are shown: no member ended well, or `position` was not kept."
            plain = [{"curves": curves(member, points)} for member in each]
            return self._whole | {
                "shared": {}, "members": plain, "left_out": [note], "thinned": False,
            }  # fmt: skip
        first = each[good.index(True)]
        size = bytes_a_particle(first) * len(each)
        shown = thinned(first, leaders_of(first), size, budget, FEWEST_STEPS)
        bodies = [
            _Body.of(member, self._scene) if g else None
            for member, g in zip(each, good, strict=True)
        ]
        one = next(filter(None, bodies))
        alike = all(body is None or one.is_like(body) for body in bodies)
        members = [
            body and body.moving(member, shown, points, whole=not alike)
            for body, member in zip(bodies, each, strict=True)
        ]
        return self._whole | {
            "shared": one.resting(first, shown) if alike else {},
            "members": members,
            "left_out": shown.left_out(),
            "thinned": shown.is_thinner,
        }


@dataclass(frozen=True)
class _Body:
    """Of one member: where it is at rest, (particle, axis), and its bonds."""

    reference: Array
    bonds: Bonds | None

    @classmethod
    def of(cls, member: xarray.Dataset, scene: Scene | None) -> _Body:
        reference = reference_of(member, scene)
        try:
            bonds = bonds_of(member, None) or bonds_of(member, scene)
        except PbdkitError:
            bonds = None
        return cls(reference, broken_as(bonds, member) if bonds else None)

    def is_like(self, other: _Body) -> bool:
        """Whether they are the same at rest."""
        if self.bonds and other.bonds:
            same_bonds = np.array_equal(self.bonds.ends, other.bonds.ends)
        else:
            same_bonds = self.bonds is other.bonds
        return same_bonds and np.array_equal(self.reference, other.reference, equal_nan=True)

    def resting(self, member: xarray.Dataset, shown: Thinning) -> dict[str, Any]:
        """What does not move of it."""
        here = self.reference[np.isfinite(self.reference).all(axis=1)]
        spacing = self.bonds.spacing if self.bonds else spacing_of(here)
        return {
            "lattice": resting(member, self.reference, shown, spacing),
            "bonds": self.bonds.shown(shown.particles) if self.bonds else None,
        }

    def moving(
        self, member: xarray.Dataset, shown: Thinning, points: int, *, whole: bool
    ) -> dict[str, Any]:
        """What moves of it, or the `whole`."""
        still = self.resting(member, shown) if whole else {"lattice": {}}
        broken = self.bonds.broken(shown.particles) if self.bonds else None
        last = member["position"].isel(time=shown.steps)
        there = last.notnull().any(["particle", "axis"]).values  # others may have made more steps
        moved = moving(member, self.reference, replace(shown, steps=shown.steps[there]))
        return {"bonds": broken} | still | {
            "lattice": still["lattice"] | moved,
            "curves": curves(member, points),
        }  # fmt: skip


def _facts(dataset: xarray.Dataset) -> list[list[str]]:
    status = dataset[STATUS].values.ravel()
    names, counts = np.unique(status, return_counts=True)
    ended = ", ".join(f"{n} {name}" for name, n in zip(names, counts, strict=True))
    sizes = " × ".join(f"{size} {name}" for name, size in dataset[STATUS].sizes.items())
    made = str(dataset.attrs.get("created", ""))
    members = f"{status.size}: {sizes}"
    return [["members", members], ["ended", ended], ["created", made], ["by", made_by(dataset)]]


def _labels(dataset: xarray.Dataset, dim: str) -> list[str]:
    """What stands along a dimension of the grid; of cases, what is set in each."""
    beside = [str(n) for n, c in dataset.coords.items() if c.dims == (dim,) and n != dim]
    if dim == CASE and beside:
        rows = zip(*(dataset[n].values.tolist() for n in beside), strict=True)
        return [", ".join(f"{n} {_label(v)}" for n, v in zip(beside, r, strict=True)) for r in rows]
    name = dim + TEXT if dim + TEXT in dataset.variables else dim
    if name not in dataset.variables:
        return [str(n) for n in range(dataset.sizes[dim])]
    values = dataset[name].values
    if values.dtype.kind == "f":  # what is 0 but for rounding is 0
        values = np.where(np.abs(values) < 1e-12 * np.abs(values).max(), 0.0, values)
    return [_label(value) for value in values.tolist()]


def _label(value: Any) -> str:
    """A value in few words."""
    return f"{value:.6g}" if isinstance(value, float) else type_alone(str(value))


def _scene(asked: dict[str, Any]) -> Scene | None:
    """That of the experiment that is varied, None where the body is."""
    import xarray

    experiment = asked.get("experiment", {})
    varied = {path.split(".")[0] for key in ("vary", "together") for path in asked.get(key, {})}
    if varied & {"lattice", "body", "neighbours", "frame"}:
        return None
    carrier = xarray.Dataset(attrs={"experiment": json.dumps(experiment)})
    try:
        return scene_of(carrier, "the lattice of a page")
    except PbdkitError:
        return None
