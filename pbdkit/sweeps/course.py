"""A sweep from its file to its dataset: what is held is not run, what is run is held."""

from __future__ import annotations

import json
import os
import socket
import uuid
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

from pbdkit.errors import ExperimentError, StorageError
from pbdkit.registry.registry import GIVEN
from pbdkit.results.layout import CONVENTIONS, SCHEMA_VERSION
from pbdkit.results.seal import put_seal
from pbdkit.sweeps.crew import Crew
from pbdkit.sweeps.grid import Dimension
from pbdkit.sweeps.joining import joined
from pbdkit.sweeps.member import Asked, Member
from pbdkit.sweeps.outlook import Outlook
from pbdkit.sweeps.store import Store
from pbdkit.sweeps.worker import WHOLE, Report

if TYPE_CHECKING:
    import xarray

RESULT = "sweep.nc"
Show = Callable[[str, float], None]


@dataclass(frozen=True)
class Summary:
    """How a sweep went: the members by how they ended, how many were run now, what was found
    damaged, and whether it came to its end; only then is there a dataset."""

    members: list[Member]
    ends: dict[str, tuple[str, str]]
    run: int
    faults: list[str]
    path: Path | None

    @property
    def failures(self) -> list[tuple[Member, str, str]]:
        """The members whose values are missing, with status and message."""
        every = ((member, *self.ends[member.job.key]) for member in self.members
                 if member.job.key in self.ends)  # fmt: skip
        return [(member, status, text) for member, status, text in every if status not in WHOLE]


def carry_out(
    asked: Asked, folder: Path, crew: Crew, stopping: Callable[[], bool], show: Show
) -> Summary:
    """Validates every member, runs those that the folder does not hold, and writes the dataset.

    Raises ExperimentError and PluginError before anything runs, and StorageError. `stopping` is
    asked all the time; once it says so, what is finished is kept and there is no dataset.
    """
    grid, members, versions = _validated(asked, show)
    jobs = {member.job.key: member.job for member in members}
    with Store(folder) as store:
        held, faults = store.held()
        todo = [job for key, job in jobs.items() if key not in held]
        passing: dict[str, Report] = {}
        count = failed = 0
        for report in crew.work(todo, stopping):
            store.commit_if_due()
            if report is not None and report.status != "interrupted":
                if report.lasting:
                    store.put(report)
                passing[report.key] = report._replace(content=b"")
                count, failed = count + 1, failed + (report.status not in WHOLE)
            what = f"{len(jobs) - len(todo) + count} of {len(jobs)} members"
            show(what + f", {failed} failed" * bool(failed), count / max(1, len(todo)))
        store.commit()

        def report_of(key: str) -> Report:
            report = passing.get(key)
            return report if report and not report.lasting else store.report(key)

        path = None
        if count == len(todo):
            dataset = joined(grid, members, report_of)
            dataset.attrs = _attributes(asked, versions)
            path = folder / RESULT
            _write(dataset, path)
        ends = {key: (r.status, r.message) for key in jobs if key in held or key in passing
                for r in [passing.get(key) or store.report(key)]}  # fmt: skip
        return Summary(members, ends, count, faults, path)


def _validated(asked: Asked, show: Show) -> tuple[list[Dimension], list[Member], dict[str, str]]:
    """The grid, the members on it, and the versions of what they use."""
    experiment = asked.experiment()
    grid, outlook = asked.grid(experiment), Outlook(asked.sweep.keep, asked.sweep.count)
    members, versions = [], {}
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


def _write(dataset: xarray.Dataset, path: Path) -> None:
    """Whole and sealed, or not at all; what was there before is replaced. Raises StorageError."""
    name = f".{socket.gethostname()}.{os.getpid()}.{uuid.uuid4().hex}.nc"
    temporary = path.absolute().with_name(name)
    try:
        dataset.to_netcdf(temporary, engine="netcdf4")
        put_seal(temporary)
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(path.absolute())
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise StorageError(f"{path}: cannot be written: {reason}") from None
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
