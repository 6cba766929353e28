"""The ray-caster against analytic geometry, and the built-in room."""

import math

import numpy as np
import pytest

from mars_lidar.scene.rooms import Box, Camera, Sphere, cast
from mars_lidar.scene.scene import Scene


def white(u, v):
    return np.ones_like(u)


def directions(size, field_of_view_deg=60.0):
    height, width = size
    focal = 0.5 * max(size) / math.tan(math.radians(field_of_view_deg) / 2)
    x = (np.arange(width) - (width - 1) / 2) / focal
    y = ((height - 1) / 2 - np.arange(height)) / focal
    d = np.stack(np.broadcast_arrays(x[None, :], y[:, None], 1.0))
    return d / np.linalg.norm(d, axis=0)


def test_wall_range_and_lambert_cosine():
    d = directions((9, 15))
    wall = Box((0.0, 0.0, 6.0), (50.0, 50.0, 1.0), (white,) * 6)
    depth, light = cast([wall], Camera((0.0, 0.0, 0.0)), (9, 15))
    np.testing.assert_allclose(depth, 5.0 / d[2], rtol=1e-13)  # the range along the ray, not z
    # Neighbours are close on a wall seen so: one ray each, so the cosine is that of the centre.
    even = np.abs(light - d[2]) < 1e-13
    assert even.mean() > 0.5
    np.testing.assert_allclose(light, d[2], atol=2e-3)  # the rest: mean over the pixel


def test_sphere_range_and_cosine():
    size = (33, 33)
    d = directions(size)
    depth, _ = cast([Sphere((0.0, 0.0, 4.0), 1.0, white)], Camera((0.0, 0.0, 0.0)), size)
    b = 4.0 * d[2]
    hit = b**2 > 15.0
    np.testing.assert_array_equal(np.isfinite(depth), hit)
    root = np.sqrt(np.where(hit, b**2 - 15.0, 0.0))
    np.testing.assert_allclose(depth[hit], (b - root)[hit], rtol=1e-12)
    narrow = Camera((0.0, 0.0, 0.0), field_of_view_deg=1e-3)
    _, middle = cast([Sphere((0.0, 0.0, 4.0), 1.0, white)], narrow, (1, 1))
    assert middle[0, 0] == pytest.approx(1.0, abs=1e-9)


def test_turned_box_shows_its_edge():
    # A cube turned by 45 degrees: the nearest point is the vertical edge, sqrt(2) before its centre.
    cube = Box((0.0, 0.0, 5.0), (1.0, 1.0, 1.0), (white,) * 6, yaw_deg=45.0)
    depth, light = cast([cube], Camera((0.0, 0.0, 0.0), field_of_view_deg=10.0), (1, 101))
    middle = 5.0 - math.sqrt(2.0)
    assert depth[0, 50] == pytest.approx(middle, rel=1e-12)
    assert depth.argmin() == 50
    x = directions((1, 101), 10.0)[0, 0] / directions((1, 101), 10.0)[2, 0]
    z = middle / (1.0 - np.abs(x))  # |x| = z - middle on the two faces
    np.testing.assert_allclose(depth[0], np.hypot(z, z * x), rtol=1e-12)
    np.testing.assert_allclose(light[0, 50], math.cos(math.pi / 4), atol=0.01)


def test_faces_and_texture_coordinates():
    def face(k):
        return lambda u, v: np.full_like(u, (k + 1) / 10)

    inside = Box((0.0, 0.0, 0.0), (2.0, 3.0, 4.0), tuple(face(k) for k in range(6)), inside=True)
    looks = {0: (-90.0, 0.0), 1: (90.0, 0.0), 2: (0.0, -90.0), 3: (0.0, 90.0), 4: (180.0, 0.0), 5: (0.0, 0.0)}
    for k, (yaw, pitch) in looks.items():
        depth, light = cast([inside], Camera((0.0, 0.0, 0.0), yaw, pitch, 0.01), (1, 1))
        assert depth[0, 0] == pytest.approx((2.0, 3.0, 4.0)[k // 2], rel=1e-12)
        assert light[0, 0] == pytest.approx((k + 1) / 10, rel=1e-6)
    slope = (white,) * 4 + (lambda u, v: 0.5 + 0.25 * u + 0.125 * v, white)
    front = Box((0.0, 0.0, 5.0), (1.0, 1.0, 1.0), slope)
    _, light = cast([front], Camera((0.5, -0.25, 0.0), field_of_view_deg=0.01), (1, 1))
    assert light[0, 0] == pytest.approx(0.5 + 0.125 - 0.03125, rel=1e-4)


def test_the_nearest_surface_wins_whatever_the_order():
    ball = Sphere((0.0, 0.0, 3.0), 0.5, white)
    wall = Box((0.0, 0.0, 5.0), (9.0, 9.0, 0.5), (lambda u, v: np.full_like(u, 0.25),) * 6)
    camera = Camera((0.0, 0.0, 0.0))
    first, two = cast([ball, wall], camera, (20, 20)), cast([wall, ball], camera, (20, 20))
    for a, b in zip(first, two, strict=True):
        np.testing.assert_array_equal(a, b)
    assert first[0].min() == pytest.approx(2.5, abs=0.02)


def test_what_is_behind_the_camera_is_not_seen():
    things = [Sphere((0.0, 0.0, -3.0), 0.5, white), Box((0.0, 0.0, -6.0), (1.0, 1.0, 1.0), (white,) * 6)]
    depth, light = cast(things, Camera((0.0, 0.0, 0.0)), (8, 8))
    assert np.isinf(depth).all()
    assert (light == 0.0).all()


def test_edges_of_the_image_are_smoothed_but_depth_is_not():
    near = Box((0.0, 0.0, 2.0), (0.5, 0.5, 0.1), (white,) * 6, yaw_deg=0.0)
    wall = Box((0.0, 0.0, 5.0), (9.0, 9.0, 0.5), (lambda u, v: np.zeros_like(u),) * 6)
    depth, light = cast([near, wall], Camera((0.03, 0.02, 0.0)), (31, 31))
    d = directions((31, 31))
    both = np.stack((1.9 / d[2], 4.5 / d[2]))
    assert np.abs(depth - both).min(0).max() < 1e-12  # one surface or the other, never between
    cosine = light / d[2]
    assert ((cosine > 0.15) & (cosine < 0.85)).sum() > 10  # part covered


# --- the room ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(1, 1), (1, 200), (200, 1), (2, 3), (90, 160), (128, 128)])
@pytest.mark.parametrize("seed", [0, 1])
def test_room_at_any_size(size, seed):
    room = Scene.example("room", size=size, seed=seed)
    assert room.shape == size
    assert room.valid.all()
    assert room.depth_m.min() > 2.3
    assert room.depth_m.max() < 9.0
    assert room.reflectivity.min() >= 0.0
    assert room.reflectivity.max() <= 1.0


@pytest.mark.parametrize("seed", range(12))
def test_every_seed_gives_a_scene_with_depth_and_contrast(seed):
    room = Scene.example(size=48, seed=seed)
    assert room.depth_m.min() < 3.0
    assert room.depth_m.max() > 8.0
    assert room.reflectivity.std() > 0.1
    assert 0.2 < room.reflectivity.mean() < 0.5
    steps = np.abs(np.diff(room.depth_m, axis=1)) > 0.5
    assert steps.sum() > 60  # outlines


def test_same_seed_same_room_other_seed_other_room():
    a, b, c = (Scene.example(size=32, seed=seed) for seed in (5, 5, 6))
    np.testing.assert_array_equal(a.depth_m, b.depth_m)
    np.testing.assert_array_equal(a.reflectivity, b.reflectivity)
    assert (a.depth_m != c.depth_m).mean() > 0.05
    assert (a.reflectivity != c.reflectivity).mean() > 0.9


def test_room_is_the_same_at_every_size():
    # Threefold size: the middle of every third pixel is the ray of the small image.
    small, large = Scene.example(size=(20, 31)), Scene.example(size=(60, 93))
    np.testing.assert_allclose(large.depth_m[1::3, 1::3], small.depth_m, rtol=1e-12)
    mean = large.reflectivity.reshape(20, 3, 31, 3).mean((1, 3))
    assert np.sqrt(np.mean((mean - small.reflectivity) ** 2)) < 0.05


def test_room_does_not_touch_the_global_random_state():
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    Scene.example(size=8)
    np.testing.assert_array_equal(np.random.get_state()[1], before)  # noqa: NPY002
