"""The stencil that most of a lattice has."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.equilibrium.rows import Rows

Floats = NDArray[np.floating[Any]]
Integers = NDArray[np.signedinteger[Any]]
CANDIDATES = 16
"""Stencils among which it is chosen, each process's most frequent."""
SAME = 1e-12
"""Relative difference below which two stencils count as one."""


def most_first(
    code: Integers, stencils: Floats, scale: Floats, rows: Rows
) -> tuple[NDArray[np.int32], Floats, Floats]:
    """The same with the stencil of most as number 0, and those alike with it."""
    tables = stencils, scale
    most = _most(code[..., rows.own, :], tables, rows)
    apart = [
        np.abs(table - one).max(axis=tuple(range(1, table.ndim)))
        for table, one in zip(tables, most, strict=True)
    ]
    alike = sum(apart) <= SAME * np.abs(most[0]).max()
    kept = (np.bincount(code[code >= 0], minlength=len(stencils)) > 0) & ~alike
    number = np.zeros(len(stencils) + 1, np.int32)
    number[:-1][kept] = 1 + np.arange(np.count_nonzero(kept))
    number[-1] = -1
    first, second = (
        np.concatenate([one[None], table[kept]]) for table, one in zip(tables, most, strict=True)
    )
    return number[code], first, second


def _most(own: Integers, tables: tuple[Floats, Floats], rows: Rows) -> tuple[Floats, Floats]:
    """The stencil and scale of most in all processes, as far as any of them has it among the most
    frequent of its own."""
    counts = np.bincount(own[own >= 0], minlength=len(tables[0]))
    some = np.argsort(-counts, kind="stable")[:CANDIDATES].tolist()
    votes: dict[bytes, int] = {}
    found: dict[bytes, tuple[Floats, Floats]] = {}
    for each in rows.every([(int(counts[n]), *(table[n] for table in tables)) for n in some]):
        for count, stencil, scale in each:
            key = stencil.tobytes() + scale.tobytes()
            votes[key] = votes.get(key, 0) + count
            found.setdefault(key, (stencil, scale))
    return found[max(votes, key=votes.__getitem__)]
