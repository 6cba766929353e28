"""The built-in scenes "room" and "random", and the ray-caster that renders them with exact depth, in NumPy.

One ray per pixel gives the depth (the range along the ray, which is what time of flight measures; it is never a mixture
of two surfaces). The reflectivity is ``albedo * cos(incidence)``, Lambert's law for a laser at the camera, averaged
over five rays where neighbouring pixels differ and one ray elsewhere. World axes: x right, y up, z forward, in metres.
A surface is a function ``albedo(u, v)`` of two coordinates on a face, in metres (on a sphere: longitude and latitude in
radians).

"random" is a different room, with other objects and another view, for every seed; it is fast to render, because
networks are trained on thousands of them. "room" has finer textures.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mars_lidar._base.types import FloatArray, NDArray

# --- The ray-caster ------------------------------------------------------------------------------------------------

Texture = Callable[[FloatArray, FloatArray], FloatArray]

# Four rays round the one through the pixel's centre, on a square turned by atan(1/2): no two share a row or a
# column, which smooths near-horizontal and near-vertical edges best.
_EXTRA = ((-0.375, -0.125), (-0.125, 0.375), (0.375, 0.125), (0.125, -0.375))
_TWO, _FOUR = np.int8(2), np.int8(4)  # numbers of faces and objects take a byte: they are compared again and again


@dataclass(frozen=True)
class Camera:
    """Pinhole camera with square pixels; the longer side of the image spans `field_of_view_deg`."""

    position: tuple[float, float, float]
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    field_of_view_deg: float = 60.0

    def rays(self, rows: FloatArray, columns: FloatArray, size: tuple[int, int]) -> FloatArray:
        """Unit directions (3, n) through the image points `rows`, `columns` (n,), in pixels."""
        height, width = size
        focal = 0.5 * max(size) / math.tan(0.5 * math.radians(self.field_of_view_deg))
        d = np.empty((3, rows.size))
        d[0] = (columns - 0.5 * (width - 1)) / focal
        d[1] = (0.5 * (height - 1) - rows) / focal
        d[2] = 1.0
        d /= np.sqrt(d[0] ** 2 + d[1] ** 2 + 1.0)
        d[1:] = _turn(d[1], d[2], self.pitch_deg)  # positive pitch looks up
        d[0], d[2] = _turn(d[0], d[2], self.yaw_deg)  # positive yaw looks right
        return d


def _turn(a: FloatArray, b: FloatArray, degrees: float) -> tuple[FloatArray, FloatArray]:
    """The vector (a, b) turned from b towards a."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return c * a + s * b, c * b - s * a


@dataclass(frozen=True)
class Box:
    """A box rotated by `yaw_deg` about the vertical, viewed from outside, or from `inside` (a room).

    `faces` are the textures of -x, +x, -y, +y, -z, +z. Texture coordinates are (z, y) on x faces, (x, z) on y
    faces and (x, y) on z faces, from the centre of the box.
    """

    centre: tuple[float, float, float]
    half: tuple[float, float, float]
    faces: tuple[Texture, ...]
    yaw_deg: float = 0.0
    inside: bool = False

    @property
    def radius(self) -> float:
        """Radius of the bounding sphere about the centre."""
        return math.hypot(*self.half)

    def _local(self, origin: FloatArray, d: FloatArray) -> tuple[FloatArray, FloatArray]:
        o = origin - self.centre
        if self.yaw_deg == 0.0:
            return o, d
        o[0], o[2] = _turn(o[0], o[2], -self.yaw_deg)
        x, z = _turn(d[0], d[2], -self.yaw_deg)
        return o, np.stack((x, d[1], z))

    def hit(self, origin: FloatArray, d: FloatArray) -> FloatArray:
        """Range (n,) at which rays (3, n) meet the box, inf for a miss: the slab method."""
        o, local = self._local(origin, d)
        enter, leave = np.full(d.shape[1], -np.inf), np.full(d.shape[1], np.inf)
        with np.errstate(divide="ignore", invalid="ignore"):  # a ray parallel to a face: +-inf, as wanted
            for k in range(3):
                inverse = 1.0 / local[k]
                middle, spread = -o[k] * inverse, self.half[k] * np.abs(inverse)
                np.fmax(enter, middle - spread, out=enter)
                np.fmin(leave, middle + spread, out=leave)
        return leave if self.inside else np.where((enter < leave) & (enter > 0.0), enter, np.inf)

    def light(self, origin: FloatArray, d: FloatArray, t: FloatArray) -> FloatArray:
        """Albedo times cosine of incidence (n,) where rays (3, n) meet the box at range `t`."""
        o, local = self._local(origin, d)
        x, y, z = o[:, None] + t * local
        # The face that holds the point is the one it is farthest out on, in half lengths.
        a, b, c = np.abs(x / self.half[0]), np.abs(y / self.half[1]), np.abs(z / self.half[2])
        up, out = (y > 0.0).view(np.int8) + _TWO, (z > 0.0).view(np.int8) + _FOUR
        face = np.where((a >= b) & (a >= c), (x > 0.0).view(np.int8), np.where(b >= c, up, out))
        light = np.empty(t.size)
        for k in range(6):
            (on,) = (face == k).nonzero()
            if on.size:
                u, v = ((z, y), (x, z), (x, y))[k // 2]
                light[on] = np.abs(local[k // 2].take(on)) * self.faces[k](u.take(on), v.take(on))
        return light


@dataclass(frozen=True)
class Sphere:
    """A sphere; its texture takes longitude and latitude in radians."""

    centre: tuple[float, float, float]
    radius: float
    texture: Texture

    def hit(self, origin: FloatArray, d: FloatArray) -> FloatArray:
        """Range (n,) at which rays (3, n) meet the sphere, inf for a miss."""
        o = origin - self.centre
        b = o[0] * d[0] + o[1] * d[1] + o[2] * d[2]  # not o @ d: BLAS libraries differ in the last bit
        discriminant = b * b - (o @ o - self.radius**2)
        t = -b - np.sqrt(np.maximum(discriminant, 0.0))
        return np.where((discriminant > 0.0) & (t > 0.0), t, np.inf)

    def light(self, origin: FloatArray, d: FloatArray, t: FloatArray) -> FloatArray:
        """Albedo times cosine of incidence (n,) where rays (3, n) meet the sphere at range `t`."""
        x, y, z = ((origin - self.centre)[:, None] + t * d) / self.radius
        cosine = -(x * d[0] + y * d[1] + z * d[2])
        return np.asarray(cosine * self.texture(np.arctan2(x, -z), np.arcsin(np.clip(y, -1.0, 1.0))))


def cast(
    objects: Sequence[Box | Sphere],
    camera: Camera,
    size: tuple[int, int],
    *,
    together: int = 1 << 14,
    contrast: float = 0.04,
) -> tuple[FloatArray, FloatArray]:
    """Depth (range along the ray, m; inf where nothing is hit) and reflectivity in [0, 1], each (H, W).

    Rays are cast `together`, so that their arrays stay in the second-level cache; pixels whose neighbours differ by
    more than `contrast` get the extra rays.
    """
    origin = np.array(camera.position)
    row, column = np.mgrid[0 : size[0], 0 : size[1]].astype(np.float64).reshape(2, -1)
    depth, centre = np.empty(row.size), np.empty(row.size)
    for first in range(0, row.size, together):
        part = slice(first, first + together)
        depth[part], centre[part] = _trace(objects, origin, camera.rays(row[part], column[part], size))
    reflectivity = centre.copy()
    uneven = np.flatnonzero(_uneven(centre.reshape(size), contrast))
    for first in range(0, uneven.size, together // len(_EXTRA)):
        some = uneven[first : first + together // len(_EXTRA)]
        down, right = np.array(_EXTRA).T[:, :, None]
        d = camera.rays((row[some] + down).ravel(), (column[some] + right).ravel(), size)
        light = _trace(objects, origin, d)[1].reshape(len(_EXTRA), -1)
        reflectivity[some] = (centre[some] + light.sum(0)) / (1 + len(_EXTRA))
    return depth.reshape(size), reflectivity.reshape(size)


def _uneven(image: FloatArray, contrast: float) -> NDArray[np.bool_]:
    """Pixels that differ from one of their four neighbours by more than `contrast`."""
    uneven = np.zeros(image.shape, dtype=np.bool_)
    for turned, unevenness in ((image, uneven), (image.T, uneven.T)):
        step = np.abs(turned[1:] - turned[:-1]) > contrast
        unevenness[1:] |= step
        unevenness[:-1] |= step
    return uneven


def _trace(objects: Sequence[Box | Sphere], origin: FloatArray, d: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Range to the nearest surface along each ray (3, n), and albedo times cosine of incidence there."""
    nearest = np.full(d.shape[1], np.inf)
    owner = np.full(d.shape[1], -1, dtype=np.int8 if len(objects) < 128 else np.intp)
    for k, thing in enumerate(objects):
        rays = _towards(thing, origin, d)
        if rays is not None and rays.size == 0:
            continue
        t = thing.hit(origin, d if rays is None else d.take(rays, axis=1))
        (hit,) = (t < (nearest if rays is None else nearest.take(rays))).nonzero()
        where = hit if rays is None else rays.take(hit)
        nearest[where] = t.take(hit)
        owner[where] = k
    light = np.zeros(d.shape[1])
    for k, thing in enumerate(objects):
        (where,) = (owner == k).nonzero()
        if where.size:
            light[where] = thing.light(origin, d.take(where, axis=1), nearest.take(where))
    return nearest, np.minimum(np.maximum(light, 0.0, out=light), 1.0, out=light)


def _towards(thing: Box | Sphere, origin: FloatArray, d: FloatArray) -> NDArray[np.intp] | None:
    """Numbers of the rays that meet the bounding sphere; None for all of them, from within it."""
    to = np.asarray(thing.centre) - origin
    distance = float(np.sqrt(to @ to))
    if distance <= thing.radius:
        return None
    cosine = math.sqrt(1.0 - (thing.radius / distance) ** 2)
    return ((to / distance) @ d >= cosine - 1e-12).nonzero()[0]


# --- The scene "room" ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Room:
    """The room, m: x in +-width / 2, y and z from 0; a door from x to x, and its height, to the passage behind."""

    width: float = 5.2
    height: float = 2.8
    length: float = 6.9
    door: tuple[float, float, float] = (0.5, 1.5, 2.1)
    passage: float = 1.55


_ROOM = _Room()


def room(size: tuple[int, int], seed: int) -> tuple[FloatArray, FloatArray]:
    """Depth (range along the ray, m) and reflectivity (Lambert cosine included), each (H, W)."""
    rng = np.random.default_rng(seed)
    paint = _Paint(rng)
    camera = Camera(position=(0.35, 1.5, 0.0), yaw_deg=-4.0, pitch_deg=-8.5, field_of_view_deg=58.0)
    depth, reflectivity = cast([*_walls(paint), *_furniture(paint, rng)], camera, size)
    return depth, reflectivity


def _walls(paint: _Paint) -> list[Box]:
    """The room, its back wall made of three boxes round a door, and the passage behind."""
    x0, x1, top = _ROOM.door
    half = 0.5 * _ROOM.width
    wall, side, end = paint.plaster(0.62, 0.07), paint.plaster(0.55, 0.06), paint.plaster(0.42, 0.1)
    floor, ceiling = paint.floor(), paint.plaster(0.78, 0.03)
    back = paint.painting(wall, centre=(-0.78, 1.72), half=(0.72, 0.5))
    far = 0.5 * (_ROOM.length + _ROOM.passage)
    faces = (side, side, floor, ceiling, wall, end)
    shell = Box((0.0, 0.5 * _ROOM.height, far), (half, 0.5 * _ROOM.height, far), faces, inside=True)

    def block(x0: float, x1: float, low: float) -> Box:
        x, y = 0.5 * (x0 + x1), 0.5 * (low + _ROOM.height)
        size = (x1 - x, _ROOM.height - y, 0.5 * _ROOM.passage)
        return Box((x, y, _ROOM.length + size[2]), size, (side, side, side, side, _moved(back, x, y), wall))

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
    cord = Box((lx, 0.5 * (low + _ROOM.height), lz), (0.012, 0.5 * (_ROOM.height - low), 0.012), (dark,) * 6)
    return [crate, parcel, ball, *table, board, post, shelf, lamp, cord]


class _Paint:
    """Textures that share one table of smooth noise, of `texels` (a power of two) per side."""

    texels = 128

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        # Periodic 1/f noise, zero mean and unit variance: one table serves every surface at its own offset.
        n = self.texels
        f = np.hypot(np.fft.fftfreq(n)[:, None], np.fft.rfftfreq(n)[None, :])
        f[0, 0] = np.inf
        noise = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((n, n))) / f**1.2, (n, n))
        noise = (noise - noise.mean()) / noise.std()
        self._table = np.pad(noise, (0, 1), mode="wrap").ravel()
        self._tones = rng.uniform(-1.0, 1.0, 1024)

    def _noise(self, u: FloatArray, v: FloatArray) -> FloatArray:
        """Noise at coordinates in texels, bilinear, periodic."""
        i, j = np.floor(u), np.floor(v)
        a, b = u - i, v - j
        row, width = i.astype(np.intp) & (self.texels - 1), self.texels + 1
        at = row * width + (j.astype(np.intp) & (self.texels - 1))
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
        a, b = self._rng.uniform(0.0, self.texels, 2)
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


# --- The scene "random" --------------------------------------------------------------------------------------------


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
