"""Draw configurations over filled contours, histories and curves, without pyplot and display."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path

import numpy as np
from matplotlib import ticker
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.tri import Triangulation
from PIL import Image
from runs import Floats, Sheet

from pbdkit.plotting.colours import KINDS
from pbdkit.plotting.data import Trajectory, triangles_of, whole
from pbdkit.plotting.layers import BOND_COLOUR, DOT_COLOUR

FOLDER = Path(__file__).parent.parent / "pictures" / "reproduction"
DPI, PAGE_IN, COLOURS = 130, 7.4, 128
CONTOURS, DETAILED = "YlOrRd", 1000
MEANINGS = {"pe1": "PE1", "pe2": "PE2", "pe1_intact": "PE1, intact bonds", "u": "|u|"}
LINES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#000000")


@dataclass(frozen=True)
class Shot:
    """Positions, kinds and values of particles in one step, with the rows of both ends of unbroken
    bonds, and of the corners of triangles without a broken side."""

    position: Floats
    kind: np.ndarray
    values: Floats
    bonds: np.ndarray
    triangles: np.ndarray


def shots_of(sheet: Sheet, steps: Sequence[int], color: str) -> list[Shot]:
    """Return recorded steps, with a variable for the colour."""
    recording = Trajectory(sheet.ds, color)
    body = recording.body
    rows = np.flatnonzero(body.inside)
    triangles = rows[triangles_of(body.reference[rows])]
    shots = []
    for now in recording.snapshots([recording.row(step) for step in steps]):
        kept = whole(triangles[:, [0, 1, 2, 2]], body.ends[now.broken], len(body.reference))
        bonds = body.ends[~now.broken]
        shots.append(Shot(now.position, now.kind, now.values, bonds, triangles[kept]))
    return shots


def save(figure: Figure, name: str, folder: Path = FOLDER) -> str:
    """Write a PNG with a palette, without date and software, so that a rerun changes nothing."""
    folder.mkdir(parents=True, exist_ok=True)
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, bbox_inches="tight", pad_inches=0.06)
    image = Image.open(buffer).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
    image.save(folder / name, optimize=True)
    return name


def configurations(
    sheet: Sheet, times: Sequence[int], name: str, color: str = "pe1", over: str = "sheet"
) -> str:
    """Draw panels of the steps paper time - 1, each with its own scale of the variable. Contours
    are drawn over the current sheet or, if it folds, over it at `rest` or over `nothing`."""
    shots = shots_of(sheet, [time - 1 for time in times], color)
    low = np.min([s.position.min(axis=0) for s in shots], axis=0) - 0.8
    high = np.max([s.position.max(axis=0) for s in shots], axis=0) + 0.8
    width, height = high - low
    columns = 3 if width < 1.45 * height and len(shots) > 4 else 2
    rows = math.ceil(len(shots) / columns)
    wide = PAGE_IN / columns
    tall = (wide - 0.9) * height / width + 0.45
    figure = Figure((PAGE_IN, rows * tall + 0.35), layout="constrained")
    for n, (time, shot) in enumerate(zip(times, shots, strict=True)):
        ax = figure.add_subplot(rows, columns, n + 1)
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        if over == "rest":
            shot = replace(shot, position=sheet.position[0], bonds=shot.bonds[:0])
        if over == "nothing":
            shot = replace(shot, triangles=np.empty((0, 3), int))
        _configuration(ax, shot, color)
        ax.set_title(f"time {time} (step {time - 1})", fontsize=8.5)
        ax.tick_params(labelsize=7)
    handles = [
        Line2D([], [], ls="", marker="o", ms=4, mfc=colour, mec=DOT_COLOUR, mew=0.4, label=kind)
        for kind, colour in reversed(KINDS.values())
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False, fontsize=8)
    return save(figure, name)


def _configuration(ax: Axes, shot: Shot, color: str) -> None:
    """Draw one panel: contours over the unbroken body, bonds, kinds, and a scale if values vary."""
    values = shot.values[np.unique(shot.triangles)]
    top = float(values.max()) if len(values) else 0.0
    if top > 1e-12:
        levels = ticker.MaxNLocator(8).tick_values(0.0, top)
        norm = BoundaryNorm(levels, 256)
        mesh = Triangulation(*shot.position.T, shot.triangles)
        ax.tricontourf(mesh, shot.values, levels, cmap=CONTOURS, norm=norm)
        bar = ax.figure.colorbar(ScalarMappable(norm, CONTOURS), ax=ax, aspect=18, shrink=0.85)
        bar.set_label(MEANINGS[color], fontsize=7)
        bar.ax.tick_params(labelsize=6.5)
        bar.set_ticks(levels[::2].tolist())
        bar.ax.ticklabel_format(axis="y", scilimits=(-2, 4))
        bar.ax.yaxis.get_offset_text().set_fontsize(6.5)
    if len(shot.kind) > DETAILED:
        return
    ends = list(shot.position[shot.bonds])
    ax.add_collection(LineCollection(ends, colors=BOND_COLOUR, linewidths=0.35, zorder=0.5))
    for kind, (_, colour) in KINDS.items():
        here = shot.position[shot.kind == kind]
        ax.scatter(*here.T, 7, colour, edgecolors=DOT_COLOUR, lw=0.3, zorder=2)


def abreast(
    sheets: Mapping[str, Sheet],
    step: int,
    color: str,
    name: str,
    box: tuple[float, float, float, float],
) -> str:
    """Draw one recorded step of several runs, side by side, each with its own scale."""
    shots = [shots_of(sheet, [step], color)[0] for sheet in sheets.values()]
    left, right, bottom, top = box
    wide = PAGE_IN / len(shots)
    tall = (wide - 0.8) * (top - bottom) / (right - left) + 0.55
    figure = Figure((PAGE_IN, tall), layout="constrained")
    for n, (label, shot) in enumerate(zip(sheets, shots, strict=True)):
        ax = figure.add_subplot(1, len(shots), n + 1)
        ax.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
        _configuration(ax, shot, color)
        ax.set_title(label, fontsize=8, loc="left")
        ax.tick_params(labelsize=7)
    return save(figure, name)


def numbered(sheet: Sheet, name: str) -> str:
    """Draw the lattice at rest with the numbers of the particles."""
    figure = Figure((PAGE_IN * 0.72, PAGE_IN * 0.72), layout="constrained")
    ax = figure.add_subplot()
    ax.margins(0.08)
    ax.set(aspect="equal", xlabel="x (lattice units)", ylabel="y (lattice units)")
    kinds = sheet.ds["kind"].values[0]
    place = sheet.position[0]
    for kind, (label, colour) in KINDS.items():
        ax.scatter(*place[kinds == kind].T, 26, colour, edgecolors=DOT_COLOUR, lw=0.4, label=label)
    for number, (x, y) in zip(sheet.ds["number"].values, place, strict=True):
        bold = "bold" if number == 67 else "normal"
        ax.annotate(str(number), (x, y), (3, 3), textcoords="offset points", size=6.5, weight=bold)
    figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=8)
    return save(figure, name)


def histories(
    series: Mapping[str, tuple[Sheet, int, int]], name: str, steps: int, *, log: bool = False
) -> str:
    """Draw x, y and PE1 of one particle over the step, one line for each (sheet, column, row)."""
    figure = Figure((PAGE_IN, 2.5), layout="constrained")
    panels = [figure.add_subplot(1, 3, n + 1) for n in range(3)]
    for n, (label, (sheet, column, row)) in enumerate(series.items()):
        u, pe1 = sheet.u[: steps + 1, column, row], sheet.of("pe1")[: steps + 1, column, row]
        rest = sheet.position[0, sheet.number(column, row) - 1]
        style = {"color": LINES[n], "lw": 1.2, "ls": ("-", "--", "-.", ":")[n % 4]}
        for ax, y in zip(panels, (rest[0] + u[:, 0], rest[1] + u[:, 1], pe1), strict=True):
            ax.plot(np.arange(len(y)), y, label=label if ax is panels[0] else None, **style)
    for ax, title in zip(panels, ("x", "y", "PE1"), strict=True):
        _label_axes(ax, "step", title)
    panels[1].ticklabel_format(axis="y", useOffset=False)
    if log:
        panels[2].set(yscale="log", ylim=(1e-5, None))
    if np.ptp([line.get_ydata() for line in panels[1].lines]) < 1e-9:
        rest_y = float(panels[1].lines[0].get_ydata()[0])
        panels[1].set_ylim(rest_y - 0.5, rest_y + 0.5)
    figure.legend(loc="outside lower center", ncols=min(len(series), 4), frameon=False, fontsize=8)
    return save(figure, name)


def curves(
    lines: Mapping[str, tuple[Floats, Floats]], labels: tuple[str, str], name: str, **axis: object
) -> str:
    """Draw one pair of axes with lines of (x, y)."""
    figure = Figure((PAGE_IN * 0.62, 3.0), layout="constrained")
    ax = figure.add_subplot()
    for n, (label, (x, y)) in enumerate(lines.items()):
        ax.plot(
            x, y, color=LINES[n], lw=1.2, marker="o", ms=2.5 + 2 * (len(lines) - 1 - n), label=label
        )
    ax.set(**axis)
    _label_axes(ax, *labels)
    ax.legend(frameon=False, fontsize=8)
    return save(figure, name)


def _label_axes(ax: Axes, x: str, y: str) -> None:
    ax.set_xlabel(x, fontsize=8.5)
    ax.set_ylabel(y, fontsize=8.5)
    ax.tick_params(labelsize=7.5)
    ax.spines[["top", "right"]].set_visible(False)
