"""One file of HTML with all that it needs: content, script, style."""

from __future__ import annotations

import json
import math
import re
from base64 import b64encode
from hashlib import sha256
from html import escape
from importlib.resources import files
from string import Template
from typing import Any

IMPORT = re.compile(r'^import (\{[^}]*\}) from "\./([a-z_]+)\.js";$', re.M)
EXPORT = re.compile(r"^export ((?:async )?(?:function\*?|class|const) (\w+))", re.M)


def source(name: str) -> str:
    """The text of a file beside this one."""
    return files("pbdkit.pages").joinpath(name).read_text("utf-8")


def script(name: str, *, exports: bool = False) -> str:
    """The module `name`.js with all that it imports as one that imports nothing: each is a function
    of its own, called once, that returns what it exports. With `exports` the whole exports what
    the module does."""
    texts: dict[str, str] = {}

    def take(name: str) -> None:
        text = source(f"{name}.js")
        for _, needed in IMPORT.findall(text):
            if needed not in texts:
                take(needed)
        texts[name] = text

    take(name)
    modules = [_closed(name, text) for name, text in texts.items()]
    given = EXPORT.findall(texts[name])
    if exports:
        modules.append(f"export const {{ {', '.join(n for _, n in given)} }} = {name}_js;")
    return "\n".join(modules)


def _closed(name: str, text: str) -> str:
    given = ", ".join(exported for _, exported in EXPORT.findall(text))
    inner = EXPORT.sub(r"\1", IMPORT.sub(r"const \1 = \2_js;", text))
    return f"const {name}_js = (() => {{\n{inner}\nreturn {{ {given} }};\n}})();"


def page(content: dict[str, Any]) -> str:
    """The page; whatever the content holds is text in it, and no request leaves it."""
    code = script("report")
    # In JSON, `<` can stand in texts alone; so nothing ends the element that holds it.
    held = json.dumps(_finite(content), allow_nan=False).replace("<", "\\u003c")
    digest = b64encode(sha256(code.encode()).digest()).decode()
    return Template(source("page.html")).substitute(
        title=escape(f"{content['title']}: report"),
        style=source("page.css"),
        content=held,
        script=code,
        hash=f"sha256-{digest}",
    )


def _finite(value: Any) -> Any:
    """The same with null for what is no number: JSON has none."""
    if isinstance(value, dict):
        return {str(key): _finite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(inner) for inner in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
