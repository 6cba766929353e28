"""Expected histograms and the likelihood of a histogram, differentiable in signal, background and delay (PyTorch)."""

from __future__ import annotations

import math
from typing import Any

from mars_lidar.io.optional import MissingLibraryError

try:
    import torch
except ImportError as _error:
    raise MissingLibraryError(f"mars_lidar.learn needs PyTorch: pip install 'mars-lidar[learn]' ({_error})") from _error

from mars_lidar import _validate
from mars_lidar.pulse import GaussianPulse, Pulse, SampledPulse
from mars_lidar.system import System

_BLOCK_BYTES = 2**27  # of matrices that are solved at a time
_FINE = 4.0  # bins per sigma of the grid (docs/joint_law.md)


def bin_photons(
    signal: torch.Tensor, background: torch.Tensor, delay_ns: torch.Tensor, system: System, *, refine: int = 1
) -> torch.Tensor:
    """Photons per period in each bin, l = S s + B / n (..., bins x refine); the pulse wraps into the period.

    Parameters
    ----------
    signal, background, delay_ns
        Tensors (...) of one floating type and device that broadcast: S and B photons per period, delay in ns.
    refine
        Parts that each bin is cut into.
    """
    signal, background, delay_ns = _inputs(signal, background, delay_ns)
    bins = system.bins * _validate.integer("refine", refine, low=1, high=2**16)
    edges = torch.arange(bins + 1, dtype=signal.dtype, device=signal.device) * (system.period_ns / bins)
    low, high = system.pulse.support_ns()
    time = edges - torch.remainder(delay_ns, system.period_ns).unsqueeze(-1)
    first, last = math.floor(-high / system.period_ns), math.ceil((2 * system.period_ns - low) / system.period_ns)
    energy = torch.zeros_like(time)
    for turn in range(-last, -first + 1):
        energy = energy + _cumulative(system.pulse, time - turn * system.period_ns)
    return signal.unsqueeze(-1) * energy.diff(dim=-1) + background.unsqueeze(-1) / bins


def expected_histogram(
    signal: torch.Tensor,
    background: torch.Tensor,
    delay_ns: torch.Tensor,
    system: System,
    *,
    refine: int | None = None,
) -> torch.Tensor:
    """Expected registrations in each bin (..., bins) under dead time; differentiable once in all three arguments.

    Solves ``h = p (N_r - G h) + q I h`` round the circle of a period: G counts the registrations of the preceding dead
    time, I those of one dead time ago (docs/joint_law.md). The gradient is that of the solution, by one solve
    with the transposed matrix, not of the steps that led there. Exact for ``start="stationary"`` up to the grid; from
    an armed start the first dead time adds less than t_d / t_r + 1 registrations, which are left out.

    Parameters
    ----------
    signal, background, delay_ns
        As for `bin_photons`.
    system
        Non-paralyzable, without gate or effects, with a dead time of 0 or of at least a bin of the grid.
    refine
        Parts that each bin is cut into for the solution; None: four to a sigma of the pulse (1 for a measured pulse).

    Raises
    ------
    ValueError, TypeError
        Bad arguments; a detector that this form does not describe.

    Notes
    -----
    Matrices are dense: O(bins^3) a pixel, in blocks, on the CPU or a GPU. Meant for up to some 512 bins.
    """
    if not isinstance(system, System):
        raise TypeError(f"system must be a System, got {type(system).__name__}")
    _check(system)
    if refine is None:
        pulse = system.pulse
        refine = max(1, math.ceil(_FINE * system.bin_ns / pulse.sigma_ns)) if isinstance(pulse, GaussianPulse) else 1
    photons = bin_photons(signal, background, delay_ns, system, refine=refine)
    bins = photons.shape[-1]
    dead = system.dead_time_periods
    if dead == 0.0:
        fine = photons * system.cycles
    elif dead * bins < 1.0:
        raise ValueError(f"dead_time_ns must be 0 or at least a bin of the grid, {system.period_ns / bins:g} ns")
    else:
        rows = photons.reshape(-1, bins)
        fine = _Registered.apply(rows, dead, system.cycles).reshape(photons.shape)  # type: ignore[no-untyped-call]
    return fine.reshape(*fine.shape[:-1], system.bins, refine).sum(-1)


class _Registered(torch.autograd.Function):
    """Registrations (pixels, bins) of photons per period and bin."""

    @staticmethod
    def forward(ctx: Any, photons: torch.Tensor, dead: float, cycles: int) -> torch.Tensor:
        armed, rearmed = _feedback(photons, dead)
        parts = [_solve(part, armed, rearmed, cycles) for part in torch.split(photons, _block(photons))]
        out = torch.cat(parts)
        ctx.save_for_backward(photons, out)
        ctx.dead, ctx.cycles = dead, cycles
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        photons, out = ctx.saved_tensors
        armed, rearmed = _feedback(photons, ctx.dead)
        size = _block(photons)
        found = []
        for part, h, g in zip(*(torch.split(x, size) for x in (photons, out, gradient)), strict=True):
            y = torch.linalg.solve(_matrix(part, armed, rearmed).mT, g.unsqueeze(-1)).squeeze(-1)
            _, _, dp, dq = _fired(part)
            # implicit function: A dh = dp (N_r - G h) + dq I h
            found.append(y * (dp * (ctx.cycles - h @ armed.mT) + dq * (h @ rearmed.mT)))
        return torch.cat(found), None, None


def _solve(photons: torch.Tensor, armed: torch.Tensor, rearmed: torch.Tensor, cycles: int) -> torch.Tensor:
    p, *_ = _fired(photons)
    out: torch.Tensor = torch.linalg.solve(_matrix(photons, armed, rearmed), (cycles * p).unsqueeze(-1)).squeeze(-1)
    return out


def _matrix(photons: torch.Tensor, armed: torch.Tensor, rearmed: torch.Tensor) -> torch.Tensor:
    p, q, *_ = _fired(photons)
    eye = torch.eye(photons.shape[-1], dtype=photons.dtype, device=photons.device)
    return eye + p.unsqueeze(-1) * armed - q.unsqueeze(-1) * rearmed


def _fired(light: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """p = 1 - e^-l of a bin armed throughout, q = 1 - p / l of one re-armed inside of it, and their derivatives."""
    quiet, p = torch.exp(-light), -torch.expm1(-light)
    dim = light < 0.02
    safe = torch.where(dim, torch.ones_like(light), light)
    series = light * (0.5 - light * (1 / 6 - light * (1 / 24 - light * (1 / 120 - light / 720))))
    slope = 0.5 - light * (1 / 3 - light * (1 / 8 - light * (1 / 30 - light / 144)))
    q, dq = torch.where(dim, series, 1 - p / safe), torch.where(dim, slope, (p / safe - quiet) / safe)
    return p, q, quiet, dq


def _feedback(like: torch.Tensor, dead: float) -> tuple[torch.Tensor, torch.Tensor]:
    """G and I (bins, bins): registrations of the preceding dead time, and those re-armed inside each bin."""
    n = like.shape[-1]
    whole = math.floor(dead)
    steps = (dead - whole) * n
    d = min(math.floor(steps + 1e-9), n - 1)
    f = max(steps - d, 0.0)
    back = torch.remainder(
        torch.arange(n, device=like.device).unsqueeze(1) - torch.arange(n, device=like.device), n
    )  # bins from the column's back to the row's
    zero = torch.zeros((n, n), dtype=like.dtype, device=like.device)
    window = ((back >= 1) & (back <= d)).to(like.dtype) + torch.where(back == (d + 1) % n, f, zero)
    rearmed = torch.where(back == d, 1.0 - f, zero) + torch.where(back == (d + 1) % n, f, zero)
    return whole + window, rearmed


def _block(photons: torch.Tensor) -> int:
    return int(max(1, _BLOCK_BYTES // (photons.element_size() * photons.shape[-1] ** 2)))


def armed_periods(histogram: torch.Tensor, system: System) -> torch.Tensor:
    """Periods D (..., bins) in which the pixel was armed in each bin, as its own histogram (..., bins) tells.

    ``N_r`` less the registrations whose dead time covers the bin (Gupta et al., ICCV 2019); a registration in the bin
    and a re-arming count half. The ends of the exposure, O(1), are left out.
    """
    _check(system)
    if not isinstance(histogram, torch.Tensor) or histogram.shape[-1:] != (system.bins,):
        told = getattr(histogram, "shape", histogram)
        raise ValueError(f"histogram must be a tensor (..., {system.bins}), got {told!r}")
    counts = histogram if histogram.is_floating_point() else histogram.to(torch.float64)
    dead = system.dead_time_periods
    if dead * system.bins < 1.0:
        if dead > 0.0:
            raise ValueError(f"dead_time_ns must be 0 or at least a bin of {system.bin_ns:g} ns")
        return torch.full_like(counts, float(system.cycles))
    armed, rearmed = _feedback(counts, dead)
    return (system.cycles - counts @ armed.mT + 0.5 * (counts @ rearmed.mT) - 0.5 * counts).clamp_min(0.0)


def histogram_log_likelihood(
    histogram: torch.Tensor,
    signal: torch.Tensor,
    background: torch.Tensor,
    delay_ns: torch.Tensor,
    system: System,
) -> torch.Tensor:
    """``sum_j h_j log l_j - l_j D_j`` (...): the log likelihood of histograms (..., bins), up to a constant.

    D_j comes from the data (`armed_periods`), so nothing is solved: O(bins). Dead time is in it exactly but for the
    width of a bin and the ends of the exposure. Background must be > 0. Its negative is a loss that needs no truth.
    """
    armed = armed_periods(histogram, system)
    photons = bin_photons(signal, background, delay_ns, system)
    counts = histogram.to(photons.dtype)
    out: torch.Tensor = (torch.xlogy(counts, photons) - photons * armed.to(photons.dtype)).sum(-1)
    return out


def _cumulative(pulse: Pulse, time: torch.Tensor) -> torch.Tensor:
    """Energy before a time after the delay, differentiable."""
    if isinstance(pulse, GaussianPulse):
        below: torch.Tensor = torch.special.ndtr(time / pulse.sigma_ns)
        return below
    assert isinstance(pulse, SampledPulse)
    knots = torch.tensor(pulse._cumulative, dtype=time.dtype, device=time.device)
    place = ((time - pulse._start_ns) / pulse.bin_ns).clamp(0.0, len(knots) - 1.0)
    cell = place.detach().floor().clamp_max(len(knots) - 2.0).long()
    energy: torch.Tensor = knots[cell] + (place - cell) * (knots[cell + 1] - knots[cell])
    return energy


def _inputs(*given: torch.Tensor) -> list[torch.Tensor]:
    for name, one in zip(("signal", "background", "delay_ns"), given, strict=True):
        if not isinstance(one, torch.Tensor) or not one.is_floating_point():
            raise TypeError(f"{name} must be a tensor of floating point numbers, got {one!r}")
    if not (bool((given[0] >= 0).all()) and bool((given[1] >= 0).all()) and bool(torch.isfinite(given[2]).all())):
        raise ValueError("signal and background must be >= 0 and delay_ns finite")
    return list(torch.broadcast_tensors(*given))  # type: ignore[no-untyped-call]


def _check(system: System) -> None:
    detector = system.detector
    if detector.mode != "nonparalyzable" or detector.effects:
        raise ValueError(
            f"the detector must be nonparalyzable and without effects, got mode {detector.mode!r}, {detector.effects}"
        )
