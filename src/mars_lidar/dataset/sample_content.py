"""What a sample shows: surfaces, in clear air or in fog, or rendered light; and its photons at a level of light."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mars_lidar._base.resample import area_mean, nearest, new_size, window
from mars_lidar._base.types import FloatArray
from mars_lidar.dataset.light import Light
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux
from mars_lidar.light.fog import Fog
from mars_lidar.light.tolerances import TOL
from mars_lidar.light.transient import Transient, parts_of
from mars_lidar.scene.layers import LayeredScene
from mars_lidar.scene.scene import Scene


@dataclass(frozen=True)
class Surfaces:
    """A scene, or one of several layers, lit by the laser; perhaps in fog."""

    scene: Scene | LayeredScene
    fog: Fog | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W)."""
        return self.scene.shape

    @property
    def layers(self) -> tuple[Scene, ...]:
        """All of them; one of an ordinary scene."""
        return self.scene.layers if isinstance(self.scene, LayeredScene) else (self.scene,)

    @property
    def depth_m(self) -> FloatArray:
        """Depth of the first layer, m, NaN where it has no surface."""
        return self.scene.depth_m

    @property
    def reflectivity(self) -> FloatArray:
        """Reflectivity of the first layer."""
        return self.scene.reflectivity

    @property
    def lit(self) -> bool:
        """Whether light returns from any pixel."""
        return any((one.reflectivity[one.valid] > 0.0).any() for one in self.layers)

    def resize(self, size: int | tuple[int, int]) -> Surfaces:
        """At another size."""
        return replace(self, scene=self.scene.resize(size))

    def __getitem__(self, key: Any) -> Surfaces:
        return replace(self, scene=self.scene[key])

    def waveform_parts(self, system: System) -> int:
        """Parts of the period in its waveforms; 0 where returns are enough."""
        return 0 if self.fog is None else TOL.parts_per_bin * system.bins

    def flux(
        self, system: System, light: Light, signal: float, sbr: float, dark: float | None = None, *, tell: bool = False
    ) -> Flux:
        """Photons; pixels without return or beyond the range are no matter for every sample, unless to `tell` them."""
        with warnings.catch_warnings():
            if not tell:
                warnings.simplefilter("ignore", UserWarning)
            clear = self.scene.flux(
                system,
                signal=signal,
                sbr=sbr,
                attenuation=light.attenuation,  # type: ignore[arg-type]  # checked by the recipe
                ambient=light.ambient,  # type: ignore[arg-type]
                dark_count_hz=light.dark_count_hz if dark is None else dark,
            )
        return clear if self.fog is None else self.fog.before(clear, system, signal)


@dataclass(frozen=True)
class Rendered:
    """Rendered light; depth and reflectivity are NaN where nobody tells them."""

    transient: Transient
    depth_m: FloatArray
    reflectivity: FloatArray
    pulse: bool = True

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W)."""
        return self.transient.shape

    @property
    def lit(self) -> bool:
        """Whether any pixel has light."""
        return bool((self.transient.totals > 0.0).any())

    def resize(self, size: int | tuple[int, int]) -> Rendered:
        """At another size: mean light, nearest depth."""
        height, width = new_size(size, self.shape)
        place = np.ix_(nearest(self.shape[0], height), nearest(self.shape[1], width))
        share = area_mean(area_mean(self.reflectivity, height, axis=0), width, axis=1)
        return replace(
            self, transient=self.transient.resize((height, width)), depth_m=self.depth_m[place], reflectivity=share
        )

    def __getitem__(self, key: Any) -> Rendered:
        keys = window("transient", key, self.shape)
        depth, share = self.depth_m[keys], self.reflectivity[keys]
        return replace(self, transient=self.transient[keys], depth_m=depth, reflectivity=share)

    def waveform_parts(self, system: System) -> int:
        """Parts of the period in its waveforms."""
        return parts_of(self.transient, system)

    def flux(
        self, system: System, light: Light, signal: float, sbr: float, dark: float | None = None, *, tell: bool = False
    ) -> Flux:
        """Photons, made row by row as they are used."""
        return self.transient.stored_flux(
            system,
            signal=signal if light.photons_per_unit is None else None,
            photons_per_unit=light.photons_per_unit,
            sbr=sbr,
            pulse=self.pulse,
            dark_count_hz=light.dark_count_hz if dark is None else dark,
        )


Shown = Surfaces | Rendered
