"""The table of claims: its tests and scripts exist, and each script of a trial is in it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from reliability import nightly

TESTS = Path(__file__).parent
SHARED = {
    "damage", "faults", "hostile_text", "isolation", "nightly", "stopping", "trials",
}  # fmt: skip
"""Modules of tests/reliability that other scripts use."""


@pytest.mark.parametrize("claim", nightly.claims(), ids=lambda c: c["trial"])
def test_a_claim_names_tests_and_a_trial(claim):
    assert claim["suite"]
    assert [name for name in claim["suite"] if not (TESTS / name).is_file()] == []
    assert ("{count}" in claim["trial"]) == ("count" in claim)
    places = [word for word in claim["trial"].split() if word.startswith("tests/")]
    assert [word for word in places if not (TESTS.parent / word.rstrip(")")).exists()] == []


def test_each_trial_is_run_by_the_nightly():
    scripts = {path.stem for path in (TESTS / "reliability").glob("*.py")} - SHARED
    commands = " ".join(claim["trial"] for claim in nightly.claims())
    assert {name for name in scripts if f"reliability/{name}.py" not in commands} == set()


def test_a_record_has_the_figures_and_the_seed():
    claim = {
        "claim": "c",
        "trial": "printf 'a\\n{count} of {seed}\\nb\\n'",
        "count": 40,
        "lines": 2,
    }
    record = nightly.run(claim, share=0.1, seed=7)
    assert record["figures"] == ["4 of 7", "b"]
    assert record["exit"] == 0
    assert record["machine"]["processors"] > 0
    assert json.loads(json.dumps(record)) == record


@pytest.mark.parametrize(("trial", "status"), [("exit 3", 3), ("true", 0)])
def test_the_nightly_fails_with_a_trial(monkeypatch, tmp_path, trial, status):
    figures = tmp_path / "trials.jsonl"
    monkeypatch.setattr(nightly, "FIGURES", figures)
    lacking = {"claim": "d", "trial": "false", "needs": ["no-such-program"]}
    monkeypatch.setattr(nightly, "claims", lambda: [{"claim": "c", "trial": trial}, lacking])
    monkeypatch.setattr("sys.argv", ["nightly"])
    assert nightly.main() == (status > 0)
    (record,) = map(json.loads, figures.read_text().splitlines())
    assert record["exit"] == status


def test_the_page_has_all_figures_of_the_last_day_of_a_trial(monkeypatch):
    pytest.importorskip("sphinx")
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "docs")
    from reference_pages import claim_rows

    machine = {"processor": "P", "processors": 2, "system": "S", "python": "3", "numpy": "2"}
    record = {"claim": "c", "commit": "1a", "exit": 0, "seconds": 5, "machine": machine}
    record["machine"]["numba"] = "0"
    parts = [("2026-01-01", "old"), ("2026-01-02", "one | 7"), ("2026-01-02", "two | 8")]
    records = [record | {"date": day, "figures": [text]} for day, text in parts]
    page = list(claim_rows([{"claim": "c", "suite": [], "trial": "t"}], records))
    assert "2026-01-02, `1a`, 5 s: one \\| 7; 2026-01-02, `1a`, 5 s: two \\| 8" in page[1]
    assert "old" not in page[1]
    assert page[-1].startswith("- P, 2 processors")
