"""Kernels that Python itself runs, from the source that is else compiled."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest


@contextmanager
def interpreting() -> Iterator[None]:
    """Interpret kernels within this context, here and in processes that are started: compiling each
    of them takes seconds. `stepping/numba_engine/test_engine` lists those that are compiled."""
    with pytest.MonkeyPatch.context() as patch, np.errstate(all="ignore"):
        patch.setattr("numba.config.DISABLE_JIT", 1)
        patch.setenv("NUMBA_DISABLE_JIT", "1")
        yield
