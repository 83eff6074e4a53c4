"""A sweep from its file to its dataset: what is held is not run, what is run is held."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from pbdkit.errors import ExperimentError
from pbdkit.registry.registry import GIVEN
from pbdkit.results.layout import CONVENTIONS, SCHEMA_VERSION
from pbdkit.results.saving import write_dataset
from pbdkit.sweeps.crew import Crew
from pbdkit.sweeps.grid import Dimension
from pbdkit.sweeps.joining import joined
from pbdkit.sweeps.member import Asked, Member
from pbdkit.sweeps.outlook import Outlook
from pbdkit.sweeps.store import Store
from pbdkit.sweeps.worker import INTERRUPTED, KEPT, Report

RESULT = "sweep.nc"
Show = Callable[[str, float], None]


@dataclass(frozen=True)
class Summary:
    """How a sweep went: its members, how those ended that did (status and message by key), how many
    were run now, what was found damaged, and where the dataset is; None where it was stopped."""

    members: list[Member]
    ends: dict[str, tuple[str, str]]
    run: int
    faults: list[str]
    path: Path | None

    @property
    def failures(self) -> list[tuple[Member, str, str]]:
        """The members that ended without values, with status and message."""
        ended = [member for member in self.members if member.job.key in self.ends]
        every = [(member, *self.ends[member.job.key]) for member in ended]
        return [entry for entry in every if entry[1] not in KEPT]


def carry_out(
    asked: Asked, folder: Path, crew: Crew, stopping: Callable[[], bool], show: Show
) -> Summary:
    """Validates every member, runs those that the folder does not hold, and writes the dataset.

    Raises ExperimentError and PluginError before anything runs, and StorageError. `stopping` is
    asked all the time; once it says so, what is finished is kept and there is no dataset.
    """

    def show_unless_stopped(what: str, share: float) -> None:
        if stopping():
            raise _StoppedError
        show(what, share)

    try:
        grid, members, versions = validated(asked, show_unless_stopped)
    except _StoppedError:
        return Summary([], {}, 0, [], None)
    jobs = {member.job.key: member.job for member in members}
    with Store(folder) as store:
        ends = store.held()
        todo = [job for key, job in jobs.items() if key not in ends]
        passing: dict[str, Report] = {}
        run = 0
        for report in _heard(crew.work(todo, stopping), len(jobs), len(todo), show):
            store.commit_if_due()
            if report is None:
                continue
            if report.lasting:
                store.put(report)
            else:
                passing[report.key] = report
            ends[report.key], run = (report.status, report.message), run + 1
        store.commit()
        store.look_around()
        if run < len(todo):
            return Summary(members, ends, run, store.faults, None)
        dataset = joined(grid, members, lambda key: passing.get(key) or store.report(key))
        dataset.attrs = _attributes(asked, versions)
        write_dataset(dataset, folder / RESULT, replace=True)
    return Summary(members, ends, run, store.faults, folder / RESULT)


class _StoppedError(Exception):
    """The sweep was stopped while its members were validated."""


def _heard(
    reports: Iterator[Report | None], members: int, todo: int, show: Show
) -> Iterator[Report | None]:
    """The reports of all but interrupted members, with what whoever waits is told meanwhile."""
    run = failed = 0
    for report in reports:
        if report is not None and report.status == INTERRUPTED:
            continue
        run, failed = run + bool(report), failed + bool(report and report.status not in KEPT)
        told = f"{members - todo + run} of {members} members"
        show(told + (f", {failed} failed" if failed else ""), run / todo)
        yield report


def validated(asked: Asked, show: Show) -> tuple[list[Dimension], list[Member], dict[str, str]]:
    """The grid, the members on it, and the versions of what they use. Raises ExperimentError and
    PluginError."""
    experiment = asked.experiment()
    grid, outlook = asked.grid(experiment), Outlook(asked.sweep.keep, asked.sweep.count)
    members: list[Member] = []
    versions: dict[str, str] = {}
    try:
        for member, one in asked.members(grid, lambda share: show("validating", share)):
            outlook.look(one, member.words)
            members.append(member)
            versions |= member.job.versions
        outlook.refuse_too_large()
    except ExperimentError as error:
        name = asked.source.name
        raise ExperimentError(f"{name}: {error}" if name else str(error), error.where) from None
    return grid, members, versions


def _attributes(asked: Asked, versions: dict[str, str]) -> dict[str, str]:
    experiment = asked.experiment()
    sweep = asked.sweep.model_dump(mode="json", by_alias=True)
    sweep["experiment"] = experiment.model_dump(mode="json", by_alias=True)
    return {
        "Conventions": CONVENTIONS,
        "schema_version": SCHEMA_VERSION,
        "title": f"sweep of {experiment.name}",
        "pbdkit_version": version("pbdkit"),
        "sweep": json.dumps(sweep),
        "plugins": json.dumps({k: v for k, v in versions.items() if k != GIVEN}),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
    }
