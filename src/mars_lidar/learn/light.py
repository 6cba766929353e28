"""Photons of a return and its background in each bin, differentiable in signal, background and delay (PyTorch)."""

from __future__ import annotations

import math

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar.instrument.effects import LIGHT_EFFECTS
from mars_lidar.instrument.pulse import GaussianPulse, Pulse, SampledPulse
from mars_lidar.instrument.system import System
from mars_lidar.learn.needed import torch


@checked
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
    signal, background, delay_ns = inputs(signal, background, delay_ns)
    return photons_in(signal, background, delay_ns, system, checks.integer("refine", refine, low=1, high=2**16))


def photons_in(
    signal: torch.Tensor, background: torch.Tensor, delay_ns: torch.Tensor, system: System, refine: int
) -> torch.Tensor:
    """`bin_photons` of what has been checked, also where `torch.vmap` does not let values be looked at."""
    bins = system.bins * refine
    edges = torch.arange(bins + 1, dtype=signal.dtype, device=signal.device) * (system.period_ns / bins)
    time = edges - torch.remainder(delay_ns, system.period_ns).unsqueeze(-1)
    energy = wrapped_energy(system, time)
    return signal.unsqueeze(-1) * energy.diff(dim=-1).clamp_min(0.0) + background.unsqueeze(-1) / bins


def wrapped_energy(system: System, time: torch.Tensor) -> torch.Tensor:
    """Energy of the periodic pulse train up to a time (ns) after the delay; grows by 1 a period."""
    period = system.period_ns
    whole = torch.round(time.detach() / period)
    rest = time - whole * period  # within half a period of the nearest pulse
    reach = max(map(abs, system.pulse.support_ns()))
    further = max(0, math.ceil(reach / period - 0.5))
    for turn in range(-further, further + 1):
        whole = whole + _cumulative(system.pulse, rest - turn * period)
    return whole


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


def inputs(*given: torch.Tensor) -> list[torch.Tensor]:
    """Checked, and of one shape."""
    found = alike(*given)
    check_values(*found)
    return found


def check_values(signal: torch.Tensor, background: torch.Tensor, delay_ns: torch.Tensor) -> None:
    """Raise where they are no light and no time."""
    if not (bool((signal >= 0).all()) and bool((background >= 0).all()) and bool(torch.isfinite(delay_ns).all())):
        raise ValueError("signal and background must be >= 0 and delay_ns finite")


def alike(*given: torch.Tensor) -> list[torch.Tensor]:
    """Checked for type and shape, and of one shape."""
    for name, one in zip(("signal", "background", "delay_ns"), given, strict=True):
        if not isinstance(one, torch.Tensor) or not one.is_floating_point():
            raise TypeError(f"{name} must be a tensor of floating point numbers, got {one!r}")
    try:
        return list(torch.broadcast_tensors(*given))  # type: ignore[no-untyped-call]
    except RuntimeError:
        told = ", ".join(str(tuple(one.shape)) for one in given)
        raise ValueError(f"signal, background and delay_ns must broadcast, got shapes {told}") from None


def detected(
    signal: torch.Tensor, background: torch.Tensor, system: System
) -> tuple[torch.Tensor, torch.Tensor, System]:
    """What the pixel detects of them, and the system for that: as `Flux.detected`, efficiency and dark counts."""
    detector = system.detector
    dark = 1e-9 * detector.dark_count_hz * system.period_ns
    if detector.detection_efficiency == 1.0 and dark == 0.0:
        return signal, background, system.detected()
    share = detector.detection_efficiency
    return signal * share, background * share + dark, system.detected()


def check_detector(system: System, *, light: bool = False) -> None:
    """Raise where the differentiable model does not describe it; `light`: efficiency and dark counts are welcome."""
    if not isinstance(system, System):
        raise TypeError(f"system must be a System, got {type(system).__name__}")
    detector = system.detector
    effects = [name for name in detector.effects if not (light and name in LIGHT_EFFECTS)]
    if detector.mode != "nonparalyzable" or effects:
        beyond = " beyond efficiency and dark counts" if light else ""
        raise ValueError(
            f"the detector must be nonparalyzable and without effects{beyond}, got mode {detector.mode!r}"
            + (f" and {', '.join(effects)}" if effects else "")
        )
