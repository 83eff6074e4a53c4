"""Measure again the claims of the paper that were judged too kindly, wrongly or not at all."""

import json
import re

import numpy as np
import pytest
from finite_elements.lattices import between_edges, error_at, solved
from finite_elements.problems import BAR, CANTILEVER
from paper_cases import QUIET, body_u, parted, run
from paper_page import DOCS, measured, verdict

import pbdkit

CORRECTED = {
    "FEM but in a much shorter time": "not reproduced",
    "in accordance with results obtained by FEM": "reproduced only with the rule `elastic` and",
    "standard Cauchy model": "reproduced only with the rule `elastic` and",
    "isotropic … elastic behaviour": "reproduced only with the rule distance-weighted on the hex",
    "simulate Hook law": "not reproduced",
    "subject to Hook law [PE1]": "reproduced only with the hexagonal lattice",
    "behaviour of different materials": "reproduced only with the rules `elastic`",
    "plastic-like": "not reproduced",
    "between the GPU cores": "reproduced only with threads of a processor",
    "in a less pronounced way": "reproduced only with late times",
    "all parameters are the same": "reproduced only with one threshold of 5.2 or 5.3",
    "differently from first gradient": "reproduced only with `paper/d2-frame-bonds`",
    "more marked in second gradient": "reproduced only with `paper/d2`, at 4 of 18 thresholds",
    "1, 5, 6, 7, 8 and 100": "reproduced",
}


@pytest.mark.parametrize("quote", CORRECTED)
def test_corrected_verdicts(quote):
    assert verdict(quote).startswith(CORRECTED[quote])


def test_d_f_and_g_break_at_the_published_times_with_one_threshold():
    """The paper's time is a step more."""
    times = {case: {n + 1 for n in parted(case)} for case in ("d1", "d2", "f1", "f2", "g")}
    spans = {case: (min(found), max(found)) for case, found in times.items()}
    assert spans == {"d1": (7, 7), "d2": (7, 8), "f1": (8, 10), "f2": (7, 9), "g": (7, 9)}
    for case in spans:
        assert set(pbdkit.load(f"paper/{case}").fracture.thresholds) == {5.2}
    assert "7 (d1), 7 to 8 (d2), 8 to 10 (f1), 7 to 9 (f2), 7 to 9 (g)" in measured(
        "all parameters"
    )
    assert parted("f1", 6.0).count(None) == 5


def test_edges_break_first_at_four_of_eighteen_thresholds_with_two_shells():
    torn = {t: parted("d2", t) for t in np.arange(2.25, 7.26, 0.25).tolist()}
    torn = {t: rows for t, rows in torn.items() if None not in rows}
    first = [t for t, rows in torn.items() if max(rows[0], rows[-1]) < min(rows[1:-1])]
    assert (first, len(torn)) == ([3.0, 4.25, 4.75, 6.0], 18)
    assert "two shells: 4 of 18 (3, 4.25, 4.75, 6);" in measured("the others [first gradient]")


def test_longest_bond_is_that_of_the_configuration_of_the_fracture_test():
    """Rows move alike: two of a follower's neighbours stand where it stands. Leaders come first."""
    longest = {}
    for speed in (1.2, 0.35):
        u, found = np.zeros(10), []
        for step in range(1, 12):
            u[-1] = speed * min(step, 10)
            found.append(1 + float(np.diff(u).max()))
            u[1:-1] = u[1:-1] / 2 + (u[:-2] + u[2:]) / 4
        longest[speed] = max(found)
    said = measured("about 10 units")
    assert f"the largest length then occurs in step 10 and is {longest[1.2]:.2f};" in said
    assert f"if they move by 0.35 per step, the largest length is {longest[0.35]:.2f}." in said
    assert parted("d1", longest[1.2] - 1e-9) == [10] * 10
    assert parted("d1", longest[1.2] + 1e-9) == [None] * 10


def test_c_contracts_little_less_than_b_until_late():
    u = {case: body_u(case, QUIET)[[9, 19, 99]] for case in ("b", "c")}
    narrow = {case: (v[:, :, 0, 1] - v[:, :, -1, 1]).max(axis=1) for case, v in u.items()}
    less = 1 - narrow["c"] / narrow["b"]
    assert less == pytest.approx([0.034, 0.0077, 0.264], abs=5e-4)
    assert "3.4%, 0.8% and 26.4%" in measured("in a less pronounced way")


@pytest.mark.parametrize(("problem", "off"), [(BAR, 0.067), (CANTILEVER, 0.145)])
def test_rule_of_the_paper_has_the_same_error_on_every_lattice(problem, off):
    parts = {"rule": {"type": "barycentre"}, "frame": {"type": "mean"}}
    for cells in (10, 20):
        u = solved(problem, cells, **parts, **between_edges(problem, cells)).u
        assert error_at(problem, u, 2 * cells) == pytest.approx(off, abs=5e-4)
    assert f"{off:.1%} and {off:.1%} ({problem.name})" in measured("much shorter time")


def test_times_against_finite_elements_match_the_materials_page():
    """Both with what prepares: the numbers in brackets."""
    table = re.findall(
        r"^\| \w+ \| 1e-3 \|(.*)\|$", (DOCS / "validation/materials.md").read_text("utf-8"), re.M
    )
    times = [[float(t) for t in re.findall(r"\(([\d.]+)\)", row)] for row in table]
    assert len(times) == 3
    steps = ", ".join(f"{row[3] / row[0]:.1f}" for row in times)
    memory = ", ".join(f"{row[2] / row[0]:.2f}" for row in times)
    assert f"is {steps} (bar, cantilever, hole)" in measured("much shorter time")
    assert f"the ratio is {memory}." in measured("much shorter time")


def test_speedup_by_threads_matches_the_performance_page():
    threads = json.loads((DOCS / "validation/performance.json").read_text("utf-8"))["threads"]
    gains = [(r["one_ns"] / r["two_ns"], r["size"]) for r in threads if r["rule"] == "barycentre"]
    said = ", ".join(f"{gain:.2f} ({size}² particles)" for gain, size in gains)
    assert said in measured("between the GPU cores")
    assert "Nothing was measured on a GPU" in measured("between the GPU cores")


def test_classification_of_the_rules_of_the_paper():
    def identified(name, *settings):
        return pbdkit.identify(pbdkit.load(f"paper/{name}", settings=list(settings)))

    kinds = {name: identified(name).kind for name in ("a", "b", "c", "f1", "f2")}
    for name, kind in kinds.items():
        assert f"{kind} ({name})" in measured("standard Cauchy model")
    assert "elasticity" not in kinds.values()
    net = identified("a", "rule={type: distance-weighted}", "lattice={type: hexagonal, a: 1.0}")
    assert (net.kind, net.symmetry) == ("elasticity", "isotropic")
    assert net.poisson_ratio == pytest.approx(-3 / 7, abs=1e-12)
    assert net.spectrum.largest_stable_relaxation == pytest.approx(0.8533, abs=1e-4)


@pytest.mark.parametrize(
    ("lattice", "tension", "shear"), [("square", 2.0, 0.0), ("hexagonal", 2.25, 0.75)]
)
def test_pe1_is_an_elastic_energy_only_on_the_hexagonal_lattice(lattice, tension, shear):
    """The factors are those of ν = 1/3: four times E / (2 (1 - ν²)) and E / (4 (1 + ν)), times the
    square of a strain."""
    for gradient, expected in (([[1, 0], [0, 0]], tension), ([[0, 0.5], [0.5, 0]], shear)):
        strain = 1e-3 * np.array(gradient)
        started = f"initial={{type: affine, gradient: {strain.tolist()}}}"
        settings = [f"lattice={{type: {lattice}, a: 1.0}}", started, "leaders=[]", "steps=1"]
        ds = run("a", *settings, "diagnostics=[{type: pe1}]")
        inside = (ds.site.values == (5, 5)).all(axis=1)
        assert ds.pe1.values[0, inside] / 1e-6 == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("relaxation", [1.0, 0.3])
def test_influence_of_a_weighted_neighbour_is_quadratic_in_distance(relaxation):
    """The move of a follower amid four leaders, times the sum of its weights."""
    places = [[0, 1], [1, 0], [1, 2], [2, 1]]
    for way in (0.1, 1.0, 2.0):
        leaders = [
            {
                "select": {"nearest": [place]},
                "motion": {"type": "displace", "displacement": [way * (place == [2, 1]), 0.0]},
            }
            for place in places
        ]
        given = {
            "name": "cross",
            "lattice": {"type": "square", "a": 1.0},
            "body": {"type": "grid", "columns": 3, "rows": 3},
            "rule": {"type": "distance-weighted"},
            "leaders": leaders,
            "steps": 1,
            "solver": {"type": "stepping", "relaxation": relaxation},
        }
        ds = pbdkit.run(given, progress=False)
        middle = (ds.site.values == (1, 1)).all(axis=1)
        move = (ds.position - ds.reference).values[-1, middle, 0]
        assert move * (4 + way) / relaxation == pytest.approx((1 + way) ** 2 - 1, abs=1e-12)
