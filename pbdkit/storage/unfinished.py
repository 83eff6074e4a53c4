"""An unfinished run beside its output: what was committed of it, in a store and one more file."""

from __future__ import annotations

import io
import os
from collections.abc import Iterable, Mapping
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.errors import StorageError
from pbdkit.storage.file_system import opened_alone, sync_folder
from pbdkit.storage.paged_file import PAGE, PagedFile
from pbdkit.storage.records_header import SETTLED, Header, read_header, write_header
from pbdkit.storage.run_files import (
    being_written,
    damaged,
    records_of,
    remove_store,
    remove_unfinished,
    store_of,
)
from pbdkit.storage.run_store import (
    FORMAT,
    Piece,
    RunStore,
    StoredArray,
    json_piece,
    keys_of,
    parts_of,
)
from pbdkit.storage.seal import Extent
from pbdkit.storage.standing import Arrays, Standing

EXTENT = np.dtype([("start", "<u8"), ("stop", "<u8"), ("digest", "<u8")])
LARGEST_ARRAY = 2**40
PAGES, EXTENTS, ARRAYS = "page/", "extents/", "array/"
"""How the keys of pieces begin."""


class UnfinishedRun:
    """The store of a run, and the records it names.

    Who writes it holds a lock on the records. A commit holds where the run stands and the file of
    the result as far as it is: its pages, the extents of the records, and the entries that wait for
    a chunk to be full. Raises StorageError.
    """

    def __init__(self, output: Path, disk: io.FileIO, store: RunStore) -> None:
        self.output, self.disk, self._store = output, disk, store
        self._arrays: set[str] = set()
        self.records = records_of(output)
        self.kept = False
        """Whether anything was committed."""

    @classmethod
    def begin(cls, output: Path, temporary: Path, disk: io.FileIO) -> UnfinishedRun:
        """Makes a store beside the output; the temporary file, open as `disk`, becomes its
        records."""
        store, records = store_of(output), records_of(output)
        taken = StorageError(f"{output}: another run began to write it meanwhile")
        try:
            os.link(temporary, records)
        except FileExistsError:
            raise taken from None
        except OSError:  # no hard links on this file system
            if records.exists():
                raise taken from None
            temporary.rename(records)
        else:
            temporary.unlink()
        if store.exists():  # one that is just being finished
            records.unlink()
            raise taken
        try:
            return cls(output, disk, RunStore(store, mode="rwc"))
        except BaseException:
            remove_unfinished(output)
            raise

    @classmethod
    def open(cls, output: Path, *, writing: bool, anyway: bool = False) -> UnfinishedRun:
        """The one that is there; commits may be lost where it is opened `anyway`. Nothing on the
        disk changes where it is damaged. Raises ExperimentError where another process writes it."""
        store, records = store_of(output), records_of(output)
        try:
            disk = opened_alone(records) if writing else io.FileIO(records, "rb")
        except OSError as error:
            raise StorageError(f"{records}: cannot be read: {error.strerror}") from None
        if disk is None:
            raise being_written(output)
        try:
            header = read_header(disk)
            opened = cls(output, disk, RunStore(store))
            try:
                opened._refuse_newer()
                opened._refuse_other(header, anyway)
                if writing:
                    opened._store.check()
            except BaseException:
                opened.release()
                raise
            if writing:
                opened.release()
                opened._store = RunStore(store, mode="rw")
        except BaseException:
            disk.close()
            raise
        opened.kept = True
        return opened

    def keep(
        self,
        standing: Standing,
        file: PagedFile,
        waiting: Mapping[str, list[NDArray[Any]]],
        written: Mapping[str, int],
    ) -> None:
        """Commits where the run stands, and its file, whose pages hold all but what waits."""
        batches = {f"waiting.{n}": np.stack(v) for n, v in waiting.items() if v}
        arrays = batches | standing.arrays
        kinds = {n: [a.dtype.str, list(a.shape)] for n, a in arrays.items()}
        facts = standing.facts | {"arrays": kinds, "written": dict(written)}
        keys = {key for n, a in arrays.items() for key in keys_of(ARRAYS + n, a)}
        gone, self._arrays = self._arrays - keys, keys
        said = [("about", json_piece(standing.about | {"format": FORMAT}))]
        parts = (parts_of(ARRAYS + n, a) for n, a in arrays.items())
        self._commit(file, chain(said, *parts, [("facts", json_piece(facts))]), gone)

    def conclude(self, file: PagedFile, status: str) -> None:
        """Commits the file of a finished run, whose pages hold all of it."""
        self._commit(file, [("facts", json_piece({"finished": status}))], set())

    def _commit(self, file: PagedFile, pieces: Iterable[Piece], gone: set[str]) -> None:
        self._note_commits()
        file.sync()
        numbers = file.changed if self.kept else file.pages
        pages = [(f"{PAGES}{n}", bytes(file.pages[n])) for n in numbers]
        added = file.added if self.kept else file.extents
        extents = [(f"{EXTENTS}{len(file.extents)}", np.array(added, EXTENT).tobytes())]
        layout = {"size": file.size, "pages": len(file.pages), "extents": len(file.extents)}
        described = [*pages, *(extents if added else []), ("file", json_piece(layout))]
        self._store.commit(chain(pieces, described), gone)
        self._note_commits()
        file.commit()
        if not self.kept:
            sync_folder(self.output.absolute().parent)
        self.kept = True

    @property
    def about(self) -> dict[str, Any]:
        """What was asked for, and by which versions."""
        return self._dict("about")

    @property
    def facts(self) -> dict[str, Any]:
        """Where it stood, without the arrays."""
        return self._dict("facts")

    def standing(self, *, on_disk: bool = False) -> Standing:
        """Where it stood at the last commit; its arrays are those of the run, which stay `on_disk`
        on request, and those that wait, ``waiting.NAME``."""
        facts, arrays = self.facts, Arrays()
        try:
            for name, (dtype, shape) in facts["arrays"].items():
                kind = np.dtype(dtype)
                if kind.kind not in "fiub" or np.prod(shape, dtype=float) > LARGEST_ARRAY:
                    raise ValueError(dtype)
                stored = StoredArray(self._store, ARRAYS + name, kind, tuple(shape))
                waits = not on_disk or name.startswith("waiting.")
                arrays[name] = np.asarray(stored) if waits else stored
        except (KeyError, TypeError, ValueError, MemoryError) as error:
            raise StorageError(f"{self._store.path}: is damaged: {error}") from None
        self._arrays = {*self._store.keys(ARRAYS)}
        return Standing(self.about, facts, arrays)

    def file(self, *, read_only: bool) -> PagedFile:
        """The file of the result, as it was committed last."""
        layout = self._dict("file")
        pages = {}
        for key in self._store.keys(PAGES):
            pages[int(key.removeprefix(PAGES))] = self._store.piece(key)
        rows = b"".join(self._store.piece(key) for key in self._store.keys(EXTENTS))
        table = np.frombuffer(rows[: len(rows) // EXTENT.itemsize * EXTENT.itemsize], EXTENT)
        extents = [Extent(*row) for row in np.sort(table, order="start").tolist()]
        counts = {"size": layout.get("size"), "pages": len(pages), "extents": len(extents)}
        if layout != counts or any(len(page) != PAGE for page in pages.values()):
            raise StorageError(f"{self._store.path}: is damaged: parts of it are missing")
        end = extents[-1].stop if extents else 0
        if end > os.fstat(self.disk.fileno()).st_size:
            raise StorageError(f"{self.disk.name}: is shorter than it was written")
        return PagedFile(self.disk, layout["size"], pages, extents, read_only=read_only)

    def close(self) -> None:
        """It stays to be gone on with, if anything was committed; else nothing of it does."""
        self._store.close()
        if not self.kept and not self.disk.closed:
            remove_unfinished(self.output)
        self.disk.close()

    def release(self) -> None:
        """Whoever writes is no longer kept waiting; the records can still be read."""
        self._store.close()

    def remove(self) -> None:
        """Once the records have the name of the result: the store goes, and then the lock."""
        self._store.close()
        remove_store(self.output)
        self.disk.close()

    def _dict(self, key: str) -> dict[str, Any]:
        found = self._store.facts(key)
        if not isinstance(found, dict):
            raise StorageError(f"{self._store.path}: is damaged: '{key}' is no map of keys")
        return found

    def _note_commits(self) -> None:
        """In the records: how many the store must have from now on."""
        write_header(self.disk, Header(self._store.identity, self._store.commits))

    def _refuse_other(self, header: Header | None, anyway: bool) -> None:
        """Raises StorageError where the records, which have this header, belong to another run, and
        unless it is opened `anyway`, where they tell of commits that the store does not have."""
        commits, store = self._store.commits, self._store.path
        if header is None or (header is SETTLED and "finished" not in self.facts):
            raise damaged(self.records, "its first bytes are not what was written")
        if header is not SETTLED and header.identity != self._store.identity:
            raise damaged(store, f"it belongs to another run than {self.records}")
        if commits < header.commits and not anyway:
            raise StorageError(
                f"{store}: is damaged: it holds {commits} commits of {header.commits}, and the "
                "last lie in a log that was damaged, cut or removed; nothing was changed; `pbdkit "
                f"resume {self.output}` with --anyway goes on from the last commit that it holds, "
                f"of step {self.facts.get('step')}"
            )

    def _refuse_newer(self) -> None:
        found = self.about.get("format")
        if found != FORMAT:
            raise StorageError(
                f"{self._store.path}: is of format {found}, and this pbdkit reads {FORMAT}; take "
                "the pbdkit that wrote it"
            )
