"""``pbdkit explain``: what broke, when, at which strain against which limit, in which order."""

import json

import numpy as np
import pytest
from property_cases import pull_right
from remembering_parts import Weakest

import pbdkit
from pbdkit.io.explain import BondRecords
from pbdkit.io.layout import OF_FRAME
from pbdkit.scene.scene import build_scene

RATE = 0.03125
LEFT = {"select": {"edge": "left"}, "motion": {"type": "hold"}}
BAR = {
    "name": "bar",
    "lattice": {"type": "square", "a": 1.0},
    "body": {"type": "grid", "columns": 2, "rows": 2},
    "rule": {"type": "barycentre"},
    "frame": {"type": "none"},
    "fracture": {"type": "strain", "failure": 0.5},
    "leaders": [
        LEFT,
        {"select": {"numbers": [3]},
         "motion": {"type": "velocity", "velocity": [RATE, 0.0], "steps": 40}},
        {"select": {"numbers": [4]},
         "motion": {"type": "velocity", "velocity": [RATE / 2, 0.0], "steps": 20}},
    ],
    "steps": 40,
}  # fmt: skip
"""Four leaders: 1 and 2 held, 3 pulled to strain 1.25, 4 to 0.3125; 3-4 is turned and stretched."""
SHEET = {
    "frame": {"type": "mean"},
    "body": {"type": "grid", "columns": 8, "rows": 6},
    "leaders": [LEFT, pull_right(0.3, 0.1, 10)],
    "fracture": {"type": "threshold", "thresholds": [1.6],
                 "cracks": [[[3.5, -2.0], [3.5, 1.2]]]},
}  # fmt: skip
STRAIN = {"type": "strain", "failure": 0.6}


@pytest.fixture
def explain(call, tmp_path):
    """The program's answer about a run of BAR with some changes."""

    def answer(*arguments, **parts):
        (tmp_path / "bar.json").write_text(json.dumps(BAR | parts))
        assert (
            call("run", str(tmp_path / "bar.json"), "-o", "bar.nc", "--force", "--quiet").code == 0
        )
        return call("explain", "bar.nc", *arguments)

    return answer


def test_a_broken_bond(explain):
    answer = explain("--bond", "3", "1")
    across = np.hypot(1.0, 17 * RATE / 2) - 1
    assert answer.out.splitlines() == [
        "bond 1-3: shell 1, rest length 1",
        "broke in step 17 at strain 0.53125, bond 1 of 1 in the order of breaking",
        "fracture strain: it breaks above the strain 0.5",
        "adjacent bonds broken before: none",
        "adjacent bonds broken in the same step: none",
        "adjacent bonds broken after: none",
        "adjacent bonds not broken: 2; the largest strain is that of 3-4: intact, strain "
        f"{across:.6g} in step 17, breaks above 0.5 ({across / 0.5:.3g} of this limit)",
    ]


def test_an_intact_bond(explain):
    answer = explain("--bond", "2", "4")
    across = np.hypot(1.0, 40 * RATE - 20 * RATE / 2) - 1
    assert answer.out.splitlines() == [
        "bond 2-4: shell 1, rest length 1",
        "intact, strain 0.3125 in step 40, breaks above 0.5 (0.625 of this limit)",
        "largest strain in a recorded step: 0.3125, in step 20",
        "adjacent bonds broken: none",
        "adjacent bonds not broken: 2; the largest strain is that of 3-4: intact, strain "
        f"{across:.6g} in step 40, breaks above 0.5 ({across / 0.5:.3g} of this limit)",
    ]


def test_adjacent_bonds_are_listed(explain):
    """3-4 breaks in the end: after 1-3."""
    answer = explain("--bond", "3", "4", fracture={"type": "strain", "failure": 0.3})
    lines = answer.out.splitlines()
    assert lines[1].endswith("bond 3 of 3 in the order of breaking")
    assert lines[3] == "adjacent bonds broken before: 1-3 (step 10), 2-4 (step 20)"
    assert lines[6] == "adjacent bonds not broken: 0"


def test_the_whole_run(explain):
    answer = explain(fracture={"type": "strain", "failure": 0.3})
    assert answer.out.splitlines()[:4] == [
        "fracture strain: 3 of 4 bonds broke",
        "first in step 10, last in step 37",
        "order  step  bond           strain       breaks above",
        "    1    10  1-3            0.3125       0.3",
    ]
    assert answer.out.splitlines()[-1].startswith("nearest to breaking: 1-2: intact, strain 0 in")


def test_run_of_a_model_without_a_limit(explain, monkeypatch):
    silent = staticmethod(lambda r, c, p: None)
    monkeypatch.setattr("pbdkit.components.fracture.Threshold.breaking_strain", silent)
    lines = explain(fracture={"type": "threshold", "thresholds": [1.3]}).out.splitlines()
    assert lines[2].split() == ["order", "step", "bond", "strain"]
    assert "not known" not in "".join(lines)
    assert lines[6] == (
        "threshold declares no strain above which a bond breaks: a fracture model declares it by "
        "`breaking_strain`"
    )


def test_json_contains_the_same_facts(explain):
    found = json.loads(explain("--bond", "1", "3", "--json").out)
    assert (found["fracture"], found["broken_in_all"]) == ("strain", 1)
    assert found["bond"] == {
        "bond": [1, 3], "shell": 1, "rest_length": 1.0, "state": "broken", "step": 17, "order": 1,
        "strain_at_break": 17 * RATE, "breaks_above": 0.5, "strain": 1.25, "at_step": 40,
        "place": "body",
    }  # fmt: skip
    assert found["most_strained"] == {"step": 40, "strain": 1.25}
    assert [(o["bond"], o["state"]) for o in found["around"]] == [
        ([1, 2], "intact"),
        ([3, 4], "intact"),
    ]
    whole = json.loads(explain("--json").out)
    assert (whole["bonds"], whole["broken"], whole["broken_from_the_start"]) == (4, 1, 0)
    assert whole["in_order"] == [found["bond"]]
    assert whole["nearest"]["bond"] == [3, 4]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--bond", "1", "4"], "bar.nc: no bond joins 1 and 4; the bonds of 1 are to 2, 3"),
        (["--bond", "1", "5"], "bar.nc: there is no particle 5; they are numbered 1 to 4"),
    ],
)
def test_missing_bond(explain, arguments, message):
    answer = explain(*arguments)
    assert (answer.code, answer.out) == (2, "")
    assert message in answer.err


def test_a_run_without_bonds(explain):
    answer = explain(fracture={"type": "none"})
    assert answer.code == 2
    assert "bar.nc: has no table of bonds, since no bond can break in this run" in answer.err
    answer = explain("--bond", "1", "3", fracture={"type": "none"}, diagnostics=[{"type": "pe1"}])
    assert answer.out.splitlines()[1] == "cannot break, strain 1.25 in step 40"


def explained(given, **more):
    ds = pbdkit.run(given, progress=False, **more)
    return ds, BondRecords(ds, build_scene(pbdkit.Experiment(**given)))


@pytest.mark.parametrize(
    "parts",
    [
        SHEET,
        SHEET | {"fracture": SHEET["fracture"] | {"frame_bonds": False}},
        SHEET | {"fracture": {"type": "damage", "onset": 0.2, "failure": 0.7, "scatter": 0.3}},
        SHEET | {"fracture": STRAIN, "diagnostics": [{"type": "displacement"}]},
    ],
    ids=["threshold", "spared", "damage", "strain"],
)  # fmt: skip
def test_only_broken_bonds_exceeded_their_limit(parts):
    ds, found = explained(BAR | parts)
    standings = found.statuses(np.arange(ds.sizes["bond"]))
    broken = [s for s in standings if s.state == "broken"]
    assert sorted(s.order for s in standings if s.order) == list(range(1, len(found.order) + 1))
    assert len(broken) > 3
    assert all(s.strain_at_break > s.breaks_above * (1 - 1e-12) for s in broken)
    assert all(s.strain_at_break is None for s in standings if s.state != "broken")
    for row in np.flatnonzero((found.steps < 0) & ~found.spared):
        assert found.most_strained(row)[1] <= standings[row].breaks_above
    spared = {s.state == "cannot break" for s in standings}
    assert (True in spared) == (not parts["fracture"].get("frame_bonds", True))
    cut = [s for s in standings if s.state == "broken from the start"]
    assert bool(cut) == ("cracks" in parts["fracture"])


CUT = {
    "body": {"type": "rectangle", "width": 6.0, "height": 3.5},
    "neighbours": {"type": "chebyshev"},
    "rule": {"type": "elastic", "poisson_ratio": 0.3},
    "frame": {"type": "natural"},
    "solver": {"type": "stepping", "relaxation": "auto"},
    "fracture": {"type": "strain", "failure": 0.2},
    "leaders": [{"select": {"edge": edge}, "motion": motion} for edge, motion in (
        ("left", {"type": "hold"}),
        ("right", {"type": "velocity", "velocity": [0.2, 0.0], "steps": 40}),
    )],
}  # fmt: skip


def test_bonds_outside_the_body_are_counted_separately(explain):
    answer = explain(**CUT).out.splitlines()
    with pbdkit.open("bar.nc") as ds:
        outside = (ds.inside.values == 0)[ds.bond_ends.values - 1].any(axis=1)
        broken = ds.broken_step.values > 0
    counts = int((broken & ~outside).sum()), int((broken & outside).sum())
    assert min(counts) > 0
    assert answer[1] == (
        f"of these {counts[0]} in the body, {counts[1]} with an end outside its outline, and 0 "
        "with an end in the frame"
    )
    assert any(line.endswith("  outside the outline") for line in answer)


def test_bonds_of_frame_points_belong_to_the_frame():
    ds, found = explained(BAR | SHEET)
    of_frame = (ds.role.values == OF_FRAME)[ds.bond_ends.values - 1].any(axis=1)
    np.testing.assert_array_equal(found.places, np.where(of_frame, 2, 0))
    assert 0 < of_frame.sum() < len(of_frame)


def test_the_limit_of_a_threshold_is_its_length():
    ds, found = explained(BAR | SHEET | {"lattice": {"type": "square", "a": 0.8}})
    np.testing.assert_allclose(found.limits, 1.0, rtol=1e-15)
    assert (ds.broken_strain.values[ds.broken_step.values > 0] > 1.0).all()


def test_model_without_a_limit():
    given = BAR | SHEET | {"fracture": Weakest(spread=0.3)}
    ds, found = explained(given, components=[Weakest])
    row = int(found.order[0])
    (status,) = found.statuses(np.array([row]))
    assert status.breaks_above is None
    assert found.nearest() is None
    assert status.strain_at_break == float(ds.broken_strain[row]) > 0.5
    remembered = found.remembered(row)
    assert remembered["onset"] == float(ds.onset[row])
    assert remembered["damage"] >= 1.0


def test_modified_file_is_refused():
    given = BAR | SHEET
    ds = pbdkit.run(given, progress=False)
    other = build_scene(pbdkit.Experiment(**given | {"neighbours": {"type": "chebyshev"}}))
    with pytest.raises(pbdkit.ExperimentError, match="its bonds are not those of its experiment"):
        BondRecords(ds, other)
