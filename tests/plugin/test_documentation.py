"""docs/extending describes every interface, hook and public name, and its examples conform."""

import ast
import importlib
import inspect
import re
import shlex
import sys
import types
import zlib
from pathlib import Path
from typing import Any, ClassVar, get_origin

import pytest

import pbdkit
import pbdkit.testing
from pbdkit.hooks import Hooks
from pbdkit.plugin import INTERFACES, Component
from pbdkit.testing import PROPERTIES, examine, examples_of

PAGES = Path(__file__).parents[2] / "docs" / "extending"
PAGE_OF = {
    "Lattice": "lattice.md",
    "NeighbourMetric": "neighbours.md",
    "FollowerRule": "rule.md",
    "FramePolicy": "frame.md",
    "FractureModel": "fracture.md",
    "ParticleOperation": "operation.md",
    "Diagnostic": "diagnostic.md",
}
CAPABILITIES = {
    "FollowerRule": (
        pbdkit.plugin.Calibrated,
        pbdkit.plugin.Loadable,
        pbdkit.plugin.TearsCells,
        pbdkit.plugin.StoresEnergy,
        pbdkit.plugin.Remembers,
        pbdkit.plugin.Draws,
        pbdkit.plugin.RenewsParticles,
        pbdkit.plugin.SharesParticles,
        pbdkit.plugin.TurnsParticles,
        pbdkit.plugin.AppliesTwice,
        pbdkit.plugin.UsesAngles,
    ),
    "FractureModel": (
        pbdkit.plugin.Remembers,
        pbdkit.plugin.Draws,
        pbdkit.plugin.RenewsBonds,
        pbdkit.plugin.Softens,
        pbdkit.plugin.SoftensCells,
        pbdkit.plugin.StartsCracked,
        pbdkit.plugin.BreaksAtStrain,
        pbdkit.plugin.UsesStiffness,
    ),
    "FramePolicy": (pbdkit.plugin.Anchors,),
}
EVERY = pytest.mark.parametrize("interface", INTERFACES.values(), ids=lambda i: i.__name__)


def text_of(interface):
    return (PAGES / PAGE_OF[interface.__name__]).read_text()


def blocks(text, language="python"):
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.M | re.S)


def in_code(text):
    """Every word that a page sets as code, arguments and blocks left out."""
    inline = re.sub(r"^```.*?^```", "", text, flags=re.M | re.S)
    return set(re.findall(r"`(\w+)(?:\([^`]*\)| = \w+)?`", inline))


@EVERY
def test_page_lists_every_method_and_declaration(interface):
    annotations = inspect.get_annotations(interface, eval_str=True)
    declared = {n for n, kind in annotations.items() if get_origin(kind) is ClassVar}
    methods = {
        n for n, v in list(vars(interface).items()) if inspect.isroutine(getattr(v, "__func__", v))
    }
    fields = set(interface.model_fields) - set(Component.model_fields)
    names = {n for n in declared | methods | fields if not n.startswith(("_", "model_"))}
    assert names
    assert names <= in_code(text_of(interface))


@EVERY
def test_page_lists_optional_methods(interface):
    text = text_of(interface)
    for capability in CAPABILITIES.get(interface.__name__, ()):
        assert re.search(rf"`(pbdkit\.plugin\.)?{capability.__name__}`", text)
        assert getattr(capability, "__abstractmethods__", set()) <= in_code(text)


@EVERY
def test_a_page_gives_the_signatures(interface):
    of = [interface, *CAPABILITIES.get(interface.__name__, ())]
    for name, arguments in re.findall(r"`(\w+)\(([\w, ]*)\)` \|", text_of(interface)):
        (method, *_) = (getattr(kind, name) for kind in of if hasattr(kind, name))
        parameters = inspect.signature(method).parameters
        assert [p for p in parameters if p != "self"] == re.findall(r"\w+", arguments), name


def reports_on(interface, code, tmp_path, monkeypatch):
    """Return the example's own run, and the report of the suite about its component."""
    # The same name in each session, so that the compiled kernels are found again.
    module = f"page_of_{interface.__name__.lower()}_{zlib.crc32(code.encode()):x}"
    (tmp_path / f"{module}.py").write_text(code)
    monkeypatch.delitem(sys.modules, module, raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    page = importlib.import_module(module)
    found = vars(page).values()
    classes = (c for c in found if inspect.isclass(c) and c.__module__ == module)
    (component,) = (c for c in classes if issubclass(c, interface))
    return [examine(example) for example in examples_of(component)]


@EVERY
def test_smallest_example_passes_conformance(interface, tmp_path, monkeypatch, compiled_at_length):
    """`cli/test_plugins_new` compiles a rule, and `testing/test_conformance` all built-in ones."""
    code = blocks(text_of(interface))[0]
    has_functions = interface in (pbdkit.FollowerRule, pbdkit.FractureModel)
    for report in reports_on(interface, code, tmp_path, monkeypatch):
        assert report.holds, str(report)
        if has_functions:
            assert "is-the-same-compiled" in [outcome.property for outcome in report.ran]


@pytest.mark.parametrize("interface", [pbdkit.FollowerRule, pbdkit.FractureModel])
def test_example_with_state_passes_conformance(interface, tmp_path, monkeypatch, interpreted):
    (code,) = (block for block in blocks(text_of(interface)) if "Remembered(" in block)
    for report in reports_on(interface, code, tmp_path, monkeypatch):
        assert report.holds, str(report)
        assert "declares-what-it-remembers" in [outcome.property for outcome in report.ran]


@pytest.mark.parametrize("name", ["AngleStiffness", "Stiffening"])
def test_examples_of_rules_pass_conformance(name, tmp_path, monkeypatch, interpreted):
    (code,) = (b for b in blocks(text_of(pbdkit.FollowerRule)) if f"class {name}" in b)
    for report in reports_on(pbdkit.FollowerRule, code, tmp_path, monkeypatch):
        assert report.holds, str(report)
        assert "is-the-same-compiled" in [outcome.property for outcome in report.ran]


@EVERY
def test_a_page_lists_the_properties_of_its_interface(interface):
    asked = text_of(interface).split("## Required properties")[1].split("## ")[0]
    told, known = set(re.findall(r"`([a-z-]+)`", asked)), {p.name for p in PROPERTIES}
    some = [p for p in PROPERTIES if len(p.interfaces) < len(INTERFACES)]
    own = {p.name for p in some if interface in p.interfaces}
    assert told & known == own
    assert {word for word in told if "-" in word} <= known


def test_table_of_properties_is_complete():
    rows = re.findall(
        r"^\| `([a-z-]+)` \| (.*?) \| (.*?) \|$", (PAGES / "testing.md").read_text(), re.M
    )
    assert [row[0] for row in rows] == [p.name for p in PROPERTIES]
    for (_, of, told), asked in zip(rows, PROPERTIES, strict=True):
        whom = {i.__name__ for i in INTERFACES.values()} if of == "all" else set(of.split(", "))
        assert whom == {i.__name__ for i in asked.interfaces}
        assert asked.description.startswith(told)


def test_moved_names_raise_an_error_with_their_new_place():
    for name in {*pbdkit.plugin.__all__} - {*pbdkit.__all__}:
        with pytest.raises(AttributeError, match=rf"from pbdkit.plugin import {name}`$"):
            getattr(pbdkit, name)
    with pytest.raises(AttributeError, match=r"from pbdkit\.plugin import Vector`$"):
        _ = pbdkit.Components
    with pytest.raises(AttributeError, match=r"module 'pbdkit' has no attribute 'nothing'$"):
        _ = pbdkit.nothing


def test_public_names_are_listed_once():
    """That of the stub, for type checkers and at run time."""
    tree = ast.parse(Path(pbdkit.__file__).with_suffix(".pyi").read_text())
    imports = (node for node in tree.body if isinstance(node, ast.ImportFrom))
    stub = {name.asname: node.module for node in imports for name in node.names}
    assert {*stub} | {"__version__"} == {*dir(pbdkit)}
    assert {name for name, module in stub.items() if module != "pbdkit"} == {*pbdkit.__all__}
    for name, module in stub.items():
        assert getattr(pbdkit, name) is getattr(importlib.import_module(module), name)


def test_every_hook_is_documented_with_its_signature():
    hooks = {n: v for n, v in vars(Hooks).items() if not n.startswith("_")}
    assert hooks
    for name, hook in hooks.items():
        arguments = ", ".join(p for p in inspect.signature(hook).parameters if p != "self")
        assert f"def {name}({arguments}):" in (PAGES / "api.md").read_text()


def test_every_page_is_linked_from_the_first():
    index = (PAGES / "README.md").read_text()
    assert {p.name for p in PAGES.glob("*.md")} - {"README.md"} == set(
        re.findall(r"\]\(([^)#]+)", index)
    )


def test_the_tutorial_leads_from_a_notebook_to_a_tested_plugin(
    tmp_path, monkeypatch, install, call, interpreted
):
    text = (PAGES / "tutorial.md").read_text()
    notebook = types.ModuleType("notebook")
    monkeypatch.setitem(sys.modules, "notebook", notebook)
    names = vars(notebook)
    for code in blocks(text)[:2]:
        exec(compile(code, "tutorial.md", "exec"), names)
    assert names["ds"].attrs["status"] == "complete"

    files = dict(re.findall(r"^`(\S+)`:\n\n```\w+\n(.*?)^```", text, re.M | re.S))
    assert set(files) == {"pbdkit-lazy/pbdkit_lazy.py", "pbdkit-lazy/tests/test_conformance.py"}
    install("pbdkit-lazy", files["pbdkit-lazy/pbdkit_lazy.py"], version="0.1.0")
    # `testing/test_conformance` runs such a file with pytest.
    tests: dict[str, Any] = {}
    exec(files["pbdkit-lazy/tests/test_conformance.py"], tests)
    (mark,) = tests["test_conformance"].pytestmark
    tested = {case.id.split("-names-itself")[0] for case in mark.args[1] if "itself" in case.id}
    assert tested == {"FollowerRule lazy", "FollowerRule lazy-angles"}

    created, *commands = re.findall(r"^pbdkit (.*)$", text, re.M)
    assert created == "plugins new pbdkit-lazy"  # by `cli/test_plugins_new`
    assert len(commands) == 4
    results = [call(*shlex.split(command)) for command in commands]
    assert [result.code for result in results] == [0] * 4, results
    for name in ("lazy", "lazy-angles"):
        assert f"FollowerRule {name}: 22 properties ran, 0 failed" in results[0].out
