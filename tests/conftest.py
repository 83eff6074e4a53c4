"""Commands, folders and results that several test modules share."""

from __future__ import annotations

import ctypes
import gc
import importlib
import json
import os
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from browser import browser, empty_page, page  # noqa: F401  # fixtures
from hypothesis import settings
from interpreted_kernels import interpreting

import pbdkit
from pbdkit.cli import main
from pbdkit.scene.scene import Scene, build_scene

# The same random scenes in every run that decides about landing; elsewhere new ones each time. No
# deadline: what an example takes depends on what else the processors do.
# `pytest --hypothesis-profile long` draws fifty times as many.
settings.register_profile("anywhere", max_examples=40, deadline=None)
settings.register_profile("landing", max_examples=40, derandomize=True, deadline=None)
settings.register_profile("long", max_examples=2000, deadline=None)
settings.load_profile("landing" if os.environ.get("CI") else "anywhere")

# A collection of garbage after 700 new objects, the default, takes up to an eighth of the processor
# time where many objects are created and kept, as by the collection of tests and by compiling.
gc.set_threshold(10_000)

# A shell that runs tests in the background has Ctrl-C ignored; processes started here receive it.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_configure(config: pytest.Config) -> None:
    """The environment of every worker, and of every process that a test starts: one folder of
    compiled kernels, kept from run to run, and one thread of linear algebra, as the systems here
    are small and the workers take the processors; and bytecode is kept."""
    if cache := getattr(config, "cache", None):
        os.environ.setdefault("PBDKIT_CACHE_DIR", str(cache.mkdir("kernels")))
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)


def pytest_collection_finish() -> None:
    """Exclude the present objects, which live until the end, from later garbage collection."""
    gc.collect()
    gc.freeze()


Build = Callable[..., Scene]
Refused = Callable[..., str]
Install = Callable[..., None]


class Result(NamedTuple):
    """The result of a call of the program."""

    code: int
    out: str
    err: str


Call = Callable[..., Result]


@pytest.fixture(autouse=True)
def _figures_are_closed() -> Iterator[None]:
    """pyplot keeps its figures, and warns of many."""
    yield
    if pyplot := sys.modules.get("matplotlib.pyplot"):
        pyplot.close("all")


@pytest.fixture(autouse=True, scope="module")
def _memory_is_given_back() -> Iterator[None]:
    """The C library would keep what large bodies took, in every worker."""
    yield
    if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):
        gc.collect()
        gc.freeze()  # What survives a module belongs to libraries and caches.
        trim(0)


@pytest.fixture
def tensile() -> dict[str, Any]:
    """A small tensile experiment: 4 × 3 particles in a frame of one layer, 30 numbers in all."""
    return {
        "version": 1,
        "name": "tensile",
        "lattice": {"type": "square", "a": 1.0},
        "body": {"type": "grid", "columns": 4, "rows": 3},
        "rule": {"type": "barycentre"},
        "leaders": [
            {"select": {"edge": "left"}, "motion": {"type": "hold"}},
            {
                "select": {"edge": "right"},
                "motion": {"type": "velocity", "velocity": [0.1, 0.0], "steps": 3},
                "until": 3,
            },
        ],
        "steps": 10,
    }


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """``install("pbdkit-x", source)`` adds a distribution with a module of that source as its entry
    point.

    It is found in this process and in those that it starts.
    """
    site = tmp_path / "site"
    site.mkdir()
    monkeypatch.setenv("PYTHONPATH", str(site), prepend=os.pathsep)
    monkeypatch.syspath_prepend(site)
    modules = []

    def make(distribution: str, source: str, version: str = "1.0", group: str = "pbdkit") -> None:
        module = distribution.replace("-", "_")
        modules.append(module)
        (site / f"{module}.py").write_text(source)
        info = site / f"{module}-{version}.dist-info"
        info.mkdir()
        metadata = f"Metadata-Version: 2.1\nName: {distribution}\nVersion: {version}\n"
        (info / "METADATA").write_text(metadata)
        (info / "entry_points.txt").write_text(f"[{group}]\n{distribution} = {module}\n")
        importlib.invalidate_caches()

    yield make
    for module in modules:
        sys.modules.pop(module, None)


@pytest.fixture
def interpreted() -> Iterator[None]:
    """Kernels are run by Python itself."""
    with interpreting():
        yield


@pytest.fixture
def compiled_at_length(request: pytest.FixtureRequest) -> None:
    """Kernels are run by Python itself; in the profile `long` they are compiled."""
    if settings().max_examples <= 100:
        request.getfixturevalue("interpreted")


@pytest.fixture
def build(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Build:
    """The scene of an experiment file e.yaml with that text."""
    monkeypatch.chdir(tmp_path)

    def of(text: str | bytes, *settings: str, components: Any = ()) -> Scene:
        Path("e.yaml").write_bytes(text.encode() if isinstance(text, str) else text)
        return build_scene(pbdkit.load("e.yaml", settings=settings, components=components))

    return of


@pytest.fixture
def refused(build: Build) -> Refused:
    """The message of the ExperimentError that the text causes; never long."""

    def message(text: str | bytes, *settings: str, components: Any = ()) -> str:
        with pytest.raises(pbdkit.ExperimentError) as caught:
            build(text, *settings, components=components)
        assert len(str(caught.value)) < 2000
        return str(caught.value)

    return message


@pytest.fixture
def call(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tensile: dict[str, Any],
) -> Call:
    """Call the program in a folder that contains only e.json, the tensile experiment."""
    folder = tmp_path / "work"
    folder.mkdir()
    monkeypatch.chdir(folder)
    Path("e.json").write_text(json.dumps(tensile))

    def of(*arguments: str) -> Result:
        with pytest.raises(SystemExit) as caught:
            main(list(arguments))
        return Result(int(caught.value.code or 0), *capsys.readouterr())

    return of


PROBE = """
import os, signal
from typing import ClassVar, Literal
import pbdkit
seen = []

class Probe(pbdkit.Diagnostic):
    type: Literal["probe"] = "probe"
    every_step: ClassVar[bool] = True

    def variables(self):
        return (pbdkit.plugin.Variable("NAME", DIMS, "zero", "1"),)

    def measure(self, now):
        if now.step == 3:
            BODY
        return (0.0,)

@pbdkit.hookimpl
def pbdkit_components():
    return [Probe]
"""


@pytest.fixture
def probing(install: Install) -> Install:
    """``probing(body)`` installs a diagnostic `probe` that runs that body in step 3."""

    def make(body: str = "pass", dims: str = "()", name: str = "probe") -> None:
        source = PROBE.replace("BODY", body).replace("DIMS", dims).replace("NAME", name)
        install("pbdkit-probe", source)

    return make
