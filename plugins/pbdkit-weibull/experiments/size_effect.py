"""Strength against size, of chains and of sheets: prints the tables of the README.

The theory of the weakest link: of n bonds in series the weakest bears the strain ε with
probability exp(-n (ε/scale)^m), so that the mean strength is scale · Γ(1 + 1/m) · n^(-1/m).
"""

from __future__ import annotations

from math import gamma
from pathlib import Path

import numpy as np

import pbdkit

FOLDER = Path(__file__).parent
SCALE, INCREMENTS = 0.1, 100


def weakest_link(bonds, modulus):
    """The mean strength of that many bonds in series."""
    return SCALE * gamma(1 + 1 / modulus) * bonds ** (-1 / modulus)


def pulled(name, columns, rows, modulus, seed, increment, steps):
    """The dataset of an experiment with that many bonds along the load, pulled in steps."""
    speed = columns * increment
    settings = [
        f"body={{type: grid, columns: {columns + 1}, rows: {rows}}}",
        f"fracture.modulus={modulus}",
        f"seed={seed}",
        f"leaders.1.motion={{type: velocity, velocity: [{speed!r}, 0.0], steps: {steps}}}",
        f"steps={steps}",
    ]
    return pbdkit.run(pbdkit.load(FOLDER / f"{name}.yaml", settings=settings), progress=False)


def chains(bonds, modulus, seed, number=100, steps=INCREMENTS):
    """(applied strain in the increment in which each chain parts, size of an increment, strength of
    each of its bonds): (chain,), a number, (chain, bond)."""
    increment = 2.2 * weakest_link(bonds, modulus) / steps
    ds = pulled("chain", bonds, number, modulus, seed, increment, steps)
    row = ds.j.values[ds.bond_ends.values[:, 0] - 1]
    order = np.argsort(row, kind="stable")
    step = ds.broken_step.values[order].reshape(number, bonds)
    first = np.where(step > 0, step, steps + 1).min(axis=1)
    return first * increment, increment, ds.strength.values[order].reshape(number, bonds)


def sheet(size, modulus, seed):
    """Applied strain at which the first bond of a sheet of size × size bonds breaks, and the
    largest load that it bears, per row and in units of a bond's strain."""
    increment = 2.0 * SCALE / INCREMENTS
    ds = pulled("sheet", size, size, modulus, seed, increment, INCREMENTS)
    step = ds.broken_step.values
    events = np.unique(step[step > 0])
    seen = np.unique(np.concatenate([events - 1, events]))
    loads = [n * increment * stiffness(ds, (step < 0) | (step > n), size) for n in seen]
    return events[0] * increment, max(loads)


def stiffness(ds, whole, size):
    """The load per row of a sheet with these bonds at unit strain, 1 where none is broken.

    Where the mean displacement rests, the differences along whole bonds add up to zero: a net of
    resistors, with currents for loads.
    """
    column = ds.i.values
    one, other = ds.bond_ends.values[whole].T - 1
    net = np.zeros((len(column),) * 2)
    net[one, other] = net[other, one] = 1.0
    laplacian = np.diag(net.sum(axis=1)) - net
    free = (column > 0) & (column < size)
    u = np.where(column == size, float(size), 0.0)
    held = laplacian[np.ix_(free, ~free)] @ u[~free]
    # What is held by nothing rests at zero, by a spring that is too weak to be felt elsewhere.
    u[free] = -np.linalg.solve(laplacian[np.ix_(free, free)] + 1e-9 * np.eye(free.sum()), held)
    return float(-(laplacian @ u)[column == 0].sum() / size)


def main():
    """Print the tables of chains and of sheets."""
    print("| bonds in series | modulus | mean strength, 500 chains | theory | share |")
    print("| --- | --- | --- | --- | --- |")
    for modulus in (2.0, 4.0, 8.0):
        for bonds in (4, 16, 64):
            runs = [chains(bonds, modulus, seed) for seed in range(5)]
            strength = np.concatenate([first - increment / 2 for first, increment, _ in runs])
            mean, theory = strength.mean(), weakest_link(bonds, modulus)
            error = strength.std() / np.sqrt(len(strength))
            print(
                f"| {bonds} | {modulus:g} | {mean:.5f} ± {error:.5f} | {theory:.5f} "
                f"| {mean / theory:.3f} |"
            )
    print("\n| sheet | modulus | first bond breaks | weakest link | largest load |")
    print("| --- | --- | --- | --- | --- |")
    for modulus in (2.0, 4.0, 8.0):
        for size in (4, 8, 16):
            first, load = np.transpose([sheet(size, modulus, seed) for seed in range(10)])
            print(
                f"| {size} × {size} | {modulus:g} | {first.mean():.4f} | "
                f"{weakest_link(size * size, modulus):.4f} | {load.mean():.4f} ± "
                f"{load.std() / np.sqrt(10):.4f} |"
            )


if __name__ == "__main__":
    main()
