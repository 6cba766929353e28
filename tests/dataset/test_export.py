"""Datasets as the files of networks: read as their loaders read them, they hold the dataset's own numbers.

The steps of reading (keys, reshapes, orders of axes, offsets, names made of names) are those of the classes
`SpadDataset` of the code of Lindell et al. 2018, of its variant that draws photons anew, of Gutierrez-Barragan et al.
2023 and of Sun et al. 2020 (`util/dataset_spadnet.py`), as they are at the heads of their repositories.
"""

import re
from glob import glob
from os.path import commonprefix, dirname
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from harness import make_system, refused
from PIL import Image
from scipy import sparse
from scipy.io import loadmat

import mars_lidar as ml
from mars_lidar import dataset
from mars_lidar.cli import main
from mars_lidar.dataset.network_files import LAYOUTS, export

SYSTEM = make_system(30.0, 300, 1024, sigma_ns=0.1)
SIDE, BINS = 8, 1024
LEVELS = [[0.5, 2.0], [2.0, 0.5]]


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One room and a scene with a hole, two levels of light, two exposures."""
    folder = tmp_path_factory.mktemp("scenes")
    depth = np.linspace(1.0, 9.0, SIDE * SIDE).reshape(SIDE, SIDE)
    depth[2:4, 5] = np.nan
    share = np.linspace(0.2, 1.0, SIDE * SIDE).reshape(SIDE, SIDE)
    np.savez(folder / "my spad intensity.npz", depth=depth, reflectivity=share)
    recipe = {
        "seed": 2,
        "scenes": [{"example": "room", "size": SIDE}, {"path": str(folder / "my spad intensity.npz")}],
        "systems": [SYSTEM],
        "light": {"levels": LEVELS},
        "realizations": 2,
    }
    ml.generate(recipe, folder / "set.zarr")
    return folder / "set.zarr"


def counts_of(store: Path, sample: int, realization: int) -> np.ndarray:
    return np.asarray(dataset.open_dataset(store).histogram[sample, realization])


def column_major(path: str | Path) -> np.ndarray:
    """Counts (bins, H, W) as all four loaders make them of `spad`."""
    spad = np.asarray(sparse.csc_matrix.todense(sparse.csc_matrix(loadmat(path)["spad"])))
    return spad.reshape(1, SIDE, SIDE, -1).transpose(0, 3, 2, 1)[0]


def samples(listed: Path) -> list[str]:
    return listed.read_text().split()


@pytest.mark.parametrize("layout", ["lindell", "deepsensorfusion"])
def test_lists_of_intensities(store: Path, tmp_path: Path, layout: str) -> None:
    done = export(store, tmp_path / "set", layout=layout, fill=True)
    images = samples(done.listed)
    assert (len(images), done.files) == (4, 8)  # 2 scenes x 2 exposures, each at two levels of light
    opened = dataset.open_dataset(store)
    for level in (1, 2):
        for k, name in enumerate(images):
            scene, realization = divmod(k, 2)
            sample = 2 * scene + level - 1
            contents = loadmat(name.replace("intensity", "spad").replace(".mat", f"_p{level}.mat"))
            counts = column_major(name.replace("intensity", "spad").replace(".mat", f"_p{level}.mat"))
            np.testing.assert_array_equal(counts.transpose(1, 2, 0), counts_of(store, sample, realization))
            rates = contents["rates"].reshape(1, SIDE, SIDE, -1).transpose(0, 3, 1, 2)
            rates = rates / rates.sum(axis=1)[None]
            assert np.isfinite(rates).all()
            bins = contents["bin"].astype(np.float32).reshape(SIDE, SIDE) - 1
            assert np.abs(rates[0].argmax(axis=0) - bins).max() <= 1
            flux = opened.maps
            lit = np.asarray(flux["signal"][sample]) > 0
            delay = np.asarray(flux["delay"][sample])
            assert np.abs((bins + 0.5) * SYSTEM.bin_ns - delay)[lit].max() < 0.51 * SYSTEM.bin_ns
            fine = contents["bin_hr"].astype(np.float32).reshape(8 * SIDE, 8 * SIDE) - 1
            assert np.abs(fine - bins.repeat(8, 0).repeat(8, 1)).max() <= 0.5001
            intensity = loadmat(name)["intensity"].astype(np.float32).reshape(8 * SIDE, 8 * SIDE) / 255
            shared = np.asarray(flux["reflectivity"][sample]).repeat(8, 0).repeat(8, 1)
            known = np.isfinite(shared)
            assert np.abs(intensity - shared)[known].max() < 0.003
            signal, sbr = (value * lit.mean() for value in LEVELS[level - 1])
            assert contents["SBR"].shape == (1, 1)
            assert contents["SBR"][0, 0] == pytest.approx(sbr, rel=1e-6)
            assert contents["photons"][0, 0] == pytest.approx(signal * SYSTEM.cycles, rel=1e-6)
            if layout == "deepsensorfusion":
                drawn_anew(contents, bins, lit)
    if layout == "deepsensorfusion":
        assert loadmat(tmp_path / "set" / "simulated_data" / "dark_img.mat")["dark_img"].reshape(50, 64).sum() == 0


def drawn_anew(contents: dict[str, Any], bins: np.ndarray, lit: np.ndarray) -> None:
    """The rates that this loader makes of pulse, signal and background, rolled to the bin of the return."""
    rate = np.zeros((SIDE, SIDE, BINS))
    rate[:, :, :16] = contents["pulse"].reshape(SIDE, SIDE, 16) * contents["signal_ppp"][:, :, None]
    rate += contents["ambient_ppp"][:, :, None]
    for y, x in zip(*np.nonzero(lit), strict=True):
        rolled = np.roll(rate[y, x], int(bins[y, x]) - 6) - contents["ambient_ppp"][y, x]
        meant = contents["rates"][y, x] * rolled.max()
        assert np.abs(rolled - meant).max() < 2e-3 * rolled.max()
    flux = contents["signal_ppp"].mean() / (BINS * contents["ambient_ppp"].mean())
    assert flux == pytest.approx(contents["SBR"][0, 0], rel=1e-6)


def test_without_fill_a_pixel_without_return_has_bin_0(store: Path, tmp_path: Path) -> None:
    done = export(store, tmp_path / "set", layout="lindell")
    contents = loadmat(samples(done.listed)[2].replace("intensity", "spad").replace(".mat", "_p1.mat"))
    hole = contents["bin"] == 0
    assert np.argwhere(hole).tolist() == [[2, 5], [3, 5]]
    assert contents["rates"][hole].sum() == 0
    assert np.isnan(contents["bin_hr"]).sum() == 2 * 64


def test_compressive_histograms(store: Path, tmp_path: Path) -> None:
    done = export(store, tmp_path / "set", layout="gutierrez")
    files = samples(done.listed)
    assert len(files) == 8
    opened = dataset.open_dataset(store)
    for k, name in enumerate(files):
        sample, realization = divmod(k, 2)
        contents = loadmat(name)
        rows, columns, bins = contents["rates"].shape
        assert (rows, columns, bins) == (SIDE, SIDE, BINS)
        assert contents["bin_size"].squeeze() * 1e12 == pytest.approx(1e3 * SYSTEM.bin_ns)
        counts = counts_of(store, sample, realization)
        np.testing.assert_array_equal(column_major(name).transpose(1, 2, 0), counts)
        np.testing.assert_array_equal(contents["est_range_bins_argmax"] - 1, counts.argmax(-1))
        signal, sbr = LEVELS[sample % 2]
        lit_pixels = np.asarray(opened.maps["signal"][sample]) > 0
        lit = np.mean(lit_pixels)
        assert abs(int(contents["mean_signal_photons"].astype(np.int32)[0, 0]) - lit * signal * SYSTEM.cycles) <= 1
        assert abs(int(contents["mean_background_photons"].astype(np.int32)[0, 0]) - signal * SYSTEM.cycles / sbr) <= 1
        assert re.search(r"_p[12]\.mat$", name)
        matched = np.asarray(contents["est_range_bins_lmf"]) - 1  # for programs that compare with its baselines
        assert np.mean(np.abs(matched - (contents["bin"] - 1.0))[lit_pixels] <= 3) > 0.9
    # the loader looks for the response where the paths of all scenes part
    (psf,) = glob(f"{dirname(commonprefix(files))}/PSF_used_for_simulation*.mat")  # noqa: RUF071  (its step)
    pulse = loadmat(psf)["psf"].mean(axis=-1)
    assert pulse.sum() == pytest.approx(1.0, abs=1e-5)
    assert pulse.argmax() == len(pulse) // 2


def test_spadnet(store: Path, tmp_path: Path) -> None:
    root = tmp_path / "set"
    done = export(store, root, layout="sun")
    files = samples(done.listed)
    assert len(files) == 8
    assert (root / "blacklist.txt").read_text().split() == []
    opened = dataset.open_dataset(store)
    for k, name in enumerate(files):
        sample, realization = divmod(k, 2)
        contents = loadmat(root / "spad_nyuv2" / name)
        np.testing.assert_array_equal(
            column_major(root / "spad_nyuv2" / name).transpose(1, 2, 0), counts_of(store, sample, realization)
        )
        level = int(re.search(r"nl\d+.mat", name).group()[2:-4])  # type: ignore[union-attr]
        assert level == sample % 2 + 1
        depth = np.asarray(opened.maps["depth"][sample])
        np.testing.assert_allclose(contents["depth"].reshape(SIDE, SIDE), np.nan_to_num(depth), rtol=1e-6)
        mono = root / "mono_nyuv2" / name.replace(f"_nl{level}.mat", "").replace("spad_", "")
        truth = np.asarray(Image.open(f"{mono}_truth.png")).astype(np.float64) / 25.5
        assert np.abs(truth - np.nan_to_num(depth)).max() < 0.021
        assert np.ptp(np.asarray(Image.open(f"{mono}_pred.png"))) == 0
    assert any("512 x 512" in note for note in done.notes)


def test_convert_points_to_export(store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["convert", str(store), str(tmp_path / "set.h5")]) == 2
    assert "mars-lidar export" in capsys.readouterr().err


def test_what_cannot_be_exported_is_refused_before_any_file(store: Path, tmp_path: Path) -> None:
    refused("layout must be one of", export, store, tmp_path / "set", layout="none")
    refused(r"intensity or \.mat or a blank", export, store, tmp_path / "intensity", layout="lindell")
    refused("a blank", export, store, tmp_path / "my set", layout="sun")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    refused("not an empty folder", export, store, tmp_path / "full", layout="sun", error=FileExistsError)
    wide = {
        "scenes": [{"example": "room", "size": 4}],
        "systems": [SYSTEM.replace(pulse=ml.GaussianPulse(sigma_ns=2.0))],
        "light": {"signal": 1.0, "sbr": 1.0},
    }
    ml.generate(wide, tmp_path / "wide.zarr")
    refused("pulses of 16 bins", export, tmp_path / "wide.zarr", tmp_path / "set", layout="deepsensorfusion")
    assert not (tmp_path / "set").exists()
    assert set(LAYOUTS) == {"lindell", "deepsensorfusion", "sun", "gutierrez"}


@pytest.mark.full
@pytest.mark.filterwarnings("default")
def test_webdataset_reads_its_tars(tmp_path, recipe, monkeypatch):
    """The exposures of WebDataset's own loader are those of the store."""
    webdataset = pytest.importorskip("webdataset")
    from mars_lidar.dataset import network_files

    monkeypatch.setattr(network_files, "_TAR_BYTES", 5 * 12 * 10 * 32 * 2)  # five exposures
    ml.generate(recipe, tmp_path / "set.zarr")
    done = export(tmp_path / "set.zarr", tmp_path / "tars", layout="webdataset")
    assert done.files == 24
    names = (tmp_path / "tars" / "list.txt").read_text().split()
    assert len(names) == 5
    stored = dataset.open_dataset(tmp_path / "set.zarr")
    urls = [str(tmp_path / "tars" / name) for name in names]
    results = set()
    for example in webdataset.WebDataset(urls, shardshuffle=False).decode():
        numbers = example["json"]
        sample, realization = numbers["sample"], numbers["realization"]
        assert example["__key__"] == f"{sample:07d}-{realization:05d}"
        np.testing.assert_array_equal(example["counts.npy"], stored.histogram[sample, realization])
        for name in ("depth", "reflectivity", "signal", "background", "delay"):
            np.testing.assert_array_equal(example[f"{name}.npy"], stored.maps[name][sample])
        assert ml.System.from_dict(numbers["system"]) in stored.recipe.systems
        assert numbers["seed"] == int(stored.seeds[sample])
        results.add((sample, realization))
    assert len(results) == 24
    refused("fill belongs to", export, tmp_path / "set.zarr", tmp_path / "more", layout="webdataset", fill=True)
