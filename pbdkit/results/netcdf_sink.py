"""A sink that makes a netCDF-4 file, which appears whole or not at all, and from the first second
on keeps what is there, so that the run can be gone on with."""

from __future__ import annotations

import errno
import json
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from pbdkit.errors import StorageError, WriteError
from pbdkit.results.layout import Column, Values
from pbdkit.results.netcdf import NetcdfFile
from pbdkit.results.sink import KeepingSink
from pbdkit.storage.destination import Destination
from pbdkit.storage.file_system import FULL, is_full
from pbdkit.storage.paged_file import PagedFile
from pbdkit.storage.run_files import damaged
from pbdkit.storage.seal import is_whole
from pbdkit.storage.standing import Standing
from pbdkit.storage.unfinished import UnfinishedRun

FIRST_S, EVERY_S, SHARE = 1.0, 1.0, 50
"""What is over by then leaves no store; so far apart are commits at least, in seconds and in times
what the last one cost."""
FINAL_STATE = "final_state"
"""The group of the file with what a run needs to be gone on with to more steps."""
WAITING = "waiting."


class NetcdfSink(KeepingSink):
    """Writes beside `path`, first under a temporary name, after a second as the records of an
    unfinished run; `finish` makes it the result. `origin` says of the run where it comes from.

    Raises StorageError where anything cannot be written; what was kept until then stays kept.
    """

    def __init__(
        self,
        path: Path,
        replace: bool = False,
        compression: str = "none",
        *,
        origin: Mapping[str, Any] | None = None,
        first_s: float = FIRST_S,
    ) -> None:
        self._destination = Destination(path, replace=replace)
        self._compress, self._first_s = compression == "zlib", first_s
        self._origin = {"replace": replace, **(origin or {})}
        self._file: NetcdfFile | None = None
        self.unfinished: UnfinishedRun | None = None

    @property
    def written(self) -> Path:
        """Where the result is, once it is finished: beside `path` where that was taken."""
        return self._destination.written

    @property
    def kept(self) -> bool:
        """Whether there is something to go on with."""
        return self.unfinished is not None and self.unfinished.kept

    def begin(self, columns: list[Column], sizes: dict[str, int], planned: dict[str, int]) -> None:
        """Opens the file, so that what cannot be written is known before the first step."""
        path = self._destination.path
        if not path.absolute().parent.is_dir():
            raise StorageError(f"{path}: there is no folder {path.parent}")
        with self._storing():
            disk = self._destination.temporary()
            self._temporary = Path(disk.name)
            self._file = NetcdfFile(PagedFile(disk), columns, compress=self._compress)
            self._file.make(sizes, planned)
        self._next = time.perf_counter() + self._first_s

    def go_on(
        self, unfinished: UnfinishedRun, standing: Standing, columns: list[Column], compression: str
    ) -> None:
        """Takes up an unfinished run instead of beginning."""
        self.unfinished, self._temporary = unfinished, unfinished.records
        file = unfinished.file(read_only=False)
        file.verify()
        with self._storing():
            file.forget()
            self._file = reopened(file, columns, standing, compress=compression == "zlib")
        self._next = time.perf_counter() + EVERY_S

    def conclude(self, unfinished: UnfinishedRun) -> None:
        """Takes up a run that is finished but for its name."""
        self.unfinished, self._temporary = unfinished, unfinished.records
        file, status = unfinished.file(read_only=False), unfinished.facts["finished"]
        with self._storing():
            settled = is_whole(file.disk)
            if settled and not file.is_settled():
                raise damaged(unfinished.records, "it is another result")
            self._complete(file, status, settled=settled)

    def put(self, values: Values) -> None:
        """Into the file, by whole chunks."""
        with self._storing() as file:
            file.put(values)

    def due(self) -> bool:
        """After a second, and then about once a second."""
        return time.perf_counter() >= self._next

    def keep(self, standing: Standing) -> None:
        """One commit: what it returns from outlives the process and the machine."""
        begun = time.perf_counter()
        with self._storing() as file:
            if self.unfinished is None:
                output, disk = self._destination.path.absolute(), file.file.disk
                self.unfinished = UnfinishedRun.begin(output, self._temporary, disk)
                self._temporary = self.unfinished.records
            file.flush()
            about = standing.about | {"origin": self._origin}
            said = Standing(about, standing.facts, standing.arrays)
            self.unfinished.keep(said, file.file, file.waiting, file.written)
        now = time.perf_counter()
        self._next = now + max(EVERY_S, SHARE * (now - begun))

    def suspend(self, standing: Standing) -> None:
        """Keeps it and leaves it."""
        self.keep(standing)
        self.abandon()

    def note_end(self, standing: Standing) -> None:
        """As a group of the file."""
        with self._storing() as file:
            file.add_group(FINAL_STATE, json.dumps(standing.facts), standing.arrays)

    def finish(self, attributes: dict[str, str]) -> None:
        """Completes the file, seals and syncs it, reads it back, and gives it its name; then the
        store goes."""
        with self._storing() as file:
            file.finish(attributes)
            file.file.check()
            if self.unfinished:
                self.unfinished.conclude(file.file, attributes["status"])
            self._complete(file.file, attributes["status"])

    def _complete(self, file: PagedFile, status: str, *, settled: bool = False) -> None:
        """The last steps, from a file that is whole with its pages. Raises OSError."""
        if not settled:
            file.verify()
            file.settle()
        try:
            self._destination.take(self._temporary, status)
        finally:
            if self.unfinished and not self._temporary.exists():
                self.unfinished.remove()
            file.disk.close()

    def abandon(self) -> None:
        """Removes the file; if it was kept, only what came after."""
        if self._file is None:
            return
        self._file.give_up()
        if self.unfinished:
            self.unfinished.close()
        else:
            self._file.file.disk.close()
            with suppress(OSError):
                self._temporary.unlink(missing_ok=True)

    @contextmanager
    def _storing(self) -> Iterator[Any]:
        path = self._destination.path
        try:
            yield self._file
            if self._file:
                self._file.file.check()
        except StorageError:
            self.abandon()
            raise
        except (OSError, RuntimeError, ValueError) as error:
            reason = self._reason(error)
            self.abandon()
            raise WriteError(f"{path}: cannot be written: {reason}") from None

    def _reason(self, error: Exception) -> str:
        """The disk's own, where it has one: the library says little."""
        try:
            if self._file:
                self._file.file.check()
        except OSError as first:
            error = first
        full = is_full(self._destination.path.absolute().parent)
        if full or getattr(error, "errno", None) == errno.ENOSPC:
            return FULL
        return str(getattr(error, "strerror", None) or error)


def reopened(
    file: PagedFile, columns: list[Column], standing: Standing, *, compress: bool
) -> NetcdfFile:
    """The dataset in the file of an unfinished run, with what waited."""
    found = NetcdfFile(file, columns, compress=compress)
    waiting = {
        name.removeprefix(WAITING): list(array)
        for name, array in standing.arrays.items()
        if name.startswith(WAITING)
    }
    written = standing.facts.get("written")
    if not isinstance(written, dict) or not {*waiting} <= {*written} == {*found.waiting}:
        raise StorageError("the store holds another dataset than the experiment makes")
    try:
        found.reopen({n: [np.asarray(v) for v in batch] for n, batch in waiting.items()}, written)
    except StorageError:
        raise
    except Exception as error:  # whatever the libraries below make of it
        raise StorageError(f"the store holds a damaged file: {error}") from None
    return found
