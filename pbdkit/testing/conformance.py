"""The conformance suite: test the properties of a component, as a report or as a test of pytest."""

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
from pbdkit.testing.states import DivergenceError
from pbdkit.testing.subject import (
    NotApplicableError,
    Property,
    PropertyError,
    Subject,
    examples_of,
    full_name,
)

PROPERTIES: tuple[Property, ...] = tuple(
    attribute
    for page in (component_properties, step_properties, mechanics_properties)
    for attribute in vars(page).values()
    if isinstance(attribute, Property)
)
"""Properties of components, in the order of their files."""


def properties_of(component: type[Component]) -> list[Property]:
    """Return the properties that components of a class must have.

    Parameters
    ----------
    component : type
        Class of components.

    Returns
    -------
    list of Property
        Properties, in the order of `PROPERTIES`.
    """
    return [p for p in PROPERTIES if issubclass(component, p.interfaces)]


State = Literal["held", "failed", "skipped"]


@dataclass(frozen=True)
class Outcome:
    """Result of one property for one component.

    Parameters
    ----------
    property : str
        Name of the property.
    state : {"held", "failed", "skipped"}
        Result of the property.
    reason : str
        Fault of the component, or reason for which the property was skipped.
    """

    property: str
    state: State
    reason: str = ""


@dataclass(frozen=True)
class Report:
    """Outcomes of one component.

    Parameters
    ----------
    component : str
        Name of the component, with its parameters.
    outcomes : tuple of Outcome
        Outcomes, in the order of the properties.
    """

    component: str
    outcomes: tuple[Outcome, ...]

    @property
    def ran(self) -> list[Outcome]:
        """Outcomes that held or failed."""
        return [o for o in self.outcomes if o.state != "skipped"]

    @property
    def failed(self) -> list[Outcome]:
        """Outcomes of properties that do not hold."""
        return [o for o in self.outcomes if o.state == "failed"]

    @property
    def skipped(self) -> list[Outcome]:
        """Outcomes that were skipped."""
        return [o for o in self.outcomes if o.state == "skipped"]

    @property
    def holds(self) -> bool:
        """True if no property failed and at least one ran."""
        return bool(self.ran) and not self.failed

    def summary(self) -> str:
        """Summarise the report in one line: how many properties ran, failed and were skipped.

        Returns
        -------
        str
            Line without line break.
        """
        reasons = Counter(o.reason for o in self.skipped)
        counts = f"{self.component}: {len(self.ran)} properties ran, {len(self.failed)} failed"
        return "; ".join([counts, *(f"{n} skipped: {why}" for why, n in reasons.items())])

    def __str__(self) -> str:
        wide = max((len(o.property) for o in self.outcomes), default=0)
        rows = [f"  {o.state:7}  {o.property:{wide}}  {o.reason}".rstrip() for o in self.outcomes]
        return "\n".join([self.summary(), *rows])


def _outcomes(component: Component, parts: Mapping[str, Any]) -> Iterator[Outcome]:
    """Yield the outcome of each property in order.

    If a property that others require fails, the others are skipped.
    """
    subject, failed = Subject(component, parts), ""
    for tested in properties_of(type(component)):
        if failed:
            yield Outcome(tested.name, "skipped", f"not tested, since {failed} fails")
            continue
        outcome = _judged(tested, subject)
        yield outcome
        failed = tested.name if tested.is_needed and outcome.state == "failed" else ""


def _judged(tested: Property, subject: Subject) -> Outcome:
    try:
        tested.check(subject)
    except NotApplicableError as reason:
        return Outcome(tested.name, "skipped", str(reason))
    except (PropertyError, DivergenceError) as fault:
        return Outcome(tested.name, "failed", str(fault))
    except Exception as error:
        package = type(subject.component).__module__.split(".")[0]
        return Outcome(tested.name, "failed", worded(error, package))
    return Outcome(tested.name, "held")


def examine(component: Component | type[Component], **parts: Any) -> Report:
    """Test the properties of one component.

    Parameters
    ----------
    component : Component or type
        Component, or a class. Of a class the first example is tested.
    **parts : object
        Parts of experiments, ``lattice``, ``neighbours`` and others, that replace the usual ones,
        for a component that requires them.

    Returns
    -------
    Report
        Outcome of each property. For a class without usable examples it contains the reason.

    Examples
    --------
    >>> class Sheared(Lattice):
    ...     '''Lattice with shifted rows.'''
    ...
    ...     type: Literal["sheared"] = "sheared"
    ...
    ...     def cell(self):
    ...         return Cell((Vector(1.0, 0.0), Vector(0.25, 1.0)))
    >>> report = pbdkit.testing.examine(Sheared())
    >>> report.holds
    True
    >>> len(report.ran)
    16
    """
    instance: Any = component
    if isinstance(component, type):
        try:
            instance = examples_of(component)[0]
        except PluginError as error:
            # A class is tested for one property: that components can be created.
            return Report(component.__name__, (Outcome("has-examples", "failed", str(error)),))
    return Report(full_name(instance), tuple(_outcomes(instance, parts)))


def examine_all(components: Sequence[type[Component]]) -> Iterator[Report]:
    """Yield a report for each example of each class.

    If no usual scene can be built with a component, it is tested on the lattices and with the
    neighbour metrics among the classes.

    Parameters
    ----------
    components : sequence of type
        Classes of components.

    Yields
    ------
    Report
        Outcomes of one component.
    """
    for component in components:
        for example in _made(component) or (component,):
            yield _examined(example, components)


def _examined(component: Component | type[Component], offered: Sequence[type[Component]]) -> Report:
    report = examine(component)
    takes_part = all(outcome.property != "takes-part" for outcome in report.failed)
    if takes_part or isinstance(component, (Lattice, NeighbourMetric)):
        return report
    lattices = {"lattice": [e for c in offered if issubclass(c, Lattice) for e in _made(c)]}
    metrics = [e for c in offered if issubclass(c, NeighbourMetric) for e in _made(c)]
    around = {"neighbours": metrics}
    for parts in (lattices, around, lattices | around):
        if all(parts.values()) and (other := examine(component, **parts)).holds:
            return other
    return report


def _made(component: type[Component]) -> list[Component]:
    """Return the examples of a class; empty if there are none."""
    with suppress(PluginError):
        return examples_of(component)
    return []


def conformance(*components: Component | type[Component], **parts: Any) -> Any:
    """Return a test function of pytest with a case for each property of each component.

    Skipped properties are skipped tests of pytest and have a reason. After the last property of a
    component a line with the number of tests, failures and skipped tests is printed.

    Parameters
    ----------
    *components : Component or type
        Components, or classes. Of a class all examples are tested.
    **parts : object
        Parts of experiments, ``lattice``, ``neighbours`` and others, that replace the usual ones.

    Returns
    -------
    callable
        Test function, to be assigned to a name that begins with ``test_``.

    Raises
    ------
    ValueError
        If no component is given.
    PluginError
        If a class has no usable examples.

    Examples
    --------
    In a test module:

    >>> class Sheared(Lattice):
    ...     '''Lattice with shifted rows.'''
    ...
    ...     type: Literal["sheared"] = "sheared"
    ...
    ...     def cell(self):
    ...         return Cell((Vector(1.0, 0.0), Vector(0.25, 1.0)))
    >>> test_conformance = conformance(Sheared())
    """
    import pytest

    if not components:
        raise ValueError("conformance() requires at least one component")
    instances: list[Component] = []
    for component in components:
        instances += examples_of(component) if isinstance(component, type) else [component]
    report_of = cache(lambda n: examine(instances[n], **parts))
    cases = [
        pytest.param(n, tested.name, id=f"{full_name(instance)}-{tested.name}")
        for n, instance in enumerate(instances)
        for tested in properties_of(type(instance))
    ]

    @pytest.mark.parametrize(("component", "name"), cases)
    def test_conformance(component: int, name: str, capsys: pytest.CaptureFixture[str]) -> None:
        report = report_of(component)
        outcome = next(o for o in report.outcomes if o.property == name)
        if outcome is report.outcomes[-1]:
            with capsys.disabled():
                print(f"\n{report.summary()}")
        if outcome.state == "failed":
            pytest.fail(f"{report.component}: {name}: {outcome.reason}", pytrace=False)
        if outcome.state == "skipped":
            pytest.skip(outcome.reason)  # The property does not apply to this component.

    return test_conformance
