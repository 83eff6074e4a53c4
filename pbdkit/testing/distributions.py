"""Examines all components that a distribution offers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress

from pbdkit.errors import PluginError
from pbdkit.interfaces import Component, Lattice, NeighbourMetric
from pbdkit.testing.examining import examine
from pbdkit.testing.examples import examples_of
from pbdkit.testing.report import Outcome, Report

NEEDED = "has-examples"
"""The one property of a class: that components can be made of it."""


def examine_all(components: Sequence[type[Component]]) -> Iterator[Report]:
    """A report for each example of each class.

    What takes part in none of the usual scenes is tried on the lattices and with the neighbours
    that are offered beside it.
    """
    for component in components:
        try:
            examples = examples_of(component)
        except PluginError as error:
            outcome = Outcome(NEEDED, "failed", str(error))
            yield Report(component.__name__, (outcome,))
            continue
        for example in examples:
            yield _examined(example, components)


def _examined(component: Component, beside: Sequence[type[Component]]) -> Report:
    report = examine(component)
    if all(outcome.property != "takes-part" for outcome in report.failed):
        return report
    lattices, metrics = _examples(Lattice, beside), _examples(NeighbourMetric, beside)
    own = [{"lattice": lattices}, {"neighbours": metrics}]
    for parts in (*own, own[0] | own[1]):
        if all(parts.values()) and not isinstance(component, (Lattice, NeighbourMetric)):
            found = examine(component, **parts)
            if found.holds:
                return found
    return report


def _examples(interface: type[Component], offered: Sequence[type[Component]]) -> list[Component]:
    """Those of the classes offered that implement the interface, as far as they can be made."""
    found: list[Component] = []
    for component in offered:
        if issubclass(component, interface):
            with suppress(PluginError):
                found += examples_of(component)
    return found
