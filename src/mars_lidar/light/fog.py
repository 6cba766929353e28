"""Returns through homogeneous fog: attenuated, with its backscatter."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.resources import check_memory
from mars_lidar._base.types import FloatArray, NDArray
from mars_lidar.instrument.system import SPEED_OF_LIGHT_M_PER_NS, System
from mars_lidar.light.flux import Flux, StoredFlux
from mars_lidar.light.tolerances import TOL
from mars_lidar.light.transient import through_pulse


@dataclass(frozen=True, kw_only=True)
class Fog:
    """Homogeneous fog in front of a scene, for any level of light.

    Attributes
    ----------
    extinction_per_m
        Extinction coefficient alpha, 1/m; 3.91 / (visibility in m), by Koschmieder's law.
    backscatter
        Photons backscattered by fog without a target, per photon of the mean signal in clear air: both are proportional
        to the power of the laser.
    nearest_m
        Depth from which on laser and field of view overlap, m.
    """

    extinction_per_m: float
    backscatter: float
    nearest_m: float = 1.0

    def __post_init__(self) -> None:
        for name, above in (("extinction_per_m", True), ("backscatter", False), ("nearest_m", True)):
            object.__setattr__(self, name, checks.real(name, getattr(self, name), low=0.0, strict_low=above))

    def before(self, flux: Flux, system: System, signal: float) -> StoredFlux:
        """Returns of the mean `signal` through this fog: `Flux.in_fog`, computed row by row on use."""
        parts = TOL.parts_per_bin * system.bins
        photons = self.backscatter * signal
        step = max(1, TOL.work_bytes // (8 * flux.shape[1] * parts))

        def rows(wanted: slice) -> Flux:
            waveform = np.empty((wanted.stop - wanted.start, flux.shape[1], parts))
            for first in range(wanted.start, wanted.stop, step):
                last = min(first + step, wanted.stop)
                band = in_fog(flux[first:last], system, self.extinction_per_m, photons, self.nearest_m, parts)
                waveform[first - wanted.start : last - wanted.start] = band.waveform
            return Flux(waveform=waveform, background=flux.background[wanted], info=info)

        info = flux.info | {
            "extinction_per_m": self.extinction_per_m,
            "backscatter": photons,
            "nearest_m": self.nearest_m,
        }
        lit, depth = _depths(flux)
        transmitted = (flux.returns_signal * np.exp(-2.0 * self.extinction_per_m * depth)).sum(axis=0)
        cloud = photons * _share(_farthest(lit, depth), self.extinction_per_m, self.nearest_m)
        return StoredFlux(transmitted + cloud, flux.background, parts, rows, info)


def in_fog(
    flux: Flux, system: System, extinction_per_m: float, backscatter: float, nearest_m: float, parts: int | None
) -> Flux:
    """The body of `Flux.in_fog`, which documents arguments and formulas."""
    if flux.waveform is not None:
        raise ValueError("in_fog needs the delays of returns, got a flux of waveforms")
    alpha = checks.real("extinction_per_m", extinction_per_m, low=0.0, strict_low=True)
    photons = checks.real("backscatter", backscatter, low=0.0)
    first = checks.real("nearest_m", nearest_m, low=0.0, strict_low=True)
    number = TOL.parts_per_bin * system.bins if parts is None else checks.integer("parts", parts, low=1, high=2**20)
    check_memory(48 * math.prod(flux.shape) * number, "the waveforms", "take rows: flux[rows]")
    lit, depth = _depths(flux)
    info = flux.info | {"extinction_per_m": alpha, "backscatter": photons, "nearest_m": first}

    wave = np.zeros((*flux.shape, number))
    for signal, tau, z in zip(flux.returns_signal, flux.returns_delay_ns, depth, strict=True):
        transmitted = (signal * np.exp(-2.0 * alpha * z))[..., None]
        wave += transmitted * system.pulse.bin_energy(np.nan_to_num(tau), system.period_ns, number)
    if photons > 0.0:
        cloud = _cloud(_farthest(lit, depth), alpha, first, 0.5 * SPEED_OF_LIGHT_M_PER_NS * system.period_ns, number)
        wave += photons * through_pulse(cloud, system)
    return Flux(waveform=np.maximum(wave, 0.0), background=flux.background, info=info)


def _depths(flux: Flux) -> tuple[NDArray[np.bool_], FloatArray]:
    """Which returns there are, and their depths, m (K, H, W); 0 where there is none."""
    lit = flux.returns_signal > 0
    depth = np.where(lit, 0.5 * SPEED_OF_LIGHT_M_PER_NS * flux.returns_delay_ns, 0.0)
    if (depth < 0.0).any():
        raise ValueError(f"delay_ns must be >= 0 in fog, got {2 * depth.min() / SPEED_OF_LIGHT_M_PER_NS:g}")
    return lit, depth


def _farthest(lit: NDArray[np.bool_], depth: FloatArray) -> FloatArray:
    """Range at which the beam of each pixel ends (H, W), m."""
    return np.asarray(np.where(lit.any(0), depth.max(0, initial=0.0), math.inf), np.float64)


def _cloud(farthest: FloatArray, alpha: float, first: float, reach_m: float, number: int) -> FloatArray:
    """Part of the backscatter in each part of the period (H, W, number), of fog up to the farthest return.

    `reach_m` is the range of one period. What returns after 256 periods is spread evenly over the period: by then the
    density, ~ 1 / z^2, changes by 2 / 256 within one, and z_0 / (256 reach_m) of the light is still to come.
    """
    reached = min(float(farthest.max()), first + 0.5 * TOL.fog_depths / alpha) / reach_m
    periods = min(TOL.fog_periods, 1 << math.ceil(math.log2(max(1.0, math.floor(reached) + 1.0))))
    edges, before = _folded(alpha, first, reach_m, number, periods)
    until = _share(farthest, alpha, first)[..., None]
    whole = np.minimum(np.floor(farthest / reach_m), periods).astype(np.int64)  # periods passed from end to end
    beyond = (whole == periods)[..., None]
    last = np.diff(np.minimum(edges[np.minimum(whole, periods - 1)], until), axis=-1)  # of the period it ends in
    rest = np.maximum(until - edges[-1, -1], 0.0) / number
    return np.asarray(before[whole] + np.where(beyond, rest, last))


@lru_cache(maxsize=4)
def _folded(alpha: float, first: float, reach_m: float, number: int, periods: int) -> tuple[FloatArray, FloatArray]:
    """Of each of the first periods: the share from before each edge (periods, number + 1); and, of none to all of
    them, the share in each part of the period (periods + 1, number)."""
    depth = np.arange(periods * number + 1, dtype=np.float64) * (reach_m / number)
    share = _share(depth, alpha, first)
    rows = np.lib.stride_tricks.sliding_window_view(share, number + 1)[::number]
    before = np.concatenate([np.zeros((1, number)), np.cumsum(np.diff(rows, axis=-1), axis=0)])
    return rows, before


def _share(depth: FloatArray, alpha: float, first: float) -> FloatArray:
    """Part of the backscatter that comes from before a depth: 1 - F(z) / F(z_0), F(z) = E_2(2 alpha z) / z."""
    from scipy.special import expn

    z = np.maximum(depth, first)
    tail = np.where(np.isinf(z), 0.0, expn(2, 2.0 * alpha * np.minimum(z, 1e300)) / z)
    return np.asarray(1.0 - tail * first / expn(2, 2.0 * alpha * first), dtype=np.float64)
