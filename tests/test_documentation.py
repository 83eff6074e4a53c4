"""Commands and code blocks of the documentation run."""

import contextlib
import io
import re
import runpy
import shlex
import signal
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path
from types import ModuleType

import pytest
from click import Context
from click.testing import CliRunner
from PIL import Image, ImageChops, ImageStat
from scene_strategies import AT_LENGTH

import pbdkit
from pbdkit.cli import program
from pbdkit.cli.commands import builtin_commands
from pbdkit.model.reading import read_text

ROOT = Path(__file__).parent.parent
EXTENDING = ROOT / "docs" / "extending"
PARTS = (ROOT / "docs").rglob("*.md")
NOTEBOOKS = sorted(p for p in PARTS if "\nfile_format: mystnb\n" in p.read_text())
LONG_NOTEBOOKS = ("fit-fields", "crack-field", "notched-beam")
"""Pages that are run in the profile `long`. Pages of commands fit full fields, too, and
`fitting/test_channels` fits softening curves."""
SHORT_NOTEBOOKS = [p for p in NOTEBOOKS if AT_LENGTH or p.stem not in LONG_NOTEBOOKS]
FOLDERS = [ROOT / "docs", EXTENDING, ROOT / "docs" / "reference", ROOT / "docs" / "validation"]
PAGES = [ROOT / "README.md", *(page for folder in FOLDERS for page in sorted(folder.glob("*.md")))]


def blocks(language):
    """Return the blocks of all pages. A block that a page shares with an earlier one, as the site's
    first page does with the README, is included once."""
    found = {}
    for page in PAGES:
        if page.name == "tutorial.md":  # `plugin/test_documentation` runs its blocks in one session
            continue
        experiments = tuple(blocks_in(page, "yaml"))
        for n, code in enumerate(blocks_in(page, language)):
            if script_of(code):  # by `test_commands_work_in_their_order`
                continue
            param = pytest.param(page, code, id=f"{page.name}-{n}")
            found.setdefault((code, experiments), param)
    return [*found.values()]


def blocks_in(page, language):
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.M | re.S)


def script_of(code):
    """Return the name of the file in the first line of a block, which commands of its page run."""
    names = re.findall(r"\A# (\w+\.py)$", code, re.M)
    return names[0] if names else None


COARSER = {
    "fit-fields": {
        '"lattice": {"type": "square", "a": 1.0}': '"lattice": {"type": "square", "a": 2.0}',
        '["lattice"]["a"] = 1.0': '["lattice"]["a"] = 2.0',
        '"candidates": candidates, "folds": 3': (
            '"candidates": {"2 mm": candidates["2 mm"]}, "folds": 2'
        ),
    },
    "fitting": {'        "profile": [ratio],\n': ""},
}
"""Changes of pages that take a minute; the site is built from them as they are. Candidates and
profiles are tested in `fitting/`."""
SPARSER = {
    "parameter-sweep": {
        "{from: 0.3, to: 1.0, count: 8}": "[0.3, 0.9, 1.0]",
        "{from: 0.0, to: 0.9, count: 7}": "[0.0, 0.6, 0.9]",
    },
}
"""Values of the sweeps of pages, replaced by some of them; the profile `long` runs all members."""
FEWER = {
    "animate": ["--every", "20"],
    "sweep": ["--workers", "1"],
    "fit crack-field": ["--plot", "crack-field.png"],
    "run modelling/dogbone-to-failure": ["--set", "lattice.a=2.5"],
    "run fracture/notched-beam": ["--set", "steps=2"],
    "run paper/f2": ["--set", "steps=60"],
    "run kirsch.yaml -o": ["--set", "lattice.a=1.0"],
    "run steel-specimen.yaml": ["--set", "steps=400"],
    "run material/dogbone": ["--set", "steps=240", "--set", "fracture.failure=0.002"],
    "run fracture/edge-crack": ["--set", "steps=1", "--set", "solver.increments=10"],
}
"""Options of commands that take long: movies of fewer steps, which draw all of them alike; sweeps
in this process; a fit with its picture, as that of LONG_FITS; runs of the first steps; and
specimens that break early or are coarse."""


def is_sweep(code):
    return re.search("^experiment:", code, re.M) is not None


def name_of(page, code):
    """Return the name of the file of a block: that of the experiment, which is the file that the
    page runs if the block has no name, or that in the first line of a sweep."""
    names = re.findall(r"\A# (\S+)\.yaml" if is_sweep(code) else r"(?m)^name: (\S+)", code)
    (name,) = names or re.findall(r"^\$ pbdkit run (\S+)\.yaml$", page.read_text(), re.M)
    return name


def save_experiments(page):
    """Save the page's own experiments, sweeps and scripts in the current folder."""
    for code in blocks_in(page, "python"):
        if name := script_of(code):
            Path(name).write_text(code)
    for code in blocks_in(page, "yaml"):
        text = code
        for values, some in SPARSER.get(page.stem, {}).items() if not AT_LENGTH else ():
            assert values in text
            text = text.replace(values, some)
        Path(f"{name_of(page, code)}.yaml").write_text(text)


def install(page):
    """Save the results of the installation on the page, which its other blocks use."""
    for name in re.findall(r"&& \.venv/bin/pbdkit run (\S+)$", page.read_text(), re.M):
        for file, content in results_of(name).items():
            Path(file).write_bytes(content)


@cache
def results_of(name):
    """Return the files that the run of an experiment writes."""
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        assert CliRunner().invoke(program, ["run", name]).exit_code == 0
        return {file.name: file.read_bytes() for file in Path().iterdir()}


@pytest.mark.parametrize(("page", "code"), blocks("python"))
def test_python_examples_run(page, code, tmp_path, monkeypatch, request):
    if page.name == "testing.md":  # `testing/test_conformance` compiles
        request.getfixturevalue("interpreted")
    monkeypatch.chdir(tmp_path)
    save_experiments(page)
    install(page)
    names = {}
    exec(compile(code, page.name, "exec"), names)
    if "ds" in names:
        assert names["ds"].attrs["status"] == "complete"
        assert abs(names["ds"].position - names["ds"].reference).max() > 0


def test_the_start_runs_the_first_case_once():
    """It then opens the result, and runs again what it changes alone."""
    text = (ROOT / "docs" / "start.md").read_text()
    runs = re.findall(r"pbdkit(?: run |\.run\()(.*)", text)
    assert runs == ["paper/a", "paper/a --set solver.memory=0.5 -o swinging.nc"]


@pytest.mark.parametrize("page", SHORT_NOTEBOOKS, ids=lambda page: page.stem)
def test_notebooks_run(page, tmp_path, monkeypatch, request):
    """Cell after cell, as when the site is built."""
    if page.stem == "rule":  # `cli/test_plugins_new` compiles a rule
        request.getfixturevalue("compiled_at_length")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    module = ModuleType("a_notebook")
    monkeypatch.setitem(sys.modules, module.__name__, module)  # so that its classes can be found
    text = page.read_text()
    for fine, coarse in COARSER.get(page.stem, {}).items():
        assert fine in text
        text = text.replace(fine, coarse)
    cells = re.findall(r"^```\{code-cell\}\n(.*?)^```", text, re.M | re.S)
    for cell in cells:
        exec(compile(cell, page.name, "exec"), vars(module))
    report = vars(module).get("report")
    assert cells
    assert report is None or report.holds


@pytest.mark.parametrize(("page", "code"), blocks("yaml"))
def test_experiments_run(page, code):
    text = page.read_text()
    if is_sweep(code):
        assert f"$ pbdkit sweep {code.split()[1]}" in text
        return
    if (
        f"\n$ pbdkit run {name_of(page, code)}.yaml\n" in text
    ):  # by `test_commands_work_in_their_order`
        return
    experiment = pbdkit.Experiment.build(read_text(code, page.name))
    assert pbdkit.run(experiment, progress=False).attrs["status"] in ("complete", "settled")


LONG_FITS = ("fit-fields.md",)
"""Pages with commands for the profile `long`. `finite_elements/test_updating` computes
this fit, and `crack-field.md` has the same command with another one."""


@pytest.mark.parametrize(
    ("page", "code"),
    [b for b in blocks("console") if AT_LENGTH or b.values[0].name not in LONG_FITS],
)
def test_commands_work_in_their_order(page, code, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save_experiments(page)
    install(page)
    for command, *shown in calls_in(code):
        if command.startswith("pbdkit live "):
            assert_served_until_interrupted(command)
            continue
        program_name, *words = shlex.split(command)
        if program_name == "python":
            printed = io.StringIO()
            with contextlib.redirect_stdout(printed):
                runpy.run_path(*words, run_name="__main__")
            assert_shown(shown, printed.getvalue())
            continue
        fewer = [o for n, o in FEWER.items() if words[: len(n.split())] == n.split()]
        changed = [option for options in fewer for option in options]
        result = CliRunner().invoke(program, words + changed)
        assert result.exit_code == 0, (command, result.output, result.exception)
        if not changed:
            assert_shown(shown, result.output)
    for movie in tmp_path.glob("*.gif"):
        assert_same_movie(ROOT / "docs" / "pictures" / movie.name, movie)


def calls_in(code):
    """Return the commands of a block, each with the lines of its output that the block shows."""
    calls = []
    for line in code.replace("\\\n", "").splitlines():
        if line.startswith(("$ pbdkit ", "$ python ")):
            calls.append([line.removeprefix("$ ")])
        elif calls:
            calls[-1].append(line)
    return calls


VARYING = re.compile(rf"(?<!\w)[\d.]+ (?:ms|s|min{'' if AT_LENGTH else '|MB'})\b")
"""Durations, and sizes of files; the profile `long`, which runs all members of sweeps, compares
sizes."""


def assert_shown(shown, output):
    """Assert that the output contains the lines in order, up to durations, sizes and `...`."""
    printed = iter([*map(plain, output.splitlines()), None])
    for line in filter(None, map(plain, shown)):
        pattern = re.escape(line).replace(re.escape("..."), ".*")
        assert any(text is not None and re.fullmatch(pattern, text) for text in printed), (
            f"not printed: {line}\n{output}"
        )


def plain(line):
    return VARYING.sub("T", " ".join(line.split()))


def assert_same_movie(shown, made):
    """Compare the frames that were made with those of the movie on the page."""
    with Image.open(shown) as first, Image.open(made) as second:
        step = (first.n_frames - 1) // (second.n_frames - 1)
        for n in range(second.n_frames):
            first.seek(n * step)
            second.seek(n)
            difference = ImageChops.difference(first.convert("RGB"), second.convert("RGB"))
            assert max(ImageStat.Stat(difference).mean) < 2.0, f"frame {n}"


def assert_served_until_interrupted(line):
    command = [sys.executable, "-m", *shlex.split(line)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as served:
        assert "http://127.0.0.1:" in served.stdout.readline()
        served.send_signal(signal.SIGINT)
        assert served.wait(20) == 0


def test_tables_are_contiguous():
    """Rows that follow no head and no other row are shown as raw text, and cells beyond the head
    not at all."""
    for page in (*PAGES, *NOTEBOOKS):
        text = re.sub(r"^(```+).*?^\1$", "", page.read_text(), flags=re.M | re.S)
        for table in re.findall(r"(?:^\|.*\n?)+", text, re.M):
            head, rule, *rows = [*table.splitlines(), ""]
            assert re.fullmatch(r"\|( *:?-+:? *\|)+ *", rule), (page, head)
            for row in [head, *filter(None, rows)]:
                assert len(re.findall(r"(?<!\\)\|", row)) == rule.count("|"), (page, row)


def test_links_have_targets():
    for page in (*PAGES, *NOTEBOOKS):
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
            assert target.startswith("http") or (page.parent / target).exists(), (page, target)


TEXTS = [
    *sorted((ROOT / "docs").rglob("*.md")),
    *sorted(ROOT.glob("plugins/*/README.md")),
    ROOT / "ARCHITECTURE.md",
    ROOT / "README.md",
]


def test_sources_named_in_text_exist():
    """Files of commands, and names in backticks, relative to the repository, to the page, or to a
    folder of the package or the tests."""
    for page in TEXTS:
        text = page.read_text("utf-8")
        names = re.findall(r"(?:python|pytest) ((?:tests|docs|experiments)/[\w/-]+(?:\.py)?)", text)
        names += re.findall(r"`((?:\w+/)+\w+\.py)`", text)
        folders = [ROOT, page.parent, ROOT / "pbdkit", ROOT / "pbdkit" / "stepping", ROOT / "tests"]
        left = [name for name in names if not any((f / name).exists() for f in folders)]
        assert left == [], page


def test_pages_for_users_have_a_figure_or_an_example():
    """Reports, decisions and the paper of a journal aside; the gallery consists of pictures."""
    apart = {"validation", "decisions", "gallery", "paper"}
    pages = [p for p in (ROOT / "docs").rglob("*.md") if apart.isdisjoint(p.parts)]
    shown = re.compile(r"!\[|^ *```(?!\{toctree\}|$)|^\n {4}\S", re.M)
    assert [page.name for page in pages if not shown.search(page.read_text())] == []


def test_readme_lists_the_two_commands_of_ci():
    text = (ROOT / "README.md").read_text()
    commands = re.findall(r"^python3 -m venv .*$", text, re.M)
    assert [c.split(" && ")[-1] for c in commands] == [
        ".venv/bin/pbdkit run paper/a",
        ".venv/bin/pytest -n auto --dist worksteal",
    ]


FENCES = {"python", "yaml", "console", "sh", "toml", "{code-cell}", "{toctree}", "{eval-rst}",
          "{glossary}", "{commands}", "{keys}", "{claims}", "{python}", "{include}",
          "{literalinclude}", "text"}  # fmt: skip
"""The kinds of blocks. The first three run above; `toml` is read by
`plugin/test_documentation`, those in braces by the builder of the site, cells above too. `text` is
what a terminal shows of a run that others stop: `test_restart` has it."""
SHELL = [
    *PAGES,
    *NOTEBOOKS,
    ROOT / "CONTRIBUTING.md",
    *sorted(ROOT.glob("plugins/*/README.md")),
]
ELSEWHERE = {
    "python3 -m venv .venv": "`.ci/run` runs both of the README",
    "bash .ci/run": "it runs this test",
    "bash .ci/nightly": "what takes too long for every change",
    "pytest": "this is a test; sessions of nox run those of plugins",
    "ruff": "the session `lint` of nox",
    "mypy": "the session `lint` of nox",
    "python tests/prose.py": "the session `lint` of nox",
    "nox": "`.ci/run` calls its sessions",
    "pre-commit": "writes into the repository's own hooks",
    "pip install": "`cli/test_plugins_new` and the session `plugins` of nox install so",
    "python tests/reliability/": "`io/test_run_store` runs short samples",
    "python tests/benchmarks": "takes an hour; tests/bench runs what it is made of",
    "python docs/reproduction": "half an hour; `experiments/test_paper_reproduction` does",
    "python experiments/": "minutes each; the tests of the plugins run what they show",
    "python -m build": "`test_distribution` builds",
    "twine upload": "publishes",
    "pbdkit plugins new": "`cli/test_plugins_new`",
    "pbdkit run pbdkit-mine/example.yaml": "`cli/test_plugins_new`",
    "pbdkit plugins check pbdkit-lazy": "`plugin/test_documentation`",
    "pbdkit run paper/a --set 'rule={type: lazy}'": "`plugin/test_documentation`",
    "pbdkit run paper/a --set 'rule={type: lazy-angles": "`plugin/test_documentation`",
    "pbdkit plot angles.nc": "`plugin/test_documentation`",
    "pbdkit run experiments/": "the tests of the plugins",
    "pbdkit plot kagome-tensile.nc": "the tests of the plugins",
    "pbdkit explain weibull-sheet.nc": "the tests of the plugins",
    "pbdkit bench": "minutes each; tests/bench runs smaller ones",
    "#SBATCH": "a line for the queue",
    "pbdkit resume sheet.nc || pbdkit run sheet.yaml": "`test_restart`",
    'eval "$(_PBDKIT_COMPLETE': "`cli/test_command_line` asks for completions",
}
"""Beginnings of commands in pages that are not run here, with the test that runs them, or the
reason why none does."""
COMMAND = re.compile(r"^ {4}((?:pbdkit|python3?|pip|pytest|nox|bash|eval|ruff|mypy|pre-commit) .*)")


def commands(page):
    """The lines of shell blocks, and of indented ones that begin with a program's name."""
    text = page.read_text()
    fenced = re.findall(r"^```sh\n(.*?)^```", text, re.M | re.S)
    outside = re.sub(r"^```.*?^```", "", text, flags=re.M | re.S)
    indented = (found[1] for line in outside.splitlines() if (found := COMMAND.match(line)))
    return [*"\n".join(fenced).splitlines(), *indented]


def test_every_block_is_run_by_a_test():
    for page in SHELL:
        fences = re.findall(r"^ *```(\S*)", page.read_text(), re.M)
        assert {fence for fence in fences if fence} <= FENCES, page
        assert len(fences) % 2 == 0, page
        assert all(fences[::2]), f"{page}: a block says what it is"
        left = [c for c in commands(page) if c.strip() and not c.startswith(tuple(ELSEWHERE))]
        assert left == [], page


def test_commands_not_run_here_are_valid():
    """Their options are known, and they name files that are there."""
    for page in SHELL:
        for line in commands(page):
            words = shlex.split(line, comments=True)
            if words[:1] == ["pbdkit"] and "||" not in words and words[1] in builtin_commands():
                command = program.get_command(None, words[1])
                command.make_parser(Context(command)).parse_args(words[2:])
            if words[:1] == ["python"] and not words[1].startswith("-"):
                assert any((folder / words[1]).exists() for folder in (ROOT, page.parent)), line
