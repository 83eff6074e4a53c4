"""What an experiment and its regions may be called."""

from __future__ import annotations

import re
from typing import Annotated

from pydantic import AfterValidator, Field

from pbdkit.experiment.parts import brief, fault
from pbdkit.interfaces.fields import RESERVED


def _valid_name(name: str) -> str:
    words = name.split("/")
    if len(name) > 200 or ".." in name or not all(re.fullmatch(_WORD, word) for word in words):
        raise fault(
            "may hold letters, digits, '.', '_', '-' and '/', no '..', and no part between slashes "
            f"that is empty or begins with a dot; got {brief(name)}"
        )
    return name


def _known_version(version: int) -> int:
    if version != 1:
        raise fault(f"this pbdkit reads version 1, got {brief(version)}")
    return version


_WORD = r"[A-Za-z0-9_-][A-Za-z0-9._-]*"
Name = Annotated[
    str, AfterValidator(_valid_name), Field(json_schema_extra={"pattern": f"^{_WORD}(/{_WORD})*$"})
]
Version = Annotated[int, AfterValidator(_known_version), Field(json_schema_extra={"const": 1})]


def _region(name: str) -> str:
    if name in RESERVED or not re.fullmatch(_WORD, name):
        raise fault(
            f"a region's name may hold letters, digits, '.', '_' and '-', and be none of "
            f"{', '.join(RESERVED)}; got {brief(name)}"
        )
    return name


RegionName = Annotated[str, AfterValidator(_region)]
