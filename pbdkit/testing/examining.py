"""Examines components: asks every property of their interface, each in its own guard."""

from __future__ import annotations

import traceback
from collections.abc import Mapping
from typing import Any

from pbdkit.interfaces import Component
from pbdkit.interfaces.answers import AnswerError
from pbdkit.registry.blame import remedy
from pbdkit.testing.properties import properties_of
from pbdkit.testing.property import NotAskedError, Property, PropertyError
from pbdkit.testing.report import Outcome, Report
from pbdkit.testing.subject import Subject

NOT_JUDGED = "not judged while"


class Examination:
    """One component and how its properties come out; each is judged once, when first asked for."""

    def __init__(self, component: Component, parts: Mapping[str, Any] | None = None) -> None:
        self._subject = Subject(component, parts)
        self.properties = properties_of(type(component))
        self._by_name = {p.name: p for p in self.properties}
        self._known: dict[str, Outcome] = {}

    @property
    def name(self) -> str:
        """Interface, type and parameters of the component."""
        return self._subject.name

    def outcome(self, name: str) -> Outcome:
        """How the property of that name comes out, those that it needs first."""
        if name not in self._known:
            self._known[name] = self._judge(self._by_name[name])
        return self._known[name]

    def report(self) -> Report:
        """How all of them come out."""
        return Report(self.name, tuple(self.outcome(p.name) for p in self.properties))

    def _judge(self, asked: Property) -> Outcome:
        for name in asked.needs:
            if name in self._by_name:
                needed = self.outcome(name)
                if needed.state == "failed":
                    return Outcome(asked.name, "skipped", f"{NOT_JUDGED} {name} fails")
                if needed.reason.startswith(NOT_JUDGED):
                    return Outcome(asked.name, "skipped", needed.reason)
        try:
            asked.check(self._subject)
        except NotAskedError as reason:
            return Outcome(asked.name, "skipped", str(reason))
        except (PropertyError, AnswerError) as fault:
            return Outcome(asked.name, "failed", str(fault))
        except Exception as error:
            return Outcome(asked.name, "failed", _told(error))
        return Outcome(asked.name, "held")


def examine(component: Component, **parts: Any) -> Report:
    """The report of one component. `parts` of an experiment (lattice=..., neighbours=...) stand in
    for those that are tried, for a component that goes with them alone."""
    return Examination(component, parts).report()


def _told(error: Exception) -> str:
    """What a component's own code has raised, and the last line of it that has."""
    cause = error.__cause__ or error
    frames = traceback.extract_tb(cause.__traceback__)
    own = [f for f in frames if "/pbdkit/" not in f.filename.replace("\\", "/")] or frames
    told = f"{type(error).__name__}: {error}{remedy(error)}"
    return f"{told} ({own[-1].filename}, line {own[-1].lineno})"
