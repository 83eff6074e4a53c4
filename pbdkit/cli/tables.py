"""Tables that commands print. Only this module imports rich, because the import takes longer than
most commands."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence

from rich.box import SIMPLE, SIMPLE_HEAD
from rich.console import Console
from rich.table import Column, Table
from rich.text import Text

__all__ = ["SIMPLE", "SIMPLE_HEAD", "Column", "Table", "add_rows", "show_table"]

UNLIMITED = 10_000
"""Width of tables that are not printed on a terminal."""


def add_rows(table: Table, rows: Iterable[Sequence[str]]) -> None:
    """Add rows of plain text. In them, ``[x]`` is not interpreted as markup."""
    for row in rows:
        table.add_row(*map(Text, row))


def show_table(table: Table, *, stderr: bool = False) -> None:
    """Print a table. If the output is not a terminal, each row is one line."""
    is_terminal = (sys.stderr if stderr else sys.stdout).isatty()
    width = None if is_terminal else UNLIMITED
    Console(stderr=stderr, width=width, highlight=False).print(table)
