"""Returns seen through homogeneous fog: attenuated, and behind its own backscatter."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from mars_lidar import _validate
from mars_lidar._memory import check_memory

if TYPE_CHECKING:
    from mars_lidar.flux import FloatArray, Flux
    from mars_lidar.system import System

_DARK = 40.0  # optical depths of the way there and back beyond which nothing comes: e^-40


def in_fog(
    flux: Flux,
    system: System,
    extinction_per_m: float,
    backscatter: float,
    nearest_m: float,
    parts: int | None,
) -> Flux:
    """The body of `Flux.in_fog`, which documents arguments and formulas."""
    from mars_lidar.flux import Flux
    from mars_lidar.system import SPEED_OF_LIGHT_M_PER_NS
    from mars_lidar.transient import Transient

    if flux.waveform is not None:
        raise ValueError("in_fog needs the delays of returns, got a flux of waveforms")
    alpha = _validate.real("extinction_per_m", extinction_per_m, low=0.0, strict_low=True)
    photons = _validate.real("backscatter", backscatter, low=0.0)
    first = _validate.real("nearest_m", nearest_m, low=0.0, strict_low=True)
    number = 4 * system.bins if parts is None else _validate.integer("parts", parts, low=1, high=2**20)
    check_memory(48 * math.prod(flux.shape) * number, "the waveforms", "take rows: flux[rows]")
    lit = flux.returns_signal > 0
    depth = np.where(lit, 0.5 * SPEED_OF_LIGHT_M_PER_NS * flux.returns_delay_ns, 0.0)
    if (depth < 0.0).any():
        raise ValueError(f"delay_ns must be >= 0 in fog, got {2 * depth.min() / SPEED_OF_LIGHT_M_PER_NS:g}")
    info = flux.info | {"extinction_per_m": alpha, "backscatter": photons, "nearest_m": first}

    wave = np.zeros((*flux.shape, number))
    for signal, tau, z in zip(flux.returns_signal, flux.returns_delay_ns, depth, strict=True):
        left = (signal * np.exp(-2.0 * alpha * z))[..., None]
        wave += left * system.pulse.bin_energy(np.nan_to_num(tau), system.period_ns, number)
    if photons > 0.0:
        part_ns = system.period_ns / number
        farthest = np.asarray(np.where(lit.any(0), depth.max(0, initial=0.0), math.inf), np.float64)  # ends the beam
        reach = min(float(farthest.max()), first + 0.5 * _DARK / alpha)
        number_of_edges = math.ceil(2.0 * reach / (SPEED_OF_LIGHT_M_PER_NS * part_ns)) + 2
        edges = np.arange(number_of_edges, dtype=np.float64) * part_ns
        share = _share(np.multiply(0.5 * SPEED_OF_LIGHT_M_PER_NS, edges), alpha, first)
        until = _share(farthest, alpha, first)
        cloud = np.diff(np.minimum(share, until[..., None]), axis=-1)
        if cloud.any():
            spread = Transient(cloud, part_ns).flux(system, photons_per_unit=photons, parts=number).waveform
            assert spread is not None
            wave += spread
    return Flux(waveform=np.maximum(wave, 0.0), background=flux.background, info=info)


def _share(depth: FloatArray, alpha: float, first: float) -> FloatArray:
    """Part of the backscatter that comes from before a depth: 1 - F(z) / F(z_0), F(z) = E_2(2 alpha z) / z."""
    from scipy.special import expn

    z = np.maximum(depth, first)
    tail = np.where(np.isinf(z), 0.0, expn(2, 2.0 * alpha * np.minimum(z, 1e300)) / z)
    return np.asarray(1.0 - tail * first / expn(2, 2.0 * alpha * first), dtype=np.float64)
