"""Examines components: asks every property of their interface, each in its own guard."""

from __future__ import annotations

import traceback
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

from pbdkit.errors import PluginError
from pbdkit.interfaces import Component, Lattice, NeighbourMetric
from pbdkit.interfaces.component import AnswerError
from pbdkit.registry.blame import remedy
from pbdkit.testing.fault import NotAskedError, PropertyError
from pbdkit.testing.properties import properties_of
from pbdkit.testing.property import Property
from pbdkit.testing.subject import Subject, examples_of, full_name

State = Literal["held", "failed", "skipped"]
NEEDED = "has-examples"
"""The one property of a class: that components can be made of it."""


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
        skipped = "; ".join(f"{n} skipped: {reason}" for reason, n in reasons.items())
        counts = f"{len(self.ran)} properties ran, {len(self.failed)} failed"
        return f"{self.component}: {counts}" + (f"; {skipped}" if skipped else "")

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
    except (PropertyError, AnswerError) as fault:
        return Outcome(asked.name, "failed", str(fault))
    except Exception as error:
        return Outcome(asked.name, "failed", _told(error))
    return Outcome(asked.name, "held")


def examine(component: Component | type[Component], **parts: Any) -> Report:
    """The report of one component; a class stands for its first example. `parts` of an experiment
    (lattice=..., neighbours=...) stand in for those that are tried, for a component that goes with
    them alone. Of a class of which none can be made the report says why."""
    try:
        one = examples_of(component)[0] if isinstance(component, type) else component
    except PluginError as error:
        return _nothing(component, error)
    return Report(full_name(one), tuple(_outcomes(one, parts)))


def _nothing(component: Any, error: PluginError) -> Report:
    return Report(component.__name__, (Outcome(NEEDED, "failed", str(error)),))


def examine_all(components: Sequence[type[Component]]) -> Iterator[Report]:
    """A report for each example of each class.

    What takes part in none of the usual scenes is tried on the lattices and with the neighbours
    that are offered beside it.
    """
    for component in components:
        try:
            examples = examples_of(component)
        except PluginError as error:
            yield _nothing(component, error)
            continue
        yield from (_examined(example, components) for example in examples)


def _examined(component: Component, beside: Sequence[type[Component]]) -> Report:
    report = examine(component)
    if all(outcome.property != "takes-part" for outcome in report.failed):
        return report
    lattices, metrics = _offered(Lattice, beside), _offered(NeighbourMetric, beside)
    own = [{"lattice": lattices}, {"neighbours": metrics}]
    for parts in (*own, own[0] | own[1]):
        if all(parts.values()) and not isinstance(component, (Lattice, NeighbourMetric)):
            found = examine(component, **parts)
            if found.holds:
                return found
    return report


def _offered(interface: type[Component], offered: Sequence[type[Component]]) -> list[Component]:
    """Examples of the classes that implement the interface, as far as they can be made."""
    found: list[Component] = []
    for component in offered:
        with suppress(PluginError):
            found += examples_of(component) if issubclass(component, interface) else []
    return found


def _told(error: Exception) -> str:
    """What a component's own code has raised, and the last line of it that has."""
    cause = error.__cause__ or error
    frames = traceback.extract_tb(cause.__traceback__)
    own = [f for f in frames if "/pbdkit/" not in f.filename.replace("\\", "/")] or frames
    told = f"{type(error).__name__}: {error}{remedy(error)}"
    return f"{told} ({own[-1].filename}, line {own[-1].lineno})"


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
    tried = [
        one
        for given in components
        for one in (examples_of(given) if isinstance(given, type) else [given])
    ]
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
            pytest.skip(outcome.reason)

    return test_conformance
