"""What the loaders of networks read of one exposure of a dataset, each variable under their name."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.types import FloatArray
from mars_lidar.dataset.read import read_sparse
from mars_lidar.dataset.samples import sample_parts
from mars_lidar.dataset.write import Maker
from mars_lidar.instrument.system import System
from mars_lidar.io import mat
from mars_lidar.light.flux import Flux

_MAT_BYTES = 2**31 - 2**16  # of a variable in a v5 file
_PULSE_BINS, _PULSE_PEAK = 16, 6  # what `deepsensorfusion` reads: the pulse in so many bins, its peak in that one
_PULSE_LEAST = 0.999  # of its energy


class Exposure:
    """The variables of one exposure; `fill` gives pixels without a return those of the nearest pixel with one.

    Photons are those of the detected flux before dead time: detection efficiency and dark counts are in them.
    """

    def __init__(self, maker: Maker, sample: int, realization: int, fill: bool) -> None:
        self._dataset, self._sample, self._realization = maker.dataset, sample, realization
        self._system = maker.dataset.recipe.systems[sample_parts(maker.dataset.recipe, sample)[1]]
        self._flux: Flux = maker.flux(sample).detected(self._system)
        lit = self._flux.signal > 0
        self._place: Any = ...
        if fill and lit.any() and not lit.all():
            from scipy.ndimage import distance_transform_edt

            self._place = tuple(distance_transform_edt(~lit, return_distances=False, return_indices=True))
        shown = maker.scene(sample)
        self.depth: FloatArray = np.nan_to_num(np.where(lit, shown.depth_m, 0.0)[self._place])  # m; 0: no return
        reflectivity = np.nan_to_num(shown.reflectivity)
        self._reflectivity: FloatArray = reflectivity / max(1.0, float(reflectivity.max(initial=0.0)))

    @property
    def rates(self) -> NDArray[np.float32]:
        """(H, W, bins), signal before dead time, largest bin of a pixel 1."""
        return np.asarray(mat.rates(self._flux, self._system).astype(np.float32)[self._place])

    @cached_property
    def _bins(self) -> tuple[NDArray[Any], FloatArray]:
        whole, fine = mat.return_bins(self._flux, self._system)
        return whole[self._place], fine[self._place]

    @cached_property
    def _counts(self) -> Any:
        """(H W, bins), pixel y W + x."""
        return read_sparse(self._dataset, self._sample, self._realization)

    @property
    def spad(self) -> Any:
        """Sparse (H W, bins), pixel y + H x as MATLAB counts."""
        from scipy import sparse

        counts = self._counts
        height, width = self._flux.shape
        row = counts.row % width * height + counts.row // width
        check_size("spad", 12 * counts.nnz)
        return sparse.csc_matrix((counts.data.astype(np.float64), (row, counts.col)), shape=counts.shape)

    @property
    def est_range_bins_argmax(self) -> NDArray[Any]:
        """Fullest bin, from 1; the first of equals."""
        counts = self._counts
        order = np.lexsort((counts.col, -counts.data.astype(np.int64), counts.row))
        pixels, first = np.unique(counts.row[order], return_index=True)
        out = np.ones(counts.shape[0], np.uint16 if counts.shape[1] < 2**16 else np.uint32)
        out[pixels] = counts.col[order][first] + 1
        return out.reshape(self._flux.shape)

    @property
    def bin(self) -> NDArray[Any]:
        """Bin of the return from 1; 0 without one."""
        return self._bins[0]

    range_bins = bin

    @property
    def bin_hr(self) -> NDArray[np.float64]:
        """The same as a real number, at 8 times the size."""
        return mat.larger(self._bins[1])

    @property
    def intensity(self) -> NDArray[np.float64]:
        """Reflectivity in [0, 1]."""
        return self._reflectivity

    @property
    def intensity_hr(self) -> NDArray[np.uint8]:
        """Reflectivity in 0 ... 255, at 8 times the size."""
        return mat.larger(np.round(255.0 * self._reflectivity).astype(np.uint8))

    @property
    def level_depth(self) -> NDArray[np.float64]:
        """The scene's median depth, m, in every pixel."""
        seen = self.depth[self.depth > 0]
        return np.full(self.depth.shape, np.median(seen) if seen.size else 0.0)

    @property
    def signal_ppp(self) -> NDArray[np.float64]:
        """Signal photons per laser pulse."""
        return self._flux.signal

    @property
    def ambient_ppp(self) -> NDArray[np.float64]:
        """Background photons per laser pulse and bin."""
        return self._flux.background / self._system.bins

    @property
    def pulse(self) -> NDArray[np.float64]:
        """(H, W, 16), energy of the pulse in bins around that of the return, which is the seventh."""
        flux = self._flux
        delay = np.where(flux.signal > 0, flux.delay_ns, 0.0)
        return np.asarray(pulse_in_bins(self._system, delay, flux.signal)[self._place])

    @property
    def mean_signal_photons(self) -> float:
        """Signal photons of an exposure before dead time, mean over pixels."""
        return float(self._flux.signal.mean()) * self._system.cycles

    photons = mean_signal_photons

    @property
    def mean_background_photons(self) -> float:
        """Background photons of an exposure before dead time, mean over pixels."""
        return float(self._flux.background.mean()) * self._system.cycles

    @property
    def SBR(self) -> float:
        """Ratio of these two."""
        return self.mean_signal_photons / self.mean_background_photons if self.mean_background_photons else np.inf

    @property
    def bin_size(self) -> float:
        """Width of a bin, s."""
        return 1e-9 * self._system.bin_ns


def pulse_in_bins(system: System, delay_ns: NDArray[Any], signal: NDArray[Any]) -> NDArray[np.float64]:
    """Energy (H, W, 16) of the pulse at each delay (H, W), ns, in bins of which the seventh is the delay's.

    A ValueError where more than a thousandth of the energy of a pixel with `signal` (H, W) lies in no such bin.
    """
    place = np.floor(np.mod(delay_ns, system.period_ns) / system.bin_ns).astype(np.int64) % system.bins
    inside = (place[..., None] - _PULSE_PEAK + np.arange(_PULSE_BINS)) % system.bins
    out = np.empty((*delay_ns.shape, _PULSE_BINS))
    for y in range(len(delay_ns)):  # a row at a time: all bins of an image need not fit in memory
        energy = system.pulse.bin_energy(delay_ns[y], system.period_ns, system.bins)
        out[y] = np.take_along_axis(energy, inside[y], axis=-1)
    if (out.sum(-1)[signal > 0] < _PULSE_LEAST).any():
        beyond = 100 * (1 - float(out.sum(-1)[signal > 0].min()))
        raise ValueError(
            f"deepsensorfusion holds pulses of {_PULSE_BINS} bins with their peak in the seventh, and {beyond:.2g} % "
            f"of the energy of this one lie beyond, in bins of {1e3 * system.bin_ns:.4g} ps"
        )
    return out


def psf(system: System) -> NDArray[np.float64]:
    """(bins, 1), energy of the pulse in bins, around the middle of those that hold any."""
    energy = np.roll(system.pulse.bin_energy(0.5 * system.bin_ns, system.period_ns, system.bins), system.bins // 2)
    held = np.flatnonzero(energy > 1e-6 * energy.max())
    half = max(system.bins // 2 - held[0], held[-1] - system.bins // 2)
    first, last = max(0, system.bins // 2 - half), min(system.bins, system.bins // 2 + half + 1)
    return np.asarray(energy[first:last, None])


def check_size(name: str, size: int) -> None:
    """Raise ValueError where a variable of `size` bytes does not fit a MATLAB v5 file."""
    if size > _MAT_BYTES:
        raise ValueError(f"a variable of a .mat (v5) takes less than 2 GiB, and {name} would {size / 2**30:.3g} GiB")
