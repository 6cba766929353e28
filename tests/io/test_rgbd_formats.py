"""NYUv2, Middlebury 2014, PFM and EXR scenes, and whole folders of scenes."""

import struct
from pathlib import Path

import h5py
import numpy as np
import pytest
from harness import refused
from harness.files import write_h5
from store_cases import png

from mars_lidar import io
from mars_lidar.io.pixels import read_pfm
from mars_lidar.io.rgbd import read_rgbd
from mars_lidar.scene.scene import Scene
from tests.harness.command import fails, ok

SHARED = Path(__file__).resolve().parents[2].parent / "shared" / "data"
NAN, INF = np.nan, np.inf


def pfm(path: Path, values, order: str = "<", scale: float = 1.0) -> Path:
    values = np.asarray(values, np.float64)
    kind = "PF" if values.ndim == 3 else "Pf"
    head = f"{kind}\n{values.shape[1]} {values.shape[0]}\n{-scale if order == '<' else scale}\n"
    path.write_bytes(head.encode() + values[::-1].astype(f"{order}f4").tobytes())
    return path


# --- PFM ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("scale", [1.0, 1 / 255])
def test_pfm_is_metres_from_the_top_in_either_byte_order(tmp_path, order, scale):
    depth, _, _ = read_rgbd(pfm(tmp_path / "d.pfm", [[1.0, 2.0, INF], [4.0, 0.0, NAN]], order, scale))
    np.testing.assert_array_equal(depth, [[1.0, 2.0, NAN], [4.0, NAN, NAN]])
    depth, _, _ = read_rgbd(tmp_path / "d.pfm", depth_unit_m=1e-3)
    np.testing.assert_allclose(depth[0, :2], [1e-3, 2e-3], rtol=1e-15)


def test_pfm_by_its_bytes(tmp_path):
    """Written by hand, not by this file's helper: bottom row first."""
    (tmp_path / "d.pfm").write_bytes(b"Pf\n2 2\n-1.0\n" + struct.pack("<4f", 3.0, 4.0, 1.0, 2.0))
    assert read_pfm(tmp_path / "d.pfm").tolist() == [[1.0, 2.0], [3.0, 4.0]]
    (tmp_path / "c.pfm").write_bytes(b"PF\n1 1\n1.0\n" + struct.pack(">3f", 1.0, 2.0, 3.0))
    assert read_pfm(tmp_path / "c.pfm").tolist() == [[[1.0, 2.0, 3.0]]]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not a PFM"),
        (b"P5\n2 2\n255\nabcd", "must begin with a line Pf or PF"),
        (b"Pf\n2 two\n-1.0\n" + 16 * b"\0", "width, height and scale are '2 two / -1.0'"),
        (b"Pf\n2 2\n0\n" + 16 * b"\0", "width, height and scale"),
        (b"Pf\n-2 2\n-1\n" + 16 * b"\0", "width, height and scale"),
        (b"Pf\n2 2\n-1.0\n" + 15 * b"\0", "cut short: 15 of 16 bytes"),
    ],
)
def test_bad_pfm(tmp_path, content, message):
    (tmp_path / "d.pfm").write_bytes(content)
    refused(rf"d\.pfm: cannot be read \(.*{message}", read_rgbd, tmp_path / "d.pfm")


def test_a_pfm_of_three_channels_is_no_depth(tmp_path):
    refused(r"d\.pfm: depth must be real numbers \(H, W\)", read_rgbd, pfm(tmp_path / "d.pfm", np.ones((2, 2, 3))))


# --- EXR ---------------------------------------------------------------------------------------------------


def test_exr(tmp_path):
    openexr = pytest.importorskip("OpenEXR", reason="OpenEXR (extra io) is not installed")
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    values = np.array([[1.5, 0.0, INF], [2.5, 3.5, 4.5]], np.float32)
    want = [[1.5, NAN, NAN], [2.5, 3.5, 4.5]]
    other = np.full((2, 3), 9.0, np.float32)
    for channels in ({"Z": values, "R": other, "G": other, "B": other}, {"depth": values}, {"Y": values, "A": other}):
        with openexr.File(header, channels) as file:
            file.write(str(tmp_path / "d.exr"))
        np.testing.assert_array_equal(read_rgbd(tmp_path / "d.exr")[0], want)
    with openexr.File(header, {"U": values, "V": values}) as file:
        file.write(str(tmp_path / "uv.exr"))
    refused(r"uv\.exr: must have a channel of depth", read_rgbd, tmp_path / "uv.exr")
    colours = {name: values + shift for name, shift in (("R", 0), ("G", 1), ("B", 2))}
    with openexr.File(header, colours) as file:
        file.write(str(tmp_path / "image.exr"))
    refused(r"image\.exr: holds colours, not depth: its channels are B, G, R", read_rgbd, tmp_path / "image.exr")
    with openexr.File(header, {f"ViewLayer.Combined.{name}": colour for name, colour in colours.items()}) as file:
        file.write(str(tmp_path / "layers.exr"))
    refused(r"layers\.exr: must have a channel of depth", read_rgbd, tmp_path / "layers.exr")
    whole = (tmp_path / "d.exr").read_bytes()
    for content in (b"", b"garbage", whole[:60], whole[:-20]):
        (tmp_path / "bad.exr").write_bytes(content)
        refused(r"bad\.exr: ", read_rgbd, tmp_path / "bad.exr")


@pytest.mark.parametrize("nothing", [1e10, 65504.0, np.inf])
def test_a_render_of_blender(tmp_path, nothing):
    """A multilayer file: depth among colours, and a background where no surface is."""
    openexr = pytest.importorskip("OpenEXR", reason="OpenEXR (extra io) is not installed")
    depth = np.linspace(1.0, 4.0, 12, dtype=np.float32).reshape(3, 4)
    depth[0, :2] = nothing
    channels = {"ViewLayer.Depth.Z": depth, "ViewLayer.Combined.R": depth, "ViewLayer.Combined.G": depth}
    with openexr.File({"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}, channels) as file:
        file.write(str(tmp_path / "render.exr"))
    result = read_rgbd(tmp_path / "render.exr")[0]
    assert np.isnan(result[0, :2]).all()
    np.testing.assert_array_equal(result[1:], depth[1:].astype(np.float64))


def test_exr_without_the_library(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "OpenEXR", None)
    (tmp_path / "d.exr").write_bytes(b"\x76\x2f\x31\x01")
    with pytest.raises(io.MissingLibraryError, match=r"depth in \.exr needs the library OpenEXR: pip install"):
        read_rgbd(tmp_path / "d.exr")


# --- NYUv2 -------------------------------------------------------------------------------------------------


def nyu(path: Path, frames: int = 3) -> np.ndarray:
    """Two rows, four columns; in HDF5 the axes are MATLAB's, reversed."""
    depth = 1.0 + np.arange(frames * 8, dtype=np.float32).reshape(frames, 2, 4)  # N, H, W
    colours = np.zeros((frames, 2, 4, 3), np.uint8)
    colours[:, 0, 1] = [255, 0, 0]
    colours[:, 1, 3] = 255
    write_h5(path, {"depths": depth.transpose(0, 2, 1), "images": colours.transpose(0, 3, 2, 1)})
    return depth


def test_nyu_frames(tmp_path):
    depth = nyu(tmp_path / "nyu.mat")
    scene = Scene.from_rgbd(tmp_path / "nyu.mat", index=2)
    np.testing.assert_array_equal(scene.depth_m, depth[2])
    np.testing.assert_allclose(scene.reflectivity, [[0, 0.2126, 0, 0], [0, 0, 0, 1]], atol=1e-15)
    for options, message in (
        ({}, "needs index, the frame from 0"),
        ({"index": 3}, r"index must be an integer in \[0, 2\], got 3"),
        ({"index": 0, "depth_unit_m": 1e-3}, "depth_unit_m does not apply to NYUv2"),
    ):
        refused(message, read_rgbd, tmp_path / "nyu.mat", **options)
    np.save(tmp_path / "d.npy", np.ones((2, 2)))
    refused(r"d\.npy: has no frames, got index 0", read_rgbd, tmp_path / "d.npy", index=0)


def test_bad_nyu(tmp_path):
    path = tmp_path / "nyu.mat"
    path.write_bytes(b"MATLAB 5.0 MAT-file")
    refused(r"nyu\.mat: has no frames, got index 0", read_rgbd, path, index=0)
    refused(r"nyu\.mat", read_rgbd, path)
    write_h5(path, {"depths": np.ones((2, 4, 3))})
    refused("must hold 'depths' and 'images' as NYUv2 does, got depths", read_rgbd, path, index=0)
    with h5py.File(path, "a") as file:
        file["images"] = np.ones((2, 3, 3, 4), np.uint8)
    refused(r"depths must be \(N, W, H\) and images \(N, 3, W, H\)", read_rgbd, path, index=0)


def test_the_command_takes_a_frame(tmp_path):
    nyu(tmp_path / "nyu.mat")
    arguments = ["simulate", "--depth", tmp_path / "nyu.mat", "--cycles", "5", "--bins", "16", "--no-picture"]
    ok(*arguments, "--index", 1, "-o", tmp_path / "a.npz")
    with io.load(tmp_path / "a.npz") as cube:
        assert cube.depth_m[0, 0] == 9.0
        assert "frame 1" in cube.recipe.source
    fails("index tells which", *arguments, "-o", tmp_path / "b.npz")


# --- Middlebury 2014 ---------------------------------------------------------------------------------------

CALIB = """cam0=[4000.5 0 1176.728; 0 4000.5 1011.728; 0 0 1]
cam1=[4000.5 0 1307.839; 0 4000.5 1011.728; 0 0 1]
doffs=131.111
baseline=193.001
width=3
height=1
ndisp=280
isint=0
vmin=31
vmax=257
"""


def middlebury(folder: Path, calib: str = CALIB) -> Path:
    folder.mkdir(parents=True)
    pfm(folder / "disp0.pfm", [[INF, 100.0, 200.5]], scale=1 / 255)
    png(folder / "im0.png", np.array([[[0, 0, 0], [255, 255, 255], [0, 255, 0]]], np.uint8))
    (folder / "calib.txt").write_text(calib)
    return folder


def test_middlebury_2014(tmp_path):
    scene = Scene.from_rgbd(middlebury(tmp_path / "a"))
    want = [[NAN, 0.193001 * 4000.5 / 231.111, 0.193001 * 4000.5 / 331.611]]
    np.testing.assert_allclose(scene.depth_m, want, rtol=1e-12)
    np.testing.assert_allclose(scene.reflectivity, [[0.0, 1.0, 0.7152]], atol=1e-15)


@pytest.mark.parametrize("name", ["disp0.pfm", "im0.png", "calib.txt"])
def test_middlebury_2014_with_a_file_missing(tmp_path, name):
    folder = middlebury(tmp_path / "a")
    (folder / name).unlink()
    refused(rf"{name} not found.*Middlebury 2014/2021", read_rgbd, folder)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("baseline=193.001\n", "", "must give baseline"),
        ("doffs=131.111", "doffs=", "doffs must begin with a number, got ''"),
        ("baseline=193.001", "baseline=-1", "baseline must begin with a number > 0, got '-1'"),
        ("cam0=[4000.5", "cam0=[nan", "cam0 must begin with a number > 0"),
    ],
)
def test_bad_calibrations(tmp_path, old, new, message):
    refused(rf"calib\.txt: {message}", read_rgbd, middlebury(tmp_path / "a", CALIB.replace(old, new)))


# --- folders -----------------------------------------------------------------------------------------------


def test_a_folder_of_everything(tmp_path):
    millimetres = np.full((2, 2), 1500, np.uint16)
    grey = np.full((2, 2), 255, np.uint8)
    middlebury(tmp_path / "b_stereo")
    nyu(tmp_path / "nyu.mat")
    png(tmp_path / "0001_depth.png", millimetres)
    png(tmp_path / "0001_colors.png", grey)
    (tmp_path / "0002_depth.png").write_bytes(b"not an image")
    png(tmp_path / "holiday.png", grey)
    for name in ("depth", "rgb"):
        (tmp_path / "seq" / name).mkdir(parents=True)
    png(tmp_path / "seq" / "depth" / "7.png", millimetres)
    png(tmp_path / "seq" / "rgb" / "7.jpg", grey)
    png(tmp_path / "seq" / "depth" / "8.png", millimetres)
    np.savez(tmp_path / "own.npz", depth=np.ones((3, 3)))
    (tmp_path / "wrong.mat").write_bytes(b"MATLAB 5.0")
    recorded = []
    scenes, problems = io.scan(tmp_path, progress=lambda done, total: recorded.append((done, total)))
    assert [(s.depth.relative_to(tmp_path).as_posix(), s.index) for s in scenes] == [
        ("0001_depth.png", None),
        ("b_stereo", None),
        ("nyu.mat", 0),
        ("nyu.mat", 1),
        ("nyu.mat", 2),
        ("own.npz", None),
        ("seq/depth/7.png", None),
        ("seq/depth/8.png", None),
    ]
    images = [None if s.image is None else s.image.relative_to(tmp_path).as_posix() for s in scenes]
    assert images == ["0001_colors.png", None, None, None, None, None, "seq/rgb/7.jpg", None]
    assert sorted(p.path.name for p in problems) == ["0002_depth.png", "wrong.mat"]
    assert all(str(p).startswith(str(p.path)) and "cannot be read" in str(p) for p in problems)
    assert recorded[-1] == (10, 10)  # a .mat may hold one depth map: it is a scene until it is read
    assert scenes[3].load(size=2).shape == (1, 2)
    unchecked, problems = io.scan(tmp_path, check=False)
    assert len(unchecked) == 10
    assert problems == []


def test_by_pattern(tmp_path):
    for k in range(3):
        png(tmp_path / f"{k}-d.png", np.full((2, 2), 1000 * (k + 1), np.uint16))
    for k in range(2):
        png(tmp_path / f"{k}-c.png", np.full((2, 2), 255, np.uint8))
    scenes, problems = io.scan(tmp_path, pattern="*-d.png", image=("-d", "-c"), depth_unit_m=1 / 5000)
    assert [(s.depth.name, s.image.name, s.depth_unit_m) for s in scenes] == [
        ("0-d.png", "0-c.png", 1 / 5000),
        ("1-d.png", "1-c.png", 1 / 5000),
    ]
    assert scenes[1].load().depth_m[0, 0] == pytest.approx(0.4)
    assert [(p.path.name, "2-c.png is missing" in p.reason) for p in problems] == [("2-d.png", True)]
    assert io.scan(tmp_path, pattern="*.tiff") == ([], [])


def test_by_manifest(tmp_path):
    nyu(tmp_path / "nyu.mat")
    np.save(tmp_path / "d.npy", np.full((2, 2), 1500, np.uint16))
    (tmp_path / "manifest.csv").write_text(
        "depth,index,depth_unit_m\nnyu.mat,1,\nd.npy,,0.001\nd.npy,,\nmissing.npy,,\nnyu.mat,one,\n,,\n"
    )
    scenes, problems = io.scan(tmp_path)
    assert [(s.depth.name, s.index, s.depth_unit_m) for s in scenes] == [("nyu.mat", 1, None), ("d.npy", None, 0.001)]
    problem_lines = sorted(str(p) for p in problems)
    assert len(problem_lines) == 4
    for part, line in zip(
        ("d.npy: depth is uint16", "manifest.csv: line 6", "manifest.csv: line 7", "no such"),
        problem_lines,
        strict=True,
    ):
        assert part in line
    (tmp_path / "other.csv").write_text("depth,colour\nd.npy,x.png\n")
    refused(r"other\.csv: columns must be depth and any of image", io.scan, tmp_path, manifest=tmp_path / "other.csv")
    refused("no such file", io.scan, tmp_path, manifest=tmp_path / "none.csv")
    refused("no such folder", io.scan, tmp_path / "none")
    refused("image must be two texts that go with a pattern", io.scan, tmp_path, image=("a", "b"))


@pytest.mark.skipif(not SHARED.is_dir(), reason=f"real inputs are absent: {SHARED}")
def test_real_data_sets_are_recognised():
    scenes, problems = io.scan(SHARED / "rgbd")
    assert [s.depth.name for s in scenes] == ["middlebury_art", "nyuv2_00001_depth.png"]
    assert scenes[1].image is not None
    assert scenes[1].image.name == "nyuv2_00001_colors.png"
    assert [p.path.name for p in problems] == ["nyuv2_home_office_spad_0161_p1.mat"]
