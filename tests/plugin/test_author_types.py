"""Components written with the types of `pbdkit.plugin` are checked by mypy --strict."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
RULE = """
from typing import Literal

from pbdkit.plugin import FollowerRule, Here, Number, Parameters, Setting, Slot, Vector, Weights


class Growing(FollowerRule):
    type: Literal["growing"] = "growing"
    growth: float = 2.0

    def weights(self, slot: Slot, setting: Setting) -> dict[str, float]:
        return {"share": self.growth**slot.shell}

    @staticmethod
    def gather(d: Vector, r: Vector, w: Weights, p: Parameters) -> tuple[Vector, Number]:
        return w.share * d, w.share

    @staticmethod
    def apply(total: tuple[Vector, Number], here: Here, p: Parameters) -> Vector:
        return total[0] / total[1]


class Wrong(Growing):
    @staticmethod
    def apply(total: tuple[Vector, Number], here: Here, p: Parameters) -> Vector:
        return total  # return-value

    def weights(self, slot: Slot, setting: Setting) -> dict[str, float]:
        return {"share": slot.shell_number}  # attr-defined


length: float = Vector(3.0, 4.0).x
corner: Vector[float] = 2.0 * Vector(1.0, 2.0) - Vector(0.5, 0.0)
text: Vector[str] = corner  # assignment
depth = corner.z  # attr-defined
"""


CONFIGURATION = """
[mypy]
strict = True
plugins = pydantic.mypy
follow_imports = skip

[mypy-pbdkit.plugin.*, pbdkit.array_types, numpy.*, pydantic.*]
follow_imports = normal
"""
"""Options of mypy. Of the modules that `pbdkit.plugin` imports, only those that declare the types
in signatures are analysed; all of them would take 15 s, and the session `lint` of nox checks
them."""


def test_a_typed_rule_is_checked(tmp_path):
    pytest.importorskip("mypy")
    file, configuration = tmp_path / "growing.py", tmp_path / "mypy.ini"
    file.write_text(RULE)
    configuration.write_text(CONFIGURATION)
    # In a process of its own, so that later tests do not share their memory with its syntax trees.
    command = [sys.executable, "-m", "mypy", "--config-file", str(configuration)]
    command += ["--cache-dir", os.devnull, str(file)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    messages = re.findall(r"growing\.py:(\d+): error: .*\[(.+)\]", done.stdout)
    marks = (re.search(r"  # ([a-z-]+)$", line) for line in RULE.splitlines())
    expected = [(str(n), mark[1]) for n, mark in enumerate(marks, 1) if mark]
    assert messages == expected, done.stdout + done.stderr
