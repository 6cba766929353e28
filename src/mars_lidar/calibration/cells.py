"""Counts of a stream in cells of phase, of interval, and of both, whose edges simulated streams of the model set."""

from __future__ import annotations

from typing import Any

import numpy as np

from mars_lidar._base.native import _core
from mars_lidar._base.types import FloatArray
from mars_lidar.calibration.model import EXCESS, Model
from mars_lidar.calibration.recording import Recording

_PHASES = 2**15  # cells of the table from phase to class
_PARTS = np.linspace(0.0, 1.0, 13)[1:-1]  # edges of phases in the counts and in the table, beside those of the light


class Cells:
    """Counts of a stream: phases; intervals; (interval, phase at its start, whether it ends in a pulse).

    The edges are set by simulated streams, never by the data, which would bias the counts. The shortest intervals are
    resolved down to 0.7 counts in the exposure, to locate the end of the dead time.
    """

    def __init__(self, model: Model, theta: FloatArray, pilot: Recording, photons: float) -> None:
        period, unit = model.clock.period_ns, model.clock.unit_ns
        gaps, phases = pilot.intervals, pilot.times / period % 1.0
        if not gaps.size:
            raise ValueError("times must be those of photons, got a stream whose like cannot be simulated")
        edges, lit = self._layout(model, theta, phases)
        centre = (np.arange(_PHASES) + 0.5) / _PHASES
        # phases from which the dead time, or a shorter one that electronics' dead time hides, ends in a pulse
        hidden = theta[model.light + 2] / (1.0 + np.array([0.0, EXCESS])[:, None, None])
        ends = (lit[: model.returns] - hidden / period) % 1.0
        coarse = np.unique(np.concatenate([_PARTS, lit.ravel(), ends.ravel()]))
        begin, end = lit.T
        inside = ((centre[:, None] - begin) % 1.0 < (end - begin) % 1.0).any(1)
        self.phases = edges.size + 1
        ratio = gaps.size / max(photons, 1.0)
        fine = max(0.7, 2.0 / ratio) * 1.5 ** np.arange(60)
        quantiles = np.r_[np.linspace(0.2, 0.8, 7), 1.0 - 0.2 * 0.5 ** np.arange(1, 6)]
        rank = np.r_[fine[fine < 0.15 * photons], photons * quantiles] * ratio
        place = gaps[np.minimum(rank.astype(int), gaps.size - 1)]
        early = (np.arange(1, 7) / 7) ** 3  # quantiles of the intervals that divide the table, closer for short ones
        ages = self._between(gaps[(early * gaps.size).astype(int)], unit)
        self.gap_edges = np.union1d(self._between(place, unit), ages)
        self._arguments: dict[str, Any] = {  # of the native cells, which cannot be pickled
            "period_ns": period,
            "shift": 0.37 / _PHASES,  # no edge lies where a clock ticks
            "phase_of": np.searchsorted(edges, centre).astype(np.int32),
            "class_of": (2 * np.searchsorted(coarse, centre)).astype(np.int32),
            "lit_of": inside.astype(np.int32),
            "gap_edges": self.gap_edges,
            "age_of": np.searchsorted(ages, np.append(self.gap_edges, np.inf)).astype(np.int32),
            "phases": self.phases,
            "classes": 2 * (coarse.size + 1),
            "ages": ages.size + 1,
        }
        self.size = int(_core.StreamCells(**self._arguments).size)

    @staticmethod
    def _layout(model: Model, theta: FloatArray, phases: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Edges of the phase cells, and the stretches (n, 2) of bright light, in periods."""
        clock = model.clock
        period, unit = clock.period_ns, clock.unit_ns
        edges, lit = [_PARTS], []
        if model.waveform is not None or model.pulse is not None:
            edges.append(np.quantile(phases, np.linspace(0.0, 1.0, 33)[1:-1]))
        if model.waveform is not None:
            dense = np.bincount((phases * 32).astype(int) % 32, minlength=32)
            bright = np.flatnonzero(dense > 1.5 * np.median(dense))
            lit = [(k / 32, (k + 1) / 32) for k in bright]
        width = float(np.sqrt(theta[model.light] ** 2 + unit**2 / 12))
        if model.pulse is not None:  # by the scatter of the phases about the delay
            off = (phases - theta[2] / period + 0.5) % 1.0 - 0.5
            dense, at = np.histogram(off, 512)
            dense = np.maximum(dense - np.median(dense), 0.0)
            middle = 0.5 * (at[1:] + at[:-1])
            mean = (dense * middle).sum() / max(dense.sum(), 1.0)
            width = period * float(np.sqrt((dense * (middle - mean) ** 2).sum() / max(dense.sum(), 1.0)))
        for r in range(model.returns):
            delay = theta[2 + 2 * r]
            peak = np.arange(-5.0, 5.01, 0.5) * width + delay
            if unit > 0.4 * width and (clock.locked or clock.units):  # edges between the units of the clock
                peak = np.unique(np.round(peak / unit)) * unit
            edges.append(peak / period % 1.0)
            lit.append(((delay - 3 * width) / period % 1.0, (delay + 3 * width) / period % 1.0))
        return np.unique(np.concatenate(edges)), np.array(lit).reshape(-1, 2)

    @staticmethod
    def _between(edges: FloatArray, unit: float) -> FloatArray:
        """Positive edges of intervals between units of a clock, off the middle where a period of half units may end."""
        off = 0.5 + 1.0 / 64.0 / np.pi  # units from a tick: half, and a part that no multiple of half a unit meets
        edges = np.unique((np.floor(edges / unit + 1e-6) + off) * unit if unit > 0.0 else edges)
        return np.asarray(edges[edges > 0.0])

    def count(self, streams: Recording, pieces: int = 1, length: float = np.inf) -> FloatArray:
        """Counts (streams, pieces, size), by pieces of this length in ns of each stream; the last has no end."""
        offsets = np.cumsum([0, *(stream.size for stream in streams)])
        counts = np.empty(((offsets.size - 1) * pieces, self.size))
        native = _core.StreamCells(**self._arguments)
        _core.count_streams(native, streams.times, offsets, pieces=pieces, length=length, out=counts)
        return counts.reshape(-1, pieces, self.size)

    def of(self, recording: Recording) -> FloatArray:
        """Counts (size,) of a recording, all stretches together."""
        return np.asarray(self.count(recording).sum((0, 1)))
