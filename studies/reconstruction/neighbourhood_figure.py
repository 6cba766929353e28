"""Figure of the study "neighbourhood"."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from mars_lidar import System
from mars_lidar._base.types import FloatArray
from mars_lidar.plot.figures import _draw_map, _limits
from mars_lidar.plot.style import style
from studies.common.draw import panels
from studies.common.report import save_figure


def neighbourhood_figure(path: Path, maps: Mapping[str, FloatArray], system: System) -> Path:
    """Maps of depth: the truth and each way."""
    with style():
        figure, axes = panels(1.35, 1, len(maps))
        depth = {name: np.asarray(system.depth_m(delay)) for name, delay in maps.items()}
        limits = _limits(depth["truth"])
        for ax, (name, values) in zip(axes[0], depth.items(), strict=True):
            _draw_map(ax, values, "depth (m)" if ax is axes[0, -1] else "", "viridis", limits, name)
            ax.images[0].set_interpolation("nearest")
        return save_figure(path, figure)
