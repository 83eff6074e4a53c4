"""Scenes with breaking bonds that a kernel brings to equilibrium, as numpy does."""

import os
import subprocess
import sys
from contextlib import nullcontext

import numpy as np
import pytest
from interpreted_kernels import interpreting

import pbdkit
from pbdkit.equilibrium import breaking_kernel as choice, load_stepping as increments
from pbdkit.equilibrium.breaking_kernel import BreakingKernel
from pbdkit.equilibrium.load_stepping import equilibrium_state
from pbdkit.progress import Watch
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.state import initial_state

DAMAGE = {"type": "damage", "onset": 0.1, "failure": 0.5, "scatter": 0.3, "frame_bonds": False}
SCENES = {
    "damage": {"lattice": {"type": "hexagonal", "a": 1.0}, "fracture": DAMAGE},
    "damage seen from the reference": {"fracture": DAMAGE | {"fictitious": "reference"}},
    "axes that move each other": {
        "neighbours": {"type": "chebyshev", "shells": 1},
        "rule": {"type": "elastic", "poisson_ratio": 0.2},
        "frame": {"type": "natural"},
        "fracture": {"type": "strain", "failure": 0.35, "scatter": 0.4, "frame_bonds": False},
    },
    "threshold, with frame bonds": {"fracture": {"type": "threshold", "thresholds": [1.4]}},
}


def scene_of(**parts):
    motion = {"type": "displace", "displacement": [2.0, 0.3]}
    given = {
        "name": "breaking",
        "seed": 5,
        "lattice": {"type": "square", "a": 1.0},
        "body": {"type": "grid", "columns": 5, "rows": 3},
        "rule": {"type": "barycentre"},
        "leaders": [
            {"select": {"edge": "left"}, "motion": {"type": "hold"}},
            {"select": {"edge": "right"}, "motion": motion},
        ],
        "steps": 1,
        "solver": {"type": "equilibrium", "increments": 3},
    }
    return build_scene(pbdkit.Experiment(version=1, **given | parts))


@pytest.fixture(autouse=True)
def _mostly_interpreted(request):
    with nullcontext() if "compiled" in request.node.name else interpreting():
        yield


def by_kernel(monkeypatch):
    """Count the increments that the kernel solves, each time."""
    monkeypatch.setattr(choice, "COMPILING_S", 0.0)
    settled, equilibrate = [], BreakingKernel.equilibrate
    monkeypatch.setattr(
        BreakingKernel,
        "equilibrate",
        lambda *given: settled.append(equilibrate(*given)) or settled[-1],
    )
    return settled


@pytest.mark.parametrize("parts", SCENES.values(), ids=SCENES)
def test_kernel_breaks_and_softens_like_numpy(parts, monkeypatch):
    scene = scene_of(**parts)
    expected, error_bound = equilibrium_state(scene)
    settled = by_kernel(monkeypatch)
    found, own = equilibrium_state(scene)
    assert len(settled) == 3
    assert any(well for well, _ in settled)
    assert (found.broken_step > 0).any() or any((v > 0).any() for v in found.bond_values)
    np.testing.assert_array_equal(found.broken_step, expected.broken_step)
    np.testing.assert_allclose(found.u, expected.u, rtol=0, atol=1e-10)
    for mine, others in zip(found.bond_values, expected.bond_values, strict=True):
        np.testing.assert_allclose(mine, others, rtol=0, atol=1e-10)
    assert own.method == error_bound.method
    assert own.distance <= scene.experiment.solver.tolerance * 2.0


def test_compiled_kernel_breaks_like_numpy(monkeypatch):
    scene = scene_of(**SCENES["threshold, with frame bonds"])
    expected, _ = equilibrium_state(scene)
    settled = by_kernel(monkeypatch)
    found, _ = equilibrium_state(scene)
    assert len(settled) == 3
    np.testing.assert_array_equal(found.broken_step, expected.broken_step)
    np.testing.assert_allclose(found.u, expected.u, rtol=0, atol=1e-10)


def test_kernel_follows_changes_of_leaders_like_numpy(monkeypatch):
    """The particle in the middle is held at first, and later it follows its neighbours."""
    motion = {"type": "velocity", "velocity": [0.6, 0.1], "steps": 3}
    middle = {"select": {"nearest": [[2.0, 1.0]]}, "motion": {"type": "hold"}, "until": 1}
    left, right = ({"select": {"edge": edge}} for edge in ("left", "right"))
    leaders = [left | {"motion": {"type": "hold"}}, right | {"motion": motion}, middle]
    scene = scene_of(fracture=DAMAGE, leaders=leaders, steps=3)
    expected, _ = equilibrium_state(scene)
    settled = by_kernel(monkeypatch)
    found, _ = equilibrium_state(scene)
    assert any(well for well, _ in settled)
    np.testing.assert_allclose(found.u, expected.u, rtol=0, atol=1e-10)


def test_repeated_increment_is_bitwise_identical(monkeypatch):
    by_kernel(monkeypatch)
    scene = scene_of(fracture=DAMAGE)
    whole, kept = initial_state(scene), None
    for n, reached in enumerate(increments.increments(scene, whole, Watch())):
        if n == 0:
            kept, since = whole.copy(), reached.moment
    for _ in increments.increments(scene, kept, Watch(), since):
        pass
    assert (kept.bond_values[-1] > 0.0).any()
    for mine, others in zip(kept.arrays(), whole.arrays(), strict=True):
        np.testing.assert_array_equal(mine, others)


def test_short_computations_are_not_compiled():
    scene = scene_of(fracture=DAMAGE)
    assert choice.breaking_kernel_of(scene, 1e-8, Watch()) is None


def test_cache_key_is_independent_of_set_order():
    program = (
        "from pbdkit.components.fracture import Damage\n"
        "from pbdkit.stepping.numba_engine.cache import source_key\n"
        "print(source_key(Damage.update))"
    )
    keys = {
        subprocess.run(
            [sys.executable, "-c", program],
            env=os.environ | {"PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for seed in "12"
    }
    assert len(keys) == 1
