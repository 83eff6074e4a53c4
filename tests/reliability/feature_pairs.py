"""Run scenes in which any two features meet, and count the pairs of features that never do.

    python tests/reliability/feature_pairs.py [--seed S] [--part N OF] [--law NAME ...] [--list]

Features are the components, diagnostics and options that the schema of experiments contains, so
that a new one is counted from the day on which it is registered. A pair has met if a scene with
both was run and all laws of `scene_laws` that are about it held, the changes of units and the
comparison of engines among them; it is refused if pbdkit reports the combination with the message
that `crossed_scenes.REFUSALS` states. Scenes are drawn from the seed. What a refused scene leaves
unmet is tried again in scenes with little besides. Prints each fault with the features and the
experiment; exits with 1 if a law is broken, or if a pair neither met nor is refused.
"""

from __future__ import annotations

import argparse
import collections
import json
import re
import resource
import signal
import sys
import traceback
from itertools import combinations
from pathlib import Path

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
from experiment_features import Features, Pair
from scene_laws import LAWS, Faults

import pbdkit

ENDS = "is loaded, but not constrained"
"""A part that comes off a torn body cannot rest: a scene may end in this message."""
PATIENCE_S = 60
"""Processor time of one law on one scene."""
MEMORY = 4 << 30
"""Address space of the trial in bytes."""
MOST_RETRIES = 400
"""Number of scenes with little besides one pair."""


class TooLongError(Exception):
    """A law took more than its processor time."""


def _interrupt(*_: object) -> None:
    raise TooLongError(f"not finished after {PATIENCE_S} s")


class Trial:
    """Scenes under laws, and the pairs that met in them."""

    def __init__(self, laws: list[str]) -> None:
        self.laws = laws
        self.met: set[Pair] = set()
        self.outcomes: collections.Counter[str] = collections.Counter()
        self.broken = 0

    def run(self, features: Features, number: int) -> None:
        """Test the laws on the scene of a set of features."""
        tree = experiment_of(features, number)
        faults: Faults = []
        for law in self.laws:
            signal.setitimer(signal.ITIMER_VIRTUAL, PATIENCE_S)
            try:
                found = LAWS[law](tree, number)
            except pbdkit.ExperimentError as error:
                self.outcomes[f"refused: {_shortened(error)}"] += 1
                if ENDS not in str(error):
                    print(number, sorted(features), f"refused: {error}", sep="\n    ", flush=True)
                return
            except Exception:
                found = [traceback.format_exc(limit=-3)]
            finally:
                signal.setitimer(signal.ITIMER_VIRTUAL, 0)
            self.outcomes[f"{law}: {'broken' if found else 'held'}"] += 1
            faults += [f"{law}: {fault}" for fault in found]
        if faults:
            self.broken += 1
            print(number, sorted(features), *faults, json.dumps(tree), sep="\n    ", flush=True)
            return
        having = CATALOGUE.of(experiment_from(tree))
        self.met |= {frozenset(pair) for pair in combinations(having, 2)} & PAIRS


def _shortened(error: Exception) -> str:
    return re.sub(r"\d[\d.e-]*", "#", str(error))[:90]


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
    parser.add_argument("--part", type=int, nargs=2, metavar=("N", "OF"), default=(0, 1))
    parser.add_argument("--law", choices=LAWS, nargs="*", default=list(LAWS))
    parser.add_argument("--list", action="store_true", help="list the pairs that never meet")
    asked = parser.parse_args()
    signal.signal(signal.SIGVTALRM, _interrupt)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    trial, (first, every) = Trial(asked.law), asked.part
    scenes = list(covering(asked.seed))
    for n in range(first, len(scenes), every):
        trial.run(scenes[n], 1000 * asked.seed + n)
    of_refusals, others = refused()
    never: set[Pair] = set()
    if every == 1:
        never = PAIRS - trial.met - of_refusals
        for n, pair in enumerate(sorted(never, key=sorted)[:MOST_RETRIES]):
            if pair not in trial.met:
                trial.run(pair, 1000 * asked.seed + len(scenes) + n)
        never -= trial.met
    for what, times in sorted(trial.outcomes.items()):
        print(f"{what:32} {times}")
    if asked.list:
        print(*(" × ".join(sorted(pair)) for pair in sorted(never, key=sorted)), sep="\n")
    print(f"{len(scenes)} scenes of seed {asked.seed}, {trial.broken} break a law")
    print(f"{len(CATALOGUE.features)} features, {len(PAIRS)} pairs: {len(trial.met)} met, ", end="")
    print(
        f"{len(of_refusals)} refused, {f'{len(never)} never' if every == 1 else 'others not tried'}"
    )
    return int(bool(trial.broken or others or never))


if __name__ == "__main__":
    sys.exit(main())
