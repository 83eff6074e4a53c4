"""Imports follow the data: experiment, scene, stepping, results, command line."""

import ast
import re
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path
from typing import NamedTuple

import pbdkit
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.numba_engine import engine
from pbdkit.stepping.program import ORDER as ORDER_OF_A_STEP

PACKAGE = Path(__file__).parent.parent / "pbdkit"
ORDER = [
    "array_types",
    "errors",
    "memory",
    "progress",
    "communicator",
    "seeds",
    "hooks",
    "plugin",
    "untrusted_files",
    "components",
    "model",
    "lattice",
    "scene",
    "stepping",
    "linear",
    "io",
    "identification",
    "equilibrium",
    "stability",
    "simulation",
    "restart",
    "mpi",
    "sweeps",
    "fitting",
    "plotting",
    "accessor",
    "api",
    "testing",
    "cli",
    "bench",
    "web",
]
FILES = sorted(p for p in PACKAGE.rglob("*.py") if p.parent != PACKAGE or p.stem in ORDER)


def room(module):
    return ORDER.index(module.split(".")[1])


MODULES = {
    ".".join(p.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__"): p
    for p in FILES
}


class Facts(NamedTuple):
    """The modules of pbdkit that a file imports, in functions and for types too; the number of its
    calls of a method `gather`, without text that it writes for kernels; and its long functions."""

    imported: set[str]
    gathers: int
    long_functions: list[str]


@cache
def facts(path):
    modules, gathers, long_functions = set(), 0, []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("pbdkit."):
            names = {f"{node.module}.{name.name}" for name in node.names}
            modules |= (names & {*MODULES}) or {node.module}
        elif isinstance(node, ast.Call):
            gathers += isinstance(node.func, ast.Attribute) and node.func.attr == "gather"
        elif isinstance(node, ast.FunctionDef):
            # A docstring with its sections is not counted.
            first = node.body[ast.get_docstring(node) is not None :][:1] or [node]
            long_functions += [node.name] * (node.end_lineno - first[0].lineno >= 60)
    return Facts(modules, gathers, long_functions)


def test_imports_follow_the_layer_order():
    downstream = {
        name: [module for module in facts(path).imported if room(module) > room(name)]
        for name, path in MODULES.items()
    }
    assert {name: modules for name, modules in downstream.items() if modules} == {}


def test_no_circular_imports():
    """Not for their types either, within a room as little as between rooms."""
    needs = {name: facts(path).imported & {*MODULES} - {name} for name, path in MODULES.items()}
    assert len(list(TopologicalSorter(needs).static_order())) == len(MODULES)


def test_rules_are_evaluated_in_one_place():
    """The evaluator alone implements further features, such as values by bond or a third axis."""
    outside = [path for path in FILES if "components" not in path.relative_to(PACKAGE).parts]
    found = {str(p.relative_to(PACKAGE)): facts(p).gathers for p in outside}
    assert {path: n for path, n in found.items() if n} == {"stepping/rule_evaluation.py": 1}


def test_functions_are_short():
    long_functions = {str(path.relative_to(PACKAGE)): facts(path).long_functions for path in FILES}
    assert {path: names for path, names in long_functions.items() if names} == {}


def test_every_package_has_a_place_in_the_order():
    folders = {p.name for p in PACKAGE.iterdir() if p.is_dir() and (p / "__init__.py").exists()}
    assert folders <= set(ORDER)


PAGE = (PACKAGE.parent / "ARCHITECTURE.md").read_text()


def test_page_names_every_package_and_no_missing_file():
    assert "## Data flow" in PAGE
    table = PAGE.split("## Data flow")[0]
    names = {word.strip("/") for word in re.findall(r"`([\w/]+)`", table)}
    assert {*ORDER} <= names
    paths = re.findall(r"`([a-z_]+/[\w/]*\.py)`", PAGE)
    files = re.findall(r"`([a-z_]+\.py)`", PAGE)
    folders = [PACKAGE, PACKAGE / "stepping", PACKAGE.parent, PACKAGE.parent / "tests"]
    assert len(paths) > 3
    assert not [path for path in paths if not any((f / path).exists() for f in folders)]
    assert not [name for name in files if not any((f / name).exists() for f in folders)]


def test_the_page_lists_the_operations_in_the_order_of_a_step():
    section = PAGE.split("## The operations of a step")[1].split("\n## ")[0]
    rows = [line for line in section.splitlines() if line.startswith("| `")]
    names = [name for row in rows for name in re.findall(r"`(\w+)`", row.split("|")[1])]
    ranks = [[kind.__name__ for kind in ORDER_OF_A_STEP].index(name) for name in names]
    assert sorted(ranks) == [*range(len(ORDER_OF_A_STEP))]


def test_kernel_on_the_page_is_the_generated_one(monkeypatch):
    sources = []
    monkeypatch.setattr(
        engine, "load_plugin_kernel", lambda levels, source, given: sources.append(source)
    )
    engine.CompiledStepper(build_scene(pbdkit.load("paper/a")))
    lines = sources[0].splitlines()
    for line in PAGE.split("```text\n")[1].split("```")[0].splitlines():
        assert line in lines, line
        del lines[: lines.index(line) + 1]
