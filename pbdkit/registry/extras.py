"""Libraries that pbdkit does without, unless something asks for them."""

from __future__ import annotations

from importlib.util import find_spec

from pbdkit.errors import ExperimentError


def refuse_without(library: str, extra: str, said: str) -> None:
    """Raises ExperimentError, with what is `said` to need it and the extra that brings it, where
    the library is not installed."""
    if find_spec(library) is None:
        raise ExperimentError(f"{said}: pip install 'pbdkit[{extra}]'")


def refuse_no_matplotlib() -> None:
    """Raises ExperimentError where there is none."""
    refuse_without("matplotlib", "plot", "pictures need matplotlib")
