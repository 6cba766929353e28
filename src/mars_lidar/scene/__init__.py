"""Scenes: surfaces, layers and built-in rooms, and the photons that they return."""

from mars_lidar.scene.layers import LayeredScene
from mars_lidar.scene.scene import Scene

__all__ = ["LayeredScene", "Scene"]
