"""The files of a plugin project, from templates."""

from __future__ import annotations

import shutil
from importlib.resources import files
from pathlib import Path
from string import Template

from pbdkit import __version__
from pbdkit.errors import ExperimentError, StorageError
from pbdkit.interfaces import INTERFACES
from pbdkit.skeleton.names import Names

DEFAULT_PARTS = {
    "lattice": "{type: square, a: 1.0}",
    "neighbours": "{type: coordination, shells: 1}",
    "rule": "{type: barycentre}",
    "frame": "{type: mean}",
    "fracture": "{type: none}",
    "diagnostics": "[{type: displacement}]",
}
"""The parts of the example experiment, but for the one that the plugin offers."""


def project_files(names: Names, interface: str) -> dict[str, str]:
    """The text of each file, by its place in the project's folder."""
    field = next(field for field, i in INTERFACES.items() if i.__name__ == interface)
    own = f"{{type: {names.type}}}" if field != "diagnostics" else f"[{{type: {names.type}}}]"
    parts = DEFAULT_PARTS | {field: own}
    known = {
        **vars(names),
        "variable": names.type.replace("-", "_"),
        "interface": interface,
        "field": field,
        "own": own,
        "pbdkit_version": ".".join(__version__.split(".")[:2]),
        "parts": "\n".join(f"{field}: {part}" for field, part in parts.items()),
    }
    templates = {
        "pyproject.toml": "pyproject.toml",
        "README.md": "README.md",
        "LICENSE": "LICENSE",
        ".gitignore": "gitignore",
        "example.yaml": "example.yaml",
        f"{names.module}.py": f"{interface}.py",
        "tests/test_example.py": "test_example.py",
        "tests/test_conformance.py": "test_conformance.py",
    }
    return {file: _filled(template, known) for file, template in templates.items()}


def write_project(names: Names, interface: str, parent: Path) -> Path:
    """Writes the project into a new folder of `parent`, named as the distribution, and returns it.

    Raises ExperimentError where there is something of that name, StorageError where it cannot be
    written; then nothing of it stays.
    """
    folder = parent / names.distribution
    texts = project_files(names, interface)
    try:
        folder.mkdir()
    except FileExistsError:
        raise ExperimentError(
            f"{folder}: exists and is left as it is; take another name or --dir"
        ) from None
    except OSError as error:
        raise StorageError(f"{folder}: cannot be made: {error.strerror}") from None
    try:
        for file, text in texts.items():
            path = folder / file
            path.parent.mkdir(exist_ok=True)
            path.write_text(text, "utf-8")
    except OSError as error:
        shutil.rmtree(folder, ignore_errors=True)
        raise StorageError(f"{folder}: cannot be written: {error.strerror}") from None
    return folder


def _filled(template: str, known: dict[str, str]) -> str:
    text = files("pbdkit.skeleton").joinpath("templates", f"{template}.txt").read_text("utf-8")
    return Template(text).substitute(known)
