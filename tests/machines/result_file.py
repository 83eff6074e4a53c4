"""A result on the disk: written, damaged, verified, read, explained and combined."""

from __future__ import annotations

import random
import tempfile
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st
from hypothesis.stateful import initialize, precondition, rule
from machines.counted import Counted, contents
from machines.run import EXPERIMENTS

import pbdkit
from pbdkit.cli.verify import _fault_of
from pbdkit.errors import ExperimentError, PbdkitError, StorageError
from pbdkit.io.explain import BondRecords
from pbdkit.io.layout import experiment_of
from pbdkit.io.netcdf import NetcdfSink
from pbdkit.io.save import save
from pbdkit.io.seal import FOOT, SealedFile, open_sealed
from pbdkit.scene.scene import build_scene
from pbdkit.simulation import Simulation, record

NAMES = ("a.nc", "b.nc", "c.nc")
OFTEN = st.integers(0, 9)
"""An intact file is read if this is 0. It takes 20 to 260 ms, and a damaged file less than 1 ms."""
KINDS = [(kind, steps) for kind in sorted(EXPERIMENTS) for steps in (3, 6)]


@cache
def result(number: int) -> tuple[bytes, dict[str, Any]]:
    """Return the bytes and the values of a result that a run writes."""
    kind, steps = KINDS[number]
    scene = build_scene(pbdkit.Experiment(**EXPERIMENTS[kind] | {"steps": steps}))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "out.nc")
        compression = scene.experiment.record.compression
        record(Simulation.of_scene(scene), NetcdfSink(path, False, compression))
        with pbdkit.open(path) as dataset:
            values = {str(name): dataset[name].values for name in dataset.variables}
        return path.read_bytes(), values


class ResultFileMachine(Counted):
    """Result files beside their bytes. A file that differs from what was written is never verified,
    and its values are never read as others than those that were written."""

    @initialize()
    def begin(self) -> None:
        self.numbers: dict[str, int] = {}
        """Content of each file: the number of the result that was written."""

    def is_intact(self, name: str) -> bool:
        return (self.folder / name).read_bytes() == result(self.numbers[name])[0]

    def is_sealed(self, name: str) -> bool:
        """Return whether the file still ends like a result; others are read in a process of their
        own, which takes a third of a second."""
        return (self.folder / name).read_bytes()[-16:] == result(0)[0][-16:]

    def is_due(self, name: str, often: int) -> bool:
        """Return whether a file is read."""
        return not often or not self.is_intact(name)

    @rule(name=st.sampled_from(NAMES), number=st.integers(0, len(KINDS) - 1))
    def write(self, name: str, number: int) -> None:
        (self.folder / name).write_bytes(result(number)[0])
        self.numbers[name] = number

    @precondition(lambda self: self.numbers)
    @rule(name=st.sampled_from(NAMES), seed=st.integers(0, 2**20))
    def damage(self, name: str, seed: int) -> None:
        if name not in self.numbers:
            return
        draw, path = random.Random(seed), self.folder / name
        data = bytearray(path.read_bytes())
        if len(data) < FOOT.size:
            return
        how = draw.choice(["flip", "flip", "flip", "zero", "swap", "cut", "append", "foot"])
        start = draw.randrange(len(data))
        length = min(draw.choice([1, 8, 512, 4096]), len(data) - start)
        if how == "flip":
            data[start] ^= 1 << draw.randrange(8)
        elif how == "zero":
            data[start : start + length] = bytes(length)
        elif how == "swap":
            other = result(draw.randrange(len(KINDS)))[0]
            data[start : start + length] = other[start : start + length].ljust(length, b"\0")
        elif how == "foot":
            data[-1 - draw.randrange(48 + 24)] ^= 1 << draw.randrange(8)
        elif how == "cut":  # The end of the file is cut, or a piece within it.
            end = start + length if draw.random() < 0.7 else len(data)
            del data[start:end]
        else:
            place = len(data) if draw.random() < 0.3 else start
            data[place:place] = draw.randbytes(length)
        path.write_bytes(data)

    @precondition(lambda self: self.numbers)
    @rule(name=st.sampled_from(NAMES))
    def restore(self, name: str) -> None:
        if name in self.numbers:
            (self.folder / name).write_bytes(result(self.numbers[name])[0])

    @precondition(lambda self: self.numbers)
    @rule(name=st.sampled_from(NAMES), often=OFTEN)
    def verify(self, name: str, often: int) -> None:
        if name not in self.numbers or not self.is_due(name, often):
            return
        if not self.is_sealed(name):
            with SealedFile(self.folder / name) as content:
                assert content.seal is None
            return
        before = contents(self.folder)
        fault = _fault_of(self.folder / name)
        assert bool(fault) != self.is_intact(name), fault
        assert name in fault or not fault
        assert contents(self.folder) == before

    @precondition(lambda self: self.numbers)
    @rule(name=st.sampled_from(NAMES), often=OFTEN, seed=st.integers(0, 2**20))
    def read_some(self, name: str, often: int, seed: int) -> None:
        """Part of a variable, which verifies this part only."""
        if name not in self.numbers or not self.is_due(name, often) or not self.is_sealed(name):
            return
        values = result(self.numbers[name])[1]
        variable = random.Random(seed).choice(sorted(values))
        try:
            with open_sealed(self.folder / name) as content:
                present = np.asarray(content[variable][...])
        except (StorageError, OSError):
            assert not self.is_intact(name)
            return
        right = values[variable]
        if right.dtype.kind in "OUT":
            assert present.tolist() == right.tolist(), variable
        else:
            assert present.astype(right.dtype).tobytes() == right.tobytes(), variable

    @precondition(lambda self: self.numbers)
    @rule(name=st.sampled_from(NAMES), often=OFTEN)
    def read_all(self, name: str, often: int) -> None:
        if name not in self.numbers or not self.is_due(name, often) or not self.is_sealed(name):
            return
        try:
            with pbdkit.open(self.folder / name) as dataset:
                for variable, right in result(self.numbers[name])[1].items():
                    np.testing.assert_array_equal(dataset[variable].values, right)
        except (StorageError, OSError):
            assert not self.is_intact(name)

    @precondition(lambda self: len(self.numbers) > 1)
    @rule(name=st.sampled_from(NAMES), other=st.sampled_from(NAMES), often=OFTEN)
    def explain_and_combine(self, name: str, other: str, often: int) -> None:
        """Read the bonds of a run, and combine two runs, if the files are intact."""
        if often or not {name, other} <= {*self.numbers} or name == other:
            return
        if not (self.is_intact(name) and self.is_intact(other)):
            return
        one, two = (pbdkit.open(self.folder / n) for n in (name, other))
        with one, two:
            right = [result(self.numbers[n])[1] for n in (name, other)]
            with suppress(ExperimentError):
                records = BondRecords(one, build_scene(experiment_of(one)))
                broken = right[0].get("broken_step", np.array(-1)) >= 0
                assert len(records.order) == broken.sum()
            whole = pbdkit.concat([one, two])
            for place, values in enumerate(right):
                steps = len(values["time"])
                present = whole["position"].isel(run=place, time=slice(steps)).values
                assert present.tobytes() == values["position"].tobytes()

    @precondition(lambda self: self.numbers)
    @rule(name=st.sampled_from(NAMES), force=st.booleans(), often=OFTEN)
    def save_again(self, name: str, force: bool, often: int) -> None:
        """A copy that is written from a dataset has its values; it replaces a file on request."""
        if often or name not in self.numbers or not self.is_intact(name):
            return
        path = self.folder / "copy.nc"
        existed = path.exists()
        with pbdkit.open(self.folder / name) as dataset:
            try:
                save(dataset, path, force=force)
            except PbdkitError:
                assert existed
                assert not force
                return
        assert force or not existed
        with open_sealed(path) as content:
            right = result(self.numbers[name])[1]["position"]
            assert np.asarray(content["position"][...]).tobytes() == right.tobytes()
