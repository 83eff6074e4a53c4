"""The conformance suite: examine the properties of a component, each in its own guard, as a report
or as a test of pytest.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

from pbdkit.errors import PluginError
from pbdkit.hooks import worded
from pbdkit.plugin import Component, Lattice, NeighbourMetric
from pbdkit.testing import component_properties, mechanics_properties, step_properties
from pbdkit.testing.subject import (
    NotAskedError,
    Property,
    PropertyError,
    Subject,
    examples_of,
    full_name,
)

PROPERTIES: tuple[Property, ...] = tuple(
    found
    for page in (component_properties, step_properties, mechanics_properties)
    for found in vars(page).values()
    if isinstance(found, Property)
)
"""Page by page, as they stand there."""


def properties_of(component: type[Component]) -> list[Property]:
    """Those that are asked of components of this class."""
    return [p for p in PROPERTIES if issubclass(component, p.interfaces)]


State = Literal["held", "failed", "skipped"]


@dataclass(frozen=True)
class Outcome:
    """How one property came out for one component; `reason` is the fault, or why it was skipped."""

    property: str
    state: State
    reason: str = ""


@dataclass(frozen=True)
class Report:
    """All outcomes of one component; `component` names it with its parameters."""

    component: str
    outcomes: tuple[Outcome, ...]

    @property
    def ran(self) -> list[Outcome]:
        """Those that were judged, held or failed."""
        return [o for o in self.outcomes if o.state != "skipped"]

    @property
    def failed(self) -> list[Outcome]:
        """Those that do not hold."""
        return [o for o in self.outcomes if o.state == "failed"]

    @property
    def skipped(self) -> list[Outcome]:
        """Those that were not judged, with the reason."""
        return [o for o in self.outcomes if o.state == "skipped"]

    @property
    def holds(self) -> bool:
        """Whether nothing failed, and something ran."""
        return bool(self.ran) and not self.failed

    def summary(self) -> str:
        """One line: how many ran and failed, and why others were skipped."""
        reasons = Counter(o.reason for o in self.skipped)
        counts = f"{self.component}: {len(self.ran)} properties ran, {len(self.failed)} failed"
        return "; ".join([counts, *(f"{n} skipped: {why}" for why, n in reasons.items())])

    def __str__(self) -> str:
        wide = max((len(o.property) for o in self.outcomes), default=0)
        rows = [f"  {o.state:7}  {o.property:{wide}}  {o.reason}".rstrip() for o in self.outcomes]
        return "\n".join([self.summary(), *rows])


def _outcomes(component: Component, parts: Mapping[str, Any]) -> Iterator[Outcome]:
    """How each property comes out, in their order; none is judged after a needed one that fails."""
    subject, failed = Subject(component, parts), ""
    for asked in properties_of(type(component)):
        if failed:
            yield Outcome(asked.name, "skipped", f"not judged while {failed} fails")
            continue
        outcome = _judged(asked, subject)
        yield outcome
        failed = asked.name if asked.is_needed and outcome.state == "failed" else ""


def _judged(asked: Property, subject: Subject) -> Outcome:
    try:
        asked.check(subject)
    except NotAskedError as reason:
        return Outcome(asked.name, "skipped", str(reason))
    except PropertyError as fault:
        return Outcome(asked.name, "failed", str(fault))
    except Exception as error:
        package = type(subject.component).__module__.split(".")[0]
        return Outcome(asked.name, "failed", worded(error, package))
    return Outcome(asked.name, "held")


def examine(component: Component | type[Component], **parts: Any) -> Report:
    """The report of one component; a class stands for its first example. `parts` of an experiment
    (lattice=..., neighbours=...) stand in for those that are tried, for a component that goes with
    them alone. Of a class of which none can be made the report says why."""
    one: Any = component
    if isinstance(component, type):
        try:
            one = examples_of(component)[0]
        except PluginError as error:
            # The one property of a class: that components can be made of it.
            return Report(component.__name__, (Outcome("has-examples", "failed", str(error)),))
    return Report(full_name(one), tuple(_outcomes(one, parts)))


def examine_all(components: Sequence[type[Component]]) -> Iterator[Report]:
    """A report for each example of each class.

    What takes part in none of the usual scenes is tried on the lattices and with the neighbours
    that are offered beside it.
    """
    for component in components:
        for example in _made(component) or (component,):
            yield _examined(example, components)


def _examined(one: Component | type[Component], beside: Sequence[type[Component]]) -> Report:
    report = examine(one)
    takes_part = all(outcome.property != "takes-part" for outcome in report.failed)
    if takes_part or isinstance(one, (Lattice, NeighbourMetric)):
        return report
    lattices = {"lattice": [e for c in beside if issubclass(c, Lattice) for e in _made(c)]}
    around = {"neighbours": [e for c in beside if issubclass(c, NeighbourMetric) for e in _made(c)]}
    for parts in (lattices, around, lattices | around):
        if all(parts.values()) and (found := examine(one, **parts)).holds:
            return found
    return report


def _made(component: type[Component]) -> list[Component]:
    """The examples of a class; none where none can be made."""
    with suppress(PluginError):
        return examples_of(component)
    return []


def conformance(*components: Component | type[Component], **parts: Any) -> Any:
    """A test function of pytest with a case for each property of each component::

        test_conformance = conformance(MyRule(strength=2.0), MyLattice)

    A class stands for its examples. `parts` of an experiment (lattice=..., neighbours=...) stand in
    for those that are tried. What was skipped is skipped in pytest too, with its reason, and after
    the last property of a component a line tells what ran. Raises ValueError without a component,
    PluginError where none can be made of a class.
    """
    import pytest

    if not components:
        raise ValueError("conformance() is given no component")
    tried: list[Component] = []
    for given in components:
        tried += examples_of(given) if isinstance(given, type) else [given]
    report_of = cache(lambda n: examine(tried[n], **parts))
    cases = [
        pytest.param(n, asked.name, id=f"{full_name(one)}-{asked.name}")
        for n, one in enumerate(tried)
        for asked in properties_of(type(one))
    ]

    @pytest.mark.parametrize(("component", "asked"), cases)
    def test_conformance(component: int, asked: str, capsys: pytest.CaptureFixture[str]) -> None:
        report = report_of(component)
        outcome = next(o for o in report.outcomes if o.property == asked)
        if outcome is report.outcomes[-1]:
            with capsys.disabled():
                print(f"\n{report.summary()}")
        if outcome.state == "failed":
            pytest.fail(f"{report.component}: {asked}: {outcome.reason}", pytrace=False)
        if outcome.state == "skipped":
            pytest.skip(outcome.reason)  # the property does not apply to this component

    return test_conformance
