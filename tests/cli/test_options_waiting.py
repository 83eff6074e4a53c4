"""Messages for a user waiting at a terminal, which no other output contains."""

from __future__ import annotations

import io
import time
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr
from typing import Any

import pytest

from pbdkit import progress as module
from pbdkit.progress import waiting


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture(autouse=True)
def _at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "DELAY_S", 0.02)
    monkeypatch.setenv("TERM", "xterm")


@contextmanager
def looking(shown: io.StringIO) -> Iterator[io.StringIO]:
    """Replace stderr here, and not in a fixture: between the two pytest takes it back."""
    with redirect_stderr(shown):
        yield shown


def until(shown: io.StringIO, text: str) -> None:
    """At most some seconds: a busy machine does not decide."""
    end = time.monotonic() + 10.0
    while text not in shown.getvalue() and time.monotonic() < end:
        time.sleep(0.01)


def test_slow_phases_and_the_next_one_are_reported() -> None:
    with looking(Terminal()) as shown, waiting("counting [sheep]") as say:
        until(shown, "counting [sheep]")
        say("sleeping")
        until(shown, "sleeping")
    assert "counting [sheep]" in shown.getvalue()
    assert "sleeping" in shown.getvalue()
    assert "0:00:0" in shown.getvalue()


def test_quick_phases_are_not_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "DELAY_S", 60.0)
    with looking(Terminal()) as shown, waiting("blinking"):
        pass
    assert shown.getvalue() == ""


@pytest.mark.parametrize("silent", [True, False])
def test_no_progress_without_a_terminal_or_with_quiet(silent: bool) -> None:
    file = Terminal() if silent else io.StringIO()
    with looking(file) as shown, waiting("counting", silent=silent) as say:
        say("sleeping")
        time.sleep(0.1)
    assert shown.getvalue() == ""


def test_progress_line_disappears_on_failure() -> None:
    def divide() -> None:
        with waiting("dividing"):
            until(shown, "dividing")
            raise ZeroDivisionError

    with looking(Terminal()) as shown, pytest.raises(ZeroDivisionError):
        divide()
    assert "dividing" in shown.getvalue()
    assert shown.getvalue().endswith("\x1b[?25h\r\x1b[1A\x1b[2K")


@pytest.mark.parametrize("command", ["check", "identify"])
def test_json_output_contains_only_json(
    call: Any, command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "DELAY_S", 0.0)
    with looking(Terminal()) as shown:
        assert call(command, "e.json", "--json").code == 0
    assert shown.getvalue() == ""
