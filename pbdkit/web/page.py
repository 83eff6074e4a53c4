"""Self-contained HTML pages: content, script and style in one file.

Arrays are stored as text in a page. They are little-endian numbers, in which bytes of equal
significance are stored together, compressed by gzip and encoded as base64.
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
"""Regular expression for an import statement in JavaScript."""
EXPORT = re.compile(r"^export ((?:async )?(?:function\*?|class|const) (\w+))", re.M)
"""Regular expression for an export in JavaScript."""


def source(name: str) -> str:
    """Return the text of a file in this package."""
    return files("pbdkit.web").joinpath(name).read_text("utf-8")


def script(name: str, *, exports: bool = False) -> str:
    """Bundle the module `name`.js and all modules that it imports into a single script without
    imports.

    Each module becomes a function that is called once and returns the exports of the module. With
    `exports` the script exports the names that the module `name`.js exports.
    """
    texts: dict[str, str] = {}

    def take(name: str) -> None:
        text = source(f"{name}.js")
        for _, needed in IMPORT.findall(text):
            if needed not in texts:
                take(needed)
        texts[name] = text

    take(name)
    modules = [_closed(name, text) for name, text in texts.items()]
    exported = EXPORT.findall(texts[name])
    if exports:
        modules.append(f"export const {{ {', '.join(n for _, n in exported)} }} = {name}_js;")
    return "\n".join(modules)


def _closed(module: str, text: str) -> str:
    names = ", ".join(name for _, name in EXPORT.findall(text))
    inner = EXPORT.sub(r"\1", IMPORT.sub(r"const \1 = \2_js;", text))
    return f"const {module}_js = (() => {{\n{inner}\nreturn {{ {names} }};\n}})();"


def page(content: dict[str, Any]) -> str:
    """Return the page as HTML. The content is embedded as data, so that the page makes no
    requests."""
    code = script("report")
    # In JSON `<` occurs only in texts. It is escaped so that no text can end the HTML element.
    data = json.dumps(_finite(content), allow_nan=False).replace("<", "\\u003c")
    digest = b64encode(sha256(code.encode()).digest()).decode()
    return Template(source("page.html")).substitute(
        title=escape(f"{content['title']}: report"),
        style=source("page.css"),
        content=data,
        script=code,
        hash=f"sha256-{digest}",
    )


def _finite(value: Any) -> Any:
    """Replace numbers that are not finite by None, which JSON writes as null."""
    if isinstance(value, dict):
        return {str(key): _finite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(inner) for inner in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


KINDS = {"f4": "<f4", "f8": "<f8", "i4": "<i4", "u1": "<u1"}
"""Data types of arrays by their names in JavaScript."""
MAX_NUMBER = 1e30
"""Largest magnitude of a number in a page. WebGL cannot draw larger numbers."""


def packed(values: ArrayLike, kind: str) -> dict[str, Any]:
    """Pack values with the data type `kind`, one of KINDS. `packed.js` reads them.

    The least significant bytes of all numbers are stored first, then the next bytes of all numbers,
    and so on. After compression, numbers that vary slowly along the last dimension take only a
    tenth of the size.
    """
    array = np.asarray(values)
    if kind[0] == "f":
        array = np.where(np.abs(array) > MAX_NUMBER, np.nan, array)
    array = np.ascontiguousarray(array, KINDS[kind])
    by_place = array.reshape(-1, 1).view(np.uint8).T.tobytes()
    data = b64encode(compress(by_place, 6, mtime=0)).decode()
    return {"packed": kind, "shape": list(array.shape), "data": data}
