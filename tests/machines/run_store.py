"""The store of a run, part by part: the database of pieces, and the file that HDF5 writes."""

from __future__ import annotations

import io
import random
from contextlib import suppress
from typing import Any

from hypothesis import strategies as st
from hypothesis.stateful import initialize, precondition, rule
from machines.counted import Counted, contents, damaged, put_back

from pbdkit.errors import StorageError
from pbdkit.io.paged_file import PAGE, Header, PagedFile, write_header
from pbdkit.io.run_store import RunStore
from pbdkit.io.seal import SealedFile

KEYS = st.sampled_from(["facts", "page/0", "page/1", "array/u/0", "array/waiting.pe1/0"])
CONTENTS = st.dictionaries(KEYS, st.integers(0, 2), max_size=4)
CODE = ("pbdkit/io/",)
SEEDS = st.integers(0, 2**20)
LINES = st.integers(1, 120)


def content_of(key: str, version: int) -> bytes:
    """Return a piece. Some are larger than a page of SQLite."""
    return f"{key}:{version}".encode() * (1, 40, 900)[version]


class PiecesMachine(Counted):
    """`RunStore`: pieces by key, in transactions. After a kill, the last commit or the interrupted
    one is there as a whole."""

    store: RunStore | None = None

    @initialize()
    def create(self) -> None:
        self.store = RunStore(self.path, mode="rwc")
        self.commits: list[dict[str, bytes]] = [{}]

    @property
    def path(self) -> Any:
        return self.folder / "out.nc.run"

    def drop(self) -> None:
        """Close the store that a killed process had; its folder is no longer used."""
        if self.store:
            self.store.close()
            self.store = None

    def teardown(self) -> None:
        self.drop()
        super().teardown()

    def put(self, pieces: dict[str, int], obsolete: set[str]) -> None:
        assert self.store
        new = [(key, content_of(key, version)) for key, version in pieces.items()]
        self.store.commit(new, obsolete)

    def after(self, pieces: dict[str, int], obsolete: set[str]) -> dict[str, bytes]:
        kept = {key: data for key, data in self.commits[-1].items() if key not in obsolete}
        return kept | {key: content_of(key, version) for key, version in pieces.items()}

    @precondition(lambda self: self.store)
    @rule(pieces=CONTENTS, obsolete=st.sets(KEYS, max_size=3))
    def commit(self, pieces: dict[str, int], obsolete: set[str]) -> None:
        self.put(pieces, obsolete)
        self.commits.append(self.after(pieces, obsolete))

    @precondition(lambda self: self.store)
    @rule(pieces=CONTENTS, obsolete=st.sets(KEYS, max_size=3), line=LINES)
    def commit_and_be_killed(self, pieces: dict[str, int], obsolete: set[str], line: int) -> None:
        reached = self.killed(line, CODE, lambda: self.put(pieces, obsolete))
        new = self.after(pieces, obsolete)
        if not reached:
            self.commits.append(new)
            return
        self.drop()
        with RunStore(self.path) as store:
            assert store.commits in (len(self.commits) - 1, len(self.commits))
            if store.commits == len(self.commits):
                self.commits.append(new)

    @precondition(lambda self: self.store)
    @rule(pieces=CONTENTS, obsolete=st.sets(KEYS, max_size=3))
    def fail_in_a_commit(self, pieces: dict[str, int], obsolete: set[str]) -> None:
        def failing() -> Any:
            yield from ((key, content_of(key, version)) for key, version in pieces.items())
            raise MemoryError

        assert self.store
        with suppress(MemoryError):
            self.store.commit(failing(), obsolete)

    @precondition(lambda self: self.store)
    @rule()
    def be_killed(self) -> None:
        self.move_to_copy()
        self.drop()

    @precondition(lambda self: self.store)
    @rule()
    def close(self) -> None:
        self.drop()

    @precondition(lambda self: not self.store)
    @rule()
    def open_again(self) -> None:
        self.store = RunStore(self.path, mode="rw")

    @precondition(lambda self: self.store)
    @rule(key=KEYS)
    def read_one(self, key: str) -> None:
        assert self.store
        try:
            assert self.store.piece(key) == self.commits[-1][key]
        except StorageError:
            assert key not in self.commits[-1]

    @rule()
    def read_beside(self) -> None:
        with RunStore(self.path) as store:
            assert store.commits == len(self.commits) - 1
            assert everything(store) == self.commits[-1]
            store.check()

    @precondition(lambda self: not self.store)
    @rule(seed=SEEDS)
    def read_after_damage(self, seed: int) -> None:
        before = contents(self.folder)
        if not damaged(self.folder, "out.nc.run*", seed):
            return
        files = contents(self.folder)
        with suppress(StorageError), RunStore(self.path) as store:
            assert everything(store) == self.commits[store.commits]
        assert contents(self.folder) == files
        put_back(self.folder, before)


def everything(store: RunStore) -> dict[str, bytes]:
    """Return all pieces of a store, except its identity."""
    return {key: store.piece(key) for key in store.keys("") if key != "identity"}


PLACES = st.integers(512, 6 * PAGE)
LENGTHS = st.one_of(st.integers(1, 200), st.integers(1, 3 * PAGE))


class PagedFileMachine(Counted):
    """`PagedFile` beside a bytearray. Reopened from the pages, extents and size of a commit, it has
    the bytes of this commit, and finalized, those that were written last."""

    @initialize()
    def create(self) -> None:
        self.path = self.folder / "out.nc.run-records"
        self.disk = io.FileIO(self.path, "x+b")
        self.file = PagedFile(self.disk)
        self.model, self.number = bytearray(), 0
        self.write(0, bytes(range(256)) * 2, values=False)
        self.commit()

    def teardown(self) -> None:
        self.disk.close()
        super().teardown()

    def write(self, place: int, data: bytes, *, values: bool) -> None:
        self.file.values_bytes = len(data) if values else -1
        self.file.seek(place)
        assert self.file.write(data) == len(data)
        self.file.values_bytes = -1
        self.model.extend(bytes(max(0, place + len(data) - len(self.model))))
        self.model[place : place + len(data)] = data

    @rule(place=PLACES, length=LENGTHS, values=st.booleans(), seed=SEEDS)
    def write_anywhere(self, place: int, length: int, values: bool, seed: int) -> None:
        self.write(place, random.Random(seed).randbytes(length), values=values)

    @rule(gap=st.integers(0, 300), length=LENGTHS, values=st.booleans(), seed=SEEDS)
    def append(self, gap: int, length: int, values: bool, seed: int) -> None:
        data = random.Random(seed).randbytes(length)
        self.write(len(self.model) + gap, data, values=values)

    @rule(longer=st.integers(0, 2 * PAGE))
    def lengthen(self, longer: int) -> None:
        self.model.extend(bytes(longer))
        self.file.truncate(len(self.model))

    @rule(place=st.integers(0, 8 * PAGE), length=LENGTHS)
    def read(self, place: int, length: int) -> None:
        self.file.seek(place)
        assert self.file.read(length) == bytes(self.model[place : place + length])

    @rule()
    def commit(self) -> None:
        self.number += 1
        file = self.file
        numbers = file.changed if self.number > 1 else set(file.pages)
        pages = {n: bytes(file.pages[n]) for n in numbers}
        self.pages = (self.pages if self.number > 1 else {}) | pages
        self.extents = [*(self.extents if self.number > 1 else []), *file.added]
        self.committed = bytes(self.model)
        assert (file.size, len(file.pages)) == (len(self.model), len(self.pages))
        write_header(self.disk, Header(bytes(16), self.number))
        file.commit()

    @rule()
    def be_killed(self) -> None:
        self.disk.close()
        self.disk = io.FileIO(self.path, "r+b")
        self.file = PagedFile(
            self.disk, len(self.committed), self.pages, sorted(self.extents), read_only=False
        )
        self.model = bytearray(self.committed)
        self.file.forget()

    @rule(place=PLACES, length=LENGTHS, seed=SEEDS)
    def overlay(self, place: int, length: int, seed: int) -> None:
        """Writes to a file that is read only remain in memory."""
        before = self.path.read_bytes()
        with io.FileIO(self.path, "rb") as disk:
            file = PagedFile(
                disk, len(self.committed), self.pages, sorted(self.extents), read_only=True
            )
            assert file.read(len(self.committed)) == self.committed
            data, model = random.Random(seed).randbytes(length), bytearray(self.committed)
            place = min(place, len(model))  # A killed process may have left bytes beyond.
            file.seek(place)
            file.write(data)
            model.extend(bytes(max(0, place + length - len(model))))
            model[place : place + length] = data
            file.seek(0)
            assert file.read(len(model) + 1) == bytes(model)
        assert self.path.read_bytes() == before

    @rule()
    def finalize(self) -> None:
        """The result is a copy, so that the machine can continue."""
        result, bytes_on_disk = self.folder / "out.nc", self.path.read_bytes()
        result.write_bytes(bytes_on_disk)
        with io.FileIO(result, "r+b") as disk:
            file = PagedFile(disk, self.file.size, self.file.pages, sorted(self.file.extents))
            file.finalize()
        with SealedFile(result) as sealed:
            assert sealed.seal is not None
            assert sealed.read(2**30) == bytes(self.model)
