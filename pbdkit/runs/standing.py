"""Where a run stands, between two steps."""

from __future__ import annotations

import time
from importlib.metadata import version

from pbdkit.results.recorder import Recorder
from pbdkit.runs.drivers import Driver
from pbdkit.storage.standing import Arrays, Standing, taken_apart


def standing_of(driver: Driver, recorder: Recorder, rate: float = 0.0) -> Standing:
    """All that decides how the run goes on, its arrays as they are, not copied; `rate` is told to
    those who ask how far it is, in steps a second."""
    arrays, experiment = Arrays(), driver.scene.experiment
    facts = {
        "run": taken_apart(driver.standing(), "run", arrays),
        "seen": taken_apart(recorder.seen, "seen", arrays),
        "chosen": list(driver.chosen),
        "step": driver.state.step,
        "rate": rate,
        "at": time.time(),
    }
    about = {
        "name": experiment.name,
        "steps": experiment.steps,
        "experiment": experiment.model_dump_json(by_alias=True),
        "plugins": experiment.distributions(),
        "pbdkit": version("pbdkit"),
    }
    return Standing(about, facts, arrays)
