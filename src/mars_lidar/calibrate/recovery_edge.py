"""The edge of a pixel's recovery: its dead time, and how much jitter has blurred it.

Records k and k + 1 are X = T + J with T the avalanches and J their jitters, drawn anew for each of them and from
nothing else. Whatever the light, their interval is therefore X_(k+1) - X_k = A + D with A = T_(k+1) - T_k and
D = J_(k+1) - J_k independent: the law of intervals is the one without jitter, `Underlying.count`, convolved with that
of D, a Gaussian of sigma sqrt(2) sigma_j. Dead time and jitter are those with which that makes the most likely counts
about the edge. Neighbouring intervals share a J; the standard errors allow for it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from mars_lidar._base.types import FloatArray
from mars_lidar.calibrate.shortest_intervals import FEW, WIDEST, Ages, Underlying
from mars_lidar.statistics.distance import neighbours

Law = Callable[[float], Underlying]
"""What lies behind a stream whose edge is so wide, ns: the same records from a narrower pulse and a wider jitter."""

_BELOW, _BEYOND = 6.0, 15.0  # the window that is fitted, in widths of the edge
LEAST_BEYOND = 5.0  # widths of the window beyond the edge without which its amplitude is not known
REACH = _BEYOND + 1.0  # widths beyond the dead time up to which intervals are needed
_CELLS = 8  # of it per width
_MOST_FOLLOWED = 0.95  # of a change of the light's jitter that the edge follows: then the edge tells next to nothing
_MOST_LOG = 300.0  # logarithm of an amplitude: trial steps where nothing is expected ask for more
_ROUNDS = 6
_STEPS = 60
_CONVERGED = 1e-3  # Newton decrement
_GAIN = 1e-4  # of log likelihood in a step, below which no further one is of use: an 80th of a standard error
_LEAST_STEP = 1e-3  # part of a scoring step; light of single photons makes the likelihood rough
_SAME = 0.02  # widths by which a last round may move the edge
ORDINARY = 1e-4  # probability below which the edge is not that of a jitter


@dataclass(frozen=True)
class Edge:
    """Dead time and jitter by the edge of the recovery.

    Attributes
    ----------
    dead_time_ns, jitter_ns
        t_d, and sigma of each record's jitter.
    covariance
        (2, 2) of the two, ns^2.
    fits
        Probability of counts as far from those of a Gaussian jitter, or farther.
    """

    dead_time_ns: float
    jitter_ns: float
    covariance: FloatArray
    fits: float

    @property
    def dead_time_error_ns(self) -> float:
        """Standard error of the dead time."""
        return math.sqrt(self.covariance[0, 0])

    @property
    def jitter_error_ns(self) -> float:
        """Standard error of the jitter."""
        return math.sqrt(self.covariance[1, 1])

    def known(self, jitter_ns: float, jitter_error_ns: float) -> Edge:
        """The edge where more is known of the jitter: of the two, the dead time goes with it."""
        slope = self.covariance[0, 1] / self.covariance[1, 1]
        dead = self.dead_time_ns + slope * (jitter_ns - self.jitter_ns)
        left = max(self.covariance[0, 0] - slope * self.covariance[0, 1], 0.0)
        variance = jitter_error_ns**2
        matrix = np.array([[left + slope**2 * variance, slope * variance], [slope * variance, variance]])
        return Edge(dead, jitter_ns, matrix, self.fits)

    def followed(self, follows: tuple[float, float], off_ns: float = 0.0) -> Edge:
        """The edge with the errors that it has with a light which was fitted with the edge's own jitter.

        `follows`: change of dead time and jitter by that of the light's jitter. An error e of the edge's jitter makes
        a light with which the edge is off by s e more, s the second of the two, and so on: by e / (1 - s). `off_ns`:
        what the jitter still differs by from that of the light.
        """
        dead, jitter = follows
        gain = 1.0 / (1.0 - min(max(jitter, 0.0), _MOST_FOLLOWED))
        turn = np.array([[1.0, dead * gain], [0.0, gain]])
        left = off_ns * gain * np.array([dead, 1.0])
        return replace(self, covariance=turn @ self.covariance @ turn.T + np.outer(left, left))


def edge_of(ages: Ages, behind: Law, dead_time_ns: float, width_ns: float, off: Sequence[Law] = ()) -> Edge | None:
    """Dead time and jitter by maximum likelihood, from rough values of the dead time and of the edge's width.

    `behind` tells the avalanches of an edge of any width: what is known is the light as it is recorded, and the more
    of its width is jitter, the less is the pulse's. `off`: what could lie behind the stream as well, a standard error
    away in one independent direction each; what this moves is part of the covariance. None where there are too few
    intervals, or where what is there is wider than an edge.
    """
    theta = np.array([dead_time_ns, math.log(width_ns), 0.0])
    for _ in range(_ROUNDS):
        width = math.exp(theta[1])
        if width > WIDEST * behind(width).period_ns or theta[0] < _BELOW * width:
            return None
        if not ages.limit_ns > theta[0] + LEAST_BEYOND * width:
            return None
        fitted = _Window.about(ages, behind, float(theta[0]), width)
        found = fitted.maximum(theta) if fitted.counts.sum() >= FEW else None
        if found is None:
            return None
        moved = max(abs(found[0] - theta[0]) / width, abs(found[1] - theta[1]))
        theta = found
        if moved < _SAME:
            break
    width = math.exp(theta[1])
    masses = [np.diff(other(width).count(float(theta[0]), fitted.after_ns)) for other in off]
    return fitted.edge(theta, masses)


@dataclass(frozen=True, eq=False)
class _Window:
    """Counts of intervals about an edge, and what is expected of them; parameters t_d, log width, log amplitude."""

    ages: Ages
    edges_ns: FloatArray
    counts: FloatArray
    after_ns: FloatArray  # ages beyond the dead time
    behind: Law
    masses: dict[tuple[float, float], FloatArray] = field(default_factory=dict)

    @classmethod
    def about(cls, ages: Ages, behind: Law, dead_time_ns: float, width_ns: float) -> _Window:
        """A window about the edge, with whole cells of the clock, as far as all intervals are known."""
        step = width_ns / _CELLS
        number = math.ceil((_BELOW + _BEYOND) * _CELLS)
        near, far = np.arange(2 * _CELLS), np.arange(2 * _CELLS, number + _CELLS, _CELLS // 2)
        after = step * np.concatenate([near, far])  # fine where the edge is, else so that sums of Gaussians are smooth
        begin, unit = dead_time_ns - _BELOW * width_ns, ages.unit_ns
        if unit > 0.0:
            step, begin = max(round(step / unit), 1) * unit, (math.floor(begin / unit) + 0.5) * unit
        known = min((_BELOW + _BEYOND) * width_ns, ages.limit_ns - begin)
        edges = begin + step * np.arange(math.ceil(known / step) + 1)
        edges = edges[edges <= ages.limit_ns]  # a cell beyond the limit would be empty for want of records
        counts = np.histogram(ages.interval_ns, edges)[0].astype(np.float64)
        return cls(ages, edges.astype(np.float64), counts, after, behind)

    def mass(self, dead_time_ns: float, width_ns: float) -> FloatArray:
        """Intervals between the ages behind that dead time, without jitter, where an edge of that width is seen."""
        key = (dead_time_ns, width_ns)
        if key not in self.masses:
            self.masses[key] = np.diff(self.behind(width_ns).count(dead_time_ns, self.after_ns))
        return self.masses[key]

    def expected(self, theta: FloatArray, mass: FloatArray | None = None) -> FloatArray:
        """Counts (m,) of each cell."""
        from scipy.special import ndtr

        dead, width = float(theta[0]), math.exp(theta[1])
        after = 0.5 * (self.after_ns[1:] + self.after_ns[:-1])
        below = ndtr((self.edges_ns[:, None] - dead - after) / width)
        below = below @ (self.mass(dead, width) if mass is None else mass)
        return np.asarray(np.maximum(math.exp(min(theta[2], _MOST_LOG)) * np.diff(below), 1e-12))

    def slopes(self, theta: FloatArray) -> FloatArray:
        """d log expected / d theta (m, 3)."""
        step = np.array([1e-2 * math.exp(theta[1]), 1e-2, 0.0])
        out = np.ones((self.counts.size, 3))
        for k in range(2):
            shift = np.zeros(3)
            shift[k] = step[k]
            up, down = self.expected(theta + shift), self.expected(theta - shift)
            out[:, k] = (np.log(up) - np.log(down)) / (2.0 * step[k])
        return out

    def gain(self, theta: FloatArray) -> float:
        """log likelihood."""
        expected = self.expected(theta)
        return float(self.counts @ np.log(expected) - expected.sum())

    def maximum(self, start: FloatArray) -> FloatArray | None:
        """Fisher scoring from t_d and log width; None where the width runs away."""
        theta = np.array([*start[:2], 0.0])
        theta[2] = math.log(max(self.counts.sum(), 1.0) / self.expected(theta).sum())
        best = self.gain(theta)
        for _ in range(_STEPS):
            expected, slopes = self.expected(theta), self.slopes(theta)
            score = slopes.T @ (self.counts - expected)
            step = np.linalg.lstsq(slopes.T @ (expected[:, None] * slopes), score)[0]
            step[1] = np.clip(step[1], -0.7, 0.7)
            if abs(float(step @ score)) < _CONVERGED:
                break
            scale = 1.0
            while scale > _LEAST_STEP and not (found := self.gain(theta + scale * step)) > best:
                scale *= 0.5
            if scale <= _LEAST_STEP:
                break
            gained = found - best
            theta, best = theta + scale * step, found
            if gained < _GAIN:
                break
            if not abs(theta[1] - start[1]) < 5.0:
                return None
        return theta

    def edge(self, theta: FloatArray, others: Sequence[FloatArray]) -> Edge:
        """The edge, its covariance, and how well it fits."""
        from scipy.stats import chi2

        expected, slopes = self.expected(theta), self.slopes(theta)
        inverse = np.linalg.pinv(slopes.T @ (expected[:, None] * slopes), hermitian=True)
        # the sum of scores of intervals that share a record's jitter: k and k + 1
        cell = np.searchsorted(self.edges_ns, self.ages.interval_ns, side="right") - 1
        inside = np.flatnonzero((cell >= 0) & (cell < self.counts.size))
        each, number = slopes[cell[inside]], self.ages.number[inside]
        next_to = np.flatnonzero(np.diff(number) == 1.0)
        shared = each[next_to].T @ each[next_to + 1]
        matrix = inverse @ (slopes.T @ (self.counts[:, None] * slopes) + shared + shared.T) @ inverse
        if (np.diag(matrix) < 0.1 * np.diag(inverse)).any():  # too few to tell
            matrix = inverse
        for mass in others:
            moved = inverse @ (slopes.T @ (expected - self.expected(theta, mass)))
            matrix = matrix + np.outer(moved, moved)
        matrix = matrix[:2, :2]
        width = math.exp(theta[1])
        sigma = math.sqrt(0.5 * max(width**2 - self.ages.clock_ns**2, 1e-30))
        scale = np.array([1.0, 0.5 * width * width / sigma])  # d sigma / d log width
        grouped = neighbours(expected, 10.0)
        got, wanted = np.add.reduceat(self.counts, grouped), np.add.reduceat(expected, grouped)
        square = float(((got - wanted) ** 2 / wanted).sum())
        fits = float(chi2.sf(square, max(len(grouped) - 3, 1)))
        return Edge(float(theta[0]), sigma, matrix * scale * scale[:, None], fits)
