"""The expected histogram under dead time, differentiable in signal, background and delay (PyTorch)."""

from __future__ import annotations

import math
from typing import Any

from mars_lidar._base import checks
from mars_lidar.instrument.pulse import GaussianPulse
from mars_lidar.instrument.system import System
from mars_lidar.learn.cyclic_solver import TOLERANCE, Delay, fired, registered
from mars_lidar.learn.light import bin_photons, check_detector, detected, inputs
from mars_lidar.learn.needed import torch

_FINE = 4.0  # parts of a sigma of the pulse
_BLOCK = 2**22  # pixels x bins of photons that are held at a time


def expected_histogram(
    signal: torch.Tensor,
    background: torch.Tensor,
    delay_ns: torch.Tensor,
    system: System,
    *,
    refine: int | None = None,
) -> torch.Tensor:
    """Expected registrations in each bin (..., bins) under dead time; differentiable once in all three arguments.

    Solves ``h = p (N_r + e - G h) + q (L h - b)`` round the circle of a period: G counts the registrations of the
    preceding dead time, L those of one dead time ago; e and b are what the dead time that outlasts the exposure adds
    where it began armed (docs/joint_law.md, 3.2 and 4.6). The gradient is that of the solution, by one solution of the
    transposed equation, not of the steps that led there. Exact, up to the grid, where the exposure forgets its start
    before its end; `mars_lidar.statistics.mean_histogram` needs no such condition. The error of the grid falls with the
    square of `refine`: at the default a total variation below 1e-4, but some 1e-3 where the dead time is within a bin
    of 0 or of whole periods.

    Parameters
    ----------
    signal, background, delay_ns
        As for `bin_photons`.
    system
        Non-paralyzable, without gate, or effects beyond detection efficiency and dark counts.
    refine
        Parts that each bin is cut into for the solution; None: four to a sigma of the pulse (1 for a measured pulse).

    Raises
    ------
    ValueError, TypeError
        Bad arguments; a detector that this form does not describe.
    ConvergenceError
        Where the equation is not solved to 1e-9.

    Notes
    -----
    O(bins) a pixel, in double precision, on the CPU or a GPU (`mars_lidar.learn.cyclic_solver`). At less cost and to
    the accuracy of a table: `HistogramTable`.
    """
    check_detector(system, light=True)
    given = inputs(signal, background, delay_ns)
    given[0], given[1], system = detected(given[0], given[1], system)
    if given[0].numel() == 0:
        return given[0].new_empty((*given[0].shape, system.bins))
    if refine is None:
        pulse = system.pulse
        refine = max(1, math.ceil(_FINE * system.bin_ns / pulse.sigma_ns)) if isinstance(pulse, GaussianPulse) else 1
    parts = checks.integer("refine", refine, low=1, high=2**16)
    flat = [one.reshape(-1) for one in given]
    out: torch.Tensor = _Expected.apply(*flat, system, parts)  # type: ignore[no-untyped-call]
    return out.reshape(*given[0].shape, system.bins)


class _Expected(torch.autograd.Function):
    """Registrations (pixels, bins) of signal, background and delay (pixels,); keeps nothing of the way there."""

    @staticmethod
    def forward(ctx: Any, signal: Any, background: Any, delay_ns: Any, system: System, parts: int) -> torch.Tensor:
        ctx.system, ctx.parts = system, parts
        out, ctx.found = [], []
        for rows in _blocks(system.bins * parts, signal, background, delay_ns):
            histogram, found = _registered(rows, system, parts)
            out.append(histogram.to(signal.dtype))
            ctx.found.append(found)
        ctx.save_for_backward(signal, background, delay_ns)
        return torch.cat(out)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        moved = []
        blocks = _blocks(ctx.system.bins * ctx.parts, *ctx.saved_tensors, gradient)
        for (*rows, wanted), found in zip(blocks, ctx.found, strict=True):
            with torch.enable_grad():
                leaves = [one.detach().requires_grad_() for one in rows]
                histogram, _ = _registered(leaves, ctx.system, ctx.parts, found)
                moved.append(torch.autograd.grad(histogram, leaves, wanted.to(histogram.dtype)))
        return (*(torch.cat(one) for one in zip(*moved, strict=True)), None, None)


def _registered(rows: Any, system: System, parts: int, found: Any = (None, None)) -> Any:
    """Histogram (pixels, bins), and the solutions that lead to it; with `found` only their gradients are needed."""
    signal, background, delay_ns = (one.double() for one in rows)
    photons = bin_photons(signal, background, delay_ns, system, refine=parts)
    delay = Delay(system.dead_time_periods, photons.shape[-1])
    tolerance = max(TOLERANCE, 1e-2 * torch.finfo(rows[0].dtype).eps)
    if system.dead_time_periods == 0.0:
        return _summed(photons * system.cycles, parts), (None, None)
    p, q = fired(photons)
    settled = registered(photons, p, delay, tolerance, found[0])
    fine, more = settled * system.cycles, None
    if system.start == "armed":
        blind, back = delay.left(settled)
        more = registered(photons, p * blind - q * back, delay, tolerance, found[1])
        fine = fine + more
    return _summed(fine, parts), (settled.detach(), None if more is None else more.detach())


def _summed(fine: torch.Tensor, parts: int) -> torch.Tensor:
    return fine.reshape(len(fine), -1, parts).sum(-1)


def _blocks(bins: int, *rows: torch.Tensor) -> Any:
    return zip(*(torch.split(one, max(1, _BLOCK // bins)) for one in rows), strict=True)
