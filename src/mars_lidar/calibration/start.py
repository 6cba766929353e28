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
    boxes = np.unique(np.round(1.5 ** np.arange(np.log(bins / 4) / np.log(1.5))).astype(int))  # of every width
    peaks, variance, widths = [], 0.0, 4.5 if model.returns == 1 else 3.0
    for _ in range(model.returns):
        masked, ratios = np.where(outside, hits, faint * passes), []
        for m in boxes:
            sums = [np.cumsum(np.r_[0.0, x, x[: m - 1]]) for x in (masked, passes)]
            inside, armed = (c[m:] - c[:-m] for c in sums)
            expected = np.maximum(faint * armed, 1e-9)
            more = np.maximum(inside, expected)
            ratios.append(more * np.log(more / expected) - (more - expected))  # log likelihood of a brighter window
        best = np.max(ratios, axis=1)
        first = int(np.argmax(best > 0.7 * best.max()))  # the narrowest that is about as likely holds one return only
        peak, sd = float(np.argmax(ratios[first]) + boxes[first] / 2) * cell, float(boxes[first]) * cell / 3
        for _ in range(6):
            off = (place - peak + period / 2) % period - period / 2
            reach = float(np.clip(widths * sd, 2.0 * cell, 0.3 * period))
            inside = np.abs(off) < reach
            rest = outside & ~inside
            faint = float((hits[rest].sum() + 1e-3) / max(passes[rest].sum(), 1.0))
            pulse = inside & outside & (passes > 0.003 * passes.max())  # not what a bright pulse hides
            extra, near = (rate - faint)[pulse], off[pulse]
            signal = max(float(extra.sum()), 1e-4)
            mean = float(np.clip((extra * near).sum() / signal, -reach, reach))
            sd = max(float((extra * (near - mean) ** 2).sum() / signal), (0.02 * boxes[first] * cell) ** 2) ** 0.5
            peak += mean
        outside &= ~inside
        peaks += [signal, peak % period]
        variance = variance or sd**2
    own = max(variance - unit**2 / 6, 0.0025 * variance, (0.15 * unit) ** 2)
    return np.array([max(faint * bins, 1e-5), *peaks, own**0.5])


def starts(fit: Fit, model: Model, fixed: dict[str, float]) -> list[FloatArray]:
    """Parameters (p,) for seven shares of jitter in the recorded width, sorted by the misfit."""
    k, unit, recording = model.light, model.clock.unit_ns, fit.recording
    observed, _ = _short_intervals(fit)
    hold = max(recording.armed_ns, fixed.get("dead_time_ns", 0.0))
    if model.returns == 0:
        first = np.array([free_waveform(recording, 64)[0].sum(), max((observed[-3] - observed[0]) / 4, 0.3 * unit)])
    else:
        first = light(recording.pieces[0][: 12 * fit.effort.first], model, hold)
    tried = []
    # from no jitter to a width of jitter alone
    for angle in np.linspace(0.0, np.pi / 2.0, 1 if "jitter" in fixed else 7):
        theta = np.r_[first, 0.0, 0.0]
        theta[k + 1] = fixed.get("jitter", angle if model.split else np.sin(angle) * theta[k])
        theta[k + 2] = fixed.get("dead_time_ns", max(observed[0], 0.05 * observed[-1]) + 2 * model.widths(theta)[1])
        tried.append(theta if "dead_time_ns" in fixed else with_edge(fit, model, theta))
    tried.append(saturated(recording.intervals, model, np.r_[first, 0.0, 0.0], fixed))
    return sorted(tried, key=lambda theta: fit.distance(model, theta))


def saturated(gaps: FloatArray, model: Model, theta: FloatArray, fixed: dict[str, float]) -> FloatArray:
    """Parameters (p,) by the moments of the intervals, which in constant light are t_d + an exponential + the jitter.

    Their third central moment is that of the exponential alone. In pulsed light this holds if the detector is
    saturated, where no interval is long enough to count photons that the dead time does not hide.
    """
    k, theta, off = model.light, theta.copy(), gaps - gaps.mean()
    mean = float(gaps.mean())
    wait = float(np.clip(0.5 * (off**3).mean(), (1e-4 * mean) ** 3, (0.99 * mean) ** 3)) ** (1.0 / 3.0)
    jitter = fixed.get("jitter", (0.5 * max(float(gaps.var()) - wait**2, 0.0)) ** 0.5)
    theta[model.amounts] *= model.clock.period_ns / wait / theta[model.amounts].sum()
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
