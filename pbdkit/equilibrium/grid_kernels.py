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
def is_empty(grid, i):
    """Whether nobody is free in a row."""
    return grid.first[i] == grid.first[i + 1] and grid.lone[i] == grid.lone[i + 1]


@njit(**FAST)
def product(grid, x, out):
    """out = K x; returns x · K x."""
    whole = 0.0
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
        whole += part
    return whole


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
def prolong(grid, coarse, halved, x):
    """x += P coarse at free places."""
    half, width = x.dtype.type(0.5), coarse.shape[2]
    line, row = np.zeros(width + 1, x.dtype), np.zeros(2 * width + 2, x.dtype)
    for i in range(grid.first.size - 1):
        if is_empty(grid, i):
            continue
        for v in range(2):
            low = (i + 1) // 2 if halved[0] else i
            high = i // 2 + 1 if halved[0] else i
            one, other = coarse[v, low], coarse[v, high]
            for n in range(width):
                line[n] = half * (one[n] + other[n])
            if halved[1]:
                for n in range(width):
                    row[2 * n] = half * (line[n] + line[n + 1])
                    row[2 * n + 1] = line[n + 1]
            else:
                for n in range(width):
                    row[n] = line[n]
            for e in range(grid.first[i], grid.first[i + 1]):
                lo, hi = grid.begin[e], grid.end[e]
                to, of = x[v, i, lo:hi], row[lo:hi]
                for j in range(hi - lo):
                    to[j] += of[j]
            for e in range(grid.lone[i], grid.lone[i + 1]):
                x[v, i, grid.place[e]] += row[grid.place[e]]


@njit(**FAST)
def descend(a, p, q, x, r, share, out):
    """x += a p, r -= a q; out = share · r in its precision; returns r · r and the largest |a p|."""
    whole, most = 0.0, 0.0
    for v in range(2):
        for i in range(x.shape[1]):
            xs, rs, ps, qs, os = x[v, i], r[v, i], p[v, i], q[v, i], out[v, i]
            part = 0.0
            for j in range(xs.size):
                xs[j] += a * ps[j]
                rs[j] -= a * qs[j]
                os[j] = share * rs[j]
                part += rs[j] * rs[j]
                most = max(most, abs(ps[j]))
            whole += part
    return whole, abs(a) * most


@njit(**FAST)
def turn(share, z, beta, p):
    """p = share · z + beta p."""
    for v in range(2):
        for i in range(p.shape[1]):
            zs, ps = z[v, i], p[v, i]
            for j in range(ps.size):
                ps[j] = share * zs[j] + beta * ps[j]


@njit(**FAST)
def dot(a, b):
    """a · b."""
    whole = 0.0
    for v in range(2):
        for i in range(a.shape[1]):
            one, other = a[v, i], b[v, i]
            part = 0.0
            for j in range(one.size):
                part += one[j] * other[j]
            whole += part
    return whole


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
                        for t in range(9):
                            # How far the place at s lies from place t of the next grid.
                            fa = abs(a + da - (a1 + 1) * (t // 3 - 1)) / (a1 + 1)
                            fb = abs(b + db - (b1 + 1) * (t % 3 - 1)) / (b1 + 1)
                            if fa < 1.0 and fb < 1.0:
                                w = hangs * (1.0 - fa) * (1.0 - fb)
                                for e in range(4):
                                    out[k, t, e] += w * own[code[i, j], s, e]


@njit(cache=KEPT)
def asymmetry(code, own):
    """The largest entry of K - Kᵀ."""
    worst = 0.0
    for s in range(9):
        for e in range(4):
            worst = max(worst, abs(own[0, s, e] - own[0, 8 - s, (0, 2, 1, 3)[e]]))
    for i in range(1, code.shape[0] - 1):
        for j in range(1, code.shape[1] - 1):
            if code[i, j] <= 0:
                continue
            for s in range(9):
                there = code[i + s // 3 - 1, j + s % 3 - 1]
                if there >= 0:
                    one, other = own[code[i, j], s], own[there, 8 - s]
                    for e in range(4):
                        worst = max(worst, abs(one[e] - other[(0, 2, 1, 3)[e]]))
    return worst


@njit(cache=KEPT)
def balance(code, own, factor):
    """Factors of rows, from place to place, with which as much of K as can be is symmetric; 1 for
    the stencil of most. Returns how many places have none."""
    left = 0
    for i in range(code.shape[0]):
        for j in range(code.shape[1]):
            factor[i, j] = 1.0 if code[i, j] == 0 else 0.0
            left += code[i, j] > 0
    found = 1
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
    return left


def run():
    """Calls each of these once, so that all are compiled."""
    code = np.zeros((8, 8), np.int32)
    code[0] = code[-1] = code[:, 0] = code[:, -1] = -1
    code[2, 2] = 1
    kind = (code >= 0).astype(np.int8)
    own, halved = np.ones((2, 9, 4)), (1, 1)
    lists = np.zeros(9, np.int64), np.zeros(7, np.int32), np.zeros(7, np.int32)
    lists += np.zeros(9, np.int64), np.zeros(1, np.int32), np.zeros(1, np.int32)
    runs(code, *lists)
    coarse_kind, coarse_code = np.zeros((6, 6), np.int8), np.zeros((6, 6), np.int32)
    coarse_kinds(kind, halved, coarse_kind)
    count = coarse_codes(code, coarse_kind, halved, coarse_code)
    galerkin(code, own, coarse_code, halved, np.zeros((count + 1, 9, 4)))
    asymmetry(code, own)
    balance(code, own, np.zeros((8, 8)))
    r, z = np.zeros((2, 8, 8)), np.zeros((2, 8, 8), np.float32)
    rough, exact = (
        Grid(
            *lists,
            ((real(1.0),) * 12,) * 3,
            own.astype(real),
            (real(1.0),) * 4,
            np.ones((2, 4), real),
        )
        for real in (np.float32, np.float64)
    )
    product(exact, r, r.copy())
    relax(rough, z, z.copy(), np.zeros((2, 8), np.float32), np.float32(0.5), True, False)
    restrict(rough, z, z, halved, coarse_code, out := np.zeros((2, 6, 6), np.float32))
    prolong(rough, out, halved, z.copy())
    scaled(exact, (1.0,) * 4, np.ones((2, 4)), r, r)
    descend(0.0, r, r, r.copy(), r.copy(), 1.0, z)
    turn(1.0, z, 0.0, r)
    dot(r, z)
    dot(r, r)
