"""Sources of plugins for tests: one that works, and every way to be broken."""
# ruff: noqa: E501  (a row of a table is a line)

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any


def rule(kind: str, extra: str = "") -> str:
    """The source of a plugin with the rule of that type: mean displacement, times `strength`."""
    return f'''
from typing import Literal
import pbdkit

class Rule(pbdkit.FollowerRule):
    type: Literal["{kind}"] = "{kind}"
    strength: float = 1.0

    @staticmethod
    def gather(d, r, w, p):
        return d, 1.0

    @staticmethod
    def apply(total, here, p):
        return p.strength * total[0] / total[1]

@pbdkit.hookimpl
def pbdkit_components():
    return [Rule]
{extra}'''


def hook(body: str) -> str:
    return f"import pbdkit\n@pbdkit.hookimpl\ndef pbdkit_components():\n    {body}\n"


def changed(old: str, new: str) -> str:
    assert old in rule("changed")
    return rule("changed").replace(old, new)


TYPELESS = hook("return [Rule]") + (
    "class Rule(pbdkit.FollowerRule):\n"
    "    @staticmethod\n    def gather(d, r, w, p): return (1.0,)\n"
    "    @staticmethod\n    def apply(total, here, p): return 0.0 * here.u\n"
)
ABSTRACT = hook("return [Rule]") + (
    "class Rule(pbdkit.FollowerRule):\n    type: str = 'half'\n"
    "    @staticmethod\n    def gather(d, r, w, p): return (1.0,)\n"
)
UNSPEAKABLE = "class Mute(Exception):\n    def __str__(self): raise Mute\nraise Mute"
BROKEN = {
    "import error": ("import no_such_module", "ModuleNotFoundError: No module named 'no_such_module' (pbdkit_broken.py, line 1)"),
    "syntax error": ("def (", "SyntaxError: invalid syntax (pbdkit_broken.py, line 1)"),
    "exit": ("raise SystemExit(3)", "SystemExit: 3 (pbdkit_broken.py, line 1)"),
    "any error": ("\n1 / 0", "ZeroDivisionError: division by zero (pbdkit_broken.py, line 2)"),
    "unspeakable error": (UNSPEAKABLE, "Mute: (its message is not available) (pbdkit_broken.py, line 3)"),
    "error like markup": ("raise OSError('[/red] \\x1b[31m')", "OSError: [/red] [31m (pbdkit_broken.py, line 1)"),
    "endless recursion": ("def f(): f()\nf()", "RecursionError: maximum recursion depth exceeded"),
    "no hook": ("", "TypeError: its module implements no hook `pbdkit_components`"),
    "misspelt hook": (hook("return []").replace("components", "component"), "PluginValidationError: unknown hook 'pbdkit_component'"),
    "hook with an argument": (hook("return []").replace("()", "(x)", 1), "PluginValidationError: Plugin 'pbdkit-broken' for hook 'pbdkit_components'"),
    "error in the hook": (hook("return {}[1]"), "KeyError: 1 (pbdkit_broken.py, line 4)"),
    "exit in the hook": (hook("raise SystemExit"), "SystemExit (pbdkit_broken.py, line 4)"),
    "no list": (hook("return 3"), "TypeError: its hook `pbdkit_components` must return a list of component classes"),
    "nothing": (hook("return None"), "TypeError: its hook `pbdkit_components` must return a list of component classes"),
    "a class for a list": (hook("return pbdkit.FollowerRule"), "TypeError: its hook `pbdkit_components` must return a list"),
    "no component": (hook("return [int]"), "TypeError: <class 'int'> does not implement an interface of pbdkit"),
    "no class": (hook("return [{}]"), "TypeError: {} does not implement an interface of pbdkit"),
    "an object": (changed("[Rule]", "[Rule()]"), "TypeError: expected the class Rule, got an object of it; give Rule"),
    "an interface": (hook("return [pbdkit.FollowerRule]"), "TypeError: FollowerRule declares no type: add `type: Literal["),
    "no type": (TYPELESS, "TypeError: Rule declares no type: add `type: Literal["),
    "a type with a colon": (rule("a:b"), "TypeError: Rule has the type 'a:b'; a type must begin with a letter or digit"),
    "abstract": (ABSTRACT, "TypeError: Rule does not define apply(total, here, p)"),
    "not static": (changed("    @staticmethod\n    def apply", "    def apply"), "TypeError: Rule.apply must be static: write @staticmethod above it, without `self` in apply(total, here, p)"),
    "wrong signature": (changed("gather(d, r, w, p)", "gather(d, r)"), "TypeError: Rule.gather(d, r) has other arguments; declare gather(d, r, w, p)"),
    "unknown annotation": (changed("strength: float", "strength: 'Nothing'"), "TypeError: the parameters of Rule cannot be described in a JSON Schema: PydanticUserError: "),
    "parameter without a schema": ("from collections.abc import Callable" + changed("strength: float = 1.0", "strength: Callable = print"), "TypeError: the parameters of Rule cannot be described in a JSON Schema: "),
    "twice a type": (rule("twice", "class Twin(Rule):\n    pass\n").replace("[Rule]", "[Rule, Twin]"), "it has two classes with the type 'twice'; change the type of one of them"),
}  # fmt: skip
"""Sources by kind, and the beginnings of the reasons that pbdkit gives."""

NEWER = "pbdkit_api = 2\n" + rule("newer")


def listed(call: Callable[..., Any]) -> dict[str, dict[str, str]]:
    """Return the rows of `plugins list` for each plugin, by distribution."""
    rows = json.loads(call("plugins", "list", "--json").out)
    return {row["distribution"]: row for row in rows if row["interface"] == "plugin"}
