"""Exports at the sizes that the networks' own loaders have written into them, read in the steps that these take.

The steps (keys, reshapes, orders of axes, offsets, names made of names) are those of the classes `SpadDataset` of the
code of Lindell et al. 2018, of its variant that draws photons anew, of Gutierrez-Barragan et al. 2023 and of Sun et al.
2020 (`util/dataset_spadnet.py`), as they are at the heads of their repositories.
"""

from __future__ import annotations

import re
from glob import glob
from os.path import commonprefix, dirname
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
import scipy.sparse
from harness import make_system
from PIL import Image

import mars_lidar as ml
from mars_lidar.dataset import open_dataset
from mars_lidar.dataset.network_files import export

pytestmark = pytest.mark.full
SYSTEM = make_system(20.0, 2000, 1024, sigma_ns=0.12, period_ns=81.92)
LEVELS = [[0.005, 1.0], [0.02, 4.0]]  # signal per period, SBR


def made(path: Path, size: int, system: ml.System, scenes: int = 1) -> Path:
    recipe = {
        "seed": 3,
        "scenes": [{"example": "room", "size": size, "seeds": {"count": scenes}}],
        "systems": [system],
        "light": {"levels": LEVELS},
    }
    ml.generate(recipe, path)
    return path


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made(tmp_path_factory.mktemp("loaders") / "set.zarr", 64, SYSTEM)


def dense(path: str, *shape: int) -> np.ndarray:
    """`spad` as all of them expand it, (1, bins, H, W)."""
    spad = np.asarray(scipy.sparse.csc_matrix.todense(scipy.io.loadmat(path)["spad"]))
    return np.transpose(spad.reshape([1, *shape]), (0, 3, 2, 1))


def lindell(listed: Path, noise: int) -> list[dict[str, Any]]:
    """Every sample of a list of intensity files, at one level of noise."""
    samples = []
    for intensity in listed.read_text().split():
        spad = intensity.replace("intensity", "spad").replace(".mat", f"_p{noise}.mat")
        rates = np.transpose(np.asarray(scipy.io.loadmat(spad)["rates"]).reshape([1, 64, 64, -1]), (0, 3, 1, 2))
        fine, coarse = scipy.io.loadmat(spad)["bin_hr"], scipy.io.loadmat(spad)["bin"]
        samples.append(
            {
                "spad": dense(spad, 64, 64, -1),
                "rates": rates / np.sum(rates, axis=1)[None, :, :, :],
                "intensity": scipy.io.loadmat(intensity)["intensity"].astype(np.float32).reshape([1, 512, 512]) / 255,
                "bins": (coarse.astype(np.float32).reshape([64, 64]) - 1)[None] / 1023,
                "bins_hr": (fine.astype(np.float32).reshape([512, 512]) - 1)[None] / 1023,
                "sbr": scipy.io.loadmat(spad)["SBR"].astype(np.float32),
                "photons": scipy.io.loadmat(spad)["photons"].astype(np.float32),
            }
        )
    return samples


def test_lindell(store: Path, tmp_path: Path) -> None:
    listed = export(store, tmp_path / "set", layout="lindell", fill=True).listed
    opened = open_dataset(store)
    depth = np.asarray(opened.maps["depth"][0])
    for level, (signal, sbr) in enumerate(LEVELS):
        (sample,) = lindell(listed, level + 1)
        counts = np.asarray(opened.histogram[level, 0])
        np.testing.assert_array_equal(sample["spad"][0].transpose(1, 2, 0), counts)
        assert np.isfinite(sample["rates"]).all()
        metres = (1023 * sample["bins"][0] + 0.5) * SYSTEM.bin_ns * 0.149896229
        assert np.abs(metres - depth).max() < SYSTEM.bin_ns * 0.149896229
        assert np.abs(sample["rates"][0].argmax(0) - 1023 * sample["bins"][0]).max() <= 1
        assert np.abs(1023 * (sample["bins_hr"][0, ::8, ::8] - sample["bins"][0])).max() <= 0.51
        assert (
            np.corrcoef(sample["intensity"][0, ::8, ::8].ravel(), opened.maps["reflectivity"][0].ravel())[0, 1] > 0.99
        )
        assert sample["sbr"][0, 0] == pytest.approx(sbr, rel=1e-5)
        assert sample["photons"][0, 0] == pytest.approx(signal * SYSTEM.cycles, rel=1e-5)


def test_deepsensorfusion(store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The loader draws photons of its own from pulse, signal and background; dark counts lie in its working folder."""
    listed = export(store, tmp_path / "set", layout="deepsensorfusion", fill=True).listed
    monkeypatch.chdir(tmp_path / "set")
    dark = np.asarray(scipy.io.loadmat("simulated_data/dark_img.mat")["dark_img"]).reshape([50, 64])
    dark = np.transpose(np.tile(np.mean(dark[:, 0:64]), [64, 1]))
    (intensity,) = listed.read_text().split()
    contents = scipy.io.loadmat(
        intensity.replace("processed", "spad").replace("intensity", "spad").replace(".mat", "_p2.mat")
    )
    bins = contents["bin"].astype(np.float32).reshape([64, 64]) - 1
    signal, ambient = contents["signal_ppp"].reshape([64, 64]), contents["ambient_ppp"].reshape([64, 64]) + dark / 1024
    rates = np.zeros((64, 64, 1024))
    rates[:, :, :16] = contents["pulse"].reshape([64, 64, 16]) * signal[:, :, None]
    rates += ambient[:, :, None]
    rates *= np.minimum(1, 1 / (1024 * ambient))[:, :, None]  # its optimal filtering
    for y, x in np.ndindex(64, 64):
        rates[y, x] = np.roll(rates[y, x], int(bins[y, x]) - 6)
    arrived = np.exp(-np.concatenate([np.zeros((64, 64, 1)), np.cumsum(rates, -1)], -1))  # none before the bin
    spad = np.random.default_rng(1).binomial(500, (1 - np.exp(-rates)) * arrived[..., :-1])
    brightest = signal > np.median(signal)
    off = np.abs(spad.argmax(-1) - bins)[brightest]
    assert np.mean(off <= 3) > 0.95
    assert np.abs(rates.argmax(-1) - bins).max() <= 1
    assert signal.mean() / (1024 * ambient.mean()) == pytest.approx(LEVELS[1][1], rel=1e-5)


def test_gutierrez(tmp_path: Path) -> None:
    """The response lies where the paths of all scenes part; with one scene the loader takes a pulse of its own."""
    store = made(tmp_path / "set.zarr", 64, SYSTEM, scenes=2)
    listed = export(store, tmp_path / "set", layout="gutierrez").listed
    files = [name for name in listed.read_text().split() if "_p2" in name.rpartition("/")[2]]
    (psf,) = glob(f"{dirname(commonprefix(files))}/PSF_used_for_simulation*.mat")  # noqa: RUF071  (its step)
    pulse = scipy.io.loadmat(psf)["psf"].mean(axis=-1)
    assert pulse.sum() == pytest.approx(1.0, abs=1e-5)
    opened = open_dataset(store)
    name, _ = files
    contents = scipy.io.loadmat(name)
    rows, columns, number = contents["rates"].shape
    assert contents["bin_size"].squeeze() * 1e12 == pytest.approx(1e3 * SYSTEM.bin_ns)
    rates = np.transpose(contents["rates"].astype(np.float32)[np.newaxis], (0, 3, 1, 2))
    rates = rates / (np.sum(rates, axis=-3, keepdims=True) + 1e-8)
    spad = dense(name, columns, rows, number)
    counts = np.asarray(opened.histogram[1, 0])
    np.testing.assert_array_equal(spad[0].transpose(1, 2, 0), counts)
    bins = (contents["bin"].astype(np.float32)[np.newaxis] - 1) / number  # its normalize_matlab_depth_bins
    depth = np.asarray(opened.maps["depth"][1])
    known = np.isfinite(depth) & (depth > 0)
    assert np.abs((bins[0] * number + 0.5) * SYSTEM.bin_ns * 0.149896229 - depth)[known].max() < 0.02
    assert np.abs(rates[0].argmax(0) - bins[0] * number)[known].max() <= 1
    argmax = np.asarray(contents["est_range_bins_argmax"]) - 1
    np.testing.assert_array_equal(argmax, counts.argmax(-1))
    assert contents["mean_signal_photons"].astype(np.int32)[0, 0] == LEVELS[1][0] * SYSTEM.cycles
    assert contents["mean_background_photons"].astype(np.int32)[0, 0] == LEVELS[1][0] / LEVELS[1][1] * SYSTEM.cycles
    assert contents["SBR"].astype(np.float32)[0, 0] == pytest.approx(LEVELS[1][1], rel=1e-5)
    matched = np.asarray(contents["est_range_bins_lmf"]) - 1  # by the programs that compare with its baselines
    assert np.mean(np.abs(matched - bins[0] * number)[known] <= 3) > 0.9


def test_sun(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """512 x 512 pixels, as SPADnet's loader has them."""
    few = SYSTEM.replace(bins=32, period_ns=64.0, pulse=ml.GaussianPulse(sigma_ns=2.0), cycles=200)
    store = made(tmp_path / "set.zarr", 512, few)
    listed = export(store, tmp_path / "files", layout="sun").listed
    monkeypatch.chdir(tmp_path / "files")
    blacklist = Path("blacklist.txt").read_text().split()
    opened = open_dataset(store)
    height, width = opened.histogram.shape[2:4]
    if (height, width) != (512, 512):
        pytest.fail(f"{height} x {width}")
    files = []
    for name in listed.read_text().split():
        level = int(re.search(r"nl\d+.mat", name).group().replace("nl", "").replace(".mat", ""))  # type: ignore[union-attr]
        if name.replace(f"_nl{level}", "") not in blacklist and level == 2:
            files.append("spad_nyuv2/" + name)
    (file,) = files
    contents = scipy.io.loadmat(file)
    np.testing.assert_array_equal(dense(file, 512, 512, -1)[0].transpose(1, 2, 0), opened.histogram[1, 0])
    depth = contents["depth"].astype(np.float32).reshape([512, 512])
    np.testing.assert_allclose(depth, np.nan_to_num(opened.maps["depth"][1]), rtol=1e-6)
    assert contents["intensity"].astype(np.float32).reshape([1, 512, 512]).max() <= 1.0
    picture = file.replace("spad_nyuv2/", "").replace("_nl2.mat", "").replace("spad_", "")
    truth = np.asarray(Image.open(f"mono_nyuv2/{picture}_truth.png")).astype(np.float64) / 25.5
    assert np.asarray(Image.open(f"mono_nyuv2/{picture}_pred.png")).shape == (512, 512)
    mask = ~((truth >= 10.0) | (truth <= 0.0))
    assert np.abs(truth - depth)[mask].max() <= 0.5 / 25.5 + 1e-6
    assert contents["mean_signal_photons"].astype(np.float32)[0, 0] == pytest.approx(
        LEVELS[1][0] * few.cycles, rel=1e-5
    )
    assert contents["SBR"].astype(np.float32)[0, 0] == pytest.approx(LEVELS[1][1], rel=1e-5)
