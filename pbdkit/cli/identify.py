"""``pbdkit identify``: what a rule is physically."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import click

from pbdkit.cli.options import experiment_argument, json_option, set_option, verbose_option

if TYPE_CHECKING:
    from pbdkit.identity.identity import Identity


@click.command()
@experiment_argument
@set_option
@verbose_option
@json_option
def identify(experiment: str, settings: tuple[str, ...], verbose: bool, as_json: bool) -> None:
    """Say what the experiment's rule is physically, on its lattice and neighbours: diffusion or an
    elastic body, and with which constants."""
    from pbdkit.api import identify, load
    from pbdkit.cli.waiting import waiting

    materials = load(experiment, settings=settings).materials()
    with waiting("identifying", silent=as_json):
        every = {name: identify(one) for name, one in materials.items()}
    if as_json:
        alone = every.get("")
        told = alone.as_dict() if alone else {name: f.as_dict() for name, f in every.items()}
        click.echo(json.dumps(told))
        return
    alike: dict[str, list[str]] = {}
    for name, found in every.items():
        alike.setdefault(json.dumps(found.as_dict()), []).append(name)
    for names in alike.values():
        _show(every[names[0]], ", ".join(filter(None, names)), verbose)
    for note in dict.fromkeys(note for found in every.values() for note in found.notes):
        names = [name for name, found in every.items() if note in found.notes]
        of = f" ({', '.join(names)})" if len(names) < len(every) else ""
        click.echo(f"note{of}: {note}")


def _show(found: Identity, materials: str, verbose: bool) -> None:
    """The table of one material, or of several that are the same."""
    from pbdkit.cli.output import show_table
    from pbdkit.identity.verdict import table

    where = f" ({materials})" if materials else ""
    click.echo(f"{found.name}: {found.rule}{where}, {found.lattice} lattice, {found.neighbours}")
    show_table(table(found, whole=verbose))
