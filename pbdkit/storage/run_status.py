"""How far an unfinished run is."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

from pbdkit.errors import StorageError
from pbdkit.storage.file_system import lock
from pbdkit.storage.run_files import has_committed, is_left, store_of
from pbdkit.storage.unfinished import UnfinishedRun


def status_of(output: Path) -> dict[str, Any] | None:
    """Of the unfinished run of an output: `step`, `steps`, `rate` in steps a second, `left_s`,
    seconds to its end if it goes on so, `age_s`, seconds since it was kept, and `state`, running or
    stopped; None where there is no such run."""
    try:
        return _status(output) if has_committed(output) else None
    except StorageError:
        if is_left(output):
            raise
        return None  # it was finished meanwhile


def _status(output: Path) -> dict[str, Any]:
    left = UnfinishedRun.open(output, writing=False)
    try:
        about, facts = left.about, left.facts
        running = not lock(left.disk)
        steps = int(about["steps"])
        step = steps if "finished" in facts else int(facts["step"])
        rate = float(facts.get("rate", 0.0))
        age = max(0.0, time.time() - float(facts.get("at", math.inf)))  # clocks are set back
        remaining = max(0.0, (steps - step) / rate - age) if rate > 0.0 else None
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise StorageError(f"{store_of(output)}: is damaged: {error}") from None
    finally:
        left.close()
    state = "running" if running else "stopped"
    found = {"step": step, "steps": steps, "rate": rate, "left_s": remaining, "age_s": age}
    return found | {"state": state}
