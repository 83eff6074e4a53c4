"""Every pair of features meets in a scene that obeys the laws, or is refused with one message."""

import re
from itertools import combinations

import pytest
from crossed_scenes import (
    FEATURES,
    PAIRS,
    REFUSALS,
    covering,
    experiment_of,
    refusal_of,
)
from scene_laws import LAWS, run

import pbdkit

SCENES = tuple(covering())


def first_meetings(scenes, cases):
    """Return further cases, such that each law is tried on each feature."""
    tried = {(feature, law) for n, law in cases for feature in scenes[n]}
    missing = {(feature, law) for feature in FEATURES for law in LAWS} - tried
    first = {f: next(n for n, features in enumerate(scenes) if f in features) for f in FEATURES}
    return {(first[feature], law) for feature, law in missing}


IN_TURN = {(n, law) for n in range(len(SCENES)) for m, law in enumerate(LAWS) if (n + m) % 4 == 0}
CASES = sorted(IN_TURN | first_meetings(SCENES, IN_TURN))
"""A quarter of the laws is tried on each scene, in turn, and each law on each feature;
`reliability/scene_laws_at_length.py` tries all."""
REFUSED = sorted(tuple(sorted(pair)) for pair in PAIRS if refusal_of(pair))


def test_every_pair_of_features_is_combined_or_refused():
    met = {frozenset(pair) for features in SCENES for pair in combinations(features, 2)}
    assert PAIRS - met == {frozenset(pair) for pair in REFUSED}
    assert {feature for features in SCENES for feature in features} == {*FEATURES}


@pytest.mark.parametrize(("first", "second", "words"), REFUSALS, ids=lambda v: str(v)[:30])
def test_incompatible_features_are_refused_with_one_message(first, second, words):
    """In pairs, each with nothing else in its way."""
    pairs = {frozenset((a, b)) for a in first for b in second} & PAIRS
    assert pairs
    for pair in sorted(map(sorted, pairs)):
        if refusal_of(pair) != words:
            continue  # reported by an earlier line
        with pytest.raises(pbdkit.ExperimentError) as refusal:
            run(experiment_of(pair))
        text = str(refusal.value)
        assert re.search(words, text), (pair, text)
        assert "\n" not in text, text


def test_every_feature_is_tested_with_every_law():
    tried = {(feature, law) for n, law in CASES for feature in SCENES[n]}
    assert tried == {(feature, law) for feature in FEATURES for law in LAWS}


@pytest.mark.parametrize(("n", "law"), CASES)
def test_scenes_satisfy_the_laws(n, law):
    faults = LAWS[law](experiment_of(SCENES[n], n), n)
    assert not faults, (sorted(SCENES[n]), faults)
