"""Writes what every kind of row does alike: the words of a neighbour, and a particle's target."""

from __future__ import annotations

from collections.abc import Iterable

from pbdkit.scene.homes import Home
from pbdkit.stepping.compiled.plan import Function, Level, Plan, values


def named_tuples(plan: Plan, level: Level) -> list[str]:
    """p of the rule, and of the fracture model, whose numbers are literals: they decide what is to
    be computed at all."""
    n = level.number
    lines = [f"p = Rule{n}({values(level.seen.rule, {Home.SCENE: f'rule{n}[{{n}}]'})})"]
    if plan.model is not None:
        literal = [plan.number(value) for value in plan.scene.constants.fracture]
        lines.append(f"q = Fracture({values(level.seen.fracture, {}, literal)})")
    return lines


RUNS = ("first_run", "last_run", "first_row", "last_row")
"""What functions of rows are given: some runs, and the rows of the first axis to keep to."""


def write_row_loop(out: Function, plan: Plan) -> None:
    """The loop over the rows of some runs, as far as motion has come; what comes after stands in
    it."""
    out.add(0, "for n in range(first_run, last_run):")
    *lead, name = plan.lead
    for a, outer in enumerate(lead):
        out.add(1, f"{outer} = runs[n, {a}]")
    a = len(lead)
    out.add(1, f"j0 = max(runs[n, {a + 2}], box[{2 * a + 2}])")
    out.add(1, f"j1 = min(runs[n, {a + 3}], box[{2 * a + 3}])", "if j0 >= j1:", "    continue")
    low, high = (f"box[{2 * a}]", f"box[{2 * a + 1}]") if a else ("first_row", "last_row")
    out.add(1, f"for {name} in range(max(runs[n, {a}], {low}), min(runs[n, {a + 1}], {high})):")
    out.depth += 2


def here_rows(plan: Plan, level: Level, s: str) -> list[str]:
    """The rows of what stands at the particles themselves, and of where their moves go."""
    lines = []
    out = "v" if level.last else f"z{level.number}"
    for c in plan.axes:
        lines += [f"h{c} = {plan.row(f'u_{c}', s)}", f"o{c} = {plan.row(f'{out}_{c}', s)}"]
        if level.number:
            lines.append(f"z{c} = {plan.row(f'z{level.number - 1}_{c}', s)}")
    lines += [f"a{n} = {plan.row(f'own{n}', s)}" for n in range(len(level.seen.own))]
    return lines


def lost_lines(plan: Plan, r: str, c: str) -> list[str]:
    """d as the rule sees it: softened, or that of the fictitious point where the bond is lost."""
    softened = [f"d = seen(d, f, {r}, {c}, q)"] if plan.softens else []
    chosen = plan.vector(f"f.{c} if is_lost else d.{c}" for c in plan.axes)
    return [f"f = fictitious(u, {r}, q)", *softened, f"d = {chosen}"]


def contributions(level: Level) -> str:
    """The contributions by name, those of a vector together."""
    return _pattern(level, [f"c{n}" for n in range(sum(level.parts))], "")


def target_lines(
    plan: Plan, level: Level, local: list[str], totals: list[str], movable: str = ""
) -> list[str]:
    """Where the particle goes, and what it remembers, where it is `movable` (everywhere); `u` is
    its displacement, and `z` that which the rule sees, on later levels. `local` are the components
    of X from site (0, 0)."""
    n, move, lines = level.number, [f"move.{c}" for c in plan.axes], list[str]()
    sums = _pattern(level, totals, "Vector")
    X = centred = plan.vector([plan.number(0.0)] * len(plan.axes))
    if level.scene.experiment.rule.uses_reference:
        lines = [f"X{c} = {value}" for c, value in zip(plan.axes, local, strict=True)]
        X = _shifted(plan, "+", plan.scene.raster.lattice.origin)
        centred = _shifted(plan, "-", plan.scene.middle)
    own = values(level.seen.own, {Home.PARTICLE: "a{n}[j]"})
    here = f"Here({'z' if n else 'u'}, {X}, {centred}, Own{n}({own}))"
    lines += [f"here = {here}", f"move = apply{n}(({sums},), here, p)"]
    if level.renews:
        lines.append(f"new = remember{n}(({sums},), here, p)")
    for c, step in zip(plan.axes, move, strict=True):
        if not level.last:
            lines.append(f"o{c}[j] = {_chosen(step, movable, plan.number(0.0))}")
            continue
        solver = plan.scene.experiment.stepping
        relaxed = f"solver[0] * {step}" if solver.relaxation != 1.0 else step
        lines.append(f"new_{c} = u.{c} + {relaxed}")
        if solver.memory != 0.0:
            lines.append(f"new_{c} = new_{c} + solver[1] * (u.{c} - o{c}[j])")
        lines.append(f"o{c}[j] = {_chosen(f'new_{c}', movable, f'u.{c}')}")
    if level.renews:
        changing = [n for n, number in enumerate(level.seen.own) if number.changes]
        lines += [
            f"a{n}[j] = {_chosen(f'new[{m}]', movable, f'a{n}[j]')}" for m, n in enumerate(changing)
        ]
    return lines


def _chosen(value: str, where: str, otherwise: str) -> str:
    return f"{value} if {where} else {otherwise}" if where else value


def _shifted(plan: Plan, sign: str, by: Iterable[float]) -> str:
    return plan.vector(
        f"X{c} {sign} {plan.number(value)}" for c, value in zip(plan.axes, by, strict=True)
    )


def local_places(plan: Plan, s: str) -> list[str]:
    """X from site (0, 0), in the order of operations of the rasters."""
    cell = plan.scene.raster.lattice.cell()
    index = [f"{name} + first[{n}]" for n, name in enumerate((*plan.lead, "j + j0"))]
    return [
        f"at[{s}, {n}] + ("
        + " + ".join(f"({at}) * {float(v[n])!r}" for at, v in zip(index, cell.vectors, strict=True))
        + ")"
        for n in range(len(plan.axes))
    ]


def _pattern(level: Level, names: list[str], kind: str) -> str:
    found, rest = [], list(names)
    for size in level.parts:
        own, rest = rest[:size], rest[size:]
        found.append(own[0] if size == 1 else f"{kind}({', '.join(own)})")
    return ", ".join(found)
