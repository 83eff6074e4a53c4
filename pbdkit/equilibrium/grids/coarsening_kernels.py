"""How the grids of a matrix are made, each from the finer one, compiled.

A grid has a `code` by (row, place), the number of the stencil in `own` or -1 where nobody is free,
and a `kind`, 0 outside, 1 free, 2 led. `halved` tells along which axes the next grid has half the
places: its place n lies at 2n - 1, or at n.
"""

from __future__ import annotations

import numpy as np
from numba import njit

KEPT = globals().get("KEPT", False)


@njit(cache=KEPT)
def runs(code, first, begin, end, lone, place, which):
    """Fills the lists of a grid; returns how many runs and lone places there are. Lists without
    room are not filled."""
    r = s = 0
    for i in range(code.shape[0]):
        first[i], lone[i] = r, s
        j = 0
        while j < code.shape[1]:
            start = j
            while j < code.shape[1] and code[i, j] == 0:
                j += 1
            if j > start:
                if r < begin.size:
                    begin[r], end[r] = start, j
                r += 1
                continue
            if code[i, j] > 0:
                if s < place.size:
                    place[s], which[s] = j, code[i, j]
                s += 1
            j += 1
    first[code.shape[0]], lone[code.shape[0]] = r, s
    return r, s


@njit(cache=KEPT)
def coarse_kinds(kind, halved, out):
    """0 outside, 1 free, 2 led, of the next grid: a place outside on which free ones hang is free,
    unless led ones are nearer."""
    a1, b1 = halved
    for n in range(1, out.shape[0] - 1):
        for m in range(1, out.shape[1] - 1):
            i, j = (2 * n - 1 if a1 else n), (2 * m - 1 if b1 else m)
            here = kind[i, j] if i < kind.shape[0] and j < kind.shape[1] else 0
            for ring in (1, 2):
                if here:
                    break
                for a in range(max(-a1, -i), min(a1, kind.shape[0] - 1 - i) + 1):
                    for b in range(max(-b1, -j), min(b1, kind.shape[1] - 1 - j) + 1):
                        near = kind[i + a, j + b]
                        if abs(a) + abs(b) == ring and near and here != 1:
                            here = near
            out[n, m] = here


@njit(cache=KEPT)
def coarse_codes(code, kind, halved, out):
    """Of the next grid: -1 where nobody is free, 0 where all stencils around are the one of most,
    so that this one's is too; others are numbered from 1. Returns the last number."""
    count = 0
    a1, b1 = halved
    for n in range(out.shape[0]):
        for m in range(out.shape[1]):
            out[n, m] = -1
            if kind[n, m] != 1:
                continue
            i, j = (2 * n - 1 if a1 else n), (2 * m - 1 if b1 else m)
            plain = i > a1 and j > b1 and i + a1 + 1 < code.shape[0] and j + b1 + 1 < code.shape[1]
            if plain:
                for a in range(-a1 - 1, a1 + 2):
                    for b in range(-b1 - 1, b1 + 2):
                        c = code[i + a, j + b]
                        if c < 0 or (c > 0 and abs(a) <= a1 and abs(b) <= b1):
                            plain = False
            count += 0 if plain else 1
            out[n, m] = 0 if plain else count
    return count


@njit(cache=KEPT)
def beside(q, half):
    """The places of the next grid between which a place lies that is q away from one of them, and
    the share of the first: numbers of a stencil, -1, 0 or 1."""
    if not half:
        return q, q, 1.0
    return (q - 1) // 2 if q % 2 else q // 2, (q + 1) // 2, 0.5 if q % 2 else 1.0


@njit(cache=KEPT)
def galerkin(code, own, coarse, halved, out):
    """out[k] = the stencil of Pᵀ K P at the place of the next grid that is numbered k."""
    a1, b1 = halved
    for n in range(1, coarse.shape[0] - 1):
        for m in range(1, coarse.shape[1] - 1):
            k = coarse[n, m]
            if k <= 0:
                continue
            for a in range(-a1, a1 + 1):
                for b in range(-b1, b1 + 1):
                    i, j = (2 * n - 1 if a1 else n) + a, (2 * m - 1 if b1 else m) + b
                    if i >= code.shape[0] or j >= code.shape[1] or code[i, j] < 0:
                        continue
                    hangs = (1.0 - 0.5 * abs(a)) * (1.0 - 0.5 * abs(b))
                    for s in range(9):
                        da, db = s // 3 - 1, s % 3 - 1
                        if code[i + da, j + db] < 0:
                            continue
                        row, next_row, of_row = beside(a + da, a1)
                        place, next_place, of_place = beside(b + db, b1)
                        for ta, wa in ((row, of_row), (next_row, 1.0 - of_row)):
                            for tb, wb in ((place, of_place), (next_place, 1.0 - of_place)):
                                w = hangs * wa * wb
                                if w > 0.0:
                                    for e in range(4):
                                        out[k, 3 * ta + tb + 4, e] += w * own[code[i, j], s, e]


@njit(cache=KEPT)
def asymmetry(code, own):
    """The largest entry of K - Kᵀ. Of places with the stencil of most one pair a direction is
    enough."""
    worst, seen, unseen = 0.0, np.zeros(9, np.bool_), 9
    for i in range(1, code.shape[0] - 1):
        for j in range(1, code.shape[1] - 1):
            here = code[i, j]
            if here < 0 or (here == 0 and not unseen):
                continue
            for s in range(9):
                there = code[i + s // 3 - 1, j + s % 3 - 1]
                if there < 0 or (here == 0 and (there > 0 or seen[s])):
                    continue
                if here == 0:
                    seen[s] = True
                    unseen -= 1
                one, other = own[here, s], own[there, 8 - s]
                for e in range(4):
                    worst = max(worst, abs(one[e] - other[(0, 2, 1, 3)[e]]))
    return worst


@njit(cache=KEPT)
def symmetrise(code, own):
    """(K + Kᵀ) / 2, where places have stencils of their own."""
    for i in range(1, code.shape[0] - 1):
        for j in range(1, code.shape[1] - 1):
            for s in range(5):
                here, there = code[i, j], code[i + s // 3 - 1, j + s % 3 - 1]
                if here < 0 or there < 0:
                    continue
                for e in range(4):
                    t = (0, 2, 1, 3)[e]
                    mean = (own[here, s, e] + own[there, 8 - s, t]) / 2
                    own[here, s, e] = own[there, 8 - s, t] = mean


@njit(cache=KEPT)
def balance(code, own, factor):
    """Factors of rows, from place to place, with which as much of K as can be is symmetric, from
    those that are known, 0 where none is. Returns how many places have none, and how many had."""
    before = 0
    for i in range(code.shape[0]):
        for j in range(code.shape[1]):
            before += code[i, j] > 0 and factor[i, j] == 0.0
    found, left = 1, before
    while left and found:
        found = 0
        for i in range(1, code.shape[0] - 1):
            for j in range(1, code.shape[1] - 1):
                if code[i, j] <= 0 or factor[i, j] != 0.0:
                    continue
                both = square = 0.0
                for s in range(9):
                    a, b = i + s // 3 - 1, j + s % 3 - 1
                    if s != 4 and code[a, b] >= 0 and factor[a, b] > 0.0:
                        for e in range(4):
                            mine = own[code[i, j], s, e]
                            both += mine * factor[a, b] * own[code[a, b], 8 - s, (0, 2, 1, 3)[e]]
                            square += mine * mine
                if square > 0.0 and both > 0.0:
                    factor[i, j] = both / square
                    found += 1
        left -= found
    return left, before


def run():
    """Calls each of these once, so that all are compiled."""
    code = np.zeros((8, 8), np.int32)
    code[0] = code[-1] = code[:, 0] = code[:, -1] = -1
    code[2, 2] = 1
    kind, own, halved = (code >= 0).astype(np.int8), np.ones((2, 9, 4)), (1, 1)
    lists = np.zeros(9, np.int64), np.zeros(7, np.int32), np.zeros(7, np.int32)
    lists += np.zeros(9, np.int64), np.zeros(1, np.int32), np.zeros(1, np.int32)
    runs(code, *lists)
    coarse_kind, coarse_code = np.zeros((6, 6), np.int8), np.zeros((6, 6), np.int32)
    coarse_kinds(kind, halved, coarse_kind)
    count = coarse_codes(code, coarse_kind, halved, coarse_code)
    galerkin(code, own, coarse_code, halved, np.zeros((count + 1, 9, 4)))
    asymmetry(code, own)
    symmetrise(code, own)
    balance(code, own, np.zeros((8, 8)))
