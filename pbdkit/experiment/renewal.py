"""Experiments that name retired components, with their successors instead."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

from pbdkit.errors import ExperimentError, warn_caller
from pbdkit.experiment.source import Source
from pbdkit.registry.retired import Retired, retired_parts, with_successors


def renewed(parts: dict[str, Any], source: Source) -> tuple[dict[str, Any], Source, list[Retired]]:
    """Return the parts with successors of what is retired, a source that holds them, and what was
    retired."""
    retired = retired_parts(parts)
    if retired:
        parts = with_successors(parts)
        source = source if source.data is None else replace(source, data=parts)
    return parts, source, retired


def announce(retired: Iterable[Retired], source: Source, fields: Mapping[str, Any]) -> None:
    """Warn of retired components that an experiment with these fields named.

    Raises ExperimentError where particles are chosen by numbers, which are those of other
    particles under the successor.
    """
    for one in retired:
        where = next(_numbered(fields), None) if one.renumbers else None
        if where:
            text = (
                f"its numbers are those of particles under {one.field} '{one.type}', which is "
                f"retired; under '{one.successor}' particles have others: choose them by place, "
                f"or by their new numbers with {one.field}: {{type: {one.successor}}}"
            )
            error = ExperimentError(source.message(where, text), where)
            error.located = True
            raise error
        warn_caller(source.message((one.field, "type"), one.advice))


def _numbered(fields: Mapping[str, Any]) -> Iterator[tuple[str | int, ...]]:
    """The fields that choose particles by their numbers."""
    for field in ("leaders", "loads"):
        for n, group in enumerate(fields[field]):
            if group.select.numbers:
                yield field, n, "select", "numbers"
    for n, diagnostic in enumerate(fields["diagnostics"]):
        if getattr(diagnostic, "numbers", None):
            yield "diagnostics", n, "numbers"
