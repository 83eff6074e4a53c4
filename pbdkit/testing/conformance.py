"""The suite as a test function of pytest, which is imported only here."""

from __future__ import annotations

from typing import Any

from pbdkit.interfaces import Component
from pbdkit.testing.examining import Examination
from pbdkit.testing.examples import examples_of


def conformance(*components: Component | type[Component], **parts: Any) -> Any:
    """A test function with a case for each property of each component::

        test_conformance = conformance(MyRule(strength=2.0), MyLattice)

    A class stands for its examples. `parts` of an experiment (lattice=..., neighbours=...) stand in
    for those that are tried. What was skipped is skipped in pytest too, with its reason, and after
    the last property of a component a line tells what ran. Raises ValueError without a component.
    """
    import pytest

    if not components:
        raise ValueError("conformance() is given no component")
    examinations = [
        Examination(one, parts)
        for given in components
        for one in (examples_of(given) if isinstance(given, type) else [given])
    ]
    cases = [
        pytest.param(examination, asked.name, id=f"{examination.name}-{asked.name}")
        for examination in examinations
        for asked in examination.properties
    ]

    @pytest.mark.parametrize(("examination", "asked"), cases)
    def test_conformance(
        examination: Examination, asked: str, capsys: pytest.CaptureFixture[str]
    ) -> None:
        outcome = examination.outcome(asked)
        if asked == examination.properties[-1].name:
            with capsys.disabled():
                print(f"\n{examination.report().summary()}")
        if outcome.state == "failed":
            pytest.fail(f"{examination.name}: {asked}: {outcome.reason}", pytrace=False)
        if outcome.state == "skipped":
            pytest.skip(outcome.reason)

    return test_conformance
