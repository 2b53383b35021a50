"""Names for the kinds of arrays that functions take and return.

Shapes are not part of a type: docstrings give them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

# Integers of any width, such as the int32 that halves the size of a large map.
AnyInts = NDArray[np.integer]
