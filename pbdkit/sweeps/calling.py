"""A sweep that is asked for in Python, where nothing need be left on the disk."""

from __future__ import annotations

import tempfile
import warnings
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pbdkit.errors import ExperimentError, PbdkitWarning
from pbdkit.experiment.beside import OF_PROGRAM
from pbdkit.experiment.given import given_classes
from pbdkit.experiment.model import Experiment
from pbdkit.experiment.source import Source
from pbdkit.interfaces import Component
from pbdkit.results.progress import progress_bar
from pbdkit.results.result_file import open as open_result
from pbdkit.stepping.choice import processors
from pbdkit.sweeps.course import carry_out
from pbdkit.sweeps.crew import Alone, Cluster, Crew
from pbdkit.sweeps.member import Asked
from pbdkit.sweeps.processes import Processes
from pbdkit.sweeps.specification import checked

if TYPE_CHECKING:
    import xarray


def called(
    experiment: Experiment,
    parts: dict[str, Any],
    folder: str | Path | None,
    workers: int | None,
    client: Any,
    progress: bool,
) -> xarray.Dataset:
    """The dataset of a sweep with these parts, loaded where no folder keeps it."""
    base = replace(experiment.as_written(), name="")
    if base.beside.folder is None:
        base.beside = OF_PROGRAM
    given = given_classes(experiment)
    if given and folder is not None:
        raise ExperimentError(
            "folder: members are known by the versions of what they use, and classes from Python "
            "have none; leave it out, or make a plugin of them (`pbdkit plugins new`)"
        )
    crew = crew_of(workers, client, given)
    sweep = checked(parts | {"experiment": base.data}, Source())
    asked = Asked(sweep, base, Source(), given)
    with ExitStack() as ending:
        kept = Path(folder or ending.enter_context(tempfile.TemporaryDirectory(prefix="pbdkit-")))
        with progress_bar(progress) as show:
            summary = carry_out(asked, kept, crew, lambda: False, show)
        for text in summary.faults:
            warnings.warn(text, PbdkitWarning, stacklevel=4)
        if failures := summary.failures:
            member, status, message = failures[0]
            text = f"{len(failures)} of {len(summary.members)} members have no values, as {status}"
            warnings.warn(f"{text}: {member.words}: {message}", PbdkitWarning, stacklevel=4)
        assert summary.path is not None  # nobody stops it but by an exception
        dataset = open_result(summary.path)
        if folder is None:
            with dataset:
                return dataset.load()
        return dataset


def crew_of(workers: int | None, client: Any, components: tuple[type[Component], ...] = ()) -> Crew:
    """Who runs the members. Raises ExperimentError where that cannot be."""
    if workers is not None and (type(workers) is not int or workers < 1):
        raise ExperimentError(f"workers: should be a number from 1, got {workers!r}")
    if client is not None and workers is not None:
        raise ExperimentError("give workers of this machine, or a cluster, not both")
    if components and (client is not None or (workers or 1) > 1):
        raise ExperimentError(
            "classes from Python are known in this process only: leave workers and client out, or "
            "make a plugin of them (`pbdkit plugins new`)"
        )
    if client is not None:
        return Cluster(client)
    number = workers or (1 if components else processors())
    return Alone(components) if number == 1 else Processes(number)
