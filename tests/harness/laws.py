"""Closed forms (Coates 1968; renewal theory of the constant rate) as oracles. Times in laser periods."""

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import integrate, special

import mars_lidar as ml

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
