"""Draw the picture of docs/validation/oscillation.md: ``python docs/reproduction/oscillating.py``.

Left: the oscillating shipped experiment, with the decay of the closed form. Right: relaxations and
memories for which the barycentre on a square sheet converges, and its slowest mode oscillates.
"""

import math

import numpy as np
from drawing import FOLDER, LINES, save
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import pbdkit
from pbdkit.linear.spectrum import modes

NAME, PARTICLE, LET_GO = "stability/oscillation", 116, 300


def main() -> None:
    """Write pictures/oscillation.png with both panels."""
    figure = Figure((7.4, 2.9), layout="constrained")
    left, right = figure.subplots(1, 2)
    _swing(left)
    _region(right)
    save(figure, "oscillation.png", FOLDER.parent)


def _swing(ax: Axes) -> None:
    """Draw y of the middle of the sheet after its release, and the envelope with √b^t."""
    experiment = pbdkit.load(NAME)
    ds = pbdkit.run(experiment, progress=False)
    found = pbdkit.analyse(experiment).oscillation(1.0, experiment.solver.memory)
    assert found is not None
    y = ds.u.sel(particle=PARTICLE, axis="y").values[LET_GO:]
    t = np.arange(len(y))
    ax.plot(t, y, color=LINES[0], lw=1.2, label=f"y of particle {PARTICLE}")
    envelope = y[0] * found.decay**t
    ax.plot(t, envelope, color=LINES[1], lw=0.8, ls="--", label="√b to the step")
    ax.plot(t, -envelope, color=LINES[1], lw=0.8, ls="--")
    for n in range(int(len(y) / found.period) + 1):
        ax.axvline(n * found.period, color="0.85", lw=0.7, zorder=0)
    ax.set(xlabel="steps since let go", ylabel="displacement (lattice units)")
    ax.set_title(f"{NAME}: period {found.period:.1f} steps", fontsize=8.5)
    ax.legend(frameon=False, fontsize=7)


def _region(ax: Axes) -> None:
    """Square sheet of 20 columns, both ends held: λ from -ρ to ρ."""
    largest = (1 + math.cos(math.pi / 19)) / 2
    w, b = np.meshgrid(np.linspace(0.005, 2.2, 440), np.linspace(-1.1, 1.1, 441))
    ends = [
        modes(np.array([end], complex), relaxation, memory)
        for end in (largest, -largest)
        for relaxation, memory in zip(w.ravel(), b.ravel(), strict=True)
    ]
    slow, fast = np.abs(np.array(ends)).max(axis=1).reshape(2, *w.shape)
    swings = (np.abs(np.array(ends)[: w.size].imag).max(axis=1) > 1e-9).reshape(w.shape)
    stable = np.maximum(slow, fast) < 1.0
    ax.contourf(
        w, b, stable * (1 + swings), [-0.5, 0.5, 1.5, 2.5], colors=["w", "#cfe3f3", "#6fa8d0"]
    )
    ax.plot([0, 2], [-1, 1], color=LINES[1], lw=0.9)
    ax.plot([1.0], [0.0], "o", color=LINES[5], ms=3.5)
    ax.annotate("the paper's rule", (1.0, 0.0), (-4, -12), textcoords="offset points", fontsize=7)
    ax.text(0.35, 0.2, "creeps", fontsize=7)
    ax.text(1.1, 0.9, "slowest mode oscillates", fontsize=7)
    ax.text(1.45, -0.55, "diverges\n(w > 1 + b)", fontsize=7)
    ax.set(xlim=(0, 2.2), ylim=(-1.1, 1.1), xlabel="relaxation w", ylabel="memory b")
    ax.set_title("barycentre, square 4, 20 columns", fontsize=8.5)


if __name__ == "__main__":
    main()
