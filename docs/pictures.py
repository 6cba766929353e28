"""Makes the picture of the first page and of links to the site: python docs/pictures.py.

Written to docs/start.png and docs/_static/preview.png, in the style of the gallery and in few colours, so that both are
small.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from PIL import Image

import mars_lidar as ml

DOCS = Path(__file__).resolve().parent
PIXEL = (34, 83)  # row and column, on the door


def main() -> None:
    """Simulate the room and draw it."""
    plt.style.use(["mars_lidar.plot.mars", DOCS / "gallery.mplstyle"])
    plt.rcParams |= {"font.size": 12, "axes.titlesize": 12}
    scene = ml.Scene.example("room", size=(96, 128))
    pulse, detector = ml.GaussianPulse(sigma_ns=0.5), ml.Detector(dead_time_ns=75.0)
    system = ml.System(period_ns=100.0, cycles=4000, bins=512, pulse=pulse, detector=detector)
    flux = scene.flux(system, signal=1.0, sbr=1.0)
    cube = ml.simulate(flux, system, seed=0)[0]
    estimate = ml.reconstruct(cube, system)
    row, column = PIXEL
    light = ml.statistics.photons_per_bin(flux[PIXEL], system, bins=512)
    mean = ml.statistics.mean_histogram(flux[PIXEL], system)

    fig, axes = plt.subplot_mosaic([["counts", "depth"], ["histogram", "histogram"]], figsize=(7.2, 6.0))
    for name, values, title in (("counts", cube.sum(-1), "counts"), ("depth", estimate.depth_m, "depth from them (m)")):
        image = axes[name].imshow(values, cmap={"counts": "magma", "depth": "viridis"}[name])
        axes[name].set(title=title, xticks=[], yticks=[])
        axes[name].plot(column, row, "o", mfc="none", mec="w", mew=2)
        fig.colorbar(image, ax=axes[name], shrink=0.8)
    plot = axes["histogram"]
    plot.fill_between(system.time_ns, system.cycles * light, step="mid", color="0.85", label="photons that arrive")
    plot.plot(system.time_ns, cube[PIXEL], ".", ms=3, color="C1", label="counts of the marked pixel")
    plot.plot(system.time_ns, mean, color="C0", label="their exact mean")
    plot.set_yscale("symlog", linthresh=1.0)
    plot.set(xlabel="time in the laser period (ns)", ylabel="per bin", xlim=(0, 100), ylim=(-0.2, None))
    plot.legend(loc="upper left")
    for name, size in (("start.png", None), ("_static/preview.png", (1200, 630))):
        fig.savefig(DOCS / name, dpi=150)
        picture = Image.open(DOCS / name).convert("RGB")
        if size:  # the middle of what networks show beside a link
            picture.thumbnail(size)
            sheet = Image.new("RGB", size, "white")
            sheet.paste(picture, ((size[0] - picture.width) // 2, (size[1] - picture.height) // 2))
            picture = sheet
        picture.quantize(256).save(DOCS / name, optimize=True)


if __name__ == "__main__":
    main()
