"""What iterations do with whole fields, (axis, row, place), compiled. Sums are given by row, for
whoever has some of the rows to add up with those of others."""

from __future__ import annotations

import numpy as np
from numba import njit

KEPT = globals().get("KEPT", False)
FAST = {"error_model": "numpy", "nogil": True, "cache": KEPT, "fastmath": True}


@njit(**FAST)
def descend(a, p, q, x, r, share, out, sums):
    """x += a p, r -= a q; out = share · r in its precision; sums, by row, = r · r and the largest
    |a p|."""
    sums[:] = 0.0
    for v in range(2):
        for i in range(x.shape[1]):
            xs, rs, ps, qs, os = x[v, i], r[v, i], p[v, i], q[v, i], out[v, i]
            part = most = 0.0
            for j in range(xs.size):
                xs[j] += a * ps[j]
                rs[j] -= a * qs[j]
                os[j] = share * rs[j]
                part += rs[j] * rs[j]
                most = max(most, abs(ps[j]))
            sums[0, i] += part
            sums[1, i] = max(sums[1, i], abs(a) * most)


@njit(**FAST)
def turn(share, z, beta, p):
    """p = share · z + beta p."""
    for v in range(2):
        for i in range(p.shape[1]):
            zs, ps = z[v, i], p[v, i]
            for j in range(ps.size):
                ps[j] = share * zs[j] + beta * ps[j]


@njit(**FAST)
def dot(a, b, sums):
    """sums, by row, = a · b."""
    sums[:] = 0.0
    for v in range(2):
        for i in range(a.shape[1]):
            one, other = a[v, i], b[v, i]
            part = 0.0
            for j in range(one.size):
                part += one[j] * other[j]
            sums[i] += part


@njit(**FAST)
def prolong(first, begin, end, lone, place, coarse, halved, x):
    """x += P coarse at the free places of a grid: its runs and lone places by row."""
    half, width = x.dtype.type(0.5), coarse.shape[2]
    line, row = np.zeros(width + 1, x.dtype), np.zeros(2 * width + 2, x.dtype)
    for i in range(first.size - 1):
        if first[i] == first[i + 1] and lone[i] == lone[i + 1]:
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
            for e in range(first[i], first[i + 1]):
                lo, hi = begin[e], end[e]
                to, of = x[v, i, lo:hi], row[lo:hi]
                for j in range(hi - lo):
                    to[j] += of[j]
            for e in range(lone[i], lone[i + 1]):
                x[v, i, place[e]] += row[place[e]]


@njit(**FAST)
def differences(still, moved, place, number, share, axis, out):
    """share · (still - moved) at flat places, into place `number` of each one's stencil, as what
    moves along an axis do. Returns the largest."""
    largest = 0.0
    for n in range(place.size):
        for v in range(2):
            value = share * (still[v, place[n]] - moved[v, place[n]])
            out[n, number[n], v, axis] = value
            largest = max(largest, abs(value))
    return largest


@njit(**FAST)
def clear_noise(stencils, noise):
    """Zero where all four numbers of a place of a stencil are as small."""
    for n in range(stencils.shape[0]):
        for s in range(stencils.shape[1]):
            c = stencils[n, s]
            if max(abs(c[0, 0]), abs(c[0, 1]), abs(c[1, 0]), abs(c[1, 1])) <= noise:
                c[:] = 0.0


def run():
    """Calls each of these once, so that all are compiled."""
    r, z = np.zeros((2, 8, 8)), np.zeros((2, 8, 8), np.float32)
    descend(0.0, r, r, r.copy(), r.copy(), 1.0, z, np.zeros((2, 8)))
    turn(1.0, z, 0.0, r)
    dot(r, z, np.zeros(8))
    dot(r, r, np.zeros(8))
    differences(r.reshape(2, -1), r.reshape(2, -1), np.zeros(1, int), np.zeros(1, int), 1.0, 0,
                np.zeros((1, 9, 2, 2)))  # fmt: skip
    clear_noise(np.zeros((1, 9, 2, 2)), 0.0)
    rows, some = np.zeros(9, np.int64), np.zeros(1, np.int32)
    prolong(rows, some, some, rows, some, np.zeros((2, 6, 6), np.float32), (1, 1), z)
