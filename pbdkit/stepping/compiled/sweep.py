"""Writes the source of a sweep: the followers of one sublattice, row by row."""

from __future__ import annotations

from collections.abc import Iterator

from pbdkit.interfaces import Cell, Slot
from pbdkit.interfaces.polygons import Side, Tiling
from pbdkit.scene.constants import WHOLE_CELLS
from pbdkit.scene.neighbourhood import Neighbourhood
from pbdkit.stepping.compiled.events import write_events
from pbdkit.stepping.compiled.wanted import Wanted, Writer, number

_ZERO = {False: "float64(0.0)", True: "float32(0.0)"}


def write_sweep(
    out: Writer, s: int, slots: tuple[Slot, ...], cell: Cell, around: Neighbourhood, wanted: Wanted
) -> None:
    """A function that moves the followers of one sublattice in some rows."""
    out.add(0, "", "", '@njit(error_model="numpy")')
    out.add(0, f"def sweep_{s}(ux, uy, vx, vy, masks, lost, spared, kind, broken, lengths, limits,")
    out.add(2, "share, step, i0, i1, j0, j1, rule, solver, first):")
    out.add(1, f"p = {_parameters('Rule', wanted.rule_parameters, 'rule')}")
    values = "".join(f"{number(v, wanted)}, " for v in wanted.fracture_parameters.values())
    out.add(1, f"q = Fracture({values})")
    out.add(1, "for i in range(i0, i1):")
    for c in "xy":
        out.add(2, f"h{c} = u{c}[{s}, i, j0:j1]", f"o{c} = v{c}[{s}, i, j0:j1]")
        for k, slot in enumerate(slots):
            m, n = slot.cell
            out.add(2, f"n{k}{c} = u{c}[{slot.target}, i + {m}, j0 + {n}:j1 + {n}]")
    if wanted.tiling:
        out.add(2, *_share_lines(s, slots, around, wanted.tiling))
    if wanted.some_missing:
        out.add(2, f"here = masks[{s}, i, j0:j1]")
    if wanted.fracture:
        out.add(2, f"gone = lost[{s}, i, j0:j1]")
        if wanted.some_bonds_last:
            out.add(2, f"lasts = spared[{s}, i, j0:j1]")
        out.add(2, "changed = 0")
    out.add(2, "for j in range(j1 - j0):")
    out.add(3, "x, y = hx[j], hy[j]", "u = Vector(x, y)")
    if wanted.fracture:
        out.add(3, "bits = int64(gone[j])", "now = bits")
    for k, slot in enumerate(slots):
        out.add(3, *_slot_lines(k, slot, around, wanted))
    _write_target(out, s, cell, len(slots), wanted)
    if wanted.fracture:
        write_events(out, s, slots, around, wanted)


def _slot_lines(k: int, slot: Slot, around: Neighbourhood, wanted: Wanted) -> Iterator[str]:
    """The contributions of one neighbour."""
    r = "Vector({}, {})".format(*(number(value, wanted) for value in slot.rest))
    yield f"d = Vector(n{k}x[j] - x, n{k}y[j] - y)"
    if wanted.fracture:
        positive = any(plane.slot == slot for plane in around.planes)
        # A bond is judged as its positive end sees it, so that both ends agree to the last bit.
        seen, sign = ("d", 1.0) if positive else ("Vector(-d.x, -d.y)", -1.0)
        rest = "Vector({}, {})".format(*(number(sign * value, wanted) for value in slot.rest))
        limits = "".join(f"limits[{slot.source}, {k}, {n}], " for n in range(len(wanted.limits)))
        yield f"breaks_now = 1 if breaks({seen}, {rest}, Constants({limits}), q) else 0"
        if wanted.some_bonds_last:
            yield f"breaks_now = breaks_now & ~(int64(lasts[j]) >> {k}) & 1"
        yield f"is_lost = ((bits >> {k}) & 1) | breaks_now"
        yield f"now = now | (is_lost << {k})"
        yield f"f = fictitious(u, {r}, q)"
        yield "d = Vector(f.x if is_lost else d.x, f.y if is_lost else d.y)"
    weights = "".join(f"{number(w, wanted)}, " for w in wanted.weights[slot])
    if wanted.tiling:
        own = wanted.weights[slot][: -len(WHOLE_CELLS)]
        sides = [f"{_share_name(slot, side, around)}[j], " for side in wanted.tiling.beside[slot]]
        weights = "".join([*(f"{number(w, wanted)}, " for w in own), *sides])
    yield f"{_pattern('c', wanted)}, = gather(d, {r}, Weights({weights}), p)"
    for n in range(sum(wanted.contributions)):
        part = f"c{n}"
        if wanted.some_missing:
            part = f"(c{n} if (here[j] >> {k}) & 1 else {_ZERO[wanted.single]})"
        yield f"t{n} = {part}" if k == 0 else f"t{n} = t{n} + {part}"


def _share_name(slot: Slot, side: Side, around: Neighbourhood) -> str:
    """The row of shares of the cells to one side of a slot."""
    slots = around.slots[slot.source]
    return f"s{side.kind}_{'own' if side.first is None else slots.index(side.first)}"


def _share_lines(
    s: int, slots: tuple[Slot, ...], around: Neighbourhood, tiling: Tiling
) -> Iterator[str]:
    """The rows of shares of all cells around the particles of a row, once each."""
    sides = {
        _share_name(slot, side, around): side for slot in slots for side in tiling.beside[slot]
    }
    for name, side in sides.items():
        target, (m, n) = (side.first.target, side.first.cell) if side.first else (s, (0, 0))
        yield f"{name} = share[{side.kind}, {target}, i + {m}, j0 + {n}:j1 + {n}]"


def _write_target(out: Writer, s: int, cell: Cell, slots: int, wanted: Wanted) -> None:
    zero = number(0.0, wanted)
    if wanted.reference:
        a, b = cell.vectors
        for c, *numbers in zip("XY", cell.sites[s].at, a, b, strict=False):
            at, along, across = map(float, numbers)
            out.add(
                3, f"{c} = {at!r} + ((i + first[0]) * {along!r} + (j + j0 + first[1]) * {across!r})"
            )
    X = centred = f"Vector({zero}, {zero})"
    if wanted.reference:
        (ax, ay), (mx, my) = ([number(v, wanted) for v in v] for v in wanted.reference)
        X, centred = f"Vector(X + {ax}, Y + {ay})", f"Vector(X - {mx}, Y - {my})"
    totals = _pattern("t", wanted, "Vector")
    here = f"Here(u, {X}, {centred}, Own())"
    out.add(3, f"mx, my = apply(({totals},), {here}, p)")
    for c in "xy":
        move = f"solver[0] * m{c}" if wanted.relaxed else f"m{c}"
        line = f"{c}2 = {c} + {move}"
        out.add(3, line)
        if wanted.memory:
            out.add(3, f"{c}2 = {c}2 + solver[1] * ({c} - o{c}[j])")
        if wanted.some_missing:
            out.add(3, f"{c}2 = {c}2 if (here[j] >> {slots}) & 1 else {c}")
        out.add(3, f"o{c}[j] = {c}2")


def _pattern(letter: str, wanted: Wanted, kind: str = "") -> str:
    """The contributions by name, those of a vector together."""
    found, n = [], 0
    for size in wanted.contributions:
        names = ", ".join(f"{letter}{n + k}" for k in range(size))
        found.append(names if size == 1 else f"{kind}({names})")
        n += size
    return ", ".join(found)


def _parameters(name: str, names: tuple[str, ...], source: str) -> str:
    values = "".join(f"{source}[{n}], " for n in range(len(names)))
    return f"{name}({values})"
