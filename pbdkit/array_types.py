"""Types of arrays in annotations."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
"""Array of any type."""
Floats = NDArray[np.floating[Any]]
"""Real numbers in the precision of the scene, or in double precision."""
Indices = NDArray[np.intp]
"""Positions along an axis of another array."""
Integers = NDArray[np.signedinteger[Any]]
"""Signed integers of any size."""
Mask = NDArray[np.bool_]
"""True where a condition holds."""
Bytes = NDArray[np.uint8]
"""Bytes, for instance of a file or an image."""
