"""Properties that hold for every lattice, neighbourhood, rule and frame."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from property_cases import (
    BOTH_ENDS_HELD,
    FRAMES,
    HOLD_LEFT,
    LATTICES,
    LATTICES_AND_NEIGHBOURS,
    LINEAR_RULES,
    NEIGHBOURS,
    RULES,
    advanced,
    all_pairs,
    displace,
    displacements,
    experiment,
    layers_from,
    pull_right,
    scene_of,
)
from scene_strategies import in_turn

import pbdkit
from pbdkit.stepping import bond_breaking, rule_evaluation

few = settings(max_examples=4, deadline=None, derandomize=True)
small = st.floats(-2.0, 2.0, allow_subnormal=False)
combinations = pytest.mark.parametrize(
    ("lattice", "neighbours"), in_turn(LATTICES_AND_NEIGHBOURS, 3)
)
every_rule = pytest.mark.parametrize("rule", RULES)


with_some_rules = pytest.mark.parametrize(
    ("lattice", "neighbours", "rule"),
    all_pairs(LATTICES, NEIGHBOURS, ["barycentre", "mean-displacement", "distance-weighted"]),
)


def paired(rules, frames):
    """Cases (lattice, neighbours, rule, frame)."""
    cases = all_pairs(LATTICES, NEIGHBOURS, rules, frames)
    return pytest.mark.parametrize(("lattice", "neighbours", "rule", "frame"), cases)


every_frame = pytest.mark.parametrize("frame", FRAMES)
every_lattice = pytest.mark.parametrize("lattice", LATTICES)

EDGES = ("left", "right", "bottom", "top")
ROUNDING = 1e-12
"""Displacements are of order 1 and runs of order 30 steps: some thousand roundings of 1e-16."""


@paired(list(RULES), list(FRAMES))
def test_a_body_at_rest_stays_at_rest_exactly(lattice, neighbours, rule, frame):
    """If nothing changes in the first steps, not even with a delay, nothing does in any other."""
    parts = {"lattice": lattice, "neighbours": neighbours, "rule": rule, "frame": frame}
    for leaders in ([], BOTH_ENDS_HELD):
        u = displacements(5, 4, leaders=leaders, steps=4, **parts)
        assert not u.any()


@combinations
def test_mean_displacement_rests_exactly_without_a_frame(lattice, neighbours):
    parts = {"lattice": lattice, "neighbours": neighbours, "rule": "mean-displacement"}
    u = displacements(frame={"type": "none"}, steps=4, **parts)
    assert not u.any()


@every_lattice
@every_rule
def test_relaxation_momentum_and_unbroken_bonds_keep_rest_exact(lattice, rule):
    solver = {"type": "stepping", "relaxation": 0.7, "memory": 0.5}
    fracture = {"type": "threshold", "thresholds": [3.0]}
    u = displacements(lattice=lattice, rule=rule, solver=solver, fracture=fracture, steps=4)
    assert not u.any()


@with_some_rules
def test_translating_every_particle_translates_the_step(lattice, neighbours, rule):
    scene = scene_of(lattice=lattice, neighbours=neighbours, rule=rule)
    u = np.random.default_rng(1).uniform(-0.1, 0.1, (len(scene.raster.body_rows), 2))
    shift = np.array([0.75, -1.5])
    moved, still = advanced(scene, u + shift, 5)[-1], advanced(scene, u, 5)[-1]
    np.testing.assert_allclose(moved, still + shift, rtol=0, atol=ROUNDING)


@combinations
def test_body_with_translated_leaders_ends_translated(lattice, neighbours):
    shift = (0.5, -0.25)
    motion = {"type": "displace", "displacement": shift}
    leaders = [{"select": {"edge": edge}, "motion": motion} for edge in EDGES]
    solver = {"type": "stepping", "relaxation": 0.9}
    parts = {"lattice": lattice, "neighbours": neighbours, "leaders": leaders, "solver": solver}
    u = displacements(5, 4, steps=400, record={"every": 400}, **parts)[-1]
    np.testing.assert_allclose(u, np.broadcast_to(shift, u.shape), rtol=0, atol=ROUNDING)


@with_some_rules
def test_results_are_bitwise_independent_of_the_origin(lattice, neighbours, rule):
    parts = {"neighbours": neighbours, "rule": rule, "leaders": [HOLD_LEFT, pull_right(0.3, 0.1)]}
    parts |= {"steps": 12}
    here = displacements(lattice=LATTICES[lattice], **parts)
    far = displacements(lattice=LATTICES[lattice] | {"origin": [1e8, -1e8]}, **parts)
    assert np.array_equal(here, far)


@every_lattice
def test_mixed_coordinates_are_independent_of_the_origin(lattice):
    parts = {"rule": "mixed-coordinate", "leaders": [HOLD_LEFT, pull_right(0.3, 0.1)]}
    here = displacements(lattice=LATTICES[lattice], **parts)
    far = displacements(lattice=LATTICES[lattice] | {"origin": [1e8, -1e8]}, **parts)
    assert np.array_equal(here, far)


ANY, SHORTEST = tuple(NEIGHBOURS), ("coordination-1", "coordination-2")
X_FLIP, Y_FLIP, TURN = (True, False), (False, True), (True, True)
SYMMETRIES = [
    *product(("square", "rectangular"), ANY, (X_FLIP, Y_FLIP), (5,)),
    # The primitive basis leans to one side, and Chebyshev neighbourhoods with it: no mirror.
    *product(("centred-rectangular", "hexagonal"), SHORTEST, (Y_FLIP,), (5,)),
    *product(LATTICES, ANY, (TURN,), (6,)),
]
"""Indices and components that change their sign in a symmetry of a body of 6 x `rows` sites."""


MIRRORED = ["barycentre", "distance-weighted", "mixed-coordinate"]


@pytest.mark.parametrize(
    ("lattice", "neighbours", "flips", "rows", "rule"),
    [(*case, MIRRORED[n % 3]) for n, case in enumerate(SYMMETRIES)],
)
def test_mirrored_loading_gives_mirrored_displacements(lattice, neighbours, flips, rows, rule):
    parts = {"lattice": lattice, "neighbours": neighbours, "rows": rows, "steps": 8}
    body, last = scene_of(**parts).raster, np.array([5, rows - 1])
    number = {tuple(s): n for n, s in enumerate(body.site_table().tolist(), 1)}
    image = {s: tuple(np.where(flips, last - s, s).tolist()) for s in number}
    loads = {(0, 1): (0.3, 0.1), (3, 4): (-0.2, 0.4), (5, 2): (0.5, -0.1)}
    sign = np.where(flips, -1.0, 1.0)

    def run(loads, contraction):
        given = RULES[rule] | ({"K": contraction} if rule == "mixed-coordinate" else {})
        leaders = [displace([number[s]], *load) for s, load in loads.items()]
        return displacements(rule=given, leaders=leaders, **parts)

    # Mixed coordinates contract where x grows: under a mirror of x K changes its sign.
    one = run(loads, -0.004)
    other = run({image[s]: np.array(load) * sign for s, load in loads.items()}, -0.004 * sign[0])
    images = [number[image[tuple(s)]] - 1 for s in body.site_of(body.body_rows).tolist()]
    np.testing.assert_allclose(
        other[:, images], one[:, body.body_rows] * sign, rtol=0, atol=ROUNDING
    )


@pytest.mark.parametrize(
    ("lattice", "neighbours", "frame"), all_pairs(LATTICES, NEIGHBOURS, ["mean", "first", "wide"])
)
def test_particle_k_layers_away_moves_first_at_step_k(lattice, neighbours, frame):
    parts = {"lattice": lattice, "neighbours": neighbours, "frame": frame, "columns": 8, "rows": 6}
    scene = scene_of(**parts)
    leader = int(scene.raster.body_rows[0])
    layers = layers_from(scene, leader)
    u = displacements(leaders=[displace([leader + 1], 1.0, 1.0)], steps=8, **parts)
    moved = u[:, scene.raster.body_rows].any(axis=2)
    steps = np.arange(9)[:, None]
    expected = (layers >= 0) & (layers <= steps) & (steps > 0)
    assert np.array_equal(moved, expected)
    assert layers.max() > 2


@every_lattice
@every_frame
def test_frame_copies_the_current_step_or_with_delay_the_previous(lattice, frame):
    parts = {"lattice": lattice, "frame": frame, "neighbours": "chebyshev-1"}
    scene = scene_of(**parts)
    u = displacements(leaders=[HOLD_LEFT, pull_right(0.3, 0.1)], steps=10, **parts)
    copied = np.zeros((11, len(scene.frame.place), 2))
    entries = scene.frame.map
    for point, body, weight in zip(entries.point, entries.body, entries.weight, strict=True):
        copied[:, point] += weight * u[:, body]
    frame_rows = np.setdiff1d(np.arange(scene.raster.count), scene.raster.body_rows)
    lag = FRAMES[frame].get("lag", 0)
    # A mean of at most three numbers of order 1.
    np.testing.assert_allclose(u[lag:, frame_rows], copied[: 11 - lag], rtol=0, atol=1e-15)


@combinations
@few
@given(first=st.tuples(small, small), second=st.tuples(small, small))
def test_the_barycentre_stays_in_the_hull_of_start_and_leaders(lattice, neighbours, first, second):
    scene = scene_of(lattice=lattice, neighbours=neighbours)
    ends = [int(scene.raster.body_rows[n]) + 1 for n in (7, -8)]
    leaders = [displace([n], *move) for n, move in zip(ends, (first, second), strict=True)]
    u = displacements(lattice=lattice, neighbours=neighbours, leaders=leaders, steps=12)
    angles = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    outward = np.array([np.cos(angles), np.sin(angles)])
    furthest = (np.array([(0.0, 0.0), first, second]) @ outward).max(axis=0)
    assert (u @ outward <= furthest + ROUNDING).all()


@paired(LINEAR_RULES, ["mean", "first", "lag"])
def test_loads_superpose_under_linear_rules(lattice, neighbours, rule, frame):
    parts = {"lattice": lattice, "neighbours": neighbours, "rule": rule, "frame": frame}
    loads = [(0.3, -0.2), (-0.1, 0.7)]
    total = tuple(np.sum(loads, axis=0))
    one, other, both = (
        displacements(leaders=[HOLD_LEFT, pull_right(*load)], steps=12, **parts)
        for load in (*loads, total)
    )
    np.testing.assert_allclose(both, one + other, rtol=0, atol=ROUNDING)


FRACTURE = {"type": "threshold", "thresholds": [2.4]}


@pytest.mark.parametrize(
    ("lattice", "rule", "fracture"), in_turn(all_pairs(LATTICES, RULES, [None, FRACTURE]), 3)
)
def test_repeated_runs_and_any_row_blocks_agree_bitwise(lattice, rule, fracture, monkeypatch):
    leaders = [HOLD_LEFT, pull_right(0.7, 0.1)]
    given = experiment(
        columns=7, rows=6, lattice=lattice, rule=rule, leaders=leaders, neighbours="chebyshev-1"
    ) | {"steps": 12}
    given |= {"fracture": fracture} if fracture else {}
    once = pbdkit.run(given, progress=False)
    if fracture:
        assert (once.broken_step > 0).any()
    for cells in (rule_evaluation.BLOCK_CELLS, 20, 1):
        monkeypatch.setattr(rule_evaluation, "BLOCK_CELLS", cells)
        monkeypatch.setattr(bond_breaking, "BLOCK_CELLS", cells)
        again = pbdkit.run(given, progress=False)
        assert once.drop_attrs().identical(again.drop_attrs())


@every_lattice
def test_order_and_division_of_leader_groups_do_not_matter(lattice):
    scene = scene_of(lattice=lattice)
    edges = [
        [int(r) + 1 for r in scene.raster.body_rows[part]] for part in (slice(5), slice(-5, None))
    ]
    whole = [displace(edges[0], 0.0, 0.2), displace(edges[1], 0.5, 0.0)]
    split = [displace([n], *m) for ns, m in zip(edges, ((0.0, 0.2), (0.5, 0.0)), strict=True)
             for n in reversed(ns)]  # fmt: skip
    expected = displacements(lattice=lattice, leaders=whole)
    for groups in (whole[::-1], split, split[::-1]):
        assert np.array_equal(displacements(lattice=lattice, leaders=groups), expected)
