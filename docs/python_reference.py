"""Directive `{python}`: the reference of Python names, generated from their numpydoc docstrings.

Its content lists the names of a page, one a line. A table with the first sentence of each comes
first, then an entry for each. The members of a class are those that it defines, or those that
follow a colon: ``pbdkit.Simulation: step run``. A name ``ds.pbd.NAME`` is a method of the accessor.
"""

from __future__ import annotations

import inspect
import re
import sys
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass, is_dataclass
from functools import cache, cached_property
from importlib import import_module
from typing import Any

from docutils import nodes
from pydantic import BaseModel
from sphinx.application import Sphinx
from sphinx.ext.napoleon import Config
from sphinx.ext.napoleon.docstring import NumpyDocstring
from sphinx.pycode import ModuleAnalyzer
from sphinx.util.docutils import SphinxDirective

import pbdkit
from pbdkit import plotting
from pbdkit.accessor import PbdAccessor

MODULES = (pbdkit.errors, pbdkit, plotting, pbdkit.plugin, pbdkit.testing)
"""Modules that declare public names in `__all__`; a name of several is documented in the last."""
ACCESSOR = "ds.pbd."
"""Prefix of the methods of the accessor. Functions of `pbdkit.plotting` are documented as such."""
FULL_NAMES = {
    name: f"{ACCESSOR}{name}" if hasattr(PbdAccessor, name) else f"{module.__name__}.{name}"
    for module in MODULES
    for name in module.__all__
}
"""Public names as they are documented."""
TYPES = {
    "Any": "object",
    "Array": "array",
    "Floats": "array of float",
    "Indices": "array of int",
    "Integers": "array of int",
    "Mask": "array of bool",
}
"""Names of types in the reference, by their names in annotations."""
STYLE = Config(napoleon_use_ivar=True)
"""Settings of the conversion of docstrings."""


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive in Sphinx."""
    app.add_directive("python", PythonReference)
    return {"parallel_read_safe": True}


class PythonReference(SphinxDirective):
    """Reference of the names in its content."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        """Return the table and the entries."""
        entries = [entry_of(line) for line in self.content if line.strip()]
        for entry in entries:
            if inspect.isroutine(entry.value) or inspect.isclass(entry.value):
                self.env.note_dependency(inspect.getfile(inspect.unwrap(entry.value)))
        text = "\n".join([*table(entries), *(line for e in entries for line in e.lines())])
        return self.parse_text_to_nodes(f"```{{eval-rst}}\n{text}\n```")


@dataclass(frozen=True)
class Entry:
    """A documented name.

    Parameters
    ----------
    name : str
        Name as users write it; that of a member alone.
    value : object
        The object; the function of a property.
    kind : str
        Type of object in Sphinx's Python domain.
    members : tuple of Entry
        Documented members of a class.
    comment : str
        Docstring of a constant or class variable, below its assignment.
    """

    name: str
    value: Any
    kind: str
    members: tuple[Entry, ...] = ()
    comment: str = ""

    @cached_property
    def docstring(self) -> str:
        """Docstring, with the fields of a pydantic model."""
        text = self.comment or inspect.getdoc(self.value) or ""
        return with_fields(text, self.value) if is_model(self.value) else text

    @property
    def summary(self) -> str:
        """First sentence of the docstring."""
        paragraph = " ".join(self.docstring.split("\n\n")[0].split())
        return re.split(r"(?<=[.]) (?=[A-Z`])", paragraph)[0]

    @property
    def is_called(self) -> bool:
        """True if users call the object; classes of results are only returned."""
        if inspect.isclass(self.value):
            is_public = any(self.value in vars_of(module) for module in MODULES)
            return is_public and bool(constructor_parameters(self.value))
        return self.kind in ("function", "method")

    @property
    def parameters(self) -> list[inspect.Parameter]:
        """Parameters of a call."""
        if inspect.isclass(self.value):
            has_fields = self.is_called or is_dataclass(self.value)
            return constructor_parameters(self.value) if has_fields else []
        if not self.is_called:
            return []
        parameters = [*inspect.signature(self.value).parameters.values()]
        is_bound = self.name.startswith(ACCESSOR) or (
            self.kind == "method" and parameters and parameters[0].name in ("self", "cls")
        )
        return parameters[1:] if is_bound else parameters

    @property
    def signature(self) -> str:
        """Signature of a call, without annotations."""
        plain = [p.replace(annotation=inspect.Parameter.empty) for p in self.parameters]
        return str(inspect.Signature(plain)) if self.is_called else ""

    def lines(self) -> Iterator[str]:
        """Yield the entry as reStructuredText."""
        yield f".. py:{self.kind}:: {self.name}{self.signature}"
        if self.kind == "property" and (kind := self.value.__annotations__.get("return")):
            yield f"   :type: {type_text(kind)}"
        yield ""
        yield textwrap.indent(converted(self), "   ")
        yield ""
        for member in self.members:
            yield textwrap.indent("\n".join(member.lines()), "   ")


def entry_of(line: str) -> Entry:
    """Return the entry that a line of the directive describes."""
    name, colon, listed = line.strip().partition(":")
    if name.startswith(ACCESSOR):
        return Entry(name, getattr(PbdAccessor, name.removeprefix(ACCESSOR)), "function")
    module, _, attribute = name.rpartition(".")
    value = getattr(import_module(module), attribute)
    if inspect.isfunction(value):
        return Entry(name, value, "function")
    if not inspect.isclass(value):
        return Entry(name, value, "data", comment=comment_of(attribute, value))
    kind = "exception" if issubclass(value, BaseException) else "class"
    members = (member_of(value, m) for m in (listed.split() if colon else members_of(value)))
    return Entry(name, value, kind, tuple(members))


def member_of(cls: type, name: str) -> Entry:
    """Return a member of a class."""
    value = inspect.getattr_static(cls, name, None)
    if comment := comments_of(cls.__module__).get((cls.__name__, name)):
        return Entry(name, value, "attribute", comment="\n".join(comment))
    if isinstance(value, property | cached_property):
        return Entry(name, value.fget if isinstance(value, property) else value.func, "property")
    return Entry(name, getattr(value, "__func__", value), "method")


def members_of(cls: type) -> Iterator[str]:
    """Yield the public class variables, methods and properties that a class defines."""
    fields = {parameter.name for parameter in constructor_parameters(cls)}
    for name in dict.fromkeys([*inspect.get_annotations(cls), *vars(cls)]):
        value = vars(cls).get(name)
        is_member = inspect.isroutine(value) or isinstance(value, property | cached_property)
        is_documented = (cls.__name__, name) in comments_of(cls.__module__)
        if (
            (is_member or is_documented)
            and name not in fields
            and not name.startswith(("_", "model_"))
        ):
            yield name


def vars_of(module: Any) -> list[Any]:
    """Return the public objects of a module."""
    return [getattr(module, name) for name in module.__all__]


@cache
def comments_of(module: str) -> dict[tuple[str, str], list[str]]:
    """Return the docstrings below assignments of a module, by class and name."""
    return ModuleAnalyzer.for_module(module).find_attr_docs()


def comment_of(name: str, value: Any) -> str:
    """Return the docstring of a constant."""
    for module in sorted(m for m in sys.modules if m.startswith("pbdkit.")):
        # Parsing takes time, so that only modules that assign the constant are parsed.
        is_there = vars(sys.modules[module]).get(name) is value and assigns(module, name)
        if is_there and (comment := comments_of(module).get(("", name))):
            return "\n".join(comment)
    raise LookupError(f"{name} has no docstring")


def assigns(module: str, name: str) -> bool:
    """Return whether a line of a module begins with an assignment to a name."""
    source = inspect.getsource(sys.modules[module])
    return re.search(rf"^{name}\b[^=\n]*=", source, re.M) is not None


def is_model(value: Any) -> bool:
    """Return whether an object is a pydantic class."""
    return inspect.isclass(value) and issubclass(value, BaseModel)


def fields_of(model: type[BaseModel]) -> list[tuple[str, Any]]:
    """Return the fields that a model adds to those of its base class."""
    inherited = getattr(model.__mro__[1], "__pydantic_fields__", {})
    return [(name, f) for name, f in model.model_fields.items() if name not in inherited]


def constructor_parameters(cls: type) -> list[inspect.Parameter]:
    """Return the parameters with which a class is called."""
    if is_model(cls):
        return [parameter_of(*field) for field in fields_of(cls)]
    if issubclass(cls, BaseException) and "__init__" not in vars(cls):
        return []
    return [*inspect.signature(cls).parameters.values()]


class ShortDefault(str):
    """Text in place of a long default in a signature."""

    def __repr__(self) -> str:
        return str(self)


def parameter_of(name: str, field: Any) -> inspect.Parameter:
    """Return a field of a model as a keyword; a default that depends on other fields is `...`."""
    by_others = field.default_factory_takes_validated_data
    default = ShortDefault("...") if by_others else field.get_default(call_default_factory=True)
    if field.is_required():
        default = inspect.Parameter.empty
    elif isinstance(default, BaseModel):
        default = ShortDefault(f"{type(default).__name__}()")
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default)


def with_fields(text: str, model: type[BaseModel]) -> str:
    """Insert the descriptions of the fields of a model before the sections of its docstring."""
    rows = [f"{name}\n    {field.description or ''}" for name, field in fields_of(model)]
    if not rows:
        return text
    start = re.search(r"^[A-Z]\w+\n-+$", text, re.M)
    place = start.start() if start else len(text)
    section = "\n".join(["\n\nParameters\n----------", *rows, "\n"])
    return text[:place].rstrip() + section + text[place:]


def type_text(annotation: Any) -> str:
    """Return an annotation as it is written in the reference."""
    text = annotation if isinstance(annotation, str) else inspect.formatannotation(annotation)
    text = text.replace("NDArray[np.bool_]", "Mask").replace(" | ", " or ")
    return re.sub(r"\b\w+\b", lambda word: TYPES.get(word[0], word[0]), text)


def converted(entry: Entry) -> str:
    """Return a docstring as reStructuredText, with the types of annotations where it has none."""
    text = str(NumpyDocstring(entry.docstring, STYLE, what=entry.kind))
    for parameter in entry.parameters:
        field = f":param {parameter.name}:"
        if parameter.annotation is not parameter.empty and f":type {parameter.name}:" not in text:
            kind = f":type {parameter.name}: {type_text(parameter.annotation)}"
            text = text.replace(field, f"{kind}\n{field}")
    text = re.sub(r"``.*?``|\|", lambda found: r"\|" if found[0] == "|" else found[0], text)
    return linked(text)


def linked(text: str) -> str:
    """Return a text with links to public names, and other words between backticks as literals."""

    def replacement(match: re.Match[str]) -> str:
        name = match[1]
        full = FULL_NAMES.get(name, name)
        is_public = full != name or re.fullmatch(r"(pbdkit|ds\.pbd)\.[\w.]+", name)
        return f":py:obj:`{name} <{full}>`" if is_public else f"``{name}``"

    return re.sub(r"(?<![`:\w])`([^`\n:<]+)`(?![`_])", replacement, text)


def table(entries: list[Entry]) -> Iterator[str]:
    """Yield a table of all names with their first sentences."""
    yield ".. list-table::\n   :class: summary\n   :widths: 30 70\n"
    for entry in entries:
        short = entry.name.startswith(ACCESSOR) or entry.name.count(".") == 1
        title = entry.name if short else entry.name.rpartition(".")[2]
        yield f"   * - :py:obj:`{title} <{entry.name}>`\n     - {linked(entry.summary)}"
    yield ""
