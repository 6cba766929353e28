"""The likelihood of a histogram under dead time, from its registrations, without solving a law (PyTorch).

Native code computes it with its first and second derivatives (native/reconstruct/coarse_likelihood.h).
"""

from __future__ import annotations

import math
import warnings
from functools import lru_cache
from typing import Any

import numpy as np

from mars_lidar._base.arguments import checked
from mars_lidar._base.native import _core
from mars_lidar._base.types import FloatArray
from mars_lidar.instrument.pulse import GaussianPulse, SampledPulse
from mars_lidar.instrument.system import System
from mars_lidar.learn.forward import HALF, by_rows, check_detector, detected, inputs, refuse_nested_forward
from mars_lidar.learn.needed import torch
from mars_lidar.learn.tolerances import TOLERANCES
from mars_lidar.reconstruction.histogram_record import relative_width


@checked
def histogram_log_likelihood(
    histogram: torch.Tensor, signal: torch.Tensor, background: torch.Tensor, delay_ns: torch.Tensor, system: System
) -> torch.Tensor:
    """Log likelihood (...) of histograms (..., bins), up to a constant; its negative is a self-supervised loss.

    ``sum_j h_j log m_j + (P_j - h_j) log((P_j - m_j) / (P_j - h_j))``: of the P_j passes in which the pixel was armed
    at the start of bin j or re-armed in it, m_j are expected to register. P_j comes from the registrations one dead
    time earlier, so that no law is solved: O(bins). Registrations in the bins that the pulse reaches, and in those
    where they re-arm the pixel, are distributed over cells of their bin according to light and dead time.

    Parameters
    ----------
    histogram
        Counts, integers or of single or double precision; a constant without derivative.
    signal, background, delay_ns
        As for `bin_photons`; background must be > 0.
    system
        Non-paralyzable, without gate, or effects beyond detection efficiency and dark counts.

    Returns
    -------
    torch.Tensor
        (...) log likelihoods.

    Raises
    ------
    TypeError
        Counts or light that are not tensors of a suitable type; `system` is not a `System`.
    ValueError
        Negative photons; another number of bins; a detector that the model does not describe; counts that require a
        gradient; third derivatives, and forward mode within forward mode (``jacfwd(jacrev(f))`` is ``hessian(f)``). The
        values of counts are not checked: negative counts give meaningless numbers.

    Warns
    -----
    UserWarning
        Pixels in which the end of the exposure makes the likelihood biased (see Notes).

    See Also
    --------
    expected_histogram, mars_lidar.reconstruction.log_likelihood

    Notes
    -----
    Unbiased to 0.1 of the Cramer-Rao bound's standard deviation at 1000 cycles, for bins of up to 3 widths (sigma) of
    the pulse, S up to 10, B up to 5 and dead times of up to 3 periods: at most 0.03 over the 399 random instruments
    with which its settings were chosen, 0.05 over 398 others, against the exact mean histogram (the bias in these units
    grows with the square root of the cycles). Where a dead time is longer than a period, the registrations that the
    ends of the exposure cut off matter, and a histogram does not contain them, if less than one pass of the pulse is
    expected to end without registration (0.2 and 0.4 in two further instruments), or if the pixel is armed for less
    than two dead times. Over simulated exposures with dead times of 3.3 to 14 periods S and B were then up to 1.8
    standard deviations off (docs/learn.md); a warning says so. The value jumps by up to 5e-3 (1e-4 mostly) where the
    window of divided bins moves by a bin; the slope in the delay jumps where a sample of a pulse begins at the edge of
    a cell.
    The processor computes it with its first and second derivatives; tensors of other devices are copied there and back.
    Pixels are shared among PyTorch's threads; docs/learn.md has the times.

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> import torch
    >>> counts = torch.from_numpy(ml.simulate(ml.Flux(1.0, 1.0, 40.0), system, seed=0)[0, 0, 0].astype("int64"))
    >>> delay_ns = torch.tensor([38.0, 40.0])
    >>> value = ml.learn.histogram_log_likelihood(counts, torch.tensor(1.0), torch.tensor(1.0), delay_ns, system)
    >>> bool(value[1] > value[0])
    True
    """
    histogram = _counts(histogram, system)
    check_detector(system, light=True)
    refuse_nested_forward("histogram_log_likelihood")
    signal, background, delay_ns = inputs(signal, background, delay_ns)
    if histogram.requires_grad:
        raise ValueError("histogram_log_likelihood has no derivatives with respect to the histogram: detach() it")
    dtype = signal.dtype
    signal, background, system = detected(signal.double(), background.double(), system)
    delay = torch.remainder(delay_ns.double(), system.period_ns) / system.period_ns
    light = torch.stack([signal, background, delay], -1)
    shape = torch.broadcast_shapes(histogram.shape[:-1], signal.shape)  # type: ignore[no-untyped-call]
    counts = histogram.double().expand(*shape, system.bins).reshape(-1, system.bins)
    value: torch.Tensor = _Likelihood.apply(counts, light.expand(*shape, 3).reshape(-1, 3), system)[0]  # type: ignore[no-untyped-call]
    return value.reshape(shape).to(dtype)


class _Likelihood(torch.autograd.Function):
    """Log likelihoods (pixels,) of counts (pixels, bins) and light (pixels, 3), and their gradients (pixels, 3)."""

    @staticmethod
    def forward(counts: torch.Tensor, light: torch.Tensor, system: System) -> tuple[torch.Tensor, torch.Tensor]:
        out = _evaluated(counts, light, system, 4)
        return out[:, 0].clone(), out[:, 1:].clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[torch.Tensor, ...]) -> None:
        counts, light, ctx.system = inputs
        ctx.save_for_backward(counts, light, output[1])
        ctx.save_for_forward(counts, light, output[1])
        ctx.set_materialize_grads(False)

    @staticmethod
    def backward(ctx: Any, value: torch.Tensor | None, slope: torch.Tensor | None) -> tuple[Any, ...]:
        counts, light, gradient = ctx.saved_tensors
        moved = torch.zeros_like(light) if value is None else value.unsqueeze(-1) * gradient
        if slope is not None:
            moved = moved + _along(counts, light, ctx.system, slope)
        return None, moved, None

    @staticmethod
    def jvp(ctx: Any, _: Any, moved: torch.Tensor, *__: None) -> tuple[torch.Tensor, torch.Tensor]:
        counts, light, gradient = ctx.saved_tensors
        return (gradient * moved).sum(-1), _along(counts, light, ctx.system, moved)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *given: Any) -> Any:
        return by_rows(_Likelihood, info, in_dims, given)


class _Curvature(torch.autograd.Function):
    """Second derivatives (pixels, 3, 3), which have no derivatives themselves."""

    @staticmethod
    def forward(counts: torch.Tensor, light: torch.Tensor, system: System) -> torch.Tensor:
        return _evaluated(counts, light, system, 16).reshape(-1, 4, 4)[:, 1:, 1:].clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: torch.Tensor) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *_: Any) -> Any:
        raise ValueError("histogram_log_likelihood has first and second derivatives only")

    @staticmethod
    def jvp(ctx: Any, *_: Any) -> Any:
        raise ValueError("histogram_log_likelihood has first and second derivatives only")

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *given: Any) -> Any:
        return by_rows(_Curvature, info, in_dims, given)


def _along(counts: torch.Tensor, light: torch.Tensor, system: System, moved: torch.Tensor) -> torch.Tensor:
    """Change (pixels, 3) of the gradients as the light moves."""
    curvature: torch.Tensor = _Curvature.apply(counts, light, system)  # type: ignore[no-untyped-call]
    return (curvature * moved.unsqueeze(-2)).sum(-1)


def _evaluated(counts: torch.Tensor, light: torch.Tensor, system: System, columns: int) -> torch.Tensor:
    """Value and derivatives (pixels, columns), by the processor."""
    out = torch.empty((len(light), columns), dtype=torch.float64)
    rows, at = (tensor.detach().cpu().contiguous().numpy() for tensor in (counts, light))
    _core.coarse_likelihood(_plan(system), rows, at, out.numpy(), threads=torch.get_num_threads())
    _warn_of_the_end(rows, at[:, 0], system)
    return out.to(light.device)


def _warn_of_the_end(counts: FloatArray, signal: FloatArray, system: System) -> None:
    """Warn of pixels in which it matters which registrations the ends of the exposure cut off.

    An end hides up to a dead time, of which the likelihood takes the mean.
    """
    dead = system.dead_time_periods
    if dead <= 1.0:
        return
    fewest = system.cycles / (1.0 + math.ceil(dead))  # armed passes, where each registers
    registrations = counts.sum(1)
    passes = np.maximum(registrations, fewest)
    armed = system.cycles - registrations * dead
    affected = np.count_nonzero((passes * np.exp(-signal) < 1.0) | (armed < 2.0 * dead))
    if affected:
        warnings.warn(
            f"histogram_log_likelihood: in {affected} of {len(signal)} pixels less than one pass of the pulse is "
            "expected to end without a registration, each of which blinds the pixel for more than a period, or the "
            "pixel is armed for less than two dead times: which registrations the ends of the exposure cut off "
            "matters, and S, B and delay may be off by more than the bound's standard deviation",
            UserWarning,
            stacklevel=2,
        )


@lru_cache(maxsize=16)
def _plan(system: System) -> _core.CoarsePlan:
    """What the native likelihood needs of a system; times in laser periods."""
    pulse, period = system.pulse, system.period_ns
    width = relative_width(system) * period
    if isinstance(pulse, GaussianPulse):
        reach = TOLERANCES.reach * pulse.sigma_ns
        ends, sampled = (-reach, reach), {"sigma": pulse.sigma_ns / period, "width": 0.0, "start": 0.0}
        knots = np.empty(0)
    else:
        assert isinstance(pulse, SampledPulse)
        sampled = {"sigma": 0.0, "width": pulse.bin_ns / period, "start": pulse._start_ns / period}
        ends, knots = pulse.support_ns(), np.asarray(pulse._cumulative, np.float64)
    fine = system.bin_ns <= TOLERANCES.even * width
    return _core.CoarsePlan(
        bins=system.bins,
        cycles=system.cycles,
        cells=0 if fine else math.ceil(system.bin_ns / (TOLERANCES.part * width)),
        dead=system.dead_time_periods,
        stationary=system.start == "stationary",
        low=ends[0] / period,
        high=ends[1] / period,
        knots=knots,
        rounds=TOLERANCES.rounds,
        tolerance=TOLERANCES.settled,
        **sampled,
    )


def _counts(histogram: torch.Tensor, system: System) -> torch.Tensor:
    """Counts (..., bins), checked."""
    if not isinstance(histogram, torch.Tensor) or histogram.shape[-1:] != (system.bins,):
        given = getattr(histogram, "shape", histogram)
        raise ValueError(f"histogram must be a tensor (..., {system.bins}), got {given!r}")
    if histogram.dtype in HALF:
        raise TypeError(f"histogram must be of integers, or of single or double precision, got {histogram.dtype}")
    return histogram
