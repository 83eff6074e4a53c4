"""The program against the plain loops, on scenes drawn at random over everything that is built.

The plain loops were written from the definition of the model alone, in positions and one particle
at a time.
"""

import numpy as np
import plain_loops
import pytest
from hypothesis import assume, given, strategies as st
from scene_strategies import experiments, grids, in_turn, initials, pulled_apart, samples

import pbdkit

TOLERANCE = 1e-11
MEASURED = ["pe1", "pe1_intact", "pe2", "u", "broken_bonds"]


@samples(30)
@given(experiments())
def test_matches_the_plain_loops(experiment):
    compare(experiment)


@samples(30)
@given(experiments(body=grids, start=initials.filter(lambda i: i["type"] == "reference")))
def test_grids_match_the_plain_loops(experiment):
    compare(experiment)


@samples(30)
@given(experiments(leaders=pulled_apart(), fracturing=st.just(True)))
def test_fracture_matches_the_plain_loops(experiment):
    compare(experiment)


def run_unless_refused(experiment):
    """Random leaders may select no particle, name frame points or contradict each other, bodies may
    be empty, and mirrors need full rectangles: such scenes are not tested here."""
    try:
        return pbdkit.run(experiment, progress=False)
    except pbdkit.ExperimentError:
        assume(False)


def with_the_noise_drawn(experiment):
    """The plain loops are given the random numbers, which only the program can draw."""
    if experiment["initial"]["type"] != "noise":
        return experiment
    start = pbdkit.run(experiment | {"steps": 1, "leaders": []}, progress=False)
    body = (start["kind"][0] != 2).values
    return experiment | {"_noise": start["u"][0].values[body].tolist()}


def compare(experiment):
    ds = run_unless_refused(experiment)
    expected = plain_loops.simulate(with_the_noise_drawn(experiment))

    for name in ("number", "site", "kind", "bond_ends", "shell"):
        np.testing.assert_array_equal(ds[name], np.array(expected[name]).reshape(ds[name].shape))
    if "broken_step" in ds:
        np.testing.assert_array_equal(ds["broken_step"], expected["broken_step"])
    for name in ("reference", "position", *MEASURED):
        np.testing.assert_allclose(
            ds[name], np.array(expected[name]), rtol=TOLERANCE, atol=TOLERANCE, err_msg=name
        )


@pytest.mark.parametrize("name", in_turn(["a", "b", "c", "d1", "d2", "e", "f1", "f2", "g"], 2))
def test_cases_of_the_paper_match_the_plain_loops(name):
    experiment = pbdkit.load(f"paper/{name}", settings=["steps=60"])
    raw = experiment.model_dump(mode="json")
    ds, expected = pbdkit.run(experiment, progress=False), plain_loops.simulate(raw)

    np.testing.assert_allclose(ds["position"], expected["position"], rtol=0, atol=TOLERANCE)
    np.testing.assert_allclose(ds["pe1"], expected["pe1"], rtol=TOLERANCE, atol=TOLERANCE)
