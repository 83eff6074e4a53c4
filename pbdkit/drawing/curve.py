"""Curves of a run: force over displacement, stress over strain, energies, one number over another.

Of a sweep there is a line a member.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

from pbdkit.drawing import driven
from pbdkit.drawing.labels import label
from pbdkit.drawing.members import hues_of, lines_of, member_dims
from pbdkit.drawing.panel import BROAD, TALL, draw_lines, new_axes
from pbdkit.drawing.series import OF_A_RUN, scalar
from pbdkit.errors import ExperimentError

if TYPE_CHECKING:
    import xarray
    from matplotlib.axes import Axes

Kind = Literal["load-displacement", "stress-strain", "energies"]
KINDS: tuple[Kind, ...] = ("stress-strain", "load-displacement", "energies")
"""In the order in which they are looked for."""
ENERGIES = ("strain_energy", "pe1", "pe1_intact", "pe2")
NEEDED = {
    "stress-strain": "stress over strain needs the diagnostic stress-strain: add "
    "{type: stress-strain, youngs_modulus: ..., width: ...} to `diagnostics`, and run again",
    "energies": "energies need a diagnostic: add {type: pe1}, or of a calibrated rule "
    "{type: strain-energy, youngs_modulus: ...}, to `diagnostics`, and run again",
}


def curve(
    dataset: xarray.Dataset,
    x: str | None = None,
    y: str | None = None,
    *,
    kind: Kind | None = None,
    group: int | None = None,
    load: int | None = None,
    obstacle: int | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw a curve and return its axes.

    `kind` is which, by default the first that the dataset has. `curve(y)` draws a variable over
    the time instead and `curve(x, y)` one over another, one number a step each: a component as
    `reaction_x`, and of what particles have the sum or mean. `group`, `load` and `obstacle` choose
    the one whose forces are drawn; without them it is the one that goes farthest. Lengths, forces
    and energies are in mm, N and mJ where the dataset has their scale. A dataset of a sweep has a
    line a member.

    Raises ExperimentError for what is not there, with the diagnostic that it takes, and where
    matplotlib is missing.
    """
    chosen = {"group": group, "load": load, "obstacle": obstacle}
    if y is None:
        x, y = None, x
    if y is not None and kind is not None:
        raise ExperimentError(f"give y or the kind '{kind}', not both")
    if y is not None:
        drawn = [scalar(dataset, y, chosen)]
        across = scalar(dataset, x or _own_axis(drawn[0]), chosen)
        return _draw(dataset, across, drawn, ax)
    return _of_kind(dataset, kind or _first_kind(dataset), chosen, ax)


def _own_axis(values: Any) -> str:
    return next((str(d) for d in values.dims if d in OF_A_RUN), "time")


def _first_kind(dataset: xarray.Dataset) -> Kind:
    has = {
        "stress-strain": "nominal_stress" in dataset,
        "load-displacement": any(name in dataset for name in driven.FORCE_OF.values()),
        "energies": any(name in dataset for name in ENERGIES),
    }
    for kind in KINDS:
        if has[kind]:
            return kind
    raise ExperimentError(f"there is no curve in it: {driven.NEEDED}; {NEEDED['stress-strain']}")


def _of_kind(
    dataset: xarray.Dataset, kind: Kind, chosen: dict[str, int | None], ax: Axes | None
) -> Axes:
    if kind == "load-displacement":
        found = driven.way(dataset, chosen)
        return _draw(dataset, found.displacement, [found.force], ax)
    if kind not in NEEDED:
        raise ExperimentError(f"there is no curve '{kind}'; there are {', '.join(KINDS)}")
    names = ["nominal_stress"] if kind == "stress-strain" else _energies(dataset)
    if any(name not in dataset for name in names) or not names:
        raise ExperimentError(NEEDED[kind])
    across = "nominal_strain" if kind == "stress-strain" else "time"
    drawn = [scalar(dataset, name, chosen) for name in names]
    return _draw(dataset, scalar(dataset, across, chosen), drawn, ax)


def _energies(dataset: xarray.Dataset) -> list[str]:
    """Those that have one unit: the energy if there is one, else the pseudo-energies."""
    there = [name for name in ENERGIES if name in dataset]
    units = [dataset[name].attrs.get("units") for name in there]
    return [name for name, unit in zip(there, units, strict=True) if unit == units[0]]


def _draw(dataset: xarray.Dataset, x: Any, drawn: list[Any], ax: Axes | None) -> Axes:
    several = len(drawn) > 1
    lines = []
    for n, y in enumerate(drawn):
        for line in lines_of(dataset, x, y):
            said = [line.name, y.attrs["long_name"]] if several else [line.name]
            hue = line.hue if member_dims(y) else n
            name = ", ".join(filter(None, said))
            lines.append(replace(line, name=name, hue=hue, dashed=n > 0))
    if not lines:
        raise ExperimentError(f"'{drawn[0].name}' has no value that could be drawn")
    ax = ax or new_axes()
    ax.set_xlabel(label(x.attrs["long_name"], x.attrs["units"], broad=BROAD))
    common = "pseudo-energy" if several else drawn[0].attrs["long_name"]
    ax.set_ylabel(label(common, drawn[0].attrs["units"], broad=TALL))
    draw_lines(ax, lines, str(dataset.attrs.get("title", "")), hues_of(drawn[0]))
    return ax
