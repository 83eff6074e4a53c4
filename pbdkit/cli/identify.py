"""Command ``pbdkit identify``: physical identity of the rule of an experiment."""

from __future__ import annotations

import json

import click

from pbdkit.cli.tables import SIMPLE, Column, Table, show_table
from pbdkit.identification.identity import TITLE_WIDTH, Identity, rows_of
from pbdkit.identification.probe import identified
from pbdkit.model.experiment import Experiment
from pbdkit.progress import waiting
from pbdkit.scene.scene import build_scene
from pbdkit.stability.relaxation import tuned


def identify(experiment: Experiment, *, verbose: bool, as_json: bool) -> None:
    """Print the identity of the rule of an experiment, for each of its materials."""
    materials = experiment.materials()
    with waiting("identifying", silent=as_json):
        identities = {
            name: identified(tuned(build_scene(material))) for name, material in materials.items()
        }
    if as_json:
        identity = identities.get("")
        content = (
            identity.as_dict()
            if identity
            else {name: value.as_dict() for name, value in identities.items()}
        )
        click.echo(json.dumps(content))
        return
    groups: dict[str, list[str]] = {}
    for name, result in identities.items():
        groups.setdefault(json.dumps(result.as_dict()), []).append(name)
    for names in groups.values():
        _show(identities[names[0]], ", ".join(filter(None, names)), verbose)
    for note in dict.fromkeys(note for result in identities.values() for note in result.notes):
        names = [name for name, result in identities.items() if note in result.notes]
        remark = f" ({', '.join(names)})" if len(names) < len(identities) else ""
        click.echo(f"note{remark}: {note}")


def _show(identity: Identity, materials: str, verbose: bool) -> None:
    """Print the table of one material, or of several materials with the same identity."""
    remark = f" ({materials})" if materials else ""
    click.echo(
        f"{identity.name}: {identity.rule}{remark}, {identity.lattice} lattice, "
        f"{identity.neighbours}"
    )
    titles = Column(no_wrap=True, min_width=TITLE_WIDTH)
    table = Table(titles, "", box=SIMPLE, show_header=False, pad_edge=False)
    for row in rows_of(identity, whole=verbose):
        table.add_row(*row)
    show_table(table)
