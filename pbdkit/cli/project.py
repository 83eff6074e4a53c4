"""The files of a plugin project, from templates, and the names in it, all made from that of its
distribution."""

from __future__ import annotations

import keyword
import os
import re
import sys
from dataclasses import dataclass
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from string import Template

from pbdkit import __version__
from pbdkit.errors import ExperimentError
from pbdkit.interfaces import INTERFACES
from pbdkit.registry import BUILTIN
from pbdkit.registry.discovery import canonical
from pbdkit.registry.registry import Registry
from pbdkit.storage.destination import write_folder

PREFIX = f"{BUILTIN}-"
TAKEN = {*keyword.kwlist, "Literal", "Field"}
"""What a class in the module cannot be called."""
DEFAULT_PARTS = {
    "lattice": "{type: square, a: 1.0}",
    "neighbours": "{type: coordination, shells: 1}",
    "rule": "{type: barycentre}",
    "frame": "{type: mean}",
    "fracture": "{type: none}",
    "diagnostics": "[{type: displacement}]",
}
"""The parts of the example experiment, but for the one that the plugin offers."""
TEMPLATES = {
    "pyproject.toml": "pyproject.toml",
    "README.md": "README.md",
    "LICENSE": "LICENSE",
    ".gitignore": "gitignore",
    "example.yaml": "example.yaml",
    "{module}.py": "{interface}.py",
    "tests/test_example.py": "test_example.py",
    "tests/test_conformance.py": "test_conformance.py",
}


@dataclass(frozen=True)
class Project:
    """``pbdkit-my-rule``: the module ``pbdkit_my_rule``, the type ``my-rule``, the class
    ``MyRule``, with a component of that interface."""

    distribution: str
    module: str
    type: str
    class_name: str
    interface: str
    field: str

    def files(self) -> dict[str, str]:
        """The text of each file, by its place in the project's folder."""
        listed = self.field == "diagnostics"
        own = f"[{{type: {self.type}}}]" if listed else f"{{type: {self.type}}}"
        parts = DEFAULT_PARTS | {self.field: own}
        known = {
            **vars(self),
            "variable": self.type.replace("-", "_"),
            "own": own,
            "pbdkit_version": ".".join(__version__.split(".")[:2]),
            "parts": "\n".join(f"{name}: {part}" for name, part in parts.items()),
        }
        folder = files("pbdkit.cli").joinpath("templates")
        texts = {}
        for file, template in TEMPLATES.items():
            text = folder.joinpath(template.format(**known) + ".txt").read_text("utf-8")
            texts[file.format(**known)] = Template(text).substitute(known)
        return texts

    def write(self, parent: Path) -> Path:
        """Writes it into a new folder of `parent`, named as the distribution, and returns that.

        Raises ExperimentError where there is something of that name, StorageError where it cannot
        be written; then nothing of it stays.
        """
        folder = parent / self.distribution
        texts = self.files()
        if os.path.lexists(folder):
            raise ExperimentError(
                f"{folder}: exists and is left as it is; take another name or --dir"
            )
        write_folder(folder, texts)
        return folder


def project_of(name: str, interface: str) -> Project:
    """The project of that name with a component of that interface.

    Raises ExperimentError where a name in it cannot be had.
    """
    if not re.fullmatch(r"[A-Za-z]([A-Za-z0-9._-]*[A-Za-z0-9])?", name):
        raise ExperimentError(
            f"'{name}' is no name for a distribution: it begins with a letter, ends with a letter "
            "or digit, and holds letters, digits, '.', '_' and '-', as pbdkit-my-rule does"
        )
    distribution = canonical(name)
    kind = distribution.removeprefix(PREFIX)
    class_name = "".join(word.capitalize() for word in kind.split("-"))
    module, instead = distribution.replace("-", "_"), f"; try {PREFIX}my-{kind}"
    if not class_name.isidentifier() or class_name in TAKEN:
        raise ExperimentError(f"'{name}' makes no name for a class{instead}")
    taken = {*keyword.kwlist, *sys.stdlib_module_names}
    spec = None if module in taken else find_spec(module)
    if module in taken or (spec and spec.origin):  # a mere folder has no origin
        raise ExperimentError(f"there is a module {module} already{instead}")
    field, own = next((field, i) for field, i in INTERFACES.items() if i.__name__ == interface)
    if [kind] in Registry().spellings(own, installed=False).values():
        raise ExperimentError(f"'{kind}' is a built-in {interface}{instead}")
    return Project(distribution, module, kind, class_name, interface, field)
