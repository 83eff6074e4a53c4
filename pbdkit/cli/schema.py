"""``pbdkit schema``."""

from __future__ import annotations

import json

import click


@click.command()
@click.argument("what", type=click.Choice(["experiment", "dataset"]), default="experiment")
@click.option("--builtin", is_flag=True, help="Leave third-party components out.")
def schema(what: str, builtin: bool) -> None:
    """Print the JSON Schema of experiments or datasets, closed over what is installed."""
    from pbdkit.experiment.schema import experiment_schema
    from pbdkit.registry.registry import Registry
    from pbdkit.results.schema import dataset_schema

    make = {"experiment": experiment_schema, "dataset": dataset_schema}[what]
    click.echo(json.dumps(make(Registry(), installed=not builtin), indent=2))
