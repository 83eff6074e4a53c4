"""Metadata of the distributions: one licence, one version, dependencies in one place."""

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

ROOT = Path(__file__).parent.parent
PROJECTS = sorted([ROOT, *(path.parent for path in ROOT.glob("plugins/*/pyproject.toml"))])


def project_of(folder: Path) -> dict[str, Any]:
    return tomllib.loads((folder / "pyproject.toml").read_text())


def read_yaml(name: str) -> Any:
    return YAML(typ="safe").load(ROOT / name)


@pytest.mark.parametrize("folder", PROJECTS, ids=lambda p: p.name)
def test_distribution_contains_the_licence(folder: Path) -> None:
    project = project_of(folder)["project"]
    assert (project["license"], project["license-files"]) == ("BSD-3-Clause", ["LICENSE"])
    text = (folder / "LICENSE").read_text()
    assert text == (ROOT / "LICENSE").read_text()
    assert "Copyright (c) 2026, the pbdkit authors" in text


def test_a_new_plugin_has_the_text_of_the_licence() -> None:
    template = (ROOT / "pbdkit/cli/templates/LICENSE.txt").read_text()
    own = "(c) the $distribution authors"
    assert template.replace(own, "(c) 2026, the pbdkit authors") == (ROOT / "LICENSE").read_text()


def test_the_citation_agrees() -> None:
    project, citation = project_of(ROOT)["project"], read_yaml("CITATION.cff")
    (release, *_) = re.findall(r"^## (\d[.\d]*)", (ROOT / "CHANGELOG.md").read_text(), re.M)
    assert citation["version"] == release
    assert citation["license"] == project["license"]
    assert citation["authors"] == project["authors"]


def test_hooks_type_check_against_the_dependencies_of_pbdkit() -> None:
    project = project_of(ROOT)
    extras = project["project"]["optional-dependencies"].values()
    groups = (project["dependency-groups"][name] for name in ("test", "lint"))
    known = {d for part in (project["project"]["dependencies"], *extras, *groups) for d in part}
    hooks = {h["id"]: h for r in read_yaml(".pre-commit-config.yaml")["repos"] for h in r["hooks"]}
    asked = hooks["mypy"]["additional_dependencies"]
    assert asked
    assert set(asked) <= known


def test_every_environment_of_a_contributor_is_a_group() -> None:
    groups = project_of(ROOT)["dependency-groups"]
    included = {part["include-group"] for part in groups["dev"] if isinstance(part, dict)}
    assert included == set(groups) - {"dev"}
    sessions = re.findall(r'install\(session, "(\w+)"\)', (ROOT / "noxfile.py").read_text())
    assert set(sessions) == included
