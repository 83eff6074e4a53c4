"""One file of HTML with all that it needs: content, script, style.

Arrays as text inside a page: little-endian, bytes of one place together, gzip, base64.
"""

from __future__ import annotations

import json
import math
import re
from base64 import b64encode
from gzip import compress
from hashlib import sha256
from html import escape
from importlib.resources import files
from string import Template
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

IMPORT = re.compile(r'^import (\{[^}]*\}) from "\./([a-z_]+)\.js";$', re.M)
EXPORT = re.compile(r"^export ((?:async )?(?:function\*?|class|const) (\w+))", re.M)


def source(name: str) -> str:
    """The text of a file beside this one."""
    return files("pbdkit.web").joinpath(name).read_text("utf-8")


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


KINDS = {"f4": "<f4", "f8": "<f8", "i4": "<i4", "u1": "<u1"}
LARGEST = 1e30
"""What lies beyond is no number in a page: WebGL draws nothing there."""


def packed(values: ArrayLike, kind: str) -> dict[str, Any]:
    """The values as one of KINDS; `packed.js` reads them.

    First all lowest bytes of all numbers stand there, then the next ones: numbers that change
    slowly along the last dimension then take a tenth of the place.
    """
    array = np.asarray(values)
    if kind[0] == "f":
        array = np.where(np.abs(array) > LARGEST, np.nan, array)
    array = np.ascontiguousarray(array, KINDS[kind])
    by_place = array.reshape(-1, 1).view(np.uint8).T.tobytes()
    data = b64encode(compress(by_place, 6, mtime=0)).decode()
    return {"packed": kind, "shape": list(array.shape), "data": data}
