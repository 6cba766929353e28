"""A small ray-caster in NumPy: boxes and spheres seen by a pinhole camera, for scenes with exact depth.

One ray per pixel gives the depth (the range along the ray, which is what time of flight measures; it is
never a mixture of two surfaces). The reflectivity is ``albedo * cos(incidence)``, Lambert's law for a laser
that sits at the camera, averaged over five rays where neighbouring pixels differ and one ray elsewhere.

World axes: x right, y up, z forward, in metres. A surface is a function ``albedo(u, v)`` of two coordinates
on a face, in metres (on a sphere: longitude and latitude in radians).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.types import FloatArray

Texture = Callable[[FloatArray, FloatArray], FloatArray]

_RAYS = 1 << 14  # cast together: their arrays stay in the second-level cache
# Four rays round the one through the pixel's centre, on a square turned by atan(1/2): no two share a row or a
# column, which smooths near-horizontal and near-vertical edges best.
_EXTRA = ((-0.375, -0.125), (-0.125, 0.375), (0.375, 0.125), (0.125, -0.375))
_TWO, _FOUR = np.int8(2), np.int8(4)  # numbers of faces and objects take a byte: they are compared again and again
_CONTRAST = 0.04  # neighbours that differ by more get the extra rays


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
    """A box turned by `yaw_deg` about the vertical, seen from outside, or from `inside` (a room).

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


def cast(objects: Sequence[Box | Sphere], camera: Camera, size: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """Depth (range along the ray, m; inf where nothing is hit) and reflectivity in [0, 1], each (H, W)."""
    origin = np.array(camera.position)
    row, column = np.mgrid[0 : size[0], 0 : size[1]].astype(np.float64).reshape(2, -1)
    depth, centre = np.empty(row.size), np.empty(row.size)
    for first in range(0, row.size, _RAYS):
        part = slice(first, first + _RAYS)
        depth[part], centre[part] = _trace(objects, origin, camera.rays(row[part], column[part], size))
    reflectivity = centre.copy()
    uneven = np.flatnonzero(_uneven(centre.reshape(size)))
    for first in range(0, uneven.size, _RAYS // len(_EXTRA)):
        some = uneven[first : first + _RAYS // len(_EXTRA)]
        down, right = np.array(_EXTRA).T[:, :, None]
        d = camera.rays((row[some] + down).ravel(), (column[some] + right).ravel(), size)
        light = _trace(objects, origin, d)[1].reshape(len(_EXTRA), -1)
        reflectivity[some] = (centre[some] + light.sum(0)) / (1 + len(_EXTRA))
    return depth.reshape(size), reflectivity.reshape(size)


def _uneven(image: FloatArray) -> NDArray[np.bool_]:
    """Pixels that differ from one of their four neighbours."""
    uneven = np.zeros(image.shape, dtype=np.bool_)
    for turned, told in ((image, uneven), (image.T, uneven.T)):
        step = np.abs(turned[1:] - turned[:-1]) > _CONTRAST
        told[1:] |= step
        told[:-1] |= step
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
        (seen,) = (t < (nearest if rays is None else nearest.take(rays))).nonzero()
        where = seen if rays is None else rays.take(seen)
        nearest[where] = t.take(seen)
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
