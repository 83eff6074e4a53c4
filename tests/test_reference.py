"""The reference of Python names: every public name is on a page, and its docstring is complete."""

import ast
import doctest
import importlib
import inspect
import sys
import textwrap
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Literal

import pytest

import pbdkit

sys.path.insert(0, str(Path(pbdkit.__file__).parents[1] / "docs"))
docscrape = pytest.importorskip("numpydoc.docscrape", reason="of the group test, with Sphinx")
reference = importlib.import_module("python_reference")

PAGES = sorted((Path(reference.__file__).parent / "reference").glob("*.md"))
EVERY = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)


@cache
def entries(page):
    """Return the entries of a page. Reading their docstrings takes time, so that each page is read
    by the tests of it."""
    lines = page.read_text().splitlines()
    named = filter(lambda line: line.startswith(("pbdkit.", "ds.")), lines)
    return [reference.entry_of(line) for line in named]


def documented(page):
    """Return the entries of a page, and members of classes, by name."""
    members = {f"{entry.name}.{m.name}": m for entry in entries(page) for m in entry.members}
    return {entry.name: entry for entry in entries(page)} | members


def test_every_public_name_is_on_a_page():
    accessor = vars(reference.PbdAccessor)
    methods = {f"ds.pbd.{name}" for name in accessor if not name.startswith("_")}
    on_pages = {entry.name for page in PAGES for entry in entries(page)}
    assert {*reference.FULL_NAMES.values()} | methods <= on_pages


@EVERY
def test_docstrings_are_complete(page):
    """Every parameter and result has a text, and so has every error that is raised."""
    for name, entry in documented(page).items():
        sections = docscrape.NumpyDocString(entry.docstring)
        assert " ".join(sections["Summary"]).rstrip("`").endswith("."), name
        described = sections["Parameters"] + sections["Other Parameters"]
        names = [n for parameter in described for n in parameter.name.split(", ")]
        if entry.parameters:
            assert names == [written(parameter) for parameter in entry.parameters], name
        if entry.kind in ("function", "method") and returns(entry.value):
            assert sections["Returns"] or sections["Yields"], name
        raised = {error for item in sections["Raises"] for error in item.type.split(", ")}
        assert errors_of(entry.value) <= raised, name
        for section in ("Returns", "Yields", "Raises", "Warns", "Attributes"):
            described += sections[section]
        for item in described:  # not the signature again
            text = " ".join(item.desc).rstrip(".").lower()
            assert text not in ("", item.name.lower(), item.type.lower()), name


def written(parameter):
    stars = {parameter.VAR_POSITIONAL: "*", parameter.VAR_KEYWORD: "**"}
    return f"{stars.get(parameter.kind, '')}{parameter.name}"


def returns(function):
    return inspect.get_annotations(function).get("return") not in (None, "None")


def errors_of(value):
    """Return the names of the errors that a function raises in its own lines."""
    if not inspect.isfunction(value):
        return set()
    tree = ast.parse(textwrap.dedent(inspect.getsource(value)))
    raised = [node.exc for node in ast.walk(tree) if isinstance(node, ast.Raise)]
    names = {error.func.id for error in raised if isinstance(getattr(error, "func", 0), ast.Name)}
    return names - {"NotImplementedError"}


@EVERY
def test_examples_run(page, tmp_path, monkeypatch, interpreted):
    for name, entry in documented(page).items():
        assert_runs(name, entry.docstring, tmp_path, monkeypatch)


def test_example_of_the_interfaces_runs(tmp_path, monkeypatch, interpreted):
    assert ">>>" in pbdkit.plugin.__doc__
    assert_runs("pbdkit.plugin", pbdkit.plugin.__doc__, tmp_path, monkeypatch)


def assert_runs(name, docstring, folder, monkeypatch):
    """Run the examples of a docstring in a folder of their own."""
    (folder / name).mkdir()
    monkeypatch.chdir(folder / name)
    monkeypatch.setenv("MPLBACKEND", "agg")
    module = ModuleType("an_example")
    monkeypatch.setitem(sys.modules, module.__name__, module)  # so that its classes can be found
    names = vars(module)
    names.update({"pbdkit": pbdkit, "Literal": Literal})
    for source in (pbdkit.plugin, pbdkit.testing):
        names.update({public: getattr(source, public) for public in source.__all__})
    test = doctest.DocTestParser().get_doctest(docstring, names, name, None, 0)
    test.globs = names  # its own is a copy
    assert doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(test).failed == 0, name
