"""The picture of the explorer's page, 64 x 64 pixels of the package's built-in room, and Matplotlib's colours for it.

Written to src/scene.json and src/colours.json.

Depths are whole millimetres, and the light that each pixel returns is in 1/4096 of the mean: from these the page makes
the same photons per period as Python, to the last bit, and the same cube of them.
"""

from __future__ import annotations

import base64
import json
from pathlib import Path

import matplotlib
import numpy as np

import mars_lidar as ml

SIZE = (64, 64)
COLOURS = {"depth": "viridis", "counts": "magma"}
SHADES = 17
SOURCES = Path(__file__).with_name("src")


def main() -> None:
    """Write both files."""
    scene = ml.Scene.example("room", size=SIZE, seed=0)
    system = ml.System(
        period_ns=100.0, cycles=1, bins=1, pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=0.0)
    )
    signal = scene.flux(system, signal=1.0, sbr=1.0).signal
    maps = {"depth_mm": np.rint(1000.0 * scene.depth_m), "light": np.rint(4096.0 * signal)}
    told = {name: base64.b64encode(values.astype("<u2").tobytes()).decode() for name, values in maps.items()}
    text = json.dumps({"height": SIZE[0], "width": SIZE[1], **told})
    SOURCES.joinpath("scene.json").write_text(text + "\n")
    shades = np.linspace(0.0, 1.0, SHADES)
    tables = {
        use: np.rint(255.0 * matplotlib.colormaps[name](shades)[:, :3]).astype(int).tolist()
        for use, name in COLOURS.items()
    }
    SOURCES.joinpath("colours.json").write_text(json.dumps(tables) + "\n")


if __name__ == "__main__":
    main()
