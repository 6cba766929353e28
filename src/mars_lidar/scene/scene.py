"""Scenes: depth, reflectivity and ambient light of each pixel.

A `Scene` has one surface on the ray of a pixel, a `LayeredScene` several: glass before a wall, nets, foliage, the two
sides of an edge.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked, checked_with_masks, constructed_by_name
from mars_lidar._base.display import as_html
from mars_lidar._base.files import reading
from mars_lidar._base.imports import late
from mars_lidar._base.resample import area_mean, image_size, nearest, new_size, window
from mars_lidar._base.types import ArrayLike, FloatArray, NDArray
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux
from mars_lidar.light.tolerances import TOL
from mars_lidar.scene.radiometry import scene_flux

_EXAMPLES = ("room", "random")


@constructed_by_name
@dataclass(frozen=True, eq=False, init=False, repr=False)
class Scene:
    """Depth, reflectivity and ambient light of each pixel.

    Parameters
    ----------
    depth_m
        Range z along the ray of each pixel (H, W), m, with the delay 2 z / c. Positive, or NaN for "no return". Masked
        entries of a masked array are also "no return".
    reflectivity
        Relative fraction of the laser light that returns, in [0, 1]: (H, W), or one number for all pixels. It includes
        all factors but distance: albedo, incidence (Lambert's cosine), and transmission.
    background
        Relative ambient light at each pixel (H, W), >= 0, in any unit; `flux` scales it. None: see the argument
        `ambient` of `flux`.

    Attributes
    ----------
    depth_m, reflectivity, background
        Read-only float64 (H, W); `background` may be None.
    valid
        Pixels with a return (H, W), bool.

    Raises
    ------
    ValueError
        Maps of different shapes, a depth that is not positive, a reflectivity outside [0, 1]; the message names the
        pixel.
    TypeError
        A map without real numbers.

    See Also
    --------
    Flux, simulate

    Examples
    --------
    >>> import mars_lidar as ml
    >>> scene = ml.Scene.example("room", size=(48, 64))
    >>> scene.depth_m.shape
    (48, 64)
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> scene.flux(system, signal=0.5, sbr=1.0).signal.mean().round(3)
    np.float64(0.5)
    """

    depth_m: FloatArray
    reflectivity: FloatArray
    background: FloatArray | None

    @checked_with_masks
    def __init__(self, depth_m: ArrayLike, reflectivity: ArrayLike, background: ArrayLike | None = None) -> None:
        depth = _numbers("depth_m", depth_m)
        if depth.ndim != 2 or depth.size == 0:
            raise ValueError(f"depth_m must be (H, W) with at least one pixel, got shape {depth.shape}")
        with np.errstate(invalid="ignore"):  # beyond the Moon a double no longer resolves delays to a picosecond
            wrong = ~np.isnan(depth) & ~((depth > 0.0) & (depth <= 1e9))
        _refuse("depth_m", depth, wrong, "in (0, 1e+09] m, or NaN for no return")
        share = _like("reflectivity", reflectivity, depth.shape)
        _refuse("reflectivity", share, ~((share >= 0.0) & (share <= 1.0)), "in [0, 1]")
        ambient = None
        if background is not None:
            ambient = _like("background", background, depth.shape)
            _refuse("background", ambient, ~((ambient >= 0.0) & (ambient < np.inf)), "finite and >= 0")
        self._fill(depth, share, ambient)

    def _fill(self, depth: FloatArray, reflectivity: FloatArray, background: FloatArray | None) -> None:
        for name, value in (("depth_m", depth), ("reflectivity", reflectivity), ("background", background)):
            if value is not None:
                value = np.array(value, dtype=np.float64, order="C")
                value.flags.writeable = False
            object.__setattr__(self, name, value)

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W)."""
        return self.depth_m.shape[0], self.depth_m.shape[1]

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Pixels with a return (H, W)."""
        return ~np.isnan(self.depth_m)

    def __repr__(self) -> str:
        h, w = self.shape
        z = self.depth_m[self.valid]
        span = f"depth {z.min():.4g} to {z.max():.4g} m" if z.size else "no return anywhere"
        lost = f", {h * w - z.size} pixels without return" if 0 < z.size < h * w else ""
        ambient = "" if self.background is None else ", background map"
        share = self.reflectivity
        return f"Scene({h} x {w} pixels, {span}{lost}, reflectivity {share.min():.3g} to {share.max():.3g}{ambient})"

    def _repr_html_(self) -> str:
        return as_html(self, {"depth (m)": self.depth_m, "reflectivity": self.reflectivity})

    def __getitem__(self, key: Any) -> Scene:
        """A crop: ``scene[rows, columns]`` with slices."""
        keys = window("scene", key, self.shape)
        return self._with(lambda depth: depth[keys], lambda image: image[keys])

    def resize(self, size: int | tuple[int, int]) -> Scene:
        """The scene at another size.

        Depth is that of the nearest pixel, so that it is never averaged across an edge and NaN remains NaN;
        reflectivity and background are means over the area of the new pixel.

        Parameters
        ----------
        size
            (H, W), or the longer side, with the aspect ratio preserved.
        """
        height, width = new_size(size, self.shape)
        rows, columns = nearest(self.shape[0], height), nearest(self.shape[1], width)
        return self._with(
            lambda depth: depth[np.ix_(rows, columns)],
            lambda image: area_mean(area_mean(image, height, axis=0), width, axis=1),
        )

    def _with(self, depth: Any, image: Any) -> Scene:
        scene = Scene.__new__(Scene)
        background = None if self.background is None else image(self.background)
        scene._fill(depth(self.depth_m), image(self.reflectivity), background)
        return scene

    def flux(
        self,
        system: System,
        *,
        signal: float,
        sbr: float,
        attenuation: Literal["none", "inverse_square"] = "none",
        ambient: Literal["uniform", "reflectivity", "map"] | None = None,
        dark_count_hz: float = 0.0,
    ) -> Flux:
        """The photon flux at each pixel, at a stated mean signal level and signal-to-background ratio.

        With V the set of valid pixels (those with a return), z the depth, rho the reflectivity::

            S   = signal * w / mean_V(w),             w = rho * g(z),   g = 1 or 1 / z^2
            B   = signal / sbr * a / mean_V(a)  +  dark_count_hz * t_r / detection_efficiency
            tau = 2 z / c

        so that ``mean_V(S) = signal`` and ``mean_V(S) / mean_V(B - dark) = sbr``. Pixels without return have
        S = 0, tau = NaN and the B of the formula.

        Parameters
        ----------
        system
            The system with the laser period t_r.
        signal
            Mean signal photons per laser period at the detector over the valid pixels, > 0; engines apply its
            `detection_efficiency` (`Flux.detected`).
        sbr
            Mean signal over mean *ambient* photons, both over the valid pixels and per laser period, in
            (0, inf]; inf: no ambient light. Dark counts are not included in the ratio and are added.
        attenuation
            g(z): ``"none"`` (distance already in the reflectivity, or compensated) or ``"inverse_square"``.
        ambient
            a: ``"uniform"``, ``"reflectivity"`` (sunlight or lamps scattered by the same surface; radiance
            does not decrease with distance) or ``"map"`` (the scene's background map). None: the map if the scene has
            one, else uniform.
        dark_count_hz
            Dark counts of every pixel, counts/s, in addition to those of the detector (`Detector.dark_count_hz`); not
            reduced by the detection efficiency.

        Returns
        -------
        Flux
            Its `info` contains the parameters, the achieved means and numbers of pixels, as plain JSON types;
            an infinite ratio is None.

        Warns
        -----
        UserWarning
            Pixels without return; pixels whose depth reaches the unambiguous range c t_r / 2.

        Raises
        ------
        TypeError, ValueError
            An argument of another type or out of range; no valid pixel; a level or ratio that cannot be
            reached because reflectivity or ambient light is zero at every valid pixel.
        """
        maps = self.depth_m[None], self.reflectivity[None], self.background
        return scene_flux(*maps, system, signal, sbr, attenuation, ambient, dark_count_hz)

    @staticmethod
    def example_names() -> tuple[str, ...]:
        """Names of the built-in scenes of `example`."""
        return _EXAMPLES

    @classmethod
    def example(cls, name: str = "room", size: int | tuple[int, int] = 128, seed: int = 0) -> Scene:
        """A built-in scene, ray-cast by this package: no files needed, exact depth, any size.

        ``"room"``: walls, floor, a door to a passage, boxes, spheres, a table, a test chart; 2.4 to 8.7 m.
        ``"random"``: a different room with boxes and spheres, and a different view, for every seed; up to 17 m.
        Depth is the range along the ray of the pixel's centre; reflectivity is albedo times the cosine of
        incidence (Lambert, laser at the camera).

        Parameters
        ----------
        name
            One of `example_names()`.
        size
            (H, W), or one number for a square. The longer side always spans the same field of view.
        seed
            Positions, sizes and textures; the same seed gives the same scene at every size.
        """
        checks.choice("name", name, _EXAMPLES)
        seed = checks.integer("seed", seed, low=0, high=2**64 - 1)
        shape = image_size(size if isinstance(size, tuple | list) else (size, size))
        if name == "random":
            from mars_lidar.scene.rooms import random_scene

            return cls(*random_scene(shape, seed))
        from mars_lidar.scene.rooms import room

        return cls(*room(shape, seed))

    @classmethod
    @checked
    def from_rgbd(
        cls,
        depth_path: str | Path,
        image_path: str | Path | None = None,
        *,
        size: int | tuple[int, int] | None = None,
        depth_unit_m: float | None = None,
        focal_px: float | None = None,
        index: int | None = None,
        max_depth_m: float | None = None,
    ) -> Scene:
        """A scene from a depth file and an image; formats: `mars_lidar.io.rgbd.read_rgbd`.

        Parameters
        ----------
        depth_path
            16-bit PNG (or TIFF), ``.pfm``, ``.exr``, ``.npy``, ``.npz``, NYUv2's labelled ``.mat``, or the
            folder of a Middlebury scene.
        image_path
            Image whose linear luminance is used as the reflectivity; None: that of the depth file or folder, else 1
            everywhere.
        size
            As for `resize`; None: the size of the files.
        depth_unit_m
            Metres per stored unit of depth; None: 0.001 (mm) for 16-bit images, 1 (m) for arrays.
        focal_px
            Focal length in pixels of the depth file: converts depth perpendicular to the image plane, as
            measured by RGB-D cameras, to range along the ray. None: the depth is used unchanged.
        index
            Frame of a NYUv2 ``.mat``, from 0; None for everything else.
        max_depth_m
            Depths beyond this, m, are treated as no return (sky, a far wall); None: no limit.

        Raises
        ------
        ValueError
            A file that is missing, damaged or of another kind: the message names it and the reason.
        """
        if size is not None:  # refuse a bad size before reading anything
            cls(np.ones((1, 1)), 1.0).resize(size)
        read = late("io.rgbd:read_rgbd")(
            depth_path, image_path, depth_unit_m=depth_unit_m, focal_px=focal_px, index=index, max_depth_m=max_depth_m
        )
        with reading(depth_path, "a scene"):
            scene = cls(*read)
        return scene if size is None else scene.resize(size)


def _numbers(name: str, value: ArrayLike) -> FloatArray:
    if isinstance(value, np.ma.MaskedArray):
        if name != "depth_m" and np.ma.is_masked(value):
            raise ValueError(f"{name} must not have masked entries; mark pixels without return in depth_m")
        value = np.ma.filled(value.astype(np.float64), np.nan)
    array = np.asarray(value)
    if array.dtype.kind not in "fiu":
        raise TypeError(f"{name} must be real numbers, got dtype {array.dtype}")
    return array.astype(np.float64)


def _like(name: str, value: ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    array = _numbers(name, value)
    if array.shape not in ((), shape):
        raise ValueError(f"{name} must have the shape of depth_m, {shape}, or be a scalar, got {array.shape}")
    return np.broadcast_to(array, shape)


def _refuse(name: str, array: FloatArray, wrong: NDArray[np.bool_], allowed: str) -> None:
    if wrong.any():
        where = tuple(int(k) for k in np.argwhere(wrong)[0])
        raise ValueError(f"{name} must be {allowed}, got {array[where]} at pixel {where}")


class LayeredScene:
    """Several surfaces in the same pixels, one return each.

    Parameters
    ----------
    layers
        Scenes of one shape, up to 16, in any order; NaN in the depth of a layer: no surface. Reflectivities have a
        common scale and include the transmission of nearer surfaces. Depth and reflectivity of the scene are those of
        the first layer, whose background map is the ambient light.

    Attributes
    ----------
    shape, depth_m, reflectivity, background
        Those of the first layer.
    """

    def __init__(self, layers: Sequence[Scene]) -> None:
        self.layers = tuple(layers)
        if not 1 <= len(self.layers) <= TOL.returns or not all(isinstance(layer, Scene) for layer in self.layers):
            raise ValueError(f"layers must be 1 to {TOL.returns} Scenes, got {layers!r}")
        if len({layer.shape for layer in self.layers}) > 1:
            raise ValueError(f"layers must have one shape, got {[layer.shape for layer in self.layers]}")
        first = self.layers[0]
        self.shape, self.depth_m, self.reflectivity = first.shape, first.depth_m, first.reflectivity
        self.background = first.background

    @classmethod
    def behind_pane(
        cls, scene: Scene | LayeredScene, depth_m: float, reflectivity: float, transmission: float = 1.0
    ) -> LayeredScene:
        """A scene behind a pane at one range.

        Parameters
        ----------
        scene
            The scene without the pane.
        depth_m
            Range of the pane along every ray, m. The pane is hidden where the first layer is nearer.
        reflectivity
            Reflectivity of the pane, on the scale of the scene, in [0, 1].
        transmission
            Fraction of the light that passes the pane there and back, in (0, 1]: a factor on the reflectivity of all
            surfaces farther away.
        """
        depth = checks.real("depth_m", depth_m, low=0.0, strict_low=True)
        share = checks.real("reflectivity", reflectivity, low=0.0, high=1.0)
        passed = checks.real("transmission", transmission, low=0.0, high=1.0, strict_low=True)
        layers = scene.layers if isinstance(scene, LayeredScene) else (scene,)

        def dimmed(layer: Scene) -> Scene:
            far = np.nan_to_num(layer.depth_m, nan=np.inf) > depth
            return Scene(layer.depth_m, np.where(far, passed, 1.0) * layer.reflectivity, layer.background)

        pane = np.where(layers[0].depth_m <= depth, np.nan, depth)
        return cls([*map(dimmed, layers), Scene(pane, share)])

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Pixels with a return from any layer (H, W)."""
        return np.asarray(np.stack([layer.valid for layer in self.layers]).any(axis=0))

    def __repr__(self) -> str:
        return f"LayeredScene({len(self.layers)} layers, the first {self.layers[0]!r})"

    def __getitem__(self, key: Any) -> LayeredScene:
        """A crop, as of a `Scene`."""
        return LayeredScene([layer[key] for layer in self.layers])

    def resize(self, size: int | tuple[int, int]) -> LayeredScene:
        """At another size, as `Scene.resize`."""
        return LayeredScene([layer.resize(size) for layer in self.layers])

    def flux(
        self,
        system: System,
        *,
        signal: float,
        sbr: float,
        attenuation: Literal["none", "inverse_square"] = "none",
        ambient: Literal["uniform", "reflectivity", "map"] | None = None,
        dark_count_hz: float = 0.0,
    ) -> Flux:
        """The photon flux, one return for each layer.

        As `Scene.flux`, with V the pixels in which any layer has a surface, w_k = rho_k g(z_k), and one scale for all::

            S_k = signal * w_k / mean_V(sum_k w_k)

        so that the sum of all returns of a pixel has the mean `signal`. Ambient ``"reflectivity"`` is the sum of the
        reflectivities of the surfaces in a pixel; in a pixel without a surface it is the largest reflectivity of all
        layers.
        """
        depth, share = (
            np.stack([getattr(layer, name) for layer in self.layers]) for name in ("depth_m", "reflectivity")
        )
        return scene_flux(depth, share, self.background, system, signal, sbr, attenuation, ambient, dark_count_hz)
