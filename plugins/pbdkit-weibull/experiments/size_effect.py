"""Strength against size, of chains and of sheets: prints the tables of the README.

The theory of the weakest link: of n bonds in series the weakest bears the strain ε with
probability exp(-n (ε/scale)^m), so that the mean strength is scale · Γ(1 + 1/m) · n^(-1/m).
"""

from __future__ import annotations

from math import gamma
from pathlib import Path

import numpy as np
import pbdkit
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

FOLDER = Path(__file__).parent
SCALE, INCREMENTS = 0.1, 100


def weakest_link(bonds, modulus):
    """The mean strength of that many bonds in series."""
    return SCALE * gamma(1 + 1 / modulus) * bonds ** (-1 / modulus)


def pulled(name, columns, rows, modulus, seed, strain):
    """The dataset of an experiment with that many bonds along the load, pulled to that strain."""
    speed = columns * strain / INCREMENTS
    settings = [
        f"body={{type: grid, columns: {columns + 1}, rows: {rows}}}",
        f"fracture.modulus={modulus}",
        f"seed={seed}",
        f"leaders.1.motion.velocity=[{speed!r}, 0.0]",
    ]
    return pbdkit.run(pbdkit.load(FOLDER / f"{name}.yaml", settings=settings), progress=False)


def chains(bonds, modulus, seed, number=100):
    """(applied strain in the increment in which each chain parts, size of an increment, strength of
    each of its bonds): (chain,), a number, (chain, bond)."""
    increment = 2.2 * weakest_link(bonds, modulus) / INCREMENTS
    ds = pulled("chain", bonds, number, modulus, seed, increment * INCREMENTS)
    row = ds.site.values[ds.bond.values[:, 0], 1]
    order = np.argsort(row, kind="stable")
    step = ds.broken_step.values[order].reshape(number, bonds)
    first = np.where(step > 0, step, INCREMENTS + 1).min(axis=1)
    return first * increment, increment, ds.strength.values[order].reshape(number, bonds)


def sheet(size, modulus, seed):
    """Applied strain at which the first bond of a sheet of size × size bonds breaks, and at which
    it comes apart."""
    increment = 2.0 * SCALE / INCREMENTS
    ds = pulled("sheet", size, size, modulus, seed, increment * INCREMENTS)
    step = ds.broken_step.values
    column = ds.site.values[:, 0]
    for last in np.unique(step[step > 0]):
        whole = ds.bond.values[(step < 0) | (step > last)]
        graph = coo_array((np.ones(len(whole)), whole.T), shape=(len(column),) * 2)
        piece = connected_components(graph, directed=False)[1]
        if not set(piece[column == 0]) & set(piece[column == size]):
            return step[step > 0].min() * increment, last * increment
    return step[step > 0].min() * increment, np.nan


def main():
    """Prints both tables."""
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
    print("\n| sheet | modulus | first bond breaks | weakest link | comes apart |")
    print("| --- | --- | --- | --- | --- |")
    for modulus in (2.0, 4.0, 8.0):
        for size in (4, 8, 16):
            first, apart = np.transpose([sheet(size, modulus, seed) for seed in range(10)])
            print(
                f"| {size} × {size} | {modulus:g} | {first.mean():.4f} "
                f"| {weakest_link(size * size, modulus):.4f} "
                f"| {np.mean(apart):.4f} ± {np.std(apart) / np.sqrt(10):.4f} |"
            )


if __name__ == "__main__":
    main()
