"""The rows of the goal table: each measures one ratio, in one run."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from bare import sweeping
from fresh import bytes_a_particle
from pairing import Ratio, of_times, ratio, wait_for_quiet
from recording import recording
from sheets import (
    CELLS,
    COMPOSITE,
    DAMAGE,
    DISTANCE,
    ELASTIC,
    FRACTURE,
    NATURAL,
    OWN,
    SCATTERED,
    Afresh,
    Everywhere,
    Moved,
    Running,
    Sharing,
    moving,
    pulled,
    stiffened,
)

BUSY = "measured while other programs computed: the second processor was not free"


@dataclass(frozen=True)
class Goal:
    """A goal with its measurement. `at_most` is true if the measurement must not exceed `goal`."""

    name: str
    goal: float
    at_most: bool
    measured: float
    low: float
    high: float
    unit: str
    note: str

    @property
    def met(self) -> bool:
        return self.measured <= self.goal if self.at_most else self.measured >= self.goal


def at_most(name: str, goal: float, found: Ratio, note: str = "", unit: str = "×") -> Goal:
    return Goal(name, goal, True, found.value, found.low, found.high, unit, note)


def at_least(name: str, goal: float, found: Ratio, note: str = "") -> Goal:
    return Goal(name, goal, False, found.value, found.low, found.high, "×", note)


def all_goals() -> Iterator[Goal]:
    for rows in (
        against_bare,
        against_plain,
        threads,
        reach,
        third_party,
        record,
        memory,
        start_up,
    ):
        yield from rows()


def against_bare() -> Iterator[Goal]:
    steps, size = 20, 1000
    bare = sweeping(size, steps)
    for name, goal, parts in (
        (
            "time of a barycentre step, 1000², 4 neighbours, all in motion, divided by that of the "
            "bare sweep",
            1.2,
            {},
        ),
        ("time of a distance-weighted step divided by that of the bare sweep", 1.6, DISTANCE),
        (
            "time of a step with irreversible fracture divided by that of the bare sweep",
            1.4,
            FRACTURE,
        ),
        (
            "time of a step of *elastic 2×2 weights*, 8 neighbours, divided by that of the bare "
            "sweep",
            1.5,
            ELASTIC,
        ),
    ):
        found = ratio(Running(moving(size, **parts), steps), bare, 11)
        note = f"{found.first_s / steps / size**2 * 1e9:.2f} ns per particle and step, bare sweep "
        yield at_most(name, goal, found, note + f"{found.second_s / steps / size**2 * 1e9:.2f}")


def against_plain() -> Iterator[Goal]:
    """Measure the additional memory of a scene, against the same scene without the feature."""
    steps, size, turns = 4, 1000, 60
    for name, goal, parts, plain, changed in (
        (
            "time of a step of elastic with the natural frame divided by that of elastic",
            1.7,
            NATURAL,
            CELLS,
            None,
        ),
        (
            "time of a step of elastic with a stiffness for every cell divided by that of elastic",
            1.5,
            NATURAL,
            CELLS,
            stiffened,
        ),
        (
            "time of a step of elastic with stiffness by region divided by that with one stiffness",
            1.5,
            COMPOSITE,
            NATURAL,
            None,
        ),
        (
            "time of a step with `strain` and scatter divided by that with `threshold`",
            2.0,
            SCATTERED,
            FRACTURE,
            None,
        ),
        (
            "time of a step with `damage` divided by that with `threshold`",
            2.5,
            DAMAGE,
            FRACTURE,
            None,
        ),
    ):
        first = Moved(moving(size, **parts), steps, changed=changed)
        sheets = (first, Moved(moving(size, **plain), steps))
        times: list[list[float]] = [[], []]
        for _ in range(turns):
            for mine, sheet in zip(times, sheets, strict=True):
                sheet()
                mine.append(sheet.seconds)
        yield at_most(f"{name}, 1000²", goal, of_times(*times))


def threads() -> Iterator[Goal]:
    one, two = (Running(moving(3000, **DISTANCE), 4, threads=n) for n in (1, 2))
    quiet = wait_for_quiet()
    # Many turns: in some of them, hopefully, no other process uses the second processor.
    found = ratio(one, two, 41)
    yield at_least(
        "speed of two threads divided by that of one, 3000², distance-weighted",
        1.7,
        found,
        "" if quiet else BUSY,
    )


def reach() -> Iterator[Goal]:
    reached, everything = Afresh(pulled(1000), 200), Afresh(pulled(1000), 200)
    everything.engine._extent = Everywhere(everything.engine._extent)
    everything.engine._arrays["sizes"][0] = 1  # one step a pass, as what has been reached
    found = ratio(everything, reached, 7)
    assert (reached.state.u == everything.state.u).all()
    name = (
        "leaders at one edge, 1000², first 200 steps: time if all particles are computed, divided "
        "by that of pbdkit"
    )
    yield at_least(name, 12, found, "the results are equal to the last bit")


def third_party() -> Iterator[Goal]:
    # On one and the same arrays: where arrays happen to lie in memory makes several per cent.
    own, built_in = Running(moving(1000, **OWN), 40), Running(moving(1000), 40)
    found = ratio(Sharing(own, own), Sharing(own, built_in), 15)
    yield at_most(
        "time of the third-party rule divided by that of the built-in rule with the same "
        "arithmetic",
        1.05,
        found,
    )


def record() -> Iterator[Goal]:
    found, note = recording(1000, 200, 10)
    name = "time of recording every 10th step of 1000² divided by that of raw writing and stepping"
    yield at_most(name, 1.3, found, note)


def memory() -> Iterator[Goal]:
    found, note = bytes_a_particle(3000)
    name = "memory per particle, 3000², only the last step recorded, output included"
    yield Goal(name, 120, True, found, found, found, "B", note)


def start_up() -> Iterator[Goal]:
    program = str(Path(sys.executable).with_name("pbdkit"))
    with tempfile.TemporaryDirectory() as folder:
        out = str(Path(folder) / "a.nc")
        for name, goal, call in (
            ("pbdkit --help", 2, [program, "--help"]),
            ("pbdkit check paper/a", 5, [program, "check", "paper/a"]),
            ("pbdkit run paper/a", 10, [program, "run", "paper/a", "-o", out, "--force"]),
        ):
            found = _processes(call, [sys.executable, "-c", "import numpy"], 20)
            note = f"{found.first_s * 1e3:.0f} ms against {found.second_s * 1e3:.0f} ms"
            yield at_most(
                f'time of `{name}` divided by that of `python -c "import numpy"`', goal, found, note
            )


def _processes(first: list[str], second: list[str], turns: int) -> Ratio:
    return ratio(_process(first), _process(second), turns)


def _process(call: list[str]) -> Callable[[], object]:
    """The bytecode of what is imported is kept, as pip keeps it of what it installs."""
    env = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    return lambda: subprocess.run(call, check=True, capture_output=True, env=env)
