"""Imports follow the data: experiment, scene, stepping, results, runs, command line."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "pbdkit"
ORDER = [
    "errors",
    "resources",
    "interfaces",
    "registry",
    "components",
    "experiment",
    "scene",
    "stepping",
    "storage",
    "results",
    "analysis",
    "identity",
    "equilibrium",
    "prediction",
    "runs",
    "ranks",
    "sweeps",
    "fitting",
    "drawing",
    "accessor",
    "api",
    "bench",
    "testing",
    "pages",
    "sessions",
    "cli",
]
FILES = sorted(p for p in PACKAGE.rglob("*.py") if p.parent != PACKAGE or p.stem in ORDER)


def room(module):
    return ORDER.index(module.split(".")[1])


def imported(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("pbdkit."):
            yield node.module


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_lead_upstream_only(path):
    own = room(".".join(("pbdkit", *path.relative_to(PACKAGE).with_suffix("").parts)))
    downstream = [module for module in imported(path) if room(module) > own]
    assert downstream == []


def test_no_files_import_each_other_in_a_circle():
    """Not for their types either, within a room as little as between rooms."""
    named = {".".join(p.relative_to(PACKAGE.parent).with_suffix("").parts): p for p in FILES}
    modules = {name.removesuffix(".__init__"): path for name, path in named.items()}
    needs = {name: {*imported(path)} & {*modules} - {name} for name, path in modules.items()}
    assert len(list(TopologicalSorter(needs).static_order())) == len(modules)


def calls_of(method, path):
    """How often a file calls the method; what it writes as text, kernels, is no call."""
    called = (n.func for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.Call))
    return sum(isinstance(f, ast.Attribute) and f.attr == method for f in called)


def test_rules_are_evaluated_in_one_place():
    """Whatever is added, values by bond or a third axis, is told to the evaluator alone."""
    outside = [path for path in FILES if "components" not in path.relative_to(PACKAGE).parts]
    found = {str(p.relative_to(PACKAGE)): calls_of("gather", p) for p in outside}
    assert {path: n for path, n in found.items() if n} == {"stepping/evaluator.py": 1}


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_functions_stay_short(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef):
            assert node.end_lineno - node.lineno < 60, node.name


def test_every_folder_has_its_place_in_the_order():
    folders = {p.name for p in PACKAGE.iterdir() if p.is_dir() and (p / "__init__.py").exists()}
    assert folders <= set(ORDER)
