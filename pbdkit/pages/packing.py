"""Arrays as text inside a page: little-endian, bytes of one place together, gzip, base64."""

from __future__ import annotations

from base64 import b64encode
from gzip import compress
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

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
