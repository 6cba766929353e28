"""Tolerances and limits of the package `mars_lidar.learn`, each with its unit and origin."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Tolerances:
    """Quantities that determine accuracy, work or memory of this package."""

    # forward: the cyclic solver
    krylov: int = 40
    """Dimension of the Krylov space of GMRES; 14 steps do in most pixels."""
    restarts: int = 25
    """Of GMRES, before it gives up."""
    residual: float = 1e-13
    """Relative to the source, at which GMRES stops: three digits above the rounding of double precision."""
    accepted_residual: float = 1e-9
    """Relative to the source, where rounding prevents further progress."""
    cached_values: int = 2**15
    """Pixels x bins solved together on a CPU: a working array of 256 KiB stays in the cache."""
    arrays: int = 24
    """(pixels, bins) beside the Krylov space, the powers of two of the recursion among them."""

    # forward: the expected histogram
    parts_of_width: float = 4.0
    """Of sigma of the pulse, or of a box as high as a measured one; `expected_histogram` states the error."""
    parts_of_period: float = 2048.0
    """With a measured pulse, whose edges have derivatives within 4e-3 then, at up to 5 photons of background."""
    followed_dead_times: float = 625.0
    """An armed exposure of fewer dead times is followed period by period. In a longer one the last registrations pass
    for those of a settled pixel: where none settles (bright light, one registration in several periods), their sum is
    off by at most 1/2, and the total variation by 1 / (4 x 625)."""
    followed_periods: int = 20_000
    """In such an exposure at most: some 5 s a batch on one core."""
    repeated: float = 1e-9
    """Change of the registrations of a bin from one period to the next, relative, at which periods repeat."""
    photons: int = 2**22
    """Pixels x bins in memory together: 32 MiB."""

    # tabulated
    table_values: int = 2**18
    """Pixels x bins evaluated together: 2 MiB."""

    # likelihood: bins that are cut (bias: docs/learn.md and tests/learn/test_likelihood.py)
    even: float = 0.1
    """Widths of the pulse in a bin in which light and registrations pass for even."""
    part: float = 0.5
    """Widths of the pulse in a cell of wider bins; half as many in the second of the two that are extrapolated."""
    reach: float = 5.0
    """Sigma of a Gaussian pulse on each side: beyond it there is 6e-7 of its light."""
    rounds: int = 60
    """In which registrations are distributed over cells that depend on each other."""
    settled: float = 1e-10
    """Change of the registrations of a cell, relative to the cycles, at which the rounds end."""

    # streams
    zero_photons: float = 0.2
    """In the exposure, that an estimate of zero stands for in a logarithm."""
    decoded_bytes: int = 256 * 2**20
    """Of chunks of several exposures, which are decoded whole: what a worker holds of them."""
    slots: int = 64
    """Scenes in the memory that workers share; its pages are taken as scenes come."""
    pool: int = 16
    """Ray-cast scenes in use together."""
    margin: float = 1.5
    """Side of a ray-cast scene relative to the crop taken from it."""
    cached_scenes: int = 32
    """In memory, of a worker."""
    crop_tries: int = 20
    """Places tried for a crop with a return in it."""


TOLERANCES = Tolerances()
