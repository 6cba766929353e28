"""The native core, compiled from `src/mars_lidar/native`: imported here, and nowhere else in the package."""

from mars_lidar import _core as _core

__all__ = ["_core"]
