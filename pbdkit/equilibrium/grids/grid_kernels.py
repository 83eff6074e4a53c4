"""What is done on one grid of a lattice: loops over its rows, compiled.

Fields are planes (axis, row, place), zero where nobody is free; the outermost ring is never free. A
row has runs of places that share the stencil `same`, from `begin` to `end`, and single places, the
lone, with stencils of their own, `own[which]`. A stencil is 3 × 3 places of 4 numbers, xx, xy, yx,
yy, row after row.

Rows are relaxed in two colours, even and odd, the places of a row from the same state; sums are
made row by row. So what comes out does not depend on how many rows are done at a time.
"""

from __future__ import annotations

from collections import namedtuple

import numpy as np
from numba import njit

KEPT = globals().get("KEPT", False)
FAST = {"error_model": "numpy", "nogil": True, "cache": KEPT, "fastmath": True}

Grid = namedtuple("Grid", "first begin end lone place which same own inverse own_inverse")
"""Of each row its `first` run and `lone` place, with the ends of the last row at the end; the
stencils, and the inverses of their middles."""


@njit(**FAST)
def around(x, i, lo, hi):
    """The rows before, at and after a run, x and y, from one place before it to one after."""
    lo, hi = lo - 1, hi + 1
    before, after = (
        (x[0, i - 1, lo:hi], x[1, i - 1, lo:hi]),
        (x[0, i + 1, lo:hi], x[1, i + 1, lo:hi]),
    )
    return before[0], before[1], x[0, i, lo:hi], x[1, i, lo:hi], after[0], after[1]


@njit(**FAST)
def of_row(c, x, y, j):
    """What three places of a row do to the one in their middle, by 12 numbers."""
    x0, y0, x1, y1, x2, y2 = x[j], y[j], x[j + 1], y[j + 1], x[j + 2], y[j + 2]
    kx = (c[0] * x0 + c[1] * y0) + (c[4] * x1 + c[5] * y1) + (c[8] * x2 + c[9] * y2)
    ky = (c[2] * x0 + c[3] * y0) + (c[6] * x1 + c[7] * y1) + (c[10] * x2 + c[11] * y2)
    return kx, ky


@njit(**FAST)
def of_run(c, rows, j):
    """K x at place j of a run."""
    ax, ay = of_row(c[0], rows[0], rows[1], j)
    bx, by = of_row(c[1], rows[2], rows[3], j)
    cx, cy = of_row(c[2], rows[4], rows[5], j)
    return ax + bx + cx, ay + by + cy


@njit(**FAST)
def of_lone(grid, e, x, i):
    """K x at a place with a stencil of its own."""
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
    """out = K x; sums, by row, = x · K x."""
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


@njit(**FAST)
def residual(grid, i, b, x, out):
    """out = b - K x of a row, (axis, place)."""
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


@njit(**FAST)
def solve_own(grid, i, r, weight, x):
    """x += weight · D⁻¹ r at the places of a row, D the middles of the stencils."""
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


@njit(**FAST)
def clear(x, i):
    """A row of zeros."""
    for v in range(2):
        for j in range(x.shape[2]):
            x[v, i, j] = 0


@njit(**FAST)
def relax(grid, b, x, row, weight, start, upwards):
    """x += weight · D⁻¹ (b - K x) on even rows, then on odd ones; `upwards` the other way round.
    `start`: from x = 0, whatever it holds. `row` is room for one."""
    rows = grid.first.size - 1
    for i in range(1 if upwards else 0, rows + 1, 2):
        # Row i, and the row before it, for which both beside it are now done.
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
    """out = Pᵀ (b - K x) at the free places of the next grid, those of a `code` of at least 0.
    `halved` tells along which axes it has half the places: its place n lies at 2n - 1, or at n."""
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


@njit(**FAST)
def whole_residual(grid, i, b, x, out):
    """The residual of a row, zero where nobody is free, and of a row that is not there."""
    for v in range(2):
        for j in range(out.shape[1]):
            out[v, j] = 0
    if 0 <= i < grid.first.size - 1:
        residual(grid, i, b, x, out)


@njit(**FAST)
def add_rows(sums, row, share, anew):
    """sums (+)= share · row, both axes."""
    for v in range(2):
        to, of = sums[v], row[v]
        if anew:
            for j in range(of.size):
                to[j] = share * of[j]
        else:
            for j in range(of.size):
                to[j] += share * of[j]


@njit(**FAST)
def scaled(grid, same, own, moves, out):
    """out = S moves at free places, S by stencil as 4 numbers."""
    for i in range(grid.first.size - 1):
        for e in range(grid.first[i], grid.first[i + 1]):
            lo, hi = grid.begin[e], grid.end[e]
            for j in range(lo, hi):
                u, v = moves[0, i, j], moves[1, i, j]
                out[0, i, j], out[1, i, j] = same[0] * u + same[1] * v, same[2] * u + same[3] * v
        for e in range(grid.lone[i], grid.lone[i + 1]):
            j, c = grid.place[e], own[grid.which[e]]
            u, v = moves[0, i, j], moves[1, i, j]
            out[0, i, j], out[1, i, j] = c[0] * u + c[1] * v, c[2] * u + c[3] * v


def run():
    """Calls each of these once, so that all are compiled."""
    lists = np.zeros(9, np.int64), np.zeros(7, np.int32), np.zeros(7, np.int32)
    lists += np.zeros(9, np.int64), np.zeros(1, np.int32), np.zeros(1, np.int32)
    grids, own = [], np.ones((2, 9, 4))
    for real in (np.float32, np.float64):
        same, middle = ((real(1.0),) * 12,) * 3, (real(1.0),) * 4
        grids.append(Grid(*lists, same, own.astype(real), middle, np.ones((2, 4), real)))
    rough, exact = grids
    r, z, half = np.zeros((2, 8, 8)), np.zeros((2, 8, 8), np.float32), np.float32(0.5)
    product(exact, r, r.copy(), np.zeros(8))
    relax(rough, z, z.copy(), np.zeros((2, 8), np.float32), half, True, False)
    coarse, code = np.zeros((2, 6, 6), np.float32), np.zeros((6, 6), np.int32)
    restrict(rough, z, z, (1, 1), code, coarse)
    scaled(exact, (1.0,) * 4, np.ones((2, 4)), r, r)
