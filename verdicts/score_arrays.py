"""Names for the kinds of arrays that judgements take and return."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# How often something was drawn.
Counts = NDArray[np.int64]
