"""The JSON Schema of datasets, in the form of ``xarray.Dataset.to_dict(data=False)``."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from pbdkit.experiment.schema import DIALECT
from pbdkit.interfaces import Component, Diagnostic
from pbdkit.registry.registry import Registry
from pbdkit.results import layout
from pbdkit.results.layout import Column

ATTRIBUTES = (
    "Conventions", "schema_version", "title", "pbdkit_version", "experiment", "plugins",
    "prediction", "status", "stop_reason", "created",
)  # fmt: skip


def dataset_schema(registry: Registry, *, installed: bool = True) -> dict[str, Any]:
    """What a dataset holds; without `installed`, of the built-in diagnostics alone."""
    base = layout.base_columns()
    optional = [*layout.bond_columns(), *layout.broken_columns(), layout.step_column()]
    optional.append(layout.leader_column())
    for diagnostic in registry.components(Diagnostic, installed=installed).values():
        optional += _columns_of(diagnostic)
    columns = base + optional
    strings: dict[str, Any] = {name: {"type": "string"} for name in ATTRIBUTES}
    strings["status"] = {"enum": list(layout.STATUSES)}
    strings["schema_version"] = {"const": layout.SCHEMA_VERSION}
    return {
        "$schema": DIALECT,
        "title": "pbdkit dataset",
        "type": "object",
        "required": ["attrs", "coords", "data_vars", "dims"],
        "properties": {
            "attrs": {"type": "object", "properties": strings, "required": list(ATTRIBUTES)},
            "dims": {"type": "object", "additionalProperties": {"type": "integer"}},
            "coords": _group([c for c in columns if c.coordinate], base),
            "data_vars": _group([c for c in columns if not c.coordinate], base),
        },
    }


def _columns_of(diagnostic: type[Component]) -> list[Column]:
    """The columns of a diagnostic, asked of one whose parameters are not set; where variables
    depend on parameters, or cannot be had, the schema leaves them open."""
    assert issubclass(diagnostic, Diagnostic)
    try:
        variables = diagnostic.model_construct(type="").variables()
        columns = [layout.diagnostic_column(v, diagnostic) for v in variables]
        json.dumps([_described(column) for column in columns])
    except Exception:  # it is somebody's code, which nobody asked to run
        return []
    return columns


def _group(columns: list[Column], required: list[Column]) -> dict[str, Any]:
    names = [c.name for c in columns if c in required]
    return {
        "type": "object",
        "required": names,
        "properties": {c.name: _described(c) for c in columns},
    }


def _described(column: Column) -> dict[str, Any]:
    attributes = {
        name: {"const": value}
        for name, value in column.attributes.items()
        if not isinstance(value, np.ndarray)
    }
    dtype = {} if column.dtype == "str" else {"dtype": {"const": np.dtype(column.dtype).name}}
    return {
        "type": "object",
        "description": f"{column.attributes['long_name']}; written {column.when.value}",
        "required": ["dims", "attrs", "dtype"],
        "properties": {
            "dims": {"const": list(column.dims)},
            "attrs": {
                "type": "object",
                "properties": attributes,
                "required": sorted(attributes),
            },
            **dtype,
        },
    }
