"""The likelihood of a histogram under dead time, from the histogram's own registrations: nothing is solved (PyTorch).

A registration blinds its pixel for the dead time, so that the registrations of the preceding dead time give the passes
in which the pixel is armed at the start of a bin, and those of one dead time earlier the passes that re-arm in it. Both
need to know where in their bins registrations lie. In a bin of even light they are spread evenly; in the bins that
the pulse reaches they are not, and these alone are cut into parts, in which light and registrations are linear.
Registrations of a bin are distributed over its parts as a pixel registers that is armed as the histogram says, part by
part. Where the passes that re-arm under the pulse are themselves registrations of the pulse, that distribution depends
on itself, and is the fixed point of an iteration.
"""

from __future__ import annotations

import math
from typing import Any

from mars_lidar._base.arguments import checked
from mars_lidar.instrument.pulse import GaussianPulse
from mars_lidar.instrument.system import System
from mars_lidar.learn.forward import HALF, Delay, check_detector, detected, fired, inputs, photons_in, wrapped_energy
from mars_lidar.learn.needed import torch
from mars_lidar.learn.tolerances import TOLERANCES
from mars_lidar.reconstruction.histogram_record import relative_width


@checked
def armed_periods(histogram: torch.Tensor, system: System) -> torch.Tensor:
    """Periods in which the pixel was armed in each bin, estimated from its histogram.

    ``N_r`` less the registrations whose dead time covers the bin (Gupta et al., ICCV 2019); a registration in the bin
    and a re-arming count half. What the dead time covers after the end of the exposure is taken for its beginning,
    where the pixel was armed (or blind from before): D is at most t_d / t_r + 1 periods off, whatever the exposure.

    Parameters
    ----------
    histogram
        (..., bins) counts.
    system
        How they were recorded: non-paralyzable, without gate.

    Returns
    -------
    torch.Tensor
        (..., bins) periods D.

    Raises
    ------
    TypeError
        Counts that are no tensor; no `System`.
    ValueError
        Another number of bins; a detector that this form does not describe.

    See Also
    --------
    histogram_log_likelihood, mars_lidar.reconstruction.generalised_coates_rates

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> import torch
    >>> counts = torch.from_numpy(ml.simulate(ml.Flux(1.0, 1.0, 40.0), system, seed=0)[0, 0, 0].astype("float64"))
    >>> armed = ml.learn.armed_periods(counts, system)
    >>> tuple(armed.shape), bool((armed < 1000).all())
    ((128,), True)
    """
    check_detector(system, light=True)
    histogram = _counts(histogram, system)
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
    """Log likelihood (...) of histograms (..., bins), up to a constant; its negative is a loss that needs no truth.

    ``sum_j h_j log m_j + (P_j - h_j) log((P_j - m_j) / (P_j - h_j))``: of the P_j passes in which the pixel was armed
    at the start of bin j or re-armed in it, m_j are expected to register. P_j comes from the registrations one dead
    time earlier, so nothing is solved: O(bins). Where the pulse is not wide beside a bin, registrations in the bins
    that it reaches are distributed over parts of their bin as the light and the dead time have them.

    Parameters
    ----------
    histogram
        Counts, integers or of single or double precision.
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
        Counts or light that are no tensors of a suitable type; no `System`.
    ValueError
        Another number of bins; a detector that this form does not describe. The values of counts and light are not
        checked, which would wait for the device: negative ones give numbers without a meaning.

    See Also
    --------
    expected_histogram, armed_periods, mars_lidar.reconstruction.log_likelihood

    Notes
    -----
    Unbiased to 0.1 of the Cramer-Rao bound's standard deviation at 1000 cycles, for bins of up to 3 widths (sigma) of
    the pulse, S up to 10, B up to 5 and any dead time (399 random instruments against the exact mean histogram, of
    which one has 0.104; the bias in these units grows with the square root of the cycles). Not so where fewer than
    about one of the passes of the pulse ends without registration in an exposure that began armed: 0.3 to 0.7.
    Where the window of bins that are cut moves by a bin, the value jumps by about 3e-7. Cost: O(bins); where
    bins are wider than a third of the pulse's width, or dead time re-arms the pixel within the pulse, the bins that the
    pulse reaches are cut into parts of a third of it (docs/learn.md has the times).

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
    given = inputs(signal, background, delay_ns)
    signal, background, delay_ns = (tensor.double() for tensor in given)
    signal, background, system = detected(signal, background, system)
    counts = histogram.double()
    if system.dead_time_periods == 0.0:
        photons = photons_in(signal, background, delay_ns, system, 1)
        value = torch.xlogy(counts, photons) - system.cycles * photons
    else:
        value = _passed(counts, signal, background, delay_ns, system)
    return value.sum(-1).to(given[0].dtype)


def _passed(counts: torch.Tensor, signal: Any, background: Any, delay_ns: Any, system: System) -> torch.Tensor:
    """Terms (..., bins) of the likelihood."""
    parts, rounds, after = _cut(system)
    if parts > 1:
        shape = torch.broadcast_shapes(counts.shape[:-1], signal.shape)  # type: ignore[no-untyped-call]
        counts = counts.expand(*shape, system.bins)
        signal, background, delay_ns = (tensor.expand(shape) for tensor in (signal, background, delay_ns))
    photons = photons_in(signal, background, delay_ns, system, 1)
    delay = Delay(system.dead_time_periods, system.bins)
    nearer: Any = 1.0 - delay.part
    if parts > 1:
        pulse = _CutBins(counts, signal, background, delay_ns, system, parts, after)
        nearer = pulse.distributed(rounds)
    blind, near, far = _rearmings(counts, delay, system, nearer)
    p, q = fired(photons)
    within = near + far
    start = torch.maximum(system.cycles - blind, (counts - within).clamp_min(0.0))
    late = (1.0 - delay.part) * near + (2.0 - delay.part) * far  # evenly spread ones of the same armed time
    expected, passes = start * p + late * q, start + within
    if parts > 1:
        expected = expected.scatter(-1, pulse.place, pulse.expected.sum(-1))
        passes = passes.scatter(-1, pulse.place, pulse.passes)
    rest, silent = passes - counts, (passes - expected).clamp_min(1e-12)
    return torch.xlogy(counts, expected.clamp_min(1e-300)) + torch.xlogy(rest, silent / rest.clamp_min(1e-12))


def _reach(system: System) -> tuple[float, float]:
    """First and last light of the pulse, ns from the delay."""
    if isinstance(system.pulse, GaussianPulse):
        return -TOLERANCES.reach * system.pulse.sigma_ns, TOLERANCES.reach * system.pulse.sigma_ns
    return system.pulse.support_ns()


def _cut(system: System) -> tuple[int, int, bool]:
    """Parts of a bin, rounds in which registrations are distributed over them, and whether those that follow are cut.

    One round does where a dead time leads from no bin of the pulse to another; five where it does, of the same period
    or of a later one. Where two dead times lead from pulse to pulse, the bins that they lead to matter as much as those
    of the pulse. Measured over random instruments (tests/learn/test_likelihood.py).
    """
    width = relative_width(system) * system.period_ns
    low, high = _reach(system)
    parts = max(2, math.ceil(system.bin_ns / (TOLERANCES.part * width)))
    once, twice = (abs(math.remainder(k * system.detector.dead_time_ns, system.period_ns)) for k in (1, 2))
    if once < high - low:
        return parts, 5, False
    if system.bin_ns <= TOLERANCES.part * width:
        return 1, 1, False
    return parts, 2, twice < high - low + system.bin_ns


class _CutBins:
    """The bins of each pixel that the pulse reaches, W in all, cut into m parts; `place` (..., W) their numbers.

    `after`: those one and two dead times later are among them.

    `distributed` sets the registrations that are `expected` in the parts (..., W, m), and the `passes` (..., W) in
    which the pixel is armed at the start of a bin or re-armed in it. Light and registrations are linear within a part.
    """

    def __init__(
        self,
        counts: torch.Tensor,
        signal: Any,
        background: Any,
        delay_ns: Any,
        system: System,
        parts: int,
        after: bool,
    ) -> None:
        n, m, period = system.bins, parts, system.period_ns
        self._counts, self._system = counts, system
        self._delay, self._fine = Delay(system.dead_time_periods, n), Delay(system.dead_time_periods, n * m)
        low, high = _reach(system)
        wide, back = math.ceil((high - low) / system.bin_ns) + 1, self._delay.shift + 1
        reached = {k % n for turn in range(3 if after else 1) for k in range(turn * (back - 1), turn * back + wide)}
        offsets = {k: number for number, k in enumerate(sorted(reached))}
        delay_ns = torch.remainder(delay_ns, period)
        first = torch.floor((delay_ns.detach() + low) / system.bin_ns).long().unsqueeze(-1)
        self.place = (first + torch.tensor(list(offsets), device=counts.device)) % n
        # edges of the parts of each bin, and of a part more on either side, for the slopes
        cells = (self.place * m).unsqueeze(-1) + torch.arange(-1, m + 2, device=counts.device)
        energy = wrapped_energy(system, cells.to(signal.dtype) * (period / (n * m)) - delay_ns[..., None, None])
        light = signal[..., None, None] * energy.diff(dim=-1).clamp_min(0.0) + background[..., None, None] / (n * m)
        self._slope = _slope(0.5 * (light[..., 2:] - light[..., :-2]) / light[..., 1:-1])
        light = light[..., 1:-1]
        self._p, self._q = fired(light)
        since = light.cumsum(-1).clamp_max(TOLERANCES.darkest)
        self._armed, self._lit = torch.exp(light - since), torch.exp(since)
        self.expected = self._armed * self._p  # of a pixel armed at the start of the bin
        self.passes = self.expected.sum(-1)
        # the two bins one dead time earlier than each, some of which may be of these themselves
        own = [offsets.get((k - back + turn) % n, len(offsets)) for k in offsets for turn in range(2)]
        self._chained, self._own = min(own) < len(offsets), torch.tensor(own, device=counts.device)
        earlier = (self.place.unsqueeze(-1) - back + torch.arange(2, device=counts.device)) % n
        self._earlier = counts.gather(-1, earlier.flatten(-2)).reshape(earlier.shape)
        self._mine = counts.gather(-1, self.place)
        shares = [_within(system, self._delay.whole + k) for k in range(2)]
        wraps = [cells[..., 1:-2] < self._fine.shift + k for k in range(2)]
        self._weights = [torch.where(wrap, shares[1], shares[0]).to(light) for wrap in wraps]

    def distributed(self, rounds: int) -> torch.Tensor:
        """Share (..., bins) of each bin's registrations that re-arm the pixel in the nearer of two bins.

        Rounds of a fixed point, from the third on from the least residual on the line through the last two
        (Anderson 1965), bin by bin. The slopes of the registrations are taken from the first two rounds.
        """
        part, counts, m = self._delay.part, self._counts, self.expected.shape[-1]
        even = counts.new_full((*self.place.shape[:-1], m), 1.0 / m)
        nearer = ((1.0 - part) * m - torch.arange(m, dtype=counts.dtype, device=counts.device)).clamp(0.0, 1.0)
        split = 0.5 * nearer * (1.0 - nearer)  # of a slope of 1 the excess in the later share
        evenly = torch.full_like(counts, 1.0 - part)
        blind, _, far = _rearmings(counts, self._delay, self._system, evenly)
        blind, far = ((values.gather(-1, self.place)) for values in (blind - far, far / max(part, 1e-300)))
        spread = self._spread()
        before: Any = None
        off: Any = None
        slopes: Any = 0.0
        self._set_rearming(slopes)
        for turn in range(rounds if self._chained else 1):
            sources = self._earlier_bins(spread, even)
            late = slopes if isinstance(slopes, float) else slopes[..., 0, :]
            later = far * (1.0 - (sources[..., 0, :] * (nearer - split * late)).sum(-1))
            change = self._pass(blind + later, self._earlier.unsqueeze(-1) * sources)
            if turn < 2:
                own = _slope(self._slope + change)
            if turn < 2 and self._chained:
                slopes = self._earlier_bins(own, torch.zeros_like(even))
                self._set_rearming(slopes)
            last, before, last_off = before, self._spread(), off
            off, spread = before - spread, before
            if last is not None:
                turned = off - last_off
                ahead = (off * turned).sum(-1, keepdim=True) / turned.square().sum(-1, keepdim=True).clamp_min(1e-30)
                spread = before - ahead.clamp(-1.0, 1.0) * (before - last)
        return evenly.scatter(-1, self.place, (self._spread() * (nearer - split * own)).sum(-1))

    def _spread(self) -> torch.Tensor:
        """Share of a bin's registrations in each of its parts."""
        return self.expected / self.expected.sum(-1, keepdim=True).clamp_min(1e-300)

    def _earlier_bins(self, own: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
        """Values (..., W, 2, m) in the two bins one dead time earlier than each: of `own` (..., W, m), or `other`."""
        every = torch.cat([own, other.unsqueeze(-2)], -2)
        picked: torch.Tensor = every.index_select(-2, self._own)
        return picked.reshape(*own.shape[:-1], 2, own.shape[-1])

    def _set_rearming(self, slopes: torch.Tensor | float) -> None:
        """Weights of earlier registrations: in what re-arms in a part, in what of it registers there, in the rest.

        A part is re-armed by the last (1 - f) of one earlier part and the first f of the next. With light 1 + b (x -
        1/2) over the part and registrations 1 + a (x - 1/2) over theirs, these shares are (1 - f, f) -/+ a f (1 - f) /
        2, and twice the light that follows a re-arming is w (1 - a w / 6 + ...), to first order in a and b.
        """
        f, m = self._fine.part, self.expected.shape[-1]
        start = (self._delay.shift + 1) * m - self._fine.shift
        self._rearming = []
        for k, share in enumerate((1.0 - f, f)):
            span = slice(start - k, start - k + m)
            a = slopes if isinstance(slopes, float) else slopes.flatten(-2)[..., span]
            rearmed = self._weights[k] * (share + (k - 0.5) * f * (1.0 - f) * a)
            follows = 1.0 + k - f + share * ((3.0 - 2.0 * share) * self._slope - share * a) / 6.0
            again = follows * self._q * rearmed
            self._rearming.append((span, rearmed, again, (rearmed - again) * self._lit))

    def _pass(self, blind: torch.Tensor, earlier: torch.Tensor) -> torch.Tensor:
        """Go through the parts of all bins with the registrations (..., W, 2, m) of one dead time earlier.

        Returns the change of the armed share over each part, relative to its mean.
        """
        within: Any = 0.0
        again: Any = 0.0
        staying: Any = 0.0
        for span, rearmed, fires, stays in self._rearming:
            source = earlier.flatten(-2)[..., span]
            within = within + (rearmed * source).sum(-1)
            again, staying = again + fires * source, staying + stays * source
        armed = torch.maximum(self._system.cycles - blind, (self._mine - within).clamp_min(0.0))
        self.passes = armed + within
        begun = armed.unsqueeze(-1) + torch.nn.functional.pad(staying.cumsum(-1), (1, 0))
        start, end = self._armed * begun[..., :-1], begun[..., 1:] / self._lit
        self.expected = again + self._p * start
        return 2.0 * (end - start) / (end + start).clamp_min(1e-300)


def _slope(value: torch.Tensor) -> torch.Tensor:
    return value.clamp(-TOLERANCES.steepest, TOLERANCES.steepest)


def _rearmings(
    counts: torch.Tensor, delay: Delay, system: System, nearer: Any
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Of registrations (..., bins): passes blind at the start of each bin, and re-armings in it, later and earlier.

    The share `nearer` of a bin's registrations re-arms in the first of the two bins that the dead time reaches, late in
    it, the rest early in the second. Beyond the end of an armed exposure there are none.
    """
    n, d, whole = counts.shape[-1], delay.shift, delay.whole
    last = [_within(system, whole + k) for k in range(3)]
    sums = [sum(_within(system, p) for p in range(1, whole + k)) for k in range(2)]
    close = counts * nearer
    near, far = torch.roll(close, d, -1), torch.roll(counts - close, d + 1, -1)
    number = torch.arange(n, device=counts.device)
    wraps = (number < d).long()
    far = counts.new_tensor(last)[(number < d + 1).long()] * far
    weight = counts.new_tensor(last)[wraps]
    before = torch.nn.functional.pad(counts.cumsum(-1), (1, 0))
    total, before = before[..., -1:], before[..., :-1]
    since = torch.roll(before, d, -1)  # registrations of the period before those that the dead time covers
    covered = counts.new_tensor(sums)[wraps] * total + weight * (total - since)
    blind = before + torch.where(wraps + whole == 0, -since, covered) + far
    return blind, weight * near, far


def _within(system: System, periods: int) -> float:
    """Share of the registrations whose effect that many periods later lies within the exposure.

    Those before a stationary exposure make up for the rest.
    """
    return 1.0 if system.start == "stationary" else max(0.0, 1.0 - periods / system.cycles)


def _counts(histogram: torch.Tensor, system: System) -> torch.Tensor:
    """Counts (..., bins), checked."""
    if not isinstance(histogram, torch.Tensor) or histogram.shape[-1:] != (system.bins,):
        given = getattr(histogram, "shape", histogram)
        raise ValueError(f"histogram must be a tensor (..., {system.bins}), got {given!r}")
    if histogram.dtype in HALF:
        raise TypeError(f"histogram must be of integers, or of single or double precision, got {histogram.dtype}")
    return histogram
