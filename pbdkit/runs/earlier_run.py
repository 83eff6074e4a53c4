"""What an earlier run has left: what it was asked for, what it recorded, and where it stood."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from importlib.metadata import version
from pathlib import Path
from typing import Any

from pbdkit.errors import ExperimentError, PbdkitError, StorageError
from pbdkit.experiment.model import Experiment
from pbdkit.experiment.settings import with_settings
from pbdkit.experiment.shipped import read_experiment
from pbdkit.experiment.source import Source
from pbdkit.registry.retired import refuse_retired
from pbdkit.results.layout import SCHEMA_VERSION, Column, Values, When
from pbdkit.results.netcdf_sink import FINAL_STATE
from pbdkit.storage.pieced_array import PiecedArray
from pbdkit.storage.seal import opened
from pbdkit.storage.standing import Standing
from pbdkit.storage.unfinished import UnfinishedRun

ENDED = ("complete", "settled", "interrupted")
"""The status of results that can be continued."""
BLOCK_BYTES = 2**22
"""Of a result that is continued so much is read at once, or one row if that is more."""


def asked(
    left: UnfinishedRun, output: Path, steps: int | None, anyway: bool
) -> tuple[Source | None, dict[str, Any]]:
    """The experiment of an unfinished run, None where all of it is done, and where it came from."""
    about, origin = left.about, left.about.get("origin")
    if not isinstance(origin, dict):
        raise StorageError("what is noted under 'origin' is damaged")
    if "finished" in left.facts:
        return None, origin
    source = _source(about, f"{output}, unfinished", steps, left.facts.get("step"))
    experiment = Experiment.build(source)
    if steps not in (None, about.get("steps")) and not experiment.solver.makes_steps:
        raise ExperimentError(
            f"{output}: an equilibrium is looked for, and the way there depends on `steps`: resume "
            f"it without --steps, or run it anew with --set steps={steps}"
        )
    if not anyway:
        _refuse_versions(output, about, experiment)
        _refuse_changed_file(output, about, origin)
    return source, origin


def chosen_parameters(facts: Mapping[str, Any]) -> tuple[str, ...]:
    """The parameters of the solver that the run has chosen itself."""
    found = facts.get("chosen", [])
    if not isinstance(found, list) or not {*found} <= {"relaxation", "memory"}:
        raise StorageError("what is noted under 'chosen' is damaged")
    return tuple(found)


def longer(
    dataset: Any, output: Path, steps: int, anyway: bool, kept: ExitStack | None = None
) -> tuple[Source, Standing]:
    """The experiment of a result, of more steps, and where it stands; its arrays stay in the file
    until `kept` is closed, where that is given. Raises ExperimentError where it is to be run anew.
    """
    about = dataset.attrs
    if about.get("status") not in ENDED:
        raise ExperimentError(f"is {about.get('status')}: there is nothing to continue")
    if (made_as := about.get("schema_version")) != SCHEMA_VERSION:
        raise ExperimentError(
            f"is of schema_version {made_as}, and what is recorded now is laid out as "
            f"{SCHEMA_VERSION}; run it anew with --set steps={steps}"
        )
    standing = _final_state(output, kept)
    source = _source(about, str(output), steps, standing.facts.get("step"))
    experiment = Experiment.build(source)
    if not experiment.solver.makes_steps:
        raise ExperimentError(
            "is an equilibrium, which is found and not continued; run it anew with "
            f"--set steps={steps}"
        )
    if not anyway:
        made = {"pbdkit": about.get("pbdkit_version"), "plugins": _map(about, "plugins")}
        _refuse_versions(output, made, experiment)
    return source, standing


def history(
    dataset: Any, columns: list[Column], experiment: Experiment, *, pieced: bool = False
) -> Iterator[Values]:
    """What was recorded and would be by the longer run, entry by entry; large ones `pieced` on
    request."""
    for column in columns:
        if column.when is When.START:
            yield {column.name: _entry(dataset[column.name], pieced)}
    for dim in ("time", "step"):
        along = [column.name for column in columns if column.grows and column.dims[0] == dim]
        steps = dataset[dim].values.tolist() if along else []
        for step, values in zip(steps, _rows(dataset, along, dim, pieced), strict=False):
            if dim == "step" or experiment.records(step):
                yield values


def _rows(dataset: Any, names: list[str], dim: str, pieced: bool) -> Iterator[Values]:
    """Row by row along a dimension. They are read in blocks: to read anything takes far longer than
    to read one row of a small body."""
    count = dataset.sizes.get(dim, 0)
    size = sum(dataset[name].nbytes for name in names)
    block = max(1, BLOCK_BYTES * count // max(1, size))
    for start in range(0, count, block):
        if pieced and block == 1:
            yield {name: _entry(dataset[name][start], pieced) for name in names}
            continue
        read = {name: dataset[name][start : start + block].values for name in names}
        for n in range(min(block, count - start)):
            yield {name: values[n] for name, values in read.items()}


def _entry(variable: Any, pieced: bool) -> Any:
    """All that a variable holds."""
    if not pieced or variable.dtype.kind not in "fiub" or variable.nbytes <= BLOCK_BYTES:
        return variable.values
    count, some = len(variable), max(1, BLOCK_BYTES * len(variable) // variable.nbytes)
    pieces = (variable[at : at + some].values for at in range(0, count, some))
    return PiecedArray(variable.shape, variable.dtype, pieces)


def _final_state(output: Path, kept: ExitStack | None) -> Standing:
    content = opened(output)
    with ExitStack() as closing:
        closing.callback(content.close)
        try:
            group = content.groups[FINAL_STATE]
            facts, arrays = json.loads(group.attrs["facts"]), dict(group.variables)
        except KeyError:
            raise StorageError("holds no final state: an older pbdkit made it") from None
        if kept is None:
            arrays = {name: variable[...] for name, variable in arrays.items()}
        else:
            kept.push(closing.pop_all())
        return Standing({}, facts, arrays)


def _source(about: Mapping[str, Any], name: str, steps: int | None, done: Any) -> Source:
    parts = _map(about, "experiment")
    refuse_retired(parts, f"{name}: going on")
    if steps is not None:
        if isinstance(done, int) and steps <= done:
            raise ExperimentError(f"{name}: {done} steps are done; --steps takes a larger number")
        parts["steps"] = steps
    return Source(name, parts)


def _map(about: Mapping[str, Any], key: str) -> dict[str, Any]:
    """What is noted there as JSON."""
    try:
        found = json.loads(about.get(key, ""))
    except (ValueError, TypeError, RecursionError):
        found = None
    if not isinstance(found, dict):
        raise StorageError(f"what is noted under '{key}' is damaged")
    return found


def _refuse_versions(output: Path, made: Mapping[str, Any], experiment: Experiment) -> None:
    here = experiment.distributions() | {"pbdkit": version("pbdkit")}
    before = {**made.get("plugins", {}), "pbdkit": made.get("pbdkit")}
    for name, now in here.items():
        if before.get(name) != now:
            raise ExperimentError(
                f"{output}: was begun with {name} {before.get(name)}, and {now} is installed: the "
                "steps to come may differ; --anyway goes on with it"
            )


def _refuse_changed_file(output: Path, about: Mapping[str, Any], origin: Any) -> None:
    """Where the run came from a file that says something else now."""
    file, settings = origin.get("experiment"), origin.get("settings", [])
    if not isinstance(file, str) or not Path(file).is_file():
        return
    try:
        source = read_experiment(file, allow_outside=True)  # only compared
        source = with_settings(source, settings, Experiment.defaults())
        now = json.loads(Experiment.build(source).model_dump_json(by_alias=True))
    except PbdkitError:
        now = None
    begun = _map(about, "experiment")
    if now is not None:  # what the run has chosen itself is no change
        chosen = begun.get("solver", {})
        now["solver"] = {k: chosen.get(k) if v == "auto" else v for k, v in now["solver"].items()}
    if now != begun:
        raise ExperimentError(
            f"{output}: {file} has changed since the run began, which goes on as it was then; "
            "--anyway does so"
        )
