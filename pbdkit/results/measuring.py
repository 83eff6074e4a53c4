"""What diagnostics declare and what they give: refused where it does not fit."""

from __future__ import annotations

from typing import Any

import numpy as np

from pbdkit.errors import PluginError
from pbdkit.interfaces import Diagnostic, Moment, Variable
from pbdkit.registry.blame import blaming


def measured_at_end(diagnostic: Diagnostic, now: Moment, sizes: dict[str, int]) -> dict[str, Any]:
    """The values of a diagnostic that is asked once, after the last step, by variable.

    Raises PluginError where they do not have the shape that is declared; values that are not
    finite stay: the run may have ended because of them.
    """
    values, own = {}, diagnostic.own_dimension
    with blaming(diagnostic, "at the end"):
        for variable, value in zip(diagnostic.variables(), diagnostic.measure(now), strict=True):
            if own in variable.dims and np.ndim(value) == len(variable.dims):
                # The first variable that has the dimension gives its length, the others keep to it.
                sizes = {own: np.shape(value)[variable.dims.index(own)]} | sizes
            shape = tuple(sizes.get(dim, -1) for dim in variable.dims)
            if np.shape(value) != shape:
                raise ValueError(f"'{variable.name}' has the shape {np.shape(value)}, not {shape}")
            values[variable.name] = np.array(value)
    return values


def refuse_unknown(
    diagnostic: Diagnostic, variable: Variable, dims: set[str], names: set[str]
) -> None:
    """Raises PluginError for a name that is taken, or a dimension that nobody gives a length."""
    what = f"Diagnostic '{diagnostic.type}' declares the variable '{variable.name}'"
    if variable.name in names:
        raise PluginError(f"{what}, and that name is taken")
    if unknown := [dim for dim in variable.dims if dim not in dims]:
        raise PluginError(f"{what} with the dimension '{unknown[0]}', which it gives no values")


def refuse_unfit(variable: Variable, value: Any, shape: tuple[int, ...], step: int) -> None:
    """Raises ValueError for another shape than declared, FloatingPointError for what is not
    finite."""
    if np.shape(value) != shape:
        raise ValueError(f"'{variable.name}' has the shape {np.shape(value)}, not {shape}")
    finite = np.isfinite(value)
    if not finite.all():
        place = np.argwhere(~finite)[0]
        whose = f"particle {place[0] + 1}" if variable.dims[:1] == ("particle",) else "the run"
        raise FloatingPointError(f"{variable.name} of {whose} at step {step}")
