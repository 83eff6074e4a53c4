"""A question to a component: one call of its functions with arrays that are kept, so that answers
can be compared and the arrays looked at afterwards."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

Arrays = dict[str, Any]


@dataclass(frozen=True)
class Question:
    """One call: `what` is called, with which arrays, and how; answers are values by name.

    An `elementwise` one is asked with arrays of one shape, a value a particle or bond.
    """

    what: str
    inputs: Arrays
    ask: Callable[[Arrays], Arrays]
    elementwise: bool = False

    def answer(self) -> Arrays:
        """The answer to fresh copies of the inputs, as it was at that moment."""
        with np.errstate(all="ignore"):
            found = self.ask({name: np.array(value) for name, value in self.inputs.items()})
        return {name: np.array(value) for name, value in found.items()}

    def larger(self) -> Question:
        """The same with all that is no index ten times as large."""
        return replace(
            self,
            inputs={n: 10.0 * v if v.dtype.kind == "f" else v for n, v in self.inputs.items()},
        )
