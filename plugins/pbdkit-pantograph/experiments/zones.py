"""The bias-extension test against the theory of inextensible fibres: prints the README's table.

Sheet of length L and width W, fibres at ±45°, pulled by d. Fibres that start at a grip stay as they
are near it: with no lengthening three zones form, A at the grips undeformed, C in the middle, where
no fibre reaches a grip, B between, where one does. Along the axis C alone gets longer, D = L - W,
and its rhombi with half-angle θ between the fibres have the diagonals √2 · l · cos θ · √2, so that

    cos θ = cos(π/4 - γ/2) = (D + d)/(√2 D),

and the fibres enclose 2θ = 90° - γ in C, 45° + θ in B, 90° in A.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

import pbdkit

FOLDER = Path(__file__).parent
FILE = "bias-extension.yaml"


class Cells(NamedTuple):
    """Cells of a sheet: `centre` (cell, axis) in the reference, the angle between fibres
    (degrees) and the zone; the strain of every link; `length` and `width` of the sheet."""

    centre: np.ndarray
    angle: np.ndarray
    zone: np.ndarray
    strain: np.ndarray
    length: float
    width: float


def pulled(across, along, pull, *settings, file=FILE):
    """The dataset of a sheet of along × across cells, pulled by a share of D, with the rule and
    the grips of an experiment beside this file."""
    size = 2.0**0.5
    length, width = along * size, across * size
    share = pull * (length - width)
    given = [
        f"body.width={length + 1e-6!r}",
        f"body.height={width + 1e-6!r}",
        f"leaders.0.select.box=[-0.1, -1.0, 0.1, {width + 1!r}]",
        f"leaders.1.select.box=[{length - 0.1!r}, -1.0, {length + 0.1!r}, {width + 1!r}]",
        f"leaders.1.motion={{type: velocity, velocity: [{share / 2000!r}, 0.0], steps: 2000}}",
        *settings,
    ]
    return pbdkit.run(pbdkit.load(FOLDER / file, settings=given), progress=False)


def cells(ds):
    """The cells of the last configuration."""
    X, x = ds.reference.values, ds.position.isel(time=-1).values
    half = np.sqrt(0.5)
    site = np.round(X / half).astype(int)
    length, width = site.max(axis=0)
    row = {tuple(s): n for n, s in enumerate(site)}
    left = [(i, j) for i, j in row if {(i + 2, j), (i + 1, j - 1), (i + 1, j + 1)} <= row.keys()]
    i, j = np.array(left).T
    corner = [
        x[[row[p] for p in zip(i + m, j + n, strict=True)]]
        for m, n in ((0, 0), (2, 0), (1, -1), (1, 1))
    ]
    along = np.linalg.norm(corner[1] - corner[0], axis=1)
    across = np.linalg.norm(corner[3] - corner[2], axis=1)
    links = np.concatenate([corner[3] - corner[0], corner[2] - corner[0]])
    # Of a cell's centre: how many of its two fibres reach the nearer grip.
    near = np.minimum(i + 1, length - i - 1)
    reaching = (near < j).astype(int) + (near < width - j).astype(int)
    zone = np.array(["C", "B", "A"])[reaching]
    zone[(near == j) | (near == width - j)] = "-"  # on a border
    centre = np.column_stack([i + 1, j]) * half
    angle = np.degrees(2 * np.arctan2(across, along))
    strain = np.linalg.norm(links, axis=1) - 1.0
    return Cells(centre, angle, zone, strain, length * half, width * half)


def theory(pull):
    """The angle between the fibres in the zones A, B and C (degrees) for d = pull · D."""
    half = np.degrees(np.arccos((1 + pull) / np.sqrt(2.0)))
    return {"A": 90.0, "B": 45.0 + half, "C": 2 * half}


def on_axis(found):
    """The mean of cos θ over the cells of C along the axis of the sheet."""
    axis = (found.zone == "C") & np.isclose(found.centre[:, 1], found.width / 2)
    return np.cos(np.radians(found.angle[axis] / 2)).mean()


def main():
    """Print the table of zones."""
    file, (across, along) = sys.argv[1], (int(n) for n in sys.argv[2:4])
    print("| d / D | A | B | C | theory A, B, C | cos θ on the axis | theory | links |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for pull in (0.05, 0.1, 0.2, 0.3):
        found, expected = cells(pulled(across, along, pull, *sys.argv[4:], file=file)), theory(pull)
        means = [
            f"{found.angle[found.zone == z].mean():.2f}° ± {found.angle[found.zone == z].std():.2f}"
            for z in "ABC"
        ]
        angles = ", ".join(f"{angle:.2f}" for angle in expected.values())
        print(
            f"| {pull:g} | {' | '.join(means)} | {angles} | {on_axis(found):.4f} | "
            f"{(1 + pull) / np.sqrt(2.0):.4f} | {100 * found.strain.min():.2f} to "
            f"{100 * found.strain.max():.2f} % |",
            flush=True,
        )


if __name__ == "__main__":
    main()
