"""JSON Schema of fit files."""

from __future__ import annotations

from typing import Any

from pydantic import TypeAdapter

from pbdkit.fitting.fit_file import Fit
from pbdkit.fitting.strength import StrengthFit
from pbdkit.model.schema import DIALECT


def fit_schema() -> dict[str, Any]:
    """Return the JSON Schema of fit files of both kinds, without that of their experiments."""
    schema = TypeAdapter[Any](Fit | StrengthFit).json_schema(by_alias=True)
    return {"$schema": DIALECT, **schema, "title": "pbdkit fit"}
