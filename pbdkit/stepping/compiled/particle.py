"""Writes what every kind of row does alike: the words of a neighbour, and a particle's target."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import islice

from pbdkit.interfaces import RenewsParticles, Softens
from pbdkit.scene.homes import Home
from pbdkit.stepping.compiled.level import Level
from pbdkit.stepping.compiled.plan import Function, Plan, listed, values

RUNS = ("first_run", "last_run", "first_row", "last_row")
"""What functions of rows are given: some runs, and the rows of the first axis to keep to."""


def parameters(plan: Plan, level: Level) -> list[str]:
    """p of the rule, and of the fracture model, whose numbers are literals: they decide what is to
    be computed at all."""
    rule = [] if level.fields else [_rule(level)]
    literal = listed(map(plan.number, plan.scene.constants.fracture))
    return [*rule, f"q = Fracture({literal})"] if plan.model else rule


def _rule(level: Level) -> str:
    """p of the rule at a particle."""
    n = level.number
    homes = {Home.SCENE: f"rule{n}[{{n}}]", Home.FIXED_PARTICLE: "g{n}[j]"}
    return f"p = Rule{n}({values(level.seen.rule, homes)})"


def write_row_loop(out: Function, plan: Plan, level: Level, s: str) -> None:
    """The loop over the rows of some runs, as far as motion has come, with the rows of what stands
    at the particles themselves and of where their moves go; what comes after stands in it."""
    out.add(0, *parameters(plan, level), "for n in range(first_run, last_run):")
    *lead, name = plan.lead
    a = len(lead)
    out.add(1, *(f"{outer} = runs[n, {m}]" for m, outer in enumerate(lead)))
    out.add(1, f"j0 = max(runs[n, {a + 2}], box[{2 * a + 2}])")
    out.add(1, f"j1 = min(runs[n, {a + 3}], box[{2 * a + 3}])", "if j0 >= j1:", "    continue")
    low, high = (f"box[{2 * a}]", f"box[{2 * a + 1}]") if a else ("first_row", "last_row")
    out.add(1, f"for {name} in range(max(runs[n, {a}], {low}), min(runs[n, {a + 1}], {high})):")
    out.depth += 2
    write_rows(out, plan, level, s)


def write_rows(out: Function, plan: Plan, level: Level, s: str) -> None:
    """The rows of what stands at the particles of a row from j0 to j1, and of where their moves
    go."""
    n = level.number
    rows = {"h@": "u_@", "o@": "v_@" if level is plan.levels[-1] else f"z{n}_@"}
    if n:
        rows["z@"] = f"{level.source}_@"
    if plan.is_loaded(level):
        rows["g@"] = "load_@"
    for row, of in rows.items():
        out.add(0, *plan.each(f"{row} = {plan.row(of, s)}"))
    for m in range(len(level.seen.own)):
        before, after = (plan.row(array, s) for array in (plan.read[m], f"own{m}"))
        out.add(0, f"a{m}, w{m} = {before}, {after}")
    out.add(0, *(f"g{m} = {plan.row(f'field{m}', s)}" for m in range(level.fields)))


def displacements(plan: Plan, level: Level) -> list[str]:
    """u of the particle, and z, which the rule sees, on later levels; p where it differs."""
    u, z = (f"{name} = {plan.vector(f'{row}@[j]')}" for name, row in ("uh", "zz"))
    return [u, *([z] if level.number else []), *([_rule(level)] if level.fields else [])]


def difference(plan: Plan, level: Level, there: str) -> str:
    """d to the neighbour whose components have this pattern."""
    return f"d = {plan.vector(f'{there} - {level.source[0]}.@')}"


def bond_lines(plan: Plan, k: object, r: str, c: str, breaks: str, since: str) -> list[str]:
    """d as the rule sees it at slot k: softened, or that of the fictitious point where the bond
    `breaks` or is lost `since` a step."""
    if plan.model is None or plan.tears:
        return []
    lines = [f"is_lost = {since} >= 0"]
    if plan.judged:
        lines = [
            f"breaks_now = 1 if {breaks} else 0",
            f"is_lost = ((bits >> {k}) & 1) | breaks_now",
            f"now = now | (is_lost << {k})",
        ]
    lines.append(f"f = fictitious(u, {r}, q)")
    if isinstance(plan.model, Softens):
        lines.append(f"d = seen(d, f, {r}, {c}, q)")
    return [*lines, f"d = {plan.vector('f.@ if is_lost else d.@')}"]


def contributions(
    plan: Plan, level: Level, r: str, weights: str, there: Iterable[str] = (), torn: bool = False
) -> str:
    """What a neighbour contributes, by name; `there` is what is remembered of it, where the rule
    sees that; with the damage t beside the bond where cells are `torn`."""
    return _gathered(plan, level, r, weights, there, "c", torn)


def more_contributions(
    plan: Plan, level: Level, r: str, weights: Sequence[str], there: Iterable[str] = ()
) -> list[str]:
    """What cells of a stiffness of their own add to it, with these weights."""
    lines = list[str]()
    for w in weights:
        lines.append(_gathered(plan, level, r, w, there, "e", plan.tears))
        lines += [f"c{n} = c{n} + {plan.rounded(f'e{n}')}" for n in range(len(level.totals))]
    return lines


def _gathered(
    plan: Plan, level: Level, r: str, weights: str, there: Iterable[str], into: str, torn: bool
) -> str:
    n = level.number
    names = _pattern(level, [f"{into}{total[1:]}" for total in level.totals], "")
    given = ["d", r, f"Weights{n}({weights})", *(["t"] if torn else []), "p"]
    if plan.shares:
        given += [f"Own{n}({_own(level)})", f"Own{n}({listed(there)})"]
    return f"{names}, = {'torn' if torn else 'gather'}{n}({', '.join(given)})"


def _own(level: Level) -> str:
    """What is remembered of the particle."""
    return values(level.seen.own, {Home.PARTICLE: "a{n}[j]"})


def target_lines(
    plan: Plan,
    level: Level,
    local: Sequence[str],
    totals: list[str],
    movable: str = "",
    otherwise: str = "u.@",
) -> list[str]:
    """Where the particle goes, and what it remembers, where it is `movable` (everywhere), and what
    stands there `otherwise`. `local` are the components of X from site (0, 0)."""
    n, solver = level.number, plan.scene.experiment.stepping
    sums = _pattern(level, totals, "Vector")
    lines = list[str]()
    X = centred = plan.literal([0.0] * len(plan.axes))
    if level.scene.experiment.rule.uses_reference:
        lines = [f"X{c} = {value}" for c, value in zip(plan.axes, local, strict=True)]
        X = _shifted(plan, "+", plan.scene.raster.lattice.origin)
        centred = _shifted(plan, "-", plan.scene.middle)
    lines.append(f"here = Here({level.source[0]}, {X}, {centred}, Own{n}({_own(level)}))")
    total = f"({sums},)"
    if plan.is_loaded(level):
        total = f"loaded{n}({total}, {plan.vector('g@[j]')}, p)"
    lines.append(f"move = apply{n}({total}, here, p)")
    changing: list[int] = []
    if isinstance(level.scene.experiment.rule, RenewsParticles):
        changing = [m for m, number in enumerate(level.seen.own) if number.changes]
        lines.append(f"new = remember{n}(({sums},), here, p)")
    if level is not plan.levels[-1]:
        lines += plan.each(f"o@[j] = {_chosen('move.@', movable, plan.number(0.0))}")
    else:
        plain = solver.relaxation == 1.0 and "relaxation" not in solver.courses
        relaxed = "move.@" if plain else "solver[0] * move.@"
        swung = "new_@ = new_@ + solver[1] * (u.@ - o@[j])"
        swing = [swung] if solver.memory != 0.0 else []
        if "memory" in solver.courses:
            swing = [f"{swung} if solver[1] != 0.0 else new_@"]
        out = f"o@[j] = {_chosen('new_@', movable, otherwise)}"
        for pattern in (f"new_@ = u.@ + {relaxed}", *swing, out):
            lines += plan.each(pattern)
    return lines + [
        f"w{n}[j] = {_chosen(f'new[{m}]', movable, f'a{n}[j]')}" for m, n in enumerate(changing)
    ]


def _shifted(plan: Plan, sign: str, by: Iterable[float]) -> str:
    parts = (f"X{c} {sign} {plan.number(v)}" for c, v in zip(plan.axes, by, strict=True))
    return f"Vector({', '.join(parts)})"


def _chosen(value: str, where: str, otherwise: str) -> str:
    return f"{value} if {where} else {otherwise}" if where else value


def local_places(plan: Plan, s: str) -> list[str]:
    """X from site (0, 0), in the order of operations of the rasters."""
    index = [f"{name} + first[{n}]" for n, name in enumerate((*plan.lead, "j + j0"))]
    places = []
    for n, along in enumerate(zip(*plan.scene.raster.lattice.cell().vectors, strict=True)):
        terms = [f"({at}) * {float(v)!r}" for at, v in zip(index, along, strict=True)]
        places.append(f"at[{s}, {n}] + ({' + '.join(terms)})")
    return places


def _pattern(level: Level, names: list[str], kind: str) -> str:
    """Names of components, those of a vector together."""
    found, rest = [], iter(names)
    for size in level.parts:
        own = list(islice(rest, size))
        found.append(own[0] if size == 1 else f"{kind}({', '.join(own)})")
    return ", ".join(found)
