"""Where a run stands: all that decides how it goes on, as facts and arrays, and back again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.errors import StorageError

Arrays = dict[str, Any]
"""Arrays by name; some are joined from parts when they are asked for."""


@dataclass(frozen=True)
class Standing:
    """What a run needs to go on: `about` what was asked for and stays, `facts` what JSON can say,
    and the arrays that the facts name."""

    about: dict[str, Any]
    facts: dict[str, Any]
    arrays: Arrays = field(default_factory=dict)

    def copied(self) -> Standing:
        """The same in arrays of its own."""
        arrays = {name: array.copy() for name, array in self.arrays.items()}
        return Standing(self.about, self.facts, arrays)


def taken_apart(value: Any, name: str, arrays: Arrays) -> Any:
    """A value as facts; its arrays go into `arrays`, under names that begin with `name`."""
    if hasattr(value, "dtype") and not isinstance(value, np.generic):
        arrays[name] = value
        return {"array": name}
    if is_dataclass(value):
        parts = {f.name: getattr(value, f.name) for f in fields(value)}
        inner = {key: taken_apart(part, f"{name}.{key}", arrays) for key, part in parts.items()}
        return {"is": type(value).__name__, **inner}
    if isinstance(value, dict):
        return {key: taken_apart(part, f"{name}.{key}", arrays) for key, part in value.items()}
    if isinstance(value, tuple | list):
        return [taken_apart(part, f"{name}.{n}", arrays) for n, part in enumerate(value)]
    return value.item() if isinstance(value, np.generic) else value


def put_together(facts: Any, arrays: Mapping[str, NDArray[Any]], kinds: Mapping[str, type]) -> Any:
    """The value of such facts; `kinds` are the dataclasses that may occur, by name. Raises
    StorageError for anything else."""
    if isinstance(facts, list):
        return tuple(put_together(part, arrays, kinds) for part in facts)
    if not isinstance(facts, dict):
        return facts
    try:
        if "array" in facts:
            return arrays[facts["array"]]
        parts = {key: put_together(p, arrays, kinds) for key, p in facts.items() if key != "is"}
        return kinds[facts["is"]](**parts) if "is" in facts else parts
    except (KeyError, TypeError) as error:
        raise StorageError(f"the state of a run is damaged: {error}") from None
