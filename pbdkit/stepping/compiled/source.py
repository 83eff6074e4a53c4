"""Writes the source of a scene's kernel: one sweep a sublattice, and the loop over steps.

Rest offsets and steps to neighbours are literals, so that what cancels at rest folds away; what
varies from run to run (the rule's parameters, thresholds, places) are arguments. Those of fracture
are literals too: they decide what is to be computed at all.
"""

from __future__ import annotations

from pbdkit.interfaces import Cell
from pbdkit.scene.neighbourhood import Neighbourhood
from pbdkit.stepping.compiled.sweep import write_sweep
from pbdkit.stepping.compiled.wanted import INDENT, Wanted, Writer, number


def write_kernel(cell: Cell, neighbourhood: Neighbourhood, wanted: Wanted) -> str:
    """The source of a module with `run`, which takes the scene `count` steps further."""
    out = Writer()
    out.add(0, '"""Made by pbdkit for one kind of scene; not to be edited."""', "")
    weights = next(iter(wanted.weights.values()))._fields
    for name, names in (
        ("Rule", wanted.rule_parameters),
        ("Fracture", wanted.fracture_parameters),
        ("Weights", weights),
        ("Constants", wanted.limits),
        ("Own", ()),
    ):
        out.add(0, f'{name} = namedtuple("{name}", {list(names)!r})')
    for s, slots in enumerate(neighbourhood.slots):
        write_sweep(out, s, slots, cell, neighbourhood, wanted)
    _write_run(out, len(neighbourhood.slots), wanted)
    return "\n".join(out.lines) + "\n"


def _write_run(out: Writer, sublattices: int, wanted: Wanted) -> None:
    flags = "parallel=True, " if wanted.parallel else ""
    out.add(0, "", "", f'@njit({flags}error_model="numpy", nogil=True, cache=True)')
    out.add(0, "def run(ux, uy, vx, vy, masks, lost, spared, kind, broken, lengths, limits,")
    out.add(2, "share, step, count, blocks, box, growth, chunks, led, led_x, led_y,")
    out.add(2, "kept_x, kept_y, points, entries, bodies, weights, rule, solver, first):")
    out.add(1, "for _ in range(count):", f"{INDENT}step += 1")
    body = Writer()
    body.add(
        0,
        "fux, fuy, fvx, fvy = ux.reshape(-1), uy.reshape(-1), vx.reshape(-1), vy.reshape(-1)",
        "for e in range(led.size):",
        f"{INDENT}kept_x[e], kept_y[e] = fux[led[e]], fuy[led[e]]",
        "for e in range(led.size):",
        f"{INDENT}fux[led[e]], fuy[led[e]] = led_x[e], led_y[e]",
        "for k in range(4):",
        f"{INDENT}box[k] += growth[k]",
    )
    _write_sweeps(body, sublattices, wanted)
    body.add(
        0,
        "for e in range(led.size):",
        f"{INDENT}fvx[led[e]], fvy[led[e]] = led_x[e], led_y[e]",
        "for e in range(led.size):",
        f"{INDENT}fux[led[e]], fuy[led[e]] = kept_x[e], kept_y[e]",
    )
    if wanted.frame:
        _write_frame(body, wanted)
    body.add(0, "ux, uy, vx, vy = vx, vy, ux, uy")
    out.add(2, *body.lines)


def _write_sweeps(body: Writer, sublattices: int, wanted: Wanted) -> None:
    arguments = "ux, uy, vx, vy, masks, lost, spared, kind, broken, lengths, limits, share, step"
    for s in range(sublattices):
        body.add(
            0,
            f"i0, i1 = max(blocks[{s}, 0], box[0]), min(blocks[{s}, 1], box[1])",
            f"j0, j1 = max(blocks[{s}, 2], box[2]), min(blocks[{s}, 3], box[3])",
            "if i0 < i1 and j0 < j1:",
        )
        tail = "j0, j1, rule, solver, first)"
        if wanted.parallel:
            body.add(1, "for c in prange(chunks):")
            body.add(2, "a, b = i0 + (i1 - i0) * c // chunks, i0 + (i1 - i0) * (c + 1) // chunks")
            body.add(2, f"sweep_{s}({arguments}, a, b, {tail}")
        else:
            body.add(1, f"sweep_{s}({arguments}, i0, i1, {tail}")


def _write_frame(body: Writer, wanted: Wanted) -> None:
    source = "fu" if wanted.lag else "fv"
    zero = number(0.0, wanted)
    body.add(0, "for f in range(points.size):", f"{INDENT}x, y = {zero}, {zero}")
    body.add(1, "for e in range(entries[f], entries[f + 1]):")
    body.add(2, f"bx, by = {source}x[bodies[e]], {source}y[bodies[e]]")
    if wanted.frame_matrices:
        body.add(2, "x = x + (weights[e, 0, 0] * bx + weights[e, 0, 1] * by)")
        body.add(2, "y = y + (weights[e, 1, 0] * bx + weights[e, 1, 1] * by)")
    else:
        body.add(2, "x = x + weights[e] * bx", "y = y + weights[e] * by")
    body.add(1, "fvx[points[f]], fvy[points[f]] = x, y")
