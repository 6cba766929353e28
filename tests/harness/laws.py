"""Closed forms (Coates 1968; renewal theory of the constant rate) as oracles. Times in laser periods."""

import itertools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import integrate, special

import mars_lidar as ml
from harness.cases import Case
from harness.pvalues import merge

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Law:
    """What is known exactly about a case; None where nothing is."""

    histogram: Floats | None = None  # (bins,): mean registrations
    count_pmf: Floats | None = None  # P(N = 0), P(N = 1), ...
    count_moments: tuple[float, float] | None = None  # mean and variance for long exposures
    independent_poisson: bool = False  # the bins are independent Poisson numbers


def armed_survival(n: NDArray[np.int64], rate: float, dead: float, exposure: float) -> Floats:
    """P(N >= n) = P(Gamma(n, 1 / rate) <= t - (n - 1) t_d) at a constant rate, armed at the start."""
    remaining = np.maximum(exposure - (n - 1) * dead, 0.0)
    return np.where(n == 0, 1.0, special.gammainc(np.maximum(n, 1), rate * remaining))


def armed_count_pmf(rate: float, dead: float, exposure: float, most: int) -> Floats:
    """P(N = 0 .. most) at a constant rate, armed at the start."""
    survival = armed_survival(np.arange(most + 2), rate, dead, exposure)
    return survival[:-1] - survival[1:]


def stationary_count_pmf(rate: float, dead: float, exposure: float, most: int) -> Floats:
    """P(N = 0 .. most) at a constant rate, warmed up.

    With probability x / (1 + x), x = rate t_d, it is blind at the start, for a time uniform on (0, t_d).
    """
    n = np.arange(most + 2)
    parts = max(8, int(8 * min(dead, exposure) * rate))
    edges = np.linspace(0.0, min(dead, exposure), parts + 1)
    blind = sum(
        integrate.fixed_quad(
            lambda r: np.array([armed_survival(n, rate, dead, exposure - x) for x in np.atleast_1d(r)]).T, a, b, n=12
        )[0]
        for a, b in itertools.pairwise(edges)
    )
    blind[0] = dead  # N >= 0, also where the pixel stays blind to the end
    x = rate * dead
    survival = (armed_survival(n, rate, dead, exposure) + x * blind / dead) / (1 + x)
    return np.asarray(survival[:-1] - survival[1:])


def constant_rate_moments(rate: float, dead: float, exposure: float, *, stationary: bool) -> tuple[float, float]:
    """Mean and variance of N, up to terms that vanish exponentially with the exposure."""
    x = rate * dead
    mean, variance = rate * exposure / (1 + x), rate * exposure / (1 + x) ** 3
    if stationary:
        return mean, variance + x**2 * (6 + 4 * x + x**2) / (6 * (1 + x) ** 4)
    return mean + x**2 / (2 * (1 + x) ** 2), variance + x**2 * (18 + 4 * x + x**2) / (12 * (1 + x) ** 4)


def first_arrival(photons: ArrayLike) -> Floats:
    """P(the first photon is in bin j) = e^-F_j (1 - e^-l_j) after l (bins,) photons since arming."""
    l_j = np.asarray(photons, float)
    before = np.concatenate([[0.0], np.cumsum(l_j)[:-1]])
    return np.asarray(-np.expm1(-l_j) * np.exp(-before))


def pmf_of(law: ml.CountLaw) -> Floats:
    """P(N = 0), P(N = 1), ... of the package's law of one pixel."""
    pmf = np.zeros(int(law.support[-1]) + 1)
    pmf[law.support] = law.pmf
    return pmf


def law_of(flux: ml.Flux, system: ml.System) -> Law:
    """What the package states of one pixel: the law of its count and its mean histogram."""
    return Law(ml.mean_histogram(flux, system), pmf_of(ml.count_law(flux, system)))


# The closed-form mean and covariance of the histogram (`mars_lidar.joint_law`) as an oracle for every engine.


@dataclass(frozen=True, eq=False)
class JointLaw:
    """Mean and covariance of cells (neighbouring bins that are joined until they hold enough) and windows."""

    law: ml.JointLaw

    @classmethod
    def of(cls, case: Case, tolerance: float = 3e-4) -> "JointLaw":
        """The law of the case's pixel; None of its engines is asked."""
        return cls(ml.joint_law(case.flux[0, 0], case.system, tolerance=tolerance))

    def cells(self, items: int, most: int) -> NDArray[np.float64]:
        """(cells, bins) weights of at most `most` cells, each with 500 registrations in `items` exposures."""
        expected = self.law.mean * items
        cell = merge(expected, max(500.0, expected.sum() / most))
        return (cell == np.arange(cell[-1] + 1)[:, None]).astype(float)

    def windows(self, items: int) -> NDArray[np.float64]:
        """(windows, bins) weights: half of the registrations in the fewest bins, and single bins, six or fewer."""
        mean = self.law.mean
        order = np.argsort(-mean, kind="stable")
        brightest = np.zeros(mean.size)
        brightest[order[: int(np.searchsorted(np.cumsum(mean[order]), 0.5 * mean.sum())) + 1]] = 1.0
        often = order[mean[order] * items >= 500][:200]
        single = np.eye(mean.size)[often[:: max(1, often.size // 6)][:6]]
        return np.vstack([brightest, single])


# Mean, variance and mean histogram of a paralyzable pixel by integration over the exposure: an oracle for its laws.
#
# An arrival is registered if and only if there is no other arrival within the dead time before it. The rate of
# registrations is therefore r(t) = lambda(t) exp(-(C(t) - C(t - t_d))), with the integrated light C, and
# registrations further apart than the dead time are independent. The variance is the mean less twice the integral of
# r(t) [R(t) - R(t - t_d)], the pairs that do not occur, with R the integral of r from the begin of the exposure on.


class Moments(NamedTuple):
    """Of one pixel; `histogram` (bins,)."""

    mean: float
    variance: float
    histogram: Floats


def paralyzable_moments(flux: ml.Flux, system: ml.System, parts: int = 4096) -> Moments:
    """Integrals over `parts` of the period and as many of the pulse; beyond the transient they grow linearly."""
    dead, bins, armed = system.dead_time_periods, system.bins, system.start == "armed"
    whole = int(dead)
    rest = dead - whole
    steps, light = _light(flux, system, parts)
    edges = np.arange(bins + 1) / bins
    phase = np.unique(np.concatenate([edges, np.linspace(0.0, 1.0, parts + 1), steps, (steps + rest) % 1.0, [rest]]))
    early = (phase < rest).astype(int)  # the dead time before began a period earlier
    past = phase - rest + early
    total, now, then = float(light(np.ones(1))[0]), light(phase), light(past)
    periods = min(system.cycles, 2 * whole + 4)
    rates, below, pairs = [], [np.zeros(phase.size)], [0.0]
    for k in range(periods):
        before = k - whole - early  # the period in which the dead time began
        lit = (then + total * before) if not armed else np.where(before < 0, 0.0, then + total * before)
        within = now + total * k - lit
        rise = np.diff(within)  # exp(-within) over a part where it is linear in the exponent
        mean_keep = np.divide(np.expm1(-rise), -rise, out=np.ones_like(rise), where=rise != 0.0)
        rates.append(np.diff(now) * np.exp(-within[:-1]) * mean_keep)
        below.append(below[-1][-1] + np.concatenate([[0.0], np.cumsum(rates[-1])]))
        first, last = (np.interp(past, phase, below[max(k - whole - j, -1) + 1]) for j in (1, 0))
        apart = below[-1] - np.where(early, first, last)
        pairs.append(pairs[-1] + float(0.5 * (apart[1:] + apart[:-1]) @ rates[-1]))
    mean = np.array([each[-1] for each in below])
    more = system.cycles - periods
    histograms = [np.add.reduceat(rate, np.searchsorted(phase, edges[:-1])) for rate in rates]
    variance = np.maximum(mean - 2.0 * np.array(pairs), 0.0)  # rounding of a pixel that counts 1
    return Moments(
        *(float(x[-1] + more * (x[-1] - x[-2])) for x in (mean, variance)), sum(histograms) + more * histograms[-1]
    )


def _light(flux: ml.Flux, system: ml.System, parts: int):
    """Phases between which the light is smooth, and photons before phases (n,) of a period."""
    background = float(flux.background.item())
    if flux.waveform is not None:
        wave = flux.waveform.reshape(-1)
        steps = np.arange(wave.size + 1) / wave.size
        below = np.concatenate([[0.0], np.cumsum(wave)])
        return steps, lambda x: background * x + np.interp(x, steps, below)
    pulse, period = system.pulse, system.period_ns
    signal, delay = (each.reshape(-1) for each in (flux.returns_signal, np.nan_to_num(flux.returns_delay_ns)))
    steps = (delay[:, None] + np.linspace(*pulse.support_ns(), parts)).ravel() / period % 1.0

    def light(x: Floats) -> Floats:
        return background * x + sum(
            s * (pulse.wrapped_cumulative(x * period - d, period) - pulse.wrapped_cumulative(-d, period))
            for s, d in zip(signal, delay, strict=True)
        )

    return steps, light
