"""The expected histogram under dead time, differentiable in signal, background and delay (PyTorch)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar.instrument.pulse import GaussianPulse
from mars_lidar.instrument.system import System
from mars_lidar.learn.cyclic_solver import TOLERANCE, Delay, blocks, by_rows, fired, registered
from mars_lidar.learn.light import alike, check_detector, check_values, detected, photons_in
from mars_lidar.learn.needed import torch

_FINE = 4.0  # parts of a sigma of the pulse
_BLOCK = 2**22  # pixels x bins of photons that are held at a time


@checked
def expected_histogram(
    signal: torch.Tensor,
    background: torch.Tensor,
    delay_ns: torch.Tensor,
    system: System,
    *,
    refine: int | None = None,
) -> torch.Tensor:
    """Expected registrations in each bin (..., bins) under dead time; differentiable in all three arguments.

    Any number of times, and under `torch.func`: ``vmap``, ``grad``, ``vjp``, ``jacrev``, ``jvp``, ``jacfwd``,
    ``hessian``.

    Solves ``h = p (N_r + e - G h) + q (L h - b)`` round the circle of a period: G counts the registrations of the
    preceding dead time, L those of one dead time ago; e and b are what the dead time that outlasts the exposure
    adds where it began armed (docs/joint_law.md, 3.2 and 4.6). Derivatives are those of the solution, by solutions
    of the same equation or of the transposed one, not of the steps that led there. Exact, up to the grid, where the
    exposure forgets its start before its end; `mars_lidar.statistics.mean_histogram` needs no such condition. The
    error of the grid falls with the square of `refine`: at the default a total variation below 1e-4, but some 1e-3
    where the dead time is within a bin of 0 or of whole periods.

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
        Bad arguments; a detector that this form does not describe; forward mode within forward mode, of which PyTorch
        drops a part without a word: take ``jacfwd(jacrev(f))``, which is ``hessian(f)``.
    ConvergenceError
        Where the equation is not solved to 1e-9.

    Notes
    -----
    O(bins) a pixel, in double precision, on the CPU or a GPU (`mars_lidar.learn.cyclic_solver`). At less cost and to
    the accuracy of a table: `HistogramTable`.
    """
    check_detector(system, light=True)
    _refuse_nested_forward()
    given = alike(signal, background, delay_ns)
    given[0], given[1], system = detected(given[0], given[1], system)
    if given[0].numel() == 0:
        return given[0].new_empty((*given[0].shape, system.bins))
    if refine is None:
        pulse = system.pulse
        refine = max(1, math.ceil(_FINE * system.bin_ns / pulse.sigma_ns)) if isinstance(pulse, GaussianPulse) else 1
    parts = checks.integer("refine", refine, low=1, high=2**16)
    flat = [one.reshape(-1) for one in given]
    out: torch.Tensor = _Expected.apply(*flat, system, parts)[0]  # type: ignore[no-untyped-call]
    return out.reshape(*given[0].shape, system.bins)


class _Expected(torch.autograd.Function):
    """Registrations (pixels, bins) of signal, background and delay (pixels,), and the solutions that lead to them.

    Of the way there nothing else is kept: derivatives go it again, block by block, with the solutions known.
    """

    @staticmethod
    def forward(signal: Any, background: Any, delay_ns: Any, system: System, parts: int) -> tuple[torch.Tensor, ...]:
        check_values(signal, background, delay_ns)
        every = blocks(_BLOCK, system.bins * parts, signal, background, delay_ns)
        done = [_registered(rows, system, parts) for rows in every]
        return tuple(torch.cat(one) for one in zip(*done, strict=True))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[torch.Tensor, ...]) -> None:
        *light, ctx.system, ctx.parts = inputs
        ctx.save_for_backward(*light, *output[1:])
        ctx.save_for_forward(*light, *output[1:])
        ctx.mark_non_differentiable(*output[1:])

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor, *_: Any) -> tuple[torch.Tensor | None, ...]:
        moved = [torch.func.vjp(again, *rows)[1](part[0]) for again, rows, part in _again(ctx, gradient)]
        return (*(torch.cat(one) for one in zip(*moved, strict=True)), None, None)

    @staticmethod
    def jvp(ctx: Any, *given: Any) -> tuple[torch.Tensor | None, ...]:
        light = ctx.saved_tensors[:3]
        moves = [torch.zeros_like(one) if moved is None else moved for one, moved in zip(light, given, strict=False)]
        done = []
        for again, rows, part in _again(ctx, *moves):  # forward mode does not nest: the transpose of the transpose
            out, pull = torch.func.vjp(again, *rows)[:2]
            done.append(torch.func.vjp(pull, torch.zeros_like(out))[1](tuple(part))[0])
        return torch.cat(done), None, None

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *given: Any) -> Any:
        return by_rows(_Expected, info, in_dims, given)


def _again(ctx: Any, *others: torch.Tensor) -> Iterator[tuple[Any, Any, Any]]:
    """Block by block: the histogram as a function of its light, that light, and the same rows of `others`."""
    for rows in blocks(_BLOCK, ctx.system.bins * ctx.parts, *ctx.saved_tensors, *others):
        light, known, rest = rows[:3], rows[3:5], rows[5:]

        def again(*light: torch.Tensor, known: Any = known) -> torch.Tensor:
            return _registered(light, ctx.system, ctx.parts, known)[0]

        yield again, light, rest


def _registered(rows: Any, system: System, parts: int, known: Any = (None, None)) -> tuple[torch.Tensor, ...]:
    """Histogram (pixels, bins), and the solutions (pixels, fine bins or none) that lead to it, where not `known`."""
    signal, background, delay_ns = (one.double() for one in rows)
    photons = photons_in(signal, background, delay_ns, system, parts)
    delay = Delay(system.dead_time_periods, photons.shape[-1])
    tolerance = max(TOLERANCE, 1e-2 * torch.finfo(rows[0].dtype).eps)
    nothing = photons.detach()[:, :0]
    if system.dead_time_periods == 0.0:
        return _summed(photons * system.cycles, parts).to(rows[0].dtype), nothing, nothing
    p, q = fired(photons)
    settled = registered(photons, p, delay, tolerance, known[0])
    fine, more = settled * system.cycles, nothing
    if system.start == "armed":
        blind, back = delay.left(settled)
        more = registered(photons, p * blind - q * back, delay, tolerance, known[1])
        fine = fine + more
    return _summed(fine, parts).to(rows[0].dtype), settled, more


def _refuse_nested_forward() -> None:
    """Raise within two transforms of forward mode: through a function of one's own PyTorch then gives zeros."""
    functorch = torch._C._functorch
    levels = functorch.get_interpreter_stack() or []
    if sum(one.key() == functorch.TransformType.Jvp for one in levels) > 1:
        raise ValueError(
            "expected_histogram cannot be differentiated by forward mode within forward mode: for second derivatives "
            "use torch.func.hessian, or jacrev or grad inside of jvp or jacfwd"
        )


def _summed(fine: torch.Tensor, parts: int) -> torch.Tensor:
    return fine.reshape(len(fine), -1, parts).sum(-1)
