"""The reference of Python names: every public name is on a page, and its docstring is complete."""

import ast
import doctest
import importlib
import inspect
import sys
import textwrap
from pathlib import Path
from types import ModuleType
from typing import Literal

import pytest

import pbdkit

sys.path.insert(0, str(Path(pbdkit.__file__).parents[1] / "docs"))
docscrape = pytest.importorskip("numpydoc.docscrape", reason="of the group test, with Sphinx")
reference = importlib.import_module("python_reference")

PAGES = sorted((Path(reference.__file__).parent / "reference").glob("*.md"))
LINES = [line for page in PAGES for line in page.read_text().splitlines()]
ENTRIES = {
    entry.name: entry
    for entry in map(reference.entry_of, filter(lambda s: s.startswith(("pbdkit.", "ds.")), LINES))
}
DOCUMENTED = ENTRIES | {
    f"{entry.name}.{member.name}": member for entry in ENTRIES.values() for member in entry.members
}
"""Names of the reference, with members of classes."""
EVERY = pytest.mark.parametrize("entry", [pytest.param(e, id=n) for n, e in DOCUMENTED.items()])


def test_every_public_name_is_on_a_page():
    accessor = vars(reference.PbdAccessor)
    methods = {f"ds.pbd.{name}" for name in accessor if not name.startswith("_")}
    assert {*reference.FULL_NAMES.values()} | methods <= {*ENTRIES}


@EVERY
def test_docstrings_are_complete(entry):
    """Every parameter and result has a text, and so has every error that is raised."""
    sections = docscrape.NumpyDocString(entry.docstring)
    assert " ".join(sections["Summary"]).rstrip("`").endswith(".")
    documented = sections["Parameters"] + sections["Other Parameters"]
    names = [name for parameter in documented for name in parameter.name.split(", ")]
    if entry.parameters:
        assert names == [written(parameter) for parameter in entry.parameters]
    if entry.kind in ("function", "method") and returns(entry.value):
        assert sections["Returns"] or sections["Yields"]
    raised = {error for item in sections["Raises"] for error in item.type.split(", ")}
    assert errors_of(entry.value) <= raised
    for name in ("Returns", "Yields", "Raises", "Warns", "Attributes"):
        documented += sections[name]
    for item in documented:  # not the signature again
        text = " ".join(item.desc).rstrip(".").lower()
        assert text not in ("", item.name.lower(), item.type.lower())


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


EXAMPLES = {
    name: entry.docstring for name, entry in DOCUMENTED.items() if ">>>" in entry.docstring
} | {"pbdkit.plugin": pbdkit.plugin.__doc__}


@pytest.mark.parametrize("name", EXAMPLES)
def test_examples_run(name, tmp_path, monkeypatch, interpreted):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    module = ModuleType("an_example")
    monkeypatch.setitem(sys.modules, module.__name__, module)  # so that its classes can be found
    names = vars(module)
    names.update({"pbdkit": pbdkit, "Literal": Literal})
    for source in (pbdkit.plugin, pbdkit.testing):
        names.update({public: getattr(source, public) for public in source.__all__})
    test = doctest.DocTestParser().get_doctest(EXAMPLES[name], names, name, None, 0)
    test.globs = names  # its own is a copy
    assert doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(test).failed == 0
