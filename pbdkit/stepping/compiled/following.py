"""Writes how frame points follow the body."""

from __future__ import annotations

from pbdkit.stepping.compiled.plan import Function, Plan


def write_frame(out: Function, plan: Plan, source: str, target: str) -> None:
    """Frame points from flat planes of the body."""
    out.add(1, f"for f in {plan.over('points.size')}:")
    write_point(out, plan, source, target)


def write_point(out: Function, plan: Plan, source: str, target: str) -> None:
    """The frame point f, in a loop."""
    _write_mapped(out, plan, source)
    out.add(2, *plan.each(f"{target}_@[points[f]] = t_@"))


def write_lagging_point(out: Function, plan: Plan, source: str, target: str) -> None:
    """The frame point f, where it was to be after the step before, in a loop."""
    out.add(2, *plan.each(f"{target}_@[points[f]] = lag_@[f]"))
    write_lag(out, plan, source)


def write_lag(out: Function, plan: Plan, source: str) -> None:
    """Where the frame point f is to be a step later, in a loop."""
    _write_mapped(out, plan, source)
    out.add(2, *plan.each("lag_@[f] = t_@"))


def _write_mapped(out: Function, plan: Plan, source: str) -> None:
    assert plan.scene.frame
    out.add(2, *plan.each(f"t_@ = {plan.number(0.0)}"))
    out.add(2, "for e in range(entries[f], entries[f + 1]):")
    for a, c in enumerate(plan.axes):
        term = f"mapped[e] * {source}_{c}[bodies[e]]"
        if plan.scene.frame.map.weight.ndim == 3:
            terms = plan.each(f"mapped[e, {a}, #] * {source}_@[bodies[e]]")
            term = f"({' + '.join(terms)})"
        out.add(3, f"t_{c} = t_{c} + {term}")
