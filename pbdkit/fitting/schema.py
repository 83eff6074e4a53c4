"""The JSON Schema of fit files."""

from __future__ import annotations

from typing import Any

from pydantic import TypeAdapter

from pbdkit.experiment.schema import DIALECT
from pbdkit.fitting.specification import Fit
from pbdkit.fitting.strength_specification import StrengthFit


def fit_schema() -> dict[str, Any]:
    """Of both kinds; what stands under `experiment` is left to the schema of experiments."""
    described = TypeAdapter[Any](Fit | StrengthFit).json_schema(by_alias=True)
    return {"$schema": DIALECT, **described, "title": "pbdkit fit"}
