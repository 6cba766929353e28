"""A small good file of every format, and what reads all of it: it returns nothing, or yields what it reads."""

import atexit
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

import mars_lidar as ml
from mars_lidar import io
from mars_lidar._base.hdf5 import SEAL
from mars_lidar.cli.system_options import _measured
from mars_lidar.dataset import DatasetRecipe, open_dataset, read_sparse
from mars_lidar.dataset.sources import read_view
from mars_lidar.io.foreign import foreign_cube
from mars_lidar.io.maps import load_maps, save_maps
from mars_lidar.io.rgbd import read_layers
from mars_lidar.io.streams.recorders import recorded
from mars_lidar.io.transient import read_truth

SYSTEM = ml.System(
    period_ns=100.0, cycles=50, bins=32, pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=30.0)
)


SECRET = 77  # counts of the file that external storage, virtual data and links point to


def _cube(path: Path) -> Iterator[Any]:
    with io.load(path) as cube:
        yield np.asarray(cube.histogram)
        yield from (cube.depth_m, cube.flux.signal, cube.flux.background, cube.flux.delay_ns, cube.reflectivity)
        yield from (cube.system.to_json(), cube.engine, cube.seed, cube.registrations, cube.settings)


def _dataset(path: Path) -> Iterator[Any]:
    stored = open_dataset(path)
    yield from (stored.recipe, stored.seeds, np.asarray(stored.histogram))
    yield from (np.asarray(array) for _, array in sorted(stored.maps.items()))
    yield read_sparse(stored, 0).todense()
    for number in range(len(stored.scene_names())):
        scene = stored.scene(number)
        yield from (value for _, value in sorted(vars(scene).items()) if isinstance(value, np.ndarray))


def _maps(path: Path) -> Iterator[Any]:
    for entries in load_maps(path):
        yield from ((name, entries[name]) for name in sorted(entries) if name not in (SEAL, "manifest"))


def _photons(path: Path) -> Iterator[Any]:
    given = {"period_ns": 100.0, "unit_ns": 1.0} if path.name.startswith("bare") else {}
    times = ml.Timestamps.load(path, **given)
    yield from (times.times_ns, times.cycle, times.bin, times.histogram(), times.period_ns, times.cycles, times.bins)


def _table(path: Path) -> Iterator[Any]:
    table = ml.Table.load(path)
    yield from (table.system.to_json(), table.signal, table.background, table.method, table.tolerance)
    for part in (table.entries, table.start_phases, table.laws):
        yield from (value for _, value in sorted(vars(part).items()) if isinstance(value, np.ndarray))


def _light(path: Path) -> None:
    light = io.read_transient(path, bin_ns=1.0 if path.suffix == ".npy" else None)
    read_truth(path, light.shape)
    light.flux(SYSTEM, signal=0.5, sbr=2.0)


def _counts_of_another_file(path: Path) -> None:
    """Counts that lie in another file: never read. What is refused by its name is as it should be."""
    try:
        cube = foreign_cube(path, SYSTEM)
    except ValueError as error:
        if "other file" in str(error) and str(path) in str(error):
            return
        raise
    if (np.asarray(cube.histogram) == SECRET).any():
        raise RuntimeError(f"{path}: the values of another file were read")


def _folder(path: Path) -> None:
    """Nothing in a folder may stop its scan; a manifest that is damaged is an argument."""
    io.scan(path.parent)


READERS: dict[str, Callable[[Path], Any]] = {
    **dict.fromkeys(["cube.zarr", "cube.h5", "cube.npz", "cube.mat", "cube.ptu"], _cube),
    "set.zarr": _dataset,
    **dict.fromkeys(["photons.npz", "photons.h5", "photons.ptu", "bare.mat", "bare73.mat", "bare.npz"], _photons),
    **dict.fromkeys(
        ["light.npy", "light.npz", "light.h5", "light.mat", "light73.mat", "tal.hdf5", "zaragoza.hdf5"], _light
    ),
    "scan.ptu": recorded,
    **dict.fromkeys(["maps.zarr", "maps.h5", "maps.npz"], _maps),
    "table.h5": _table,
    **dict.fromkeys(["depth.png", "depth.tif", "depth.npy", "depth.npz", "depth.pfm", "depth.exr"], ml.Scene.from_rgbd),
    "layers.npz": read_layers,
    "nyu.mat": lambda path: ml.Scene.from_rgbd(path, index=1),
    "art/dmin.txt": lambda path: ml.Scene.from_rgbd(path.parent),
    "art/disp1.png": lambda path: ml.Scene.from_rgbd(path.parent),
    "bike/calib.txt": lambda path: ml.Scene.from_rgbd(path.parent),
    "folder/a.npz": _folder,
    "folder/nyu.mat": _folder,
    "listed/manifest.csv": _folder,
    "system.yaml": ml.System.load,
    "system.json": ml.System.load,
    "recipe.yaml": DatasetRecipe.load,
    "scene.yaml": lambda path: read_view(path, SYSTEM),
    **dict.fromkeys(
        ["counts.csv", "counts.npy", "counts.h5", "counts.mat", "pages.tif"], lambda path: foreign_cube(path, SYSTEM)
    ),
    **dict.fromkeys(
        ["sparse.mat", "packed.mat", "sparse73.mat", "sparse.npz", "cells.mat", "cells73.mat"],
        lambda path: foreign_cube(path, SYSTEM, variable="spad[2]" if path.name.startswith("cells") else None),
    ),
    **dict.fromkeys(["external.h5", "virtual.h5", "linked.h5"], _counts_of_another_file),
    "four.mat": lambda path: foreign_cube(path, SYSTEM, variable="counts"),
    "window.mat": lambda path: foreign_cube(path, SYSTEM, unit_ns=1.0, window_ns=(200.0, 250.0)),
    "stream.csv": lambda path: ml.Timestamps.load(path, period_ns=100.0, unit_ns=1.0).histogram(),
    "pulse.csv": lambda path: _measured(path, 0.1, "peak"),
    "matlab.mat": ml.Scene.from_rgbd,
    "pulse.npy": lambda path: _measured(path, 0.1, "peak"),
}
LEAVES_OUT = ("folder/a.npz", "folder/nyu.mat")  # never an error: what is damaged is left out


def make(folder: Path) -> list[str]:
    """Write them all; the names of those whose libraries are here."""
    import h5py
    import ptufile
    from PIL import Image
    from scipy import sparse
    from scipy.io import savemat

    flux = ml.Flux(np.linspace(0.1, 2.0, 12).reshape(3, 4), 0.1, 40.0)
    for suffix in (".zarr", ".h5", ".npz", ".mat", ".ptu"):
        io.simulate_to(folder / f"cube{suffix}", flux, SYSTEM)
    recipe = {"scenes": {"example": "room", "size": [3, 4]}, "systems": [SYSTEM], "light": {"signal": [0.5, 1.0]}}
    ml.generate(recipe | {"store": {"layout": "sparse"}}, folder / "set.zarr")
    times = ml.simulate_timestamps(flux, SYSTEM)
    for suffix in (".npz", ".h5", ".ptu"):
        times.save(folder / f"photons{suffix}")
    stamps = np.sort(np.random.default_rng(1).random(300) * 5e4)
    savemat(folder / "bare.mat", {"t_ns": stamps})
    np.savez_compressed(folder / "bare.npz", t_ns=stamps)
    with h5py.File(folder / "bare73.mat", "w") as file:
        file["a"], file["b"] = stamps[:100], stamps[100:]
        cells = file.create_dataset("t_ns", (2, 1), h5py.ref_dtype)
        cells[0, 0], cells[1, 0] = file["a"].ref, file["b"].ref
    light = np.random.default_rng(2).random((3, 4, 50))
    truth = {"depth": np.full((3, 4), 2.0), "reflectivity": np.full((3, 4), 0.5)}
    np.save(folder / "light.npy", light)
    np.savez_compressed(folder / "light.npz", transient=light, bin_ns=1.0, start_ns=3.0, **truth)
    savemat(folder / "light.mat", {"transient": light, "bin_ns": 1.0, "start_ns": 3.0, **truth}, do_compression=True)
    with h5py.File(folder / "light.h5", "w") as file:
        data = file.create_dataset("transient", data=light, chunks=(1, 4, 50), compression="gzip", shuffle=True)
        data.attrs.update({"bin_ns": 1.0, "start_ns": 3.0})
        file["depth"] = truth["depth"]
    with h5py.File(folder / "light73.mat", "w") as file:
        file["transient"], file["bin_ns"] = light.transpose(2, 1, 0), [[1.0]]
    with h5py.File(folder / "tal.hdf5", "w") as file:
        file["H"], file["H_format"] = light.transpose(2, 1, 0), 1
        file["delta_t"], file["t_start"] = 0.01, 0.5
    with h5py.File(folder / "zaragoza.hdf5", "w") as file:  # x y bounces time colours
        file["data"], file["deltaT"], file["t0"] = light.reshape(4, 3, 1, 50, 1), 0.01, 0.5
    scan = np.random.default_rng(5).poisson(1.0, (2, 3, 4, 1, 20)).astype(np.uint16)
    ptufile.imwrite(folder / "scan.ptu", scan, 50e-9, 2.5e-9, pixel_time=50 * 50e-9)
    maps = {"peak": ml.reconstruct(np.asarray(io.load(folder / "cube.npz").histogram), SYSTEM, "peak")}
    for suffix in (".zarr", ".h5", ".npz"):
        save_maps(folder / f"maps{suffix}", maps)
    ml.Table.build(SYSTEM, signal=(0.1, 1, 2), background=(0.1, 1, 2)).save(folder / "table.h5")
    depth = np.random.default_rng(3).random((6, 7)) + 1.0
    Image.fromarray((1000 * depth).astype(np.uint16)).save(folder / "depth.png")
    Image.fromarray((1000 * depth).astype(np.uint16)).save(folder / "depth.tif")
    np.save(folder / "depth.npy", depth)
    np.savez_compressed(folder / "depth.npz", depth=depth, reflectivity=depth / 2, background=depth)
    np.savez_compressed(folder / "layers.npz", depth=np.stack([depth, depth + 1]), reflectivity=np.full((2, 6, 7), 0.3))
    pfm = b"Pf\n7 6\n-1.0\n" + depth[::-1].astype("<f4").tobytes()
    (folder / "depth.pfm").write_bytes(pfm)
    with h5py.File(folder / "nyu.mat", "w") as file:
        file.create_dataset("depths", data=np.ones((3, 7, 6)) + 1, chunks=(1, 7, 6), compression="gzip")
        file["images"] = np.full((3, 3, 7, 6), 99, np.uint8)
    for name in ("art", "bike", "folder", "listed"):
        (folder / name).mkdir()
    Image.fromarray(np.full((6, 7), 90, np.uint8)).save(folder / "art/disp1.png")
    Image.fromarray(np.full((6, 7, 3), 90, np.uint8)).save(folder / "art/view1.png")
    (folder / "art/dmin.txt").write_text("200\n")
    (folder / "bike/disp0.pfm").write_bytes(pfm)
    shutil.copy(folder / "art/view1.png", folder / "bike/im0.png")
    (folder / "bike/calib.txt").write_text("cam0=[3000 0 4; 0 3000 3; 0 0 1]\ndoffs=100.5\nbaseline=193.0\n")
    shutil.copy(folder / "depth.npz", folder / "folder/a.npz")
    shutil.copy(folder / "nyu.mat", folder / "folder/nyu.mat")
    shutil.copy(folder / "depth.npz", folder / "listed/a.npz")
    (folder / "listed/manifest.csv").write_text("depth,depth_unit_m,focal_px\na.npz,1.0,500\na.npz,,\n")
    SYSTEM.save(folder / "system.yaml")
    SYSTEM.save(folder / "system.json")
    (folder / "recipe.yaml").write_text(
        "seed: 7\nscenes:\n  - example: room\n    size: 8\n    seeds: {first: 0, count: 3}\n  - path: folder\n"
        "crop: {size: [4, 4], count: 2}\nsystems: {file: system.yaml}\nlight: {signal: [0.5, 1.0], sbr: 5}\n"
        "store: {layout: sparse, chunk_mib: 1}\n"
    )
    (folder / "scene.yaml").write_text("depth: depth.png\nfocal_px: 500\nlight: {signal: 1, sbr: 2}\n")
    counts = np.random.default_rng(4).poisson(2.0, (3, 4, 32))
    np.save(folder / "counts.npy", counts)
    savemat(folder / "counts.mat", {"counts": counts})
    np.savetxt(folder / "counts.csv", counts[0, 0], fmt="%d")
    pages = [Image.fromarray(counts[:, :, k].astype(np.uint16)) for k in range(32)]
    pages[0].save(folder / "pages.tif", save_all=True, append_images=pages[1:])
    with h5py.File(folder / "counts.h5", "w") as file:
        file["counts"] = counts
    matrix = sparse.csc_matrix(counts.transpose(1, 0, 2).reshape(12, 32).astype(float))
    savemat(folder / "sparse.mat", {"spad": matrix})
    savemat(folder / "packed.mat", {"spad": matrix}, do_compression=True)
    savemat(folder / "four.mat", {"counts": counts[0], "depth": counts[0] + 1.0}, format="4")
    sparse.save_npz(folder / "sparse.npz", matrix)
    both = np.empty((1, 2), object)
    both[0, 0], both[0, 1] = counts.astype(float), matrix
    savemat(folder / "cells.mat", {"spad": both})
    for name in ("sparse73.mat", "cells73.mat"):
        with h5py.File(folder / name, "w") as file:
            group = file.create_group("spad" if name == "sparse73.mat" else "#refs#/a")
            group.attrs["MATLAB_sparse"] = np.uint64(12)
            group["data"], group["ir"], group["jc"] = matrix.data, matrix.indices, matrix.indptr
            if name == "cells73.mat":
                file["#refs#/b"] = counts.transpose(2, 1, 0).astype(float)
                cells = file.create_dataset("spad", (2, 1), h5py.ref_dtype)
                cells[0, 0], cells[1, 0] = file["#refs#/b"].ref, group.ref
    times = np.empty((3, 4), object)
    for place in np.ndindex(times.shape):
        times[place] = np.sort(np.random.default_rng(6).random(30) * 300.0)
    savemat(folder / "window.mat", {"times": times})
    np.savetxt(folder / "stream.csv", stamps[:100])
    np.savetxt(folder / "pulse.csv", np.exp(-(np.linspace(-3, 3, 40) ** 2)))
    savemat(folder / "matlab.mat", {"depth": np.random.default_rng(3).random((6, 7)) + 1.0})
    other_folder = Path(tempfile.mkdtemp(prefix="fuzz"))
    atexit.register(shutil.rmtree, other_folder, True)
    (other_folder / "secret.bin").write_bytes(bytes([SECRET]) * 384)
    with h5py.File(other_folder / "secret.h5", "w") as file:
        file["counts"] = np.full((3, 4, 32), SECRET, np.uint8)
    with h5py.File(folder / "external.h5", "w") as file:
        file.create_dataset("counts", (3, 4, 32), "u1", external=[(str(other_folder / "secret.bin"), 0, 384)])
    virtual = h5py.VirtualLayout((3, 4, 32), "u1")
    virtual[:] = h5py.VirtualSource(other_folder / "secret.h5", "counts", (3, 4, 32))
    with h5py.File(folder / "virtual.h5", "w") as file:
        file.create_virtual_dataset("counts", virtual)
    with h5py.File(folder / "linked.h5", "w") as file:
        file["counts"] = h5py.ExternalLink(str(other_folder / "secret.h5"), "/counts")
    np.save(folder / "pulse.npy", np.exp(-(np.linspace(-3, 3, 40) ** 2)))
    try:
        import OpenEXR
    except ImportError:
        return [name for name in READERS if not name.endswith(".exr")]
    pixels = {"Z": np.ascontiguousarray(depth, np.float32)}
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, pixels).write(
        str(folder / "depth.exr")
    )
    return list(READERS)
