"""Figure of the study "downstream": a scene as every network has it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mars_lidar.plot.style import style
from studies.downstream.data import Config, crop
from studies.downstream.run import TARGETS, Run

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SHORT = {"poisson": "Poisson", "nearest": "MaRS, nearest", "mars": "MaRS"}


def picture(folder: Path, config: Config, found: Mapping[Run, Any], sbr: float) -> Figure:
    """The first test scene: truth, and every arm's window network on its own and on gold-standard data."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    scene = crop(config.test[0], config)
    arms = list(config.arms)
    with style():
        figure = Figure(figsize=(1.05 * (len(arms) + 1), 4.7), dpi=90, layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots(4, len(arms) + 1, squeeze=False)
        for half, target in enumerate(TARGETS):
            true = scene.depth_m if target == "depth" else scene.reflectivity
            limits: dict[str, Any] = {"vmin": float(np.nanmin(true)), "vmax": float(np.nanmax(true))}
            limits["cmap"] = "viridis" if target == "depth" else "gray"
            axes[2 * half, 0].imshow(true, **limits)
            axes[2 * half, 0].set_title(f"{target}, true")
            axes[2 * half + 1, 0].axis("off")
            for k, arm in enumerate(arms, 1):
                one = Run(arm, sbr, config.arms[arm][0])
                with np.load(folder / f"{one.name}.npz") as shown:
                    for row, data in enumerate(("own", "gold")):
                        ax = axes[2 * half + row, k]
                        ax.imshow(shown[f"{data}_window_{target}"], **limits)
                        error = found[one][data]["window"][target]
                        told = f"{error['rmse']:.3f} m" if target == "depth" else f"{error['psnr']:.1f} dB"
                        ax.set_title(f"{_SHORT.get(arm, arm)}\n{data}: {told}" if row == 0 else f"{data}: {told}")
        for ax in axes.flat:
            ax.set(xticks=[], yticks=[])
        figure.suptitle(f"Window networks, SBR {sbr:g}; figures under the names: over all test scenes", fontsize=8)
    return figure
