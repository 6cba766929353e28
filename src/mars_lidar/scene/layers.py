"""Scenes with several surfaces on the ray of a pixel: glass before a wall, nets, foliage, the two sides of an edge."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base import checks
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux
from mars_lidar.light.tolerances import TOL
from mars_lidar.scene.radiometry import scene_flux
from mars_lidar.scene.scene import Scene


class LayeredScene:
    """Several surfaces in the same pixels, one return each.

    Parameters
    ----------
    layers
        Scenes of one shape, up to 16, in any order; NaN in the depth of one: it has no surface there. Reflectivities
        share one scale and include what the surfaces before them let through. The first is the one whose depth and
        reflectivity count as the scene's, and its background map is taken for the ambient light.

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
            Without the pane.
        depth_m
            Range of the pane along every ray, m. Where the first layer is nearer the pane is hidden.
        reflectivity
            Of the pane, on the scale of the scene's, in [0, 1].
        transmission
            Share of the light that passes it on the way there and back, in (0, 1]: a factor on the reflectivity of
            everything farther away.
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

        so that all returns of a pixel together have the mean `signal`. Ambient ``"reflectivity"`` is the sum of the
        reflectivities of the surfaces in a pixel; in a pixel without any it is the largest reflectivity of all
        layers.
        """
        depth, share = (
            np.stack([getattr(layer, name) for layer in self.layers]) for name in ("depth_m", "reflectivity")
        )
        return scene_flux(depth, share, self.background, system, signal, sbr, attenuation, ambient, dark_count_hz)
