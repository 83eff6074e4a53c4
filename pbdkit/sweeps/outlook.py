"""How large the result of a sweep will be, before anything is run."""

from __future__ import annotations

import json
import math

import numpy as np
import xxhash

from pbdkit.errors import ExperimentError, did_you_mean
from pbdkit.experiment.model import Experiment
from pbdkit.resources.memory import machine_memory
from pbdkit.results.layout import Column, Values
from pbdkit.results.recorder import Recorder
from pbdkit.results.sink import Sink
from pbdkit.scene.scene import build_scene
from pbdkit.sweeps.member import named
from pbdkit.sweeps.specification import Keep

SHAPING = ("lattice", "body", "neighbours", "frame", "fracture", "diagnostics", "units")
"""The parts of an experiment on which the shape of its dataset depends, besides its times."""
SHARE = 0.5
"""Of the memory of this machine that the dataset of a sweep may take."""
TEXT = 8
"""Bytes of a text, about."""


class _Plan(Sink):
    """Takes the columns of a run that is not made."""

    def begin(self, columns: list[Column], sizes: dict[str, int], planned: dict[str, int]) -> None:
        """Keeps what it is told."""
        self.columns, self.sizes, self.planned = columns, sizes, planned

    def put(self, values: Values) -> None:
        """Not wanted."""

    def finish(self, attributes: dict[str, str]) -> None:
        """Does not come."""

    def abandon(self) -> None:
        """Does not come."""


class Outlook:
    """Looks at the experiments of all members, builds the scene of each different body, and sums up
    the dataset that they come to."""

    def __init__(self, keep: Keep, count: int) -> None:
        self._keep, self._count = keep, count
        self._seen: set[bytes] = set()
        self._columns: dict[str, Column] = {}
        self._sizes: dict[str, int] = {}
        self._times: set[tuple[int, tuple[int, ...] | None, int, int]] = set()

    def look(self, experiment: Experiment, words: str) -> None:
        """At one more, which messages call so. Raises ExperimentError and PluginError where it has
        no scene, and where a variable that is to be kept is none of its dataset."""
        steps, asked = experiment.steps, experiment.record
        between = experiment.record_count - asked.count(steps)
        self._times.add((steps, asked.at, asked.every, between))
        data = experiment.model_dump(mode="json", by_alias=True)
        shape = xxhash.xxh3_128_digest(json.dumps([data.get(part) for part in SHAPING]).encode())
        if shape in self._seen:
            return
        self._seen.add(shape)
        plan = _Plan()
        with named(words):
            Recorder(build_scene(experiment), plan).begin()
        known = {column.name: column for column in plan.columns}
        for name in self._keep.variables or ():
            if name not in known:
                hint = did_you_mean(name, known)
                what = f"there is no variable '{name}'{hint} (known: {', '.join(known)})"
                raise ExperimentError(f"keep.variables: {what}", ("keep", "variables"))
        self._columns |= known
        for dim, size in plan.sizes.items():
            self._sizes[dim] = max(size, self._sizes.get(dim, 0))
        self._sizes["step"] = max(steps + 1, self._sizes.get("step", 0))

    def refuse_too_large(self) -> None:
        """Raises ExperimentError where the dataset cannot be in memory at once, or where no member
        comes to a step that is to be kept."""
        keep, last = self._keep, max(steps for steps, *_ in self._times)
        if isinstance(keep.times, tuple) and min(keep.times) > last:
            text = f"keep.times: {min(keep.times)} is beyond the last step of all, {last}"
            raise ExperimentError(text, ("keep", "times"))
        sizes = self._sizes | {"time": self._number_of_times()}
        names = self._columns if keep.variables is None else keep.variables
        wanted = [self._columns[name] for name in names]
        each = sum(math.prod(sizes.get(d, 1) for d in c.dims) * _bytes(c) for c in wanted)
        if each * self._count > (most := int(SHARE * machine_memory())):
            raise ExperimentError(
                f"{self._count} members come to a dataset of {each * self._count / 2**30:.3g} GiB, "
                f"and this machine can hold {most / 2**30:.3g}; keep fewer variables, or "
                "`times: last`, or vary less",
                ("keep",),
            )

    def _number_of_times(self) -> int:
        """Along the joined dimension, as far as it is known before."""
        times = self._keep.times
        if times == "last":
            return len({steps for steps, *_ in self._times})
        if isinstance(times, tuple):
            return len(set(times))
        return max(
            between + (steps // every + 2 if at is None else len({0, steps, *at}))
            for steps, at, every, between in self._times
        )


def _bytes(column: Column) -> int:
    return TEXT if column.dtype == "str" else np.dtype(column.dtype).itemsize
