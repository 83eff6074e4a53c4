"""The members of a sweep: one validated experiment each, and the digest that it is known by."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from typing import NamedTuple

import xxhash

from pbdkit.errors import ExperimentError, PluginError
from pbdkit.experiment.model import Experiment
from pbdkit.experiment.settings import with_value
from pbdkit.experiment.source import Source
from pbdkit.interfaces import Component
from pbdkit.results.layout import SCHEMA_VERSION, reserved_names
from pbdkit.results.physical import IN_MM
from pbdkit.sweeps.grid import Dimension, Setting, dimensions, places, words
from pbdkit.sweeps.specification import Keep, Sweep


class Job(NamedTuple):
    """What whoever runs a member is told: the experiment as JSON, with all that is not kept left
    out of it, the variables to keep (None: all), the times, and the versions to run it with."""

    key: str
    experiment: str
    variables: tuple[str, ...] | None
    times: str | tuple[int, ...]
    versions: dict[str, str]


@dataclass(frozen=True)
class Member:
    """One place on the grid."""

    place: tuple[int, ...]
    words: str
    job: Job


@dataclass(frozen=True)
class Asked:
    """A sweep as it was asked for: of which experiment, with the classes from Python that it names,
    and the source of the sweep itself."""

    sweep: Sweep
    base: Source
    source: Source
    components: tuple[type[Component], ...] = ()

    def experiment(self) -> Experiment:
        """What is varied, as it is without that. Raises ExperimentError and PluginError."""
        return Experiment.build(self.base, self.components)

    def grid(self, experiment: Experiment) -> list[Dimension]:
        """The dimensions."""
        diagnosed = (v for d in experiment.diagnostics for v in d.variables())
        taken = reserved_names() | {n for v in diagnosed for n in (v.name, *v.dims)}
        return dimensions(self.sweep, experiment, taken)

    def members(
        self, grid: list[Dimension], show: Callable[[float], None]
    ) -> Iterator[tuple[Member, Experiment]]:
        """Each member with its experiment; `show` is told the share that has been validated.

        Raises ExperimentError and PluginError, which name the parameters of the member.
        """
        installed, count = version("pbdkit"), self.sweep.count
        for n, (place, settings) in enumerate(places(grid)):
            show(n / count)
            with named(words(settings)):
                experiment = self._with(settings)
                versions = {"pbdkit": installed} | experiment.distributions()
                job = job_of(experiment, self.sweep.keep, versions)
            yield Member(place, words(settings), job), experiment

    def _with(self, settings: Iterable[Setting]) -> Experiment:
        source, defaults = self.base, Experiment.defaults()
        for section, path, value in settings:
            label = self.source.places.get((section, path), section)
            source = with_value(source, path, value, label, defaults)
        return Experiment.build(source, self.components)


@contextmanager
def named(member: str) -> Iterator[None]:
    """What is wrong in the block is said with the words for the member."""
    try:
        yield
    except (ExperimentError, PluginError) as error:
        raise type(error)(f"member {member}: {error}", error.where) from None


def job_of(experiment: Experiment, keep: Keep, versions: dict[str, str]) -> Job:
    """What is to be run: nothing is recorded or measured that nobody keeps, and on one thread where
    the experiment does not say on how many, as other members run beside it."""
    data = experiment.model_dump(mode="json", by_alias=True)
    steps = experiment.steps
    if keep.times != "all":
        wanted = (steps,) if keep.times == "last" else keep.times
        kept = sorted({step for step in wanted if step <= steps}) or [0]
        data["record"] = {k: v for k, v in data["record"].items() if k != "every"} | {"at": kept}
    if keep.variables is not None:
        asked = {name for kept in keep.variables for name in (kept, kept.removesuffix(IN_MM))}
        measured = zip(experiment.diagnostics, data["diagnostics"], strict=True)
        data["diagnostics"] = [
            part
            for diagnostic, part in measured
            if "bonds" in diagnostic.needs or {v.name for v in diagnostic.variables()} & asked
        ]
    if data["solver"].get("threads") == "auto":
        data["solver"]["threads"] = 1
    text = json.dumps(data)
    content = json.dumps(
        [text, keep.variables, keep.times, sorted(versions.items()), SCHEMA_VERSION]
    )
    return Job(
        xxhash.xxh3_128_hexdigest(content.encode()), text, keep.variables, keep.times, versions
    )
