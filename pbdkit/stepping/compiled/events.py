"""Writes the part of a sweep that notes which bonds broke: rare, so it may be slow."""

from __future__ import annotations

from pbdkit.interfaces import Slot
from pbdkit.scene.neighbourhood import Neighbourhood
from pbdkit.scene.raster import FOLLOWER
from pbdkit.stepping.compiled.wanted import INDENT, Wanted, Writer, number


def write_events(
    out: Writer, s: int, slots: tuple[Slot, ...], around: Neighbourhood, wanted: Wanted
) -> None:
    """Keeps the lost bonds of the row, and notes step and length of those that broke just now, as
    their positive end sees them: rare."""
    out.add(3, "changed = changed | (now ^ bits)", "gone[j] = now")
    out.add(2, "if changed:")
    out.add(3, "for j in range(j0, j1):", f"{INDENT}now = int64(lost[{s}, i, j])")
    for k, slot in enumerate(slots):
        for n, plane in enumerate(around.planes):
            if plane.slot == slot:
                out.add(4, f"if (now >> {k}) & 1 and broken[{n}, i, j] < 0:")
                out.add(5, f"broken[{n}, i, j] = step")
                out.add(5, _length_line(n, slot, "i, j", _there(slot), wanted))
            if plane.opposite == slot:
                there = _there(slot)
                out.add(4, f"if (now >> {k}) & 1 and broken[{n}, {there}] < 0:")
                out.add(5, f"if kind[{slot.target}, {there}] != {FOLLOWER}:")
                out.add(6, f"broken[{n}, {there}] = step")
                out.add(6, _length_line(n, plane.slot, there, "i, j", wanted))


def _there(slot: Slot) -> str:
    return f"i + {slot.cell[0]}, j + {slot.cell[1]}"


def _length_line(plane: int, slot: Slot, here: str, there: str, wanted: Wanted) -> str:
    """The length of a bond from its positive end `here` to `there`, in the intermediate
    configuration, which the sweep leaves as it is."""
    parts = (
        f"{number(rest, wanted)} + (u{c}[{slot.target}, {there}] - u{c}[{slot.source}, {here}])"
        for c, rest in zip("xy", slot.rest, strict=True)
    )
    return f"lengths[{plane}, {here}] = length(Vector({', '.join(parts)}))"
