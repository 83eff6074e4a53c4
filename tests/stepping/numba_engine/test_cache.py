"""Kernels that are kept: what lies damaged or is not ours alone is never run, and never a fault of
the rule."""

import json
import os
import shutil
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Literal

import numpy as np
import pytest

import pbdkit
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.engine_choice import choose, make_engine
from pbdkit.stepping.numba_engine import cache as kernel_cache
from pbdkit.stepping.numba_engine.engine import CompiledStepper

SHEET = {
    "name": "sheet",
    "lattice": {"type": "square", "a": 1.0},
    "body": {"type": "grid", "columns": 5, "rows": 5},
    "rule": {"type": "mean-displacement"},
    "initial": {"type": "noise", "amplitude": 0.1},
    "steps": 10,
}


@pytest.fixture(scope="module")
def kernel(tmp_path_factory):
    """A cache folder that holds a kernel."""
    folder = tmp_path_factory.mktemp("kernel") / "cache"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PBDKIT_CACHE_DIR", str(folder))
        assert kernel_is_right()
    return folder


@pytest.fixture
def cached_kernel(cache, kernel):
    """The cache folder of a test, with a kernel that another process left there."""
    shutil.copytree(kernel, cache)
    cache.chmod(kernel.stat().st_mode)
    return cache


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """A cache folder of its own, as a new process meets it."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("PBDKIT_CACHE_DIR", str(folder))
    monkeypatch.setattr(kernel_cache, "_loaded", {})
    return folder


SOURCE = """
@njit(cache=CACHED)
def run(out):
    out[0] = apply(Vector(3.0, 4.0)).x
"""


def halved(total):
    return 0.5 * total


def kernel_is_right():
    """Return whether a kernel that this process has not loaded yet has the result of Python."""
    kernel_cache._loaded.clear()
    out = np.empty(1)
    kernel_cache.load_kernel(SOURCE, {"apply": halved}, (out,))(out)
    return out[0] == halved(3.0)


def cached_files(folder):
    """Every file that is kept, by what it is."""
    (kernel,) = folder.iterdir()
    files = [file for file in kernel.rglob("*") if file.is_file()]
    return {file.suffix: file for file in files}


def test_damaged_files_are_rebuilt(cached_kernel):
    cache = cached_kernel
    assert kernel_is_right()
    assert set(cached_files(cache)) == {".py", ".json", ".nbi", ".nbc"}
    for suffix in (".py", ".json", ".nbi", ".nbc"):
        file = cached_files(cache)[suffix]
        whole = file.read_bytes()
        flipped = whole[: len(whole) // 2] + bytes([whole[len(whole) // 2] ^ 4])
        file.write_bytes(flipped + whole[len(flipped) :] if suffix == ".nbc" else whole[:100])
        assert kernel_is_right()
        assert kernel_cache._is_whole(file.parents[1] if suffix[1] == "n" else file.parent)
    assert len(list(cache.iterdir())) == 1


def test_complete_kernel_is_read_and_not_rebuilt(cached_kernel, monkeypatch):
    cache = cached_kernel
    assert kernel_is_right()
    before = {file: file.stat().st_mtime_ns for file in cached_files(cache).values()}
    monkeypatch.setattr(kernel_cache, "_digests", counted := Counted(kernel_cache._digests))
    assert kernel_is_right()
    assert counted.calls == 1
    assert before == {file: file.stat().st_mtime_ns for file in cached_files(cache).values()}


class Counted:
    def __init__(self, function):
        self.function, self.calls = function, 0

    def __call__(self, *arguments):
        self.calls += 1
        return self.function(*arguments)


def test_full_disk_is_not_blamed_on_the_rule_and_leaves_nothing(cache, monkeypatch, tmp_path):
    def full(*arguments, **words):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("numba.core.caching.IndexDataCacheFile.save", full)
    (temporary := tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))  # not that of other processes
    assert kernel_is_right()
    assert list(cache.iterdir()) == []
    assert list(temporary.glob("pbdkit*")) == []


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="modes are of POSIX systems")
def test_directory_writable_by_others_is_not_used(cached_kernel):
    cache = cached_kernel
    cached_files(cache)[".py"].write_text("raise SystemExit('planted')")
    cache.chmod(0o777)
    assert kernel_cache.cache_folder() is None
    before = cached_files(cache)[".json"].read_bytes()
    assert kernel_is_right()
    assert cached_files(cache)[".json"].read_bytes() == before


def test_without_a_directory_kernels_are_compiled_in_memory(cache):
    cache.write_text("a file")
    assert kernel_cache.cache_folder() is None
    assert kernel_is_right()
    assert cache.read_text() == "a file"


class Odd(pbdkit.FractureModel):
    type: Literal["odd"] = "odd"

    def constants(self, slot):
        return {}

    @staticmethod
    def breaks(d, r, c, p):
        return np.asarray(d.x).astype(str) == "never"

    @staticmethod
    def fictitious(u, r, p):
        return 0.0 * r


class Raises(pbdkit.FollowerRule):
    type: Literal["raises"] = "raises"

    @staticmethod
    def gather(d, r, w, p):
        raise OverflowError("too much")

    @staticmethod
    def apply(total, here, p):
        return total[0]


def test_a_fracture_model_that_does_not_compile_is_named(cache, monkeypatch):
    monkeypatch.setattr("pbdkit.stepping.engine_choice.PATIENCE_S", 0.0)
    scene = build_scene(pbdkit.Experiment(**SHEET | {"fracture": Odd()}))
    engine, made = make_engine(scene, choose(scene))
    assert engine.name == "numpy"
    assert "FractureModel 'odd' failed to compile" in made.reason


@pytest.mark.parametrize("initial", ["reference", "noise"])
def test_exception_during_compilation_is_an_error_of_the_rule(initial):
    start = {"type": initial} | ({"amplitude": 0.1} if initial == "noise" else {})
    scene = build_scene(pbdkit.Experiment(**SHEET | {"rule": Raises(), "initial": start}))
    with pytest.raises(pbdkit.PluginError, match=r"FollowerRule 'raises' failed .*too much"):
        CompiledStepper(scene)


def test_concurrent_requests_compile_a_kernel_once(cache, monkeypatch):
    made = []

    def make(source, folder, names, arguments):
        made.append(folder)
        time.sleep(0.2)
        folder.mkdir()
        (folder / kernel_cache.SOURCE).write_text(source)
        digests = json.dumps(kernel_cache._digests(folder))
        (folder / kernel_cache.DIGESTS).write_text(digests)
        return "kernel"

    monkeypatch.setattr(kernel_cache, "_made", make)
    monkeypatch.setattr(kernel_cache, "_prepared", lambda *given: "kernel")
    with ThreadPoolExecutor(4) as several:  # each opens the lock by itself, as processes do
        found = [
            several.submit(kernel_cache._cached_kernel, "x = 1", "key", {}, ()) for _ in range(4)
        ]
    assert [future.result() for future in found] == ["kernel"] * 4
    assert len(made) == 1
    assert [path.name for path in cache.iterdir()] == ["kernel_key"]
