"""Dark count rates over the pixels of an array."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked


@checked
def dark_count_map(
    shape: tuple[int, int],
    *,
    median_hz: float,
    spread: float = 0.5,
    hot_fraction: float = 0.02,
    hot_factor: float = 100.0,
    seed: int = 0,
) -> NDArray[np.float64]:
    """A realistic map (H, W) of dark count rates, counts/s, for `Flux.with_dark_counts`.

    Rates of the pixels of an array are log-normal, with a population of "hot" pixels far above the rest.

    Parameters
    ----------
    shape
        (H, W).
    median_hz
        Median of the pixels that are not hot, counts/s.
    spread
        Standard deviation of the logarithm of the rate.
    hot_fraction
        Probability that a pixel is hot, in [0, 1].
    hot_factor
        Median of the hot pixels over that of the others; their logarithms spread alike.
    seed
        Integer in [0, 2**64).

    Raises
    ------
    TypeError
        A rate, factor or shape that is no number.
    ValueError
        A shape that is not (H, W), or a number out of its range.

    See Also
    --------
    Detector, Flux

    Examples
    --------
    >>> import mars_lidar as ml
    >>> rates = ml.dark_count_map((4, 6), median_hz=50.0)
    >>> rates.shape
    (4, 6)
    """
    if not isinstance(shape, tuple | list) or len(shape) != 2:
        raise ValueError(f"shape must be (H, W), got {shape!r}")
    size = tuple(checks.integer("shape", n, low=1, high=2**20) for n in shape)
    median = checks.real("median_hz", median_hz, low=0.0)
    sigma = checks.real("spread", spread, low=0.0, high=10.0)
    share = checks.real("hot_fraction", hot_fraction, low=0.0, high=1.0)
    factor = checks.real("hot_factor", hot_factor, low=1.0)
    random = np.random.Generator(np.random.PCG64(checks.integer("seed", seed, low=0, high=2**64 - 1)))
    hot = random.random(size) < share
    return np.asarray(median * np.exp(sigma * random.standard_normal(size)) * np.where(hot, factor, 1.0))
