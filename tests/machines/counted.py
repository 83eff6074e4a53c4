"""Base class of the state machines, kills at a line of code, and damage to files."""

from __future__ import annotations

import os
import random
import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import pytest
from hypothesis.stateful import RuleBasedStateMachine, invariant
from reliability.damage import damage

MEMORY = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
"""Folder in memory, where syncing takes no time; None for the default of the system."""


class Counted(RuleBasedStateMachine):
    """State machine that counts its steps and has a folder, which it may move."""

    steps: ClassVar[int] = 0
    is_killed = False
    """True from the line on at which the call of `killed` ends for the machine."""

    def __init__(self) -> None:
        super().__init__()
        self.patch = pytest.MonkeyPatch()
        self.base = Path(tempfile.mkdtemp(prefix="pbdkit-machine-", dir=MEMORY))
        self.folder, self._folders = self.base / "0", 0
        self.folder.mkdir()
        type(self).steps -= 1  # Invariants are checked before the first step, too.

    def teardown(self) -> None:
        self.patch.undo()
        shutil.rmtree(self.base)

    @invariant()
    def count(self) -> None:
        type(self).steps += 1

    def new_folder(self) -> Path:
        """Return the name of a folder that does not exist yet."""
        self._folders += 1
        return self.base / str(self._folders)

    def move_to_copy(self) -> None:
        """Continue in a copy of the folder, which is what a kill leaves of it."""
        old, self.folder = self.folder, self.new_folder()
        shutil.copytree(old, self.folder)

    def killed(self, line: int, parts: tuple[str, ...], call: Callable[[], object]) -> bool:
        """Call a function as if the process were killed at a line of these parts of pbdkit, and
        return whether it came to this line. If so, the machine continues in the folder as the kill
        leaves it; what the function does after this line has no effect."""
        target, self.is_killed = self.new_folder(), False

        def copy() -> None:
            shutil.copytree(self.folder, target)
            self.is_killed = True

        if copied_at(line, parts, copy, call):
            self.folder = target
            return True
        return False


def copied_at(
    line: int, parts: tuple[str, ...], copy: Callable[[], object], call: Callable[[], object]
) -> bool:
    """Call a function, and call `copy` when the function comes to its n-th line in files of pbdkit
    with one of the parts in their paths. Return whether it came there."""
    left = [line]

    def trace_lines(frame: Any, event: str, argument: Any) -> Any:
        if event == "line":
            left[0] -= 1
            if left[0] == 0:
                copy()
                sys.settrace(earlier)
        return trace_lines if left[0] > 0 else None

    def trace_calls(frame: Any, event: str, argument: Any) -> Any:
        name = frame.f_code.co_filename
        traced = left[0] > 0 and any(part in name for part in parts)
        return trace_lines if traced else None

    earlier = sys.gettrace()
    sys.settrace(trace_calls)
    try:
        call()
    finally:
        sys.settrace(earlier)
    return left[0] <= 0


def damaged(folder: Path, pattern: str, seed: int) -> str:
    """Damage one of the files of that pattern that are not empty, or remove it. Return what was
    done; the text is empty if there is no such file."""
    draw = random.Random(seed)
    paths = sorted(p for p in folder.glob(pattern) if p.is_file() and p.stat().st_size)
    if not paths:
        return ""
    path = draw.choice(paths)
    if draw.random() < 0.1:
        path.unlink()
        return f"removed {path.name}"
    return f"{damage(draw, path)} {path.name}"


def contents(folder: Path) -> dict[str, bytes]:
    """Return the files of a folder, except empty ones and the memory that SQLite shares."""
    paths = (p for p in folder.rglob("*") if p.is_file() and not p.name.endswith("-shm"))
    data = {str(path.relative_to(folder)): path.read_bytes() for path in paths}
    return {name: content for name, content in data.items() if content}


def without_counters(files: dict[str, bytes]) -> dict[str, bytes]:
    """Return files without the numbers of changes in the headers of SQLite databases. Opening a
    store for writing increases them."""
    return {
        name: data[:24] + data[28:92] + data[96:] if data.startswith(b"SQLite format 3") else data
        for name, data in files.items()
    }


def put_back(folder: Path, files: dict[str, bytes]) -> None:
    """Restore the files of a folder."""
    for path in folder.rglob("*"):
        if path.is_file():
            path.unlink()
    for name, content in files.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(content)
