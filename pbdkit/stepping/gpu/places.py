"""Writes what one thread of a GPU does with places of the rasters and of bonds: the same lines that
rows are swept with, on flat arrays.

Every place has a group: 0 where nobody follows, then a number for each sublattice and kind of row
whose particles have all their neighbours (`rows.py`), then one for each sublattice where something
may be missing (`slot_loop.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import Slot
from pbdkit.scene.bonds import bonds_in, plane_block
from pbdkit.stepping.compiled.bond_pass import judging
from pbdkit.stepping.compiled.level import Level
from pbdkit.stepping.compiled.particle import parameters
from pbdkit.stepping.compiled.plan import Function, Plan
from pbdkit.stepping.compiled.rows import GENERAL, PLAIN, WITH_CELLS, Words, write_whole
from pbdkit.stepping.compiled.slot_loop import write_one
from pbdkit.stepping.compiled.stretches import kinds_of
from pbdkit.stepping.compiled.tearing import marking_lines

THREAD = ("me", "threads")
"""What functions are given: the number of a thread, and of how many."""
Whole = Sequence[tuple[int, int]]
"""The sublattice and kind of the groups that have all their neighbours."""


def find_groups(plan: Plan) -> tuple[NDArray[Any], Whole]:
    """The group of each place of the rasters, and which groups come first."""
    raster, whole = plan.scene.raster, list[tuple[int, int]]()
    groups = np.zeros(raster.shape, np.int64)
    blocks = [raster.body_block(s) for s in range(raster.shape[0])]
    for s, block in enumerate(blocks):
        if block:
            kinds = kinds_of(plan.scene, block, plan.long)
            block.of(groups)[kinds == GENERAL] = -1 - s
            for kind in (PLAIN, WITH_CELLS):
                if (kinds == kind).any():
                    whole.append((s, kind))
                    block.of(groups)[kinds == kind] = len(whole)
    np.copyto(groups, len(whole) - groups, where=groups < 0)
    return groups.astype(np.min_scalar_type(int(groups.max()))), whole


def breakable_bonds(plan: Plan) -> NDArray[np.uint8]:
    """1 where a bond is that may break, as planes of bonds lie."""
    planes, shape = plan.scene.neighbourhood.planes, plan.scene.raster.shape
    found = np.zeros((len(planes), *shape[1:]), np.uint8)
    for n, plane in enumerate(planes):
        if block := plane_block(plan.scene.raster, plane, inside=plan.softens_cells):
            too = plan.model.breaks_frame_bonds()
            block.within(found[n])[...] = bonds_in(plan.scene.raster, block, plane, too)
    return found


def write_sweep(plan: Plan, level: Level, whole: Whole, events: Function | None) -> Function:
    """The function by which a thread moves its particles, one after the other."""
    out = Function(plan.shared, f"sweep{level.number}", *THREAD)
    out.add(0, *parameters(plan, level), "base = 0", *_aliases(plan, level))
    for s, kind in whole:
        for k, slot in enumerate(plan.scene.neighbourhood.slots[s]):
            out.add(0, *_steps(plan, kind, s, k, slot))
    out.add(0, f"for j in {plan.over('flat_groups.size')}:", "    group = flat_groups[j]")
    if level.scene.experiment.rule.uses_reference:
        out.add(1, *_cells(plan))
    out.depth = 1
    if plan.tears:  # marked particles are taken as those of which something may be missing
        for n, (s, _) in enumerate(whole, 1):
            out.add(0, f"if group == {n} and flat_torn[j]:", f"    group = {len(whole) + 1 + s}")
    for n, (s, kind) in enumerate(whole, 1):
        slots = plan.scene.neighbourhood.slots[s]
        words = [_words(plan, level, kind, s, k) for k in range(len(slots))]
        out.add(0, f"if group == {n}:", "    changed = 0")
        write_whole(out, plan, level, s, words, "flat_lost[j]")
        if events:
            out.add(1, "if changed:", "    " + events.call(str(s), "j", "1"))
    out.add(0, f"if group > {len(whole)}:", f"    s, changed = group - {len(whole) + 1}, 0")
    write_one(out, plan, level)
    if events:
        out.add(1, "if changed:", "    " + events.call("s", "j", "1"))
    return out


def write_bonds(plan: Plan) -> Function:
    """The function by which a thread renews its bonds and breaks them, plane after plane."""
    out = Function(plan.shared, "judge_bonds", *THREAD)
    out.add(0, parameters(plan, plan.levels[-1])[-1])
    out.add(0, "cells = flat_broken.size // len(ends)", "for n in range(len(ends)):")
    out.add(1, f"r = {plan.vector('end_rests[n, #]')}")
    kept = {"since": "broken", "ways": "lengths", "may": "breakable"}
    kept |= {f"b{m}": f"bond{m}" for m in range(plan.bonds)}
    kept |= {f"x{m}": f"limit{m}" for m in range(plan.limits)}
    out.add(1, *(f"{name} = flat_{of}[n * cells:(n + 1) * cells]" for name, of in kept.items()))
    out.add(1, f"for j in {plan.over('cells')}:", "    if may[j] and since[j] < 0:")
    out.add(3, "here = ends[n, 0] * cells + j", "there = here + end_steps[n]")
    out.add(3, *judging(plan, "flat_u_@[there] - flat_u_@[here]", "here").write)
    out.add(3, *marking_lines(plan, "n * cells + j", "here"))
    return out


def _aliases(plan: Plan, level: Level) -> list[str]:
    """The names by which lines know the rows of a particle, for the whole arrays."""
    n = level.number
    rows = {"h@": "u_@", "o@": "v_@" if level is plan.levels[-1] else f"z{n}_@"}
    if n:
        rows["z@"] = f"{level.source}_@"
    if plan.is_loaded(level):
        rows["g@"] = "load_@"
    lines = [line for row, of in rows.items() for line in plan.each(f"{row} = flat_{of}")]
    lines += [f"a{m} = w{m} = flat_own{m}" for m in range(len(level.seen.own))]
    return lines + [f"g{m} = flat_field{m}" for m in range(level.fields)]


def _cells(plan: Plan) -> list[str]:
    """The cell indices of place j, the last one as `j + j0`."""
    lines, within = ["j0 = j % extent[-1] - j"], "j // extent[-1]"
    for axis, name in reversed(list(enumerate(plan.lead, 1))):
        lines.append(f"{name} = {within} % extent[{axis}]")
        within += f" // extent[{axis}]"
    return lines


def _steps(plan: Plan, kind: int, s: int, k: int, slot: Slot) -> list[str]:
    """The way in flat arrays to a neighbour, to the home of its bond and to the cells beside it."""
    lines = [f"w{s}_{k} = away[{s}, {k}]"]
    if plan.bonds or plan.limits or plan.bonds_first:
        lines.append(f"v{s}_{k} = bonds_away[{s}, {k}]")
    if kind == WITH_CELLS:
        lines += [f"q{s}_{k}_{side} = cells_away[{s}, {k}, {side}]" for side in (0, 1)]
    return lines


def _words(plan: Plan, level: Level, kind: int, s: int, k: int) -> Words:
    there, home = f"j + w{s}_{k}", f"j + v{s}_{k}"
    shares = [f"flat_share[j + q{s}_{k}_{side}]" for side in (0, 1)] if kind == WITH_CELLS else []
    return Words(
        f"flat_{level.source}_@[{there}]",
        [f"flat_{array}[{there}]" for array in plan.shown],
        shares,
        f"flat_bond{{n}}[{home}]",
        f"flat_limit{{n}}[{home}]",
        f"flat_broken[{home}]",
    )
