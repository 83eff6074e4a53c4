"""What does not go together in an experiment, though each part is right by itself."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from pbdkit.experiment.newton import Newton
from pbdkit.interfaces import Draws, Loadable, RenewsParticles, Softens, SoftensCells
from pbdkit.interfaces.fields import unknown_regions
from pbdkit.interfaces.rule import material_of

Key = str | tuple[str, ...]


def clashes_of(asked: Any) -> Iterator[tuple[Key, str]]:
    """The fields of an experiment at which parts clash, each with a message."""
    yield from ((key, text) for key, clashes, text in _looked_at(asked) if clashes)
    for field in ("rule", "fracture"):
        for name, region, text in unknown_regions(getattr(asked, field), asked.regions):
            yield (field, name, region), text
        yield from _drawn_from(field, getattr(asked, field))
    for name, region in asked.regions.items():
        if any(box.in_sites for box in region.boxes()):
            yield ("regions", name), "counts sites, and a region is a place: take a rectangle"


def _drawn_from(field: str, part: Any) -> Iterator[tuple[Key, str]]:
    draws = isinstance(part, Draws) and any(not number.changes for number in part.remembered())
    for name in part.courses if draws else ():
        yield (
            (field, name),
            f"'{part.type}' draws numbers from it before the first step, so that it cannot change; "
            "give one number, or draw none",
        )


def _looked_at(asked: Any) -> Iterator[tuple[Key, bool, str]]:
    yield from _of_neighbours(asked)
    yield from _of_events(asked)
    yield from _of_forces(asked)


def _of_neighbours(asked: Any) -> list[tuple[Key, bool, str]]:
    """What needs bonds that last."""
    anew, jumps = asked.neighbours.nearness() is not None, not asked.solver.makes_steps
    settles = asked.stepping.settle is not None
    return [
        ("fracture", anew and asked.fracture.can_break,
         "bonds cannot break where neighbours are re-evaluated: there are no lasting bonds; "
         "set neighbours.reevaluate: false or fracture: {type: none}"),
        ("cuts", anew and bool(asked.cuts),
         "bonds cannot be cut where neighbours are re-evaluated: there are no lasting bonds; "
         "set neighbours.reevaluate: false, or leave cuts out"),
        ("solver", anew and jumps,
         "where neighbours are re-evaluated nothing tells where the steps lead; "
         "set neighbours.reevaluate: false or solver: {type: stepping}"),
        ("solver", anew and settles,
         "where neighbours are re-evaluated no distance from equilibrium is known; "
         "set neighbours.reevaluate: false, or leave solver.settle out"),
        ("loads", anew and bool(asked.loads),
         "need neighbours that stay; set neighbours.reevaluate: false"),
    ]  # fmt: skip


def _of_events(asked: Any) -> list[tuple[Key, bool, str]]:
    """What comes after the run's last step, and where steps do not tell their end."""
    last, late = max(asked.record.at or (0,)), max((cut.at for cut in asked.cuts), default=0)
    jumps, settles = not asked.solver.makes_steps, asked.stepping.settle is not None
    remembers, softens = (
        isinstance(asked.rule, RenewsParticles),
        isinstance(asked.fracture, (Softens, SoftensCells)),
    )
    return [
        ("record", last > asked.steps, f"step {last} is beyond the run's {asked.steps}"),
        ("record", asked.record.increments and not jumps,
         "increments of load are those of an equilibrium; take solver: {type: equilibrium}, or "
         "leave record.increments out"),
        ("cuts", late > asked.steps, f"step {late} is beyond the run's {asked.steps}"),
        ("solver", settles and (remembers or softens),
         f"'{(asked.rule if remembers else asked.fracture).type}' remembers, so that no distance "
         "from equilibrium is known; leave solver.settle out"),
        ("solver", jumps and remembers,
         f"the rule '{asked.rule.type}' remembers, so that where the steps lead depends on "
         "all of them; take solver: {type: stepping}"),
    ]  # fmt: skip


def _of_forces(asked: Any) -> list[tuple[Key, bool, str]]:
    """What masses, obstacles and loads ask for."""
    rests = not asked.solver.makes_steps or asked.stepping.settle is not None
    masses = any(isinstance(group.motion, Newton) for group in asked.leaders)
    knows_forces = material_of(asked.rule) is not None
    return [
        ("solver", masses and rests,
         "leaders that move by Newton's law have no place at which they rest beforehand; take "
         "solver: {type: stepping} without settle, or a load on followers"),
        ("rule", masses and not knows_forces,
         f"leaders that move by Newton's law need forces, and '{asked.rule.type}' knows none "
         "with these parameters; take a calibrated rule: elastic with poisson_ratio above -1, or "
         "springs"),
        ("loads", bool(asked.loads) and not (knows_forces and isinstance(asked.rule, Loadable)),
         f"the rule '{asked.rule.type}' with these parameters knows no forces: it says where a "
         "particle goes, and of no material how far a force would move it; take a calibrated "
         "rule ('elastic' or 'strain-gradient' with poisson_ratio above -1, 'orthotropic', "
         "'springs')"),
    ]  # fmt: skip
