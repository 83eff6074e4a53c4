"""Commands ``pbdkit plugins``: list and check installed plugins, and create a plugin project from
templates."""

from __future__ import annotations

import json
import keyword
import os
import re
import sys
from dataclasses import asdict, dataclass
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING

import click

from pbdkit import __version__
from pbdkit.cli.commands import builtin_commands, plugins_with_commands
from pbdkit.errors import ExperimentError, PluginError, did_you_mean
from pbdkit.hooks import Plugin, canonical
from pbdkit.io.atomic_file import write_folder
from pbdkit.plugin import BUILTIN, INTERFACES, LISTS
from pbdkit.plugin.registry import Registry

if TYPE_CHECKING:
    from pbdkit.testing import Report


def list_(as_json: bool) -> None:
    """List components and plugins, and their states."""
    registry = Registry()
    rows = [row for plugin in registry.plugins for row in _rows(plugin)]
    rows += [row for plugin in plugins_with_commands() for row in _rows(plugin)]
    for warning in registry.warnings():
        click.echo(f"warning: {warning}", err=True)
    if as_json:
        click.echo(json.dumps(rows))
        return
    from pbdkit.cli.tables import Table, add_rows, show_table

    table = Table(box=None, pad_edge=False)
    for column in rows[0]:
        table.add_column(column, overflow="fold", no_wrap=column not in ("reason", "type"))
    add_rows(table, ([*row.values()] for row in rows))
    show_table(table)


def new(name: str, interface: str, parent: Path) -> None:
    """Write a complete plugin project NAME, e.g. pbdkit-my-rule, ready to install and run."""
    project = project_of(name, interface)
    folder = project.write(parent)
    click.echo(
        f"{folder}: the {interface} '{project.type}' is in {project.module}.py; next:\n"
        f"  pip install -e {folder if folder.is_absolute() else f'./{folder}'}\n"
        f"  pbdkit run {folder / 'example.yaml'}"
    )


def check_plugins(distributions: tuple[str, ...], verbose: bool, as_json: bool) -> int:
    """Check the components of distributions, by default of all plugins.

    Returns
    -------
    int
        Exit status: 3 if a property fails, or if a plugin does not load.
    """
    from pbdkit.testing import examine_all

    rows, success = [], True
    for plugin in _selected_plugins(distributions):
        if plugin.fault:
            success = False
            click.echo(f"{plugin} is {plugin.fault}", err=True)
        for report in examine_all(plugin.components):
            success = success and report.holds
            rows.append({"distribution": plugin.distribution} | asdict(report))
            if not as_json:
                click.echo(report if verbose else _summary(report))
    if as_json:
        click.echo(json.dumps({"holds": success, "reports": rows}))
    elif success:
        examples = "1 example" if len(rows) == 1 else f"{len(rows)} examples"
        click.echo(f"{examples} of its components passed all properties")
    return 0 if success else 3


def _rows(plugin: Plugin) -> list[dict[str, str]]:
    """Return a row for the plugin, and one for each of its components."""
    rows = [("plugin", plugin.name, plugin.state, plugin.reason)]
    for offer in plugin.offers:
        interface = offer.interface.__name__ if offer.interface else ""
        rows.append((interface, offer.name, offer.state, offer.reason))
    for command in plugin.commands:
        in_conflict = command.name in builtin_commands()
        reason = f"pbdkit has a command '{command.name}'" if in_conflict else ""
        rows.append(("command", command.name, "conflict" if in_conflict else "ok", reason))
    origin = {"distribution": plugin.distribution, "version": plugin.version}
    return [
        {"interface": kind, "type": name, **origin, "state": state, "reason": reason}
        for kind, name, state, reason in rows
    ]


def _selected_plugins(distributions: tuple[str, ...]) -> list[Plugin]:
    """Return the plugins of distributions, or all except the built-in one.

    Raises
    ------
    PluginError
        For a distribution that is not installed, or if there is no plugin.
    """
    by_distribution: dict[str, list[Plugin]] = {}
    for plugin in Registry().plugins:
        by_distribution.setdefault(canonical(plugin.distribution), []).append(plugin)
    names = distributions or [name for name in by_distribution if name != BUILTIN]
    if not names:
        raise PluginError(
            "no plugin is installed; `pbdkit plugins check pbdkit` checks the built-in components"
        )
    for name in names:
        if canonical(name) not in by_distribution:
            hint = did_you_mean(
                name, [members[0].distribution for members in by_distribution.values()]
            )
            raise PluginError(f"'{name}' is not installed, or is not a plugin{hint}")
    return [plugin for name in names for plugin in by_distribution[canonical(name)]]


def _summary(report: Report) -> str:
    faults = [f"  failed  {outcome.property}: {outcome.reason}" for outcome in report.failed]
    return "\n".join([report.summary(), *faults])


PREFIX = f"{BUILTIN}-"
"""Beginning of the names of plugins."""
RESERVED_NAMES = {*keyword.kwlist, "Literal", "Field"}
"""Names that a class in the module cannot have."""
DEFAULT_PARTS = {
    "lattice": "{type: square, a: 1.0}",
    "neighbours": "{type: coordination, shells: 1}",
    "rule": "{type: barycentre}",
    "frame": "{type: mean}",
    "fracture": "{type: none}",
    "operations": "[]",
    "diagnostics": "[{type: displacement}]",
}
"""Parts of the example experiment, except the component of the plugin."""
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
"""Template of each file of a project."""


@dataclass(frozen=True)
class Project:
    """A plugin project: names, and the interface of its component.

    Parameters
    ----------
    distribution
        For instance ``pbdkit-my-rule``.
    module
        ``pbdkit_my_rule``.
    type
        ``my-rule``.
    class_name
        ``MyRule``.
    interface
        Name of the interface.
    field
        Key of experiment files for such components.
    """

    distribution: str
    module: str
    type: str
    class_name: str
    interface: str
    field: str

    def files(self) -> dict[str, str]:
        """Return the text of each file by its path in the project's folder."""
        part = f"{{type: {self.type}}}"
        part_text = f"[{part}]" if self.field in LISTS else part
        parts = DEFAULT_PARTS | {self.field: part_text}
        substitutions = {
            **vars(self),
            "variable": self.type.replace("-", "_"),
            "own": part_text,
            "pbdkit_version": ".".join(__version__.split(".")[:2]),
            "parts": "\n".join(f"{name}: {part}" for name, part in parts.items()),
        }
        folder = files("pbdkit.cli").joinpath("templates")
        texts = {}
        for file, template in TEMPLATES.items():
            text = folder.joinpath(template.format(**substitutions) + ".txt").read_text("utf-8")
            texts[file.format(**substitutions)] = Template(text).substitute(substitutions)
        return texts

    def write(self, parent: Path) -> Path:
        """Write the project into a new folder of `parent`, and return that folder.

        Raises
        ------
        ExperimentError
            If a file or folder of that name exists.
        StorageError
            If the project cannot be written; files written until then are removed.
        """
        folder = parent / self.distribution
        texts = self.files()
        if os.path.lexists(folder):
            raise ExperimentError(
                f"{folder}: exists and is not replaced; choose another name or --dir"
            )
        write_folder(folder, texts)
        return folder


def project_of(name: str, interface: str) -> Project:
    """Return the project for a distribution name and an interface.

    Raises
    ------
    ExperimentError
        If the name, or one derived from it, is invalid or in use.
    """
    if not re.fullmatch(r"[A-Za-z]([A-Za-z0-9._-]*[A-Za-z0-9])?", name):
        raise ExperimentError(
            f"'{name}' is not a valid distribution name: it starts with a letter, ends with a "
            "letter or digit, and contains letters, digits, '.', '_' and '-', for instance "
            "pbdkit-my-rule"
        )
    distribution = canonical(name)
    kind = distribution.removeprefix(PREFIX)
    class_name = "".join(word.capitalize() for word in kind.split("-"))
    module, remedy = distribution.replace("-", "_"), f"; try {PREFIX}my-{kind}"
    if not class_name.isidentifier() or class_name in RESERVED_NAMES:
        raise ExperimentError(f"'{name}' cannot be converted to the name of a class{remedy}")
    reserved = {*keyword.kwlist, *sys.stdlib_module_names}
    spec = None if module in reserved else find_spec(module)
    if module in reserved or (spec and spec.origin):  # A folder without __init__.py has no origin.
        raise ExperimentError(f"there is already a module {module}{remedy}")
    field, base = next(
        (field, interface_class)
        for field, interface_class in INTERFACES.items()
        if interface_class.__name__ == interface
    )
    if [kind] in Registry().spellings(base, installed=False).values():
        raise ExperimentError(f"'{kind}' is a built-in {interface}{remedy}")
    return Project(distribution, module, kind, class_name, interface, field)
