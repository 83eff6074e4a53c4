"""The verdict of the spectrum on the numbers as they are: stable, slow or diverging, and why."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass

from pbdkit.experiment.model import Experiment
from pbdkit.prediction.analysis import Analysis
from pbdkit.scene.scene import build_scene

LARGEST = 4000
"""Particles of which the spectrum is found in about a second."""
SLOW = 2000
"""Steps to a thousandth from which on a body is called slow."""


@dataclass(frozen=True)
class Judgement:
    """In one word, "stable", "slow", "diverging" or "unknown", and why."""

    word: str
    why: str


def judged(experiment: Experiment) -> Judgement:
    """Of the body as it starts, at rest unless the experiment says otherwise."""
    try:
        scene = build_scene(experiment)
        if scene.raster.count > LARGEST:
            size = f"the body has more than {LARGEST} particles"
            return Judgement("unknown", f"{size}; `pbdkit check` tells of larger ones")
        analysis = Analysis(scene)
        return _worded(analysis)
    except Exception as error:  # whatever a plugin raises, the session goes on
        return Judgement("unknown", str(error) or type(error).__name__)


def _worded(analysis: Analysis) -> Judgement:
    radius, stable = analysis.spectral_radius, analysis.stable
    if radius is None:
        left = analysis.left_out
        return Judgement("unknown", left[0] if left else "these steps have no spectrum")
    if not stable:
        bound = analysis.largest_stable_relaxation
        remedy = f"; relaxation below {bound:.4g} is stable" if bound else ""
        return Judgement("diverging", f"the fastest mode grows {radius:.4g} times a step{remedy}")
    steps = analysis.steps_to["1e-3"]
    if steps is None:
        return Judgement("slow", "a mode neither grows nor shrinks: nothing holds it")
    fading = f"the slowest mode shrinks to a thousandth in {steps} steps"
    if steps <= SLOW:
        return Judgement("stable", fading)
    best = analysis.best_memory
    own = analysis.scene.experiment.stepping.memory
    remedy = f"; memory {best:.4g} is fastest" if best and not math.isclose(best, own) else ""
    return Judgement("slow", fading + remedy)


class Judge:
    """Judges in a thread of its own, the newest experiment that it was given."""

    def __init__(self, tell: Callable[[Judgement], None]) -> None:
        self._tell, self._asked = tell, threading.Condition()
        self._newest: Experiment | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._work, name="judge", daemon=True)
        self._thread.start()

    def ask(self, experiment: Experiment) -> None:
        """Of this experiment, unless another is asked of before its turn."""
        with self._asked:
            self._newest = experiment
            self._asked.notify()

    def close(self) -> None:
        """Ends the thread once it has judged what it is at."""
        with self._asked:
            self._closed = True
            self._asked.notify()

    def _work(self) -> None:
        while True:
            with self._asked:
                self._asked.wait_for(lambda: self._closed or self._newest is not None)
                if self._closed:
                    return
                experiment, self._newest = self._newest, None
            assert experiment
            self._tell(judged(experiment))
