"""Types used in the whole package."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

BoolArray = NDArray[np.bool_]
FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]
Progress = Callable[[int, int], object]
"""Called as ``progress(done, total)``; an exception from it stops the work."""
