"""Draw the picture of docs/parameter-sweep.md.

Run it as ``python docs/reproduction/stability_map.py [FOLDER]``.

Runs the 40 × 40 members of docs/stability-map.yaml that the folder does not contain yet, and draws
which of them decay, beside the boundary that is predicted before the first step.
"""

import sys
from pathlib import Path

import numpy as np
from drawing import DOT_COLOUR, FOLDER, LINES, save
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

import pbdkit
from pbdkit.model.reading import read_file

FILE = FOLDER.parent.parent / "stability-map.yaml"
FINE = 221


def main(folder: Path | None) -> None:
    """Write pictures/stability-map.png, and print the number of members that agree."""
    parts = read_file(FILE).data
    del parts["version"]
    found = pbdkit.sweep(**parts, folder=folder)
    size = abs(found.u).max(["particle", "axis"])
    settles = (size.sel(time=400) < size.sel(time=0)).values
    w, b = found.relaxation.values, found.memory.values
    known = pbdkit.analyse(parts["experiment"])
    predicted = np.array([[known.stable_at(x, y) for y in b] for x in w])
    print(f"members: {settles.size}, converged: {settles.sum()}")
    print(f"as predicted: {(settles == predicted).sum()}")
    figure = Figure((4.6, 3.6), layout="constrained")
    ax = figure.subplots()
    ax.pcolormesh(w, b, settles.T, cmap=ListedColormap(["#f3d6c6", "#6fa8d0"]))
    xs, ys = np.linspace(w[0], w[-1], FINE), np.linspace(b[0], b[-1], FINE)
    fine = np.array([[known.stable_at(x, y) for x in xs] for y in ys], float)
    ax.contour(xs, ys, fine, [0.5], colors=[LINES[5]], linewidths=1.2)
    ax.text(0.5, 0.25, "settled", color=DOT_COLOUR, fontsize=8)
    ax.text(1.5, -0.5, "grew, or diverged", color=DOT_COLOUR, fontsize=8)
    ax.set(xlabel="relaxation w", ylabel="memory b", title="40 × 40 runs, and the prediction")
    save(figure, "stability-map.png", FOLDER.parent)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else None)
