"""The built-in scene "random": another room, other things in it and another view for every seed. Sizes in metres.

Made to be cheap: networks are trained on thousands of these. The scene "room" has the finer textures.
"""

from __future__ import annotations

import math

import numpy as np

from mars_lidar._base.types import FloatArray
from mars_lidar.scene.raycast import Box, Camera, Sphere, Texture, cast


def random_scene(size: tuple[int, int], seed: int) -> tuple[FloatArray, FloatArray]:
    """Depth (range along the ray, m) and reflectivity (Lambert cosine included), each (H, W).

    A room 2 to 10 m wide, 2.2 to 4 m high and 2.5 to 14 m long; 0 to 2 partitions; 2 to 10 boxes and spheres of 0.1
    to 1 m (log-uniform), a third of them in the air; a camera near the front wall that looks up to 20 degrees aside.
    """
    rng = np.random.default_rng(seed)
    width, height = rng.uniform(2.0, 10.0), rng.uniform(2.2, 4.0)
    length = math.exp(rng.uniform(math.log(2.5), math.log(14.0)))
    shell = Box(
        (0.0, 0.5 * height, 0.5 * length),
        (0.5 * width, 0.5 * height, 0.5 * length),
        tuple(_texture(rng) for _ in range(6)),
        inside=True,
    )
    objects: list[Box | Sphere] = [shell]
    for _ in range(int(rng.integers(3))):  # from floor to ceiling, from one side
        half = 0.5 * width * rng.uniform(0.15, 0.6)
        x = float(rng.choice((-1.0, 1.0))) * (0.5 * width - half)
        z = length * rng.uniform(0.45, 0.9)
        objects.append(Box((x, 0.5 * height, z), (half, 0.5 * height, 0.05), (_texture(rng),) * 6))
    for _ in range(int(rng.integers(2, 11))):
        objects.append(_thing(rng, width, height, length))
    camera = Camera(
        position=(width * rng.uniform(-0.2, 0.2), height * rng.uniform(0.3, 0.7), 0.02 * length),
        yaw_deg=rng.uniform(-20.0, 20.0),
        pitch_deg=rng.uniform(-12.0, 8.0),
        field_of_view_deg=rng.uniform(30.0, 75.0),
    )
    return cast(objects, camera, size)


def _thing(rng: np.random.Generator, width: float, height: float, length: float) -> Box | Sphere:
    radius = min(math.exp(rng.uniform(math.log(0.1), 0.0)), 0.4 * height)
    x = rng.uniform(-0.45, 0.45) * width
    z = length * math.sqrt(rng.uniform(0.2**2, 0.95**2))  # more of them where the view is wide
    z = max(z, 0.02 * length + 1.2 * radius + 0.3)  # never round the camera
    floating = rng.uniform() < 1.0 / 3.0
    if rng.uniform() < 0.4:
        y = rng.uniform(radius, height - radius) if floating else radius
        return Sphere((x, y, z), radius, _texture(rng, around=True))
    half = tuple(float(radius * side) for side in rng.uniform(0.25, 0.7, 3))  # inside of the sphere of that radius
    y = rng.uniform(half[1], height - half[1]) if floating else half[1]
    return Box((x, y, z), (half[0], half[1], half[2]), (_texture(rng),) * 6, rng.uniform(-90.0, 90.0))


def _texture(rng: np.random.Generator, around: bool = False) -> Texture:
    """Plain, striped, checked, or cloudy (a few waves); albedo 0.05 to 0.95. `around`: radians, on a sphere."""
    kind, low, high = int(rng.integers(4)), rng.uniform(0.05, 0.95), rng.uniform(0.05, 0.95)
    pitch = rng.integers(2, 9) / (2.0 * math.pi) if around else 1.0 / rng.uniform(0.1, 0.8)
    turn = 0.0 if around else rng.uniform(0.0, math.pi)
    a, b, phase = math.cos(turn) * pitch, math.sin(turn) * pitch, rng.uniform(0.0, 1.0)
    middle, swing = 0.5 * (low + high), 0.5 * (high - low)

    def plain(u: FloatArray, v: FloatArray) -> FloatArray:
        return np.full(u.shape, low)

    def stripes(u: FloatArray, v: FloatArray) -> FloatArray:
        return np.where((a * u + b * v + phase) % 1.0 < 0.5, low, high)

    def checks(u: FloatArray, v: FloatArray) -> FloatArray:
        first, second = (a * u + b * v + phase) % 1.0 < 0.5, (a * v - b * u) % 1.0 < 0.5
        return np.where(first == second, low, high)

    def clouds(u: FloatArray, v: FloatArray) -> FloatArray:
        wave = np.sin(5.0 * (a * u + b * v) + phase) * np.sin(3.7 * (a * v - b * u) + 2.0 * phase)
        return np.asarray(middle + swing * wave)

    return (plain, stripes, checks, clouds)[kind]
