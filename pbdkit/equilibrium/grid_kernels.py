"""Compiled loops over the rows of grids. They coarsen a grid, update the fields of an iteration,
and relax.

A grid has two arrays (row, place): `code` is the index of the stencil in `own`, -1 where no
particle is free; `kind` is 0 outside, 1 at free particles, 2 at leaders. The next grid is the next
coarser one. It has half the places along the axes `halved`: along these axes its place n coincides
with place 2n - 1 of this grid. Along the other axes its place n coincides with place n. Fields are
planes (axis, row, place), zero where no particle is free; the outermost ring is never free.

A row consists of runs and lone places. A run contains the places from `begin` to `end`, which all
have the stencil `same`; a lone place has the stencil `own[which]`. A stencil has 3 × 3 places, row
by row, with 4 numbers each: xx, xy, yx, yy. Relaxation alternates between the even and the odd
rows; all places of a row are updated simultaneously. Sums are computed row by row, so that the
result does not depend on the number of rows processed at a time.
"""

from __future__ import annotations

from collections import namedtuple

import numpy as np
from numba import njit

CACHED = globals().get("CACHED", False)
"""True if numba caches the compiled functions on disk."""
EXACT = {"cache": CACHED, "no_cfunc_wrapper": True}
"""Options of numba for loops over grids."""
FAST = {**EXACT, "error_model": "numpy", "nogil": True, "fastmath": True}
"""Options of numba for loops over fields."""
INTERNAL = {"no_cpython_wrapper": True, "cache": False}
"""Further options of functions that only compiled functions call."""


@njit(**EXACT)
def runs(code, first, begin, end, lone, place, which):
    """Fill the lists of runs and lone places of a grid, and return how many there are of each.
    Lists that are too short are not filled."""
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


@njit(**EXACT)
def coarse_kinds(kind, halved, out):
    """Compute the kinds of the next grid. A place of the next grid that lies outside the body is
    free if values at free places of this grid are interpolated from it, unless leaders are
    nearer."""
    a1, b1 = halved
    for n in range(1, out.shape[0] - 1):
        for m in range(1, out.shape[1] - 1):
            i, j = (2 * n - 1 if a1 else n), (2 * m - 1 if b1 else m)
            place_kind = kind[i, j]
            for ring in (1, 2):
                if place_kind:
                    break
                for a in range(max(-a1, -i), min(a1, kind.shape[0] - 1 - i) + 1):
                    for b in range(max(-b1, -j), min(b1, kind.shape[1] - 1 - j) + 1):
                        near = kind[i + a, j + b]
                        if abs(a) + abs(b) == ring and near and place_kind != 1:
                            place_kind = near
            out[n, m] = place_kind


@njit(**EXACT)
def coarse_codes(code, kind, halved, out):
    """Compute the codes of the next grid, and return the largest. The code is -1 where no particle
    is free, and 0 where all stencils of this grid around the place are the most frequent one. All
    other places are numbered from 1."""
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


@njit(**{**EXACT, **INTERNAL})
def beside(q, half):
    """Return the two places of the next grid between which a place of this grid lies, and the
    weight of the first of them in the interpolation. The place of this grid is q places away from
    the one that coincides with the centre of a coarse stencil. The results are counted from that
    centre: -1, 0 or 1. With `half`, the next grid has half the places along the axis."""
    if not half:
        return q, q, 1.0
    return (q - 1) // 2 if q % 2 else q // 2, (q + 1) // 2, 0.5 if q % 2 else 1.0


@njit(**EXACT)
def galerkin(code, stencils, coarse, halved, out):
    """Compute out[k], the stencil of Pᵀ K P at the place with the code k on the next grid."""
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
                                        out[k, 3 * ta + tb + 4, e] += w * stencils[code[i, j], s, e]


@njit(**EXACT)
def asymmetry(code, stencils):
    """Return the largest entry of K - Kᵀ. All places with the most frequent stencil have equal
    entries, so that only one pair of these places is compared in each direction."""
    worst, is_checked, unchecked = 0.0, np.zeros(9, np.bool_), 9
    for i in range(1, code.shape[0] - 1):
        for j in range(1, code.shape[1] - 1):
            number = code[i, j]
            if number < 0 or (number == 0 and not unchecked):
                continue
            for s in range(9):
                neighbour = code[i + s // 3 - 1, j + s % 3 - 1]
                if neighbour < 0 or (number == 0 and (neighbour > 0 or is_checked[s])):
                    continue
                if number == 0:
                    is_checked[s] = True
                    unchecked -= 1
                entry, opposite = stencils[number, s], stencils[neighbour, 8 - s]
                for e in range(4):
                    worst = max(worst, abs(entry[e] - opposite[(0, 2, 1, 3)[e]]))
    return worst


@njit(**EXACT)
def symmetrise(code, stencils):
    """Replace K by (K + Kᵀ) / 2 at places with separate stencils."""
    for i in range(1, code.shape[0] - 1):
        for j in range(1, code.shape[1] - 1):
            for s in range(5):
                number, neighbour = code[i, j], code[i + s // 3 - 1, j + s % 3 - 1]
                if number < 0 or neighbour < 0:
                    continue
                for e in range(4):
                    t = (0, 2, 1, 3)[e]
                    mean = (stencils[number, s, e] + stencils[neighbour, 8 - s, t]) / 2
                    stencils[number, s, e] = stencils[neighbour, 8 - s, t] = mean


@njit(**EXACT)
def balance(code, stencils, factor):
    """Compute the row factors that make K as symmetric as possible. Places that already have a
    factor, which is not 0, keep it; from them the computation spreads to their neighbours, until no
    further factor can be determined. Return the number of places without a factor after and before
    the call."""
    initial = 0
    for i in range(code.shape[0]):
        for j in range(code.shape[1]):
            initial += code[i, j] > 0 and factor[i, j] == 0.0
    progress, missing = 1, initial
    while missing and progress:
        progress = 0
        for i in range(1, code.shape[0] - 1):
            for j in range(1, code.shape[1] - 1):
                if code[i, j] <= 0 or factor[i, j] != 0.0:
                    continue
                both = square = 0.0
                for s in range(9):
                    a, b = i + s // 3 - 1, j + s % 3 - 1
                    if s != 4 and code[a, b] >= 0 and factor[a, b] > 0.0:
                        for e in range(4):
                            entry = stencils[code[i, j], s, e]
                            both += (
                                entry * factor[a, b] * stencils[code[a, b], 8 - s, (0, 2, 1, 3)[e]]
                            )
                            square += entry * entry
                if square > 0.0 and both > 0.0:
                    factor[i, j] = both / square
                    progress += 1
        missing -= progress
    return missing, initial


def run_coarsening():
    """Call each function once, so that all are compiled."""
    code = np.zeros((8, 8), np.int32)
    code[0] = code[-1] = code[:, 0] = code[:, -1] = -1
    code[2, 2] = 1
    kind, stencils, halved = (code >= 0).astype(np.int8), np.ones((2, 9, 4)), (1, 1)
    lists = np.zeros(9, np.int64), np.zeros(7, np.int32), np.zeros(7, np.int32)
    lists += np.zeros(9, np.int64), np.zeros(1, np.int32), np.zeros(1, np.int32)
    runs(code, *lists)
    coarse_kind, coarse_code = np.zeros((6, 6), np.int8), np.zeros((6, 6), np.int32)
    coarse_kinds(kind, halved, coarse_kind)
    count = coarse_codes(code, coarse_kind, halved, coarse_code)
    galerkin(code, stencils, coarse_code, halved, np.zeros((count + 1, 9, 4)))
    asymmetry(code, stencils)
    symmetrise(code, stencils)
    balance(code, stencils, np.zeros((8, 8)))


@njit(**FAST)
def descend(a, p, q, x, r, share, out, sums):
    """Compute x += a p, r -= a q, and out = share · r in the precision of `out`. For each row,
    `sums` receives r · r and the largest |a p|."""
    sums[:] = 0.0
    for v in range(2):
        for i in range(x.shape[1]):
            xs, rs, ps, qs, os = x[v, i], r[v, i], p[v, i], q[v, i], out[v, i]
            part = longest = 0.0
            for j in range(xs.size):
                xs[j] += a * ps[j]
                rs[j] -= a * qs[j]
                os[j] = share * rs[j]
                part += rs[j] * rs[j]
                longest = max(longest, abs(ps[j]))
            sums[0, i] += part
            sums[1, i] = max(sums[1, i], abs(a) * longest)


@njit(**FAST)
def turn(share, z, beta, p):
    """Compute p = share · z + beta p."""
    for v in range(2):
        for i in range(p.shape[1]):
            zs, ps = z[v, i], p[v, i]
            for j in range(ps.size):
                ps[j] = share * zs[j] + beta * ps[j]


@njit(**FAST)
def dot(a, b, sums):
    """Compute the scalar product a · b of each row."""
    sums[:] = 0.0
    for v in range(2):
        for i in range(a.shape[1]):
            first, second = a[v, i], b[v, i]
            part = 0.0
            for j in range(first.size):
                part += first[j] * second[j]
            sums[i] += part


@njit(**FAST)
def prolong(first, begin, end, lone, place, coarse, halved, x):
    """Compute x += P coarse at the free places of a grid, given its runs and lone places by row."""
    half, width = x.dtype.type(0.5), coarse.shape[2]
    line, row = np.zeros(width + 1, x.dtype), np.zeros(2 * width + 2, x.dtype)
    for i in range(first.size - 1):
        if first[i] == first[i + 1] and lone[i] == lone[i + 1]:
            continue
        for v in range(2):
            low = (i + 1) // 2 if halved[0] else i
            high = i // 2 + 1 if halved[0] else i
            lower, upper = coarse[v, low], coarse[v, high]
            for n in range(width):
                line[n] = half * (lower[n] + upper[n])
            if halved[1]:
                for n in range(width):
                    row[2 * n] = half * (line[n] + line[n + 1])
                    row[2 * n + 1] = line[n + 1]
            else:
                for n in range(width):
                    row[n] = line[n]
            for e in range(first[i], first[i + 1]):
                lo, hi = begin[e], end[e]
                to, of = x[v, i, lo:hi], row[lo:hi]
                for j in range(hi - lo):
                    to[j] += of[j]
            for e in range(lone[i], lone[i + 1]):
                x[v, i, place[e]] += row[place[e]]


@njit(**FAST)
def differences(still, moved, place, number, share, axis, out):
    """Write share · (still - moved) at flat places into entry `number` of their stencils. This is
    the derivative with respect to a displacement along `axis`. Return the largest value."""
    largest = 0.0
    for n in range(place.size):
        for v in range(2):
            value = share * (still[v, place[n]] - moved[v, place[n]])
            out[n, number[n], v, axis] = value
            largest = max(largest, abs(value))
    return largest


@njit(**FAST)
def clear_noise(stencils, noise):
    """Set the entries of stencils to zero. This is done for each block (axis, axis) in which no
    magnitude exceeds `noise`."""
    for n in range(stencils.shape[0]):
        for s in range(stencils.shape[1]):
            c = stencils[n, s]
            if max(abs(c[0, 0]), abs(c[0, 1]), abs(c[1, 0]), abs(c[1, 1])) <= noise:
                c[:] = 0.0


def run_fields():
    """Call each function once, so that all are compiled."""
    r, z = np.zeros((2, 8, 8)), np.zeros((2, 8, 8), np.float32)
    descend(0.0, r, r, r.copy(), r.copy(), 1.0, z, np.zeros((2, 8)))
    turn(1.0, z, 0.0, r)
    dot(r, z, np.zeros(8))
    dot(r, r, np.zeros(8))
    differences(r.reshape(2, -1), r.reshape(2, -1), np.zeros(1, int), np.zeros(1, int), 1.0, 0,
                np.zeros((1, 9, 2, 2)))  # fmt: skip
    clear_noise(np.zeros((1, 9, 2, 2)), 0.0)
    rows, lists = np.zeros(9, np.int64), np.zeros(1, np.int32)
    prolong(rows, lists, lists, rows, lists, np.zeros((2, 6, 6), np.float32), (1, 1), z)


Grid = namedtuple("Grid", "first begin end lone place which same own inverse own_inverse")
"""Grid as an argument of kernels. It contains for each row the indices of the `first` run and of
the first `lone` place, followed by the total numbers of runs and lone places; and it contains the
stencils and the inverses of their diagonal blocks."""


@njit(**{**FAST, **INTERNAL})
def around(x, i, lo, hi):
    """Return views of the row of a run and of the rows before and after it, for the components
    along x and y. The views extend from one place before the run to one place after it."""
    lo, hi = lo - 1, hi + 1
    previous, following = (
        (x[0, i - 1, lo:hi], x[1, i - 1, lo:hi]),
        (x[0, i + 1, lo:hi], x[1, i + 1, lo:hi]),
    )
    return previous[0], previous[1], x[0, i, lo:hi], x[1, i, lo:hi], following[0], following[1]


@njit(**{**FAST, **INTERNAL})
def of_row(c, x, y, j):
    """Return the product of three places of a row and the 12 numbers of one row of a stencil."""
    x0, y0, x1, y1, x2, y2 = x[j], y[j], x[j + 1], y[j + 1], x[j + 2], y[j + 2]
    kx = (c[0] * x0 + c[1] * y0) + (c[4] * x1 + c[5] * y1) + (c[8] * x2 + c[9] * y2)
    ky = (c[2] * x0 + c[3] * y0) + (c[6] * x1 + c[7] * y1) + (c[10] * x2 + c[11] * y2)
    return kx, ky


@njit(**{**FAST, **INTERNAL})
def of_run(c, rows, j):
    """Return K x at place j of a run."""
    ax, ay = of_row(c[0], rows[0], rows[1], j)
    bx, by = of_row(c[1], rows[2], rows[3], j)
    cx, cy = of_row(c[2], rows[4], rows[5], j)
    return ax + bx + cx, ay + by + cy


@njit(**{**FAST, **INTERNAL})
def of_lone(grid, e, x, i):
    """Return K x at a place with a separate stencil."""
    j, k = grid.place[e], grid.which[e]
    kx = ky = x[0, 0, 0] * 0
    for a in range(3):
        for b in range(3):
            c, u, v = grid.own[k, 3 * a + b], x[0, i + a - 1, j + b - 1], x[1, i + a - 1, j + b - 1]
            kx += c[0] * u + c[1] * v
            ky += c[2] * u + c[3] * v
    return kx, ky


@njit(**FAST)
def product(grid, x, out, sums):
    """Compute out = K x, and x · K x of each row in `sums`."""
    for i in range(grid.first.size - 1):
        part = 0.0
        for e in range(grid.first[i], grid.first[i + 1]):
            lo, hi = grid.begin[e], grid.end[e]
            rows, ox, oy = around(x, i, lo, hi), out[0, i, lo:hi], out[1, i, lo:hi]
            for j in range(hi - lo):
                ox[j], oy[j] = of_run(grid.same, rows, j)
            for j in range(hi - lo):
                part += rows[2][j + 1] * ox[j] + rows[3][j + 1] * oy[j]
        for e in range(grid.lone[i], grid.lone[i + 1]):
            j = grid.place[e]
            kx, ky = of_lone(grid, e, x, i)
            out[0, i, j], out[1, i, j] = kx, ky
            part += x[0, i, j] * kx + x[1, i, j] * ky
        sums[i] = part


@njit(**{**FAST, **INTERNAL})
def residual(grid, i, b, x, out):
    """Compute out = b - K x of a row, (axis, place)."""
    for e in range(grid.first[i], grid.first[i + 1]):
        lo, hi = grid.begin[e], grid.end[e]
        rows, bx, by = around(x, i, lo, hi), b[0, i, lo:hi], b[1, i, lo:hi]
        ox, oy = out[0, lo:hi], out[1, lo:hi]
        for j in range(hi - lo):
            kx, ky = of_run(grid.same, rows, j)
            ox[j], oy[j] = bx[j] - kx, by[j] - ky
    for e in range(grid.lone[i], grid.lone[i + 1]):
        j = grid.place[e]
        kx, ky = of_lone(grid, e, x, i)
        out[0, j], out[1, j] = b[0, i, j] - kx, b[1, i, j] - ky


@njit(**{**FAST, **INTERNAL})
def solve_own(grid, i, r, weight, x):
    """Compute x += weight · D⁻¹ r at the places of a row, with the diagonal blocks D."""
    d = grid.inverse
    for e in range(grid.first[i], grid.first[i + 1]):
        lo, hi = grid.begin[e], grid.end[e]
        rx, ry, ox, oy = r[0, lo:hi], r[1, lo:hi], x[0, i, lo:hi], x[1, i, lo:hi]
        for j in range(hi - lo):
            ox[j] += weight * (d[0] * rx[j] + d[1] * ry[j])
            oy[j] += weight * (d[2] * rx[j] + d[3] * ry[j])
    for e in range(grid.lone[i], grid.lone[i + 1]):
        j, k, c = grid.place[e], grid.which[e], grid.own_inverse
        x[0, i, j] += weight * (c[k, 0] * r[0, j] + c[k, 1] * r[1, j])
        x[1, i, j] += weight * (c[k, 2] * r[0, j] + c[k, 3] * r[1, j])


@njit(**{**FAST, **INTERNAL})
def clear(x, i):
    """Set a row to zero."""
    for v in range(2):
        for j in range(x.shape[2]):
            x[v, i, j] = 0


@njit(**FAST)
def relax(grid, b, x, weight, start, upwards):
    """Relax x += weight · D⁻¹ (b - K x) on even rows, then on odd ones; with `upwards` in the
    opposite order. With `start` the iteration begins from x = 0, and values of x are ignored."""
    rows, row = grid.first.size - 1, np.empty((2, x.shape[2]), x.dtype)
    for i in range(1 if upwards else 0, rows + 1, 2):
        # Relax row i, then row i - 1, since both rows next to row i - 1 are relaxed by then.
        if i < rows:
            if start:
                clear(x, i)
                for v in range(2):
                    for j in range(row.shape[1]):
                        row[v, j] = b[v, i, j]
            else:
                residual(grid, i, b, x, row)
            solve_own(grid, i, row, weight, x)
        if i > 0:
            if start:
                clear(x, i - 1)
            residual(grid, i - 1, b, x, row)
            solve_own(grid, i - 1, row, weight, x)


@njit(**FAST)
def restrict(grid, b, x, halved, code, out):
    """Compute out = Pᵀ (b - K x) at the free places of the next grid, where `code` is at least
    0."""
    half, width, across = x.dtype.type(0.5), code.shape[1], x.shape[2]
    odd, even = np.zeros((2, across), x.dtype), np.zeros((2, across), x.dtype)
    sums = np.zeros((2, 2 * width + 2), x.dtype)
    for n in range(code.shape[0]):
        if halved[0]:
            add_rows(sums, even, half, True)
            whole_residual(grid, 2 * n - 1, b, x, odd)
            add_rows(sums, odd, x.dtype.type(1.0), False)
            whole_residual(grid, 2 * n, b, x, even)
            add_rows(sums, even, half, False)
        else:
            whole_residual(grid, n, b, x, odd)
            add_rows(sums, odd, x.dtype.type(1.0), True)
        for v in range(2):
            to, of, free = out[v, n], sums[v], code[n]
            to[0] = to[width - 1] = 0
            if halved[1]:
                for m in range(1, width - 1):
                    value = of[2 * m - 1] + half * (of[2 * m - 2] + of[2 * m])
                    to[m] = value if free[m] >= 0 else value * 0
            else:
                for m in range(1, width - 1):
                    to[m] = of[m] if free[m] >= 0 else of[m] * 0


@njit(**{**FAST, **INTERNAL})
def whole_residual(grid, i, b, x, out):
    """Compute the residual of a row, zero where no particle is free and for a row outside the
    grid."""
    for v in range(2):
        for j in range(out.shape[1]):
            out[v, j] = 0
    if 0 <= i < grid.first.size - 1:
        residual(grid, i, b, x, out)


@njit(**{**FAST, **INTERNAL})
def add_rows(sums, row, share, overwrite):
    """Add share · row to `sums` for both axes or, with `overwrite`, replace `sums` by it."""
    for v in range(2):
        to, of = sums[v], row[v]
        if overwrite:
            for j in range(of.size):
                to[j] = share * of[j]
        else:
            for j in range(of.size):
                to[j] += share * of[j]


@njit(**FAST)
def scaled(grid, same, table, moves, out):
    """Multiply the moves at free places by S. The 2 × 2 matrix S of a place is given by its
    stencil, as 4 numbers."""
    for i in range(grid.first.size - 1):
        for e in range(grid.first[i], grid.first[i + 1]):
            lo, hi = grid.begin[e], grid.end[e]
            for j in range(lo, hi):
                u, v = moves[0, i, j], moves[1, i, j]
                out[0, i, j], out[1, i, j] = same[0] * u + same[1] * v, same[2] * u + same[3] * v
        for e in range(grid.lone[i], grid.lone[i + 1]):
            j, c = grid.place[e], table[grid.which[e]]
            u, v = moves[0, i, j], moves[1, i, j]
            out[0, i, j], out[1, i, j] = c[0] * u + c[1] * v, c[2] * u + c[3] * v


def run():
    """Call each function once, so that all are compiled."""
    run_coarsening()
    run_fields()
    lists = np.zeros(9, np.int64), np.zeros(7, np.int32), np.zeros(7, np.int32)
    lists += np.zeros(9, np.int64), np.zeros(1, np.int32), np.zeros(1, np.int32)
    grids, stencils = [], np.ones((2, 9, 4))
    for real in (np.float32, np.float64):
        same, middle = ((real(1.0),) * 12,) * 3, (real(1.0),) * 4
        grids.append(Grid(*lists, same, stencils.astype(real), middle, np.ones((2, 4), real)))
    rough, exact = grids
    r, z, half = np.zeros((2, 8, 8)), np.zeros((2, 8, 8), np.float32), np.float32(0.5)
    product(exact, r, r.copy(), np.zeros(8))
    relax(rough, z, z.copy(), half, True, False)
    coarse, code = np.zeros((2, 6, 6), np.float32), np.zeros((6, 6), np.int32)
    restrict(rough, z, z, (1, 1), code, coarse)
    scaled(exact, (1.0,) * 4, np.ones((2, 4)), r, r)
