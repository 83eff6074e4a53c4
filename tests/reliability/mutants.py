"""Mutation testing: draw small changes of the source at random, and count those that tests detect.

The operators are those of cosmic-ray, and one more for the text of kernels. Each mutant is written
to a copy of the repository. A process that is forked from a prepared one executes the tests that
cover the changed statement, cheapest first, until one of them fails. Which tests cover a statement,
and what each test costs, is measured once for each state of the repository.

At first the prepared process has imported the tests and pbdkit, and the changed function gets its
new code there, if that is possible. Other mutants, and those that survive, are repeated in
processes that import the changed file, with more tests. Survivors that change no result are
described in equivalent_mutants.yaml.

    pip install --group nightly
    python tests/reliability/mutants.py --count 500 --seed 1
"""

from __future__ import annotations

import argparse
import difflib
import gc
import hashlib
import importlib
import inspect
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
import traceback
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache, partial
from itertools import islice
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any, NamedTuple

import parso
import pytest
from cosmic_ray.ast import ast_nodes
from cosmic_ray.mutating import mutate_code
from cosmic_ray.operators.operator import Operator
from cosmic_ray.plugins import get_operator
from parso.python.tree import FStringString, String
from ruamel.yaml import YAML

ROOT = Path(__file__).parents[2]
EQUIVALENT = Path(__file__).with_name("equivalent_mutants.yaml")
AREAS = {
    "evaluator": [
        "stepping/rule_evaluation.py",
        "stepping/followers.py",
        "stepping/bond_breaking.py",
        "stepping/leaders.py",
        "stepping/state.py",
        "scene/constants.py",
        "components/rules.py",
        "components/elasticity.py",
        "plugin/vector.py",
    ],
    "engines": [
        "stepping/numpy_engine.py",
        "stepping/program.py",
        "stepping/step.py",
        "stepping/kernel.py",
        "stepping/numba_engine/*.py",
        "equilibrium/grid_kernels.py",
        "equilibrium/breaking_kernel.py",
    ],
    "equilibrium": [
        "equilibrium/newton.py",
        "equilibrium/branch.py",
        "equilibrium/cell_forces.py",
        "equilibrium/load_stepping.py",
        "equilibrium/system.py",
        "equilibrium/linearise.py",
        "equilibrium/linear_solver.py",
        "equilibrium/sparse.py",
        "equilibrium/stencil_matrix.py",
        "equilibrium/lattice_system.py",
        "equilibrium/krylov.py",
        "equilibrium/multigrid.py",
        "equilibrium/error_bound.py",
    ],
    "contact": ["stepping/contact.py", "scene/obstacles.py", "equilibrium/contact_system.py"],
    "fits": ["fitting/*.py", "identification/*.py"],
    "layout": [
        "lattice/*.py",
        "plugin/lattice.py",
        "components/lattices.py",
        "components/neighbours.py",
        "components/frames.py",
        "scene/frame.py",
        "stepping/frame_following.py",
        "stepping/neighbour_search.py",
    ],
}
"""Source files of each area."""
TESTS = [
    "lattice",
    "plugin/test_lattice.py",
    "plugin/test_rule.py",
    "plugin/test_schedule.py",
    "plugin/test_vector.py",
    "components",
    "scene",
    "stepping",
    "linear",
    "equilibrium",
    "identification",
    "fitting",
    "hard_cases",
    "mpi/test_partition.py",
    "mpi/test_driver.py",
    "testing",
    "test_simulation.py",
    "test_random_scenes.py",
    "test_crossed_scenes.py",
]
"""Tests that are executed, below tests/."""
REPLACEMENTS = {
    "BinaryOperator": "Add_Sub Sub_Add Mul_Div Div_Mul Mul_Add FloorDiv_Mul Mod_FloorDiv Pow_Mul "
    "BitOr_BitAnd BitAnd_BitOr BitXor_BitOr LShift_RShift",
    "ComparisonOperator": "Eq_NotEq NotEq_Eq Lt_LtE LtE_Lt Gt_GtE GtE_Gt Lt_Gt Gt_Lt LtE_GtE "
    "GtE_LtE Is_IsNot IsNot_Is",
    "UnaryOperator": "Delete_USub Delete_Not Delete_Invert",
}
OPERATORS = [
    *(f"Replace{kind}_{pair}" for kind, pairs in REPLACEMENTS.items() for pair in pairs.split()),
    *("AddNot", "ReplaceTrueWithFalse", "ReplaceFalseWithTrue", "ReplaceAndWithOr"),
    *("ReplaceOrWithAnd", "ReplaceBreakWithContinue", "ReplaceContinueWithBreak"),
    *("NumberReplacer", "ZeroIterationForLoop"),
]
"""Operators of cosmic-ray; the others mostly raise a TypeError, or change no result."""
IGNORED_CALLS = {"warn", "warning", "info", "debug", "cast", "TypeVar", "progress"}
"""Functions the arguments of which do not affect results."""
IGNORED_ARGUMENTS = {"strict", "examples", "description", "stacklevel"}
"""Keyword arguments that do not affect results: `strict` asserts that lengths are equal."""
IGNORED_NODES = {"raise_stmt", "assert_stmt", "decorator", "import_from", "import_name"}
TEXT_FOLDERS = ("numba_engine", "stepping")
"""Folders in which strings are parts of kernels."""
LONGEST_TEST_S = 8.0
"""Processor time above which a test is not executed."""
LIMIT_S = 5.0
"""Processor time after which a test is ended, in addition to four times what it needs."""
COMPILATION_S = 25.0
"""Additional processor time where code may be compiled."""
COMPILED = ("evaluator", "engines")
"""Areas with code that is compiled."""
LONGEST_SLEEP_S = 100.0
"""Time after which a process that uses no processor is ended."""
OPTIONS = ["-q", "-p", "no:cacheprovider", "-o", "addopts="]
"""Options of pytest, without those of the project."""
OPTIONS += ["-W", "ignore::pytest.PytestAssertRewriteWarning"]  # Packages are already imported.
GOAL = 0.9
FAULT = 70
"""Exit status of a process in which pytest itself failed."""
UNCHANGED = 71
"""Exit status of a process in which no function could be replaced."""


class KernelText(Operator):  # type: ignore[misc]
    """Exchange an operator in the text of a kernel."""

    PAIRS = ((" + ", " - "), (" - ", " + "), (" * ", " / "), (" < ", " <= "), (" > ", " < "))
    PAIRS += ((" and ", " or "), ("+= 1", "+= 2"), (" == ", " != "), (" += ", " -= "))

    def mutation_positions(self, node: Any) -> Iterator[tuple[Any, Any]]:
        """Yield the position of each operator that can be exchanged."""
        if isinstance(node, (String, FStringString)):
            for old, _ in self.PAIRS:
                for _ in range(node.value.count(old)):
                    yield node.start_pos, node.end_pos

    def mutate(self, node: Any, index: int) -> Any:
        """Exchange one of them."""
        for old, new in self.PAIRS:
            parts = node.value.split(old)
            if index < len(parts) - 1:
                node.value = old.join(parts[: index + 1]) + new + old.join(parts[index + 1 :])
                return node
            index -= len(parts) - 1
        raise IndexError(index)

    @classmethod
    def examples(cls) -> tuple[Any, ...]:
        """Return no examples; cosmic-ray uses them for its own tests."""
        return ()


class Mutant(NamedTuple):
    """A change of one source file; `lines` are those of the statement in a function that contains
    it, and (0, 0) for statements that the import of the file executes."""

    area: str
    path: str
    operator: str
    occurrence: int
    line: int
    lines: tuple[int, int]

    @property
    def name(self) -> str:
        """Identify the mutant by its place and operator."""
        return f"{self.path}:{self.line}:{self.operator}:{self.occurrence}"

    def code(self) -> str:
        """Return the source with the change."""
        return _code(self.path, self.operator, self.occurrence)

    def change(self) -> tuple[str, str, str]:
        """Return the file, the changed line and the line that replaces it."""
        before = (ROOT / self.path).read_text().splitlines()
        after = self.code().splitlines()
        old, new = (
            " ".join(line[2:].strip() for line in difflib.ndiff(before, after) if line[0] == sign)
            for sign in "-+"
        )
        return self.path.removeprefix("pbdkit/"), old, new


@cache
def _code(path: str, operator: str, occurrence: int) -> str:
    code = mutate_code((ROOT / path).read_text(), _operator(operator), occurrence)
    assert code is not None
    return str(code)


def _operator(name: str) -> Operator:
    return KernelText() if name == "KernelText" else get_operator(f"core/{name}")()


def _ancestors(node: Any) -> Iterator[tuple[Any, Any]]:
    """Yield each ancestor of a node with the child that leads to the node."""
    while node.parent is not None:
        yield node.parent, node
        node = node.parent


def _is_relevant(node: Any, in_kernels: bool) -> bool:
    """Return whether a change of the node can affect results: it is not in an annotation, a message
    or an assertion for the type checker."""
    if node.type == "string" and node.parent.type == "simple_stmt":
        return False  # A docstring.
    for parent, child in ((node, None), *_ancestors(node)):
        kind = parent.type
        if kind in IGNORED_NODES or (kind.startswith("fstring") and not in_kernels):
            return False
        if kind == "argument" and parent.children[0].get_code().strip() in IGNORED_ARGUMENTS:
            return False
        if kind == "annassign" and child is parent.children[1]:
            return False
        if kind in ("tfpdef", "funcdef") and child not in (None, parent.children[0]):
            before = parent.children[parent.children.index(child) - 1]
            if getattr(before, "value", "") in (":", "->") and child.type != "suite":
                return False
        if kind in ("if_stmt", "trailer", "atom_expr", "power"):
            code = parent.get_code(include_prefix=False)
            name = code.split("(", 1)[0].split(".")[-1].strip()
            if code.startswith("if TYPE_CHECKING") or name in IGNORED_CALLS:
                return False
    return True


def _statement(node: Any) -> tuple[int, int]:
    """Return first and last line of the statement in a function, or of the header of a compound
    statement; (0, 0) for headers of functions and for statements outside functions."""
    parents = [parent for parent, _ in _ancestors(node)]
    if any(parent.type in ("funcdef", "lambdef") for parent in parents):
        for parent in (node, *parents):
            if parent.type == "simple_stmt":
                return parent.start_pos[0], parent.end_pos[0]
            if parent.type.endswith("_stmt"):
                colons = (c for c in parent.children if getattr(c, "value", "") == ":")
                ends = (c.start_pos[0] for c in colons if c.start_pos > node.start_pos)
                last = min(ends, default=node.end_pos[0])
                return node.start_pos[0], last if parent is node else max(last, node.end_pos[0])
            if parent.type in ("funcdef", "classdef"):
                break
    return 0, 0


def mutants_of(area: str, path: Path) -> dict[tuple[int, int], list[Mutant]]:
    """Return the mutants of a file at each place in it."""
    relative = str(path.relative_to(ROOT))
    in_kernels = any(f"/{folder}/" in relative for folder in TEXT_FOLDERS)
    places: dict[tuple[int, int], list[Mutant]] = defaultdict(list)
    names = [*OPERATORS, *(["KernelText"] if in_kernels else [])]
    operators = {name: _operator(name) for name in names}
    occurrences: Counter[str] = Counter()
    for node in ast_nodes(parso.parse(path.read_text())):
        relevant: bool | None = None
        for name, operator in operators.items():
            for start, _ in operator.mutation_positions(node):
                if relevant is None:
                    relevant = _is_relevant(node, in_kernels)
                if relevant:
                    lines = _statement(node)
                    number = occurrences[name]
                    places[start].append(Mutant(area, relative, name, number, start[0], lines))
                occurrences[name] += 1
    return places


def _order(seed: int, path: Path, places: Iterable[tuple[int, int]]) -> Iterator[str]:
    """Yield a random number for each place in a file, which depends on the text of its line only:
    after a change of the source elsewhere, the same places are drawn."""
    lines = path.read_text().splitlines()
    equal: Counter[tuple[str, int]] = Counter()
    for line, column in places:
        text = lines[line - 1]
        place = text.strip(), column - len(text) + len(text.lstrip())
        equal[place] += 1
        named = f"{seed} {path.relative_to(ROOT)} {place} {equal[place]}"
        yield hashlib.sha256(named.encode()).hexdigest()


def drawn(count: int, seed: int, areas: Sequence[str]) -> list[Mutant]:
    """Draw places in the source of each area at random, and at each place one mutant."""
    mutants = []
    for number, area in enumerate(areas):
        paths = sorted(p for part in AREAS[area] for p in (ROOT / "pbdkit").glob(part))
        ranked: list[tuple[str, list[Mutant]]] = []
        for path in paths:
            places = mutants_of(area, path)
            ranked += zip(_order(seed, path, places), places.values(), strict=True)
        share = count // len(areas) + (number < count % len(areas))
        chosen = (random.Random(n).choice(choices) for n, choices in sorted(ranked))
        mutants += islice(filter(_is_python, chosen), share)
    return mutants


def _is_python(mutant: Mutant) -> bool:
    try:
        compile(mutant.code(), mutant.path, "exec")
    except SyntaxError:
        return False
    return True


class Recording:
    """A plugin of pytest that measures what each test costs, and which lines it executes."""

    def __init__(self, coverage: Any) -> None:
        self.coverage = coverage
        self.cost: dict[str, float] = {}
        self.failed: set[str] = set()

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_protocol(self, item: Any) -> Iterator[None]:
        """Execute a test in a context of its own, and end it if it is too long to be used."""
        self.coverage.switch_context(item.nodeid)
        begun = time.process_time()
        signal.signal(signal.SIGPROF, lambda *_: pytest.fail("too long"))
        signal.setitimer(signal.ITIMER_PROF, 1.5 * LONGEST_TEST_S)
        yield
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        self.cost[item.nodeid] = time.process_time() - begun
        self.coverage.switch_context("")

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Note tests that fail or are skipped, which cannot detect a mutant."""
        if report.outcome != "passed":
            self.failed.add(report.nodeid)


def record(name: str, target: Path) -> None:
    """Execute a file of tests in the current folder, and write which lines each test executes."""
    import coverage

    measured = coverage.Coverage(data_file=None, source=["pbdkit"])
    recording = Recording(measured)
    measured.start()
    code = pytest.main([*OPTIONS, name], plugins=[recording])
    measured.stop()
    if code not in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED):
        raise RuntimeError(f"the tests of {name} could not be executed")
    data = measured.get_data()
    cost = {test: s for test, s in recording.cost.items() if test not in recording.failed}
    numbers = {test: n for n, test in enumerate(cost)}
    lines = {
        str(Path(path).relative_to(Path.cwd())): {
            line: sorted(numbers[test] for test in tests if test in numbers)
            for line, tests in data.contexts_by_lineno(path).items()
        }
        for path in data.measured_files()
    }
    site = tuple(p for p in sys.path if p.endswith("site-packages") or "lib/python" in p)
    modules = [
        module
        for module, content in sys.modules.items()
        if (getattr(content, "__file__", None) or "").startswith(site)
    ]
    target.write_text(json.dumps({"cost": cost, "lines": lines, "modules": modules}))


def test_files() -> list[str]:
    """Return the files of tests that are executed."""
    found = (ROOT / "tests" / name for name in TESTS)
    files = (sorted(p.rglob("test_*.py")) if p.is_dir() else [p] for p in found)
    return [str(path.relative_to(ROOT)) for part in files for path in part]


class Selection:
    """A plugin of pytest that executes selected tests in the order of their limits, which are given
    in seconds of processor time. A longer test ends the process."""

    def __init__(self, limits: dict[str, float]) -> None:
        self.limits = limits
        self.order = {name: n for n, name in enumerate(limits)}

    def pytest_collection_modifyitems(self, items: list[Any]) -> None:
        """Keep the selected tests, in their order."""
        items[:] = sorted(
            (item for item in items if item.nodeid in self.order),
            key=lambda item: self.order[item.nodeid],
        )

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_protocol(self, item: Any) -> Iterator[None]:
        """Execute a test with its limit."""
        signal.setitimer(signal.ITIMER_PROF, self.limits[item.nodeid])
        yield
        signal.setitimer(signal.ITIMER_PROF, 0.0)


class Coverage:
    """Processor time and covered lines of each test, as recorded."""

    def __init__(self, records: Sequence[Path]) -> None:
        self.cost: dict[str, float] = {}
        self.lines: dict[str, dict[int, set[str]]] = defaultdict(lambda: defaultdict(set))
        self.modules: dict[str, None] = {}
        for path in records:
            kept = json.loads(path.read_text())
            self.cost |= kept["cost"]
            self.modules |= dict.fromkeys(kept["modules"])
            names = [*kept["cost"]]
            for source, lines in kept["lines"].items():
                for line, tests in lines.items():
                    self.lines[source][int(line)].update(names[n] for n in tests)

    def tests(self, mutant: Mutant, patience_s: float) -> tuple[list[str], list[str]]:
        """Return tests that execute the statement: those of the file that mirrors the source, and
        the others. The cheapest tests are taken until the time is used up. The n-th case of a
        function counts as n times as expensive.

        If no test executes the statement, as in compiled functions, in headers of functions and
        outside functions, all tests that execute any line of the file are taken, and those of the
        file that mirrors it.
        """
        lines = self.lines[mutant.path]
        first, last = mutant.lines
        source = Path(mutant.path)
        mirror = "/".join(["tests", *source.parts[1:-1], f"test_{source.stem}"])
        names = {name for n in range(first, last + 1) for name in lines.get(n, ())}
        if not names:
            names = {name for covering in lines.values() for name in covering}
            names |= {name for name in self.cost if name.startswith(mirror)}
        taken: Counter[str] = Counter()
        ranked = []
        for name in sorted(names, key=lambda n: (self.cost[n], n)):
            if self.cost[name] < LONGEST_TEST_S:
                function = name.split("[")[0]
                taken[function] += 1
                ranked.append((self.cost[name] * taken[function], self.cost[name], name))
        chosen: tuple[list[str], list[str]] = ([], [])
        total = 0.0
        for _, cost, name in sorted(ranked):
            total += cost
            if total > patience_s and total > cost:
                break
            chosen[not name.startswith(mirror)].append(name)
        return chosen


def execute(parts: Iterable[dict[str, float]]) -> int:
    """Execute tests in this process, part by part, until one fails."""
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    for part in filter(None, parts):
        files = sorted({name.split("::")[0] for name in part})
        code = pytest.main([*OPTIONS, "-x", *files], plugins=[Selection(part)])
        if code not in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED):
            return int(code)
    return 0


Codes = dict[tuple[str, str, int], CodeType]
"""Codes of functions by file, qualified name and first line."""
Functions = dict[tuple[str, str, int], list[FunctionType]]


def _nested(code: CodeType) -> list[CodeType]:
    """Return the code of each function and class that is defined directly in a code."""
    return [value for value in code.co_consts if isinstance(value, CodeType)]


def _body(code: CodeType) -> tuple[Any, ...]:
    """Return what a code does, without the functions and classes that it defines."""
    constants = [repr(value) for value in code.co_consts if not isinstance(value, CodeType)]
    return code.co_code, constants, code.co_names, code.co_varnames, code.co_freevars


def _whole(code: CodeType) -> tuple[Any, ...]:
    return *_body(code), *map(_whole, _nested(code))


def _collect(code: CodeType, codes: Codes) -> None:
    codes[code.co_filename, code.co_qualname, code.co_firstlineno] = code
    for part in _nested(code):
        _collect(part, codes)


def changed_functions(old: CodeType, new: CodeType, codes: Codes) -> bool:
    """Collect the codes of the functions of a module or a class that differ, and of the functions
    in them. Return False if the body of the module or of a class differs: it runs at the import."""
    if _body(old) != _body(new):
        return False
    for a, b in zip(_nested(old), _nested(new), strict=True):
        if _whole(a) != _whole(b):
            if not a.co_flags & inspect.CO_OPTIMIZED:
                if not changed_functions(a, b, codes):
                    return False
            elif a.co_name.startswith("<") and a.co_name != "<lambda>":
                return False
            else:
                _collect(b, codes)
    return True


def imported_functions(folder: Path) -> Functions:
    """Return the functions of the imported files in a folder."""
    functions: Functions = defaultdict(list)
    for value in gc.get_objects():
        if isinstance(value, FunctionType) and value.__code__.co_filename.startswith(str(folder)):
            code = value.__code__
            functions[code.co_filename, code.co_qualname, code.co_firstlineno].append(value)
    return functions


def replace_functions(functions: Functions, path: Path, old: str, new: str) -> bool:
    """Give the functions of an imported file their new code; return whether that was possible."""
    codes: Codes = {}
    before, after = (compile(text, str(path), "exec") for text in (old, new))
    if "njit" in old or not changed_functions(before, after, codes) or not codes:
        return False
    for key, code in codes.items():
        for function in functions.get(key, ()):
            function.__code__ = code
    return next(iter(codes)) in functions


def judged(work: Any, log: Path) -> str:
    """Return the result of a mutant: `killed`, `timeout` or `survived`."""
    pid = os.fork()
    if pid == 0:
        os.setsid()
        for stream in (1, 2):
            os.dup2(os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND), stream)
        resource.setrlimit(resource.RLIMIT_AS, (8 << 30, 8 << 30))
        code = FAULT
        try:
            code = work()
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(code)
    status, used, last = None, "", time.monotonic()
    while status is None and time.monotonic() < last + LONGEST_SLEEP_S:
        done, value = os.waitpid(pid, os.WNOHANG)
        status = value if done else None
        if not done and used != (now := _used(pid)):
            used, last = now, time.monotonic()
        time.sleep(0.01)
    with suppress(ProcessLookupError):
        os.killpg(pid, signal.SIGKILL)
    if status is None:
        os.waitpid(pid, 0)
        return "timeout"
    code = os.waitstatus_to_exitcode(status)
    if code == FAULT:
        raise RuntimeError(f"the tests could not be executed: {log}")
    if code == UNCHANGED:
        return "unchanged"
    if code in (-signal.SIGKILL, -signal.SIGPROF):
        return "timeout"
    return "survived" if code == 0 else "killed"


def _used(pid: int) -> str:
    """Return the processor time of a process, in the units of the kernel."""
    return " ".join(Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[11:13])


def _digest(paths: Iterable[Path]) -> str:
    return hashlib.sha256(b"".join(path.read_bytes() for path in paths)).hexdigest()


class Trial:
    """A copy of the repository in a folder, in which one file at a time is changed."""

    def __init__(self, folder: Path) -> None:
        self.copy, self.folder = folder / "copy", folder
        self._time = int(time.time())
        self.versions: dict[str, str] = {}
        self.explained = equivalent()
        self._copy_repository()
        source = _digest(ROOT / name for name in self._files() if name.startswith("pbdkit/"))
        records = []
        for name in test_files():
            key = hashlib.sha256(f"{source} {_digest([ROOT / name])}".encode()).hexdigest()[:16]
            target = folder / "records" / f"{name.replace('/', '.')}-{key}.json"
            if not target.exists():
                target.parent.mkdir(exist_ok=True)
                command = [sys.executable, str(Path(__file__)), "--record", name, str(target)]
                subprocess.run(command, cwd=self.copy, env=self._environment(), check=True)
            records.append(target)
            self.versions[name] = key
        self.coverage = Coverage(records)

    def _files(self) -> list[str]:
        options = ["--cached", "--others", "--exclude-standard"]
        listed = subprocess.check_output(["git", "ls-files", *options], cwd=ROOT, text=True)
        return [name for name in listed.splitlines() if (ROOT / name).is_file()]

    def _copy_repository(self) -> None:
        for name in self._files():
            source, target = ROOT / name, self.copy / name
            target.parent.mkdir(parents=True, exist_ok=True)
            if not target.exists() or source.read_bytes() != target.read_bytes():
                shutil.copy2(source, target)

    def _environment(self) -> dict[str, str]:
        kernels = {"PBDKIT_CACHE_DIR": str(self.folder / "kernels"), "CI": "1"}
        kernels["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
        paths = os.pathsep.join([str(self.copy), *filter(None, [os.environ.get("PYTHONPATH")])])
        return os.environ | kernels | {"PYTHONPATH": paths, "OMP_NUM_THREADS": "1"}

    def prepare(self) -> None:
        """Import everything that tests use except pbdkit, which the forked processes import."""
        os.environ.update(self._environment())
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
        sys.dont_write_bytecode = False
        os.chdir(self.copy)
        (self.folder / "kernels").mkdir(exist_ok=True)
        sys.path[:] = [p for p in sys.path if not Path(p or ".").resolve().is_relative_to(ROOT)]
        sys.path.insert(0, str(self.copy))
        for name in self.coverage.modules:
            with suppress(Exception):
                importlib.import_module(name)
        assert not any(name.split(".")[0] == "pbdkit" for name in sys.modules)
        gc.collect()
        gc.freeze()

    def check(self) -> None:
        """Raise RuntimeError unless the cheapest tests pass without any change."""
        tests = sorted(self.coverage.cost, key=lambda name: self.coverage.cost[name])[:20]
        if self._judged([dict.fromkeys(tests, 60.0)]) != "survived":
            raise RuntimeError(f"the tests fail without any change: {self.folder / 'log'}")

    def results(
        self, mutants: Sequence[Mutant], patience_s: float
    ) -> Iterator[tuple[Mutant, str, float]]:
        """Yield mutants with their results and the processor time, each in a new process, except
        those that are explained."""
        for mutant in mutants:
            if mutant.change() in self.explained:
                continue
            begun = _children_s()
            with self._changed(mutant):
                extra = LIMIT_S + COMPILATION_S
                verdict = self._judged(self._tests(mutant, patience_s, extra))
            yield mutant, verdict, _children_s() - begun

    def replaced(
        self, mutants: Sequence[Mutant], patience_s: float
    ) -> Iterator[tuple[Mutant, str, float]]:
        """Yield those mutants that can be had by replacing the code of functions, with their
        results, which a process finds that has imported pbdkit and the tests.

        The result is `slow` if a test exceeded its limit, and is confirmed by `results`."""
        if not mutants:
            return
        source, target = os.pipe()
        if pid := os.fork():
            os.close(target)
            with os.fdopen(source) as lines:
                for line in lines:
                    number, verdict, spent = json.loads(line)
                    yield mutants[number], verdict, spent
            if os.waitpid(pid, 0)[1]:
                raise RuntimeError(f"a process of the trial ended early: {self.folder / 'log'}")
            return
        try:
            with os.fdopen(target, "w") as lines:
                functions = self._import_tests()
                for number, mutant in enumerate(mutants):
                    if mutant.change() in self.explained:
                        continue
                    path, begun = self.copy / mutant.path, _children_s()
                    old = path.read_text()
                    with self._changed(mutant) as new:
                        change = partial(replace_functions, functions, path, old, new)
                        extra = LIMIT_S + COMPILATION_S * (mutant.area in COMPILED)
                        verdict = self._judged(self._tests(mutant, patience_s, extra), change)
                    verdict = "slow" if verdict == "timeout" else verdict
                    if verdict != "unchanged":
                        spent = _children_s() - begun
                        print(json.dumps([number, verdict, spent]), file=lines, flush=True)
        except BaseException:
            traceback.print_exc()
            os._exit(1)
        os._exit(0)

    def _import_tests(self) -> Functions:
        """Import pbdkit and the tests, and return the functions."""
        log = os.open(self.folder / "log-of-import", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        streams = [os.dup(1), os.dup(2)]
        for stream in (1, 2):
            os.dup2(log, stream)
        files = sorted({name.split("::")[0] for name in self.coverage.cost})
        pytest.main([*OPTIONS, "--collect-only", *files])
        for stream, kept in zip((1, 2), streams, strict=True):
            os.dup2(kept, stream)
        gc.collect()
        gc.unfreeze()
        functions = imported_functions(self.copy / "pbdkit")
        gc.freeze()
        return functions

    @contextmanager
    def _changed(self, mutant: Mutant) -> Iterator[str]:
        """Write the changed file, and afterwards the original one."""
        path = self.copy / mutant.path
        original, changed = path.read_text(), mutant.code()
        try:
            self._write(path, changed)
            yield changed
        finally:
            self._write(path, original)

    def digest(self, mutant: Mutant, patience_s: float) -> str:
        """Return a digest of the tests of a mutant."""
        parts = self.coverage.tests(mutant, patience_s)
        names = [(name, self.versions[name.split("::")[0]]) for part in parts for name in part]
        return hashlib.sha256(json.dumps(names).encode()).hexdigest()

    def _tests(self, mutant: Mutant, patience_s: float, extra: float) -> list[dict[str, float]]:
        """Return tests of a mutant with their limits."""
        parts = self.coverage.tests(mutant, patience_s)
        return [{name: extra + 4 * self.coverage.cost[name] for name in part} for part in parts]

    def _judged(self, parts: Sequence[dict[str, float]], change: Any = lambda: True) -> str:
        """Execute tests with kernels of their own after a change in the process."""
        kernels, log = self.folder / "kernels-of-mutant", self.folder / "log"
        shutil.rmtree(kernels, ignore_errors=True)
        shutil.copytree(self.folder / "kernels", kernels, copy_function=os.link)
        os.environ["PBDKIT_CACHE_DIR"] = str(kernels)
        log.unlink(missing_ok=True)
        return judged(lambda: execute(parts) if change() else UNCHANGED, log)

    def _write(self, path: Path, text: str) -> None:
        """Write a file with a time of its own, so that no older bytecode counts as valid."""
        path.write_text(text)
        self._time += 2
        os.utime(path, (self._time, self._time))


def _children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def equivalent() -> dict[tuple[str, str, str], str]:
    """Return the mutants that change no result, with the reason."""
    entries = YAML(typ="safe").load(EQUIVALENT)
    return {(entry["file"], entry["line"], entry["mutant"]): entry["reason"] for entry in entries}


def report(results: dict[Mutant, str]) -> bool:
    """Print survivors and the table, and return whether the goal is met."""
    explained = equivalent()
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for mutant, verdict in sorted(results.items()):
        outcome = verdict
        if verdict == "survived":
            file, line, changed = mutant.change()
            outcome = "explained" if (file, line, changed) in explained else "survived"
            print(f"{outcome}: {mutant.name}\n    - {line}\n    + {changed}")
        counts[mutant.area][outcome] += 1
        counts["all"][outcome] += 1
    print("area | mutants | killed | of these by time limit | survived, explained | unexplained")
    for area in [*(a for a in AREAS if a in counts), "all"]:
        n = counts[area]
        killed = n["killed"] + n["timeout"]
        print(
            f"{area} | {n.total()} | {killed} | {n['timeout']} | {n['explained']} | {n['survived']}"
        )
    share = (n["killed"] + n["timeout"]) / max(1, n.total())
    print(f"killed: {share:.1%}, goal {GOAL:.0%}; unexplained survivors: {n['survived']}, goal 0")
    return share >= GOAL and not n["survived"]


class Results:
    """The results of mutants in a file. A survivor is tried again if it has other tests."""

    def __init__(self, path: Path, trial: Trial) -> None:
        self.path, self.trial = path, trial
        self.kept = json.loads(path.read_text()) if path.exists() else {}

    def _key(self, mutant: Mutant) -> str:
        return f"{mutant.name} {_digest([ROOT / mutant.path])}"

    def get(self, mutant: Mutant) -> str | None:
        """Return the result of a mutant."""
        verdict, _ = self.kept.get(self._key(mutant), (None, ""))
        return str(verdict) if verdict else None

    def is_open(self, mutant: Mutant, patience_s: float, *, is_last: bool) -> bool:
        """Return whether the mutant has no result, was slow or survived other tests."""
        verdict, tests = self.kept.get(self._key(mutant), (None, ""))
        if verdict == "slow":
            return is_last
        known = verdict in ("killed", "timeout")
        return not known and tests != self.trial.digest(mutant, patience_s)

    def keep(self, mutant: Mutant, verdict: str, patience_s: float) -> None:
        """Write the result of a mutant."""
        self.kept[self._key(mutant)] = verdict, self.trial.digest(mutant, patience_s)
        self.path.write_text(json.dumps(self.kept, indent=0))


def main() -> int:
    """Draw mutants, execute the tests, and report."""
    parser = argparse.ArgumentParser(description="Mutation testing of pbdkit.")
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--area", choices=[*AREAS], action="append", help="default: all")
    parser.add_argument("--folder", type=Path, default=ROOT / "build" / "mutants")
    parser.add_argument("--first", type=float, default=5.0, help="seconds of tests per mutant")
    parser.add_argument("--patience", type=float, default=60.0, help="the same for survivors")
    parser.add_argument("--show", action="store_true", help="print the mutants, execute nothing")
    parser.add_argument("--record", nargs=2, metavar=("FILE", "TARGET"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.record:
        record(options.record[0], Path(options.record[1]))
        return 0
    mutants = drawn(options.count, options.seed, options.area or [*AREAS])
    if options.show:
        print(*(mutant.name for mutant in mutants), sep="\n")
        return 0
    options.folder.mkdir(parents=True, exist_ok=True)
    trial = Trial(options.folder.resolve())
    results = Results(options.folder / "results.json", trial)
    trial.prepare()
    trial.check()
    for patience_s, way in ((options.first, trial.replaced), (options.patience, trial.results)):
        is_last = way == trial.results
        pending = [m for m in mutants if results.is_open(m, patience_s, is_last=is_last)]
        for mutant, verdict, spent in way(pending, patience_s):
            print(f"{mutant.area} | {mutant.name} | {verdict} | {spent:.1f} s", flush=True)
            results.keep(mutant, verdict, patience_s)
    verdicts = ((mutant, results.get(mutant) or "survived") for mutant in mutants)
    return 0 if report(dict(verdicts)) else 1


if __name__ == "__main__":
    sys.exit(main())
