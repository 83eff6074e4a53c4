"""Writes how frame points follow the body."""

from __future__ import annotations

from pbdkit.stepping.compiled.plan import Function, Plan


def write_frame(out: Function, plan: Plan, source: str, target: str) -> None:
    """Frame points from flat planes of the body."""
    out.add(1, "for f in range(points.size):")
    write_point(out, plan, source, target)


def write_point(out: Function, plan: Plan, source: str, target: str) -> None:
    """The frame point f, in a loop."""
    assert plan.scene.frame
    out.add(2, *plan.each(f"t_@ = {plan.number(0.0)}"))
    out.add(2, "for e in range(entries[f], entries[f + 1]):")
    for a, c in enumerate(plan.axes):
        term = f"mapped[e] * {source}_{c}[bodies[e]]"
        if plan.scene.frame.map.weight.ndim == 3:
            terms = plan.each(f"mapped[e, {a}, #] * {source}_@[bodies[e]]")
            term = f"({' + '.join(terms)})"
        out.add(3, f"t_{c} = t_{c} + {term}")
    out.add(2, *plan.each(f"{target}_@[points[f]] = t_@"))
