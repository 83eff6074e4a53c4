"""Source of the kernel of a scene. It consists of sweeps that move particles, and of a loop over
steps, to which each operation adds its lines.

In the code for rows in which all neighbours exist, rest offsets and index offsets of neighbours are
literals. Other rows use more general code. Values that differ between runs (parameters, thresholds,
places) are arguments.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from pbdkit.stepping.kernel import Function, Lines
from pbdkit.stepping.numba_engine import sweeps
from pbdkit.stepping.numba_engine.blocking import write_deep_passes, write_piece
from pbdkit.stepping.numba_engine.plan import Level, Passes, Plan, PlanWriter, goes_deep
from pbdkit.stepping.program import Program, program_of

Groups = Sequence[tuple[int, int]]
"""Type of the combinations (sublattice, kind of row) that occur."""


def write_kernel(plan: Plan, program: Program, groups: Groups) -> tuple[str, list[str]]:
    """Return the source of a module, and the names of the arrays that it reads. Its function
    ``run(arrays, step, count, chunks, band)`` makes `count` steps."""
    events = sweeps.write_events(plan) if plan.judged else None
    bonds = sweeps.write_bond_pass(plan) if plan.bonds_first else []
    functions = [*([events] if events else []), *bonds]
    moves = list[Function]()
    for level in plan.levels:
        functions += _sweep(plan, level, groups, events)
        moves.append(functions[-1])
    passes = Passes(bonds[-1] if bonds else None, moves)
    run = Function(plan.shared, "run", "arrays", "step", "count", "chunks", "band")
    writer = LatticeWriter(plan, run, passes)
    pieces = write_piece(plan, program, passes) if goes_deep(plan) else []
    if pieces:
        write_deep_passes(writer, program, pieces[-1])
    else:
        run.add(0, "for moment in range(count):")
    writer.begin()
    for operation in program:
        operation.emit(writer)
    writer.end()
    run.add(1, *(["moment += 1"] if pieces else []))
    return write_module(plan, [*functions, *passes.functions.values(), *pieces], run)


def write_module(plan: Plan, functions: Iterable[Function], run: Function) -> tuple[str, list[str]]:
    """Return the source of a module with the given functions and the entry `run`, and the names of
    the arrays that it reads."""
    options = f'parallel={plan.parallel}, error_model="numpy", nogil=True, no_cfunc_wrapper=True'
    jit = f"@njit({options}, cache=CACHED)"
    head = [jit, f"def run({', '.join(run.own)}):", f"    {', '.join(run.used)}, = arrays"]
    return module_text(plan, functions, head, run), run.used


def module_text(
    plan: Plan, functions: Iterable[Function], head: Iterable[str], run: Function
) -> str:
    """Return the source of a module with the given functions and `run`, the signature of which is
    `head`."""
    visible = plan.levels[-1].seen
    kinds = {"Fracture": visible.fracture, "Constants": visible.bond}
    for n, level in enumerate(plan.levels):
        of_level = level.seen
        kinds |= {
            f"Rule{n}": of_level.rule,
            f"Weights{n}": of_level.weights,
            f"Own{n}": of_level.own,
        }
    fields = {kind: [number.name for number in numbers] for kind, numbers in kinds.items()}
    for operation in program_of(plan.scene):
        fields |= {kind: list(names) for kind, names in operation.numbers().items()}
    lines = ['"""Made by pbdkit for one kind of scene; not to be edited."""', ""]
    if plan.scene.axes == 3:
        lines.append("Vector = SpaceVector")
    lines += [f'{kind} = namedtuple("{kind}", {names!r})' for kind, names in fields.items()]
    for n, level in enumerate(plan.levels):
        for m, word in enumerate(level.scene.constants.choices):
            lines.append(f"Word{n}_{m} = Word({word!r})")
    lines += [line for function in functions for line in function.source]
    lines += ["", "", *head, *("    " + line for line in run.lines)]
    return "\n".join(lines) + "\n"


def _sweep(plan: Plan, level: Level, groups: Groups, events: Function | None) -> list[Function]:
    """Return the functions for the kinds of rows that occur. The last function calls the others for
    all rows."""
    out = Function(plan.shared, f"sweep{level.number}", "first_row", "last_row")
    general, functions = sweeps.write_general(plan, level, events), list[Function]()
    for n, (s, kind) in enumerate(groups):
        runs = [f"starts[{n}, first_row, 0]", f"starts[{n}, last_row, 1]", "first_row", "last_row"]
        if kind == sweeps.GENERAL:
            functions.append(general)
            runs.insert(0, str(s))
        else:
            functions += sweeps.write_row(plan, level, s, kind, events)
        out.add(0, functions[-1].call(*runs))
    return [*dict.fromkeys(functions), out]


class LatticeWriter(PlanWriter):
    """Writer of a step that is made operation after operation, each on all cells that motion has
    reached."""

    _judging: Function | None = None
    """Pass over bonds that the next sweep includes."""

    def begin(self) -> None:
        """Write lines that define the names in the lines of operations, and that extend the box
        that motion has reached."""
        out, plan = self.out, self.plan
        out.add(1, "step += 1")
        planes = ["u_@", "v_@", *(f"z{n}_@" for n in range(len(plan.levels) - 1))]
        for name in planes:
            out.add(1, *plan.each(f"flat_{name} = {name}.reshape(-1)"))
        out.add(1, *plan.opening("moment"))
        out.add(1, *(f"was{m}[:] = own{m}" for m in plan.copied_values))
        for name in (f"{name}{m}" for m in plan.prescribed_numbers for name in ("own", "was")):
            out.add(1, f"flat_{name} = {name}.reshape(-1)")
        out.add(1, "for e in range(box.size):", "    box[e] += growth[e]")
        out.add(1, "i0, i1 = max(0, box[0]), min(starts.shape[1] - 1, box[1])")

    def end(self) -> None:
        """Write lines that swap the arrays of the displacements before the step and after it."""
        u, v = (", ".join(self.plan.each(f"{name}_@")) for name in "uv")
        self.out.add(1, f"{u}, {v} = {v}, {u}")

    def listed(self, name: str, *lines: str, ahead: bool = False) -> None:
        """Write a loop over all entries."""
        self.out.add(1, f"for e in range({name}.size):", *("    " + line for line in lines))

    def judge_bonds(self) -> None:
        """Store the pass over bonds; the next sweep includes it."""
        self._judging = self.passes.judge

    def sweep(self, level: int) -> None:
        """Write a call for all rows. If there is a pass over bonds, pass and sweep alternate band
        by band, so that the data of a band stay in the cache."""
        sweep, bond_update, self._judging = self.passes.sweeps[level], self._judging, None
        if bond_update is None:
            write_pass(self.out, self.plan, 1, sweep, "i0", "i1")
            return
        out, plan = self.out, self.plan
        back, ahead = (along[0] for along in plan.scene.owner_reach)
        out.add(1, f"judged, last = max(0, i0 - {back}), min(starts.shape[1] - 1, i1 + {ahead})")
        out.add(1, "for low in range(i0, i1, band):", "    high = min(low + band, i1)")
        out.add(2, f"ready = last if high == i1 else min(high + {ahead}, last)")
        write_pass(out, plan, 2, bond_update, "judged", "ready", "0", "kind.shape[-1]")
        out.add(2, "judged = ready")
        write_pass(out, plan, 2, sweep, "low", "high")

    def over_rows(self, name: str, write: Callable[[Function], None]) -> None:
        """Write a call for all rows."""
        write_pass(self.out, self.plan, 1, self.rows(name, write), "i0", "i1", "moment")

    def follow(self, mapped: Callable[[str], Lines], planes: str, delay: int = 0) -> None:
        """Write a loop over all frame points."""
        source = "flat_u" if delay else planes
        self.out.add(1, "for f in range(points.size):")
        self.out.add(2, *mapped(source), *self.plan.each(f"{planes}_@[points[f]] = t_@"))


def write_pass(
    out: Function, plan: Plan, depth: int, one: Function, low: str, high: str, *more: str
) -> None:
    """Write a call for the rows from `low` to `high`. On several threads, it is called for a part
    of the rows on each thread."""
    if not plan.parallel:
        out.add(depth, one.call(low, high, *more))
        return
    out.add(depth, "for c in prange(chunks):")
    span = (f"{low} + ({high} - {low}) * {c} // chunks" for c in ("c", "(c + 1)"))
    out.add(depth + 1, one.call(*span, *more))
