"""Gives every xarray.Dataset the accessor `pbd`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import xarray

from pbdkit.drawing.comparison import compare
from pbdkit.drawing.crack import Kind as CrackKind
from pbdkit.drawing.crack import crack
from pbdkit.drawing.curve import Kind as CurveKind
from pbdkit.drawing.curve import curve
from pbdkit.drawing.history import history
from pbdkit.drawing.movie import animate, animation
from pbdkit.drawing.picture import plot
from pbdkit.results.older_layout import in_this_layout
from pbdkit.results.physical import in_physical_units
from pbdkit.results.sites import indices_of, rows_at

if TYPE_CHECKING:
    from matplotlib.animation import FuncAnimation
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@xarray.register_dataset_accessor("pbd")  # type: ignore[no-untyped-call]  # xarray's is untyped
class PbdAccessor:
    """What pbdkit adds to a dataset: ``dataset.pbd.plot(...)``."""

    def __init__(self, dataset: xarray.Dataset) -> None:
        self._dataset = in_this_layout(dataset)

    def plot(
        self,
        time: float | Iterable[float | None] | None = None,
        color: str | None = None,
        *,
        ax: Axes | Sequence[Axes] | None = None,
        **look: Any,
    ) -> Axes | Figure:
        """`pbdkit.drawing.plot`: a picture; the Axes of one step (default the last), or a Figure of
        several."""
        drawn = plot(self._dataset, time, color, ax=ax, **look)
        if not isinstance(drawn, list):
            return drawn
        from pbdkit.drawing.figures import figure_of

        return figure_of(drawn[0])

    def compare(
        self,
        other: xarray.Dataset,
        time: float | None = None,
        color: str | None = None,
        *,
        difference: bool = False,
        **look: Any,
    ) -> Axes | list[Axes]:
        """`pbdkit.drawing.compare` of this dataset with another."""
        theirs = in_this_layout(other)
        return compare(self._dataset, theirs, time, color, difference=difference, **look)

    def animate(self, file: str | Path, color: str | None = None, **look: Any) -> None:
        """`pbdkit.drawing.animate`: a movie, MP4 or GIF."""
        animate(self._dataset, file, color, **look)

    def animation(self, color: str | None = None, **look: Any) -> FuncAnimation:
        """The same as an animation of matplotlib, for notebooks: of longer runs 60 steps."""
        return animation(self._dataset, color, **look)

    def at(self, **index: int) -> xarray.Dataset:
        """What stands at site indices: ``at(i=3, j=4)`` is one particle, as ``sel(particle=...)``
        gives it, ``at(j=0)`` all of a line.

        Every site has indices of its own, those of one repeat cell too. Raises ExperimentError
        where no particle is, and for what is no index.
        """
        rows, whole = rows_at(self._dataset, index), {*index} == {*indices_of(self._dataset)}
        return self._dataset.isel(particle=rows[0] if whole else rows)

    def components(self) -> xarray.Dataset:
        """The dataset with `position_x`, `position_y` in place of `position`, and so on of
        everything along `axis`: for plots of one against the other, and for tables."""
        parts: dict[str, xarray.Variable] = {}
        labels = []
        for name, vector in self._dataset.variables.items():
            for n in range(vector.sizes.get("axis", 0)) if name != "axis" else ():
                axis = self._dataset["axis"].values[n]
                part = parts[f"{name}_{axis}"] = vector.isel(axis=n)
                part.attrs["long_name"] = f"{part.attrs.get('long_name', name)}, {axis} component"
                labels += [f"{name}_{axis}"] if name in self._dataset.coords else []
        return self._dataset.drop_dims("axis", errors="ignore").assign(parts).set_coords(labels)

    def physical(self) -> xarray.Dataset:
        """The dataset in mm, mm² and, of stresses, forces and energies, MPa, N and mJ, as far as
        variables say their scale: those of experiments with `units`."""
        return in_physical_units(self._dataset)

    def history(
        self,
        name: str | None = None,
        *,
        particle: int | Iterable[int] | None = None,
        i: int | None = None,
        j: int | None = None,
        bond: Sequence[int] | None = None,
        ax: Axes | None = None,
    ) -> Axes:
        """What becomes of particles, or of a bond, over the steps: a variable, by default the
        displacement; see `pbdkit.drawing.history.history`."""
        return history(self._dataset, name, particle=particle, i=i, j=j, bond=bond, ax=ax)

    def curve(
        self,
        x: str | None = None,
        y: str | None = None,
        *,
        kind: CurveKind | None = None,
        group: int | None = None,
        load: int | None = None,
        obstacle: int | None = None,
        ax: Axes | None = None,
    ) -> Axes:
        """Stress over strain, force over displacement, energies, or any number over another; see
        `pbdkit.drawing.curve.curve`."""
        chosen = {"group": group, "load": load, "obstacle": obstacle}
        return curve(self._dataset, x, y, kind=kind, ax=ax, **chosen)

    def crack(self, kind: CrackKind = "map", *, ax: Axes | None = None) -> Axes:
        """The broken bonds by the step of breaking, the length of the crack, or the number of
        broken bonds over the steps; see `pbdkit.drawing.crack.crack`."""
        return crack(self._dataset, kind=kind, ax=ax)
