"""Command ``pbdkit schema``, which prints the JSON Schema of files."""

from __future__ import annotations

import json

import click

from pbdkit.hooks import import_object
from pbdkit.plugin.registry import Registry

SCHEMAS = {
    "experiment": "pbdkit.model.schema:experiment_schema",
    "dataset": "pbdkit.io.layout:dataset_schema",
    "sweep": "pbdkit.sweeps.specification:sweep_schema",
    "fit": "pbdkit.fitting.fit_file:fit_schema",
}
"""Functions that return schemas. Only the requested one is imported."""


def schema(what: str, builtin: bool) -> None:
    """Print the JSON Schema of experiments, datasets, sweeps or fits."""
    schema_of = import_object(SCHEMAS[what])
    has_components = what in ("experiment", "dataset")
    result = schema_of(Registry(), installed=not builtin) if has_components else schema_of()
    click.echo(json.dumps(result, indent=2))
