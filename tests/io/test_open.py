"""Damaged or crafted result files are refused with one line; nothing hangs."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import pytest
from scene_strategies import in_turn

import pbdkit
from pbdkit.io.open import reading
from pbdkit.untrusted_files import try_reading

Call = Callable[..., Any]
TORN = ["--set=leaders.1.motion.velocity=[1.2, 0.0]", "--set=steps=12"]


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of a run in which bonds broke."""
    from pbdkit.cli import main

    path = tmp_path_factory.mktemp("sound") / "sound.nc"
    with pytest.raises(SystemExit):
        main(["run", "paper/d1", "-o", str(path), "--quiet", *TORN])
    return path


@pytest.fixture
def read_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read a file in a separate process for the first command only: what comes of it depends on the
    bytes of the file alone."""
    outcomes: dict[bytes, pbdkit.StorageError | None] = {}

    def trying(path: Path) -> None:
        content = path.read_bytes()
        if content not in outcomes:
            try:
                outcomes[content] = try_reading(path)
            except pbdkit.StorageError as error:
                outcomes[content] = error
        if outcomes[content]:
            raise outcomes[content]

    monkeypatch.setattr("pbdkit.io.open.try_reading", trying)


def attribute(name: str, value: Any) -> Callable[[Any], None]:
    return lambda file: file.setncattr(name, value)


def value(name: str, at: Any, new: Any) -> Callable[[Any], None]:
    def change(file: Any) -> None:
        file[name][at] = new

    return change


def rename(name: str) -> Callable[[Any], None]:
    return lambda file: file.renameVariable(name, f"{name}_gone")


CRAFTED: dict[str, Callable[[Any], None]] = {
    "no position": rename("position"),
    "no reference": rename("reference"),
    "no kind": rename("kind"),
    "no time": rename("time"),
    "no roles": rename("role"),
    "no indices": rename("i"),
    "no bonds": rename("bond"),
    "positions not finite": value("position", (slice(None), 40), np.nan),
    "a reference not finite": value("reference", 3, np.inf),
    "bonds of nobody": value("bond_ends", 5, [10**6, -7]),
    "kinds unknown": value("kind", slice(None), 77),
    "no JSON": attribute("experiment", "{"),
    "JSON of another kind": attribute("experiment", "[1, 2]"),
    "nested JSON": attribute("experiment", "[" * 100_000),
    "a number for JSON": attribute("experiment", 3.0),
    "another experiment": attribute("experiment", '{"name": "x"}'),
    "plugins no JSON": attribute("plugins", "{"),
    "an odd version": attribute("schema_version", "one"),
    "a formula for a title": attribute("title", r"$\frac{$"),
    "a number for a title": attribute("title", 3.0),
    "a title of a megabyte": attribute("title", "x " * 2**19),
}


REFUSED = ["no position", "positions not finite", "bonds of nobody", "no JSON", "nested JSON"]
"""Files that `pbdkit explain` refuses."""


@pytest.mark.usefixtures("read_once")
@pytest.mark.parametrize("name", in_turn(CRAFTED, 3))
def test_crafted_file_is_plotted_or_refused_in_one_line(name: str, sound: Path, call: Call) -> None:
    shutil.copy(sound, "crafted.nc")
    with netCDF4.Dataset("crafted.nc", "a") as file:
        CRAFTED[name](file)
    for arguments in (["explain"], ["plot", "--color", "pe1"], ["report", "--force"]):
        result = call(arguments[0], "crafted.nc", *arguments[1:])
        refused = name in REFUSED and arguments == ["explain"]
        assert result.code in ((2, 6) if refused else (0, 2, 6)), result.err
        assert len(result.err) < 1000
        warning, *fault = result.err.splitlines()
        assert warning.startswith("warning: crafted.nc: has no seal")
        assert len(fault) == bool(result.code)
        for line in fault:
            assert line.startswith("pbdkit: ")
            assert "crafted.nc" in line


@pytest.mark.usefixtures("read_once")
@pytest.mark.parametrize("seed", in_turn(range(12), 2))
def test_file_with_overwritten_bytes_is_read_or_refused(seed: int, sound: Path, call: Call) -> None:
    random, damaged = np.random.default_rng(seed), bytearray(sound.read_bytes())
    begin = int(random.integers(len(damaged)))
    damaged[begin : begin + 400] = random.bytes(min(400, len(damaged) - begin))
    Path("damaged.nc").write_bytes(damaged)
    for command in ("explain", "plot"):
        result = call(command, "damaged.nc")
        assert result.code in (0, 2, 3, 6), result.err
        assert "a bug in pbdkit" not in result.err
        assert ("damaged.nc" in result.err) == bool(result.code)


def test_truncated_file_is_refused(sound: Path, call: Call) -> None:
    whole = sound.read_bytes()
    for length in (0, 10, 1000, len(whole) // 2, len(whole) - 1000):
        Path("cut.nc").write_bytes(whole[:length])
        refused = call("explain", "cut.nc")
        assert (refused.code, refused.err.startswith("pbdkit: cut.nc: ")) == (6, True)


def test_file_without_the_end_of_its_seal_gives_a_warning(sound: Path, call: Call) -> None:
    Path("cut.nc").write_bytes(sound.read_bytes()[:-10])
    result = call("explain", "cut.nc")
    assert (result.code, result.out) == (0, call("explain", str(sound)).out)
    assert result.err.startswith("warning: cut.nc: has no seal")


def test_failing_disk_is_not_damage(tmp_path: Path) -> None:
    path = tmp_path / "out.nc"
    pbdkit.run("paper/a", settings={"steps": 2}, output=path, progress=False)

    message = r"out.nc: cannot be read: Input/output error"
    with pytest.raises(pbdkit.StorageError, match=message), reading(path):
        raise OSError(errno.EIO, os.strerror(errno.EIO))
