"""RGB-D files: values, units, gaps, and what is said of bad files."""

import struct
from pathlib import Path

import h5py
import numpy as np
import pytest
from harness import refused
from harness.files import write_h5
from PIL import Image
from store_cases import png

from mars_lidar import io
from mars_lidar.io.pixels import read_pfm
from mars_lidar.io.rgbd import read_layers, read_rgbd
from mars_lidar.scene.scene import Scene
from tests.harness.command import fails, ok

SHARED = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "rgbd"
NAN, INF = np.nan, np.inf

needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason=f"real RGB-D inputs are absent: {SHARED}")


def srgb(value):
    return value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4


@pytest.fixture
def millimetres() -> np.ndarray:
    return np.array([[0, 1000, 1500], [65535, 2500, 1]], dtype=np.uint16)


METRES = [[NAN, 1.0, 1.5], [65.535, 2.5, 0.001]]


# --- depth -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".png", ".tiff"])
def test_16_bit_depth_is_millimetres_and_zero_is_no_return(tmp_path, millimetres, suffix):
    depth, reflectivity, background = read_rgbd(png(tmp_path / f"d{suffix}", millimetres))
    np.testing.assert_allclose(depth, METRES, rtol=1e-15)
    assert (reflectivity == 1.0).all()
    assert background is None


def test_other_units(tmp_path, millimetres):
    depth, _, _ = read_rgbd(png(tmp_path / "d.png", millimetres), depth_unit_m=1 / 5000)
    np.testing.assert_allclose(depth, np.array(METRES) / 5, rtol=1e-14)
    np.save(tmp_path / "d.npy", millimetres)
    depth, _, _ = read_rgbd(tmp_path / "d.npy", depth_unit_m=1e-3)
    np.testing.assert_allclose(depth, METRES, rtol=1e-15)


def test_npy_depth_is_metres_and_zero_nan_inf_are_no_return(tmp_path):
    np.save(tmp_path / "d.npy", np.array([[0.0, NAN, np.inf, 2.5]], dtype=np.float32))
    depth, _, _ = read_rgbd(str(tmp_path / "d.npy"))
    np.testing.assert_array_equal(depth, [[NAN, NAN, NAN, 2.5]])


def test_npz(tmp_path):
    depth, share, light = np.full((2, 2), 3.0), np.full((2, 2), 0.25), np.array([[1.0, 2.0], [0.0, 4.0]])
    np.savez(tmp_path / "s.npz", depth=depth, reflectivity=share, background=light)
    scene = Scene.from_rgbd(tmp_path / "s.npz")
    np.testing.assert_array_equal(scene.depth_m, depth)
    np.testing.assert_array_equal(scene.reflectivity, share)
    np.testing.assert_array_equal(scene.background, light)
    np.savez(tmp_path / "i.npz", depth=depth, image=np.full((2, 2, 3), 188, dtype=np.uint8))
    np.testing.assert_allclose(Scene.from_rgbd(tmp_path / "i.npz").reflectivity, srgb(188 / 255), rtol=1e-14)
    np.savez(tmp_path / "d.npz", depth=depth)
    assert (Scene.from_rgbd(tmp_path / "d.npz").reflectivity == 1.0).all()


def test_focal_length_turns_depth_into_range(tmp_path):
    np.save(tmp_path / "d.npy", np.full((3, 5), 2.0))
    depth, _, _ = read_rgbd(tmp_path / "d.npy", focal_px=4.0)
    assert depth[1, 2] == 2.0
    assert depth[1, 4] == pytest.approx(2.0 * np.sqrt(1 + 4 / 16), rel=1e-15)
    assert depth[0, 0] == pytest.approx(2.0 * np.sqrt(1 + (4 + 1) / 16), rel=1e-15)
    np.testing.assert_allclose(depth, depth[::-1, ::-1], rtol=1e-15)


# --- reflectivity ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("pixel", "expected"),
    [
        ((255, 255, 255), 1.0),
        ((0, 0, 0), 0.0),
        ((10, 10, 10), 10 / 255 / 12.92),
        ((255, 0, 0), 0.2126),
        ((0, 255, 0), 0.7152),
        ((0, 0, 255), 0.0722),
        ((200, 100, 50), 0.2126 * srgb(200 / 255) + 0.7152 * srgb(100 / 255) + 0.0722 * srgb(50 / 255)),
    ],
)
def test_reflectivity_is_linear_luminance(tmp_path, pixel, expected):
    depth = png(tmp_path / "d.png", np.full((1, 1), 1000, dtype=np.uint16))
    for name, colour in (("rgb.png", pixel), ("rgba.png", (*pixel, 7))):
        image = png(tmp_path / name, np.array([[colour]], dtype=np.uint8))
        assert read_rgbd(depth, image)[1][0, 0] == pytest.approx(expected, abs=1e-15, rel=1e-13)


def test_grey_and_palette_images(tmp_path):
    depth = png(tmp_path / "d.png", np.full((1, 2), 1000, dtype=np.uint16))
    eight = png(tmp_path / "8.png", np.array([[0, 128]], dtype=np.uint8))
    sixteen = png(tmp_path / "16.png", np.array([[0, 128 * 257]], dtype=np.uint16))
    palette = Image.new("P", (2, 1))
    palette.putpalette([255, 0, 0, 0, 255, 0])
    palette.putdata([1, 0])
    palette.save(tmp_path / "p.png")
    grey = [[0.0, srgb(128 / 255)]]
    for image, expected in ((eight, grey), (sixteen, grey), (tmp_path / "p.png", [[0.7152, 0.2126]])):
        np.testing.assert_allclose(read_rgbd(depth, image)[1], expected, rtol=1e-14)


def test_npy_reflectivity_is_linear_and_overrides_the_archive(tmp_path):
    np.savez(tmp_path / "s.npz", depth=np.ones((1, 2)), reflectivity=np.zeros((1, 2)))
    np.save(tmp_path / "r.npy", np.array([[0.125, 0.5]], dtype=np.float32))
    assert read_rgbd(tmp_path / "s.npz", tmp_path / "r.npy")[1].tolist() == [[0.125, 0.5]]
    np.save(tmp_path / "i.npy", np.array([[0, 255]], dtype=np.uint8))
    assert read_rgbd(tmp_path / "s.npz", tmp_path / "i.npy")[1].tolist() == [[0.0, 1.0]]


def test_size_takes_nearest_depth_and_mean_light(tmp_path):
    depth = png(tmp_path / "d.png", np.array([[1000, 1000, 9000, 0]] * 2, dtype=np.uint16))
    image = np.array([[0, 255, 255, 255], [255, 0, 255, 255]], dtype=np.uint8)
    scene = Scene.from_rgbd(depth, png(tmp_path / "i.png", image), size=(1, 2))
    np.testing.assert_array_equal(scene.depth_m, [[1.0, NAN]])
    np.testing.assert_allclose(scene.reflectivity, [[0.5, 1.0]], rtol=1e-15)  # linear light, not grey levels
    assert Scene.from_rgbd(depth, size=2).shape == (1, 2)


# --- Middlebury --------------------------------------------------------------------------------------------


def middlebury(folder: Path, dmin: str = "200\n") -> Path:
    folder.mkdir(exist_ok=True)
    png(folder / "disp1.png", np.array([[0, 100, 174]], dtype=np.uint8))
    png(folder / "view1.png", np.array([[[0, 0, 0], [255, 255, 255], [0, 255, 0]]], dtype=np.uint8))
    (folder / "dmin.txt").write_text(dmin)
    return folder


def test_middlebury_folder(tmp_path):
    scene = Scene.from_rgbd(middlebury(tmp_path / "a"))
    np.testing.assert_allclose(scene.depth_m, [[NAN, 3740 * 0.16 / 300, 1.6]], rtol=1e-14)
    np.testing.assert_allclose(scene.reflectivity, [[0.0, 1.0, 0.7152]], atol=1e-15)
    other = png(tmp_path / "other.png", np.full((1, 3), 255, dtype=np.uint8))
    assert (Scene.from_rgbd(tmp_path / "a", other).reflectivity == 1.0).all()


@pytest.mark.parametrize("name", ["disp1.png", "view1.png", "dmin.txt", "disp0.pfm", "im0.png", "calib.txt"])
def test_middlebury_folder_with_a_file_missing(tmp_path, name):
    old = name in ("disp1.png", "view1.png", "dmin.txt")
    folder = middlebury(tmp_path / "a") if old else middlebury_2014(tmp_path / "a")
    (folder / name).unlink()
    refused(rf"{name} not found.*Middlebury" + " 2014/2021" * (not old), read_rgbd, folder)


@pytest.mark.parametrize("text", ["", "two hundred", "nan", "-3", "1 2"])
def test_bad_dmin(tmp_path, text):
    with pytest.raises(ValueError, match=r"dmin.txt: must hold one number >= 0"):
        read_rgbd(middlebury(tmp_path / "a", text))


def test_depth_unit_does_not_apply_to_middlebury(tmp_path):
    with pytest.raises(ValueError, match="depth_unit_m does not apply"):
        read_rgbd(middlebury(tmp_path / "a"), depth_unit_m=0.001)


# --- bad files: the message names the file and the reason --------------------------------------------------


def scene_refused(message: str, *paths: Path, **options):
    return refused(message, Scene.from_rgbd, *paths, **options)


def test_missing_files(tmp_path, millimetres):
    assert str(tmp_path / "no.png") in scene_refused("no such file", tmp_path / "no.png")
    depth = png(tmp_path / "d.png", millimetres)
    assert str(tmp_path / "no.jpg") in scene_refused("no such file", depth, tmp_path / "no.jpg")


def test_truncated_image(tmp_path):
    whole = png(tmp_path / "d.png", np.random.default_rng(0).integers(1, 60000, (64, 64)).astype(np.uint16))
    (tmp_path / "cut.png").write_bytes(whole.read_bytes()[:3000])
    scene_refused(r"cut\.png: cannot be read", tmp_path / "cut.png")


def test_pickles_are_not_loaded(tmp_path):
    np.save(tmp_path / "d.npy", np.array([[None]], dtype=object), allow_pickle=True)
    scene_refused(r"d\.npy: cannot be read", tmp_path / "d.npy")


@pytest.mark.parametrize(
    ("name", "array", "message"),
    [
        ("8.png", np.ones((2, 2), np.uint8), "16-bit integers in one channel.*uint8"),
        ("rgb.png", np.ones((2, 2, 3), np.uint8), "16-bit integers in one channel"),
        ("d.jpg", np.ones((4, 4), np.uint8), r"d\.jpg: depth must be a \.png"),
        ("i.npy", np.ones((2, 2), np.uint16), r"i\.npy: depth is uint16.*depth_unit_m"),
        ("n.npy", np.array([[1.0, -2.0]]), r"n\.npy: depth must not be negative, got -2 m"),
        ("3.npy", np.ones((2, 2, 2)), r"3\.npy: depth must be real numbers \(H, W\), got shape \(2, 2, 2\)"),
        ("e.npy", np.ones((0, 2)), r"e\.npy: depth must be real numbers"),
        ("0.npy", np.zeros((2, 2)), r"0\.npy: no pixel has a depth"),
    ],
)
def test_depth_of_the_wrong_kind(tmp_path, name, array, message):
    (np.save if name.endswith(".npy") else png)(tmp_path / name, array)
    scene_refused(message, tmp_path / name)


DEPTH = np.ones((2, 2))


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"z": DEPTH}, "must hold an array 'depth', got z"),
        ({"depth": DEPTH, "reflectivity": DEPTH, "image": DEPTH}, "one of 'reflectivity' and 'image'"),
        ({"depth": DEPTH, "reflectivity": 2 * DEPTH}, r"reflectivity must lie in \[0, 1\], got 2 to 2"),
        ({"depth": DEPTH, "reflectivity": np.ones((3, 2))}, "size of depth, 2 x 2, got 3 x 2"),
        ({"depth": DEPTH, "background": -DEPTH}, "background must be finite and >= 0"),
        ({"depth": DEPTH, "image": np.full((2, 2), 7.0)}, r"floats must lie in \[0, 1\]"),
        ({"depth": DEPTH, "image": np.ones((2, 2), np.int32)}, "8 or 16 bits per channel"),
        ({"depth": DEPTH, "image": np.ones((2, 2, 5))}, "grey or RGB"),
    ],
)
def test_bad_archives(tmp_path, arrays, message):
    np.savez(tmp_path / "a.npz", **arrays)
    assert scene_refused(message, tmp_path / "a.npz").startswith(str(tmp_path / "a.npz"))


def test_sizes_must_agree(tmp_path, millimetres):
    depth = png(tmp_path / "d.png", millimetres)
    image = png(tmp_path / "i.png", np.ones((3, 2), dtype=np.uint8))
    output = scene_refused("must have the size of the depth, 2 x 3", depth, image)
    assert output.startswith(str(image))
    assert "got 3 x 2" in output


@pytest.mark.parametrize("option", ["depth_unit_m", "focal_px", "max_depth_m", "size"])
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan])
def test_bad_options(tmp_path, millimetres, option, value):
    names = [png(tmp_path / "d.png", millimetres)] + [tmp_path / "absent.png"] * (option == "size")  # before reading
    for path in names:
        scene_refused(f"{option} must be", path, error=(ValueError, TypeError), **{option: value})


# --- real inputs -------------------------------------------------------------------------------------------


@needs_shared
def test_nyu_frame():
    paths = SHARED / "nyuv2_00001_depth.png", SHARED / "nyuv2_00001_colors.png"
    scene = Scene.from_rgbd(*paths)
    assert scene.shape == (480, 640)
    assert scene.valid.all()
    assert (scene.depth_m.min(), scene.depth_m.max()) == (pytest.approx(1.123), pytest.approx(2.609))
    assert 0.1 < scene.reflectivity.mean() < 0.6
    small = Scene.from_rgbd(*paths, size=128)
    assert small.shape == (96, 128)
    assert small.reflectivity.mean() == pytest.approx(scene.reflectivity.mean(), rel=1e-12)


@needs_shared
def test_middlebury_art():
    scene = Scene.from_rgbd(SHARED / "middlebury_art")
    assert scene.shape == (555, 695)
    assert (~scene.valid).sum() == 886
    z = scene.depth_m[scene.valid]
    assert (z.min(), z.max()) == (pytest.approx(598.4 / 424), pytest.approx(598.4 / 273))
    # The rim of the paper cup spans columns 534 to 621 at half size, a focal length of 1870 px.
    width = (621 - 534) / 1870 * scene.depth_m[425, 575]
    assert 0.06 < width < 0.09


def test_depths_beyond_the_largest_are_no_return(tmp_path):
    """In a file, through the command, in a manifest; of perpendicular depth where there is a focal length."""
    depth = np.array([[1.0, 5.0, 100.0], [2.0, 6.0, 1000.0]])
    path = tmp_path / "d.npy"
    np.save(path, depth)
    near, _, _ = read_rgbd(path, max_depth_m=5.0)
    assert np.array_equal(np.isnan(near), depth > 5.0)
    assert np.array_equal(np.isnan(read_rgbd(path, max_depth_m=5.0, focal_px=1.0)[0]), depth > 5.0)
    refused("no pixel has a depth", read_rgbd, path, max_depth_m=0.5)
    (tmp_path / "manifest.csv").write_text("depth,max_depth_m\nd.npy,10\n")
    (listed,), problems = io.scan(tmp_path)
    assert problems == []
    assert np.array_equal(np.isnan(listed.load().depth_m), depth > 10.0)
    np.savez(tmp_path / "layers.npz", depth=np.stack([depth, depth + 1.0]), reflectivity=np.ones((2, 2, 3)))
    layers = read_layers(tmp_path / "layers.npz", max_depth_m=5.5).layers
    assert np.array_equal(np.isnan(layers[1].depth_m), depth + 1.0 > 5.5)
    out = tmp_path / "out.npz"
    near = ("--max-depth-m", "5", "--cycles", "100", "-o")
    ok("simulate", "--depth", path, "--no-picture", *near, out)
    assert np.array_equal(np.isnan(io.load(out).depth_m), depth > 5.0)
    ok("generate", path, *near, tmp_path / "set.zarr")


@pytest.mark.parametrize("suffix", [".png", ".tif", ".npy"])
def test_a_colour_image_is_no_depth(tmp_path, suffix):
    colours = np.random.default_rng(1).integers(0, 255, (4, 5, 3)).astype(np.uint8)
    (np.save if suffix == ".npy" else png)(tmp_path / f"colour{suffix}", colours)
    refused(rf"colour\{suffix}: .*(4, 5, 3)", read_rgbd, tmp_path / f"colour{suffix}", depth_unit_m=1.0)


# NYUv2, Middlebury 2014, PFM and EXR scenes, and whole folders of scenes.


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
    fails("index selects", *arguments, "-o", tmp_path / "b.npz")


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


def middlebury_2014(folder: Path, calib: str = CALIB) -> Path:
    folder.mkdir(parents=True)
    pfm(folder / "disp0.pfm", [[INF, 100.0, 200.5]], scale=1 / 255)
    png(folder / "im0.png", np.array([[[0, 0, 0], [255, 255, 255], [0, 255, 0]]], np.uint8))
    (folder / "calib.txt").write_text(calib)
    return folder


def test_middlebury_2014(tmp_path):
    scene = Scene.from_rgbd(middlebury_2014(tmp_path / "a"))
    want = [[NAN, 0.193001 * 4000.5 / 231.111, 0.193001 * 4000.5 / 331.611]]
    np.testing.assert_allclose(scene.depth_m, want, rtol=1e-12)
    np.testing.assert_allclose(scene.reflectivity, [[0.0, 1.0, 0.7152]], atol=1e-15)


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
    refused(rf"calib\.txt: {message}", read_rgbd, middlebury_2014(tmp_path / "a", CALIB.replace(old, new)))


# --- folders -----------------------------------------------------------------------------------------------


def test_a_folder_of_everything(tmp_path):
    millimetres = np.full((2, 2), 1500, np.uint16)
    grey = np.full((2, 2), 255, np.uint8)
    middlebury_2014(tmp_path / "b_stereo")
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
    parts = ("d.npy: depth is uint16", "manifest.csv: line 6", "manifest.csv: line 7", "no such")
    for part, line in zip(parts, sorted(map(str, problems)), strict=True):
        assert part in line
    (tmp_path / "other.csv").write_text("depth,colour\nd.npy,x.png\n")
    refused(r"other\.csv: columns must be depth and any of image", io.scan, tmp_path, manifest=tmp_path / "other.csv")
    refused("no such file", io.scan, tmp_path, manifest=tmp_path / "none.csv")
    refused("no such folder", io.scan, tmp_path / "none")
    refused("image must be two texts that go with a pattern", io.scan, tmp_path, image=("a", "b"))


@needs_shared
def test_real_data_sets_are_recognised():
    scenes, problems = io.scan(SHARED)
    assert [s.depth.name for s in scenes] == ["middlebury_art", "nyuv2_00001_depth.png"]
    assert scenes[1].image is not None
    assert scenes[1].image.name == "nyuv2_00001_colors.png"
    assert [p.path.name for p in problems] == ["nyuv2_home_office_spad_0161_p1.mat"]
