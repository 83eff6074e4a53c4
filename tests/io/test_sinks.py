"""Results are written beside the stepping, in order, and what goes wrong there is not lost."""

import threading
from pathlib import Path

import numpy as np
import pytest

import pbdkit
from pbdkit.io.atomic_file import Destination
from pbdkit.io.netcdf import NetcdfSink
from pbdkit.io.sinks import LARGE_BYTES, MAX_WAITING, KeepingSink, OverlappingSink
from pbdkit.progress import Watch
from pbdkit.scene.scene import build_scene
from pbdkit.simulation import Simulation, record

LARGE = np.zeros(LARGE_BYTES // 8)


class Noting(KeepingSink):
    """Records the values it receives, with the thread; fails at one value."""

    def __init__(self, fails_at=None):
        self.calls, self.threads, self.fails_at = [], set(), fails_at
        self.gate = threading.Event()
        self.gate.set()

    def begin(self, columns, sizes, planned):
        self.calls.append("begin")

    def put(self, values):
        self.gate.wait(10)
        self.threads.add(threading.current_thread())
        self.calls.append(next(iter(values)))
        if self.calls[-1] == self.fails_at:
            raise pbdkit.StorageError("the disk is full")

    def due(self):
        return False

    def keep(self, standing):
        self.calls.append("keep")

    def suspend(self, standing):
        self.calls.append("suspend")

    def keep_final(self, standing):
        self.calls.append("end")

    def finish(self, attributes):
        self.calls.append("finish")

    def abandon(self):
        self.calls.append("abandon")


def test_small_values_are_written_immediately():
    inner = Noting()
    sink = OverlappingSink(inner)
    sink.begin([], {}, {})
    sink.put({"a": np.zeros(3)})
    sink.finish({})
    assert inner.calls == ["begin", "a", "finish"]
    assert inner.threads == {threading.main_thread()}


def test_large_values_are_written_in_order_by_one_thread():
    inner = Noting()
    sink = OverlappingSink(inner)
    sink.begin([], {}, {})
    for name in "abcdefgh":
        sink.put({name: LARGE if name in "adf" else np.zeros(1)})
    sink.finish({})
    assert inner.calls == ["begin", *"abcdefgh", "finish"]
    assert len(inner.threads - {threading.main_thread()}) == 1


def test_final_values_may_be_large():
    """The value has the size of a record in which every bond of a large body broke."""
    inner = Noting()
    sink = OverlappingSink(inner)
    sink.begin([], {}, {})
    sink.put({"a": LARGE})
    sink.keep_final(None)
    sink.put({"b": LARGE})
    sink.finish({})
    assert inner.calls == ["begin", "a", "end", "b", "finish"]


def test_memory_stays_bounded_if_the_disk_is_slow():
    inner = Noting()
    inner.gate.clear()
    sink, done = OverlappingSink(inner), []

    def produce():
        for n in range(10):
            sink.put({str(n): LARGE})
            done.append(n)

    producer = threading.Thread(target=produce)
    producer.start()
    producer.join(0.3)
    assert len(done) <= MAX_WAITING
    inner.gate.set()
    producer.join(10)
    sink.finish({})
    assert inner.calls == [*map(str, range(10)), "finish"]


def test_error_in_the_writer_thread_is_raised():
    inner = Noting(fails_at="b")
    sink = OverlappingSink(inner)

    def produce():
        for name in "abcdefgh":
            sink.put({name: LARGE})
        sink.finish({})

    with pytest.raises(pbdkit.StorageError, match="the disk is full"):
        produce()
    sink.abandon()
    assert inner.calls[-1] == "abandon"
    assert "finish" not in inner.calls


def test_large_run_is_identical_with_overlapped_writing(tmp_path):
    experiment = pbdkit.load(
        "start", settings=["body.columns=300", "body.rows=250", "steps=6", "record.every=2"]
    )
    scene = build_scene(experiment)
    plain, beside = tmp_path / "plain.nc", tmp_path / "beside.nc"
    record(Simulation.of_scene(scene), NetcdfSink(plain))
    record(Simulation.of_scene(scene), OverlappingSink(NetcdfSink(beside)))
    with pbdkit.open(plain) as one, pbdkit.open(beside) as other:
        for name in one.variables:
            np.testing.assert_array_equal(one[name], other[name])
    assert sorted(p.name for p in tmp_path.iterdir()) == ["beside.nc", "plain.nc"]


def test_output_created_by_another_program_is_kept(tmp_path):
    path = tmp_path / "out.nc"
    sink = NetcdfSink(path)
    scene = build_scene(pbdkit.load("paper/b", settings=["steps=3"]))

    def appear():
        path.write_text("somebody else's")
        return False

    with pytest.raises(pbdkit.StorageError, match="was created by another program meanwhile"):
        record(Simulation.of_scene(scene, watch=Watch(appear)), sink)
    assert path.read_text() == "somebody else's"
    (kept,) = (p for p in tmp_path.iterdir() if p != path)
    with pbdkit.open(kept) as ds:
        assert ds.attrs["status"] == "complete"


def test_file_of_another_run_is_no_leftover_without_locks(tmp_path, monkeypatch):
    """The name of its result begins with this one's."""
    monkeypatch.setattr("pbdkit.io.atomic_file.lock", lambda file: True)
    with Destination(tmp_path / "x.nc.2", replace=False).temporary() as live:
        left = Destination(tmp_path / "x.nc", replace=False).temporary()
        left.close()
        with Destination(tmp_path / "x.nc", replace=False).temporary():
            assert Path(live.name).exists()
            assert not Path(left.name).exists()


def test_compression_changes_the_file_but_not_the_values(tmp_path):
    sizes = {}
    for compression in ("none", "zlib"):
        settings = ["body.columns=100", "steps=20", f"record.compression={compression}"]
        experiment = pbdkit.load("start", settings=settings)
        path = tmp_path / f"{compression}.nc"
        sink = NetcdfSink(path, compression=experiment.record.compression)
        record(Simulation.of_scene(build_scene(experiment)), sink)
        sizes[compression] = path.stat().st_size
    assert sizes["zlib"] < 0.3 * sizes["none"]
    with pbdkit.open(tmp_path / "none.nc") as one, pbdkit.open(tmp_path / "zlib.nc") as other:
        np.testing.assert_array_equal(one.position, other.position)


@pytest.mark.parametrize(("columns", "along_time"), [(10, True), (400, False)])
def test_chunks_suit_a_history_and_a_snapshot(tmp_path, columns, along_time):
    settings = [f"body.columns={columns}", f"body.rows={columns}", "steps=30"]
    path = tmp_path / "out.nc"
    record(
        Simulation.of_scene(build_scene(pbdkit.load("start", settings=settings))), NetcdfSink(path)
    )
    with pbdkit.open(path) as ds:
        chunks = ds.position.encoding["chunksizes"]
        assert np.prod(chunks) * 8 <= 1.01 * 2**20
        assert (chunks[0] > 1) == along_time
        assert (chunks[1] == ds.sizes["particle"]) == along_time
