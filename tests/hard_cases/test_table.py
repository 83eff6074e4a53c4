"""Every hard case has a row with a number in docs/validation/stability.md, and tests of its own."""

import ast
import re
from pathlib import Path

import pytest

CASES = Path(__file__).parent
PAGE = CASES.parents[1] / "docs" / "validation" / "stability.md"
COUNT = 25
CHECKS = ("raises", "warns", "assert_allclose")


def rows():
    """The rows of the table, each as its cells, by number."""
    table = PAGE.read_text().split("## Hard cases")[1].split("\n## ")[0]
    found = [line.strip("| ").split(" | ") for line in table.splitlines() if line.startswith("| ")]
    return [cells for cells in found if cells[0].isdigit()]


def checks(function):
    """Return whether a test asserts its expected result."""
    for node in ast.walk(function):
        called = node.func if isinstance(node, ast.Call) else None
        if isinstance(node, ast.Assert) or getattr(called, "attr", "") in CHECKS:
            return True
    return False


def numbered_tests():
    """The number of the case and the function, of all tests of hard cases."""
    for path in sorted(CASES.glob("test_*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            number = re.match(r"test_case_(\d+)_", getattr(node, "name", None) or "")
            if number and isinstance(node, ast.FunctionDef):
                yield int(number[1]), node


def test_table_has_one_row_per_case():
    assert [int(cells[0]) for cells in rows()] == list(range(1, COUNT + 1))


@pytest.mark.parametrize("cells", rows(), ids=lambda cells: cells[0])
def test_row_has_event_treatment_and_a_measured_number(cells):
    assert len(cells) == 5
    assert all(len(cell) > 3 for cell in cells[1:])
    assert re.search(r"\d", cells[4])


@pytest.mark.parametrize("number", range(1, COUNT + 1))
def test_every_case_has_tests_with_assertions(number):
    own = [function for n, function in numbered_tests() if n == number]
    assert own
    assert all(checks(function) for function in own)


def test_every_test_belongs_to_a_case_of_the_table():
    assert {n for n, _ in numbered_tests()} <= set(range(1, COUNT + 1))
