"""Scenes: surfaces, layers and built-in rooms, and the photons that they return."""

from mars_lidar.scene.scene import LayeredScene, Scene

__all__ = ["LayeredScene", "Scene"]
