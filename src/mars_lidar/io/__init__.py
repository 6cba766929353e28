"""Files: histogram cubes with everything that is needed to make them again.

Every library is imported when its format is first used.
"""

from mars_lidar.io.cube import SUFFIXES, Cube, load, save
from mars_lidar.io.recipe import Recipe
from mars_lidar.io.store import IncompleteFileError
from mars_lidar.io.stream import Interrupted, WriteError, Written, regenerate, simulate_to, verify

__all__ = [
    "SUFFIXES",
    "Cube",
    "IncompleteFileError",
    "Interrupted",
    "Recipe",
    "WriteError",
    "Written",
    "load",
    "regenerate",
    "save",
    "simulate_to",
    "verify",
]
