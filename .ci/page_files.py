"""Small files of the kinds that pages name as the reader's own: `make(name)` writes one into the present folder."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path


def _pair(depth: str, image: str, seed: int) -> None:
    import numpy as np
    from PIL import Image

    import mars_lidar as ml

    scene = ml.Scene.example("room", size=(60, 80), seed=seed)
    for name in (depth, image):
        Path(name).parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((1000 * scene.depth_m).astype(np.uint16)).save(depth)
    Image.fromarray(np.repeat((255 * scene.reflectivity).astype(np.uint8)[..., None], 3, axis=2)).save(image)


def _rgbd() -> None:
    for k in range(2):
        _pair(f"rgbd/s{k}_depth.png", f"rgbd/s{k}.jpg", seed=k + 1)


def _nyu() -> None:
    for k in range(2):
        _pair(f"nyu/s{k}_depth.png", f"nyu/s{k}_colors.png", seed=k + 1)


def _scans() -> None:
    _pair("scans/a.png", "scans/a.jpg", seed=1)
    Path("scans/list.csv").write_text("depth,image\na.png,a.jpg\n")


def _labelled() -> None:
    import h5py
    import numpy as np

    import mars_lidar as ml

    scene = ml.Scene.example("room", size=(30, 40))
    with h5py.File("nyu_depth_v2_labeled.mat", "w") as file:  # as MATLAB has it: the dimensions the other way round
        file["depths"] = np.tile(scene.depth_m.T.astype(np.float32), (8, 1, 1))
        file["images"] = np.tile((255 * scene.reflectivity.T).astype(np.uint8), (8, 3, 1, 1))


def _transient(path: str) -> None:
    import h5py
    import numpy as np

    y, x = np.mgrid[-1:1:30j, -1:1:40j]
    at = 10 + 4 * (x**2 + y**2)
    values = np.exp(-0.5 * ((0.02 * np.arange(1000) - at[..., None] + 10) / 0.1) ** 2).astype(np.float32)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    if path.endswith(".npy"):
        np.save(path, values)
        return
    if "colours" in path:
        values = np.repeat(values[..., None], 3, axis=-1)
    with h5py.File(path, "w") as file:
        file["transient"] = values
        file["transient"].attrs.update(bin_ns=0.02, start_ns=10.0)


def _foliage() -> None:
    import numpy as np

    depth = np.stack([np.full((60, 80), 3.0), np.full((60, 80), 6.0)])
    np.savez("foliage.npz", depth=depth, reflectivity=np.full((2, 60, 80), 0.4))


def _room() -> None:
    import mars_lidar as ml

    pulse, detector = ml.GaussianPulse(sigma_ns=0.5), ml.Detector(dead_time_ns=75.0)
    system = ml.System(period_ns=100.0, cycles=200, bins=256, pulse=pulse, detector=detector)
    ml.io.simulate_to("room.zarr", ml.Scene.example("room").flux(system, signal=1.0, sbr=1.0), system)


def _counts(path: str) -> None:
    import numpy as np
    import scipy.io

    import mars_lidar as ml

    pulse, detector = ml.GaussianPulse(sigma_ns=0.2), ml.Detector(dead_time_ns=30.0)
    system = ml.System(period_ns=50.0, cycles=20_000, bins=250, pulse=pulse, detector=detector)
    counts = ml.simulate(ml.Scene.example("room", size=8).flux(system, signal=0.1, sbr=2.0), system)[0]
    if path.endswith(".npy"):
        np.save(path, counts)
    else:
        scipy.io.savemat(path, {"counts": counts})


def _histogram() -> None:
    import numpy as np

    import mars_lidar as ml

    pulse, detector = ml.GaussianPulse(sigma_ns=1.0), ml.Detector(dead_time_ns=50.0)
    system = ml.System(period_ns=100.0, cycles=20_000, bins=1000, pulse=pulse, detector=detector)
    counts = ml.simulate(ml.Flux(1.5, 1.0, 40.0), system)[0, 0, 0]
    np.savetxt("lab.csv", np.c_[system.time_ns, counts], delimiter=",", header="time_ns,counts", comments="", fmt="%g")


def _photon_times() -> None:
    import numpy as np
    import scipy.io

    import mars_lidar as ml

    pulse, detector = ml.GaussianPulse(sigma_ns=0.5), ml.Detector(dead_time_ns=80.0)
    system = ml.System(period_ns=782 * 0.064, cycles=200_000, bins=500, pulse=pulse, detector=detector)
    times = ml.simulate_timestamps(ml.Flux(0.05, 0.01, 20.0), system).times_ns
    scipy.io.savemat("tcspc.mat", {"tPhoton": np.floor(times / 0.064), "syncPeriod": 782.0})


def _recipe() -> None:
    Path("recipe.yaml").write_text(
        "scenes: {example: room, size: 32, seeds: {count: 8}}\n"
        "systems:\n"
        "  period_ns: 100.0\n"
        "  cycles: 100\n"
        "  bins: 64\n"
        "  pulse: {kind: gaussian, sigma_ns: 1.0}\n"
        "  detector: {dead_time_ns: 75.0}\n"
        "light: {signal: 0.5, sbr: [1, 2]}\n"
    )


def _scene_file() -> None:
    make("render.hdf5")
    Path("render.yaml").write_text("transient: render.hdf5\nlight: {signal: 0.5, sbr: 5}\n")


def _command(line: str) -> Callable[[], None]:
    return lambda: subprocess.run(["bash", "-euo", "pipefail", "-c", line], check=True) and None


FILES: dict[str, Callable[[], None]] = {
    "depth.png": lambda: _pair("depth.png", "colors.png", seed=0),
    "colors.png": lambda: _pair("depth.png", "colors.png", seed=0),
    "colour.png": lambda: _pair("depth.png", "colour.png", seed=0),
    "rgbd/": _rgbd,
    "nyu/": _nyu,
    "scans/": _scans,
    "nyu_depth_v2_labeled.mat": _labelled,
    "render.hdf5": lambda: _transient("render.hdf5"),
    "colours.hdf5": lambda: _transient("colours.hdf5"),
    "render.npy": lambda: _transient("render.npy"),
    "render.yaml": _scene_file,
    "renders/": lambda: _transient("renders/colours.hdf5"),
    "foliage.npz": _foliage,
    "room.zarr": _room,
    "face.mat": lambda: _counts("face.mat"),
    "face.npy": lambda: _counts("face.npy"),
    "lab.csv": _histogram,
    "tcspc.mat": _photon_times,
    "recipe.yaml": _recipe,
    "spad.yaml": _command("mars-lidar init spad.yaml && sed -i 's/dead_time_ns: 75.*/dead_time_ns: 50.0/' spad.yaml"),
    "lab-detector.yaml": _command("mars-lidar init lab-detector.yaml"),
}


def make(name: str) -> None:
    """Write it, unless it is there."""
    if not Path(name).exists():
        FILES[name]()
