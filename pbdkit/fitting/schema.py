"""The JSON Schema of fit files."""

from __future__ import annotations

from typing import Any

from pydantic import TypeAdapter

from pbdkit.fitting.specification import Fit
from pbdkit.fitting.strength import StrengthFit
from pbdkit.model.schema import DIALECT


def fit_schema() -> dict[str, Any]:
    """Of both kinds; what stands under `experiment` is left to the schema of experiments."""
    described = TypeAdapter[Any](Fit | StrengthFit).json_schema(by_alias=True)
    return {"$schema": DIALECT, **described, "title": "pbdkit fit"}
