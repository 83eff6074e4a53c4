"""The data determine how many modes a measured boundary has, and fits converge to the minimum."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from fitting.test_fit import measured, plate

import pbdkit

COARSE = {"lattice": {"type": "square", "a": 2.0}}


@pytest.fixture(scope="module")
def fit_with(tmp_path_factory):
    """Fit a plate with ends that move by polynomials of the second and third degree."""

    def fit(noise, modes):
        generator = np.random.default_rng(4)
        path = tmp_path_factory.mktemp("modes") / "field.csv"
        measured(plate(**COARSE), path, noise=noise, count=600, generator=generator)
        made = plate(noise=noise, generator=generator, **COARSE)
        given = {"file": str(path), "noise": noise}
        unknown = {"rule.poisson_ratio": [0.0, 0.49]}
        return pbdkit.fit(
            {"experiment": made, "unknown": unknown, "measured": given, "modes": modes}
        )

    return fit


def test_the_noise_limits_the_number_of_modes(fit_with):
    precise, noisy = (fit_with(noise, "auto") for noise in (1e-6, 3e-2))
    assert precise.modes() == {0: 4, 1: 4}
    assert sum(noisy.modes().values()) <= 5
    assert precise.ratio == pytest.approx(1.0, abs=0.1)
    assert precise.as_dict()["modes"] == [{"0": 4, "1": 4}]
    assert "modes of measured boundaries: 4 of group 0, 4 of group 1" in str(precise).splitlines()


def test_each_group_can_have_its_number(fit_with):
    found = fit_with(1e-6, [5, "auto"])
    assert found.modes() == {0: 5, 1: 4}
    assert found.solution.z.size == 1 + 2 * (5 + 4)
    with pytest.raises(pbdkit.ExperimentError, match=r"^fit: modes: expected a number for each"):
        fit_with(1e-6, [5])


@pytest.mark.parametrize("number", [9, 43, 51])
def test_a_sample_of_the_long_trial(number, monkeypatch):
    """Few and noisy points with patches, short edges, bounds that are not valid together."""
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "reliability")
    import fit_convergence

    verdict, details = fit_convergence.judge(fit_convergence.make_trial(0, number))
    sys.modules.pop("fit_convergence")
    assert verdict == "good", details
