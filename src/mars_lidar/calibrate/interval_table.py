"""Registrations by the phase of the last one, the time since it, and the kind of light: all that the model says.

The model's stream is a Markov renewal process: given the phase of a registration the next one depends on nothing
else. So a table of intervals by phase and age, with the light that fell on the pixel in each of its cells, is a test
of the whole model. In each cell the difference is a martingale's, of variance `expected`, uncorrelated with the others;
what the fit of the light does to it is known from its derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.types import FloatArray
from mars_lidar.calibrate.armed_time import begun, places
from mars_lidar.calibrate.intervals import Stream
from mars_lidar.calibrate.light_error import Fitted, chi_square

_MOST = 4_000_000  # intervals looked at
_CHUNK = 2**18
_PHASES, _AGES = 16, 24
_BRIGHT = 2.0  # times the level between the pulses
_COARSE = 64  # parts of the period by which that level is found
_LEAST = 10.0  # registrations expected in a cell that is judged by itself
_ENOUGH = 50.0  # photons of a kind of light that make the laws normal, expected and in the fit ...
_OTHERS = 200.0  # ... where the light was fitted to others than those that are judged
_NORMAL = 100.0  # photons in effect that make a weighted sum of them normal
_ORDERS = 5
_SHARES = (0.25, 0.5, 0.75, 1.0)  # of the dead time, that a hidden one may last
_PARTS = 16  # of a group of phases

IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class AgeTable:
    """Intervals by phase of their start (p), age at their end (m), and light at their end: faint, bright.

    Attributes
    ----------
    phases
        (p + 1,) edges of the phases, in periods.
    edges_ns
        (m + 1,) edges of the ages, ns; the last is infinite.
    observed, expected
        (p, m, 2) registrations, and photons that arrived.
    slopes
        (p, m, 2, parameters) derivatives of `expected` by those of the light.
    watched
        (m,) ages that the fit of the light has watched.
    judged
        (2,) whether the light was fitted to enough photons of the kind.
    """

    phases: FloatArray
    edges_ns: FloatArray
    observed: FloatArray
    expected: FloatArray
    slopes: FloatArray
    watched: NDArray[np.bool_]

    judged: NDArray[np.bool_]

    @property
    def recovery(self) -> AgeTable:
        """This table summed to ages alone, (1, m, 1)."""
        kept = [one[:, :, self.judged] for one in (self.observed, self.expected, self.slopes)]
        observed, expected, slopes = (one.sum((0, 2), keepdims=True) for one in kept)
        judged = np.array([self.judged.any()])
        return AgeTable(self.phases[[0, -1]], self.edges_ns, observed, expected, slopes, self.watched, judged)

    def p_values(self, light: Fitted, other: AgeTable | None = None) -> dict[str, float]:
        """Against those of `other`, or of the model, by age and of the cells, by chi-square, and in some directions."""
        return {
            "recovery, chi²": _p_of_cells(self.recovery, light, None if other is None else other.recovery),
            "recovery by phase, chi²": _p_of_cells(self, light, other),
            "recovery, trend": _p_of_trends(self, light, other),
            "recovery, unseen photons": _p_of_unseen(self, light, other),
        }


def age_table(
    stream: Stream, light: Fitted, dead_time_ns: float, hold_off_ns: float, like: AgeTable | None = None
) -> AgeTable:
    """The table of a stream in that light; with the cells of another one, `like`."""
    bright = _bright(light)
    start, dt = intervals_of(stream, _MOST)
    phases = _phase_edges(light.rate) if like is None else like.phases
    edges = _age_edges(dt, dead_time_ns, hold_off_ns) if like is None else like.edges_ns
    shape = (phases.size - 1, edges.size - 1)
    weights = np.concatenate([light.rate[:, None], light.slopes], axis=1)
    both = np.concatenate([np.where(bright[:, None], 0.0, weights), np.where(bright[:, None], weights, 0.0)], axis=1)
    observed = np.zeros((*shape, 2))
    fell = np.zeros((*shape, both.shape[1]))
    for first in range(0, start.size, _CHUNK):
        part = slice(first, first + _CHUNK)
        _count(observed, start[part], dt[part], phases, edges, bright, light.period_ns)
        for age, passes in enumerate(passes_of(start[part], dt[part], phases, edges, bright.size, light.period_ns)):
            fell[:, age] += passes @ both
    split = fell.reshape(*shape, 2, weights.shape[1])
    seen = np.array([light.registrations[~bright].sum(), light.registrations[bright].sum()])
    watched = edges[:-1] >= hold_off_ns - 1e-9
    enough = seen >= (_ENOUGH if light.own and watched.all() else _OTHERS)
    return AgeTable(phases, edges, observed, split[..., 0], split[..., 1:], watched, enough)


def intervals_of(stream: Stream, most: int) -> tuple[FloatArray, FloatArray]:
    """Time of a registration and time to the next, ns, of the first intervals of the stream."""
    start: list[FloatArray] = [np.empty(0)]
    dt: list[FloatArray] = [np.empty(0)]
    left = most
    for piece in stream.pieces:
        t = piece.times_ns[: left + 1]
        start.append(t[:-1])
        dt.append(np.diff(t))
        left -= max(t.size - 1, 0)
        if left <= 0:
            break
    return np.concatenate(start), np.concatenate(dt)


def _bright(light: Fitted) -> NDArray[np.bool_]:
    """(n,) bins in which most of the light is a pulse."""
    rate = light.rate
    parts = np.linspace(0, rate.size, min(_COARSE, rate.size) + 1).astype(int)
    means = np.add.reduceat(rate, parts[:-1]) / np.diff(parts)
    level = _BRIGHT * np.quantile(means, 0.25)
    # chance makes some bins of a free shape large
    return np.asarray(np.repeat(means, np.diff(parts)) > level if light.free else rate > level)


def _phase_edges(rate: FloatArray) -> FloatArray:
    """Half of the phases for the light, half for the time: what follows a photon of the background is told apart."""
    share = np.cumsum(0.5 * rate / max(float(rate.sum()), 1e-300) + 0.5 / rate.size)
    inner = np.searchsorted(share / share[-1], np.arange(1, _PHASES) / _PHASES) + 1
    return np.concatenate([[0.0], np.unique(np.minimum(inner, rate.size - 1)) / rate.size, [1.0]])


def _age_edges(dt: FloatArray, dead_time_ns: float, hold_off_ns: float) -> FloatArray:
    """Finer for the young; the end of the hold-off is one."""
    reach = max(float(np.quantile(dt, 0.995)) if dt.size else 0.0, hold_off_ns) - dead_time_ns
    edges = dead_time_ns + max(reach, 1e-9) * (np.arange(_AGES) / (_AGES - 1)) ** 2
    return np.concatenate([np.unique(np.append(edges, hold_off_ns)), [np.inf]])


def _count(
    table: FloatArray,
    start: FloatArray,
    dt: FloatArray,
    phases: FloatArray,
    edges: FloatArray,
    bright: NDArray[np.bool_],
    period_ns: float,
) -> None:
    """Add intervals to `table`."""
    age = np.searchsorted(edges, dt, side="right") - 1
    kept = (age >= 0) & (age < edges.size - 1)
    start, dt, age = start[kept], dt[kept], age[kept]
    end = places(start + dt, period_ns, bright.size)[1]
    cell = (_phase(start, phases, period_ns) * (edges.size - 1) + age) * 2 + bright[end]
    table += np.bincount(cell, minlength=table.size).reshape(table.shape)


def _phase(start: FloatArray, phases: FloatArray, period_ns: float) -> IntArray:
    x = start / period_ns
    return np.asarray(np.searchsorted(phases, x - np.floor(x), side="right") - 1, dtype=np.int64)


def passes_of(
    start: FloatArray, dt: FloatArray, phases: FloatArray, edges: FloatArray, bins: int, period_ns: float
) -> list[FloatArray]:
    """For each age: how often each bin was passed, (p, bins), while a pixel had that age."""
    alive = dt > edges[0]
    start, dt = start[alive], dt[alive]
    group = _phase(start, phases, period_ns)
    begin = places(start + edges[0], period_ns, bins)
    number = phases.size - 1
    found = []
    for edge in edges[1:]:
        end = places(start + np.minimum(dt, edge), period_ns, bins)
        whole = np.bincount(group, end[0] - begin[0], minlength=number)[:, None]
        over, under = (begun(group * bins + place, part, number, bins) for _, place, part in (end, begin))
        found.append(whole + over - under)
        alive = dt > edge
        start, dt, group = start[alive], dt[alive], group[alive]
        begin = (end[0][alive], end[1][alive], end[2][alive])
    return found


def _compared(table: AgeTable, other: AgeTable | None) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(p, m, 2) differences, their variances, and the rate that was found, in units of the light.

    Against another table: observed - expected * (the other's observed / expected).
    """
    if other is None:
        return table.observed - table.expected, table.expected, np.ones_like(table.expected)
    theirs = np.maximum(other.expected, 1e-300)
    both = np.maximum(table.expected + other.expected, 1e-300)
    ratio = (table.observed + other.observed) / both
    off = table.observed - table.expected * other.observed / theirs
    return off, ratio * table.expected * (1.0 + table.expected / theirs), ratio


def _p_of_cells(table: AgeTable, light: Fitted, other: AgeTable | None) -> float:
    off, variance, ratio = _compared(table, other)
    least = table.expected if other is None else ratio * np.minimum(table.expected, other.expected)
    judged = (least >= _LEAST) & table.judged
    if not judged.any():
        return 1.0
    slopes = (ratio[..., None] * table.slopes)[judged]
    watched = slopes * np.broadcast_to(table.watched[:, None], judged.shape)[judged][:, None]
    return chi_square(off[judged], variance[judged], light.correction(slopes, watched))[2]


def _p_of_trends(table: AgeTable, light: Fitted, other: AgeTable | None) -> float:
    """Slow changes with age, polynomials in the light that fell, for faint and bright light apart.

    Afterpulses add to the faint light; what a detector misses, it misses of both.
    """
    off, variance, _ = _compared(table, other)
    seen = np.where((variance > 0) & table.judged, table.expected, 0.0).sum(0)
    trends = [np.zeros((0, *table.expected.shape))]
    for kind in range(2):
        total = seen[:, kind].sum()
        if total >= _ENOUGH:
            passed = (np.cumsum(seen[:, kind]) - 0.5 * seen[:, kind]) / total
            weights = np.zeros((_ORDERS, *off.shape))
            weights[..., kind] = np.polynomial.legendre.legvander(2.0 * passed - 1.0, _ORDERS - 1).T[:, None]
            trends.append(weights)
    return _p_of_scores(table, light, other, np.concatenate(trends))


def _p_of_unseen(table: AgeTable, light: Fitted, other: AgeTable | None) -> float:
    """Photons that the records do not show, and that blind the detector again: a second dead time, to first order.

    Behind electronics that are dead for t_e a photon at age u in (t_d, t_e) blinds the detector until u + t_d; a
    paralyzable one is blinded by each for its whole dead time.
    """
    dead = float(table.edges_ns[0])
    age = 0.5 * (table.edges_ns[:-1] + table.edges_ns[1:])
    parts = (np.arange(_PARTS) + 0.5) / _PARTS
    start = (table.phases[:-1, None] + np.diff(table.phases)[:, None] * parts) * light.period_ns  # (p, parts)
    cumulative = np.concatenate([[0.0], np.cumsum(light.rate)])

    def before(time_ns: FloatArray) -> FloatArray:
        """Photons from time 0 on."""
        x = time_ns / light.period_ns
        cycle = np.floor(x)
        phase = np.interp(x - cycle, np.linspace(0.0, 1.0, cumulative.size), cumulative)
        return np.asarray(phase + cumulative[-1] * cycle, dtype=np.float64)

    ends = before(start + dead)[..., None]
    weights = []
    for first, blind in ((0.0, dead), *((share * dead, share * dead) for share in _SHARES)):
        begin = np.minimum(np.maximum(first, age - blind), dead)
        fell = ends - before(start[..., None] + begin)
        weights.append(np.broadcast_to(fell.mean(1)[..., None], table.expected.shape))
    return _p_of_scores(table, light, other, np.stack(weights))


def _p_of_scores(table: AgeTable, light: Fitted, other: AgeTable | None, weight: FloatArray) -> float:
    """Rao's score test of changes `weight` (q, p, m, 2) of the rate, relative to the light.

    Neyman's smooth test (Skand. Aktuarietidskr. 20, 149, 1937) of a model with fitted parameters.
    """
    off, variance, ratio = _compared(table, other)
    judged = variance > 0 if other is None else np.minimum(table.expected, other.expected) >= _LEAST
    weight = weight * (judged & table.judged)
    square, fourth = (np.einsum("qpmk,pmk->q", weight**k, variance) for k in (2, 4))
    weight = weight[square**2 > _NORMAL * fourth]
    if not len(weight):
        return 1.0
    spread = np.einsum("qpmk,rpmk,pmk->qr", weight, weight, variance)
    slopes = ratio[..., None] * table.slopes
    slope = np.einsum("qpmk,pmkt->qt", weight, slopes)
    watched = np.einsum("qpmk,pmkt->qt", weight, slopes * table.watched[:, None, None])
    return chi_square(np.einsum("qpmk,pmk->q", weight, off), spread, light.correction(slope, watched))[2]
