"""Starting values of the fit: light without the dead time, and a dead time for each of several jitters."""

from __future__ import annotations

import numpy as np

from mars_lidar._base.types import FloatArray
from mars_lidar.calibration.fit import Fit
from mars_lidar.calibration.model import Model
from mars_lidar.calibration.recording import free_light, free_waveform


def light(t: FloatArray, model: Model, hold: float) -> FloatArray:
    """Background, signal and delay of each return, and width of the recorded pulse, by matched filters."""
    period, unit = model.clock.period_ns, model.clock.unit_ns
    bins = int(np.clip(period / max(unit, 1e-9), 64, 2**14))
    hits, passes = free_light(t, model.clock, hold, bins)
    rate = hits / np.maximum(passes, 1.0)
    cell = period / bins
    place = (np.arange(bins) + 0.5) * cell
    outside = np.ones(bins, bool)
    # the median of windows with enough photons for one
    windows = np.linspace(0, bins, 64, endpoint=False).astype(int)
    coarse = np.add.reduceat(hits, windows) / np.maximum(np.add.reduceat(passes, windows), 1.0)
    faint = max(float(np.median(coarse)), 1e-3 / max(passes.sum(), 1.0))
    boxes = np.unique(np.round(1.5 ** np.arange(30)).astype(int))  # of every width
    peaks, variance = [], 0.0
    for _ in range(model.returns):
        best = (-np.inf, 0, 1)
        masked = np.where(outside, hits, faint * passes)
        for m in boxes[boxes <= bins // 4]:
            sums = [np.cumsum(np.r_[0.0, x, x[: m - 1]]) for x in (masked, passes)]
            inside, armed = (c[m:] - c[:-m] for c in sums)
            expected = np.maximum(faint * armed, 1e-9)
            more = np.maximum(inside, expected)
            z = more * np.log(more / expected) - (more - expected)  # log likelihood ratio of a brighter window
            best = max(best, (float(z.max()), int(z.argmax()), int(m)))
        _, at, m = best
        peak, least = (at + m / 2) * cell, max(0.8 * m, 2) * cell
        reach = 1.6 * least
        for _ in range(4):
            off = (place - peak + period / 2) % period - period / 2
            inside = np.abs(off) < reach
            rest = outside & ~inside
            faint = float((hits[rest].sum() + 1e-3) / max(passes[rest].sum(), 1.0))
            extra = (rate - faint)[inside & outside]
            near = off[inside & outside]
            signal = max(float(extra.sum()), 1e-4)
            mean = float(np.clip((extra * near).sum() / signal, -reach, reach))
            var = max(float((extra * (near - mean) ** 2).sum() / signal), (0.2 * m * cell) ** 2)
            peak += mean
            reach = float(np.clip(4.5 * np.sqrt(var), least, 0.3 * period))
        outside &= ~inside
        peaks += [signal, peak % period]
        variance = variance or var
    own = max(variance - unit**2 / 6, 0.0025 * variance, (0.15 * unit) ** 2)
    return np.array([max(faint * bins, 1e-5), *peaks, own**0.5])


def starts(fit: Fit, model: Model, fixed: dict[str, float]) -> list[FloatArray]:
    """Parameters (p,) for seven shares of jitter in the recorded width, sorted by the misfit."""
    k, unit, recording = model.light, model.clock.unit_ns, fit.recording
    photons = min(recording.photons, fit.effort.first)
    observed, _ = _short_intervals(fit)
    hold = max(4 * observed[-3] - 3 * observed[0], fixed.get("dead_time_ns", 0.0)) + 2 * unit
    hold = min(hold, float(np.quantile(recording.intervals, 0.95)))  # of a saturated detector few are longer
    if model.returns == 0:
        first = np.array([free_waveform(recording, 64)[0].sum(), max((observed[-3] - observed[0]) / 4, 0.3 * unit)])
    else:
        first = light(recording.pieces[0][: 12 * photons], model, hold)
    tried = []
    # from no jitter to a width of jitter alone
    for angle in np.linspace(0.0, np.pi / 2.0, 1 if "jitter" in fixed else 7):
        theta = np.r_[first, 0.0, 0.0]
        theta[k + 1] = fixed.get("jitter", angle if model.split else np.sin(angle) * theta[k])
        theta[k + 2] = fixed.get("dead_time_ns", max(observed[0], 0.05 * observed[-1]) + 2 * model.widths(theta)[1])
        tried.append(theta if "dead_time_ns" in fixed else with_edge(fit, model, theta))
    trials = []
    for theta in (*tried, saturated(recording.intervals, model, np.r_[first, 0.0, 0.0], fixed)):
        cells = fit.cells(model, theta, photons)
        rows = cells.count(fit.streams(model, theta, photons))[:, 0]
        recorded = cells.of(recording) * (photons / recording.photons)
        r = (2 * np.sqrt(recorded + 0.375) - 2 * np.sqrt(rows + 0.375).mean(0)) ** 2
        trials.append((float(r.sum()), theta))
    return [theta for _, theta in sorted(trials, key=lambda pair: pair[0])]


def saturated(gaps: FloatArray, model: Model, theta: FloatArray, fixed: dict[str, float]) -> FloatArray:
    """Parameters (p,) by the moments of the intervals, which in constant light are t_d + an exponential + the jitter.

    Their third central moment is that of the exponential alone. In pulsed light this holds if the detector is
    saturated, where no interval is long enough to count photons that the dead time does not hide.
    """
    k, theta, off = model.light, theta.copy(), gaps - gaps.mean()
    mean = float(gaps.mean())
    wait = float(np.clip(0.5 * (off**3).mean(), (1e-4 * mean) ** 3, (0.99 * mean) ** 3)) ** (1.0 / 3.0)
    jitter = fixed.get("jitter", (0.5 * max(float(gaps.var()) - wait**2, 0.0)) ** 0.5)
    amounts = [0, *range(1, k, 2)]
    theta[amounts] *= model.clock.period_ns / wait / theta[amounts].sum()
    theta[k] = max(float(theta[k]), jitter)
    theta[k + 1] = np.arcsin(jitter / theta[k]) if model.split else jitter
    theta[k + 2] = fixed.get("dead_time_ns", mean - wait)
    return model.bounded(theta)


def _short_intervals(fit: Fit) -> tuple[FloatArray, FloatArray]:
    """Short intervals of the recording, compared at the end of the dead time, and the share of those below each."""
    low = np.sort(np.diff(fit.recording.pieces[0][: 12 * fit.effort.first]))
    n = low.size
    ranks = np.unique(np.minimum([1, 5, 20, max(30, n // 500), max(60, n // 100), max(120, n // 30)], n - 1))
    return low[ranks], ranks / n


def with_edge(fit: Fit, model: Model, theta: FloatArray) -> FloatArray:
    """Parameters with a dead time at which simulated streams have the short intervals of the recording."""
    k, (observed, shares) = model.light, _short_intervals(fit)
    for _ in range(4):
        made = fit.streams(model, theta, min(fit.recording.photons, fit.effort.first), 4).intervals
        if not made.size:
            break
        here = made[np.minimum((shares * made.size).astype(int), made.size - 1)]
        theta = theta.copy()
        theta[k + 2] = max(theta[k + 2] + float((observed - here)[1:-1].mean()), 0.05 * observed[0])
    return theta
