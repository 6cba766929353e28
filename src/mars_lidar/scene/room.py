"""The built-in scene "room": what stands where, and what it is painted with. Seeded, sizes in metres."""

from __future__ import annotations

import numpy as np

from mars_lidar._base.types import FloatArray
from mars_lidar.scene.raycast import Box, Camera, Sphere, Texture, cast

_TABLE = 128  # texels per side of the noise table, a power of two
_WIDTH, _HEIGHT, _LENGTH = 5.2, 2.8, 6.9  # the room: x in +-_WIDTH / 2, y from 0, z from 0
_DOOR = (0.5, 1.5, 2.1)  # the passage behind the back wall: x from, x to, height
_PASSAGE = 1.55  # its length


def room(size: tuple[int, int], seed: int) -> tuple[FloatArray, FloatArray]:
    """Depth (range along the ray, m) and reflectivity (Lambert cosine included), each (H, W)."""
    rng = np.random.default_rng(seed)
    paint = _Paint(rng)
    camera = Camera(position=(0.35, 1.5, 0.0), yaw_deg=-4.0, pitch_deg=-8.5, field_of_view_deg=58.0)
    depth, reflectivity = cast([*_walls(paint), *_furniture(paint, rng)], camera, size)
    return depth, reflectivity


def _walls(paint: _Paint) -> list[Box]:
    """The room, its back wall made of three boxes round a door, and the passage behind."""
    x0, x1, top = _DOOR
    half = 0.5 * _WIDTH
    wall, side, end = paint.plaster(0.62, 0.07), paint.plaster(0.55, 0.06), paint.plaster(0.42, 0.1)
    floor, ceiling = paint.floor(), paint.plaster(0.78, 0.03)
    back = paint.painting(wall, centre=(-0.78, 1.72), half=(0.72, 0.5))
    far = 0.5 * (_LENGTH + _PASSAGE)
    faces = (side, side, floor, ceiling, wall, end)
    shell = Box((0.0, 0.5 * _HEIGHT, far), (half, 0.5 * _HEIGHT, far), faces, inside=True)

    def block(left: float, right: float, low: float) -> Box:
        x, y = 0.5 * (left + right), 0.5 * (low + _HEIGHT)
        size = (right - x, _HEIGHT - y, 0.5 * _PASSAGE)
        return Box((x, y, _LENGTH + size[2]), size, (side, side, side, side, _moved(back, x, y), wall))

    return [shell, block(-half, x0, 0.0), block(x0, x1, top), block(x1, half, 0.0)]


def _moved(texture: Texture, x: float, y: float) -> Texture:
    """The texture in the coordinates of the room, so that it runs on from box to box."""
    return lambda u, v: texture(u + x, v + y)


def _furniture(paint: _Paint, rng: np.random.Generator) -> list[Box | Sphere]:
    def near(middle: float, spread: float) -> float:
        return float(middle + spread * rng.uniform(-1.0, 1.0))

    crate_half = near(0.36, 0.03)
    x, z, turn = near(0.98, 0.1), near(3.95, 0.15), near(24.0, 12.0)
    wood, dark = paint.wood(0.5), paint.wood(0.3)
    crate = Box((x, crate_half, z), (crate_half,) * 3, (paint.crate(crate_half),) * 6, turn)
    small = near(0.19, 0.03)
    parcel = Box(
        (x + near(0.0, 0.08), 2 * crate_half + small, z + near(0.0, 0.06)),
        (small * 1.25, small, small),
        (paint.parcel(small),) * 6,
        near(-18.0, 14.0),
    )
    radius = near(0.48, 0.05)
    ball = Sphere((near(-0.95, 0.12), radius, near(3.75, 0.2)), radius, paint.ball())

    # A table at the back with a globe and a block on it: its thin legs test depth edges.
    tx, tz, top = near(-0.85, 0.1), near(5.75, 0.12), 0.72
    table: list[Box | Sphere] = [Box((tx, top, tz), (0.85, 0.03, 0.42), (dark,) * 6)]
    for sx in (-0.78, 0.78):
        for sz in (-0.35, 0.35):
            middle = 0.5 * (top - 0.03)
            table.append(Box((tx + sx, middle, tz + sz), (0.035, middle, 0.035), (dark,) * 6))
    globe = near(0.17, 0.02)
    table.append(Sphere((tx + near(-0.35, 0.1), top + 0.03 + globe, tz), globe, paint.globe()))
    table.append(Box((tx + near(0.35, 0.1), top + 0.13, tz), (0.2, 0.1, 0.14), (wood,) * 6, near(15.0, 20.0)))

    # A test board on a post: Siemens star, checker and bars.
    bx, bz = near(1.95, 0.04), near(5.3, 0.1)
    chart = (dark,) * 4 + (paint.chart(), dark)
    board = Box((bx, 1.12, bz), (0.52, 0.7, 0.025), chart, near(28.0, 6.0))
    post = Box((bx + 0.02, 0.25, bz + 0.08), (0.04, 0.25, 0.04), (dark,) * 6)
    shelf = Box((-2.43, 1.0, near(4.9, 0.15)), (0.17, 1.0, 0.75), (dark, paint.books()) + (dark,) * 4)
    # A lamp on a thin cord brings something near into the upper half.
    lx, lz, low = near(0.15, 0.25), near(4.6, 0.3), near(2.1, 0.06)
    lamp = Sphere((lx, low, lz), 0.2, paint.lamp())
    cord = Box((lx, 0.5 * (low + _HEIGHT), lz), (0.012, 0.5 * (_HEIGHT - low), 0.012), (dark,) * 6)
    return [crate, parcel, ball, *table, board, post, shelf, lamp, cord]


class _Paint:
    """Textures that share one table of smooth noise."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        # Periodic 1/f noise, zero mean and unit variance: one table serves every surface at its own offset.
        f = np.hypot(np.fft.fftfreq(_TABLE)[:, None], np.fft.rfftfreq(_TABLE)[None, :])
        f[0, 0] = np.inf
        noise = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((_TABLE, _TABLE))) / f**1.2, (_TABLE, _TABLE))
        noise = (noise - noise.mean()) / noise.std()
        self._table = np.pad(noise, (0, 1), mode="wrap").ravel()
        self._tones = rng.uniform(-1.0, 1.0, 1024)

    def _noise(self, u: FloatArray, v: FloatArray) -> FloatArray:
        """Noise at coordinates in texels, bilinear, periodic."""
        i, j = np.floor(u), np.floor(v)
        a, b = u - i, v - j
        row, width = i.astype(np.intp) & (_TABLE - 1), _TABLE + 1
        at = row * width + (j.astype(np.intp) & (_TABLE - 1))
        t = self._table
        low, high = t[at], t[at + width]
        low += b * (t[at + 1] - low)
        high += b * (t[at + (width + 1)] - high)
        value: FloatArray = low + a * (high - low)
        return value

    def _tone(self, i: FloatArray, j: FloatArray) -> FloatArray:
        """A number in [-1, 1] of its own for each cell (i, j)."""
        cell = (i.astype(np.int64) * 7919 + j.astype(np.int64) * 104729) % self._tones.size
        tone: FloatArray = self._tones[cell]
        return tone

    def _offset(self) -> tuple[float, float]:
        a, b = self._rng.uniform(0.0, _TABLE, 2)
        return float(a), float(b)

    def plaster(self, albedo: float, contrast: float) -> Texture:
        """Soft cloudy noise."""
        a, b = self._offset()
        return lambda u, v: np.asarray(albedo * (1.0 + contrast * self._noise(30 * u + a, 30 * v + b)))

    def wood(self, albedo: float) -> Texture:
        """Wavy grain along u."""
        a, b = self._offset()

        def texture(u: FloatArray, v: FloatArray) -> FloatArray:
            wavy = self._noise(6 * u + a, 40 * v + b)
            grain = np.sin(2 * np.pi * (9.0 * v + 0.5 * wavy))
            return np.asarray(albedo * (1.0 + 0.16 * grain + 0.05 * wavy))

        return texture

    def floor(self) -> Texture:
        """Tiles of 0.5 m in two tones with grout, and a round rug."""
        a, b = self._offset()
        rug_x, rug_z = self._rng.uniform(-0.1, 0.3), self._rng.uniform(-0.35, -0.1)

        def texture(u: FloatArray, v: FloatArray) -> FloatArray:
            i, j = np.floor(2.0 * u), np.floor(2.0 * v)
            base = np.where((i + j) % 2 == 0, 0.8, 0.34) * (1.0 + 0.1 * self._tone(i, j))
            edge = 0.25 - np.maximum(np.abs(u - 0.5 * i - 0.25), np.abs(v - 0.5 * j - 0.25))
            base = np.where(edge < 0.008, 0.2, base)
            r = np.hypot(u - rug_x, v - rug_z)
            on = np.flatnonzero(r < 1.1)
            base[on] = rug(r[on], np.arctan2(v[on] - rug_z, u[on] - rug_x))
            return base * (1.0 + 0.07 * self._noise(45 * u + a, 45 * v + b))

        def rug(r: FloatArray, angle: FloatArray) -> FloatArray:
            ring = np.searchsorted((0.3, 0.36, 0.85, 0.93, 1.02), r)
            tone = np.array((0.75, 0.15, 0.48, 0.85, 0.22, 0.6))[ring]
            petal = (r > 0.4) & (r < 0.4 + 0.38 * np.abs(np.sin(6.0 * angle)))
            return np.where(petal, 0.85, tone)

        return texture

    def painting(self, wall: Texture, centre: tuple[float, float], half: tuple[float, float]) -> Texture:
        """A framed landscape, sun over hills, on a wall."""
        sun = self._rng.uniform(-0.45, 0.45)
        phases = self._rng.uniform(0.0, 2 * np.pi, 3)

        def texture(u: FloatArray, v: FloatArray) -> FloatArray:
            x, y = (u - centre[0]) / half[0], (v - centre[1]) / half[1]
            picture = 0.45 + 0.25 * y
            disc = np.hypot((x - sun) * half[0] / half[1], y - 0.3)
            picture = np.where(disc < 0.3, 0.95, picture + 0.25 * np.exp(-2.5 * (disc - 0.3)))
            for k, (level, tone) in enumerate(((0.0, 0.5), (-0.3, 0.3), (-0.62, 0.12))):
                hills = 0.16 * np.sin((2.2 + k) * x + phases[k])
                hills += 0.07 * np.sin((5.1 + 2 * k) * x - phases[k])
                picture = np.where(y < level + hills, tone, picture)
            edge = np.maximum(np.abs(u - centre[0]) - half[0], np.abs(v - centre[1]) - half[1])
            framed = np.where(edge < 0.0, np.where(edge > -0.05, 0.9, picture), 0.1)
            return np.where(edge < 0.07, framed, wall(u, v))

        return texture

    def crate(self, half: float) -> Texture:
        """Slats in a frame with a diagonal brace."""
        wood = self.wood(0.62)

        def texture(u: FloatArray, v: FloatArray) -> FloatArray:
            x, y = u / half, v / half
            rim, across = np.maximum(np.abs(x), np.abs(y)), np.abs(x - y)
            front = (rim > 0.8) | (across < 0.2)
            seam = (np.abs(rim - 0.8) < 0.015) | ((np.abs(across - 0.2) < 0.02) & (rim < 0.8))
            slats = np.where(np.abs((y * 2.5) % 1.0 - 0.5) > 0.46, 0.2, 0.8)
            return np.asarray(wood(u, v) * np.where(seam, 0.35, np.where(front, 1.15, slats)))

        return texture

    def parcel(self, half: float) -> Texture:
        """Paper with a dark ribbon crosswise."""
        paper = self.plaster(0.8, 0.04)
        return lambda u, v: np.where(np.minimum(np.abs(u), np.abs(v)) < 0.18 * half, 0.12, paper(u, v))

    def ball(self) -> Texture:
        """Eight lunes in two tones with bright caps."""
        turn = self._rng.uniform(0.0, 2 * np.pi)
        skin = self.plaster(1.0, 0.03)

        def texture(u: FloatArray, v: FloatArray) -> FloatArray:
            lune = np.where(np.sin(4.0 * (u + turn)) > 0.0, 0.88, 0.3)
            return np.asarray(np.where(np.abs(v) > 1.2, 0.92, lune) * skin(u, v))

        return texture

    def globe(self) -> Texture:
        """Continents of noise on a dark sea."""
        a, b = self._offset()
        return lambda u, v: np.where(self._noise(22 * u + a, 22 * v + b) > 0.3, 0.85, 0.4)

    def lamp(self) -> Texture:
        """Paper with ribs along the parallels."""
        return lambda u, v: np.where(np.sin(18.0 * v) > 0.85, 0.45, 0.92)

    def books(self) -> Texture:
        """Five shelves of books of many widths, heights and tones."""

        def texture(u: FloatArray, v: FloatArray) -> FloatArray:
            shelf = np.floor(2.5 * (v + 1.0))
            up = v + 1.0 - 0.4 * shelf
            book = np.floor((u + 0.012 * np.sin(40.0 * u + shelf)) / 0.05)
            tone = self._tone(book, shelf)
            height = 0.3 + 0.05 * self._tone(book + 31.0, shelf)
            cover = 0.5 + 0.38 * tone
            cover = np.where(np.abs(up - 0.22) < 0.02, 0.9 - 0.6 * (tone > 0.3), cover)
            inside = (np.abs(u) < 0.7) & (up > 0.04)
            return np.where(inside, np.where(up < height, cover, 0.08), 0.42)

        return texture

    def chart(self) -> Texture:
        """Siemens star above a checker of halving squares."""

        def texture(u: FloatArray, v: FloatArray) -> FloatArray:
            y = v - 0.2
            r = np.hypot(u, y)
            star = np.where(np.sin(16.0 * np.arctan2(y, u)) > 0.0, 0.93, 0.05)
            period = 0.16 * 0.5 ** np.floor((u + 0.46) / 0.23)
            square = np.floor(2 * (u + 0.46) / period) + np.floor(2 * v / period)
            checker = np.where(square % 2 == 0, 0.93, 0.05)
            low = (v < -0.32) & (v > -0.64) & (np.abs(u) < 0.46)
            face = np.where(r < 0.43, star, np.where(low, checker, 0.93))
            return np.where(np.maximum(np.abs(u) / 0.52, np.abs(v) / 0.7) > 0.975, 0.08, face)

        return texture
