"""Test the laws that scenes obey, over a number of random scenes.

    python tests/reliability/scene_laws_at_length.py [--count N] [--seed S] [--law NAME ...]

Scenes are those in which every pair of features meets, drawn from seed after seed. Prints each
fault with the features and the experiment; exits with 1 where there is any.
"""

from __future__ import annotations

import argparse
import collections
import json
import sys
import traceback
from collections.abc import Iterator
from itertools import count, islice
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[2]), str(Path(__file__).parent.parent)]

from crossed_scenes import Features, covering, experiment_of
from scene_laws import LAWS, Faults, Tree

import pbdkit

REFUSED = "is loaded, but not constrained"
"""A part that comes off a torn body cannot rest: the one refusal in which a scene may end."""


def scenes(seed: int) -> Iterator[tuple[int, Features]]:
    """Numbers and features without end."""
    for later in count(seed):
        yield from ((1000 * later + n, found) for n, found in enumerate(covering(later)))


def faults_of(law: str, experiment: Tree, number: int) -> Faults | None:
    """Return the violation of the law; None if the run reports that there is no equilibrium."""
    try:
        return LAWS[law](experiment, number)
    except pbdkit.ExperimentError as error:
        return None if REFUSED in str(error) else [f"refused: {error}"]
    except Exception:
        return [traceback.format_exc(limit=-3)]


def main() -> int:
    """Count the outcomes of the trials."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--law", choices=LAWS, nargs="*", default=list(LAWS))
    asked = parser.parse_args()
    found: collections.Counter[str] = collections.Counter()
    for number, features in islice(scenes(asked.seed), asked.count):
        experiment = experiment_of(features, number)
        for law in asked.law:
            faults = faults_of(law, experiment, number)
            outcome = "without equilibrium" if faults is None else "broken" if faults else "held"
            found[f"{law}: {outcome}"] += 1
            if faults:
                print(number, law, sorted(features), *faults, sep="\n    ")
                print("   ", json.dumps(experiment), flush=True)
    for what, times in sorted(found.items()):
        print(f"{what:32} {times}")
    return int(any("broken" in what for what in found))


if __name__ == "__main__":
    sys.exit(main())
