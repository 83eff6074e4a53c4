"""Directives that generate reference pages at build time.

`{commands}` renders the commands of the command line from their click objects, `{keys}` the keys of
experiment files from the JSON Schema, `{claims}` the promises with their tests and figures.
"""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import click
from docutils import nodes
from ruamel.yaml import YAML
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from pbdkit.cli import program

Schema = dict[str, Any]

SCHEMA = Path(__file__).parent.parent / "schemas" / "experiment.schema.json"
"""Schema of experiments with the built-in components."""

CLAIMS = Path(__file__).parent.parent / "tests" / "reliability" / "claims.yaml"
FIGURES = Path(__file__).parent / "validation" / "trials.jsonl"

UNIT_PATTERN = "µ"
"""Part of the pattern of a text with a unit."""
LARGE = 1e9
"""Bounds of this size or more, or below its inverse, are technical and are left out."""
SHORT = 90
"""Largest number of characters of a list of values or a default in a table."""


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directives with Sphinx."""
    app.add_directive("commands", Commands)
    app.add_directive("keys", Keys)
    app.add_directive("claims", Claims)
    return {"parallel_read_safe": True}


class Commands(SphinxDirective):
    """Reference of all commands."""

    def run(self) -> list[nodes.Node]:
        """Return the sections of all commands."""
        text = "\n".join(command_sections())
        return self.parse_text_to_nodes(text, allow_section_headings=True)


class Keys(SphinxDirective):
    """Reference of all keys of an experiment."""

    def run(self) -> list[nodes.Node]:
        """Return a section for each key at the top level."""
        schema = json.loads(SCHEMA.read_text("utf-8"))
        text = "\n".join(key_sections(schema))
        return self.parse_text_to_nodes(text, allow_section_headings=True)


class Claims(SphinxDirective):
    """Table of what pbdkit promises, the tests of it and the last figures of each trial."""

    def run(self) -> list[nodes.Node]:
        """Return the table and the commits and machines of its figures."""
        for source in (CLAIMS, FIGURES):
            self.env.note_dependency(str(source))
        records = map(json.loads, FIGURES.read_text("utf-8").splitlines())
        claims = YAML(typ="safe").load(CLAIMS)
        return self.parse_text_to_nodes("\n".join(claim_rows(claims, list(records))))


def claim_rows(claims: list[dict[str, Any]], records: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the Markdown of the claims, each with the records of its last day, and of the
    machines."""
    latest: dict[str, list[dict[str, Any]]] = {}
    for record in records:
        same_day = [r for r in latest.get(record["claim"], []) if r["date"] == record["date"]]
        latest[record["claim"]] = [*same_day, record]
    yield "| claim | in every change, `tests/` | trial | every | last figures |\n| " + "--- | " * 5
    for claim in claims:
        nights = claim.get("nights", 1)
        tests = ", ".join(f"`{name}`" for name in claim["suite"])
        row = [claim["claim"], tests, f"`{cell(claim['trial'])}`"]
        row += ["night" if nights == 1 else f"{nights} nights"]
        figures = map(last_figures, latest.get(claim["claim"], [None]))
        yield "| " + " | ".join([*row, "; ".join(figures)]) + " |"
    yield "\nThe machines of these figures:\n"
    yield from sorted({f"- {machine_text(record)}" for record in chain(*latest.values())})


def last_figures(record: dict[str, Any] | None) -> str:
    """Return the text of one run of a trial."""
    if record is None:
        return "not run yet"
    outcome = "" if record["exit"] == 0 else f"**failed** (status {record['exit']}); "
    what = f"{record['date']}, `{record['commit']}`, {record['seconds']} s: {outcome}"
    return what + "; ".join(cell(line) for line in record["figures"])


def machine_text(record: dict[str, Any]) -> str:
    """Return the description of the machine of a record."""
    machine = record["machine"]
    versions = ", ".join(f"{name} {machine[name]}" for name in ("python", "numpy", "numba"))
    processors = f"{machine['processor']}, {machine['processors']} processors"
    return f"{processors}, {machine['system']}, {versions}"


def command_sections() -> Iterator[str]:
    """Yield the Markdown of each command and of the commands of its group."""
    context = click.Context(program, info_name="pbdkit")
    for name in program.list_commands(context):
        command = program.get_command(context, name)
        if command is None:
            continue
        yield from command_section(command, f"pbdkit {name}", "##")
        for inner, subcommand in sorted(getattr(command, "commands", {}).items()):
            yield from command_section(subcommand, f"pbdkit {name} {inner}", "###")


def command_section(command: click.Command, name: str, mark: str) -> Iterator[str]:
    """Yield the Markdown of one command: usage, help text and options."""
    context = click.Context(command, info_name=name)
    usage = " ".join([name, *command.collect_usage_pieces(context)])
    yield f"{mark} {name}\n\n```console\n$ {usage}\n```\n"
    yield paragraphs(inspect.cleandoc(command.help or "")) + "\n"
    records = [r for p in command.params if (r := p.get_help_record(context)) and r[1]]
    if records:
        yield "| option | effect |\n| --- | --- |"
        yield from (f"| `{cell(option)}` | {cell(text)} |" for option, text in records)
    yield ""


def paragraphs(text: str) -> str:
    r"""Return a help text as Markdown; click's `\b` marks paragraphs with their own line breaks."""
    parts = re.split(r"\n\s*\n", text.strip())
    return "\n\n".join(
        f"```text\n{part.removeprefix(chr(8)).strip(chr(10))}\n```"
        if part.startswith("\b")
        else part
        for part in parts
    )


def key_sections(schema: Schema) -> Iterator[str]:
    """Yield the Markdown of each key at the top level of an experiment."""
    models = schema["$defs"]
    required = schema["required"]
    yield "## Overview\n"
    yield "| key | value | default | |\n| --- | --- | --- | --- |"
    for name, value in schema["properties"].items():
        default, text = default_text(name, value, required), cell(value.get("description", ""))
        yield f"| `{name}` | {value_text(value, models)} | {default} | {text} |"
    yield ""
    seen: set[str] = set()
    for name, value in schema["properties"].items():
        references = [r for r in referenced(value) if r not in seen and is_object(models[r])]
        if references:
            yield f"## {name}\n"
        while references:
            reference = references.pop(0)
            if reference not in seen:
                seen.add(reference)
                yield from model_section(reference, models)
                inner = referenced(models[reference].get("properties", {}))
                references += [r for r in inner if is_object(models[r]) and r not in seen]


def model_section(name: str, models: Schema) -> Iterator[str]:
    """Yield the Markdown of one type: description and parameters."""
    model = models[name]
    properties = model.get("properties", {})
    title = properties.get("type", {}).get("const", name)
    yield f"### {title}\n"
    yield model.get("description", "").replace("``", "`") + "\n"
    rows = {key: value for key, value in properties.items() if key != "type"}
    if rows:
        yield "| parameter | value | default | |\n| --- | --- | --- | --- |"
        for key, value in rows.items():
            default = default_text(key, value, model.get("required", []))
            description = cell(value.get("description", ""))
            yield f"| `{key}` | {value_text(value, models)} | {default} | {description} |"
        yield ""


def is_object(model: Schema) -> bool:
    """Return whether a definition describes a component rather than a value."""
    return "properties" in model and "TimeDependent" not in model.get("title", "")


def referenced(part: Any) -> list[str]:
    """Return the names of the definitions that a part of a schema refers to."""
    return list(dict.fromkeys(re.findall(r'"#/\$defs/(\w+)"', json.dumps(part))))


def default_text(name: str, value: Schema, required: list[str]) -> str:
    """Return the default of a key, or the word required."""
    if name in required:
        return "required"
    if value.get("default") is None:
        return ""
    text = json.dumps(value["default"], ensure_ascii=False)
    return f"`{cell(text)}`" if len(text) <= SHORT else ""


def value_text(value: Schema, models: Schema) -> str:
    """Return a short description of the values that a schema accepts."""
    alternatives = [a for a in value.get("anyOf", value.get("oneOf", [])) if "deprecated" not in a]
    if alternatives:
        texts = [value_text(alternative, models) for alternative in alternatives]
        return ", ".join(dict.fromkeys(text for text in texts if text))
    if "$ref" in value:
        return reference_text(value["$ref"].rpartition("/")[2], models)
    if "const" in value or "enum" in value:
        constants = value.get("enum", [value.get("const")])
        return ", ".join(f"`{json.dumps(c).strip(chr(34))}`" for c in constants)
    if value.get("type") == "array":
        items = value.get("items") or next(iter(value.get("prefixItems", [])), {})
        return f"list of {value_text(items, models)}" if items else "list"
    if UNIT_PATTERN in value.get("pattern", ""):
        return "text with a unit"
    return plain_text(value)


def reference_text(name: str, models: Schema) -> str:
    """Return the name of a type, as it is written in experiments."""
    model = models[name]
    if name == "Field":
        return "[field](fields.md)"
    if "TimeDependent" in name:
        return "[time-dependent](time-dependent.md)"
    constant = model.get("properties", {}).get("type", {}).get("const")
    return f"`{constant}`" if constant else name


def plain_text(value: Schema) -> str:
    """Return the type and the bounds of a plain value."""
    kind = {"null": "", "string": "text", "object": "mapping"}.get(
        value.get("type", ""), value.get("type", "")
    )
    bounds = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}
    limits = [
        f"{sign} {value[key]:g}"
        for key, sign in bounds.items()
        if key in value and (value[key] == 0 or 1 / LARGE < abs(value[key]) < LARGE)
    ]
    return " ".join(filter(None, [kind, ", ".join(limits)]))


def cell(text: str) -> str:
    """Return a text as the content of a table cell."""
    return " ".join(text.split()).replace("|", "\\|")
