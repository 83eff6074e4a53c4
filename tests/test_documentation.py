"""What the documentation shows, runs."""

import re
import shlex
import sys
from pathlib import Path
from types import ModuleType

import pytest
from click.testing import CliRunner

import pbdkit
from pbdkit.cli import program
from pbdkit.experiment.source import read_text

ROOT = Path(__file__).parent.parent
EXTENDING = ROOT / "docs" / "extending"
NOTEBOOKS = sorted(p for p in (ROOT / "docs" / "tutorial").glob("*.md") if p.stem != "index")
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), *sorted(EXTENDING.glob("*.md"))]


def blocks(language):
    return [
        pytest.param(page, code, id=f"{page.name}-{n}")
        for page in PAGES
        for n, code in enumerate(
            re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.M | re.S)
        )
        if page.name != "tutorial.md"  # its blocks build on each other: test_extending.py runs them
    ]


def is_sweep(code):
    return re.search("^experiment:", code, re.M) is not None


def save_experiments(page):
    """The page's own experiments, each as NAME.yaml in the current folder, and its sweeps, which
    say in their first line what they are called."""
    for code in re.findall(r"^```yaml\n(.*?)^```", page.read_text(), re.M | re.S):
        (name,) = re.findall(r"\A# (\S+)\.yaml" if is_sweep(code) else r"(?m)^name: (\S+)", code)
        Path(f"{name}.yaml").write_text(code)


@pytest.mark.parametrize(("page", "code"), blocks("python"))
def test_python_runs(page, code, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save_experiments(page)
    names = {}
    exec(compile(code, page.name, "exec"), names)
    if "ds" in names:
        assert names["ds"].attrs["status"] == "complete"
        assert abs(names["ds"].position - names["ds"].reference).max() > 0


@pytest.mark.parametrize("page", NOTEBOOKS, ids=lambda page: page.stem)
def test_notebooks_run(page, tmp_path, monkeypatch):
    """Cell after cell, as when the site is built."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    module = ModuleType("a_notebook")
    monkeypatch.setitem(sys.modules, module.__name__, module)  # so that its classes can be found
    cells = re.findall(r"^```\{code-cell\}\n(.*?)^```", page.read_text(), re.M | re.S)
    for cell in cells:
        exec(compile(cell, page.name, "exec"), vars(module))
    report = vars(module).get("report")
    assert cells
    assert report is None or report.holds


@pytest.mark.parametrize(("page", "code"), blocks("yaml"))
def test_experiments_run(page, code):
    if is_sweep(code):
        assert f"$ pbdkit sweep {code.split()[1]}" in page.read_text()
        return
    experiment = pbdkit.Experiment.build(read_text(code, page.name))
    assert pbdkit.run(experiment, progress=False).attrs["status"] in ("complete", "settled")


@pytest.mark.parametrize(("page", "code"), blocks("console"))
def test_commands_work_in_their_order(page, code, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (experiment,) = (c for p, c in (b.values for b in blocks("yaml")) if p.name == "README.md")
    Path("tensile.yaml").write_text(experiment)
    save_experiments(page)
    if "plot" in code:
        assert "pbdkit run" in code
    for line in code.splitlines():
        if not line.startswith("$ pbdkit "):
            continue
        result = CliRunner().invoke(program, shlex.split(line.removeprefix("$ pbdkit ")))
        if "barycenter" in line:
            assert "did you mean 'barycentre'?" in str(result.exception)
        else:
            assert result.exit_code == 0, (line, result.output, result.exception)


@pytest.mark.parametrize("page", [*PAGES, *NOTEBOOKS], ids=lambda p: p.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
        if not target.startswith("http"):
            assert (page.parent / target).exists(), target


def test_readme_lists_the_two_commands_that_ci_runs():
    text = (ROOT / "README.md").read_text()
    commands = re.findall(r"^python3 -m venv .*$", text, re.M)
    assert [c.split(" && ")[-1] for c in commands] == [
        ".venv/bin/pbdkit run paper/a",
        ".venv/bin/pytest -n auto --dist worksteal",
    ]
