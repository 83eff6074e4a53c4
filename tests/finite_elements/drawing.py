"""The picture of error against time: a panel a problem."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

COLOURS = {
    "P1": "#9ecae1",
    "Q1": "#4292c6",
    "P2": "#bdbdbd",
    "Q2": "#636363",
    "equilibrium": "#d94801",
    "steps with memory": "#238b45",
    "steps": "#a1d99b",
}


def draw(path: Path, found: dict[str, Any], elements: tuple[str, ...]) -> None:
    """Curves by problem and name. scikit-fem's times (of a processor, which others that are at work
    change little) are those of assembly and solving, pbdkit's those of setting up, too."""
    figure = Figure(figsize=(12, 4.2), layout="constrained")
    axes = figure.subplots(1, len(found), sharey=True)
    for ax, (problem, curves) in zip(axes, found.items(), strict=True):
        for name, points in curves.items():
            fem = name in elements
            times = [p.solving.processor + (0.0 if fem else p.setup.processor) for p in points]
            label = f"scikit-fem {name}" if fem else f"pbdkit, {name}"
            ax.loglog(
                [1e3 * t for t in times],
                [p.error for p in points],
                marker="o" if fem else "s",
                markersize=4,
                linestyle="--" if fem else "-",
                color=COLOURS[name],
                label=label,
            )
        ax.set_title(problem)
        ax.set_xlabel("processor time, ms")
        ax.grid(which="major", color="#dddddd", linewidth=0.6)
    axes[0].set_ylabel("relative L2 error of the displacements")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    figure.savefig(path, dpi=110)
