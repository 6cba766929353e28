"""The likelihood of a histogram under dead time, differentiable in signal, background and delay (PyTorch)."""

from __future__ import annotations

from mars_lidar._base.arguments import checked
from mars_lidar.instrument.system import System
from mars_lidar.learn.cyclic_solver import Delay
from mars_lidar.learn.light import bin_photons, check_detector, detected, inputs
from mars_lidar.learn.needed import torch


@checked
def armed_periods(histogram: torch.Tensor, system: System) -> torch.Tensor:
    """Periods D (..., bins) in which the pixel was armed in each bin, as its own histogram (..., bins) tells.

    ``N_r`` less the registrations whose dead time covers the bin (Gupta et al., ICCV 2019); a registration in the bin
    and a re-arming count half. What the dead time covers after the end of the exposure is taken for its beginning,
    where the pixel was armed (or blind from before): D is at most t_d / t_r + 1 periods off, whatever the exposure.
    """
    check_detector(system, light=True)
    if not isinstance(histogram, torch.Tensor) or histogram.shape[-1:] != (system.bins,):
        told = getattr(histogram, "shape", histogram)
        raise ValueError(f"histogram must be a tensor (..., {system.bins}), got {told!r}")
    counts = histogram if histogram.is_floating_point() else histogram.to(torch.float64)
    if system.dead_time_periods == 0.0:
        return torch.full_like(counts, float(system.cycles))
    delay = Delay(system.dead_time_periods, system.bins)
    covered = delay.blind(counts) + 0.5 * (counts - delay.rearmed(counts))
    return (system.cycles - covered).clamp_min(0.0)


@checked
def histogram_log_likelihood(
    histogram: torch.Tensor,
    signal: torch.Tensor,
    background: torch.Tensor,
    delay_ns: torch.Tensor,
    system: System,
) -> torch.Tensor:
    """``sum_j h_j log l_j - l_j D_j`` (...): the log likelihood of histograms (..., bins), up to a constant.

    D_j comes from the data (`armed_periods`), so nothing is solved: O(bins). Dead time is in it exactly but for the
    width of a bin and the ends of the exposure, which move it by less than (S + B) (t_d / t_r + 1), by as much as one
    or two registrations do. Background must be > 0. Its negative is a loss that needs no truth.
    """
    armed = armed_periods(histogram, system)
    signal, background, delay_ns = inputs(signal, background, delay_ns)
    signal, background, system = detected(signal, background, system)
    photons = bin_photons(signal, background, delay_ns, system)
    counts = histogram.to(photons.dtype)
    out: torch.Tensor = (torch.xlogy(counts, photons) - photons * armed.to(photons.dtype)).sum(-1)
    return out
