"""The expected histogram from a lookup table, differentiable in signal, background and delay (PyTorch)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from mars_lidar._base.arguments import checked
from mars_lidar.learn.forward import Delay, blocks, by_rows, check_detector, inputs, values_of, wrapped_energy
from mars_lidar.learn.needed import torch
from mars_lidar.learn.tolerances import TOLERANCES
from mars_lidar.table import Table


class HistogramTable(torch.nn.Module):
    """Expected histograms (..., bins) of signal, background and delay (...), from a `mars_lidar.Table`.

    Between the table's nodes the mean histogram is bilinear in S and B, as in `Table.lookup` (docs/table.md, L1), and
    continuous at the nodes. Its derivatives in S and B are those of the chords of a cell and jump at the nodes: with
    the spacing of the paper's table by less than 5 % in S and 15 % in B. Derivatives in the delay jump by less than 0.1
    %. Second derivatives are those of this piecewise function, linear in S and in B but for the shift; for smooth
    derivatives use `mars_lidar.learn.expected_histogram`. The canonical shape is shifted to the delay by a fraction of
    a bin: the registrations before the cut follow from the photons before it, given exactly by the pulse, and from the
    armed fraction, which at the edges of the bin follows from the registrations of the last dead time in the table and
    in between decreases by the photons of the bin. A pulse narrower than a bin thus stays narrow, no bin is negative,
    and the total is preserved. The error of the shift in total variation is below 1e-3, also for pulses of a quarter of
    a bin, unless the dead time is shorter than the pulse (2e-2 at S = 10, t_d = 3 sigma).

    As in the table, the start-up part of an armed exposure stays at the canonical delay (docs/table.md, 4).
    `mars_lidar.learn.expected_histogram` evaluates each pixel instead.

    Parameters
    ----------
    table
        A table of a non-paralyzable detector without gate or effects.
    cycles
        Laser periods of the exposure; None: the table's.

    Raises
    ------
    TypeError, ValueError
        Not a table; a table that is not valid for `cycles`; another detector. `forward`: pixels outside the table.

    See Also
    --------
    expected_histogram, mars_lidar.Table

    Notes
    -----
    A module: ``.to("cuda")`` moves the table, ``.double()`` evaluates in double precision (float32 otherwise). Its
    histograms take ``4 x nodes x bins`` bytes; a gradient needs some tens of MB in addition.

    Examples
    --------
    >>> import torch
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=64,
    ...     pulse=ml.GaussianPulse(sigma_ns=2.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> table = ml.Table.build(system, signal=(0.1, 2.0, 6), background=(0.1, 1.0, 4), tolerance=1e-3)
    >>> model = ml.learn.HistogramTable(table)
    >>> signal, background, delay_ns = (torch.tensor([x], requires_grad=True) for x in (0.5, 0.5, 30.0))
    >>> mean = model(signal, background, delay_ns)
    >>> mean.sum().backward()
    >>> tuple(mean.shape), bool(signal.grad > 0)
    ((1, 64), True)
    """

    @checked
    def __init__(self, table: Table, *, cycles: int | None = None) -> None:
        super().__init__()
        system = table.system if cycles is None else table.system.replace(cycles=cycles)
        check_detector(system)
        if not table.serves(system.cycles):
            raise ValueError(f"cycles must be {table.system.cycles}: not all of this table holds for {system.cycles}")
        axes = [torch.from_numpy(values.copy()) for values in (table.signal, table.background)]
        for name, axis in zip(("signal", "background"), axes, strict=True):
            if len(axis) < 2:
                raise ValueError(f"table must have at least two values of {name}, got one")
        s, b = torch.cartesian_prod(*axes).unbind(-1)
        mean = table.at(s.numpy(), b.numpy(), interpolation="nearest", cycles=system.cycles).cumulants[:, :1]
        self.system = system
        self.signal: torch.Tensor
        self.background: torch.Tensor
        self.histograms: torch.Tensor
        self.register_buffer("signal", axes[0])
        self.register_buffer("background", axes[1])
        self.register_buffer("histograms", torch.from_numpy((mean * table.shapes(system.cycles)).astype("float32")))

    def forward(self, signal: torch.Tensor, background: torch.Tensor, delay_ns: torch.Tensor) -> torch.Tensor:
        """Expected registrations (..., bins), in the type of `signal`; light as for `bin_photons`.

        Parameters
        ----------
        signal, background, delay_ns
            Tensors (...) within the table's range, as for `bin_photons`.
        """
        given = inputs(signal, background, delay_ns)
        for name, values, axis in zip(("signal", "background"), given, (self.signal, self.background), strict=False):
            low, high = float(axis[0]), float(axis[-1])
            least, most = (
                (float(end) for end in values_of(values).detach().aminmax()) if values.numel() else (low, high)
            )
            if not (low <= least and most <= high):
                raise ValueError(
                    f"{name} must lie in the table's [{low:g}, {high:g}] photons per period, got {least:g} to {most:g}"
                )
        flat = [tensor.reshape(-1).to(self.histograms.dtype) for tensor in given]
        parts = blocks(TOLERANCES.table_values, self.system.bins, *flat)
        out = [_Again.apply(self._expected, *rows) for rows in parts]  # type: ignore[no-untyped-call]
        expected: torch.Tensor = torch.cat(out) if out else self.histograms.new_empty((0, self.system.bins))
        return expected.reshape(*given[0].shape, self.system.bins).to(given[0].dtype)

    def extra_repr(self) -> str:
        """Size of the table, for ``print``."""
        return f"{len(self.signal)} x {len(self.background)} x {self.system.bins}, {self.system.cycles} cycles"

    def _expected(self, signal: torch.Tensor, background: torch.Tensor, delay_ns: torch.Tensor) -> torch.Tensor:
        n, period = self.system.bins, self.system.period_ns
        histogram = self._canonical(signal, background)
        back = torch.remainder(0.5 - delay_ns / period, 1.0) * n  # bins from a new edge forward to the canonical one
        whole = back.detach().floor()
        before = self._before(histogram, signal.unsqueeze(-1), background.unsqueeze(-1), (back - whole).unsqueeze(-1))
        moved = histogram - before + torch.roll(before, -1, -1)
        place = (torch.arange(n, device=back.device) + whole.long().unsqueeze(-1)) % n
        return torch.gather(moved, 1, place)

    def _canonical(self, signal: torch.Tensor, background: torch.Tensor) -> torch.Tensor:
        """Mean histograms (pixels, bins) at half a period: bilinear between the nodes."""
        (i, x), (j, y) = _cell(self.signal, signal), _cell(self.background, background)
        wide = len(self.background)
        rows = torch.stack([i * wide + j, i * wide + j + 1, (i + 1) * wide + j, (i + 1) * wide + j + 1], -1)
        weights = torch.stack([(1 - x) * (1 - y), (1 - x) * y, x * (1 - y), x * y], -1)
        return torch.bmm(weights.unsqueeze(1), self.histograms[rows]).squeeze(1)

    def _before(self, histogram: Any, signal: Any, background: Any, part: Any) -> torch.Tensor:
        """Registrations in the first `part` (pixels, 1) of each bin."""
        n, delay = self.system.bins, Delay(self.system.dead_time_periods, self.system.bins)
        photons = signal * self._energy(torch.ones_like(part)) + background / n
        share = (signal * self._energy(part) + background * part / n) / photons.clamp_min(1e-30)
        share = torch.where(photons > 1e-30, share, part)  # an empty bin is uniform
        # blind at a bin's start: registrations of the bins within the last dead time, and a part of one
        cut = 1.0 - delay.part
        until = (signal * self._energy(part.new_tensor([[cut]])) + background * cut / n) / photons.clamp_min(1e-30)
        last = histogram * (1.0 - torch.where(photons > 1e-30, until, torch.full_like(until, cut)))
        blind = delay.blind(histogram) + torch.roll(last - delay.part * histogram, delay.shift + 1, -1)
        armed = (self.system.cycles - blind).clamp_min(1e-6 * self.system.cycles)
        # A' = -A + r by the photons so far: a falling exponential and what re-arms, even among them, to meet both edges
        after, fallen = torch.roll(armed, -1, -1), -torch.expm1(-photons)
        rest = (after - armed * torch.exp(-photons)) / fallen.clamp_min(1e-12)
        part_fallen = -torch.expm1(-photons * share)
        so_far = rest * (photons * share - part_fallen) + armed * part_fallen
        total = rest * (photons - fallen) + armed * fallen
        before: torch.Tensor = histogram * so_far / total.clamp_min(1e-30)
        return before

    def _energy(self, part: torch.Tensor) -> torch.Tensor:
        """Energy of the canonical pulse in the first `part` (pixels, 1) of each bin (pixels, bins)."""
        system, n = self.system, self.system.bins
        low, high = (math.floor((0.5 + limit / system.period_ns) * n) for limit in system.pulse.support_ns())
        low, high = (0, n) if low < 0 or high >= n else (low, high + 1)  # the bins that it reaches
        edge = torch.arange(low, high, dtype=part.dtype, device=part.device)
        times = (torch.stack([edge.expand(len(part), -1), edge + part]) / n - 0.5) * system.period_ns
        start, stop = wrapped_energy(system, times).unbind(0)
        return torch.nn.functional.pad((stop - start).clamp_min(0.0), (low, n - high))


class _Again(torch.autograd.Function):
    """A function whose gradient evaluates it again, so that twenty maps of the size of the result are not stored."""

    @staticmethod
    def forward(function: Callable[..., torch.Tensor], *given: torch.Tensor) -> torch.Tensor:
        return function(*given)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: torch.Tensor) -> None:
        ctx.function, *given = inputs
        ctx.save_for_backward(*given)
        ctx.save_for_forward(*given)

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        pull = torch.func.vjp(ctx.function, *ctx.saved_tensors)[1]
        return None, *pull(gradient)

    @staticmethod
    def jvp(ctx: Any, _: None, *moved: torch.Tensor | None) -> torch.Tensor:
        given = ctx.saved_tensors
        moves = tuple(
            torch.zeros_like(tensor) if move is None else move for tensor, move in zip(given, moved, strict=True)
        )
        out, pull = torch.func.vjp(ctx.function, *given)[:2]  # forward mode does not nest: transposed twice
        along: torch.Tensor = torch.func.vjp(pull, torch.zeros_like(out))[1](moves)[0]
        return along

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *given: Any) -> Any:
        return by_rows(_Again, info, in_dims, given)


def _cell(axis: torch.Tensor, values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Interval of an axis, and the place in it, linear in the photons."""
    axis = axis.to(values.dtype)
    cell = torch.searchsorted(axis, values.detach().contiguous(), right=True).sub(1).clamp(0, len(axis) - 2)
    low, high = axis[cell], axis[cell + 1]
    return cell, (values - low) / (high - low)
