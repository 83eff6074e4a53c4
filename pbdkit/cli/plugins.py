"""``pbdkit plugins``: list and check installed plugins, and create a new plugin project from
templates.
"""

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
from pbdkit.cli.commands import own_commands, plugins_with_commands
from pbdkit.cli.options import json_option
from pbdkit.errors import ExperimentError
from pbdkit.io.atomic_file import write_folder
from pbdkit.plugin import BUILTIN, INTERFACES, LISTS
from pbdkit.plugin.discovery import canonical
from pbdkit.plugin.registry import Registry

if TYPE_CHECKING:
    from pbdkit.plugin.discovery import Plugin
    from pbdkit.testing import Report


INTERFACE_NAMES = (
    "FollowerRule", "Lattice", "NeighbourMetric", "FramePolicy", "FractureModel",
    "ParticleOperation", "Diagnostic",
)  # fmt: skip
"""The open interfaces by name, here so that `--help` imports none of them."""


@click.group(invoke_without_command=True)
@click.pass_context
def plugins(context: click.Context) -> None:
    """What is installed, and in which state."""
    if context.invoked_subcommand is None:
        click.echo(context.get_help())


@plugins.command("list")
@json_option
def list_(as_json: bool) -> None:
    """A row for each component and one for each plugin."""
    from pbdkit.plugin.registry import Registry

    registry = Registry()
    rows = [row for plugin in registry.plugins for row in _rows(plugin)]
    rows += [row for plugin in plugins_with_commands() for row in _rows(plugin)]
    for warning in registry.doubts():
        click.echo(f"warning: {warning}", err=True)
    if as_json:
        click.echo(json.dumps(rows))
        return
    from rich.table import Table
    from rich.text import Text

    from pbdkit.cli.options import show_table

    table = Table(box=None, pad_edge=False)
    for column in rows[0]:
        table.add_column(column, overflow="fold", no_wrap=column not in ("reason", "type"))
    for row in rows:
        table.add_row(*map(Text, row.values()))  # no markup: [x] is what it says
    show_table(table)


@plugins.command(short_help="Write a plugin project that installs and runs.")
@click.argument("name")
@click.option(
    "--interface",
    type=click.Choice(INTERFACE_NAMES),
    default=INTERFACE_NAMES[0],
    show_default=True,
    help="What the plugin adds.",
)
@click.option(
    "--dir",
    "parent",
    type=click.Path(exists=True, file_okay=False, path_type=Path),
    default=".",
    help="Where the project's folder is made; here by default.",
)
def new(name: str, interface: str, parent: Path) -> None:
    """Write a plugin project NAME, e.g. pbdkit-my-rule, that installs and runs as it stands."""

    project = project_of(name, interface)
    folder = project.write(parent)
    click.echo(
        f"{folder}: the {interface} '{project.type}' stands in {project.module}.py; next:\n"
        f"  pip install -e {folder if folder.is_absolute() else f'./{folder}'}\n"
        f"  pbdkit run {folder / 'example.yaml'}"
    )


@plugins.command(short_help="Try every property on each component of a plugin.")
@click.argument("distributions", metavar="[DISTRIBUTION]...", nargs=-1)
@click.option("--verbose", is_flag=True, help="Show every property, held, failed and skipped.")
@json_option
@click.pass_context
def check(
    context: click.Context, distributions: tuple[str, ...], verbose: bool, as_json: bool
) -> None:
    """Tries every property of its interface on each component of a distribution.

    Without a name those of all plugins are tried. `pbdkit` is the distribution of the built-in
    components. Exits 3 where something fails, or a plugin does not load.
    """
    from pbdkit.testing import examine_all

    rows, holds = [], True
    for plugin in _asked_for(distributions):
        if plugin.fault:
            holds = False
            click.echo(f"{plugin} is {plugin.fault}", err=True)
        for report in examine_all(plugin.components):
            holds = holds and report.holds
            rows.append({"distribution": plugin.distribution} | asdict(report))
            if not as_json:
                click.echo(report if verbose else _told(report))
    if as_json:
        click.echo(json.dumps({"holds": holds, "reports": rows}))
    elif holds:
        tried = "1 example" if len(rows) == 1 else f"{len(rows)} examples"
        click.echo(f"all properties hold for {tried} of its components")
    context.exit(0 if holds else 3)


def _rows(plugin: Plugin) -> list[dict[str, str]]:
    """One of the plugin and one of each of its components."""
    rows = [("plugin", plugin.name, plugin.state, plugin.reason)]
    for offer in plugin.offers:
        interface = offer.interface.__name__ if offer.interface else ""
        rows.append((interface, offer.name, offer.state, offer.reason))
    for command in plugin.commands:
        taken = command.name in own_commands()
        reason = f"pbdkit has a command '{command.name}'" if taken else ""
        rows.append(("command", command.name, "conflict" if taken else "ok", reason))
    origin = {"distribution": plugin.distribution, "version": plugin.version}
    return [
        {"interface": kind, "type": name, **origin, "state": state, "reason": reason}
        for kind, name, state, reason in rows
    ]


def _asked_for(distributions: tuple[str, ...]) -> list[Plugin]:
    """The plugins of these distributions, or all but the built-in one.

    Raises PluginError for a name that is not installed, and where there is no plugin at all.
    """
    from pbdkit.errors import PluginError, did_you_mean
    from pbdkit.plugin import BUILTIN
    from pbdkit.plugin.discovery import canonical
    from pbdkit.plugin.registry import Registry

    known: dict[str, list[Plugin]] = {}
    for plugin in Registry().plugins:
        known.setdefault(canonical(plugin.distribution), []).append(plugin)
    asked = distributions or [name for name in known if name != BUILTIN]
    if not asked:
        raise PluginError(
            "no plugin is installed; `pbdkit plugins check pbdkit` tries what is built in"
        )
    for name in asked:
        if canonical(name) not in known:
            hint = did_you_mean(name, [own[0].distribution for own in known.values()])
            raise PluginError(f"'{name}' is not installed, or is no plugin{hint}")
    return [plugin for name in asked for plugin in known[canonical(name)]]


def _told(report: Report) -> str:
    faults = [f"  failed  {outcome.property}: {outcome.reason}" for outcome in report.failed]
    return "\n".join([report.summary(), *faults])


PREFIX = f"{BUILTIN}-"
TAKEN = {*keyword.kwlist, "Literal", "Field"}
"""What a class in the module cannot be called."""
DEFAULT_PARTS = {
    "lattice": "{type: square, a: 1.0}",
    "neighbours": "{type: coordination, shells: 1}",
    "rule": "{type: barycentre}",
    "frame": "{type: mean}",
    "fracture": "{type: none}",
    "operations": "[]",
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
        own = f"{{type: {self.type}}}"
        own = f"[{own}]" if self.field in LISTS else own
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
