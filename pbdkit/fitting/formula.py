"""Formulas of the quantities that are derived from a fit."""

from __future__ import annotations

import ast
import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

NAME = re.compile(r"(?<![\w.])[^\W\d]\w*(?:\.\w+)*")
"""Pattern of a name: a variable of a diagnostic, or the path of a parameter."""
MAX_LENGTH = 200
"""Maximum number of characters of a formula."""
OPERATIONS: dict[type[ast.AST], Callable[..., Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.UAdd: operator.pos,
    ast.USub: operator.neg,
}
"""Operations in formulas, by the class of their node in a syntax tree."""


@dataclass(frozen=True)
class Formula:
    """An arithmetic expression of named quantities.

    It consists of names, numbers, `+ - * / **`, parentheses, and indices from 0 in brackets.

    Parameters
    ----------
    text
        The expression, for example `youngs_modulus / (2 * (1 + rule.poisson_ratio))` or `K_I[1]`.
    """

    text: str

    @classmethod
    def read(cls, text: str) -> Formula:
        """Return the formula of a text.

        Raises
        ------
        ValueError
            If the text is not a formula.
        """
        formula = cls(text)
        if len(text) > MAX_LENGTH:
            raise ValueError(f"a formula has at most {MAX_LENGTH} characters")
        _refuse_others(formula._tree, text)
        if not formula.names:
            raise ValueError(f"'{text}' contains no name of a quantity")
        return formula

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names in the formula, each once."""
        return tuple(dict.fromkeys(NAME.findall(self.text)))

    @property
    def is_name(self) -> bool:
        """Return whether the formula is a single quantity, with or without an index."""
        return isinstance(self._tree, ast.Name | ast.Subscript)

    def indexed(self, index: tuple[int, ...]) -> str:
        """Return the formula of one of several values."""
        numbers = ", ".join(map(str, index))
        if isinstance(self._tree, ast.Subscript):
            return f"{self.text.rstrip().removesuffix(']').rstrip()}, {numbers}]"
        return f"{self.text if self.is_name else f'({self.text})'}[{numbers}]"

    @cached_property
    def _tree(self) -> ast.expr:
        # Paths are not names in Python, and are replaced by their numbers.
        numbered = NAME.sub(lambda match: f"_{self.names.index(match[0])}", self.text)
        try:
            return ast.parse(numbered.strip(), mode="eval").body
        except (SyntaxError, RecursionError, MemoryError):
            raise ValueError(f"'{self.text}' is not a formula; {EXPECTED}") from None

    def value(self, values: Mapping[str, NDArray[Any]]) -> NDArray[Any]:
        """Evaluate the formula.

        Parameters
        ----------
        values
            Real or complex values by name.

        Raises
        ------
        ValueError
            If an index is out of range, or if the shapes of arrays differ.
        """

        def evaluate(node: ast.AST) -> Any:
            if isinstance(node, ast.Constant):
                return np.asarray(node.value, float)
            if isinstance(node, ast.Name):
                return values[self.names[int(node.id[1:])]]
            if isinstance(node, ast.Subscript):
                return evaluate(node.value)[_index(node.slice)]
            if isinstance(node, ast.UnaryOp):
                return OPERATIONS[type(node.op)](evaluate(node.operand))
            assert isinstance(node, ast.BinOp)
            return OPERATIONS[type(node.op)](evaluate(node.left), evaluate(node.right))

        try:
            with np.errstate(all="ignore"):
                return np.asarray(evaluate(self._tree))
        except IndexError as error:
            raise ValueError(f"'{self.text}': {error}") from None


EXPECTED = (
    "expected names of quantities, numbers, + - * / **, parentheses and indices in brackets, as in "
    "K_I[0] ** 2 / youngs_modulus"
)
"""Description of formulas in messages."""


def _refuse_others(node: ast.AST, text: str) -> None:
    """Raise ValueError for a node that is not a part of formulas."""
    if isinstance(node, ast.Subscript):
        valid = isinstance(node.value, ast.Name) and _index(node.slice) is not None
        parts: list[ast.AST] = []
    elif isinstance(node, ast.BinOp | ast.UnaryOp):
        valid = type(node.op) in OPERATIONS
        operands = [node.left, node.right] if isinstance(node, ast.BinOp) else [node.operand]
        parts = [*operands]
    else:
        is_number = isinstance(node, ast.Constant) and type(node.value) in (int, float)
        valid, parts = is_number or isinstance(node, ast.Name), []
    if not valid:
        raise ValueError(f"'{text}' is not a formula; {EXPECTED}")
    for part in parts:
        _refuse_others(part, text)


def _index(node: ast.AST) -> tuple[int, ...] | None:
    """Return an index of whole numbers; None for any other index."""
    nodes = node.elts if isinstance(node, ast.Tuple) else [node]
    numbers = [part.value for part in nodes if isinstance(part, ast.Constant)]
    if len(numbers) < len(nodes) or any(type(number) is not int for number in numbers):
        return None
    return tuple(int(str(number)) for number in numbers)
