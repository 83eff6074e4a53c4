"""Every pair of features meets in a scene that obeys the laws, or is refused with one message."""

import datetime
import os
import re
from functools import cache
from itertools import combinations
from typing import Literal

import pytest
from crossed_scenes import (
    CATALOGUE,
    FEATURES,
    PAIRS,
    REFUSALS,
    covering,
    experiment_from,
    experiment_of,
    refused_pairs,
    refusing,
)
from experiment_features import LEFT_OUT, Catalogue
from scene_laws import LAWS

from pbdkit import Diagnostic, ExperimentError
from pbdkit.plugin import Variable

TRIALS = 21
"""Number of trials of a law on a scene; `reliability/feature_pairs.py` makes all."""
BEGIN = datetime.date(2026, 1, 1)
DAY = 0 if os.environ.get("CI") else (datetime.date.today() - BEGIN).days
"""Day that selects the trials; always 0 under CI."""
scenes = cache(lambda: tuple(covering()))


def test_every_pair_of_features_is_combined_or_refused():
    met = {frozenset(pair) for features in scenes() for pair in combinations(features, 2)}
    assert met & refused_pairs().keys() == set()
    assert PAIRS - met - refused_pairs().keys() == set()
    assert {feature for features in scenes() for feature in features} == FEATURES


def test_a_component_is_a_feature_once_it_is_registered():
    class Temperature(Diagnostic):
        type: Literal["temperature"] = "temperature"
        scale: Literal["kelvin", "celsius"] = "kelvin"

        def variables(self):
            return (Variable("temperature", (), "temperature", "1"),)

        def measure(self, now):
            return (0.0,)

    added = {"diagnostics: temperature", "diagnostics.scale: celsius"}
    assert Catalogue([Temperature]).features - Catalogue().features == added


def test_features_that_are_left_out_exist():
    catalogue = Catalogue()
    assert FEATURES.isdisjoint(LEFT_OUT)
    assert {feature for feature in LEFT_OUT if feature in catalogue.found} == {*LEFT_OUT}


def test_scenes_have_their_features():
    for n in range(0, len(scenes()), 8):
        features = scenes()[n]
        assert features <= CATALOGUE.of(experiment_from(experiment_of(features, n)))


@pytest.mark.parametrize(("first", "second", "words"), REFUSALS, ids=lambda v: str(v)[:30])
def test_incompatible_features_are_refused_with_one_message(first, second, words):
    pairs = sorted(sorted((a, b)) for a in first for b in second if frozenset((a, b)) in PAIRS)
    assert pairs
    pair = pairs[len(words) % len(pairs)]
    text = refusing(pair)
    assert re.search(refused_pairs()[frozenset(pair)], text or "not refused"), (pair, text)
    assert "\n" not in str(text), text


@pytest.mark.parametrize("n", range(TRIALS))
def test_scenes_satisfy_the_laws(n):
    turn, law = divmod(n + TRIALS * DAY, len(LAWS))
    number = (turn + 41 * law) % len(scenes())
    name = list(LAWS)[law]
    try:
        faults = LAWS[name](experiment_of(scenes()[number], number), number)
    except ExperimentError as error:  # for three features together; the script tries their pairs
        pytest.skip(f"scene {number} is refused: {error}")
    repeat = f"python tests/reliability/feature_pairs.py --scene {number} --law {name}"
    assert not faults, (repeat, sorted(scenes()[number]), faults)
