"""Scenes: surfaces, layers and built-in rooms, and their returned photons."""

from mars_lidar.scene.scene import LayeredScene, Scene

__all__ = ["LayeredScene", "Scene"]
