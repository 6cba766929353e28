"""The native core, compiled from `src/mars_lidar/native`: imported here, and nowhere else in the package."""

import mars_lidar._core as _core

__all__ = ["_core"]
