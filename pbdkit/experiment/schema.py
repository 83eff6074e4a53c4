"""The JSON Schema of experiments, closed over what is installed."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from pbdkit.experiment.model import Experiment
from pbdkit.interfaces import INTERFACES
from pbdkit.registry.registry import Registry

DIALECT = "https://json-schema.org/draft/2020-12/schema"


def experiment_schema(registry: Registry, *, installed: bool = True) -> dict[str, Any]:
    """What an experiment file may hold; without `installed`, of the built-in components alone."""
    offered = {
        field: registry.spellings(interface, installed=installed)
        for field, interface in INTERFACES.items()
    }
    models: list[type[BaseModel]] = [
        Experiment,
        *(c for components in offered.values() for c in components),
    ]
    names, together = models_json_schema([(model, "validation") for model in models])
    definitions = together["$defs"]
    top = definitions.pop(names[Experiment, "validation"]["$ref"].split("/")[-1])
    for field, components in offered.items():
        choice = {"oneOf": [dict(names[c, "validation"]) for c in components]}
        for component, spellings in components.items():
            described = names[component, "validation"]["$ref"].rsplit("/", 1)[-1]
            _close(definitions[described]["properties"]["type"], spellings)
        part = top["properties"][field]
        if field == "diagnostics":
            part["items"] = choice
        else:
            default = {"default": part["default"]} if "default" in part else {}
            top["properties"][field] = choice | default
    used = _reachable(top, definitions)
    return {
        "$schema": DIALECT,
        "title": "pbdkit experiment",
        **{k: v for k, v in top.items() if k != "title"},
        "$defs": {name: definitions[name] for name in sorted(used)},
    }


def _close(kind: dict[str, Any], names: list[str]) -> None:
    """`type` is one of these names."""
    kind.pop("const", None)
    kind |= {"const": names[0]} if len(names) == 1 else {"enum": names}
    kind["default"] = names[0]


def _reachable(schema: Any, definitions: dict[str, Any]) -> set[str]:
    """The definitions that the schema refers to, directly or not."""
    found: set[str] = set()
    waiting = [schema]
    while waiting:
        node = waiting.pop()
        if isinstance(node, dict):
            name = str(node.get("$ref", "")).rsplit("/", 1)[-1]
            if name in definitions and name not in found:
                found.add(name)
                waiting.append(definitions[name])
            waiting += node.values()
        elif isinstance(node, list):
            waiting += node
    return found
