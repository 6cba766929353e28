"""Types used in the whole package."""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

BoolArray = NDArray[np.bool_]
FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]
Progress = Callable[[int, int], object]
"""Called as ``progress(done, total)``; an exception from it stops the work."""

__all__ = ["ArrayLike", "BoolArray", "FloatArray", "IndexArray", "NDArray", "Progress"]
