"""The kernel that the documentation shows is the one that is generated."""

import re
from pathlib import Path

from particle_operations import Drag

import pbdkit
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.numba_engine import plan
from pbdkit.stepping.numba_engine.engine import CompiledStepper

PAGE = Path(__file__).parents[3] / "docs" / "extending" / "kernel.md"
SHEET = {
    "name": "kernel",
    "lattice": {"type": "square", "a": 1.0},
    "body": {"type": "grid", "columns": 30, "rows": 20},
    "rule": {"type": "mean-displacement"},
    "leaders": [{"select": {"edge": "left"}, "motion": {"type": "hold"}}],
    "operations": [Drag(select={"edge": "top"})],
    "steps": 10,
}


def test_the_kernel_of_the_page_is_generated(monkeypatch):
    sources = []

    def load_kernel(source, functions, arguments):
        sources.append(source)

    monkeypatch.setattr(plan, "load_kernel", load_kernel)
    CompiledStepper(build_scene(pbdkit.Experiment(**SHEET)))
    shown = re.findall(r"^ {4}(.*)$", PAGE.read_text(), re.M)
    assert [line for line in sources[0].splitlines() if line] == shown
