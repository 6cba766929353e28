"""Expected histograms under dead time, differentiable in signal, background and delay (PyTorch).

Registrations round the laser period under dead time: a linear equation in each pixel, solved at a cost of O(bins).

With l photons in a bin, p = 1 - e^-l is the probability that an armed pixel registers in it, q = 1 - p / l that of a
pixel re-armed in it (uniformly). G counts the registrations of the preceding dead time, L shifts them by it, and

    A h = s,     A = 1 + diag(p) G - diag(q) L                                                          (1)

gives registrations h from a source s: s = p for one settled period (docs/joint_law.md, 3.1). G need not be formed:
c = G h grows from bin to bin by h - L h, so that with (1) it obeys a recursion of first order round the circle,

    c_{j+1} = e^-l_j c_j + s_j - (1 - q_j) (L h)_j,     in short c = C [s - (1 - q) L h],                (2)
    h = T L h + (s - p C s),     T x = q x + p C [(1 - q) x].                                            (3)

T L is the chain of the phases of successive registrations (arXiv 2512.04924), without a matrix. (3) does not determine
their number; since the pixel is blind for t_d after each, mean(c) = t_d sum(h). Hence

    B h = Q s,     B h = h - T L h + v (t_d sum(h) + mean C [(1 - q) L h]),     Q s = s - p C s + v mean(C s)   (4)

for any v that does not sum to 0. B = Q A, so that (1) transposed, A' y = g, is y = Q' z with B' z = g. Both are solved
by GMRES (Saad & Schultz 1986), all pixels of a batch at a time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar.instrument.effects import LIGHT_EFFECTS
from mars_lidar.instrument.pulse import GaussianPulse, Pulse, SampledPulse
from mars_lidar.instrument.system import System
from mars_lidar.learn.needed import torch
from mars_lidar.learn.tolerances import TOLERANCES
from mars_lidar.statistics.cells import whole_bins
from mars_lidar.statistics.chain import ConvergenceError

# --- Photons of each bin -------------------------------------------------------------------------------------------


@checked
def bin_photons(
    signal: torch.Tensor, background: torch.Tensor, delay_ns: torch.Tensor, system: System, *, refine: int = 1
) -> torch.Tensor:
    """Photons per period in each bin, l = S s + B / n (..., bins x refine); the pulse wraps into the period.

    Parameters
    ----------
    signal, background, delay_ns
        Tensors (...) of one floating type and device that broadcast: S and B photons per period, delay in ns.
    system
        Laser, detector and histogram.
    refine
        Number of parts of each bin.

    Returns
    -------
    torch.Tensor
        (..., bins x refine) photons per period.

    Raises
    ------
    TypeError
        Light that is not a floating tensor, or of half precision; `system` is not a `System`.
    ValueError
        Negative photons, a delay that is not finite, shapes that do not broadcast, `refine` out of range.

    See Also
    --------
    expected_histogram, mars_lidar.statistics.photons_per_bin

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> import torch
    >>> photons = ml.learn.bin_photons(torch.tensor(1.0), torch.tensor(0.5), torch.tensor(40.0), system)
    >>> tuple(photons.shape), round(float(photons.sum()), 4)  # S + B
    ((128,), 1.5)
    """
    signal, background, delay_ns = inputs(signal, background, delay_ns)
    return photons_in(signal, background, delay_ns, system, checks.integer("refine", refine, low=1, high=2**16))


def photons_in(
    signal: torch.Tensor, background: torch.Tensor, delay_ns: torch.Tensor, system: System, refine: int
) -> torch.Tensor:
    """`bin_photons` of checked arguments, also within `torch.vmap`, where values cannot be read."""
    bins = system.bins * refine
    edges = torch.arange(bins + 1, dtype=signal.dtype, device=signal.device) * (system.period_ns / bins)
    time = edges - torch.remainder(delay_ns, system.period_ns).unsqueeze(-1)
    energy = wrapped_energy(system, time)
    return signal.unsqueeze(-1) * energy.diff(dim=-1).clamp_min(0.0) + background.unsqueeze(-1) / bins


def wrapped_energy(system: System, time: torch.Tensor) -> torch.Tensor:
    """Energy of the periodic pulse train up to a time (ns) after the delay; increases by 1 each period."""
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
    """Tensors of one shape, checked for type, shape and values."""
    light = alike(*given)
    check_values(*light)
    return light


def values_of(tensor: torch.Tensor) -> torch.Tensor:
    """Values of a tensor without the wrappers of `torch.func`, which prevent checks."""
    functorch = torch._C._functorch
    while functorch.is_functorch_wrapped_tensor(tensor):
        tensor = functorch.get_unwrapped(tensor)
    return tensor


def check_values(signal: torch.Tensor, background: torch.Tensor, delay_ns: torch.Tensor) -> None:
    """Raise ValueError for negative photons or a delay that is not finite."""
    signal, background, delay_ns = map(values_of, (signal, background, delay_ns))
    if not (bool((signal >= 0).all()) and bool((background >= 0).all()) and bool(torch.isfinite(delay_ns).all())):
        raise ValueError("signal and background must be >= 0 and delay_ns finite")


HALF = (torch.float16, torch.bfloat16)


def alike(*given: torch.Tensor) -> list[torch.Tensor]:
    """Tensors broadcast to one shape, checked for type and shape."""
    for name, tensor in zip(("signal", "background", "delay_ns"), given, strict=True):
        if not isinstance(tensor, torch.Tensor) or not tensor.is_floating_point():
            raise TypeError(f"{name} must be a tensor of floating point numbers, got {tensor!r}")
        if tensor.dtype in HALF:
            raise TypeError(f"{name} must be of single or double precision, got {tensor.dtype}")
    try:
        return list(torch.broadcast_tensors(*given))  # type: ignore[no-untyped-call]
    except RuntimeError:
        shapes = ", ".join(str(tuple(tensor.shape)) for tensor in given)
        raise ValueError(f"signal, background and delay_ns must broadcast, got shapes {shapes}") from None


def detected(
    signal: torch.Tensor, background: torch.Tensor, system: System
) -> tuple[torch.Tensor, torch.Tensor, System]:
    """Detected photons, with efficiency and dark counts as `Flux.detected`, and the system that detects all of them."""
    detector = system.detector
    dark = 1e-9 * detector.dark_count_hz * system.period_ns
    if detector.detection_efficiency == 1.0 and dark == 0.0:
        return signal, background, system.detected()
    share = detector.detection_efficiency
    return signal * share, background * share + dark, system.detected()


def check_detector(system: System, *, light: bool = False) -> None:
    """Raise if the differentiable model does not describe the detector; `light`: allow efficiency and dark counts."""
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


# --- The cyclic solver ---------------------------------------------------------------------------------------------

Rows = torch.Tensor  # (pixels, bins), double


def fired(light: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """p and q of photons in a bin."""
    p = -torch.expm1(-light)
    dim = light < 0.02
    series = light * (0.5 - light * (1 / 6 - light * (1 / 24 - light * (1 / 120 - light / 720))))
    return p, torch.where(dim, series, 1 - p / torch.where(dim, torch.ones_like(light), light))


def slopes(light: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Derivatives of p and q in the photons of a bin."""
    dim = light < 0.02
    series = 0.5 - light * (1 / 3 - light * (1 / 8 - light * (1 / 30 - light * (1 / 144 - light / 840))))
    some = torch.where(dim, torch.ones_like(light), light)
    return torch.exp(-light), torch.where(dim, series, (-torch.expm1(-some) / some - torch.exp(-some)) / some)


class Delay:
    """A dead time of K + (d + f) / n periods on n bins: the bins of re-arming and the blind bins."""

    def __init__(self, dead: float, bins: int) -> None:
        self.periods, self.bins = dead, bins
        self.whole, self.shift, self.part = whole_bins(dead, bins)

    def rearmed(self, h: torch.Tensor, near: Any = 1.0, far: Any = 1.0) -> torch.Tensor:
        """L h, its two parts weighted."""
        d, f = self.shift, self.part
        moved: torch.Tensor = near * (1.0 - f) * torch.roll(h, d, -1) + far * f * torch.roll(h, d + 1, -1)
        return moved

    def rearmed_transposed(self, y: torch.Tensor) -> torch.Tensor:
        """L' y."""
        d, f = self.shift, self.part
        return (1.0 - f) * torch.roll(y, -d, -1) + f * torch.roll(y, -d - 1, -1)

    def blind(self, h: torch.Tensor) -> torch.Tensor:
        """G h: registrations that keep the pixel blind at the start of each bin."""
        n, d = self.bins, self.shift
        below = torch.nn.functional.pad(torch.cat([h, h], -1).cumsum(-1), (1, 0))
        window = below[..., n : 2 * n] - below[..., n - d : 2 * n - d] + self.part * torch.roll(h, d + 1, -1)
        return window + self.whole * h.sum(-1, keepdim=True)

    def at_end(self, h: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Dead time beyond the end of the exposure, for settled registrations h per period: e and its decrements.

        With (4.6) of docs/joint_law.md, e: expected periods, of those that follow the exposure, in which the pixel is
        still blind at the start of a bin; its decrements: re-armings after the end.
        """
        k, j = self.whole, torch.arange(self.bins, device=h.device)
        falls = self.rearmed(h, k + (j < self.shift).to(h.dtype), k + (j <= self.shift).to(h.dtype))
        total = h.sum(-1, keepdim=True)
        first = (k + 1) * (self.blind(h)[..., :1] - k * total) + 0.5 * k * (k + 1) * total
        return first - torch.nn.functional.pad(falls.cumsum(-1), (1, -1)), falls


class Circle:
    """(4) and its transpose for rows of photons per bin."""

    def __init__(self, photons: Rows, delay: Delay) -> None:
        self.delay = delay
        n = photons.shape[1]
        # a pixel without light fires never: as good as once in 1e12 periods, and nothing is divided by 0
        photons = torch.where(photons.sum(-1, keepdim=True) > 0.0, photons, torch.full_like(photons, 1e-12 / n))
        self.p, self.q = fired(photons)
        before = torch.nn.functional.pad(photons.cumsum(-1), (1, 0))
        self.decays = []  # of 1, 2, 4, .. bins: recursions by doubling, for they are many short sums
        step = 1
        while step < n:
            self.decays.append((step, torch.exp(before[:, :-step] - before[:, step:])))
            step *= 2
        total = before[:, -1:]
        self.since, self.until = torch.exp(-before[:, 1:]), torch.exp(before[:, :-1] - total)
        self.closing = -1.0 / torch.expm1(-total)
        x = delay.rearmed(torch.ones_like(photons) / n)
        shape = self.q * x + self.p * self.recursion((1.0 - self.q) * x)  # T L of uniform registrations
        wait = self.recursion((1.0 - self.q) * delay.rearmed(shape)).mean(-1, keepdim=True)
        self.v = shape / (delay.periods + wait)

    def recursion(self, x: Rows) -> Rows:
        """C x: c_{j+1} = e^-l_j c_j + x_j round the circle."""
        y = x.clone()
        for step, decay in self.decays:
            y[:, step:] += decay[:, 1:] * y[:, :-step]
        return torch.roll(y + self.since * (self.closing * y[:, -1:]), 1, -1)

    def recursion_transposed(self, x: Rows) -> Rows:
        """C' x."""
        y = x.clone()
        for step, decay in self.decays:
            y[:, :-step] += decay[:, :-1] * y[:, step:]
        return torch.roll(y + self.until * (self.closing * y[:, :1]), -1, -1)

    def apply(self, h: Rows) -> Rows:
        """B h."""
        x = self.delay.rearmed(h)
        c = self.recursion((1.0 - self.q) * x)
        total = self.delay.periods * h.sum(-1, keepdim=True) + c.mean(-1, keepdim=True)
        return h - self.q * x - self.p * c + self.v * total

    def source(self, s: Rows) -> Rows:
        """Q s."""
        c = self.recursion(s)
        return s - self.p * c + self.v * c.mean(-1, keepdim=True)

    def _back(self, z: Rows) -> tuple[Rows, Rows]:
        """v' z, and C' of it as a mean over the bins less p z, which B' and Q' are made of."""
        weight = (self.v * z).sum(-1, keepdim=True)
        return weight, self.recursion_transposed(weight / z.shape[-1] - self.p * z)

    def apply_transposed(self, z: Rows) -> Rows:
        """B' z."""
        weight, c = self._back(z)
        back = self.delay.rearmed_transposed((1.0 - self.q) * c - self.q * z)
        return z + back + self.delay.periods * weight

    def solve(self, s: Rows, tolerance: float = TOLERANCES.residual, turned: bool = False) -> Rows:
        """x of A x = s, (1), or of A' x = s."""
        if not turned:
            return gmres(self.apply, self.source(s), tolerance)
        z = gmres(self.apply_transposed, s, tolerance)
        return z + self._back(z)[1]  # Q' z


def gmres(apply: Callable[[Rows], Rows], wanted: Rows, tolerance: float = TOLERANCES.residual) -> Rows:
    """x (rows, n) of apply(x) = wanted, of rows that are independent; ConvergenceError for a residual above 1e-9."""
    size = torch.linalg.vector_norm(wanted, dim=-1).clamp_min(1e-300)
    x, rest, last = torch.zeros_like(wanted), wanted, math.inf
    for _ in range(TOLERANCES.restarts):
        residual = float((torch.linalg.vector_norm(rest, dim=-1) / size).max())
        rounding = residual <= TOLERANCES.accepted_residual and residual > 0.3 * last
        if residual <= tolerance or rounding:
            return x
        last = residual
        x = x + _krylov(apply, rest, tolerance * size)
        rest = wanted - apply(x)
    if not last <= TOLERANCES.accepted_residual:
        steps = TOLERANCES.krylov * TOLERANCES.restarts
        raise ConvergenceError(f"the feedback equation has a relative residual of {last:.1e} after {steps} steps")
    return x


def _krylov(apply: Callable[[Rows], Rows], rest: Rows, enough: torch.Tensor) -> Rows:
    """Correction of x that minimises the residual in the Krylov space of `apply` and `rest`."""
    least = torch.finfo(rest.dtype).tiny
    size = torch.linalg.vector_norm(rest, dim=-1)
    basis = rest.new_empty((len(rest), TOLERANCES.krylov + 1, rest.shape[-1]))
    basis[:, 0] = rest / size.clamp_min(least)[:, None]
    triangle = rest.new_zeros((len(rest), TOLERANCES.krylov, TOLERANCES.krylov))
    target, cosines, sines = [size], list[torch.Tensor](), list[torch.Tensor]()
    for k in range(TOLERANCES.krylov):
        fresh = apply(basis[:, k])
        known = basis[:, : k + 1]
        column = torch.bmm(known, fresh.unsqueeze(-1)).squeeze(-1)  # once: what rounding leaves, a restart takes away
        fresh = fresh - torch.bmm(column.unsqueeze(1), known).squeeze(1)
        length = torch.linalg.vector_norm(fresh, dim=-1)
        basis[:, k + 1] = fresh / length.clamp_min(least)[:, None]
        entries = list(column.unbind(-1))
        for i, (c, s) in enumerate(zip(cosines, sines, strict=True)):  # Givens rotations
            entries[i], entries[i + 1] = c * entries[i] + s * entries[i + 1], c * entries[i + 1] - s * entries[i]
        radius = torch.hypot(entries[k], length).clamp_min(least)
        cosines.append(entries[k] / radius)
        sines.append(length / radius)
        entries[k] = radius
        triangle[:, : k + 1, k] = torch.stack(entries, -1)
        target.append(-sines[k] * target[k])
        target[k] = cosines[k] * target[k]
        if bool((target[k + 1].abs() <= enough).all()):
            break
    used = len(cosines)
    right = torch.stack(target[:used], -1).unsqueeze(-1)
    steps = torch.linalg.solve_triangular(triangle[:, :used, :used], right, upper=True)
    return torch.bmm(steps.mT, basis[:, :used]).squeeze(1)


class _Solution(torch.autograd.Function):
    """x of A x = s, or of A' x = s, for rows of photons and sources.

    Derivatives of any order and of both modes, for they are solutions themselves: with y of A' y = g,

        dx = A^-1 (ds - dA x),     dA x = dp G x - dq L x,     s -> y,     l -> y (q' L x - p' G x).
    """

    @staticmethod
    def forward(photons: Rows, source: Rows, known: Rows | None, delay: Delay, tolerance: float, turned: bool) -> Rows:
        if known is not None:
            return known.clone()
        every = blocks(_block(photons.device), photons.shape[-1], photons, source)
        return torch.cat([Circle(light, delay).solve(wanted, tolerance, turned) for light, wanted in every])

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Rows) -> None:
        photons, _, _, *ctx.settings = inputs
        ctx.save_for_backward(photons, output)
        ctx.save_for_forward(photons, output)

    @staticmethod
    def backward(ctx: Any, gradient: Rows) -> tuple[Rows, Rows, None, None, None, None]:
        photons, x = ctx.saved_tensors
        delay, tolerance, turned = ctx.settings
        y = _Solution.apply(photons, gradient, None, delay, tolerance, not turned)  # type: ignore[no-untyped-call]
        (p, q), (primal, dual) = slopes(photons), (y, x) if turned else (x, y)
        return dual * (q * delay.rearmed(primal) - p * delay.blind(primal)), y, None, None, None, None

    @staticmethod
    def jvp(ctx: Any, photons_moved: Rows | None, source_moved: Rows | None, *_: None) -> Rows:
        photons, x = ctx.saved_tensors
        delay, tolerance, turned = ctx.settings
        moved = torch.zeros_like(x) if source_moved is None else source_moved
        if photons_moved is not None:
            p, q = (slope * photons_moved for slope in slopes(photons))
            if turned:
                blind = delay.blind((p * x).flip(-1)).flip(-1)  # G' x: G is a correlation round the circle
                moved = moved + delay.rearmed_transposed(q * x) - blind
            else:
                moved = moved + q * delay.rearmed(x) - p * delay.blind(x)
        out: Rows = _Solution.apply(photons, moved, None, delay, tolerance, turned)  # type: ignore[no-untyped-call]
        return out

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *given: Any) -> Any:
        return by_rows(_Solution, info, in_dims, given)


def by_rows(function: Any, info: Any, in_dims: tuple[int | None, ...], given: tuple[Any, ...]) -> Any:
    """Rule of `torch.vmap` for a function of independent rows: the batch becomes further rows."""
    number, flat = info.batch_size, []
    for argument, dim in zip(given, in_dims, strict=True):
        if isinstance(argument, torch.Tensor):
            batched = argument.expand(number, *argument.shape) if dim is None else argument.movedim(dim, 0)
            argument = batched.reshape(-1, *batched.shape[2:])
        flat.append(argument)
    out = function.apply(*flat)
    if isinstance(out, torch.Tensor):
        return out.reshape(number, -1, *out.shape[1:]), 0
    return tuple(argument.reshape(number, len(argument) // number, *argument.shape[1:]) for argument in out), (
        0,
    ) * len(out)


def registered(
    photons: Rows, source: Rows, delay: Delay, tolerance: float = TOLERANCES.residual, known: Rows | None = None
) -> Rows:
    """h of (1), differentiable in photons and sources, (pixels, bins) in double; `known`: h, if already computed."""
    h: Rows = _Solution.apply(photons, source, known, delay, tolerance, False)  # type: ignore[no-untyped-call]
    return h


def blocks(most: int, bins: int, *rows: torch.Tensor) -> Any:
    """Blocks of rows of all tensors, of at most `most` rows x bins."""
    return zip(*(torch.split(tensor, max(1, most // bins)) for tensor in rows), strict=True)


def _block(device: torch.device) -> int:
    """Pixels x bins solved at a time on a device: what a cache holds, or half of what a GPU has free."""
    if device.type != "cuda":
        return TOLERANCES.cached_values
    free, _ = torch.cuda.mem_get_info(device)
    return max(TOLERANCES.cached_values, free // (2 * 8 * (TOLERANCES.krylov + TOLERANCES.arrays)))


# --- The expected histogram ----------------------------------------------------------------------------------------


@checked
def expected_histogram(
    signal: torch.Tensor, background: torch.Tensor, delay_ns: torch.Tensor, system: System, *, refine: int | None = None
) -> torch.Tensor:
    """Expected registrations in each bin (..., bins) under dead time; differentiable in all three arguments.

    Derivatives of any order exist, also under `torch.func`: ``vmap``, ``grad``, ``vjp``, ``jacrev``, ``jvp``,
    ``jacfwd``, ``hessian``.

    Solves ``h = p (N_r + e - G h) + q (L h - b)`` round the circle of a period: G counts the registrations of the
    preceding dead time, L those of one dead time ago; e and b account for
    the dead time that extends beyond the end of an exposure with an armed start (docs/joint_law.md, 3.2 and 4.6).
    Derivatives are solutions of the same or of the transposed equation. That e and b are those of a settled pixel is
    wrong while the start-up transient lasts: armed exposures of fewer than 625 dead times are followed period by period
    instead, until two periods are equal to 1e-9.

    Accuracy for S up to 10 and B up to 5 photons per period at the default of `refine`, largest of 200 random systems a
    class: total variation 4e-4; derivatives in S and B 5e-3, in the delay 3e-3 for Gaussian pulses, 9e-3 for measured
    ones and 3e-2 where their dead time is within the pulse's length of 0 or of whole periods (norm over the bins
    relative to that of the derivative; medians below 2e-4). docs/learn.md has the table, and two regions where
    derivatives are less accurate: that in the delay with measured pulses narrower than a bin, and that in B with hardly
    any background in long armed exposures of locked pixels.

    Parameters
    ----------
    signal, background, delay_ns
        As for `bin_photons`.
    system
        Non-paralyzable, without gate, or effects beyond detection efficiency and dark counts.
    refine
        Number of parts of each bin for the solution; None: four to a sigma of a Gaussian pulse, or to the width of a
        box with the peak of a measured one, there at least 2048 in a period; four times as many if the dead time is
        within 8 sigma, or the length of the measured pulse, of 0 or of whole periods.

    Returns
    -------
    torch.Tensor
        (..., bins) registrations in `System.cycles` periods.

    Raises
    ------
    TypeError, ValueError
        Invalid arguments; a detector that the model does not describe; forward mode within forward mode, of which
        PyTorch silently drops a part: use ``jacfwd(jacrev(f))``, which is ``hessian(f)``.
    ConvergenceError
        The equation is not solved to 1e-9.

    See Also
    --------
    HistogramTable, histogram_log_likelihood, mars_lidar.mean_histogram

    Notes
    -----
    O(bins) a pixel, in double precision, on the CPU or a GPU (`mars_lidar.learn.forward`). `HistogramTable` is faster,
    with the accuracy of a table.

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> import torch
    >>> signal, background, delay_ns = (torch.tensor(x, requires_grad=True) for x in (1.0, 1.0, 40.0))
    >>> mean = ml.learn.expected_histogram(signal, background, delay_ns, system)
    >>> mean.sum().backward()
    >>> round(mean.sum().item()), round(signal.grad.item())  # registrations, and the change with a photon of signal
    (815, 167)
    """
    check_detector(system, light=True)
    refuse_nested_forward("expected_histogram")
    if _is_followed(system) and system.cycles > TOLERANCES.followed_periods:
        raise ValueError(
            f"expected_histogram follows an armed start through at most {TOLERANCES.followed_periods:,} periods, got "
            f"{system.cycles:,}, which are only {system.cycles / system.dead_time_periods:.0f} dead times: use "
            "start='stationary', or mean_histogram"
        )
    given = alike(signal, background, delay_ns)
    given[0], given[1], system = detected(given[0], given[1], system)
    if given[0].numel() == 0:
        return given[0].new_empty((*given[0].shape, system.bins))
    if refine is None:
        refine = _refined(system)
    parts = checks.integer("refine", refine, low=1, high=2**16)
    flat = [tensor.reshape(-1) for tensor in given]
    out: torch.Tensor = _Expected.apply(*flat, system, parts)[0]  # type: ignore[no-untyped-call]
    return out.reshape(*given[0].shape, system.bins)


def _refined(system: System) -> int:
    """Parts of a bin by the width of the pulse: four times as many where it re-arms a pixel within a pulse.

    A measured pulse has edges. The error of a derivative at an edge is the re-armings in its part of a bin, relative to
    the armed fraction: of first order in the part, whatever the width of the pulse.
    """
    pulse, least = system.pulse, 0.0
    if isinstance(pulse, SampledPulse):
        width = pulse.bin_ns / float(np.diff(pulse._cumulative).max())  # of a box with the same peak
        extent, least = len(pulse.values) * pulse.bin_ns, TOLERANCES.parts_of_period / system.bins
    else:
        assert isinstance(pulse, GaussianPulse)
        width, extent = pulse.sigma_ns, 8.0 * pulse.sigma_ns
    beyond = math.remainder(system.detector.dead_time_ns, system.period_ns)
    finer = 4.0 if abs(beyond) < extent else 1.0
    return min(math.ceil(finer * max(TOLERANCES.parts_of_width * system.bin_ns / width, least)), 2**16)


class _Expected(torch.autograd.Function):
    """Registrations (pixels, bins) of signal, background and delay (pixels,), and the solutions that lead to them.

    No other intermediate result is stored: derivatives are computed again, block by block, from the known solutions.
    """

    @staticmethod
    def forward(signal: Any, background: Any, delay_ns: Any, system: System, parts: int) -> tuple[torch.Tensor, ...]:
        check_values(signal, background, delay_ns)
        every = blocks(_together(system), system.bins * parts, signal, background, delay_ns)
        done = [_registered(rows, system, parts) for rows in every]
        return tuple(torch.cat(blocks_of) for blocks_of in zip(*done, strict=True))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[torch.Tensor, ...]) -> None:
        *light, ctx.system, ctx.parts = inputs
        ctx.save_for_backward(*light, *output[1:])
        ctx.save_for_forward(*light, *output[1:])
        ctx.mark_non_differentiable(*output[1:])

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor, *_: Any) -> tuple[torch.Tensor | None, ...]:
        moved = [torch.func.vjp(again, *rows)[1](part[0]) for again, rows, part in _again(ctx, gradient)]
        return (*(torch.cat(parts) for parts in zip(*moved, strict=True)), None, None)

    @staticmethod
    def jvp(ctx: Any, *given: Any) -> tuple[torch.Tensor | None, ...]:
        light = ctx.saved_tensors[:3]
        moves = [
            torch.zeros_like(tensor) if moved is None else moved for tensor, moved in zip(light, given, strict=False)
        ]
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
    for rows in blocks(_together(ctx.system), ctx.system.bins * ctx.parts, *ctx.saved_tensors, *others):
        light, known, rest = rows[:3], rows[3:5], rows[5:]

        def again(*light: torch.Tensor, known: Any = known) -> torch.Tensor:
            return _registered(light, ctx.system, ctx.parts, known)[0]

        yield again, light, rest


def _registered(rows: Any, system: System, parts: int, known: Any = (None, None)) -> tuple[torch.Tensor, ...]:
    """Histogram (pixels, bins), and the solutions (pixels, fine bins or none) that lead to it, where not `known`."""
    signal, background, delay_ns = (tensor.double() for tensor in rows)
    photons = photons_in(signal, background, delay_ns, system, parts)
    delay = Delay(system.dead_time_periods, photons.shape[-1])
    tolerance = max(TOLERANCES.residual, 1e-2 * torch.finfo(rows[0].dtype).eps)
    nothing = photons.detach()[:, :0]
    if system.dead_time_periods == 0.0:
        return _summed(photons * system.cycles, parts).to(rows[0].dtype), nothing, nothing
    if _is_followed(system):
        fine = _followed(photons, delay, system.cycles)
        return _summed(fine, parts).to(rows[0].dtype), nothing, nothing
    p, q = fired(photons)
    settled = registered(photons, p, delay, tolerance, known[0])
    fine, more = settled * system.cycles, nothing
    if system.start == "armed":
        blind, back = delay.at_end(settled)
        more = registered(photons, p * blind - q * back, delay, tolerance, known[1])
        fine = fine + more
    return _summed(fine, parts).to(rows[0].dtype), settled, more


def _is_followed(system: System) -> bool:
    """Whether the exposure may end before the start-up transient does, by its cycles in dead times."""
    return system.start == "armed" and system.cycles < TOLERANCES.followed_dead_times * system.dead_time_periods


def _together(system: System) -> int:
    """Pixels x bins of a block: derivatives of a followed exposure store every period."""
    return TOLERANCES.photons // (TOLERANCES.arrays * system.cycles if _is_followed(system) else 1)


def _followed(photons: Rows, delay: Delay, cycles: int) -> Rows:
    """Registrations in an exposure that starts armed, followed from one block of bins to the next.

    Blocks are no longer than the dead time, so that the re-armings in a block, L h, are known. With a the probability
    that the pixel is armed at the start of a bin, h = p a + q L h, and a_{j+1} = e^-l_j a_j + (1 - q_j) (L h)_j.
    Periods that repeat the one before are not followed any further.
    """
    n = photons.shape[-1]
    dead = min(delay.whole * n + delay.shift, n * cycles)
    lengths = [min(max(dead, 1), n - begin) for begin in range(0, n, max(dead, 1))]
    blocks_of = [torch.split(part, lengths, -1) for part in (photons, *fired(photons))]
    lit = [(light, p, q, _decays(light)) for light, p, q in zip(*blocks_of, strict=True)]
    armed, past = torch.ones_like(photons[:, :1]), torch.zeros_like(photons[:, :1]).expand(-1, dead + 1)
    total, before = torch.zeros_like(photons), torch.zeros_like(photons)
    for cycle in range(cycles):
        pieces = []
        for light, p, q, decays in lit:
            m = light.shape[-1]
            if dead:
                again = (1.0 - delay.part) * past[:, 1 : m + 1] + delay.part * past[:, :m]
            else:  # within a bin: what it registers re-arms in it
                last = delay.part * past
                here = (p * armed + q * last) / (1.0 - q * (1.0 - delay.part))
                again = (1.0 - delay.part) * here + last
            chances = torch.cat([armed, (1.0 - q) * again], -1)
            for step, decay in decays:
                chances = torch.cat([chances[:, :step], chances[:, step:] + decay * chances[:, :-step]], -1)
            pieces.append(p * chances[:, :-1] + q * again)
            armed, past = chances[:, -1:], torch.cat([past, pieces[-1]], -1)[:, m:]
        period = torch.cat(pieces, -1)
        total = total + period
        if bool((values_of(period - before).abs() <= TOLERANCES.repeated * values_of(period)).all()):
            return total + (cycles - 1 - cycle) * period
        before = period
    return total


def _decays(light: Rows) -> list[tuple[int, Rows]]:
    """Probabilities of no photon in 1, 2, 4, .. bins in front of the edges of a block's bins."""
    edges, step = torch.nn.functional.pad(light.cumsum(-1), (1, 0)), 1
    decays: list[tuple[int, Rows]] = []
    while step <= light.shape[-1]:
        decays.append((step, torch.exp(edges[:, :-step] - edges[:, step:])))
        step *= 2
    return decays


def refuse_nested_forward(name: str) -> None:
    """Raise within two transforms of forward mode, where PyTorch returns zeros for custom functions."""
    functorch = torch._C._functorch
    levels = functorch.get_interpreter_stack() or []
    if sum(level.key() == functorch.TransformType.Jvp for level in levels) > 1:
        raise ValueError(
            f"{name} cannot be differentiated by forward mode within forward mode: for second derivatives "
            "use torch.func.hessian, or jacrev or grad inside of jvp or jacfwd"
        )


def _summed(fine: torch.Tensor, parts: int) -> torch.Tensor:
    return fine.reshape(len(fine), -1, parts).sum(-1)
