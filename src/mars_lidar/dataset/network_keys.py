"""What the loaders of networks read of one exposure of a dataset, each variable under their name."""

from __future__ import annotations

import math
from collections.abc import Callable
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
        self._depth: FloatArray = np.nan_to_num(np.where(lit, shown.depth_m, 0.0)[self._place])
        reflectivity = np.nan_to_num(shown.reflectivity)
        self._reflectivity: FloatArray = reflectivity / max(1.0, float(reflectivity.max(initial=0.0)))

    @cached_property
    def _bins(self) -> tuple[NDArray[Any], FloatArray]:
        whole, fine = mat.return_bins(self._flux, self._system)
        return whole[self._place], fine[self._place]

    @cached_property
    def _counts(self) -> Any:
        """(H W, bins), pixel y W + x."""
        return read_sparse(self._dataset, self._sample, self._realization)

    def _spad(self) -> Any:
        from scipy import sparse

        counts = self._counts
        height, width = self._flux.shape
        row = counts.row % width * height + counts.row // width
        check_size("spad", 12 * counts.nnz)
        return sparse.csc_matrix((counts.data.astype(np.float64), (row, counts.col)), shape=counts.shape)

    def _fullest(self) -> NDArray[Any]:
        counts = self._counts
        order = np.lexsort((counts.col, -counts.data.astype(np.int64), counts.row))
        pixels, first = np.unique(counts.row[order], return_index=True)
        out = np.ones(counts.shape[0], np.uint16 if counts.shape[1] < 2**16 else np.uint32)
        out[pixels] = counts.col[order][first] + 1
        return out.reshape(self._flux.shape)

    def _matched(self) -> NDArray[Any]:
        """Bin of the largest value of the counts correlated with the pulse, from 1; the first of equals."""
        counts = self._counts.toarray().astype(np.float64)
        pulse = self._system.pulse.bin_energy(0.5 * self._system.bin_ns, self._system.period_ns, self._system.bins)
        spectrum = np.fft.rfft(counts, axis=-1) * np.conj(np.fft.rfft(pulse))
        matched = np.fft.irfft(spectrum, n=self._system.bins, axis=-1).round(9)
        kind = np.uint16 if self._system.bins < 2**16 else np.uint32
        return np.asarray((matched.argmax(-1) + 1).astype(kind).reshape(self._flux.shape))

    def _pulse(self) -> NDArray[np.float64]:
        delay = np.where(self._flux.signal > 0, self._flux.delay_ns, 0.0)
        return np.asarray(pulse_in_bins(self._system, delay, self._flux.signal)[self._place])

    def _median(self) -> NDArray[np.float64]:
        seen = self._depth[self._depth > 0]
        return np.full(self._depth.shape, np.median(seen) if seen.size else 0.0)

    def _photons(self, per_period: NDArray[np.float64]) -> float:
        """Of an exposure before dead time, mean over pixels."""
        mean = float(per_period.mean()) * self._system.cycles
        whole = float(round(mean))  # loaders cut it to an integer: 19.999999999999996 is 20
        return whole if math.isclose(mean, whole, rel_tol=1e-12) else mean

    def _ratio(self) -> float:
        background = self._photons(self._flux.background)
        return self._photons(self._flux.signal) / background if background else np.inf

    def __getitem__(self, key: str) -> Any:
        return KEYS[key](self)


KEYS: dict[str, Callable[[Exposure], Any]] = {  # maps are (H, W)
    "spad": Exposure._spad,  # sparse (H W, bins), pixel y + H x as MATLAB counts
    "rates": lambda e: mat.rates(e._flux, e._system).astype(np.float32)[e._place],  # (H, W, bins), largest bin 1
    "bin": lambda e: e._bins[0],  # of the return, from 1; 0 without one
    "range_bins": lambda e: e._bins[0],
    "bin_hr": lambda e: mat.larger(e._bins[1]),  # the same as a real number, at 8 times the size
    "est_range_bins_argmax": Exposure._fullest,  # bin, from 1; the first of equals
    "est_range_bins_lmf": Exposure._matched,  # of the counts correlated with the pulse, from 1; the first of equals
    "depth": lambda e: e._depth,  # m; 0 without a return
    "level_depth": Exposure._median,  # of the scene, m, in every pixel
    "intensity": lambda e: e._reflectivity,  # in [0, 1]
    "intensity_hr": lambda e: mat.larger(np.round(255.0 * e._reflectivity).astype(np.uint8)),  # at 8 times the size
    "signal_ppp": lambda e: e._flux.signal,  # photons per laser pulse
    "ambient_ppp": lambda e: e._flux.background / e._system.bins,  # photons per laser pulse and bin
    "pulse": Exposure._pulse,  # (H, W, 16), its energy in bins around that of the return, which is the seventh
    "mean_signal_photons": lambda e: e._photons(e._flux.signal),
    "photons": lambda e: e._photons(e._flux.signal),
    "mean_background_photons": lambda e: e._photons(e._flux.background),
    "SBR": Exposure._ratio,  # of these two
    "bin_size": lambda e: 1e-9 * e._system.bin_ns,  # s
}


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
