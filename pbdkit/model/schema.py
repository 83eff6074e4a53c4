"""JSON Schema of experiments with the installed components."""

from __future__ import annotations

import json
import re
from itertools import chain
from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from pbdkit.model.experiment import Experiment
from pbdkit.plugin import INTERFACES, LISTS
from pbdkit.plugin.discovery import RETIRED, Retired
from pbdkit.plugin.registry import Registry

DIALECT = "https://json-schema.org/draft/2020-12/schema"
"""Dialect of the schema."""
SECTIONS = re.compile(r"\n\n[A-Z]\w+\n-+\n")
"""Beginning of the sections of a docstring. They are meant for Python users and are omitted."""


def experiment_schema(registry: Registry, *, installed: bool = True) -> dict[str, Any]:
    """Return the JSON Schema of experiment files.

    Parameters
    ----------
    registry
        Components.
    installed
        Whether to include installed components. Otherwise the schema contains the built-in ones
        only.
    """
    offered = {
        field: registry.spellings(interface, installed=installed)
        for field, interface in INTERFACES.items()
    }
    models: chain[type[BaseModel]] = chain([Experiment], *offered.values())
    names, combined = models_json_schema([(model, "validation") for model in models])
    definitions = combined["$defs"]
    top = definitions.pop(names[Experiment, "validation"]["$ref"].split("/")[-1])
    for field, components in offered.items():
        for component, spellings in components.items():
            described = names[component, "validation"]["$ref"].rsplit("/", 1)[-1]
            named = definitions[described]["properties"]["type"]
            named.pop("const", None)
            named |= {"const": spellings[0]} if len(spellings) == 1 else {"enum": spellings}
            named["default"] = spellings[0]
        part, choice = top["properties"][field], [dict(names[c, "validation"]) for c in components]
        if field in LISTS:
            part["items"] = {"oneOf": choice} if choice else False
        else:
            kept = {k: v for k, v in part.items() if k in ("default", "description")}
            choice += [_deprecated(retired) for retired in RETIRED if retired.field == field]
            top["properties"][field] = {"oneOf": choice} | kept
    for model in [top, *definitions.values()]:
        if "description" in model:
            model["description"] = SECTIONS.split(model["description"])[0]
    everything = json.dumps([top, definitions], ensure_ascii=False)
    used = sorted(name for name in definitions if f'"#/$defs/{name}"' in everything)
    top |= {"title": "pbdkit experiment", "$defs": {name: definitions[name] for name in used}}
    return {"$schema": DIALECT, "title": top["title"], **top}


def _deprecated(retired: Retired) -> dict[str, Any]:
    return {
        "additionalProperties": False,
        "deprecated": True,
        "description": retired.advice,
        "properties": {"type": {"const": retired.type, "title": "Type", "type": "string"}},
        "required": ["type"],
        "type": "object",
    }
