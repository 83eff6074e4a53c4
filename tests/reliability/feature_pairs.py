"""Run scenes in which any two features meet, and count the pairs of features that never do.

    python tests/reliability/feature_pairs.py [--seed S] [--scene N ...] [--law NAME ...] [--list]

Features are the components, diagnostics and options that the schema of experiments contains, so
that a new one is counted from the day on which it is registered. A pair has met if a scene with
both was run and all laws of `scene_laws` that are about it held, the changes of units and the
comparison of engines among them; it is refused if pbdkit reports the combination with the message
that `crossed_scenes.REFUSALS` states. Scenes are drawn from the seed, and each is run in a process
of its own with bounded memory and processor time; a scene that is ended there counts as broken.
What a refused scene leaves unmet is tried again in scenes with little besides. Prints each fault
with the number, the features and the experiment of its scene; exits with 1 if a law is broken, or
if a pair neither met nor is refused.
"""

from __future__ import annotations

import argparse
import collections
import json
import multiprocessing
import re
import resource
import signal
import sys
import traceback
from contextlib import suppress
from itertools import combinations
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

import numba  # noqa: F401  # the processes of the scenes share all that is loaded
import scipy.interpolate
import scipy.optimize
import scipy.sparse.linalg
import scipy.spatial  # noqa: F401  # as above
import xarray  # noqa: F401  # as above

sys.path[:0] = [str(Path(__file__).parents[2]), str(Path(__file__).parent.parent)]

from crossed_scenes import (
    CATALOGUE,
    PAIRS,
    covering,
    experiment_from,
    experiment_of,
    refused_pairs,
    refusing,
)
from experiment_features import Features, Pair, Tree
from scene_laws import LAWS, Faults

import pbdkit

ENDS = "is loaded, but not constrained"
"""A part that comes off a torn body cannot rest: a scene may end in this message."""
PATIENCE_S = 60
"""Processor time of one law on one scene."""
MOST_S = 3 * PATIENCE_S
"""Processor time of one scene, after which its process is ended even within a library."""
MEMORY = 4 << 30
"""Address space of the process of a scene in bytes."""
MOST_RETRIES = 400
"""Number of scenes with little besides one pair."""
SLOWEST = 5
"""Number of scenes of which the processor time is printed."""


class TooLongError(Exception):
    """A law took more than its processor time."""


class Outcome(NamedTuple):
    """The faults that a law has found, or the message that refuses the scene."""

    law: str
    faults: Faults
    refusal: str = ""


def _interrupt(*_: object) -> None:
    raise TooLongError(f"not finished after {PATIENCE_S} s")


def _test(tree: Tree, number: int, laws: list[str], results: Connection) -> None:
    """Send the outcome of each law, until one of them refuses the scene."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CPU, (MOST_S, MOST_S))
    signal.signal(signal.SIGVTALRM, _interrupt)
    for law in laws:
        signal.setitimer(signal.ITIMER_VIRTUAL, PATIENCE_S)
        try:
            results.send(Outcome(law, LAWS[law](tree, number)))
        except pbdkit.ExperimentError as error:
            results.send(Outcome(law, [], str(error)))
            return
        except Exception:
            results.send(Outcome(law, [traceback.format_exc(limit=-3)]))
        finally:
            signal.setitimer(signal.ITIMER_VIRTUAL, 0)


def tested(tree: Tree, number: int, laws: list[str]) -> list[Outcome]:
    """Return the outcomes of the laws on an experiment, from a process of its own."""
    forked = multiprocessing.get_context("fork")
    receiver, sender = forked.Pipe(duplex=False)
    process = forked.Process(target=_test, args=(tree, number, laws, sender))
    process.start()
    sender.close()
    outcomes: list[Outcome] = []
    with suppress(EOFError):
        while True:
            outcomes.append(receiver.recv())
    process.join()
    if process.exitcode:
        end = f"its process ended with {process.exitcode} (limits: {MOST_S} s, {MEMORY} bytes)"
        outcomes.append(Outcome(laws[len(outcomes)], [end]))
    return outcomes


class Trial:
    """Scenes under laws, and the pairs that met in them."""

    def __init__(self, laws: list[str]) -> None:
        self.laws = laws
        self.met: set[Pair] = set()
        self.outcomes: collections.Counter[str] = collections.Counter()
        self.seconds: dict[int, float] = {}
        self.broken = 0

    def run(self, features: Features, number: int) -> None:
        """Test the laws on the scene of a set of features."""
        tree, begun = experiment_of(features, number), _processor_time()
        outcomes = tested(tree, number, self.laws)
        self.seconds[number] = _processor_time() - begun
        faults = [f"{one.law}: {fault}" for one in outcomes for fault in one.faults]
        for law, found, refusal in outcomes:
            word = "refused" if refusal else "broken" if found else "held"
            self.outcomes[f"refused: {_shortened(refusal)}" if refusal else f"{law}: {word}"] += 1
            if refusal and ENDS not in refusal:
                faults.append(f"refused: {refusal}")
        if faults:
            place = f"scene {number} ({self.seconds[number]:.0f} s)"
            print(place, sorted(features), *faults, json.dumps(tree), sep="\n    ", flush=True)
        self.broken += any(one.faults for one in outcomes)
        if not any(one.faults or one.refusal for one in outcomes):
            having = CATALOGUE.of(experiment_from(tree))
            self.met |= {frozenset(pair) for pair in combinations(having, 2)} & PAIRS


def _processor_time() -> float:
    """Return the processor time of the processes that have ended."""
    times = resource.getrusage(resource.RUSAGE_CHILDREN)
    return times.ru_utime + times.ru_stime


def _shortened(message: str) -> str:
    return re.sub(r"\d[\d.e-]*", "#", message)[:90]


def refused() -> tuple[set[Pair], int]:
    """Return the pairs that are refused with the stated message, and the number of others."""
    found, others = set(), 0
    for pair, words in refused_pairs().items():
        text = refusing(pair)
        if text is not None and re.search(words, text):
            found.add(pair)
        else:
            others += 1
            print(f"{sorted(pair)}: not refused with '{words}', but: {text}", flush=True)
    return found, others


def main() -> int:
    """Run the scenes and count the outcomes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--scene", type=int, nargs="+", help="only the scenes with these numbers")
    parser.add_argument("--law", choices=LAWS, nargs="*", default=list(LAWS))
    parser.add_argument("--list", action="store_true", help="list the pairs that never meet")
    asked = parser.parse_args()
    trial, scenes = Trial(asked.law), list(covering(asked.seed))
    numbers = [1000 * asked.seed + n for n in range(len(scenes))]
    for features, number in zip(scenes, numbers, strict=True):
        if asked.scene is None or number in asked.scene:
            trial.run(features, number)
    of_refusals: set[Pair] = set()
    never: set[Pair] = set()
    others = 0
    if asked.scene is None:
        of_refusals, others = refused()
        never = PAIRS - trial.met - of_refusals
        for n, pair in enumerate(sorted(never, key=sorted)[:MOST_RETRIES]):
            if pair not in trial.met:
                trial.run(pair, numbers[-1] + 1 + n)
        never -= trial.met
    for what, times in sorted(trial.outcomes.items()):
        print(f"{what:32} {times}")
    if asked.list:
        print(*(" × ".join(sorted(pair)) for pair in sorted(never, key=sorted)), sep="\n")
    slowest = sorted(trial.seconds.items(), key=lambda one: -one[1])[:SLOWEST]
    print("slowest scenes:", ", ".join(f"{n} ({seconds:.0f} s)" for n, seconds in slowest))
    print(f"{len(trial.seconds)} scenes of seed {asked.seed}, {trial.broken} break a law")
    print(f"{len(CATALOGUE.features)} features, {len(PAIRS)} pairs: {len(trial.met)} met, ", end="")
    rest = "the others not tried" if asked.scene else f"{len(never)} never"
    print(f"{len(of_refusals)} refused, {rest}")
    return int(bool(trial.broken or others or never))


if __name__ == "__main__":
    sys.exit(main())
